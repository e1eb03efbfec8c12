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

"""``semcal update``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from semcal_ros.cli.check_command import echo_check
from semcal_ros.cli.options import PATH, options_of, output_option
from semcal_ros.cli.output import echo_notes, echo_rejected, echo_verdict, show_progress
from semcal_ros.cli.recording_input import check_outputs, recording_input
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.files.recordings import RecordedFiles
from semcal_ros.workflows.check_and_update import UpdateOptions, update_by_recording


@click.command("update")
@click.argument("calibration", type=PATH)
@recording_input
@output_option("Renewed calibration file.")
@options_of(UpdateOptions)
def command(
    calibration: Path,
    recording: RecordedFiles,
    output: Path,
    config: MicroscopeConfig,
    options: UpdateOptions,
) -> None:
    """Renew CALIBRATION with a few views of the grid in RECORDING.

    The old calibration, with its uncertainty, is the prior: ten views are enough for what all magnifications share.

    \b
    Example:
      semcal update cal.yaml recordings/grid_today -o cal_today.yaml
    """
    check_outputs([("-o", output, ())], recording=recording)
    with show_progress() as on_progress:
        done = update_by_recording(
            calibration, recording, replace(options, config=config, on_progress=on_progress)
        )
    done.calibration.save(output)
    echo_verdict(done.calibration)
    echo_check(done.result.check)
    echo_notes(done.notes)
    echo_rejected(done.rejections)
    click.echo(f"calibration: {output}")
