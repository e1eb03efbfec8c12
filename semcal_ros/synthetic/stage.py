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

"""A specimen stage with the faults of real ones, and views of a grid on it.

It shares neither priors nor equations with the calibration: the specimen is a rigid body that is
turned about axes in space, and its points are projected by the true camera. So it serves to test the
stated uncertainty. A stage that is driven does not do quite what it is told: wrong gain, tilted axes, and backlash.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.plane_geometry import rotations_from_vectors
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import did_you_mean
from semcal_ros.synthetic.pose import Pose
from semcal_ros.synthetic.specimens.grid import GridFaults, square_for
from semcal_ros.synthetic.thresholds import AXIS_OFFSET_MAX_M, SCALE_SIGMA_MAX, TILT_MAX_RAD

__all__ = [
    "STAGES",
    "GridFaults",
    "SimulatedStage",
    "StagePosition",
    "make_stage",
    "pose_at",
    "pose_on_stage",
    "read_position",
    "stage_views",
    "visit_scales",
]


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
        Spread of the relative scale of a visit: how repeatable the magnification is.
    tilt_error_rad, reading_sigma_rad
        Constant error of the tilt that is read, and its scatter.
    drift_sigma_px, line_jitter_px
        Spread per axis of the drift during a frame, and of the shift of each line.
    rotation_error_rad, rotation_sigma_rad
        Constant error of the rotation that is read, and its scatter.
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
    rotation_error_rad: float = 0.0
    rotation_sigma_rad: float = 0.0

    def __post_init__(self) -> None:
        if not all(abs(offset) <= AXIS_OFFSET_MAX_M for offset in self.miss_m):
            listed = " and ".join(f"{1e6 * offset:g}" for offset in self.miss_m)
            raise InvalidValueError(
                f"a tilt axis that misses the specimen by {listed} um",
                expected=f"at most {1e6 * AXIS_OFFSET_MAX_M:g} um",
            )
        if not 0.0 <= self.scale_sigma <= SCALE_SIGMA_MAX:
            raise InvalidValueError(
                f"a repeatability of {100.0 * self.scale_sigma:g} %",
                expected=f"0 to {100.0 * SCALE_SIGMA_MAX:g} %",
            )
        if not self.tilts_rad or not all(abs(tilt) <= TILT_MAX_RAD for tilt in self.tilts_rad):
            raise InvalidValueError(
                f"tilts {', '.join(f'{math.degrees(tilt):g}' for tilt in self.tilts_rad)} degrees",
                expected=f"one or more, at most {math.degrees(TILT_MAX_RAD):g}",
            )

    @property
    def tilted_rad(self) -> tuple[float, ...]:
        """The tilts that are not zero; zero if there are no others."""
        return tuple(tilt for tilt in self.tilts_rad if tilt) or (0.0,)


STAGES: Mapping[str, SimulatedStage] = MappingProxyType(
    {
        # The tilt axis misses the specimen by a tenth of a millimetre, which is what is left of a eucentric
        # height that is set by eye; it lies one degree from where a configuration says, and the readings are
        # off by what is usual. The specimen lies on the stage in some direction.
        "one-axis": SimulatedStage(
            tilts_rad=tuple(math.radians(tilt) for tilt in (0.0, 20.0, 30.0, 40.0)),
            axis_rad=math.radians(1.0),
            miss_m=(1e-4, 0.0),
            scale_sigma=1.5e-3,
            tilt_error_rad=math.radians(0.3),
            reading_sigma_rad=math.radians(0.1),
            line_jitter_px=0.05,
            rotation_error_rad=math.radians(12.0),
            rotation_sigma_rad=math.radians(0.2),
        ),
        "two-axis": SimulatedStage(
            axis_rad=None, height_sigma_m=4e-5, scale_sigma=1.5e-3, line_jitter_px=0.05
        ),
    }
)


"""``one-axis`` is like the stage of a scanning electron microscope; ``two-axis``, which tilts in every direction
about the specimen itself, is like none."""


def make_stage(
    name: str = "one-axis",
    *,
    eucentric_error_m: float | None = None,
    repeatability: float | None = None,
    line_jitter_px: float | None = None,
) -> SimulatedStage:
    """Return a stage of :data:`STAGES` with other faults.

    Parameters
    ----------
    name
        Its name.
    eucentric_error_m
        How far the tilt axis lies beside the beam.
    repeatability
        Relative 1-sigma of the magnification of a visit.
    line_jitter_px
        1-sigma of the shift of each line.

    Raises
    ------
    InvalidValueError
        If there is no such stage, a value is out of range, or a two-axis stage has an axis that misses.
    """
    if name not in STAGES:
        raise InvalidValueError(
            f"stage '{name}'", expected=f"one of {', '.join(STAGES)}", do=did_you_mean(name, STAGES)
        )
    stage = STAGES[name]
    if eucentric_error_m is not None:
        if stage.axis_rad is None and eucentric_error_m != 0.0:
            raise InvalidValueError(
                f"a eucentric error of {1e6 * eucentric_error_m:g} um of a two-axis stage",
                expected="a one-axis stage, as the other tilts about the specimen itself",
            )
        stage = replace(stage, miss_m=(eucentric_error_m, 0.0))
    if repeatability is not None:
        stage = replace(stage, scale_sigma=repeatability)
    if line_jitter_px is not None:
        stage = replace(stage, line_jitter_px=line_jitter_px)
    return stage


@dataclass(frozen=True)
class StagePosition:
    """What a stage says about its position.

    Attributes
    ----------
    tilt_rad, rotation_rad, x_m, y_m, z_m, scan_rotation_rad
        Its joints; x and y move the specimen on the tilted stage.
    """

    tilt_rad: float = 0.0
    rotation_rad: float = 0.0
    x_m: float = 0.0
    y_m: float = 0.0
    z_m: float = 0.0
    scan_rotation_rad: float = 0.0

    @property
    def joints(self) -> dict[str, float]:
        """The joints by their usual names, rad and m."""
        return {
            "tilt": self.tilt_rad,
            "rotation": self.rotation_rad,
            "x": self.x_m,
            "y": self.y_m,
            "z": self.z_m,
            "scan_rotation": self.scan_rotation_rad,
        }


def read_position(
    stage: SimulatedStage, true: StagePosition, rng: np.random.Generator
) -> StagePosition:
    """Return what the stage says at a true position."""
    tilt, rotation = rng.normal(size=2)
    return replace(
        true,
        tilt_rad=true.tilt_rad + stage.tilt_error_rad + stage.reading_sigma_rad * tilt,
        rotation_rad=true.rotation_rad
        + stage.rotation_error_rad
        + stage.rotation_sigma_rad * rotation,
    )


def visit_scales(stage: SimulatedStage | None, seed: int) -> Iterator[float]:
    """Factors on the scale of one visit after the other; without end, the same for the same seed."""
    rng = np.random.default_rng((seed, 0x7151))
    while True:
        yield 1.0 if stage is None else 1.0 + stage.scale_sigma * float(rng.normal())


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
    turn_rad: float = np.pi,
    most_corners: int | None = None,
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
    turn_rad
        The specimen is turned by up to this much either way before every view.
    most_corners
        So many corners of a view are found, chosen at random; None for all.
    """
    rng = np.random.default_rng(seed)
    # A separate generator: what a seed draws is the same with all corners.
    choice = np.random.default_rng(seed + 1_000_000)
    faults = grid or GridFaults()
    errors: dict[float, float] = {}
    out = []
    for number, g in enumerate(visits):
        camera = camera_at(g)
        square_m = square_for(1.0 / camera.m, camera.width)
        size = 1.0 + errors.setdefault(square_m, faults.squares_sigma * rng.normal())
        i, j = np.meshgrid(np.arange(-45.0, 46.0), np.arange(-45.0, 46.0))
        x, y = i.ravel() * square_m, j.ravel() * square_m
        scale = 1.0 + stage.scale_sigma * rng.normal()
        level = stage.common_height_m + stage.visit_height_sigma_m * rng.normal()
        for k, tilt in enumerate(stage.tilts_rad):
            turn = rng.uniform(-turn_rad, turn_rad)
            direction = rng.uniform(0.0, 2.0 * np.pi) if stage.axis_rad is None else stage.axis_rad
            pose, _ = pose_on_stage(stage, tilt, turn, direction)
            points = (size * faults.applied(x, y, square_m)) @ pose.R.T + pose.t_m
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
                turn_read = turn + stage.rotation_error_rad
                if stage.rotation_sigma_rad > 0.0:
                    turn_read += stage.rotation_sigma_rad * rng.normal()
                reading = StageReading(tilt + stage.tilt_error_rad + scatter, turn_read, 0.0)
            # The detector does not know which way the lattice lies.
            c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[rng.integers(4)]
            board = np.stack([c * x - s * y, s * x + c * y], axis=1)[seen]
            sigma = np.full(len(xy), noise_px if noise_px > 0.0 else 0.01)
            name = f"{number}/{k}"
            view = GridView(
                float(g), board, xy, sigma, name, visit=number, square_m=square_m, stage=reading
            )
            kept = choice.permutation(len(xy))[:most_corners]
            out.append(view if most_corners is None else view.chosen(kept))
    return out


def pose_on_stage(
    stage: SimulatedStage,
    tilt_rad: float,
    rotation_rad: float,
    direction_rad: float | None = None,
    *,
    offset_m: ArrayLike = (0.0, 0.0),
    height_m: float = 0.0,
) -> tuple[Pose, StagePosition]:
    """Turn the specimen about its normal, tilt it, and bring its origin to the beam within its plane.

    Parameters
    ----------
    stage
        Its axis may miss the specimen, which then changes its height with the tilt.
    tilt_rad, rotation_rad
        The rotation is done first.
    direction_rad
        Direction of the tilt axis, instead of the stage's.
    offset_m
        Where beside the beam the origin lies, in x and y of the sem frame.
    height_m
        Height of the specimen without a tilt.

    Returns
    -------
    pose
        The specimen in the sem frame.
    position
        The true position of the stage.

    Raises
    ------
    InvalidValueError
        If neither the stage nor ``direction_rad`` says where the axis is.
    """
    direction = stage.axis_rad if direction_rad is None else direction_rad
    if direction is None:
        raise InvalidValueError("a stage without a tilt axis", expected="the direction of the tilt")
    pivot, tilt = _pivot_and_tilt(stage, tilt_rad, direction)
    offset = np.asarray(offset_m, dtype=np.float64) - (pivot - tilt @ pivot)[:2]
    x, y = np.linalg.solve(tilt[:2, :2], offset)
    position = StagePosition(tilt_rad, rotation_rad, float(x), float(y))
    return pose_at(stage, position, direction, height_m=height_m), position


def pose_at(
    stage: SimulatedStage,
    position: StagePosition,
    direction_rad: float,
    *,
    height_m: float = 0.0,
) -> Pose:
    """Return the specimen in the sem frame with the stage at a true position.

    Parameters
    ----------
    stage
        Its axis may miss the specimen, which a tilt then carries away from the beam.
    position
        Its tilt, rotation, x and y.
    direction_rad
        Direction of the tilt axis.
    height_m
        Height of the specimen without a tilt.
    """
    pivot, tilt = _pivot_and_tilt(stage, position.tilt_rad, direction_rad)
    # The stage carries the specimen to s on the tilted plane: X = lean (s - pivot) + pivot.
    travel = np.array([position.x_m, position.y_m, 0.0])
    origin = tilt @ (travel - pivot) + pivot + np.array([0.0, 0.0, height_m])
    return Pose(tilt @ _turn([0.0, 0.0, 1.0], position.rotation_rad), origin)


def _pivot_and_tilt(
    stage: SimulatedStage, tilt_rad: float, direction_rad: float
) -> tuple[Array, Array]:
    along = np.array([np.cos(direction_rad), np.sin(direction_rad), 0.0])
    across = np.array([-along[1], along[0], 0.0])
    pivot = stage.miss_m[0] * across + stage.miss_m[1] * np.array([0.0, 0.0, 1.0])
    return pivot, _turn(along, tilt_rad)


def _seen(camera: ScanCamera, points: Array, scale: float) -> tuple[Array, Array]:
    """Return the raw pixels of the points within the image, and which points these are.

    ``scale`` is that of the visit relative to the camera's.
    """
    middle = 0.5 * np.array([camera.width - 1.0, camera.height - 1.0])
    xy = camera.distort(middle + scale * (camera.project_ideal(points) - middle))
    with np.errstate(invalid="ignore"):
        seen = np.all((xy > 5) & (xy < np.array([camera.width, camera.height]) - 6), axis=1)
    return xy[seen], seen


@dataclass(frozen=True)
class ActuatorFaults:
    """How far the axes of a stage are from what a controller assumes.

    Attributes
    ----------
    gain
        (x, y) travel over commanded travel.
    turned_rad
        Angle from the commanded to the actual direction of travel, from x towards y: axes that are mounted askew.
    backlash_m
        (x, y) play between motor and stage: after a reversal an axis stands still for so much commanded travel.
    """

    gain: tuple[float, float] = (1.0, 1.0)
    turned_rad: float = 0.0
    backlash_m: tuple[float, float] = (0.0, 0.0)

    def __post_init__(self) -> None:
        values = np.array([*self.gain, self.turned_rad, *self.backlash_m])
        if not np.all(np.isfinite(values)) or min(self.gain) <= 0.0 or min(self.backlash_m) < 0.0:
            raise InvalidValueError(
                f"{self}", expected="finite gains above 0, and finite play of 0 or more"
            )


class StageActuator:
    """Turns commanded velocities into those of the stage.

    Parameters
    ----------
    faults
        What is wrong with it. Its axes are in gear in the positive direction at first.
    """

    def __init__(self, faults: ActuatorFaults | None = None) -> None:
        self._faults = faults or ActuatorFaults()
        self._slack_m = np.array(self._faults.backlash_m)

    def obey(
        self, velocity_m_s: tuple[float, float], start_s: float, end_s: float
    ) -> list[tuple[float, tuple[float, float]]]:
        """Follow a command from ``start_s`` until the next one at ``end_s``.

        Returns
        -------
        Times within, the first ``start_s``, and the (x, y) velocity of the stage from each on, m/s.
        """
        command = np.array(velocity_m_s, dtype=np.float64)
        play = np.array(self._faults.backlash_m)
        # In gear in the positive direction where the slack is all taken up, in the negative where it is zero.
        left_m = np.where(command > 0.0, play - self._slack_m, self._slack_m)
        engaged_s = start_s + np.where(
            command == 0.0, math.inf, left_m / np.maximum(np.abs(command), 1e-30)
        )
        times = sorted({start_s, *(float(t) for t in engaged_s if start_s < t < end_s)})
        moved = [(t, self._travel(np.where(engaged_s <= t, command, 0.0))) for t in times]
        self._slack_m = np.clip(self._slack_m + command * (end_s - start_s), 0.0, play)
        return moved

    def _travel(self, motor_m_s: Array) -> tuple[float, float]:
        x, y = motor_m_s * np.array(self._faults.gain)
        c, s = math.cos(self._faults.turned_rad), math.sin(self._faults.turned_rad)
        return float(c * x - s * y), float(s * x + c * y)


def grid_view(
    camera: ScanCamera,
    rotation: Array,
    translation_m: Array,
    *,
    square_px: float = 40.0,
    noise_px: float = 0.0,
    rng: np.random.Generator | None = None,
    name: str = "",
    project: Callable[[Array], Array] | None = None,
) -> GridView:
    """Return all lattice corners inside the image, with Gaussian noise on their pixels.

    ``project`` takes the place of the camera's own projection of sem-frame points.
    """
    square_m = square_px / camera.m
    i, j = np.meshgrid(np.arange(-40, 41), np.arange(-40, 41))
    board: Array = np.column_stack([i.ravel(), j.ravel()]).astype(float) * square_m
    points = np.column_stack([board, np.zeros(len(board))]) @ rotation.T + translation_m
    xy = (project or camera.project)(points)
    with np.errstate(invalid="ignore"):
        seen = np.all((xy > 5) & (xy < np.array([camera.width, camera.height]) - 6), axis=1)
    xy = xy[seen]
    if noise_px > 0.0:
        assert rng is not None
        xy = xy + rng.normal(scale=noise_px, size=xy.shape)
    sigma = np.full(len(xy), noise_px if noise_px > 0.0 else 0.01)
    return GridView(camera.magnification, board[seen].astype(np.float64), xy, sigma, name)


def grid_views(
    camera_at: Callable[[float], ScanCamera],
    magnifications: Sequence[float],
    *,
    views: int = 4,
    noise_px: float = 0.0,
    height_sigma_m: float = 40e-6,
    square_px: float = 40.0,
    seed: int = 0,
    flat_height_sigma_m: float = 0.0,
    project: Callable[[float, Array], Array] | None = None,
) -> list[GridView]:
    """``views`` random poses per magnification, the first untilted, tilts up to 40 degrees.

    The heights have the sigma ``height_sigma_m``, those of the untilted views ``flat_height_sigma_m``. ``project``
    takes the place of the cameras' projection: of sem-frame points at a magnification, as of a whole microscope.
    """
    rng = np.random.default_rng(seed)
    # A separate generator: the poses of a seed are the same with and without noise.
    noise_rng = np.random.default_rng(seed + 1_000_000)
    out = []
    for g in magnifications:
        camera = camera_at(g)
        for k in range(views):
            tilt = 0.0 if k == 0 else rng.uniform(np.radians(15), np.radians(40))
            axis = rng.uniform(0, 2 * np.pi)
            turn = rotations_from_vectors(np.array([[0.0, 0.0, rng.uniform(-0.6, 0.6)]]))[0]
            tilted = rotations_from_vectors(tilt * np.array([[np.cos(axis), np.sin(axis), 0.0]]))[0]
            centre = rng.uniform(-0.5, 0.5, size=2) * square_px / camera.m
            # Without its own height sigma, the first view draws no number, so that seeds keep their poses.
            sigma = flat_height_sigma_m if k == 0 else height_sigma_m
            translation = np.array([*centre, rng.normal() * sigma if sigma > 0.0 else 0.0])
            out.append(
                grid_view(
                    camera,
                    tilted @ turn,
                    translation,
                    square_px=square_px,
                    noise_px=noise_px,
                    rng=noise_rng,
                    name=f"{g:g}/{k}",
                    project=None if project is None else partial(project, g),
                )
            )
    return out
