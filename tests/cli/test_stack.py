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

"""``semcal stack`` of scans at 0 and 90 degrees."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import tifffile

from tests.helpers.semcal_runs import run
from tests.helpers.turned_scans import scan, surface

GIVEN = ("--pixel-size", "10nm")


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    """Two scans of 320 x 256 px; the drift of the first is 8 px in x, that of the second 6 px in y."""
    folder = tmp_path / "pair"
    folder.mkdir()
    shown = surface(1)
    for k, way in enumerate(((8.0, 0.0), (0.0, 6.0))):
        image = scan(shown, lambda u, way=way: u[..., None] * np.array(way), (320, 256), 90.0 * k)
        tifffile.imwrite(folder / f"{k}.tif", image)
    return folder


def test_a_pair_is_averaged_without_the_drift_of_its_lines(pair, tmp_path, capsys):
    out, sigma = tmp_path / "out.tif", tmp_path / "sigma.tif"
    assert run("stack", pair, *GIVEN, "--scan-pairs", 90, "-o", out, "--sigma", sigma) == 0
    said = capsys.readouterr().out
    found = re.findall(r"drift within (\S+) px in x and (\S+) px in y", said)
    # From the first knot to the last of five; three standard deviations of an outer one.
    assert np.array(found, dtype=float) == pytest.approx(
        np.array([[6.4, 0.0], [0.0, 4.8]]), abs=0.3
    )
    assert "2 of 2 frames averaged" in said
    mean = tifffile.imread(out)
    assert mean.shape == tifffile.imread(sigma).shape == (256, 256)
    rows, cols = np.indices((256, 256), dtype=float)
    # Where the specimen was in the middle of the first scan.
    expected = 128.0 + 40.0 * surface(1)(cols - 127.5 - 4.0, rows - 127.5)
    seen = np.isfinite(mean)
    assert np.corrcoef(mean[seen], expected[seen])[0, 1] > 0.97


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--scan-pairs", -90), "other sense of rotation"),
        (("--scan-pairs", 45), "expected 90 or -90"),
        (("--scan-pairs", 90, "--video", "film.mp4"), "--scan-pairs together with --video"),
        (("--scan-pairs", "90deg", "--no-drift"), "--scan-pairs together with --no-drift"),
        (("--scan-pairs", 90, "--interpolation", "linear"), "together with --interpolation"),
        (("--scan-pairs", "90,0"), "not one angle"),
    ],
)
def test_what_cannot_be_averaged_is_refused(pair, tmp_path, capsys, monkeypatch, options, message):
    monkeypatch.chdir(tmp_path)
    assert run("stack", pair, *GIVEN, *options, "-o", "out.tif") == 2
    assert message in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["pair"]


def test_a_single_scan_is_no_pair(pair, tmp_path, capsys):
    out = tmp_path / "out.tif"
    assert run("stack", pair / "0.tif", *GIVEN, "--scan-pairs", 90, "-o", out) == 2
    assert "1 frame for --scan-pairs" in capsys.readouterr().err
    assert not out.exists()
