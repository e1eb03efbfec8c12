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

"""What the views of a calibration cover: cells of the image field that have corners, and tilts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array, Indices
from semcal_ros.core.calibration.judge import CalibrationResult

__all__ = [
    "Cells",
    "assign_cells",
    "compute_empty_share",
    "compute_reached_shares",
    "compute_tilts_deg",
    "concatenate_corners",
]


@dataclass(frozen=True)
class Cells:
    """A lattice of nearly square cells over the field, and the cell of every corner."""

    columns: int
    rows: int
    index: Indices
    centres: Array

    @property
    def counts(self) -> Indices:
        """(columns * rows,) number of corners in each cell."""
        return np.bincount(self.index, minlength=self.columns * self.rows)


def compute_empty_share(result: CalibrationResult, across: int = 12) -> float:
    """Compute the share of cells without a corner, with ``across`` cells across the field."""
    counts = assign_cells(result, np.concatenate([v.image_xy for v in result.views]), across).counts
    return float(np.mean(counts == 0))


def assign_cells(result: CalibrationResult, xy: Array, across: int) -> Cells:
    """Divide the field, ``across`` cells wide, and assign each pixel ``xy`` to a cell."""
    width, height = result.model.image_size
    rows = max(1, round(across * height / width))
    size = np.array([width / across, height / rows])
    ij = np.floor((xy + 0.5) / size).astype(np.intp)
    ij = np.clip(ij, 0, [across - 1, rows - 1])
    j, i = np.mgrid[0:rows, 0:across]
    centres = (np.stack([i.ravel(), j.ravel()], axis=1) + 0.5) * size - 0.5
    return Cells(across, rows, ij[:, 1] * across + ij[:, 0], centres)


def compute_reached_shares(result: CalibrationResult, across: int = 6) -> dict[float, float]:
    """Compute, for each magnification, the share of cells, ``across`` in a row, with a corner."""
    xy: dict[float, list[Array]] = {}
    for view in result.views:
        xy.setdefault(float(view.magnification), []).append(view.image_xy)
    return {
        g: float(np.mean(assign_cells(result, np.concatenate(own), across).counts > 0))
        for g, own in sorted(xy.items())
    }


def concatenate_corners(result: CalibrationResult) -> tuple[Array, Array]:
    """Concatenate all corners (n, 2) and their residuals (n, 2), px."""
    return (
        np.concatenate([v.image_xy for v in result.views]),
        np.concatenate(result.fit.residuals_px),
    )


def compute_tilts_deg(result: CalibrationResult) -> tuple[Array, Array]:
    """Compute the tilt of the grid in each view, and the direction of its normal, degrees."""
    normals = result.fit.rotations[:, :, 2]
    upright = normals * np.where(normals[:, 2:] < 0.0, -1.0, 1.0)
    tilt = np.degrees(np.arccos(np.clip(upright[:, 2], -1.0, 1.0)))
    return tilt, np.degrees(np.arctan2(upright[:, 1], upright[:, 0]))
