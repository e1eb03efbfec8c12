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

"""Poses that fit better than those to which an adjustment came.

The tilt of a plane that is seen under a nearly parallel projection may have either sign, and everything mirrored in
the reference plane looks the same from above. A pose that was found while the camera was still wrong may be far off;
another one follows from the affine part of its view."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.blocks import Problem, State, pick_views
from semcal_ros.core.calibration.estimator.bundle_adjustment import BundleResult, refine
from semcal_ros.core.calibration.estimator.priors import Setup
from semcal_ros.core.calibration.estimator.problem import (
    Functions,
    build_problem,
    weighted_squares,
    with_coefficients,
)
from semcal_ros.core.calibration.estimator.residuals import view_residuals
from semcal_ros.core.calibration.estimator.variance_components import VarianceComponents
from semcal_ros.core.calibration.initial_values import pose_from_camera
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import names_of
from semcal_ros.core.camera.plane_geometry import mirrored_tilt
from semcal_ros.core.camera.projection import ALL_NAMES
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import CalibrationError, InvalidValueError

__all__ = [
    "COARSE",
    "LEAST_DECREASE",
    "adjust",
    "adjust_with_other_poses",
    "mirror",
    "refine_coarsely",
    "resolve_mirrored_tilts",
    "restart_poses",
    "right_way_up",
    "thin_view",
    "try_other_poses",
]

# Shared unknowns that change their sign when everything is mirrored in the reference plane.
_ODD = ("grid_curvature_m", "axis_z_m")
# Rounds of turning views over. Each follows an adjustment to the last one, and the rounds end when
# no view turns.
_MAX_TURNS = 5
LEAST_DECREASE = 0.1
"""Least decrease of a sum of squares, in sigmas, that makes another pose of a view: what few steps leave is less."""
# Steps from either sign of a tilt, enough to say which fits better; the adjustment does the rest.
_POSE_ITERATIONS = 12
# Tolerance of the intermediate adjustments; only the last one needs to be exact.
COARSE = 1e-6
# Corners per view for what only needs to be near: signs of tilts, poses, start functions.
_ENOUGH_CORNERS = 60


def adjust(problem: Problem, state: State, *, tolerance: float = 1e-9) -> BundleResult:
    """Refine, and turn views to their mirrored tilt as long as that fits better."""
    result = refine(problem, state, tolerance=tolerance)
    for _ in range(_MAX_TURNS):
        turned, changed = resolve_mirrored_tilts(problem, result.state)
        if not changed:
            break
        result = refine(problem, turned, tolerance=tolerance)
    return result


def refine_coarsely(problem: Problem, state: State) -> BundleResult:
    """Adjust as exactly as what comes between needs."""
    return refine(problem, state, tolerance=COARSE)


def mirror(functions: Functions, problem: Problem, state: State) -> State:
    """Return the state mirrored in the reference plane: tilts, heights and the sign of rho.

    Every point stays where it is seen, so that views and poses alone do not tell the two states apart; priors do, and
    what a stage says. Exact where rho is a constant and the stage has no offsets.
    """
    names = list(names_of(functions))
    first = sum(functions[name].size for name in names[: names.index("rho")])
    theta = state.theta.copy()
    theta[first : first + functions["rho"].size] *= -1.0
    for k, name in enumerate(problem.shared):
        if name in _ODD:
            theta[len(theta) - len(problem.shared) + k] *= -1.0
    flip = np.array([1.0, 1.0, -1.0])
    visits = state.visits * [1.0, -1.0] if len(state.visits) else state.visits
    return replace(
        state,
        theta=theta,
        rotations=mirrored_tilt(state.rotations),
        translations_m=state.translations_m * flip,
        visits=visits,
    )


def right_way_up(
    setup: Setup, functions: Functions, problem: Problem, result: BundleResult
) -> BundleResult:
    """Return the adjustment, or the one of the mirrored start if that fits better.

    It is tried where the pivot has come to lie on the far side of the specimen, where no microscope has it.
    """
    rho = with_coefficients(functions, result.state.theta)["rho"](setup.magnifications[0])
    if rho >= 0.0:
        return result
    other = refine(problem, mirror(functions, problem, result.state), tolerance=COARSE)
    return other if other.cost < result.cost else result


def resolve_mirrored_tilts(problem: Problem, state: State) -> tuple[State, int]:
    """Fit the poses from both signs of the tilt; return the better ones and how many changed."""
    pairs = zip(problem.starts[:-1], problem.starts[1:], strict=True)
    middle = np.stack([problem.board_m[a:b].mean(axis=0) for a, b in pairs])
    rotations = mirrored_tilt(state.rotations)
    # Turning about the middle of the visible points keeps the view in place.
    moved = np.einsum("vij,vj->vi", state.rotations - rotations, middle)
    mirrored = replace(state, rotations=rotations, translations_m=state.translations_m + moved)
    own = refine(problem, state, fixed_theta=True, max_iterations=_POSE_ITERATIONS)
    other = refine(problem, mirrored, fixed_theta=True, max_iterations=_POSE_ITERATIONS)
    better = _view_costs(problem, other) < _view_costs(problem, own) - LEAST_DECREASE
    return pick_views(better, other.state, own.state), int(better.sum())


def restart_poses(setup: Setup, problem: Problem, state: State) -> tuple[State, int]:
    """Fit every pose anew from the affine part of its view under the camera of ``state``; return the better ones and
    how many changed.

    A pose that has got into an optimum of its own while the camera was still wrong comes out of it.
    """
    table = problem.cameras(state.theta)
    count = 0
    own = refine(problem, state, fixed_theta=True, max_iterations=_POSE_ITERATIONS)
    best = own.state
    costs = _view_costs(problem, own)
    starts = [
        _affine_poses(setup, view, table[k])
        for view, k in zip(setup.views, problem.group, strict=True)
    ]
    for k in (0, 1):
        rotations, translations = state.rotations.copy(), state.translations_m.copy()
        for v, start in enumerate(starts):
            if start is not None:
                rotations[v], translations[v] = start[0][k], start[1][k]
        fresh = replace(
            state,
            rotations=rotations,
            translations_m=translations,
            drift_px=np.zeros_like(state.drift_px),
            lattices=np.zeros_like(state.lattices),
        )
        other = refine(problem, fresh, fixed_theta=True, max_iterations=_POSE_ITERATIONS)
        other_costs = _view_costs(problem, other)
        better = other_costs < costs - LEAST_DECREASE
        best, costs = pick_views(better, other.state, best), np.where(better, other_costs, costs)
        count += int(better.sum())
    return best, count


def _affine_poses(setup: Setup, view: GridView, parameters: Array) -> tuple[Array, Array] | None:
    """Both poses of a view by :func:`pose_from_camera`, or None where the camera is none."""
    width, height = setup.image_size
    try:
        camera = ScanCamera(
            magnification=view.magnification,
            **dict(zip(ALL_NAMES, parameters.tolist(), strict=False)),
            norm_px=setup.norm_px,
            raster_ratio=setup.raster_ratio,
            width=width,
            height=height,
        )
        return pose_from_camera(view, camera)
    except (InvalidValueError, CalibrationError, np.linalg.LinAlgError):
        return None


def _view_costs(problem: Problem, result: BundleResult) -> Array:
    square = weighted_squares(problem, result)
    known = view_residuals(problem, result.state).values()
    own = np.sum([np.sum(residual.values**2, axis=1) for residual in known], axis=0)
    # A pose that moves corners to where the camera shows nothing is none.
    square = np.where(result.lost, np.inf, square)
    return np.bincount(problem.view_of_point, weights=square) + own


def thin_view(view: GridView) -> GridView:
    """Return the view with a random part of its corners, enough for a pose and a rough camera."""
    if len(view.board_xy_m) <= _ENOUGH_CORNERS:
        return view
    keep = np.random.default_rng(0).permutation(len(view.board_xy_m))[:_ENOUGH_CORNERS]
    return view.chosen(keep)


def try_other_poses(
    setup: Setup, functions: Functions, spread: VarianceComponents, state: State
) -> tuple[State, int]:
    """Try the mirrored tilt of every view, and a pose from the affine part of it; return how many fit better.

    A tilt that was chosen while the camera was still wrong may have the wrong sign, and then holds the camera back.
    """
    thin = replace(setup, views=tuple(thin_view(v) for v in setup.views))
    few = build_problem(thin, functions, thin.views, spread)
    state, mirrored = resolve_mirrored_tilts(few, state)
    state, restarted = restart_poses(thin, few, state)
    return state, mirrored + restarted


def adjust_with_other_poses(
    setup: Setup,
    functions: Functions,
    spread: VarianceComponents,
    problem: Problem,
    state: State,
) -> tuple[BundleResult, int]:
    """Adjust, and adjust to other poses as long as some fit better; return how many did."""
    result, total = refine_coarsely(problem, state), 0
    for _ in range(_MAX_TURNS):
        state, count = try_other_poses(setup, functions, spread, result.state)
        other = refine_coarsely(problem, state) if count else result
        if other.cost > result.cost - LEAST_DECREASE:
            # Better for some of the corners, and not for all.
            break
        result, total = other, total + count
    return result, total
