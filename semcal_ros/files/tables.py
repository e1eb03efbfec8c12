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

"""Tables as CSV, Parquet and Excel files, written and read."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.atomic import atomic_write_bytes
from semcal_ros.text_files import read_text_file

DRIFT_COLUMNS = (
    "stamp_ns",
    "dx_m",
    "dy_m",
    "sigma_x_m",
    "sigma_y_m",
    "dx_px",
    "dy_px",
    "sigma_x_px",
    "sigma_y_px",
    "status",
    "correlation_m",
    "correlation_px",
)
"""Columns of ``drift.csv``."""

SIMILARITY_COLUMNS = ("rotation_rad", "sigma_rotation_rad", "log_scale", "sigma_log_scale")
"""Further columns of ``drift.csv`` where the image turns or its scale creeps."""

Rows = Sequence[Sequence[object]]

# Excel computes with 53 bits: a longer whole number, such as a stamp in ns, keeps its digits as text only.
_EXCEL_WHOLE = 2**53
# A table of pixel sizes or drifts has some hundred kilobytes; what is longer is something else.
_MOST_BYTES = 64 * 2**20


def _cell(value: object) -> str:
    """Format a value so that it reads back the same; None is written as ``nan``."""
    if value is None:
        return "nan"
    return repr(float(value)) if isinstance(value, float) else str(value)


def _encode_csv(columns: Sequence[str], rows: Rows) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_cell(value) for value in row] for row in rows)
    return text.getvalue().encode("utf-8")


def _encode_parquet(columns: Sequence[str], rows: Rows) -> bytes:
    import pyarrow
    from pyarrow import parquet

    cells = list(zip(*rows, strict=True)) or [()] * len(columns)
    table = pyarrow.table(
        {name: pyarrow.array(values) for name, values in zip(columns, cells, strict=True)}
    )
    file = io.BytesIO()
    parquet.write_table(table, file)
    return file.getvalue()


def _excel_cell(value: object) -> object:
    if isinstance(value, float):
        # Excel has neither; an empty cell is left out of its sums and charts.
        return float(value) if math.isfinite(value) else None
    return str(value) if isinstance(value, int) and abs(value) > _EXCEL_WHOLE else value


def _encode_excel(columns: Sequence[str], rows: Rows) -> bytes:
    from openpyxl import Workbook
    from openpyxl.styles import Font

    book = Workbook()
    sheet = book.active
    sheet.append(list(columns))
    for cell in sheet[1]:
        cell.font = Font(bold=True)
    sheet.freeze_panes = "A2"
    for row in rows:
        sheet.append([_excel_cell(value) for value in row])
    file = io.BytesIO()
    book.save(file)
    return file.getvalue()


_ENCODERS: Mapping[str, Callable[[Sequence[str], Rows], bytes]] = MappingProxyType(
    {".csv": _encode_csv, ".parquet": _encode_parquet, ".xlsx": _encode_excel}
)
#: Suffixes of the tables that can be written.
TABLE_SUFFIXES = tuple(_ENCODERS)
_LIBRARIES = {".parquet": "pyarrow", ".xlsx": "openpyxl"}


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a table completely or not at all, in the format that the suffix names.

    CSV and Parquet keep every number as it is; Excel gets whole numbers beyond 2**53 as text, and empty
    cells for what is not finite.

    Parameters
    ----------
    path
        ``.csv``, ``.parquet`` (which needs pyarrow) or ``.xlsx`` (which needs openpyxl).
    columns
        Names of the columns.
    rows
        Numbers, texts, or None for what is not known.

    Raises
    ------
    InvalidValueError
        The suffix is another one, its library is missing, or the number of values in a row differs from
        the number of columns.
    OSError
        The file cannot be written; an existing one is untouched.
    """
    encode = _ENCODERS.get(path.suffix.lower())
    if encode is None:
        raise InvalidValueError(
            f"{path} for a table", expected="a name that ends in " + ", ".join(TABLE_SUFFIXES)
        )
    listed = [tuple(row) for row in rows]
    for row in listed:
        if len(row) != len(columns):
            raise InvalidValueError(f"a row of {len(row)} values", expected=f"{len(columns)}")
    try:
        data = encode(columns, listed)
    except ImportError as error:
        raise InvalidValueError(
            f"{path} without {_LIBRARIES[path.suffix.lower()]}: {error}",
            expected="the library that writes it",
            do="pip install 'semcal_ros[tables]', or name the table .csv",
        ) from error
    atomic_write_bytes(path, data)


def read_table(path: Path) -> tuple[list[str], list[list[str]]]:
    """Read a table: the names of its columns, and its rows as texts.

    Comma, semicolon and tab separate the values of a CSV file; empty lines and lines that begin with ``#`` are
    left out. Of an Excel file, the first sheet is read.

    Parameters
    ----------
    path
        ``.csv``, ``.parquet`` (which needs pyarrow) or ``.xlsx`` (which needs openpyxl).

    Raises
    ------
    InvalidValueError
        The file cannot be read, is no such table, or its library is missing.
    """
    suffix = path.suffix.lower()
    if suffix not in TABLE_SUFFIXES:
        raise InvalidValueError(
            f"{path} for a table", expected="a name that ends in " + ", ".join(TABLE_SUFFIXES)
        )
    try:
        if suffix == ".csv":
            text = read_text_file(
                path, _MOST_BYTES, error=InvalidValueError, expected="a table as UTF-8 text"
            )
            rows = _split_csv(text)
        else:
            rows = _read_parquet(path) if suffix == ".parquet" else _read_excel(path)
    except ImportError as error:
        raise InvalidValueError(
            f"{path} without {_LIBRARIES[suffix]}: {error}",
            expected="the library that reads it",
            do="pip install 'semcal_ros[tables]', or save the table as .csv",
        ) from error
    except InvalidValueError:
        raise
    except Exception as error:  # the libraries raise what they like on broken files
        raise InvalidValueError(
            f"{path}: not a table ({error})",
            expected=f"a {suffix} file",
            do="save it anew, or as .csv",
        ) from error
    if len(rows) < 2:
        raise InvalidValueError(
            f"{path} without rows",
            expected="a line with the names of the columns, then their values",
        )
    return rows[0], rows[1:]


def _split_csv(text: str) -> list[list[str]]:
    lines = [t for t in text.lstrip("\ufeff").splitlines() if t.strip() and not t.startswith("#")]
    if not lines:
        return []
    # Where commas are decimal, semicolons separate.
    separator = next((c for c in (";", "\t", ",") if c in lines[0]), ",")
    rows = csv.reader(lines, delimiter=separator)
    return [[cell.strip() for cell in row] for row in rows]


def _read_parquet(path: Path) -> list[list[str]]:
    from pyarrow import parquet

    table = parquet.read_table(path).to_pydict()
    columns = [[_text(value) for value in values] for values in table.values()]
    return [list(table), *(list(row) for row in zip(*columns, strict=True))]


def _read_excel(path: Path) -> list[list[str]]:
    from openpyxl import load_workbook

    book = load_workbook(path, read_only=True, data_only=True)
    rows = [
        [_text(value) for value in row] for row in book.worksheets[0].iter_rows(values_only=True)
    ]
    return [row for row in rows if any(row)]


def _text(value: object) -> str:
    return "" if value is None else _cell(value).strip()
