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

"""Every command with a single image, and with what is none: done, or refused in one line; never a traceback."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from semcal_ros.cli import main
from tests.helpers.node_scenes import make_calibration

# What each command needs beside the recording; the folder is that of its outputs.
COMMANDS: dict[str, Callable[[Path], list[object]]] = {
    "info": lambda _: ["info"],
    "calibrate": lambda f: ["calibrate", "-o", f / "new.yaml"],
    "check": lambda f: ["check", f / "cal.yaml"],
    "update": lambda f: ["update", "-o", f / "new.yaml", f / "cal.yaml"],
    "evaluate": lambda f: ["evaluate", f / "cal.yaml"],
    "drift": lambda f: ["drift", "-o", f / "drift.csv"],
    "rectify": lambda f: ["rectify", "--calibration", f / "cal.yaml", "-o", f / "flat.tif"],
    "stack": lambda f: ["stack", "-o", f / "mean.tif"],
    "cantilever": lambda f: [
        *("measure", "cantilever", "--calibration", f / "cal.yaml", "--length", "5um"),
        *("--base", "10,48", "--tip", "80,48", "-o", f / "bending.csv"),
    ],
    "ball": lambda f: ["reconstruct", "--calibration", f / "cal.yaml", "-o", f / "ball.ply"],
    "tilts": lambda f: ["reconstruct", "--tilts", "0deg,10deg", "-o", f / "heights.tif"],
    "import": lambda f: ["import", "--", f / "bag"],
}
# With one image of a specimen, these have a result; the others say what they lack.
DONE = {"info", "drift", "rectify", "stack", "import"}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    make_calibration().save(tmp_path / "cal.yaml")
    return tmp_path


def run(command: str, folder: Path, recording: Path) -> int:
    given = COMMANDS[command](folder)
    scale: list[object] = ["--pixel-size", "600nm"]
    if command == "import":
        return main([str(a) for a in ["import", *scale, recording, folder / "bag"]])
    return main([str(a) for a in [*given, *scale, recording]])


@pytest.mark.parametrize("command", COMMANDS)
def test_one_image_is_enough_or_refused_in_one_line(
    command: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    noise = np.random.default_rng(0).normal(size=(96, 96)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    path = folder / "one.png"
    cv2.imwrite(str(path), np.clip(128 + 40 * smooth / smooth.std(), 0, 255).astype(np.uint8))
    status = run(command, folder, path)
    said = capsys.readouterr().err
    if command in DONE:
        assert status == 0, said
        return
    lines = [line for line in said.splitlines() if line.startswith("semcal:")]
    assert status == 2 and len(lines) == 1, said
    assert "; " in lines[0] or "expected" in lines[0]


@pytest.mark.parametrize("command", COMMANDS)
def test_what_is_no_image_is_refused_in_one_line(
    command: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "empty").mkdir()
    (folder / "notes.txt").write_text("no image")
    (folder / "zero.png").touch()
    whole = cv2.imencode(".png", np.random.default_rng(0).integers(0, 255, (96, 96), np.uint8))[1]
    (folder / "cut.png").write_bytes(whole.tobytes()[:400])
    (folder / "cut.tif").write_bytes(b"II*\0\x08\0\0\0")
    before = sorted(folder.iterdir())
    for name in ("empty", "notes.txt", "zero.png", "cut.png", "cut.tif", "missing"):
        assert run(command, folder, folder / name) == 2, name
        said = capsys.readouterr().err
        assert len([t for t in said.splitlines() if t.startswith("semcal:")]) == 1, said
        assert name in said
    # Nothing is left behind.
    assert sorted(folder.iterdir()) == before
