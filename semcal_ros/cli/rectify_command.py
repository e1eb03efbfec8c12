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

"""``semcal rectify``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from semcal_ros.cli.options import options_of
from semcal_ros.cli.output import echo_notes, echo_states, show_progress
from semcal_ros.cli.recording_input import check_spared, recording_input
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.wording import counted
from semcal_ros.files.recordings import RecordedFiles
from semcal_ros.workflows.rectify import RectifyOptions, rectify_recording


@click.command("rectify")
@recording_input
@options_of(RectifyOptions)
def command(recording: RecordedFiles, config: MicroscopeConfig, options: RectifyOptions) -> None:
    """Drift-free, undistorted copy of RECORDING in square pixels.

    As a bag, with camera_info and projection per frame; as TIFFs, with pixel size, times and conditions.

    \b
    Example:
      semcal rectify tiffs --calibration cal.yaml -o corrected/ --scale-bar
      semcal rectify recordings/zoom --calibration cal.yaml -o zoom_rect
    """
    output = str(options.output)
    check_spared("-o", Path(output), recording)
    with show_progress() as on_progress:
        done = rectify_recording(
            recording, replace(options, config=config, on_progress=on_progress)
        )
    echo_notes(done.notes)
    echo_states(done.states)
    for warning in done.warnings:
        click.echo(f"warning: {warning}", err=True)
    click.echo(f"{counted(done.frame_count, 'frame')}: {output}")
