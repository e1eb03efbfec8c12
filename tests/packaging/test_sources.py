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

"""House rules that a reader relies on: what a package offers, one version, every dependency declared."""

from __future__ import annotations

import importlib.metadata
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree

import pytest
import yaml

import semcal_ros
from tests.helpers.project import NODES, PYPROJECT, ROOT, runtime_imports

PACKAGE = ROOT / "semcal_ros"
MODULES = sorted(PACKAGE.rglob("*.py"))
# Packages of ROS come from a distribution or from requirements/ros-*.txt.
ROS = re.compile(r"rclpy|rcl_interfaces|ament_index_python|std_srvs|launch\w*|\w+_msgs")
# Distributions that rosdep cannot install, as package.xml says.
NO_ROSDEP_KEY = {"apsw", "av", "backports.zstd", "pydantic", "tifffile"}
ROSDEP_KEYS = {
    "opencv-python-headless": "python3-opencv",
    "pillow": "python3-pil",
    "pyyaml": "python3-yaml",
    "rosbags": "python3-rosbags-pip",
    "trimesh": "python3-trimesh-pip",
}

# Keys that rosdep/python.yaml of rosdistro had in August 2026, for Ubuntu 24.04. Look there before adding one.
RESOLVED_KEYS = {
    *(
        "python3-click",
        "python3-hypothesis",
        "python3-jinja2",
        "python3-joblib",
        "python3-jsonschema",
    ),
    *("python3-matplotlib", "python3-numpy", "python3-opencv", "python3-packaging", "python3-pil"),
    *("python3-pytest", "python3-pytest-timeout", "python3-rosbags-pip", "python3-ruamel.yaml"),
    *("python3-scipy", "python3-tqdm", "python3-trimesh-pip", "python3-yaml"),
}


def test_packages_say_what_is_public() -> None:
    """Where a package offers names, ``__all__`` lists them. In a module, an underscore says what is private."""
    silent = []
    for path in PACKAGE.rglob("__init__.py"):
        text = path.read_text(encoding="utf-8")
        offers = re.search(r"^(?:from semcal_ros|def |class )", text, re.MULTILINE)
        if offers and "\n__all__ = " not in text:
            silent.append(str(path.relative_to(ROOT)))
    assert silent == []


@pytest.mark.slow
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


def test_all_versions_agree() -> None:
    package_xml = ElementTree.parse(ROOT / "package.xml").findtext("version")
    changelog = (ROOT / "CHANGELOG.rst").read_text(encoding="utf-8")
    released = re.findall(r"^(\d+\.\d+\.\d+) \(", changelog, re.MULTILINE)
    citation = re.findall(
        r"^version: (\S+)$", (ROOT / "CITATION.cff").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert [semcal_ros.__version__] == citation
    assert semcal_ros.__version__ == package_xml == released[0]


def test_package_xml_says_the_same_as_pyproject() -> None:
    project, package = PYPROJECT["project"], ElementTree.parse(ROOT / "package.xml").getroot()
    assert package.findtext("name") == project["name"]
    for tag, key in (("maintainer", "maintainers"), ("author", "authors")):
        people = [{"name": p.text, "email": p.get("email")} for p in package.iter(tag)]
        assert people == project[key]
    assert {url.text for url in package.iter("url")} <= set(project["urls"].values())


def test_the_executables_are_the_modules_with_a_main() -> None:
    modules = {
        path.stem
        for path in (PACKAGE / "nodes").rglob("*.py")
        if "\ndef main(" in path.read_text(encoding="utf-8")
    }
    assert modules == set(NODES)
    targets = PYPROJECT["project"]["entry-points"]["semcal_ros.nodes"]
    assert targets == {node: f"semcal_ros.nodes.start:{node}" for node in NODES}


def _declared() -> set[str]:
    """Names of the distributions that pyproject.toml asks for, in lower case."""
    return _names(PYPROJECT["project"]["dependencies"])


def _names(requirements: list[str]) -> set[str]:
    return {re.split(r"[\s<>=!;\[]", requirement)[0].lower() for requirement in requirements}


def test_every_import_is_declared_and_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    # Setuptools, once imported, adds copies of packages of its own.
    monkeypatch.setattr(sys, "path", [folder for folder in sys.path if "_vendor" not in folder])
    homes = importlib.metadata.packages_distributions()
    standard = sys.stdlib_module_names | {"semcal_ros", "compression"}  # the latter: Python 3.14
    imported = {name.partition(".")[0] for path in MODULES for name in runtime_imports(path)}
    needed = {n for n in imported - standard if not ROS.fullmatch(n)}
    extras = PYPROJECT["project"]["optional-dependencies"]
    optional = set().union(*(_names(extras[name]) for name in extras.keys() - {"test"}))
    assert {home.lower() for n in needed for home in homes[n]} == _declared() | optional


def test_declared_dependencies_have_exact_versions() -> None:
    pinned = (ROOT / "requirements" / "base.txt").read_text(encoding="utf-8").lower()
    assert [name for name in _declared() if not re.search(rf"(?m)^{name}==", pinned)] == []


def test_package_xml_names_what_pyproject_asks_for() -> None:
    depends = {node.text for node in ElementTree.parse(ROOT / "package.xml").iter("exec_depend")}
    keys = {ROSDEP_KEYS.get(name, f"python3-{name}") for name in _declared() - NO_ROSDEP_KEY}
    assert keys == {name for name in depends if name and name.startswith("python3-")}


def test_rosdep_knows_every_key() -> None:
    root = ElementTree.parse(ROOT / "package.xml").getroot()
    keys = {str(node.text) for node in root if node.tag.endswith("depend")}
    assert {key for key in keys if key.startswith("python3-")} <= RESOLVED_KEYS
    assert not {key for key in keys if not ROS.fullmatch(key)} - RESOLVED_KEYS


def test_package_xml_names_what_tests_need() -> None:
    """colcon finds them in pyproject.toml, rosdep in package.xml."""
    asked = PYPROJECT["project"]["optional-dependencies"]["test"]
    keys = {node.text for node in ElementTree.parse(ROOT / "package.xml").iter("test_depend")}
    assert keys == {f"python3-{re.split('[<>=]', name)[0]}" for name in asked}


def test_the_pages_for_docs_ros_org_have_a_configuration() -> None:
    (name,) = {node.text for node in ElementTree.parse(ROOT / "package.xml").iter("rosdoc2")}
    head, settings = yaml.safe_load_all((ROOT / str(name)).read_text(encoding="utf-8"))
    assert head == {"type": "rosdoc2 config", "version": 1}
    assert (ROOT / settings["settings"]["python_source"]).is_dir()


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
