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

"""Residuals and unknowns of a ladder: numerical derivatives, the prior, and the form of the functions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.camera.calibration_model import CalibrationModel, ScaleSigma, names_of
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.ladder.residuals import make_link, pair_rows, pair_values
from semcal_ros.core.ladder.unknowns import (
    LadderSetup,
    LadderState,
    PicturePlace,
    make_setup,
    start_state,
)
from tests.helpers.ladders import SIZE, calibration_of, make_scope

PICTURES = tuple(
    PicturePlace(f"{g:g}", g, visit)
    for visit, g in enumerate([5000.0, 7000.0, 10000.0, 14000.0])
    for _ in range(2)
)


def _with_terms(model: CalibrationModel) -> CalibrationModel:
    """With every further term, each a constant of its own."""
    g_range = model.magnification_range
    sizes = {"xi_s": 0.002, "xi_u": -0.001, "coil_x3": 1e-3, "settling_2": 2e-3, "coil_y2": -1e-3}
    functions = dict(model.functions) | {
        name: ContinuousFunction("chebyshev_log", np.array([value]), g_range)
        for name, value in sizes.items()
    }
    size = sum(functions[name].size for name in names_of(functions))
    return replace(model, functions=functions, covariance=1e-8 * np.eye(size), record=None)


def _random_state(setup: LadderSetup, seed: int = 0) -> LadderState:
    rng = np.random.default_rng(seed)
    components, bends, jumps, visits, slopes, poses, drifts, creep = setup.bounds
    values = start_state(setup).values.copy()
    values[components] += rng.normal(size=components.stop - components.start)
    values[bends] += 0.1 * setup.bend_sigmas * rng.normal(size=len(setup.bend_sigmas))
    values[jumps] += 0.003 * rng.normal(size=jumps.stop - jumps.start)
    values[visits] += 0.001 * rng.normal(size=visits.stop - visits.start)
    values[slopes] = [0.1, -0.2]
    pose = np.array([1.0, 20.0, 20.0, 0.5, 0.5])
    values[poses] += (pose * rng.normal(size=(len(setup.pictures), 5))).ravel()
    values[drifts] += rng.normal(size=drifts.stop - drifts.start)
    values[creep] = 2e-4
    return LadderState(setup, values)


@pytest.mark.parametrize("terms", [False, True])
def test_derivatives_are_those_of_the_residuals(terms: bool) -> None:
    model = calibration_of(make_scope())
    setup = make_setup(_with_terms(model) if terms else model, PICTURES, (SIZE, SIZE))
    state = _random_state(setup)
    rng = np.random.default_rng(1)
    first, second = rng.uniform(60.0, 200.0, (2, 7, 2))
    times = [(xy[:, 1] - 128.0) / SIZE for xy in (first, second)]
    spread = rng.normal(size=(7, 2, 2))
    covariance = 0.01 * (np.eye(2) + spread @ np.swapaxes(spread, 1, 2))
    # Across the zoom, and within one visit, which both pictures share.
    for numbers in ((1, 4), (6, 7)):
        link = make_link(setup, numbers, first, second, covariance, times)
        rows = pair_rows(state, link)
        np.testing.assert_allclose(rows.values, pair_values(state, link), atol=1e-9)
        whole = np.zeros((len(rows.values), setup.size))
        np.add.at(whole, (slice(None), rows.columns), rows.jacobian)
        scale = np.maximum(np.max(np.abs(whole), axis=0), 1e-3)
        # A step that moves the residuals by some thousandths of a sigma.
        for column in rows.columns:
            step = 1e-3 / scale[column]
            moved = [
                pair_values(
                    LadderState(setup, state.values + sign * step * np.eye(setup.size)[column]),
                    link,
                )
                for sign in (-1.0, 1.0)
            ]
            numerical = -(moved[1] - moved[0]) / (2.0 * step)
            np.testing.assert_allclose(
                whole[:, column], numerical, atol=2e-5 * scale[column], err_msg=str(column)
            )
        others = np.ones(setup.size)
        others[rows.columns] = 0.0
        np.testing.assert_array_equal(
            pair_values(LadderState(setup, state.values + 1e-3 * others), link),
            pair_values(state, link),
        )


def test_a_place_on_a_slope_is_seen_where_it_was_found() -> None:
    """A picture against itself: whatever the unknowns are, nothing is left."""
    model = calibration_of(make_scope())
    setup = make_setup(model, PICTURES, (SIZE, SIZE))
    xy = np.random.default_rng(2).uniform(20.0, 236.0, (30, 2))
    times = [(xy[:, 1] - 128.0) / SIZE] * 2
    link = make_link(setup, (4, 4), xy, xy, np.broadcast_to(np.eye(2), (30, 2, 2)), times)
    np.testing.assert_allclose(pair_values(_random_state(setup), link), 0.0, atol=1e-9)


def test_the_start_has_the_cameras_of_the_end_of_the_grid_beyond_it() -> None:
    model = calibration_of(make_scope())
    setup = make_setup(model, PICTURES, (SIZE, SIZE))
    parameters = start_state(setup).parameters
    known, end = model.at(5000.0), model.at(8000.0)
    # The camera of one magnification has room for all terms, those of a ladder for the ones that are there.
    size = parameters.shape[1]
    np.testing.assert_allclose(parameters[0], known.parameters[:size], rtol=1e-9)
    # Nominal scales differ; everything else stays.
    for row in (4, 6):
        np.testing.assert_allclose(
            parameters[row, 1:], end.parameters[1:size], rtol=1e-6, atol=1e-9
        )
        ratio = PICTURES[row].magnification / 8000.0
        assert parameters[row, 0] == pytest.approx(end.m * ratio, rel=1e-9)


def test_the_prior_of_the_functions_is_the_covariance_of_the_calibration() -> None:
    # Without what adds to it at every magnification.
    model = replace(calibration_of(make_scope()), scale_sigma=ScaleSigma())
    setup = make_setup(model, PICTURES, (SIZE, SIZE))
    for g in (3000.0, 8000.0):
        design = setup.design(g)
        covariance = design @ setup.root @ setup.root.T @ design.T
        own = model.at(g).covariance
        assert own is not None
        size = len(covariance)
        assert not np.any(own[size:])
        own = own[:size, :size]
        np.testing.assert_allclose(covariance, own, rtol=1e-6, atol=1e-12 * float(own.max()))


def test_a_ladder_goes_beyond_one_end() -> None:
    model = calibration_of(make_scope())
    for seen in ((2000.0, 4000.0), (700.0, 4000.0, 10000.0)):
        pictures = tuple(PicturePlace("", g, k) for k, g in enumerate(seen))
        with pytest.raises(InvalidValueError, match="beyond one end"):
            make_setup(model, pictures, (SIZE, SIZE))
