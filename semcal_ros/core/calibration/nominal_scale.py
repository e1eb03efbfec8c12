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

"""The scale that views show, against the one that magnification, display width and squares predict."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.plane_geometry import view_affine
from semcal_ros.core.errors import CalibrationError, UnusableCalibrationError

__all__ = [
    "DISPLAY_WIDTH_LIMITS_M",
    "advise_scale",
    "check_nominal_scale",
    "check_square_sides",
    "is_scale_far",
    "observed_scale_factor",
]

# Display widths of real files are 114 to 519 mm (design, section 3), so a guess from their middle is
# wrong by 2.1 at most. What is off by more is another unit, or not a microscope; and it is 4 sigmas
# from the prior of the scale, which would bend everything else.
_FAR = 3.0
# In octaves: with the right display width, the scale of a microscope is never this close to a factor
# of two.
_TWICE = 0.12
#: Widths of displays that are accepted, from a chip's to a projector's, m.
DISPLAY_WIDTH_LIMITS_M = (1e-3, 100.0)
_UNITS = (("m", 1.0), ("mm", 1e-3), ("um", 1e-6), ("nm", 1e-9))


def observed_scale_factor(views: Sequence[GridView], nominal_px_per_m: Array) -> float:
    """Return the median ratio of observed to nominal scale, from the homographies of the views.

    Parameters
    ----------
    views
        V views.
    nominal_px_per_m
        (V,) scale that the nominal values predict for each.
    """
    affines = [view_affine(v.board_xy_m, v.image_xy, v.image_xy.mean(axis=0)) for v in views]
    return float(np.median(np.array([a.scale for a in affines]) / nominal_px_per_m))


def is_scale_far(factor: Array) -> Mask:
    """Return whether ratios of observed to nominal scale are too far from 1 for a calibration."""
    return (factor < 1.0 / _FAR) | (factor > _FAR)


def advise_scale(
    factor: float,
    *,
    display_width_m: float,
    squares_m: Sequence[float],
    pixel_size_m: float | None = None,
) -> str:
    """Return the options that make the nominal scale the observed one; see :func:`check_nominal_scale`."""
    width_m = display_width_m / factor
    ways = []
    if DISPLAY_WIDTH_LIMITS_M[0] <= width_m <= DISPLAY_WIDTH_LIMITS_M[1]:
        ways.append(f"--display-width {_format_length(width_m)}")
    if pixel_size_m is not None:
        size = _format_length(pixel_size_m / factor)
        ways.append(f"--pixel-size {size} in place of a magnification or another pixel size")
    fitting = ", or ".join(ways) or f"magnifications {factor:.4g} times as large"
    if not squares_m:
        return f"give {fitting} (display_width_m in a configuration)"
    sides = ",".join(_format_length(factor * side) for side in sorted(set(squares_m), reverse=True))
    return (
        f"if the squares are right, give {fitting}; if the magnification is, give --squares {sides} "
        "(display_width_m and squares_m in a configuration)"
    )


def check_nominal_scale(
    factor: float,
    *,
    display_width_m: float,
    squares_m: Sequence[float],
    pixel_size_m: float | None = None,
) -> None:
    """Refuse views whose scale is far from that of their units.

    Parameters
    ----------
    factor
        Ratio of the observed to the nominal scale.
    display_width_m
        Display width to which the magnifications refer, m.
    squares_m
        Sides of the squares in view, m; empty where they are not known.
    pixel_size_m
        Nominal pixel size, where all views have the same, m.

    Raises
    ------
    UnusableCalibrationError
        If it is off by more than a factor of 3; the error says what would fit.
    """
    if not is_scale_far(np.array(factor)):
        return
    sides = " and ".join(_format_length(side) for side in sorted(set(squares_m), reverse=True))
    raise UnusableCalibrationError(
        f"images that show {factor:.3g} times the scale that a display width of "
        f"{_format_length(display_width_m)}"
        + (f" and squares of {sides}" if sides else "")
        + " predict",
        expected=f"a scale within a factor of {_FAR:g} of the predicted one",
        do=advise_scale(
            factor,
            display_width_m=display_width_m,
            squares_m=squares_m,
            pixel_size_m=pixel_size_m,
        ),
    )


def check_square_sides(factor: float, display_width_m: float) -> None:
    """Refuse a scale that results from confusing the side of a square with the period of the grid.

    Raises
    ------
    CalibrationError
        If the ratio of the observed to the nominal scale is about 2 or a half.
    """
    if abs(abs(np.log2(factor)) - 1.0) >= _TWICE:
        return
    width_m = display_width_m / factor
    raise CalibrationError(
        f"images that show {factor:.3g} times the scale that squares_m and the display width of "
        f"{display_width_m:g} m predict",
        expected="squares_m to hold the sides of single squares, not the period of the grid",
        do=f"correct squares_m (--squares), or if that is right, set display_width_m to {width_m:.4g} m "
        f"(--display-width {_format_length(width_m)})",
    )


def _format_length(length_m: float) -> str:
    """Format a length as options take it, such as ``25.1mm``."""
    unit, size_m = next((u for u in _UNITS if length_m >= u[1]), _UNITS[-1])
    return f"{float(f'{length_m / size_m:.4g}'):g}{unit}"
