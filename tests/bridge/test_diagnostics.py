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

"""Counters, rate, latency and levels of a stream."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest

from semcal_ros.bridge.diagnostics import DiagnosticLevel, StreamStatistics, fill_diagnostic_status
from semcal_ros.core.errors import InvalidValueError


def running(frames: int = 11, period_s: float = 0.1) -> StreamStatistics:
    statistics = StreamStatistics(window_s=2.0, stale_after_s=3.0)
    for index in range(frames):
        time_s = index * period_s
        statistics.receive(time_s)
        statistics.publish(time_s + 0.01, latency_s=0.01 if index else 0.03)
    return statistics


def test_rate_and_latency() -> None:
    statistics = running()
    assert statistics.rate_hz(1.0) == pytest.approx(10.0)
    latency = statistics.latency_s(1.0)
    assert latency is not None
    assert latency[0] == pytest.approx((0.03 + 10 * 0.01) / 11)
    assert latency[1] == 0.03
    assert statistics.received == statistics.published == 11


def test_the_window_forgets() -> None:
    statistics = running()
    assert statistics.latency_s(2.05) == pytest.approx((0.01, 0.01))  # the slow first one is gone
    assert statistics.rate_hz(10.0) == 0.0
    assert statistics.latency_s(10.0) is None


def test_levels() -> None:
    statistics = StreamStatistics(stale_after_s=3.0)
    assert statistics.summary(0.0).level is DiagnosticLevel.STALE
    statistics = running()
    assert statistics.summary(1.0).level is DiagnosticLevel.OK
    statistics.drop(2)
    warned = statistics.summary(1.1)
    assert warned.level is DiagnosticLevel.WARN
    assert warned.message.startswith("2 frames")
    assert statistics.summary(1.2).level is DiagnosticLevel.OK
    statistics.reject("an image with encoding 'yuv422'")
    rejected = statistics.summary(1.3)
    assert rejected.level is DiagnosticLevel.WARN
    assert "yuv422" in rejected.message
    stale = statistics.summary(4.5)
    assert stale.level is DiagnosticLevel.STALE
    assert "3.5 s" in stale.message


def test_rejections_before_any_frame_are_told() -> None:
    statistics = StreamStatistics()
    statistics.reject("a magnification of nan")
    assert "nan" in statistics.summary(0.0).message


def test_fill_status(new: Callable[[str], Any]) -> None:
    statistics = running()
    statistics.drop()
    statistics.reject("bad")
    statistics.note("residual_px", 0.0123456789)
    message = new("diagnostic_msgs/msg/DiagnosticStatus")
    fill_diagnostic_status(message, "sem/rectifier", "JSM-820", statistics.summary(1.0))
    assert message.level in (1, b"\x01")
    assert (message.name, message.hardware_id) == ("sem/rectifier", "JSM-820")
    pairs = {pair.key: pair.value for pair in message.values}
    assert pairs["received"] == pairs["published"] == "11"
    assert pairs["dropped"] == pairs["rejected"] == "1"
    assert pairs["last_rejection"] == "bad"
    assert pairs["residual_px"] == "0.0123457"
    assert float(pairs["rate_hz"]) == pytest.approx(10.0)
    assert float(pairs["latency_max_ms"]) == pytest.approx(30.0)


def test_one_thread_reports_what_another_one_counts() -> None:
    """A replay counts in its own thread; a queue that grows while it is read would raise."""
    statistics, ended = StreamStatistics(window_s=0.5), threading.Event()

    def count() -> None:
        for k in itertools.count():
            statistics.publish(1e-5 * k, latency_s=0.01)
            statistics.note(f"key {k % 50}", k)
            statistics.forget(f"key {(k + 25) % 50}")
            if ended.is_set():
                return

    thread = threading.Thread(target=count)
    thread.start()
    try:
        until_s = time.monotonic() + 1.0
        while time.monotonic() < until_s:
            assert statistics.summary(1e9).message
            statistics.latency_s(0.0)
    finally:
        ended.set()
        thread.join()


def test_refuses_nonsense() -> None:
    with pytest.raises(InvalidValueError):
        StreamStatistics(window_s=0.0)
    with pytest.raises(InvalidValueError):
        StreamStatistics(stale_after_s=float("nan"))
