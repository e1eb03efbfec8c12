"""``semcal simulate``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import click

from semcal_ros.cli.options import PATH, overwrite_option
from semcal_ros.cli.output import show_progress
from semcal_ros.core.arrays import AnyImage
from semcal_ros.files.bags.simulated import write_simulated
from semcal_ros.synthetic import (
    CALIBRATION_MAGNIFICATIONS,
    DRIFTS,
    PRESETS,
    SPECIMEN_KINDS,
    Detector,
    RecordingPlan,
    VirtualMicroscope,
    calibration_plan,
    drift_plan,
    drift_preset,
    preset,
    steps_plan,
    truth_of,
    zoom_plan,
)
from semcal_ros.workflows.inputs import count_frames

__all__ = ["command"]


@click.command("simulate")
@click.argument("output", type=PATH)
@click.option(
    "--plan",
    type=click.Choice(["grid", "drift", "steps", "zoom"]),
    default="grid",
    show_default=True,
    help="Chess grid at many poses; one place under drift; steps or a sweep of the magnification.",
)
@click.option(
    "--preset", "name", type=click.Choice(sorted(PRESETS)), default="jsm820", show_default=True
)
@click.option("--specimen", type=click.Choice(SPECIMEN_KINDS), help="All but grid: what is seen.")
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
@click.option("--electrons", type=click.FloatRange(0), help="Per pixel; 0 for no shot noise.")
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
    _check_magnifications(plan, magnifications)
    microscope = preset(name)
    if size != microscope.width:
        microscope = microscope.with_image_size(size, size)
    detector = Detector(bits=int(bits))
    if electrons is not None:
        detector = replace(detector, electrons=electrons)
    if blur is not None:
        detector = replace(detector, blur_px=blur)
    recording = _make_plan(
        plan, microscope, detector, specimen, drift_name, magnifications, views, frames, seed
    )
    with show_progress() as on_progress:
        advance = count_frames(on_progress, "simulating", len(recording))
        write_simulated(
            output,
            recording.frames,
            _render(recording, advance),
            truth_of(recording),
            overwrite=overwrite,
        )
    click.echo(f"{len(recording)} frames: {output}")


def _render(recording: RecordingPlan, advance: Callable[[int], object]) -> Iterator[AnyImage]:
    for index in range(len(recording)):
        yield recording.render(index)
        advance(1)


def _check_magnifications(plan: str, values: tuple[float, ...]) -> None:
    if any(not (math.isfinite(g) and g > 0) for g in values):
        raise click.BadParameter("magnifications are finite and greater than 0")
    wanted = {"drift": (0, 1), "zoom": (0, 2)}.get(plan)
    if wanted is not None and len(values) not in wanted:
        raise click.BadParameter(
            f"--plan {plan} takes {wanted[1]} --magnification, not {len(values)}"
        )


def _make_plan(
    plan: str,
    microscope: VirtualMicroscope,
    detector: Detector,
    specimen: str | None,
    drift_name: str | None,
    magnifications: tuple[float, ...],
    views: int,
    frames: int | None,
    seed: int,
) -> RecordingPlan:
    if plan == "grid":
        chosen = magnifications or CALIBRATION_MAGNIFICATIONS
        made = calibration_plan(
            microscope, magnifications=sorted(chosen), views=views, detector=detector, seed=seed
        )
    elif plan == "drift":
        made = drift_plan(
            microscope,
            magnification=magnifications[0] if magnifications else 5000.0,
            frames=frames or 48,
            kind=specimen or "gold",
            drift=drift_preset(drift_name or "settling"),
            detector=detector,
            seed=seed,
        )
    elif plan == "steps":
        made = steps_plan(
            microscope,
            magnifications=magnifications or (500.0, 2000.0, 8000.0),
            frames=frames or 12,
            kind=specimen or "grid",
            detector=detector,
            seed=seed,
        )
    else:
        first, last = magnifications or (600.0, 6000.0)
        made = zoom_plan(
            microscope,
            first_magnification=first,
            last_magnification=last,
            frames=frames or 36,
            kind=specimen or "grid",
            detector=detector,
            seed=seed,
        )
    if drift_name is not None:
        made = replace(made, drift=drift_preset(drift_name))
    return made
