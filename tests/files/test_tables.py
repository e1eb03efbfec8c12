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

"""CSV tables keep full precision and are written completely or not at all."""

from __future__ import annotations

import csv
import math
import sys
from pathlib import Path

import openpyxl
import pytest
from pyarrow import parquet

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.tables import DRIFT_COLUMNS, write_table


def test_values_read_back_exactly(tmp_path: Path) -> None:
    path = tmp_path / "drift.csv"
    row = (
        1_700_000_000_123_456_789,
        1 / 3,
        -2e-9,
        None,
        0.1,
        1.5,
        2.5,
        0.01,
        0.02,
        "coasting: a, b",
        0.5,
        -0.25,
    )
    write_table(path, DRIFT_COLUMNS, [row])
    with path.open(newline="") as stream:
        (read,) = csv.DictReader(stream)
    assert int(read["stamp_ns"]) == row[0]
    assert float(read["dx_m"]) == 1 / 3
    assert read["sigma_x_m"] == "nan"
    assert read["status"] == "coasting: a, b"


def test_bad_row_keeps_the_old_table(tmp_path: Path) -> None:
    path = tmp_path / "drift.csv"
    write_table(path, ("a",), [(1,)])
    with pytest.raises(InvalidValueError, match="row of 2"):
        write_table(path, ("a",), [(1, 2)])
    assert path.read_text() == "a\n1\n"


_ROW = (
    1_700_000_000_123_456_789,
    1 / 3,
    -2e-9,
    None,
    math.nan,
    1.5,
    2.5,
    0.01,
    0.02,
    "coasting: a, b",
    0.5,
    -0.25,
)


def test_a_parquet_table_keeps_numbers_as_numbers(tmp_path: Path) -> None:
    write_table(tmp_path / "drift.parquet", DRIFT_COLUMNS, [_ROW, _ROW])
    table = parquet.read_table(tmp_path / "drift.parquet")
    assert table.column_names == list(DRIFT_COLUMNS)
    first = table.to_pylist()[0]
    assert first["stamp_ns"] == _ROW[0]
    assert first["dx_m"] == 1 / 3
    assert first["sigma_x_m"] is None
    assert math.isnan(first["sigma_y_m"])


def test_an_excel_table_loses_no_digit_of_a_stamp(tmp_path: Path) -> None:
    write_table(tmp_path / "drift.xlsx", DRIFT_COLUMNS, [_ROW])
    names, values = openpyxl.load_workbook(tmp_path / "drift.xlsx").active.values
    assert names == DRIFT_COLUMNS
    # As a number, Excel would show 1700000000123456768.
    assert values[0] == str(_ROW[0])
    assert values[1] == 1 / 3
    assert values[3] is None
    assert values[4] is None


def test_an_empty_table_has_its_columns(tmp_path: Path) -> None:
    for suffix in (".csv", ".parquet", ".xlsx"):
        write_table(tmp_path / f"t{suffix}", ("a", "b"), [])
    assert parquet.read_table(tmp_path / "t.parquet").column_names == ["a", "b"]


def test_other_suffixes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidValueError, match=r"expected a name that ends in .csv, .parquet"):
        write_table(tmp_path / "drift.txt", ("a",), [(1,)])
    assert not list(tmp_path.iterdir())


def test_a_missing_library_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    with pytest.raises(InvalidValueError, match=r"pip install 'semcal_ros\[tables\]'"):
        write_table(tmp_path / "drift.xlsx", ("a",), [(1,)])
    assert not list(tmp_path.iterdir())
