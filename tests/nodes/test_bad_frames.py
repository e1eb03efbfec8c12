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

"""Frames and magnifications beyond all reason: refused with a reason, counted, without harm to what follows."""

from __future__ import annotations

import array
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Twist
from sensor_msgs.msg import Image
from std_msgs.msg import Float64, Float64MultiArray

from tests.helpers.node_scenes import SIZE, image_message, magnification_message, texture
from tests.helpers.ros_process import LATCHED, PATIENT, RELIABLE, Peer, running
from tests.helpers.stream_bench import (
    CALIBRATION,
    KINDS,
    MAGNIFICATION,
    RECTIFIER,
    Bench,
    Kind,
    Watch,
    bench_of,
    noisy,
    pixels,
    resident_kib,
)

BIGGEST = 2**32 - 1
FRAMES = {kind.node: kind for kind in KINDS}


@pytest.fixture(params=FRAMES)
def kind(request: pytest.FixtureRequest) -> Kind:
    return FRAMES[request.param]


@pytest.fixture
def bench(peer: Peer, kind: Kind, tmp_path: Path) -> Iterator[Bench]:
    CALIBRATION.save(tmp_path / "cal.yaml")
    parameters: dict[str, Any] = dict(PATIENT)
    if kind.rectifies:
        parameters["calibration"] = tmp_path / "cal.yaml"
    with bench_of(peer, kind, parameters) as made:
        yield made


def _frame(
    height: int, width: int, step: int, size: int, encoding: str = "mono8"
) -> Callable[[], Image]:
    def make() -> Image:
        message = Image(height=height, width=width, step=step, encoding=encoding)
        message.data = array.array("B", bytes(size))
        return message

    return make


def _changed(**values: Any) -> Callable[[], Image]:
    def make() -> Image:
        message = image_message(texture())
        for key, value in values.items():
            setattr(message, key, value)
        return message

    return make


def _odd_stamp() -> Image:
    message = image_message(texture())
    message.header.stamp.nanosec = BIGGEST
    return message


# What is wrong, and what the reason must name.
REFUSED: dict[str, tuple[Callable[[], Image], str]] = {
    "zero-length data": (_frame(SIZE, SIZE, SIZE, 0), "truncated image data of 0 bytes"),
    "truncated data": (_frame(SIZE, SIZE, SIZE, SIZE * SIZE - 1), "truncated"),
    "overlong data": (_frame(SIZE, SIZE, SIZE, SIZE * SIZE + 1), "overlong"),
    "greatest step": (_frame(SIZE, SIZE, BIGGEST, SIZE * SIZE), f"a step of {BIGGEST} bytes"),
    # height * step is 0 and 65536 in 32 bits.
    "wrapping to nothing": (_frame(2**16, 1, 2**16, 0), f"expected {2**32} bytes"),
    "wrapping to the data": (_frame(2**16 + 1, 1, 2**16, 2**16), f"expected {2**32 + 2**16} bytes"),
    "greatest of everything": (_frame(BIGGEST, BIGGEST, BIGGEST, 4), "truncated"),
    "step below the width": (_frame(SIZE, SIZE, SIZE - 1, SIZE * (SIZE - 1)), "a step of"),
    "step of one byte per pixel": (_frame(SIZE, SIZE, SIZE, SIZE**2, "mono16"), "a step of"),
    "no width": (_frame(SIZE, 0, 0, 0), f"an image of 0 x {SIZE} pixels"),
    "no height": (_frame(0, SIZE, SIZE, 0), f"an image of {SIZE} x 0 pixels"),
    "no encoding": (_changed(encoding=""), "encoding ''"),
    "unknown encoding": (_changed(encoding="bayer_rggb8"), "bayer_rggb8"),
    # It must neither fill the log nor the diagnostics.
    "endless encoding": (_changed(encoding="y" * 100_000), "encoding 'yyyy"),
    "impossible stamp": (_odd_stamp, f"a stamp with {BIGGEST} ns"),
}


def _expect_right(bench: Bench, picture: np.ndarray, g: float = MAGNIFICATION) -> None:
    message = bench.exchange(picture)
    np.testing.assert_array_equal(pixels(message), bench.kind.right(picture, g))


def test_what_cannot_be_a_frame_is_refused_and_does_no_harm(bench: Bench) -> None:
    bench.set_magnification(MAGNIFICATION)
    for make, _ in REFUSED.values():
        bench.send(make())
    count = len(REFUSED)
    state = bench.wait_counts(received=count, rejected=count, dropped=0, published=0)
    assert state["level"] == "1"
    assert f"last rejection: a stamp with {BIGGEST} ns" in state["message"]
    for what, (_, reason) in REFUSED.items():
        assert reason in bench.node.output, what
    warnings = [line for line in bench.node.output.splitlines() if "[WARN]" in line]
    assert max(map(len, warnings)) < 400
    # Nothing was learnt from them: the drift of the first good frame is zero, so its pixels are exact.
    _expect_right(bench, texture(1))
    bench.wait_counts(received=count + 1, rejected=count, dropped=0, published=1)
    state = bench.watch.wait_fresh(bench.kind.full_name)
    assert (state["level"], state["message"].partition(" ")[2]) == ("0", "Hz")


# Height, width; what comes out is as large as what went in.
SMALL = [(1, 1), (1, 2), (2, 1), (1, SIZE), (SIZE, 1), (2, 2), (3, 5), (16, 16)]
# OpenCV cannot sample images with a side of 2**15 - 1 px or more.
LONG = [(1, 65535), (65535, 1), (40000, 2)]


BYTES_PER_PIXEL = {"mono8": 1, "mono16": 2, "32FC1": 4, "bgr8": 3}


def test_tiny_and_endless_frames_end_in_an_image_or_a_reason(bench: Bench) -> None:
    bench.set_magnification(MAGNIFICATION)
    sizes = {}
    for encoding, per_pixel in BYTES_PER_PIXEL.items():
        for height, width in [*SMALL, *LONG]:
            step = width * per_pixel
            message = _frame(height, width, step, step * height, encoding)()
            message.header.stamp.sec = bench.sent + 1
            bench.send(message)
            sizes[bench.sent] = height, width, step * height
    # Each is either published or refused, and not both.
    state = bench.wait_counts(received=len(sizes), dropped=0)
    assert int(state["published"]) + int(state["rejected"]) == len(sizes), str(state)
    bench.expect(bench.count("published"))
    for message in bench.images:
        expected = sizes[message.header.stamp.sec]
        assert (message.height, message.width, len(message.data)) == expected
    if bench.kind is RECTIFIER:
        # No drift to find in them: all that can be sampled is.
        assert len(bench.images) == len(SMALL) * len(BYTES_PER_PIXEL)
    _expect_right(bench, texture(2))


def test_pixels_that_are_no_numbers_stay_where_they_are(bench: Bench) -> None:
    bench.set_magnification(MAGNIFICATION)
    grey = texture().astype(np.float32)
    gaps = np.where(np.arange(SIZE)[:, None] % 2, np.float32(np.nan), grey)
    strange = [
        np.full((SIZE, SIZE), np.nan, np.float32),
        gaps,
        np.full((SIZE, SIZE), np.inf, np.float32),
        np.where(grey > 128.0, np.float32(3e38), np.float32(-3e38)),
        np.full((SIZE, SIZE), 1e-45, np.float32),
    ]
    for image in strange:
        bench.send(image_message(image, float(bench.sent), encoding="32FC1"))
        message = bench.expect(bench.sent)
        assert message.encoding == "32FC1"
    # Nothing of it stays in an image that the drift is measured against.
    message = bench.exchange(texture(3))
    np.testing.assert_array_equal(pixels(message), bench.kind.right(texture(3), MAGNIFICATION))


ABSURD = [
    0.0,
    -0.0,
    -1000.0,
    float("nan"),
    float("inf"),
    float("-inf"),
    1e12,
    1.7976931348623157e308,
    1e-300,
    5e-324,  # the smallest denormal
    0.999,
]


@pytest.mark.parametrize("kind", ["drift_compensator", "stream_corrector"], indirect=True)
def test_a_stream_that_was_never_tracked_claims_no_drift(bench: Bench) -> None:
    """Each frame shows another place: what the filter expects of a typical drift is no measurement."""
    bench.set_magnification(MAGNIFICATION)
    for seed in range(4):
        bench.exchange(texture(seed + 10))
    for messages in (bench.drifts, bench.velocities):
        bench.peer.wait_for(lambda m=messages: len(m) >= 3, "drift")
    drifts = {m.header.stamp.sec: m.pose.covariance for m in bench.drifts}
    velocities = {m.header.stamp.sec: m.twist.covariance for m in bench.velocities}
    pixel_m = CALIBRATION.at(MAGNIFICATION).pixel_size_m[0]
    for stamp, covariance in drifts.items():
        # At the first frame the drift is zero by definition.
        known = 0.0 <= covariance[0] ** 0.5 < pixel_m
        assert known if stamp == 1 else (covariance[0], covariance[7]) == (1e6, 1e6)
    assert all((c[0], c[7]) == (1e6, 1e6) for c in velocities.values())

    def known() -> bool:
        bench.exchange(noisy(texture(10), bench.sent))
        bench.peer.wait_for(lambda: bench.drifts[-1].header.stamp.sec == bench.sent, "its drift")
        return bool(bench.drifts[-1].pose.covariance[0] < 1e6)

    # The first frame but for its noise: now it is known. On a busy machine the node measures beside the stream, and
    # what comes with a frame is what was known before it.
    bench.peer.wait_for(known, "a known drift")


def test_an_absurd_magnification_is_refused_and_the_old_one_not_used_on(bench: Bench) -> None:
    bench.set_magnification(MAGNIFICATION)
    _expect_right(bench, texture())
    for index, value in enumerate(ABSURD, 1):
        bench.set_magnification(value)
        bench.send(texture(index))
    count = len(ABSURD)
    state = bench.wait_counts(received=count + 1, published=1, rejected=count, dropped=0)
    assert state["frames_without_magnification"] == str(count)
    assert state["magnification"] == "unknown"
    assert state["level"] == "1"
    assert "waiting for magnification" in state["message"]
    # In one of the reports since each; this one may only have counted the last frame.
    said = [earlier["message"] for earlier in bench.watch.states(bench.kind.full_name)]
    assert any("last rejection: a magnification of" in text for text in said)
    assert len(bench.images) == 1
    bench.set_magnification(3000.0)
    message = bench.exchange(texture(50))
    if not bench.kind.tracks:
        np.testing.assert_array_equal(pixels(message), bench.kind.right(texture(50), 3000.0))
    state = bench.wait_counts(received=count + 2, published=2, rejected=count, dropped=0)
    assert state["magnification"] == "3000"


def test_the_ends_of_the_magnifications_that_are_possible_give_an_answer(bench: Bench) -> None:
    """Far outside the calibrated range: an image with a warning, or a reason, and then all is well again."""
    for done, magnification in enumerate((1.0, 1e8), 1):
        bench.set_magnification(magnification)
        bench.send(texture())
        bench.peer.wait_for(
            lambda n=done: bench.count("published") + bench.count("rejected") == n, "an answer"
        )
        assert bench.state()["magnification"] == f"{magnification:.6g}"
        if bench.kind.rectifies:
            assert bench.state()["level"] == "1"
            assert bench.state()["in_calibrated_range"] == "False"
    bench.expect(bench.count("published"))
    bench.set_magnification(MAGNIFICATION)
    message = bench.exchange(texture(1))
    if not bench.kind.tracks:
        # Maps may be interpolated between nodes of a lattice, which may turn a grey level.
        right = bench.kind.right(texture(1), MAGNIFICATION).astype(int)
        assert np.abs(pixels(message) - right).max() <= 1


def test_neither_memory_nor_the_log_grows_with_bad_messages(bench: Bench) -> None:
    """Every refusal has a reason of its own, two a frame; none of them may be kept, and not all be logged."""
    bench.set_magnification(MAGNIFICATION)
    _expect_right(bench, texture())

    def flood(first: int, last: int) -> int:
        for index in range(first, last):
            message = _frame(SIZE, SIZE, SIZE + index, 40 * index)()
            message.encoding = f"encoding {index}" if index % 2 else "mono8"
            bench.send(message)
            bench.magnification.publish(magnification_message(-float(index)))
            if index % 40 == 0 or index == last - 1:
                # Not faster than they can be refused, of which 50 may wait: all shall be.
                bench.wait_counts(received=bench.sent, dropped=0)
        return bench.resident_kib()

    start = time.monotonic()
    first = flood(1, 200)
    # What the allocator and the log handlers reserve is reserved by now. 400 more frames of 16 kB on average are
    # 6 MB, of which nothing may stay: a page here and there is left for the allocator.
    grown_kib = flood(200, 600) - first
    assert grown_kib < 2 * 1024
    # The value of a magnification may be overtaken by the next.
    assert bench.count("rejected") >= 599
    lines = [line for line in bench.node.output.splitlines() if "[WARN]" in line]
    assert lines
    # A hundred reasons in ten seconds are enough for who reads them.
    assert len(lines) <= 100 * (1.0 + (time.monotonic() - start) / 10.0)


# -- the nodes that make no frames -------------------------------------------------------------------


@pytest.mark.long
def test_the_parameter_server_survives_absurd_magnifications(peer: Peer, tmp_path: Path) -> None:
    CALIBRATION.save(tmp_path / "cal.yaml")
    watch = Watch(peer)
    value = peer.node.create_publisher(Float64, "magnification", LATCHED)
    projections = peer.collect(Float64MultiArray, "projection")
    node = "/sem/parameter_server"
    with running("parameter_server", {"calibration": tmp_path / "cal.yaml"}) as process:
        watch.wait_heard(node, "projection")
        peer.wait_for(lambda: value.get_subscription_count() == 1, "the subscription")
        for rejected, absurd in enumerate(ABSURD, 1):
            value.publish(magnification_message(absurd))
            peer.wait_for(lambda n=rejected: watch.count(node, "rejected") == n, f"{absurd}")
        assert projections == []
        value.publish(magnification_message(3000.0))
        peer.wait_for(lambda: projections, "the projection")
        expected = CALIBRATION.at(3000.0).rectified.P_affine
        np.testing.assert_allclose(np.reshape(projections[-1].data, (3, 4)), expected, rtol=1e-12)
        before = resident_kib(process.process.pid)
        for index in range(600):
            value.publish(magnification_message(-1.0 - index if index % 2 else 1000.0 + index))
            if index % 50 == 0:
                peer.spin(0.02)
        value.publish(magnification_message(4000.0))
        final = CALIBRATION.at(4000.0).rectified.P_affine.ravel()
        peer.wait_for(lambda: np.allclose(projections[-1].data, final, rtol=1e-12), "the last one")
        assert resident_kib(process.process.pid) - before < 6 * 1024
        assert process.process.poll() is None


def test_the_virtual_sem_refuses_absurd_orders(peer: Peer) -> None:
    watch = Watch(peer)
    images = peer.collect(Image, "image_raw")
    knob = peer.node.create_publisher(Float64, "virtual_sem/set_magnification", RELIABLE)
    stage = peer.node.create_publisher(Twist, "virtual_sem/stage", RELIABLE)
    settings = {"width": 64, "height": 64, "rate": 20.0, "specimen": "gold"}
    with running("virtual_sem", settings) as process:
        peer.wait_for(lambda: images, "a frame")
        for publisher in (knob, stage):
            peer.wait_for(lambda p=publisher: p.get_subscription_count() == 1, "the subscription")
        node = "/sem/virtual_sem"
        # In groups: ten orders wait at most.
        for first in range(0, len(ABSURD), 8):
            for absurd in ABSURD[first : first + 8]:
                knob.publish(Float64(data=absurd))
            count = min(first + 8, len(ABSURD))
            peer.wait_for(lambda n=count: watch.count(node, "rejected") == n, "the refusals")
        for absurd in (float("nan"), float("inf"), float("-inf")):
            twist = Twist()
            twist.linear.x = absurd
            stage.publish(twist)
        count = len(ABSURD) + 3
        peer.wait_for(lambda: watch.count(node, "rejected") == count, "the refusals of the stage")
        # Faster than light for a specimen: wherever it is then, frames go on, or a reason is given.
        twist = Twist()
        twist.linear.x, twist.angular.z = 1e300, 1e300
        stage.publish(twist)
        peer.spin(0.5)
        stage.publish(Twist())
        watch.wait_fresh(node)
        assert process.process.poll() is None
        assert watch.latest(node)["magnification"] == "1000"
