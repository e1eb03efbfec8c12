# Copyright 2026 semcal_ros maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""``semcal drift``, ``stack`` and ``rectify`` where little or nothing can be tracked."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from rosbags.highlevel import AnyReader

from semcal_ros.bridge.drift import UNKNOWN_VARIANCE
from tests.helpers.node_scenes import make_calibration
from tests.helpers.semcal_runs import run

GIVEN = ("--pixel-size", "10nm", "--frame-interval", "1s")


def speckle(seed: int) -> np.ndarray:
    """A (96, 128) picture of a place of its own."""
    rng = np.random.default_rng(seed)
    smooth = cv2.GaussianBlur(rng.normal(size=(96, 128)), (0, 0), 2.0)
    noisy = 120.0 + 35.0 * smooth / smooth.std() + rng.normal(0.0, 3.0, smooth.shape)
    return np.clip(noisy, 0, 255).astype(np.uint8)


def folder(path: Path, seeds: Sequence[int]) -> Path:
    """Pictures of the places ``seeds``; the same place comes with other noise and nothing moved."""
    path.mkdir()
    rng = np.random.default_rng(99)
    for k, seed in enumerate(seeds):
        image = speckle(seed) + rng.normal(0.0, 3.0, (96, 128))
        cv2.imwrite(str(path / f"{k:04d}.png"), np.clip(image, 0, 255).astype(np.uint8))
    return path


def test_nothing_tracked_has_no_sigma_no_rate_and_exit_1(tmp_path, capsys):
    """Each frame shows another place: where the specimen is, nobody can know."""
    table, plot = tmp_path / "d.csv", tmp_path / "d.png"
    source = folder(tmp_path / "places", range(4))
    command = ("drift", source, *GIVEN, "-o", table, "--plot", plot, "--forecast", 10)
    assert run(*command) == 1
    captured = capsys.readouterr()
    assert "none of 4 frames was tracked" in captured.err
    assert "rate" not in captured.out and "after the last frame" not in captured.out
    with table.open() as file:
        sigma = [float(row["sigma_x_m"]) for row in csv.DictReader(file)]
    assert sigma[0] == 0.0 and all(math.isinf(s) for s in sigma[1:])


def test_one_matched_frame_is_enough_for_a_rate(tmp_path, capsys):
    source = folder(tmp_path / "same", (0, 0))
    assert run("drift", source, *GIVEN, "-o", tmp_path / "d.csv") == 0
    captured = capsys.readouterr()
    assert "final drift rate" in captured.out and "warning" not in captured.err


def test_a_stack_of_one_frame_in_five_warns_with_the_reasons(tmp_path, capsys):
    command = ("stack", folder(tmp_path / "places", range(5)), *GIVEN, "-o", tmp_path / "s.tif")
    assert run(*command) == 0
    warning = next(line for line in capsys.readouterr().err.splitlines() if "warning" in line)
    assert "4 of 5 frames left out: 4 frames: no shift stands out" in warning


def test_a_single_frame_is_its_own_stack_and_drift(tmp_path, capsys):
    source = folder(tmp_path / "one", (0,))
    assert run("drift", source, *GIVEN, "-o", tmp_path / "d.csv", "--forecast", 10) == 0
    assert run("stack", source, *GIVEN, "-o", tmp_path / "s.tif") == 0
    assert run("info", source, *GIVEN) == 0
    captured = capsys.readouterr()
    assert "rate" not in captured.out and "warning" not in captured.err


def test_rectify_says_that_the_drift_was_left_in(tmp_path, capsys):
    make_calibration().save(tmp_path / "cal.yaml")
    given = (
        "--pixel-size",
        "600nm",
        "--frame-interval",
        "1s",
        "--calibration",
        tmp_path / "cal.yaml",
    )
    for seeds, expected in ((range(4), True), ((0, 0), False)):
        source = folder(tmp_path / f"places{len(seeds)}", seeds)
        assert run("rectify", source, *given, "-o", tmp_path / f"flat{len(seeds)}.tif") == 0
        assert ("was tracked: the drift is not known" in capsys.readouterr().err) == expected
    # On the topics of a bag, as on those of the nodes: what is not observed.
    assert run("rectify", tmp_path / "places4", *given, "-o", tmp_path / "bag") == 0
    with AnyReader([tmp_path / "bag"]) as reader:
        links = [c for c in reader.connections if c.topic == "/sem/drift"]
        drifts = [reader.deserialize(m[2], m[0].msgtype).pose for m in reader.messages(links)]
    assert drifts[0].covariance[0] < 1e-12
    assert len(drifts) == 4 and all(d.covariance[0] == UNKNOWN_VARIANCE for d in drifts[1:])
