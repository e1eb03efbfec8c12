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

"""How many coefficients a function gets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.calibration.estimator.problem import Priors, Setup, constant_functions
from semcal_ros.core.calibration.judgement.evaluate import fit_poses
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.select import Candidates, Summary, select_functions
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.distortion import LATE_TERMS, PRODUCTS
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import grid_views

JSM = preset("jsm820")
MAGNIFICATIONS = np.geomspace(100.0, 10000.0, 6)


def _aspect_size(values: np.ndarray, information: float) -> int:
    """Coefficients for an aspect that is known independently at every magnification."""
    setup = Setup((), MAGNIFICATIONS, (512, 512), 0.12, Priors())
    matrices, rights = np.zeros((6, 10, 10)), np.zeros((6, 10))
    matrices[:, 1, 1] = information
    rights[:, 1] = information * values
    chosen = select_functions(
        Summary(matrices, rights), setup, constant_functions(setup, {}), ("aspect",), ()
    )
    return chosen["aspect"][1]


def test_a_constant_gets_one_coefficient_and_a_line_two() -> None:
    assert _aspect_size(np.ones(6), 1e6) == 1
    assert _aspect_size(1.0 + 0.01 * np.log(MAGNIFICATIONS / 1000.0), 1e6) == 2


@pytest.mark.parametrize("outermost", [0, -1])
def test_the_outermost_magnifications_are_never_left_out(outermost: int) -> None:
    """Only the outermost one shows this change: the others could not predict it."""
    values = np.ones(6)
    values[outermost] += 0.003
    assert _aspect_size(values, 1e6) > 1


def test_changes_from_one_solution_are_those_of_solving_every_candidate() -> None:
    """Random equations of ten functions and two shared unknowns; some functions are there, others not."""
    rng = np.random.default_rng(3)
    setup = Setup((), MAGNIFICATIONS, (512, 512), 0.12, Priors())
    terms = ("xi_s", "coil_x2")
    base = constant_functions(setup, {})
    count = len(base) + len(terms) + 2
    roots = rng.normal(size=(6, count, 3 * count))
    summary = Summary(
        roots @ np.swapaxes(roots, 1, 2),
        rng.normal(size=(6, count)),
        np.zeros(2),
        np.array([4.0, 9.0]),
    )
    candidates = Candidates(summary, setup, base, terms)
    sizes = dict.fromkeys(base, ("chebyshev_log", 1))
    sizes |= {"xi_s": ("chebyshev_log", 0), "coil_x2": ("chebyshev_log", 1)}
    sizes |= {"aspect": ("chebyshev", 3), "xi_r": ("chebyshev_log", 2)}
    options = {
        "aspect": [("chebyshev", 2), ("chebyshev", 5), ("chebyshev_log", 3)],
        "xi_r": [("chebyshev_log", 1), ("chebyshev", 2)],
        "xi_s": [("chebyshev_log", 1), ("chebyshev", 2)],
        "coil_x2": [("chebyshev_log", 0), ("chebyshev_log", 2)],
    }
    falls = candidates.changes(sizes, options)
    assert set(falls) == {(name, option) for name in options for option in options[name]}
    score = candidates.score(sizes)
    for (name, option), fall in falls.items():
        # What differs is rounding.
        expected = score - candidates.score({**sizes, name: option})
        assert fall == pytest.approx(expected, rel=1e-7, abs=1e-7)
        assert expected != 0.0


def _displaced_lens(g: float) -> ScanCamera:
    """Decentring after Brown (1966) by (0.012, -0.004), without any radial distortion whose centre could move."""
    return replace(JSM.camera_at(g), xi_r=0.0, xi_t=0.004, xi_u=0.008, xi_v=0.004, xi_w=-0.008)


def _strong_lens(g: float) -> ScanCamera:
    """A lens with radial distortion of the fifth order, 2.4 px in the corner at 250x and none far above."""
    return replace(JSM.camera_at(g), xi_r4=0.003 * np.exp(-g / 500.0))


def _calibrate_at_five(truth: Callable[[float], ScanCamera], seed: int) -> CalibrationModel:
    """A calibration from 20 views, without a residual field, that is right at magnifications which it never saw."""
    size, display = JSM.image_size, JSM.display_width_m
    views = grid_views(
        truth, (250.0, 500.0, 1000.0, 2000.0, 4000.0), noise_px=0.05, views=4, seed=seed
    )
    model = calibrate_views(views, image_size=size, display_width_m=display).model
    assert model.residual is None
    clean = grid_views(truth, (350.0, 1400.0, 2800.0), noise_px=0.0, views=3, seed=9)
    # Some 30 coefficients from 20 views with 0.05 px of noise; without products the displaced lens is 0.07 px off.
    assert fit_poses(clean, model.at, height_sigma_m=4e-5).rms_px() < 0.03
    return model


@pytest.mark.long
@pytest.mark.parametrize(
    ("truth", "is_strong"), [(_strong_lens, True), (JSM.camera_at, False)], ids=["strong", "usual"]
)
def test_radial_distortion_of_the_fifth_order_is_found(
    truth: Callable[[float], ScanCamera], is_strong: bool
) -> None:
    model = _calibrate_at_five(truth, seed=5)
    assert ("xi_r4" in model.functions) == is_strong
    name = "xi_r4" if is_strong else "xi_r"
    for g in (350.0, 700.0, 1400.0):
        ours = model.at(g)
        sigma = np.sqrt(np.diag(ours.covariance))[ours.names.index(name)]
        assert abs(getattr(ours, name) - getattr(truth(g), name)) < 4.0 * sigma


@pytest.mark.long
@pytest.mark.parametrize("seed", [0, 1, 4])
def test_few_magnifications_are_not_followed_by_late_terms(seed: int) -> None:
    """With a sign that changes, the fifth order gains 22 to 74 here, and 1.5 at most with the same sign everywhere."""
    views = grid_views(
        JSM.camera_at, (100.0, 400.0, 1500.0, 5000.0), noise_px=0.02, views=4, seed=seed
    )
    size, display = JSM.image_size, JSM.display_width_m
    options = CalibrationOptions(residual="off")
    model = calibrate_views(views, image_size=size, display_width_m=display, options=options).model
    assert not [name for name in LATE_TERMS if name in model.functions]


@pytest.mark.long
@pytest.mark.parametrize(
    ("truth", "has_products"),
    [
        pytest.param(_displaced_lens, True, id="displaced lens"),
        pytest.param(JSM.camera_at, False, id="centre that moves"),
    ],
)
def test_products_of_both_coordinates_are_there_for_a_displaced_lens(
    truth: Callable[[float], ScanCamera], has_products: bool
) -> None:
    model = _calibrate_at_five(truth, seed=3)
    assert any(name in model.functions for name in PRODUCTS) == has_products
