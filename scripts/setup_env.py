"""Makes `.venv`: Python packages, ROS 2 from PyPI, and semcal_ros itself. Standard library only.

Nothing is done where a stamp in `.venv` says that everything is as the requirement files ask.
The environment of the other ROS distribution is kept beside it as `.venv-<distro>` and put back
when asked for. A Python environment works only at the path it was made for, so `.venv` is always
a real directory and the other one waits under another name.
"""

from __future__ import annotations

import argparse
import fcntl
import hashlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
VENV = ROOT / ".venv"
STAMP = "semcal_setup.json"
DISTROS = ("jazzy", "kilted")
PACKAGE_SOURCES = (
    "setup.py",
    "setup.cfg",
    "pyproject.toml",
    "package.xml",
    "resource/*",
    "launch/*",
    "msg_configs/*",
    "dds/*",
    "security/*",
)


def main() -> int:
    parser = argparse.ArgumentParser(description="Make or update .venv.")
    parser.add_argument("--distro", default="jazzy", help="ROS 2 distribution: jazzy or kilted")
    parser.add_argument(
        "--this-python",
        action="store_true",
        help="make .venv anew when it was made by another Python version than this one",
    )
    options = parser.parse_args()
    if options.distro not in DISTROS:
        return fail(
            f"ROS_DISTRO is {options.distro!r}",
            f"one of {', '.join(DISTROS)}",
            "call make ROS_DISTRO=jazzy",
        )
    with open(ROOT / ".venv.lock", "w", encoding="ascii") as lock:
        # Two runs of make in one tree must not build the same environment at once.
        fcntl.flock(lock, fcntl.LOCK_EX)
        return bring_up_to_date(options.distro, options.this_python)


def bring_up_to_date(distro: str, this_python: bool) -> int:
    if VENV.exists() and read_stamp(VENV) is None:
        return fail(
            f"{VENV} was not made by this project",
            "no .venv, or one made by make setup",
            "move it away and call make setup again",
        )
    select(distro)
    environment = environment_key(distro)
    stamp = read_stamp(VENV) or {}
    stale = stamp.get("environment") != environment or not (VENV / "bin/python").exists()
    if stale or (this_python and stamp.get("python") != python_version()):
        print(
            f"Making .venv with Python {python_version()} and ROS 2 {distro.capitalize()}; "
            "this takes a minute or two.",
            flush=True,
        )
        if not create(distro):
            return 1
        stamp = {"distro": distro, "python": python_version(), "environment": environment}
        write_stamp(stamp)
    package = digest(path for pattern in PACKAGE_SOURCES for path in sorted(ROOT.glob(pattern)))
    if stamp.get("package") != package:
        print("Installing semcal_ros into .venv.", flush=True)
        if not pip("--no-deps", "--no-build-isolation", "--editable", str(ROOT)):
            return 1
        write_stamp({**stamp, "package": package})
    return 0


def select(distro: str) -> None:
    """Put the environment of this distribution at .venv, if there is one."""
    current = (read_stamp(VENV) or {}).get("distro")
    if current == distro:
        return
    if current is not None:
        aside = VENV.with_name(f".venv-{current}")
        shutil.rmtree(aside, ignore_errors=True)
        VENV.rename(aside)
    kept = VENV.with_name(f".venv-{distro}")
    if kept.exists():
        kept.rename(VENV)


def create(distro: str) -> bool:
    shutil.rmtree(VENV, ignore_errors=True)
    VENV.mkdir()
    # Marks the directory as ours from the start: an interrupted run can be repeated.
    write_stamp({"distro": distro})
    if not run([sys.executable, "-m", "venv", str(VENV)]):
        fail(
            "python -m venv failed",
            "a Python with the modules venv and ensurepip",
            "on Debian and Ubuntu install python3-venv, or choose another with make PYTHON=...",
        )
        return False
    files = requirement_files(distro)
    setuptools = next(
        line
        for line in files[0].read_text(encoding="utf-8").splitlines()
        if line.startswith("setuptools==")
    )
    # Two pure-Python packages exist as sources only and are built with this setuptools.
    return pip(setuptools) and pip(
        "--no-deps",
        "--no-build-isolation",
        "--use-pep517",
        *(word for path in files for word in ("-r", str(path))),
    )


def pip(*arguments: str) -> bool:
    command = [
        str(VENV / "bin/python"),
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-input",
        "--disable-pip-version-check",
        *arguments,
    ]
    if run(command):
        return True
    fail(
        "pip could not install the packages",
        "the versions in requirements/*.txt to be found",
        "check the network or the package index named by `pip config list`",
    )
    return False


def run(command: list[str]) -> bool:
    return subprocess.run(command, cwd=ROOT, stdin=subprocess.DEVNULL, check=False).returncode == 0


def requirement_files(distro: str) -> list[Path]:
    return [ROOT / "requirements" / f"{name}.txt" for name in ("base", f"ros-{distro}", "test")]


def environment_key(distro: str) -> str:
    return f"{VENV} {digest(requirement_files(distro))}"


def digest(paths: Iterable[Path]) -> str:
    total = hashlib.sha256()
    for path in paths:
        if path.is_file():
            total.update(f"{path.relative_to(ROOT)}\0".encode())
            total.update(hashlib.sha256(path.read_bytes()).digest())
    return total.hexdigest()


def python_version() -> str:
    return ".".join(str(number) for number in sys.version_info[:3])


def read_stamp(venv: Path) -> dict[str, str] | None:
    try:
        return dict(json.loads((venv / STAMP).read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return None


def write_stamp(stamp: dict[str, str]) -> None:
    fresh = VENV / f"{STAMP}.new"
    fresh.write_text(json.dumps(stamp, indent=1) + "\n", encoding="utf-8")
    os.replace(fresh, VENV / STAMP)


def fail(seen: str, expected: str, do: str) -> int:
    print(f"setup: {seen}; expected {expected}; {do}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
