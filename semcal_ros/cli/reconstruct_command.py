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

"""``semcal reconstruct``."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click

from semcal_ros.applications.reconstruction.tilt_series import HeightMap
from semcal_ros.cli.options import (
    LENGTH_OR_ZERO,
    PATH,
    calibration_option,
    dask_option,
    output_option,
    parse_angle,
    parse_tilts,
)
from semcal_ros.cli.output import echo_json, echo_notes, echo_paths, show_progress
from semcal_ros.cli.recording_input import check_outputs, recording_input
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.wording import counted
from semcal_ros.files.meshes import MESH_SUFFIXES, UNITS_PER_M
from semcal_ros.files.recordings import RecordedFiles
from semcal_ros.files.tables import TABLE_SUFFIXES
from semcal_ros.workflows.measure_relief import RELIEF_SUFFIXES, measure_relief
from semcal_ros.workflows.reconstruct import reconstruct


@click.command("reconstruct")
@recording_input
@calibration_option("Needed for a ball; for tilted images it gives the pixel size and its 1-sigma.")
@output_option(
    "Mesh of a ball: .ply or .stl. Heights: .tif, or points as .ply, .csv, .parquet, .xlsx."
)
@click.option(
    "--tilts",
    callback=parse_tilts,
    metavar="ANGLE,...",
    help="Tilts of two or three images, such as 0deg,6deg,12deg (bare numbers are degrees), instead of those of the"
    " stage: measures heights.",
)
@click.option(
    "--tilt-axis",
    callback=parse_angle,
    metavar="ANGLE",
    help="About where the tilt axis points in the image, such as 90deg; its sense tells hills from dents.",
)
@click.option(
    "--tilt-sigma",
    callback=parse_angle,
    metavar="ANGLE",
    help="1-sigma of each tilt, such as 0.1deg, instead of that of the configuration.",
)
@click.option("--cloud", type=PATH, help="Also write all points: .ply.")
@click.option("--figure", type=PATH, help="Image of cloud and mesh: .png.")
@click.option(
    "--unit",
    type=click.Choice(list(UNITS_PER_M)),
    default="nm",
    show_default=True,
    help="Unit of lengths in the mesh and the cloud.",
)
@click.option(
    "--spacing",
    type=click.FloatRange(3.0, 100.0),
    default=5.0,
    show_default=True,
    help="Least distance of features in px.",
)
@click.option(
    "--keyframes",
    type=click.IntRange(3, 2000),
    default=150,
    show_default=True,
    help="Largest number of keyframes used.",
)
@click.option(
    "--height-sigma",
    type=LENGTH_OR_ZERO,
    default="10um",
    show_default=True,
    metavar="LENGTH",
    help="1-sigma of the height above or below the plane of the calibration.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@dask_option
def command(
    recording: RecordedFiles,
    calibration: Path | None,
    output: Path,
    tilts: tuple[float, ...] | None,
    tilt_axis: float | None,
    tilt_sigma: float | None,
    cloud: Path | None,
    figure: Path | None,
    unit: str,
    spacing: float,
    keyframes: int,
    height_sigma: float,
    as_json: bool,
    config: MicroscopeConfig,
    dask: str | None,
) -> None:
    """Heights from two or three tilted images, or the shape of a ball that turns in RECORDING.

    \b
    Examples:
      semcal reconstruct a.tif b.tif c.tif --tilts -7deg,0deg,7deg -o heights.tif --figure heights.png
      semcal reconstruct recordings/ball --calibration cal.yaml -o ball.ply --figure ball.png
    """
    if calibration is None or any(given is not None for given in (tilts, tilt_axis, tilt_sigma)):
        _measure_relief(
            recording,
            config,
            calibration,
            output,
            cloud,
            figure,
            unit=unit,
            tilts=tilts,
            tilt_axis=tilt_axis,
            tilt_sigma=tilt_sigma,
            as_json=as_json,
        )
        return
    check_outputs(
        [
            ("-o", output, MESH_SUFFIXES),
            ("--cloud", cloud, (".ply",)),
            ("--figure", figure, (".png",)),
        ]
    )
    with show_progress() as on_progress:
        done = reconstruct(
            recording,
            calibration=calibration,
            config=config,
            spacing_px=spacing,
            keyframes=keyframes,
            height_sigma_m=height_sigma,
            dask=dask,
            on_progress=on_progress,
        )
    done.save_mesh(output, unit=unit)
    if cloud is not None:
        done.save_cloud(cloud, unit=unit)
    if figure is not None:
        # Imported here, so that a run without a figure does not wait for matplotlib.
        from semcal_ros.report.reconstruction_figures import write_ball_figure

        with show_progress("drawing"):
            write_ball_figure(done.structure, done.ball, figure)
    if as_json:
        echo_json({**done.summary(), "notes": done.notes})
    else:
        _echo_summary(done.summary())
    echo_notes(done.notes)
    if not as_json:
        echo_paths({"mesh": output, "points": cloud, "image": figure})


def _measure_relief(
    recording: RecordedFiles,
    config: MicroscopeConfig,
    calibration: Path | None,
    output: Path,
    cloud: Path | None,
    figure: Path | None,
    *,
    unit: str,
    tilts: tuple[float, ...] | None,
    tilt_axis: float | None,
    tilt_sigma: float | None,
    as_json: bool,
) -> None:
    check_outputs(
        [
            ("-o", output, RELIEF_SUFFIXES),
            ("--cloud", cloud, (".ply", *TABLE_SUFFIXES)),
            ("--figure", figure, (".png",)),
        ],
        recording=recording,
    )
    with show_progress() as on_progress:
        done = measure_relief(
            recording,
            tilts_rad=tilts,
            axis_rad=tilt_axis,
            tilt_sigma_rad=tilt_sigma,
            calibration=calibration,
            config=config,
            on_progress=on_progress,
        )
    done.save(output, unit=unit)
    if cloud is not None:
        done.save(cloud, unit=unit)
    if figure is not None:
        # Imported here, so that a run without a figure does not wait for matplotlib.
        from semcal_ros.report.reconstruction_figures import write_relief_figure

        with show_progress("drawing"):
            write_relief_figure(done.heights, figure)
    if as_json:
        echo_json({**done.summary(), "notes": done.notes})
    else:
        _echo_relief(done.heights)
    echo_notes(done.notes)
    if not as_json:
        echo_paths({"heights": output, "points": cloud, "image": figure})


def _echo_relief(found: HeightMap) -> None:
    for pair in found.pairs:
        click.echo(
            f"{len(pair.first)} of {counted(pair.matches, 'match', 'matches')} agree with a tilt, RMS "
            f"{pair.rms_px:.2f} px; axis at {math.degrees(pair.axis_rad):.2f} +- "
            f"{math.degrees(pair.covariance[0, 0] ** 0.5):.2f} deg"
        )
    click.echo(
        f"relief {1e6 * found.relief_m:.4g} um, RMS {1e6 * found.rms_m:.4g} um, 1-sigma "
        f"{1e6 * found.median_sigma_m:.2g} um (median), of {found.coverage:.0%} of image {found.reference + 1}"
    )
    if found.relief_ratio is not None:
        click.echo(
            f"relief of the second pair over that of the first: {found.relief_ratio:.3f}, expected 1 +- "
            f"{found.relief_ratio_sigma:.3f}"
        )


def _echo_summary(result: dict[str, Any]) -> None:
    low, high = (1e9 * v for v in result["diameter_interval_m"])
    parts = {name: 1e9 * value for name, value in result["sigma_parts_m"].items()}
    click.echo(
        f"{counted(result['points_on_ball'], 'point')} on the ball, {result['points']} in all, from "
        f"{counted(result['views'], 'keyframe')} of {counted(result['frames'], 'frame')}, RMS "
        f"{result['residual_rms_px']:.3f} px"
    )
    click.echo(
        f"diameter {1e9 * result['diameter_m']:.2f} nm, 95 % interval {low:.2f} to {high:.2f} nm"
    )
    click.echo(
        f"  1-sigma: noise {parts['noise']:.2f}, shape {parts['shape']:.2f}, scale "
        f"{parts['scale']:.2f}, patches {parts['patches']:.2f} nm; depth {result['relief_sigma']:.2%}"
    )
    click.echo(f"  points about the sphere: RMS {1e9 * result['sphere_rms_m']:.2f} nm")
    departure = result["departure"]
    click.echo(
        f"  {'a ball' if result['is_ball'] else 'NOT A BALL'}: the most significant departure is "
        f"{1e9 * departure['height_m']:+.1f} +- {1e9 * departure['height_sigma_m']:.1f} nm "
        f"({departure['kind']}), by chance with a probability of {departure['probability']:.2g}"
    )
    kind = "watertight" if result["watertight"] else "open where nothing was seen"
    click.echo(
        f"mesh: {result['vertices']} vertices, {result['faces']} faces, "
        f"{result['coverage']:.0%} of the sphere, {kind}"
    )
    click.echo(
        f"mirror image excluded because {result['convexity']:.0%} of the surface bulges towards "
        f"the gun; perspective alone: {result['mirror_sigma']:+.1f} sigma"
    )
