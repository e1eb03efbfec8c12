"""Views of the grid on a stage as real ones are, with known truth and without images.

It shares neither priors nor equations with the calibration: the specimen is a rigid body that is
turned about axes in space, and its points are projected by the true camera.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.scan_camera import ScanCamera

__all__ = ["StageOfTests", "stage_views"]


@dataclass(frozen=True)
class StageOfTests:
    """A stage and a grid with their faults.

    Attributes
    ----------
    tilts_rad
        Tilts that each visit has.
    axis_rad
        Direction of the tilt axis.
    miss_m
        Where the axis lies: beside the beam, across its own direction, and below the specimen.
    height_sigma_m, visit_height_sigma_m, scale_sigma, drift_sigma_px
        Spread of the height of a view, of a visit, of the scale of a visit, and of the drift.
    tilt_error_rad, reading_sigma_rad
        Constant error of the tilt that is read, and its scatter.
    stretch, shear, curvature
        Shape of the grid.
    line_jitter_px
        1-sigma of the shift of each line.
    """

    tilts_rad: tuple[float, ...] = (0.0, 0.35, 0.55, 0.7)
    axis_rad: float = 0.2
    miss_m: tuple[float, float] = (0.0, 0.0)
    height_sigma_m: float = 1e-5
    visit_height_sigma_m: float = 0.0
    scale_sigma: float = 0.0
    drift_sigma_px: float = 0.0
    tilt_error_rad: float = 0.0
    reading_sigma_rad: float = 0.0
    stretch: float = 0.0
    shear: float = 0.0
    curvature: float = 0.0
    line_jitter_px: float = 0.0


def _turn(axis: Sequence[float], angle: float) -> Array:
    """Rodrigues' formula."""
    x, y, z = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)


def stage_views(
    camera_at: Callable[[float], ScanCamera],
    visits: Sequence[float],
    stage: StageOfTests,
    *,
    noise_px: float = 0.05,
    seed: int = 0,
    readings: bool = False,
    square_px: float = 40.0,
    turn_rad: float = np.pi,
) -> list[GridView]:
    """Record the visits, in this order of magnifications, with all tilts at each.

    The specimen is turned by up to ``turn_rad`` either way before every view.
    """
    rng = np.random.default_rng(seed)
    across = np.array([-np.sin(stage.axis_rad), np.cos(stage.axis_rad), 0.0])
    along = np.array([np.cos(stage.axis_rad), np.sin(stage.axis_rad), 0.0])
    pivot = stage.miss_m[0] * across + stage.miss_m[1] * np.array([0.0, 0.0, 1.0])
    out = []
    for number, g in enumerate(visits):
        camera = camera_at(g)
        scale = 1.0 + stage.scale_sigma * rng.normal()
        level = stage.visit_height_sigma_m * rng.normal()
        for k, tilt in enumerate(stage.tilts_rad):
            turn = rng.uniform(-turn_rad, turn_rad)
            square_m = square_px / camera.m
            i, j = np.meshgrid(np.arange(-45.0, 46.0), np.arange(-45.0, 46.0))
            x, y = i.ravel() * square_m, j.ravel() * square_m
            real = np.stack(
                [
                    x * (1.0 + 0.5 * stage.stretch) + stage.shear * y,
                    y * (1.0 - 0.5 * stage.stretch),
                    0.5 * stage.curvature * (x * x + y * y),
                ],
                axis=1,
            )
            lean = _turn(along, tilt)
            turned = real @ _turn([0.0, 0.0, 1.0], turn).T
            points = (turned - pivot) @ lean.T + pivot
            # The operator moves the specimen within its own plane until its origin is in view.
            normal = lean[:, 2]
            origin = -lean @ pivot + pivot
            slide = origin.copy()
            slide[2] = -(normal[0] * slide[0] + normal[1] * slide[1]) / normal[2]
            points -= slide
            points[:, :2] += rng.uniform(-0.5, 0.5, 2) * square_m
            points[:, 2] += level + stage.height_sigma_m * rng.normal()
            ideal = camera.project_ideal(points)
            middle = 0.5 * np.array([camera.width - 1.0, camera.height - 1.0])
            xy = camera.distort(middle + scale * (ideal - middle))
            with np.errstate(invalid="ignore"):
                seen = np.all((xy > 5) & (xy < np.array([camera.width, camera.height]) - 6), axis=1)
            xy = xy[seen]
            late = xy[:, 1] / camera.height - 0.5
            xy = xy + late[:, None] * stage.drift_sigma_px * rng.normal(size=2)
            jitter = stage.line_jitter_px * rng.normal(size=camera.height)
            xy[:, 0] += jitter[np.clip(np.round(xy[:, 1]).astype(int), 0, camera.height - 1)]
            xy = xy + noise_px * rng.normal(size=xy.shape)
            reading = None
            if readings:
                scatter = stage.reading_sigma_rad * rng.normal()
                reading = StageReading(tilt + stage.tilt_error_rad + scatter, turn, 0.0)
            board = np.stack([x, y], axis=1)[seen]
            # The detector does not know which way the lattice lies.
            quarter = rng.integers(4)
            c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
            board = np.stack([c * board[:, 0] - s * board[:, 1], s * board[:, 0] + c * board[:, 1]], axis=1)
            sigma = np.full(len(xy), noise_px if noise_px > 0.0 else 0.01)
            out.append(
                GridView(
                    float(g), board, xy, sigma, f"{number}/{k}", visit=number, stage=reading
                )
            )
    return out
