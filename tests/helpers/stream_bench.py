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

"""A stream node that is put under stress: what goes in, what comes out, and what it says of itself."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from numpy.typing import NDArray
from rclpy.duration import Duration
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float64

from semcal_ros.core.rectification.rectifier import Rectifier
from tests.helpers.node_scenes import (
    SIZE,
    image_message,
    magnification_message,
    make_calibration,
    texture,
)
from tests.helpers.ros_process import LATCHED, RELIABLE, NodeProcess, Peer

CALIBRATION = make_calibration()
MAGNIFICATION = 2000.0
# Grey levels: far less than two frames of the textures here differ by when one is 1 px off.
NOISE = 2.0
MARGIN = 16
STREAM_PERIOD_S = 0.05


@dataclass(frozen=True)
class Kind:
    """One of the nodes that turn frames into frames."""

    node: str
    image: str
    outputs: tuple[str, ...]

    @property
    def full_name(self) -> str:
        return f"/sem/{self.node}"

    @property
    def rectifies(self) -> bool:
        return "camera_info" in self.outputs

    @property
    def tracks(self) -> bool:
        return "drift" in self.outputs

    def right(
        self, picture: NDArray[Any], magnification: float, interpolation: str = "linear"
    ) -> NDArray[Any]:
        """What must come out of a frame without drift."""
        if not self.rectifies:
            return picture
        size = picture.shape[1], picture.shape[0]
        camera = CALIBRATION.at(magnification).resized(*size)
        return Rectifier(interpolation).rectify(picture, camera)


RECTIFIER = Kind("rectifier", "image_rect", ("image_rect", "camera_info"))
COMPENSATOR = Kind(
    "drift_compensator", "image_stabilized", ("image_stabilized", "drift", "drift_velocity")
)
CORRECTOR = Kind(
    "stream_corrector", "image_rect", ("image_rect", "camera_info", "drift", "drift_velocity")
)
KINDS = (RECTIFIER, COMPENSATOR, CORRECTOR)


def pixels(message: Any) -> NDArray[Any]:
    """Image of a mono8 message."""
    return np.frombuffer(message.data, np.uint8).reshape(message.height, message.width)


def noisy(picture: NDArray[np.uint8], seed: int) -> NDArray[np.uint8]:
    """The image as another frame would show it."""
    noise = np.random.default_rng(seed).normal(0.0, NOISE, picture.shape)
    return np.clip(np.round(picture + noise), 0, 255).astype(np.uint8)


def difference(first: NDArray[Any], second: NDArray[Any]) -> float:
    """RMS difference away from the borders, grey levels."""
    inner = (slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
    change = first[inner].astype(float) - second[inner]
    return float(np.sqrt(np.mean(change**2)))


def resident_kib(pid: int) -> int:
    """Resident memory of a process (proc_pid_status(5))."""
    for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    raise LookupError(f"process {pid} has no memory any more")


class Restartable:
    """An executable that can be killed and started again with what it was given the first time."""

    def __init__(
        self,
        name: str,
        parameters: Mapping[str, Any] | None = None,
        arguments: Sequence[str] = (),
        place: Callable[[list[str]], list[str]] | None = None,
    ) -> None:
        self._given = name, dict(parameters or {}), tuple(arguments)
        self._place = place
        self.start_again()

    @property
    def output(self) -> str:
        """What the present process has written."""
        return self.process.output

    @property
    def pid(self) -> int:
        return self.process.process.pid

    def alive(self) -> bool:
        return self.process.process.poll() is None

    def kill(self) -> None:
        """End it as the kernel does: without a word to anybody."""
        assert self.process.stop(signal.SIGKILL) == -signal.SIGKILL
        self.process.close()

    def start_again(self) -> None:
        self.process = NodeProcess(*self._given, place=self._place)


@contextmanager
def restartable(
    name: str,
    parameters: Mapping[str, Any] | None = None,
    *arguments: str,
    place: Callable[[list[str]], list[str]] | None = None,
) -> Iterator[Restartable]:
    """An executable to be killed; it must be up again, and in order, at the end."""
    made = Restartable(name, parameters, arguments, place)
    try:
        yield made
        assert made.alive(), made.output
        assert "Traceback" not in made.output
    finally:
        made.process.stop()
        made.process.close()


@dataclass
class Watch:
    """What the nodes say on /diagnostics, so that an older process of a name is not mixed up with the newer."""

    peer: Peer
    arrays: list[Any] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._since_ns = 0
        self.peer.node.create_subscription(DiagnosticArray, "/diagnostics", self._take, RELIABLE)

    def _take(self, array: Any, info: Mapping[str, Any]) -> None:
        if info["source_timestamp"] >= self._since_ns:
            self.arrays.append(array)

    def forget(self) -> None:
        """What was said so far is no news, nor what has not been handled yet."""
        self._since_ns = time.time_ns()
        self.arrays.clear()

    def states(self, node: str) -> list[dict[str, str]]:
        """Everything that a node has said since, oldest first."""
        found = []
        for array in self.arrays:
            for status in array.status:
                if status.name == f"{node}: stream":
                    level = int.from_bytes(status.level, "little")
                    values = {value.key: value.value for value in status.values}
                    found.append({**values, "level": str(level), "message": status.message})
        return found

    def latest(self, node: str) -> dict[str, str]:
        """The last of these, or nothing."""
        return (self.states(node) or [{}])[-1]

    def count(self, node: str, key: str) -> int:
        """A counter, -1 before the first report."""
        return int(self.latest(node).get(key, -1))

    def wait_fresh(self, node: str) -> dict[str, str]:
        """The second report from now on: the first may have been under way already."""
        self.forget()
        self.peer.wait_for(lambda: len(self.states(node)) >= 2, f"two reports of {node}")
        return self.latest(node)

    def wait_heard(self, node: str, *topics: str) -> None:
        """As that of Peer, but not content with what an earlier process has said."""
        for topic in topics:
            self.peer.wait_for(
                lambda key=f"subscribers.{topic}": self.count(node, key) > 0,
                f"{node} to find a subscriber of {topic}",
            )


@dataclass
class Bench:
    """One node of :data:`KINDS` between a microscope and a consumer, both played by the test."""

    peer: Peer
    kind: Kind
    node: Restartable
    watch: Watch
    image: Any
    magnification: Any
    images: list[Any]
    infos: list[Any]
    drifts: list[Any]
    velocities: list[Any]
    sent: int = 0

    def ready(self) -> None:
        """Wait until both sides have found each other."""
        self.watch.wait_heard(self.kind.full_name, *self.kind.outputs)
        for publisher in (self.image, self.magnification):
            self.peer.wait_for(
                lambda p=publisher: p.get_subscription_count() >= 1, "the subscription"
            )

    def set_magnification(self, magnification: float) -> None:
        self.magnification.publish(magnification_message(magnification))
        # That this side knows of the node does not mean that it has heard. One that was killed never answers.
        self.magnification.wait_for_all_acked(Duration(seconds=3.0))

    def send(self, picture: NDArray[Any] | Image, stamp_s: float | None = None) -> None:
        """Publish a frame, a second of stamp after the one before if no stamp is given."""
        self.sent += 1
        stamp_s = float(self.sent) if stamp_s is None else stamp_s
        message = picture
        if not isinstance(picture, Image):
            message = image_message(picture, stamp_s)
        self.image.publish(message)

    def expect(self, count: int) -> Any:
        """Wait for that many images in all; the last one."""
        self.peer.wait_for(lambda: len(self.images) >= count, f"image {count}")
        return self.images[count - 1]

    def exchange(self, picture: NDArray[Any], stamp_s: float | None = None) -> Any:
        """Send one frame and wait for what comes of it."""
        count = len(self.images)
        self.send(picture, stamp_s)
        return self.expect(count + 1)

    def state(self) -> dict[str, str]:
        return self.watch.latest(self.kind.full_name)

    def count(self, key: str) -> int:
        return self.watch.count(self.kind.full_name, key)

    def wait_counts(self, **counts: int) -> dict[str, str]:
        """Wait until the counters in the diagnostics are exactly these."""

        def equal() -> bool:
            return all(self.count(key) == value for key, value in counts.items())

        try:
            self.peer.wait_for(equal, "the counters")
        except AssertionError:
            raise AssertionError(f"expected {counts}; {self.state()}") from None
        return self.state()

    def resident_kib(self) -> int:
        return resident_kib(self.node.pid)

    def kill(self) -> None:
        """As that of the node; what it said is forgotten."""
        self.node.kill()
        self.watch.forget()


@contextmanager
def bench_of(
    peer: Peer,
    kind: Kind,
    parameters: Mapping[str, Any] | None = None,
    arguments: Sequence[str] = (),
    *,
    magnification_type: Any = Float64,
    magnification_topic: str = "magnification",
) -> Iterator[Bench]:
    """A running node with everything that goes in and out; it must still be up at the end."""
    watch = Watch(peer)
    image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
    value = peer.node.create_publisher(magnification_type, magnification_topic, LATCHED)
    with restartable(kind.node, parameters, *arguments) as node:
        made = Bench(
            peer,
            kind,
            node,
            watch,
            image,
            value,
            peer.collect(Image, kind.image),
            peer.collect(CameraInfo, "camera_info"),
            peer.collect(PoseWithCovarianceStamped, "drift"),
            peer.collect(TwistWithCovarianceStamped, "drift_velocity"),
        )
        made.ready()
        yield made


class Stream:
    """Frames of a specimen at rest, sent while the test waits for something; remembered by stamp."""

    def __init__(self, bench: Bench) -> None:
        self.bench = bench
        self.sent: dict[int, NDArray[np.uint8]] = {}
        self.picture = texture()

    def until(self, condition: Callable[[], Any], what: str) -> None:
        """Send a frame every 50 ms until the condition holds."""
        next_s = time.monotonic()

        def sending() -> Any:
            nonlocal next_s
            if time.monotonic() >= next_s:
                next_s = time.monotonic() + STREAM_PERIOD_S
                self.send()
            return condition()

        self.bench.peer.wait_for(sending, what)

    def send(self) -> int:
        """Send one frame; its stamp in s."""
        stamp_s = self.bench.sent + 1
        self.sent[stamp_s] = noisy(self.picture, stamp_s)
        self.bench.send(self.sent[stamp_s], stamp_s)
        return stamp_s

    def since(self, messages: list[Any], stamp_s: int) -> list[Any]:
        """What came of the frames after a stamp."""
        return [m for m in messages if m.header.stamp.sec > stamp_s]


def round_trip_s(bench: Bench, pictures: Sequence[NDArray[Any]]) -> float:
    """Time from sending a frame to receiving what comes of it, one at a time: median, seconds."""
    times = []
    for picture in pictures:
        start = time.monotonic()
        bench.exchange(picture)
        times.append(time.monotonic() - start)
    return float(np.median(times))


def shifted_texture(shift_px: int, seed: int = 0, size: int = SIZE) -> NDArray[np.uint8]:
    """A texture that is seen ``shift_px`` further right: what the stage or drift would do."""
    return np.roll(texture(seed, size), shift_px, axis=1)
