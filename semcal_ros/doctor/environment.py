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

"""Collect what the checks of this machine and process need; works without ROS."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import warnings
from collections.abc import Iterable
from importlib import import_module, metadata
from pathlib import Path

from packaging.utils import canonicalize_name

from semcal_ros.doctor.observations import Environment
from semcal_ros.middleware.ament_prefix import prefixes_of_user

__all__ = ["collect_environment"]

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
