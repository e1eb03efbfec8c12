"""Algorithm 1 and the differential equations of appendix A, on known answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.calibration.distortion_centre import find_distortion_centre
from semcal_ros.core.calibration.pda import ode_weights
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.synthetic.grid_views import grid_views

BARREL = ScanCamera(
    500.0, 2.1e6, 1.0, 0.0, 255.5, 255.5, 50.0, 0.01, 0.0, 290.0, 240.0, 256.0, 512, 512
)


def test_radial_centre_is_the_common_epipole():
    views = grid_views(lambda g: BARREL, [500.0], views=5, noise_px=0.02)
    found = find_distortion_centre(views)
    assert not found.degenerate
    # xi_r = 0.01 moves the corner of the image by 7 px; 0.02 px noise then places the centre to a few pixels.
    np.testing.assert_allclose(found.centre_px, [290.0, 240.0], atol=6.0)
    assert found.noise_rms_px == pytest.approx(0.02 * np.sqrt(2.0), rel=0.2)
    assert found.homography_rms_px > 10 * found.noise_rms_px


def test_without_distortion_the_situation_is_degenerate():
    views = grid_views(lambda g: replace(BARREL, xi_r=0.0), [500.0], views=5, noise_px=0.02)
    found = find_distortion_centre(views)
    assert found.degenerate
    assert found.p_value > 1e-3


def test_the_papers_threshold_never_holds_with_real_noise():
    views = grid_views(lambda g: replace(BARREL, xi_r=0.0), [500.0], views=5, noise_px=0.02)
    assert not find_distortion_centre(views, tau_px=1e-3).degenerate
    assert find_distortion_centre(views, tau_px=0.1).degenerate


@pytest.mark.parametrize(
    ("weights", "solution"),
    [
        ([2.0], lambda u: np.exp(-2.0 * u)),
        ([9.0, 0.0], lambda u: np.cos(3.0 * u)),
        ([4.0, 5.0], lambda u: np.exp(-u) + 0.7 * np.exp(-4.0 * u)),
    ],
)
def test_weights_of_a_known_equation(weights, solution):
    u = np.linspace(0.0, 1.0, 401)
    found = ode_weights(u, solution(u), np.ones(401), len(weights))
    # Repeated first-order differences at the two ends of 400 steps, where the solutions are steepest, cost 10 %.
    np.testing.assert_allclose(found, weights, rtol=0.1, atol=0.05)
