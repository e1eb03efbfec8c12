"""Scatter of corners beyond their own uncertainty: an uneven board, or a camera that does not follow the microscope.

Where that is most of the residuals, the uncertainties of single corners say little about which of them to believe, and
a robust loss at their scale takes all of them for outliers. So what they scatter in common is added to each.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from semcal_ros.core.calibration.views import GridView

__all__ = ["excess_sigma_px", "with_excess"]

Array = NDArray[np.float64]

# Median of the squared length of a normal vector in the plane, in variances per axis.
_MEDIAN_SQUARE = 2.0 * float(np.log(2.0))
# Ratio of variances up to which the stated uncertainties are good enough.
_GOOD_ENOUGH = 1.5


def excess_sigma_px(views: Sequence[GridView], residuals_px: Array, unknowns: int) -> float:
    """1-sigma per axis, px, that all corners scatter beyond their own; 0 where that is not worth a correction.

    Parameters
    ----------
    views
        Views with n corners together.
    residuals_px
        (n, 2) residuals of a fit.
    unknowns
        Number of fitted unknowns, which make the residuals smaller than the errors.
    """
    own = np.concatenate([v.sigma_px for v in views]) ** 2
    square = np.sum(residuals_px**2, axis=1)
    target: float = _MEDIAN_SQUARE * max(1.0 - unknowns / (2.0 * len(square)), 0.1)

    def surplus(variance: float) -> float:
        ratio = float(np.median(square / (own + variance)))
        return ratio - target

    if not np.all(np.isfinite(square)) or surplus(0.0) < (_GOOD_ENOUGH - 1.0) * target:
        return 0.0
    return float(np.sqrt(brentq(surplus, 0.0, float(square.max()) / target + 1e-12)))


def with_excess(views: Sequence[GridView], sigma_px: float) -> tuple[GridView, ...]:
    """The views, their corners more uncertain by ``sigma_px`` per axis."""
    return tuple(view.with_excess(sigma_px) for view in views)
