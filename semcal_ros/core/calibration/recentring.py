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

"""Brings a grid back into the field of view: how far it is off, and which way of the stage brings it back.

Which way the image moves with x and y of a stage depends on how the stage is mounted, on the scan rotation and on the
tilt, and is learned from two small moves. A move of less than half a square can be told from the corners alone,
although all squares look alike.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from semcal_ros.core.arrays import Array
from semcal_ros.core.corners import LatticeDetection
from semcal_ros.core.errors import CalibrationError

__all__ = [
    "PROBE_SQUARES",
    "find_stage_move",
    "grid_is_centred",
    "image_from_stage",
    "lattice_shift",
]

PROBE_SQUARES = 0.3
"""Length of the moves to learn from, in squares: more than any backlash that lets a stage be used at this
magnification, and less than the half beyond which the next corner is nearer."""

# Middle of what is seen of the grid, off the middle of the image, as a part of the image.
_OFF = 0.08
# Spread of the displacements of single corners, in squares, above which pictures do not show the same corners.
_SPREAD = 0.15
# A move of the stage over that of the image, in squares each: 1, or the cosine of the tilt (0.34 at 70 degrees); below
# this, the stage has not moved or the picture is older than the move.
_LEAST_MOVED = 0.2


def _middle_off_px(detection: LatticeDetection) -> Array:
    box = 0.5 * (detection.xy.min(axis=0) + detection.xy.max(axis=0))
    off: Array = box - 0.5 * (np.array(detection.image_size) - 1.0)
    return off


def grid_is_centred(detection: LatticeDetection) -> bool:
    """Return whether what is seen of the grid lies about the middle of the image.

    Parameters
    ----------
    detection
        Its corners.
    """
    off = np.abs(_middle_off_px(detection)) / np.array(detection.image_size)
    return bool(np.all(off <= _OFF))


def lattice_shift(before: LatticeDetection, after: LatticeDetection) -> Array:
    """Measure by how much a lattice has moved, if that is less than half a square.

    Parameters
    ----------
    before, after
        The corners in two pictures.

    Returns
    -------
    (2,) way from the first to the second, px.

    Raises
    ------
    CalibrationError
        The corners do not move together.
    """
    distance, nearest = cKDTree(before.xy).query(after.xy)
    spacing_px = min(before.spacing_px, after.spacing_px)
    same = distance < 0.5 * spacing_px
    ways = after.xy[same] - before.xy[nearest[same]]
    spread = 1.4826 * np.median(np.abs(ways - np.median(ways, axis=0))) if len(ways) else np.inf
    if 2 * len(ways) < len(after.xy) or spread > _SPREAD * spacing_px:
        raise CalibrationError(
            "the corners of two pictures do not move together",
            expected=f"a grid that follows a move of {PROBE_SQUARES:g} squares",
            do="check that x and y of the stage are in m, and that nothing else moves it",
        )
    shift: Array = np.median(ways, axis=0)
    return shift


def image_from_stage(ways_m: Array, shifts_px: Array, nominal_px_per_m: float) -> Array:
    """Return the matrix (2, 2), px/m, that maps a way of the stage to that of the image.

    Parameters
    ----------
    ways_m
        (2, 2) two ways (x, y) of the stage, one in each row.
    shifts_px
        (2, 2) what the image did.
    nominal_px_per_m
        What it would do without a tilt.

    Raises
    ------
    CalibrationError
        The image did not follow one of them.
    """
    matrix = np.asarray(np.linalg.solve(ways_m, shifts_px).T, dtype=np.float64)
    least = float(np.linalg.svd(matrix, compute_uv=False)[-1])
    if not least > _LEAST_MOVED * nominal_px_per_m:
        moved = ", ".join(f"{np.hypot(*shift):.1f} px" for shift in shifts_px)
        expected = ", ".join(f"{np.hypot(*way) * nominal_px_per_m:.1f} px" for way in ways_m)
        raise CalibrationError(
            f"the image does not follow x and y of the stage: it moved by {moved}",
            expected=f"about {expected}, in different directions",
            do="check the stage, its backlash, and that its messages tell x and y",
        )
    return matrix


def find_stage_move(detection: LatticeDetection, px_per_m: Array) -> Array:
    """Return the way (2,) of the stage, m, that brings what is seen of the grid to the middle of the image.

    A grid that reaches beyond the image is farther off than can be seen: look again afterwards.

    Parameters
    ----------
    detection
        The corners.
    px_per_m
        (2, 2) as :func:`image_from_stage` returns it.
    """
    return np.asarray(-np.linalg.solve(px_per_m, _middle_off_px(detection)), dtype=np.float64)
