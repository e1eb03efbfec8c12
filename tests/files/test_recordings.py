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

"""Frames and their magnification from recordings, and what bad recordings get."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from semcal_ros.config.config import ImageConfig, MagnificationConfig, MicroscopeConfig
from semcal_ros.core.errors import BagError, InvalidValueError
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.files.bags.reader import BagTopic, find_topic, topic_matches
from semcal_ros.files.bags.writer import BagWriter
from semcal_ros.files.recordings import RecordedFrame, open_recording

FLOAT = "std_msgs/msg/Float64"
IMAGE = "sensor_msgs/msg/Image"
MS = 1_000_000
T0 = 1_700_000_000 * 10**9
CONFIG = MicroscopeConfig(name="test", display_width_m=0.12)


def number(value: float) -> Any:
    message = blank_message(FLOAT)
    message.data = value
    return message


def image(
    stamp_ns: int, value: int = 7, encoding: str = "mono8", size: tuple[int, int] = (4, 6)
) -> Any:
    message = blank_message(IMAGE)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    message.header.frame_id = "sem"
    message.height, message.width = size
    message.encoding = encoding
    message.step = size[1]
    message.data = np.full(size[0] * size[1], value, dtype=np.uint8)
    return message


def write(path: Path, messages: list[tuple[str, int, Any]]) -> Path:
    with BagWriter(path) as writer:
        for topic, time_ns, message in messages:
            writer.write(topic, time_ns, message)
    return path


def frames_of(path: Path, config: MicroscopeConfig = CONFIG) -> list[RecordedFrame]:
    with open_recording(path, config) as recording:
        return list(recording.frames())


def test_zero_order_hold_by_recorder_time(tmp_path: Path) -> None:
    messages = [
        ("/sem/magnification", T0, number(100.0)),
        # Same receive time as the change: the new value holds from then on.
        ("/sem/image_raw", T0 + 10 * MS, image(T0 + 1)),
        ("/sem/magnification", T0 + 10 * MS, number(200.0)),
        ("/sem/image_raw", T0 + 20 * MS, image(T0 + 2)),
        ("/sem/magnification", T0 + 30 * MS, number(400.0)),
        ("/sem/image_raw", T0 + 90 * MS, image(T0 + 3)),
    ]
    frames = frames_of(write(tmp_path / "bag", messages))
    assert [f.magnification for f in frames] == [200.0, 200.0, 400.0]
    assert [f.stamp_ns for f in frames] == [T0 + 1, T0 + 2, T0 + 3]
    assert frames[0].log_time_ns == T0 + 10 * MS
    assert (frames[0].frame_id, frames[0].encoding) == ("sem", "mono8")
    assert frames[0].image.shape == (4, 6)


def stamped_pixel_size(stamp_ns: int, nm: float) -> Any:
    message = blank_message("geometry_msgs/msg/Vector3Stamped")
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    message.vector.x = nm
    return message


PIXEL_CONFIG = dataclasses.replace(
    CONFIG,
    magnification=MagnificationConfig(
        quantity="pixel_size",
        topic="pixel_size",
        type="geometry_msgs/msg/Vector3Stamped",
        field="vector.x",
        unit="nm",
    ),
)


def test_stamped_pixel_sizes_are_compared_by_header_stamps(tmp_path: Path) -> None:
    messages = [
        ("/sem/image_raw", T0, image(T0 + 5)),
        ("/sem/image_raw", T0 + 1, image(T0 + 15)),
        # Received last, in the wrong order, but stamped before the images.
        ("/sem/pixel_size", T0 + 2, stamped_pixel_size(T0 + 10, 50.0)),
        ("/sem/pixel_size", T0 + 3, stamped_pixel_size(T0, 100.0)),
    ]
    frames = frames_of(write(tmp_path / "bag", messages), PIXEL_CONFIG)
    # display width / (pixel size x 6 columns)
    expected = [0.12 / (100e-9 * 6), 0.12 / (50e-9 * 6)]
    assert [f.magnification for f in frames] == pytest.approx(expected, rel=1e-12, abs=0)


def test_frames_without_a_valid_magnification_are_skipped_and_counted(tmp_path: Path) -> None:
    messages: list[tuple[str, int, Any]] = [("/sem/image_raw", T0, image(T0))]
    for k, value in enumerate([500.0, 0.0, float("nan"), -3.0, 600.0]):
        messages.append(("/sem/magnification", T0 + (10 * k + 5) * MS, number(value)))
        messages.append(("/sem/image_raw", T0 + (10 * k + 9) * MS, image(T0 + k + 1)))
    with open_recording(write(tmp_path / "bag", messages), CONFIG) as recording:
        frames = list(recording.frames())
        notes = " | ".join(recording.notes)
        again = list(recording.frames())
        assert recording.frame_count == 6
    assert [f.magnification for f in frames] == [500.0, 600.0]
    assert "3 messages on /sem/magnification ignored" in notes
    assert "4 images have no valid magnification" in notes
    assert len(again) == 2
    assert " | ".join(recording.notes) == notes


def test_bad_images_are_rejected_with_reasons(tmp_path: Path) -> None:
    short = image(T0 + 1)
    short.data = short.data[:-3]
    messages = [
        ("/sem/magnification", T0, number(100.0)),
        ("/sem/image_raw", T0 + 1, short),
        ("/sem/image_raw", T0 + 2, image(T0 + 2, encoding="bayer_rggb8")),
        ("/sem/image_raw", T0 + 3, image(T0 + 3)),
    ]
    with open_recording(write(tmp_path / "bag", messages), CONFIG) as recording:
        assert [f.stamp_ns for f in recording.frames()] == [T0 + 3]
        assert [r.log_time_ns for r in recording.rejected] == [T0 + 1, T0 + 2]
        assert "truncated" in recording.rejected[0].reason
        assert "bayer_rggb8" in recording.rejected[1].reason
        assert any("2 images were left out" in note for note in recording.notes)


def test_undecodable_image_is_rejected(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/sem/magnification", T0, number(100.0))
        writer.add_topic("/sem/image_raw", IMAGE)
        writer.write_raw("/sem/image_raw", T0 + 1, b"\x00\x01\x00\x00 nonsense")
        writer.write("/sem/image_raw", T0 + 2, image(T0 + 2))
    with open_recording(tmp_path / "bag", CONFIG) as recording:
        assert len(list(recording.frames())) == 1
        assert "cannot be decoded" in recording.rejected[0].reason


def test_all_images_bad_is_an_error_with_the_first_reason(tmp_path: Path) -> None:
    messages = [
        ("/sem/magnification", T0, number(100.0)),
        ("/sem/image_raw", T0 + 1, image(T0, encoding="yuv422")),
    ]
    with pytest.raises(BagError, match="yuv422"):
        frames_of(write(tmp_path / "bag", messages))


def test_databar_is_cut(tmp_path: Path) -> None:
    messages = [
        ("/sem/magnification", T0, number(100.0)),
        ("/sem/image_raw", T0 + 1, image(T0, size=(10, 6))),
        ("/sem/image_raw", T0 + 2, image(T0, size=(3, 6))),
    ]
    path = write(tmp_path / "bag", messages)
    config = dataclasses.replace(CONFIG, image=ImageConfig(databar_rows=3))
    with open_recording(path, config) as recording:
        (only,) = recording.frames()
        assert only.image.shape == (7, 6)
        assert "databar" in recording.rejected[0].reason


def test_unset_stamps_fall_back_to_the_recorder(tmp_path: Path) -> None:
    messages = [
        ("/sem/magnification", T0, number(100.0)),
        ("/sem/image_raw", T0 + 1, image(0)),
    ]
    with open_recording(write(tmp_path / "bag", messages), CONFIG) as recording:
        assert [f.stamp_ns for f in recording.frames()] == [T0 + 1]
        assert any("no header stamp" in note for note in recording.notes)


def only_images(path: Path) -> Path:
    return write(path, [("/sem/image_raw", T0, image(T0))])


def only_bad_magnification(path: Path) -> Path:
    bad = float("nan")
    return write(path, [("/sem/image_raw", T0, image(T0)), ("/sem/magnification", T0, number(bad))])


def only_magnification(path: Path) -> Path:
    return write(path, [("/sem/magnification", T0, number(10.0))])


def wrong_type(path: Path) -> Path:
    wrong = blank_message("std_msgs/msg/String")
    return write(path, [("/sem/image_raw", T0, image(T0)), ("/sem/magnification", T0, wrong)])


def two_cameras(path: Path) -> Path:
    return write(
        path,
        [
            ("/a/image_raw", T0, image(T0)),
            ("/b/image_raw", T0, image(T0)),
            ("/sem/magnification", T0, number(10.0)),
        ],
    )


def no_messages(path: Path) -> Path:
    with BagWriter(path) as writer:
        writer.add_topic("/sem/image_raw", IMAGE)
        writer.add_topic("/sem/magnification", FLOAT)
    return path


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (only_images, "no topic is the magnification"),
        (only_bad_magnification, "no valid magnification"),
        (only_magnification, "no topic is the image"),
        (wrong_type, "has type std_msgs/msg/String"),
        (two_cameras, "/a/image_raw .*/b/image_raw"),
        (no_messages, "no valid magnification"),
    ],
)
def test_unusable_recordings_are_one_line_that_names_topics(
    tmp_path: Path, make: Callable[[Path], Path], expected: str
) -> None:
    path = make(tmp_path / "bag")
    with pytest.raises(BagError, match=expected) as caught:
        frames_of(path)
    assert "\n" not in str(caught.value)


def test_other_names_are_used_if_there_is_only_one_candidate(tmp_path: Path) -> None:
    messages = [("/jeol/mag", T0, number(10.0)), ("/jeol/picture", T0 + 1, image(T0))]
    with open_recording(write(tmp_path / "bag", messages), CONFIG) as recording:
        assert len(list(recording.frames())) == 1
        assert any("/jeol/picture" in note for note in recording.notes)
        assert any("/jeol/mag" in note for note in recording.notes)


def test_topic_names() -> None:
    assert topic_matches("image_raw", "/sem/image_raw")
    assert topic_matches("cam/image_raw", "/sem/cam/image_raw")
    assert topic_matches("/sem/image_raw", "/sem/image_raw")
    assert not topic_matches("/image_raw", "/sem/image_raw")
    assert not topic_matches("image_raw", "/sem/my_image_raw")


def test_absolute_name_resolves_an_ambiguity() -> None:
    topics = [BagTopic("/a/image_raw", IMAGE, 1), BagTopic("/b/image_raw", IMAGE, 1)]
    found, note = find_topic(
        Path("bag"), topics, what="image", wanted="/b/image_raw", type_name=IMAGE
    )
    assert (found.name, note) == ("/b/image_raw", "")


def test_folders_that_are_no_recording(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"x")
    with pytest.raises(BagError, match=r"a\.png: not a readable image"):
        open_recording(tmp_path)
    (tmp_path / "b.tif").write_bytes(b"x")
    with pytest.raises(BagError, match=r"2 image files, none usable.*a\.png"):
        open_recording(tmp_path)
    cv2.imwrite(str(tmp_path / "c.png"), np.zeros((10, 10), np.uint8))
    with pytest.raises(BagError, match=r"c\.png without a pixel size.*--pixel-size"):
        open_recording(tmp_path)
    with pytest.raises(BagError, match="does not exist"):
        open_recording(tmp_path / "missing")


def test_a_folder_of_ordinary_images_with_a_stated_magnification(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    eight = rng.integers(0, 256, (40, 50), dtype=np.uint8)
    sixteen = rng.integers(0, 65536, (40, 50), dtype=np.uint16)
    cv2.imwrite(str(tmp_path / "b.png"), eight)
    cv2.imwrite(str(tmp_path / "a.png"), sixteen)
    (tmp_path / "c.jpg").write_bytes(b"no image")
    (tmp_path / "d.bmp").write_bytes(b"")
    (tmp_path / "notes.txt").write_text("x")
    with open_recording(tmp_path, magnification=250.0) as recording:
        frames = list(recording.frames())
        assert recording.frame_count == 2
        assert [note for note in recording.notes if "2 files such as c.jpg are skipped" in note]
    np.testing.assert_array_equal(frames[0].image, sixteen)
    np.testing.assert_array_equal(frames[1].image, eight)
    assert [f.encoding for f in frames] == ["mono16", "mono8"]
    assert [f.magnification for f in frames] == [250.0, 250.0]
    assert frames[0].stamp_ns < frames[1].stamp_ns
    with open_recording(tmp_path / "b.png", magnification=250.0) as recording:
        assert len(list(recording.frames())) == 1


def test_a_magnification_is_stated_only_where_it_is_missing(tmp_path: Path) -> None:
    messages = [
        ("/sem/magnification", T0, number(100.0)),
        ("/sem/image_raw", T0 + 1, image(T0 + 1)),
    ]
    bag = write(tmp_path / "bag", messages)
    with pytest.raises(BagError, match="which has the topic /sem/magnification"):
        open_recording(bag, CONFIG, magnification=100.0)
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((10, 10), np.uint8))
    with pytest.raises(InvalidValueError, match="greater than 0"):
        open_recording(tmp_path / "a.png", magnification=-1.0)


@pytest.mark.parametrize(
    ("name", "count", "steps"),
    [("grid_calibration", 105, 21), ("gold_drift_5000x", 48, 1), ("grid_zoom_sweep", 36, 36)],
)
def test_reference_recordings(reference_data: Path, name: str, count: int, steps: int) -> None:
    with open_recording(reference_data / name) as recording:
        frames = [(f.stamp_ns, f.magnification, f.image.shape) for f in recording.frames()]
        assert recording.frame_count == count
        assert recording.notes == ()
    assert len(frames) == count
    assert len({g for _, g, _ in frames}) == steps
    assert {shape for *_, shape in frames} == {(512, 512)}
