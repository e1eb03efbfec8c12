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

"""A ladder that is recorded by itself: which pictures to take, whether one serves, and how to keep the place in sight.

Which way the picture moves with x and y of a stage is learned from the pictures that are moved anyway. What is seen of
the place at the next magnification tells how far it is off the middle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array, check_positive
from semcal_ros.core.calibration.acquisition import (
    find_exposure_fault,
    image_from_stage,
    is_same_magnification,
)
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.errors import CalibrationError, InvalidValueError, Rejection
from semcal_ros.core.ladder.correspondences import PairFailure, Prepared, SmoothMap, locate_picture
from semcal_ros.core.ladder.extend import scale_of_pictures
from semcal_ros.core.ladder.matching import LadderPicture, make_predictor
from semcal_ros.core.ladder.thresholds import (
    ANCHORS,
    LADDER_MOVES,
    MAGNIFICATION_MAX,
    MOVE_MAX,
    MOVE_MIN,
    OFF_CENTRE_MAX,
    SCAN_ROTATION_OFF_RAD,
    SHIFT_STEPS,
    STEP,
)


@dataclass(frozen=True)
class PlannedStep:
    """Pictures at one magnification: one at each of the moves, and one with the scan turned.

    Attributes
    ----------
    magnification
        The magnification.
    field_m
        Width of the field, m.
    moves_m
        Moves (x, y) of the specimen or of the beam from the middle, m.
    turn_rad
        Rotation of the scan of the last picture, in the middle.
    """

    magnification: float
    field_m: float
    moves_m: tuple[tuple[float, float], ...]
    turn_rad: float


def plan_ladder(model: CalibrationModel, magnification: float) -> tuple[PlannedStep, ...]:
    """Plan a ladder from inside the calibrated range to a magnification beyond it.

    Parameters
    ----------
    model
        The calibration.
    magnification
        Where it is to reach, above or below the range.

    Raises
    ------
    InvalidValueError
        If the magnification lies in the range, or where no microscope goes.
    """
    last = check_positive(magnification, "magnification")
    low, high = model.magnification_range
    if low <= last <= high or last > MAGNIFICATION_MAX or last < low * low / MAGNIFICATION_MAX:
        raise InvalidValueError(
            f"an extension to {last:g}x of a calibration of {low:g}x to {high:g}x",
            expected=f"a magnification beyond that, up to {MAGNIFICATION_MAX:g}x",
        )
    upwards = last > high
    edge = high if upwards else low
    sign = 1.0 if upwards else -1.0
    # A range that is shorter has fewer steps inside.
    inside = min(ANCHORS - 1, math.floor(math.log(high / low) / math.log(STEP) + 1e-9))
    first = edge * STEP ** (-sign * inside)
    count = math.ceil(abs(math.log(last / first)) / math.log(STEP) - 1e-9)
    steps = []
    for number, g in enumerate(np.geomspace(first, last, count + 1)):
        digits = 10.0 ** (math.floor(math.log10(g)) - 3)
        rounded = float(round(g / digits) * digits)
        field = model.display_width_m / rounded
        moves = tuple((x * field, y * field) for x, y in LADDER_MOVES)
        steps.append(PlannedStep(rounded, field, moves, 0.5 * math.pi * (-1.0) ** number))
    return tuple(steps)


@dataclass(frozen=True)
class PictureRequest:
    """One picture to take.

    Attributes
    ----------
    visit
        Number of the magnification: it is set anew for each.
    magnification
        Magnification to set.
    move
        Move (x, y) of the specimen from the middle, in fields of view.
    turn_rad
        Rotation of the scan against that of the other pictures.
    """

    visit: int
    magnification: float
    move: tuple[float, float]
    turn_rad: float

    @property
    def is_middle(self) -> bool:
        """Whether the place is asked for in the middle, the scan not turned."""
        return self.move == (0.0, 0.0) and self.turn_rad == 0.0


@dataclass(frozen=True, eq=False)
class TakenPicture:
    """A picture that serves.

    Attributes
    ----------
    request
        What it answers.
    picture
        The picture.
    place_m
        Where x and y of the stage were, m; None where that is not known.
    offset_px
        (2,) where it shows what was in the middle of the picture in the middle, off its own middle, px; None for the
        first one.
    """

    request: PictureRequest
    picture: LadderPicture
    place_m: tuple[float, float] | None = None
    offset_px: Array | None = None


def plan_pictures(
    model: CalibrationModel, magnification: float, *, turned: bool = True
) -> tuple[PictureRequest, ...]:
    """The pictures of :func:`.plan_ladder`, one after the other; its errors.

    Parameters
    ----------
    model
        The calibration.
    magnification
        Where the ladder is to reach.
    turned
        Whether the scan can be turned.
    """
    requests = []
    for visit, step in enumerate(plan_ladder(model, magnification)):
        g, field = step.magnification, step.field_m
        moves = [(x / field, y / field) for x, y in step.moves_m]
        requests += [PictureRequest(visit, g, move, 0.0) for move in moves]
        if turned:
            requests.append(PictureRequest(visit, g, (0.0, 0.0), step.turn_rad))
    return tuple(requests)


def find_offset(
    model: CalibrationModel,
    reference: LadderPicture,
    picture: LadderPicture,
    turn_rad: float = 0.0,
) -> Array | Rejection[PairFailure]:
    """Find where a picture shows what is in the middle of another one.

    Parameters
    ----------
    model
        The calibration, which need not reach as far.
    reference, picture
        Pictures of one size and of neighbouring magnifications.
    turn_rad
        By how much the scan of the picture is turned against that of the reference.

    Returns
    -------
    (2,) that place off the middle of the picture, px; or why the two were not matched.

    Raises
    ------
    InvalidValueError
        If they differ in size, or have not the shape of those of the calibration.
    """
    scale = scale_of_pictures(model, (reference, picture))
    # The first one of a match has the larger pixels.
    upwards = picture.magnification >= reference.magnification
    first, second = (reference, picture) if upwards else (picture, reference)
    cameras = model.at(first.magnification), model.at(second.magnification)
    turn = turn_rad if upwards else -turn_rad
    found = locate_picture(_prepare(first), _prepare(second), make_predictor(*cameras, turn, scale))
    if isinstance(found, Rejection):
        return found
    height, width = picture.image.shape[:2]
    middle = 0.5 * np.array([[width - 1.0, height - 1.0]])
    seen = found(middle) if upwards else _inverse(found, middle)
    return np.asarray((seen - middle)[0])


def _prepare(picture: LadderPicture) -> Prepared:
    return Prepared(np.asarray(picture.image, dtype=np.float32))


def _inverse(smooth: SmoothMap, wanted: Array) -> Array:
    """The pixel (1, 2) that a map takes to another one, by Newton's method."""
    xy = wanted
    for _ in range(SHIFT_STEPS):
        xy = xy + np.linalg.solve(smooth.jacobian(xy), (wanted - smooth(xy))[..., None])[..., 0]
    return xy


def take_picture(
    model: CalibrationModel,
    taken: Sequence[TakenPicture],
    request: PictureRequest,
    picture: LadderPicture,
    place_m: tuple[float, float] | None = None,
) -> TakenPicture:
    """Take a picture for a request if it serves.

    Parameters
    ----------
    model
        The calibration.
    taken
        Those before.
    request
        What was asked for.
    picture
        The picture.
    place_m
        Where the stage was.

    Raises
    ------
    CalibrationError
        With what is wrong with it.
    InvalidValueError
        If it has not the shape of the pictures of the calibration.
    """
    scale_of_pictures(model, (picture,))
    if not is_same_magnification(request.magnification, picture.magnification):
        raise CalibrationError(
            f"a picture at {picture.magnification:g}x", expected=f"{request.magnification:g}x"
        )
    if fault := find_exposure_fault(picture.image):
        raise CalibrationError(fault)
    middle = next((one for one in reversed(taken) if one.request.is_middle), None)
    if middle is None:
        if _prepare(picture).is_featureless:
            raise CalibrationError(
                "a picture that shows noise only", expected="a specimen with texture"
            )
        return TakenPicture(request, picture, place_m)
    _check_rotation(middle.picture, request, picture)
    offset = _find_offset_of(model, middle.picture, request, picture)
    field = np.array(picture.image.shape[::-1], dtype=np.float64)
    off = float(np.max(np.abs(offset / field)))
    if request.is_middle and off > OFF_CENTRE_MAX:
        raise CalibrationError(
            f"the place is off the middle by {100.0 * off:.0f} % of the field",
            expected=f"{100.0 * OFF_CENTRE_MAX:.0f} % at most",
            do="bring it to the middle",
        )
    moved = float(np.hypot(*(offset / field)))
    for other in taken:
        asked = other.request
        if request.move == (0.0, 0.0) or asked.move == (0.0, 0.0) or asked.visit != request.visit:
            continue
        assert other.offset_px is not None
        if np.hypot(*((offset - other.offset_px) / field)) < MOVE_MIN:
            raise CalibrationError(
                "a picture that is moved as the one before",
                expected="another direction",
                do="move along the other axis",
            )
    if request.move != (0.0, 0.0) and not MOVE_MIN <= moved <= MOVE_MAX:
        raise CalibrationError(
            f"a picture that is moved by {100.0 * moved:.0f} % of the field",
            expected="a fifth to a third",
        )
    return TakenPicture(request, picture, place_m, offset)


def _check_rotation(middle: LadderPicture, request: PictureRequest, picture: LadderPicture) -> None:
    """Refuse a scan that is not turned as was asked for, as far as that is told."""
    if middle.scan_rotation_rad is None or picture.scan_rotation_rad is None:
        return
    turned = picture.scan_rotation_rad - middle.scan_rotation_rad
    if abs(math.remainder(turned - request.turn_rad, 2.0 * math.pi)) > SCAN_ROTATION_OFF_RAD:
        raise CalibrationError(
            f"a scan that is turned by {math.degrees(turned):.0f} degrees against that of the picture in the middle",
            expected=f"{math.degrees(request.turn_rad):.0f}",
        )


def _find_offset_of(
    model: CalibrationModel,
    middle: LadderPicture,
    request: PictureRequest,
    picture: LadderPicture,
) -> Array:
    # Which sense a microscope calls positive is found when all is there.
    turns = (request.turn_rad, -request.turn_rad) if request.turn_rad else (0.0,)
    reasons = []
    for turn in turns:
        found = find_offset(model, middle, picture, turn)
        if not isinstance(found, Rejection):
            return found
        reasons.append(found.reason)
    raise CalibrationError(
        f"a picture at {picture.magnification:g}x that does not match the one in the middle at "
        f"{middle.magnification:g}x: {reasons[0]}",
        expected="the same place of a specimen with texture, in focus",
        do="bring the place back to the middle",
    )


def learn_motion(model: CalibrationModel, taken: Sequence[TakenPicture]) -> Array | None:
    """Learn from the moved pictures which way the picture goes with x and y of the stage.

    Parameters
    ----------
    model
        The calibration.
    taken
        The pictures so far, with where the stage was.

    Returns
    -------
    (2, 2) px/m from a way of the stage to one of the picture at a magnification of 1, the scan not turned; None where
    too few pictures were moved.

    Raises
    ------
    CalibrationError
        The picture does not follow the stage.
    """
    for visit in sorted({one.request.visit for one in taken}, reverse=True):
        own = [one for one in taken if one.request.visit == visit and one.request.turn_rad == 0.0]
        base = next((one for one in own if one.request.is_middle), None)
        moved = [one for one in own if one.request.move != (0.0, 0.0)]
        if base is None or base.place_m is None or len(moved) < 2:
            continue
        ways, shifts = np.zeros((2, 2)), np.zeros((2, 2))
        for row, one in enumerate(moved[:2]):
            if one.place_m is None or one.offset_px is None:
                break
            ways[row] = np.subtract(one.place_m, base.place_m)
            shifts[row] = one.offset_px
        else:
            g = base.picture.magnification
            nominal = model.nominal_px_per_m(g) * base.picture.image.shape[1] / model.image_width
            return image_from_stage(ways, shifts, nominal) / g
    return None
