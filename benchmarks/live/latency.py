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

"""From the source to the callback of a consumer: in a chain of processes, and in the one process of the suite.

    python -m benchmarks.live.latency
    python -m benchmarks.live.latency --sizes 2048 --rounds 1 --seconds 10

The source is a source of the node microscope that has ready pictures in memory, and stamps each when it gives it away.
The consumer notes how old each frame is when it is called, and does nothing. Both modes take turns in one run. The
corrector's own time is what its diagnostics say of the suite, from the message at hand to the frame handed over: no
transport is in it.
"""

from __future__ import annotations

import argparse
import atexit
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.live.scenes import Config, calibration, pictures
from benchmarks.live.stream import DDS_VARIABLES, MAGNIFICATION, MALLOC, PROFILE, REPOSITORY
from benchmarks.table import show

FOLDER = "SEMCAL_LATENCY_FOLDER"
MODES = ("chain", "suite")
RATES = {512: 25.0, 2048: 25.0, 4096: 4.0}
WARM_UP_S = 5.0
# Of the end of a round, in which a frame may still be on its way.
REST_S = 1.0
START_S, STOP_S = 30.0, 20.0


@dataclass(frozen=True)
class Plan:
    size: int
    rate_hz: float


# -- in the processes -------------------------------------------------------------------------------


def folder() -> Path:
    return Path(os.environ[FOLDER])


def write_at_exit(name: str, values: list[Any]) -> None:
    atexit.register(lambda: (folder() / name).write_text(json.dumps(values), encoding="utf-8"))


class Ready:
    """Pictures that are in memory, at a fixed rate."""

    streams = True
    lossless = False

    def __init__(self, _config: Any) -> None:
        plan = Plan(**json.loads((folder() / "plan.json").read_text(encoding="utf-8")))
        self._pictures = pictures(plan.size)
        self._period_s = 1.0 / plan.rate_hz
        self._due_s = time.monotonic()
        self._sent: list[int] = []
        write_at_exit("sent.json", self._sent)

    def open(self) -> str:
        return "pictures in memory"

    def read(self, timeout_s: float) -> Any:
        from semcal_ros.drivers.source import SourceFrame

        now_s = time.monotonic()
        # A microscope that was held up does not send what it missed in a burst.
        self._due_s = max(self._due_s + self._period_s, now_s)
        time.sleep(self._due_s - now_s)
        picture = self._pictures[len(self._sent) % len(self._pictures)]
        self._sent.append(time.time_ns())
        width_m = 0.12 / MAGNIFICATION
        return SourceFrame(picture, self._sent[-1], field_width_m=width_m)

    def close(self) -> None:
        pass


class Noting:
    """A consumer that notes when it is called."""

    def __init__(self, _node: Any = None) -> None:
        self._seen: list[tuple[int, int]] = []
        write_at_exit("seen.json", self._seen)

    def __call__(self, frame: Any) -> None:
        self._seen.append((frame.stamp_ns, time.time_ns()))


def be(role: str, arguments: Sequence[str]) -> int:
    """One of the processes."""
    from semcal_ros.nodes.run_source import run_source, run_suite

    if role == "source":
        return run_source(Ready, arguments)
    if role == "suite":
        return run_suite(Ready, arguments)
    from rclpy.node import Node

    from semcal_ros.client import CalibratedStream
    from semcal_ros.nodes.common.run import run_node

    streams = []

    def make() -> Node:
        node = Node("noting", namespace="sem")
        streams.append(CalibratedStream(node, Noting(), config=str(folder() / "config.yaml")))
        return node

    return run_node(make, arguments)


# -- the measurement ---------------------------------------------------------------------------------


def started(work: Path, role: str, environment: dict[str, str], *given: str) -> Any:
    if role == "corrector":
        command = [sys.executable, "-m", "semcal_ros.nodes.stream_corrector"]
    else:
        command = [sys.executable, "-m", "benchmarks.live.latency", "--role", role]
    command += ["--ros-args", "-p", f"config:={work / 'config.yaml'}"]
    for parameter in given:
        command += ["-p", parameter]
    with open(work / f"{role}.log", "wb") as log:
        return subprocess.Popen(
            command, cwd=REPOSITORY, env=environment, stdout=log, stderr=subprocess.STDOUT
        )


def one_round(mode: str, plan: Plan, seconds: float) -> tuple[list[float], int, int, list[float]]:
    """Latencies, s; frames that were sent and lost; the corrector's own times, s."""
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        calibration().save(work / "cal.yaml")
        (work / "config.yaml").write_text(Config(0.8 / plan.rate_hz).text, encoding="utf-8")
        (work / "plan.json").write_text(json.dumps(vars(plan)), encoding="utf-8")
        about = work / "latency_consumer-1.0.dist-info"
        about.mkdir()
        (about / "METADATA").write_text("Name: latency_consumer\nVersion: 1.0\n", encoding="utf-8")
        entry = "[semcal_ros.consumers]\nnoting = benchmarks.live.latency:Noting\n"
        (about / "entry_points.txt").write_text(entry, encoding="utf-8")
        environment = {k: v for k, v in os.environ.items() if k not in (*DDS_VARIABLES, *MALLOC)}
        environment |= dict.fromkeys(DDS_VARIABLES, str(PROFILE)) | MALLOC
        environment |= {FOLDER: name, "OPENBLAS_NUM_THREADS": "1"}
        environment["PYTHONPATH"] = os.pathsep.join((name, str(REPOSITORY)))
        environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
        given = (f"calibration:={work / 'cal.yaml'}", "diagnostics_period:=0.2")
        if mode == "suite":
            made = [
                started(work, "suite", environment, *given, "viewer:=false", "consumers:=noting")
            ]
        else:
            made = [
                started(work, "sink", environment),
                started(work, "corrector", environment, *given),
                started(work, "source", environment),
            ]
        own_s = follow(seconds + WARM_UP_S)
        for process in reversed(made):
            process.send_signal(signal.SIGINT)
            process.wait(STOP_S)
        sent = json.loads((work / "sent.json").read_text(encoding="utf-8"))
        seen = dict(json.loads((work / "seen.json").read_text(encoding="utf-8")))
    end_ns = sent[-1] - round(1e9 * REST_S)
    counted = [stamp for stamp in sent if end_ns - round(1e9 * seconds) <= stamp < end_ns]
    got = [stamp for stamp in counted if stamp in seen]
    return [1e-9 * (seen[s] - s) for s in got], len(counted), len(counted) - len(got), own_s


def follow(seconds: float) -> list[float]:
    """Wait for the corrector, then for so long; return what it says that a frame takes, s."""
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node

    context = Context()
    rclpy.init(context=context)
    node = Node("latency_watch", context=context, namespace="sem")
    told: list[float] = []

    def keep(array: Any) -> None:
        for status in array.status:
            if status.name == "/sem/stream_corrector: stream":
                told.extend(
                    1e-3 * float(v.value) for v in status.values if v.key == "processing_ms"
                )

    node.create_subscription(DiagnosticArray, "/diagnostics", keep, 10)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    limit_s = time.monotonic() + START_S
    while not told:
        if time.monotonic() > limit_s:
            raise TimeoutError("the corrector gets no frames")
        executor.spin_once(timeout_sec=0.1)
    end_s = time.monotonic() + seconds + REST_S
    before = 0
    while time.monotonic() < end_s:
        executor.spin_once(timeout_sec=0.1)
        if end_s - time.monotonic() > seconds:
            before = len(told)
    executor.shutdown()
    node.destroy_node()
    rclpy.shutdown(context=context)
    return told[before:]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=list(RATES))
    parser.add_argument("--rate", type=float, help="Hz; by default as many as each size allows")
    parser.add_argument("--seconds", type=float, default=20.0, help="of each round")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--role", help=argparse.SUPPRESS)
    options, rest = parser.parse_known_args()
    if options.role:
        raise SystemExit(be(options.role, rest))
    rows: list[list[object]] = []
    for size in options.sizes:
        plan = Plan(size, options.rate or RATES.get(size, 10.0))
        found: dict[str, list[tuple[list[float], int, int, list[float]]]] = {m: [] for m in MODES}
        for _ in range(options.rounds):
            for mode in MODES:
                found[mode].append(one_round(mode, plan, options.seconds))
        own_s = statistics.median(s for part in found["suite"] for s in part[3])
        for mode in MODES:
            latency_s = np.array([s for part in found[mode] for s in part[0]])
            middle_s = float(np.median(latency_s))
            rows.append(
                [
                    f"{size} at {plan.rate_hz:g} Hz, {mode}",
                    1e3 * own_s,
                    1e3 * middle_s,
                    middle_s / own_s,
                    1e3 * float(np.percentile(latency_s, 99)),
                    sum(part[1] for part in found[mode]),
                    sum(part[2] for part in found[mode]),
                ]
            )
    show(
        "Latency from the source to the callback",
        ["frames", "own ms", "median ms", "over own", "99 % ms", "sent", "lost"],
        rows,
        f"{options.rounds} rounds of {options.seconds:g} s each, in turns",
    )


if __name__ == "__main__":
    main()
