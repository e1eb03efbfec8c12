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

"""How a camera parameter changes with the magnification.

None of these laws is a polynomial in g or in log g. A calibration that fits such polynomials
therefore meets a curve that it can only approximate, as with a real microscope, so that a test
against it is meaningful.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

__all__ = ["Constant", "Exponential", "Law", "Logistic", "Saturation"]


class Law(Protocol):
    """A parameter as a function of g; hashable, because the rendered geometry is cached."""

    def __call__(self, magnification: float) -> float:
        """Value at a magnification."""
        ...

    def __hash__(self) -> int:
        """Equal laws have equal hashes."""
        ...


@dataclass(frozen=True)
class Constant:
    """The same value at every magnification."""

    value: float

    def __call__(self, magnification: float) -> float:
        """Value at a magnification."""
        return self.value


@dataclass(frozen=True)
class Exponential:
    """``high + (low - high) exp(-g / scale)``: ``low`` at g = 0, ``high`` far above ``scale``."""

    low: float
    high: float
    scale: float

    def __call__(self, magnification: float) -> float:
        """Value at a magnification."""
        return self.high + (self.low - self.high) * math.exp(-magnification / self.scale)


@dataclass(frozen=True)
class Saturation:
    """``low + (high - low) g^n / (g^n + half^n)``: half way between the ends at ``g = half``."""

    low: float
    high: float
    half: float
    exponent: float = 1.0

    def __call__(self, magnification: float) -> float:
        """Value at a magnification."""
        fraction = 1.0 / (1.0 + (self.half / magnification) ** self.exponent)
        return float(self.low + (self.high - self.low) * fraction)


@dataclass(frozen=True)
class Logistic:
    """``low + (high - low) / (1 + exp(-(g - middle) / width))``."""

    low: float
    high: float
    middle: float
    width: float

    def __call__(self, magnification: float) -> float:
        """Value at a magnification."""
        fraction = 0.5 * (1.0 + math.tanh(0.5 * (magnification - self.middle) / self.width))
        return float(self.low + (self.high - self.low) * fraction)
