"""``semcal reconstruct``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np

from semcal_ros.applications.reconstruction import (
    Ball,
    SequenceTracker,
    Structure,
    TrackerSettings,
    measure_ball,
    reconstruct,
)
from semcal_ros.bridge.images import to_gray
from semcal_ros.calibration import Calibration
from semcal_ros.cli.common import (
    config_option,
    configured,
    echo_json,
    progress,
    require_folder,
    require_suffix,
)
from semcal_ros.cli.drift_common import frame_time_option
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.atomic import atomic_write_bytes
from semcal_ros.files.meshes import MESH_SUFFIXES, UNITS_PER_M, save_cloud, save_mesh
from semcal_ros.files.recordings import Recording, open_recording
from semcal_ros.workflows.follow_drift import camera_of, start_time_s, with_frame_time

__all__ = ["command"]


@click.command("reconstruct")
@click.argument("recording", type=click.Path(path_type=Path))
@click.option("--calibration", required=True, type=click.Path(path_type=Path))
@click.option(
    "-o", "--output", required=True, type=click.Path(path_type=Path), help="Mesh: .ply or .stl."
)
@click.option("--cloud", type=click.Path(path_type=Path), help="All points, as .ply.")
@click.option("--figure", type=click.Path(path_type=Path), help="Picture of cloud and mesh: .png.")
@click.option(
    "--unit",
    type=click.Choice(list(UNITS_PER_M)),
    default="nm",
    show_default=True,
    help="Of lengths in the mesh and the cloud.",
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
    help="Most of them that are used.",
)
@click.option(
    "--height-sigma",
    type=click.FloatRange(0.0),
    default=40e-6,
    show_default=True,
    metavar="M",
    help="1-sigma of the height above or below the plane of the calibration.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON.")
@config_option
@frame_time_option
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
    _check_outputs(output, cloud, figure)
    model = Calibration.load(calibration)
    microscope = with_frame_time(configured(config, model), frame_time)
    tracker = SequenceTracker(TrackerSettings(spacing_px=spacing))
    with open_recording(recording, microscope) as opened:
        outside = _track(opened, model, tracker)
        notes = list(opened.notes)
    chosen = _spread(tracker.finish(), keyframes)
    with progress(None, "reconstructing") as bar:
        structure = reconstruct(chosen, microscope.scan, on_step=_shown(bar))
        ball = measure_ball(structure, height_sigma_m=height_sigma)
    save_mesh(output, ball.mesh, unit=unit)
    if cloud is not None:
        _save_cloud(cloud, structure, ball, unit)
    if figure is not None:
        from semcal_ros.report.ball_figures import render_ball

        atomic_write_bytes(figure, render_ball(structure, ball))
    if outside:
        notes.append(f"{outside} frames are outside of the calibrated range")
    notes += _doubts(structure, microscope.scan is not None)
    result = _result(structure, ball, tracker.frames)
    if as_json:
        echo_json({**result, "notes": notes})
    else:
        _tell(result)
    for note in notes:
        click.echo(f"note: {note}", err=True)
    if not as_json:
        for name, path in (("mesh", output), ("points", cloud), ("picture", figure)):
            if path is not None:
                click.echo(f"{name}: {path}")


def _check_outputs(output: Path, cloud: Path | None, figure: Path | None) -> None:
    wanted = ((output, MESH_SUFFIXES, "-o"), (cloud, (".ply",), "--cloud"))
    seen: set[Path] = set()
    for path, suffixes, option in (*wanted, (figure, (".png",), "--figure")):
        if path is None:
            continue
        require_suffix(path, suffixes, option)
        require_folder(path)
        if path.resolve() in seen:
            raise InvalidValueError(
                f"{option} {path} is another output", expected="a file of its own"
            )
        seen.add(path.resolve())


def _track(opened: Recording, model: Calibration, tracker: SequenceTracker) -> int:
    """Track all frames; returns how many were outside of the calibrated range."""
    first, outside = None, 0
    with progress(opened.frame_count, "tracking") as bar:
        for frame in opened.frames():
            first = frame.stamp_ns if first is None else first
            camera = camera_of(frame, model, opened.config)
            outside += not camera.in_range
            grey = to_gray(frame.image, frame.encoding)
            tracker.add(grey, camera, start_time_s(frame, first, opened.config))
            bar.update(1)
    return outside


def _spread(keyframes: list[Any], most: int) -> list[Any]:
    """At most so many keyframes, evenly spread."""
    if len(keyframes) <= most:
        return keyframes
    chosen = np.unique(np.linspace(0, len(keyframes) - 1, most).round().astype(int))
    return [keyframes[int(k)] for k in chosen]


def _shown(bar: Any) -> Callable[[str], None]:
    def show(step: str) -> None:
        bar.set_description_str(step)

    return show


def _save_cloud(path: Path, structure: Structure, ball: Ball, unit: str) -> None:
    normals = structure.normals
    columns = {
        "nx": normals[:, 0],
        "ny": normals[:, 1],
        "nz": normals[:, 2],
        "sigma": structure.normal_sigma_m * UNITS_PER_M[unit],
        "on_ball": ball.sphere.inliers.astype(float),
    }
    save_cloud(path, structure.points_m, columns, unit=unit)


def _doubts(structure: Structure, timed: bool) -> list[str]:
    notes = []
    if structure.unplaced:
        notes.append(f"{structure.unplaced} keyframes could not be linked to the others")
    if structure.convexity < 0.8:
        notes.append(
            f"only {structure.convexity:.0%} of the surface bulges towards the gun: it could be "
            "its mirror image"
        )
    if structure.mirror_sigma < -4.0:
        notes.append("the perspective of the camera prefers the mirror image")
    if structure.relief_sigma > 0.01:
        notes.append(
            f"depth is uncertain by {structure.relief_sigma:.1%} (1-sigma): turn the specimen more"
        )
    if not timed:
        notes.append(
            "the scan timing is not configured: movement within frames is left in; give the time "
            "of one pass as --frame-time or in a configuration"
        )
    if not structure.adjustment.converged:
        notes.append("the adjustment did not converge")
    if not structure.settled:
        notes.append(
            f"measuring did not settle in {structure.passes} passes: points still moved by more than"
            " half of their 1-sigma"
        )
    return notes


def _result(structure: Structure, ball: Ball, frames: int) -> dict[str, Any]:
    counts = np.bincount(structure.observations.point, minlength=len(structure.points_m))
    return {
        "frames": frames,
        "views": len(structure.cameras),
        "points": len(structure.points_m),
        "points_on_ball": int(np.count_nonzero(ball.sphere.inliers)),
        "passes": structure.passes,
        "median_views_per_point": float(np.median(counts)),
        "residual_rms_px": structure.adjustment.rms_px,
        "vertices": len(ball.mesh.vertices_m),
        "faces": len(ball.mesh.faces),
        "watertight": ball.mesh.watertight,
        "coverage": ball.coverage,
        "diameter_m": ball.diameter_m,
        "diameter_sigma_m": ball.sigma_m,
        "diameter_interval_m": list(ball.interval_m),
        "sigma_parts_m": {
            "noise": ball.noise_sigma_m,
            "shape": ball.shape_sigma_m,
            "scale": ball.scale_sigma_m,
        },
        "sphere_rms_m": ball.sphere.rms_m,
        "relief_sigma": structure.relief_sigma,
        "relief_condition": structure.relief_condition,
        "convexity": structure.convexity,
        "mirror_sigma": structure.mirror_sigma,
    }


def _tell(result: dict[str, Any]) -> None:
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
    kind = "watertight" if result["watertight"] else "open where nothing was seen"
    click.echo(
        f"mesh: {result['vertices']} vertices, {result['faces']} faces, "
        f"{result['coverage']:.0%} of the sphere, {kind}"
    )
    click.echo(
        f"mirror image excluded because {result['convexity']:.0%} of the surface bulges towards "
        f"the gun; perspective alone: {result['mirror_sigma']:+.1f} sigma"
    )
