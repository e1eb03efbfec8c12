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
from pathlib import Path

import pytest

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.tables import DRIFT_COLUMNS, write_csv


def test_values_read_back_exactly(tmp_path: Path) -> None:
    path = tmp_path / "drift.csv"
    row = (1_700_000_000_123_456_789, 1 / 3, -2e-9, None, 0.1, 1.5, 2.5, "coasting: a, b")
    write_csv(path, DRIFT_COLUMNS, [row])
    with path.open(newline="") as stream:
        (read,) = csv.DictReader(stream)
    assert int(read["stamp_ns"]) == row[0]
    assert float(read["dx_m"]) == 1 / 3
    assert read["sigma_x_m"] == "nan"
    assert read["status"] == "coasting: a, b"


def test_bad_row_keeps_the_old_table(tmp_path: Path) -> None:
    path = tmp_path / "drift.csv"
    write_csv(path, ("a",), [(1,)])
    with pytest.raises(InvalidValueError, match="row of 2"):
        write_csv(path, ("a",), [(1, 2)])
    assert path.read_text() == "a\n1\n"
