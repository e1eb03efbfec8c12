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

from semcal_ros.core.arrays import Array, Indices, invert_scaled
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
    for v, own in enumerate(observed):
        x, y = corners.rows[:, :, problem.starts[v] : problem.starts[v + 1]]
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
class Eliminated:
    """Normal equations without the unknowns of views (here: poses) and visits, and the way back to these.

    Attributes
    ----------
    information, gradient
        (M, C, C) and (M, C) of each magnification.
    pose_by_rest, pose
        (V, p, C + w) and (V, p): a view's step is ``pose - pose_by_rest @ rest``, where ``rest`` is
        the step of its magnification and of its visit.
    visit_by_rest, visit
        (J, w, C) and (J, w), the same for visits.
    pose_inverse, visit_inverse
        (V, p, p) and (J, w, w): inverse of what was eliminated.
    """

    information: Array
    gradient: Array
    pose_by_rest: Array
    pose: Array
    visit_by_rest: Array
    visit: Array
    pose_inverse: Array
    visit_inverse: Array

    def back(self, problem: Problem, change: Array) -> tuple[Array, Array, Array]:
        """Return the steps of views' magnifications (V, C), visits (J, w) and poses (V, p)."""
        by_group = problem.designs @ change
        rest = by_group[problem.group]
        visits = self.visit
        if problem.effects is not None:
            own = by_group[problem.effects.visit_group]
            visits = visits - np.einsum("jwc,jc->jw", self.visit_by_rest, own)
            both = np.concatenate([rest, visits[problem.effects.visit]], axis=1)
        else:
            both = rest
        return rest, visits, self.pose - np.einsum("vpq,vq->vp", self.pose_by_rest, both)


def schur_complement(
    problem: Problem, state: State, normal: NormalEquations, damping: float
) -> Eliminated:
    """Eliminate the poses, then the visits."""
    first, outer = problem.layout.visit.start, problem.layout.view.start
    pose_inverse = _damped_inverse(normal.matrix[:, outer:, outer:], damping)
    right = np.concatenate(
        [normal.matrix[:, outer:, :outer], normal.right[:, outer:, None]], axis=2
    )
    solved = pose_inverse @ right
    cross = normal.matrix[:, :outer, outer:]
    own = normal.matrix[:, :outer, :outer] - cross @ solved[:, :, :outer]
    gradient = normal.right[:, :outer] - (cross @ solved[:, :, outer:])[:, :, 0]
    groups = len(problem.designs)
    if problem.effects is None:
        empty = np.zeros((0, 0, first)), np.zeros((0, 0)), np.zeros((0, 0, 0))
        visit_by_rest, visit, visit_inverse = empty
        group = problem.group
    else:
        group = problem.effects.visit_group
        own = sum_by(problem.effects.visit, len(group), own)
        gradient = sum_by(problem.effects.visit, len(group), gradient)
        sigma = problem.effects.visit_sigmas
        visit_columns = np.arange(first, outer)
        own[:, visit_columns, visit_columns] += sigma**-2.0
        gradient[:, first:] -= state.visits / sigma**2
        visit_inverse = _damped_inverse(own[:, first:, first:], damping)
        visit_by_rest = visit_inverse @ own[:, first:, :first]
        visit = (visit_inverse @ gradient[:, first:, None])[:, :, 0]
        across = own[:, :first, first:]
        gradient = gradient[:, :first] - (across @ visit[:, :, None])[:, :, 0]
        own = own[:, :first, :first] - across @ visit_by_rest
    return Eliminated(
        information=sum_by(group, groups, own),
        gradient=sum_by(group, groups, gradient),
        pose_by_rest=solved[:, :, :outer],
        pose=solved[:, :, outer],
        visit_by_rest=visit_by_rest,
        visit=visit,
        pose_inverse=pose_inverse,
        visit_inverse=visit_inverse,
    )


def _damped_inverse(matrix: Array, damping: float) -> Array:
    diagonal = np.arange(matrix.shape[-1])
    out = matrix.copy()
    out[:, diagonal, diagonal] = damped_diagonal(matrix, damping)
    return invert_scaled(out)


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
