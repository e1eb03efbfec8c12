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

import math
from pathlib import Path

import click
import numpy as np

from semcal_ros.cli.options import (
    PATH,
    calibration_option,
    dask_option,
    interpolation_option,
    no_drift_option,
    output_option,
    parse_tilts,
)
from semcal_ros.cli.output import (
    echo_nominal_unit,
    echo_notes,
    echo_paths,
    echo_states,
    show_progress,
)
from semcal_ros.cli.recording_input import check_outputs, recording_input
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.drift.scan_pairs import ScanPairDrift
from semcal_ros.core.wording import counted
from semcal_ros.files.images.write import IMAGE_SUFFIXES, TIFF_SUFFIXES
from semcal_ros.files.recordings import RecordedFiles
from semcal_ros.files.video import FPS_RANGE, VIDEO_CODECS
from semcal_ros.workflows.stack import StackResult, stack

# 1-sigma of the drift beyond which the average is visibly blurred, px.
_UNKNOWN_PX = 1.0


def parse_scan_pairs(
    context: click.Context, parameter: click.Parameter, text: str | None
) -> float | None:
    """Callback of ``--scan-pairs``; in degrees."""
    angles = parse_tilts(context, parameter, text)
    if angles is None:
        return None
    if len(angles) != 1:
        raise click.BadParameter(f"{text!r} is not one angle such as 90")
    return math.degrees(angles[0])


@click.command("stack")
@recording_input
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
@click.option(
    "--scale-bar",
    is_flag=True,
    help="Append a strip with a scale bar and its uncertainty below the average.",
)
@no_drift_option("Average the frames where they are.")
@click.option(
    "--scan-pairs",
    metavar="ANGLE",
    callback=parse_scan_pairs,
    help="Of 2 to 12 frames, every second one was scanned with a scan rotation of 90 or -90 degrees (90: it shows the"
    " specimen turned clockwise): undo the drift within the scans, and average the square that all show.",
)
@interpolation_option("cubic")
@dask_option
def command(
    recording: RecordedFiles,
    output: Path,
    calibration: Path | None,
    sigma: Path | None,
    video: Path | None,
    fps: float,
    at: float | None,
    scale_bar: bool,
    no_drift: bool,
    scan_pairs: float | None,
    interpolation: str,
    config: MicroscopeConfig,
    dask: str | None,
) -> None:
    """Average of the frames of RECORDING, each moved to where the specimen was in the first one.

    Frames whose drift is not known are left out.

    \b
    Example:
      semcal stack recordings/gold --calibration cal.yaml -o gold.tif --video gold.mp4
    """
    outputs = (
        ("-o", output, IMAGE_SUFFIXES),
        ("--sigma", sigma, TIFF_SUFFIXES),
        ("--video", video, tuple(VIDEO_CODECS)),
    )
    check_outputs(outputs, recording=recording)
    with show_progress() as on_progress:
        result = stack(
            recording,
            calibration=calibration,
            config=config,
            at=at,
            drift=not no_drift,
            scan_pairs_deg=scan_pairs,
            interpolation=interpolation,
            video=video,
            fps=fps,
            output=output,
            sigma=sigma,
            scale_bar=scale_bar,
            dask=dask,
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
        echo_notes([f"{counted(result.other_kind, 'frame')} of another size or encoding left out"])
    echo_states(result.states)
    x_nm, y_nm = (1e9 * size for size in result.camera.pixel_size_m)
    click.echo(
        f"{result.image.frames} of {counted(len(result.used), 'frame')} averaged, "
        f"{x_nm:.6g} x {y_nm:.6g} nm per px"
    )
    if result.scan_drift is not None:
        _echo_scan_drift(result.scan_drift, result.camera.pixel_size_m[0])
    left_out = len(result.used) - result.image.frames
    if 2 * result.image.frames <= len(result.used):
        # Half of the frames: more of the recording is missing than is in the average.
        reasons = "; ".join(
            f"{counted(count, 'frame')}: {kind}" for kind, count in result.reasons.items()
        )
        click.echo(
            f"warning: {left_out} of {counted(len(result.used), 'frame')} left out: {reasons}",
            err=True,
        )
    elif result.lost:
        echo_notes([f"tracking was lost: {counted(result.lost, 'frame')} after that left out"])
    if result.scan_drift is not None:
        # Of two values each, the median of the scatter would be a third too small.
        error = result.image.standard_error
        rms = float(np.sqrt(np.nanmean(np.square(error))))
        click.echo(f"standard error: {rms:.4g} grey levels (RMS of the pixels)")
    elif result.typical_error is not None:
        click.echo(f"standard error: {result.typical_error:.4g} grey levels (median of the pixels)")


def _echo_scan_drift(drift: ScanPairDrift, pixel_size_m: float) -> None:
    """Print how far each scan was displaced while it was taken."""
    lines = np.linspace(drift.progress[0], drift.progress[-1], 101)
    for number, sigma in enumerate(drift.sigma_px):
        way_px = np.ptp(drift.at(number, lines), axis=0)
        x_nm, y_nm = 1e9 * pixel_size_m * way_px
        click.echo(
            f"scan {number + 1}: drift within {way_px[0]:.2f} px in x and {way_px[1]:.2f} px in y"
            f" ({x_nm:.3g} and {y_nm:.3g} nm) from {lines[0]:.0%} to {lines[-1]:.0%} of its lines;"
            f" 1-sigma {float(np.median(sigma)):.2g} px in the median, {float(sigma.max()):.2g} px at most"
        )
    if float(drift.sigma_px.max()) > _UNKNOWN_PX:
        click.echo(
            "warning: parts of the scans have too little structure to tell their drift; look at the average there",
            err=True,
        )
