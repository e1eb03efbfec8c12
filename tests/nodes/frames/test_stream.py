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

"""Which of the images that wait are worked on, and with which interval and magnification."""

from __future__ import annotations

import time
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from semcal_ros.config.config import ImageConfig, load_config
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.rectification.line_phase import estimate_line_phase
from semcal_ros.nodes.frames.stream import (
    FrameInput,
    StreamFrame,
    StreamNode,
    describe_blank_image,
    is_late,
)
from tests.files.images.test_databar import scanned, with_bar
from tests.helpers.node_fakes import (
    FakeEndpoints,
    FakeParameters,
    fake_context,
    fake_reporter,
    notes,
)
from tests.helpers.node_scenes import image_message, magnification_message, texture

IMAGE = texture(size=32)


@pytest.mark.parametrize(
    ("waited_ms", "interval_ms", "late"),
    [
        # Less than 40 ms is never late, however fast the stream.
        (39.0, 1.0, False),
        (41.0, 1.0, True),
        (41.0, 26.0, True),
        # Nor is less than 1.5 intervals, however long they are.
        (41.0, 28.0, False),
        (149.0, 100.0, False),
        (151.0, 100.0, True),
        # Before there is an interval.
        (41.0, 0.0, True),
    ],
)
def test_late_is_more_than_40_ms_and_more_than_one_and_a_half_intervals(
    waited_ms: float, interval_ms: float, late: bool
) -> None:
    assert is_late(1e-3 * waited_ms, 1e-3 * interval_ms) == late


class Bench:
    """A frame input, and the frames that it hands on."""

    def __init__(
        self, depth: float = 10, *, bidirectional: bool = False, databar_rows: int | None = None
    ) -> None:
        self.endpoints: Any = FakeEndpoints(depth)
        parameters: Any = FakeParameters({"mixed_frames": "drop"})
        self.reporter, self.log = fake_reporter()
        self.frames: list[StreamFrame] = []
        config = load_config("virtual_sem")
        config = replace(
            config,
            scan=ScanTiming(0.1, bidirectional=bidirectional),
            image=ImageConfig(databar_rows=databar_rows),
        )
        context = fake_context(self.endpoints, config, parameters, self.reporter)
        self.input = FrameInput(context, self.frames.append)

    @property
    def images(self) -> Any:
        return self.endpoints.subscriptions["image_raw"]

    def magnification(self, value: float, sent_ns: int) -> None:
        info = {"source_timestamp": sent_ns, "received_timestamp": sent_ns}
        topic = self.endpoints.subscriptions["magnification"]
        topic.callback(magnification_message(value), info)

    def receive(self, *sent_s: float, waited_s: float = 0.0, image: np.ndarray = IMAGE) -> None:
        """Images that were sent at these times and have waited here for that long, all there at once."""
        received_ns = time.time_ns() - round(waited_s * 1e9)
        messages = [
            (
                image_message(image, sent),
                {"source_timestamp": round(sent * 1e9), "received_timestamp": received_ns},
            )
            for sent in sent_s
        ]
        self.images.waiting.extend(messages[1:])
        self.images.callback(*messages[0])

    @property
    def stamps_s(self) -> list[float]:
        return [round(frame.stamp_ns * 1e-9, 6) for frame in self.frames]


def test_images_in_time_are_all_worked_on_in_order() -> None:
    bench = Bench()
    bench.receive(1.0, 1.1, 1.2)
    assert bench.stamps_s == [1.0, 1.1, 1.2]


def test_late_images_make_way_for_the_newest() -> None:
    bench = Bench()
    bench.receive(1.0)
    bench.receive(1.1, 1.2, 1.3, waited_s=10.0)
    assert bench.stamps_s == [1.0, 1.3]
    # What was skipped counts as dropped, and not as a longer interval.
    assert bench.frames[-1].interval_s == pytest.approx(0.1)
    assert notes(bench.reporter)["dropped"] == "2"


def test_a_late_image_that_is_the_newest_is_worked_on() -> None:
    bench = Bench()
    bench.receive(1.0, waited_s=10.0)
    assert bench.stamps_s == [1.0]


def test_a_user_with_a_longer_queue_gets_every_image() -> None:
    bench = Bench(depth=11)
    bench.receive(1.0, 1.1, 1.2, waited_s=10.0)
    assert bench.stamps_s == [1.0, 1.1, 1.2]


def test_after_a_restart_the_old_magnification_is_not_believed_until_a_new_one_comes() -> None:
    bench = Bench()
    bench.magnification(1000.0, sent_ns=1)
    bench.receive(1.0)
    bench.images.restarts += 1
    bench.receive(1.1)
    assert [frame.magnification for frame in bench.frames] == [1000.0, None]
    bench.magnification(2000.0, sent_ns=1_150_000_000)
    bench.receive(1.2)
    assert bench.frames[-1].magnification == 2000.0


def test_an_unusable_magnification_makes_it_unknown_until_the_next_usable_one() -> None:
    bench = Bench()
    for sent_s, value in ((0.5, 1000.0), (1.5, -1.0), (2.5, 2000.0)):
        bench.magnification(value, sent_ns=round(sent_s * 1e9))
        bench.receive(sent_s + 0.5)
    assert [frame.magnification for frame in bench.frames] == [1000.0, None, 2000.0]
    assert any("a magnification of -1" in line for line in bench.log)


def test_a_microscope_that_says_nothing_after_its_restart_is_believed_again_after_a_while(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench()
    bench.magnification(1000.0, sent_ns=1)
    bench.receive(1.0)
    bench.images.restarts += 1
    bench.receive(1.1)
    now_s = time.monotonic()
    # The latched value is offered once more after 3 s.
    monkeypatch.setattr("semcal_ros.nodes.frames.held_values.time.monotonic", lambda: now_s + 3.5)
    bench.receive(1.2)
    monkeypatch.setattr("semcal_ros.nodes.frames.held_values.time.monotonic", lambda: now_s + 4.5)
    bench.receive(1.3)
    assert [frame.magnification for frame in bench.frames] == [1000.0, None, None, 1000.0]


@pytest.mark.parametrize(
    ("image", "said"),
    [
        (IMAGE, ""),
        (np.full((32, 32), 130, dtype=np.uint8), "even: all grey levels are 130"),
        # Noise of a detector without a beam.
        (np.arange(1024).reshape(32, 32).astype(np.uint8) % 3, "dark: no grey level above 2"),
        (np.arange(1024).reshape(32, 32).astype(np.uint16) % 9, "dark: no grey level above 8"),
        # A dim picture of 12 bits.
        (np.arange(1024).reshape(32, 32).astype(np.uint16) % 64, ""),
        # A label across a large image is seen although not all of it is looked at.
        (np.kron(IMAGE, np.ones((40, 40), dtype=np.uint8)), ""),
        (np.zeros((32, 32, 3), dtype=np.uint8), "even: all grey levels are 0"),
    ],
)
def test_an_image_without_a_picture_is_told(image: np.ndarray, said: str) -> None:
    assert describe_blank_image(image) == (f"the image is {said}" if said else "")


def test_a_blanked_beam_is_told_and_its_end_too(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    now_s = [100.0]
    monkeypatch.setattr("semcal_ros.nodes.frames.stream.time.monotonic", lambda: now_s[0])
    blank = np.zeros((32, 32), dtype=np.uint8)
    for image in (IMAGE, blank, blank, IMAGE):
        now_s[0] += 1.0
        bench.receive(now_s[0], image=image)
        dark = [text for text in bench.input.conditions() if "the image is even" in text]
        assert len(dark) == (image is blank)
    # It is a frame all the same, and once is enough to say it.
    assert len(bench.frames) == 4
    assert bench.log == [
        "the image is even: all grey levels are 0; check beam blank, shutter and detector",
        "the image has contrast again",
    ]


def test_one_turn_of_the_executor_is_bounded() -> None:
    bench = Bench()
    bench.receive(*(1.0 + 0.1 * number for number in range(20)))
    assert len(bench.frames) == 9
    assert len(bench.images.waiting) == 11


@pytest.mark.parametrize("topic", ["image_raw", "magnification"])
def test_images_or_magnifications_of_two_publishers_are_refused_where_they_would_be_kept(
    topic: str,
) -> None:
    bench = Bench()
    bench.input.refuse_rivals()
    bench.endpoints.subscriptions[topic].rivals = "2 publishers on it: /a, /b"
    assert bench.input.has_rivals
    with pytest.raises(InvalidValueError, match="/a, /b; expected one; end the others"):
        bench.input.refuse_rivals()
    # A stream goes on all the same.
    bench.receive(1.0)
    assert bench.stamps_s == [1.0]


def test_an_older_frame_is_refused_where_the_newest_one_is_of_no_use() -> None:
    bench = Bench()

    def refused() -> str:
        with pytest.raises(InvalidValueError, match="the newest frame cannot be used: ") as error:
            bench.input.refuse_unused()
        return str(error.value)

    def sent(message: Any, at_s: float) -> None:
        info = {"source_timestamp": round(at_s * 1e9), "received_timestamp": time.time_ns()}
        bench.images.callback(message, info)

    bench.receive(1.0)
    assert "its magnification is not known" in refused()
    bench.magnification(1000.0, sent_ns=1_500_000_000)
    bench.receive(2.0)
    bench.input.refuse_unused()
    # Its stamp is the begin of a scan of 0.1 s.
    bench.magnification(2000.0, sent_ns=3_050_000_000)
    sent(image_message(IMAGE, 3.0), 3.1)
    assert "while the magnification changed" in refused()
    bench.receive(4.0)
    bench.input.refuse_unused()
    message = image_message(IMAGE, 5.0)
    message.encoding = "bgra8"
    sent(message, 5.1)
    assert "bgra8" in refused()
    assert len(bench.frames) == 3


def test_images_before_their_magnification_are_counted_and_told_once_it_has_come() -> None:
    reporter, log = fake_reporter()
    node: Any = SimpleNamespace(reporter=reporter, _waiting=0, _without_magnification=0)
    for g in (None, None, 1000.0, 1000.0, None):
        frame: Any = SimpleNamespace(magnification=g)
        assert StreamNode.known_magnification(node, frame) == g
    assert log == ["images not used because their magnification was not known: 2"]
    assert notes(reporter)["frames_without_magnification"] == "3"


def shifted_lines() -> np.ndarray:
    """Texture whose odd lines are two pixels to the right of where they belong."""
    texture = cv2.GaussianBlur(np.random.default_rng(0).normal(size=(96, 128)), (0, 0), 2.0)
    picture = np.clip(120.0 + 150.0 * texture, 0, 255)
    picture[1::2, 2:] = picture[1::2, :-2]
    return picture.astype(np.uint8)


def test_the_lines_of_a_bidirectional_scan_are_moved_back() -> None:
    bench = Bench(bidirectional=True)
    bench.receive(1.0, image=shifted_lines())
    assert abs(estimate_line_phase(bench.frames[0].image).shift_px) < 0.1
    assert float(notes(bench.reporter)["line_phase_px"]) == pytest.approx(2.0, abs=0.1)


def test_a_line_phase_that_nobody_declared_is_said_once_and_left() -> None:
    bench = Bench()
    bench.receive(1.0, 1.1, 1.2, image=shifted_lines())
    assert np.array_equal(bench.frames[0].image, shifted_lines())
    assert [text for text in bench.log if "odd lines" in text] == bench.input.conditions()


def test_a_data_bar_that_the_configuration_does_not_tell_of_is_cut_off_and_said_once() -> None:
    bench = Bench()
    bench.receive(1.0, 1.1, 1.2, image=with_bar(scanned(), 40, "5.0 kV 10 um"))
    # The second image decides; none with another size goes out before.
    assert bench.stamps_s == [1.1, 1.2]
    assert {frame.image.shape for frame in bench.frames} == {scanned().shape}
    assert {frame.databar_rows for frame in bench.frames} == {40}
    assert [text for text in bench.log if "data bar" in text] == [
        "the lowest 40 rows are a data bar and are cut off; image.databar_rows: 40 in the configuration says so, "
        "0 keeps them"
    ]
    assert notes(bench.reporter)["databar_rows"] == "40"
    assert bench.input.conditions() == []


@pytest.mark.parametrize("rows", [None, 40])
def test_a_blanked_beam_is_told_above_the_text_of_a_data_bar(rows: int | None) -> None:
    bench = Bench(databar_rows=rows)
    bench.receive(1.0, image=with_bar(np.zeros_like(scanned()), 40, "5.0 kV 10 um"))
    assert bench.input.conditions() == ["the image is even: all grey levels are 0"]


def test_a_stated_data_bar_of_no_rows_stays() -> None:
    bench = Bench(databar_rows=0)
    image = with_bar(scanned(), 40, "5.0 kV 10 um")
    bench.receive(1.0, image=image)
    assert np.array_equal(bench.frames[0].image, image) and not bench.log
