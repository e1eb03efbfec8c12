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

"""Calibration of each magnification on its own: Algorithms 1 and 2 of the paper (method "discrete").

Per magnification: scale and poses with zero distortion, the distortion centre by Algorithm 1, then
bundle adjustment of everything from zero distortion. Where there is no distortion, its centre is
put on the image centre and only the tangential term is estimated. Directions that one magnification
cannot determine (principal point and pivot distance at high magnification) are held by the priors.

The centre is the common left epipole of the radial fundamental matrices between a plane and its
images (Hartley and Kang 2007, doi:10.1109/TPAMI.2007.1147). Without distortion the matrices are
arbitrary. The paper detects that by an error below 1e-3 px, which no real corner reaches; here an
F-test asks whether the plane's homography leaves anything but noise, and the fixed threshold stays
as an option.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtrc

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.calibration.estimator.blocks import Problem, State
from semcal_ros.core.calibration.estimator.bundle_adjustment import BundleResult, variance_factor
from semcal_ros.core.calibration.estimator.poses import (
    adjust,
    initial_values,
    resolve_mirrored_tilts,
)
from semcal_ros.core.calibration.estimator.problem import (
    Setup,
    build_problem,
    constant_functions,
)
from semcal_ros.core.calibration.estimator.thresholds import HELD_SIGMA
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import FUNCTION_NAMES, stack_coefficients
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.plane_geometry import (
    fit_homography,
    normalising_similarity,
    transform_points,
)

# Derived: the cubic has 10 terms per coordinate, and two more corners show its residuals.
_FEWEST_CORNERS = 12


# Defined: the false-alarm rate of the F-test. Seven magnifications without distortion are all recognised in 99 % of
# cases.
_SIGNIFICANCE = 1e-3


@dataclass(frozen=True)
class DistortionCentre:
    """Result of Algorithm 1.

    Attributes
    ----------
    degenerate
        True when homographies alone explain the views: no distortion, and no centre.
    centre_px
        (2,) centre of the distortion; the image points' mean when degenerate.
    homography_rms_px
        RMS residual of the homographies.
    noise_rms_px
        RMS residual beside a smooth part (cubic in the image): the noise of the corners.
    p_value
        Probability of residuals as smooth as these without distortion.
    """

    degenerate: bool
    centre_px: Array
    homography_rms_px: float
    noise_rms_px: float
    p_value: float


def _radial_fundamental(board: Array, image: Array, from_image: Array) -> Array:
    """Return the (3, 3) F with image' F board = 0 in normalised coordinates; unit norm, rank 2.

    Normalised 8-point algorithm. ``from_image`` normalises the image of all views alike, so that
    their matrices share the left epipole.
    """
    b = np.column_stack(
        [transform_points(normalising_similarity(board), board), np.ones(len(board))]
    )
    x = np.column_stack([transform_points(from_image, image), np.ones(len(image))])
    rows = (x[:, :, None] * b[:, None, :]).reshape(len(b), 9)
    _, vectors = np.linalg.eigh(rows.T @ rows)
    u, s, vt = np.linalg.svd(vectors[:, 0].reshape(3, 3))
    return u @ np.diag([s[0], s[1], 0.0]) @ vt


def _cubic_basis(image: Array) -> Array:
    x, y = ((image - image.mean(axis=0)) / (np.ptp(image) / 2.0)).T
    return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)


def _smooth_part(view: GridView) -> tuple[Array, Array, int]:
    """Return homography residuals, these without their cubic part, and the number of its terms."""
    h = fit_homography(view.board_xy_m, view.image_xy)
    residual = view.image_xy - transform_points(h, view.board_xy_m)
    basis = _cubic_basis(view.image_xy)
    smooth = basis @ np.linalg.lstsq(basis, residual, rcond=None)[0]
    return residual, residual - smooth, 2 * basis.shape[1]


def find_distortion_centre(
    views: Sequence[GridView], *, tau_px: float | None = None
) -> DistortionCentre:
    """Run Algorithm 1 on the views of one magnification.

    Parameters
    ----------
    views
        Views; those with fewer than 12 corners are ignored, since the cubic needs 10.
    tau_px
        With a value, the paper's threshold on the RMS homography error decides instead of the
        F-test.
    """
    usable = [v for v in views if len(v.board_xy_m) >= _FEWEST_CORNERS]
    mean = np.mean([v.image_xy.mean(axis=0) for v in views], axis=0)
    if not usable:
        return DistortionCentre(True, mean, float("nan"), float("nan"), 1.0)
    residual_sum = noise_sum = 0.0
    corners = smooth_freedom = 0
    for view in usable:
        residual, noise, coefficients = _smooth_part(view)
        residual_sum += float(np.sum(residual**2))
        noise_sum += float(np.sum(noise**2))
        corners += len(residual)
        # 8 of the coefficients describe what the homography has already fitted.
        smooth_freedom += coefficients - 8
    noise_freedom = max(2 * corners - 8 * len(usable) - smooth_freedom, 1)
    ratio = ((residual_sum - noise_sum) / smooth_freedom) / max(noise_sum / noise_freedom, 1e-300)
    p_value = float(fdtrc(smooth_freedom, noise_freedom, max(ratio, 0.0)))
    rms = float(np.sqrt(residual_sum / corners))
    degenerate = rms <= tau_px if tau_px is not None else p_value > _SIGNIFICANCE
    centre = mean
    if not degenerate:
        from_image = normalising_similarity(np.concatenate([v.image_xy for v in usable]))
        stack = np.hstack(
            [_radial_fundamental(v.board_xy_m, v.image_xy, from_image) for v in usable]
        )
        epipole = np.linalg.solve(from_image, np.linalg.svd(stack)[0][:, -1])
        centre = epipole[:2] / epipole[2]
    return DistortionCentre(
        degenerate, centre, rms, float(np.sqrt(2.0 * noise_sum / noise_freedom)), p_value
    )


@dataclass(frozen=True)
class DiscreteFit:
    """Separate calibrations of M magnifications.

    Attributes
    ----------
    magnifications
        (M,) ascending.
    parameters
        (M, 10) in the order of ``FUNCTION_NAMES``.
    covariances
        (M, 10, 10).
    centres
        Result of Algorithm 1 at each magnification.
    results
        The adjustments.
    """

    magnifications: Array
    parameters: Array
    covariances: Array
    centres: tuple[DistortionCentre, ...]
    results: tuple[BundleResult, ...]

    def select(self, keep: Mask) -> DiscreteFit:
        """Return the calibrations of those magnifications where ``keep``, (M,), is true."""
        return DiscreteFit(
            self.magnifications[keep],
            self.parameters[keep],
            self.covariances[keep],
            tuple(c for c, kept in zip(self.centres, keep, strict=True) if kept),
            tuple(r for r, kept in zip(self.results, keep, strict=True) if kept),
        )


def _hold(problem: Problem, values: Mapping[str, float]) -> Problem:
    mean, sigma = problem.prior_mean.copy(), problem.prior_sigma.copy()
    for name, value in values.items():
        mean[FUNCTION_NAMES.index(name)] = value
        sigma[FUNCTION_NAMES.index(name)] = HELD_SIGMA
    return replace(problem, prior_mean=mean, prior_sigma=sigma)


def _with(state: State, values: Mapping[str, float]) -> State:
    theta = state.theta.copy()
    for name, value in values.items():
        theta[FUNCTION_NAMES.index(name)] = value
    return replace(state, theta=theta)


def _fit_one(setup: Setup, tau_px: float | None) -> tuple[DistortionCentre, Problem, BundleResult]:
    """Run steps 2 to 9 of Algorithm 2 for a setup with a single magnification."""
    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in setup.views]))
    start = initial_values(setup.views, nominal, setup.centre_px, setup.priors.rho_mean)
    functions = constant_functions(setup, {"scale": start.scale_factor})
    problem = build_problem(setup, functions, setup.views, setup.priors.height_sigma_m)
    state = State(stack_coefficients(functions), start.rotations, start.translations_m)
    # Aspect and skew are freed only with the distortion, which they would imitate without it.
    held = _hold(problem, {"xi_r": 0.0, "xi_t": 0.0, "aspect": 1.0, "skew": 0.0})
    pinhole = adjust(held, resolve_mirrored_tilts(held, state)[0])

    centre = find_distortion_centre(setup.views, tau_px=tau_px)
    if centre.degenerate:
        middle = {"xi_r": 0.0, "ex": float(setup.centre_px[0]), "ey": float(setup.centre_px[1])}
        problem = _hold(problem, middle)
        return centre, problem, adjust(problem, _with(pinhole.state, middle))
    # A centre outside the image is noise; the adjustment then starts from the middle.
    inside = np.all((centre.centre_px > 0) & (centre.centre_px < np.array(setup.image_size)))
    ex, ey = centre.centre_px if inside else setup.centre_px
    return (
        centre,
        problem,
        adjust(problem, _with(pinhole.state, {"ex": float(ex), "ey": float(ey)})),
    )


def fit_discrete(setup: Setup, *, tau_px: float | None = None) -> DiscreteFit:
    """Calibrate every magnification of ``setup`` separately.

    ``tau_px`` selects the paper's fixed threshold of Algorithm 1 instead of the statistical test.
    """
    centres, results, parameters, covariances = [], [], [], []
    for g in setup.magnifications:
        own = replace(
            setup,
            views=tuple(v for v in setup.views if v.magnification == g),
            magnifications=np.array([g]),
            breakpoints=(),
        )
        centre, problem, result = _fit_one(own, tau_px)
        centres.append(centre)
        results.append(result)
        parameters.append(result.state.theta)
        covariances.append(result.covariance * variance_factor(problem, result))
    return DiscreteFit(
        setup.magnifications,
        np.stack(parameters),
        np.stack(covariances),
        tuple(centres),
        tuple(results),
    )


def table_functions(
    magnifications: Array, parameters: Array, covariances: Array
) -> tuple[dict[str, ContinuousFunction], Array]:
    """Interpolate linearly in log g between separate calibrations; covariance of all nodes.

    The discrete calibrations of the literature offer this between their magnifications.
    """
    g_range = (float(magnifications[0]), float(magnifications[-1]))
    functions = {
        name: ContinuousFunction("linear_log", parameters[:, i].copy(), g_range, magnifications)
        for i, name in enumerate(FUNCTION_NAMES)
    }
    return functions, _block_covariance(covariances)


def _block_covariance(covariances: Sequence[Array] | Array) -> Array:
    """Return the (10 M, 10 M) covariance, parameter-major, of M independent nodes."""
    stacked = np.asarray(covariances)
    count, size = stacked.shape[0], stacked.shape[1]
    full = np.zeros((size, count, size, count))
    for i in range(count):
        full[:, i, :, i] = stacked[i]
    return full.reshape(size * count, size * count)
