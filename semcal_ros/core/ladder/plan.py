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

"""Which pictures of a specimen extend a calibration to a magnification."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import check_positive
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.ladder.thresholds import ANCHORS, LADDER_MOVES, MAGNIFICATION_MAX, STEP


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
