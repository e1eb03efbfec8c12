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

"""A folder of SEM TIFFs becomes a recording whose field widths are exactly those of the files."""

from __future__ import annotations

import dataclasses
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from semcal_ros.config.config import MagnificationConfig, MicroscopeConfig, load_config
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.errors import BagError
from semcal_ros.files.bags.reader import open_bag
from semcal_ros.files.images.to_bag import SIDECAR, import_images
from semcal_ros.files.recordings import open_recording


def write_tescan(
    path: Path,
    pixel_m: float,
    size: tuple[int, int],
    time: str = "",
    bits: int = 8,
    bar: int = 0,
    angles: str = "",
) -> None:
    date = f"Date=2020-01-02\nTime={time}\n" if time else ""
    text: Any = f"{date}ImageStripSize={bar}\nPixelSizeX={pixel_m!r}\nPixelSizeY={pixel_m!r}\n"
    text = (text + angles).encode()
    data = struct.pack("<IH", len(text) + 2, 2) + text
    pixels = (np.arange(size[0] * size[1]) % 250).reshape(size).astype(f"uint{bits}")
    tifffile.imwrite(path, pixels, extratags=[(50431, 7, len(data), data, True)])


def make_folder(folder: Path) -> Path:
    folder.mkdir()
    write_tescan(folder / "img_10.tif", 3.1e-7, (16, 24), "10:00:00")
    write_tescan(folder / "img_9.tif", 1.7e-8, (20, 40), "12:00:00", bits=16, bar=4)
    write_tescan(folder / "img_2.tif", 2.5e-9, (8, 8), "12:00:00")
    (folder / "broken.tif").write_bytes(b"II*\x00")
    (folder / "photo.jpg").write_bytes(b"x")
    (folder / "readme.md").write_text("x")
    return folder


def test_pixel_sizes_order_and_sizes_survive(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "tiffs")
    calls: list[tuple[int, int]] = []
    summary = import_images(folder, tmp_path / "bag", on_progress=lambda *a: calls.append(a))
    assert summary.imported == 3
    assert sorted(s.name for s in summary.skipped) == ["broken.tif", "photo.jpg"]
    assert calls == [(1, 3), (2, 3), (3, 3)]
    assert any("photo.jpg is skipped" in line for line in summary.lines())
    with open_recording(tmp_path / "bag") as recording:
        frames = list(recording.frames())
        width_m = recording.config.display_width_m
    sizes = [width_m / f.magnification / f.image.shape[1] for f in frames]
    # Times decide the order; the two of the same second keep the natural order of their names.
    assert sizes == pytest.approx([3.1e-7, 2.5e-9, 1.7e-8], rel=1e-14, abs=0)
    assert [f.image.shape for f in frames] == [(16, 24), (8, 8), (16, 40)]
    assert [f.encoding for f in frames] == ["mono8", "mono8", "mono16"]
    stamps = [f.stamp_ns for f in frames]
    assert stamps[1] - stamps[0] == 7200 * 10**9
    assert stamps == sorted(set(stamps))


def test_metadata_topic_and_sidecar(tmp_path: Path) -> None:
    import_images(make_folder(tmp_path / "tiffs"), tmp_path / "bag")
    with open_bag(tmp_path / "bag") as bag:
        texts = [json.loads(m.message.data) for m in bag.messages(["/sem/metadata"])]
    assert [t["file"] for t in texts] == ["img_10.tif", "img_2.tif", "img_9.tif"]
    assert texts[2]["pixel_size_m"] == 1.7e-8
    report = json.loads((tmp_path / "bag" / SIDECAR).read_text())
    assert report["images"] == texts
    assert {s["file"] for s in report["skipped"]} == {"broken.tif", "photo.jpg"}
    assert report["display_width_m"] == load_config("generic").display_width_m


@pytest.mark.parametrize(
    "source",
    [
        MagnificationConfig(display_width_m=0.3),
        MagnificationConfig(quantity="pixel_size", unit="nm", topic="/my/pixel"),
        MagnificationConfig(quantity="field_width", unit="um"),
        MagnificationConfig(quantity="pixel_size", unit="pm", image_width_px=1000),
    ],
)
def test_every_quantity_reads_back(tmp_path: Path, source: MagnificationConfig) -> None:
    folder = tmp_path / "tiffs"
    folder.mkdir()
    write_tescan(folder / "a.tif", 3.1e-7, (16, 24))
    config = MicroscopeConfig(name="x", display_width_m=0.2, magnification=source)
    import_images(folder, tmp_path / "bag", config=config)
    with open_recording(tmp_path / "bag", config) as recording:
        (frame,) = recording.frames()
    assert frame.magnification == pytest.approx(0.2 / (3.1e-7 * 24), rel=1e-12, abs=0)


def test_folder_is_read_directly_as_it_would_be_imported(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "tiffs")
    import_images(folder, tmp_path / "bag")
    with open_recording(folder) as direct, open_recording(tmp_path / "bag") as imported:
        pairs = list(zip(direct.frames(), imported.frames(), strict=True))
        assert direct.frame_count == 3
        assert any("photo.jpg" in note for note in direct.notes)
    for one, two in pairs:
        assert one.stamp_ns == two.stamp_ns
        assert one.magnification == pytest.approx(two.magnification, rel=1e-14, abs=0)
        assert np.array_equal(one.image, two.image)


def _stages(folder: Path, bag: Path, *angles: str) -> tuple[list[StageReading | None], str]:
    """Readings and notes of a folder of files with these angles, which an import repeats."""
    folder.mkdir()
    for index, text in enumerate(angles):
        write_tescan(folder / f"{index}.tif", 1e-8, (8, 8), f"10:00:{index:02}", angles=text)
    with open_recording(folder) as recording:
        stages = [frame.stage for frame in recording.frames()]
        notes = " | ".join(recording.notes)
    import_images(folder, bag)
    nothing = (None, StageReading())
    with open_recording(bag) as imported:
        for stage, frame in zip(stages, imported.frames(), strict=True):
            assert frame.stage == stage or (frame.stage in nothing and stage in nothing)
    return stages, notes


def test_files_say_where_the_stage_was(tmp_path: Path) -> None:
    turned = "StageRotation=20.0\nScanRotation=0.0\n"
    stages, notes = _stages(
        tmp_path / "tiffs",
        tmp_path / "bag",
        f"StageTilt=0.0\n{turned}",
        f"StageTilt=30.0\n{turned}",
        "",
    )
    assert stages == [
        StageReading(0.0, np.radians(20.0)),
        StageReading(np.radians(30.0), np.radians(20.0)),
        None,
    ]
    assert "stage.tilt_axis_deg" in notes


def test_rotations_of_unknown_sense_are_left_out(tmp_path: Path) -> None:
    stages, notes = _stages(
        tmp_path / "tiffs",
        tmp_path / "bag",
        "StageTilt=10.0\nStageRotation=20.0\n",
        "StageTilt=10.0\nStageRotation=50.0\n",
        "StageTilt=10.0\nStageRotation=50.0\nScanRotation=90.0\n",
        "StageTilt=100.0\n",
    )
    assert stages == [StageReading(np.radians(10.0)), StageReading(np.radians(10.0)), None, None]
    assert "the stage of 3.tif is not used: tilt 1.74533 rad" in notes
    assert "the rotation of the stage is not used" in notes
    assert "the stage is not used for 1 file with a rotated scan" in notes


def test_files_without_time_are_one_second_apart(tmp_path: Path) -> None:
    folder = tmp_path / "tiffs"
    folder.mkdir()
    for name in ("b_10.tif", "b_2.tif"):
        write_tescan(folder / name, 1e-8, (4, int(name[2:-4])))
    with open_recording(folder) as recording:
        frames = list(recording.frames())
    assert [f.image.shape[1] for f in frames] == [2, 10]
    assert frames[1].stamp_ns - frames[0].stamp_ns == 10**9


def test_damaged_pixels_are_skipped_and_nothing_is_left_if_all_are(tmp_path: Path) -> None:
    folder = tmp_path / "tiffs"
    folder.mkdir()
    write_tescan(folder / "a.tif", 1e-8, (16, 16))
    write_tescan(folder / "b.tif", 1e-8, (16, 16))
    whole = (folder / "a.tif").read_bytes()
    (folder / "a.tif").write_bytes(whole[:-50])
    summary = import_images(folder, tmp_path / "bag")
    assert summary.imported == 1
    assert [s.name for s in summary.skipped] == ["a.tif"]
    (folder / "b.tif").write_bytes(whole[:-50])
    with pytest.raises(BagError, match="can be decoded"):
        import_images(folder, tmp_path / "other")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["bag", "tiffs"]


def test_refusals(tmp_path: Path) -> None:
    folder = make_folder(tmp_path / "tiffs")
    with pytest.raises(BagError, match="does not exist"):
        import_images(tmp_path / "missing", tmp_path / "bag")
    (tmp_path / "empty").mkdir()
    with pytest.raises(BagError, match="has no image file"):
        import_images(tmp_path / "empty", tmp_path / "bag")
    import_images(folder, tmp_path / "bag")
    with pytest.raises(BagError, match="exists"):
        import_images(folder, tmp_path / "bag")
    assert import_images(folder, tmp_path / "bag", overwrite=True).imported == 3
    with pytest.raises(BagError, match="not replaced"):
        import_images(folder, folder, overwrite=True)
    odd = dataclasses.replace(
        load_config("generic"),
        magnification=MagnificationConfig(
            type="geometry_msgs/msg/Vector3Stamped", field="vector.x"
        ),
    )
    with pytest.raises(BagError, match="--config generic"):
        import_images(folder, tmp_path / "bag2", config=odd)


def test_conditions_are_told_once_and_latched(tmp_path: Path) -> None:
    folder = tmp_path / "tiffs"
    folder.mkdir()
    for number, voltage in ((1, 5000), (2, 5000), (3, 10000)):
        settings = f"HV={voltage}\nWD=0.0101\nSerialNumber=7\n"
        write_tescan(folder / f"{number}.tif", 2.5e-9, (8, 8), f"12:00:0{number}", angles=settings)
    import_images(folder, tmp_path / "bag")
    with open_bag(tmp_path / "bag") as reader:
        topics = {topic.name: topic for topic in reader.topics}
    assert topics["/sem/conditions"].count == 2
    assert topics["/sem/conditions"].latched
    with open_recording(tmp_path / "bag") as recording:
        found = [frame.conditions for frame in recording.frames()]
    assert [c and c.acceleration_voltage_v for c in found] == [5000.0, 5000.0, 10000.0]
    assert all(c is not None and c.working_distance_m == 0.0101 for c in found)
