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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import click

from semcal_ros.applications.reconstruction.tilt_series import HeightMap
from semcal_ros.cli.options import options_of
from semcal_ros.cli.output import echo_json, echo_notes, echo_paths, show_progress
from semcal_ros.cli.recording_input import check_outputs, recording_input
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.wording import counted
from semcal_ros.files.meshes import MESH_SUFFIXES, UNITS_PER_M
from semcal_ros.files.recordings import RecordedFiles
from semcal_ros.files.tables import TABLE_SUFFIXES
from semcal_ros.workflows.measure_relief import (
    RELIEF_SUFFIXES,
    ReliefOptions,
    measure_recorded_relief,
)
from semcal_ros.workflows.options import Option
from semcal_ros.workflows.reconstruct import ReconstructOptions, reconstruct_ball


@dataclass(frozen=True)
class ReconstructOutputs:
    """What is written and printed."""

    output: Annotated[
        Path,
        Option(
            "Mesh of a ball: .ply or .stl. Heights: .tif, or points as .ply, .csv, .parquet, .xlsx.",
            kind="path",
            names=("-o", "--output"),
            required=True,
        ),
    ]
    cloud: Annotated[Path | None, Option("Also write all points: .ply.", kind="path")] = None
    figure: Annotated[Path | None, Option("Image of cloud and mesh: .png.", kind="path")] = None
    unit: Annotated[
        str, Option("Unit of lengths in the mesh and the cloud.", choices=tuple(UNITS_PER_M))
    ] = "nm"
    as_json: Annotated[bool, Option("Print the result as JSON.", names=("--json",))] = False

    def check(
        self,
        output: Sequence[str],
        cloud: Sequence[str],
        recording: RecordedFiles | None = None,
    ) -> None:
        """Refuse files with other suffixes, and those that would replace a part of the recording."""
        outputs = [
            ("-o", self.output, output),
            ("--cloud", self.cloud, cloud),
            ("--figure", self.figure, (".png",)),
        ]
        check_outputs(outputs, recording=recording)

    def echo(self, name: str) -> None:
        """Say what was written, unless JSON was asked for; ``name`` is that of the first file."""
        if not self.as_json:
            echo_paths({name: self.output, "points": self.cloud, "image": self.figure})


@click.command("reconstruct")
@recording_input
@options_of(ReconstructOutputs, "outputs")
@options_of(ReliefOptions, "relief")
@options_of(ReconstructOptions)
def command(
    recording: RecordedFiles,
    config: MicroscopeConfig,
    outputs: ReconstructOutputs,
    relief: ReliefOptions,
    options: ReconstructOptions,
) -> None:
    """Heights from two or three tilted images, or the shape of a ball that turns in RECORDING.

    \b
    Examples:
      semcal reconstruct a.tif b.tif c.tif --tilts -7deg,0deg,7deg -o heights.tif --figure heights.png
      semcal reconstruct recordings/ball --calibration cal.yaml -o ball.ply --figure ball.png
    """
    stated = (relief.tilts_rad, relief.axis_rad, relief.tilt_sigma_rad)
    if options.calibration is None or any(given is not None for given in stated):
        known = replace(relief, config=config, calibration=options.calibration)
        _measure_relief(recording, outputs, known)
        return
    outputs.check(MESH_SUFFIXES, (".ply",))
    with show_progress() as on_progress:
        done = reconstruct_ball(recording, replace(options, config=config, on_progress=on_progress))
    done.save_mesh(outputs.output, unit=outputs.unit)
    if outputs.cloud is not None:
        done.save_cloud(outputs.cloud, unit=outputs.unit)
    if outputs.figure is not None:
        # Imported here, so that a run without a figure does not wait for matplotlib.
        from semcal_ros.report.reconstruction_figures import write_ball_figure

        with show_progress("drawing"):
            write_ball_figure(done.structure, done.ball, outputs.figure)
    if outputs.as_json:
        echo_json({**done.summary(), "notes": done.notes})
    else:
        _echo_summary(done.summary())
    echo_notes(done.notes)
    outputs.echo("mesh")


def _measure_relief(
    recording: RecordedFiles, outputs: ReconstructOutputs, relief: ReliefOptions
) -> None:
    outputs.check(RELIEF_SUFFIXES, (".ply", *TABLE_SUFFIXES), recording)
    with show_progress() as on_progress:
        done = measure_recorded_relief(recording, replace(relief, on_progress=on_progress))
    done.save(outputs.output, unit=outputs.unit)
    if outputs.cloud is not None:
        done.save(outputs.cloud, unit=outputs.unit)
    if outputs.figure is not None:
        # Imported here, so that a run without a figure does not wait for matplotlib.
        from semcal_ros.report.reconstruction_figures import write_relief_figure

        with show_progress("drawing"):
            write_relief_figure(done.heights, outputs.figure)
    if outputs.as_json:
        echo_json({**done.summary(), "notes": done.notes})
    else:
        _echo_relief(done.heights)
    echo_notes(done.notes)
    outputs.echo("heights")


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
