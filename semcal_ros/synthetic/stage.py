"""A specimen stage and a grid with the faults of real ones, and views of the grid on it.

It shares neither priors nor equations with the calibration: the specimen is a rigid body that is
turned about axes in space, and its points are projected by the true camera. It serves to test the
stated uncertainty.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.synthetic.specimens.grid import square_for

__all__ = ["GridFaults", "SimulatedStage", "stage_views"]


@dataclass(frozen=True)
class SimulatedStage:
    """A stage and a scan with their faults.

    Attributes
    ----------
    tilts_rad
        Tilts that each visit has.
    axis_rad
        Direction of the tilt axis, or None for a stage that tilts in any direction.
    miss_m
        Where the axis lies: beside the beam, across its own direction, and below the specimen.
    height_sigma_m, visit_height_sigma_m, common_height_m
        Spread of the height of a view and of a visit, and a height that all views have.
    scale_sigma
        Spread of the relative scale of a visit.
    tilt_error_rad, reading_sigma_rad
        Constant error of the tilt that is read, and its scatter.
    drift_sigma_px, line_jitter_px
        Spread per axis of the drift during a frame, and of the shift of each line.
    """

    tilts_rad: tuple[float, ...] = (0.0, 0.35, 0.55, 0.7)
    axis_rad: float | None = 0.2
    miss_m: tuple[float, float] = (0.0, 0.0)
    height_sigma_m: float = 1e-5
    visit_height_sigma_m: float = 0.0
    common_height_m: float = 0.0
    scale_sigma: float = 0.0
    tilt_error_rad: float = 0.0
    reading_sigma_rad: float = 0.0
    drift_sigma_px: float = 0.0
    line_jitter_px: float = 0.0


@dataclass(frozen=True)
class GridFaults:
    """How a grid differs from squares in a plane.

    Attributes
    ----------
    stretch, shear
        Relative difference of its axes (x longer), and how far x moves with y.
    curvature
        1/m.
    wave, wave_squares
        Amplitude of a displacement of the rows in parts of a square, and its period in squares.
    """

    stretch: float = 0.0
    shear: float = 0.0
    curvature: float = 0.0
    wave: float = 0.0
    wave_squares: float = 12.0

    def applied(self, x: Array, y: Array, square_m: float) -> Array:
        """Return the (n, 3) corners of squares that should lie at x and y, (n,) each, m."""
        wave = self.wave * square_m * np.sin(2.0 * np.pi * y / (self.wave_squares * square_m))
        return np.stack(
            [
                x * (1.0 + 0.5 * self.stretch) + self.shear * y + wave,
                y * (1.0 - 0.5 * self.stretch),
                0.5 * self.curvature * (x * x + y * y),
            ],
            axis=1,
        )


def _turn(axis: ArrayLike, angle: float) -> Array:
    """Rotate about an axis by Rodrigues' formula."""
    x, y, z = np.asarray(axis, dtype=np.float64) / np.linalg.norm(axis)
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)


def stage_views(
    camera_at: Callable[[float], ScanCamera],
    visits: Sequence[float],
    stage: SimulatedStage,
    grid: GridFaults | None = None,
    *,
    noise_px: float = 0.05,
    outliers: float = 0.0,
    seed: int = 0,
    readings: bool = False,
    square_ratio_sigma: float = 0.0,
    turn_rad: float = np.pi,
) -> list[GridView]:
    """Record a multi-scale grid at the visits' magnifications, in this order, with all tilts at each.

    Parameters
    ----------
    camera_at
        The true camera at each magnification.
    visits
        Magnification of each visit.
    stage, grid
        Their faults.
    noise_px
        1-sigma of the corners.
    outliers
        Part of the corners that are wrong by 1 px.
    seed
        Seed of all that is random.
    readings
        Whether the views have readings of the stage.
    square_ratio_sigma
        Spread of the relative error of each size of squares.
    turn_rad
        The specimen is turned by up to this much either way before every view.
    """
    rng = np.random.default_rng(seed)
    faults = grid or GridFaults()
    errors: dict[float, float] = {}
    out = []
    for number, g in enumerate(visits):
        camera = camera_at(g)
        square_m = square_for(1.0 / camera.m, camera.width)
        size = 1.0 + errors.setdefault(square_m, square_ratio_sigma * rng.normal())
        i, j = np.meshgrid(np.arange(-45.0, 46.0), np.arange(-45.0, 46.0))
        x, y = i.ravel() * square_m, j.ravel() * square_m
        scale = 1.0 + stage.scale_sigma * rng.normal()
        level = stage.common_height_m + stage.visit_height_sigma_m * rng.normal()
        for k, tilt in enumerate(stage.tilts_rad):
            turn = rng.uniform(-turn_rad, turn_rad)
            direction = rng.uniform(0.0, 2.0 * np.pi) if stage.axis_rad is None else stage.axis_rad
            points = _posed(size * faults.applied(x, y, square_m), stage, turn, direction, tilt)
            points[:, :2] += rng.uniform(-0.5, 0.5, 2) * square_m
            points[:, 2] += level + stage.height_sigma_m * rng.normal()
            xy, seen = _seen(camera, points, scale)
            xy = xy + np.outer(
                xy[:, 1] / camera.height - 0.5, stage.drift_sigma_px * rng.normal(size=2)
            )
            jitter = stage.line_jitter_px * rng.normal(size=camera.height)
            xy[:, 0] += jitter[np.clip(np.round(xy[:, 1]).astype(int), 0, camera.height - 1)]
            xy = xy + noise_px * rng.normal(size=xy.shape)
            wrong = rng.uniform(size=len(xy)) < outliers
            xy[wrong] += _turn([0.0, 0.0, 1.0], rng.uniform(0.0, 6.28))[:2, 0]
            reading = None
            if readings:
                scatter = stage.reading_sigma_rad * rng.normal()
                reading = StageReading(tilt + stage.tilt_error_rad + scatter, turn, 0.0)
            # The detector does not know which way the lattice lies.
            c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[rng.integers(4)]
            board = np.stack([c * x - s * y, s * x + c * y], axis=1)[seen]
            sigma = np.full(len(xy), noise_px if noise_px > 0.0 else 0.01)
            name = f"{number}/{k}"
            out.append(
                GridView(
                    float(g), board, xy, sigma, name, visit=number, square_m=square_m, stage=reading
                )
            )
    return out


def _posed(
    corners: Array, stage: SimulatedStage, turn: float, direction: float, tilt: float
) -> Array:
    """Return the corners on the stage, moved within their plane until the origin is in view."""
    along = np.array([np.cos(direction), np.sin(direction), 0.0])
    across = np.array([-along[1], along[0], 0.0])
    pivot = stage.miss_m[0] * across + stage.miss_m[1] * np.array([0.0, 0.0, 1.0])
    lean = _turn(along, tilt)
    turned = corners @ _turn([0.0, 0.0, 1.0], turn).T
    origin, normal = pivot - lean @ pivot, lean[:, 2]
    # From the origin to the beam, within the plane.
    to_beam = np.array([-origin[0], -origin[1], 0.0])
    to_beam[2] = -(normal[0] * to_beam[0] + normal[1] * to_beam[1]) / normal[2]
    posed: Array = (turned - pivot) @ lean.T + pivot + to_beam
    return posed


def _seen(camera: ScanCamera, points: Array, scale: float) -> tuple[Array, Array]:
    """Return the raw pixels of the points within the image, and which points these are.

    ``scale`` is that of the visit relative to the camera's.
    """
    middle = 0.5 * np.array([camera.width - 1.0, camera.height - 1.0])
    xy = camera.distort(middle + scale * (camera.project_ideal(points) - middle))
    with np.errstate(invalid="ignore"):
        seen = np.all((xy > 5) & (xy < np.array([camera.width, camera.height]) - 6), axis=1)
    return xy[seen], seen
