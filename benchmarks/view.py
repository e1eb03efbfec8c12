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

"""What an open page of ``semcal view`` costs the stream: latency without the viewer, with it, and with a page open.

A publisher sends frames to ``stream_corrector``, and waits for what comes of each: the time in between is the latency.
Rounds without the viewer, with the viewer and no page, and with a page that takes pictures as fast as they come (a
process that answers as the browser does, and draws nothing) follow each other, so that other work on the machine is in
all of them. Needs the nodes installed, as `make setup` does.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
import rclpy
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import Image
from std_msgs.msg import Float64

from benchmarks.live.scenes import calibration, pictures
from benchmarks.table import quick_from_command_line, show
from examples.live_nodes import LiveNodes

REPOSITORY = Path(__file__).resolve().parents[1]
MAGNIFICATION = 5000.0
SIZE, RATE_HZ = 512, 20.0
TIMEOUT_S = 30.0

PAGE = """
import asyncio, json, sys
from tornado.websocket import websocket_connect

async def run():
    page = await websocket_connect(sys.argv[1].replace("http", "ws", 1) + "live")
    print("open", flush=True)
    while (told := await page.read_message()) is not None:
        if isinstance(told, bytes):
            await page.write_message(json.dumps({"type": "seen"}))

asyncio.run(run())
"""


class Loop:
    """Sends frames and takes the corrected ones."""

    def __init__(self) -> None:
        rclpy.init()
        self.node = rclpy.create_node("benchmark", namespace="/sem")
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.magnification = self.node.create_publisher(Float64, "magnification", latched)
        self.images = self.node.create_publisher(Image, "image_raw", 8)
        self.node.create_subscription(Image, "image_rect", self._take, 8)
        self.magnification.publish(Float64(data=MAGNIFICATION))
        self._came: dict[int, float] = {}
        self._sent = 0
        self._pictures = [np.ascontiguousarray(p) for p in pictures(SIZE)]

    def _take(self, message: Image) -> None:
        self._came[message.header.stamp.nanosec] = time.monotonic()

    def latency_ms(self, frames: int) -> list[float]:
        """Send frames at the rate; the latency of each that came back."""
        found, next_s = [], time.monotonic()
        for _ in range(frames):
            while time.monotonic() < next_s:
                rclpy.spin_once(self.node, timeout_sec=max(0.0, next_s - time.monotonic()))
            next_s = max(next_s + 1.0 / RATE_HZ, time.monotonic())
            self._sent += 1
            message = Image(height=SIZE, width=SIZE, encoding="mono8", step=SIZE)
            message.header.frame_id = "sem_optical"
            message.header.stamp.sec = int(time.time())
            message.header.stamp.nanosec = self._sent
            message.data = self._pictures[self._sent % len(self._pictures)].tobytes()
            started_s = time.monotonic()
            self.images.publish(message)
            while self._sent not in self._came and time.monotonic() - started_s < 1.0:
                rclpy.spin_once(self.node, timeout_sec=0.01)
            if self._sent in self._came:
                found.append(1e3 * (self._came[self._sent] - started_s))
        return found


@contextmanager
def viewer() -> Iterator[str]:
    """``semcal view``; its address."""
    command = [sys.executable, "-u", "-m", "semcal_ros", "view", "--port", "0"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=REPOSITORY
    ) as process:
        assert process.stdout is not None
        found = None
        while found is None:
            found = re.search(r"open (http://\S+/)", process.stdout.readline())
        yield found[1]
        process.terminate()


@contextmanager
def page(address: str) -> Iterator[None]:
    """A page that takes all pictures."""
    with subprocess.Popen(
        [sys.executable, "-u", "-c", PAGE, address], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None and process.stdout.readline()
        yield
        process.terminate()


def main() -> None:
    """Print the table."""
    quick = quick_from_command_line(__doc__)
    rounds, frames = (2, 60) if quick else (6, 300)
    latencies: dict[str, list[float]] = {"no viewer": [], "viewer, no page": [], "a page": []}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "cal.yaml"
        calibration().save(file)
        nodes = LiveNodes(Path(folder) / "logs")
        try:
            nodes.start("stream_corrector", {"calibration": file})
            loop = Loop()
            deadline_s = time.monotonic() + TIMEOUT_S
            while not loop.latency_ms(1):
                assert time.monotonic() < deadline_s
            loop.latency_ms(60)
            for _ in range(rounds):
                for name, found in latencies.items():
                    with ExitStack() as stack:
                        if name != "no viewer":
                            address = stack.enter_context(viewer())
                            if name == "a page":
                                stack.enter_context(page(address))
                            loop.latency_ms(20)
                        found += loop.latency_ms(frames)
        finally:
            nodes.end()
            rclpy.try_shutdown()
    base = float(np.median(latencies["no viewer"]))
    rows: list[list[object]] = [
        [name, len(found), float(np.median(found)) / base, float(np.percentile(found, 95)) / base]
        for name, found in latencies.items()
    ]
    show(
        f"latency of image_rect, {SIZE} x {SIZE} at {RATE_HZ:g} Hz, over the median without the viewer ({base:.1f} ms)",
        ["", "frames", "median", "95 %"],
        rows,
    )


if __name__ == "__main__":
    main()
