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

from dataclasses import dataclass, replace

import cv2
import numpy as np

from semcal_ros.core.arrays import Array32
from semcal_ros.core.camera.scan_camera import ScanCamera

__all__ = ["FieldTable", "tabulate_field"]

# Half a pixel along the lines, where the beam settles. Down the image the knots of the field are a quarter of its
# height apart, so that a step of a few rows does.
_COLUMN_PX = 0.5
_MOST_ROWS = 256
# Change of the last step, px; what is left is smaller by the slope of the field.
_SETTLED_PX = 0.002
_MAX_STEPS = 12
# A larger displacement is none of a microscope, and would make a table much larger than the image.
_LARGEST_PX = 256.0


@dataclass(frozen=True)
class FieldTable:
    """Minus the displacement by a residual field, of an image and of a margin around it.

    Attributes
    ----------
    x_px, y_px
        (rows, columns) each, of the table.
    margin_px
        (left, top) pixels from the first column and row of the table to those of the image.
    step_px
        Distance between columns and between rows.
    """

    x_px: Array32
    y_px: Array32
    margin_px: tuple[float, float]
    step_px: tuple[float, float]

    def invert(self, column: Array32, row: Array32) -> tuple[Array32, Array32] | None:
        """Return raw minus undisplaced columns and rows at undisplaced ones, or None where that does not settle."""
        per_x, per_y = (np.float32(1.0 / step) for step in self.step_px)
        at_x = (column + np.float32(self.margin_px[0])) * per_x
        at_y = (row + np.float32(self.margin_px[1])) * per_y
        x, y = self._look_up(at_x, at_y)
        for _ in range(_MAX_STEPS):
            new = self._look_up(at_x + x * per_x, at_y + y * per_y)
            change = max(float(np.max(np.abs(new[0] - x))), float(np.max(np.abs(new[1] - y))))
            x, y = new
            if change <= _SETTLED_PX:
                return x, y
        return None

    def _look_up(self, column: Array32, row: Array32) -> tuple[Array32, Array32]:
        border = cv2.BORDER_REPLICATE
        x, y = (
            cv2.remap(plane, column, row, cv2.INTER_LINEAR, borderMode=border)
            for plane in (self.x_px, self.y_px)
        )
        return np.asarray(x, dtype=np.float32), np.asarray(y, dtype=np.float32)


def tabulate_field(
    camera: ScanCamera, size: tuple[int, int], rows_beyond: float = 0.0
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
    """
    field, norm = camera.residual, camera.norm_px
    assert field is not None
    # The basis functions of a spline sum to 1: no displacement is larger than the largest coefficient.
    largest = norm * float(np.max(np.abs(field.coefficients)))
    if not largest <= _LARGEST_PX:
        return None
    ends = float(field.knots_x[-1]), float(field.knots_y[-1])
    # Up to where the field ends, and becomes constant.
    margins = [
        # Whole, so that neighbouring magnifications have the same.
        1.0 + np.ceil(largest + max(norm * end - 0.5 * count, 0.0))
        for end, count in zip(ends, size, strict=True)
    ]
    margins[1] += np.ceil(rows_beyond)
    steps = _COLUMN_PX, max(size[1] / _MOST_ROWS, 1.0)
    columns, rows = (
        np.arange(int((count + 2.0 * margin) / step) + 1, dtype=np.float64) * step
        - (margin + 0.5 * (count - 1))
        for count, margin, step in zip(size, margins, steps, strict=True)
    )
    back_px = replace(field, coefficients=-norm * field.coefficients)
    x, y = back_px.on_lattice(columns / norm, rows / norm)
    return FieldTable(x, y, (margins[0], margins[1]), steps)
