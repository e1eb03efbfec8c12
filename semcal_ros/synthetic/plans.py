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

"""Plans of recordings: which frames, when, at which magnification and pose; and their truth as plain values for a file.

Keys of the truth carry their unit; everything is SI or px. The dictionary holds::

    schema              "semcal_ros/truth/1"
    microscope          name of the preset
    specimen            "grid", "gold" or "flat"
    image_width_px, image_height_px, norm_px, display_width_m, databar_rows
    scan                frame_time_s, averages, flyback_fraction
    frames              list, in the order of the recording:
        start_time_s        start of the first pass, after the start of the recording
        magnification
        rotation            (3, 3): X = rotation x + translation_m + drift
        translation_m       (3,)
        square_m            square size, or None without a grid
        drift_m             (2,) at the centre of the acquisition; what lay at X is seen
                            at X + drift
        pixel_size_m        (x, y) true size of an undistorted pixel at the reference plane, in
                            this visit
        visit, visit_scale  number of the visit of the magnification, and the factor with which it
                            came back
        stage, stage_read   tilt, rotation, x, y, z, scan_rotation (rad, m): where the stage was,
                            and what it said; None for a stage that says nothing
    stage               tilt_axis_rad (None for any direction), miss_m (beside the beam, below),
                        height_sigma_m, repeatability, tilt_error_rad, rotation_error_rad,
                        line_jitter_px; None for a perfect one
    grid                stretch, shear, curvature_per_m, wave, wave_squares, and square_errors, a
                        list of square_m and relative error; None for a perfect one
    parameters          list, one entry per magnification, ascending, without the visits' factors:
        magnification, m_px_per_m, aspect, skew, principal_point_px (x, y), rho_per_m, xi_r, xi_t,
        centre_px (x, y), residual_spiral, residual_sine, residual_settling
    residual_sine_cycles, residual_settling_length   shape of the residual, see Residual
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import did_you_mean
from semcal_ros.synthetic.detector import Detector
from semcal_ros.synthetic.drift import DRIFTS, NO_DRIFT, DriftFunction
from semcal_ros.synthetic.microscope import VirtualMicroscope
from semcal_ros.synthetic.pose import Pose, random_poses
from semcal_ros.synthetic.render import render_frame
from semcal_ros.synthetic.specimens.gold import GoldOnCarbon
from semcal_ros.synthetic.specimens.grid import (
    ChessGrid,
    FlatSpecimen,
    GridFaults,
    Specimen,
    square_for,
)
from semcal_ros.synthetic.specimens.target import TargetSpecimen, random_target
from semcal_ros.synthetic.stage import (
    SimulatedStage,
    StagePosition,
    pose_on_stage,
    read_position,
    visit_scales,
)
from semcal_ros.synthetic.thresholds import LADDER_MOVES, LADDER_STEP, RESTING_RAD

SPECIMEN_KINDS: tuple[str, ...] = ("grid", "gold", "flat", "target", "rough_target")

CALIBRATION_MAGNIFICATIONS: tuple[float, ...] = (100.0, *(500.0 * k for k in range(1, 21)))
"""100 and 500, 1000, ... 10 000, as in Malti et al. (2012)."""

TRUTH_SCHEMA = "semcal_ros/truth/1"


def specimen_for(
    kind: str,
    pixel_size_m: float,
    image_width: int,
    seed: int = 0,
    grid: GridFaults | None = None,
) -> tuple[Specimen, float | None]:
    """Return the specimen of a kind, and the square size in m if it is the grid.

    ``grid`` says how the grid differs from squares in a plane.

    Raises
    ------
    InvalidValueError
        If the kind is unknown.
    """
    if kind == "grid":
        square_m = square_for(pixel_size_m, image_width)
        return _grid_of(square_m, grid, seed), square_m
    if kind == "gold":
        return GoldOnCarbon(seed), None
    if kind == "flat":
        return FlatSpecimen(), None
    if kind == "target":
        return TargetSpecimen(), None
    if kind == "rough_target":
        return random_target(seed), None
    raise InvalidValueError(
        f"specimen '{kind}'",
        expected=f"one of {', '.join(SPECIMEN_KINDS)}",
        do=did_you_mean(kind, SPECIMEN_KINDS),
    )


def _grid_of(square_m: float, grid: GridFaults | None, seed: int) -> ChessGrid:
    """Return the region of the grid with squares of this size."""
    if grid is None:
        return ChessGrid(square_m)
    return ChessGrid(square_m, grid, grid.size_errors(seed)[square_m])


@dataclass(frozen=True, eq=False)
class PlannedFrame:
    """One frame of a recording.

    Attributes
    ----------
    start_time_s
        Start of the first pass.
    magnification
        Magnification g.
    pose
        Specimen plane without drift.
    square_m
        Square size in view when the specimen is the grid, else None.
    visit
        Number of the visit: a stretch of the recording in which the magnification is not changed.
    visit_scale
        Factor with which the magnification came back in this visit.
    position, position_read
        Where the stage is and what it says, or None for a stage that says nothing.
    """

    start_time_s: float
    magnification: float
    pose: Pose
    square_m: float | None
    visit: int = 0
    visit_scale: float = 1.0
    position: StagePosition | None = None
    position_read: StagePosition | None = None

    @property
    def joints(self) -> dict[str, float] | None:
        """What the stage says, by the names of its joints, or None."""
        return None if self.position_read is None else self.position_read.joints


@dataclass(frozen=True, eq=False)
class RecordingPlan:
    """A whole recording; frames are rendered one at a time and do not depend on each other.

    Attributes
    ----------
    microscope, kind, frames, drift, detector, seed
        What is recorded; ``kind`` is one of :data:`SPECIMEN_KINDS`.
    stage, grid
        Their faults, or None for a perfect stage and grid. The jitter of the lines is that of the stage.
    """

    microscope: VirtualMicroscope
    kind: str
    frames: tuple[PlannedFrame, ...]
    drift: DriftFunction
    detector: Detector
    seed: int
    stage: SimulatedStage | None = None
    grid: GridFaults | None = None

    def __post_init__(self) -> None:
        if self.kind not in SPECIMEN_KINDS:
            specimen_for(self.kind, 1e-6, self.microscope.width)
        if self.stage is not None:
            jitter_px = self.stage.line_jitter_px
            object.__setattr__(self, "detector", replace(self.detector, line_jitter_px=jitter_px))

    def __len__(self) -> int:
        return len(self.frames)

    def render(self, index: int) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Render a frame; raises as :func:`~semcal_ros.synthetic.render.render_frame`."""
        frame = self.frames[index]
        specimen: Specimen
        if frame.square_m is not None:
            specimen = _grid_of(frame.square_m, self.grid, self.seed)
        else:
            pixel_m = self.microscope.nominal_pixel_size_m(frame.magnification)
            specimen, _ = specimen_for(self.kind, pixel_m, self.microscope.width, self.seed)
        return render_frame(
            self.microscope.during_visit(frame.visit_scale),
            specimen,
            frame.pose,
            frame.magnification,
            start_time_s=frame.start_time_s,
            drift=self.drift,
            seed=(self.seed, index),
            detector=self.detector,
        )

    def drift_at_centre_m(self, index: int) -> Array:
        """(2,) drift in m at the centre of a frame's acquisition."""
        centre = self.frames[index].start_time_s + self.microscope.timing.centre_offset_s
        drift = np.asarray(self.drift(np.array([centre])), dtype=np.float64)
        return drift.reshape(2)


def calibration_plan(
    microscope: VirtualMicroscope,
    *,
    magnifications: Sequence[float] = CALIBRATION_MAGNIFICATIONS,
    views: int = 5,
    interval_s: float = 20.0,
    max_tilt_rad: float = math.radians(40.0),
    height_sigma_m: float = 40e-6,
    drift: DriftFunction = NO_DRIFT,
    detector: Detector | None = None,
    seed: int = 0,
    stage: SimulatedStage | None = None,
    grid: GridFaults | None = None,
) -> RecordingPlan:
    """Plan the grid at several magnifications, ``views`` poses each, the first one untilted.

    With a ``stage``, the magnifications are visited in their order and then back, with half of the views
    each; the last one is visited once. On a stage with a tilt axis, every visit of two views or more begins
    untilted, and the others take the stage's tilts in turn; ``max_tilt_rad`` and ``height_sigma_m`` are
    those of the other stages.
    """
    _require_positive("views per magnification", views)
    drawn = [
        random_poses(
            seed * 1009 + number,
            views,
            field_width_m=microscope.nominal_pixel_size_m(g) * microscope.width,
            max_tilt_rad=max_tilt_rad,
            min_tilt_rad=min(math.radians(15.0), 0.5 * max_tilt_rad),
            height_sigma_m=height_sigma_m if stage is None else stage.height_sigma_m,
        )
        for number, g in enumerate(magnifications)
    ]
    rng, scales = np.random.default_rng((seed, 0x57A6)), visit_scales(stage, seed)
    frames: list[PlannedFrame] = []
    tilted = 0
    for visit, (number, poses) in enumerate(_list_visits(drawn, stage)):
        g, scale = float(magnifications[number]), next(scales)
        pixel_m = microscope.nominal_pixel_size_m(g)
        square_m = square_for(pixel_m, microscope.width)
        level_m = 0.0
        if stage is not None:
            level_m = stage.common_height_m + stage.visit_height_sigma_m * float(rng.normal())
        for index, pose in enumerate(poses):
            frame = PlannedFrame(interval_s * len(frames), g, pose, square_m, visit, scale)
            if stage is not None and stage.axis_rad is not None:
                tilt = 0.0
                if index > 0 or len(poses) == 1:
                    tilt = stage.tilted_rad[tilted % len(stage.tilted_rad)]
                    tilted += 1
                placed, position = pose_on_stage(
                    stage,
                    tilt,
                    float(rng.uniform(-math.pi, math.pi)),
                    offset_m=rng.normal(0.0, 0.02 * pixel_m * microscope.width, 2),
                    height_m=level_m + stage.height_sigma_m * float(rng.normal()),
                )
                frame = replace(
                    frame,
                    pose=placed,
                    position=position,
                    position_read=read_position(stage, position, rng),
                )
            elif level_m != 0.0:
                frame = replace(frame, pose=Pose(pose.R, pose.t_m + [0.0, 0.0, level_m]))
            frames.append(frame)
    return RecordingPlan(
        microscope, "grid", tuple(frames), drift, detector or Detector(), seed, stage, grid
    )


def _list_visits(
    drawn: Sequence[tuple[Pose, ...]], stage: SimulatedStage | None
) -> Iterator[tuple[int, tuple[Pose, ...]]]:
    """(number of the magnification, its poses) of each visit."""
    last = len(drawn) - 1
    for number, poses in enumerate(drawn):
        whole = stage is None or number == last
        yield number, poses if whole else poses[: (len(poses) + 1) // 2]
    if stage is None:
        return
    for number in reversed(range(last)):
        if rest := drawn[number][(len(drawn[number]) + 1) // 2 :]:
            yield number, rest


def drift_plan(
    microscope: VirtualMicroscope,
    *,
    magnification: float = 5000.0,
    frames: int = 48,
    kind: str = "gold",
    interval_s: float | None = None,
    drift: DriftFunction = DRIFTS["settling"],
    pose: Pose | None = None,
    detector: Detector | None = None,
    seed: int = 0,
    stage: SimulatedStage | None = None,
    grid: GridFaults | None = None,
) -> RecordingPlan:
    """Plan one magnification and pose under drift; without ``interval_s`` there is no pause."""
    step_s = microscope.timing.acquisition_time_s if interval_s is None else interval_s
    plan = RecordingPlan(microscope, kind, (), drift, detector or Detector(), seed, stage, grid)
    return _at_rest(plan, [magnification] * frames, step_s, pose, (0.0, 0.0), one_region=True)


def zoom_plan(
    microscope: VirtualMicroscope,
    *,
    first_magnification: float = 600.0,
    last_magnification: float = 6000.0,
    frames: int = 36,
    kind: str = "grid",
    interval_s: float | None = None,
    drift: DriftFunction = NO_DRIFT,
    pose: Pose | None = None,
    detector: Detector | None = None,
    seed: int = 0,
    stage: SimulatedStage | None = None,
    grid: GridFaults | None = None,
) -> RecordingPlan:
    """Plan a geometric sweep of the magnification over one region and pose (by default tilted by 8 deg)."""
    _require_positive("frames", frames)
    sweep = np.geomspace(first_magnification, last_magnification, frames).round(1)
    step_s = microscope.timing.acquisition_time_s if interval_s is None else interval_s
    plan = RecordingPlan(microscope, kind, (), drift, detector or Detector(), seed, stage, grid)
    return _at_rest(plan, sweep.tolist(), step_s, pose, RESTING_RAD, one_region=True)


def ladder_plan(
    microscope: VirtualMicroscope,
    *,
    first_magnification: float = 4400.0,
    last_magnification: float = 100e3,
    views: int = 5,
    kind: str = "gold",
    interval_s: float = 5.0,
    drift: DriftFunction = DRIFTS["slow"],
    detector: Detector | None = None,
    seed: int = 0,
    stage: SimulatedStage | None = None,
) -> RecordingPlan:
    """Plan one place of a flat specimen at a ladder of magnifications, in equal steps of at most 1.5.

    At each magnification there are ``views`` pictures: one in the middle, others moved by a quarter of the field, and
    the last one with the scan turned by a quarter, to either side in turn.
    """
    _require_positive("views per magnification", views)
    low, high = sorted((first_magnification, last_magnification))
    steps = max(1, math.ceil(math.log(high / low) / math.log(LADDER_STEP) - 1e-9))
    ladder = (low * (high / low) ** (np.arange(steps + 1) / steps)).round(1)
    rng, scales = np.random.default_rng((seed, 0x1ADD)), visit_scales(stage, seed)
    planned: list[PlannedFrame] = []
    for visit, g in enumerate(ladder.tolist()):
        field_m, scale = microscope.nominal_pixel_size_m(g) * microscope.width, next(scales)
        for index in range(views):
            is_turned = views > 1 and index == views - 1
            turn = 0.5 * math.pi * (-1.0) ** visit if is_turned else 0.0
            move = (0.0, 0.0) if is_turned else LADDER_MOVES[index % len(LADDER_MOVES)]
            place = field_m * (np.array(move) + rng.normal(0.0, 0.02, 2))
            # The scan turns by what is set to a tenth of a degree.
            angle = turn + math.radians(0.1) * float(rng.normal())
            flat = Pose.flat(rotation_rad=angle)
            pose = Pose(flat.R, -(flat.R @ np.append(place, 0.0)))
            position = StagePosition(x_m=place[0], y_m=place[1], scan_rotation_rad=turn)
            read = position if stage is None else read_position(stage, position, rng)
            at_s = interval_s * len(planned)
            planned.append(PlannedFrame(at_s, g, pose, None, visit, scale, position, read))
    return RecordingPlan(
        microscope, kind, tuple(planned), drift, detector or Detector(), seed, stage
    )


def steps_plan(
    microscope: VirtualMicroscope,
    *,
    magnifications: Sequence[float] = (500.0, 2000.0, 8000.0),
    frames: int = 12,
    kind: str = "grid",
    drift: DriftFunction = DRIFTS["fast"],
    pose: Pose | None = None,
    detector: Detector | None = None,
    seed: int = 0,
    stage: SimulatedStage | None = None,
    grid: GridFaults | None = None,
) -> RecordingPlan:
    """Plan ``frames`` at each of several magnifications without a pause, each on the grid region that suits it."""
    _require_positive("frames", frames)
    steps = [g for g in magnifications for _ in range(frames)]
    step_s = microscope.timing.acquisition_time_s
    plan = RecordingPlan(microscope, kind, (), drift, detector or Detector(), seed, stage, grid)
    return _at_rest(plan, steps, step_s, pose, RESTING_RAD, one_region=False)


def _at_rest(
    plan: RecordingPlan,
    magnifications: Sequence[float],
    step_s: float,
    pose: Pose | None,
    angles_rad: tuple[float, float],
    *,
    one_region: bool,
) -> RecordingPlan:
    """Return the plan with frames of a stage that stands still, by default with this tilt and rotation.

    With ``one_region``, the region of the grid that suits the middle of the magnifications stays in view.
    """
    _require_positive("frames", len(magnifications))
    microscope, stage = plan.microscope, plan.stage
    position = read = None
    if pose is not None:
        plane = pose
    elif stage is None or stage.axis_rad is None:
        tilt, rotation = angles_rad
        plane = Pose.tilted(tilt, 0.6, rotation) if tilt else Pose.flat(rotation_rad=rotation)
    else:
        plane, position = pose_on_stage(stage, *angles_rad, height_m=stage.common_height_m)
        read = read_position(stage, position, np.random.default_rng((plan.seed, 0x57A6)))
    middle = math.exp(float(np.mean(np.log(magnifications))))
    scales = visit_scales(stage, plan.seed)
    planned: list[PlannedFrame] = []
    for visit, (g, visited) in enumerate(groupby(magnifications)):
        scale = next(scales)
        pixel_m = microscope.nominal_pixel_size_m(middle if one_region else g)
        _, square_m = specimen_for(plan.kind, pixel_m, microscope.width)
        for _ in visited:
            at_s = step_s * len(planned)
            planned.append(
                PlannedFrame(at_s, float(g), plane, square_m, visit, scale, position, read)
            )
    return replace(plan, frames=tuple(planned))


def _require_positive(what: str, count: int) -> None:
    if count < 1:
        raise InvalidValueError(f"{count} {what}", expected="at least 1")


def parameters_of(microscope: VirtualMicroscope, magnification: float) -> dict[str, Any]:
    """Return the true camera parameters at a magnification, as listed above."""
    camera = microscope.camera_at(magnification)
    residual, growth = microscope.residual, microscope.residual_growth(magnification)
    return {
        "magnification": camera.magnification,
        "m_px_per_m": camera.m,
        "aspect": camera.aspect,
        "skew": camera.skew,
        "principal_point_px": [camera.px, camera.py],
        "rho_per_m": camera.rho,
        "xi_r": camera.xi_r,
        "xi_t": camera.xi_t,
        "centre_px": [camera.ex, camera.ey],
        "residual_spiral": growth * residual.spiral,
        "residual_sine": growth * residual.sine,
        "residual_settling": growth * residual.settling,
    }


def truth_of(plan: RecordingPlan) -> dict[str, Any]:
    """Return the truth of a recording as lists, numbers and strings, ready for JSON."""
    microscope = plan.microscope
    magnifications = sorted({frame.magnification for frame in plan.frames})
    return {
        "schema": TRUTH_SCHEMA,
        "microscope": microscope.name,
        "specimen": plan.kind,
        "image_width_px": microscope.width,
        "image_height_px": microscope.height,
        "norm_px": 0.5 * microscope.width,
        "display_width_m": microscope.display_width_m,
        "databar_rows": plan.detector.databar_rows,
        "scan": {
            "frame_time_s": microscope.timing.frame_time_s,
            "averages": microscope.timing.averages,
            "flyback_fraction": microscope.timing.flyback_fraction,
        },
        "frames": [_describe_frame(plan, index) for index in range(len(plan))],
        "parameters": [parameters_of(microscope, g) for g in magnifications],
        "residual_sine_cycles": microscope.residual.sine_cycles,
        "residual_settling_length": microscope.residual.settling_length,
        "stage": _describe_stage(plan),
        "grid": _describe_grid(plan),
    }


def _describe_stage(plan: RecordingPlan) -> dict[str, Any] | None:
    stage = plan.stage
    if stage is None:
        return None
    return {
        "tilt_axis_rad": stage.axis_rad,
        "miss_m": list(stage.miss_m),
        "height_sigma_m": stage.height_sigma_m,
        "repeatability": stage.scale_sigma,
        "tilt_error_rad": stage.tilt_error_rad,
        "rotation_error_rad": stage.rotation_error_rad,
        "line_jitter_px": plan.detector.line_jitter_px,
    }


def _describe_grid(plan: RecordingPlan) -> dict[str, Any] | None:
    grid = plan.grid
    if grid is None:
        return None
    return {
        "stretch": grid.stretch,
        "shear": grid.shear,
        "curvature_per_m": grid.curvature,
        "wave": grid.wave,
        "wave_squares": grid.wave_squares,
        "square_errors": [
            {"square_m": square_m, "error": error}
            for square_m, error in grid.size_errors(plan.seed).items()
        ],
    }


def _describe_frame(plan: RecordingPlan, index: int) -> dict[str, Any]:
    frame = plan.frames[index]
    camera = plan.microscope.during_visit(frame.visit_scale).camera_at(frame.magnification)
    return {
        "start_time_s": frame.start_time_s,
        "magnification": frame.magnification,
        "rotation": frame.pose.R.tolist(),
        "translation_m": frame.pose.t_m.tolist(),
        "square_m": frame.square_m,
        "drift_m": plan.drift_at_centre_m(index).tolist(),
        "pixel_size_m": list(camera.pixel_size_m),
        "visit": frame.visit,
        "visit_scale": frame.visit_scale,
        "stage": None if frame.position is None else frame.position.joints,
        "stage_read": frame.joints,
    }
