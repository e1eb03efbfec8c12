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

"""A recording of compressed images gives the frames that one of the images themselves gives."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from semcal_ros.bridge.compressed import fill_compressed
from semcal_ros.bridge.fields import fill_header
from semcal_ros.bridge.images import ENCODINGS, fill_image
from semcal_ros.cli.main import main
from semcal_ros.config.config import (
    COMPRESSED_IMAGE_TYPE,
    IMAGE_TYPE,
    ImageConfig,
    MicroscopeConfig,
)
from semcal_ros.core.errors import BagError
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.files.bags.writer import BagWriter
from semcal_ros.files.recordings import RecordedFiles, RecordedFrame, open_recording
from tests.files.images.test_databar import scanned, with_bar

T0 = 1_700_000_000 * 10**9
RAW = MicroscopeConfig(name="test", display_width_m=0.12)
COMPRESSED = dataclasses.replace(
    RAW, image=ImageConfig("image_raw/compressed", COMPRESSED_IMAGE_TYPE)
)


def picture(encoding: str, seed: int = 0) -> NDArray[Any]:
    pixel = ENCODINGS[encoding]
    shape = (20, 30) if pixel.channels == 1 else (20, 30, 3)
    return np.random.default_rng(seed).integers(0, 256, shape).astype(pixel.dtype) * 3


def message(image: NDArray[Any], encoding: str, stamp_ns: int, codec: str = "") -> Any:
    header = blank_message("std_msgs/msg/Header")
    fill_header(header, stamp_ns, "sem")
    made = blank_message(COMPRESSED_IMAGE_TYPE if codec else IMAGE_TYPE)
    if codec:
        fill_compressed(made, image, encoding, header, codec)
    else:
        fill_image(made, image, encoding, header)
    return made


def recorded(path: Path, *messages: tuple[str, Any]) -> Path:
    """A bag with one magnification, then these messages 1 ms apart."""
    number = blank_message("std_msgs/msg/Float64")
    number.data = 500.0
    with BagWriter(path) as writer:
        writer.write("/sem/magnification", T0, number)
        for index, (topic, made) in enumerate(messages, 1):
            writer.write(topic, T0 + index * 1_000_000, made)
    return path


def frames_and_notes(
    path: Path, config: MicroscopeConfig
) -> tuple[list[RecordedFrame], tuple[str, ...]]:
    with open_recording(path, config) as recording:
        return list(recording.frames()), recording.notes


def level(path: Path, config: MicroscopeConfig) -> int:
    """Grey level of the only frame, which tells the topics apart."""
    (frame,), _ = frames_and_notes(path, config)
    return int(frame.image[0, 0])


def flat(value: int, codec: str = "") -> Any:
    return message(np.full((4, 6), value, np.uint8), "mono8", T0, codec)


@pytest.mark.parametrize("encoding", ["mono8", "mono16", "bgr8", "rgb8"])
def test_the_same_frames_from_either_type(tmp_path: Path, encoding: str) -> None:
    images = [picture(encoding, seed) for seed in range(3)]
    bags = []
    for codec in ("", "png"):
        topic = "/sem/image_raw/compressed" if codec else "/sem/image_raw"
        made = [(topic, message(im, encoding, T0 + k, codec)) for k, im in enumerate(images)]
        bags.append(recorded(tmp_path / f"bag{codec}", *made))
    raw, none = frames_and_notes(bags[0], RAW)
    compressed, neither = frames_and_notes(bags[1], COMPRESSED)
    assert none == neither == ()
    assert len(raw) == len(compressed) == 3
    for one, other in zip(raw, compressed, strict=True):
        np.testing.assert_array_equal(one.image, other.image)
        assert one.image.dtype == other.image.dtype
        assert {**vars(one), "image": None} == {**vars(other), "image": None}
    assert compressed[0].encoding == encoding


def test_jpeg_and_databar(tmp_path: Path) -> None:
    path = recorded(tmp_path / "bag", ("/sem/image_raw/compressed", flat(77, "jpeg")))
    image = dataclasses.replace(COMPRESSED.image, databar_rows=1)
    (frame,), _ = frames_and_notes(path, dataclasses.replace(COMPRESSED, image=image))
    assert frame.image.shape == (3, 6)
    assert np.abs(frame.image.astype(int) - 77).max() <= 2


def test_a_recording_with_the_other_type_only_is_read_with_a_note(tmp_path: Path) -> None:
    compressed = recorded(tmp_path / "c", ("/sem/image_raw/compressed", flat(1, "png")))
    (frame,), notes = frames_and_notes(compressed, RAW)
    assert frame.image[0, 0] == 1
    assert notes == (
        f"the images on /sem/image_raw/compressed are {COMPRESSED_IMAGE_TYPE}, not {IMAGE_TYPE}",
    )
    raw = recorded(tmp_path / "r", ("/sem/image_raw", flat(2)))
    (frame,), notes = frames_and_notes(raw, COMPRESSED)
    assert frame.image[0, 0] == 2
    assert notes == (f"the images on /sem/image_raw are {IMAGE_TYPE}, not {COMPRESSED_IMAGE_TYPE}",)
    # A driver that publishes compressed images only may leave out the suffix, or use a name of its own.
    for number, topic in enumerate(("/sem/image_raw", "/jeol/image")):
        path = recorded(tmp_path / str(number), (topic, flat(3, "png")))
        (frame,), notes = frames_and_notes(path, RAW)
        assert frame.image[0, 0] == 3
        assert any(topic in note and COMPRESSED_IMAGE_TYPE in note for note in notes)


def test_where_both_are_recorded_the_configuration_decides(tmp_path: Path) -> None:
    path = recorded(
        tmp_path / "bag",
        ("/sem/image_raw", flat(1)),
        ("/sem/image_raw/compressed", flat(2, "png")),
        ("/sem/image_rect", flat(3)),
    )
    assert level(path, RAW) == 1
    assert level(path, COMPRESSED) == 2


def test_the_same_images_compressed_are_better_than_others_raw(tmp_path: Path) -> None:
    path = recorded(
        tmp_path / "bag",
        ("/sem/image_rect", flat(3)),
        ("/sem/image_raw/compressed", flat(2, "png")),
        ("/sem/image_rect/compressed", flat(4, "png")),
    )
    assert level(path, RAW) == 2


def test_several_candidates_are_refused(tmp_path: Path) -> None:
    path = recorded(
        tmp_path / "bag",
        ("/a/image/compressed", flat(1, "png")),
        ("/b/image/compressed", flat(2, "png")),
    )
    with pytest.raises(BagError, match="several topics could be the image"):
        frames_and_notes(path, RAW)


def test_bad_images_are_rejected_with_reasons(tmp_path: Path) -> None:
    cut, foreign = flat(1, "png"), flat(2, "png")
    cut.data = cut.data[:-20]
    foreign.format = "32FC1; compressedDepth png"
    topic = "/sem/image_raw/compressed"
    path = recorded(tmp_path / "bag", (topic, cut), (topic, foreign), (topic, flat(3, "png")))
    with open_recording(path, COMPRESSED) as recording:
        assert [int(frame.image[0, 0]) for frame in recording.frames()] == [3]
        assert recording.frame_count == 3
        reasons = [rejected.reason for rejected in recording.rejected]
    assert "truncated" in reasons[0]
    assert "compressedDepth" in reasons[1]


def test_commands_read_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    topic = "/sem/image_raw/compressed"
    image = message(picture("mono16"), "mono16", T0, "png")
    path = recorded(tmp_path / "bag", (topic, image))
    assert main(["info", str(path)]) == 0
    told = capsys.readouterr()
    assert "1 x 30 x 20 mono16" in told.out
    assert COMPRESSED_IMAGE_TYPE in told.err


@pytest.mark.parametrize("codec", ["png", "jpeg"])
def test_an_outline_needs_no_decoding(tmp_path: Path, codec: str) -> None:
    """Size, encoding and stamp come from the header; equal bytes have the same digest."""
    images = [picture("mono8", seed) for seed in (0, 1, 1)]
    made = [message(image, "mono8", T0 + k, codec) for k, image in enumerate(images, 1)]
    path = recorded(tmp_path / "bag", *(("/sem/image_raw/compressed", one) for one in made))
    with open_recording(path, COMPRESSED) as opened:
        outlines, frames = list(opened.outlines({0})), list(opened.frames())
    assert [o.image is None for o in outlines] == [False, True, True]
    assert [o.size_px for o in outlines] == [(30, 20)] * 3
    assert [(o.stamp_ns, o.encoding, o.magnification) for o in outlines] == [
        (f.stamp_ns, f.encoding, f.magnification) for f in frames
    ]
    assert outlines[0].digest != outlines[1].digest == outlines[2].digest


@pytest.mark.parametrize("databar_rows", [None, 0, 12])
def test_a_data_bar_that_nobody_told_of_is_cut_off_and_said(
    tmp_path: Path, databar_rows: int | None
) -> None:
    # The beam was blanked at first.
    barred = [with_bar(np.zeros_like(scanned()), 30, "5.0 kV")]
    barred += [with_bar(scanned(), 30, f"5.0 kV {k} um") for k in range(4)]
    made = [
        ("/sem/image_raw", message(barred_picture, "mono8", T0 + (k + 1) * 1_000_000))
        for k, barred_picture in enumerate(barred)
    ]
    given = RecordedFiles(recorded(tmp_path / "bag", *made), databar_rows=databar_rows)
    with open_recording(given, RAW) as recording:
        frames = list(recording.frames())
        notes = [text for text in recording.notes if "data bar" in text]
    expected = 200 if databar_rows is None else 230 - databar_rows
    assert {frame.image.shape[0] for frame in frames} == {expected}
    assert bool(notes) is (databar_rows is None)
