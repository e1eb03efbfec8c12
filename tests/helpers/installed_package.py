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

"""A package of somebody else, installed beside the environment as `colcon build` or pip would."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from tests.helpers.project import ROOT

__all__ = ["CONSUMER", "Installed", "install", "write_consumers"]

CONSUMER = ROOT / "tests" / "consumer"
"""The package of the page "Write your node"."""


@dataclass(frozen=True)
class Installed:
    """Where a package is."""

    prefix: Path

    @property
    def modules(self) -> Path:
        """The folder for PYTHONPATH."""
        return next(self.prefix.rglob("site-packages"))

    def environment(self) -> dict[str, str]:
        """Variables with which processes find it, before anything else."""
        paths = [str(self.modules), str(ROOT), os.environ.get("PYTHONPATH", "")]
        prefixes = [str(self.prefix), os.environ.get("AMENT_PREFIX_PATH", sys.prefix)]
        return {
            **os.environ,
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
            "AMENT_PREFIX_PATH": os.pathsep.join(prefixes),
        }


def install(source: Path, folder: Path) -> Installed:
    """Install the package of a folder below another one; scripts go where `ros2 run` looks for them."""
    shutil.copytree(source, folder / "source")
    options = ("--no-deps", "--no-build-isolation", "--quiet", "--no-warn-script-location")
    # Without the last one, pip removes a package of that name from the environment.
    command = [sys.executable, "-m", "pip", "install", *options, "--ignore-installed"]
    command += ["--prefix", str(folder / "install"), str(folder / "source")]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    made = Installed(folder / "install")
    # pip has no place for the scripts of a single package, as colcon has by setup.cfg.
    scripts = made.prefix / "lib" / "bead_tracker"
    if (made.prefix / "bin").is_dir():
        shutil.move(made.prefix / "bin", scripts)
    return made


def write_consumers(folder: Path, module: str, code: str, entries: Mapping[str, str]) -> str:
    """Write a module with entry points as an installed package has them; returns the PYTHONPATH that finds it."""
    (folder / f"{module}.py").write_text(code, encoding="utf-8")
    about = folder / f"{module}-1.0.dist-info"
    about.mkdir()
    metadata = f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n"
    (about / "METADATA").write_text(metadata, encoding="utf-8")
    lines = "".join(f"{name} = {module}:{what}\n" for name, what in entries.items())
    (about / "entry_points.txt").write_text(f"[semcal_ros.consumers]\n{lines}", encoding="utf-8")
    return os.pathsep.join(filter(None, [str(folder), os.environ.get("PYTHONPATH", "")]))
