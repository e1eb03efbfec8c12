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

from dataclasses import replace
from pathlib import Path

import click
import numpy as np

from semcal_ros.cli.options import options_of
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
from semcal_ros.files.video import VIDEO_CODECS
from semcal_ros.workflows.stack import StackOptions, StackResult, stack_recording


@click.command("stack")
@recording_input
@options_of(StackOptions)
def command(recording: RecordedFiles, config: MicroscopeConfig, options: StackOptions) -> None:
    """Average of the frames of RECORDING, each moved to where the specimen was in the first one.

    Frames whose drift is not known are left out.

    \b
    Example:
      semcal stack recordings/gold --calibration cal.yaml -o gold.tif --video gold.mp4
    """
    written = {
        name: None if given is None else Path(given)
        for name, given in (
            ("-o", options.output),
            ("--sigma", options.sigma),
            ("--video", options.video),
        )
    }
    suffixes = (IMAGE_SUFFIXES, TIFF_SUFFIXES, tuple(VIDEO_CODECS))
    outputs = [(*one, ends) for one, ends in zip(written.items(), suffixes, strict=True)]
    check_outputs(outputs, recording=recording)
    with show_progress() as on_progress:
        result = stack_recording(
            recording, replace(options, config=config, on_progress=on_progress)
        )
    _echo_result(result)
    echo_paths(dict(zip(("average", "standard error", "video"), written.values(), strict=True)))


def _echo_result(result: StackResult) -> None:
    echo_notes(result.notes)
    if not result.is_calibrated:
        echo_nominal_unit(result.config.display_width_m, "the pixel size is the nominal one")
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
    for warning in result.warnings:
        click.echo(f"warning: {warning}", err=True)
    if result.lost and 2 * result.image.frames > len(result.used):
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
