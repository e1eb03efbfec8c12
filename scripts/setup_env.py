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

"""Makes `.venv`: Python packages, ROS 2 from PyPI, and semcal_ros itself. Standard library only.

A stamp in `.venv` holds digests of what it was made from; nothing is done while they agree. The
environment of the other ROS distribution waits as `.venv-<distro>`: a Python environment works only
at the path it was made for, so it is moved back there and not used in place.
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import json
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import NoReturn

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
STAMP = VENV / "semcal_setup.json"
DISTROS = ("jazzy", "kilted")
# What an editable installation copies or generates from.
PACKAGE_SOURCES = (
    *("setup.py", "setup.cfg", "pyproject.toml", "package.xml", "semcal_ros/__init__.py"),
    *("resource/*", "launch/*", "msg_configs/*", "dds/*", "security/*"),
)


def main() -> None:
    parser = argparse.ArgumentParser(description="Make or update .venv.")
    parser.add_argument("--distro", default="jazzy", help="ROS 2 distribution: jazzy or kilted")
    parser.add_argument(
        "--this-python",
        action="store_true",
        help="make .venv again if another Python version than this one made it",
    )
    options = parser.parse_args()
    if options.distro not in DISTROS:
        stop(f"ROS_DISTRO is {options.distro!r}", "jazzy or kilted", "call make ROS_DISTRO=jazzy")
    with open(ROOT / ".venv.lock", "w", encoding="ascii") as lock:
        # Two runs of make in one tree must not build the same environment at once.
        fcntl.flock(lock, fcntl.LOCK_EX)
        update(options.distro, options.this_python)


def update(distro: str, this_python: bool) -> None:
    """Bring .venv to what the requirement files and the sources ask for."""
    select(distro)
    files = [
        ROOT / "requirements" / f"{name}.txt"
        for name in ("base", f"ros-{distro}", "microscope", "view", "test")
    ]
    wanted = {"distro": distro, "environment": f"{VENV} {digest(files)}"}
    stamp = read_stamp()
    other_python = this_python and stamp.get("python") != platform.python_version()
    if wanted.items() - stamp.items() or other_python or not (VENV / "bin/python").exists():
        print(
            f"Making .venv with Python {platform.python_version()} and ROS 2 {distro.capitalize()}; "
            "this takes a minute or two.",
            flush=True,
        )
        create(distro, files)
        stamp = {**wanted, "python": platform.python_version()}
        write_stamp(stamp)
    package = digest(path for name in PACKAGE_SOURCES for path in sorted(ROOT.glob(name)))
    if stamp.get("package") != package:
        print("Installing semcal_ros into .venv.", flush=True)
        pip("--no-deps", "--no-build-isolation", "--editable", str(ROOT))
        write_stamp({**stamp, "package": package})
    add_ament_index()


def add_ament_index() -> None:
    """Let every Python of .venv find the packages in it, as the setup script of a ROS installation does.

    Launch files, ``get_package_share_directory`` and the user's own scripts look the packages up by this variable.
    """
    line = (
        "import os, sys; os.environ['AMENT_PREFIX_PATH'] = os.pathsep.join([sys.prefix, *(p for p in "
        "os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p not in ('', sys.prefix))])\n"
    )
    for folder in VENV.glob("lib/python*/site-packages"):
        (folder / "semcal_ament_index.pth").write_text(line, encoding="ascii")


def select(distro: str) -> None:
    """Put the environment of this distribution at .venv, if there is one."""
    current = read_stamp().get("distro")
    if VENV.exists() and current is None:
        stop(
            f"{VENV} was not made by this project",
            "no .venv, or one made by make setup",
            "move it away and call make setup again",
        )
    if current == distro:
        return
    if current is not None:
        aside = ROOT / f".venv-{current}"
        shutil.rmtree(aside, ignore_errors=True)
        VENV.rename(aside)
    waiting = ROOT / f".venv-{distro}"
    if waiting.exists():
        waiting.rename(VENV)


def create(distro: str, requirement_files: list[Path]) -> None:
    shutil.rmtree(VENV, ignore_errors=True)
    VENV.mkdir()
    # Marks the directory as ours from the start, so that an interrupted run can be repeated.
    write_stamp({"distro": distro})
    if not run(sys.executable, "-m", "venv", str(VENV)):
        stop(
            "python -m venv failed",
            "a Python with the modules venv and ensurepip",
            "on Debian and Ubuntu install python3-venv, or choose another with make PYTHON=...",
        )
    base = requirement_files[0].read_text(encoding="utf-8").splitlines()
    # Two pure-Python packages exist as sources only and are built with this setuptools.
    pip(next(line for line in base if line.startswith("setuptools==")))
    requirements = (word for path in requirement_files for word in ("-r", str(path)))
    pip("--no-deps", "--no-build-isolation", "--use-pep517", *requirements)


def pip(*arguments: str) -> None:
    options = ("--quiet", "--no-input", "--disable-pip-version-check")
    if not run(str(VENV / "bin/python"), "-m", "pip", "install", *options, *arguments):
        stop(
            "pip could not install the packages",
            "the versions in requirements/*.txt to be found",
            "check the network or the package index named by `pip config list`",
        )


def run(*command: str) -> bool:
    return subprocess.run(command, cwd=ROOT, stdin=subprocess.DEVNULL, check=False).returncode == 0


def digest(paths: Iterable[Path]) -> str:
    total = hashlib.sha256()
    for path in paths:
        if path.is_file():
            total.update(f"{path.relative_to(ROOT)}\0{len(path.read_bytes())}\0".encode())
            total.update(path.read_bytes())
    return total.hexdigest()


def read_stamp() -> dict[str, str]:
    try:
        return dict(json.loads(STAMP.read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}


def write_stamp(stamp: dict[str, str]) -> None:
    fresh = STAMP.with_suffix(".new")
    fresh.write_text(json.dumps(stamp, indent=1) + "\n", encoding="utf-8")
    fresh.replace(STAMP)


def stop(seen: str, expected: str, do: str) -> NoReturn:
    print(f"setup: {seen}; expected {expected}; {do}", file=sys.stderr)
    sys.exit(2)


if __name__ == "__main__":
    main()
