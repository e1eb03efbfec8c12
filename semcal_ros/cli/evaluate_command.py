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

"""``semcal evaluate``."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import click

from semcal_ros.cli.options import PATH, json_option, options_of
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
from semcal_ros.core.wording import counted
from semcal_ros.files.recordings import RecordedFiles
from semcal_ros.workflows.evaluate import EvaluateOptions, evaluate_recording


@click.command("evaluate")
@click.argument("calibration", type=PATH)
@recording_input
@options_of(EvaluateOptions)
@json_option
def command(
    calibration: Path,
    recording: RecordedFiles,
    config: MicroscopeConfig,
    options: EvaluateOptions,
    as_json: bool,
) -> None:
    """Reprojection RMS of CALIBRATION on a grid RECORDING that it was not made from.

    Poses are fitted to each view; the camera is not. The RMS does not show a wrong scale, since
    heights imitate it: nm per px is compared by itself, with heights as usual.

    \b
    Example:
      semcal evaluate cal.yaml recordings/other_grid
    """
    with show_progress() as on_progress:
        result = evaluate_recording(
            calibration, recording, replace(options, config=config, on_progress=on_progress)
        )
    if as_json:
        summary = asdict(replace(result, rejections=()))
        summary["rejections"] = list_rejections(result.rejections)
        for row in summary["by_magnification"]:
            del row["views"]
        echo_json(summary)
        return
    echo_table(
        ["magnification", "views", "RMS px", "calibrated above seen nm per px, %", ""],
        [
            [
                f"{row.magnification:g}",
                str(row.views),
                f"{row.rms_px:.4f}",
                f"{100.0 * row.scale_error:+.3f} +- {100.0 * row.scale_sigma:.3f}",
                "" if row.in_range else "out of range",
            ]
            for row in result.by_magnification
        ],
    )
    click.echo(
        f"{result.views} of {counted(result.views + result.rejected, 'view')}, RMS {result.rms_px:.4f} px"
    )
    echo_notes(result.notes)
    echo_rejected(result.rejections)
