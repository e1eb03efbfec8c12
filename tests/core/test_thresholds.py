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
from pathlib import Path

import pytest

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.thresholds import Source, Table
from tests.helpers.project import ROOT, load_script

CORE = ROOT / "semcal_ros" / "core"
ROOMS = sorted(path.parent for path in CORE.glob("*/thresholds.py"))
# Geometry, and nothing that could be otherwise: from a cell to its four neighbours; the unit matrix.
NO_THRESHOLDS = {"STEPS", "_IDENTITY"}


@pytest.fixture(params=ROOMS, ids=lambda room: room.name)
def room(request: pytest.FixtureRequest) -> Path:
    return request.param


def _table(room: Path) -> tuple[object, Table]:
    module = importlib.import_module(f"semcal_ros.core.{room.name}.thresholds")
    return module, module.TABLE


def test_no_number_of_the_room_stands_elsewhere(room: Path) -> None:
    house = load_script("house")
    modules = house.read_modules(ROOT, f"core/{room.name}")
    named = {m.path: {name for name, _, _ in house.find_constants(m)} for m in modules}
    rows = list(_table(room)[1])
    assert len(named.pop(f"core/{room.name}/thresholds.py")) == len(rows) > 20
    assert {p: names for p, names in named.items() if names - NO_THRESHOLDS} == {}


def test_every_number_is_used_and_has_a_unit_and_a_source(room: Path) -> None:
    used = {
        node.id
        for path in room.glob("*.py")
        if path.stem != "thresholds"
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Name)
    }
    module, table = _table(room)
    for row in table:
        assert getattr(module, row.name) is row.value
        assert row.unit and row.text.endswith((".", ",")), row
        assert row.name in used, row


def test_a_name_stands_once_and_a_command_with_what_it_shows() -> None:
    table = Table()
    assert table.measured("A", 2.5, "px", "Seen at most", command="python -m this") == 2.5
    (row,) = table
    assert row.source is Source.MEASURED and row.text == "Seen at most (python -m this)"
    with pytest.raises(InvalidValueError, match="two thresholds A"):
        table.stated("A", 3, "px", "Again.")
