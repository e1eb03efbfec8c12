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

"""Which of the shifts that show a periodic specimen alike is its shift: its defects tell.

All shifts that differ by a period show a perfect lattice alike. Defects decide: at a wrong shift, every defect
disagrees twice, where it is and where it should be. Of a disordered lattice, such as the pores of anodic alumina, each
cell is a little defect: at a wrong shift, most tiles disagree by a part of their structure. What neither tells is
refused where the lattice is fine, since a prediction would only hide a jump by a period; one defect is enough that
agrees with it. Where a period is a good part of the field, a jump by one is a move of the stage and no drift, and a
prediction that is good to a tenth of it decides.

What does not repeat in an image by itself, such as a tool over the lattice, has no say: where either image does not
show the lattice, or next to it, tiles count neither for the refinement nor as defects. A tool moves by itself, and its
outline would outvote the defects. Each defect that is left unexplained at a shift may be one that another shift would
explain, which was not among the compared ones: more defects have to speak for a shift than are left.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from semcal_ros.core.arrays import Array, Mask, mad_sigma, median
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.agreement import (
    Agreement,
    TileNoise,
    find_agreement,
    information_weights,
)
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.registration.fixed_pixels import grow_mask
from semcal_ros.core.registration.inverse_compositional import (
    Alignment,
    TileStatistics,
    align,
    align_reweighted,
)
from semcal_ros.core.registration.noise_spectrum import normal_deviations, shared_pixels
from semcal_ros.core.registration.periodicity import is_fine
from semcal_ros.core.registration.thresholds import (
    ALONG_STARTS_PX,
    DEFECT_EVIDENCE_MAX,
    DEFECT_SIGMAS,
    DISORDER_MIN,
    DISORDERED_SHARE_MIN,
    DISORDERED_TILES_MIN,
    EVIDENCE_MIN,
    HALF_PERIOD_SIGMAS,
    LONE_DEFECT_MOVED_PX_MIN,
    NOISE_DOUBT,
    PERIODS_COMPARED_MAX,
    PERIODS_REACH_SIGMAS,
    SAME_SHIFT_PX,
    SMEARED_PX,
)
from semcal_ros.core.registration.tiles import Pyramid, PyramidLevel


@dataclass(frozen=True)
class ChosenShift:
    """The shift of a periodic specimen, and which tiles agree with it."""

    alignment: Alignment
    agreement: Agreement


@dataclass(frozen=True)
class UntoldShift:
    """Why no shift of a periodic specimen is told.

    Attributes
    ----------
    rejection
        The reason.
    suggested_px
        (2,) the shift for which more defects speak than for the one nearest to the prediction; NaN where there is none,
        or where defects are left that say that the specimen is farther away than what was compared.
    """

    rejection: Rejection[MatchFailure]
    suggested_px: Array


@dataclass(frozen=True)
class _Shown:
    """Where a reference and an image show the lattice, and all around.

    Attributes
    ----------
    level
        The reference.
    by_reference
        (rows, cols) the tiles in which the reference does.
    hidden
        (h + 1, w + 1) integral of the pixels of the image that do not, or are near such.
    """

    level: PyramidLevel
    by_reference: Mask
    hidden: Array

    @classmethod
    def of(cls, level: PyramidLevel, reference: Mask, image: Mask, fixed: Mask | None) -> _Shown:
        """From the pixels (h, w) of both that do, and those of the image that are ``fixed``."""
        # The edge of something else may run through the tiles around.
        around = np.ones((2 * level.side[1] + 1, 2 * level.side[0] + 1), np.uint8)
        masks = [cv2.dilate((~mask).astype(np.uint8), around) for mask in (reference, image)]
        if fixed is not None:
            masks[1][grow_mask(fixed, SMEARED_PX + math.ceil(level.sigma_px))] = 1
        hidden = [np.asarray(cv2.integral(mask), np.float64) for mask in masks]
        return cls(level, _is_free(level, hidden[0], np.zeros(2)), hidden[1])

    @property
    def is_all(self) -> bool:
        """Whether there is nothing else."""
        return bool(np.all(self.by_reference)) and not self.hidden[-1, -1]

    def at(self, shift: Array) -> Mask:
        """(rows, cols) the tiles in which both do at a shift (2,)."""
        return self.by_reference & _is_free(self.level, self.hidden, shift)


def _is_free(level: PyramidLevel, hidden: Array, shift: Array) -> Mask:
    """(rows, cols) the tiles that have no hidden pixel at a shift."""
    sides = []
    for axis in (0, 1):
        count, most = level.normal_matrices.shape[1 - axis], hidden.shape[1 - axis] - 1
        first = level.origin[axis] + round(float(shift[axis])) + level.side[axis] * np.arange(count)
        sides.append((np.clip(first, 0, most), np.clip(first + level.side[axis], 0, most)))
    (left, right), (top, bottom) = sides
    corners = [hidden[np.ix_(y, x)] for y in (top, bottom) for x in (left, right)]
    return np.asarray(corners[3] - corners[2] - corners[1] + corners[0] == 0)


@dataclass(frozen=True)
class _Candidate:
    """A shift of the class, refined.

    Attributes
    ----------
    alignment
        The shift.
    energies
        (rows, cols) mean squared residuals of all tiles of the reference; NaN where none were compared.
    structure
        (rows, cols) variance of what the reference shows in them, in grey levels of the image.
    brightness
        (rows, cols) mean grey level of the reference in them.
    counted
        (rows, cols) the tiles that show the lattice there.
    products
        Number of independent values in a tile.
    is_held
        Whether it was only refined across the lines of a grating, since nothing tells a place along them there.
    """

    alignment: Alignment
    energies: Array
    structure: Array
    brightness: Array
    counted: Mask
    products: float
    is_held: bool = False

    @property
    def shift_px(self) -> Array:
        """(2,) shift."""
        return self.alignment.shift_px


def choose_period(
    levels: tuple[PyramidLevel, ...],
    pyramid: Pyramid,
    periods: Array,
    start_px: Array,
    highest_px: Array,
    guess: Array,
    spread: Array | None,
    noise: TileNoise,
    repeats: tuple[Mask, Mask],
    fixed: Mask | None,
) -> ChosenShift | UntoldShift:
    """The shift of a periodic specimen that its defects tell, or why it is not told.

    Parameters
    ----------
    levels, pyramid
        Reference and image.
    periods
        As found by :func:`~semcal_ros.core.registration.periodicity.find_periods`.
    start_px
        (2,) any shift that explains the image.
    highest_px
        (2,) the one of the highest correlation. It is compared, too, where all of both images shows the lattice: it
        may be farther than what a prediction allows.
    guess, spread
        (2,) predicted shift and its covariance (2, 2), or None.
    noise
        That of both.
    repeats
        (h, w) where each of them shows the lattice
        (:func:`~semcal_ros.core.registration.periodicity.find_repeating`).
    fixed
        (h, w) True at the pixels of the image that do not show the specimen, or None. The reference is without them at
        the predicted shift alone: at another period they would be defects.
    """
    level = levels[-1]
    shown = _Shown.of(level, *repeats, fixed)
    first = _refine_first(pyramid, start_px, noise, shown)
    if isinstance(first, Rejection):
        return UntoldShift(first, np.full(2, np.nan))
    shifts = [*_list_shifts(first.shift_px, periods, guess, spread, level.size)]
    if shown.is_all:
        # The highest correlation is no tool's.
        shifts.append(highest_px)
    compared = _compare_shifts(pyramid, shifts, noise, shown)
    if not compared:
        reason = "refinement did not converge at any period"
        return UntoldShift(Rejection(MatchFailure.NOT_CONVERGED, reason), np.full(2, np.nan))

    best = compared[0]
    for other in compared[1:]:
        pro, contra = _weigh(best, other)
        if _is_worse_everywhere(best, other) or (
            pro < contra and not _is_worse_everywhere(other, best)
        ):
            best = other
    predicted = _find_predicted(compared, periods, guess, spread)
    usual = None if is_fine(periods, level.size) else predicted
    if usual is not None and usual is not best and not _is_expected(usual, guess, spread):
        # A stage may have moved by nearly a period.
        usual = None
    if usual is not None and (usual is best or not _tells(best, usual, EVIDENCE_MIN)):
        best, rejection = usual, _find_flaw(usual, periods, noise)
    else:
        rejection = _find_flaw(best, periods, noise)
        rejection = rejection or _find_rival(best, compared, periods, noise, best is predicted)
    told = rejection or _leave_out(pyramid, best, noise, shown)
    if isinstance(told, ChosenShift):
        return told
    nearest = min(compared, key=lambda c: float(np.hypot(*(c.shift_px - guess))))
    is_open = best is nearest or told.status is MatchFailure.DEFECTS_ELSEWHERE
    return UntoldShift(told, np.full(2, np.nan) if is_open else best.shift_px)


def _find_rival(
    best: _Candidate,
    compared: list[_Candidate],
    periods: Array,
    noise: TileNoise,
    is_predicted: bool,
) -> Rejection[MatchFailure] | None:
    """Why defects do not tell the best shift from all others; None if they do."""
    left = _count_left_defects(best, noise)
    least = _find_least_evidence(best, left, is_predicted)
    start = f"ambiguous: a specimen that repeats every {np.hypot(*periods[0]):.1f} px, "
    if len(compared) == 1:
        return Rejection(MatchFailure.AMBIGUOUS, start + "and only one shift to compare")
    rival = next((c for c in compared if c is not best and not _tells(best, c, least)), None)
    if rival is None:
        return None
    (x, y), (a, b) = best.shift_px.tolist(), rival.shift_px.tolist()
    shifts = f"({x:.1f}, {y:.1f}) and ({a:.1f}, {b:.1f})"
    reason = start + f"whose defects do not tell shifts {shifts} px apart"
    against = DEFECT_EVIDENCE_MAX * left
    if against >= EVIDENCE_MIN or against > _weigh(best, rival)[0]:
        reason += f", and with {left} of them elsewhere"
        return Rejection(MatchFailure.DEFECTS_ELSEWHERE, reason)
    return Rejection(MatchFailure.AMBIGUOUS, reason)


def _find_flaw(
    chosen: _Candidate, periods: Array, noise: TileNoise
) -> Rejection[MatchFailure] | None:
    """Why a shift is not that of the specimen, whatever the others are; None if nothing speaks against it."""
    if chosen.is_held:
        reason = "ambiguous: lines, whose defects do not tell a place along them"
    elif _leaves_structure(chosen, noise):
        reason = (
            f"ambiguous: a specimen that repeats every {np.hypot(*periods[0]):.1f} px, of which no shift that was "
            "compared explains the image"
        )
    else:
        return None
    return Rejection(MatchFailure.AMBIGUOUS, reason)


def _compare_shifts(
    pyramid: Pyramid, shifts: Sequence[Array], noise: TileNoise, shown: _Shown
) -> list[_Candidate]:
    """Shifts of the class, each refined by what shows the lattice."""
    level, along = shown.level, _along_lines(shown.level)
    brightness = level.normal_matrices[..., 2, 3] / level.pixel_counts
    compared: list[_Candidate] = []
    for shift in shifts:
        found = _refine(pyramid, shift, noise, shown)
        is_held = isinstance(found, Rejection) or not found.converged
        if is_held:
            # Of lines, only defects tell the place along them, which are elsewhere.
            found = align([level], pyramid, shift, held=along)
        if isinstance(found, Rejection) or not found.converged:
            continue
        aside_px = float(np.max(np.abs(found.shift_px - shift)))
        if is_held and not shown.is_all and aside_px > SAME_SHIFT_PX:
            # What is none of the lattice has pulled it.
            continue
        if any(np.max(np.abs(found.shift_px - c.shift_px)) < SAME_SHIFT_PX for c in compared):
            continue
        tiles = found.tile_statistics()
        assert tiles is not None
        energies, structure = np.full((2, *level.normal_matrices.shape[:2]), np.nan)
        squares = tiles.image - 2.0 * tiles.gain * tiles.common + tiles.gain**2 * tiles.reference
        energies[tiles.rows, tiles.cols] = squares / tiles.pixels
        structure[tiles.rows, tiles.cols] = tiles.gain**2 * tiles.reference / tiles.pixels
        counted = shown.at(found.shift_px)
        # Of a tile that smoothing leaves with less than one, as of one.
        products = max(1.0, median(tiles.pixels) / shared_pixels(tiles.sigma_px))
        compared.append(
            _Candidate(found, energies, structure, brightness, counted, products, is_held)
        )
    return compared


def _refine_first(
    pyramid: Pyramid, start_px: Array, noise: TileNoise, shown: _Shown
) -> Alignment | Rejection[MatchFailure]:
    """The shift next to a start, also where that is a pixel off along the lines of a grating."""
    first = _refine(pyramid, start_px, noise, shown)
    along = _along_lines(shown.level)
    for aside_px in ALONG_STARTS_PX if shown.is_all else ():
        if isinstance(first, Alignment) and first.converged:
            return first
        other = _refine(pyramid, start_px + aside_px * along, noise, shown)
        first = other if isinstance(other, Alignment) and other.converged else first
    return first


def _along_lines(level: PyramidLevel) -> Array:
    """(2,) direction in which a reference has the least gradients."""
    whole = level.normal_matrices[..., :2, :2].sum(axis=(0, 1))
    return np.asarray(np.linalg.eigh(whole)[1][:, 0])


def _refine(
    pyramid: Pyramid, shift: Array, noise: TileNoise, shown: _Shown
) -> Alignment | Rejection[MatchFailure]:
    """The shift next to one, by what shows the lattice: the rest would pull it."""
    level = shown.level
    if shown.is_all:
        return align([level], pyramid, shift)
    weights = _weigh_tiles(shown, shift, noise)

    def keep(tiles: TileStatistics) -> Array:
        return weights[tiles.rows, tiles.cols]

    return align_reweighted(level, pyramid, shift, weights, keep, looks=False)


def _weigh_tiles(shown: _Shown, shift: Array, noise: TileNoise) -> Array:
    """(rows, cols) information of the tiles that show the lattice."""
    level = shown.level
    weights = information_weights(level, noise)
    return np.where(shown.at(shift), weights, 0.0)


def _leave_out(
    pyramid: Pyramid, found: _Candidate, noise: TileNoise, shown: _Shown
) -> ChosenShift | Rejection[MatchFailure]:
    """The shift by all that agrees with it."""
    tiles = found.alignment.tile_statistics()
    assert tiles is not None
    agreement = find_agreement(tiles, noise)
    if shown.is_all and agreement.is_complete:
        return ChosenShift(found.alignment, agreement)
    latest = [agreement]

    shift = found.shift_px
    lattice = shown.at(shift)

    def judge(tiles: TileStatistics) -> Array:
        own = find_agreement(tiles, noise)
        # A tool without structure disagrees with nothing.
        counted = np.where(lattice[tiles.rows, tiles.cols], own.weights, 0.0)
        latest[:] = [replace(own, weights=counted)]
        return counted

    weights = _weigh_tiles(shown, shift, noise)
    alignment = align_reweighted(shown.level, pyramid, shift, weights, judge, looks=False)
    if isinstance(alignment, Rejection):
        return alignment
    if np.max(np.abs(alignment.shift_px - shift)) > SAME_SHIFT_PX:
        return Rejection(
            MatchFailure.AMBIGUOUS,
            "ambiguous: what repeats moves otherwise than all that agrees with its shift",
        )
    return ChosenShift(alignment, latest[0])


def _find_least_evidence(best: _Candidate, left: int, is_predicted: bool) -> float:
    """Evidence that has to speak for a shift: two defects, and more than are left unexplained there.

    One is enough for a shift that was predicted, but not near zero: what is none of the specimen stays in its place.
    """
    moved = float(np.hypot(*best.shift_px)) > LONE_DEFECT_MOVED_PX_MIN
    least = DEFECT_EVIDENCE_MAX if is_predicted and moved else EVIDENCE_MIN
    return max(least, DEFECT_EVIDENCE_MAX * (left + 1))


def _count_left_defects(best: _Candidate, noise: TileNoise) -> int:
    """Return how many defects a shift leaves unexplained."""
    tiles = best.alignment.tile_statistics()
    assert tiles is not None
    disagrees = np.zeros_like(best.counted)
    disagrees[tiles.rows, tiles.cols] = find_agreement(tiles, noise).disagrees
    labels, bodies = cv2.connectedComponents(disagrees.astype(np.uint8), connectivity=8)
    # What has a part that is not of the lattice is no defect of it.
    return len(np.setdiff1d(np.arange(1, labels), bodies[~best.counted]))


def _find_predicted(
    compared: list[_Candidate], periods: Array, guess: Array, spread: Array | None
) -> _Candidate | None:
    """The shift that a prediction tells; None where it is not good enough. One that was not refined along lines is
    none.
    """
    if spread is None:
        return None
    shortest = float(np.min(np.hypot(*periods.T)))
    sigma = float(np.sqrt(np.max(np.linalg.eigvalsh(spread))))
    if HALF_PERIOD_SIGMAS * sigma > 0.5 * shortest:
        return None
    distances = [np.inf if c.is_held else float(np.hypot(*(c.shift_px - guess))) for c in compared]
    nearest = int(np.argmin(distances))
    return compared[nearest] if distances[nearest] < 0.25 * shortest else None


def _is_expected(candidate: _Candidate, guess: Array, spread: Array | None) -> bool:
    """Whether a shift is where it was predicted."""
    left = candidate.shift_px - guess
    return (
        spread is not None
        and float(left @ np.linalg.solve(spread, left)) <= PERIODS_REACH_SIGMAS**2
    )


def _list_shifts(
    shift: Array, periods: Array, guess: Array, spread: Array | None, size: tuple[int, int]
) -> Array:
    """Shifts of the class that the prediction allows, and those next to it; the nearest to it first."""
    counts = np.arange(-60, 61)
    if len(periods) == 1:
        steps = counts[:, None] * periods[0]
    else:
        steps = (counts[:, None, None] * periods[0] + counts[None, :, None] * periods[1]).reshape(
            -1, 2
        )
    found = shift + steps
    found = found[np.all(np.abs(found) < 0.5 * np.array(size), axis=1)]
    covariance = np.eye(2) * (0.25 * max(size)) ** 2 if spread is None else spread
    covariance = covariance + np.eye(2) * (0.5 * np.hypot(*periods[0])) ** 2
    left = found - guess
    distances = np.einsum("ni,ij,nj->n", left, np.linalg.inv(covariance), left)
    order = np.argsort(distances, kind="stable")
    # The nearest ones always compete: a jump by a period is what must not happen.
    allowed = (distances[order] <= PERIODS_REACH_SIGMAS**2) | (np.arange(len(order)) < 9)
    return found[order[allowed]][:PERIODS_COMPARED_MAX]


def _tells(first: _Candidate, second: _Candidate, least: float) -> bool:
    """Whether the defects are where the first of two shifts says, and none where the second does, or the second is
    worse everywhere.
    """
    if _is_worse_everywhere(second, first):
        return True
    pro, contra = _weigh(first, second)
    return pro >= least and contra < DEFECT_EVIDENCE_MAX


def _is_worse_everywhere(first: _Candidate, second: _Candidate) -> bool:
    """Whether the first of two shifts leaves more of the structure than the second in most tiles.

    A tile that shows less structure than noise does not say so: where the image is brighter, more noise is left there.
    """
    excess = first.energies - second.energies
    # What the better one leaves is the noise of both images.
    shows = second.structure > 0.5 * second.energies
    return _are_left(np.where(shows, excess, np.minimum(excess, 0.0)), second, first.counted)


def _leaves_structure(candidate: _Candidate, noise: TileNoise) -> bool:
    """Whether a shift leaves more in most tiles than noise that is known to a factor of two, and some of them would
    rather move: another focus alone leaves as much, and moves nothing.
    """
    expected = NOISE_DOUBT * (noise.image + noise.reference)
    if not _are_left(candidate.energies - expected, candidate, candidate.counted):
        return False
    tiles = candidate.alignment.tile_statistics()
    assert tiles is not None
    return not find_agreement(tiles, noise).is_complete


def _are_left(excess: Array, candidate: _Candidate, counted: Mask) -> bool:
    """Whether an excess (rows, cols) of squared residuals is a part of the structure in most of the counted tiles."""
    relative = excess / np.maximum(candidate.structure, 1e-30)
    own = relative[np.isfinite(relative) & counted & candidate.counted]
    if len(own) < DISORDERED_TILES_MIN:
        return False
    return float(np.mean(own > DISORDER_MIN)) >= DISORDERED_SHARE_MIN


def _weigh(first: _Candidate, second: _Candidate) -> tuple[float, float]:
    """Evidence for the first of two shifts and for the second, by the residual energies of their tiles.

    What lies together counts as one defect, however large and clear it is.
    """
    difference = second.energies - first.energies
    finite = np.isfinite(difference) & first.counted & second.counted
    if not np.any(finite):
        return 0.0, 0.0
    # At the better of the two shifts a tile has its noise, and nothing else.
    least = np.minimum(first.energies, second.energies)
    relative = difference[finite] / _noise_by_brightness(least[finite], first.brightness[finite])
    left = np.zeros(difference.shape)
    left[finite] = relative - float(np.median(relative))
    deviations = normal_deviations(left / max(mad_sigma(left[finite]), 1e-30), first.products)
    return _count_defects(deviations), _count_defects(-deviations)


def _noise_by_brightness(energies: Array, brightness: Array) -> Array:
    """(n,) energies that noise alone leaves in tiles of so much brightness: a straight line through medians of the
    darker and of the brighter third (the resistant line of Tukey, Exploratory Data Analysis, 1977, chapter 5).

    Electrons scatter more where it is bright: beside the noise of dark tiles, that of bright ones would be a defect.
    """
    middle = max(float(np.median(energies)), 1e-30)
    low, high = np.quantile(brightness, [1.0 / 3.0, 2.0 / 3.0])
    if not high > low:
        return np.full(len(energies), middle)
    dark, bright = brightness <= low, brightness >= high
    places = [float(np.median(brightness[part])) for part in (dark, bright)]
    levels = [float(np.median(energies[part])) for part in (dark, bright)]
    slope = max(0.0, (levels[1] - levels[0]) / (places[1] - places[0]))
    line = levels[0] + slope * (brightness - places[0])
    return np.maximum(line, max(min(levels), 1e-6 * middle))


def _count_defects(deviations: Array) -> float:
    """Sum of the squares of clear deviations above zero, of each body of tiles that of one defect at most."""
    clear = deviations > DEFECT_SIGMAS
    labels, bodies = cv2.connectedComponents(clear.astype(np.uint8), connectivity=8)
    sums = np.bincount(bodies.ravel(), weights=(deviations**2).ravel(), minlength=labels)
    return float(np.minimum(sums[1:], DEFECT_EVIDENCE_MAX).sum())
