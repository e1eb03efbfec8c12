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

"""Maps of raw positions, interpolated from a few exact values.

A map is evaluated exactly at Chebyshev nodes only and interpolated by polynomials in x and y
(Trefethen 2019, doi:10.1137/1.9781611975949), in bands of rows: a small matrix product per band, of
which only the values at the nodes depend on the frame. What is less smooth is added from tables: the distortion of
the scan along each axis, and the residual field of a camera.

:meth:`~semcal_ros.core.camera.residual_field.FieldSlice.inverse` finds the raw position of a point by Newton's method,
exactly and slowly. In the table of a field, ``e(u)``, raw minus undisplaced position, is the fixed point of
``e(u) = -n G(u + e(u))``, with the field ``n G`` tabulated at the pixels: a few look-ups per point, since the error
shrinks by the slope of the field, some hundredths, in each. The table is interpolated linearly at positions that OpenCV
rounds to 1/32 of its step, so that ``e`` is wrong by up to 1/64 of its change from step to step. Whoever uses a table
checks what comes out.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import cv2
import numpy as np

from semcal_ros.core.arrays import Array, Array32, Indices
from semcal_ros.core.caches import LruCache
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.rectification.raw_positions import (
    PixelDrift,
    RasterDrift,
    camera_key,
    deflection_from_output,
    raw_from_output,
)
from semcal_ros.core.rectification.thresholds import (
    COMPARED_FACTOR,
    COMPARED_ROWS,
    DEFLECTION_ERROR_MAX_PX,
    FIELD_BEYOND_STEP,
    FIELD_COLUMN_PX,
    FIELD_CONVERGED_PX,
    FIELD_DEGREES,
    FIELD_DISPLACEMENT_MAX_PX,
    FIELD_ROW_STEP_AT_512,
    FIELD_ROWS_MAX,
    FIELD_STEPS_MAX,
    FIELD_TABLES_KEPT,
    FIELD_TESTS,
    FIELD_WHOLE_PART,
    MAP_DEGREES,
    MAP_ERROR_MAX_PX,
    MATRICES_KEPT,
    MOVING_ERROR_MAX_PX,
    OUTSIDE_PX,
    SCAN_BEYOND,
    SCAN_DEGREES,
    SCAN_STEP_PX,
    SCAN_TESTS,
    SETTLED_AFTER,
    SLOW_RESPONSE_PX,
    TEST_OFFSET,
    TESTED_KEPT,
    TESTED_NEARBY,
    TESTS_BETWEEN_NODES,
    TESTS_PER_AXIS,
)

# Columns and rows are in one map.
_NO_MAP = np.empty(0, np.float32)

# The first order is not tested where it is wrong by no more; the rest must then be so much better.
_MAX_RESPONSE_ERROR_PX = MOVING_ERROR_MAX_PX - MAP_ERROR_MAX_PX
_IDENTITY = np.eye(2, dtype=np.float32)


@dataclass(frozen=True)
class FieldTable:
    """Minus the displacement by a residual field, of an image and of a margin around it.

    Attributes
    ----------
    back_px
        (rows, columns, 2) of the table, by x and by y.
    margin_px
        (left, top) pixels from the first column and row of the table to those of the image.
    step_px
        Distance between columns and between rows.
    slope
        A bound of the larger of the slopes of both components, along x and y together, px per px.
    strips
        (n, 1) rows of the table by which each row of look-ups lies farther down in it, where it holds only what is
        near these; else (1, 1) zero.
    """

    back_px: Array32
    margin_px: tuple[float, float]
    step_px: tuple[float, float]
    slope: float
    strips: Array32

    def invert(self, column: Array32, row: Array32, start: Array32 | None = None) -> Array32 | None:
        """Return raw minus undisplaced positions, (n, k, 2), at undisplaced columns and rows, (n, k) each, or None
        where that does not settle. The nearer ``start`` is to them, the sooner they are found.
        """
        count, width = column.shape
        at = np.empty((count, width, 2), dtype=np.float32)
        for axis, values in enumerate((column, row)):
            at[..., axis] = values
            at[..., axis] += self.margin_px[axis]
        # A row at a time: numpy is slow along an axis of two.
        per_px = np.tile([1.0 / step for step in self.step_px], width).astype(np.float32)
        at.reshape(count, -1)[...] *= per_px
        at[..., 1] += self.strips
        # Each step leaves an error of at most the slope times that before it; a steeper field need not settle.
        settled = FIELD_CONVERGED_PX * max(1.0 / max(self.slope, 1e-3) - 1.0, 1.0)
        found = self._look_up(at) if start is None else start
        for _ in range(FIELD_STEPS_MAX):
            moved = found.reshape(count, -1) * per_px
            moved += at.reshape(count, -1)
            before, found = found, self._look_up(moved.reshape(at.shape))
            if cv2.norm(found, before, cv2.NORM_INF) <= settled:
                return found
        return None

    def _look_up(self, at: Array32) -> Array32:
        border = cv2.BORDER_REPLICATE
        found = cv2.remap(self.back_px, at, _NO_MAP, cv2.INTER_LINEAR, borderMode=border)
        return np.asarray(found, dtype=np.float32)


def tabulate_field(
    camera: ScanCamera,
    size: tuple[int, int],
    rows_beyond: float = 0.0,
    near: Array32 | None = None,
) -> FieldTable | None:
    """Tabulate the residual field of a camera; None where it is too large.

    Parameters
    ----------
    camera
        A camera with a residual field.
    size
        (width, height) of its image.
    rows_beyond
        Rows above and below the image up to which the table goes on, px.
    near
        (n, k) rows at which the table will be looked up, once: it then holds little else.
    """
    field, norm = camera.residual, camera.norm_px
    assert field is not None
    # The basis functions of a spline sum to 1: no displacement is larger than the largest coefficient.
    largest = norm * float(np.max(np.abs(field.coefficients)))
    if not largest <= FIELD_DISPLACEMENT_MAX_PX:
        return None
    ends = float(field.knots_x[-1]), float(field.knots_y[-1])
    # Up to where the field ends, and becomes constant.
    margins = [
        # Whole, so that neighbouring magnifications have the same.
        1.0 + np.ceil(largest + max(norm * end - 0.5 * count, 0.0))
        for end, count in zip(ends, size, strict=True)
    ]
    margins[1] += np.ceil(rows_beyond)
    coarsest = FIELD_ROW_STEP_AT_512 * math.sqrt(size[1] / 512.0)
    steps = FIELD_COLUMN_PX, max(min(size[1] / FIELD_ROWS_MAX, coarsest), 1.0)
    columns, rows = _lattice(size, (margins[0], margins[1]), steps)
    back_px = replace(field, coefficients=-norm * field.coefficients)
    picked, strips = None, np.zeros((1, 1), np.float32)
    if near is not None:
        # What the field displaces stays that near; where it goes on in a straight line, the slope of a cubic spline
        # is at most six times its largest coefficient per step of its knots.
        knots = norm * field.knots_y[[3, 4, -5, -4]]
        reach = largest * (1.0 + 6.0 * rows_beyond / min(knots[1] - knots[0], knots[3] - knots[2]))
        first = np.floor((near.min(axis=1) - reach + margins[1]) / steps[1]).astype(np.intp) - 1
        last = np.ceil((near.max(axis=1) + reach + margins[1]) / steps[1]).astype(np.intp) + 1
        tall = int(np.max(last - first)) + 1
        if tall * len(first) < FIELD_WHOLE_PART * len(rows):
            picked = np.clip(first[:, None] + np.arange(tall), 0, len(rows) - 1).ravel()
            strips = (np.arange(len(first)) * tall - first)[:, None].astype(np.float32)
    table = back_px.on_lattice(columns / norm, rows / norm, picked)
    return FieldTable(table, (margins[0], margins[1]), steps, field.largest_slope, strips)


@lru_cache(maxsize=4)
def _lattice(
    size: tuple[int, int], margins: tuple[float, float], steps: tuple[float, float]
) -> tuple[Array, Array]:
    """Columns and rows of a table, px from the middle of the image."""
    columns, rows = (
        np.arange(int((count + 2.0 * margin) / step) + 1, dtype=np.float64) * step
        - (margin + 0.5 * (count - 1))
        for count, margin, step in zip(size, margins, steps, strict=True)
    )
    return columns, rows


@dataclass(frozen=True)
class _ScanTables:
    """The distortion of a scan at many places.

    Attributes
    ----------
    by_axis
        For each axis that has any, deflections in rising order and raw minus deflected pixels.
    begin_px
        Deflection along the lines at their beginning.
    """

    by_axis: dict[int, tuple[Array, Array]]
    begin_px: float

    def raw(self, deflection: Array) -> Array:
        """Return the raw pixels (n, 2) at which the beam should be at ``deflection`` (n, 2), px."""
        raw = deflection.copy()
        for axis, table in self.by_axis.items():
            raw[:, axis] += np.interp(deflection[:, axis], *table)
        return raw


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


@lru_cache(maxsize=MATRICES_KEPT)
def _make_interpolant(size: tuple[int, int], degree: int) -> _Interpolant:
    """Matrices for one size of image and one degree."""
    tests, bases = [], []
    for n_pixels in size:
        # Denser at the edges, as the nodes are and as the beam settles at the start of a line.
        angles = np.pi * (np.arange(TESTS_PER_AXIS) + TEST_OFFSET) / TESTS_PER_AXIS
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
class _TestedMap:
    """A map with a residual field that was compared with exact positions.

    Attributes
    ----------
    size, degree
        (width, height) of the image, and degree of the field down the image.
    camera
        The camera.
    raw
        (k, 2, 3) raw minus output columns and rows at the nodes, in the first, the middle and the last column.
    undisplaced
        (k,) undisplaced rows at the nodes, in the middle column.
    error_px
        The largest difference that was found.
    """

    size: tuple[int, int]
    degree: int
    camera: ScanCamera
    raw: Array32
    undisplaced: Array32
    error_px: float

    def covers(self, other: _TestedMap) -> bool:
        """Whether a map like the other one, whose ``error_px`` is what it may have, needs no test of its own.

        It must be much the same, and the error that its field adds to the one that was measured, which is linear
        in the difference of the fields, small.
        """
        if (self.size, self.degree, self.raw.shape) != (other.size, other.degree, other.raw.shape):
            return False
        middle = len(self.raw) // 2
        for axis, nearby in enumerate(TESTED_NEARBY):
            # Most of the others are told by one pixel.
            differ = abs(float(self.raw[middle, axis, 1]) - float(other.raw[middle, axis, 1]))
            if not differ <= nearby * self.size[axis]:
                return False
        field_here, field = self.camera.residual, other.camera.residual
        assert field_here is not None
        assert field is not None
        # The slices of one field share their knots.
        if field.knots_y is not field_here.knots_y or field.knots_x is not field_here.knots_x:
            return False
        nearby_px = np.multiply(TESTED_NEARBY, self.size)[:, None]
        if not (np.abs(self.raw - other.raw) <= nearby_px).all():
            return False
        added_px = 0.0
        if field.coefficients is not field_here.coefficients:
            norm_px = self.camera.norm_px
            changed = other.camera.norm_px * field.coefficients - norm_px * field_here.coefficients
            # A spline lies between its coefficients: none of the columns has a larger error.
            left = self._remainders @ changed.reshape(len(changed), -1)
            added_px = COMPARED_FACTOR * _largest(left)
        return self.error_px + added_px <= other.error_px

    @cached_property
    def _remainders(self) -> Array:
        """(n, ny) what interpolation leaves of each basis function of the field down the image, at some rows."""
        assert self.camera.residual is not None
        height, nodes = self.size[1], len(self.undisplaced)
        angles = np.pi * (np.arange(COMPARED_ROWS) + 0.5) / COMPARED_ROWS
        rows = 0.5 * (height - 1) * (1.0 - np.cos(angles))
        matrix = _make_basis(height, nodes - 1, rows)[1]
        at = np.concatenate([self.undisplaced, matrix @ self.undisplaced])
        basis = self.camera.residual.basis_down((at - 0.5 * (height - 1)) / self.camera.norm_px)
        return np.asarray(basis[nodes:] - matrix @ basis[:nodes])


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

    @property
    def is_interpolated(self) -> bool:
        """Whether the positions are interpolated, and not computed at every pixel, which is slow."""
        return self._rows is not None

    def band(self, top: int, bottom: int, out: Array32) -> None:
        """Write raw x and raw y of the rows ``top`` to ``bottom`` side by side: (rows, 2 w)."""
        if self._rows is not None and self._columns is not None:
            np.matmul(self._rows[top:bottom], self._columns, out=out)
            return
        width = self.size[0]
        x, y = np.meshgrid(np.arange(width), np.arange(top, bottom))
        xy = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
        raw = raw_from_output(xy, self.size, *self._exact)
        raw[~np.all(np.isfinite(raw), axis=1)] = OUTSIDE_PX
        out[:, :width] = raw[:, 0].reshape(x.shape)
        out[:, width:] = raw[:, 1].reshape(x.shape)


class SmoothMaps:
    """Makes :class:`RawMap`, keeping what does not change from frame to frame.

    The degree of the polynomials is the lowest whose map agrees with the exact one to 0.001 px at
    81 points between the nodes of every single frame. A residual field is added from a table, as
    long as some 300 pixels agree to 0.001 px, or to 0.003 px where the specimen drifts fast. A map
    that neither follows, or that has holes, is computed exactly at every pixel, which is slow.
    """

    def __init__(self) -> None:
        self._degrees: LruCache[tuple[int, int, bool, bool], int] = LruCache(MATRICES_KEPT)
        self._tables: LruCache[tuple[object, ...], FieldTable | None] = LruCache(FIELD_TABLES_KEPT)
        self._seen: tuple[object, float] | None = None
        # Coils and settling hardly depend on the magnification.
        self._scan_tables: LruCache[object, _ScanTables | None] = LruCache(MATRICES_KEPT)
        self._scan_degrees: LruCache[tuple[int, int], int] = LruCache(MATRICES_KEPT)
        self._field_degrees: LruCache[tuple[int, int], int] = LruCache(MATRICES_KEPT)
        self._tested: deque[_TestedMap] = deque(maxlen=TESTED_KEPT)
        # Of the frame before: where to begin.
        self._departure: Array32 | None = None

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
        if camera is not None and camera.residual is not None:
            found = self._map_with_field(size, camera, drift, timing)
            if found is not None:
                return found
        return self._map_without_field(size, camera, drift, timing)

    def _map_without_field(
        self,
        size: tuple[int, int],
        camera: ScanCamera | None,
        drift: RasterDrift | None,
        timing: ScanTiming | None,
    ) -> RawMap:
        """The map by polynomials, with the distortion of the scan from tables where there is any.

        With a residual field, it is by polynomials alone.
        """
        if camera is not None and camera.distorts_scan and camera.residual is None:
            found = self._map_with_scan(size, camera, drift, timing)
            if found is not None:
                return found
        return self._map_by_polynomials(size, camera, drift, timing)

    def _map_with_scan(
        self,
        size: tuple[int, int],
        camera: ScanCamera,
        drift: RasterDrift | None,
        timing: ScanTiming | None,
    ) -> RawMap | None:
        """The map of where the beam should be, and from there to where it is by tables; None where there are none.

        At the nodes the drift is that of the time at which the raw pixel is scanned.
        """
        width, height = size
        key = camera.scan_key
        if (tables := self._scan_tables.get((size, key), None)) is None:
            tables = _tabulate_scan(size, camera)
            self._scan_tables.put((size, key), tables)
        if tables is None:
            return None
        smooth = self._map_by_polynomials(size, camera, drift, timing, tables)
        if smooth._columns is None:
            return None
        begin_px = tables.begin_px
        smooth_degree = len(smooth._columns) - 3
        for degree in [d for d in SCAN_DEGREES if d >= self._scan_degrees.get(size, 0)]:
            rows = _make_field_rows(height, smooth_degree, max(degree, smooth_degree))
            columns = np.empty((len(rows.places) + 2, 2 * width), dtype=np.float32)
            columns[-2:] = smooth._columns[-2:]
            np.matmul(rows.at_nodes, smooth._columns[:-2], out=columns[:-2])
            start, apart = rows.places[:-1], np.diff(rows.places, axis=0)
            between = np.unique((start + apart * TESTS_BETWEEN_NODES).astype(np.intp))
            matrix = rows.at_pixels[between, :-2].astype(np.float64)
            identity = np.arange(width, dtype=np.float64), rows.places.astype(np.float64)
            tested = _tested_columns(columns[:-2, :width] + identity[0] - begin_px)
            errors_px = []
            for axis, table in tables.by_axis.items():
                part = columns[:-2, axis * width : (axis + 1) * width]
                target = part + identity[axis]
                added = np.interp(target, *table)
                goal = matrix @ target[:, tested]
                truth = np.interp(goal, *table)
                # What lies outside of the raw frame comes out black anyway.
                scanned = (goal + truth > -1.0) & (goal + truth < size[axis])
                missed = np.abs(matrix @ added[:, tested] - truth)
                errors_px.append(np.max(missed[scanned], initial=0.0))
                part += added
            if max(errors_px) <= MAP_ERROR_MAX_PX:
                self._scan_degrees.put(size, degree)
                return RawMap(size, rows.at_pixels, columns, (camera, drift, timing))
        return None

    def _map_with_field(
        self,
        size: tuple[int, int],
        camera: ScanCamera,
        drift: RasterDrift | None,
        timing: ScanTiming | None,
    ) -> RawMap | None:
        """The map without the field, and the field from a table; None where that is not accurate."""
        width, height = size
        plain = camera.parametric
        moving = None if drift is None else PixelDrift(size, plain, drift, timing)
        smooth = self._map_without_field(size, plain, drift, timing)
        if smooth._columns is None:
            return None
        step = FIELD_BEYOND_STEP * height
        # The polynomials have nodes in the first and the last row.
        outside = smooth._columns[[0, -3], width:]
        farthest = max(-float(outside[0].min()), float(outside[1].max()), 0.0)
        beyond = step * min(np.ceil(farthest / step), 1.0 / FIELD_BEYOND_STEP)
        key = camera_key(size, camera)
        table = self._tables.get((key, beyond), None)
        if table is None and self._seen == (key, beyond):
            # A camera that is seen twice is likely to be seen again.
            table = tabulate_field(camera, size, beyond)
            self._tables.put((key, beyond), table)
        self._seen = key, beyond
        response, spread = _response(size, plain, moving, timing)
        smooth_degree = len(smooth._columns) - 3
        for degree in [d for d in FIELD_DEGREES if d >= self._field_degrees.get(size, 0)]:
            # The nodes of the field carry the rest, too.
            rows = _make_field_rows(height, smooth_degree, max(degree, smooth_degree))
            columns = np.empty((len(rows.places) + 2, 2 * width), dtype=np.float32)
            columns[-2:] = smooth._columns[-2:]
            np.matmul(rows.at_nodes, smooth._columns[:-2], out=columns[:-2])
            column = columns[:-2, :width] + columns[-2, :width]
            row = columns[:-2, width:] + rows.places
            used = tabulate_field(camera, size, beyond, row) if table is None else table
            if used is None:
                return None
            start = self._departure
            if start is not None and start.shape != (*column.shape, 2):
                start = None
            self._departure = departure = used.invert(column, row, start)
            if departure is None:
                return None
            added = departure if response is None else cv2.transform(departure, response)
            columns[:-2, :width] += added[..., 0]
            columns[:-2, width:] += added[..., 1]
            found = RawMap(size, rows.at_pixels, columns, (camera, drift, timing))
            largest_px = cv2.norm(departure, cv2.NORM_INF)
            uncertain_px = spread * largest_px
            is_slow = (
                response is None or _largest(response - _IDENTITY) * largest_px <= SLOW_RESPONSE_PX
            )
            limit_px = MAP_ERROR_MAX_PX if is_slow else MOVING_ERROR_MAX_PX
            is_known = is_slow or uncertain_px <= _MAX_RESPONSE_ERROR_PX
            made = _describe(
                found, degree, row, limit_px - (0.0 if is_slow or not is_known else uncertain_px)
            )
            if is_known and any(test.covers(made) for test in self._tested):
                return found
            error_px = _measure_error(found, plain, departure, None if is_known else moving)
            if error_px <= made.error_px:
                self._field_degrees.put(size, degree)
                if is_known:
                    self._tested.appendleft(replace(made, error_px=error_px))
                return found
        return None

    def _map_by_polynomials(
        self,
        size: tuple[int, int],
        camera: ScanCamera | None,
        drift: RasterDrift | None,
        timing: ScanTiming | None,
        tables: _ScanTables | None = None,
    ) -> RawMap:
        """The map by polynomials alone, or the exact one where they do not follow it.

        With ``tables`` of the distortion of the scan it is to where the beam should be.
        """
        exact = camera, drift, timing
        interpolated = self._sample_departure(size, *exact, tables)
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
        tables: _ScanTables | None,
    ) -> tuple[_Interpolant, Array] | None:
        """The map minus the identity, (2, nodes, nodes) of x and y, at the nodes of the lowest
        degree that is accurate, or None where none is.
        """
        # Neighbouring magnifications need the same degree.
        key = (*size, camera is not None and camera.residual is not None, tables is not None)
        limit_px = MAP_ERROR_MAX_PX if tables is None else DEFLECTION_ERROR_MAX_PX
        for degree in [d for d in MAP_DEGREES if d >= self._degrees.get(key, 0)]:
            interpolant = _make_interpolant(size, degree)
            points, nodes = interpolant.points_xy, interpolant.nodes
            if tables is None or camera is None:
                reached = raw_from_output(points, size, camera, drift, timing)
            else:
                reached = deflection_from_output(points, size, camera, drift, timing, tables.raw)
            departure = (reached - points).T
            at_nodes = departure[:, : nodes * nodes].reshape(2, nodes, nodes)
            truth = departure[:, nodes * nodes :].reshape(2, TESTS_PER_AXIS, TESTS_PER_AXIS)
            error = interpolant.test_rows @ at_nodes @ interpolant.test_cols - truth
            largest = float(np.max(np.abs(error)))
            if not np.isfinite(largest):
                return None
            if largest <= limit_px:
                self._degrees.put(key, degree)
                return interpolant, at_nodes
        return None


def _response(
    size: tuple[int, int],
    plain: ScanCamera,
    moving: PixelDrift | None,
    timing: ScanTiming | None,
) -> tuple[Array32 | None, float]:
    """The (2, 2) raw shift per departure of the field, to first order in the drift per row, in the middle of the image
    and of the frame, None for the identity; and by how much it differs in the corners at most.
    """
    if moving is None or timing is None or moving.is_still:
        return None, 0.0
    width, height = size
    right, bottom = width - 1.0, height - 1.0
    places = np.array(
        [[0.5 * right, 0.5 * bottom], [0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]]
    )
    # What lies there at the time at which its row is scanned, and the next.
    scanned = np.vstack([places, places + [0.0, 1.0]])
    raw = plain.raw_from_rect(moving.moved(np.vstack([places, places]), scanned))
    per_row = raw[5:] - raw[:5]
    offset_s = timing.pixel_offset_s(
        np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), height, width
    )
    rows_per_px = (offset_s[1:] - offset_s[0]) / (offset_s[2] - offset_s[0])
    # The inverse of the identity minus the outer product of the two (Sherman and Morrison).
    growth = per_row / (1.0 - per_row @ rows_per_px)[:, None]
    responses = growth[:, :, None] * rows_per_px
    spread = np.abs(responses[1:] - responses[0]).sum(axis=2)
    return (np.eye(2) + responses[0]).astype(np.float32), float(np.max(spread))


def _tabulate_scan(size: tuple[int, int], camera: ScanCamera) -> _ScanTables | None:
    """Return the tables of a scan; None where the beam stands still or goes back."""
    count = int(np.ceil(max(size) / (SCAN_STEP_PX * np.sqrt(size[0] / 512.0)))) + 1
    places = np.linspace(-0.5, 0.5, count)
    places = np.concatenate([[-SCAN_BEYOND], places, [SCAN_BEYOND]])
    # The picture may be a part of the raster.
    raster = camera.raster
    extent = np.maximum(size, 2.0 * raster.norm_px * np.array([1.0, raster.ratio]))
    raw = raster.middle_px + places[:, None] * extent
    deflected = camera.deflect(raw)
    if not np.all(np.diff(deflected, axis=0) > 0.0):
        return None
    departure = raw - deflected
    by_axis = {
        axis: (deflected[:, axis].copy(), departure[:, axis].copy())
        for axis in (0, 1)
        if np.any(departure[:, axis])
    }
    return _ScanTables(by_axis, float(camera.deflect([[-0.5, -0.5]])[0, 0]))


def _tested_columns(since: Array) -> Indices:
    """Columns of an image at which the distortion of the scan is tested, whose deflections are ``since`` (nodes, w) px
    from that at the beginning of a line.
    """
    width = since.shape[1]
    begins = [int(np.argmin(np.abs(part))) for part in (since.max(axis=0), since.min(axis=0))]
    first, last = max(min(begins) - 1, 0), min(max(begins) + 1, width - 1)
    settled = min(last + SETTLED_AFTER * width, width - 1.0)
    parts = (first, last), (last, settled), (0, width - 1)
    picked = [np.linspace(a, b, n) for (a, b), n in zip(parts, SCAN_TESTS, strict=True)]
    return np.unique(np.concatenate(picked).astype(np.intp))


def _largest(values: Array | Array32) -> float:
    return float(np.max(np.abs(values)))


def _describe(found: RawMap, degree: int, row: Array32, error_px: float) -> _TestedMap:
    """A map whose field has its nodes at the undisplaced rows (k, w), with the error that it may have."""
    width = found.size[0]
    camera = found._exact[0]
    assert camera is not None
    assert found._columns is not None
    picked = [0, width // 2, width - 1, width, width + width // 2, 2 * width - 1]
    raw = found._columns[:-2, picked].reshape(-1, 2, 3)
    return _TestedMap(found.size, degree, camera, raw, row[:, width // 2].copy(), error_px)


def _measure_error(
    found: RawMap, plain: ScanCamera, departure: Array32, moving: PixelDrift | None
) -> float:
    """By how much some pixels of a map with a departure by a field at its nodes miss the equation of the exact
    position, px.

    The test takes no iteration: where the field moves a raw position to is where the drift and the rest of the camera
    put it. Without ``moving``, the first order of the response is not tested.
    """
    width = found.size[0]
    camera = found._exact[0]
    assert camera is not None
    assert found._rows is not None
    assert found._columns is not None
    at = _test_pixels(found.size)
    at = at[0], np.union1d(at[1], _find_frame_edges(found))
    rows, picked = found._rows[at[1]], found._columns[:, np.concatenate([at[0], width + at[0]])]
    raw = (
        (rows @ picked).reshape(-1, 2, len(at[0])).swapaxes(1, 2).reshape(-1, 2).astype(np.float64)
    )
    # What lies outside of the raw frame comes out black anyway.
    scanned = np.all((raw > -1.0) & (raw < np.array(found.size)), axis=1)
    if moving is None:
        at_nodes = departure[:, at[0]].reshape(len(departure), -1)
        undisplaced = raw - (rows[:, :-2] @ at_nodes).reshape(-1, 2)
    else:
        # The response is that of the middle of the image and of the frame.
        x, y = np.meshgrid(*at)
        xy = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
        undisplaced = plain.raw_from_rect(moving.moved(xy, raw))
    residual = camera.without_residual(raw) - undisplaced
    return float(np.max(np.abs(residual[scanned]), initial=0.0))


def _find_frame_edges(found: RawMap) -> Indices:
    """Rows at which the raw frame begins and ends.

    The slope of a field changes suddenly where it ends, and polynomials follow that least well.
    """
    width, height = found.size
    assert found._rows is not None
    assert found._columns is not None
    raw = found._rows @ found._columns[:, [width, width + width // 2, 2 * width - 1]]
    inside = (raw >= 0.0) & (raw <= height - 1.0)
    first, last = inside.argmax(axis=0), height - 1 - inside[::-1].argmax(axis=0)
    return np.concatenate([first, last])[np.tile(inside.any(axis=0), 2)]


@lru_cache(maxsize=MATRICES_KEPT)
def _test_pixels(size: tuple[int, int]) -> tuple[Indices, Indices]:
    """Columns and rows at which a map with a residual field is tested, denser towards the edges."""
    columns, rows = (
        np.unique(
            np.round(0.5 * (n - 1) * (1.0 - np.cos(np.pi * (np.arange(k) + TEST_OFFSET) / k)))
        )
        for n, k in zip(size, FIELD_TESTS, strict=True)
    )
    return columns.astype(np.intp), rows.astype(np.intp)


@dataclass(frozen=True)
class _FieldRows:
    """How the columns of a map, with those of a field among them, become its rows.

    Attributes
    ----------
    places
        (k, 1) rows of the image at which the field is looked up.
    at_nodes
        (k, nodes): columns without those of the field, and without the identity, to these rows.
    at_pixels
        (h, k + 2): these rows and the identity, to the rows of the image.
    """

    places: Array32
    at_nodes: Array32
    at_pixels: Array32


@lru_cache(maxsize=MATRICES_KEPT)
def _make_field_rows(height: int, degree: int, field_degree: int) -> _FieldRows:
    pixels = np.arange(height, dtype=np.float64)
    places, field = _make_basis(height, field_degree, pixels)
    return _FieldRows(
        places[:, None].astype(np.float32),
        _make_basis(height, degree, places)[1].astype(np.float32),
        np.column_stack([field, np.ones(height), pixels]).astype(np.float32),
    )
