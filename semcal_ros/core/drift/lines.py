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

"""A specimen that shows lines only, for some frames: drift across them is measured, and drift along them predicted."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.estimates import DriftPredictor
from semcal_ros.core.drift.filter import DriftFilter
from semcal_ros.core.drift.operations import Inflate
from semcal_ros.core.drift.state import DriftState


@dataclass(frozen=True)
class LinesOnly:
    """What is known along lines while nothing else is seen.

    Attributes
    ----------
    along
        (2,) direction of the lines, px; None where both directions are measured.
    unseen
        What was known before the first frame that did not tell the drift along them.
    of_unseen
        (2, 2) what that adds to the covariance of the last frame.
    blind
        Numbers of the keyframes that were made since, whose own place along the lines was only predicted.
    """

    along: Array | None = None
    unseen: DriftState | None = None
    of_unseen: Array = field(default_factory=lambda: np.zeros((2, 2)))
    blind: frozenset[int] = frozenset()

    def begin_or_go_on(self, along: Array, drift_filter: DriftFilter) -> LinesOnly:
        """Note a frame that shows lines in a direction (2,), before the filter makes use of it."""
        unseen = self.unseen
        if unseen is None:
            unseen = drift_filter.state.without_keyframes()
        return replace(self, along=along, unseen=unseen)

    def inflate(self, inflation: Inflate, drift_filter: DriftFilter) -> LinesOnly:
        """Let the covariance of what is only predicted grow."""
        if self.unseen is None:
            return self
        return replace(self, unseen=inflation(self.unseen, drift_filter.process_noise))

    def with_keyframe(self, key: int) -> LinesOnly:
        """Note a new keyframe."""
        return self if self.unseen is None else replace(self, blind=self.blind | {key})

    def covariance(self, drift_filter: DriftFilter, px_from_unit: Array) -> Array:
        """(2, 2) covariance of the drift along the lines, which has only been predicted since they alone are seen."""
        if self.unseen is None or self.along is None:
            return np.zeros((2, 2))
        coasting = DriftPredictor(self.unseen, drift_filter.process_noise, None)
        covariance = coasting.at(drift_filter.state.time_s).covariance[:2, :2]
        direction = np.linalg.solve(px_from_unit, self.along)
        variance = float(self.along @ px_from_unit @ covariance @ px_from_unit.T @ self.along)
        return variance * np.outer(direction, direction)
