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

"""Poses of views: first ones from the affine part of every view, and others that fit better.

The first ones presume only the nominal scale (magnification, image width, display width) and zero distortion. The tilt
of a plane that is seen under a nearly parallel projection may have either sign, and everything mirrored in the
reference plane looks the same from above. A pose that was found while the camera was still wrong may be far off;
another one follows from the affine part of its view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.blocks import Problem, State, pick_views
from semcal_ros.core.calibration.estimator.bundle_adjustment import (
    BundleResult,
    refine,
    refine_poses,
)
from semcal_ros.core.calibration.estimator.problem import (
    Functions,
    Setup,
    VarianceComponents,
    build_problem,
)
from semcal_ros.core.calibration.estimator.residuals import view_squares
from semcal_ros.core.calibration.estimator.thresholds import (
    COARSE_TOLERANCE,
    DECREASE_MIN,
    MIRROR_ROUNDS,
    POSE_CORNERS,
    POSE_STEPS,
    WIDE_RATIO,
)
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import columns_of, with_coefficients
from semcal_ros.core.camera.plane_geometry import (
    AffineView,
    mirrored_tilt,
    rotation_from_affine,
    view_affine,
)
from semcal_ros.core.camera.projection import ALL_NAMES
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import CalibrationError, InvalidValueError
from semcal_ros.core.wording import counted


@dataclass(frozen=True)
class InitialValues:
    """Starting values of the adjustment.

    Attributes
    ----------
    scale_factor
        Observed over nominal scale, median over the views.
    rho
        Inverse pivot distance, 1/m.
    rotations, translations_m
        (V, 3, 3) and (V, 3).
    wide
        Whether the perspective within the widest view is so strong that it determines ``rho`` by
        itself, as in a photograph.
    """

    scale_factor: float
    rho: float
    rotations: Array
    translations_m: Array
    wide: bool


def _estimate_rho(affines: Sequence[AffineView], rotations: Array, fallback: float) -> float:
    """Fit |depth gradient| = rho * sin(tilt) by least squares, weighted by the field of view."""
    gradient = np.array([np.linalg.norm(a.gradient) for a in affines])
    tilt = np.linalg.norm(rotations[:, 2, :2], axis=1)
    # Noise of the gradient grows with the scale, since it acts over a smaller field.
    weight = np.array([a.scale for a in affines]) ** -4.0
    denominator = float(np.sum(weight * tilt * tilt))
    if denominator <= 0.0:
        return fallback
    return float(np.sum(weight * gradient * tilt) / denominator)


def initial_values(
    views: Sequence[GridView], nominal_px_per_m: Array, centre_px: Array, rho_prior: float
) -> InitialValues:
    """Estimate starting values from V views and their nominal scales (V,) in px per m."""
    affines = [view_affine(v.board_xy_m, v.image_xy, centre_px) for v in views]
    ratios = np.array([a.scale for a in affines]) / nominal_px_per_m
    factor = float(np.median(ratios))
    rotations = np.stack([rotation_from_affine(a.matrix, a.gradient) for a in affines])
    rho = _estimate_rho(affines, rotations, rho_prior)
    board = np.stack([a.board_xy_m for a in affines])
    translations = -np.einsum("vij,vj->vi", rotations[:, :, :2], board)
    # The grid point at the image centre lies on the axis: at the reference plane, unless its scale
    # determines its height.
    wide = _is_wide(rho, (2.0 * centre_px[0] + 1.0) / min(a.scale for a in affines))
    if wide:
        translations[:, 2] += (factor / ratios - 1.0) / rho
    return InitialValues(factor, rho, rotations, translations, wide)


def _is_wide(rho: float, field_m: float) -> bool:
    return bool(rho * field_m > WIDE_RATIO)


def pose_from_camera(view: GridView, camera: ScanCamera) -> tuple[Array, Array]:
    """Estimate two candidate poses of a view under a known camera.

    Returns
    -------
    rotations, translations_m
        (2, 3, 3) and (2, 3): the pose from the affine part of the undistorted view, and its
        mirrored tilt.

    Raises
    ------
    CalibrationError
        If the camera can undistort fewer than four corners of the view.
    """
    ideal = camera.undistort(view.image_xy)
    known = np.all(np.isfinite(ideal), axis=1)
    if known.sum() < 4:
        raise CalibrationError(
            f"{view.name}, in which the calibration can undistort only {counted(known.sum(), 'corner')}",
            expected="images of the microscope that was calibrated",
            do="check the magnification and --display-width",
        )
    principal = np.array([camera.px, camera.py])
    centre = np.array([0.5 * (camera.width - 1), 0.5 * (camera.height - 1)])
    affine = view_affine(view.board_xy_m[known], ideal[known], centre)
    metric = np.asarray(
        np.linalg.solve(camera.ideal_from_sem_jacobian, affine.matrix), dtype=np.float64
    )
    rotation = rotation_from_affine(metric, affine.gradient)
    both = np.stack([rotation, mirrored_tilt(rotation[None])[0]])
    offset = np.linalg.solve(camera.ideal_from_sem_jacobian, centre - principal)
    # The grid plane passes through the reference plane on the axis of the image centre, unless its
    # scale determines its height.
    depth = 1.0
    if _is_wide(camera.rho, camera.width / camera.m):
        depth = 1.0 / float(np.linalg.norm(metric, 2))
    translations = -both[:, :, :2] @ affine.board_xy_m
    translations[:, :2] += depth * offset
    if depth != 1.0:
        translations[:, 2] += (depth - 1.0) / camera.rho
    return both, translations


# Shared unknowns that change their sign when everything is mirrored in the reference plane.
_ODD = ("grid_curvature_m", "axis_z_m", "stage_wedge_x", "stage_wedge_y")


def adjust(problem: Problem, state: State, *, tolerance: float = 1e-9) -> BundleResult:
    """Refine, and turn views to their mirrored tilt as long as that fits better."""
    result = refine(problem, state, tolerance=tolerance)
    for _ in range(MIRROR_ROUNDS):
        turned, changed = resolve_mirrored_tilts(problem, result.state)
        if not changed:
            break
        result = refine(problem, turned, tolerance=tolerance)
    return result


def refine_coarsely(problem: Problem, state: State) -> BundleResult:
    """Adjust as exactly as what comes between needs."""
    return refine(problem, state, tolerance=COARSE_TOLERANCE)


def mirror(functions: Functions, problem: Problem, state: State) -> State:
    """Return the state mirrored in the reference plane: tilts, heights and the sign of rho.

    Every point stays where it is seen, so that views and poses alone do not tell the two states apart; priors do, and
    what a stage says: its axis is turned over, since a tilt of the other sign is one about the opposite axis. Exact
    where rho is a constant.
    """
    theta = state.theta.copy()
    theta[columns_of(functions)["rho"]] *= -1.0
    for k, name in enumerate(problem.shared, start=len(theta) - len(problem.shared)):
        if name in _ODD:
            theta[k] *= -1.0
        elif name == "stage_axis":
            theta[k] -= np.copysign(np.pi, theta[k])
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

    It is tried where the pivot has come to lie on the far side of the specimen, where no microscope has it, and where
    the axis of the stage has come to lie the other way round.
    """
    rho = with_coefficients(functions, result.state.theta)["rho"](setup.magnifications[0])
    axis = problem.shared_values(result.state.theta, ["stage_axis"])[0]
    if rho >= 0.0 and abs(axis) <= 0.5 * np.pi:
        return result
    other = refine(problem, mirror(functions, problem, result.state), tolerance=COARSE_TOLERANCE)
    return other if other.cost < result.cost else result


def resolve_mirrored_tilts(problem: Problem, state: State) -> tuple[State, int]:
    """Fit the poses from both signs of the tilt; return the better ones and how many changed."""
    middle = np.stack([problem.board_m[own].mean(axis=0) for own in problem.points_of_views])
    rotations = mirrored_tilt(state.rotations)
    # Turning about the middle of the visible points keeps the view in place.
    moved = np.einsum("vij,vj->vi", state.rotations - rotations, middle)
    mirrored = replace(state, rotations=rotations, translations_m=state.translations_m + moved)
    own = refine_poses(problem, state, max_iterations=POSE_STEPS)
    other = refine_poses(problem, mirrored, max_iterations=POSE_STEPS)
    better = view_squares(problem, other) < view_squares(problem, own) - DECREASE_MIN
    return pick_views(better, other, own), int(better.sum())


def restart_poses(setup: Setup, problem: Problem, state: State) -> tuple[State, int]:
    """Fit every pose anew from the affine part of its view under the camera of ``state``; return the better ones and
    how many changed.

    A pose that has got into an optimum of its own while the camera was still wrong comes out of it.
    """
    table = problem.cameras(state.theta)
    count = 0
    best = refine_poses(problem, state, max_iterations=POSE_STEPS)
    squares = view_squares(problem, best)
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
        other = refine_poses(problem, fresh, max_iterations=POSE_STEPS)
        other_squares = view_squares(problem, other)
        better = other_squares < squares - DECREASE_MIN
        best = pick_views(better, other, best)
        squares = np.where(better, other_squares, squares)
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


def thin_view(view: GridView) -> GridView:
    """Return the view with a random part of its corners, enough for a pose and a rough camera.

    Lines stay whole: a single place says where they are along their direction.
    """
    if len(view.board_xy_m) <= POSE_CORNERS or view.across is not None:
        return view
    keep = np.random.default_rng(0).permutation(len(view.board_xy_m))[:POSE_CORNERS]
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
    result, total = right_way_up(setup, functions, problem, refine_coarsely(problem, state)), 0
    for _ in range(MIRROR_ROUNDS):
        state, count = try_other_poses(setup, functions, spread, result.state)
        other = refine_coarsely(problem, state) if count else result
        if other.cost > result.cost - DECREASE_MIN:
            # Better for some of the corners, and not for all.
            break
        result, total = other, total + count
    return result, total
