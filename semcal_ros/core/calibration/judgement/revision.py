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

"""Adjustment of a known calibration to new views of the grid.

The camera of the views is that of the calibration, uncertain by its covariance, plus changes that all
magnifications share. Poses, visits, drift, the shape of the grid and the stage are adjusted as in a calibration
(:mod:`~semcal_ros.core.calibration.pipeline`).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, solve_scaled
from semcal_ros.core.calibration.estimator.blocks import Problem, State
from semcal_ros.core.calibration.estimator.bundle_adjustment import (
    BundleResult,
    refine,
    residual_variance,
)
from semcal_ros.core.calibration.estimator.correlated_errors import (
    estimate_jitter,
    estimate_shared_excess_px,
    jitter_covariance,
)
from semcal_ros.core.calibration.estimator.poses import adjust
from semcal_ros.core.calibration.estimator.problem import (
    Priors,
    Setup,
    Spread,
    VarianceComponents,
    build_problem,
    initial_components,
    with_shared,
)
from semcal_ros.core.calibration.estimator.thresholds import DECREASE_MIN, HELD_SIGMA
from semcal_ros.core.calibration.estimator.variance_components import update_components
from semcal_ros.core.calibration.judgement.evaluate import fit_poses
from semcal_ros.core.calibration.judgement.thresholds import DRIFT_UPDATES, FREE_CHANGE
from semcal_ros.core.calibration.stage import StageAxis
from semcal_ros.core.calibration.start import (
    add_shared_unknowns,
    align_lattices,
    mark_untilted,
    tempered,
    with_excess,
)
from semcal_ros.core.calibration.views import (
    GridView,
    estimate_excess_sigma_px,
    median_sigma_px,
    refuse_tilted_lines,
)
from semcal_ros.core.calibration.window_bias import flatten_view
from semcal_ros.core.camera.calibration_model import (
    ALL_FUNCTIONS,
    CalibrationModel,
    design_matrix,
)
from semcal_ros.core.camera.distortion import LATE_TERMS
from semcal_ros.core.camera.projection import ALL_NAMES
from semcal_ros.core.camera.records import FitRecord
from semcal_ros.core.camera.scan_distortion import SCAN_NAMES, SETTLING
from semcal_ros.core.errors import CalibrationError

_CHANGING = ("scale", "aspect", "skew", "xi_r", "xi_t", "xi_u", "ex", "ey")
_GAINS = ("xi_r", "xi_t", "xi_u")
WATCHED = ("xi_s", *LATE_TERMS, "coil_x2", "coil_x3", "coil_y2", "coil_y3", *SCAN_NAMES[SETTLING])
"""Parameters of which a few views may show a change, whether the calibration has a function for them or not."""


def changing(model: CalibrationModel) -> tuple[str, ...]:
    """Return the parameters that may have changed since the calibration, by the same amount at all magnifications.

    That of the scale is relative. A calibration from a specimen, or from an old file, has no ``xi_u``.
    """
    return tuple(name for name in _CHANGING if name in model.functions)


def gaining(model: CalibrationModel) -> tuple[str, ...]:
    """Return those of which a part may have changed in proportion to them, as the distortion of a lens that got
    stronger does.
    """
    return tuple(name for name in _GAINS if name in model.functions)


@dataclass(frozen=True)
class Revision:
    """A calibration that was adjusted to new views.

    Attributes
    ----------
    model
        The calibration before.
    setup
        The new views, with the residual field of the calibration taken out.
    names
        The parameters that may have changed by the same amount at all magnifications.
    problem, result
        The adjustment. Its unknowns are a 1, the principal components of the calibration's covariance in sigmas,
        the height of the grid and the size of its squares, the changes of ``names``, the relative changes of
        :func:`gaining`, and what all views share.
    covariance
        (K, K) of the unknowns, with what the jitter of lines adds.
    misfit
        RMS of the residuals over what the uncertainty of the corners explains.
    """

    model: CalibrationModel
    setup: Setup
    names: tuple[str, ...]
    problem: Problem
    result: BundleResult
    covariance: Array
    misfit: float

    @property
    def components(self) -> slice:
        """Where the components of the calibration's covariance are among the unknowns."""
        return slice(1, 1 + len(self.model.coefficients))

    @property
    def proposed(self) -> Array:
        """(K,) the unknowns after one more Gauss-Newton step, in which nothing is held."""
        step = solve_scaled(*self.result.equations(self.problem))
        return np.asarray(self.result.state.theta + step)

    @property
    def changes(self) -> slice:
        """Where the changes of ``names`` are among the unknowns."""
        return slice(self.gains.start - len(self.names), self.gains.start)

    @property
    def gains(self) -> slice:
        """Where the relative changes of :func:`gaining` are among the unknowns."""
        count = len(gaining(self.model))
        first = len(self.result.state.theta) - len(self.problem.shared) - count
        return slice(first, first + count)


def free_sigmas(model: CalibrationModel, setup: Setup) -> dict[str, float]:
    """Prior 1-sigma of changes of any size, of :func:`changing` and of what is :data:`WATCHED`."""
    free = {name: setup.prior_of(name)[1] for name in (*changing(model), *WATCHED)}
    return free | {"scale": FREE_CHANGE}


def make_setup(
    model: CalibrationModel,
    views: Sequence[GridView],
    image_size: tuple[int, int],
    untilted: str | Sequence[str],
    axis: StageAxis,
) -> Setup:
    """Arrange views in the calibrated range as for a calibration, with the field of the old one taken out.

    Parameters
    ----------
    model
        The calibration.
    views
        New views; those outside the calibrated range are left out.
    image_size
        (width, height) of the images.
    untilted, axis
        As in :class:`~semcal_ros.core.calibration.options.CalibrationOptions`.

    Raises
    ------
    CalibrationError
        If no view lies in the calibrated range, or one of a grating is tilted.
    InvalidValueError
        If an untilted view is named that is not there.
    """
    refuse_tilted_lines(views)
    low, high = model.magnification_range
    inside = [v for v in views if low * (1 - 1e-9) <= v.magnification <= high * (1 + 1e-9)]
    if not inside:
        seen = sorted({v.magnification for v in views})
        raise CalibrationError(
            f"views at {', '.join(f'{g:g}' for g in seen[:6])}x, outside the calibrated {low:g}x to {high:g}x"
            if views
            else "no views of the grid",
            expected="at least one view of the grid in the calibrated range",
            do="record the grid at a calibrated magnification",
        )
    ordered = sorted(inside, key=lambda v: v.magnification)
    cameras = {v.magnification: model.at(v.magnification).resized(*image_size) for v in ordered}
    flat = tuple(flatten_view(v, cameras[v.magnification]) for v in ordered)
    priors = Priors()
    if model.record is not None and model.record.is_wide:
        priors = priors.of_photographs(cameras[flat[0].magnification].rho)
    magnifications = np.unique([v.magnification for v in flat])
    setup = Setup(flat, magnifications, image_size, model.display_width_m, priors, axis=axis)
    setup = replace(setup, raster_ratio=model.image_height / model.image_width)
    return add_shared_unknowns(align_lattices(mark_untilted(setup, untilted)))


def _spread(model: CalibrationModel, setup: Setup) -> VarianceComponents:
    """The spread of visits and heights that the calibration found, which a few views cannot tell."""
    start = initial_components(setup)
    heights = record_of(model, setup.priors)
    return replace(
        start,
        # A spread of zero would be one that no view can contradict.
        scale=Spread(max(model.scale_sigma.repeatability, 1e-6), 0.0),
        visit_height=Spread(heights.visit_height_sigma_m or start.visit_height.sigma, 0.0),
        height_sigma_m=np.full(len(setup.views), heights.height_sigma_m),
    )


def record_of(model: CalibrationModel, priors: Priors) -> FitRecord:
    """Return the record of the fit, or what is usual where an old file does not have it."""
    usual = FitRecord(priors.height_sigma_m, priors.visit_height_sigma_m)
    return usual if model.record is None else model.record


def _camera_designs(model: CalibrationModel, setup: Setup) -> tuple[Array, Array]:
    """Designs (M, P, 1 + P + 2) of the camera as calibrated, and the prior 1-sigma of its unknowns.

    The first unknown is 1; the next are the principal components of the calibration's covariance, in sigmas;
    the last are the height of the grid and the size of its squares.
    """
    theta, root = model.coefficients, model.principal_components
    size = len(theta)
    own = _designs_of_size(model, setup.magnifications, setup.image_size)
    cameras = own[:, :, :size] @ theta + own[:, :, size]
    common = np.zeros((*cameras.shape, 2))
    common[:, 0, 0] = cameras[:, 0] * cameras[:, 5]
    common[:, 0, 1] = cameras[:, 0]
    designs = np.concatenate([cameras[:, :, None], own[:, :, :size] @ root, common], axis=2)
    scale = model.scale_sigma
    sigma = np.concatenate(
        [
            [HELD_SIGMA],
            np.ones(size),
            [max(scale.height_m, HELD_SIGMA), max(scale.grid, HELD_SIGMA)],
        ]
    )
    return designs, sigma


def _designs_of_size(
    model: CalibrationModel, magnifications: Array, size: tuple[int, int]
) -> Array:
    """(M, P, K + 1) from the coefficients of a calibration, and 1, to the cameras of images of some size."""
    s = size[0] / model.image_width
    shift_y = 0.5 * (size[1] - s * model.image_height)
    out = []
    for g in magnifications:
        design = design_matrix(model.functions, float(g), model.nominal_px_per_m(float(g)))
        constant = np.zeros(len(design))
        for name in ("px", "py", "ex", "ey"):
            row = ALL_NAMES.index(name)
            design[row] *= s
            constant[row] = 0.5 * s - 0.5 + (shift_y if name.endswith("y") else 0.0)
        design[0] *= s
        out.append(np.column_stack([design, constant]))
    return np.stack(out)


def revise(
    model: CalibrationModel,
    setup: Setup,
    sigmas: Mapping[str, float],
    gains: Mapping[str, float] | None = None,
    held: Collection[str] = (),
) -> Revision:
    """Adjust a calibration, and all that :func:`make_setup` leaves open, to views.

    Parameters
    ----------
    model
        The calibration.
    setup
        The views, from :func:`make_setup`.
    sigmas
        Prior 1-sigma of each change, by its parameter: of those of :func:`changing`, or of :data:`WATCHED` as well.
    gains
        That of the relative changes of :func:`gaining`; None: they change by the same amount everywhere.
    held
        Parameters of ``sigmas`` that are adjusted as if they had not changed. The covariance is that of all, and
        :attr:`Revision.proposed` tells what they would be.

    Raises
    ------
    CalibrationError
        If the calibration cannot project the views at all.
    """
    poses = fit_poses(
        setup.views,
        lambda g: replace(model.at(g).resized(*setup.image_size), residual=None),
        height_sigma_m=_spread(model, setup).height_sigma_m,
    )
    spread = _spread(model, setup)
    relative = {name: (gains or {}).get(name, 0.0) for name in gaining(model)}
    fitted = {name: sigma for name, sigma in sigmas.items() if name not in held}
    problem = _build(model, setup, spread, fitted, relative)
    unknowns = problem.designs.shape[2] - len(setup.shared)
    theta = np.concatenate([[1.0], np.zeros(unknowns - 1), setup.shared_start()])
    state = State(theta, poses.rotations, poses.translations_m)
    pairs = zip(setup.views, poses.residuals_px, strict=True)
    start_px = max(estimate_excess_sigma_px([view], left_px, 6) for view, left_px in pairs)
    result = adjust(problem, state)
    if start_px > 0.0:
        # As at the start of a calibration: believed to its own noise, what has changed may lead the poses astray.
        noisy = _build(model, tempered(setup, start_px), spread, fitted, relative)
        other = adjust(problem, adjust(noisy, state).state)
        if other.cost < result.cost - DECREASE_MIN:
            result = other
    own_px = median_sigma_px(setup.views)
    shared_px = estimate_shared_excess_px(setup, problem, result)
    if shared_px > 0.0:
        setup = with_excess(setup, shared_px)
        problem = _build(model, setup, spread, fitted, relative)
        result = refine(problem, result.state)
    for _ in range(DRIFT_UPDATES if problem.effects is not None else 0):
        own = update_components(setup, problem, result)
        spread = replace(spread, drift_sigma_px=own.drift_sigma_px, lattice_sigma=own.lattice_sigma)
        problem = _build(model, setup, spread, fitted, relative)
        result = refine(problem, result.state)
    misfit = float(np.sqrt(residual_variance(problem, result)) * np.hypot(1.0, shared_px / own_px))
    lines = estimate_jitter(problem, result)
    views = setup.views
    if lines.sigma_px > 0.0 and problem.across is None:
        # All of it is along x, where settling and coils show, and the half of it at most in the mean over both axes.
        views = tuple(view.add_line_noise(lines.sigma_px) for view in views)
    freedom = problem.layout.of_view.size * len(views) + len(theta)
    excess = estimate_excess_sigma_px(views, result.residuals_px, freedom)
    if excess > 0.0 or views is not setup.views:
        setup = with_excess(replace(setup, views=views), excess)
        problem = _build(model, setup, spread, fitted, relative)
        result = refine(problem, result.state)
    if held:
        # After the 1, the components, the height and the squares.
        theta, first = result.state.theta, len(model.coefficients) + 3
        changes = dict.fromkeys(sigmas, 0.0)
        changes |= dict(zip(fitted, theta[first : first + len(fitted)], strict=True))
        parts = theta[:first], [*changes.values()], theta[first + len(fitted) :]
        theta = np.concatenate(parts)
        problem = _build(model, setup, spread, sigmas, relative)
        result = refine(problem, replace(result.state, theta=theta), max_iterations=0)
    covariance = result.covariance + jitter_covariance(problem, result, lines)
    return Revision(model, setup, tuple(sigmas), problem, result, covariance, misfit)


def _build(
    model: CalibrationModel,
    setup: Setup,
    spread: VarianceComponents,
    sigmas: Mapping[str, float],
    gains: Mapping[str, float],
) -> Problem:
    """Make the adjustment: the camera as calibrated, then the changes by an amount and the relative ones, whose prior
    1-sigma are given by their parameters, then what all views share.
    """
    problem = build_problem(setup, model.functions, setup.views, spread)
    designs, sigma = _camera_designs(model, setup)
    rows = [ALL_FUNCTIONS.index(name) for name in (*sigmas, *gains)]
    if max(rows) >= designs.shape[1]:
        missing = len(ALL_NAMES) - designs.shape[1]
        designs = np.pad(designs, ((0, 0), (0, missing), (0, 0)))
    changes = np.zeros((*designs.shape[:2], len(rows)))
    for column, row in enumerate(rows):
        is_relative = row == 0 or column >= len(sigmas)
        changes[:, row, column] = designs[:, row, 0] if is_relative else 1.0
    free = np.maximum([*sigmas.values(), *gains.values()], HELD_SIGMA)
    cameras = np.concatenate([designs, changes], axis=2)
    mean = np.append(1.0, np.zeros(cameras.shape[2] - 1))
    shared = len(problem.shared)
    own_mean, own_sigma = setup.shared_priors() if shared else (np.zeros(0), np.zeros(0))
    return replace(
        problem,
        parameters=ALL_NAMES[: designs.shape[1]],
        designs=with_shared(cameras, shared),
        prior_mean=np.concatenate([mean, own_mean]),
        prior_sigma=np.concatenate([sigma, free, own_sigma]),
    )
