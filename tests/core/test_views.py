"""Square sizes from how the spacing changes with the magnification."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from semcal_ros.core.errors import CalibrationError
from semcal_ros.core.views import assign_squares, views_from_detections

SQUARES = (25e-6, 10e-6, 5e-6, 2e-6, 1e-6)


@dataclass(frozen=True)
class _Detection:
    ij: np.ndarray
    xy: np.ndarray
    sigma_px: np.ndarray
    spacing_px: float
    image_size: tuple[int, int] = (512, 512)
    accepted: bool = True
    reason: str = ""


def _spacings(g, squares, factor):
    return squares * g * 512 / 0.12 * factor


@pytest.mark.parametrize("factor", [1.0, 0.93, 1.3, 2.4, 0.4, 4.2])
def test_squares_are_found_under_a_wrong_display_width(factor):
    g = np.array([100.0, 500.0, 1000.0, 2500.0, 5000.0, 10000.0])
    squares = np.array([25e-6, 25e-6, 10e-6, 5e-6, 2e-6, 1e-6])
    wobble = np.array([1.0, 1.02, 0.99, 1.01, 0.98, 1.0])
    found = assign_squares(_spacings(g, squares, factor) * wobble, g * 512 / 0.12, SQUARES)
    np.testing.assert_allclose(found.square_m, squares)
    assert found.scale_factor == pytest.approx(factor, rel=0.03)
    assert found.spread < 1.05


def test_with_one_square_size_the_display_width_decides():
    g = np.array([1000.0, 1100.0])
    found = assign_squares(_spacings(g, 10e-6, 1.2), g * 512 / 0.12, SQUARES)
    np.testing.assert_allclose(found.square_m, 10e-6)
    assert found.scale_factor == pytest.approx(1.2)


def test_views_get_metres():
    ij = np.array([[i, j] for i in range(4) for j in range(3)])
    detection = _Detection(ij, ij * 42.67 + 100.0, np.full(12, 0.05), 42.67)
    views, assignment = views_from_detections(
        [detection], [1000.0], display_width_m=0.12, squares_m=SQUARES, names=["a"]
    )
    # The origin is the corner nearest to the middle of the image.
    middle = ij[np.argmin(np.sum((detection.xy - 255.5) ** 2, axis=1))]
    np.testing.assert_allclose(views[0].board_xy_m, (ij - middle) * 10e-6, atol=1e-18)
    assert views[0].name == "a"
    assert assignment.square_m.tolist() == pytest.approx([10e-6])


def test_no_or_rejected_detections_are_refused():
    with pytest.raises(CalibrationError, match="no image"):
        views_from_detections([], [], display_width_m=0.12, squares_m=SQUARES)
    rejected = _Detection(
        np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), 0.0, accepted=False, reason="blank"
    )
    with pytest.raises(CalibrationError, match="blank"):
        views_from_detections([rejected], [100.0], display_width_m=0.12, squares_m=SQUARES)
