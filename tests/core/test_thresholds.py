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

"""Tables of thresholds: all numbers of a room that has one stand in it, each with a unit and a source."""

from __future__ import annotations

import ast
import importlib
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.thresholds import Source, Table, sigmas_of_chance
from tests.helpers.project import ROOT, load_script

PACKAGE = ROOT / "semcal_ros"
FLOORS = ("core", "applications", "synthetic")
TABLES = sorted(path for floor in FLOORS for path in (PACKAGE / floor).rglob("thresholds.py"))
# That of core is what a table is.
ROOMS = [path.parent for path in TABLES if path.parent != PACKAGE / "core"]
# A room with no more numbers than these may keep each beside its use.
FEW = 4
# Geometry and indices, nothing that could be otherwise: from a cell to its four neighbours; the unit matrix.
NO_THRESHOLDS = {
    *("STEPS", "_IDENTITY", "_MIRROR", "_PAIRS", "_SCALE"),
    # Sizes of the parts of the state.
    *("MOTION_SIZE", "BASE_SIZE", "KEYFRAME_SIZE"),
}
# Changes the rows of a room in turn.
THRESHOLDS = "benchmarks.thresholds"
house = load_script("house")


def _name(room: Path) -> str:
    return room.relative_to(PACKAGE).as_posix()


@pytest.fixture(params=ROOMS, ids=_name)
def room(request: pytest.FixtureRequest) -> Path:
    return request.param


def _table(room: Path) -> tuple[ModuleType, Table]:
    module = importlib.import_module(".".join(room.relative_to(ROOT).parts) + ".thresholds")
    return module, module.TABLE


def _modules(room: Path) -> list[Any]:
    """The modules of a room, without those of the rooms in it."""
    return [
        m
        for m in house.read_modules(ROOT, _name(room))
        if m.path.count("/") == _name(room).count("/") + 1
    ]


def test_no_number_of_the_room_stands_elsewhere(room: Path) -> None:
    named = {m.path: {name for name, _, _ in house.find_constants(m)} for m in _modules(room)}
    rows = list(_table(room)[1])
    assert len(named.pop(f"{_name(room)}/thresholds.py")) == len(rows) > FEW
    assert {p: names for p, names in named.items() if names - NO_THRESHOLDS} == {}


def test_defaults_of_settings_stand_in_the_table() -> None:
    """Of the classes ``...Settings`` of the method: a number that a caller may change has a source, too."""
    found, beside = set(), []
    for module in house.read_modules(ROOT, "core"):
        for own in ast.walk(module.tree):
            if not (isinstance(own, ast.ClassDef) and own.name.endswith("Settings")):
                continue
            found.add(own.name)
            beside += [
                f"{module.path}: {ast.unparse(field.target)}"
                for field in own.body
                if isinstance(field, ast.AnnAssign) and field.value is not None
                for part in ast.walk(field.value)
                if isinstance(part, ast.Constant) and type(part.value) in (int, float)
            ]
    assert {"DriftSettings", "RegistrationSettings"} <= found
    assert beside == []


def test_numbers_without_a_table_are_few_and_say_their_source() -> None:
    found: dict[str, list[tuple[str, str]]] = {}
    for module in (m for floor in FLOORS for m in house.read_modules(ROOT, floor)):
        place = module.path.rpartition("/")[0]
        if PACKAGE / place not in ROOMS:
            found.setdefault(place, []).extend(
                (name, kind) for name, _, kind in house.find_constants(module)
            )
    assert {place: len(rows) for place, rows in found.items() if len(rows) > FEW} == {}
    kinds = {source.value for source in Source}
    assert [name for rows in found.values() for name, kind in rows if kind not in kinds] == []


def test_every_number_is_used_and_has_a_unit_and_a_source(room: Path) -> None:
    module, table = _table(room)
    name = module.__name__
    used = {
        alias.name
        for path in PACKAGE.rglob("*.py")
        if name in (text := path.read_text(encoding="utf-8"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.ImportFrom) and node.module == name
        for alias in node.names
    }
    for row in table:
        assert getattr(module, row.name) is row.value
        said = (
            row.text.removesuffix(")").rpartition(" (")[0]
            if row.source is Source.MEASURED
            else row.text
        )
        assert row.unit and said.endswith((".", ",")), row
        # One number may be the start of another.
        assert row.name in used or _uses(module, row.name) > 1, row


def _uses(module: ModuleType, name: str) -> int:
    tree = ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8"))
    return sum(isinstance(node, ast.Name) and node.id == name for node in ast.walk(tree))


def test_a_measured_number_names_a_command_that_exists_and_a_year(room: Path) -> None:
    module, table = _table(room)
    for row in table:
        if row.source is not Source.MEASURED:
            continue
        found = re.search(r"\(python -m ([\w.]+)(?: (\w+))?[^()]*\)$", row.text)
        assert found, row
        command, of_room = found.groups()
        path = ROOT / command.replace(".", "/")
        assert path.with_suffix(".py").exists() or (path / "__main__.py").exists(), row
        assert re.search(r"\b20\d\d\b", row.text), row
        if command == THRESHOLDS:
            own = importlib.import_module(f"{THRESHOLDS}.__main__").ROOMS[of_room]
            assert module.__name__ == f"semcal_ros.{own.table}.thresholds", row


def test_a_name_stands_once_and_a_command_with_what_it_shows() -> None:
    table = Table()
    assert table.measured("A", 2.5, "px", "Seen at most", command="python -m this") == 2.5
    (row,) = table
    assert row.source is Source.MEASURED and row.text == "Seen at most (python -m this)"
    with pytest.raises(InvalidValueError, match="two thresholds A"):
        table.stated("A", 3, "px", "Again.")


def test_sigmas_are_the_quantiles_of_the_normal_distribution() -> None:
    # Tables: 1.96 sigmas for 5 % on both sides, 3.09 for one in a thousand on one.
    assert sigmas_of_chance(0.05) == pytest.approx(1.959964, abs=1e-6)
    assert sigmas_of_chance(1e-3, sides=1) == pytest.approx(3.090232, abs=1e-6)


def test_the_page_counts_the_sources_of_each_room() -> None:
    kinds = [
        Source.DERIVED,
        Source.MEASURED,
        Source.DEFINED,
        Source.COST,
        Source.STATED,
    ]
    page = (ROOT / "doc" / "thresholds.md").read_text(encoding="utf-8")
    stated = {
        cells[0].strip("`"): [int(cell) for cell in cells[1:]]
        for line in page.splitlines()
        if len(cells := [cell.strip() for cell in line.strip("|").split("|")]) == 1 + len(kinds)
        and all(cell.isdigit() for cell in cells[1:])
    }
    counts = {
        _name(own): [sum(row.source is kind for row in _table(own)[1]) for kind in kinds]
        for own in ROOMS
    }
    together = [sum(column) for column in zip(*counts.values(), strict=True)]
    assert stated == {**counts, "together": together}
