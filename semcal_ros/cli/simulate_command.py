"""``semcal simulate``."""

from __future__ import annotations

from pathlib import Path

import click

from semcal_ros.cli.options import PATH, overwrite_option
from semcal_ros.cli.output import show_progress
from semcal_ros.synthetic import DRIFTS, PRESETS, SPECIMEN_KINDS
from semcal_ros.workflows.simulate import PLAN_KINDS, simulate

__all__ = ["command"]


@click.command("simulate")
@click.argument("output", type=PATH)
@click.option(
    "--plan",
    type=click.Choice(PLAN_KINDS),
    default="grid",
    show_default=True,
    help="Chess grid at many poses; one place under drift; steps of the magnification; a sweep of it.",
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
    help="grid, steps: repeat for each; drift: one; zoom: first and last.",
)
@click.option(
    "--views", type=click.IntRange(1), default=5, show_default=True, help="grid: poses each."
)
@click.option(
    "--frames", type=click.IntRange(1), help="drift, zoom: number of frames; steps: of each step."
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
    overwrite: bool,
) -> None:
    """Record the virtual SEM to the bag OUTPUT, with truth.json (SI units) beside it.

    \b
    Example:
      semcal simulate grid --plan grid --preset jsm820
      semcal simulate zoom --plan zoom --magnification 600 --magnification 6000
    """
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
            overwrite=overwrite,
            on_progress=on_progress,
        )
    click.echo(f"{count} frames: {output}")
