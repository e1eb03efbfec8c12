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

"""Corners that are found off where the beam settles within their windows: in pictures, and in a calibration of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import erf

from benchmarks.calibration.fleet.microscope import DISPLAY_WIDTH_M, draw_microscope
from benchmarks.calibration.fleet.score import views_of
from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.views import GridView, views_from_detections
from semcal_ros.core.calibration.window_bias import (
    approach_window_bias,
    find_window_bias,
    undo_window_bias,
)
from semcal_ros.core.camera.scan_distortion import (
    SCAN_NAMES,
    Raster,
    deflection_shift,
    settling_decay,
)
from semcal_ros.core.corners import LatticeDetection, find_lattice
from semcal_ros.core.errors import InvalidValueError
from tests.helpers.long_tests import long_but

WIDTH, HEIGHT = 512, 384
RASTER = Raster.of(WIDTH, HEIGHT)
SQUARE_M = 1e-6


def amplitudes_of(name: str, amplitude_px: float) -> Array:
    """Amplitudes of the scan: one function, of so many px in the first column."""
    amplitudes = np.zeros(len(SCAN_NAMES))
    amplitudes[SCAN_NAMES.index(name)] = amplitude_px / RASTER.norm_px
    return amplitudes


def draw(pattern: str, spacing_px: float, angle: float, amplitudes: Array) -> Array:
    """A grid that lies flat, seen by a beam with this deflection, with the noise of 5000 electrons."""
    y, x = (a.astype(np.float64) for a in np.mgrid[:HEIGHT, :WIDTH])
    raw = np.stack([x.ravel(), y.ravel()], axis=1)
    i, j = lattice_from_raw(raw, spacing_px, angle, amplitudes).T
    blur_px = 0.9
    # The distance from the next edge, with a sign; the edges of dots are circles.
    if pattern == "chess":
        edges = [(t - np.round(t)) * np.where(np.round(t) % 2 == 0, 1.0, -1.0) for t in (i, j)]
        both = [erf(spacing_px * d / (np.sqrt(2.0) * blur_px)) for d in edges]
        bright = 0.5 + 0.3 * both[0] * both[1]
    else:
        away = np.hypot(i - np.round(i), j - np.round(j)) - 0.28
        bright = 0.5 - 0.3 * erf(spacing_px * away / (np.sqrt(2.0) * blur_px))
    rng = np.random.default_rng(round(1e3 * angle))
    return np.asarray(rng.poisson(5000.0 * bright).reshape(HEIGHT, WIDTH), dtype=np.float32)


def lattice_from_raw(raw: Array, spacing_px: float, angle: float, amplitudes: Array) -> Array:
    """(n, 2) lattice coordinates of raw pixels."""
    at = raw + deflection_shift(raw, amplitudes, RASTER) - 0.5 * np.array([WIDTH, HEIGHT])
    c, s = np.cos(angle), np.sin(angle)
    return at @ np.array([[c, -s], [s, c]]) / spacing_px


def errors_along(
    found: LatticeDetection, spacing_px: float, angle: float, amplitudes: Array
) -> Array:
    """(n,) found less true position along the lines, px."""
    at = lattice_from_raw(found.xy, spacing_px, angle, amplitudes)
    off = (at - np.round(at)) * spacing_px
    c, s = np.cos(angle), np.sin(angle)
    # Where the beam settles, a pixel is so much of what it is elsewhere.
    step = np.array([0.01, 0.0])
    ahead, behind = (
        deflection_shift(found.xy + e, amplitudes, RASTER)[:, 0] for e in (step, -step)
    )
    return np.asarray((off @ np.array([c, -s])) / (1.0 + (ahead - behind) / 0.02))


# Decays over 6, 12 and 24 columns: the faster one is over before the lattice tells anything of it, and of the slower
# ones it follows a part. Dots are broader than corners, and are off by more.
CASES = long_but(
    lambda case: case[0] == "chess",
    (
        ("chess", 30.0, "settling_2"),
        ("chess", 60.0, "settling_3"),
        ("dots", 30.0, "settling_2"),
        ("dots", 40.0, "settling_4"),
    ),
)


@pytest.mark.parametrize("case", CASES)
def test_the_bias_is_what_the_settling_says(case: tuple[str, float, str]) -> None:
    pattern, spacing_px, name = case
    amplitudes = amplitudes_of(name, 3.0)
    before, left, stated = [], [], []
    for angle in np.linspace(0.1, 1.4, 9):
        found = find_lattice(draw(pattern, spacing_px, angle, amplitudes), pattern=pattern)
        assert isinstance(found, LatticeDetection)
        view = view_of(found)
        off = errors_along(found, spacing_px, angle, amplitudes)
        whole = find_window_bias(view, amplitudes, RASTER)
        bias, sigma = whole[:, 0], undo_window_bias(view, whole).covariance_px2[:, 0, 0] ** 0.5
        # Where the beam has settled nothing is off, and nothing is taken out.
        assert np.max(np.abs(bias[found.xy[:, 0] > 200.0])) < 0.1 * np.min(found.sigma_px)
        large = np.abs(bias) > 2.0 * found.sigma_px
        before.append((off / found.sigma_px)[large])
        left.append(((off - bias) / found.sigma_px)[large])
        stated.append(((off - bias) / sigma)[large])
    was, now, over_sigma = (
        np.sqrt(np.mean(np.concatenate(part) ** 2)) for part in (before, left, stated)
    )
    assert len(np.concatenate(stated)) >= 8
    assert was > 3.0
    # To first order only: a half of it may remain, beside the noise, and that is a part of the sigmas.
    assert now < np.hypot(1.0, 0.5 * was)
    assert over_sigma < 1.3


def view_of(found: LatticeDetection) -> GridView:
    """The view of a detection whose magnification is the nominal one."""
    px_per_m = found.spacing_px / SQUARE_M
    views, _ = views_from_detections(
        [found],
        [px_per_m * DISPLAY_WIDTH_M / WIDTH],
        display_width_m=DISPLAY_WIDTH_M,
        squares_m=[SQUARE_M],
    )
    return views[0]


def see_undistorted(pattern: str) -> GridView:
    """A view of a grid by a beam that goes where it should."""
    found = find_lattice(draw(pattern, 30.0, 0.3, np.zeros(len(SCAN_NAMES))), pattern=pattern)
    assert isinstance(found, LatticeDetection)
    return view_of(found)


def test_without_settling_or_without_what_a_fit_says_nothing_is_taken_out() -> None:
    view = see_undistorted("chess")
    assert not np.any(find_window_bias(view, amplitudes_of("coil_y3", 2.0), RASTER))
    amplitudes = amplitudes_of("settling_3", 3.0)
    assert np.any(find_window_bias(view, amplitudes, RASTER))
    assert not np.any(find_window_bias(replace(view, scan_response=None), amplitudes, RASTER))
    # What is taken out is a part of the sigmas, and is taken out once.
    bias = find_window_bias(view, amplitudes, RASTER)
    without = undo_window_bias(view, bias)
    np.testing.assert_allclose(without.image_xy, view.image_xy - bias)
    assert np.all(without.sigma_px >= view.sigma_px)
    assert not np.any(find_window_bias(without, amplitudes, RASTER))


def test_a_decay_that_was_fitted_to_biased_corners_tells_the_bias_in_one_step() -> None:
    view = see_undistorted("dots")
    true = amplitudes_of("settling_3", 1.0)
    bias = find_window_bias(view, true, RASTER)
    # Of one corner: its decay is fitted a times too large.
    nearest = int(np.argmax(np.abs(bias[:, 0])))
    decay = 0.5 * WIDTH * settling_decay(view.image_xy[:, 0], true, RASTER)[nearest]
    a = np.linalg.norm(bias[nearest]) / decay
    assert a > 0.02
    approached, left = approach_window_bias(view, np.zeros_like(bias), (1.0 + a) * true, RASTER)
    # The decay of the points that are not near the border is not quite nothing.
    np.testing.assert_allclose(approached[nearest], bias[nearest], rtol=1e-3)
    np.testing.assert_allclose(left, (1.0 + a) * bias, atol=1e-9)


def test_what_the_coils_do_is_taken_out_at_once() -> None:
    view = see_undistorted("dots")
    coils = amplitudes_of("coil_x7", 1.0)
    bias = find_window_bias(view, coils, RASTER)
    assert np.max(np.abs(bias)) > np.min(view.sigma_px)
    approached, _ = approach_window_bias(view, np.zeros_like(bias), coils, RASTER)
    np.testing.assert_allclose(approached, bias)


def test_odd_views_have_no_bias() -> None:
    view, settling = see_undistorted("chess"), amplitudes_of("settling_3", 3.0)
    # Of a part of the corners it would be that of another lattice.
    assert view.chosen(np.arange(0, len(view.image_xy), 3)).scan_response is None
    none = np.zeros((0, 2))
    empty = GridView(
        view.magnification,
        none,
        none,
        np.zeros(0),
        square_m=SQUARE_M,
        scan_response=np.zeros((0, 2, 2)),
    )
    assert find_window_bias(empty, settling, RASTER).shape == (0, 2)
    with pytest.raises(InvalidValueError, match="responses to the scan"):
        replace(view, scan_response=np.zeros((3, 2, 2)))


@pytest.mark.slow
@pytest.mark.long
def test_a_calibration_is_not_led_astray_by_the_bias() -> None:
    # One decay that the camera has, 2 px over 12 columns, and corners that are moved as dots are.
    own = replace(
        draw_microscope(0, 3),
        width=WIDTH,
        height=HEIGHT,
        magnifications=(300.0, 600.0, 1200.0),
        views=3,
        visits=1,
        squares_across=11.0,
        principal_px=(250.0, 195.0),
        centre_px=(260.0, 190.0),
        noise_px=0.02,
        outliers=0.0,
        coil_px=(0.0, 0.0),
        spiral=0.0,
        settling_px=2.0,
        settling_columns=12.0,
        settles_late=True,
    )
    views = []
    for view in views_of(own):
        spacing = view.square_m * own.scale(view.magnification)
        response = np.zeros((len(view.image_xy), 2, 2))
        response[:, 1, 0] = 0.03 * spacing**2
        told = replace(view, scan_response=response)
        bias = find_window_bias(told, amplitudes_of("settling_3", -2.0), RASTER)
        views.append(replace(told, image_xy=view.image_xy + bias))

    def worst(given: Sequence[GridView]) -> float:
        """How far off the first columns are, px, with what is alike in all of them."""
        model = calibrate_views(
            given, image_size=(WIDTH, HEIGHT), display_width_m=DISPLAY_WIDTH_M
        ).model
        camera = model.at(600.0)
        columns = np.stack([np.arange(4.0, 30.0), np.full(26, 190.0)], axis=1)
        settled = deflection_shift(columns, camera.scan_amplitudes, camera.raster)[:, 0]
        true = deflection_shift(columns, amplitudes_of("settling_3", -2.0), RASTER)[:, 0]
        return float(np.max(np.abs(settled - true - np.mean(settled - true))))

    untold = worst([replace(view, scan_response=None) for view in views])
    assert untold > 0.1
    assert worst(views) < untold / 3.0
