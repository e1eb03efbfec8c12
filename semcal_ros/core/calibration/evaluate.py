"""Errors of views of a grid under known cameras: poses are fitted, cameras are not.

This is the only figure by which calibrations are compared (design section 6.6): single parameters
trade off against each other and against the poses.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, Indices
from semcal_ros.core.calibration.bundle_adjustment import BundleResult, refine
from semcal_ros.core.calibration.initial_values import pose_from_camera
from semcal_ros.core.calibration.normal_equations import State, make_problem
from semcal_ros.core.calibration.views import GridView, add_excess_noise, estimate_excess_sigma_px
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import CalibrationError

__all__ = ["ViewPose", "fit_poses", "rms_by_magnification"]


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
    if not views:
        raise CalibrationError("no views", expected="at least one view of a grid")
    magnifications = np.unique([v.magnification for v in views])
    cameras = [camera_at(float(g)) for g in magnifications]
    of_view = [cameras[int(np.searchsorted(magnifications, v.magnification))] for v in views]
    corrected = [
        replace(v, image_xy=c.without_residual(v.image_xy))
        for v, c in zip(views, of_view, strict=True)
    ]
    problem = make_problem(
        corrected,
        magnifications,
        np.stack([c.parameters for c in cameras])[:, :, None],
        norm_px=cameras[0].norm_px,
        nominal_px_per_m=np.array([c.m for c in cameras]),
        prior_mean=np.ones(1),
        prior_sigma=np.ones(1),
        height_sigma_m=height_sigma_m,
    )
    if starts is None:
        both = [pose_from_camera(v, c) for v, c in zip(views, of_view, strict=True)]
        rotations = np.stack([r for r, _ in both], axis=1)
        translations = np.stack([t for _, t in both], axis=1)
    else:
        rotations, translations = starts[0][None], starts[1][None]
    fits = [
        refine(problem, State(np.ones(1), r, t), fixed_theta=True)
        for r, t in zip(rotations, translations, strict=True)
    ]
    usable = [f for f in fits if np.isfinite(f.cost)]
    if not usable:
        raise CalibrationError(
            "views that the calibration cannot project",
            expected="images of the microscope that was calibrated",
            do="check the magnification and the display width",
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
