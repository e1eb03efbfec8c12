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

"""A stream over three machines: the microscope's, the one of the nodes, and a viewer's.

    python -m benchmarks.network            # some twenty minutes, as root
    python -m benchmarks.network --quick    # four rows

The machines are network namespaces (:mod:`benchmarks.network.namespaces`), joined by a switch; the processors do the
work of all three. So that what is missing in the end is what the network lost, the node has a queue from which it takes
every image, however late: by default it skips late ones, and a busy processor would pass for a bad network. *driver
late* is how late the driver itself was with its frames, and that is the processors' as well.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.live.stream import MALLOC, PROFILE, WARM_UP_S, Plan, run_processes
from benchmarks.network.namespaces import Network, why_not
from benchmarks.table import show

MICROSCOPE, NODES, VIEWER = "microscope", "nodes", "viewer"
PLACES = {"source": MICROSCOPE, "node": NODES, "watch": NODES, "sink": VIEWER}
# Frames of a size, and their rate, Hz.
STREAMS = ((512, 30.0), (1024, 10.0), (2048, 5.0), (4096, 2.0))
PORT = 11811
# The defaults, 4 MB and 30 s, are full after some 40 datagrams of 64 kB that have lost a packet; then none is accepted.
REASSEMBLY = ("net.ipv4.ipfrag_high_thresh=134217728", "net.ipv4.ipfrag_time=3")
VARIABLES = (
    "FASTRTPS_DEFAULT_PROFILES_FILE",
    "FASTDDS_DEFAULT_PROFILES_FILE",
    "FASTDDS_BUILTIN_TRANSPORTS",
    "ROS_STATIC_PEERS",
    "ROS_DISCOVERY_SERVER",
    "ROS_AUTOMATIC_DISCOVERY_RANGE",
)


def profile(name: str) -> dict[str, str]:
    """The variables that select how Fast DDS sends."""
    if name == "none":
        return {}
    path = PROFILE.with_name(f"fastdds_{name}.xml")
    return dict.fromkeys(VARIABLES[:2], str(path))


@dataclass(frozen=True)
class Case:
    """One row."""

    size: int
    rate_hz: float
    mbit_per_s: float = 1000.0
    profile: str = "large_images"
    discovery: str = "multicast"
    compressed: bool = False
    clock_ahead_s: float = 0.0
    #: For so long the viewer's cable is pulled out.
    unplugged_s: float = 0.0
    #: Somebody else's suite runs in the same domain, in a namespace of its own.
    stranger: bool = False
    #: Fraction of the packets that the viewer's cable loses.
    loss: float = 0.0
    #: Room in the kernel for images of which a packet was lost (doc/network.md).
    reassembly: bool = False
    #: All on one machine: what the processors alone cost.
    one_machine: bool = False


def cases(quick: bool) -> list[Case]:
    if quick:
        return [
            Case(512, 30.0),
            Case(1024, 10.0, 100.0, compressed=True),
            Case(512, 30.0, discovery="static peers"),
            Case(512, 30.0, discovery="discovery server"),
        ]
    streams = [
        Case(size, rate, mbit, how)
        for mbit, fitting in ((1000.0, STREAMS), (100.0, STREAMS[:2]))
        for size, rate in fitting
        for how in ("large_images", "network", "none")
    ]
    # More than the cable carries, and what helps.
    compressed = [
        Case(2048, 5.0, 100.0),
        Case(2048, 5.0, 100.0, "network"),
        Case(1024, 10.0, 100.0, compressed=True),
        Case(2048, 2.0, 100.0, "network", compressed=True),
    ]
    others = [
        Case(512, 30.0, discovery="static peers"),
        Case(512, 30.0, discovery="discovery server"),
        Case(512, 30.0, unplugged_s=5.0),
        Case(512, 30.0, profile="network", unplugged_s=5.0),
        Case(512, 30.0, clock_ahead_s=3.0),
        Case(512, 30.0, clock_ahead_s=-3.0),
        Case(512, 30.0, stranger=True),
        Case(512, 30.0, one_machine=True),
    ]
    lossy = [
        Case(512, 30.0, profile=how, loss=loss)
        for loss in (0.01, 0.05)
        for how in ("large_images", "network")
    ]
    lossy += [Case(512, 30.0, loss=loss, reassembly=True) for loss in (0.01, 0.05)]
    return streams + compressed + others + lossy


@contextmanager
def discovery(case: Case, network: Network, environment: dict[str, str]) -> Iterator[None]:
    """Let the machines find each other, by the variables in ``environment``."""
    if case.discovery == "static peers":
        environment["ROS_STATIC_PEERS"] = ";".join(map(network.address, set(PLACES.values())))
    if case.discovery != "discovery server":
        yield
        return
    address = network.address(NODES)
    environment["ROS_DISCOVERY_SERVER"] = f"{address}:{PORT}"
    command = [*find_server(), "-i", "0", "-l", address, "-p", str(PORT)]
    with subprocess.Popen(
        network.command(NODES, command), stdout=subprocess.DEVNULL, env=with_libraries()
    ) as server:
        time.sleep(1.0)
        try:
            yield
        finally:
            server.kill()


def find_server() -> list[str]:
    """Fast DDS' discovery server."""
    name = "fast-discovery-server"
    places = [Path(sys.prefix) / "bin", *map(Path, os.environ.get("PATH", "").split(os.pathsep))]
    found = [place / name for place in places if (place / name).exists()]
    if not found:
        raise SystemExit(f"{name} is not installed")
    return [str(found[0])]


def with_libraries() -> dict[str, str]:
    """An environment in which the server of the wheels finds its libraries."""
    library = Path(sys.prefix) / "lib"
    folders = [library, *library.glob("python*/site-packages/ros_fastrtps.libs")]
    return {**os.environ, "LD_LIBRARY_PATH": os.pathsep.join(map(str, folders))}


def measured(case: Case, seconds: float) -> dict[str, Any]:
    environment = {k: v for k, v in os.environ.items() if k not in VARIABLES}
    environment |= {**MALLOC, **profile(case.profile), "ROS_DOMAIN_ID": "0"}
    environment["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SUBNET"
    plan = Plan(
        case.size,
        case.rate_hz,
        seconds,
        compressed=case.compressed,
        clock_ahead_s=case.clock_ahead_s,
        every_image=True,
    )
    places = dict.fromkeys(PLACES, NODES) if case.one_machine else PLACES
    machines = list(dict.fromkeys(PLACES.values()))
    by_multicast = case.discovery == "multicast"
    with ExitStack() as stack:
        network = stack.enter_context(
            Network(
                machines,
                mbit_per_s=case.mbit_per_s,
                multicast=by_multicast,
                loss={VIEWER: case.loss} if case.loss else None,
            )
        )
        if case.reassembly:
            subprocess.run(network.command(VIEWER, ["sysctl", "-qw", *REASSEMBLY]), check=True)
        stack.enter_context(discovery(case, network, environment))
        if case.stranger:
            stack.enter_context(stranger(network, environment))

        def meanwhile() -> None:
            if case.unplugged_s:
                given = network, case.unplugged_s, seconds
                threading.Thread(target=unplug, args=given, daemon=True).start()

        return run_processes(
            plan,
            environment,
            lambda role, command: network.command(places[role], command),
            meanwhile,
        )


def unplug(network: Network, unplugged_s: float, seconds: float) -> None:
    """Pull the viewer's cable out in the middle of the stream."""
    time.sleep(WARM_UP_S + 0.4 * seconds)
    network.plug(VIEWER, connected=False)
    time.sleep(unplugged_s)
    network.plug(VIEWER, connected=True)


@contextmanager
def stranger(network: Network, environment: dict[str, str]) -> Iterator[None]:
    """Another microscope and its suite on the viewer's machine, in the same domain."""
    names = ("virtual_sem", "stream_corrector")
    commands = [
        [sys.executable, "-m", f"semcal_ros.nodes.{name}", "--ros-args", "-r", "__ns:=/other"]
        for name in names
    ]
    running = [
        subprocess.Popen(
            network.command(VIEWER, command),
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for command in commands
    ]
    try:
        yield
    finally:
        for process in running:
            process.kill()
            process.wait()


def row(case: Case, found: dict[str, Any] | str) -> list[object]:
    described = [
        f"{case.size} at {case.rate_hz:g} Hz",
        round(8e-6 * case.size**2 * case.rate_hz),
        round(case.mbit_per_s),
        "compressed" if case.compressed else "raw",
        case.profile,
        case.discovery,
        ", ".join(
            word
            for word, wanted in (
                (f"cable out {case.unplugged_s:g} s", case.unplugged_s),
                (f"clock {case.clock_ahead_s:+g} s", case.clock_ahead_s),
                ("stranger", case.stranger),
                (f"{case.loss:.0%} lost", case.loss),
                ("room to reassemble", case.reassembly),
                ("one machine", case.one_machine),
            )
            if wanted
        )
        or "-",
    ]
    if isinstance(found, str):
        return [*described, found]
    return [
        *described,
        found["in"],
        # Those of the first seconds, too, which are not counted.
        f"{found['node'].get('received', '-')} of {found['sent']}",
        found["out"],
        found["median_ms"],
        found["p99_ms"],
        found["late_source_ms"],
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="less of everything")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each stream")
    parser.add_argument("--only", help="rows whose JSON contains this")
    parser.add_argument("--repeat", type=int, default=1, help="times that all of it is done")
    options = parser.parse_args()
    reason = why_not()
    if reason:
        raise SystemExit(f"no network namespaces here: {reason}")
    rows = []
    header = [
        "stream", "Mbit/s", "cable", "viewer", "profile", "discovery", "",
        "sent", "at the node", "at the viewer", "median ms", "99 % ms", "driver late, 99 % ms",
    ]  # fmt: skip
    for case in cases(options.quick) * options.repeat:
        if options.only and options.only not in json.dumps(case.__dict__):
            continue
        try:
            found: dict[str, Any] | str = measured(case, options.seconds)
        except OSError as error:
            found = str(error)
        rows.append(row(case, found))
        print(*rows[-1], flush=True)
    show("A stream over three machines", header, [r + [""] * (len(header) - len(r)) for r in rows])


if __name__ == "__main__":
    main()
