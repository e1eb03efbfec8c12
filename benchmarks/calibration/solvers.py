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

"""The solver of the calibration beside others, on one adjustment: the same unknowns, residuals and derivatives.

    python -m benchmarks.calibration.solvers [--recording grid_calibration]

The views are those of a reference recording with some corners of each, the functions those that its calibration
chooses, and the start is the first state of that calibration. Beside `refine` there is `scipy.optimize.least_squares`
(trust region, sparse), and, where they are installed (`pip install pyceres gtsam`), Ceres and GTSAM, with one residual
block per view. All get the derivatives of `corner_rows`. *above* is the cost above the least that any has reached, in
half chi-squares; *sigmas* the largest difference of a coefficient from that of `refine`, in its stated sigmas;
*seconds* is processor time.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import importlib.util
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.sparse
from scipy.optimize import least_squares

from benchmarks.calibration.cases import CONFIG, found_in, reference_folder
from benchmarks.table import show
from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.calibration.estimator.blocks import (
    Problem,
    State,
    empty_effects,
    retract,
    select_views,
    states_of,
)
from semcal_ros.core.calibration.estimator.bundle_adjustment import refine, refit_functions
from semcal_ros.core.calibration.estimator.poses import thin_view
from semcal_ros.core.calibration.estimator.problem import Setup, build_problem
from semcal_ros.core.calibration.estimator.residuals import (
    corner_rows,
    prior_cost,
    stack_rows,
    view_costs,
    view_residuals,
    whitened_norm,
)
from semcal_ros.core.calibration.pipeline import prepare
from semcal_ros.core.calibration.select import select
from semcal_ros.core.calibration.start import start
from semcal_ros.core.camera.calibration_model import stack_coefficients

# As in the last adjustment of a calibration.
_TOLERANCE, _MOST_STEPS = 1e-10, 300


@dataclass(frozen=True)
class Unknowns:
    """All unknowns as changes of a state, one vector: theta (K,), visits (J, 2), views (V, p)."""

    problem: Problem
    base: State

    @property
    def sizes(self) -> tuple[int, int, int]:
        visits = self.base.visits.size
        views = len(self.problem.group) * self.problem.layout.of_view.size
        return len(self.base.theta), visits, views

    def at(self, x: Array) -> State:
        k, j, _ = self.sizes
        views = x[k + j :].reshape(len(self.problem.group), -1)
        return retract(self.problem, self.base, x[:k], views, x[k : k + j].reshape(-1, 2))


def _turn_derivative(turn: Array) -> Array:
    """(3, 3) by how much a turn after a rotation changes with its rotation vector: the left Jacobian of SO(3)."""
    angle = float(np.linalg.norm(turn))
    x, y, z = turn
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle < 1e-8:
        return np.eye(3) + 0.5 * cross
    first, second = (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.asarray(np.eye(3) + first * cross + second * cross @ cross)


def rows_of_view(part: Problem, state: State, turn: Array) -> tuple[Array, Array]:
    """Residuals (n,) of a problem of one view and their derivatives (n, P) by its unknowns, with Huber's loss in both.

    Half the sum of their squares is the robust cost. ``turn`` is by how much the view has been turned.
    """
    corners = corner_rows(part, state)
    norm = whitened_norm(part, corners.residuals_px)
    weight = corners.huber_weight
    # Of a corner outside, the square root of twice Huber's loss, along the residual.
    loss = np.where(weight < 1.0, 2.0 * weight * norm**2 - (weight * norm) ** 2, norm**2)
    factor = np.sqrt(loss / np.maximum(weight * norm**2, 1e-300))
    known = stack_rows(part.layout, view_residuals(part, state))[0]
    values = np.concatenate([(corners.rows[:, -1] * factor).ravel(), known[:, -1]])
    by = np.zeros((len(values), part.layout.size))
    by[: -len(known), corners.columns[:-1]] = np.concatenate(list(corners.rows[:, :-1]), axis=1).T
    by[-len(known) :] = known[:, :-1]
    own = part.layout["view.turn"]
    by[:, own] = by[:, own] @ _turn_derivative(turn)
    return values, -by


class Parts:
    """The problems of single views, and how their unknowns stand among all."""

    def __init__(self, unknowns: Unknowns):
        problem = self.problem = unknowns.problem
        assert problem.effects is not None
        self.unknowns, self.visit = unknowns, problem.effects.visit
        count = len(problem.group)
        chosen: list[Mask] = [np.arange(count) == v for v in range(count)]
        self.parts = [select_views(problem, own) for own in chosen]
        self.bases = [states_of(unknowns.base, own) for own in chosen]

    def evaluate(self, v: int, theta: Array, visit: Array, view: Array) -> tuple[Array, ...]:
        """Residuals of a view, and derivatives by changes of theta (K,), of its visit (2,) and of the view (p,)."""
        part, base = self.parts[v], self.bases[v]
        visits = np.zeros_like(base.visits)
        visits[self.visit[v]] = visit
        state = retract(part, base, theta, view[None], visits)
        turn = view[part.layout.of_view["view.turn"]]
        values, by = rows_of_view(part, state, turn)
        layout = part.layout
        by_theta = by[:, layout.magnification] @ self.problem.designs[self.problem.group[v]]
        return values, by_theta, by[:, layout.visit], by[:, layout.view]

    def priors(self) -> tuple[Array, Array, Array]:
        """Sigmas of theta, its residuals at the base, and the sigmas of a visit."""
        assert self.problem.effects is not None
        sigma = self.problem.prior_sigma
        left = (self.unknowns.base.theta - self.problem.prior_mean) / sigma
        return sigma, left, self.problem.effects.visit_sigmas


Solver = Callable[[Unknowns], State]


def solve_by_refine(unknowns: Unknowns) -> State:
    """By the solver of the calibration."""
    found = refine(
        unknowns.problem, unknowns.base, tolerance=_TOLERANCE, max_iterations=_MOST_STEPS
    )
    return found.state


def solve_by_scipy(unknowns: Unknowns) -> State:
    """By `scipy.optimize.least_squares`, with a sparse matrix of derivatives."""
    parts = Parts(unknowns)
    k, j, size = unknowns.sizes
    width = unknowns.problem.layout.of_view.size
    sigma, left, visit_sigma = parts.priors()
    visits = unknowns.base.visits / visit_sigma

    @lru_cache(maxsize=1)
    def every(at: bytes) -> tuple[Array, Any]:
        x = np.frombuffer(at).copy()
        values, blocks = [], []
        for v, visit in enumerate(parts.visit):
            own = slice(k + j + v * width, k + j + (v + 1) * width)
            of_visit = slice(k + 2 * visit, k + 2 * visit + 2)
            r, *by = parts.evaluate(v, x[:k], x[of_visit], x[own])
            columns = np.concatenate([np.arange(k), np.r_[of_visit], np.r_[own]])
            values.append(r)
            filled = scipy.sparse.csr_matrix(np.concatenate(by, axis=1))
            place = scipy.sparse.csr_matrix(
                (np.ones(len(columns)), (np.arange(len(columns)), columns)), (len(columns), len(x))
            )
            blocks.append(filled @ place)
        values.append(left + x[:k] / sigma)
        values.append((visits + x[k : k + j].reshape(-1, 2) / visit_sigma).ravel())
        weights = np.concatenate([1.0 / sigma, np.tile(1.0 / visit_sigma, j // 2)])
        blocks.append(scipy.sparse.eye(k + j, len(x), format="csr").multiply(weights[:, None]))
        return np.concatenate(values), scipy.sparse.vstack(blocks, format="csr")

    found = least_squares(
        lambda x: every(x.tobytes())[0],
        np.zeros(k + j + size),
        jac=lambda x: every(x.tobytes())[1],
        x_scale="jac",
        ftol=_TOLERANCE,
        xtol=None,
        gtol=None,
        max_nfev=_MOST_STEPS,
    )
    return unknowns.at(found.x)


def solve_by_ceres(unknowns: Unknowns) -> State:
    """By Ceres (Levenberg and Marquardt's method, sparse Schur complement), through pyceres."""
    pyceres: Any = importlib.import_module("pyceres")
    parts = Parts(unknowns)
    k, j, size = unknowns.sizes
    x = np.zeros(k + j + size)
    theta = x[:k].copy()
    visits = [np.zeros(2) for _ in range(j // 2)]
    views = [np.zeros(unknowns.problem.layout.of_view.size) for _ in parts.parts]
    sigma, left, visit_sigma = parts.priors()

    class View(pyceres.CostFunction):
        def __init__(self, v: int) -> None:
            super().__init__()
            self.v = v
            values = parts.evaluate(v, theta, np.zeros(2), views[v])[0]
            self.set_num_residuals(len(values))
            self.set_parameter_block_sizes([k, 2, len(views[v])])

        def Evaluate(self, at: Any, residuals: Any, jacobians: Any) -> bool:
            r, *by = parts.evaluate(self.v, *(np.asarray(p) for p in at))
            residuals[:] = r
            for out, own in zip(jacobians or (), by, strict=False):
                if out is not None:
                    out[:] = own.ravel()
            return bool(np.all(np.isfinite(r)))

    class Prior(pyceres.CostFunction):
        def __init__(self, start: Array, scale: Array) -> None:
            super().__init__()
            self.start, self.scale = start, scale
            self.set_num_residuals(len(start))
            self.set_parameter_block_sizes([len(start)])

        def Evaluate(self, at: Any, residuals: Any, jacobians: Any) -> bool:
            residuals[:] = self.start + np.asarray(at[0]) / self.scale
            if jacobians is not None and jacobians[0] is not None:
                jacobians[0][:] = np.diag(1.0 / self.scale).ravel()
            return True

    problem = pyceres.Problem()
    for v, visit in enumerate(parts.visit):
        problem.add_residual_block(View(v), None, [theta, visits[visit], views[v]])
    problem.add_residual_block(Prior(left, sigma), None, [theta])
    for own, start_at in zip(visits, unknowns.base.visits, strict=True):
        problem.add_residual_block(Prior(start_at / visit_sigma, visit_sigma), None, [own])
    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.SPARSE_SCHUR
    options.max_num_iterations = _MOST_STEPS
    options.function_tolerance = _TOLERANCE
    options.gradient_tolerance = options.parameter_tolerance = 0.0
    options.num_threads = 1
    pyceres.solve(options, problem, pyceres.SolverSummary())
    return unknowns.at(np.concatenate([theta, *visits, *views]))


def solve_by_gtsam(unknowns: Unknowns) -> State:
    """By GTSAM (Levenberg and Marquardt's method on a factor graph)."""
    gtsam: Any = importlib.import_module("gtsam")
    parts = Parts(unknowns)
    k, j, _ = unknowns.sizes
    sigma, left, visit_sigma = parts.priors()
    count, width = j // 2, unknowns.problem.layout.of_view.size
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    values.insert(0, np.zeros(k))
    for i in range(count):
        values.insert(1 + i, np.zeros(2))
    for v in range(len(parts.parts)):
        values.insert(1 + count + v, np.zeros(width))

    def view_error(v: int) -> Callable[..., Array]:
        def error(factor: Any, at: Any, by: Any) -> Array:
            keys = factor.keys()
            r, *own = parts.evaluate(v, *(at.atVector(key) for key in keys))
            for place, derivative in enumerate(own if by is not None else ()):
                by[place] = np.asfortranarray(derivative)
            return r

        return error

    def prior_error(start_at: Array, scale: Array) -> Callable[..., Array]:
        def error(factor: Any, at: Any, by: Any) -> Array:
            if by is not None:
                by[0] = np.diag(1.0 / scale)
            return np.asarray(start_at + at.atVector(factor.keys()[0]) / scale)

        return error

    def add(keys: list[int], error: Callable[..., Array], length: int) -> None:
        graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(length), keys, error))

    for v, visit in enumerate(parts.visit):
        length = len(parts.evaluate(v, np.zeros(k), np.zeros(2), np.zeros(width))[0])
        add([0, 1 + int(visit), 1 + count + v], view_error(v), length)
    add([0], prior_error(left, sigma), k)
    for i, start_at in enumerate(unknowns.base.visits):
        add([1 + i], prior_error(start_at / visit_sigma, visit_sigma), 2)
    options = gtsam.LevenbergMarquardtParams()
    options.setMaxIterations(_MOST_STEPS)
    options.setRelativeErrorTol(_TOLERANCE)
    options.setAbsoluteErrorTol(0.0)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, options).optimize()
    keys = range(1 + count + len(parts.parts))
    return unknowns.at(np.concatenate([found.atVector(key) for key in keys]))


SOLVERS: dict[str, tuple[str | None, Solver]] = {
    "refine": (None, solve_by_refine),
    "scipy least_squares": (None, solve_by_scipy),
    "Ceres": ("pyceres", solve_by_ceres),
    "GTSAM": ("gtsam", solve_by_gtsam),
}


def draw_problem(setup: Setup) -> Unknowns:
    """The adjustment that a calibration ends with, at the state that it starts with."""
    first = start(setup)
    own = select(first, "off").adjustment
    sizes = {name: (f.kind, f.smooth_size) for name, f in own.functions.items()}
    functions = refit_functions(first.functions, sizes)
    problem = build_problem(setup, functions, setup.views, own.spread)
    theta = np.concatenate([stack_coefficients(functions), setup.shared_start()])
    base = State(theta, first.state.rotations, first.state.translations_m)
    return Unknowns(problem, empty_effects(problem, base))


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--recording", default="grid_calibration", help="of the reference data")
    given = parser.parse_args()
    found = found_in(reference_folder() / given.recording, lambda _k, _g: True)
    views = [thin_view(view) for view in found.views]
    setup = prepare(views, image_size=found.image_size, display_width_m=CONFIG.display_width_m)
    unknowns = draw_problem(setup)
    problem, ends = unknowns.problem, {}
    for name, (package, solve) in SOLVERS.items():
        if package is not None and importlib.util.find_spec(package) is None:
            print(f"{name}: {package} is not installed")
            continue
        begin_s = time.process_time()
        state = solve(unknowns)
        cost = float(view_costs(problem, state).sum()) + prior_cost(problem, state)
        ends[name] = state, cost, time.process_time() - begin_s
        print(name, f"{cost:.4f}", f"{ends[name][2]:.1f} s", flush=True)
    least = min(cost for _, cost, _ in ends.values())
    own = ends["refine"][0]
    sigmas = np.sqrt(np.diag(refine(problem, own, max_iterations=0).covariance))
    rows: list[list[object]] = [
        [name, seconds, f"{cost - least:.2g}", float(np.max(np.abs(s.theta - own.theta) / sigmas))]
        for name, (s, cost, seconds) in ends.items()
    ]
    title = f"{given.recording}: {len(problem.group)} views, {sum(unknowns.sizes)} unknowns"
    show(title, ["solver", "seconds", "above", "sigmas"], rows)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
