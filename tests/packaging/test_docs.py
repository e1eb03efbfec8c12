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

"""What README and doc/ claim: links, commands, executables, parameters, keys, and a snippet that runs."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import sys
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pytest

# rclpy imports a parser whose dependency uses modules that Python 3.11 deprecates; only the import is excused.
with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)
    from rclpy.node import Node


from semcal_ros.bridge.continuous_parameters import PARAMETER_KINDS
from semcal_ros.core.camera.projection import ALL_NAMES
from semcal_ros.nodes.common import base
from semcal_ros.nodes.common.parameters import ParameterDeclaration
from semcal_ros.synthetic import preset
from tests.helpers.node_scenes import make_calibration
from tests.helpers.project import NODES, ROOT, load_script

DOC = ROOT / "doc"
PAGES = [ROOT / "README.md", *sorted(DOC.rglob("*.md"))]
ROOTS = (ROOT, ROOT / "semcal_ros")
FOLDERS = {path.name for root in ROOTS for path in root.iterdir() if path.is_dir()}
COMMANDS = {
    path.stem.removesuffix("_command")
    for path in (ROOT / "semcal_ros" / "cli").glob("*_command.py")
}
_FENCE = re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL)


def _text(name: str) -> str:
    return (DOC / name).read_text(encoding="utf-8")


def _prose(path: Path) -> str:
    return _FENCE.sub("", path.read_text(encoding="utf-8"))


def _anchors(path: Path) -> set[str]:
    """Anchors of the headings, made as GitHub makes them."""
    headings = re.findall(r"^#+ (.+)$", _prose(path), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h.lower()).strip().replace(" ", "-") for h in headings}


def _name(path: Path) -> str:
    return str(path.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_relative_links_resolve(page: Path) -> None:
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", _prose(page)):
        if re.match(r"[a-z]+:", target):
            continue
        file, _, anchor = target.partition("#")
        found = (page.parent / file).resolve() if file else page
        if not found.exists() or (anchor and anchor not in _anchors(found)):
            broken.append(target)
    assert not broken


def test_named_files_and_modules_exist() -> None:
    """Paths in code style, from the root or from the package, and what `python -m` is told to run."""
    missing = []
    for page in [*PAGES, ROOT / "CONTRIBUTING.md"]:
        text = page.read_text(encoding="utf-8")
        missing += [
            f"{page.name}: {path}"
            for path in re.findall(r"`((?:[\w.]+/)+[\w.]*)`", text)
            if path.partition("/")[0] in FOLDERS and not any((r / path).exists() for r in ROOTS)
        ]
        for module in re.findall(r"python -m ((?:benchmarks|examples|semcal_ros)[\w.]*)", text):
            base = ROOT / module.replace(".", "/")
            if not base.with_suffix(".py").exists() and not (base / "__main__.py").exists():
                missing.append(f"{page.name}: python -m {module}")
    assert missing == []


def test_docstrings_cite_pages_and_headings_that_exist() -> None:
    """As ``doc/page.md``, or ``doc/page.md``, "Heading"."""
    missing = []
    for path in (ROOT / "semcal_ros").rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for page, heading in re.findall(r'``(doc/[\w./]+)``(?:, "([^"\n]+)")?', text):
            cited = ROOT / page
            lines = cited.read_text(encoding="utf-8").splitlines() if cited.exists() else [""]
            titles = {line.lstrip("#").strip() for line in lines if line.startswith("#")}
            if not titles or (heading and heading not in titles):
                missing.append(f"{path.name}: {page} {heading}")
    assert missing == []


def _resolves(name: str) -> bool:
    """Whether a dotted name is a module, or what one has."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            # Fields of a dataclass without a default are annotations only.
            if part not in getattr(found, "__annotations__", {}):
                found = getattr(found, part, None)
        return found is not None
    return False


def test_cross_references_of_docstrings_lead_somewhere() -> None:
    role = re.compile(r":(?:mod|class|func|meth|data|attr|exc):`~?(semcal_ros[\w.]*)`")
    named = {
        name: path.relative_to(ROOT)
        for path in (ROOT / "semcal_ros").rglob("*.py")
        for name in role.findall(path.read_text(encoding="utf-8"))
    }
    assert len(named) > 50
    assert {name: path for name, path in named.items() if not _resolves(name)} == {}
    assert not _resolves("semcal_ros.core.calibration.joint")


def test_the_page_of_flows_names_modules_that_exist() -> None:
    """With or without their folders, as `live_drift.py` or `nodes/frames/live_drift.py`."""
    text = (ROOT / "doc" / "how_it_runs.md").read_text(encoding="utf-8")
    paths = [p.as_posix() for p in (ROOT / "semcal_ros").rglob("*.py")]
    paths += [p.as_posix() for p in (ROOT / "tests").rglob("*.py")]
    named = set(re.findall(r"[\w/]+\.py\b", text))
    assert len(named) > 50
    assert {name for name in named if not any(p.endswith(f"/{name}") for p in paths)} == set()


@pytest.mark.parametrize("page", PAGES, ids=_name)
def test_named_commands_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    # A command is named in code: after a backtick, a prompt, an indentation or a heading.
    named = set(re.findall(r"(?:`|\$ |^    |^## )semcal ([a-z]+)\b", text, re.MULTILINE))
    assert named <= COMMANDS


def test_every_command_is_described() -> None:
    headings = re.findall(r"^## semcal ([\w-]+)$", _text("cli.md"), re.MULTILINE)
    described = {name.replace("-", "_") for name in headings}
    assert described == COMMANDS


def _options_of(command: str) -> set[str]:
    """Options of a command and of the commands in it."""
    module = importlib.import_module(f"semcal_ros.cli.{command}_command")
    parts = [module.command, *getattr(module.command, "commands", {}).values()]
    return {name for part in parts for option in part.params for name in option.opts}


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_every_option_is_described(command: str) -> None:
    text = _text("cli.md")
    options = {name for name in _options_of(command) if "--" in name}
    # Those of the introduction: the output is in every example.
    options -= {"--output"}
    assert {name for name in options if name not in text} == set()


def test_the_tables_of_options_are_those_of_the_commands() -> None:
    scripts = load_script("option_tables")
    page = _text("cli.md")
    assert len(scripts.TABLE.findall(page)) >= 4
    assert scripts.write_tables(page) == page, "run python scripts/option_tables.py"


def test_named_options_exist() -> None:
    """Options in the examples and descriptions of the command line."""
    known = {"--help", "--version"}
    # Of `dask worker`, and of a benchmark that is named by its folder.
    others = {"--nthreads", "--nworkers", "--reference"}
    for command in COMMANDS:
        known |= _options_of(command)
    text = "".join(_text(name) for name in ("cli.md", "calibration.md", "sem_tiff.md", "paper.md"))
    # A benchmark has options of its own.
    text = re.sub(r"python -m benchmarks[^`\n]*", "", text)
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]+", text)) <= known | others


def test_the_nodes_are_those_of_the_package() -> None:
    text = _text("nodes.md")
    table = re.findall(r"^\| \[`(\w+)`\]\(#\w+\)", text, re.MULTILINE)
    sections = [h for h in re.findall(r"^## (\w+)$", text, re.MULTILINE) if "_" in h or h in NODES]
    run = re.findall(r"ros2 run semcal_ros (\w+)", "".join(p.read_text("utf-8") for p in PAGES))
    assert len(NODES) == 10
    assert sorted(table) == sorted(sections) == sorted(NODES)
    assert set(run) <= set(NODES)


class _Captured(Exception):
    """Ends the construction of a node once its parameters are known."""


def _settings_of(node: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, ParameterDeclaration]:
    """What a node declares, without ROS at work."""
    kind = base.node_class(node)
    captured: dict[str, ParameterDeclaration] = {}

    def capture(_node: Any, declarations: Iterable[ParameterDeclaration]) -> None:
        captured.update({declaration.name: declaration for declaration in declarations})
        raise _Captured

    monkeypatch.setattr(Node, "__init__", lambda *_args, **_kwargs: None)
    monkeypatch.setattr(base, "Parameters", capture)
    with pytest.raises(_Captured):
        kind()
    return captured


def _section(text: str, heading: str) -> str:
    return text.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]


@pytest.mark.parametrize("node", NODES)
def test_every_parameter_is_described(node: str, monkeypatch: pytest.MonkeyPatch) -> None:
    text = _text("nodes.md")
    described = _section(text, node) + _section(text, "Parameters of all nodes")
    settings = _settings_of(node, monkeypatch)
    assert set(settings) >= {"config"}
    assert [name for name in settings if f"`{name}`" not in described] == []


@pytest.mark.parametrize("node", NODES)
def test_described_choices_are_those_of_the_code(
    node: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    section = _section(_text("nodes.md"), node)
    for name, setting in _settings_of(node, monkeypatch).items():
        row = re.search(rf"^\| [^|]*`{name}`[^|]*\|(.*)$", section, re.MULTILINE)
        if row is None or "as for" in row.group(1):
            continue  # described in prose, or at another node
        assert [choice for choice in setting.choices if f"`{choice}`" not in row.group(1)] == []
        if setting.fixed:
            assert "*start*" in row.group(1), f"{name} is only read at start"


@pytest.mark.parametrize("node", NODES)
def test_described_defaults_are_those_of_the_code(
    node: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    section = _section(_text("nodes.md"), node)
    compared = 0
    for name, setting in _settings_of(node, monkeypatch).items():
        row = re.search(rf"^\| `{name}` \| ([^|]+) \|", section, re.MULTILINE)
        if row is None or not (described := row.group(1).strip()):
            continue  # described with others, in prose, or at another node
        default = setting.default
        if isinstance(default, bool | str):
            code = str(default).lower() if isinstance(default, bool) else default or "empty"
            assert described.strip("`") in (code, "required"), name
        else:
            # A unit may follow.
            assert float(described.split()[0]) == pytest.approx(default, rel=1e-3), name
        compared += 1
    assert compared or node in ("rectifier", "drift_compensator")


def test_the_diagnostic_keys_are_those_of_the_code() -> None:
    section = _section(_text("nodes.md"), "Diagnostics")
    described = {
        key.partition(".")[0]
        for row in re.findall(r"^\| (`.+?`) \|", section, re.MULTILINE)
        for key in re.findall(r"`([^`]+)`", row)
    }
    files = [*(ROOT / "semcal_ros/nodes").rglob("*.py"), ROOT / "semcal_ros/bridge/diagnostics.py"]
    code = "".join(path.read_text(encoding="utf-8") for path in files)
    noted = set(re.findall(r'\.note\(\s*f?"(\w+)', code)) | set(
        re.findall(r'^ +\("(drift_\w+)", ', code, re.MULTILINE)
    )
    assert noted <= described
    assert {key for key in described if f'"{key}' not in code} == set()


def test_every_continuous_parameter_is_described() -> None:
    section = _section(_text("nodes.md"), "parameter_server")
    assert [kind for kind in PARAMETER_KINDS if f"| `{kind}` |" not in section] == []


def test_every_key_of_the_calibration_file_is_described() -> None:
    schema = json.loads(
        (ROOT / "semcal_ros/files/calibration.schema.json").read_text(encoding="utf-8")
    )
    keys = {
        *schema["properties"],
        *schema["properties"]["functions"]["required"],
        *schema["properties"]["covariance"]["properties"],
        *schema["$defs"]["function"]["properties"],
        *schema["$defs"]["function"]["properties"]["kind"]["enum"],
    }
    text = _text("calibration_file.md")
    assert {key for key in keys if f"`{key}`" not in text} == set()


@pytest.mark.parametrize("page", ["model.md", "calibration_file.md"])
def test_every_parameter_of_the_camera_is_described(page: str) -> None:
    text = _text(page)
    named = set(re.findall(r"`(\w+)`", text))
    for stem, first, last in re.findall(r"`(\w+)(\d)` to `\1(\d)`", text):
        named |= {f"{stem}{k}" for k in range(int(first), int(last) + 1)}
    if page == "calibration_file.md":
        named |= {"m"}  # relative to its nominal value there, as `scale`
    assert set(ALL_NAMES) - named == set()


def test_the_preset_beside_the_paper_is_that_of_the_code() -> None:
    section = _section(_text("paper.md"), "The preset `jsm820`")
    stated = {
        name: [float(number) for number in re.findall(r"\d+\.?\d*", cell.rpartition(": ")[2])]
        for name, cell in re.findall(r"^\| (\w+)[^|]*\|[^|]*\| ([^|]*?) \|$", section, re.MULTILINE)
    }
    low, high = (preset("jsm820").camera_at(g) for g in (100.0, 10000.0))
    for name, field, digits in (
        ("e_x", "ex", 2),
        ("e_y", "ey", 2),
        ("xi_r", "xi_r", 5),
        ("xi_t", "xi_t", 6),
        ("a", "aspect", 4),
        ("s", "skew", 5),
    ):
        assert stated[name] == [round(getattr(camera, field), digits) for camera in (low, high)]
    assert stated["f"] == [round(camera.m / camera.rho) for camera in (low, high)]
    assert stated["p_x"] == [low.px, low.py] == [high.px, high.py]


def test_the_notebook_snippet_runs(tmp_path: Path) -> None:
    text = _text("python.md")
    snippets = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    (snippet,) = (s for s in snippets if "rect_from_raw" in s)
    make_calibration().save(tmp_path / "cal.yaml")
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", snippet],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert "nan" not in done.stdout


def test_the_readme_is_short_and_its_snippets_are_python() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    prose = re.sub(r"^    .*$|^\|.*$|\(https?:[^)]*\)|\([\w/.#-]*\)", "", text, flags=re.MULTILINE)
    assert len(prose.split()) < 500
    for snippet in re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL):
        compile(snippet, "README.md", "exec")
