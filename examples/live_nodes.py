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

"""Executables of the suite as processes of their own, set up as the launch files do it."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Mapping
from pathlib import Path

from ament_index_python.packages import get_package_prefix

from semcal_ros.middleware import add_environment_prefix

END_S = 60.0
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
MALLOC_VARIABLES = (
    ("MALLOC_MMAP_THRESHOLD_", "268435456"),
    ("MALLOC_TRIM_THRESHOLD_", "536870912"),
)


class LiveNodes:
    """Started nodes, below /sem; what they print goes to files in ``logs``."""

    def __init__(self, logs: Path) -> None:
        # A domain of its own, so that an example neither hears nor disturbs anybody else's robots.
        os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        add_environment_prefix()
        prefix = Path(get_package_prefix("semcal_ros"))
        profile = str(prefix / "share" / "semcal_ros" / "dds" / "fastdds_large_images.xml")
        # Shared memory for whole images, and memory that is used again. A profile of the user's own stays.
        if not any(name in os.environ for name in PROFILE_VARIABLES):
            os.environ.update(dict.fromkeys(PROFILE_VARIABLES, profile))
        for name, value in MALLOC_VARIABLES:
            os.environ.setdefault(name, value)
        self._executables = prefix / "lib" / "semcal_ros"
        self._logs = logs
        self._logs.mkdir(parents=True, exist_ok=True)
        self._processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(self, name: str, parameters: Mapping[str, object]) -> subprocess.Popen[bytes]:
        """Start an executable with parameters."""
        command = [str(self._executables / name), "--ros-args", "-r", "__ns:=/sem"]
        for key, value in parameters.items():
            text = str(value).lower() if isinstance(value, bool) else str(value)
            command += ["-p", f"{key}:={text}"]
        with open(self._logs / f"{name}.log", "wb") as log:
            process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)
        self._processes[name] = process
        return process

    def check(self) -> None:
        """Raise if one has failed."""
        for name, process in self._processes.items():
            if process.poll():
                log = self._logs / f"{name}.log"
                last = log.read_text(errors="replace").strip().splitlines()[-1:]
                raise RuntimeError(f"{name} ended, expected to run; see {log}: {' '.join(last)}")

    def end(self) -> None:
        """End them in the order in which they were started."""
        for process in self._processes.values():
            process.send_signal(signal.SIGINT)
        for process in self._processes.values():
            process.wait(END_S)
