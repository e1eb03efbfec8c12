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

"""What an adjustment makes small: residuals of unit variance, and their derivatives by named blocks of unknowns.

There are two kinds. A corner has a residual in x and in y, observed minus projected
(:func:`corner_rows`), with a robust loss. What else is known of a view is a :class:`Residual`: its
height, its drift, the shape of its lattice, and its orientation, from the stage or because it is
untilted. The priors of visits and of theta are independent of each other and need no derivatives.

To add a residual of a view, write a function like :func:`height_residual` and name it in
:data:`VIEW_RESIDUALS`: solver, covariance and tests go through that table (``doc/how_it_runs.md``, "How to add a
residual").
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from semcal_ros.core.arrays import Array, Indices
from semcal_ros.core.calibration.estimator.blocks import (
    GRID_NAMES,
    MISS_NAMES,
    Layout,
    Problem,
    State,
)
from semcal_ros.core.calibration.estimator.thresholds import HUBER_SIGMAS, LOSS_LOST
from semcal_ros.core.calibration.stage import OFFSET_NAMES, attitude_residuals, height_of_tilt
from semcal_ros.core.camera.projection import (
    ProjectionJacobians,
    project_points,
    project_points_with_jacobians,
)
from semcal_ros.core.robust_losses import huber_loss, huber_weight


@dataclass(frozen=True)
class Residual:
    """Residuals of one kind, r for each view, of unit variance.

    Attributes
    ----------
    values
        (V, r) observed or presumed minus predicted.
    by
        (V, r, size) derivatives of the prediction by blocks of unknowns, divided by the same sigmas; those by a block
        that a problem does not have are left out.
    """

    values: Array
    by: Mapping[str, Array]


def heights_on_beam(problem: Problem, state: State) -> tuple[Array, Array, Array]:
    """Return (V,) heights at which the specimen's plane crosses the beam, without what a tilt of the stage changes, and
    their derivatives by pose and axis (:func:`.stage.height_of_tilt`).
    """
    scan = np.zeros(len(problem.group))
    if problem.attitudes is not None:
        scan = problem.attitudes.scan_rotation_rad
    miss = problem.shared_values(state.theta, MISS_NAMES)
    return height_of_tilt(scan, state.rotations, state.translations_m, miss)


def height_residual(problem: Problem, state: State) -> Residual:
    """The specimen's plane crosses the beam at the height of its visit, but for what a tilt of the stage changes."""
    height, by_pose, by_miss = heights_on_beam(problem, state)
    if problem.effects is not None:
        height = height - state.visits[problem.effects.visit, 1]
    precision = 1.0 / problem.height_sigma_m[:, None, None]
    by = {
        "view.turn": by_pose[:, None, :3],
        "view.shift": by_pose[:, None, 3:] * problem.unit_m[:, None, None],
        "visit.height": -np.ones((len(height), 1, 1)),
        "stage.axis": by_miss[:, None, :],
    }
    whitened = {name: precision * derivative for name, derivative in by.items()}
    return Residual(-height[:, None] * precision[:, 0], whitened)


def drift_residual(problem: Problem, state: State) -> Residual | None:
    """A view drifts by as much as usual."""
    if problem.effects is None:
        return None
    precision = 1.0 / problem.effects.drift_sigma_px[:, None]
    return Residual(-state.drift_px * precision, {"view.drift": precision[:, None] * np.eye(2)})


def lattice_residual(problem: Problem, state: State) -> Residual | None:
    """The lattice of a view is stretched and sheared as little as usual."""
    if problem.effects is None or problem.effects.lattice_sigma is None:
        return None
    precision = 1.0 / problem.effects.lattice_sigma
    count = len(problem.group)
    by = {"view.lattice": np.broadcast_to(np.diag(precision), (count, 2, 2))}
    return Residual(-state.lattices * precision, by)


def attitude_residual(problem: Problem, state: State) -> Residual | None:
    """A view is tilted and turned as the stage says, or not tilted at all."""
    if problem.attitudes is None:
        return None
    offsets = problem.shared_values(state.theta, OFFSET_NAMES)
    own, by_turn, by_offset = attitude_residuals(problem.attitudes, offsets, state.rotations)
    return Residual(own, {"view.turn": by_turn, "stage.offset": by_offset})


VIEW_RESIDUALS: Mapping[str, Callable[[Problem, State], Residual | None]] = {
    "height": height_residual,
    "drift": drift_residual,
    "lattice": lattice_residual,
    "attitude": attitude_residual,
}
"""What is known of a view beside its corners; a function returns None where a problem does not have it."""


def view_residuals(problem: Problem, state: State) -> dict[str, Residual]:
    """Return those of :data:`VIEW_RESIDUALS` that a problem has, by name."""
    found = {name: residual(problem, state) for name, residual in VIEW_RESIDUALS.items()}
    return {name: own for name, own in found.items() if own is not None}


def stack_rows(layout: Layout, residuals: Mapping[str, Residual]) -> Array:
    """Return residuals as rows (V, r, P + 1) over the columns of a layout, the values last."""
    count = sum(own.values.shape[1] for own in residuals.values())
    views = len(next(iter(residuals.values())).values)
    rows = np.zeros((views, count, layout.size + 1))
    first = 0
    for own in residuals.values():
        part = rows[:, first : first + own.values.shape[1]]
        part[:, :, -1] = own.values
        for name, derivative in own.by.items():
            if name in layout:
                part[:, :, layout[name]] = derivative
        first += own.values.shape[1]
    return rows


def _shaped_grid(problem: Problem, state: State) -> Array:
    """Return the (N, 3) grid points with the shape of the grid."""
    if not problem.shared:
        return problem.board_m
    x, y, _ = problem.board_m.T
    stretch, shear, curvature = problem.shared_values(state.theta, GRID_NAMES)
    if len(state.lattices):
        own = state.lattices[problem.view_of_point]
        stretch, shear = stretch + own[:, 0], shear + own[:, 1]
    grid = np.stack(
        [
            x * (1.0 + 0.5 * stretch) + shear * y,
            y * (1.0 - 0.5 * stretch),
            0.5 * curvature * (x * x + y * y),
        ],
        axis=1,
    )
    return grid * _square_sizes(problem, state)[:, None]


def _square_sizes(problem: Problem, state: State) -> Array:
    """Return the (N,) factors by which the squares are larger than stated."""
    size = np.ones(len(problem.board_m))
    for name, shown in problem.points_on_squares.items():
        size += shown * problem.shared_values(state.theta, [name])
    return size


def _points_and_cameras(problem: Problem, state: State) -> tuple[Array, Array, Array]:
    """Return the rotated grid points, the points in the sem frame, and their cameras."""
    view = problem.view_of_point
    grid = _shaped_grid(problem, state)
    rotated = np.empty_like(grid)
    for rotation, points in zip(state.rotations, problem.points_of_views, strict=True):
        np.matmul(grid[points], rotation.T, out=rotated[points])
    cameras = problem.cameras(state.theta)[problem.group]
    if problem.effects is not None:
        cameras[:, 0] += state.visits[problem.effects.visit, 0] / problem.unit_m
    # In memory the points come last, so that each parameter of all points is contiguous.
    return rotated, rotated + state.translations_m[view], np.take(cameras.T, view, axis=1).T


def _drift_shift(problem: Problem, state: State) -> Array | float:
    """Return the (N, 2) shift of every point by the drift within its image."""
    if problem.effects is None:
        return 0.0
    return problem.effects.frame_time[:, None] * state.drift_px[problem.view_of_point]


def corner_residuals(problem: Problem, state: State) -> Array:
    """Return (N, 2) observed minus projected pixels; NaN where a point has no projection."""
    _, points, cameras = _points_and_cameras(problem, state)
    projected = project_points(cameras, points, problem.raster)
    return problem.observed_px - projected - _drift_shift(problem, state)


def whitened_norm(problem: Problem, residuals_px: Array) -> Array:
    """Return the (N,) lengths of residuals (N, 2) in standard deviations."""
    xx, yx, yy = problem.whitening.T
    x, y = residuals_px.T
    return np.hypot(xx * x, yx * x + yy * y)


def _loss(norm: Array) -> Array:
    """Return Huber's loss of whitened residual norms; that of a point without a projection is large."""
    return np.where(np.isfinite(norm), huber_loss(norm, HUBER_SIGMAS), LOSS_LOST)


def _weight(norm: Array) -> Array:
    """Return Huber's weight of whitened residual norms; a point without a projection has none."""
    return np.where(np.isfinite(norm), huber_weight(norm, HUBER_SIGMAS), 0.0)


def view_costs(problem: Problem, state: State) -> Array:
    """Return (V,) half robust sums of squares of corners, and of what is known of the views besides."""
    loss = _loss(whitened_norm(problem, corner_residuals(problem, state)))
    return np.add.reduceat(loss, problem.starts[:-1]) + 0.5 * _known_squares(problem, state)


def view_squares(problem: Problem, state: State) -> Array:
    """Return (V,) sums of the squares of corners with Huber's weights, and of what is known of the views besides.

    A view with a corner that has no projection has an infinite one: to move it there is no improvement.
    """
    norm = whitened_norm(problem, corner_residuals(problem, state))
    weight = _weight(norm)
    square = np.where(weight > 0.0, norm**2 * weight, np.inf)
    return np.bincount(problem.view_of_point, weights=square) + _known_squares(problem, state)


def _known_squares(problem: Problem, state: State) -> Array:
    """(V,) sums of squares of what is known of the views beside their corners."""
    own = [np.sum(r.values**2, axis=1) for r in view_residuals(problem, state).values()]
    return np.asarray(np.sum(own, axis=0))


def theta_cost(problem: Problem, theta: Array) -> float:
    """Return half the sum of squares of theta about its priors."""
    prior = (theta - problem.prior_mean) / problem.prior_sigma
    return 0.5 * float(prior @ prior)


def prior_cost(problem: Problem, state: State) -> float:
    """Return half the sum of squares of theta and of the visits about their priors."""
    cost = theta_cost(problem, state.theta)
    if problem.effects is not None:
        cost += 0.5 * float(np.sum((state.visits / problem.effects.visit_sigmas) ** 2))
    return cost


@dataclass(frozen=True)
class CornerRows:
    """Linearised observations of corners, of unit variance and with their Huber weights.

    Attributes
    ----------
    layout
        The blocks on which the corners depend directly.
    columns
        (A + 1,) where their unknowns stand among those of a view; the right-hand side is the last.
    rows
        (2, A + 1, N): derivatives by these unknowns, and the residual.
    residuals_px
        (N, 2) without weights.
    huber_weight
        (N,).
    turn_curvature
        (V, 3, 3) what the cost curves with the turn of each view beside the square of ``rows``.
    """

    layout: Layout
    columns: Indices
    rows: Array
    residuals_px: Array
    huber_weight: Array
    turn_curvature: Array


class _CornerDerivatives:
    """Derivatives (2, size, N) of the projections of all corners by each block of unknowns, or those of the view."""

    def __init__(self, problem: Problem, state: State, *, poses_only: bool):
        self.problem, self.state = problem, state
        self.rotated, points, cameras = _points_and_cameras(problem, state)
        self.jacobians: ProjectionJacobians = project_points_with_jacobians(
            cameras, points, problem.raster, points_only=poses_only
        )
        self.by_point = np.moveaxis(self.jacobians.d_xyz, 0, -1)  # (2, 3, N) in the sem frame

    @cached_property
    def by_grid_point(self) -> Array:
        """(2, 3, N) by the points of the grid before their squares grow, in its axes."""
        out = np.empty_like(self.by_point)
        for rotation, points in zip(
            self.state.rotations, self.problem.points_of_views, strict=True
        ):
            np.matmul(rotation.T, self.by_point[:, :, points], out=out[:, :, points])
        return out * self.square_sizes

    @cached_property
    def square_sizes(self) -> Array:
        """(N,) factors by which the squares are larger than stated."""
        return _square_sizes(self.problem, self.state)

    def by_camera(self) -> Array:
        """By the parameters of the camera."""
        return np.moveaxis(self.jacobians.d_parameters, 0, -1)[:, self.problem.parameter_index]

    def by_grid_shape(self) -> Array:
        """By stretch, shear and curvature of the grid."""
        x, y, _ = self.problem.board_m.T
        bent = 0.5 * (x * x + y * y) * self.by_grid_point[:, 2]
        return np.concatenate([self.by_lattice(), bent[:, None]], axis=1)

    def by_squares(self) -> Array:
        """By the relative sizes of the squares."""
        x, y, z = (_shaped_grid(self.problem, self.state) / self.square_sizes[:, None] ** 2).T
        dx, dy, dz = np.moveaxis(self.by_grid_point, 1, 0)
        along = x * dx + y * dy + z * dz
        shown = self.problem.points_on_squares.values()
        return np.stack([along * points for points in shown], axis=1)

    def by_visit_scale(self) -> Array:
        """By the relative scale of the visit: that of the camera, in other units."""
        m = self.jacobians.d_parameters[:, :, 0].T
        return np.asarray((m / self.problem.unit_m[self.problem.view_of_point])[:, None])

    def by_turn(self) -> Array:
        """By a rotation vector in the sem frame."""
        x, y, z = self.rotated.T
        dx, dy, dz = np.moveaxis(self.by_point, 1, 0)
        return np.stack([y * dz - z * dy, z * dx - x * dz, x * dy - y * dx], axis=1)

    def by_shift(self) -> Array:
        """By the translation, in pixels of the view."""
        return np.asarray(self.by_point * self.problem.unit_m[self.problem.view_of_point])

    def by_drift(self) -> Array:
        """By the drift within the frame."""
        assert self.problem.effects is not None
        return np.asarray(np.eye(2)[:, :, None] * self.problem.effects.frame_time)

    def by_lattice(self) -> Array:
        """By stretch and shear of the lattice of the view."""
        x, y, _ = self.problem.board_m.T
        dx, dy, _ = np.moveaxis(self.by_grid_point, 1, 0)
        return np.stack([0.5 * (x * dx - y * dy), y * dx], axis=1)


_CORNER_DERIVATIVES: Mapping[str, Callable[[_CornerDerivatives], Array]] = {
    "camera": _CornerDerivatives.by_camera,
    "grid.shape": _CornerDerivatives.by_grid_shape,
    "grid.squares": _CornerDerivatives.by_squares,
    "visit.scale": _CornerDerivatives.by_visit_scale,
    "view.turn": _CornerDerivatives.by_turn,
    "view.shift": _CornerDerivatives.by_shift,
    "view.drift": _CornerDerivatives.by_drift,
    "view.lattice": _CornerDerivatives.by_lattice,
}


def corner_rows(problem: Problem, state: State, *, poses_only: bool = False) -> CornerRows:
    """Compute the whitened residuals and derivatives of all corners.

    With ``poses_only`` the derivatives are those by the unknowns of each view.
    """
    derivatives = _CornerDerivatives(problem, state, poses_only=poses_only)
    left = problem.observed_px - derivatives.jacobians.xy - _drift_shift(problem, state)
    huber = _weight(whitened_norm(problem, left))
    layout = problem.layout.of_view if poses_only else problem.layout.only(_CORNER_DERIVATIVES)
    rows = np.empty((2, layout.size + 1, len(left)))
    for block in layout.blocks:
        rows[:, layout[block.name]] = _CORNER_DERIVATIVES[block.name](derivatives)
    rows[:, -1] = left.T
    rows[:, :, huber == 0.0] = 0.0
    whiten(problem.whitening, rows, huber)
    columns = np.append(problem.layout.columns(layout), problem.layout.size)
    curvature = _turn_curvature(problem, derivatives, left, huber)
    return CornerRows(layout, columns, rows, left, huber, curvature)


def _turn_curvature(
    problem: Problem, derivatives: _CornerDerivatives, left: Array, huber: Array
) -> Array:
    """Return the second derivatives (V, 3, 3) of the cost by the turns of views that come with the residuals.

    A turn ``w`` moves a point ``p`` by ``w x p + w x (w x p) / 2``. Where a parallel projection sees a view from above,
    the tilt acts by the second term alone, so that the square of the first derivatives says nothing of it.
    """
    xx, yx, yy = problem.whitening.T
    x = xx * left[:, 0]
    y = yx * left[:, 0] + yy * left[:, 1]
    pull = np.stack([xx * x + yx * y, yy * y]) * huber
    force = derivatives.by_point[0] * pull[0] + derivatives.by_point[1] * pull[1]
    force[:, huber == 0.0] = 0.0
    points = problem.points_of_views
    moment = np.stack([force[:, own] @ derivatives.rotated[own] for own in points])
    symmetric = 0.5 * (moment + np.swapaxes(moment, 1, 2))
    trace = np.trace(moment, axis1=1, axis2=2)
    return np.asarray(trace[:, None, None] * np.eye(3) - symmetric)


def whiten(whitening: Array, rows: Array, huber: Array) -> None:
    """Scale rows (2, k, N) to unit variance, in place."""
    xx, yx, yy = whitening.T * np.sqrt(huber)
    rows[1] *= yy
    if np.any(yx):
        rows[1] += yx * rows[0]
    rows[0] *= xx
