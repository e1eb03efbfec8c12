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

"""The machine, Python, and how ROS 2 is set up here: what is collected of them, and its checks; works without ROS."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from importlib import import_module, metadata
from pathlib import Path

from packaging.requirements import InvalidRequirement, Requirement
from packaging.utils import canonicalize_name
from packaging.version import InvalidVersion

from semcal_ros.core.errors import ConfigError
from semcal_ros.doctor.findings import CheckResult, note, ok, problem
from semcal_ros.doctor.observations import Environment
from semcal_ros.middleware import (
    SharedMemory,
    local_only,
    prefixes_of_user,
    profile_file,
    shared_memory,
)

_PYTHON = ((3, 10), (3, 14))  # as in the Makefile
_GET_ROS = (
    "run `make setup` and use .venv/bin/semcal, or install the wheels that requirements/ names, or source the"
    " setup script of a ROS 2 installation"
)
_DOMAINS = 232  # the ports of a higher id would exceed 65535
# Ids above would use ports that Linux hands out to other programs
# (https://docs.ros.org/en/jazzy/Concepts/Intermediate/About-Domain-ID.html).
_SAFE_DOMAINS = 101
_RANGES = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")
# What the shipped profile asks of a socket: one frame of 4096 x 4096 with 16 bits.
_SOCKET_BYTES = 32 * 1024**2
_MB = 1024**2  # bytes per MiB
_MESSAGES = ("sensor_msgs.msg", "std_srvs.srv", "diagnostic_msgs.msg")
_PREFIXES = "AMENT_PREFIX_PATH"
# Importing rclpy loads the middleware, which may end the process at once: a separate process does it.
_PROBE = (
    f"import os, rclpy; print(os.environ.get('{_PREFIXES}', '')); print(rclpy.__file__); "
    "print(rclpy.get_rmw_implementation_identifier())"
)
_PROBE_S = 60.0  # importing rclpy takes about a second; this only ends a process that hangs
_LONGEST = 200  # characters of a reason, which must fit on one line
_RECEIVE_BUFFER = Path("/proc/sys/net/core/rmem_max")
_SHM = Path("/dev/shm")
_INSTALLATIONS = Path("/opt/ros")


def check_python(seen: Environment) -> list[CheckResult]:
    """Check whether this version of Python is supported."""
    version = ".".join(map(str, seen.python))
    if _PYTHON[0] <= seen.python <= _PYTHON[1]:
        return [ok("Python", version)]
    return [
        problem("Python", version, expected="3.10 to 3.14", do="run `make setup PYTHON=python3.12`")
    ]


def check_packages(seen: Environment) -> list[CheckResult]:
    """Check whether the requirements of this package are installed in matching versions."""
    found = [
        problem(
            "packages",
            f"{wanted.name} {have or 'is not installed'}",
            expected=f"{wanted.specifier or 'any version'}",
            do=f'`python -m pip install "{wanted.name}{wanted.specifier}"`',
        )
        for wanted, have in _unmet(seen, "semcal-ros")
        # OpenCV has several package names; without it this command could not have started.
        if not wanted.name.startswith("opencv")
    ]
    if found:
        return found
    shown = ("numpy", "scipy", "opencv-python-headless", "opencv-python", "rosbags")
    versions = [f"{name} {seen.packages[name]}" for name in shown if name in seen.packages]
    return [ok("packages", ", ".join(versions) or "as the ROS workspace has them")]


def _unmet(seen: Environment, distribution: str) -> Iterator[tuple[Requirement, str | None]]:
    """Requirements of a distribution that are not met, with the version that is installed."""
    for line in seen.requirements.get(distribution, ()):
        try:
            wanted = Requirement(line)
            if wanted.marker is not None and not wanted.marker.evaluate({"extra": ""}):
                continue
            have = seen.packages.get(canonicalize_name(wanted.name))
            if have is None or not wanted.specifier.contains(have, prereleases=True):
                yield wanted, have
        except (InvalidRequirement, InvalidVersion):
            continue  # metadata of other people: pip judges them


def check_rclpy(seen: Environment) -> list[CheckResult]:
    """Check whether ROS 2 can be imported; otherwise say how to get it."""
    reason = seen.import_errors.get("rclpy")
    if reason is None:
        missing = [
            f"{name} ({why})"
            for name, why in seen.import_errors.items()
            if name.endswith((".msg", ".srv"))
        ]
        if missing:
            return [problem("ROS 2", f"rclpy works, but not {', '.join(missing)}", do=_GET_ROS)]
        return [ok("ROS 2", f"rclpy from {seen.rclpy_file}")]
    if "No module named 'rclpy'" in reason:
        here = (
            f"; {', '.join(seen.installations)} is installed, but not sourced or for another Python"
        )
        return [
            problem(
                "ROS 2", f"rclpy is not installed{here * bool(seen.installations)}", do=_GET_ROS
            )
        ]
    if _wrong_middleware(seen):
        return []  # check_rmw reports it
    return [
        problem(
            "ROS 2",
            f"rclpy is there but cannot be imported ({reason})",
            expected="one ROS 2, made for this Python",
            do="use a shell in which no other ROS or virtual environment was sourced",
        )
    ]


def check_one_ros(seen: Environment) -> list[CheckResult]:
    """Check whether wheels and a sourced workspace are mixed, or wheels of two distributions."""
    rclpy = seen.packages.get("ros-rclpy")
    if rclpy is None:
        return []
    # The wheels of a distribution require each other in narrow ranges of versions.
    for name in filter(lambda name: name.startswith("ros-"), sorted(seen.requirements)):
        for wanted, have in _unmet(seen, name):
            return [
                problem(
                    "ROS 2 wheels",
                    f"{name} {seen.packages.get(name, '')} with {wanted.name} {have or 'missing'}",
                    expected=f"{wanted.name}{wanted.specifier}, of the same distribution",
                    do="make the environment again: `make setup`",
                )
            ]
    others = [
        prefix
        for prefix in seen.environment.get("AMENT_PREFIX_PATH", "").split(":")
        if prefix and Path(prefix) != Path(seen.prefix)
    ]
    foreign = bool(seen.rclpy_file) and not Path(seen.rclpy_file).is_relative_to(seen.prefix)
    if foreign or others:
        where = seen.rclpy_file if foreign else ", ".join(others)
        return [
            (problem if foreign else note)(
                "ROS 2 wheels",
                f"this environment has wheels of ROS 2, and {where} is sourced as well",
                expected="one of the two",
                do="use a new shell without the setup script, or an environment without the wheels",
            )
        ]
    return [ok("ROS 2 wheels", f"ros-rclpy {rclpy}")]


def check_package_index(seen: Environment) -> list[CheckResult]:
    """Check whether scripts and launch files of the user find the packages of this environment."""
    if "ros-rclpy" not in seen.packages or not seen.rclpy_file:
        return []
    if seen.prefix in seen.script_prefixes:
        return [
            ok("package index", f"scripts look packages up in {', '.join(seen.script_prefixes)}")
        ]
    listed = ", ".join(seen.script_prefixes) or "empty"
    return [
        problem(
            "package index",
            f"AMENT_PREFIX_PATH is {listed} for a script, so that get_package_share_directory and launch find nothing "
            "of this environment",
            expected=f"{seen.prefix} in it",
            do=f"`export AMENT_PREFIX_PATH={seen.prefix}`; `make setup` does that for its own environment",
        )
    ]


def _wrong_middleware(seen: Environment) -> bool:
    named = seen.environment.get("RMW_IMPLEMENTATION", "")
    return bool(named) and named in seen.import_errors.get("rclpy", "")


def check_rmw(seen: Environment) -> list[CheckResult]:
    """Check which middleware is used."""
    if _wrong_middleware(seen):
        return [
            problem(
                "middleware",
                f"RMW_IMPLEMENTATION is {seen.environment['RMW_IMPLEMENTATION']}, which cannot be loaded"
                f" ({seen.import_errors['rclpy']})",
                expected="an installed one such as rmw_fastrtps_cpp",
                do="unset RMW_IMPLEMENTATION, or install that middleware",
            )
        ]
    if not seen.rmw:
        return []
    if seen.rmw.startswith("rmw_fastrtps"):
        return [ok("middleware", seen.rmw)]
    return [
        note(
            "middleware",
            f"{seen.rmw}, which does not read the shipped profile for large images",
            do="use the same middleware in all processes, and its own settings for large messages",
        )
    ]


def check_domain(seen: Environment) -> list[CheckResult]:
    """Check whether the domain id is valid."""
    given = seen.environment.get("ROS_DOMAIN_ID", "")
    if not given:
        return [ok("domain", "ROS_DOMAIN_ID is not set: 0")]
    if not given.isdecimal() or int(given) > _DOMAINS:
        return [
            problem(
                "domain",
                f"ROS_DOMAIN_ID is {given!r}",
                expected=f"0 to {_SAFE_DOMAINS}",
                do="set the same number in all shells",
            )
        ]
    if int(given) > _SAFE_DOMAINS:
        return [
            note(
                "domain",
                f"ROS_DOMAIN_ID is {given}, whose ports Linux gives to other programs too",
                expected=f"0 to {_SAFE_DOMAINS}",
            )
        ]
    return [ok("domain", f"ROS_DOMAIN_ID is {given}; nodes with another number are not seen")]


def check_discovery(seen: Environment) -> list[CheckResult]:
    """Check which hosts and processes can be discovered."""
    reach = seen.environment.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "")
    peers = seen.environment.get("ROS_STATIC_PEERS", "")
    if reach and reach not in _RANGES:
        return [
            problem(
                "discovery",
                f"ROS_AUTOMATIC_DISCOVERY_RANGE is {reach!r}",
                expected="one of " + ", ".join(_RANGES),
            )
        ]
    if reach == "OFF" and not peers:
        return [
            problem(
                "discovery",
                "ROS_AUTOMATIC_DISCOVERY_RANGE is OFF and no ROS_STATIC_PEERS are set",
                expected="LOCALHOST or SUBNET",
                do="set it in all shells alike; otherwise no node finds another",
            )
        ]
    found = []
    if seen.environment.get("ROS_LOCALHOST_ONLY") == "1":
        found.append(
            note(
                "discovery",
                "ROS_LOCALHOST_ONLY=1: nodes on other hosts are not found",
                do="use ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST, which replaces it, or unset it",
            )
        )
    if seen.environment.get("ROS_DISCOVERY_SERVER"):
        found.append(
            note(
                "discovery",
                "ROS_DISCOVERY_SERVER is set: only what is subscribed to is listed below",
                do="set it in all shells alike",
            )
        )
    reached = f"{reach or 'not set: SUBNET'}" + (f", and hosts {peers}" if peers else "")
    return found or [ok("discovery", f"ROS_AUTOMATIC_DISCOVERY_RANGE is {reached}")]


def _memory(seen: Environment) -> SharedMemory | None:
    try:
        return shared_memory(seen.environment)
    except ConfigError:
        return None  # check_profile reports it


def check_profile(seen: Environment) -> list[CheckResult]:
    """Whether a profile is set and can be used; `large images` says whether it is needed."""
    if seen.rmw and not seen.rmw.startswith("rmw_fastrtps"):
        return []
    try:
        memory = shared_memory(seen.environment)
    except ConfigError as error:
        return [
            problem(
                "DDS profile",
                f"{error.seen}; Fast DDS goes on without it",
                expected=error.expected,
                do="use the shipped dds/fastdds_large_images.xml, or unset the variable",
            )
        ]
    named = profile_file(seen.environment)
    where = "" if named is None else f" ({named[0]})"
    if memory.segment_bytes is None:
        return [
            note(
                "DDS profile",
                f"{memory.source}{where}: the size of its shared memory is not stated",
                expected="more shared memory than one image takes",
                do="compare with `Large images` in doc/nodes.md",
            )
        ]
    size = f"{memory.segment_bytes / _MB:.1f} MiB of shared memory"
    if named is None and memory.source != "no profile is set":
        return [
            problem(
                "DDS profile",
                memory.source,
                expected="the variable of the installed version",
                do="set FASTRTPS_DEFAULT_PROFILES_FILE and FASTDDS_DEFAULT_PROFILES_FILE both",
            )
        ]
    return [ok("DDS profile", f"{memory.source}{where}: {size}")]


def check_shared_memory(seen: Environment) -> list[CheckResult]:
    """Check whether /dev/shm has room for the segment of one more process."""
    memory = _memory(seen)
    if memory is None or memory.segment_bytes is None or not seen.rmw.startswith("rmw_fastrtps"):
        return []
    free = seen.shm_free_bytes
    if free is None:
        return [note("/dev/shm", "it does not exist: processes talk through the network stack")]
    if free < memory.segment_bytes:
        return [
            problem(
                "/dev/shm",
                f"{free / _MB:.0f} MiB are free",
                expected=f"{memory.segment_bytes / _MB:.1f} MiB for each process of the DDS profile",
                do="enlarge it (a container: --shm-size=2g), or remove /dev/shm/fast* that killed processes left,"
                " while no ROS process runs; a process without it uses UDP",
            )
        ]
    return [ok("/dev/shm", f"{free / _MB:.0f} MiB are free")]


def check_socket_buffers(seen: Environment) -> list[CheckResult]:
    """Check whether images from other hosts can arrive without loss."""
    have = seen.receive_buffer_bytes
    if have is None or local_only(seen.environment) or have >= _SOCKET_BYTES:
        return []
    return [
        note(
            "socket buffers",
            f"net.core.rmem_max is {have / _MB:.1f} MiB",
            expected=f"{_SOCKET_BYTES / _MB:.0f} MiB where large images come from other hosts",
            do=f"`sysctl -w net.core.rmem_max={_SOCKET_BYTES}` on the receiving host",
        )
    ]


ENVIRONMENT_CHECKS: tuple[Callable[[Environment], list[CheckResult]], ...] = (
    check_python,
    check_packages,
    check_rclpy,
    check_one_ros,
    check_package_index,
    check_rmw,
    check_domain,
    check_discovery,
    check_profile,
    check_shared_memory,
    check_socket_buffers,
)


def collect_environment() -> Environment:
    """Collect the state of this machine and process, without a ROS graph; imports what the nodes import."""
    rclpy_file, rmw, script_prefixes, reason = _probe_ros()
    distributions = [found for found in metadata.distributions() if found.metadata["Name"]]
    errors = {"rclpy": reason} if reason else _import_errors(_MESSAGES)
    return Environment(
        python=sys.version_info[:2],
        packages={_name(found): found.version for found in distributions},
        requirements={_name(found): tuple(found.requires or ()) for found in distributions},
        import_errors=errors,
        rclpy_file=rclpy_file,
        prefix=sys.prefix,
        installations=tuple(sorted(str(p.parent) for p in _INSTALLATIONS.glob("*/setup.sh"))),
        environment=dict(os.environ),
        script_prefixes=tuple(p for p in script_prefixes.split(os.pathsep) if p),
        rmw=rmw,
        shm_free_bytes=shutil.disk_usage(_SHM).free if _SHM.is_dir() else None,
        receive_buffer_bytes=_number_in(_RECEIVE_BUFFER),
    )


def _probe_ros() -> tuple[str, str, str, str]:
    """File of rclpy, name of the middleware, where scripts look packages up, and, where rclpy cannot be imported, the
    reason.
    """
    # This command has put its own prefix there, which a script of the user's does not do.
    outer = {**os.environ, _PREFIXES: os.pathsep.join(prefixes_of_user())}
    command = [sys.executable, "-W", "ignore", "-c", _PROBE]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, timeout=_PROBE_S, env=outer
        )
    except subprocess.TimeoutExpired:
        return "", "", "", f"importing it took over {_PROBE_S:g} s"
    lines = done.stdout.split("\n")
    if done.returncode == 0 and len(lines) >= 4:
        return lines[-3], lines[-2], lines[-4], ""
    said = [line.strip() for line in done.stderr.splitlines() if line.strip()]
    reason = said[-1][:_LONGEST] if said else f"the process ended with {done.returncode}"
    return "", "", "", reason


def _import_errors(modules: Iterable[str]) -> dict[str, str]:
    reasons = {name: _import_error(name) for name in modules}
    return {name: reason for name, reason in reasons.items() if reason}


def _import_error(module: str) -> str:
    try:
        with warnings.catch_warnings():
            # Warnings of other modules at import do not matter here.
            warnings.simplefilter("ignore")
            import_module(module)
    except Exception as error:  # a broken installation may raise any exception
        return _one_line(error)
    return ""


def _one_line(error: Exception) -> str:
    text = " ".join(str(error).split()) or type(error).__name__
    return text[:_LONGEST]


def _name(distribution: metadata.Distribution) -> str:
    return canonicalize_name(distribution.metadata["Name"])


def _number_in(path: Path) -> int | None:
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None
