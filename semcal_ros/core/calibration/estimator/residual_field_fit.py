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

"""Estimation of the residual field together with the coefficients of the camera.

The field is linear in its coefficients, so one reduced system over all magnifications holds both:
the poses are eliminated view by view, and each view leaves an information matrix on its camera and
its slice of the field. Cross-validation decides on the strength of the field and whether there is
one: it leaves out magnifications, or views where there are few magnifications.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from semcal_ros.core.arrays import Array, Indices, Mask, equilibrate
from semcal_ros.core.calibration.estimator.blocks import Problem, State
from semcal_ros.core.calibration.estimator.bundle_adjustment import (
    BundleResult,
    residual_variance,
    variance_factor,
)
from semcal_ros.core.calibration.estimator.normal_equations import eliminate_views, sum_by
from semcal_ros.core.calibration.estimator.problem import Setup
from semcal_ros.core.calibration.estimator.residuals import (
    corner_rows,
    stack_rows,
    view_residuals,
    whiten,
)
from semcal_ros.core.calibration.estimator.thresholds import (
    COEFFICIENTS_IN_G_MAX,
    FIELD_GAIN_SIGMAS,
    FIELD_SIZE_MIN,
    FOLDS_MAX,
    GAINING_PART,
    MAGNIFICATIONS_MIN,
    NO_STRENGTH_PX,
    OVERLAP_PX,
    REFERENCE_WIDTH_PX,
    RIDGES,
    ROUNDING_DAMPING,
    SMOOTHNESS,
    STEADINESS,
    STRENGTHS_PX,
)
from semcal_ros.core.camera.residual_field import ResidualField, zero_field
from semcal_ros.core.errors import UnusableCalibrationError


@dataclass(frozen=True)
class FieldSystem:
    """Quadratic approximation of the reprojection error with the poses eliminated.

    Cross-validation leaves out its members: magnifications, or views where there are few
    magnifications.

    Attributes
    ----------
    information, right
        (N, C + F, C + F) and (N, C + F): the cost of camera, shared unknowns and slice z of a member is
        ``0.5 z' information z - right' z`` plus a constant, in units of the noise variance.
    group
        (N,) index of each member's magnification.
    designs
        (M, C, K): camera and shared unknowns of each magnification per unit of theta.
    weights
        (M, ng): slice of the field per coefficient in log g.
    theta_mean, theta_precision
        (K,) prior of theta.
    excess
        (N,) half chi-squares of the residuals beyond those that the corners' own noise explains.
    observations
        (N,) number of coordinates of corners.
    """

    information: Array
    right: Array
    group: Indices
    designs: Array
    weights: Array
    theta_mean: Array
    theta_precision: Array
    excess: Array
    observations: Array

    def assembled(self, keep: Mask) -> tuple[Array, Array]:
        """Assemble the normal equations of theta and the field from members in ``keep``.

        The prior of theta is in them, that of the field is not.
        """
        count, own_size, width = len(self.designs), self.designs.shape[1], self.right.shape[1]
        blocks, rights = np.zeros((count, width, width)), np.zeros((count, width))
        for v in np.flatnonzero(keep):
            blocks[self.group[v]] += self.information[v]
            rights[self.group[v]] += self.right[v]
        size = self.designs.shape[2]
        turned = np.swapaxes(self.designs, 1, 2)
        cross = np.einsum("mka,mg->kga", turned @ blocks[:, :own_size, own_size:], self.weights)
        ng, slice_size = self.weights.shape[1], width - own_size
        pairs = (self.weights[:, :, None] * self.weights[:, None, :]).reshape(count, -1)
        own = pairs.T @ blocks[:, own_size:, own_size:].reshape(count, -1)
        own = own.reshape(ng, ng, slice_size, slice_size).transpose(0, 2, 1, 3)
        matrix = np.empty((size + ng * slice_size, size + ng * slice_size))
        matrix[:size, :size] = (turned @ blocks[:, :own_size, :own_size] @ self.designs).sum(axis=0)
        matrix[np.diag_indices(size)] += self.theta_precision
        matrix[:size, size:] = cross.reshape(size, -1)
        matrix[size:, :size] = matrix[:size, size:].T
        matrix[size:, size:] = own.reshape(ng * slice_size, -1)
        camera = np.einsum("mpk,mp->k", self.designs, rights[:, :own_size])
        field = np.einsum("mg,ma->ga", self.weights, rights[:, own_size:]).ravel()
        return matrix, np.concatenate([camera + self.theta_precision * self.theta_mean, field])

    def solve(self, keep: Mask, prior: Array) -> Array:
        """Solve for theta followed by the coefficients of the field, from members in ``keep``."""
        matrix, right = self.assembled(keep)
        return _solve_field(matrix, right, prior)

    def covariance(self, prior: Array) -> Array:
        """Return the covariance of the result of :meth:`solve` from all members."""
        matrix, _ = self.assembled(np.ones(len(self.group), dtype=bool))
        scaled, scale = equilibrate(_with_field_prior(matrix, prior))
        inverse = cho_solve(_cholesky(scaled), np.eye(len(scale)))
        return 0.5 * (inverse + inverse.T) * np.outer(scale, scale)

    def costs(self, solution: Array) -> Array:
        """Return the (N,) cost of each member, up to a constant."""
        size = self.designs.shape[2]
        slices = self.weights @ solution[size:].reshape(self.weights.shape[1], -1)
        z = np.concatenate([self.designs @ solution[:size], slices], axis=1)[self.group]
        bent = (self.information @ z[:, :, None])[:, :, 0]
        return np.sum((0.5 * bent - self.right) * z, axis=1)


def _with_field_prior(matrix: Array, prior: Array) -> Array:
    """Return the equations of theta and the field with the precision ``prior`` of the field."""
    out = matrix.copy()
    out[-len(prior) :, -len(prior) :] += prior
    return out


def _solve_field(matrix: Array, right: Array, prior: Array) -> Array:
    """Solve equations of theta and the field, which has the precision ``prior``."""
    scaled, scale = equilibrate(_with_field_prior(matrix, prior))
    return scale * cho_solve(_cholesky(scaled), scale * right)


def _cholesky(scaled: Array) -> tuple[Array, bool]:
    """Factor a matrix with ones on its diagonal, which rounding may have taken out of the positive definite ones."""
    for ridge in RIDGES:
        with suppress(np.linalg.LinAlgError):
            factor: tuple[Array, bool] = cho_factor(
                scaled + ridge * np.eye(len(scaled)), check_finite=False
            )
            return factor
    raise _rounded("the residual field")


def _rounded(whose: str) -> UnusableCalibrationError:
    return UnusableCalibrationError(
        f"equations of {whose} that rounding has made unsolvable",
        expected="views that determine the camera",
        do="record more views, or calibrate with --residual off",
    )


@dataclass(frozen=True)
class FieldChoice:
    """Result of the cross-validation.

    Attributes
    ----------
    strength_px
        Prior standard deviation of a coefficient, px.
    gain, gain_sigma
        Held-out half chi-squares that the field gains, and their standard error.
    worthwhile
        Whether the gain is significant.
    explained
        Part of the misfit of the members that are left out which the field predicts; infinite where there is none.
    prior
        Prior precision of the coefficients.
    """

    strength_px: float
    gain: float
    gain_sigma: float
    worthwhile: bool
    explained: float
    prior: Array


def blank_field(setup: Setup) -> ResidualField:
    """Make a field without displacement for the magnifications of these views."""
    g = setup.magnifications
    count = min(COEFFICIENTS_IN_G_MAX, len(g))
    return zero_field(setup.image_size, (float(g[0]), float(g[-1])), count)


def undo_field(setup: Setup, field: ResidualField) -> Setup:
    """Return the views as they would be under the parametric distortion alone."""
    slices = {float(g): field.at(float(g)) for g in setup.magnifications}
    views = []
    for view in setup.views:
        q = (view.image_xy - setup.centre_px) / setup.norm_px
        shift = setup.norm_px * slices[view.magnification].displacement(q)
        views.append(replace(view, image_xy=view.image_xy + shift))
    return replace(setup, views=tuple(views), corrected=True)


def field_system(
    setup: Setup,
    problem: Problem,
    result: BundleResult,
    field: ResidualField,
    *,
    of_grid: bool = False,
) -> FieldSystem:
    """Compute the reduced system about an adjustment.

    ``setup`` holds the raw views; ``problem`` and ``result`` are the adjustment of the views
    corrected by ``field``. Weights are scaled to the variance that the residuals show. With
    ``of_grid`` the field is one of displacements on the grid, which turns with it, and not one of
    the image.
    """
    variance = residual_variance(problem, result)
    own_variance = np.concatenate([v.own_variance_share for v in setup.views])
    scaled = replace(problem, whitening=problem.whitening / np.sqrt(variance))
    corners = corner_rows(scaled, result.state)
    size = field.slice_size
    priors = stack_rows(problem.layout, view_residuals(scaled, result.state))
    inner = problem.layout.size
    # The field comes after the unknowns of a view, before the right-hand side.
    width = inner + size + 1
    place = np.r_[0:inner, width - 1]
    augmented = np.zeros((len(setup.views), width, width))
    augmented[:, place[:, None], place] = np.swapaxes(priors, 1, 2) @ priors
    observed = np.r_[corners.columns[:-1], inner : inner + size, width - 1]
    one = field.at(float(setup.magnifications[0]))
    for v, (view, part) in enumerate(zip(setup.views, problem.points_of_views, strict=True)):
        rows = np.zeros((2, size, len(view.image_xy)))
        if of_grid:
            spline = one.basis(view.board_xy_m / (problem.unit_m[v] * setup.norm_px)).T
            turned = setup.norm_px * result.state.rotations[v, :2, :2]
            rows[:, 0::2] = turned[:, 0, None, None] * spline
            rows[:, 1::2] = turned[:, 1, None, None] * spline
        else:
            spline = one.basis((view.image_xy - setup.centre_px) / setup.norm_px).T
            # The residual is observed plus field minus projected, so the field has the opposite
            # sign of a projection.
            rows[0, 0::2] = rows[1, 1::2] = -setup.norm_px * spline
        whiten(scaled.whitening[part], rows, corners.huber_weight[part])
        own = corners.rows[:, :, part]
        x, y = np.concatenate([own[:, :-1], rows, own[:, -1:]], axis=1)
        augmented[v][np.ix_(observed, observed)] += x @ x.T + y @ y.T
    few = len(setup.magnifications) < MAGNIFICATIONS_MIN
    if few and scaled.effects is not None:
        # The members are views: each is taken for a visit of its own.
        own_visit = np.arange(len(setup.views), dtype=np.intp)
        state = replace(result.state, visits=result.state.visits[scaled.effects.visit])
        effects = replace(scaled.effects, visit=own_visit, visit_group=problem.group)
        scaled = replace(scaled, effects=effects)
    else:
        state = result.state
    information, right = _without_poses_and_visits(scaled, state, augmented)
    weights = np.stack([field.weights(float(g)) for g in setup.magnifications])
    slices = weights @ field.coefficients.reshape(len(field.coefficients), -1)
    group = problem.group if scaled.effects is None else scaled.effects.visit_group
    z = np.concatenate([problem.designs @ result.state.theta, slices], axis=1)[group]
    right += np.einsum("vpq,vq->vp", information, z)
    # Of each residual half the square, of which a corner has two.
    half = 0.5 * problem.dimensions
    # A few outliers are no misfit that a field could explain.
    beyond = (variance_factor(problem, result) - own_variance) / variance
    excess = half * np.add.reduceat(result.huber_weight * beyond, problem.starts[:-1])
    observations = problem.dimensions * np.diff(problem.starts).astype(float)
    if not few:
        count = len(setup.magnifications)
        observations = sum_by(problem.group, count, observations)
        excess = sum_by(problem.group, count, excess)
        information, right = (sum_by(group, count, a) for a in (information, right))
        group = np.arange(count, dtype=np.intp)
    return FieldSystem(
        information,
        right,
        group,
        problem.designs,
        weights,
        problem.prior_mean,
        problem.prior_sigma**-2.0,
        excess,
        observations,
    )


def _without_poses_and_visits(
    problem: Problem, state: State, augmented: Array
) -> tuple[Array, Array]:
    """Eliminate poses, then visits, from augmented normal equations (V, k, k).

    The order is camera and shared unknowns, visit, pose, field, right-hand side. Returns matrices
    and right-hand sides of each visit, or of each view where there are no visits.
    """
    layout, width = problem.layout, augmented.shape[1] - 1
    # What is eliminated comes last.
    order = np.r_[layout.magnification, layout.size : width, layout.visit, layout.view]
    matrix, right = augmented[:, order[:, None], order], augmented[:, order, -1]
    for damping in (0.0, ROUNDING_DAMPING):
        with suppress(np.linalg.LinAlgError):
            return eliminate_views(problem, state, matrix, right, damping)[:2]
    raise _rounded("views")


def _second_differences(count: int) -> Array:
    rows = np.diff(np.eye(count), n=2, axis=0)
    return rows.T @ rows


def _prior(field: ResidualField, strength_px: float, norm_px: float) -> Array:
    """Return the prior precision of all coefficients."""
    ng, ny, nx, _ = field.coefficients.shape
    bent = np.kron(np.eye(ny), _second_differences(nx)) + np.kron(
        _second_differences(ny), np.eye(nx)
    )
    smooth = (np.eye(ny * nx) + SMOOTHNESS**2 * bent) * (norm_px / strength_px) ** 2
    steps = np.diff(np.eye(ng), axis=0)
    steady = np.eye(ng) + STEADINESS**2 * steps.T @ steps
    overlaps = field.overlaps() * (norm_px / OVERLAP_PX)
    # The two components are the last axis of the coefficients.
    whole = np.kron(steady, np.kron(smooth, np.eye(2)))
    whole += np.kron(np.eye(ng), overlaps.T @ overlaps)
    return whole


def held_prior(field: ResidualField, norm_px: float) -> Array:
    """Return the prior precision that holds a field at zero."""
    return _prior(field, NO_STRENGTH_PX, norm_px)


def _folds(system: FieldSystem) -> list[Mask]:
    """Return masks of the members that are left out together."""
    candidates = np.ones(len(system.group), dtype=bool)
    if len(system.designs) >= MAGNIFICATIONS_MIN:
        # The calibration does not claim to hold beyond the outermost magnifications: they are not
        # left out.
        candidates[[0, -1]] = False
    order = np.cumsum(candidates) - 1
    folds = min(FOLDS_MAX, int(candidates.sum()))
    return [candidates & (order % folds == k) for k in range(folds)]


def choose_field(
    setup: Setup,
    system: FieldSystem,
    blank: ResidualField,
) -> FieldChoice:
    """Choose the strength that predicts left-out members best, and whether to have a field."""
    folds = _folds(system)
    rest = [system.assembled(~fold) for fold in folds]

    def held_out(strength_px: float) -> Array:
        prior = _prior(blank, strength_px, setup.norm_px)
        pairs = zip(folds, rest, strict=True)
        return np.concatenate(
            [system.costs(_solve_field(*own, prior))[fold] for fold, own in pairs]
        )

    without = held_out(NO_STRENGTH_PX)
    relative = setup.image_size[0] / REFERENCE_WIDTH_PX
    gains = {s: without - held_out(s) for s in (relative * s for s in STRENGTHS_PX)}
    best = max(gains, key=lambda s: float(gains[s].sum()))
    gain = float(gains[best].sum())
    # A misfit d, whitened, that the field removes from residuals r of unit variance gains r d - d^2 / 2 in each of
    # them: d^2 / 2 on average, with the variance d^2.
    sigma = float(np.sqrt(2.0 * max(gain, 0.0)))
    most = np.mean(gains[best] > 0.0) >= GAINING_PART
    prior = _prior(blank, best, setup.norm_px)
    judged = np.any(folds, axis=0)
    excess = float(np.sum(system.excess[judged]))
    # A displacement of so many sigmas in each coordinate gains half its square.
    least = 0.5 * FIELD_SIZE_MIN**2 * float(np.sum(system.observations[judged]))
    return FieldChoice(
        strength_px=best,
        gain=gain,
        gain_sigma=sigma,
        worthwhile=bool(most and gain > max(FIELD_GAIN_SIGMAS * sigma, least)),
        explained=gain / excess if excess > 0.0 else np.inf,
        prior=prior,
    )


def solve_field(
    system: FieldSystem, prior: Array, blank: ResidualField, keep: Mask | None = None
) -> tuple[Array, ResidualField]:
    """Solve for theta and the field from all members, or from those in ``keep``."""
    every = np.ones(len(system.group), dtype=bool)
    solution = system.solve(every if keep is None else keep, prior)
    theta, coefficients = np.split(solution, [system.designs.shape[2]])
    return theta, replace(blank, coefficients=coefficients.reshape(blank.coefficients.shape))


@dataclass(frozen=True)
class FittedField:
    """The residual field of a :class:`JointFit`.

    Attributes
    ----------
    field
        The field itself.
    choice
        Its strength, and the result of cross-validation.
    system
        The reduced system at the solution, from which magnifications can be left out.
    converged
        Whether camera and field stopped changing.
    """

    field: ResidualField
    choice: FieldChoice
    system: FieldSystem
    converged: bool


@dataclass(frozen=True)
class GridPattern:
    """Displacements of the corners that turn with the grid: it is not regular.

    Attributes
    ----------
    system
        The reduced system with the pattern as unknowns.
    choice
        Its strength, and the result of cross-validation.
    """

    system: FieldSystem
    choice: FieldChoice
