"""Maps of raw positions, interpolated from a few exact values.

A map is evaluated exactly at Chebyshev nodes only and interpolated by polynomials in x and y
(Trefethen 2019, doi:10.1137/1.9781611975949), in bands of rows: a small matrix product per band, of
which only the values at the nodes depend on the frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from semcal_ros.core.arrays import Array, Array32
from semcal_ros.core.caches import LruCache
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.rectification.raw_positions import RasterDrift, raw_from_output

__all__ = ["RawMap", "SmoothMaps"]

# Test points along each axis, which lie where none of the degrees has a node.
_TESTS, _TEST_OFFSET = 9, 0.37
# The last ones are for residual fields, whose splines are less smooth than the distortion.
_DEGREES = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96)
# The promise is 0.002 px; between the test points the maps may differ by more.
_MAX_MAP_ERROR_PX = 0.001
# Sizes of images times degrees for which the matrices are kept; one stream needs one or two.
_MAX_KEPT = 16
# A raw position outside every frame, for output pixels without one: they come out as 0.
_OUTSIDE_PX = -1e4


@dataclass(frozen=True)
class _Interpolant:
    """Polynomial interpolation from a lattice of nodes to the pixels of an image and to a few test
    points.

    Attributes
    ----------
    points_xy
        (nodes^2 + tests^2, 2) nodes, then test points, row by row.
    nodes
        Number of nodes along each axis.
    rows
        (h, nodes + 2): node rows to pixel rows; then 1 and the row index, by which the interpolated
        departure becomes a position in the same product.
    cols
        (nodes, w): node columns to pixel columns.
    test_rows, test_cols
        (tests, nodes) and (nodes, tests): to the test points.
    """

    points_xy: Array
    nodes: int
    rows: Array32
    cols: Array32
    test_rows: Array
    test_cols: Array


def _make_basis(n_pixels: int, degree: int, at: Array) -> tuple[Array, Array]:
    """Node positions in px, and the (n_at, degree + 1) matrix that interpolates node values
    (barycentric formula).
    """
    k = np.arange(degree + 1)
    half = 0.5 * max(n_pixels - 1, 1)
    nodes = half * (1.0 - np.cos(np.pi * k / degree))
    weights = np.where(k % 2 == 0, 1.0, -1.0)
    weights[[0, -1]] *= 0.5
    difference = at[:, None] - nodes[None, :]
    hit = np.abs(difference) < 1e-9
    terms = weights / np.where(hit, 1.0, difference)
    matrix = terms / terms.sum(axis=1, keepdims=True)
    exact = hit.any(axis=1)
    matrix[exact] = hit[exact]
    return nodes, matrix


@lru_cache(maxsize=_MAX_KEPT)
def _make_interpolant(size: tuple[int, int], degree: int) -> _Interpolant:
    """Matrices for one size of image and one degree."""
    tests, bases = [], []
    for n_pixels in size:
        # Denser at the edges, as the nodes are and as the beam settles at the start of a line.
        angles = np.pi * (np.arange(_TESTS) + _TEST_OFFSET) / _TESTS
        test = 0.5 * (n_pixels - 1) * (1.0 - np.cos(angles))
        tests.append(test)
        nodes, at_pixels = _make_basis(n_pixels, degree, np.arange(n_pixels, dtype=np.float64))
        bases.append((nodes, at_pixels, _make_basis(n_pixels, degree, test)[1]))
    lattices = [np.meshgrid(bases[0][0], bases[1][0]), np.meshgrid(*tests)]
    points = [np.stack([x.ravel(), y.ravel()], axis=1) for x, y in lattices]
    height = size[1]
    rows = np.column_stack([bases[1][1], np.ones(height), np.arange(height)])
    return _Interpolant(
        # One axis after the other in memory, as they are worked on.
        points_xy=np.asfortranarray(np.vstack(points)),
        nodes=degree + 1,
        rows=rows.astype(np.float32),
        cols=np.ascontiguousarray(bases[0][1].T, dtype=np.float32),
        test_rows=bases[1][2],
        test_cols=np.ascontiguousarray(bases[0][2].T),
    )


@dataclass(frozen=True)
class RawMap:
    """Raw positions of all output pixels of one frame, computed in bands of rows.

    Attributes
    ----------
    size
        (width, height), px.
    """

    size: tuple[int, int]
    _rows: Array32 | None
    _columns: Array32 | None
    _exact: tuple[ScanCamera | None, RasterDrift | None, ScanTiming | None]

    def band(self, top: int, bottom: int, out: Array32) -> None:
        """Write raw x and raw y of the rows ``top`` to ``bottom`` side by side: (rows, 2 w)."""
        if self._rows is not None and self._columns is not None:
            np.matmul(self._rows[top:bottom], self._columns, out=out)
            return
        width = self.size[0]
        x, y = np.meshgrid(np.arange(width), np.arange(top, bottom))
        xy = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
        raw = raw_from_output(xy, self.size, *self._exact)
        raw[~np.all(np.isfinite(raw), axis=1)] = _OUTSIDE_PX
        out[:, :width] = raw[:, 0].reshape(x.shape)
        out[:, width:] = raw[:, 1].reshape(x.shape)


class SmoothMaps:
    """Makes :class:`RawMap`, keeping what does not change from frame to frame.

    The degree of the polynomials is the lowest whose map agrees with the exact one to 0.001 px at
    81 points between the nodes of every single frame. A map that no polynomial follows, or that
    has holes, is computed exactly at every pixel, which is slow.
    """

    def __init__(self) -> None:
        self._degrees: LruCache[tuple[int, int, bool], int] = LruCache(_MAX_KEPT)

    def make_map(
        self,
        size: tuple[int, int],
        camera: ScanCamera | None,
        drift: RasterDrift | None,
        timing: ScanTiming | None,
    ) -> RawMap:
        """The map of one frame; the arguments are those of
        :func:`~semcal_ros.core.rectification.raw_positions.raw_from_output`.
        """
        exact = camera, drift, timing
        interpolated = self._sample_departure(size, *exact)
        if interpolated is None:
            return RawMap(size, None, None, exact)
        interpolant, departure = interpolated
        width, nodes = size[0], interpolant.nodes
        # What single precision has to carry through the product is the small departure from the
        # identity; the identity comes last, when nothing is added any more.
        columns = np.zeros((nodes + 2, 2 * width), dtype=np.float32)
        columns[:nodes, :width] = departure[0].astype(np.float32) @ interpolant.cols
        columns[:nodes, width:] = departure[1].astype(np.float32) @ interpolant.cols
        columns[nodes, :width] = np.arange(width)
        columns[nodes + 1, width:] = 1.0
        return RawMap(size, interpolant.rows, columns, exact)

    def _sample_departure(
        self,
        size: tuple[int, int],
        camera: ScanCamera | None,
        drift: RasterDrift | None,
        timing: ScanTiming | None,
    ) -> tuple[_Interpolant, Array] | None:
        """The map minus the identity, (2, nodes, nodes) of x and y, at the nodes of the lowest
        degree that is accurate, or None where none is.
        """
        # Neighbouring magnifications need the same degree.
        key = (*size, camera is not None and camera.residual is not None)
        for degree in [d for d in _DEGREES if d >= self._degrees.get(key, 0)]:
            interpolant = _make_interpolant(size, degree)
            points, nodes = interpolant.points_xy, interpolant.nodes
            departure = (raw_from_output(points, size, camera, drift, timing) - points).T
            at_nodes = departure[:, : nodes * nodes].reshape(2, nodes, nodes)
            truth = departure[:, nodes * nodes :].reshape(2, _TESTS, _TESTS)
            error = interpolant.test_rows @ at_nodes @ interpolant.test_cols - truth
            largest = float(np.max(np.abs(error)))
            if not np.isfinite(largest):
                return None
            if largest <= _MAX_MAP_ERROR_PX:
                self._degrees.put(key, degree)
                return interpolant, at_nodes
        return None
