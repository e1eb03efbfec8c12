"""The node stream_corrector over DDS beside a process that only relays the images.

Three processes: this one publishes images at a fixed rate, by turns to the relay and to the
corrector, and takes the time until each comes back; so both see the same machine at the same time.
The relay is the least that a Python node can do: it subscribes to images and publishes them again.
Each size runs in processes of its own, with and without the Fast DDS profile for large images.
"""

from __future__ import annotations

import argparse
import array
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from table import show

REPOSITORY = Path(__file__).resolve().parents[1]
PROFILE = REPOSITORY / "dds" / "fastdds_large_images.xml"
# As the comment in the profile recommends: large buffers are reused instead of faulted in anew.
MALLOC = {"MALLOC_MMAP_THRESHOLD_": "268435456", "MALLOC_TRIM_THRESHOLD_": "536870912"}
DDS_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")

# Frames per second of each of the two streams.
RATES = {512: 10.0, 1024: 10.0, 2048: 4.0, 4096: 1.5}
PATHS = ("relay", "corrector")
MAGNIFICATION = 5000.0
TIMEOUT_S = 20.0
WARM_UP = 2


# -- the relay -------------------------------------------------------------------------------------


def relay() -> None:
    """Publish again what arrives, with the same quality of service as the suite's nodes."""
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from rclpy.qos import QoSProfile
    from sensor_msgs.msg import Image

    rclpy.init()
    node = rclpy.create_node("relay", namespace="/relay")
    publisher = node.create_publisher(Image, "image_rect", QoSProfile(depth=2))
    node.create_subscription(Image, "image_raw", publisher.publish, QoSProfile(depth=1))
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


# -- one measurement -------------------------------------------------------------------------------


def calibration_text() -> str:
    """A calibration with a little of every distortion, for 512 x 512."""
    from semcal_ros import Calibration
    from semcal_ros.core.functions import ContinuousFunction

    limits = (500.0, 20000.0)
    values = {"scale": 1.01, "aspect": 1.004, "skew": 0.001, "px": 250.0, "py": 262.0, "rho": 50.0}
    values |= {"xi_r": 0.01, "xi_t": 0.001, "ex": 235.0, "ey": 268.0}
    functions = {
        name: ContinuousFunction("chebyshev_log", np.array([value]), limits)
        for name, value in values.items()
    }
    return Calibration(
        functions=functions,
        covariance=np.eye(len(values)) * 1e-8,
        image_width=512,
        image_height=512,
        display_width_m=0.12,
        magnifications=limits,
        method="joint",
    ).dumps()


def pictures(size: int, count: int = 16) -> list[np.ndarray]:
    """A random texture that drifts slowly on a circle, with noise.

    A fifth of a pixel of 512 per frame, so that every frame can be tracked.
    """
    rng = np.random.default_rng(0)
    wide = rng.standard_normal((size + 16, size + 16), dtype=np.float32)
    wide = cv2.GaussianBlur(wide, (0, 0), 2.5)
    wide *= 40.0 / wide.std()
    # One noise, rolled: drawing it anew is slow at 4096.
    noise = rng.standard_normal((size, size), dtype=np.float32) * 5.0
    radius = 0.5 * size / 512
    out = []
    for k in range(count):
        angle = 2.0 * np.pi * k / count
        x, y = radius * np.cos(angle) - 8.0, radius * np.sin(angle) - 8.0
        moved = cv2.warpAffine(
            wide, np.array([[1.0, 0.0, x], [0.0, 1.0, y]]), (size, size), flags=cv2.INTER_CUBIC
        )
        out.append(np.clip(128.0 + moved + np.roll(noise, 37 * k), 0, 255).astype(np.uint8))
    return out


def config_text(size: int) -> str:
    """A microscope that scans each frame in most of the time between two."""
    return (
        "name: benchmark\ndisplay_width_m: 0.12\n"
        "magnification: {quantity: magnification}\n"
        f"scan: {{frame_time_s: {0.8 / RATES[size]}}}\n"
    )


@contextmanager
def running(command: list[str], log: Path) -> Iterator[subprocess.Popen]:
    with open(log, "wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.wait(TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


class Measurement:
    """Publishes and times; the answers arrive in a thread of their own."""

    def __init__(self, size: int, frames: int) -> None:
        import rclpy
        from rclpy.qos import DurabilityPolicy, QoSProfile
        from sensor_msgs.msg import Image
        from std_msgs.msg import Float64

        self._rclpy = rclpy
        self._frames = frames
        self._period_s = 1.0 / RATES[size]
        rclpy.init()
        self._node = rclpy.create_node("benchmark")
        self._sent: dict[str, dict[int, float]] = {path: {} for path in PATHS}
        self._back: dict[str, dict[int, float]] = {path: {} for path in PATHS}
        self._publishers = {}
        for path in PATHS:
            self._publishers[path] = self._node.create_publisher(
                Image, f"/{path}/image_raw", QoSProfile(depth=2)
            )
            self._node.create_subscription(
                Image, f"/{path}/image_rect", self._receiver(path), QoSProfile(depth=2)
            )
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._magnification = self._node.create_publisher(
            Float64, "/corrector/magnification", latched
        )
        self._magnification.publish(Float64(data=MAGNIFICATION))
        self._messages = []
        for picture in pictures(size):
            message = Image(height=size, width=size, step=size, encoding="mono8")
            data = array.array("B")
            data.frombytes(picture.tobytes())
            message.data = data
            self._messages.append(message)
        self._thread = threading.Thread(target=rclpy.spin, args=(self._node,), daemon=True)
        self._thread.start()

    def _receiver(self, path: str) -> Callable[[object], None]:
        def receive(message) -> None:
            now = time.perf_counter()
            stamp = message.header.stamp
            self._back[path][stamp.sec * 10**9 + stamp.nanosec] = now

        return receive

    def _publish(self, path: str, index: int) -> None:
        message = self._messages[index % len(self._messages)]
        now_ns = time.time_ns()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(now_ns, 10**9)
        self._sent[path][now_ns] = time.perf_counter()
        self._publishers[path].publish(message)

    def _wait(self, condition: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + TIMEOUT_S
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"waited {TIMEOUT_S:g} s in vain for {what}")
            time.sleep(0.02)

    def _stream(self, count: int) -> None:
        """Frames by turns at the fixed rate."""
        start = time.monotonic()
        for turn in range(count * len(PATHS)):
            due = start + turn * self._period_s / len(PATHS)
            time.sleep(max(0.0, due - time.monotonic()))
            self._publish(PATHS[turn % len(PATHS)], turn // len(PATHS))

    def run(self) -> dict[str, dict[str, object]]:
        for path, publisher in self._publishers.items():
            self._wait(lambda p=publisher: p.get_subscription_count() == 1, f"the {path}")
            topic = f"/{path}/image_rect"
            self._wait(lambda t=topic: self._node.count_publishers(t) == 1, topic)
        self._wait(lambda: self._magnification.get_subscription_count() == 1, "its magnification")
        # Until both answer, whatever discovery takes.
        deadline = time.monotonic() + TIMEOUT_S
        while min(len(back) for back in self._back.values()) < WARM_UP:
            if time.monotonic() > deadline:
                break
            self._stream(2 * WARM_UP)
        time.sleep(0.5)
        for path in PATHS:
            self._sent[path].clear()
            self._back[path].clear()
        self._stream(self._frames)
        deadline = time.monotonic() + max(3.0, 12.0 * self._period_s)
        while time.monotonic() < deadline and any(
            len(self._back[p]) < len(self._sent[p]) for p in PATHS
        ):
            time.sleep(0.05)
        result: dict[str, dict[str, object]] = {}
        for path in PATHS:
            sent, back = self._sent[path], dict(self._back[path])
            taken = [back[stamp] - sent[stamp] for stamp in back if stamp in sent]
            median, late = np.percentile(taken, [50, 95]).tolist() if taken else (None, None)
            result[path] = {"in": len(sent), "out": len(taken), "median": median, "late": late}
        return result

    def close(self) -> None:
        self._rclpy.try_shutdown()
        self._thread.join(TIMEOUT_S)


def measure(size: int, frames: int) -> None:
    """Start the processes, measure, print the result as one line of JSON."""
    with tempfile.TemporaryDirectory() as folder:
        calibration = Path(folder) / "calibration.yaml"
        calibration.write_text(calibration_text(), encoding="utf-8")
        corrector = [sys.executable, "-m", "semcal_ros.nodes.stream_corrector", "--ros-args"]
        corrector += ["-r", "__ns:=/corrector", "-p", f"calibration:={calibration}"]
        config = Path(folder) / "benchmark.yaml"
        config.write_text(config_text(size), encoding="utf-8")
        corrector += ["-p", f"config:={config}"]
        relaying = [sys.executable, __file__, "--relay"]
        log = Path(folder) / "corrector.log"
        with running(relaying, Path(folder) / "relay.log"), running(corrector, log):
            measurement = Measurement(size, frames)
            try:
                result = measurement.run()
            finally:
                measurement.close()
    print(json.dumps(result), flush=True)


# -- all of them -----------------------------------------------------------------------------------


def measured(size: int, frames: int, extra: dict[str, str]) -> dict[str, dict[str, object]] | None:
    """Result of one measurement in an environment of its own."""
    environment = {k: v for k, v in os.environ.items() if k not in (*DDS_VARIABLES, *MALLOC)}
    # A domain of its own on this host alone: nobody else's nodes are heard or disturbed.
    environment["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 100)
    environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    command = [sys.executable, __file__, "--measure", str(size), str(frames)]
    done = subprocess.run(
        command, env=environment | extra, stdout=subprocess.PIPE, text=True, check=False
    )
    lines = [line for line in done.stdout.splitlines() if line.startswith("{")]
    return json.loads(lines[-1]) if lines else None


def ratio(value: float | None, unit: float | None) -> float | None:
    return value / unit if value and unit else None


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="less of everything")
    parser.add_argument("--relay", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--measure", nargs=2, type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    try:
        import rclpy  # noqa: F401
    except ImportError:
        print("\nLive nodes over DDS: rclpy is not installed")
        return
    if options.relay:
        return relay()
    if options.measure:
        return measure(*options.measure)
    profile = dict.fromkeys(DDS_VARIABLES, str(PROFILE))
    variants = {"default": {}, "profile, malloc": profile | MALLOC}
    rows: list[list[object]] = []
    for size in (512, 1024, 2048) if options.quick else RATES:
        frames = round(RATES[size] * (3 if options.quick else 8))
        unit: float | None = None
        for name, extra in variants.items():
            result = measured(size, frames, extra)
            if result is None:
                rows.append([f"{size}  {name}  failed", *[None] * 8])
                continue
            for path in PATHS:
                one, base = result[path], result["relay"]
                unit = unit or base["median"]
                row: list[object] = [f"{size}  {name}  {path}", RATES[size]]
                row += [one["in"], one["out"], one["in"] - one["out"]]
                row += [ratio(one["median"], base["median"]), ratio(one["late"], base["median"])]
                row += [ratio(one["late"], base["late"]), ratio(one["median"], unit)]
                rows.append(row)
    show(
        "Live: image_raw to image_rect over DDS (mono8), by turns through a relay and stream_corrector",
        ["size  transport  path", "Hz", "in", "out", "lost", "median", "95 %", "95 %/95 %"]
        + ["median/default"],
        rows,
        "median, 95 %: latency as ratio to the relay's median in the same run; 95 %/95 %: to its 95 %.",
        "median/default: to the relay's median at this size over the default transport, in another run.",
        "Published reliable, depth 2; subscribed keep-last 1: of several waiting frames the newest wins.",
    )


if __name__ == "__main__":
    main()
