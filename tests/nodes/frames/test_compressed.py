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

"""The order of things in a compressed output, without the middleware."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import CompressedImage

from semcal_ros.bridge.compressed import image_from_compressed
from semcal_ros.bridge.diagnostics import StreamStatistics
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.nodes.frames.compressed import CompressedOutput, compressed_parameters
from tests.helpers.node_fakes import fake_context
from tests.helpers.node_scenes import image_message, stamp_of, texture
from tests.helpers.ros_process import TIMEOUT_S

TOPIC = "image_rect/compressed"


class _Publisher:
    """Publishes to the endpoints that made it."""

    def __init__(self, endpoints: Stub) -> None:
        self._endpoints = endpoints
        self.publish = endpoints._publish

    @property
    def is_awaited(self) -> bool:
        return self._endpoints.subscribers > 0


class Stub:
    """What a compressed output is connected with; publishing waits for ``may_publish``."""

    def __init__(self) -> None:
        declared = compressed_parameters("image_rect")
        self.parameters = {declaration.name: declaration.default for declaration in declared}
        self.statistics = StreamStatistics()
        self.note = self.statistics.note
        self.rejected: list[Exception] = []
        self.reject = self.rejected.append
        self.may_publish = threading.Event()
        self.is_publishing = threading.Event()
        self.published: list[Any] = []
        self.subscribers = 1
        self.results: Callable[[], None] = lambda: None
        self.results_waiting = threading.Semaphore(0)

    def below(self, topic: str, name: str) -> str:
        return f"{topic}/{name}"

    def stream_publisher(self, message_type: Any, topic: str, name: str) -> Any:
        assert (message_type, topic) == (CompressedImage, TOPIC)
        return _Publisher(self)

    def guard(self, callback: Callable[[], None]) -> Any:
        self.results = callback
        return SimpleNamespace(trigger=self.results_waiting.release)

    def output(self) -> CompressedOutput:
        context = fake_context(self, parameters=self.parameters, reporter=self)
        return CompressedOutput(context, "image_rect")

    def _publish(self, message: Any) -> None:
        self.is_publishing.set()
        assert self.may_publish.wait(TIMEOUT_S)
        self.published.append(message)

    def hand_over(self, count: int) -> None:
        """Wait for so many results and handle them, as an executor would."""
        for _ in range(count):
            assert self.results_waiting.acquire(timeout=TIMEOUT_S)
        self.results()

    def notes(self) -> dict[str, str]:
        return dict(self.statistics.summary(0.0).values)


def submit(output: CompressedOutput, image: Any, stamp_s: float, encoding: str = "mono8") -> None:
    header = image_message(texture(), stamp_s).header
    output.publish(image, SimpleNamespace(encoding=encoding, header=header))


def test_the_newest_waits_and_has_pixels_of_its_own() -> None:
    stub = Stub()
    output = stub.output()
    memory = texture().copy()
    for stamp_s in (1, 2, 3, 4):
        memory[:] = stamp_s
        submit(output, memory, stamp_s)
        # The first is in hand before the others come.
        assert stub.is_publishing.wait(TIMEOUT_S)
    memory[:] = 99
    stub.may_publish.set()
    stub.hand_over(2)
    assert [stamp_of(message)[0] for message in stub.published] == [1, 4]
    for message, value in zip(stub.published, (1, 4), strict=True):
        assert (image_from_compressed(message)[0] == value).all()
    notes = stub.notes()
    assert (notes[f"compressed.{TOPIC}"], notes[f"skipped.{TOPIC}"]) == ("2", "2")


def test_without_subscribers_not_even_the_pixels_are_copied() -> None:
    stub = Stub()
    stub.subscribers = 0
    output = stub.output()
    output.publish(None, None)
    assert not stub.published
    assert f"compressed.{TOPIC}" not in stub.notes()


def test_closing_waits_for_the_image_in_hand_and_is_the_last_of_it() -> None:
    stub = Stub()
    output = stub.output()
    submit(output, texture(), 1)
    assert stub.is_publishing.wait(TIMEOUT_S)
    closing = threading.Thread(target=output.close)
    closing.start()
    closing.join(0.2)
    assert closing.is_alive()
    stub.may_publish.set()
    closing.join(TIMEOUT_S)
    assert not closing.is_alive()
    submit(output, texture(), 2)
    stub.hand_over(2)
    assert [stamp_of(message)[0] for message in stub.published] == [1]


def test_errors_come_back_to_the_executor() -> None:
    stub = Stub()
    output = stub.output()
    submit(output, texture().astype(np.float32), 1, "32FC1")
    stub.hand_over(1)
    (error,) = stub.rejected
    assert isinstance(error, InvalidValueError)
    assert "32FC1 image as png" in str(error)
    # What nobody foresaw must not be lost in a thread.
    output.publish(texture(), SimpleNamespace(encoding="mono8", header=None))
    with pytest.raises(AttributeError):
        stub.hand_over(1)
