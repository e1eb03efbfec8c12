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

"""One frame through the core and through a whole node callback, beside the least that must be done.

The least is one ``cv2.remap`` with maps at hand and one copy of the image. All take their turn in
one run of one process, so that a busy machine slows all of them alike. Where many processes wait for
the processors, that is not enough: ``--busy`` counts the processor time of one thread.
"""

from __future__ import annotations

import argparse
import array
import json
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any

# As in the nodes: small products only wait for a second thread.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np

from benchmarks.live.scenes import CONFIG, calibration, pictures
from benchmarks.table import interleaved
from semcal_ros import Calibration
from semcal_ros.core.rectification.raw_positions import RasterDrift
from semcal_ros.core.rectification.rectifier import Rectifier

if TYPE_CHECKING:
    from semcal_ros.nodes.frames.live_drift import LiveDrift
    from semcal_ros.nodes.rectifier import RectifierNode
    from semcal_ros.nodes.stream_corrector import StreamCorrector

MAGNIFICATION = 5000.0
# More than any cache keeps: each is new to it.
MAGNIFICATIONS = np.geomspace(1000.0, 15000.0, 97)
ROUNDS = {512: 60, 1024: 40, 2048: 20, 4096: 9}
COLUMNS = (
    "core, still",
    "core, drift",
    "core, magnification",
    "core, both",
    "core, fast",
    "settling, still",
    "settling, drift",
    "settling, magnification",
    "settling, both",
    "settling, fast",
    "field, still",
    "field, drift",
    "field, magnification",
    "field, both",
    "field, fast",
    "node, still",
    "node, both",
    "registration",
)


def drifts(camera: Any, count: int = 31, *, px: float = 1.0) -> list[RasterDrift]:
    """Drifts of some ``px``, px/s and px/s^2."""
    rng = np.random.default_rng(0)
    return [RasterDrift(*(px * rng.normal(size=(3, 2)) / camera.m)) for _ in range(count)]


def core_actions(size: int, image: np.ndarray) -> dict[str, Callable[[], object]]:
    """The floor and the core call for one frame."""
    out, copy = np.empty_like(image), np.empty_like(image)
    map_x, map_y = Rectifier().maps(
        (size, size), calibration().at(MAGNIFICATION).resized(size, size)
    )

    def floor() -> None:
        cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR, dst=out)
        np.copyto(copy, out)

    return {
        "floor": floor,
        **_rectifications("core", calibration(), size, image, out),
        **_rectifications("settling", calibration(with_terms=True), size, image, out),
        **_rectifications("field", calibration(with_field=True), size, image, out),
    }


def _rectifications(
    name: str, model: Calibration, size: int, image: np.ndarray, out: np.ndarray
) -> dict[str, Callable[[], object]]:
    """Streams of every kind through the core; ``fast`` is a stage that moves by some ten pixels per second."""
    camera = model.at(MAGNIFICATION).resized(size, size)
    cameras = cycle([model.at(g).resized(size, size) for g in MAGNIFICATIONS])
    moving, moving_fast = cycle(drifts(camera)), cycle(drifts(camera, px=20.0))
    # One rectifier for each, as in a stream of that kind.
    still, drifting, zooming, both, fast = (Rectifier() for _ in range(5))
    scan = CONFIG.scan
    return {
        f"{name}, still": lambda: still.rectify(image, camera, out=out),
        f"{name}, drift": lambda: drifting.rectify(image, camera, next(moving), scan, out=out),
        f"{name}, magnification": lambda: zooming.rectify(image, next(cameras), out=out),
        f"{name}, both": lambda: both.rectify(image, next(cameras), next(moving), scan, out=out),
        f"{name}, fast": lambda: fast.rectify(image, camera, next(moving_fast), scan, out=out),
    }


class KnownDrift:
    """In the place of the tracker, whose time is measured by itself."""

    def __init__(self, tracker: LiveDrift, update: Any, camera: Any) -> None:
        from semcal_ros.core.drift.estimates import DriftEstimate
        from semcal_ros.nodes.frames.live_drift import FrameDrift

        covariance = np.eye(4) * 1e-18
        self._tracker = tracker
        self._made = cycle(
            FrameDrift(DriftEstimate(0.0, d.position, d.velocity, np.zeros(2), covariance), update)
            for d in drifts(camera)
        )

    def estimate(self, _frame: Any, _camera: Any) -> Any:
        return next(self._made)

    def reset(self) -> None:
        self._tracker.reset()

    def close(self) -> None:
        self._tracker.close()


@contextmanager
def nodes(size: int, folder: Path) -> Iterator[tuple[RectifierNode, StreamCorrector]]:
    """A rectifier and a stream corrector, both with a calibration."""
    import rclpy
    from geometry_msgs.msg import PoseWithCovarianceStamped as Pose
    from geometry_msgs.msg import TwistWithCovarianceStamped as Twist
    from sensor_msgs.msg import CameraInfo

    from semcal_ros.nodes.rectifier import RectifierNode
    from semcal_ros.nodes.stream_corrector import StreamCorrector

    calibration().save(folder / "cal.yaml")
    (folder / "config.yaml").write_text(CONFIG.text, encoding="utf-8")
    given = {"calibration": folder / "cal.yaml", "config": folder / "config.yaml"}
    # Registration is measured here and now, however long it takes.
    given |= {"stream_corrector:drift_tracking": "every_frame"}
    arguments = [part for k, v in given.items() for part in ("-p", f"{k}:={v}")]
    rclpy.init(args=["benchmark", "--ros-args", "--log-level", "error", *arguments])
    made = RectifierNode(), StreamCorrector()
    listener = rclpy.create_node("listener", namespace="/sem")
    # What nobody takes is not published.
    small = (CameraInfo, "camera_info"), (Pose, "drift"), (Twist, "drift_velocity")
    for kind, topic in small:
        listener.create_subscription(kind, topic, lambda _message: None, 1)
    try:
        deadline = time.monotonic() + 10.0
        while not all(listener.count_publishers(topic) for _, topic in small):
            assert time.monotonic() < deadline, "the nodes are not found"
            time.sleep(0.05)
        time.sleep(0.5)
        yield made
    finally:
        for node in (listener, *made):
            node.destroy_node()
        rclpy.shutdown()


def node_actions(
    rectifier: RectifierNode, corrector: StreamCorrector, images: list[np.ndarray]
) -> dict[str, Callable[[], object]]:
    """From a message that has arrived to the messages that are published."""
    from sensor_msgs.msg import Image
    from std_msgs.msg import Float64

    size = len(images[0])
    messages = []
    for image in images:
        message = Image(height=size, width=size, step=size * image.itemsize)
        message.encoding = "mono8" if image.itemsize == 1 else "mono16"
        message.data = array.array("B", image.tobytes())
        messages.append(message)
    clock = {"ns": 1_000_000_000}
    frames, knob = cycle(messages), cycle(MAGNIFICATIONS)

    def info() -> dict[str, int]:
        return {"source_timestamp": clock["ns"], "received_timestamp": clock["ns"]}

    def turn(node: Any, magnification: float) -> None:
        clock["ns"] += 1_000_000
        message = Float64(data=float(magnification))
        node.frames._magnification._on_message(message, info())

    def frame(node: Any) -> None:
        clock["ns"] += 100_000_000
        message = next(frames)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(clock["ns"], 10**9)
        node.frames._on_image(message, info())

    def both() -> None:
        turn(corrector, next(knob))
        frame(corrector)

    turn(rectifier, MAGNIFICATION)
    turn(corrector, MAGNIFICATION)
    frame(corrector)
    known = corrector.correction.tracking._latest.update
    camera = calibration().at(MAGNIFICATION).resized(size, size)
    tracker = corrector.correction.tracking
    corrector.correction.tracking = KnownDrift(tracker, known, camera)

    def registration() -> None:
        clock["ns"] += 100_000_000
        message = next(frames)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(clock["ns"], 10**9)
        given = corrector.frames._frame(message, info(), 1.0)
        tracker.estimate(given, camera)

    return {
        "node, still": lambda: frame(rectifier),
        "node, both": both,
        "registration": registration,
    }


def measure(size: int, depth: int, quick: bool, busy: bool) -> dict[str, float]:
    """Times of one size and depth as ratios to the floor, and the floor in s."""
    clock = time.thread_time if busy else time.perf_counter
    if busy:
        cv2.setNumThreads(1)
    images = pictures(size, depth)
    actions = core_actions(size, images[0])
    with tempfile.TemporaryDirectory() as folder, nodes(size, Path(folder)) as made:
        actions |= node_actions(*made, images)
        interleaved(actions, 20 if size <= 1024 else 4)
        times = interleaved(actions, max(ROUNDS[size] // (3 if quick else 1), 3), clock)
        for node in made:
            rejected = node.reporter.statistics.rejected
            assert not rejected, f"{rejected} frames rejected"
    return {"floor": times["floor"], **{k: times[k] / times["floor"] for k in COLUMNS}}


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="less of everything")
    parser.add_argument("--busy", action="store_true", help="processor time of one thread")
    parser.add_argument("size", type=int)
    parser.add_argument("depth", type=int, choices=(8, 16))
    options = parser.parse_args()
    os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    print(json.dumps(measure(options.size, options.depth, options.quick, options.busy)))


if __name__ == "__main__":
    main()
