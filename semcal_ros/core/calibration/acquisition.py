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

"""Recording of a grid by itself: which views to take, and how to keep the grid in the field of view.

A survey visits magnifications at equal ratios. What follows is chosen by
:func:`~semcal_ros.core.calibration.judgement.plan.plan_views` from the calibration that the views so far give, until nm
per pixel is as certain as asked. Each visit has one view for each tilt, differently turned in the plane, so that the
faults of the grid and those of the camera are told apart.

Which way the image moves with x and y of a stage depends on how the stage is mounted, on the scan rotation and on the
tilt, and is learned from two small moves. A move of less than half a square can be told from the corners alone,
although all squares look alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from semcal_ros.core.arrays import AnyImage, Array, check_positive, mad_sigma
from semcal_ros.core.calibration.estimator.thresholds import SPREAD_COUNT_MIN
from semcal_ros.core.calibration.judgement.plan import plan_views
from semcal_ros.core.calibration.judgement.thresholds import PLANNED_TILTS_RAD, SQUARES_ACROSS_MIN
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.calibration.thresholds import (
    BLURRED_PART,
    MAGNIFICATION_OFF,
    MOVED_MIN,
    OFF_CENTRE_MAX,
    PROBE_SQUARES,
    ROUND_WORTH,
    SATURATED_PART,
    SHIFT_SCATTER_MAX,
    SPANNED_PART,
    SURVEY_RATIO,
    TILT_MAX_RAD,
    TILT_OFF_RAD,
    VIEW_ROTATION_RAD,
    VIEWS_MAX,
    VISIT_ROTATION_RAD,
    VISITS_AT_ONCE,
)
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.corners import LatticeDetection
from semcal_ros.core.errors import CalibrationError, InvalidValueError
from semcal_ros.core.wording import counted


def _middle_off_px(detection: LatticeDetection) -> Array:
    box = 0.5 * (detection.xy.min(axis=0) + detection.xy.max(axis=0))
    off: Array = box - 0.5 * (np.array(detection.image_size) - 1.0)
    return off


def grid_is_centred(detection: LatticeDetection) -> bool:
    """Return whether what is seen of the grid lies about the middle of the image.

    Parameters
    ----------
    detection
        Its corners.
    """
    off = np.abs(_middle_off_px(detection)) / np.array(detection.image_size)
    return bool(np.all(off <= OFF_CENTRE_MAX))


def lattice_shift(before: LatticeDetection, after: LatticeDetection) -> Array:
    """Measure by how much a lattice has moved, if that is less than half a square.

    Parameters
    ----------
    before, after
        The corners in two pictures.

    Returns
    -------
    (2,) way from the first to the second, px.

    Raises
    ------
    CalibrationError
        The corners do not move together.
    """
    distance, nearest = cKDTree(before.xy).query(after.xy)
    spacing_px = min(before.spacing_px, after.spacing_px)
    same = distance < 0.5 * spacing_px
    ways = after.xy[same] - before.xy[nearest[same]]
    spread = mad_sigma(ways - np.median(ways, axis=0)) if len(ways) else np.inf
    if 2 * len(ways) < len(after.xy) or spread > SHIFT_SCATTER_MAX * spacing_px:
        raise CalibrationError(
            "the corners of two pictures do not move together",
            expected=f"a grid that follows a move of {PROBE_SQUARES:g} squares",
            do="check that x and y of the stage are in m, and that nothing else moves it",
        )
    shift: Array = np.median(ways, axis=0)
    return shift


def image_from_stage(ways_m: Array, shifts_px: Array, nominal_px_per_m: float) -> Array:
    """Return the matrix (2, 2), px/m, that maps a way of the stage to that of the image.

    Parameters
    ----------
    ways_m
        (2, 2) two ways (x, y) of the stage, one in each row.
    shifts_px
        (2, 2) what the image did.
    nominal_px_per_m
        What it would do without a tilt.

    Raises
    ------
    CalibrationError
        The image did not follow one of them.
    """
    matrix = np.asarray(np.linalg.solve(ways_m, shifts_px).T, dtype=np.float64)
    least = float(np.linalg.svd(matrix, compute_uv=False)[-1])
    if not least > MOVED_MIN * nominal_px_per_m:
        moved = ", ".join(f"{np.hypot(*shift):.1f} px" for shift in shifts_px)
        expected = ", ".join(f"{np.hypot(*way) * nominal_px_per_m:.1f} px" for way in ways_m)
        raise CalibrationError(
            f"the image does not follow x and y of the stage: it moved by {moved}",
            expected=f"about {expected}, in different directions",
            do="check the stage, its backlash, and that its messages tell x and y",
        )
    return matrix


def find_stage_move(detection: LatticeDetection, px_per_m: Array) -> Array:
    """Return the way (2,) of the stage, m, that brings what is seen of the grid to the middle of the image.

    A grid that reaches beyond the image is farther off than can be seen: look again afterwards.

    Parameters
    ----------
    detection
        The corners.
    px_per_m
        (2, 2) as :func:`image_from_stage` returns it.
    """
    return np.asarray(-np.linalg.solve(px_per_m, _middle_off_px(detection)), dtype=np.float64)


@dataclass(frozen=True)
class AcquisitionGoal:
    """What is to be calibrated, and how well.

    Attributes
    ----------
    magnification_range
        Least and greatest magnification.
    squares_m
        Sides of the squares that the grid has, m.
    display_width_m
        Display width to which magnifications refer, m.
    target
        Relative 1-sigma of nm per pixel to reach in the whole range, repeatability of the magnification aside.
    tilts_rad
        Tilts of the views of each visit, rad.
    most_views
        End after so many views, with the target met or not.
    """

    magnification_range: tuple[float, float]
    squares_m: tuple[float, ...]
    display_width_m: float
    target: float = 1e-3
    tilts_rad: tuple[float, ...] = PLANNED_TILTS_RAD
    most_views: int = VIEWS_MAX

    def __post_init__(self) -> None:
        low, high = self.magnification_range
        check_positive(low, "the least magnification")
        check_positive(self.target, "target =")
        check_positive(self.display_width_m, "display_width_m =")
        if not low <= high < math.inf:
            raise InvalidValueError(
                f"magnifications from {low:g} to {high:g}", expected="the lower one first"
            )
        if not self.squares_m or min(self.squares_m) <= 0.0:
            raise InvalidValueError(
                f"squares of {list(self.squares_m)} m", expected="the sizes of the grid's squares"
            )
        if len(self.tilts_rad) < 2 or max(self.tilts_rad) - min(self.tilts_rad) < 0.1:
            raise InvalidValueError(
                f"tilts of {[round(math.degrees(t), 1) for t in self.tilts_rad]} degrees",
                expected="at least two that are 6 degrees apart",
            )
        if max(map(abs, self.tilts_rad)) > TILT_MAX_RAD:
            raise InvalidValueError(
                f"a tilt of {math.degrees(max(map(abs, self.tilts_rad))):.0f} degrees",
                expected=f"{math.degrees(TILT_MAX_RAD):.0f} degrees at most",
            )
        needed = len(self.tilts_rad) * len(_survey_magnifications(self.magnification_range))
        if self.most_views < needed:
            raise InvalidValueError(
                counted(self.most_views, "view"),
                expected=f"at least {needed} for this range",
                do="allow more, or narrow the range",
            )


@dataclass(frozen=True)
class ViewRequest:
    """One view to take.

    Attributes
    ----------
    visit
        Number of the visit: the magnification is set anew for each.
    magnification
        Magnification to set.
    tilt_rad
        Tilt of the specimen, rad.
    turn_rad
        Turn in the plane, of the scan or of the specimen, -pi to pi.
    square_m
        Side of the squares that should be in view, m.
    """

    visit: int
    magnification: float
    tilt_rad: float
    turn_rad: float
    square_m: float


@dataclass(frozen=True)
class Proposal:
    """What to do after a calibration.

    Attributes
    ----------
    requests
        Views to take; empty at the end.
    largest, at
        Largest relative 1-sigma of nm per pixel now, repeatability aside, and the magnification where that is.
    reached
        Whether the target is met.
    reason
        Why it ends here, in words; empty if it does not.
    """

    requests: tuple[ViewRequest, ...]
    largest: float
    at: float
    reached: bool
    reason: str


def _survey_magnifications(magnification_range: tuple[float, float]) -> tuple[float, ...]:
    low, high = magnification_range
    if low == high:
        return (low,) * SPREAD_COUNT_MIN
    steps = math.ceil(math.log(high / low) / math.log(SURVEY_RATIO) - 1e-9)
    visits = np.geomspace(low, high, max(steps + 1, SPREAD_COUNT_MIN))
    visits[0], visits[-1] = low, high
    return tuple(float(g) for g in visits)


def _square_in_view(goal: AcquisitionGoal, magnification: float) -> float:
    field_m = goal.display_width_m / magnification
    fitting = [size for size in goal.squares_m if field_m / size >= SQUARES_ACROSS_MIN]
    return max(fitting) if fitting else min(goal.squares_m)


def _requests_of(
    goal: AcquisitionGoal, visit: int, magnification: float
) -> tuple[ViewRequest, ...]:
    """The views of one visit."""
    square_m = _square_in_view(goal, magnification)
    return tuple(
        ViewRequest(
            visit,
            magnification,
            tilt,
            math.remainder(
                0.2 + VISIT_ROTATION_RAD * visit + VIEW_ROTATION_RAD * number, 2.0 * math.pi
            ),
            square_m,
        )
        for number, tilt in enumerate(goal.tilts_rad)
    )


def plan_survey(goal: AcquisitionGoal) -> tuple[ViewRequest, ...]:
    """Return the views of the survey: what can be known without any calibration, and gives the first one."""
    visits = _survey_magnifications(goal.magnification_range)
    return tuple(r for visit, g in enumerate(visits) for r in _requests_of(goal, visit, g))


def propose_visits(
    goal: AcquisitionGoal, model: CalibrationModel, taken: Sequence[ViewRequest]
) -> Proposal:
    """Choose the next visits from the calibration of the views so far.

    Parameters
    ----------
    goal
        What is asked for.
    model
        The calibration.
    taken
        The requests so far, whether or not a view came of them.

    Raises
    ------
    InvalidValueError
        The calibration does not state what a plan needs.
    """
    left = (goal.most_views - len(taken)) // len(goal.tilts_rad)
    plan = plan_views(
        model,
        goal.target,
        squares_m=goal.squares_m,
        most_visits=max(1, min(VISITS_AT_ONCE, left)),
        single_setting=False,
    )
    reason = ""
    if plan.largest <= goal.target:
        reason = "the target is met"
    elif left < 1:
        reason = (
            f"{counted(len(taken), 'view')} of at most {goal.most_views} are taken, "
            f"and another visit takes {len(goal.tilts_rad)}"
        )
    elif not plan.visits or plan.visits[-1].largest > (1.0 - ROUND_WORTH) * plan.largest:
        reason = "more views would hardly help"
    first = 1 + max((request.visit for request in taken), default=-1)
    requests: tuple[ViewRequest, ...] = ()
    if not reason:
        requests = tuple(
            request
            for number, visit in enumerate(plan.visits)
            for request in _requests_of(goal, first + number, visit.magnification)
        )
    return Proposal(requests, plan.largest, plan.at, plan.largest <= goal.target, reason)


def is_same_magnification(wanted: float, magnification: float) -> bool:
    """Return whether a magnification is the one that was asked for, as far as a display tells it."""
    return abs(magnification / wanted - 1.0) <= MAGNIFICATION_OFF


def is_magnification_of(request: ViewRequest, magnification: float) -> bool:
    """Return whether a magnification is the one of a request, as far as a display tells it."""
    return is_same_magnification(request.magnification, magnification)


def request_of_picture(
    goal: AcquisitionGoal, visit: int, magnification: float, stage: StageReading | None
) -> ViewRequest | None:
    """Return the request that a picture of an earlier acquisition must have answered, which is not of the survey.

    Parameters
    ----------
    goal
        What is asked for.
    visit
        Number of its visit.
    magnification, stage
        Of the picture.

    Returns
    -------
    None for a magnification outside the range.
    """
    low, high = goal.magnification_range
    if not low / (1.0 + MAGNIFICATION_OFF) <= magnification <= high * (1.0 + MAGNIFICATION_OFF):
        return None
    known = stage or StageReading()
    return ViewRequest(
        visit,
        magnification,
        known.tilt_rad or 0.0,
        known.scan_rotation_rad or known.rotation_rad or 0.0,
        _square_in_view(goal, magnification),
    )


def find_exposure_fault(image: AnyImage) -> str:
    """Say whether much of a picture is black or white; empty if not.

    Parameters
    ----------
    image
        (h, w) grey values.
    """
    grey = np.asarray(image, dtype=np.float64)
    largest = 2.0 ** (8 * image.dtype.itemsize) - 1.0 if image.dtype.kind == "u" else math.inf
    dark, bright = float(np.mean(grey <= 0.0)), float(np.mean(grey >= largest))
    if max(dark, bright) <= SATURATED_PART:
        return ""
    share, end = max((dark, "black"), (bright, "white"))
    return f"{100.0 * share:.0f} % of the pixels are {end}: change brightness or contrast"


def find_picture_fault(
    image: AnyImage,
    detection: LatticeDetection,
    request: ViewRequest,
    stage: StageReading | None,
) -> str:
    """Say what is wrong with a picture in which the grid was found; empty if nothing is.

    Parameters
    ----------
    image
        (h, w) grey values.
    detection
        The corners.
    request
        What was asked for.
    stage
        Where the stage says that it is, or None.
    """
    if stage is not None and stage.tilt_rad is not None:
        off = stage.tilt_rad - request.tilt_rad
        if abs(off) > TILT_OFF_RAD:
            return (
                f"the stage is tilted by {math.degrees(stage.tilt_rad):.1f} degrees"
                f" instead of {math.degrees(request.tilt_rad):.1f}"
            )
    if fault := find_exposure_fault(image):
        return fault
    if detection.blur_px > BLURRED_PART * detection.spacing_px:
        return f"out of focus: edges are blurred by {detection.blur_px:.1f} px"
    spanned = np.ptp(detection.xy, axis=0) / np.array(detection.image_size)
    if min(spanned) < SPANNED_PART:
        return f"the grid fills {100.0 * float(min(spanned)):.0f} % of the image: move it to the middle"
    return ""
