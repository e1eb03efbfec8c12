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

"""Reprojection errors of grid views, and their normal equations with the poses eliminated.

The unknowns are nested:

- one vector ``theta``, from which the camera of each magnification and what all views share (the
  shape of the grid, the errors of the stage) follow linearly (``camera = design @ theta``);
- for each visit of a magnification, how far the scale and the height did not come back;
- for each view, its pose, the drift within the image, and, where the lattices of the views do not
  have the same axes, how far the stretch and shear of its own lattice differ from the shared ones.

They are eliminated from the inside out (Schur complements), so the reduced system has the size of
``theta`` for any number of views; what is left is an information matrix on the camera of each
magnification and the shared unknowns.

Triggs et al., Bundle Adjustment - A Modern Synthesis, doi:10.1007/3-540-44480-7_21, section 6.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from semcal_ros.core.arrays import Array, Indices, Mask, invert_scaled
from semcal_ros.core.calibration.stage import (
    OFFSET_NAMES,
    Attitudes,
    attitude_residuals,
    height_of_tilt,
)
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.plane_geometry import rotations_from_vectors
from semcal_ros.core.camera.projection import (
    ALL_NAMES,
    PARAMETER_NAMES,
    project_points,
    project_points_with_jacobians,
)
from semcal_ros.core.camera.scan_distortion import Raster

__all__ = [
    "GRID_NAMES",
    "MISS_NAMES",
    "Effects",
    "Eliminated",
    "NormalEquations",
    "Problem",
    "State",
    "WhitenedRows",
    "damped_diagonal",
    "empty_effects",
    "make_problem",
    "normal_equations",
    "pick_views",
    "pose_priors",
    "prior_cost",
    "reduced_normal_equations",
    "residuals",
    "retract",
    "schur_complement",
    "select_views",
    "states_of",
    "sum_by",
    "view_costs",
    "visit_sigmas",
    "whiten",
    "whitened_norm",
    "whitened_rows",
    "with_states_of",
]


GRID_NAMES: tuple[str, ...] = ("grid_stretch", "grid_shear", "grid_curvature_m")
"""Stretch (x longer and y shorter by half of it), shear (x moves with y), and curvature in 1/m."""
MISS_NAMES: tuple[str, ...] = ("axis_x_m", "axis_y_m", "axis_z_m")
"""Where the tilt axis lies, as in :func:`~semcal_ros.core.calibration.stage.height_of_tilt`."""


# Huber's threshold on the norm of a whitened 2-D residual: 99 % of Gaussian corners stay quadratic.
_HUBER = 3.0
# Loss of a corner that the camera does not show at all: that of one that is far outside the image. An adjustment may
# start in such a state, and leaves it as soon as it can; one that ends in it is refused.
_LOST = 1e6


@dataclass(frozen=True)
class Effects:
    """What varies from visit to visit and from view to view, besides the poses.

    Attributes
    ----------
    visit
        (V,) index of each view's visit.
    visit_group
        (J,) index of each visit's magnification.
    scale_sigma, height_sigma_m
        Prior 1-sigma of a visit's relative scale, and of the height that its views share.
    drift_sigma_px
        (V,) prior 1-sigma per axis of the drift during one frame.
    frame_time
        (N,) when each point was scanned, in frames from the middle of the frame.
    lattice_sigma
        (2,) prior 1-sigma of a view's own stretch and shear of the grid, or None where all lattices
        have the same axes.
    """

    visit: Indices
    visit_group: Indices
    scale_sigma: float
    height_sigma_m: float
    drift_sigma_px: Array
    frame_time: Array
    lattice_sigma: Array | None = None


@dataclass(frozen=True)
class Problem:
    """Observations and priors of one adjustment.

    A magnification has C unknowns: the ``parameters`` of its camera, then those in ``shared``.

    Attributes
    ----------
    board_m, observed_px
        (N, 3) and (N, 2): grid points, and observed raw pixels (corrected by the residual field
        where there is one).
    whitening
        (N, 3): the lower triangle (xx, yx, yy) that turns a residual into one of unit covariance.
    starts
        (V + 1,) offsets of the views in these arrays.
    group
        (V,) index of each view's magnification in ``designs``.
    designs
        (M, C, K): unknowns of each magnification per unit of theta.
    unit_m
        (V,) metres per pose unit (about one pixel), which keeps the equations well scaled.
    raster
        Where the raster lies in the pictures.
    prior_mean, prior_sigma
        (K,) prior of theta; an infinite sigma stands for no prior.
    height_sigma_m
        (V,) prior 1-sigma of each view's height about the reference plane.
    parameters
        Names of the parameters of the camera that the designs give; the others are zero.
    shared
        Names of the unknowns that all views share: of the grid's shape (``GRID_NAMES`` and
        ``square_1``...), of the miss of the tilt axis (``MISS_NAMES``), and of the stage.
    square_class
        (V,) which size of squares each view shows; 0 is the one without a ``square_`` unknown.
    effects
        What varies besides the poses, or None where nothing does.
    attitudes
        What is known about the orientations of the views, or None.
    """

    board_m: Array
    observed_px: Array
    whitening: Array
    starts: Indices
    group: Indices
    designs: Array
    unit_m: Array
    raster: Raster
    prior_mean: Array
    prior_sigma: Array
    height_sigma_m: Array
    parameters: tuple[str, ...] = PARAMETER_NAMES
    shared: tuple[str, ...] = ()
    square_class: Indices | None = None
    effects: Effects | None = None
    attitudes: Attitudes | None = None

    @cached_property
    def view_of_point(self) -> Indices:
        """(N,) view index of every point."""
        return np.repeat(np.arange(len(self.group)), np.diff(self.starts))

    @property
    def shared_columns(self) -> int:
        """Number C of the unknowns of a magnification: camera and shared ones."""
        return len(self.parameters) + len(self.shared)

    @property
    def visit_columns(self) -> int:
        """Number of unknowns of a visit."""
        return 0 if self.effects is None else 2

    @property
    def pose_columns(self) -> int:
        """Number of unknowns of a view: turn, shift, drift, and the shape of its lattice."""
        if self.effects is None:
            return 6
        return 8 if self.effects.lattice_sigma is None else 10

    @cached_property
    def parameter_index(self) -> Indices:
        """(P,) place of each of ``parameters`` among those of a camera."""
        return np.array([ALL_NAMES.index(name) for name in self.parameters], dtype=np.intp)

    def column(self, name: str) -> int:
        """Return the column of a parameter of the camera, or of a shared unknown."""
        return (*self.parameters, *self.shared).index(name)

    def cameras(self, theta: Array) -> Array:
        """Return the parameters of the cameras, (M, 10), or (M, 25) with others than those of every camera."""
        own = self.designs[:, : len(self.parameters)] @ theta
        if self.parameters == PARAMETER_NAMES:
            return own
        out = np.zeros((len(self.designs), len(ALL_NAMES)))
        out[:, self.parameter_index] = own
        return out

    def shared_values(self, theta: Array, names: Sequence[str]) -> Array:
        """Return the values of shared unknowns, zero for those that the problem does not have."""
        known = dict(zip(self.shared, theta[len(theta) - len(self.shared) :], strict=True))
        return np.array([known.get(name, 0.0) for name in names])


@dataclass(frozen=True)
class State:
    """Values of the unknowns.

    Attributes
    ----------
    theta
        (K,) coefficients of the cameras, then the shared unknowns.
    rotations, translations_m
        (V, 3, 3) and (V, 3) sem frame from grid.
    visits
        (J, 2) relative scale and height in m of each visit; empty without effects.
    drift_px
        (V, 2) drift during the frame; empty without effects.
    lattices
        (V, 2) own stretch and shear of each view; empty where all lattices have the same axes.
    """

    theta: Array
    rotations: Array
    translations_m: Array
    visits: Array = field(default_factory=lambda: np.zeros((0, 2)))
    drift_px: Array = field(default_factory=lambda: np.zeros((0, 2)))
    lattices: Array = field(default_factory=lambda: np.zeros((0, 2)))


def make_problem(
    views: Sequence[GridView],
    magnifications: Array,
    designs: Array,
    *,
    raster: Raster,
    nominal_px_per_m: Array,
    prior_mean: Array,
    prior_sigma: Array,
    height_sigma_m: Array | float,
    parameters: tuple[str, ...] = PARAMETER_NAMES,
) -> Problem:
    """Arrange views for an adjustment; ``magnifications`` (M,) are the distinct ones, in order.

    ``height_sigma_m`` is one number, or one for each view.
    """
    counts = [len(v.board_xy_m) for v in views]
    group = np.searchsorted(magnifications, [v.magnification for v in views]).astype(np.intp)
    board = np.concatenate([v.board_xy_m for v in views])
    return Problem(
        board_m=np.column_stack([board, np.zeros(len(board))]),
        observed_px=np.concatenate([v.image_xy for v in views]),
        whitening=np.concatenate([v.whitening for v in views]),
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.intp),
        group=group,
        designs=designs,
        unit_m=1.0 / nominal_px_per_m[group],
        raster=raster,
        parameters=parameters,
        prior_mean=prior_mean,
        prior_sigma=prior_sigma,
        height_sigma_m=np.broadcast_to(np.asarray(height_sigma_m, dtype=np.float64), len(views)),
    )


def _shaped_grid(problem: Problem, state: State) -> Array:
    """Return the (N, 3) grid points with the shape of the grid."""
    if not problem.shared:
        return problem.board_m
    x, y, _ = problem.board_m.T
    stretch, shear, curvature = problem.shared_values(state.theta, GRID_NAMES)
    if len(state.lattices):
        own = state.lattices[problem.view_of_point]
        stretch, shear = stretch + own[:, 0], shear + own[:, 1]
    size = np.zeros(len(x))
    for k, name in _square_names(problem):
        assert problem.square_class is not None
        size += (problem.square_class == k)[problem.view_of_point] * problem.shared_values(
            state.theta, [name]
        )
    grid = np.stack(
        [
            x * (1.0 + 0.5 * stretch) + shear * y,
            y * (1.0 - 0.5 * stretch),
            0.5 * curvature * (x * x + y * y),
        ],
        axis=1,
    )
    return grid * (1.0 + size[:, None])


def _square_names(problem: Problem) -> list[tuple[int, str]]:
    """Return the class of each size of squares that has an unknown, and the name of this."""
    return [
        (int(name.removeprefix("square_")), name)
        for name in problem.shared
        if name.startswith("square_")
    ]


def _points_and_cameras(problem: Problem, state: State) -> tuple[Array, Array, Array]:
    view = problem.view_of_point
    grid = _shaped_grid(problem, state)
    rotated = np.empty_like(grid)
    for rotation, first, last in zip(
        state.rotations, problem.starts[:-1], problem.starts[1:], strict=True
    ):
        np.matmul(grid[first:last], rotation.T, out=rotated[first:last])
    cameras = problem.cameras(state.theta)[problem.group]
    if problem.effects is not None:
        cameras[:, 0] += state.visits[problem.effects.visit, 0] / problem.unit_m
    return rotated, rotated + state.translations_m[view], cameras[view]


def _drift_shift(problem: Problem, state: State) -> Array | float:
    """Return the (N, 2) shift of every point by the drift within its image."""
    if problem.effects is None:
        return 0.0
    return problem.effects.frame_time[:, None] * state.drift_px[problem.view_of_point]


def residuals(problem: Problem, state: State) -> Array:
    """Return (N, 2) observed minus projected pixels; NaN where a point has no projection."""
    _, points, cameras = _points_and_cameras(problem, state)
    projected = project_points(cameras, points, problem.raster)
    return problem.observed_px - projected - _drift_shift(problem, state)


def whitened_norm(problem: Problem, miss: Array) -> Array:
    """Return the (N,) lengths of residuals (N, 2) in standard deviations."""
    xx, yx, yy = problem.whitening.T
    return np.hypot(xx * miss[:, 0], yx * miss[:, 0] + yy * miss[:, 1])


def _huber(norm: Array) -> tuple[Array, Array]:
    """Return Huber's loss (half the squared norm inside) and weight of whitened residual norms.

    A point without a projection has a large loss and no weight.
    """
    seen = np.isfinite(norm)
    norm = np.where(seen, norm, 0.0)
    outside = norm > _HUBER
    loss = np.where(outside, _HUBER * (norm - 0.5 * _HUBER), 0.5 * norm * norm)
    weight = np.where(outside, _HUBER / np.maximum(norm, _HUBER), 1.0)
    return np.where(seen, loss, _LOST), np.where(seen, weight, 0.0)


def view_costs(problem: Problem, state: State) -> Array:
    """Return (V,) half robust sums of squares, with the priors of the poses."""
    loss, _ = _huber(whitened_norm(problem, residuals(problem, state)))
    own = pose_priors(problem, state)[:, :, -1]
    return np.add.reduceat(loss, problem.starts[:-1]) + 0.5 * np.sum(own**2, axis=1)


def prior_cost(problem: Problem, state: State) -> float:
    """Return half the sum of squares of theta and of the visits about their priors."""
    prior = (state.theta - problem.prior_mean) / problem.prior_sigma
    return float(0.5 * prior @ prior + 0.5 * np.sum(_visit_priors(problem, state) ** 2))


def visit_sigmas(problem: Problem) -> Array:
    """Return the (2,) prior 1-sigma of the unknowns of a visit."""
    assert problem.effects is not None
    return np.array([problem.effects.scale_sigma, problem.effects.height_sigma_m])


def _visit_priors(problem: Problem, state: State) -> Array:
    return state.visits if problem.effects is None else state.visits / visit_sigmas(problem)


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations of each view, (V, P, P) and (V, P).

    The order is: camera and shared unknowns (C), visit, pose.
    """

    matrix: Array
    right: Array
    residuals_px: Array
    huber_weight: Array


@dataclass(frozen=True)
class WhitenedRows:
    """Linearised observations of unit variance, Huber-weighted.

    Attributes
    ----------
    columns
        (A,) which of the unknowns of a view the observations depend on directly; the right-hand
        side is the last.
    rows
        (2, A, N): derivatives by these unknowns, and the residual.
    residuals_px
        (N, 2) without weights.
    huber_weight
        (N,).
    """

    columns: Indices
    rows: Array
    residuals_px: Array
    huber_weight: Array


def whitened_rows(problem: Problem, state: State, *, poses_only: bool = False) -> WhitenedRows:
    """Compute the whitened residuals and derivatives of all observations.

    With ``poses_only`` the derivatives are those by the unknowns of each view.
    """
    rotated, points, cameras = _points_and_cameras(problem, state)
    jacobians = project_points_with_jacobians(cameras, points, problem.raster)
    miss = problem.observed_px - jacobians.xy - _drift_shift(problem, state)
    huber = _huber(whitened_norm(problem, miss))[1]
    shift = np.moveaxis(jacobians.d_xyz, 0, -1)
    view = problem.view_of_point
    first = problem.shared_columns
    pose = first + problem.visit_columns
    columns = list(range(pose, pose + problem.pose_columns + 1))
    if not poses_only:
        visit = range(first, first + problem.visit_columns // 2)
        columns = [*range(len(problem.parameters)), *_grid_columns(problem), *visit, *columns]
    rows = np.empty((2, len(columns), len(points)))
    by_grid = np.zeros((2, 3, 0))
    if len(state.lattices) or (not poses_only and len(_grid_columns(problem)) > 0):
        by_grid = np.einsum("kin,nij->kjn", shift, state.rotations[view])
    if not poses_only:
        at = len(problem.parameters)
        rows[:, :at] = np.moveaxis(jacobians.d_parameters, 0, -1)[:, problem.parameter_index]
        if len(_grid_columns(problem)) > 0:
            for derivative in _by_grid_shape(problem, state, by_grid):
                rows[:, at] = derivative
                at += 1
        if problem.effects is not None:
            rows[:, at] = rows[:, problem.column("m")] / problem.unit_m[view]
    at = len(columns) - 1 - problem.pose_columns
    x, y, z = rotated.T
    rows[:, at] = y * shift[:, 2] - z * shift[:, 1]
    rows[:, at + 1] = z * shift[:, 0] - x * shift[:, 2]
    rows[:, at + 2] = x * shift[:, 1] - y * shift[:, 0]
    rows[:, at + 3 : at + 6] = shift * problem.unit_m[view]
    if problem.effects is not None:
        rows[:, at + 6 : at + 8] = 0.0
        rows[0, at + 6] = rows[1, at + 7] = problem.effects.frame_time
    if len(state.lattices):
        rows[:, at + 8], rows[:, at + 9] = (
            _by_stretch(problem, by_grid),
            _by_shear(problem, by_grid),
        )
    rows[:, -1] = miss.T
    rows[:, :, huber == 0.0] = 0.0
    whiten(problem.whitening, rows, huber)
    return WhitenedRows(np.array(columns, dtype=np.intp), rows, miss, huber)


def _grid_columns(problem: Problem) -> list[int]:
    """Return the columns of the shared unknowns that describe the shape of the grid."""
    own = [name for name in problem.shared if name in GRID_NAMES]
    own += [name for _, name in _square_names(problem)]
    return [problem.column(name) for name in own]


def _by_stretch(problem: Problem, by_grid: Array) -> Array:
    """Return the (2, N) derivative of the pixels by the stretch of the grid."""
    x, y, _ = problem.board_m.T
    out: Array = 0.5 * (x * by_grid[:, 0] - y * by_grid[:, 1])
    return out


def _by_shear(problem: Problem, by_grid: Array) -> Array:
    """Return the (2, N) derivative of the pixels by the shear of the grid."""
    out: Array = problem.board_m[:, 1] * by_grid[:, 0]
    return out


def _by_grid_shape(problem: Problem, state: State, by_grid: Array) -> Iterator[Array]:
    """Yield the (2, N) derivative of the pixels by the unknown of each of ``_grid_columns``.

    ``by_grid`` (2, 3, N) is that by the points of the grid.
    """
    x, y, _ = problem.board_m.T
    squares = {name: k for k, name in _square_names(problem)}
    along_shape = None
    for column in _grid_columns(problem):
        name = (*problem.parameters, *problem.shared)[column]
        if name == "grid_stretch":
            yield _by_stretch(problem, by_grid)
        elif name == "grid_shear":
            yield _by_shear(problem, by_grid)
        elif name == "grid_curvature_m":
            yield 0.5 * (x * x + y * y) * by_grid[:, 2]
        else:
            assert problem.square_class is not None
            if along_shape is None:
                along_shape = np.einsum("kjn,nj->kn", by_grid, _shaped_grid(problem, state))
            yield along_shape * (problem.square_class == squares[name])[problem.view_of_point]


def whiten(whitening: Array, rows: Array, huber: Array) -> None:
    """Scale rows (2, k, N) to unit variance, in place."""
    xx, yx, yy = whitening.T * np.sqrt(huber)
    rows[1] *= yy
    if np.any(yx):
        rows[1] += yx * rows[0]
    rows[0] *= xx


def pose_priors(problem: Problem, state: State) -> Array:
    """Return the priors of the poses as whitened rows (V, r, P + 1), the residual last.

    They are those of the height, of the drift within the image, of the shape of the lattice and of
    the orientation.
    """
    first, width = problem.shared_columns, problem.visit_columns + problem.pose_columns
    pose = first + problem.visit_columns
    count = problem.pose_columns - 5 + (0 if problem.attitudes is None else 3)
    rows = np.zeros((len(problem.group), count, first + width + 1))
    scan = np.zeros(len(problem.group))
    if problem.attitudes is not None:
        scan = problem.attitudes.scan_rotation_rad
    miss = problem.shared_values(state.theta, MISS_NAMES)
    height, by_pose, by_miss = height_of_tilt(scan, state.rotations, state.translations_m, miss)
    rows[:, 0, pose : pose + 3] = by_pose[:, :3]
    rows[:, 0, pose + 3 : pose + 6] = by_pose[:, 3:] * problem.unit_m[:, None]
    _fill(problem, rows[:, 0], MISS_NAMES, by_miss)
    if problem.effects is not None:
        height = height - state.visits[problem.effects.visit, 1]
        rows[:, 0, first + 1] = -1.0
        sigma = problem.effects.drift_sigma_px
        rows[:, 1, pose + 6] = rows[:, 2, pose + 7] = 1.0 / sigma
        rows[:, 1:3, -1] = -state.drift_px / sigma[:, None]
        own_sigma = problem.effects.lattice_sigma
        if own_sigma is not None:
            rows[:, 3, pose + 8], rows[:, 4, pose + 9] = 1.0 / own_sigma
            rows[:, 3:5, -1] = -state.lattices / own_sigma
    rows[:, 0, -1] = -height
    rows[:, 0] /= problem.height_sigma_m[:, None]
    if problem.attitudes is not None:
        offsets = problem.shared_values(state.theta, OFFSET_NAMES)
        own, by_turn, by_offset = attitude_residuals(problem.attitudes, offsets, state.rotations)
        rows[:, -3:, -1] = own
        rows[:, -3:, pose : pose + 3] = by_turn
        for k in range(3):
            _fill(problem, rows[:, k - 3], OFFSET_NAMES, by_offset[:, k])
    return rows


def _fill(problem: Problem, rows: Array, names: Sequence[str], values: Array) -> None:
    """Set the columns of shared unknowns in rows (V, P + 1), in place."""
    for k, name in enumerate(names):
        if name in problem.shared:
            rows[:, problem.column(name)] = values[:, k]


def normal_equations(
    problem: Problem, state: State, *, poses_only: bool = False
) -> NormalEquations:
    """Compute the Huber-weighted normal equations of every view, with the priors of its pose.

    With ``poses_only`` the observations fill only the columns of the pose, which takes a third of
    the time.
    """
    whitened = whitened_rows(problem, state, poses_only=poses_only)
    priors = pose_priors(problem, state)
    matrix = np.swapaxes(priors, 1, 2) @ priors
    columns = whitened.columns
    observed = np.empty((len(problem.group), len(columns), len(columns)))
    for v, own in enumerate(observed):
        x, y = whitened.rows[:, :, problem.starts[v] : problem.starts[v + 1]]
        np.matmul(x, x.T, out=own)
        own += y @ y.T
    matrix[:, columns[:, None], columns] += observed
    return NormalEquations(
        matrix[:, :-1, :-1], matrix[:, :-1, -1], whitened.residuals_px, whitened.huber_weight
    )


@dataclass(frozen=True)
class Eliminated:
    """Normal equations without poses and visits, and the way back to these.

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
    first = problem.shared_columns
    outer = first + problem.visit_columns
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
        sigma = visit_sigmas(problem)
        own[:, [first, first + 1], [first, first + 1]] += sigma**-2.0
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


def retract(problem: Problem, state: State, change: Array, pose: Array, visits: Array) -> State:
    """Return the state after changes of theta (K,), of the poses (V, p) and of the visits (J, w)."""
    return State(
        state.theta + change,
        rotations_from_vectors(pose[:, :3]) @ state.rotations,
        state.translations_m + pose[:, 3:6] * problem.unit_m[:, None],
        state.visits + visits if len(state.visits) else state.visits,
        state.drift_px + pose[:, 6:8] if len(state.drift_px) else state.drift_px,
        state.lattices + pose[:, 8:] if len(state.lattices) else state.lattices,
    )


def pick_views(pick: Mask, chosen: State, other: State) -> State:
    """Return ``other`` with what ``chosen`` has of the views in ``pick`` (V,)."""
    return with_states_of(other, pick, states_of(chosen, pick))


def states_of(state: State, chosen: Mask) -> State:
    """Return the state of some of the views (V,)."""
    return replace(
        state,
        rotations=state.rotations[chosen],
        translations_m=state.translations_m[chosen],
        drift_px=state.drift_px[chosen] if len(state.drift_px) else state.drift_px,
        lattices=state.lattices[chosen] if len(state.lattices) else state.lattices,
    )


def with_states_of(state: State, chosen: Mask, own: State) -> State:
    """Return the state with that of some of the views (V,), as :func:`states_of` gives it."""
    out = {}
    for name in ("rotations", "translations_m", "drift_px", "lattices"):
        values = getattr(state, name).copy()
        if len(values):
            values[chosen] = getattr(own, name)
        out[name] = values
    return replace(state, **out)


def empty_effects(problem: Problem, state: State) -> State:
    """Return the state with effects of zero, as many as the problem has."""
    effects, none = problem.effects, np.zeros((0, 2))
    if effects is None:
        return replace(state, visits=none, drift_px=none, lattices=none)
    visits, own = np.zeros((len(effects.visit_group), 2)), np.zeros((len(problem.group), 2))
    lattices = none if effects.lattice_sigma is None else own
    return replace(state, visits=visits, drift_px=own, lattices=lattices)


def select_views(problem: Problem, chosen: Mask) -> Problem:
    """Return the problem with only some of its views."""
    points = chosen[problem.view_of_point]
    counts = np.diff(problem.starts)[chosen]
    effects = problem.effects
    if effects is not None:
        effects = replace(
            effects,
            visit=effects.visit[chosen],
            drift_sigma_px=effects.drift_sigma_px[chosen],
            frame_time=effects.frame_time[points],
        )
    return replace(
        problem,
        board_m=problem.board_m[points],
        observed_px=problem.observed_px[points],
        whitening=problem.whitening[points],
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.intp),
        group=problem.group[chosen],
        unit_m=problem.unit_m[chosen],
        height_sigma_m=problem.height_sigma_m[chosen],
        square_class=None if problem.square_class is None else problem.square_class[chosen],
        attitudes=None if problem.attitudes is None else problem.attitudes.chosen(chosen),
        effects=effects,
    )
