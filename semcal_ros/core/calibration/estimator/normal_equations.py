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

"""Normal equations of grid views, with the poses and then the visits eliminated.

They are eliminated from the inside out (Schur complements), so the reduced system has the size of
``theta`` for any number of views; what is left is an information matrix on the camera of each
magnification and the shared unknowns.

Triggs et al., Bundle Adjustment - A Modern Synthesis, doi:10.1007/3-540-44480-7_21, section 6.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array, Indices
from semcal_ros.core.calibration.estimator.blocks import Problem, State
from semcal_ros.core.calibration.estimator.residuals import (
    corner_rows,
    stack_rows,
    view_residuals,
)


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of each view, (V, P, P) and (V, P), in the columns of the problem's layout."""

    matrix: Array
    right: Array
    residuals_px: Array
    huber_weight: Array


def normal_equations(
    problem: Problem, state: State, *, poses_only: bool = False, for_step: bool = False
) -> NormalEquations:
    """Compute the Huber-weighted normal equations of every view, with all that is known of the view.

    With ``poses_only`` the corners fill only the columns of the view's own unknowns, which is faster.
    ``for_step`` adds the size of the second derivatives by the turns of the views: steps by the first alone go astray
    where a tilt acts by its square. By its size, also where a flat view is the highest point and not the lowest, a step
    leads downwards (saddle-free Newton: Dauphin et al. 2014, arXiv:1406.2572).
    What is known of visits and of theta comes in when these are eliminated and reduced.
    """
    corners = corner_rows(problem, state, poses_only=poses_only)
    priors = stack_rows(problem.layout, view_residuals(problem, state))
    matrix = np.swapaxes(priors, 1, 2) @ priors
    columns = corners.columns
    observed = np.empty((len(problem.group), len(columns), len(columns)))
    for own, points in zip(observed, problem.points_of_views, strict=True):
        x, y = corners.rows[:, :, points]
        np.matmul(x, x.T, out=own)
        own += y @ y.T
    matrix[:, columns[:, None], columns] += observed
    if for_step:
        turn = problem.layout["view.turn"]
        values, axes = np.linalg.eigh(corners.turn_curvature)
        matrix[:, turn, turn] += (axes * np.abs(values)[:, None, :]) @ np.swapaxes(axes, 1, 2)
    return NormalEquations(
        matrix[:, :-1, :-1], matrix[:, :-1, -1], corners.residuals_px, corners.huber_weight
    )


@dataclass(frozen=True)
class Inner:
    """Unknowns that were eliminated: their steps are ``step - by_rest @ rest``, (n, p) and (n, p, q), and the inverse
    of their own equations is (n, p, p).
    """

    by_rest: Array
    step: Array
    inverse: Array


@dataclass(frozen=True)
class Eliminated:
    """Normal equations without the unknowns of views (here: poses) and visits, and the way back to these.

    Attributes
    ----------
    information, gradient
        (M, C, C) and (M, C) of each magnification.
    views
        V blocks of p unknowns; their rest are the C + w unknowns of the magnification and of the visit.
    visits
        J blocks of w unknowns; their rest are the C unknowns of the magnification.
    """

    information: Array
    gradient: Array
    views: Inner
    visits: Inner

    def back(self, problem: Problem, change: Array) -> tuple[Array, Array, Array]:
        """Return the steps of views' magnifications (V, C), visits (J, w) and poses (V, p)."""
        by_group = problem.designs @ change
        rest = by_group[problem.group]
        visits = self.visits.step
        if problem.effects is not None:
            own = by_group[problem.effects.visit_group]
            visits = visits - np.einsum("jwc,jc->jw", self.visits.by_rest, own)
            both = np.concatenate([rest, visits[problem.effects.visit]], axis=1)
        else:
            both = rest
        return rest, visits, self.views.step - np.einsum("vpq,vq->vp", self.views.by_rest, both)


def schur_complement(
    problem: Problem, state: State, normal: NormalEquations, damping: float
) -> Eliminated:
    """Eliminate the poses, then the visits."""
    own, gradient, views, visits = eliminate_views(
        problem, state, normal.matrix, normal.right, damping
    )
    group = problem.group if problem.effects is None else problem.effects.visit_group
    groups = len(problem.designs)
    return Eliminated(
        information=sum_by(group, groups, own),
        gradient=sum_by(group, groups, gradient),
        views=views,
        visits=visits,
    )


def eliminate_views(
    problem: Problem, state: State, matrix: Array, right: Array, damping: float
) -> tuple[Array, Array, Inner, Inner]:
    """Eliminate the unknowns of views, which come last, then those of visits, which come before these.

    Parameters
    ----------
    matrix, right
        (V, k, k) and (V, k) normal equations of each view.
    damping
        Marquardt's damping of what is eliminated.

    Returns
    -------
    The equations of the others, of each visit, or of each view where there are no visits; and the unknowns of views
    and of visits.

    Raises
    ------
    numpy.linalg.LinAlgError
        If what is eliminated is not positive definite.
    """
    outer = matrix.shape[1] - problem.layout.of_view.size
    own, gradient, views = eliminate(matrix, right, outer, damping)
    if problem.effects is None:
        none = Inner(np.zeros((0, 0, outer)), np.zeros((0, 0)), np.zeros((0, 0, 0)))
        return own, gradient, views, none
    sigma, count = problem.effects.visit_sigmas, len(problem.effects.visit_group)
    own, gradient = (sum_by(problem.effects.visit, count, sums) for sums in (own, gradient))
    first = outer - len(sigma)
    visit_columns = np.arange(first, outer)
    own[:, visit_columns, visit_columns] += sigma**-2.0
    gradient[:, first:] -= state.visits / sigma**2
    own, gradient, visits = eliminate(own, gradient, first, damping)
    return own, gradient, views, visits


def eliminate(
    matrix: Array, right: Array, first: int, damping: float = 0.0
) -> tuple[Array, Array, Inner]:
    """Eliminate the unknowns from ``first`` on.

    Parameters
    ----------
    matrix, right
        (n, q + p, q + p) and (n, q + p) normal equations, where ``first`` is q.
    damping
        Marquardt's damping of what is eliminated.

    Returns
    -------
    The equations of the others, (n, q, q) and (n, q), and what was eliminated.

    Raises
    ------
    numpy.linalg.LinAlgError
        If what is eliminated is not positive definite.

    Notes
    -----
    An inverse makes what is left wrong by the rounding times the condition of what is eliminated, a Cholesky factor by
    the rounding times the root of it (Higham, Accuracy and Stability of Numerical Algorithms,
    doi:10.1137/1.9780898718027, section 10.1). The difference counts where the pose of a view takes nearly all that is
    known of a pivot or a grid: what an inverse leaves of it is not positive, and a choice among terms has no minimum.
    """
    inner = matrix[:, first:, first:].copy()
    diagonal = np.arange(inner.shape[-1])
    inner[:, diagonal, diagonal] = damped_diagonal(inner, damping)
    # By powers of two, which do not round.
    scale = np.exp2(-np.round(0.5 * np.log2(inner[:, diagonal, diagonal])))
    factor = np.linalg.cholesky(inner * (scale[:, :, None] * scale[:, None, :]))
    root = np.linalg.inv(factor) * scale[:, None, :]
    transposed = np.swapaxes(root, 1, 2)
    both = np.concatenate([matrix[:, :, :first], right[:, :, None]], axis=2)
    half = root @ both[:, first:]
    left = both[:, :first] - np.swapaxes(half[:, :, :first], 1, 2) @ half
    solved = transposed @ half
    return (
        left[:, :, :first],
        left[:, :, first],
        Inner(solved[:, :, :first], solved[:, :, first], transposed @ root),
    )


def damped_diagonal(matrix: Array, damping: Array | float) -> Array:
    """Return the (V, p) diagonals of (V, p, p) with Marquardt's damping; 1 where nothing is known of an unknown, as of
    the pose of a view of which the camera shows no corner.
    """
    known = np.diagonal(matrix, axis1=1, axis2=2)
    return np.where(known > 0.0, known * (1.0 + damping), 1.0)


def sum_by(index: Indices, count: int, values: Array) -> Array:
    """Return the sums (count, ...) of values (n, ...) that have the same index."""
    out = np.zeros((count, *values.shape[1:]))
    np.add.at(out, index, values)
    return out


def reduced_normal_equations(
    problem: Problem, theta: Array, information: Array, gradient: Array
) -> tuple[Array, Array]:
    """Assemble the reduced normal equations (K, K) and (K,) of theta, with its prior.

    ``information`` (M, C, C) and ``gradient`` (M, C) are the blocks of each magnification.
    """
    designs = problem.designs
    matrix = (np.swapaxes(designs, 1, 2) @ information @ designs).sum(axis=0)
    right = np.einsum("mpk,mp->k", designs, gradient)
    matrix[np.diag_indices_from(matrix)] += problem.prior_sigma**-2.0
    right = right - (theta - problem.prior_mean) * problem.prior_sigma**-2.0
    return matrix, right
