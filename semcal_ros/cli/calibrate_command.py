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

"""``semcal calibrate``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import click

from semcal_ros.calibration import Calibration
from semcal_ros.cli.extend_command import echo_pairs, echo_steps
from semcal_ros.cli.options import given_options, options_of, refuse_grid_options, refuse_with
from semcal_ros.cli.output import (
    echo_notes,
    echo_rejected,
    echo_table,
    echo_term_sizes,
    echo_verdict,
    show_progress,
)
from semcal_ros.cli.recording_input import PIXEL_SIZE_AT, check_outputs, recording_input
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.calibration.options import MethodOptions
from semcal_ros.core.calibration.paper.pda import focal_length_and_skew, prime
from semcal_ros.core.corners import PATTERN_NAMES, describe_odds
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import counted, group_by_kind
from semcal_ros.files.recordings import RecordedFiles
from semcal_ros.workflows.calibrate import (
    PAPER_OPTIONS,
    CalibrateOptions,
    RecordingCalibration,
    calibrate_recording,
)
from semcal_ros.workflows.calibrate_specimen import SpecimenOptions, calibrate_recorded_specimen
from semcal_ros.workflows.options import Option

# Options that are about a grid or one of its methods.
_OF_GRIDS = (
    "--method",
    "--pda-order",
    "--legendre",
    "--pda-step",
    "--breakpoints",
    "--residual",
    "--tau",
    "--squares-sigma",
    "--report",
    "--paper",
    "--dask",
)
_OF_PDA = ("--pda-order", "--legendre", "--pda-step")
_OF_JOINT = ("--breakpoints", "--residual")
# Of each method, the options of the others.
_OF_OTHER_METHODS = {
    "joint": (*_OF_PDA, "--tau"),
    "discrete": (*_OF_JOINT, *_OF_PDA),
    "pda": _OF_JOINT,
}


@dataclass(frozen=True)
class CalibrateOutputs:
    """What is written."""

    output: Annotated[
        Path, Option("Calibration file.", kind="path", names=("-o", "--output"), required=True)
    ]
    report: Annotated[Path | None, Option("Also write an HTML report.", kind="path")] = None
    paper: Annotated[
        bool, Option("With an appendix in the report that compares with the paper.")
    ] = False


def _calibrate_specimen(
    recording: RecordedFiles, output: Path, config: MicroscopeConfig, known: SpecimenOptions
) -> None:
    context = click.get_current_context()
    refuse_grid_options("--specimen looks at a specimen")
    refuse_with("--specimen", "which looks at no grid", _OF_GRIDS)
    known = replace(known, pixel_size=context.meta.get(PIXEL_SIZE_AT), config=config)
    missing = [known.pixel_size, known.length, known.stage_scale].count(None)
    if missing != 2:
        raise InvalidValueError(
            "--specimen without a known size" if missing == 3 else "two known sizes",
            expected="--pixel-size 23.1nm@5000, --length 4.2um@0,110,80,300,82, or --stage-scale 0.5%",
        )
    with show_progress() as on_progress:
        done = calibrate_recorded_specimen(recording, replace(known, on_progress=on_progress))
    done.calibration.save(output)
    echo_verdict(done.calibration)
    echo_steps(done.calibration, done.result.steps)
    for weakness in done.result.weaknesses:
        click.echo(f"note: {weakness}", err=True)
    echo_notes(done.notes)
    echo_pairs(done.result.rejected, done.result.unused)
    click.echo(f"calibration: {output}")


@click.command("calibrate")
@recording_input
@options_of(CalibrateOutputs, "outputs")
@options_of(CalibrateOptions)
@options_of(MethodOptions, "paper_options", PAPER_OPTIONS)
@click.option(
    "--specimen",
    is_flag=True,
    help="Without a grid: moved, turned and zoomed pictures of a flat, textured specimen, and one known size.",
)
@options_of(SpecimenOptions, "known")
def command(
    recording: RecordedFiles,
    config: MicroscopeConfig,
    outputs: CalibrateOutputs,
    options: CalibrateOptions,
    paper_options: MethodOptions,
    specimen: bool,
    known: SpecimenOptions,
) -> None:
    """Calibrate from RECORDING: a bag, or a folder of SEM TIFF files or ordinary images, of the grid.

    \b
    Example:
      semcal calibrate recordings/grid -o cal.yaml --report report.html
      semcal calibrate recordings/grid -o cal.yaml --untilted 0,5,10 --height-sigma 20um
      semcal calibrate recordings/gold -o cal.yaml --specimen --pixel-size 23.1nm@5000
      semcal calibrate recordings/gold -o cal.yaml --specimen --stage-scale 0.5%
      semcal calibrate recordings/grid -o cal.yaml --method pda --pda-step auto
    """
    output, report = outputs.output, outputs.report
    check_outputs([("-o", output, ()), ("--report", report, ())])
    if specimen:
        _calibrate_specimen(recording, output, config, known)
        return
    for name in ("--length", "--stage-scale", "--known-sigma"):
        if name in given_options():
            raise InvalidValueError(
                f"{name} without --specimen", expected="both", do="add --specimen"
            )
    refuse_with(
        f"--method {options.method}", "which does not use it", _OF_OTHER_METHODS[options.method]
    )
    asked = replace(options, config=config, options=paper_options)
    with show_progress() as on_progress:
        done = calibrate_recording(
            recording, replace(asked, on_progress=on_progress), keep_images=report is not None
        )
    done.calibration.save(output)
    _echo_result(done)
    click.echo(f"calibration: {output}")
    if report is not None:
        with show_progress("writing the report"):
            title = f"Calibration from {recording.name}"
            _write_report(done, report, title, outputs.paper, output)
        click.echo(f"report: {report}")


def _echo_result(done: RecordingCalibration) -> None:
    echo_verdict(done.calibration)
    statistics, method = done.calibration.statistics, done.calibration.method
    rejected = done.collected.rejected
    total = statistics["views"] + len(rejected)
    echo_table(
        ["magnification", "views", "RMS px", "held-out RMS px"],
        [
            [
                f"{row['magnification']:g}",
                str(row["views"]),
                f"{row['rms_px']:.4f}",
                "-"
                if row["held_out_rms_px"] is None
                else f"{row['held_out_rms_px']:.4f}{'*' if row['held_out_extrapolated'] else ' '}",
            ]
            for row in statistics["by_magnification"]
        ],
    )
    if statistics["held_out_rms_px"] is not None:
        click.echo("held out: calibrated without that magnification; * is extrapolated")
    patterns = Counter(PATTERN_NAMES[view.detection.pattern] for view in done.collected.found)
    odds = [view.detection.odds for view in done.collected.found if view.detection.odds > 0.0]
    if patterns:
        least = f", by odds of {describe_odds(min(odds))}" if odds else ""
        if odds and min(odds) < 1.0:
            least = f", although another kind fits better in places, by odds of {describe_odds(1.0 / min(odds))}"
        (pattern, _), *others = patterns.most_common()
        taken = "".join(
            f"; in {counted(number, 'view')} taken for {other}, with the same points"
            for other, number in others
        )
        click.echo(f"the grid: {pattern}{least}{taken}")
    click.echo(
        f"{statistics['views']} of {counted(total, 'view')}, {counted(statistics['corners'], 'corner')}, "
        f"method {method}: RMS {statistics['rms_px']:.4f} px"
        + (
            f", held out {statistics['held_out_rms_px']:.4f} px"
            if statistics["held_out_rms_px"] is not None
            else ""
        )
    )
    _echo_steps(statistics["fit"])
    _echo_equations(done.calibration)
    echo_term_sizes(done.calibration)
    if done.calibration.residual is not None:
        click.echo("with a residual field for what the distortion parameters do not describe")
    told = sum(view.stage is not None for view in done.result.views)
    if told:
        unused = "" if method == "joint" else f", but method {method} does not use it"
        click.echo(
            f"the stage is known for {told} of {counted(statistics['views'], 'view')}{unused}"
        )
    echo_rejected(rejected)
    echo_notes(done.notes)
    for warning in group_by_kind(done.result.warnings):
        click.echo(f"warning: {warning}", err=True)


def _echo_steps(fit: dict[str, Any]) -> None:
    if not fit.get("steps"):
        return
    echo_table(
        ["step G", "magnifications", "error of (19)", "RMS px", ""],
        [
            [
                f"{row['step']:g}",
                str(row["magnifications"]),
                "-" if row["equation_error"] is None else f"{row['equation_error']:.3f}",
                f"{row['rms_px']:.4f}",
                "chosen" if row["step"] == fit["step"] else "",
            ]
            for row in fit["steps"]
        ],
    )
    click.echo(
        "RMS px: of all views, poses fitted; its least value chooses. "
        "Error of (19): 1 if the equations explain nothing"
    )


# Of the parameters that have one; the others are ratios.
_UNITS = {"px": "px", "py": "px", "rho": "1/m", "ex": "px", "ey": "px"}


def _echo_equations(calibration: Calibration) -> None:
    equations = calibration.equations
    if not equations:
        return
    low, high = equations[0].g_range
    # Two conditions belong to an equation of second order; the others need derivatives too.
    inner = range(1, equations[0].order - 1)
    echo_table(
        ["x", "unit", "equation", f"x({low:g})", f"x({high:g})"]
        + [f"{prime(j)}({low:g})" for j in inner],
        [
            [
                e.name,
                _UNITS.get(e.name, ""),
                str(e),
                *_format_values([e.start[0], e.end, *(e.start[j] for j in inner)]),
            ]
            for e in equations
        ]
        + [
            [name, "px", "", *_format_values([at_low, at_high]), *("" for _ in inner)]
            for name, at_low, at_high in zip(
                ("f = m/rho", "s = skew f"),
                focal_length_and_skew(calibration, low),
                focal_length_and_skew(calibration, high),
                strict=True,
            )
        ],
    )
    click.echo(
        f"x' = dx/du with u = (g - {low:g}) / {high - low:g}, from 0 to 1; scale is m over nominal, "
        f"{calibration.nominal_px_per_m(1.0):.6g} g px per m"
    )


def _format_values(values: Sequence[float]) -> list[str]:
    return [f"{value:.8g}" for value in values]


def _write_report(
    done: RecordingCalibration, path: Path, title: str, paper: bool, calibration: Path
) -> None:
    from semcal_ros.report import write_calibration_report

    write_calibration_report(
        done.result,
        path,
        detections=done.collected.found,
        rejected=done.collected.rejected,
        title=title,
        paper=paper,
        calibration=str(calibration),
    )
