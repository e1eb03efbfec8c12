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

"""How a calibration was extended beyond its grid by a ladder of zoom steps over a specimen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semcal_ros.core.errors import InvalidValueError


@dataclass(frozen=True)
class Relay:
    """A jump of the scale somewhere between two magnifications of a ladder.

    Attributes
    ----------
    low, high
        The magnifications between which it lies.
    jump
        Relative change of the scale from below to above.
    """

    low: float
    high: float
    jump: float

    def __post_init__(self) -> None:
        if not (0.0 < self.low < self.high < np.inf and np.isfinite(self.jump)):
            raise InvalidValueError(
                f"a relay of {self.jump} between {self.low} and {self.high}",
                expected="a finite jump between two increasing magnifications",
            )

    def sigma(self, magnification: float) -> float:
        """Relative 1-sigma of the scale at a magnification that may lie on either side; 0 outside.

        The relay lies anywhere between both with the same probability per log g, and the calibration has it in the
        middle. So the side is wrong with the probability f up to the middle, and 1 - f above, where f is the part of
        the way from ``low`` to ``high``.
        """
        if not self.low < magnification < self.high:
            return 0.0
        part = float(np.log(magnification / self.low) / np.log(self.high / self.low))
        return abs(self.jump) * float(np.sqrt(min(part, 1.0 - part)))


@dataclass(frozen=True)
class LadderRecord:
    """What a ladder leaves in its calibration.

    Attributes
    ----------
    anchored
        (lowest, highest) magnification that was calibrated without it.
    growth
        Relative 1-sigma of the scale that each factor of e beyond these adds, common to all of the ladder: what no
        adjustment of the pictures can tell.
    relays
        Jumps of the scale that were found.
    """

    anchored: tuple[float, float]
    growth: float
    relays: tuple[Relay, ...] = ()

    def __post_init__(self) -> None:
        low, high = self.anchored
        if not (0.0 < low <= high < np.inf and np.isfinite(self.growth) and self.growth >= 0.0):
            raise InvalidValueError(
                f"a ladder from {self.anchored} that adds {self.growth}",
                expected="an increasing range, and a number of at least 0",
            )

    def beyond(self, magnification: float) -> float:
        """Distance of a magnification from the range that was calibrated without the ladder, in log g; 0 inside."""
        low, high = self.anchored
        return float(max(np.log(magnification / high), np.log(low / magnification), 0.0))

    def growth_sigma(self, magnification: float) -> float:
        """Relative 1-sigma of the scale that the steps of the ladder add at a magnification."""
        return self.growth * self.beyond(magnification)

    def relay_sigma(self, magnification: float) -> float:
        """Relative 1-sigma of the scale that the unknown places of the relays add at a magnification."""
        return float(np.hypot.reduce([0.0, *(relay.sigma(magnification) for relay in self.relays)]))
