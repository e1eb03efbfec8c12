"""House rules that a reader relies on: small modules, explicit __all__, one version."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

import semcal_ros

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = ROOT / "semcal_ros"
MODULES = sorted(PACKAGE.rglob("*.py"))


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("path", MODULES, ids=_name)
def test_a_module_is_short(path: Path) -> None:
    limit = 250 if "nodes" in path.relative_to(PACKAGE).parts else 400
    assert len(path.read_text(encoding="utf-8").splitlines()) < limit


@pytest.mark.parametrize(
    "path",
    [path for path in MODULES if not path.stem.startswith("_") or path.stem == "__init__"],
    ids=_name,
)
def test_a_public_module_says_what_it_offers(path: Path) -> None:
    tree = ast.parse(path.read_text(encoding="utf-8"))
    if all(isinstance(node, ast.Expr) for node in tree.body):
        return  # only a docstring: a folder of modules
    names = {
        target.id
        for node in tree.body
        if isinstance(node, ast.Assign | ast.AnnAssign)
        for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
        if isinstance(target, ast.Name)
    }
    body = [
        node
        for node in tree.body
        if not isinstance(node, ast.Expr)
        and not (isinstance(node, ast.ImportFrom) and node.module == "__future__")
    ]
    assert "__all__" in names or not body


@pytest.mark.parametrize("folder", ["benchmarks", "examples"])
def test_scripts_find_what_they_import(folder: str) -> None:
    """Benchmarks are not run here, so that a name that has moved would be noticed late."""
    names = sorted(
        ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for path in (ROOT / folder).rglob("*.py")
    )
    command = [sys.executable, "-W", "error", "-c", f"import {', '.join(names)}"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def _version_of_setup() -> str:
    tree = ast.parse((ROOT / "setup.py").read_text(encoding="utf-8"))
    for node in tree.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "VERSION":
            return str(ast.literal_eval(node.value))
    raise AssertionError("setup.py assigns no VERSION")


def test_all_versions_agree() -> None:
    package_xml = ElementTree.parse(ROOT / "package.xml").findtext("version")
    released = re.findall(
        r"^(\d+\.\d+\.\d+) \(", (ROOT / "CHANGELOG.rst").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert _version_of_setup() == semcal_ros.__version__ == package_xml == released[0]


def test_package_xml_names_what_ros_imports_need() -> None:
    depends = {node.text for node in ElementTree.parse(ROOT / "package.xml").iter("exec_depend")}
    imported = {
        name
        for path in [*(PACKAGE / "nodes").rglob("*.py"), *(ROOT / "launch").glob("*.py")]
        for name in re.findall(
            r"^\s*(?:from|import) (\w+_msgs|std_srvs|rcl_interfaces|rclpy|launch\w*)",
            path.read_text(encoding="utf-8"),
            re.MULTILINE,
        )
    }
    assert imported, "no node imports ROS: the pattern is wrong"
    assert imported <= depends
