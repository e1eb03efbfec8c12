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

"""Lengths with their uncertainty, as texts."""

from __future__ import annotations

import math

__all__ = ["digits_of", "format_with_sigma"]

_UNITS = ((1e-6, "µm"), (1e-9, "nm"))


def digits_of(sigma: float) -> int:
    """Return how many decimals show two digits of a 1-sigma: 0 to 6, and 3 where it is not known."""
    if not (math.isfinite(sigma) and sigma > 0.0):
        return 3
    return min(max(1 - math.floor(math.log10(sigma)), 0), 6)


def format_with_sigma(length_m: float, sigma_m: float | None) -> str:
    """Format a length and its 1-sigma in one unit, µm or nm, with two digits of the 1-sigma.

    Without one, the text says that the scale is nominal; with one that is not finite, that it is not known.
    """
    size, unit = next((u for u in _UNITS if abs(length_m) >= 0.9995 * u[0]), _UNITS[-1])
    if sigma_m is None:
        return f"{length_m / size:.4g} {unit} (nominal)"
    if not math.isfinite(sigma_m):
        return f"{length_m / size:.4g} {unit} (uncertainty not known)"
    digits = digits_of(sigma_m / size)
    return f"{length_m / size:.{digits}f} ± {sigma_m / size:.{digits}f} {unit}"
