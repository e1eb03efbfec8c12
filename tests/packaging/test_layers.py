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

"""The floors of the house: which room may import which, and what core may not touch."""

from __future__ import annotations

import ast
import graphlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.node_scenes import make_calibration
from tests.helpers.project import ROOT, runtime_imports

PACKAGE = ROOT / "semcal_ros"

# Room -> rooms it may import, itself aside. Read from the bottom: every arrow goes down.


def _tables() -> tuple[dict[str, set[str]], dict[str, set[str]]]:
    """Which room may import which, in the package and in its core, as CONTRIBUTING.md says it."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    package, _, core = text.partition("\nInside `core`:\n")
    rows = (
        re.findall(r"^\| `(\w+)` \| .+ \| (.*)\|$", part, re.MULTILINE) for part in (package, core)
    )
    first, second = (
        {room: set(re.findall(r"`(\w+)`", below)) for room, below in part} for part in rows
    )
    return first, second


MAY_IMPORT, CORE_MAY_IMPORT = _tables()
THIRD_PARTY = {
    "core": {"numpy", "scipy", "cv2"},
    "synthetic": {"numpy", "scipy", "cv2"},
    "applications": {"numpy", "scipy", "cv2"},
    "bridge": {"numpy", "scipy", "cv2"},
}
# The places of ROS: the nodes, and the modules of doctor and client that listen.
ROS_PLACES = (PACKAGE / "nodes", PACKAGE / "doctor" / "live.py", PACKAGE / "client" / "stream.py")
# Files, clocks, processes and logging have no place in core.
NOT_IN_CORE = {
    "asyncio",
    "datetime",
    "glob",
    "io",
    "logging",
    "os",
    "pathlib",
    "shutil",
    "socket",
    "subprocess",
    "tempfile",
    "time",
}

BLOCKER = """
import importlib, importlib.abc, pkgutil, sys

class Block(importlib.abc.MetaPathFinder):
    names = {"rclpy", "yaml", "click", "rosbags", "jsonschema", "tifffile", "matplotlib"}

    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        ros = top.endswith("_msgs") or top.startswith(("ament", "rcl", "rosidl", "std_srvs"))
        if top in self.names or ros:
            raise ImportError(f"{name} is blocked")
        return None

sys.meta_path.insert(0, Block())
import semcal_ros.core
for module in pkgutil.walk_packages(semcal_ros.core.__path__, "semcal_ros.core."):
    importlib.import_module(module.name)
    print(module.name)
"""

WITHOUT_ROS = (
    BLOCKER.partition("import semcal_ros.core")[0].replace(
        '"rclpy", "yaml", "click", "rosbags", "jsonschema", "tifffile", "matplotlib"', '"rclpy"'
    )
    + "from semcal_ros import Calibration, calibrate\nprint(Calibration.load, calibrate)\n"
)


def _sources(layer: str) -> list[Path]:
    return sorted((PACKAGE / layer).rglob("*.py"))


def _rooms(folder: Path) -> set[str]:
    """Names of the modules and packages of a folder."""
    found = {path.stem for path in folder.glob("*.py")}
    found |= {path.name for path in folder.iterdir() if list(path.rglob("*.py"))}
    return found - {"__init__", "__main__"}


def test_the_tables_name_every_room() -> None:
    assert set(MAY_IMPORT) == _rooms(PACKAGE)
    assert set(CORE_MAY_IMPORT) == _rooms(PACKAGE / "core")


@pytest.mark.parametrize("table", [MAY_IMPORT, CORE_MAY_IMPORT], ids=["package", "core"])
def test_no_import_can_go_in_a_circle(table: dict[str, set[str]]) -> None:
    order = list(graphlib.TopologicalSorter(table).static_order())
    assert set(order) == set(table)
    assert all(order.index(below) < order.index(room) for room in table for below in table[room])


@pytest.mark.parametrize(
    ("folder", "table"),
    [(PACKAGE, MAY_IMPORT), (PACKAGE / "core", CORE_MAY_IMPORT)],
    ids=["package", "core"],
)
def test_a_room_imports_only_rooms_below(folder: Path, table: dict[str, set[str]]) -> None:
    prefix = ".".join(folder.relative_to(ROOT).parts) + "."
    wrong = []
    for room, below in table.items():
        for path in [*(folder / room).rglob("*.py"), *folder.glob(f"{room}.py")]:
            for name in runtime_imports(path):
                other = name.removeprefix(prefix).partition(".")[0]
                if name.startswith(prefix) and other not in below | {room}:
                    wrong.append(f"{path.relative_to(ROOT)}: {name}")
    assert not wrong


@pytest.mark.parametrize("layer", THIRD_PARTY)
def test_a_layer_imports_only_its_libraries(layer: str) -> None:
    allowed = THIRD_PARTY[layer] | sys.stdlib_module_names | {"semcal_ros"}
    wrong = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in _sources(layer)
        for name in runtime_imports(path)
        if name.partition(".")[0] not in allowed
    ]
    assert not wrong


def test_ros_is_imported_by_nodes_and_the_listener_only() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in PACKAGE.rglob("*.py")
        if not any(path.is_relative_to(place) for place in ROS_PLACES)
        for name in runtime_imports(path)
        if name.partition(".")[0] in {"rclpy", "ament_index_python", "std_srvs", "launch"}
        or name.partition(".")[0].endswith("_msgs")
    ]
    assert not wrong


def test_middleware_needs_no_ros() -> None:
    """The doctor uses it, which must work where ROS does not."""
    done = _run(BLOCKER.partition("import semcal_ros.core")[0] + "import semcal_ros.middleware\n")
    assert done.returncode == 0, done.stderr


def test_the_doctor_works_without_ros() -> None:
    """Its command and all checks; only the listener is loaded later."""
    done = _run(
        WITHOUT_ROS.partition("from semcal_ros")[0] + "import semcal_ros.cli.doctor_command"
    )
    assert done.returncode == 0, done.stderr


def test_core_has_no_files_clocks_or_logging() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in _sources("core")
        for name in runtime_imports(path)
        if name.partition(".")[0] in NOT_IN_CORE
    ]
    calls = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in _sources("core")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in {"open", "print", "input"}
    ]
    assert not wrong + calls


def _run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", code],
        capture_output=True,
        text=True,
        check=False,
        cwd=ROOT,
        timeout=120,
    )


def test_core_imports_without_ros_or_any_other_layers_library() -> None:
    done = _run(BLOCKER)
    assert done.returncode == 0, done.stderr
    assert "semcal_ros.core.camera.scan_camera" in done.stdout.split()


def test_the_api_imports_without_ros() -> None:
    done = _run(WITHOUT_ROS)
    assert done.returncode == 0, done.stderr


def test_the_blocker_blocks() -> None:
    done = _run(BLOCKER.replace("import semcal_ros.core\n", "import rclpy\n", 1))
    assert done.returncode != 0
    assert "rclpy is blocked" in done.stderr


def test_quick_commands_load_only_what_they_use(tmp_path: Path) -> None:
    make_calibration().save(tmp_path / "cal.yaml")
    slow = (
        *("pydantic", "rosbags", "ruamel.yaml", "matplotlib", "tifffile", "rclpy", "trimesh"),
        *("scipy", "cv2", "PIL", "av", "joblib", "jinja2", "tqdm"),
    )
    code = (
        "import sys; from semcal_ros.cli import main; "
        "status = main(sys.argv[1:]); "
        f"loaded = [name for name in {slow} if name in sys.modules]; "
        "sys.exit(str(loaded) if status or loaded else 0)"
    )
    for arguments in (["--help"], ["at", str(tmp_path / "cal.yaml"), "1000"]):
        done = subprocess.run(
            [sys.executable, "-c", code, *arguments],
            cwd=ROOT,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
