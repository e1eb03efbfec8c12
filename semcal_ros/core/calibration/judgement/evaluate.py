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

"""Errors of views of a grid under known cameras: poses are fitted, cameras are not.

This is the only figure by which calibrations are compared: single parameters
trade off against each other and against the poses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import MEDIAN_CHI2, Array, Indices
from semcal_ros.core.calibration.estimator.blocks import MISS_NAMES, Problem, State, make_problem
from semcal_ros.core.calibration.estimator.bundle_adjustment import BundleResult, refine
from semcal_ros.core.calibration.estimator.poses import pose_from_camera
from semcal_ros.core.calibration.estimator.problem import Priors
from semcal_ros.core.calibration.estimator.thresholds import HELD_SIGMA
from semcal_ros.core.calibration.judgement.thresholds import FREE_CHANGE, POSE_STEPS_MAX
from semcal_ros.core.calibration.stage import StageAxis, attitudes
from semcal_ros.core.calibration.views import GridView, add_excess_noise, estimate_excess_sigma_px
from semcal_ros.core.calibration.window_bias import flatten_view
from semcal_ros.core.camera.projection import ALL_NAMES
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import CalibrationError


@dataclass(frozen=True)
class ViewPose:
    """Views with fitted poses.

    Attributes
    ----------
    rotations, translations_m
        (V, 3, 3) and (V, 3): sem frame from grid.
    residuals_px
        One (n, 2) array per view: observed minus projected pixels, both without the residual field.
    magnifications
        (V,) magnification of each view.
    converged
        Whether the fit of the poses converged.
    """

    rotations: Array
    translations_m: Array
    residuals_px: tuple[Array, ...]
    magnifications: Array
    converged: bool

    def rms_px(self) -> float:
        """Return the RMS distance over all corners, px."""
        square = np.concatenate([np.sum(r * r, axis=1) for r in self.residuals_px])
        return float(np.sqrt(np.mean(square)))


@dataclass(frozen=True)
class ScaleError:
    """How nm per pixel of a calibration and of images of the grid disagree.

    Attributes
    ----------
    relative
        The calibration's nm per pixel over that of the images, minus 1.
    sigma
        1-sigma of it: of the images (corners, heights) and of the calibration, together.
    """

    relative: float
    sigma: float


def _without_fields(
    views: Sequence[GridView], camera_at: Callable[[float], ScanCamera]
) -> tuple[Array, list[ScanCamera], list[GridView]]:
    """Return the magnifications, their cameras, and the views without the residual field and the bias of windows."""
    if not views:
        raise CalibrationError("no views", expected="at least one view of a grid")
    magnifications = np.unique([v.magnification for v in views])
    cameras = [camera_at(float(g)) for g in magnifications]
    group = np.searchsorted(magnifications, [v.magnification for v in views])
    corrected = [flatten_view(v, cameras[k]) for v, k in zip(views, group, strict=True)]
    return magnifications, cameras, corrected


def compare_scales(
    views: Sequence[GridView],
    camera_at: Callable[[float], ScanCamera],
    poses: ViewPose,
    *,
    height_sigma_m: float,
    visit_height_sigma_m: float = 0.0,
) -> dict[float, ScaleError]:
    """Compare the scale of images of a grid with that of a calibration, at each magnification.

    With free heights, a wrong scale hides in them. Here they have a prior.

    Parameters
    ----------
    views, camera_at
        As for :func:`fit_poses`; the cameras have a covariance.
    poses
        Result of :func:`fit_poses`.
    height_sigma_m
        Prior 1-sigma of the height of each view about the reference plane.
    visit_height_sigma_m
        1-sigma of the height that all views at one magnification share.

    Raises
    ------
    CalibrationError
        If there are no views.
    """
    magnifications, cameras, corrected = _without_fields(views, camera_at)
    count = len(magnifications)
    known = np.stack([c.all_parameters for c in cameras])
    size, shared = known.shape[1], len(MISS_NAMES)
    designs = np.zeros((count, size + shared, 1 + count + shared))
    designs[:, :size, 0] = known
    designs[np.arange(count), 0, 1 + np.arange(count)] = [c.m for c in cameras]
    # A tilt axis that misses the specimen makes heights of tilts, which are alike in all views.
    designs[:, size:, 1 + count :] = np.eye(shared)
    problem = make_problem(
        corrected,
        magnifications,
        designs,
        parameters=ALL_NAMES,
        raster=cameras[0].raster,
        nominal_px_per_m=np.array([c.m for c in cameras]),
        prior_mean=np.append(1.0, np.zeros(count + shared)),
        prior_sigma=np.concatenate(
            [
                [HELD_SIGMA],
                np.full(count, FREE_CHANGE),
                np.full(shared, Priors().axis_miss_sigma_m),
            ]
        ),
        height_sigma_m=height_sigma_m,
    )
    problem = _hold_lines_flat(replace(problem, shared=MISS_NAMES))
    theta = np.append(1.0, np.zeros(count + shared))
    result = refine(problem, State(theta, poses.rotations, poses.translations_m))
    own = np.concatenate([v.sigma_px for v in views])
    # Corners that scatter more than they say make the scale as much less certain.
    median = float(np.median(np.sum(result.residuals_px**2, axis=1) / own**2))
    excess = max(median / MEDIAN_CHI2[problem.dimensions], 1.0)
    out = {}
    for k, (g, camera) in enumerate(zip(magnifications, cameras, strict=True)):
        sigma = np.sqrt(result.covariance[1 + k, 1 + k] * excess)
        ours = camera.pixel_size_sigma_m[0] / camera.pixel_size_m[0]
        parts = (sigma, camera.rho * visit_height_sigma_m, ours)
        out[float(g)] = ScaleError(float(result.state.theta[1 + k]), float(np.linalg.norm(parts)))
    return out


def _hold_lines_flat(problem: Problem) -> Problem:
    """Return the problem with views of a grating untilted: what a tilt does to lines, another scale does as well."""
    if problem.across is None:
        return problem
    count = len(problem.group)
    flat = attitudes([None] * count, [True] * count, StageAxis(), Priors().untilted_sigma_rad)
    return replace(problem, attitudes=flat)


def fit_poses(
    views: Sequence[GridView],
    camera_at: Callable[[float], ScanCamera],
    *,
    height_sigma_m: Array | float = 1e-4,
    starts: tuple[Array, Array] | None = None,
) -> ViewPose:
    """Fit the pose of every view with the camera of its magnification held fixed.

    ``height_sigma_m`` is the prior 1-sigma of the heights, one number or (V,). ``starts`` are
    rotations (V, 3, 3) and translations (V, 3) near the solution; without starts both signs of the
    tilt are tried.

    Raises
    ------
    CalibrationError
        If there are no views, or a view's corners cannot be projected by the camera at all.
    """
    magnifications, cameras, corrected = _without_fields(views, camera_at)
    problem = make_problem(
        corrected,
        magnifications,
        np.stack([c.all_parameters for c in cameras])[:, :, None],
        parameters=ALL_NAMES,
        raster=cameras[0].raster,
        nominal_px_per_m=np.array([c.m for c in cameras]),
        prior_mean=np.ones(1),
        prior_sigma=np.ones(1),
        height_sigma_m=height_sigma_m,
    )
    problem = _hold_lines_flat(problem)
    if starts is None:
        of_view = [cameras[k] for k in problem.group]
        both = [pose_from_camera(v, c) for v, c in zip(views, of_view, strict=True)]
        rotations = np.stack([r for r, _ in both], axis=1)
        translations = np.stack([t for _, t in both], axis=1)
    else:
        rotations, translations = starts[0][None], starts[1][None]
    fits = [
        refine(problem, State(np.ones(1), r, t), fixed_theta=True, max_iterations=POSE_STEPS_MAX)
        for r, t in zip(rotations, translations, strict=True)
    ]
    usable = [f for f in fits if np.isfinite(f.cost)]
    if not usable:
        raise CalibrationError(
            "views that the calibration cannot project",
            expected="images of the microscope that was calibrated",
            do="check the magnification and --display-width",
        )
    g_of_view = magnifications[problem.group]
    best = _select_best(usable, problem.starts, g_of_view)
    excess = estimate_excess_sigma_px(views, np.concatenate(best.residuals_px), 6 * len(views))
    if excess == 0.0:
        return best
    whitening = np.concatenate([v.whitening for v in add_excess_noise(views, excess)])
    state = State(np.ones(1), best.rotations, best.translations_m)
    again = refine(replace(problem, whitening=whitening), state, fixed_theta=True)
    return _select_best([again], problem.starts, g_of_view)


def _select_best(fits: Sequence[BundleResult], starts: Indices, magnifications: Array) -> ViewPose:
    costs = np.stack(
        [
            np.add.reduceat(
                np.sum(f.residuals_px**2 * f.huber_weight[:, None], axis=1), starts[:-1]
            )
            for f in fits
        ]
    )
    best = np.argmin(costs, axis=0)
    return ViewPose(
        rotations=np.stack([fits[k].state.rotations[v] for v, k in enumerate(best)]),
        translations_m=np.stack([fits[k].state.translations_m[v] for v, k in enumerate(best)]),
        residuals_px=tuple(
            fits[k].residuals_px[starts[v] : starts[v + 1]] for v, k in enumerate(best)
        ),
        magnifications=magnifications,
        converged=all(f.converged for f in fits),
    )


def rms_by_magnification(fit: ViewPose) -> dict[float, float]:
    """Return the RMS distance of the corners in px for each magnification, ascending."""
    out: dict[float, float] = {}
    for g in np.unique(fit.magnifications):
        square = np.concatenate(
            [
                np.sum(r * r, axis=1)
                for r, own in zip(fit.residuals_px, fit.magnifications, strict=True)
                if own == g
            ]
        )
        out[float(g)] = float(np.sqrt(np.mean(square)))
    return out
