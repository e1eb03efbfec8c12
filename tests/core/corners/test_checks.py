"""The checks of fitted corners, on fits that are written down."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from semcal_ros.core.arrays import Array
from semcal_ros.core.corners.checks import inflate_variance
from semcal_ros.core.corners.corner_fit import CornerFit


def fits(chi2: Array, freedom: float) -> CornerFit:
    """Fits of which only the residuals matter."""
    values = {field.name: np.zeros(len(chi2)) for field in fields(CornerFit)}
    return CornerFit(**{**values, "chi2": chi2, "freedom": np.full(len(chi2), freedom)})


def test_covariances_grow_with_the_common_misfit_and_with_a_far_larger_one() -> None:
    # Three standard deviations of chi-square per degree of freedom are 3 sqrt(2 / 50) = 0.6.
    chi2 = np.array([1.9, 2.0, 2.0, 2.1, 3.15, 3.25, 9.0])
    keep = np.array([True, True, True, True, False, False, False])
    factors = inflate_variance(fits(chi2, 50.0), keep)
    assert factors == pytest.approx([2.0, 2.0, 2.0, 2.0, 2.0, 3.25, 9.0])
