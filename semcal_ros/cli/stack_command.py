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

"""``semcal stack``."""

from __future__ import annotations

from pathlib import Path

import click

from semcal_ros.cli.options import (
    PATH,
    calibration_option,
    check_outputs,
    interpolation_option,
    magnification_option,
    no_drift_option,
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
from semcal_ros.files.grey_images import GREY_SUFFIXES, TIFF_SUFFIXES
from semcal_ros.files.video import FPS_RANGE, VIDEO_CODECS
from semcal_ros.workflows.stack import StackResult, stack

__all__ = ["command"]


@click.command("stack")
@recording_argument
@output_option("Average: .tif (32-bit, with the pixel size) or .png (as deep as the recording).")
@calibration_option("Undo distortion, too.")
@click.option("--sigma", type=PATH, help="Standard error of the average: .tif.")
@click.option("--video", type=PATH, help="Stabilised video: .mp4 or .avi.")
@click.option(
    "--fps",
    type=click.FloatRange(*FPS_RANGE),
    default=10.0,
    show_default=True,
    help="Frames per second of the video.",
)
@click.option("--at", type=float, metavar="G", help="Take the frames of this magnification.")
@no_drift_option("Average the frames where they are.")
@interpolation_option("cubic")
@recording_options
@magnification_option
def command(
    recording: Path,
    output: Path,
    calibration: Path | None,
    sigma: Path | None,
    video: Path | None,
    fps: float,
    at: float | None,
    no_drift: bool,
    interpolation: str,
    config: str,
    frame_time: float | None,
    magnification: float | None,
) -> None:
    """Average of the frames of RECORDING, each moved to where the specimen was in the first one.

    Frames whose drift is not known are left out.

    \b
    Example:
      semcal stack recordings/gold --calibration cal.yaml -o gold.tif --video gold.mp4
    """
    outputs = (
        ("-o", output, GREY_SUFFIXES),
        ("--sigma", sigma, TIFF_SUFFIXES),
        ("--video", video, tuple(VIDEO_CODECS)),
    )
    check_outputs(outputs, recording=recording)
    with show_progress() as on_progress:
        result = stack(
            recording,
            calibration=calibration,
            config=config,
            frame_time_s=frame_time,
            magnification=magnification,
            at=at,
            drift=not no_drift,
            interpolation=interpolation,
            video=video,
            fps=fps,
            output=output,
            sigma=sigma,
            on_progress=on_progress,
        )
    _echo_result(result, calibrated=calibration is not None)
    echo_paths({"average": output, "standard error": sigma, "video": video})


def _echo_result(result: StackResult, *, calibrated: bool) -> None:
    echo_notes(result.notes)
    if not calibrated:
        echo_nominal_unit(result.config.display_width_m, "the pixel size is the nominal one")
    elif not result.camera.in_range:
        click.echo("warning: the frames are outside the calibrated range", err=True)
    if result.other_kind:
        echo_notes([f"{result.other_kind} frames of another size or encoding are left out"])
    echo_states(result.states)
    x_nm, y_nm = (1e9 * size for size in result.camera.pixel_size_m)
    click.echo(
        f"{result.image.frames} of {len(result.used)} frames averaged, "
        f"{x_nm:.6g} x {y_nm:.6g} nm per px"
    )
    if result.lost:
        echo_notes([f"tracking was lost: {result.lost} frames after that are left out"])
    if result.typical_error is not None:
        click.echo(f"standard error: {result.typical_error:.4g} grey levels (median of the pixels)")
