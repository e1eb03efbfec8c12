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

"""``semcal simulate``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import click

from semcal_ros.cli.options import (
    LENGTH_OR_ZERO,
    PATH,
    Command,
    overwrite_option,
    parse_ratio,
)
from semcal_ros.cli.output import show_progress
from semcal_ros.core.wording import counted
from semcal_ros.synthetic import (
    DRIFTS,
    PRESETS,
    SPECIMEN_KINDS,
    STAGES,
    TYPICAL_GRID,
    make_stage,
)
from semcal_ros.workflows.simulate import MOST_FRAMES, MOST_VIEWS, PLAN_KINDS, simulate


def _ratio_option(*names: str, default: str, text: str) -> Callable[[Command], Command]:
    """Return an option that takes a ratio such as ``0.1%``."""
    return click.option(
        *names, default=default, show_default=True, callback=parse_ratio, metavar="RATIO", help=text
    )


@click.command("simulate")
@click.argument("output", type=PATH)
@click.option(
    "--plan",
    type=click.Choice(PLAN_KINDS),
    default="grid",
    show_default=True,
    help="Chess grid at many poses; one place under drift; steps of the magnification; a sweep of it; a specimen "
    "beyond the grid.",
)
@click.option(
    "--preset", "name", type=click.Choice(sorted(PRESETS)), default="jsm820", show_default=True
)
@click.option(
    "--specimen", type=click.Choice(SPECIMEN_KINDS), help="Specimen of all plans but grid."
)
@click.option(
    "--drift", "drift_name", type=click.Choice(sorted(DRIFTS)), help="Drift of the specimen."
)
@click.option(
    "--magnification",
    "magnifications",
    type=float,
    multiple=True,
    help="grid, steps: repeat for each; drift: one; zoom, ladder: first and last.",
)
@click.option(
    "--views",
    type=click.IntRange(1, MOST_VIEWS),
    default=5,
    show_default=True,
    help="grid, ladder: poses each.",
)
@click.option(
    "--frames",
    type=click.IntRange(1, MOST_FRAMES),
    help="drift, zoom: number of frames; steps: of each step.",
)
@click.option(
    "--size",
    type=click.IntRange(32, 8192),
    default=512,
    show_default=True,
    help="Width and height.",
)
@click.option("--bits", type=click.Choice(["8", "16"]), default="8", show_default=True)
@click.option(
    "--electrons", type=click.FloatRange(0), help="Electrons per pixel; 0 for no shot noise."
)
@click.option("--blur", type=click.FloatRange(0), help="Sigma of the beam in px.")
@click.option("--seed", type=int, default=0, show_default=True)
@click.option(
    "--stage",
    "stage_name",
    type=click.Choice(tuple(STAGES)),
    default="one-axis",
    show_default=True,
    help="One tilt axis, which says its tilt; or tilts in every direction, as no stage does.",
)
@click.option(
    "--eucentric-error",
    "eucentric_error_m",
    type=LENGTH_OR_ZERO,
    metavar="LENGTH",
    help="How far the axis of a one-axis stage misses the specimen.  [default: 100um]",
)
@_ratio_option(
    "--repeatability",
    default="0.15%",
    text="1-sigma of the scale, each time that a magnification is set.",
)
@_ratio_option("--grid-stretch", default="0.02%", text="Difference of the grid's axes.")
@_ratio_option(
    "--grid-shear", default="0.01%", text="How far the grid's axes are from a right angle."
)
@click.option(
    "--grid-bow",
    "grid_radius_m",
    default="1m",
    show_default=True,
    type=LENGTH_OR_ZERO,
    metavar="RADIUS",
    help="Radius to which the grid is bowed; 0 for a flat one.",
)
@_ratio_option("--grid-wave", default="0%", text="Amplitude of a wave in its rows, of a square.")
@_ratio_option(
    "--grid-squares", "squares_sigma", default="0.02%", text="1-sigma of each size of its squares."
)
@click.option(
    "--line-jitter",
    "line_jitter_px",
    type=click.FloatRange(0),
    default=0.05,
    show_default=True,
    help="1-sigma of the shift of each scan line in px.",
)
@overwrite_option
def command(
    output: Path,
    plan: str,
    name: str,
    specimen: str | None,
    drift_name: str | None,
    magnifications: tuple[float, ...],
    views: int,
    frames: int | None,
    size: int,
    bits: str,
    electrons: float | None,
    blur: float | None,
    seed: int,
    stage_name: str,
    eucentric_error_m: float | None,
    repeatability: float,
    grid_stretch: float,
    grid_shear: float,
    grid_radius_m: float,
    grid_wave: float,
    squares_sigma: float,
    line_jitter_px: float,
    overwrite: bool,
) -> None:
    """Record the virtual SEM to the bag OUTPUT, with truth.json (SI units) beside it.

    \b
    Example:
      semcal simulate grid --plan grid --preset jsm820
      semcal simulate worn --eucentric-error 300um --repeatability 0.4% --grid-stretch 0.1%
      semcal simulate ladder --plan ladder
      semcal simulate zoom --plan zoom --magnification 600 --magnification 6000
    """
    stage = make_stage(
        stage_name,
        eucentric_error_m=eucentric_error_m,
        repeatability=repeatability,
        line_jitter_px=line_jitter_px,
    )
    grid = replace(
        TYPICAL_GRID,
        stretch=grid_stretch,
        shear=grid_shear,
        curvature=1.0 / grid_radius_m if grid_radius_m > 0.0 else 0.0,
        wave=grid_wave,
        squares_sigma=squares_sigma,
    )
    with show_progress() as on_progress:
        count = simulate(
            output,
            plan,
            microscope=name,
            specimen=specimen,
            drift=drift_name,
            magnifications=magnifications,
            views=views,
            frames=frames,
            size=size,
            bits=int(bits),
            electrons=electrons,
            blur_px=blur,
            seed=seed,
            stage=stage,
            grid=grid,
            overwrite=overwrite,
            on_progress=on_progress,
        )
    click.echo(f"{counted(count, 'frame')}: {output}")
