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
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from semcal_ros.applications.cantilever import SHAPES, group_frames
from semcal_ros.cli.options import FIGURE_SUFFIXES, LENGTH, PATH, calibration_option, output_option
from semcal_ros.cli.output import echo_notes, echo_paths, echo_table, show_progress
from semcal_ros.cli.recording_input import check_outputs, recordings_input
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.files.images.write import PixelScale
from semcal_ros.files.recordings import RecordedFiles
from semcal_ros.files.tables import TABLE_SUFFIXES
from semcal_ros.files.video import FPS_RANGE, VIDEO_CODECS
from semcal_ros.workflows.measure_cantilever import CantileverMeasurement, measure_cantilever

if TYPE_CHECKING:
    PairParam = click.ParamType[tuple[float, float]]
else:
    PairParam = click.ParamType


class _PixelType(PairParam):
    """Two numbers: column and row."""

    name = "X,Y"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        if isinstance(value, tuple):
            return value
        try:
            x, y = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not a pair of pixel coordinates such as 120.5,300", param, ctx)
        if not (math.isfinite(x) and math.isfinite(y)):
            self.fail(f"{value!r} is not finite", param, ctx)
        return x, y


@click.group("measure", context_settings={"help_option_names": ["-h", "--help"]})
def command() -> None:
    """Measure in nanometres, with uncertainty.

    \b
    Example:
      semcal measure cantilever bending --calibration cal.yaml --length 35e-6 -o bending.csv
    """


@command.command("cantilever")
@recordings_input
@calibration_option(required=True)
@click.option(
    "--length",
    required=True,
    type=LENGTH,
    metavar="LENGTH",
    help="Length of the cantilever, such as 35um; a bare number is in m.",
)
@output_option("Table: .csv, .parquet or .xlsx.")
@click.option("--plot", type=PATH, help="Deflection of each pose: png, svg, pdf.")
@click.option("--strip", type=PATH, help="Annotated frames: png, svg or pdf.")
@click.option("--video", type=PATH, help="Annotated frames: .mp4 or .avi.")
@click.option("--fps", type=click.FloatRange(*FPS_RANGE), default=4.0, show_default=True)
@click.option(
    "--poses",
    type=click.IntRange(1),
    metavar="N",
    help="Number of poses at each magnification, with equally many frames each; "
    "by default, each frame is a pose.",
)
@click.option(
    "--shape",
    type=click.Choice(SHAPES),
    default="free",
    show_default=True,
    help="Shape of the bent beam: terms of second and third order; a beam loaded at its end; second order.",
)
@click.option(
    "--base",
    "bases",
    type=_PixelType(),
    multiple=True,
    help="Base of the cantilever in the first frame, if it is not found automatically; "
    "once, or once for each magnification in the order of the recording.",
)
@click.option(
    "--tip", "tips", type=_PixelType(), multiple=True, help="Free end of the cantilever, likewise."
)
def cantilever(
    recordings: list[RecordedFiles],
    calibration: Path,
    length: float,
    output: Path,
    plot: Path | None,
    strip: Path | None,
    video: Path | None,
    fps: float,
    poses: int | None,
    shape: str,
    bases: tuple[tuple[float, float], ...],
    tips: tuple[tuple[float, float], ...],
    config: MicroscopeConfig,
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
            ("-o", output, TABLE_SUFFIXES),
            ("--plot", plot, FIGURE_SUFFIXES),
            ("--strip", strip, FIGURE_SUFFIXES),
            ("--video", video, tuple(VIDEO_CODECS)),
        ]
    )
    with show_progress() as on_progress:
        done = measure_cantilever(
            recordings,
            calibration=calibration,
            length_m=length,
            poses=poses,
            shape=shape,
            bases=bases,
            tips=tips,
            config=config,
            on_progress=on_progress,
        )
    done.save(output)
    with show_progress("drawing"):
        _draw(done, plot, strip, video, fps)
    echo_notes(done.notes)
    _echo_result(done)
    echo_paths({"deflections": output, "plot": plot, "strip": strip, "video": video})


def _draw(
    done: CantileverMeasurement,
    plot: Path | None,
    strip: Path | None,
    video: Path | None,
    fps: float,
) -> None:
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
        write_bending_video(images, series, scales, done.poses, fps, video)


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
