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

"""``semcal compare``."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import click

from semcal_ros.calibration import Calibration
from semcal_ros.cli.options import FIGURE_SUFFIXES, PATH, json_option, options_of
from semcal_ros.cli.output import echo_json, echo_notes, echo_paths, echo_table
from semcal_ros.core.calibration.judgement.compare import (
    CalibrationDifference,
    compare_calibrations,
)
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.tables import TABLE_SUFFIXES, write_table
from semcal_ros.workflows.options import Option

_COLUMNS = (
    "magnification",
    "nm_per_px",
    "difference_nm_per_px",
    "difference_percent",
    "sigma_percent",
    "largest_px",
    "field_sigmas",
)


@dataclass(frozen=True)
class CompareOptions:
    """Where two calibrations are compared, and what is written."""

    magnifications: Annotated[
        tuple[float, ...],
        Option(
            "Compare at this magnification, as often as wanted (default: seven over the common range).",
            names=("--magnification",),
            repeated=True,
            metavar="G",
        ),
    ] = ()
    table: Annotated[
        Path | None, Option("The table as .csv, .parquet or .xlsx.", kind="path of a file")
    ] = None
    figure: Annotated[
        Path | None, Option("A picture as .png, .svg or .pdf.", kind="path of a file")
    ] = None


@click.command("compare")
@click.argument("first", type=PATH)
@click.argument("second", type=PATH)
@options_of(CompareOptions)
@json_option
def command(first: Path, second: Path, options: CompareOptions, as_json: bool) -> None:
    """By how much the calibration SECOND differs from FIRST, in px and nm, over its joint sigma.

    Exit status: 0 they agree, 1 they differ, 2 bad input.

    \b
    Example:
      semcal compare january.yaml june.yaml --figure difference.png
    """
    table, figure = options.table, options.figure
    for option, path, suffixes in (
        ("--table", table, TABLE_SUFFIXES),
        ("--figure", figure, FIGURE_SUFFIXES),
    ):
        if path is not None and path.suffix.lower() not in suffixes:
            raise InvalidValueError(
                f"{option} {path}", expected="a name that ends in " + ", ".join(suffixes)
            )
    calibrations = Calibration.load(first), Calibration.load(second)
    difference = compare_calibrations(*calibrations, options.magnifications)
    rows = _tabulate(difference)
    if table is not None:
        write_table(table, _COLUMNS, rows)
    if figure is not None:
        # Imported here: nobody else is to wait for the plotting library.
        from semcal_ros.report.comparison_figure import write_difference_figure

        names = first.name, second.name
        write_difference_figure(difference, names, calibrations[0].image_size, figure)
    if as_json:
        echo_json(
            {
                "agree": difference.agree,
                "largest_sigmas": difference.largest_sigmas,
                "same_recording": difference.same_recording,
                "at": [dict(zip(_COLUMNS, row, strict=True)) for row in rows],
            }
        )
    else:
        _echo(difference, rows)
        echo_paths({"table": table, "figure": figure})
    if not difference.agree:
        sys.exit(1)


def _tabulate(difference: CalibrationDifference) -> list[tuple[float, ...]]:
    return [
        (
            one.magnification,
            1e9 * one.pixel_size_m,
            1e9 * one.pixel_size_m * one.scale,
            100.0 * one.scale,
            100.0 * one.scale_sigma,
            one.worst_px,
            one.field_sigmas,
        )
        for one in difference.at
    ]


def _echo(difference: CalibrationDifference, rows: list[tuple[float, ...]]) -> None:
    said = "agree" if difference.agree else "DIFFER"
    click.echo(
        f"the calibrations {said} from {difference.low:g}x to {difference.high:g}x: largest difference "
        f"{difference.largest_sigmas:.1f} joint sigma"
    )
    echo_table(
        ["magnification", "nm per px", "differs by nm", "%", "field: px at most", "joint sigma"],
        [
            [
                f"{g:.0f}",
                f"{size:.5g}",
                f"{nm:+.2g}",
                f"{percent:+.3f} +- {sigma:.3f}",
                f"{px:.3f}",
                f"{sigmas:.1f}",
            ]
            for g, size, nm, percent, sigma, px, sigmas in rows
        ],
    )
    if difference.same_recording:
        echo_notes(
            [
                "both come from the same recording: their errors are not independent, and the joint sigma is too large"
            ]
        )
