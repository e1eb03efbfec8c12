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

"""The corner finder: saddle candidates, lattice growing, sub-pixel fit, rejection."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.core.arrays import Array, Image, Indices
from semcal_ros.core.corners.lattice import Lattice, grow_best_lattice
from semcal_ros.core.corners.lattice_refinement import RefinedCorners, refine_lattice
from semcal_ros.core.corners.local_map import fit_local_maps
from semcal_ros.core.corners.saddle import LatticeStatus, find_saddles, prepare_image, screen_image
from semcal_ros.core.errors import Rejection

__all__ = ["MINIMUM_CORNERS", "LatticeDetection", "LatticeStatus", "find_lattice"]


# Scales of the search for saddle points, px. A quarter of the spacing is best, so that these suit
# spacings of about 10, 6, 17 and 28 px, in steps of a factor of 1.7. The first suits the small
# squares of low magnifications; a convincing lattice ends the search.
SCALES_PX = (2.5, 1.5, 4.2, 7.0)
# A view with fewer corners is refused. The cubic in the search for the distortion centre has 10
# terms per coordinate.
MINIMUM_CORNERS = 12
# A lattice that covers this part of the image will not be surpassed at another scale.
FILLED = 0.6
# Debris and missing squares may spoil the other corners without another scale being better.
CONVINCING = 0.6

# If a larger part of the corners does not continue the lattice, that part is a second board rather
# than cut off by debris.
FOREIGN_MAX = 0.15


def _no_covariance() -> Array:
    return np.zeros((0, 2, 2))


def _no_positions() -> Array:
    return np.zeros((0, 2))


@dataclass(frozen=True)
class LatticeDetection:
    """Corners of a chess board found in one image.

    Attributes
    ----------
    ij
        (n, 2) lattice indices. The origin is arbitrary; the image of the axes is right-handed
        (positive determinant with x right and y down).
    xy
        (n, 2) positions, px.
    sigma_px
        (n,) 1-sigma per axis, px: the root of half the trace of the covariance.
    spacing_px
        Larger singular value of the local map from lattice to image at the image centre, px per
        square: the spacing without foreshortening by a tilt.
    image_size
        (width, height) without the databar, px.
    covariance_px2
        (n, 2, 2) covariance of each position, px^2.
    blur_px
        Median standard deviation of the blur of the edges, px.
    rejected_xy
        (k, 2) expected positions of lattice points in the image that were rejected, px.
    """

    ij: Indices
    xy: Array
    sigma_px: Array
    spacing_px: float
    image_size: tuple[int, int]
    covariance_px2: Array = field(default_factory=_no_covariance)
    blur_px: float = float("nan")
    rejected_xy: Array = field(default_factory=_no_positions)

    @property
    def rejected(self) -> int:
        """Number of lattice points in the image that were rejected."""
        return len(self.rejected_xy)


def find_lattice(
    image: ArrayLike, *, databar_rows: int = 0
) -> LatticeDetection | Rejection[LatticeStatus]:
    """Find the corners of a chess board, in view as a whole or in part, at any rotation and tilt.

    Candidates are maxima of minus the determinant of the Hessian at several scales; a lattice is
    grown from them with local prediction and the alternating sign of the contrast; every corner in
    view is then fitted by a model of two crossing blurred edges (see
    :mod:`semcal_ros.core.corners.edge_model`), which gives position and covariance.

    Parameters
    ----------
    image
        (h, w) grey values, 8 or 16 bit integers or floats.
    databar_rows
        Rows at the bottom that do not belong to the image.

    Returns
    -------
    The corners, or a rejection if the image is blank or saturated, or shows no lattice or two.

    Raises
    ------
    InvalidValueError
        If ``image`` is not a single-channel image of at least 32 x 32 px.
    """
    grey = prepare_image(image, databar_rows)
    size = (grey.shape[1], grey.shape[0])
    scaled = screen_image(grey)
    if isinstance(scaled, Rejection):
        return scaled
    best = _best_corners(scaled, size)
    if best is None:
        return Rejection(
            LatticeStatus.NO_LATTICE, "no chess lattice: no regular pattern of saddle points"
        )
    corners, filled = best
    if corners.quality < 0.5:
        return Rejection(
            LatticeStatus.NO_LATTICE,
            f"no chess lattice: only {round(100 * corners.quality)} % of the expected corners"
            " look like corners",
        )
    if corners.foreign > max(FOREIGN_MAX * len(corners.ij), MINIMUM_CORNERS // 2):
        return Rejection(
            LatticeStatus.TWO_BOARDS,
            f"two boards: {corners.foreign} corners do not continue the lattice of the other"
            f" {len(corners.ij)}",
        )
    if len(corners.ij) < MINIMUM_CORNERS and filled < FILLED / 2.0:
        return Rejection(
            LatticeStatus.NO_LATTICE,
            f"no chess lattice: only {len(corners.ij)} regular corners, in"
            f" {max(1, round(100 * filled))} % of the image",
        )
    if len(corners.ij) < MINIMUM_CORNERS:
        return Rejection(
            LatticeStatus.TOO_FEW_CORNERS,
            f"too few corners: {len(corners.ij)} found, at least {MINIMUM_CORNERS} needed",
        )
    return _make_detection(corners, size)


def _best_corners(image: Image, size: tuple[int, int]) -> tuple[RefinedCorners, float] | None:
    """Find the best corners over all scales, and the part of the image that they cover."""
    candidates: list[tuple[float, Lattice]] = []
    best: tuple[RefinedCorners, float] | None = None
    for scale in SCALES_PX:
        lattice = grow_best_lattice(find_saddles(image, scale), size)
        if lattice is None or len(lattice.ij) < MINIMUM_CORNERS // 2:
            continue
        filled = _covered_share(lattice, size)
        if filled <= FILLED:
            candidates.append((filled, lattice))
            continue
        best = _better(best, refine_lattice(image, lattice), filled)
        if best is not None and best[0].quality > CONVINCING:
            return best
    for filled, lattice in candidates:
        best = _better(best, refine_lattice(image, lattice), filled)
    return best


def _better(
    best: tuple[RefinedCorners, float] | None, other: RefinedCorners | None, filled: float
) -> tuple[RefinedCorners, float] | None:
    """Return the candidate with the larger product of number of corners and quality."""
    if other is None:
        return best
    if best is None or len(other.ij) * other.quality > len(best[0].ij) * best[0].quality:
        return other, filled
    return best


def _covered_share(lattice: Lattice, size: tuple[int, int]) -> float:
    """Return the part of the image that the cells of a lattice cover."""
    area = float(np.abs(np.linalg.det(lattice.axes)).sum())
    return area / (size[0] * size[1])


def _make_detection(corners: RefinedCorners, size: tuple[int, int]) -> LatticeDetection:
    centre = np.array([(size[0] - 1) / 2.0, (size[1] - 1) / 2.0])
    nearest = int(np.argmin(np.linalg.norm(corners.xy - centre, axis=1)))
    maps = fit_local_maps(
        corners.ij[nearest : nearest + 1], corners.ij, corners.xy, leave_out_self=False
    )
    spacing = float(np.linalg.svd(maps.axes[0], compute_uv=False)[0])
    trace = np.trace(corners.covariance, axis1=1, axis2=2)
    return LatticeDetection(
        corners.ij,
        corners.xy,
        np.sqrt(trace / 2.0),
        spacing,
        size,
        corners.covariance,
        corners.blur_px,
        corners.rejected_xy,
    )
