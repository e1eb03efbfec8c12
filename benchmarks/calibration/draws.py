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

"""Random numbers of the generators that share no code with what they judge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Draws:
    """Draws from one generator, in the order in which they are asked for."""

    rng: np.random.Generator

    def between(self, low: float, high: float) -> float:
        """A number, all of them alike."""
        return float(self.rng.uniform(low, high))

    def ratio(self, low: float, high: float) -> float:
        """A positive number, all ratios alike."""
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def either(self, part: float) -> bool:
        """Whether to be one of this part."""
        return bool(self.rng.uniform() < part)
