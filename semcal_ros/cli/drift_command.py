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

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import click

from semcal_ros.cli.options import FIGURE_SUFFIXES, options_of
from semcal_ros.cli.output import (
    echo_nominal_unit,
    echo_notes,
    echo_paths,
    echo_states,
    show_progress,
)
from semcal_ros.cli.recording_input import check_outputs, recording_input
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.wording import counted
from semcal_ros.files.recordings import RecordedFiles
from semcal_ros.files.tables import TABLE_SUFFIXES
from semcal_ros.files.video import FPS_RANGE, VIDEO_CODECS
from semcal_ros.workflows.options import Option
from semcal_ros.workflows.track_drift import (
    DriftOptions,
    describe_forecast,
    describe_rate,
    track_recording,
    write_drift_video,
)


@dataclass(frozen=True)
class DriftOutputs:
    """What is written and printed."""

    output: Annotated[
        Path,
        Option(
            "Table: .csv, .parquet or .xlsx.",
            kind="path",
            names=("-o", "--output"),
            required=True,
        ),
    ]
    plot: Annotated[Path | None, Option("Also draw a figure: .png, .svg or .pdf.", kind="path")] = (
        None
    )
    video: Annotated[
        Path | None,
        Option("Frames as recorded, and in place beside them: .mp4 or .avi.", kind="path"),
    ] = None
    fps: Annotated[float, Option("Frames per second of the video.", between=FPS_RANGE)] = 10.0
    forecast_s: Annotated[
        float | None,
        Option(
            "Also forecast the drift this long after the last frame, such as 5s.", kind="time ahead"
        ),
    ] = None


@click.command("drift")
@recording_input
@options_of(DriftOutputs, "outputs")
@options_of(DriftOptions)
def command(
    recording: RecordedFiles, config: MicroscopeConfig, outputs: DriftOutputs, options: DriftOptions
) -> None:
    """Drift of the specimen in RECORDING at the centre of each frame, relative to the first one.

    What lay at X in the sem frame is seen at X + drift. Columns: stamp_ns, dx_m, dy_m, sigma_x_m, sigma_y_m,
    dx_px, dy_px (rectified pixels), sigma_x_px, sigma_y_px (without that of the scale), status, correlation_m and
    correlation_px (of x and y).

    \b
    Example:
      semcal drift recordings/gold --calibration cal.yaml -o drift.csv --plot drift.png
    """
    output, plot, video = outputs.output, outputs.plot, outputs.video
    check_outputs(
        (
            ("-o", output, TABLE_SUFFIXES),
            ("--plot", plot, FIGURE_SUFFIXES),
            ("--video", video, tuple(VIDEO_CODECS)),
        ),
        recording=recording,
    )
    calibration, forecast = options.calibration, outputs.forecast_s
    with show_progress() as on_progress:
        track = track_recording(recording, replace(options, config=config, on_progress=on_progress))
        if video is not None:
            write_drift_video(
                recording,
                track,
                video,
                calibration=calibration,
                fps=outputs.fps,
                on_progress=on_progress,
            )
    track.save(output)
    if plot is not None:
        # Imported here, so that a run without a plot does not wait for matplotlib.
        from semcal_ros.report.drift_figures import write_drift_figure

        with show_progress("drawing"):
            write_drift_figure(track.path, plot, recording.name)
    echo_notes(track.notes)
    if calibration is None and recording.pixel_size_m is None:
        echo_nominal_unit(
            track.config.display_width_m,
            "drift is in raw pixels, scaled by the nominal pixel size",
        )
    echo_states(track.states)
    if track.path.followed:
        click.echo(describe_rate(track.path))
        if forecast is not None:
            click.echo(describe_forecast(track.forecast(forecast), forecast))
    echo_paths({"drift": output, "plot": plot, "video": video})
    if len(track) > 1 and not track.path.followed:
        click.echo(
            f"warning: none of {counted(len(track), 'frame')} was tracked: the drift is not known, "
            "and its sigma in the table is infinite",
            err=True,
        )
        raise click.exceptions.Exit(1)
