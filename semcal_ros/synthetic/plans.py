"""Plans of recordings: which frames, when, at which magnification and pose."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic.detector import Detector
from semcal_ros.synthetic.drift import DRIFTS, NO_DRIFT, DriftFunction
from semcal_ros.synthetic.microscope import VirtualMicroscope
from semcal_ros.synthetic.pose import Pose, random_poses
from semcal_ros.synthetic.render import render_frame
from semcal_ros.synthetic.specimens.gold import GoldOnCarbon
from semcal_ros.synthetic.specimens.grid import ChessGrid, FlatSpecimen, Specimen, square_for
from semcal_ros.synthetic.specimens.target import TargetSpecimen

__all__ = [
    "CALIBRATION_MAGNIFICATIONS",
    "SPECIMEN_KINDS",
    "PlannedFrame",
    "RecordingPlan",
    "calibration_plan",
    "drift_plan",
    "specimen_for",
    "steps_plan",
    "zoom_plan",
]


SPECIMEN_KINDS: tuple[str, ...] = ("grid", "gold", "flat", "target")

CALIBRATION_MAGNIFICATIONS: tuple[float, ...] = (100.0, *(500.0 * k for k in range(1, 21)))
"""100 and 500, 1000, ... 10 000, as in Malti et al. (2012)."""


def specimen_for(
    kind: str, pixel_size_m: float, image_width: int, seed: int = 0
) -> tuple[Specimen, float | None]:
    """Return the specimen of a kind, and the square size in m if it is the grid.

    Raises
    ------
    InvalidValueError
        If the kind is unknown.
    """
    if kind == "grid":
        square_m = square_for(pixel_size_m, image_width)
        return ChessGrid(square_m), square_m
    if kind == "gold":
        return GoldOnCarbon(seed), None
    if kind == "flat":
        return FlatSpecimen(), None
    if kind == "target":
        return TargetSpecimen(), None
    raise InvalidValueError(f"specimen '{kind}'", expected=f"one of {', '.join(SPECIMEN_KINDS)}")


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
    """

    start_time_s: float
    magnification: float
    pose: Pose
    square_m: float | None


@dataclass(frozen=True, eq=False)
class RecordingPlan:
    """A whole recording; frames are rendered one at a time and do not depend on each other.

    Attributes
    ----------
    microscope, kind, frames, drift, detector, seed
        What is recorded; ``kind`` is one of :data:`SPECIMEN_KINDS`.
    """

    microscope: VirtualMicroscope
    kind: str
    frames: tuple[PlannedFrame, ...]
    drift: DriftFunction
    detector: Detector
    seed: int

    def __post_init__(self) -> None:
        if self.kind not in SPECIMEN_KINDS:
            specimen_for(self.kind, 1e-6, self.microscope.width)

    def __len__(self) -> int:
        return len(self.frames)

    def render(self, index: int) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Render a frame; raises as :func:`~semcal_ros.synthetic.render.render_frame`."""
        frame = self.frames[index]
        specimen: Specimen
        if frame.square_m is not None:
            specimen = ChessGrid(frame.square_m)
        else:
            pixel_m = self.microscope.nominal_pixel_size_m(frame.magnification)
            specimen, _ = specimen_for(self.kind, pixel_m, self.microscope.width, self.seed)
        return render_frame(
            self.microscope,
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
) -> RecordingPlan:
    """Plan the grid at several magnifications, ``views`` poses each, the first one untilted."""
    _require_positive("views per magnification", views)
    frames: list[PlannedFrame] = []
    for number, g in enumerate(magnifications):
        pixel_m = microscope.nominal_pixel_size_m(g)
        square_m = square_for(pixel_m, microscope.width)
        poses = random_poses(
            seed * 1009 + number,
            views,
            field_width_m=pixel_m * microscope.width,
            max_tilt_rad=max_tilt_rad,
            min_tilt_rad=min(math.radians(15.0), 0.5 * max_tilt_rad),
            height_sigma_m=height_sigma_m,
        )
        for pose in poses:
            frames.append(PlannedFrame(interval_s * len(frames), float(g), pose, square_m))
    return RecordingPlan(microscope, "grid", tuple(frames), drift, detector or Detector(), seed)


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
) -> RecordingPlan:
    """Plan one magnification and pose under drift; without ``interval_s`` there is no pause."""
    return _fixed_pose(
        microscope, [magnification] * frames, kind, interval_s, drift, pose, detector, seed
    )


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
) -> RecordingPlan:
    """Plan a geometric sweep of the magnification over one region and pose (by default tilted by 8 deg)."""
    _require_positive("frames", frames)
    sweep = np.geomspace(first_magnification, last_magnification, frames).round(1)
    tilted = Pose.tilted(math.radians(8.0), 0.6, 0.1) if pose is None else pose
    return _fixed_pose(microscope, sweep.tolist(), kind, interval_s, drift, tilted, detector, seed)


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
) -> RecordingPlan:
    """Plan ``frames`` at each of several magnifications without a pause, each on the grid region that suits it."""
    _require_positive("frames", frames)
    plane = Pose.tilted(math.radians(8.0), 0.6, 0.1) if pose is None else pose
    period_s = microscope.timing.acquisition_time_s
    planned: list[PlannedFrame] = []
    for g in magnifications:
        _, square_m = specimen_for(kind, microscope.nominal_pixel_size_m(g), microscope.width)
        for _ in range(frames):
            planned.append(PlannedFrame(period_s * len(planned), float(g), plane, square_m))
    return RecordingPlan(microscope, kind, tuple(planned), drift, detector or Detector(), seed)


def _fixed_pose(
    microscope: VirtualMicroscope,
    magnifications: Sequence[float],
    kind: str,
    interval_s: float | None,
    drift: DriftFunction,
    pose: Pose | None,
    detector: Detector | None,
    seed: int,
) -> RecordingPlan:
    _require_positive("frames", len(magnifications))
    step_s = microscope.timing.acquisition_time_s if interval_s is None else interval_s
    # One region of the grid is in view throughout: the one that suits the middle of the sweep.
    middle = math.exp(float(np.mean(np.log(magnifications))))
    _, square_m = specimen_for(kind, microscope.nominal_pixel_size_m(middle), microscope.width)
    plane = Pose.flat() if pose is None else pose
    planned = tuple(
        PlannedFrame(step_s * index, float(g), plane, square_m)
        for index, g in enumerate(magnifications)
    )
    return RecordingPlan(microscope, kind, planned, drift, detector or Detector(), seed)


def _require_positive(what: str, count: int) -> None:
    if count < 1:
        raise InvalidValueError(f"{count} {what}", expected="at least 1")
