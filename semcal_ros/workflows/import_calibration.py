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

"""From a table of pixel sizes to a nominal calibration."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from semcal_ros.calibration import Calibration
from semcal_ros.core.camera.calibration_model import KnownPixelSize, make_nominal_calibration
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.tables import read_table
from semcal_ros.workflows.options import KeywordsOf, Option
from semcal_ros.workflows.provenance import describe_computation

_METRES = {"pm": 1e-12, "nm": 1e-9, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "mm": 1e-3, "m": 1.0}
# The pixel size in a header: "nm per px", "nm/pixel", "pixel size (nm)", "nm_per_px".
_UNIT = re.compile(r"(?<![a-zµμ])(pm|nm|um|µm|μm|mm|m)(?![a-zµμ])")


@dataclass(frozen=True)
class ImportOptions:
    """What a table of pixel sizes does not tell."""

    image_size: Annotated[
        tuple[int, int],
        Option(
            "Size of the images whose pixels these are, without databar, such as 1024x768.",
            kind="image size",
            required=True,
            python="(width, height) in px.",
        ),
    ]
    sigma: Annotated[
        float,
        Option("Relative 1-sigma of pixel sizes for which the table has none.", kind="ratio"),
    ] = 0.03
    display_width_m: Annotated[
        float | None,
        Option(
            "Width of the display that the magnification refers to (default: the one that fits).",
            kind="length",
        ),
    ] = None


@KeywordsOf(ImportOptions)
def import_calibration(table: str | os.PathLike[str], options: ImportOptions) -> Calibration:
    """Make a nominal calibration from a table of magnifications and pixel sizes.

    Parameters
    ----------
    table
        A ``.csv``, ``.parquet`` or ``.xlsx`` file with a column of magnifications and one of pixel sizes, whose header
        names the unit, such as ``nm per px``; optionally one of their 1-sigma, in ``%``, in
        the unit that its header names, or else in that of the sizes.

    Raises
    ------
    InvalidValueError
        If the table cannot be read, has no such columns, or its numbers cannot be pixel sizes; with the line.
    """
    path = Path(table)
    columns, rows = read_table(path)
    lower = [re.sub(r"[_\-]", " ", name.lower()) for name in columns]
    magnification = _find(
        path, columns, [k for k, n in enumerate(lower) if "mag" in n], "magnification"
    )
    spreads = [k for k, n in enumerate(lower) if "sigma" in n or "uncertainty" in n]
    sized = [
        k for k, n in enumerate(lower) if _UNIT.search(n) and k not in (*spreads, magnification)
    ]
    size = _find(path, columns, sized, "nm per px")
    unit = _METRES[_UNIT.search(lower[size])[1]]  # type: ignore[index]  # it was found there
    percent, spread_unit = False, unit
    if spreads:
        percent = "%" in columns[spreads[0]] or "percent" in lower[spreads[0]]
        named = _UNIT.search(lower[spreads[0]])
        spread_unit = unit if named is None else _METRES[named[1]]
    known = []
    for number, row in enumerate(rows, start=2):
        where = f"{path}, row {number}: "
        if len(row) <= max(magnification, size):
            raise InvalidValueError(f"{where}{len(row)} values", expected=f"{len(columns)}")
        value_m = unit * _number(row[size], where)
        relative_sigma = options.sigma
        if spreads and len(row) > spreads[0] and row[spreads[0]].strip():
            spread = _number(row[spreads[0]], where)
            relative_sigma = 0.01 * spread if percent else spread_unit * spread / value_m
        known.append(
            KnownPixelSize(_number(row[magnification], where), value_m, relative_sigma, where)
        )
    model = make_nominal_calibration(known, options.image_size, options.display_width_m)
    origin = replace(describe_computation(), recording=f"{path.name} (a table of pixel sizes)")
    return Calibration.from_model(replace(model, provenance=origin))


def _find(path: Path, columns: list[str], found: list[int], example: str) -> int:
    if len(found) != 1:
        raise InvalidValueError(
            f"{path} with the columns {', '.join(columns)}",
            expected=f"one column with a header such as {example}",
        )
    return found[0]


def _number(text: str, where: str) -> float:
    clean = text.strip().removesuffix("x").removesuffix("×").replace("\u00a0", "").replace(" ", "")
    if re.fullmatch(r"[+-]?[1-9]\d{0,2}(,\d{3})+", clean):
        raise InvalidValueError(
            f"{where}{text!r}, a thousand or a decimal number",
            expected="a number without separators of thousands",
        )
    if clean.count(",") == 1 and "." not in clean:
        clean = clean.replace(",", ".")
    try:
        return float(clean)
    except ValueError as error:
        raise InvalidValueError(f"{where}{text!r}", expected="a number") from error
