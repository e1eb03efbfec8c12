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

from pathlib import Path

import click

from semcal_ros.cli.options import (
    calibration_option,
    interpolation_option,
    no_drift_option,
    output_option,
    overwrite_option,
    recording_argument,
    recording_options,
)
from semcal_ros.cli.output import echo_notes, echo_states, show_progress
from semcal_ros.workflows.rectify import rectify

__all__ = ["command"]


@click.command("rectify")
@recording_argument
@calibration_option(required=True)
@output_option("Bag to make.")
@no_drift_option("Leave drift in; correct distortion only.")
@interpolation_option("linear")
@click.option(
    "--namespace", default="/sem", show_default=True, help="Namespace of the topics in the output."
)
@recording_options
@overwrite_option
def command(
    recording: Path,
    calibration: Path,
    output: Path,
    no_drift: bool,
    interpolation: str,
    namespace: str,
    config: str,
    frame_time: float | None,
    overwrite: bool,
) -> None:
    """Drift-free, undistorted copy of RECORDING in square pixels, with camera_info and projection per frame.

    \b
    Example:
      semcal rectify recordings/zoom --calibration cal.yaml -o zoom_rect
    """
    with show_progress() as on_progress:
        done = rectify(
            recording,
            output,
            calibration=calibration,
            config=config,
            frame_time_s=frame_time,
            drift=not no_drift,
            interpolation=interpolation,
            namespace=namespace,
            overwrite=overwrite,
            on_progress=on_progress,
        )
    echo_notes(done.notes)
    if done.extrapolated:
        click.echo(
            f"warning: {done.extrapolated} frames are outside the calibrated range", err=True
        )
    echo_states(done.states)
    click.echo(f"{done.frame_count} frames: {output}")
