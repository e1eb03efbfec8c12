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

"""The inverse of a residual field at many points, for maps of whole images.

:meth:`~semcal_ros.core.camera.residual_field.FieldSlice.inverse` finds the raw position of a point by Newton's method,
exactly and slowly. Here ``e(u)``, raw minus undisplaced position, is the fixed point of ``e(u) = -n G(u + e(u))``, with
the field ``n G`` tabulated at the pixels: a few look-ups per point, since the error shrinks by the slope of the field,
some hundredths, in each.

The table is interpolated linearly at positions that OpenCV rounds to 1/32 of its step, so that ``e`` is wrong by up to
1/64 of its change from step to step. Whoever uses a table checks what comes out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from semcal_ros.core.arrays import Array, Array32
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.rectification.thresholds import (
    FIELD_COLUMN_PX,
    FIELD_CONVERGED_PX,
    FIELD_DISPLACEMENT_MAX_PX,
    FIELD_ROW_STEP_AT_512,
    FIELD_ROWS_MAX,
    FIELD_STEPS_MAX,
    FIELD_WHOLE_PART,
)

# Columns and rows are in one map.
_NO_MAP = np.empty(0, np.float32)


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
