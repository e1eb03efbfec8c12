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

from pathlib import Path
from typing import Any

import click

from semcal_ros.cli.options import (
    PATH,
    calibration_option,
    check_outputs,
    output_option,
    recording_argument,
    recording_options,
)
from semcal_ros.cli.output import echo_json, echo_notes, echo_paths, show_progress
from semcal_ros.files.meshes import MESH_SUFFIXES, UNITS_PER_M
from semcal_ros.workflows.reconstruct import reconstruct

__all__ = ["command"]


@click.command("reconstruct")
@recording_argument
@calibration_option(required=True)
@output_option("Mesh: .ply or .stl.")
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
    type=click.FloatRange(0.0),
    default=10e-6,
    show_default=True,
    metavar="M",
    help="1-sigma of the height above or below the plane of the calibration.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@recording_options
def command(
    recording: Path,
    calibration: Path,
    output: Path,
    cloud: Path | None,
    figure: Path | None,
    unit: str,
    spacing: float,
    keyframes: int,
    height_sigma: float,
    as_json: bool,
    config: str,
    frame_time: float | None,
) -> None:
    """Shape of a ball that turns in RECORDING: points, mesh, diameter.

    \b
    Example:
      semcal reconstruct recordings/ball --calibration cal.yaml -o ball.ply --figure ball.png
    """
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
            frame_time_s=frame_time,
            spacing_px=spacing,
            keyframes=keyframes,
            height_sigma_m=height_sigma,
            on_progress=on_progress,
        )
    done.save_mesh(output, unit=unit)
    if cloud is not None:
        done.save_cloud(cloud, unit=unit)
    if figure is not None:
        # Imported here, so that a run without a figure does not wait for matplotlib.
        from semcal_ros.report.ball_figures import write_ball_figure

        write_ball_figure(done.structure, done.ball, figure)
    if as_json:
        echo_json({**done.summary(), "notes": done.notes})
    else:
        _echo_summary(done.summary())
    echo_notes(done.notes)
    if not as_json:
        echo_paths({"mesh": output, "points": cloud, "image": figure})


def _echo_summary(result: dict[str, Any]) -> None:
    low, high = (1e9 * v for v in result["diameter_interval_m"])
    parts = {name: 1e9 * value for name, value in result["sigma_parts_m"].items()}
    click.echo(
        f"{result['points_on_ball']} points on the ball, {result['points']} in all, from "
        f"{result['views']} keyframes of {result['frames']} frames, RMS "
        f"{result['residual_rms_px']:.3f} px"
    )
    click.echo(
        f"diameter {1e9 * result['diameter_m']:.2f} nm, 95 % interval {low:.2f} to {high:.2f} nm"
    )
    click.echo(
        f"  1-sigma: noise {parts['noise']:.2f}, shape {parts['shape']:.2f}, scale "
        f"{parts['scale']:.2f} nm; depth {result['relief_sigma']:.2%}"
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
