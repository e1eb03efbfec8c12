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

"""The grid finder: lattices at all scales, the pattern of their cells, sub-pixel fit, rejection.

Smoothed to its spacing, every grid on a square lattice is the checkerboard that its strongest
harmonics make: a checkerboard itself, or dots, crosses and crossed lines, whose saddle points lie
between them. So one search grows lattices of saddle points at all scales; the unit cell of each, made
of its bright squares, says which pattern it is; and what is most likely is fitted at sub-pixel
accuracy.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.core.arrays import Array, Image, Indices
from semcal_ros.core.corners.checks import estimate_scatter_px
from semcal_ros.core.corners.crossed_waves import find_cells
from semcal_ros.core.corners.dots_and_lines import (
    bright_cells,
    centre_cells,
    count_regular_area,
    fit_lattice_shapes,
    grow_at_scale,
    refine_cells,
    split_mixture,
)
from semcal_ros.core.corners.grating import find_lines, fit_lines
from semcal_ros.core.corners.lattice import (
    Lattice,
    LatticeStatus,
    enlarged,
    prepare_image,
    screen_image,
)
from semcal_ros.core.corners.lattice_refinement import RefinedCorners, refine_lattice
from semcal_ros.core.corners.local_map import fit_local_maps
from semcal_ros.core.corners.pattern import (
    PATTERN_NAMES,
    CellShape,
    CellShapes,
    Pattern,
    PatternChoice,
    check_pattern,
    describe_odds,
)
from semcal_ros.core.corners.thresholds import (
    ALONG_SIGMA,
    CELL_ASYMMETRY_MAX,
    CELL_FULL_PX,
    CELL_MISFIT_MAX,
    CHESS_MISFIT_MAX,
    CLEAR_MISFIT,
    COMMON_POWER_MIN,
    CONVINCING_PART,
    COVERED_RATIO,
    FILLED_PART,
    FOREIGN_MAX,
    GROWN_MIN,
    LATTICES_TRIED,
    MINIMUM_CORNERS,
    QUALITY_MIN,
    SAME_AREA_LOG,
    SCALE_MAX_PART,
    SCALES_PX,
    SMALL_PART,
    SPACING_MIN_PX,
    UNEVEN_MAX,
)
from semcal_ros.core.errors import Rejection

_POINTS = {
    "chess": "corners",
    "dots": "dots",
    "crosses": "crosses",
    "lines": "crossings",
    "grating": "places on lines",
}


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
        (n, 2, 2) covariance of each position, px^2: from the noise of the pixels, and the scatter beyond it.
    blur_px
        Median standard deviation of the blur of the edges, px.
    rejected_xy
        (k, 2) expected positions of lattice points in the image that were rejected, px.
    pattern
        What the points are: corners of a checkerboard, centres of dots or crosses, crossings of lines, or places on
        parallel lines.
    odds
        How many times as likely this pattern is as the next one; at most a million.
    across
        (n, 2) unit vectors across the lines of a grating, along which alone the positions are known, and to which
        ``sigma_px`` refers; (0, 2) for other patterns.
    scan_response
        (n, 2, 2) by how far each position moves, px, where the displacement of the picture along x has another slope
        (``[:, 0]``) and another second derivative, per px (``[:, 1]``), about it than the lattice has.
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
    odds: float = float("nan")
    across: Array = field(default_factory=_no_positions)
    scan_response: Array = field(default_factory=_no_covariance)

    @property
    def rejected(self) -> int:
        """Number of lattice points in the image that were rejected."""
        return len(self.rejected_xy)


def find_lattice(
    image: ArrayLike, *, databar_rows: int = 0, pattern: str = "auto"
) -> LatticeDetection | Rejection[LatticeStatus]:
    """Find a grid, in view as a whole or in part, at any rotation and tilt.

    Candidates are lattices through saddle points of the image at all scales, up to points a quarter of the picture
    apart; where none of them shows its pattern clearly, also the cells that its spatial frequencies tell (see
    :mod:`semcal_ros.core.corners.crossed_waves`). Corners of a checkerboard are fitted by a model of two crossing
    blurred edges (see :mod:`semcal_ros.core.corners.edge_model`), which gives position and covariance; dots, crosses
    and crossings of lines by their mean cell (see :mod:`semcal_ros.core.corners.dots_and_lines`). Where edges are
    rough or blurred over many pixels, that is done in a reduced picture.

    Parameters
    ----------
    image
        (h, w) grey values, 8 or 16 bit integers or floats.
    databar_rows
        Rows at the bottom that do not belong to the image.
    pattern
        "chess", "dots" (also holes and small squares), "crosses", "lines" (crossed), or "auto" for whichever of these
        is seen; or "grating" for parallel lines, of which "auto" only says that it sees them.

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
    scaled = screen_image(grey)
    if isinstance(scaled, Rejection):
        return scaled
    pyramid = _Pyramid(scaled)
    if wanted == "grating":
        return _find_grating(pyramid)
    candidates = _rank(list(_search(pyramid)))
    # Where saddle points show no clear pattern, its frequencies tell the lattice.
    crossed = None if any(c.is_clear for c in candidates) else _find_crossed(pyramid)
    answer: Rejection[LatticeStatus] | None = None
    best: LatticeDetection | None = None
    is_clear = False
    for candidate in candidates:
        if crossed is not None and not _may_be(candidate, crossed):
            continue
        measured = _measure_likely(pyramid, candidate, wanted)
        if isinstance(measured, Rejection):
            # What is said is said of the candidate that covers most of the image.
            answer = answer or measured
        elif measured is not None and (best is None or _filled_by(measured) > _filled_by(best)):
            best, is_clear = measured, candidate.is_clear
        if best is not None and candidate.filled > 0.5 * FILLED_PART:
            break
    if best is not None and (is_clear or crossed is not None):
        return best
    # Of a checkerboard, the corners are elsewhere than its cells.
    if crossed is not None and (wanted not in ("auto", "chess") or not crossed.is_likely_chess):
        measured = _measure_likely(pyramid, crossed, wanted)
        if isinstance(measured, LatticeDetection):
            return measured
        answer = answer or measured
    # Noise between parallel lines makes lattices too.
    if wanted == "auto" and isinstance(find_lines(pyramid.level, pyramid.size), Lattice):
        return Rejection(
            LatticeStatus.OTHER_PATTERN,
            "parallel lines, which do not tell a tilt: if the specimen was not tilted, set the pattern to grating",
        )
    if best is not None:
        return best
    what = "points" if wanted == "auto" else _POINTS[wanted]
    return answer or Rejection(LatticeStatus.NO_LATTICE, f"no grid: no regular pattern of {what}")


def _measure_likely(
    pyramid: _Pyramid, candidate: _Candidate, wanted: PatternChoice
) -> LatticeDetection | Rejection[LatticeStatus] | None:
    """Measure a candidate as what it may be; return the likeliest pattern that is found, or why there is none."""
    answer: Rejection[LatticeStatus] | None = None
    best: LatticeDetection | None = None
    for shape in _likely_shapes(candidate, wanted):
        found = shape if isinstance(shape, Rejection) else _measure(pyramid, candidate, shape)
        if isinstance(found, Rejection):
            answer = answer or found
        # What is less likely must cover clearly more.
        elif best is None or _filled_by(found) > COVERED_RATIO * _filled_by(best):
            best = found
    return best or answer


def _find_crossed(pyramid: _Pyramid) -> _Candidate | None:
    """Return the cells of a pattern that repeats in two directions, by its frequencies."""
    places = find_cells(pyramid.level, pyramid.size)
    if places is None or len(places.ij) < GROWN_MIN:
        return None
    cells = centre_cells(pyramid.level, places)
    shapes = fit_lattice_shapes(pyramid.level, cells)
    if shapes is None:
        return None
    filled = float(np.abs(np.linalg.det(cells.axes)).sum()) / (pyramid.size[0] * pyramid.size[1])
    return _Candidate(cells, cells, shapes, filled, filled, True)


def _may_be(candidate: _Candidate, crossed: _Candidate) -> bool:
    """Whether the cells of a candidate may be those that the frequencies tell.

    They are as large, or the latter are but parts of cells, which average to less where they are not alike.
    """
    if candidate.cells is None or candidate.shapes is None or crossed.shapes is None:
        return True
    area, other = (
        float(np.median(np.abs(np.linalg.det(cells.axes))))
        for cells in (candidate.cells, crossed.corners)
    )
    are_parts = crossed.shapes.power < COMMON_POWER_MIN * candidate.shapes.power
    return are_parts or abs(np.log(area / other)) < SAME_AREA_LOG


def _find_grating(pyramid: _Pyramid) -> LatticeDetection | Rejection[LatticeStatus]:
    """Find parallel lines, and fit their positions at places as far apart as the lines."""
    lines = find_lines(pyramid.level, pyramid.size)
    if isinstance(lines, Rejection):
        return lines
    shape = CellShape("grating", True, float("nan"), float("nan"), 0.0)
    whole = _Candidate(lines, lines, None, 1.0, 1.0, False)
    found = _measure(pyramid, whole, shape)
    if isinstance(found, Rejection):
        return found
    if found.rejected > len(found.ij):
        return Rejection(
            LatticeStatus.NO_LATTICE,
            f"no grating: only {len(found.ij)} of {len(found.ij) + found.rejected} places on lines agree with even "
            "distances",
        )
    fit = fit_lines(found.ij, found.xy)
    along = fit.along
    if fit.scatter_px > UNEVEN_MAX * found.spacing_px:
        return Rejection(
            LatticeStatus.NO_LATTICE,
            f"no grating: lines that depart from even distances by {fit.scatter_px:.2g} px, 1-sigma, which are "
            f"{100.0 * fit.scatter_px / found.spacing_px:.0f} % of their distance",
        )
    across = np.stack([along[:, 1], -along[:, 0]], axis=1)
    variance = np.einsum("ni,nij,nj->n", across, found.covariance_px2, across)
    scatter = estimate_scatter_px(found.ij, found.xy, found.covariance_px2, dimensions=1)
    variance = variance + scatter**2
    far = np.full(len(along), (ALONG_SIGMA * max(found.image_size)) ** 2)
    # Places are numbered from anywhere along the lines. One of them counts as known, so that the numbers have a place.
    middle = 0.5 * (np.array(found.image_size) - 1.0)
    nearest = int(np.argmin(np.sum((found.xy - middle) ** 2, axis=1)))
    far[nearest] = variance[nearest]
    covariance = variance[:, None, None] * across[:, :, None] * across[:, None, :]
    covariance += far[:, None, None] * along[:, :, None] * along[:, None, :]
    return replace(found, covariance_px2=covariance, sigma_px=np.sqrt(variance), across=across)


class _Pyramid:
    """An image with a contrast of about 1, and the same reduced by powers of two."""

    def __init__(self, image: Image):
        self._levels = [image]

    @property
    def image(self) -> Image:
        """The image itself."""
        return self._levels[0]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the image, px."""
        return self.image.shape[1], self.image.shape[0]

    def level(self, octave: int) -> Image:
        """Return the image reduced by two to the power of ``octave``."""
        while len(self._levels) <= octave:
            last = self._levels[-1]
            width, height = last.shape[1] // 2, last.shape[0] // 2
            cropped = last[: 2 * height, : 2 * width]
            small = cv2.resize(cropped, (width, height), interpolation=cv2.INTER_AREA)
            self._levels.append(np.asarray(small, dtype=np.float32))
        return self._levels[octave]


@dataclass(frozen=True)
class _Candidate:
    """A lattice through saddle points, the cells that its bright squares make, and the patterns these may be.

    Attributes
    ----------
    corners, cells, shapes
        The lattices, and the shapes; None where too little is in view.
    filled, regular
        Parts of the image that its squares cover, and that those of them cover which continue their neighbours.
    is_mixture
        Whether only every other bright square is a cell, so that the lattice is not that of a checkerboard.
    """

    corners: Lattice
    cells: Lattice | None
    shapes: CellShapes | None
    filled: float
    regular: float
    is_mixture: bool

    @property
    def is_clear(self) -> bool:
        """Whether it shows its pattern."""
        return self.shapes is not None and self.shapes.best.misfit < CLEAR_MISFIT

    @property
    def is_likely_chess(self) -> bool:
        """Whether its cells are most likely those of a checkerboard."""
        return self.shapes is not None and self.shapes.best.pattern == "chess"


def _grow(pyramid: _Pyramid, scale: float) -> Lattice | None:
    """Grow a lattice of the saddle points at a scale, px; None if there is none."""
    octave = max(0, int(np.log2(scale / SCALES_PX[0])))
    corners = grow_at_scale(pyramid.level(octave), scale, octave, pyramid.size)
    return None if corners is None or len(corners.ij) < GROWN_MIN else corners


def _search(pyramid: _Pyramid) -> Iterator[_Candidate]:
    """Find lattices scale by scale; a clear checkerboard that fills the image ends the search."""
    image, size = pyramid.image, pyramid.size
    for scale in SCALES_PX:
        if scale > SCALE_MAX_PART * min(size) and scale > SCALES_PX[0]:
            continue
        corners = _grow(pyramid, scale)
        if corners is None:
            continue
        bright = bright_cells(image, corners)
        cells = None if bright is None else split_mixture(pyramid.level, bright)
        shapes = None if cells is None else fit_lattice_shapes(pyramid.level, cells)
        area = size[0] * size[1]
        filled = float(np.abs(np.linalg.det(corners.axes)).sum()) / area
        regular = count_regular_area(corners) / area
        candidate = _Candidate(corners, cells, shapes, filled, regular, cells is not bright)
        yield candidate
        is_chess = shapes is not None and shapes.allows("chess") and not candidate.is_mixture
        if candidate.regular > FILLED_PART and candidate.is_clear and is_chess:
            return


def _rank(found: list[_Candidate]) -> list[_Candidate]:
    """Return the most regular candidates first, without those whose cells are mixtures of different ones."""
    tried = [c for c in found if c.shapes is None or c.shapes.best.misfit < CELL_MISFIT_MAX]
    largest = max((c.regular for c in tried), default=0.0)
    near = [c.shapes.power for c in tried if c.shapes is not None and c.regular > 0.5 * largest]
    strongest = max(near, default=0.0)
    kept = [
        c
        for c in tried
        if (c.is_clear or c.filled > SMALL_PART)
        and (c.shapes is None or c.shapes.power >= COMMON_POWER_MIN * strongest)
    ]
    return sorted(kept, key=lambda c: c.regular, reverse=True)[:LATTICES_TRIED]


def _likely_shapes(
    candidate: _Candidate, wanted: PatternChoice
) -> list[CellShape | Rejection[LatticeStatus]]:
    """Return the shapes that the cells of a candidate may have, the most likely first, or why there is none."""
    shapes = candidate.shapes
    if shapes is None:
        # Of the few squares of a small board, none may be in view as a whole.
        return [CellShape("chess", True, 1.0, 0.0, 0.0)] if wanted in ("auto", "chess") else []
    # Of a checkerboard, the corners are elsewhere than the cells of a mixture.
    may_be_chess = shapes.allows("chess") and not candidate.is_mixture
    if shapes.asymmetry > CELL_ASYMMETRY_MAX and not may_be_chess:
        return [Rejection(LatticeStatus.NO_LATTICE, "no grid: the lattice is not square")]
    if wanted == "auto":
        likely = [s for s in shapes.every if shapes.allows(s.pattern)]
        if candidate.is_mixture:
            likely = [s for s in shapes.every if s.pattern != "chess"]
        likely.sort(key=shapes.rank)
        return list(likely)
    # The same points lie at the middle of dots and of crosses: only a checkerboard has others.
    if (shapes.best.pattern == "chess") != (wanted == "chess") and not shapes.allows(wanted):
        seen = shapes.best.pattern
        return [
            Rejection(
                LatticeStatus.OTHER_PATTERN,
                f"{PATTERN_NAMES[seen]}, not {PATTERN_NAMES[wanted]}, by odds of"
                f" {describe_odds(shapes.odds_against(wanted))}: set the pattern to {seen} or auto",
            )
        ]
    return [shapes.get(wanted)]


def _measure(
    pyramid: _Pyramid, candidate: _Candidate, shape: CellShape
) -> LatticeDetection | Rejection[LatticeStatus]:
    """Fit the points of a pattern, at full resolution or where most of them pass, and judge them."""
    best = _refine_best(pyramid, candidate, shape)
    if shape.pattern == "chess" and (best is None or best.quality < QUALITY_MIN):
        # Rounded squares with bright edges have two saddle points at a corner, which are one where it is smoothed.
        smoother = _grow_smoothly(pyramid, candidate)
        again = None if smoother is None else _refine_best(pyramid, smoother, shape)
        if again is not None and (best is None or _passed(again) > _passed(best)):
            best = again
    if best is None:
        return Rejection(
            LatticeStatus.NO_LATTICE,
            f"no grid: a regular pattern, but its {_POINTS[shape.pattern]} are not alike",
        )
    if shape.pattern == "chess":
        return _judge_chess(pyramid, candidate, best)
    return _judge(best, candidate, pyramid.size, shape.pattern)


def _grow_smoothly(pyramid: _Pyramid, candidate: _Candidate) -> _Candidate | None:
    """The candidate with a lattice through the saddle points at the scale that suits its squares; None if there is no
    such lattice.
    """
    spacing = float(np.median(np.linalg.norm(candidate.corners.axes, axis=2)))
    largest = SCALE_MAX_PART * min(pyramid.size)
    scale = min(
        (s for s in SCALES_PX if s <= largest),
        key=lambda s: abs(np.log(4.0 * s / spacing)),
        default=0.0,
    )
    if scale <= SCALES_PX[0]:
        return None
    corners = _grow(pyramid, scale)
    return None if corners is None else replace(candidate, corners=corners)


def _refine_best(
    pyramid: _Pyramid, candidate: _Candidate, shape: CellShape
) -> RefinedCorners | None:
    """Fit the points of a pattern at full resolution, or where most of them pass."""
    best: RefinedCorners | None = None
    spacing = np.linalg.norm(candidate.corners.axes, axis=2)
    if shape.pattern != "chess" and candidate.cells is not None:
        spacing = np.linalg.norm(candidate.cells.axes, axis=2)
    typical = float(np.median(spacing))
    first = 0 if shape.pattern == "chess" else max(0, int(np.ceil(np.log2(typical / CELL_FULL_PX))))
    last = max(first, int(np.log2(typical / SPACING_MIN_PX)))
    for octave in range(first, last + 1):
        points = _refine(pyramid.level(octave), candidate, shape, octave)
        if points is not None and (best is None or _passed(points) > _passed(best)):
            best = points
        if best is not None and best.quality > CONVINCING_PART:
            break
    return best


def _passed(points: RefinedCorners) -> float:
    return len(points.ij) * points.quality


def _refine(
    image: Image, candidate: _Candidate, shape: CellShape, octave: int
) -> RefinedCorners | None:
    """Fit the points in a reduced picture; return them in pixels of the whole one."""
    factor = 2.0**octave
    if shape.pattern == "chess":
        points = refine_lattice(image, candidate.corners.reduced(factor))
    else:
        assert candidate.cells is not None
        points = refine_cells(image, candidate.cells.reduced(factor), shape)
    if points is None or octave == 0:
        return points
    return replace(
        points,
        xy=enlarged(points.xy, factor),
        rejected_xy=enlarged(points.rejected_xy, factor),
        covariance=factor**2 * points.covariance,
        scan_response=points.scan_response * np.array([factor, factor**2])[:, None],
        blur_px=factor * points.blur_px,
    )


def _judge_chess(
    pyramid: _Pyramid, candidate: _Candidate, corners: RefinedCorners
) -> LatticeDetection | Rejection[LatticeStatus]:
    """Return the corners if they are good enough and, as fitted, still those of a checkerboard."""
    judged = _judge(corners, candidate, pyramid.size, "chess")
    if isinstance(judged, Rejection) or candidate.is_clear:
        return judged
    maps = fit_local_maps(judged.ij, judged.ij, judged.xy, leave_out_self=False)
    cells = bright_cells(pyramid.image, Lattice(judged.ij, judged.xy, maps.axes))
    shapes = None if cells is None else fit_lattice_shapes(pyramid.level, cells)
    if shapes is None:
        return judged
    if not shapes.allows("chess"):
        return Rejection(
            LatticeStatus.OTHER_PATTERN,
            f"{PATTERN_NAMES[shapes.best.pattern]}, but not well enough in view",
        )
    if shapes.chess.misfit > CHESS_MISFIT_MAX:
        return Rejection(LatticeStatus.NO_LATTICE, "no grid: a regular pattern, but not of squares")
    return replace(judged, odds=shapes.odds_of("chess"))


def _filled_by(points: LatticeDetection) -> float:
    """Return the part of the image that the squares of a lattice cover."""
    return len(points.ij) * points.spacing_px**2 / (points.image_size[0] * points.image_size[1])


def _judge(
    points: RefinedCorners, candidate: _Candidate, size: tuple[int, int], pattern: Pattern
) -> LatticeDetection | Rejection[LatticeStatus]:
    """Return the points of a candidate, if they are good enough."""
    what = _POINTS[pattern]
    if points.quality < QUALITY_MIN:
        return Rejection(
            LatticeStatus.NO_LATTICE,
            f"no grid: only {round(100 * points.quality)} % of the expected {what}"
            f" look like {what}",
        )
    if points.foreign > max(FOREIGN_MAX * len(points.ij), GROWN_MIN):
        return Rejection(
            LatticeStatus.TWO_BOARDS,
            f"two boards: {points.foreign} {what} do not continue the lattice of the other"
            f" {len(points.ij)}",
        )
    if len(points.ij) < MINIMUM_CORNERS and candidate.filled < 0.5 * FILLED_PART:
        return Rejection(
            LatticeStatus.NO_LATTICE,
            f"no grid: only {len(points.ij)} regular {what}, in"
            f" {max(1, round(100 * candidate.filled))} % of the image",
        )
    if len(points.ij) < MINIMUM_CORNERS:
        return Rejection(
            LatticeStatus.TOO_FEW_CORNERS,
            f"too few {what}: {len(points.ij)} found, at least {MINIMUM_CORNERS} needed",
        )
    odds = float("nan") if candidate.shapes is None else candidate.shapes.odds_of(pattern)
    return _make_detection(points, size, pattern, odds)


def _make_detection(
    corners: RefinedCorners, size: tuple[int, int], pattern: Pattern, odds: float
) -> LatticeDetection:
    centre = np.array([(size[0] - 1) / 2.0, (size[1] - 1) / 2.0])
    nearest = int(np.argmin(np.linalg.norm(corners.xy - centre, axis=1)))
    maps = fit_local_maps(
        corners.ij[nearest : nearest + 1], corners.ij, corners.xy, leave_out_self=False
    )
    spacing = float(np.linalg.svd(maps.axes[0], compute_uv=False)[0])
    # Of lines, the scatter is estimated across them.
    scatter = 0.0
    if pattern != "grating":
        scatter = estimate_scatter_px(corners.ij, corners.xy, corners.covariance)
    covariance = corners.covariance + scatter**2 * np.eye(2)
    trace = np.trace(covariance, axis1=1, axis2=2)
    return LatticeDetection(
        corners.ij,
        corners.xy,
        np.sqrt(trace / 2.0),
        spacing,
        size,
        covariance,
        corners.blur_px,
        corners.rejected_xy,
        pattern,
        odds,
        scan_response=corners.scan_response,
    )
