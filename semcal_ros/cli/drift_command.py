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

"""``semcal drift``."""

from __future__ import annotations

from pathlib import Path

import click

from semcal_ros.cli.options import (
    FIGURE_SUFFIXES,
    PATH,
    calibration_option,
    check_outputs,
    output_option,
    recording_argument,
    recording_options,
)
from semcal_ros.cli.output import (
    echo_nominal_unit,
    echo_notes,
    echo_paths,
    echo_states,
    show_progress,
)
from semcal_ros.workflows.track_drift import describe_forecast, describe_rate, track_drift

__all__ = ["command"]


@click.command("drift")
@recording_argument
@output_option("CSV file.")
@calibration_option("Work in rectified coordinates.")
@click.option("--plot", type=PATH, help="Also draw a figure: .png, .svg or .pdf.")
@click.option(
    "--forecast",
    type=click.FloatRange(min=0.0, min_open=True),
    metavar="S",
    help="Also forecast the drift this long after the last frame.",
)
@click.option(
    "--live", is_flag=True, help="Drift as known live, without hindsight from later frames."
)
@recording_options
def command(
    recording: Path,
    output: Path,
    calibration: Path | None,
    plot: Path | None,
    forecast: float | None,
    live: bool,
    config: str,
    frame_time: float | None,
) -> None:
    """Drift of the specimen in RECORDING at the centre of each frame, relative to the first one.

    What lay at X in the sem frame is seen at X + drift. Columns: stamp_ns, dx_m, dy_m, sigma_x_m, sigma_y_m,
    dx_px, dy_px (rectified pixels), status.

    \b
    Example:
      semcal drift recordings/gold --calibration cal.yaml -o drift.csv --plot drift.png
    """
    check_outputs([("-o", output, ()), ("--plot", plot, FIGURE_SUFFIXES)])
    with show_progress() as on_progress:
        track = track_drift(
            recording,
            calibration=calibration,
            config=config,
            frame_time_s=frame_time,
            live=live,
            on_progress=on_progress,
        )
    track.save_csv(output)
    if plot is not None:
        # Imported here, so that a run without a plot does not wait for matplotlib.
        from semcal_ros.report.drift_figures import write_drift_figure

        write_drift_figure(track.path, plot)
    echo_notes(track.notes)
    if calibration is None:
        echo_nominal_unit(
            track.config.display_width_m,
            "drift is in raw pixels, scaled by the nominal pixel size",
        )
    echo_states(track.states)
    if len(track) > 1:
        click.echo(describe_rate(track.path))
    if forecast is not None:
        click.echo(describe_forecast(track.forecast(forecast), forecast))
    echo_paths({"drift": output, "plot": plot})
