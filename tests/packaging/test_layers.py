"""The layers: who may import whom, and what core may not touch."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "semcal_ros"

# Layer -> parts of the package it may import, itself aside.
MAY_IMPORT = {
    "core": set(),
    "synthetic": {"core"},
    "schemas": {"core"},
    "bridge": {"core", "schemas"},
    "files": {"core", "bridge", "schemas", "calibration"},
    "doctor": {"core", "bridge", "calibration", "nodes"},
}
# Layer -> distributions it may import beside the standard library.
THIRD_PARTY = {
    "core": {"numpy", "scipy", "cv2"},
    "synthetic": {"numpy", "scipy", "cv2"},
    "bridge": {"numpy", "scipy", "cv2", "yaml", "jsonschema"},
}
# What the doctor takes from the nodes: the parts of them that need no ROS.
FROM_NODES = {"dds_profile", "message_types", "transport"}
# The places of ROS: the nodes, and the one module of the doctor that listens.
ROS_PLACES = (PACKAGE / "nodes", PACKAGE / "doctor" / "live.py")
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


def _imports(path: Path) -> Iterator[str]:
    """Full names of all that a module imports at run time, inside functions too."""
    pending: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            pending.extend(node.orelse)
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            # `from semcal_ros import x` names the part in the alias.
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        pending.extend(ast.iter_child_nodes(node))


@pytest.mark.parametrize("layer", MAY_IMPORT)
def test_a_layer_imports_only_layers_below(layer: str) -> None:
    allowed = MAY_IMPORT[layer] | {layer}
    wrong = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in _sources(layer)
        for name in _imports(path)
        if name.startswith("semcal_ros.") and name.split(".")[1] not in allowed
    ]
    assert not wrong


@pytest.mark.parametrize("layer", THIRD_PARTY)
def test_a_layer_imports_only_its_libraries(layer: str) -> None:
    allowed = THIRD_PARTY[layer] | sys.stdlib_module_names | {"semcal_ros"}
    wrong = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in _sources(layer)
        for name in _imports(path)
        if name.partition(".")[0] not in allowed
    ]
    assert not wrong


def test_ros_is_imported_by_nodes_and_the_listener_only() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in PACKAGE.rglob("*.py")
        if not any(path.is_relative_to(place) for place in ROS_PLACES)
        for name in _imports(path)
        if name.partition(".")[0] in {"rclpy", "ament_index_python", "std_srvs", "launch"}
        or name.partition(".")[0].endswith("_msgs")
    ]
    assert not wrong


def test_the_doctor_takes_of_the_nodes_what_needs_no_ros() -> None:
    taken = {
        name.split(".")[2]
        for path in _sources("doctor")
        for name in _imports(path)
        if name.startswith("semcal_ros.nodes.")
    }
    assert taken == FROM_NODES
    for part in taken:
        done = _run(
            BLOCKER.partition("import semcal_ros.core")[0] + f"import semcal_ros.nodes.{part}"
        )
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
        for name in _imports(path)
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
