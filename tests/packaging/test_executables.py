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

"""Every executable is where `ros2 run` looks for it, starts, and ends cleanly."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import rclpy
from ament_index_python import get_package_prefix, get_package_share_directory
from rclpy.context import Context
from rclpy.node import Node

from tests.helpers.project import NODES
from tests.helpers.semcal_runs import run

pytestmark = pytest.mark.slow

# A process must import numpy, cv2 and rclpy and be discovered: 2 s alone, more on a busy machine.
START_S = 60.0
STOP_S = 20.0


def _executable(name: str) -> Path:
    return Path(get_package_prefix("semcal_ros")) / "lib" / "semcal_ros" / name


@pytest.fixture(scope="module")
def observer() -> Iterator[Node]:
    context = Context()
    rclpy.init(context=context)
    node = Node("packaging_observer", context=context, enable_rosout=False)
    yield node
    node.destroy_node()
    context.try_shutdown()


def _arguments(name: str, folder: Path) -> list[str]:
    """What an executable cannot start without."""
    if name == "bag_player":
        bag = folder / "tiny"
        assert run("simulate", bag, "--plan", "drift", "--frames", 2, "--size", 64) == 0
        return ["--ros-args", "-p", f"bag:={bag}", "-p", "loop:=true"]
    if name == "microscope":
        (folder / "pictures").mkdir()
        journal = ["-p", f"journal:={folder / 'journal'}"]
        return ["--ros-args", "-p", f"folder:={folder / 'pictures'}", *journal]
    return []


def _wait_for(observer: Node, name: str, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + START_S
    while time.monotonic() < deadline:
        if (name, "/sem") in observer.get_node_names_and_namespaces():
            return
        if process.poll() is not None:
            raise AssertionError(f"{name} ended with {process.returncode}: {process.communicate()}")
        time.sleep(0.05)
    raise AssertionError(f"{name} did not appear in the ROS graph within {START_S} s")


# Both signals end in one handler of run_node, so each node gets one of them in turn; both where a node has
# processes of its own or must end its publishing itself.
STOPS = [
    (name, stop)
    for k, name in enumerate(NODES)
    for j, stop in enumerate((signal.SIGINT, signal.SIGTERM))
    if k % 2 == j or name in ("bag_player", "calibration_server")
]


# Once, in thousands of starts, a process ended by SIGSEGV after its node had ended, in the middleware's own threads; a
# hundred more starts and signals did not show it again.
@pytest.mark.flaky(reruns=1)
@pytest.mark.parametrize(("name", "stop"), STOPS, ids=[f"{n}-{s.name.lower()}" for n, s in STOPS])
def test_an_executable_starts_and_stops(
    name: str, stop: signal.Signals, observer: Node, tmp_path: Path
) -> None:
    process = subprocess.Popen(
        [str(_executable(name)), *_arguments(name, tmp_path)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        _wait_for(observer, name, process)
        process.send_signal(stop)
        _, errors = process.communicate(timeout=STOP_S)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0, errors
    assert "Traceback" not in errors


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM], ids=["sigint", "sigterm"])
def test_a_signal_that_comes_during_the_imports_ends_it_without_a_traceback(
    stop: signal.Signals,
) -> None:
    process = subprocess.Popen(
        [str(_executable("stream_corrector"))],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        # numpy is among the first of the imports; the others take a second more.
        maps, deadline = Path(f"/proc/{process.pid}/maps"), time.monotonic() + START_S
        while "numpy" not in maps.read_text() and time.monotonic() < deadline:
            time.sleep(0.002)
        process.send_signal(stop)
        output, _ = process.communicate(timeout=STOP_S)
    finally:
        process.kill()
        process.wait()
    assert (process.returncode, output) == (0, "")


def test_nothing_else_is_in_the_executables_folder() -> None:
    found = {path.name for path in _executable("x").parent.iterdir() if os.access(path, os.X_OK)}
    # A colcon workspace has the command `semcal` there as well.
    assert found - {"semcal"} == set(NODES)


FIND = "from ament_index_python import get_package_prefix as p; print(p('semcal_ros'))"
COMMAND = f"from semcal_ros.cli import main; main(['at', '--help']); {FIND}"
NODE = f"""
from semcal_ros.nodes.common.run import run_node
def factory():
    {FIND}
run_node(factory, [])
"""


@pytest.mark.parametrize("program", [COMMAND, NODE], ids=["command", "node"])
def test_commands_and_executables_find_the_index_in_a_plain_shell(
    program: str, tmp_path: Path
) -> None:
    """As after a login: only PATH and HOME are set."""
    if Path(get_package_prefix("semcal_ros")) != Path(sys.prefix):
        pytest.skip("installed in a workspace, whose set-up file names the index")
    source = str(Path(__file__).resolve().parents[2])
    done = subprocess.run(
        [sys.executable, "-c", program],
        env={"PATH": "/usr/bin:/bin", "HOME": str(tmp_path), "PYTHONPATH": source},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.stdout.strip().endswith(get_package_prefix("semcal_ros")), done.stderr


def test_nothing_of_the_suite_runs_when_the_interpreter_starts() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import sys; print('semcal_ros' in sys.modules)"],
        env={"PATH": "/usr/bin:/bin"},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.stdout.strip() == "False", done.stderr


def test_semcal_is_a_command_of_the_environment() -> None:
    """In a folder that an activated environment and a sourced workspace have on the PATH."""
    done = subprocess.run(
        [Path(get_package_prefix("semcal_ros")) / "bin" / "semcal", "--version"],
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": os.environ.get("PYTHONPATH", "")},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    assert "0." in done.stdout


@pytest.mark.parametrize("part", ["package.xml", "launch", "config", "msg_configs", "dds"])
def test_share_holds_what_a_workspace_would(part: str) -> None:
    share = Path(get_package_share_directory("semcal_ros"))
    source = Path(__file__).resolve().parents[2] / part
    assert (share / part).exists()
    if source.is_dir():
        installed = {path.name for path in (share / part).iterdir()}
        assert installed >= {path.name for path in source.iterdir() if path.is_file()}
