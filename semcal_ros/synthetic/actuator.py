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

"""A stage that does not do quite what it is told: wrong gain, tilted axes, and backlash."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError


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
