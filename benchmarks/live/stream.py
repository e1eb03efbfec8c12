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

"""A stream through stream_corrector over DDS: publisher, node and subscriber in processes of their own.

    python -m benchmarks.live.stream 512 200 --seconds 600
    python -m benchmarks.live.stream 4096 10 --seconds 600

Latency is from the moment before a frame is published to the moment at which its corrected image is
in the hands of a Python subscriber. A frame counts as lost on the way where its number in the
sequence is missing; the node's own counters tell where. With --relay the node is replaced by the
least that a Python node can do: cv2.remap with maps at hand, written into the outgoing message.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.live.scenes import Config, calibration, pictures

REPOSITORY = Path(__file__).resolve().parents[2]
PROFILE = REPOSITORY / "dds" / "fastdds_large_images.xml"
DDS_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
# As the comment in the profile recommends: large buffers are reused instead of faulted in anew.
MALLOC = {"MALLOC_MMAP_THRESHOLD_": "268435456", "MALLOC_TRIM_THRESHOLD_": "536870912"}
MAGNIFICATION = 5000.0
WARM_UP_S = 4.0
TIMEOUT_S = 30.0
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
PAGE = os.sysconf("SC_PAGE_SIZE")


@dataclass(frozen=True)
class Plan:
    """One measurement."""

    size: int
    rate_hz: float
    seconds: float
    depth: int = 8
    relay: bool = False
    profile: bool = True
    tracking: str = "auto"
    #: Of the image that the subscriber takes: as it is, or with ``compressed``.
    compressed: bool = False
    #: How far the clock of the publisher is ahead, s.
    clock_ahead_s: float = 0.0
    #: Whether the corrector takes every image, however late, instead of skipping those that waited too long.
    every_image: bool = False


# -- the processes ---------------------------------------------------------------------------------


def quality(depth: int) -> Any:
    from rclpy.qos import QoSProfile

    return QoSProfile(depth=depth)


def publish(plan: Plan) -> None:
    """Frames at the fixed rate, numbered by their order; prints how many."""
    import array

    import rclpy
    from rclpy.qos import DurabilityPolicy, QoSProfile
    from sensor_msgs.msg import Image
    from std_msgs.msg import Float64

    rclpy.init()
    node = rclpy.create_node("source", namespace="/sem")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    knob = node.create_publisher(Float64, "magnification", latched)
    knob.publish(Float64(data=MAGNIFICATION))
    publisher = node.create_publisher(Image, "image_raw", quality(10))
    messages = []
    for picture in pictures(plan.size, plan.depth):
        step = plan.size * picture.itemsize
        message = Image(height=plan.size, width=plan.size, step=step)
        message.encoding = f"mono{plan.depth}"
        message.data = array.array("B", picture.tobytes())
        messages.append(message)
    deadline = time.monotonic() + TIMEOUT_S
    while publisher.get_subscription_count() < 1:
        if time.monotonic() > deadline:
            raise TimeoutError("nobody subscribes to image_raw")
        time.sleep(0.02)
    start, late_s = time.monotonic() + 1.0, []
    count = round((plan.seconds + WARM_UP_S) * plan.rate_hz)
    for k in range(count):
        due = start + k / plan.rate_hz
        time.sleep(max(0.0, due - time.monotonic()))
        late_s.append(time.monotonic() - due)
        # A microscope that was held up does not send what it missed in a burst.
        start += max(0.0, late_s[-1] - 1.0 / plan.rate_hz)
        message = messages[k % len(messages)]
        stamp_ns = time.time_ns() + round(1e9 * plan.clock_ahead_s)
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
        message.header.frame_id = str(k)
        publisher.publish(message)
    print(
        json.dumps(
            {
                "sent": count,
                "late_ms": 1e3 * float(np.percentile(late_s, 99)),
                "latest_ms": 1e3 * max(late_s),
            }
        )
    )
    time.sleep(2.0)
    rclpy.shutdown()


def subscribe(plan: Plan) -> None:
    """Takes image_rect until a signal; prints number and latency of all frames."""
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from sensor_msgs.msg import CompressedImage, Image

    rclpy.init()
    node = rclpy.create_node("sink", namespace="/sem")
    seen: list[tuple[int, float]] = []

    def receive(message: Any) -> None:
        stamp = message.header.stamp
        late_s = 1e-9 * (time.time_ns() - stamp.sec * 10**9 - stamp.nanosec)
        seen.append((int(message.header.frame_id), late_s + plan.clock_ahead_s))

    if plan.compressed:
        node.create_subscription(CompressedImage, "image_rect/compressed", receive, quality(10))
    else:
        node.create_subscription(Image, "image_rect", receive, quality(10))
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    print(json.dumps(seen))


def relay(plan: Plan) -> None:
    """The least that a node in Python must do."""
    import cv2
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from sensor_msgs.msg import Image

    from semcal_ros.bridge.images import image_from_message, pixel_memory
    from semcal_ros.core.rectification.rectifier import Rectifier

    rclpy.init()
    node = rclpy.create_node("relay", namespace="/sem")
    publisher = node.create_publisher(Image, "image_rect", quality(2))
    camera = calibration().at(MAGNIFICATION).resized(plan.size, plan.size)
    map_x, map_y = Rectifier().maps((plan.size, plan.size), camera)
    out = Image()

    def pass_on(message: Any) -> None:
        image = image_from_message(message)
        memory = pixel_memory(out, image, message.encoding, message.header)
        cv2.remap(image, map_x, map_y, cv2.INTER_LINEAR, dst=memory)
        publisher.publish(out)

    node.create_subscription(Image, "image_raw", pass_on, quality(8))
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)


# -- the measurement -------------------------------------------------------------------------------


class Watch:
    """Memory and processor time of a process, and its diagnostics."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self.memory_mb: list[float] = []
        self._start: tuple[float, float] | None = None
        self.cores = 0.0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(1.0):
            try:
                words = Path(f"/proc/{self._pid}/stat").read_text().rsplit(")", 1)[1].split()
            except OSError:
                return
            self.memory_mb.append(int(words[21]) * PAGE / 2**20)
            now = time.monotonic(), (int(words[11]) + int(words[12])) / TICKS_PER_S
            if self._start is None and len(self.memory_mb) > WARM_UP_S:
                self._start = now
            if self._start is not None and now[0] > self._start[0]:
                self.cores = (now[1] - self._start[1]) / (now[0] - self._start[0])

    def close(self) -> None:
        self._stop.set()
        self._thread.join()


@contextmanager
def process(
    role: str,
    plan: Plan,
    folder: Path,
    environment: dict[str, str],
    place: Callable[[str, list[str]], list[str]] = lambda _role, command: command,
) -> Iterator[Any]:
    """A process of a role, which ``place`` may put on a machine of its own."""
    output = folder / f"{role}.out"
    if role == "node" and not plan.relay:
        command = [sys.executable, "-m", "semcal_ros.nodes.stream_corrector", "--ros-args"]
        given = {"calibration": folder / "cal.yaml", "config": folder / "config.yaml"}
        given |= {"drift_tracking": plan.tracking}
        if plan.every_image:
            given["qos_overrides./sem/image_raw.subscription.depth"] = 50
        for key, value in given.items():
            command += ["-p", f"{key}:={value}"]
    else:
        command = [sys.executable, "-m", "benchmarks.live.stream"]
        command += ["--role", role, json.dumps(asdict(plan))]
    with open(output, "wb") as stream, open(folder / f"{role}.err", "wb") as errors:
        made = subprocess.Popen(
            place(role, command), cwd=REPOSITORY, stdout=stream, stderr=errors, env=environment
        )
    try:
        yield made
    finally:
        made.send_signal(signal.SIGINT)
        try:
            made.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            made.kill()
            made.wait()


def watch(plan: Plan) -> None:
    """Prints what the corrector said of itself, in the end."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.executors import ExternalShutdownException

    found: dict[str, str] = {}
    rclpy.init()
    node = rclpy.create_node("watch", namespace="/sem")

    def keep(array: Any) -> None:
        for status in array.status:
            if status.name.startswith("/sem/stream_corrector:"):
                found.update({value.key: value.value for value in status.values})

    node.create_subscription(DiagnosticArray, "/diagnostics", keep, 10)
    with suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    print(json.dumps(found))


def measured(plan: Plan) -> dict[str, Any]:
    """Run the processes and gather what they say."""
    environment = {k: v for k, v in os.environ.items() if k not in (*DDS_VARIABLES, *MALLOC)}
    # A domain of its own on this host alone: nobody else's nodes are heard or disturbed.
    environment["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    if plan.profile:
        environment |= dict.fromkeys(DDS_VARIABLES, str(PROFILE)) | MALLOC
    return run_processes(plan, environment)


def run_processes(
    plan: Plan,
    environment: dict[str, str],
    place: Callable[[str, list[str]], list[str]] = lambda _role, command: command,
    meanwhile: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Run the processes, ``place`` telling where each runs, and gather what they say."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        calibration().save(folder / "cal.yaml")
        text = Config(0.8 / plan.rate_hz).text
        (folder / "config.yaml").write_text(text, encoding="utf-8")
        with (
            process("watch", plan, folder, environment, place),
            process("sink", plan, folder, environment, place),
            process("node", plan, folder, environment, place) as node,
        ):
            watched = Watch(node.pid)
            with process("source", plan, folder, environment, place) as source:
                meanwhile()
                try:
                    source.wait(plan.seconds + WARM_UP_S + 2 * TIMEOUT_S)
                except subprocess.TimeoutExpired as error:
                    raise OSError("the publisher is held up") from error
            watched.close()
            time.sleep(1.5)
        said, sent, seen = (
            json.loads((folder / f"{role}.out").read_text() or "[]")
            for role in ("watch", "source", "sink")
        )
        if not sent:
            raise OSError((folder / "source.err").read_text().strip().splitlines()[-1])
    return result(plan, sent, seen, watched, dict(said))


def result(
    plan: Plan, sent: dict[str, Any], seen: list[list[float]], watch: Watch, said: dict[str, str]
) -> dict[str, Any]:
    """What came out, without the first seconds."""
    first = round(WARM_UP_S * plan.rate_hz)
    kept = [(int(k), s) for k, s in seen if k >= first]
    numbers, latency_ms = [k for k, _ in kept], 1e3 * np.array([s for _, s in kept])
    memory = watch.memory_mb[int(WARM_UP_S) :]
    half = len(memory) // 2
    got = len(set(numbers))
    return {
        **asdict(plan),
        "sent": sent["sent"],
        "in": sent["sent"] - first,
        "out": got,
        "last": max(numbers, default=None),
        "lost": sent["sent"] - first - got,
        "late_source_ms": sent["late_ms"],
        "latest_source_ms": sent["latest_ms"],
        "median_ms": float(np.median(latency_ms)) if got else None,
        "p99_ms": float(np.percentile(latency_ms, 99)) if got else None,
        "max_ms": float(latency_ms.max()) if got else None,
        "cores": watch.cores,
        "memory_mb": memory[-1] if memory else None,
        "growth_mb": max(memory[half:]) - max(memory[: half or 1]) if half else None,
        "node": {k: said[k] for k in NOTED if k in said},
    }


NOTED = (
    "received",
    "published",
    "dropped",
    "rejected",
    "processing_ms",
    "drift_ms",
    "drift_frames_forecast",
    "drift_frames_coasted",
)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("size", nargs="?", type=int)
    parser.add_argument("rate", nargs="?", type=float, help="Hz")
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--depth", type=int, choices=(8, 16), default=8)
    parser.add_argument("--relay", action="store_true", help="the least node in place of ours")
    parser.add_argument("--default-transport", action="store_true", help="without the DDS profile")
    parser.add_argument("--tracking", default="auto", help="parameter drift_tracking")
    parser.add_argument("--role", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.role:
        roles = {"source": publish, "sink": subscribe, "node": relay, "watch": watch}
        roles[options.role[0]](Plan(**json.loads(options.role[1])))
        return
    if not options.size or not options.rate:
        parser.error("size and rate are needed")
    plan = Plan(
        options.size,
        options.rate,
        options.seconds,
        options.depth,
        options.relay,
        not options.default_transport,
        options.tracking,
    )
    print(json.dumps(measured(plan), indent=1))


if __name__ == "__main__":
    main()
