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
from semcal_ros.core.corners.dots_and_lines import (
    bright_cells,
    find_cell_lattices,
    fit_lattice_shapes,
    refine_cells,
)
from semcal_ros.core.corners.lattice import Lattice, grow_best_lattice
from semcal_ros.core.corners.lattice_refinement import RefinedCorners, refine_lattice
from semcal_ros.core.corners.local_map import fit_local_maps
from semcal_ros.core.corners.pattern import (
    PATTERN_NAMES,
    CellShape,
    CellShapes,
    Pattern,
    PatternChoice,
    check_pattern,
)
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


# Part of the power of a unit cell that no shape explains, above which it is no grid. Photographs
# leave 0.006, and bright rims an eighth of the pitch wide up to 0.2.
MISFIT_MAX = 0.2
# Of a chess board nothing but growth and blur changes the cell; photographs leave up to 0.004.
CHESS_MISFIT_MAX = 0.08
# A hexagonal lattice of dots has 0.05 or more, and a square one with a blur of a sixth of the pitch, seen
# at 45 degrees, has 0.001.
ASYMMETRY_MAX = 0.02
# Below this a grown lattice, whose points are good to a few tenths of a pixel, shows its pattern; with
# blurred or wrongly grown cells the fitted corners decide.
CLEAR_MISFIT = 0.02
# Square dots a half of their distance wide also make a lattice of dots and gaps, whose cells differ: what
# is common to them has two thirds of the power or less. Lattices of different scales through the same
# dots differ by a tenth.
POWER_MIN = 0.8
# Lattices of different scales that are looked at for dots and lines.
LATTICES_TRIED = 4

_POINTS = {"chess": "corners", "dots": "dots", "lines": "crossings"}


def _no_covariance() -> Array:
    return np.zeros((0, 2, 2))


def _no_positions() -> Array:
    return np.zeros((0, 2))


@dataclass(frozen=True)
class LatticeDetection:
    """Points of a grid found in one image: corners, dots or crossings.

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
        square, or between dots or lines: the spacing without foreshortening by a tilt.
    image_size
        (width, height) without the databar, px.
    covariance_px2
        (n, 2, 2) covariance of each position, px^2.
    blur_px
        Median standard deviation of the blur of the edges, px.
    rejected_xy
        (k, 2) expected positions of lattice points in the image that were rejected, px.
    pattern
        What the points are: corners of a chess board, centres of dots, or crossings of lines.
    """

    ij: Indices
    xy: Array
    sigma_px: Array
    spacing_px: float
    image_size: tuple[int, int]
    covariance_px2: Array = field(default_factory=_no_covariance)
    blur_px: float = float("nan")
    rejected_xy: Array = field(default_factory=_no_positions)
    pattern: Pattern = "chess"

    @property
    def rejected(self) -> int:
        """Number of lattice points in the image that were rejected."""
        return len(self.rejected_xy)


def find_lattice(
    image: ArrayLike, *, databar_rows: int = 0, pattern: str = "auto"
) -> LatticeDetection | Rejection[LatticeStatus]:
    """Find a grid, in view as a whole or in part, at any rotation and tilt.

    Chess boards: candidates are maxima of minus the determinant of the Hessian at several scales; a
    lattice is grown from them with local prediction and the alternating sign of the contrast; every
    corner in view is then fitted by a model of two crossing blurred edges (see
    :mod:`semcal_ros.core.corners.edge_model`), which gives position and covariance. Dots, holes and
    crossed lines: see :mod:`semcal_ros.core.corners.dots_and_lines`.

    Parameters
    ----------
    image
        (h, w) grey values, 8 or 16 bit integers or floats.
    databar_rows
        Rows at the bottom that do not belong to the image.
    pattern
        "chess", "dots" (also holes and small squares), "lines" (crossed), or "auto" for whichever of
        these is seen.

    Returns
    -------
    The corners, centres of the dots or crossings of the lines; or a rejection if the image is blank
    or saturated, or shows no lattice, two, or one of another pattern.

    Raises
    ------
    InvalidValueError
        If ``image`` is not a single-channel image of at least 32 x 32 px, or for another
        ``pattern``.
    """
    wanted = check_pattern(pattern)
    grey = prepare_image(image, databar_rows)
    size = (grey.shape[1], grey.shape[0])
    scaled = screen_image(grey)
    if isinstance(scaled, Rejection):
        return scaled
    if wanted in ("dots", "lines"):
        return _find_cells(scaled, size, wanted)
    chess = _find_chess(scaled, size)
    if wanted == "chess":
        return _other_pattern(chess.pattern, wanted) if isinstance(chess, CellShape) else chess
    if isinstance(chess, CellShape):
        return _find_cells(scaled, size, wanted)
    if isinstance(chess, Rejection):
        cells = _find_cells(scaled, size, wanted)
        # What is no other pattern either was most likely meant to be a chess board.
        return chess if isinstance(cells, Rejection) else cells
    # In a part of another grid there may be something like a small chess board.
    if _filled_by(chess) < FILLED / 2.0:
        cells = _find_cells(scaled, size, wanted)
        if not isinstance(cells, Rejection) and _filled_by(cells) > _filled_by(chess):
            return cells
    return chess


def _filled_by(points: LatticeDetection) -> float:
    """Return the part of the image that the squares of a lattice cover."""
    return len(points.ij) * points.spacing_px**2 / (points.image_size[0] * points.image_size[1])


def _find_chess(
    scaled: Image, size: tuple[int, int]
) -> LatticeDetection | CellShape | Rejection[LatticeStatus]:
    """Find the corners of a chess board; return the shape of the cells of another grid."""
    best = _best_corners(scaled, size)
    if best is None:
        return Rejection(
            LatticeStatus.NO_LATTICE, "no chess lattice: no regular pattern of saddle points"
        )
    if isinstance(best, CellShape):
        return best
    corners, filled, is_chess = best
    chess = _judge(corners, filled, size, "chess")
    if isinstance(chess, Rejection) or is_chess:
        return chess
    maps = fit_local_maps(chess.ij, chess.ij, chess.xy, leave_out_self=False)
    shapes = _shapes_of(scaled, Lattice(chess.ij, chess.xy, maps.axes))
    if shapes is None:
        return chess
    if shapes.allows("chess") and shapes.chess.misfit > CHESS_MISFIT_MAX:
        return Rejection(
            LatticeStatus.NO_LATTICE, "no chess lattice: a regular pattern, but not of squares"
        )
    return chess if shapes.allows("chess") else shapes.best


def _shapes_of(scaled: Image, corners: Lattice) -> CellShapes | None:
    """Fit the shapes of the unit cell of a chess board, or of what was taken for one."""
    cells = bright_cells(scaled, corners)
    return None if cells is None else fit_lattice_shapes(scaled, cells)


def _find_cells(
    scaled: Image, size: tuple[int, int], pattern: PatternChoice
) -> LatticeDetection | Rejection[LatticeStatus]:
    """Find dots or crossed lines; with ``pattern`` "auto" either of them."""
    wanted = "dots or crossed lines" if pattern == "auto" else PATTERN_NAMES[pattern]
    answer = Rejection(LatticeStatus.NO_LATTICE, f"no {wanted}: no regular pattern")
    tried = [
        (lattice, shapes)
        for lattice in find_cell_lattices(scaled)[:LATTICES_TRIED]
        if (shapes := fit_lattice_shapes(scaled, lattice)) and shapes.best.misfit < MISFIT_MAX
    ]
    largest = max((_covered_share(lattice, size) for lattice, _ in tried), default=0.0)
    strongest = max(
        (s.power for lattice, s in tried if _covered_share(lattice, size) > 0.5 * largest),
        default=0.0,
    )
    for lattice, shapes in tried:
        if shapes.power < POWER_MIN * strongest:
            continue
        if shapes.asymmetry > ASYMMETRY_MAX:
            answer = Rejection(LatticeStatus.NO_LATTICE, f"no {wanted}: the lattice is not square")
            continue
        shape = shapes.best if pattern == "auto" else shapes.get(pattern)
        if shape.pattern == "chess" or not shapes.allows(shape.pattern):
            return _other_pattern(shapes.best.pattern, pattern)
        points = refine_cells(scaled, lattice, shape)
        if points is not None:
            filled = _covered_share(lattice, size)
            judged = _judge(points, filled, size, shape.pattern)
            if not isinstance(judged, Rejection):
                return judged
            answer = judged
    return answer


def _other_pattern(seen: str, wanted: str) -> Rejection[LatticeStatus]:
    if wanted == "auto":
        return Rejection(
            LatticeStatus.OTHER_PATTERN, f"{PATTERN_NAMES[seen]}, but not well enough in view"
        )
    return Rejection(
        LatticeStatus.OTHER_PATTERN,
        f"{PATTERN_NAMES[seen]}, not {PATTERN_NAMES[wanted]}: set the pattern to {seen} or auto",
    )


def _judge(
    points: RefinedCorners, filled: float, size: tuple[int, int], pattern: Pattern
) -> LatticeDetection | Rejection[LatticeStatus]:
    """Return the points of a lattice that covers the part ``filled`` of the image, if good enough."""
    name = "chess lattice" if pattern == "chess" else PATTERN_NAMES[pattern]
    what = _POINTS[pattern]
    if points.quality < 0.5:
        return Rejection(
            LatticeStatus.NO_LATTICE,
            f"no {name}: only {round(100 * points.quality)} % of the expected {what}"
            f" look like {what}",
        )
    if points.foreign > max(FOREIGN_MAX * len(points.ij), MINIMUM_CORNERS // 2):
        return Rejection(
            LatticeStatus.TWO_BOARDS,
            f"two boards: {points.foreign} {what} do not continue the lattice of the other"
            f" {len(points.ij)}",
        )
    if len(points.ij) < MINIMUM_CORNERS and filled < FILLED / 2.0:
        return Rejection(
            LatticeStatus.NO_LATTICE,
            f"no {name}: only {len(points.ij)} regular {what}, in"
            f" {max(1, round(100 * filled))} % of the image",
        )
    if len(points.ij) < MINIMUM_CORNERS:
        return Rejection(
            LatticeStatus.TOO_FEW_CORNERS,
            f"too few {what}: {len(points.ij)} found, at least {MINIMUM_CORNERS} needed",
        )
    return _make_detection(points, size, pattern)


def _best_corners(
    image: Image, size: tuple[int, int]
) -> tuple[RefinedCorners, float, bool] | CellShape | None:
    """Find the best corners over all scales, the part of the image that they cover, and whether its cells were found
    to be those of a chess board already.

    If a lattice fills the image and has clearly the cells of another grid, return their shape.
    """
    candidates: list[tuple[float, Lattice]] = []
    best: tuple[RefinedCorners, float, bool] | None = None
    for scale in SCALES_PX:
        lattice = grow_best_lattice(find_saddles(image, scale), size)
        if lattice is None or len(lattice.ij) < MINIMUM_CORNERS // 2:
            continue
        filled = _covered_share(lattice, size)
        if filled <= FILLED:
            candidates.append((filled, lattice))
            continue
        shapes = _shapes_of(image, lattice)
        clear = shapes is not None and shapes.best.misfit < CLEAR_MISFIT
        if shapes is not None and clear and not shapes.allows("chess"):
            return shapes.best
        # Corners that are refined show the cells more clearly still.
        is_chess = (
            shapes is not None
            and shapes.allows("chess")
            and shapes.chess.misfit <= CHESS_MISFIT_MAX
        )
        best = _better(best, refine_lattice(image, lattice), filled, is_chess)
        if best is not None and best[0].quality > CONVINCING:
            return best
    for filled, lattice in candidates:
        best = _better(best, refine_lattice(image, lattice), filled, False)
    return best


def _better(
    best: tuple[RefinedCorners, float, bool] | None,
    other: RefinedCorners | None,
    filled: float,
    is_chess: bool,
) -> tuple[RefinedCorners, float, bool] | None:
    """Return the candidate with the larger product of number of corners and quality."""
    if other is None:
        return best
    if best is None or len(other.ij) * other.quality > len(best[0].ij) * best[0].quality:
        return other, filled, is_chess
    return best


def _covered_share(lattice: Lattice, size: tuple[int, int]) -> float:
    """Return the part of the image that the cells of a lattice cover."""
    area = float(np.abs(np.linalg.det(lattice.axes)).sum())
    return area / (size[0] * size[1])


def _make_detection(
    corners: RefinedCorners, size: tuple[int, int], pattern: Pattern
) -> LatticeDetection:
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
        pattern,
    )
