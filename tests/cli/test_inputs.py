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

"""Every command with every kind of input: done, or refused in one line; never a traceback."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
import tifffile

from semcal_ros.cli import main
from tests.helpers.node_scenes import make_calibration, write_recording
from tests.helpers.sem_files import save_sem_tiff

# What each command needs beside the recording; the folder is that of its outputs.
COMMANDS: dict[str, Callable[[Path], list[object]]] = {
    "info": lambda _: ["info"],
    "calibrate": lambda f: ["calibrate", "-o", f / "new.yaml"],
    "check": lambda f: ["check", f / "cal.yaml"],
    "update": lambda f: ["update", "-o", f / "new.yaml", f / "cal.yaml"],
    "extend": lambda f: ["extend", "-o", f / "new.yaml", f / "cal.yaml"],
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
    # Only what is refused before ROS is loaded.
    "play": lambda _: ["play"],
    "doctor": lambda _: ["doctor"],
}
BAGS_ONLY = ("play", "doctor")
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
    if command in BAGS_ONLY:
        return main([command, str(recording)])
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
    assert ("semcal import" in lines[0]) == (command in BAGS_ONLY)


@pytest.mark.parametrize("command", BAGS_ONLY)
def test_images_are_no_bag_and_the_command_that_makes_one_is_told(
    command: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    each(folder / "my scans", _plain("png"))
    for name in ("my scans", "my scans/f*.png"):
        assert main([command, str(folder / name)]) == 2
        assert f"`semcal import '{folder / name}' BAG`" in capsys.readouterr().err


def test_a_folder_of_folders_names_the_one_with_images(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "day" / "notes").mkdir(parents=True)
    assert main(["info", str(folder / "day")]) == 2
    assert "check the path" in capsys.readouterr().err
    each(folder / "day" / "session 2", _plain("png"))
    assert main(["info", str(folder / "day")]) == 2
    assert f"give one, such as {folder}/day/session 2" in capsys.readouterr().err


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
    (folder / "cut.mp4").write_bytes(b"\0\0\0\x20ftypisom")
    (folder / "cut.mcap").write_bytes(b"\x89MCAP0\r\n")
    before = sorted(folder.iterdir())
    names = (
        "empty",
        "notes.txt",
        "zero.png",
        "cut.png",
        "cut.tif",
        "cut.mp4",
        "cut.mcap",
        "missing",
    )
    for name in (*names, "no*.png"):
        assert run(command, folder, folder / name) == 2, name
        said = capsys.readouterr().err
        assert len([t for t in said.splitlines() if t.startswith("semcal:")]) == 1, said
        assert name in said
    # Nothing is left behind.
    assert sorted(folder.iterdir()) == before


# The specimen moves by so much from frame to frame, px.
STEP = np.array([1.25, -0.5])


def frames(dtype: str) -> list[np.ndarray]:
    """Four frames of a specimen that moves."""
    noise = np.random.default_rng(0).normal(size=(160, 160)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    grey = np.clip(128.0 + 40.0 * smooth / smooth.std(), 0, 255)
    out = []
    for k in range(4):
        x, y = 80.0 - k * STEP
        seen = cv2.getRectSubPix(grey.astype(np.float32), (96, 96), (x, y))
        scaled = {"uint8": seen, "uint16": 200.0 * seen, "float32": seen / 255.0}[dtype]
        out.append(scaled.astype(dtype))
    return out


def each(folder: Path, write: Callable[[Path, np.ndarray], object], dtype: str = "uint8") -> Path:
    """A folder with a file of each frame."""
    folder.mkdir()
    for k, image in enumerate(frames(dtype)):
        write(folder / f"f{k}", image)
    return folder


def _write_video(path: Path) -> Path:
    with av.open(str(path), "w") as film:
        stream = film.add_stream("h264", rate=5)
        stream.width = stream.height = 96
        stream.pix_fmt = "yuv420p"
        for image in frames("uint8"):
            film.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="gray8")))
        film.mux(stream.encode())
    return path


def _write_stack(path: Path, dtype: str = "uint8", **options: Any) -> Path:
    tifffile.imwrite(path, np.stack(frames(dtype)), photometric="minisblack", **options)
    return path


def _plain(suffix: str) -> Callable[[Path, np.ndarray], object]:
    return lambda path, image: cv2.imwrite(f"{path}.{suffix}", image)


def _tiff(path: Path, image: np.ndarray) -> None:
    tifffile.imwrite(f"{path}.tif", image)


def _colour_tiff(path: Path, image: np.ndarray) -> None:
    tifffile.imwrite(f"{path}.tif", np.dstack([image] * 3), photometric="rgb")


def _of_both(path: Path, image: np.ndarray) -> None:
    cv2.imwrite(f"{path}.{'png' if path.name in ('f0', 'f2') else 'bmp'}", image)


# What a recording may be, each with the same four frames.
KINDS: dict[str, Callable[[Path], Path]] = {
    "TIFFs of an SEM": lambda f: each(f / "x", lambda p, i: save_sem_tiff(Path(f"{p}.tif"), i)),
    "8-bit TIFFs": lambda f: each(f / "x", _tiff),
    "16-bit TIFFs": lambda f: each(f / "x", _tiff, "uint16"),
    "float TIFFs": lambda f: each(f / "x", _tiff, "float32"),
    "colour TIFFs": lambda f: each(f / "x", _colour_tiff),
    "TIFF of pages": lambda f: _write_stack(f / "x.tif"),
    "ImageJ stack": lambda f: _write_stack(
        f / "x.tif", "uint16", imagej=True, metadata={"axes": "TYX"}
    ),
    "OME-TIFF": lambda f: _write_stack(f / "x.ome.tif", metadata={"axes": "TYX"}),
    "PNGs": lambda f: each(f / "x", _plain("png")),
    "16-bit PNGs": lambda f: each(f / "x", _plain("png"), "uint16"),
    "JPEGs": lambda f: each(f / "x", _plain("jpg")),
    "BMPs": lambda f: each(f / "x", _plain("bmp")),
    "PNGs and BMPs": lambda f: each(f / "x", _of_both),
    "pattern": lambda f: each(f / "x", _plain("png")) / "f*.png",
    "video": lambda f: _write_video(f / "x.mp4"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_recording_has_the_same_drift(kind: str, folder: Path) -> None:
    path = KINDS[kind](folder)
    given = [] if kind == "TIFFs of an SEM" else ["--pixel-size", "600nm"]
    table = folder / "drift.csv"
    assert main(["drift", str(path), *given, "--frame-interval", "1s", "-o", str(table)]) == 0
    with table.open() as file:
        moved = [(float(r["dx_px"]), float(r["dy_px"])) for r in csv.DictReader(file)]
    # A video and JPEGs lose some of the texture; the other kinds agree to some thousandths.
    lossy = kind in ("video", "JPEGs")
    np.testing.assert_allclose(moved, np.arange(4)[:, None] * STEP, atol=0.1 if lossy else 0.03)
    # What is imported is the same recording.
    assert main(["import", str(path), *given, "--frame-interval", "1s", str(folder / "bag")]) == 0
    assert main(["drift", str(folder / "bag"), "-o", str(table)]) == 0
    with table.open() as file:
        again = [(float(r["dx_px"]), float(r["dy_px"])) for r in csv.DictReader(file)]
    np.testing.assert_allclose(again, moved, atol=0.01)


def test_a_bag_is_no_image_and_says_so(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_recording(folder / "bag", [2000.0, 2000.0])
    (folder / "one.png").write_bytes(b"")
    for command in (
        ["import", str(folder / "bag"), str(folder / "again")],
        ["info", str(folder / "bag"), str(folder / "one.png")],
    ):
        assert main(command) == 2
        assert "bag is a bag; expected image files" in capsys.readouterr().err
