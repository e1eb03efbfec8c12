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

"""What drift does to a frame on its way through a node, without ROS at work."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from semcal_ros.bridge.zero_order_hold import ZeroOrderHold, find_values, scan_interval_ns
from semcal_ros.config.config import MicroscopeConfig, load_config, parse_config
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.registration.agreement import MovingTiles
from semcal_ros.nodes.common.parameters import INTERPOLATION
from semcal_ros.nodes.frames.compressed import compressed_parameters
from semcal_ros.nodes.frames.live_drift import (
    DRIFT_PARAMETERS,
    DriftCorrection,
    FrameDrift,
    LoadMonitor,
)
from semcal_ros.nodes.frames.outputs import ImageOutput
from semcal_ros.nodes.frames.stream import StreamFrame, nominal_camera
from tests.helpers.node_fakes import FakeParameters, fake_context
from tests.helpers.node_scenes import image_message, texture

CONFIG = replace(load_config("virtual_sem"), scan=None)
IMAGE = texture(size=128)
CAMERA = nominal_camera(5000.0, 128, 128, CONFIG.display_width_m)
S = 1_000_000_000

MS = 1_000_000
RASTER = """
name: test
display_width_m: 0.12
image: {{stamp: {stamp}}}
magnification: {{quantity: magnification}}
{scan}
"""
SCAN = "scan: {frame_time_s: 0.25, averages: 4}"


class Bench:
    """A correction with an output of images, and what both publish, in this order."""

    def __init__(self, closing: ExitStack) -> None:
        self.published: list[tuple[str, Any]] = []
        endpoints: Any = SimpleNamespace(
            stream_publisher=self._publisher,
            trigger_service=lambda *_: None,
            below=lambda topic, name: f"{topic}/{name}",
            guard=lambda _callback: SimpleNamespace(trigger=lambda: None),
        )
        declared = (*DRIFT_PARAMETERS, INTERPOLATION, *compressed_parameters("image_stabilized"))
        parameters = FakeParameters({one.name: one.default for one in declared})
        parameters.set("drift_tracking", "every_frame")
        context = fake_context(endpoints, CONFIG, parameters)
        self.image = ImageOutput(context, "image_stabilized")
        closing.callback(self.image.close)
        self.correction = DriftCorrection(context, closing)
        self.drifts: list[FrameDrift | None] = []

    def _publisher(self, _kind: Any, topic: str, _name: str = "") -> Any:
        return SimpleNamespace(
            is_awaited=topic != "image_stabilized/compressed",
            publish=lambda message: self.published.append((topic, message)),
        )

    def receive(self, image: np.ndarray, second: int, *, mixed: bool = False) -> list[str]:
        """Take a frame; the topics on which something was published, in order."""
        self.published.clear()
        header = image_message(image, float(second)).header
        frame = StreamFrame(image, "mono8", header, second * S, 5000.0, mixed)

        def publish(drift: FrameDrift | None) -> None:
            self.drifts.append(drift)
            self.image.publish(frame)

        self.correction.correct(frame, CAMERA, self.image, publish)
        return [topic for topic, _ in self.published]


@pytest.fixture
def bench() -> Any:
    with ExitStack() as closing:
        yield Bench(closing)


def test_the_image_comes_before_its_drift(bench: Bench) -> None:
    topics = ["image_stabilized", "drift", "drift_velocity", "~/moving"]
    assert bench.receive(IMAGE, 1) == topics
    assert bench.correction.conditions() == []


def test_a_shift_is_taken_out_of_the_image(bench: Bench) -> None:
    for second in range(1, 4):
        bench.receive(IMAGE, second)
    # Content that moves to the right by four pixels; the border that came in is not compared.
    bench.receive(np.roll(IMAGE, 4, axis=1), 4)
    drift = bench.drifts[-1]
    assert drift is not None
    dx_px = float(CAMERA.ideal_from_sem_jacobian[0] @ drift.estimate.drift_m)
    # What wraps around at the border is not the specimen: a tenth of a pixel of the four.
    assert dx_px == pytest.approx(4.0, abs=0.1)
    inside = np.s_[16:-16, 16:-16]
    difference = bench.image.pixels[inside].astype(float) - IMAGE[inside]
    # A tenth of a pixel on a texture of this contrast; unshifted, they would differ by more than ten times this.
    assert np.sqrt(np.mean(np.square(difference))) < 0.1 * IMAGE.std()


def test_what_moves_is_drawn_at_the_magnification_of_a_frame_that_was_not_measured(
    bench: Bench,
) -> None:
    bench.receive(IMAGE, 1)
    tracking: Any = bench.correction.tracking
    tracking._parameters.set("drift_tracking", "forecast")
    frame = StreamFrame(IMAGE, "mono8", image_message(IMAGE, 2.0).header, 2 * S, 10000.0, False)
    twice = nominal_camera(10000.0, 128, 128, CONFIG.display_width_m)
    drift = tracking.estimate(frame, twice)
    assert drift.is_forecast
    assert drift.zoom == pytest.approx(2.0, rel=1e-12)
    mask = np.zeros((128, 128), dtype=bool)
    mask[72:88, 80:88] = True
    parts = MovingTiles.of_pixels(mask)
    moves = replace(drift, measured=replace(drift.measured, moving=parts)).draw_moving((128, 128))
    # From the middle of the image, 63.5 px; the drift is none.
    assert np.argwhere(moves).min(axis=0).tolist() == [80, 96]
    assert np.argwhere(moves).max(axis=0).tolist() == [111, 111]
    stays = replace(drift, measured=replace(drift.measured, fixed=parts)).draw_moving((128, 128))
    np.testing.assert_array_equal(stays > 0, mask)


def test_a_frame_of_two_magnifications_has_no_drift(bench: Bench) -> None:
    bench.receive(IMAGE, 1)
    assert bench.receive(IMAGE, 2, mixed=True) == ["image_stabilized"]
    assert bench.drifts[-1] is None
    np.testing.assert_array_equal(bench.image.pixels, IMAGE)


def test_a_reset_begins_at_zero(bench: Bench) -> None:
    bench.receive(IMAGE, 1)
    bench.correction.tracking.reset()
    bench.receive(np.roll(IMAGE, 4, axis=1), 2)
    drift = bench.drifts[-1]
    assert drift is not None
    np.testing.assert_array_equal(drift.estimate.drift_m, 0.0)


def config(stamp: str = "start", scan: str = SCAN) -> MicroscopeConfig:
    return parse_config(RASTER.format(stamp=stamp, scan=scan))


def run(load: LoadMonitor, frames: int, interval_s: float, cost_s: float) -> list[bool]:
    states = []
    for _ in range(frames):
        load.add_interval(interval_s)
        load.add_cost(cost_s)
        states.append(load.keeps_up)
    return states


def test_a_slow_stream_is_measured_frame_by_frame() -> None:
    assert all(run(LoadMonitor(), 50, 0.5, 0.02))


def test_a_fast_stream_is_not_waited_for_and_comes_back_with_room_to_spare() -> None:
    load = LoadMonitor()
    assert not run(load, 50, 0.005, 0.01)[-1]
    # Just enough time would make it go to and fro.
    assert not run(load, 200, 0.020, 0.01)[-1]
    assert run(load, 200, 0.030, 0.01)[-1]
    assert run(load, 200, 0.020, 0.01)[-1]


def test_one_hiccup_changes_nothing() -> None:
    load = LoadMonitor()
    run(load, 50, 0.1, 0.02)
    load.add_cost(0.3)
    assert load.keeps_up
    assert math.isnan(LoadMonitor().cost_s)


@pytest.mark.parametrize("value", [-1.0, math.nan, math.inf])
def test_times_that_cannot_be_are_refused(value: float) -> None:
    with pytest.raises(InvalidValueError):
        LoadMonitor().add_interval(value)
    with pytest.raises(InvalidValueError):
        LoadMonitor().add_cost(value)


@pytest.mark.parametrize(("stamp", "start_ms"), [("start", 0), ("centre", -500), ("end", -1000)])
def test_with_stamps_the_scan_is_where_the_stamp_says(stamp: str, start_ms: int) -> None:
    # Four passes of 0.25 s; one per cent of the second at either end does not count.
    interval = scan_interval_ns(5000 * MS, None, config(stamp))
    assert interval == ((5000 + start_ms + 10) * MS, (5000 + start_ms + 990) * MS)


def test_with_publication_times_the_last_moments_belong_to_the_frame() -> None:
    # Published when it is complete: a magnification 20 ms before is announced with it.
    assert scan_interval_ns(0, 1000 * MS, config()) == (10 * MS, 980 * MS)
    # Published later: one that came during the last 20 ms of the scan is none of these.
    assert scan_interval_ns(0, 1100 * MS, config()) == (10 * MS, 990 * MS)
    # Published before it can be complete.
    assert scan_interval_ns(0, 500 * MS, config()) == (5 * MS, 480 * MS)
    # Without raster timing it was scanned between its stamp and its publication.
    assert scan_interval_ns(0, 200 * MS, config(scan="")) == (2 * MS, 180 * MS)
    # What is published as soon as it is grabbed may come right after its magnification.
    assert scan_interval_ns(0, 20 * MS, config(scan="")) is None


@pytest.mark.parametrize(
    ("changed_ms", "found", "during"),
    [
        (5, 2.0, [2.0]),  # in the first rows
        (500, 2.0, [1.0, 2.0]),  # mixed
        (985, 2.0, [1.0, 2.0]),
        (995, 1.0, [1.0]),  # in the last rows
        (1050, 1.0, [1.0]),  # after the scan, and before the frame was published
        (1095, 2.0, [1.0]),  # announced together with it
        (1150, 1.0, [1.0]),
    ],
)
def test_the_value_of_a_frame_is_the_one_during_its_scan(
    changed_ms: int, found: float, during: list[float]
) -> None:
    hold = ZeroOrderHold[float]()
    hold.insert(-1000 * MS, 1.0)
    hold.insert(changed_ms * MS, 2.0)
    assert find_values(hold, 0, 1100 * MS, config()) == (found, during)


@pytest.mark.parametrize(
    ("stamp", "changed_ms", "found"),
    [("start", 5, 2.0), ("start", 995, 1.0), ("end", -995, 2.0), ("end", -5, 1.0)],
)
def test_a_stamped_value_is_the_one_during_the_scan_wherever_the_frame_is_stamped(
    stamp: str, changed_ms: int, found: float
) -> None:
    hold = ZeroOrderHold[float]()
    hold.insert(-5000 * MS, 1.0)
    hold.insert(changed_ms * MS, 2.0)
    assert find_values(hold, 0, None, config(stamp)) == (found, [found])


def test_a_recursive_average_shows_earlier_passes() -> None:
    averaging = replace(config(), scan=ScanTiming(0.25, recursive_averages=4))
    interval = scan_interval_ns(0, None, averaging)
    assert interval is not None
    # After eleven passes, 0.75^11 = 0.042 of what was before is left.
    assert -11 * 250 * MS < interval[0] < -10 * 250 * MS
    assert interval[1] == 247.5 * MS


def test_nothing_is_known_of_a_stamp_of_another_clock() -> None:
    replayed_ns = 50_000_000 * 1000 * MS
    assert scan_interval_ns(0, replayed_ns, config()) is None
    assert scan_interval_ns(replayed_ns, 0, config()) is None
    assert scan_interval_ns(0, None, config(scan="")) is None
    # Published at its stamp, as recordings are: nothing came before.
    assert scan_interval_ns(0, 0, config()) is None


def test_values_that_began_within_an_interval() -> None:
    hold = ZeroOrderHold[float]()
    for stamp, value in ((10, 1.0), (20, 2.0), (30, 3.0)):
        hold.insert(stamp, value)
    assert hold.between(10, 30) == [2.0, 3.0]
    assert hold.between(0, 9) == []
    assert hold.between(30, 99) == []
