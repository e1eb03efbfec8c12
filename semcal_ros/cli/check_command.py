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

"""``semcal check``."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import click

from semcal_ros.cli.options import PATH, json_option, options_of, refuse_grid_options
from semcal_ros.cli.output import (
    echo_json,
    echo_notes,
    echo_rejected,
    echo_table,
    list_rejections,
    show_progress,
)
from semcal_ros.cli.recording_input import recording_input
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.calibration.judgement.check import CalibrationCheck, Change, Verdict
from semcal_ros.core.wording import counted
from semcal_ros.files.recordings import RecordedFiles
from semcal_ros.workflows.check_and_update import CheckOptions, check_recording
from semcal_ros.workflows.check_specimen import MovesCheck, SpecimenCheckOptions, check_specimen

_UNITS = {
    "centre of distortion": ("px", 1.0, 2),
    **dict.fromkeys(("distortion", "spiral", "products and fifth order"), ("", 1.0, 6)),
}
# More make the table too wide; --json has them all.
_VALUES_SHOWN_MAX = 3


@click.command("check")
@click.argument("calibration", type=PATH)
@recording_input
@options_of(CheckOptions)
@click.option(
    "--specimen",
    is_flag=True,
    help="RECORDING shows one place of any specimen at several magnifications, or under moves of the stage, not the "
    "grid: compare their scales, or the pixels with the moves.",
)
@options_of(SpecimenCheckOptions, "known")
@json_option
def command(
    calibration: Path,
    recording: RecordedFiles,
    config: MicroscopeConfig,
    options: CheckOptions,
    specimen: bool,
    known: SpecimenCheckOptions,
    as_json: bool,
) -> None:
    """Whether CALIBRATION still holds, by one or more views of the grid in RECORDING.

    With --specimen, by one place of any specimen at several magnifications; that shows whether their scales have
    changed against each other, but nothing that is common to all of them.

    Exit status: 0 valid, 1 degraded or invalid, 2 bad input.

    \b
    Example:
      semcal check cal.yaml recordings/grid_today
      semcal check cal.yaml recordings/gold_steps --specimen
    """
    if specimen:
        refuse_grid_options("--specimen compares images of any specimen")
        _check_specimen(calibration, recording, replace(known, config=config), as_json=as_json)
        return
    with show_progress() as on_progress:
        done = check_recording(
            calibration, recording, replace(options, config=config, on_progress=on_progress)
        )
    if as_json:
        echo_json(
            {
                **describe_check(done.result),
                "notes": list(done.notes),
                "rejections": list_rejections(done.rejections),
            }
        )
    else:
        click.echo(f"{calibration}: {done.result.verdict.value}")
        echo_check(done.result)
        click.echo(_advise(done.result))
        echo_notes(done.notes)
        echo_rejected(done.rejections)
    if done.result.verdict is not Verdict.VALID:
        sys.exit(1)


def _check_specimen(
    calibration: Path,
    recording: RecordedFiles,
    known: SpecimenCheckOptions,
    *,
    as_json: bool,
) -> None:
    with show_progress() as on_progress:
        known = replace(known, on_progress=on_progress)
        done = check_specimen(calibration, recording, **vars(known))
    if as_json:
        echo_json(
            {
                "holds": done.holds,
                "ratios": [asdict(ratio) for ratio in done.ratios],
                "moves": [asdict(move) for move in done.moves],
            }
        )
    else:
        what = "the scales of the magnifications" if done.ratios else "pixels and stage"
        click.echo(f"{calibration}: {what} " + ("agree" if done.holds else "DO NOT AGREE"))
        rows = [
            [
                f"{r.low:g} to {r.high:g}",
                *(
                    [r.reason or "-", "", ""]
                    if r.reason
                    else [
                        f"{100.0 * value:+.3f} +- {100.0 * sigma:.3f}"
                        for value, sigma in (
                            (r.scale, r.scale_sigma),
                            (r.aspect, r.aspect_sigma),
                            (r.skew, r.skew_sigma),
                        )
                    ]
                ),
            ]
            for r in done.ratios
        ]
        if rows:
            echo_table(["magnifications", "ratio of scales %", "aspect %", "skew %"], rows)
            click.echo(
                "a change that is common to all magnifications is not seen: that needs the grid"
            )
        _echo_moves(done.moves, known.stage_accuracy)
        echo_notes(done.notes)
    if not done.holds:
        sys.exit(1)


def _echo_moves(moves: Sequence[MovesCheck], stage_accuracy: float) -> None:
    if not moves:
        return
    echo_table(
        ["magnification", "nm per px x %", "nm per px y %", "skew %", "frames", "scatter nm"],
        [
            [
                f"{move.magnification:g}",
                *(
                    f"{100.0 * value:+.2f} +- {100.0 * sigma:.2f}"
                    for value, sigma in (
                        (move.found.scale_x, move.scale_sigma[0]),
                        (move.found.scale_y, move.scale_sigma[1]),
                        (move.found.skew, move.skew_sigma),
                    )
                ),
                str(move.found.frames),
                f"{1e9 * move.found.scatter_m:.3g}",
            ]
            for move in moves
        ],
    )
    click.echo(
        f"against moves of the stage, which count as true to {100.0 * stage_accuracy:g} % along each axis "
        "(--stage-accuracy): smaller changes are not seen, nor the distortion"
    )


def echo_check(result: CalibrationCheck) -> None:
    """Print what has changed, and how much of nm per pixel that is."""
    changed = {change.name for change in result.changes}
    rows = [
        [
            change.name,
            _format_values(change),
            ", ".join(f"{z:+.1f}" for z in change.z_scores),
            f"{change.largest_px:.2f}",
            f"{1e9 * change.largest_m:.3g}",
            f"{change.p_value:.2g}",
            "changed" if change.name in changed else "",
        ]
        for change in result.tested
    ]
    pattern = result.shape
    known = math.isfinite(pattern.p_value)
    rows.append(
        [
            "other distortion",
            f"{pattern.rms_px:.4f} px RMS" if known else "too few views",
            f"{pattern.z_score:.1f}" if known else "-",
            "",
            "",
            f"{pattern.p_value:.2g}" if known else "-",
            "changed" if known and pattern.significant else "",
        ]
    )
    rows.append(
        [
            "residuals",
            f"{result.misfit:.2f} times those expected",
            f"{result.misfit_z:+.1f}",
            *("", "", "", ""),
        ]
    )
    echo_table(
        ["", "images against calibration", "z", "px at most", "nm at most", "probability", ""], rows
    )
    click.echo(
        f"the images have {-100.0 * result.scale_change:+.3f} +- {100.0 * result.scale_sigma:.3f} % more nm per px "
        f"than calibrated; {counted(result.views, 'view')}, RMS {result.rms_px:.4f} px"
        + (f", {result.out_of_range} outside the calibrated range" if result.out_of_range else "")
    )


def describe_check(result: CalibrationCheck) -> dict[str, Any]:
    """Return a check as plain data, with its z-scores."""

    def plain(change: Change) -> dict[str, Any]:
        return {**asdict(change), "z_scores": list(change.z_scores)}

    return {
        **asdict(result),
        "verdict": result.verdict.value,
        "changes": [plain(change) for change in result.changes],
        "tested": [plain(change) for change in result.tested],
        "shape": {**asdict(result.shape), "z_score": result.shape.z_score},
        "misfit_z": result.misfit_z,
    }


def _advise(result: CalibrationCheck) -> str:
    if result.verdict is Verdict.VALID:
        return "nothing to do: the views agree with the calibration within its uncertainty"
    if result.verdict is Verdict.INVALID:
        return (
            "this is another microscope, grid or display width: check --config, --squares and --display-width, else "
            "calibrate anew"
        )
    if result.not_renewable:
        return (
            f"calibrate anew: `semcal update` does not renew {' and '.join(result.not_renewable)}"
        )
    return "renew it with `semcal update` and such views, or calibrate again"


def _format_values(change: Change) -> str:
    pairs = zip(change.values, change.sigmas, strict=True)
    if change.name in ("scale", "aspect", "skew"):
        return ", ".join(f"{100.0 * v:+.3f} +- {100.0 * s:.3f} %" for v, s in pairs)
    if len(change.values) > _VALUES_SHOWN_MAX:
        return f"{len(change.values)} amplitudes"
    unit, factor, digits = _UNITS[change.name]
    return ", ".join(
        f"{factor * v:+.{digits}f} +- {factor * s:.{digits}f} {unit}".strip() for v, s in pairs
    )
