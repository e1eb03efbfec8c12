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

"""``semcal measure``."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import click

from semcal_ros.applications.cantilever import group_frames
from semcal_ros.cli.options import FIGURE_SUFFIXES, options_of
from semcal_ros.cli.output import echo_notes, echo_paths, echo_table, show_progress
from semcal_ros.cli.recording_input import check_outputs, recordings_input
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.files.images.write import PixelScale
from semcal_ros.files.recordings import RecordedFiles
from semcal_ros.files.tables import TABLE_SUFFIXES
from semcal_ros.files.video import FPS_RANGE, VIDEO_CODECS
from semcal_ros.workflows.measure_cantilever import (
    CantileverMeasurement,
    CantileverOptions,
    measure_recorded_cantilever,
)
from semcal_ros.workflows.options import Option


@dataclass(frozen=True)
class CantileverOutputs:
    """What is written."""

    output: Annotated[
        Path,
        Option(
            "Table: .csv, .parquet or .xlsx.",
            kind="path",
            names=("-o", "--output"),
            required=True,
        ),
    ]
    plot: Annotated[Path | None, Option("Deflection of each pose: png, svg, pdf.", kind="path")] = (
        None
    )
    strip: Annotated[Path | None, Option("Annotated frames: png, svg or pdf.", kind="path")] = None
    video: Annotated[Path | None, Option("Annotated frames: .mp4 or .avi.", kind="path")] = None
    fps: Annotated[float, Option("Frames per second of the video.", between=FPS_RANGE)] = 4.0


@click.group("measure", context_settings={"help_option_names": ["-h", "--help"]})
def command() -> None:
    """Measure in nanometres, with uncertainty.

    \b
    Example:
      semcal measure cantilever bending --calibration cal.yaml --length 35e-6 -o bending.csv
    """


@command.command("cantilever")
@recordings_input
@options_of(CantileverOptions)
@options_of(CantileverOutputs, "outputs")
def cantilever(
    recordings: list[RecordedFiles],
    config: MicroscopeConfig,
    options: CantileverOptions,
    outputs: CantileverOutputs,
) -> None:
    """Bending of a cantilever in RECORDINGS: deflection of its free end in each frame.

    The first pose is the reference: there, nothing touches the cantilever. All magnifications may
    be in one recording or each in its own; their k-th poses are compared. Deflections are positive
    to the right as seen from the base.

    \b
    Example:
      semcal measure cantilever bending --calibration cal.yaml --length 35e-6 --poses 11 \\
          --config jsm820 -o bending.csv --plot bending.png --strip frames.png
    """
    check_outputs(
        [
            ("-o", outputs.output, TABLE_SUFFIXES),
            ("--plot", outputs.plot, FIGURE_SUFFIXES),
            ("--strip", outputs.strip, FIGURE_SUFFIXES),
            ("--video", outputs.video, tuple(VIDEO_CODECS)),
        ]
    )
    with show_progress() as on_progress:
        done = measure_recorded_cantilever(
            recordings, replace(options, config=config, on_progress=on_progress)
        )
    done.save(outputs.output)
    with show_progress("drawing"):
        _draw(done, outputs)
    echo_notes(done.notes)
    _echo_result(done)
    echo_paths(
        {
            "deflections": outputs.output,
            "plot": outputs.plot,
            "strip": outputs.strip,
            "video": outputs.video,
        }
    )


def _draw(done: CantileverMeasurement, outputs: CantileverOutputs) -> None:
    plot, strip, video = outputs.plot, outputs.strip, outputs.video
    if plot is None and strip is None and video is None:
        return
    # Imported here, so that a run without a figure does not wait for matplotlib.
    from semcal_ros.report.cantilever_figures import (
        write_bending_video,
        write_poses_figure,
        write_strip_figure,
    )

    images = [one.images for one in done.series]
    series = [one.measured for one in done.series]
    # These are raw images, whose pixels are as wide as the camera's.
    scales = [
        PixelScale(one.camera.pixel_size_m[0], max(one.camera.pixel_size_sigma_m))
        for one in done.series
    ]
    if plot is not None:
        write_poses_figure(done.repeatability, plot)
    if strip is not None:
        firsts = [group[0] for group in group_frames(len(images[0]), done.poses)]
        write_strip_figure(images, series, scales, firsts, strip)
    if video is not None:
        write_bending_video(images, series, scales, done.poses, outputs.fps, video)


def _echo_result(done: CantileverMeasurement) -> None:
    for one in done.series:
        label = f"{one.measured.magnification:g}x"
        echo_notes(f"{label}: {note}" for note in one.measured.notes)
        beam = one.measured.undeformed
        if math.isfinite(beam.length_m):
            length, sigma = 1e6 * beam.length_m, 1e6 * beam.length_sigma_m
            click.echo(f"{label}: {length:.4f} +- {sigma:.4f} um long by the calibration")
    agreed = done.repeatability
    headers = ["pose", *(f"{g:g}x nm" for g in agreed.magnifications), "spread nm"]
    rows = []
    for pose in range(agreed.deflection_m.shape[1]):
        cells = [
            f"{1e9 * v:.1f} +- {1e9 * s:.1f}"
            for v, s in zip(agreed.deflection_m[:, pose], agreed.sigma_m[:, pose], strict=True)
        ]
        rows.append([str(pose + 1), *cells, _format_nm(agreed.spread_m[pose])])
    echo_table(headers, rows)
    if len(done.series) > 1:
        click.echo(
            f"spread between magnifications (RMS, without pose 1): "
            f"{_format_nm(agreed.rms_spread_m)} nm calibrated, "
            f"{_format_nm(agreed.by_length_rms_spread_m)} nm by the known length; expected "
            f"{_format_nm(agreed.expected_spread_m)} nm"
        )


def _format_nm(length_m: float) -> str:
    return f"{1e9 * length_m:.2f}" if math.isfinite(length_m) else "-"
