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

"""What `scripts/house.py` counts, on a package of a few lines whose figures are known."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import pytest

from tests.helpers.project import ROOT, load_script

THRESHOLDS = '''"""The room's thresholds."""

from semcal_ros.core.thresholds import Table

__all__ = ["LEAST", "MOST"]

TABLE = Table()
LEAST = TABLE.measured("LEAST", 3.0, "px", "so many", command="a command")
MOST = TABLE.stated("MOST", 4, "1", "nothing better")
'''
FIT = '''"""A fit.

Its text is no code.
"""

from dataclasses import dataclass

from semcal_ros.core.drift.thresholds import LEAST
import semcal_ros.core.drift.thresholds

# Two numbers under one comment.
_A, _B = 1.0, (2.0, -3.0)
_C = 1 / 3
_D = 5.0  # beside it
D_OF = {"a": 1}

_E = 2**4
_OF = np.array([1.0, np.pi])
_NO = np.array([_E])
# Derived: from a formula that takes
# two lines.
_G = 6.0
_H = 7.0  # Stated: nothing better


@dataclass(frozen=True)
class Fit:
    """One."""

    value: float


@dataclass
class Other:
    def fit(self, a, b, *, c):
        """Nothing."""
        _F = 3.0
'''


@pytest.fixture(scope="module")
def house() -> ModuleType:
    return load_script("house")


def _write(root: Path) -> None:
    room = root / "semcal_ros" / "core" / "drift"
    room.mkdir(parents=True)
    (room / "__init__.py").write_text('"""The room."""\n', encoding="utf-8")
    (room / "thresholds.py").write_text(THRESHOLDS, encoding="utf-8")
    (room / "fit.py").write_text(FIT, encoding="utf-8")


def test_everything_is_counted(house: ModuleType, tmp_path: Path) -> None:
    _write(tmp_path)
    report = house.count_all(house.read_modules(tmp_path))
    assert report.figures == {
        "files": 3,
        "lines of code": 5 + 19,
        "lines of imports": 1 + 3,
        "lines of __all__": 1,
        "modules with one importer": 1,
        "constants, comment": 5,
        "constants, derived": 1,
        "constants, measured": 1,
        "constants, none": 2,
        "constants, stated": 2,
        "dataclasses in core/calibration": 0,
        "dataclasses in core/drift": 2,
        "functions with over 10 parameters": 0,
        "parameters of the longest list": 3,
    }
    assert report.one_importer == ["semcal_ros.core.drift.thresholds"]
    assert report.without_source == ["core/drift/fit.py:17 _E", "core/drift/fit.py:18 _OF"]
    assert report.longest == ["3 core/drift/fit.py:35 fit"]


def test_two_trees_stand_side_by_side(
    house: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _write(tmp_path)
    monkeypatch.setattr(house, "read_commit", lambda commit: [])
    monkeypatch.setattr(house, "ROOT", tmp_path)
    assert house.main(["--against", "0123456789", "--list"]) == 0
    text = capsys.readouterr().out
    assert text.splitlines()[0].split() == ["012345678", "now"]
    assert text.splitlines()[1].split() == ["files", "0", "3"]
    assert "\n  core/drift/fit.py:17 _E\n" in text


def test_a_commit_is_read_without_a_change_of_the_tree(house: ModuleType) -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("no repository")
    modules = house.read_commit("HEAD", "client")
    assert "client/stream.py" in {module.path for module in modules}
