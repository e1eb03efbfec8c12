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

"""A wheel and a workspace put the same things in the same places; only the executables are made differently."""

from __future__ import annotations

import configparser
import os
import re
import shutil
import subprocess
import sys
import zipfile
from email.parser import HeaderParser
from pathlib import Path

import pytest
import setuptools
from packaging.version import Version

import semcal_ros
from tests.helpers.project import NODES, PYPROJECT, ROOT

pytestmark = pytest.mark.slow

PARTS = (
    *("pyproject.toml", "setup.py", "setup.cfg", "package.xml", "README.md", "LICENSE"),
    *("resource", "launch", "config", "msg_configs", "dds", "security", "viewers", "semcal_ros"),
)
SHARED = {
    str(path.relative_to(ROOT))
    for folder in ("launch", "config", "msg_configs", "dds", "security", "viewers")
    for path in (ROOT / folder).glob("*")
    if path.is_file()
} | {"package.xml"}


@pytest.fixture
def source(tmp_path: Path) -> Path:
    """A copy of what is built: a build leaves traces in its source."""
    copy = tmp_path / "source"
    copy.mkdir()
    for part in PARTS:
        if (ROOT / part).is_dir():
            skipped = shutil.ignore_patterns("__pycache__")
            shutil.copytree(ROOT / part, copy / part, ignore=skipped)
        else:
            shutil.copy(ROOT / part, copy / part)
    return copy


def _run(folder: Path, *arguments: str) -> None:
    # Deprecations of the commands that colcon calls are none of ours.
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={k: v for k, v in os.environ.items() if k != "PYTHONWARNINGS"},
        capture_output=True,
        text=True,
        check=False,
        timeout=150,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def _entry_points(text: str) -> configparser.ConfigParser:
    parser = configparser.ConfigParser()
    parser.read_string(text)
    return parser


@pytest.mark.skipif(
    Version(setuptools.__version__) < Version("70.1"),
    reason="pip would fetch the setuptools that pyproject.toml asks for",
)
def test_a_wheel_holds_everything(source: Path, tmp_path: Path) -> None:
    pip = ("-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation")
    _run(source, *pip, "--disable-pip-version-check", "--wheel-dir", str(tmp_path), ".")
    (path,) = tmp_path.glob("*.whl")
    data = f"semcal_ros-{semcal_ros.__version__}.data/data"
    information = f"semcal_ros-{semcal_ros.__version__}.dist-info"
    with zipfile.ZipFile(path) as wheel:
        names = set(wheel.namelist())
        modes = {i.filename: i.external_attr >> 16 for i in wheel.infolist()}
        scripts = _entry_points(wheel.read(f"{information}/entry_points.txt").decode())
        metadata = HeaderParser().parsestr(wheel.read(f"{information}/METADATA").decode())
    sources = {
        str(p.relative_to(ROOT))
        for p in (ROOT / "semcal_ros").rglob("*")
        if p.is_file() and "__pycache__" not in p.parts
    }
    assert sources - names == set()
    assert {f"{data}/share/semcal_ros/{name}" for name in SHARED} - names == set()
    assert f"{data}/share/ament_index/resource_index/packages/semcal_ros" in names
    executables = {name for name in names if name.startswith(f"{data}/lib/")}
    assert executables == {f"{data}/lib/semcal_ros/{node}" for node in NODES}
    assert all(modes[name] & 0o111 for name in executables)
    assert dict(scripts["console_scripts"]) == PYPROJECT["project"]["scripts"]
    assert metadata["Version"] == semcal_ros.__version__
    assert metadata["License"] == "Apache-2.0"
    needed = [r for r in metadata.get_all("Requires-Dist", []) if "extra ==" not in r]
    assert len(needed) == len(PYPROJECT["project"]["dependencies"])


@pytest.mark.parametrize("linked", [False, True], ids=["install", "symlink-install"])
def test_a_workspace_has_all_executables_in_its_folder(
    source: Path, tmp_path: Path, linked: bool
) -> None:
    """What colcon calls; with ``--symlink-install`` in a folder of links to what setup.py names."""
    folder = source
    if linked:
        folder = tmp_path / "build"
        folder.mkdir()
        for part in set(PARTS) - {"pyproject.toml", "README.md", "LICENSE"}:
            (folder / part).symlink_to(source / part)
    prefix = tmp_path / "install"
    install = ("install", "--single-version-externally-managed", "--record", "files")
    _run(folder, "setup.py", "--quiet", *install, "--prefix", str(prefix))
    assert {p.name for p in (prefix / "lib/semcal_ros").iterdir()} == {*NODES, "semcal"}
    # A sourced workspace has this folder on its PATH, where colcon finds a file in it.
    (command,) = (prefix / "bin").iterdir()
    assert command.name == "semcal"
    assert command.samefile(prefix / "lib/semcal_ros/semcal")
    assert not command.readlink().is_absolute()
    shared = prefix / "share" / "semcal_ros"
    assert {str(p.relative_to(shared)) for p in shared.rglob("*") if p.is_file()} == SHARED
    assert (prefix / "share/ament_index/resource_index/packages/semcal_ros").is_file()
    # rosdep provides the dependencies, under names that pip does not know; those of tests are optional.
    (egg,) = (prefix / "lib").glob("python*/site-packages/*.egg-info")
    asked = (egg / "requires.txt").read_text(encoding="utf-8").strip()
    assert asked.startswith("[")
    assert set(re.findall(r"(?m)^\[(.+)\]$", asked)) == set(
        PYPROJECT["project"]["optional-dependencies"]
    )


def test_colcon_can_read_what_setup_py_says(source: Path) -> None:
    """It stops after the configuration files and reads every attribute as a Python literal."""
    code = (
        "import ast, distutils.core as c\n"
        "d = c.run_setup('setup.py', stop_after='config')\n"
        "values = {**d.__dict__, **d.metadata.__dict__}\n"
        "names = 'name version packages package_data data_files entry_points install_requires'\n"
        "for n in (*names.split(), 'python_requires', 'license'):\n"
        "    assert ast.literal_eval(repr(values[n])), n\n"
        "required = ast.literal_eval(repr(values['extras_require']))['test']\n"
        "assert 'pytest' in {r.partition('>')[0] for r in required}  # else colcon runs no tests\n"
        "assert 'semcal_ros.core.drift' in d.packages\n"
    )
    _run(source, "-W", "ignore", "-c", "import setuptools\n" + code)
