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

"""Structure of tracks with gaps: an affine rank-3 factorization that grows view by view, and its upgrade to metres.

Tomasi and Kanade (1992), doi:10.1007/BF00129684: the centred tracks of points seen in all views are
the product of (2 views, 3) camera rows and (3, points) coordinates. Here the block with the most
significant relief is factorized by the SVD, further views and points are added by linear least
squares, and the whole is refined by robust alternation over the observations. Translations are
unknowns of each view, so drift between views does no harm.

The tracks are in true scale (see :class:`.Tracks`), so the rows of every camera become orthonormal:
``M_i Q M_i^T = I`` for one symmetric Q = A A^T. That is linear in the six entries of Q and
absolute: scale, aspect and skew are those of the calibration. Two ambiguities remain in
parallel projection, whatever the number of views:

- the *bas-relief* direction is weak when the views differ by small rotations; see
  :attr:`MetricUpgrade.condition`;
- the *mirror image* in depth, with mirrored rotations, explains the tracks exactly as well:
  :func:`mirror_structure`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from semcal_ros.applications.reconstruction.thresholds import (
    BLOCK_VIEWS_MIN,
    COMMON_MIN,
    DEPTH_LEVER_MIN,
    HUBER_SIGMAS,
    VIEW_POINTS_MIN,
    WINDOWS,
)
from semcal_ros.core.arrays import Array, Indices, Mask, mad_sigma
from semcal_ros.core.errors import InvalidValueError, StructureError
from semcal_ros.core.robust_losses import huber_weight
from semcal_ros.core.wording import counted

# Reverses depth.
_MIRROR = np.diag([1.0, 1.0, -1.0])
# Rows and columns of the six different entries of Q.
_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@dataclass(frozen=True, eq=False)
class Tracks:
    """Positions of points in the views, in the plane of the specimen.

    Parameters
    ----------
    xy_m
        (views, points, 2) sem-frame X and Y at height 0 of the line of sight, m
        (:meth:`~semcal_ros.core.camera.scan_camera.ScanCamera.sem_from_ideal` of undistorted
        pixels). The calibrated intrinsics are divided out, so that every view is a parallel
        projection in true scale, up to ``1 / (1 + rho Z)``. Arbitrary where not seen.
    seen
        (views, points) whether each view sees each point.
    """

    xy_m: Array
    seen: Mask

    def __post_init__(self) -> None:
        if self.xy_m.ndim != 3 or self.xy_m.shape != (*self.seen.shape, 2):
            raise InvalidValueError(
                f"tracks of shape {self.xy_m.shape} with a mask of shape {self.seen.shape}",
                expected="(views, points, 2) and (views, points)",
            )
        if not np.all(np.isfinite(self.xy_m[self.seen])):
            raise InvalidValueError("tracks that are not finite", expected="finite metres")


@dataclass(frozen=True, eq=False)
class AffineStructure:
    """Cameras and points up to an affine transform of space.

    Attributes
    ----------
    cameras
        (views, 2, 3) rows of the affine cameras.
    offsets_m
        (views, 2) translations, m.
    points
        (points, 3) coordinates in an affine frame.
    views_placed, points_placed
        (views,), (points,) which of them could be placed; the others are zero.
    rms_m
        Robust RMS of the residuals per coordinate, m.
    relief
        RMS extent along the weakest direction of the first block over its residual noise: where it
        is near 1 there is no depth in the views.
    """

    cameras: Array
    offsets_m: Array
    points: Array
    views_placed: Mask
    points_placed: Mask
    rms_m: float
    relief: float


def factorize(tracks: Tracks, *, sweeps: int = 30) -> AffineStructure:
    """Compute the affine structure of tracks.

    Raises
    ------
    StructureError
        If no three views share 12 points that move against each other.
    """
    start = _choose_first_block(tracks)
    state = _GrowingStructure(tracks, *start)
    state.grow()
    for _ in range(sweeps):
        state.place_points(~np.zeros(tracks.seen.shape[1], dtype=bool))
        state.place_views(~np.zeros(tracks.seen.shape[0], dtype=bool))
    state.grow()
    return state.result()


def _choose_first_block(tracks: Tracks) -> tuple[Indices, Indices, float]:
    """Choose views and points of the block with the most relief; also relief over noise."""
    best: tuple[float, Indices, Indices, float] | None = None
    n_views = len(tracks.seen)
    for length in (w for w in WINDOWS if w <= max(n_views, BLOCK_VIEWS_MIN)):
        for first in range(0, n_views - length + 1, max(1, length // 4)):
            views = np.arange(first, first + length)
            points = np.flatnonzero(tracks.seen[views].all(axis=0))
            if len(points) < COMMON_MIN:
                continue
            table = _centre_rows(tracks.xy_m[np.ix_(views, points)])
            values = np.linalg.svd(table, compute_uv=False)
            if len(values) < 4:
                continue
            noise = float(np.sqrt(np.mean(values[3:] ** 2)))
            score = float(values[2]) / max(noise, 1e-30) * np.sqrt(len(points))
            relief = float(values[2]) / max(noise, 1e-30)
            if best is None or score > best[0]:
                best = (score, views, points, relief)
    if best is None:
        raise StructureError(
            f"no {BLOCK_VIEWS_MIN} of {n_views} views share {COMMON_MIN} points",
            expected="a sequence in which points can be followed from view to view",
            do="record slower movements or more texture",
        )
    return best[1], best[2], best[3]


def _centre_rows(block: Array) -> Array:
    """Return the (2 views, points) tracks with the mean of each row subtracted."""
    table = np.moveaxis(block, 2, 1).reshape(-1, block.shape[1])
    return np.asarray(table - table.mean(axis=1, keepdims=True), dtype=np.float64)


class _GrowingStructure:
    """The structure while views and points are added to it."""

    def __init__(self, tracks: Tracks, views: Indices, points: Indices, relief: float) -> None:
        self.xy, self.seen = tracks.xy_m, tracks.seen
        n_views, n_points = self.seen.shape
        self.cameras = np.zeros((n_views, 2, 3))
        self.offsets = np.zeros((n_views, 2))
        self.points = np.zeros((n_points, 3))
        self.views_in = np.zeros(n_views, dtype=bool)
        self.points_in = np.zeros(n_points, dtype=bool)
        self.relief = relief
        block = self.xy[np.ix_(views, points)]
        u, s, vt = np.linalg.svd(_centre_rows(block), full_matrices=False)
        # Points of unit spread, cameras in metres: both sides of a good size for the alternation.
        root = np.sqrt(len(points))
        self.points[points] = vt[:3].T * root
        self.cameras[views] = (u[:, :3] * s[:3] / root).reshape(-1, 2, 3)
        self.offsets[views] = block.mean(axis=1)
        self.views_in[views] = True
        self.points_in[points] = True
        self.sigma = self._scale()

    def _residuals(self) -> tuple[Array, Mask]:
        used = self.seen & self.views_in[:, None] & self.points_in[None, :]
        predicted = np.einsum("vij,pj->vpi", self.cameras, self.points) + self.offsets[:, None]
        return np.where(used[..., None], self.xy - predicted, 0.0), used

    def _scale(self) -> float:
        error, used = self._residuals()
        sigma = mad_sigma(error[used])
        # Some of the points are fitted almost exactly; keep the scale away from zero.
        return max(sigma, 1e-12 * float(np.abs(self.cameras).max()))

    def _weights(self) -> Array:
        """Compute (views, points) Huber weights; zero for unused observations."""
        error, used = self._residuals()
        size = np.linalg.norm(error, axis=2) / self.sigma
        return np.where(used, huber_weight(size, HUBER_SIGMAS), 0.0)

    def place_views(self, wanted: Mask, weights: Array | None = None) -> None:
        """Fit cameras that see enough placed points by least squares."""
        able = (self.seen & self.points_in).sum(axis=1) >= VIEW_POINTS_MIN
        index = np.flatnonzero(wanted & able)
        if not len(index):
            return
        fresh = ~self.views_in[index]
        weight = (self._weights() if weights is None else weights)[index]
        weight[fresh] = (self.seen[index] & self.points_in)[fresh]
        design = np.column_stack([self.points, np.ones(len(self.points))])
        for step in range(4 if fresh.any() else 1):
            normal = np.einsum("vp,pi,pj->vij", weight, design, design, optimize=True)
            seen_m = self._filled(index)
            right = np.einsum("vp,pi,vpk->vik", weight, design, seen_m, optimize=True)
            found = np.asarray(np.linalg.solve(normal + 1e-9 * np.eye(4), right), dtype=np.float64)
            if step < 3 and fresh.any():
                error = seen_m - np.einsum("pi,vik->vpk", design, found)
                size = np.linalg.norm(error, axis=2)
                use = self.seen[index] & self.points_in
                median = np.array([np.median(s[u]) for s, u in zip(size, use, strict=True)])
                limit = np.maximum(2.0 * median, self.sigma)[:, None]
                weight = np.where(use, limit / np.maximum(size, limit), 0.0)
        self.cameras[index] = np.moveaxis(found[:, :3], 1, 2)
        self.offsets[index] = found[:, 3]
        self.views_in[index] = True

    def _filled(self, views: Indices) -> Array:
        return np.where(self.seen[views][..., None], self.xy[views], 0.0)

    def place_points(self, wanted: Mask) -> None:
        """Fit points that enough placed views see from different sides by least squares."""
        index = np.flatnonzero(
            wanted & ((self.seen & self.views_in[:, None]).sum(axis=0) >= BLOCK_VIEWS_MIN)
        )
        if not len(index):
            return
        weight = self._weights()[:, index]
        fresh = ~self.points_in[index]
        weight[:, fresh] = (self.seen[:, index] & self.views_in[:, None])[:, fresh]
        shift = np.where(
            self.seen[:, index][..., None], self.xy[:, index] - self.offsets[:, None], 0.0
        )
        normal = np.einsum("vp,vki,vkj->pij", weight, self.cameras, self.cameras, optimize=True)
        right = np.einsum("vp,vki,vpk->pi", weight, self.cameras, shift, optimize=True)
        values = np.linalg.eigvalsh(normal)
        good = values[:, 0] > DEPTH_LEVER_MIN * values[:, 2]
        placed = index[good]
        self.points[placed] = np.linalg.solve(normal[good], right[good][..., None])[..., 0]
        self.points_in[placed] = True

    def grow(self) -> None:
        """Add points and views until nothing more can be added."""
        for _ in range(len(self.seen) + 1):
            before = (int(self.views_in.sum()), int(self.points_in.sum()))
            self.place_points(~self.points_in)
            open_views = ~self.views_in
            if open_views.any():
                counts = (self.seen & self.points_in).sum(axis=1) * open_views
                # Views with the most placed points first: they add points for the others.
                self.place_views(counts >= max(0.7 * counts.max(), VIEW_POINTS_MIN))
            self.sigma = self._scale()
            if before == (int(self.views_in.sum()), int(self.points_in.sum())):
                return
            self.place_points(self.points_in.copy())
            self.place_views(self.views_in.copy())

    def result(self) -> AffineStructure:
        self.sigma = self._scale()
        return AffineStructure(
            self.cameras,
            self.offsets,
            self.points,
            self.views_in,
            self.points_in,
            self.sigma,
            self.relief,
        )


@dataclass(frozen=True, eq=False)
class MetricUpgrade:
    """Metric structure in the frame of the specimen.

    Attributes
    ----------
    rotations
        (views, 3, 3) sem_from_specimen; identity where a view was not placed.
    translations_m
        (views, 3), z = 0.
    points_m
        (points, 3) m.
    condition
        Singular value ratio of the six equations: below about 1e-3 the relief is hardly determined.
    orthonormality
        RMS departure of the upgraded camera rows from orthonormal ones, dimensionless.
    positive
        Whether the linear solution was positive definite; if not, it was made so and refined.
    """

    rotations: Array
    translations_m: Array
    points_m: Array
    condition: float
    orthonormality: float
    positive: bool


def upgrade_to_metric(affine: AffineStructure) -> MetricUpgrade:
    """Upgrade an affine structure to a metric one.

    Raises
    ------
    StructureError
        If fewer than three views are placed, or all of them look from one direction.
    """
    placed = affine.views_placed
    cameras = affine.cameras[placed]
    if len(cameras) < 3:
        raise StructureError(
            counted(len(cameras), "view"),
            expected="at least 3, since two leave the relief undetermined",
        )
    # Whiten the points, so that Q is near a multiple of the identity and its condition means
    # something.
    spread = np.linalg.cholesky(np.cov(affine.points[affine.points_placed].T))
    scaled = cameras @ spread
    unit = float(np.sqrt(np.mean(scaled**2)))
    scaled = scaled / unit
    rows, right = _form_equations(scaled, 1.0 / unit**2)
    solution, _, rank, values = np.linalg.lstsq(rows, right, rcond=None)
    condition = float(values[-1] / values[0])
    if rank < 6 or condition < 1e-7:
        raise StructureError(
            f"{counted(len(cameras), 'view')} from nearly one direction",
            expected="views that are rotated about an axis across the beam",
        )
    q = np.zeros((3, 3))
    for value, (i, j) in zip(solution, _PAIRS, strict=True):
        q[i, j] = q[j, i] = value
    smallest = float(np.linalg.eigvalsh(q)[0])
    positive = smallest > 0.0
    root = np.asarray(np.linalg.cholesky(_make_positive(q)), dtype=np.float64)
    root = _refine_root(scaled, root, 1.0 / unit)
    metric = scaled @ root * unit
    points = affine.points @ np.linalg.inv(spread @ root).T
    rotations = np.broadcast_to(np.eye(3), (len(placed), 3, 3)).copy()
    rotations[placed] = _find_nearest_rotations(metric)
    error = metric @ np.swapaxes(metric, 1, 2) - np.eye(2)
    translations = np.zeros((len(placed), 3))
    translations[:, :2] = affine.offsets_m
    return MetricUpgrade(
        *_turn_to_middle_view(rotations, translations, points, placed),
        condition,
        float(np.sqrt(np.mean(error**2))),
        positive,
    )


def mirror_structure(rotations: Array, points_m: Array) -> tuple[Array, Array]:
    """Return the other structure with the same projections: (views, 3, 3) and (points, 3)."""
    return _MIRROR @ rotations @ _MIRROR, points_m @ _MIRROR


def _form_equations(cameras: Array, size: float) -> tuple[Array, Array]:
    """Form rows and right side of ``M Q M^T = size * I`` in the six entries of Q."""
    i, j = cameras[:, 0], cameras[:, 1]

    def row(a: Array, b: Array) -> Array:
        terms = [a[:, p] * b[:, q] + (a[:, q] * b[:, p] if p != q else 0.0) for p, q in _PAIRS]
        return np.stack(terms, axis=1)

    rows = np.concatenate([row(i, i), row(j, j), row(i, j)])
    ones = np.ones(len(cameras))
    return rows, np.concatenate([ones, ones, 0.0 * ones]) * size


def _make_positive(q: Array) -> Array:
    values, vectors = np.linalg.eigh(q)
    values = np.maximum(values, 1e-3 * values[-1])
    return np.asarray((vectors * values) @ vectors.T, dtype=np.float64)


def _refine_root(cameras: Array, root: Array, size: float) -> Array:
    """Refine the root of Q so that the rows are orthonormal in the least-squares sense."""
    lower = np.tril_indices(3)

    def error(values: Array) -> Array:
        a = np.zeros((3, 3))
        a[lower] = values
        rows = cameras @ a
        gram = rows @ np.swapaxes(rows, 1, 2) / size**2 - np.eye(2)
        return np.concatenate([gram[:, 0, 0], gram[:, 1, 1], np.sqrt(2.0) * gram[:, 0, 1]])

    found = least_squares(error, root[lower], method="lm", max_nfev=400)
    out = np.zeros((3, 3))
    out[lower] = found.x
    return out


def _find_nearest_rotations(rows: Array) -> Array:
    """Find the nearest rotations (n, 3, 3) to camera rows (n, 2, 3)."""
    u, _, vt = np.linalg.svd(rows, full_matrices=False)
    two = u @ vt
    return np.concatenate([two, np.cross(two[:, 0], two[:, 1])[:, None]], axis=1)


def _turn_to_middle_view(
    rotations: Array, translations: Array, points: Array, placed: Mask
) -> tuple[Array, Array, Array]:
    """Express the structure in the axes of the middle placed view, so that z is its depth."""
    index = np.flatnonzero(placed)
    first = rotations[index[len(index) // 2]]
    return rotations @ first.T, translations, points @ first.T
