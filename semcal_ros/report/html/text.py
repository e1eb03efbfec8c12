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

"""Text of a page: safe characters, and quantities in readable units."""

from __future__ import annotations

import unicodedata

import numpy as np

# Most decimals of a number: longer ones do not fit a table.
_MOST_DECIMALS = 9


def remove_control_characters(text: object) -> str:
    """Replace what a page or UTF-8 cannot carry: control characters and lone surrogates."""
    kept = (
        c if c.isspace() or unicodedata.category(c) not in ("Cc", "Cs") else "�" for c in str(text)
    )
    return "".join(kept)


def format_with_sigma(value: float, sigma: float) -> str:
    """Format a value with two digits of its 1-sigma, such as ``230.54 ± 0.31``."""
    if not (np.isfinite(sigma) and sigma > 0.0):
        return f"{value:.4g}"
    digits = int(np.clip(1 - np.floor(np.log10(sigma)), 0, _MOST_DECIMALS))
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"


def format_length(length_m: float, sigma_m: float | None = None) -> str:
    """Format a length in nm or µm, with two digits of its 1-sigma if it is given; those of photographs in mm."""
    unit, factor = ("µm", 1e6) if abs(length_m) >= 1e-6 else ("nm", 1e9)
    if abs(length_m) >= 1e-2:
        unit, factor = "mm", 1e3
    value = factor * length_m
    if sigma_m is None or not (np.isfinite(sigma_m) and sigma_m > 0.0):
        return f"{value:#.4g}".rstrip(".") + f" {unit}"
    return f"{format_with_sigma(value, factor * sigma_m)} {unit}"


def format_magnification(g: float, digits: int = 4) -> str:
    """Format a magnification to a number of digits, never with an exponent."""
    return f"{float(f'{g:.{digits}g}'):.10g}×"


def format_px(value: float | None) -> str:
    """Format an error in px; a dash stands for a missing one."""
    if value is None or np.isnan(value):
        return "–"
    if np.isinf(value):
        return "no answer"
    return f"{value:.3f} px"
