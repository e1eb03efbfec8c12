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

"""Scatter beyond the stated uncertainty is found where there is some, and only there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.views import GridView, add_excess_noise, estimate_excess_sigma_px
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import grid_views


def _view(n, rng):
    sigma = rng.uniform(0.02, 0.08, n)
    covariance = sigma[:, None, None] ** 2 * np.eye(2)
    return GridView(1.0, np.zeros((n, 2)), np.zeros((n, 2)), sigma, "", covariance)


@pytest.mark.parametrize("excess", [0.0, 0.1, 0.5])
def test_known_excess_is_found(excess):
    rng = np.random.default_rng(0)
    view = _view(4000, rng)
    residuals = rng.normal(size=(4000, 2)) * np.hypot(view.sigma_px, excess)[:, None]
    # A tenth of outliers must not matter much: they move the median by a few percent.
    residuals[:400] *= 30.0
    # The median of 4000 squares is known to 2 %, the outliers raise it by 20 %: 10 % of a sigma.
    assert estimate_excess_sigma_px([view], residuals, 6) == pytest.approx(excess, rel=0.13)


def test_unknowns_that_take_up_half_of_the_scatter_are_allowed_for():
    # An affine map fitted to a hexagon leaves half of the variance, the same at all six corners.
    turn = np.arange(6) * np.pi / 3.0
    design = np.stack([np.ones(6), np.cos(turn), np.sin(turn)], axis=1)
    left = np.eye(6) - design @ np.linalg.pinv(design)
    rng = np.random.default_rng(3)
    views = [_view(6, rng) for _ in range(1000)]
    noise = [rng.normal(size=(6, 2)) * np.hypot(0.05, 0.2) for _ in views]
    views = [replace(v, sigma_px=np.full(6, 0.05)) for v in views]
    residuals = np.concatenate([left @ n for n in noise])
    found = estimate_excess_sigma_px(views, residuals, 6 * len(views))
    # The median of 6000 squares, half of them independent, is known to 3 %: 1.5 % of a sigma.
    assert found == pytest.approx(0.2, rel=0.05)


def test_excess_is_added_to_every_corner():
    view = _view(10, np.random.default_rng(1))
    (wider,) = add_excess_noise([view], 0.3)
    np.testing.assert_allclose(wider.sigma_px**2, view.sigma_px**2 + 0.09)
    np.testing.assert_allclose(wider.covariance_px2, view.covariance_px2 + 0.09 * np.eye(2))


def _put_some_elsewhere(xy, rng):
    """Corners (n, 2), one in a hundred of which is 1.5 px off."""
    off = rng.normal(size=xy.shape)
    off *= 1.5 / np.linalg.norm(off, axis=1, keepdims=True)
    return np.where(rng.random((len(xy), 1)) < 0.01, xy + off, xy)


@pytest.mark.slow
@pytest.mark.long
def test_an_uneven_board_is_told_and_counts_in_the_uncertainty_and_a_few_outliers_do_not():
    microscope = preset("jsm820")
    rng = np.random.default_rng(2)
    magnifications = [100.0, 400.0, 1500.0, 5000.0]
    even = grid_views(microscope.camera_at, magnifications, noise_px=0.02, views=4)
    uneven = [
        GridView(
            v.magnification,
            v.board_xy_m,
            v.image_xy + rng.normal(scale=0.2, size=v.image_xy.shape),
            v.sigma_px,
            v.name,
        )
        for v in even
    ]
    options = {
        "image_size": (512, 512),
        "display_width_m": 0.12,
        "options": CalibrationOptions(residual="off"),
    }
    good, bad = (calibrate_views(v, **options) for v in (even, uneven))
    assert good.model.statistics["fit"]["excess_sigma_px"] == 0.0
    # Some thousand corners: known to a few percent.
    assert bad.model.statistics["fit"]["excess_sigma_px"] == pytest.approx(0.2, rel=0.06)
    assert not any("residuals are" in w for w in good.warnings)
    assert any("residuals are 10" in w or "residuals are 9" in w for w in bad.warnings)
    # One corner in a hundred that is somewhere else is no misfit of functions: it is in the weights.
    wrong = [replace(v, image_xy=_put_some_elsewhere(v.image_xy, rng)) for v in even]
    few = calibrate_views(wrong, **options)
    assert few.model.statistics["fit"]["excess_sigma_px"] == 0.0
    assert not any("residuals are" in w for w in few.warnings)
    # Where there are views, ten times the scatter makes what only the corners determine much less
    # certain: the distortion. Aspect and skew are limited by the drift and the tilts, too.
    sigma = [np.sqrt(np.diag(r.model.at(1500.0).covariance)[[6, 7]]) for r in (good, bad)]
    assert np.all(sigma[1] > 2.0 * sigma[0])
