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

"""Every unknown of the adjustment against numerical derivatives of the whole system.

The system has visits that do not come back, drift within the images, a grid that is no perfect
grid, a tilt axis that misses the specimen, and a stage with constant errors.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from semcal_ros.core.calibration.estimator.blocks import State, empty_effects, retract
from semcal_ros.core.calibration.estimator.bundle_adjustment import refine
from semcal_ros.core.calibration.estimator.normal_equations import (
    eliminate,
    normal_equations,
    reduced_normal_equations,
    schur_complement,
)
from semcal_ros.core.calibration.estimator.problem import (
    Priors,
    Setup,
    Spread,
    VarianceComponents,
    build_problem,
    constant_functions,
    initial_components,
)
from semcal_ros.core.calibration.estimator.residuals import (
    VIEW_RESIDUALS,
    corner_residuals,
    corner_rows,
    stack_rows,
    view_residuals,
    whitened_norm,
)
from semcal_ros.core.calibration.stage import StageAxis
from semcal_ros.core.calibration.start import add_shared_unknowns, align_lattices
from semcal_ros.core.camera.calibration_model import stack_coefficients
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import GridFaults, SimulatedStage, grid_views, stage_views
from tests.helpers.calibrations import calibrated

MICROSCOPE = preset("strong_perspective")


@pytest.fixture(scope="module", params=[None, (7e-4, 4e-4)], ids=["same axes", "own lattices"])
def system(request):
    """The problem, and a state near its optimum, with every effect there is."""
    stage, grid = SimulatedStage(miss_m=(1e-4, -6e-5)), GridFaults(1e-3, -5e-4, 10.0)
    views = stage_views(
        MICROSCOPE.camera_at, (200.0, 600.0, 200.0), stage, grid, seed=3, readings=True
    )
    views = [replace(v, square_m=1e-5 if v.magnification < 300 else 2e-5) for v in views]
    ordered = tuple(sorted(views, key=lambda v: v.magnification))
    setup = Setup(
        ordered,
        np.array([200.0, 600.0]),
        MICROSCOPE.image_size,
        MICROSCOPE.display_width_m,
        Priors(),
        axis=StageAxis(0.2),
    )
    setup = add_shared_unknowns(align_lattices(setup))
    functions = constant_functions(setup, {})
    count = len(setup.views)
    spread = VarianceComponents(
        Spread(2e-3, 0.0),
        Spread(3e-5, 0.0),
        np.full(count, 4e-5),
        np.full(count, 0.2),
        None if request.param is None else np.array(request.param),
    )
    problem = build_problem(setup, functions, setup.views, spread)
    rng = np.random.default_rng(0)
    start = _start(setup, functions)
    state = empty_effects(problem, refine(problem, start).state)
    # Away from the optimum and from zero, where no derivative vanishes by chance.
    state = replace(
        state,
        theta=state.theta + 0.3 * rng.normal(size=len(state.theta)) * _theta_scale(setup),
        visits=rng.normal(size=state.visits.shape) * [1e-3, 2e-5],
        drift_px=rng.normal(size=state.drift_px.shape) * 0.2,
        lattices=rng.normal(size=state.lattices.shape) * 5e-4,
    )
    return problem, state


def _start(setup, functions):
    from semcal_ros.core.calibration.estimator.poses import initial_values

    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in setup.views]))
    start = initial_values(setup.views, nominal, setup.centre_px, setup.priors.rho_mean)
    theta = np.concatenate([stack_coefficients(functions), setup.shared_start()])
    return State(theta, start.rotations, start.translations_m)


def _theta_scale(setup):
    # The derivatives by angles of the stage are those of small differences from it.
    shared = np.minimum(setup.shared_priors()[1], 0.01) * 0.2
    return np.concatenate([[1e-3, 1e-3, 1e-3, 3.0, 3.0, 2.0, 1e-3, 1e-3, 3.0, 3.0], shared])


def _moved(problem, state, x):
    """The state after a step in all unknowns: theta, visits, poses."""
    size, visits = len(state.theta), state.visits.size
    return retract(
        problem,
        state,
        x[:size],
        x[size + visits :].reshape(len(problem.group), -1),
        x[size : size + visits].reshape(-1, 2),
    )


def _whole(problem, state, x, huber):
    """All whitened residuals, of observations and of priors, as one vector."""
    moved = _moved(problem, state, x)
    miss = corner_residuals(problem, moved)
    xx, yx, yy = problem.whitening.T * np.sqrt(huber)
    return np.concatenate(
        [
            xx * miss[:, 0],
            yx * miss[:, 0] + yy * miss[:, 1],
            stack_rows(problem.layout, view_residuals(problem, moved))[:, :, -1].ravel(),
            (-moved.visits / problem.effects.visit_sigmas).ravel(),
            (problem.prior_mean - moved.theta) / problem.prior_sigma,
        ]
    )


@pytest.fixture(scope="module")
def dense(system):
    """Numerical normal equations of the whole system."""
    problem, state = system
    huber = normal_equations(problem, state).huber_weight
    size = len(state.theta) + state.visits.size + problem.layout.of_view.size * len(problem.group)
    # Steps small enough for the curvature and large enough for rounding, in units of the priors.
    own = np.minimum(problem.prior_sigma, 1.0)
    own_steps = [1e-6] * (problem.layout.of_view.size - 8)
    steps = np.concatenate(
        [
            1e-4 * own,
            np.tile(problem.effects.visit_sigmas * 1e-2, len(state.visits)),
            np.tile([*[1e-5] * 3, *[1e-3] * 3, *[1e-3] * 2, *own_steps], len(problem.group)),
        ]
    )
    columns = []
    for k in range(size):
        delta = np.zeros(size)
        delta[k] = steps[k]
        change = _whole(problem, state, delta, huber) - _whole(problem, state, -delta, huber)
        columns.append(change / (2.0 * steps[k]))
    jacobian = np.stack(columns, axis=1)
    right = -jacobian.T @ _whole(problem, state, np.zeros(size), huber)
    return jacobian.T @ jacobian, right


def test_the_step_is_that_of_the_whole_system(system, dense):
    """Eliminating poses and visits gives the Gauss-Newton step of all unknowns at once."""
    problem, state = system
    matrix, right = dense
    scale = 1.0 / np.sqrt(np.diag(matrix))
    step = scale * np.linalg.solve(matrix * np.outer(scale, scale), scale * right)
    reduced = schur_complement(problem, state, normal_equations(problem, state), 0.0)
    own, pull = reduced_normal_equations(
        problem, state.theta, reduced.information, reduced.gradient
    )
    change = np.linalg.solve(own, pull)
    _, visits, poses = reduced.back(problem, change)
    found = np.concatenate([change, visits.ravel(), poses.ravel()])
    sigma = np.sqrt(np.diag(np.linalg.inv(matrix * np.outer(scale, scale)))) * scale
    # Numerical derivatives are good to about 1e-5 of a step; in units of the sigmas.
    np.testing.assert_allclose(found / sigma, step / sigma, rtol=2e-3, atol=2e-3)


def test_covariances_are_those_of_the_whole_system(system, dense):
    problem, state = system
    matrix, _ = dense
    scale = 1.0 / np.sqrt(np.diag(matrix))
    inverse = np.linalg.inv(matrix * np.outer(scale, scale)) * np.outer(scale, scale)
    result = refine(problem, state, max_iterations=0)
    size = len(state.theta)
    np.testing.assert_allclose(
        np.sqrt(np.diag(result.covariance)), np.sqrt(np.diag(inverse)[:size]), rtol=2e-3
    )
    visits = np.diag(inverse)[size : size + state.visits.size].reshape(-1, 2)
    np.testing.assert_allclose(np.sqrt(result.visit_variance), np.sqrt(visits), rtol=2e-3)
    rows = stack_rows(problem.layout, view_residuals(problem, state))[:, :, :-1]
    first, outer = problem.layout.visit.start, problem.layout.view.start
    found = np.concatenate(list(result.prior_variance.values()), axis=1)
    for v in (0, len(problem.group) - 1):
        # The unknowns of a view from those of the whole system.
        take = np.zeros((rows.shape[2], len(inverse)))
        take[:first, :size] = problem.designs[problem.group[v]]
        visit = size + 2 * problem.effects.visit[v]
        take[[first, first + 1], [visit, visit + 1]] = 1.0
        pose = size + state.visits.size + problem.layout.of_view.size * v
        own = np.arange(problem.layout.of_view.size)
        take[outer + own, pose + own] = 1.0
        spread = take @ inverse @ take.T
        expected = np.diag(rows[v] @ spread @ rows[v].T)
        np.testing.assert_allclose(found[v], expected, rtol=5e-3, atol=1e-6)
    at = problem.layout.of_view["view.drift"]
    for j in range(len(state.visits)):
        members = np.flatnonzero(problem.effects.visit == j)
        mean = np.zeros((2, len(inverse)))
        for v in members:
            own = (
                size
                + state.visits.size
                + problem.layout.of_view.size * v
                + np.arange(at.start, at.stop)
            )
            mean[[0, 1], own] = 1.0 / len(members)
        np.testing.assert_allclose(
            result.mean_drift_variance[j], np.diag(mean @ inverse @ mean.T), rtol=5e-3
        )


# Steps in the units of the blocks, small against their curvature and large against rounding.
STEPS = {
    "camera": 1e-5,
    "grid.shape": 1e-6,
    "grid.squares": 1e-6,
    "stage.axis": 1e-8,
    "stage.offset": 1e-6,
    "visit.scale": 1e-6,
    "visit.height": 1e-8,
    "view.turn": 1e-6,
    "view.shift": 1e-3,
    "view.drift": 1e-3,
    "view.lattice": 1e-6,
}


def _stepped(problem, state, block, k, step):
    """The state after a step in the k-th unknown of a block of every magnification, visit or view."""
    layout = problem.layout
    theta = np.zeros_like(state.theta)
    visits, views = np.zeros_like(state.visits), np.zeros((len(problem.group), layout.of_view.size))
    if block in layout.of_view:
        views[:, layout.of_view[block].start + k] = step
    elif block in layout.of_visit:
        visits[:, layout.of_visit[block].start + k] = step
    else:
        # The functions of this problem are constants: the camera is theta itself, but for the scale.
        column = layout[block].start + k
        theta[column] = step / problem.designs[0, column, column]
    return retract(problem, state, theta, views, visits)


def _central(values, step):
    return (values(step) - values(-step)) / (2.0 * step)


@pytest.mark.parametrize("name", VIEW_RESIDUALS)
def test_derivatives_of_the_residuals_of_views(system, name):
    """Of every kind, by every unknown of every block; where a residual names no derivative, there is none."""
    problem, state = system
    residual = VIEW_RESIDUALS[name](problem, state)
    if residual is None:
        assert name == "lattice"
        assert "view.lattice" not in problem.layout
        return
    rows = stack_rows(problem.layout, {name: residual})
    assert set(residual.by) <= set(STEPS)
    for block in problem.layout.blocks:
        step = STEPS[block.name]
        for k in range(len(block.unknowns)):

            def values(delta, block=block.name, k=k):
                moved = _stepped(problem, state, block, k, delta)
                return VIEW_RESIDUALS[name](problem, moved).values

            found = rows[:, :, problem.layout[block.name].start + k]
            expected = -_central(values, step)
            # Rounding of a residual of some sigmas, over the step.
            largest = np.max(np.abs(residual.values))
            floor = 1e-9 * (1.0 + largest) / step
            if name == "attitude":
                # A rotation that is left is taken for a small one: per rad, this leaves out the residual itself.
                floor += largest
            np.testing.assert_allclose(found, expected, rtol=1e-5, atol=floor, err_msg=block.name)


def test_derivatives_of_the_corners(system):
    """By every unknown of every block, those included on which a corner does not depend."""
    problem, state = system
    corners = corner_rows(problem, state)
    rows = np.zeros((2, problem.layout.size, len(problem.board_m)))
    rows[:, corners.columns[:-1]] = corners.rows[:, :-1]
    xx, yx, yy = problem.whitening.T * np.sqrt(corners.huber_weight)
    # The first magnification alone: its scale has the step in px per m.
    own = problem.group[problem.view_of_point] == 0
    for block in problem.layout.blocks:
        for k, unknown in enumerate(block.unknowns):
            step = STEPS[block.name] * (problem.designs[0, 0, 0] if unknown == "m" else 1.0)

            def values(delta, block=block.name, k=k):
                moved = _stepped(problem, state, block, k, delta)
                x, y = corner_residuals(problem, moved).T
                return np.stack([xx * x, yx * x + yy * y])

            found = rows[:, problem.layout[block.name].start + k, own]
            expected = -_central(values, step)[:, own]
            scale = np.max(np.abs(expected)) + 1e-6 / step
            np.testing.assert_allclose(
                found / scale, expected / scale, rtol=1e-4, atol=1e-6, err_msg=block.name
            )


def test_the_cost_curves_with_a_tilt_as_is_said():
    """Of a view that stands flat although it is tilted: there the first derivatives by the tilt vanish."""
    microscope = preset("parallel")
    views = grid_views(microscope.camera_at, (2000.0,), noise_px=0.05, views=3, seed=4)
    size, width = microscope.image_size, microscope.display_width_m
    setup = Setup(tuple(views), np.array([2000.0]), size, width, Priors(rho_mean=0.0))
    functions = constant_functions(setup, {})
    problem = build_problem(setup, functions, setup.views, initial_components(setup))
    start = _start(setup, functions)
    # Every view is flat: the tilted ones leave residuals of many sigmas.
    state = empty_effects(problem, replace(start, rotations=np.stack([np.eye(3)] * len(views))))
    corners = corner_rows(problem, state)
    turn = corners.layout["view.turn"]
    for v, (first, last) in enumerate(zip(problem.starts[:-1], problem.starts[1:], strict=True)):
        rows = corners.rows[:, turn, first:last]
        by_first = np.einsum("kpn,kqn->pq", rows, rows)
        curvature = by_first + corners.turn_curvature[v]
        huber = corners.huber_weight[first:last]

        def cost(step, v=v, first=first, last=last, huber=huber):
            turns = np.zeros((len(views), problem.layout.of_view.size))
            turns[v, problem.layout.of_view["view.turn"]] = step
            still = np.zeros_like(state.visits)
            moved = retract(problem, state, np.zeros_like(state.theta), turns, still)
            left = whitened_norm(problem, corner_residuals(problem, moved))[first:last]
            return 0.5 * float(np.sum(huber * left**2))

        step = 1e-3
        for axis in np.eye(3)[:2]:
            second = (cost(step * axis) - 2.0 * cost(0.0 * axis) + cost(-step * axis)) / step**2
            assert second == pytest.approx(axis @ curvature @ axis, rel=2e-3)
            # Without the second derivatives there would be hardly any.
            assert axis @ by_first @ axis < 0.1 * abs(second)


@pytest.mark.long
@pytest.mark.parametrize("seed", [2, 6])
def test_flat_views_under_parallel_projection_converge(seed):
    """The tilt of a view from above acts by its square alone; such views once stopped at the iteration limit."""
    result = calibrated("parallel", seed=seed)
    assert result.model.statistics["fit"]["converged"]


def _eliminated_error(seed):
    """The error of what five unknowns leave of two others, of which they take one wholly, in parts of what there was.

    Of the five two pairs are alike to 1e-3, so that their condition is some 1e6. Integers tell the truth exactly.
    """
    rng = np.random.default_rng(seed)
    a, b, c, other = rng.integers(-1000, 1000, (4, 30))
    near = rng.integers(-1, 2, (2, 30))
    inner = np.stack([a, a + near[0], b, b + near[1], c])
    rows = np.concatenate([[[3, -2, 1, 0, 1] @ inner, other], inner])
    matrix = rows @ rows.T
    exact = [[Fraction(int(value)) for value in row] for row in matrix]
    for k in range(6, 1, -1):
        for i in range(k):
            part = exact[i][k] / exact[k][k]
            exact[i][:k] = [v - part * w for v, w in zip(exact[i][:k], exact[k][:k], strict=True)]
    expected = np.array([row[:2] for row in exact[:2]], dtype=np.float64)
    found, _, _ = eliminate(matrix[None].astype(np.float64), np.zeros((1, 7)), 2)
    before = np.sqrt(np.diag(matrix)[:2])
    return float(np.max(np.abs(found[0] - expected) / np.outer(before, before)))


def test_what_unknowns_that_are_much_alike_leave_is_right_to_rounding():
    """The median of 20 is below 7 coefficients x 2e-16 x sqrt(1e6 ... 1e7); by an inverse it would be 3e-11."""
    assert np.median([_eliminated_error(seed) for seed in range(20)]) < 5e-12
