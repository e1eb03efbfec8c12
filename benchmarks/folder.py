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

"""A folder that another process fills, through the node `microscope` to a subscriber: what is lost, and how late it is.

    python -m benchmarks.folder 500 5              500 pictures, 5 per second
    python -m benchmarks.folder 500 5 --kill 250   the node is killed (SIGKILL) and started again at the 250th
    python -m benchmarks.folder 500 5 --polled     as on a network share, where the system tells of no changes

The latency is the time from the end of the writing of a file to its image in a callback of another process.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import rclpy
import tifffile
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import Image

WRITER = """
import sys, time
from pathlib import Path
from benchmarks.folder import save
folder, count, rate, side = Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])
begun = time.time()
for number in range(count):
    time.sleep(max(0.0, begun + number / rate - time.time()))
    save(folder / f"{number:05d}.tif", number, side)
    print(number, time.time_ns(), flush=True)
"""
# What has not come so long after the last one is lost: a node that is started again needs some seconds, and more where
# others want the processor.
SILENT_S = 60.0
SETTINGS = (
    "[System]\r\nSystemType=Quanta\r\n[Beam]\r\nBeam=EBeam\r\n[EBeam]\r\nHV=5000\r\n[EScan]\r\n"
)


def save(path: Path, number: int, side: int) -> None:
    """A picture of noise with its number in the first two pixels, as a Thermo Fisher microscope saves it."""
    image = np.random.default_rng(number).integers(0, 255, (side, side)).astype(np.uint8)
    image[0, :2] = number & 255, number >> 8
    size = f"[Image]\r\nResolutionX={side}\r\nResolutionY={side}\r\n"
    text = f"{SETTINGS}PixelWidth=1e-9\r\nPixelHeight=1e-9\r\n{size}"
    with open(path, "wb") as stream:
        tifffile.imwrite(stream, image, extratags=[(34682, 2, 0, text.encode() + b"\0", True)])


def start(folder: Path, journal: Path, polled: bool) -> subprocess.Popen[bytes]:
    """The node, as a process of its own."""
    values = {"config": "generic", "source": "folder", "folder": folder, "journal": journal}
    given = [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]
    hide = "import sys; sys.modules['watchdog.events'] = None; " if polled else ""
    code = f"{hide}from semcal_ros.nodes.microscope import main; raise SystemExit(main())"
    return subprocess.Popen([sys.executable, "-c", code, "--ros-args", *given])


def main() -> None:
    """Print what came and when."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("count", type=int)
    parser.add_argument("rate", type=float)
    parser.add_argument("--side", type=int, default=1024)
    parser.add_argument("--kill", type=int, default=0)
    parser.add_argument("--polled", action="store_true")
    asked = parser.parse_args()
    received: list[tuple[int, int]] = []

    def on_image(message: Image) -> None:
        received.append((message.data[0] + 256 * message.data[1], time.time_ns()))

    rclpy.init()
    listener = rclpy.create_node("listener", namespace="sem")
    listener.create_subscription(Image, "image_raw", on_image, 100)
    executor = SingleThreadedExecutor()
    executor.add_node(listener)
    with tempfile.TemporaryDirectory() as scratch:
        folder, journal = Path(scratch) / "sem", Path(scratch) / "journal"
        folder.mkdir()
        node = start(folder, journal, asked.polled)
        while not journal.exists():
            time.sleep(0.1)
        command = [sys.executable, "-c", WRITER, str(folder), str(asked.count), str(asked.rate)]
        writer = subprocess.Popen([*command, str(asked.side)], stdout=subprocess.PIPE, text=True)
        seen, limit_s = 0, time.monotonic() + SILENT_S
        while len({n for n, _ in received}) < asked.count and time.monotonic() < limit_s:
            executor.spin_once(timeout_sec=0.1)
            if len(received) > seen:
                seen, limit_s = len(received), time.monotonic() + SILENT_S
            if asked.kill and len(received) >= asked.kill:
                os.kill(node.pid, signal.SIGKILL)
                node.wait()
                print(f"killed after {len(received)} images")
                asked.kill = 0
                node = start(folder, journal, asked.polled)
        quiet_s = time.monotonic() + 2.0
        while time.monotonic() < quiet_s:
            executor.spin_once(timeout_sec=0.1)
        node.send_signal(signal.SIGINT)
        node.wait()
        lines = writer.communicate()[0].splitlines()
    saved = {int(line.split()[0]): int(line.split()[1]) for line in lines}
    executor.shutdown()
    listener.destroy_node()
    rclpy.shutdown()
    times = Counter(number for number, _ in received)
    ms = np.array([(at - saved[number]) * 1e-6 for number, at in received])
    print(
        f"{asked.count} written, {len(times)} received, {len(received) - len(times)} more than once"
    )
    if missing := sorted(set(range(asked.count)) - set(times)):
        print(f"missing: {', '.join(map(str, missing))}")
    print(
        f"latency: median {np.median(ms):.0f} ms, 99 % {np.percentile(ms, 99):.0f}, longest {ms.max():.0f}"
    )


if __name__ == "__main__":
    main()
