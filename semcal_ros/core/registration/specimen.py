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

"""The shift of the specimen where not all of an image moves with it.

Starts are the prediction, the highest peaks of the correlation, and what the whole image asked for. From each the shift
is refined by those tiles that agree with it (:mod:`.agreement`). The specimen is what moves as predicted, if only one
of these motions does and the prediction is good to a few pixels; otherwise what has nearly all of the structure. Where
nothing says which it is, the image is refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import AnyImage, Array, Mask
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.agreement import (
    Agreement,
    MovingTiles,
    TileNoise,
    find_agreement,
    information_weights,
)
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.registration.fixed_pixels import grow_mask
from semcal_ros.core.registration.inverse_compositional import (
    Alignment,
    TileStatistics,
    align_reweighted,
)
from semcal_ros.core.registration.noise_spectrum import estimate_noise_variance
from semcal_ros.core.registration.normalised_correlation import CoarsePeak
from semcal_ros.core.registration.one_direction import OneDirection, known_across
from semcal_ros.core.registration.reference import Reference, Region
from semcal_ros.core.registration.thresholds import (
    HYPOTHESES_MAX,
    MAJORITY_SHARE,
    NEAR_CHI2_MAX,
    NOISE_PATCHES,
    PREDICTED_PX_MAX,
    PREDICTED_SHARE_MIN,
    SAME_SHIFT_PX,
    SPECIMEN_SHARE_MIN,
    WELL_PREDICTED_PX,
)
from semcal_ros.core.registration.tiles import Pyramid


@dataclass(frozen=True)
class _Hypothesis:
    """A shift of those tiles that agree with it; ``suspected`` are those where something moved in the image before."""

    alignment: Alignment
    agreement: Agreement
    start: CoarsePeak
    suspected: Mask | None

    @property
    def share(self) -> float:
        """Part of the structure that agrees, where most of it did not move otherwise in the image before: of that.

        A tool that was known before stays where it is when the stage moves.
        """
        if self.suspected is None:
            return self.agreement.share
        others = ~grow_mask(self.suspected, 1)
        informs = self.agreement.informs
        total = float(informs[others].sum())
        if total <= MAJORITY_SHARE * float(informs.sum()):
            return self.agreement.share
        return float(informs[others & ~self.agreement.disagrees].sum()) / total


def look_at_whole(
    reference: Reference,
    alignment: Alignment | Rejection[MatchFailure],
    image_noise: float,
    stretch_px: float = 0.0,
) -> Agreement | None:
    """Which tiles agree with an alignment of the whole image, whose edges another scale may have moved by
    ``stretch_px``; None where it did not converge.
    """
    if isinstance(alignment, Rejection) or not alignment.converged:
        return None
    statistics = alignment.tile_statistics()
    assert statistics is not None
    sigma_px = reference.levels[-1].sigma_px
    noise = TileNoise.of(sigma_px, reference.noise_variance, image_noise)
    found = find_agreement(statistics, noise, stretch_px=stretch_px)
    if not np.any(found.informs > 0.0):
        # Of a faint structure, which the image has as a whole, no tile tells what it is; all of them count.
        return replace(found, share=1.0 - float(np.mean(found.disagrees)))
    return found


@dataclass(frozen=True)
class Kept:
    """The specimen alone, of an image in which something else moves.

    Attributes
    ----------
    alignment
        That of the specimen, or why it is not known.
    peak
        Where it was looked for.
    moving, share
        What moves otherwise, and the part of the structure that agrees, as of :class:`_Hypothesis`.
    other_px
        (2,) another shift with which a part of the image agrees, which may be the one; NaN where there is none.
    """

    alignment: Alignment | Rejection[MatchFailure]
    peak: CoarsePeak
    moving: MovingTiles | None
    share: float
    other_px: Array


def keep_specimen(
    reference: Reference,
    pyramid: Pyramid,
    alignment: Alignment | Rejection[MatchFailure],
    peak: CoarsePeak,
    peaks: list[CoarsePeak],
    guess: Array,
    spread: Array | None,
    follow_px: Region | None = None,
    suspected: MovingTiles | None = None,
    stretch_px: float = 0.0,
) -> Kept | None:
    """The alignment of the specimen alone where not all of the image moves with it; None where all does.

    What moves as the part ``follow_px`` of the image does is the specimen, if there is such a part; ``suspected`` is
    where something moved otherwise in the image before, and ``stretch_px`` by how much another scale may move edges.
    """
    level, noise = reference.levels[-1], noise_beside_tools(reference, pyramid)
    first = information_weights(level, noise)
    starts = [peak, *(p for p in peaks[:HYPOTHESES_MAX] if p is not peak)]
    sigma = np.inf if spread is None else float(np.sqrt(np.max(np.linalg.eigvalsh(spread))))
    if sigma < PREDICTED_PX_MAX:
        x, y = guess.tolist()
        starts.insert(0, replace(peak, shift_px=(x, y), step_px=1.0 + 3.0 * sigma))
    if isinstance(alignment, Alignment) and alignment.converged:
        x, y = alignment.shift_px.tolist()
        starts.insert(0, replace(peak, shift_px=(x, y), step_px=peak.step_px))
    found: list[_Hypothesis] = []
    tries = [(start, suspected) for start in starts]
    for start, known in tries:
        if any(
            np.max(np.abs(np.subtract(start.shift_px, h.alignment.shift_px))) < SAME_SHIFT_PX
            for h in found
        ):
            continue
        for looks_for_odd in (True, False):
            judge = _Judge(
                reference, noise, known, np.array(start.shift_px), stretch_px, looks_for_odd
            )
            tried = align_reweighted(
                level,
                pyramid,
                np.array(start.shift_px),
                judge.first(first),
                judge,
                looks=known is None,
            )
            agreement, is_one = judge.latest, False
            if not isinstance(tried, Rejection) and tried.converged:
                assert agreement is not None
                is_one = agreement.share >= PREDICTED_SHARE_MIN and agreement.are_bodies
            # Of few bodies, what is left without an odd one may be too little.
            if is_one or not judge.found_odd:
                break
        if isinstance(tried, Rejection) or agreement is None:
            continue
        if is_one and not any(
            np.max(np.abs(tried.shift_px - h.alignment.shift_px)) < SAME_SHIFT_PX for h in found
        ):
            found.append(_Hypothesis(tried, agreement, start, judge.suspected))
            has_others = bool(np.all(np.isfinite(agreement.odd.others_px)))
            if agreement.odd.in_doubt and has_others and known is suspected:
                # What the others show without the largest body.
                x, y = (tried.shift_px + agreement.odd.others_px).tolist()
                largest = _find_tiles(reference, tried, agreement.odd.largest)
                tries.append((replace(start, shift_px=(x, y)), largest))
            if follow_px is not None:
                # Another one may be that of the part that is the specimen.
                continue
            is_near = spread is not None and _is_near(tried, guess, spread)
            is_most = (
                agreement.share > MAJORITY_SHARE and judge.share_of_new < 1.0 - SPECIMEN_SHARE_MIN
            ) and not agreement.odd.in_doubt
            if is_near and sigma < WELL_PREDICTED_PX and is_most:
                # No other one can have as much, and no tool comes in so fast.
                break
    if not found:
        return None
    best: _Hypothesis | Rejection[MatchFailure]
    if follow_px is not None:
        best = _choose_followed(found, reference, follow_px)
    else:
        best = _choose_hypothesis(reference, found, guess, spread)
    others = [h for h in found if h is not best]
    if isinstance(best, Rejection) and best.status is MatchFailure.STAGE_MOVE:
        others = [h for h in found if spread is None or not _is_near(h.alignment, guess, spread)]
    other_px = np.full(2, np.nan)
    if others:
        other_px = max(others, key=lambda h: h.agreement.share).alignment.shift_px
    if isinstance(best, Rejection):
        return Kept(best, peak, None, 0.0, other_px)
    moving = find_moving(reference, best.alignment, best.agreement)
    share = best.share
    if follow_px is not None:
        share = _share_inside(best.alignment, best.agreement, reference, follow_px)
    return Kept(best.alignment, best.start, moving, share, other_px)


def are_edges(agreement: Agreement) -> bool:
    """Whether lines may be the edges of a thing: other bodies move otherwise, or lie beside lines that do not run
    through the image.
    """
    runs_through = float(np.mean(agreement.informs > 0.0)) > MAJORITY_SHARE
    return agreement.odd.in_doubt or bool(np.any(agreement.odd.largest) and not runs_through)


def keep_across(
    reference: Reference, pyramid: Pyramid, lines: OneDirection, guess: Array, spread: Array
) -> Kept | None:
    """What moves across lines as predicted, at the predicted place along them; None where the prediction is uncertain,
    too little does, or the stage may have moved within the image.
    """
    predicted = float(lines.across @ spread @ lines.across)
    if not predicted <= WELL_PREDICTED_PX**2:
        return None
    level, noise = reference.levels[-1], noise_beside_tools(reference, pyramid)
    judge = _Judge(reference, noise, None, guess, 0.0, looks_for_odd=False)
    first = judge.first(information_weights(level, noise))
    found = align_reweighted(level, pyramid, guess, first, judge, held=lines.along)
    agreement = judge.latest
    if isinstance(found, Rejection) or not found.converged or agreement is None:
        return None
    innovation = float(lines.across @ (found.shift_px - guess))
    is_near = innovation**2 <= NEAR_CHI2_MAX * (predicted + SAME_SHIFT_PX**2)
    is_most = agreement.share > MAJORITY_SHARE and agreement.are_bodies
    if not (is_near and is_most) or are_edges(agreement):
        return None
    x, y = guess.tolist()
    peak = CoarsePeak((x, y), float("nan"), float("nan"), 1.0)
    if _are_lines_elsewhere(_sum_lines(reference, _Hypothesis(found, agreement, peak, None))):
        return None
    alone = known_across(found, lines, spread, agreement.weights > 0.0)
    if isinstance(alone, Rejection):
        return None
    moving = find_moving(reference, found, agreement)
    return Kept(alone, peak, moving, agreement.share, np.full(2, np.nan))


class _Judge:
    """Which tiles agree near a shift, of an image in which something may move where it did so in the image before."""

    def __init__(
        self,
        reference: Reference,
        noise: TileNoise,
        suspected: MovingTiles | None,
        shift_px: Array,
        stretch_px: float,
        looks_for_odd: bool,
    ) -> None:
        level, self._noise, self._stretch_px = reference.levels[-1], noise, stretch_px
        self._looks_for_odd = looks_for_odd
        #: Whether a body was left out that only differs from all others.
        self.found_odd = False
        self.latest: Agreement | None = None
        self._suspected: Mask | None = None
        self._place: tuple[int, int, tuple[int, ...]] | None = None
        #: Of the tiles that were compared last.
        self.suspected: Mask | None = None
        if suspected is not None:
            rows, cols = level.normal_matrices.shape[:2]
            x, y = (
                origin + side * (np.arange(count) + 0.5) + shift
                for origin, side, count, shift in zip(
                    level.origin, level.side, (cols, rows), shift_px.tolist(), strict=True
                )
            )
            self._suspected = suspected.at(x, y)

    def first(self, weights: Array) -> Array:
        """Weights (rows, cols) to begin with, without what is suspected and what lies around it."""
        if self._suspected is None:
            return weights
        return np.where(grow_mask(self._suspected, 1), 0.0, weights)

    def __call__(self, tiles: TileStatistics) -> Array:
        """Weights of the compared tiles."""
        self.suspected = (
            None if self._suspected is None else self._suspected[tiles.rows, tiles.cols]
        )
        # At another shift, other tiles may be compared.
        place = tiles.rows.start, tiles.cols.start, tiles.pixels.shape
        odd = None
        if self.latest is not None and place == self._place:
            odd = self.latest.odd.tiles
        self._place = place
        self.latest = find_agreement(
            tiles,
            self._noise,
            self.suspected,
            self._stretch_px,
            odd,
            looks_for_odd=self._looks_for_odd,
        )
        self.found_odd |= bool(np.any(self.latest.odd.tiles))
        return self.latest.weights

    @property
    def share_of_new(self) -> float:
        """Part of the structure that disagrees and did not do so in the image before."""
        assert self.latest is not None
        new, informs = self.latest.disagrees, self.latest.informs
        if self.suspected is not None:
            new = new & ~grow_mask(self.suspected, 1)
        return float(informs[new].sum() / max(informs.sum(), 1e-30))


def _choose_followed(
    found: list[_Hypothesis], reference: Reference, follow_px: Region
) -> _Hypothesis | Rejection[MatchFailure]:
    """The shift with which a part of the image agrees."""
    shares = [_share_inside(h.alignment, h.agreement, reference, follow_px) for h in found]
    best = int(np.argmax(shares))
    return found[best] if shares[best] > SPECIMEN_SHARE_MIN else _not_followed(shares[best])


def refuse_unless_followed(
    reference: Reference, alignment: Alignment, image_noise: float, follow_px: Region
) -> Rejection[MatchFailure] | None:
    """Return why an alignment is not that of a part of the image; None if it is."""
    agreement = look_at_whole(reference, alignment, image_noise)
    share = 0.0
    if agreement is not None:
        share = _share_inside(alignment, agreement, reference, follow_px)
    return None if share > SPECIMEN_SHARE_MIN else _not_followed(share)


def _not_followed(share: float) -> Rejection[MatchFailure]:
    return Rejection(
        MatchFailure.AMBIGUOUS,
        f"ambiguous: {100.0 * max(share, 0.0):.0f} % of the structure of the part to follow moves by one shift",
    )


def _share_inside(
    alignment: Alignment, agreement: Agreement, reference: Reference, part: Region
) -> float:
    """Part of the structure inside a rectangle of the image that agrees with a shift; 0 without structure there."""
    statistics, level = alignment.tile_statistics(), reference.levels[-1]
    assert statistics is not None
    corner, side = _first_corner(reference, statistics, alignment), level.side
    rows, cols = agreement.disagrees.shape
    x, y = (
        corner[axis] + (np.arange(count) + 0.5) * side[axis]
        for axis, count in ((0, cols), (1, rows))
    )
    inside = np.outer((y >= part[1]) & (y < part[3]), (x >= part[0]) & (x < part[2]))
    weight = np.trace(statistics.gradient, axis1=-2, axis2=-1) * agreement.informs * inside
    agreeing = float(weight[~agreement.disagrees].sum())
    return agreeing / max(float(weight.sum()), 1e-30)


def refuse_other_motions(whole: Agreement) -> Rejection[MatchFailure] | None:
    """Return why an image of which all is taken for the specimen is refused for what does not move with the rest; None
    where nearly all does.
    """
    if whole.share < SPECIMEN_SHARE_MIN:
        reason = f"ambiguous: {100.0 * (1.0 - whole.share):.0f} % of the structure does not move with the rest"
        return Rejection(MatchFailure.AMBIGUOUS, reason)
    return _refuse_doubt() if whole.odd.in_doubt else None


def _refuse_doubt() -> Rejection[MatchFailure]:
    return Rejection(
        MatchFailure.AMBIGUOUS,
        "ambiguous: one body has most of the structure, and others move otherwise; nothing says which of them are the "
        "specimen",
    )


def _choose_hypothesis(
    reference: Reference, found: list[_Hypothesis], guess: Array, spread: Array | None
) -> _Hypothesis | Rejection[MatchFailure]:
    """The shift that is the specimen's: by the prediction, or because nearly all agrees with it.

    A stage that moves within a frame leaves its first lines where they were predicted, and the rest at another shift.
    """
    ordered = sorted(found, key=lambda h: -h.agreement.share)
    if spread is not None:
        near = [h for h in ordered if _is_near(h.alignment, guess, spread)]
        sigma = float(np.sqrt(np.max(np.linalg.eigvalsh(spread))))
        if sigma < PREDICTED_PX_MAX:
            moved = _find_move(reference, near[0], ordered) if len(near) == 1 else None
            sure = [h for h in near if not h.agreement.odd.in_doubt]
            if moved is not None or len(sure) == 1:
                return moved or sure[0]
    best = ordered[0]
    others = sum(h.agreement.share for h in ordered[1:])
    if best.agreement.odd.in_doubt:
        return _refuse_doubt()
    if best.agreement.share > SPECIMEN_SHARE_MIN and others < 0.5 * best.agreement.share:
        return best
    return Rejection(
        MatchFailure.AMBIGUOUS,
        f"ambiguous: {100.0 * best.agreement.share:.0f} % of the structure moves by one shift, and "
        "nothing says that this is the specimen",
    )


def _find_move(
    reference: Reference, first: _Hypothesis, found: Sequence[_Hypothesis]
) -> Rejection[MatchFailure] | None:
    """Why an image is no picture of one place: its lines up to one of them agree with one shift, and those from there
    on with another one. None where that is not so.

    A tool that moves over the specimen is not found at another place of the reference, or not over whole lines.
    """
    own = _sum_lines(reference, first)
    for other in found:
        if other is first:
            continue
        others = _sum_lines(reference, other)
        line, least, most = max(
            (
                _compare_sides(*pair, line)
                for line in own.y[1:].tolist()
                for pair in ((own, others), (others, own))
            ),
            key=lambda sides: sides[1] - sides[2],
        )
        if least > SPECIMEN_SHARE_MIN > most:
            moved_px = float(np.hypot(*(other.alignment.shift_px - first.alignment.shift_px)))
            return Rejection(
                MatchFailure.STAGE_MOVE,
                f"the stage moved within the frame: from line {line:.0f} on, the specimen is {moved_px:.1f} px away "
                "from where the lines before show it",
            )
    return None


def _compare_sides(before: _Lines, after: _Lines, line: float) -> tuple[float, float, float]:
    """The line, how much agrees with one shift above it and with the other one from it on, the least of the two, and
    the most of what agrees on the sides that are not theirs.
    """
    least = min(before.share(line, above=True), after.share(line, above=False))
    return line, least, max(before.share(line, above=False), after.share(line, above=True))


@dataclass(frozen=True)
class _Lines:
    """How much of the lines of tiles agrees with a shift: (rows,) their places in the image, what of them does, and
    their structure.
    """

    y: Array
    agreeing: Array
    whole: Array

    def share(self, line: float, *, above: bool) -> float:
        """Part of the structure above a line, or from it on, that agrees."""
        chosen = (self.y < line) == above
        return float(self.agreeing[chosen].sum() / max(self.whole[chosen].sum(), 1e-30))


def _are_lines_elsewhere(lines: _Lines) -> bool:
    """Whether all lines above or below one disagree and the others agree: a stage that moved leaves them so."""
    for line in lines.y[1:].tolist():
        sides = [lines.share(line, above=above) for above in (True, False)]
        if max(sides) > SPECIMEN_SHARE_MIN and min(sides) < 1.0 - SPECIMEN_SHARE_MIN:
            return True
    return False


def _sum_lines(reference: Reference, hypothesis: _Hypothesis) -> _Lines:
    agreement = hypothesis.agreement
    statistics = hypothesis.alignment.tile_statistics()
    assert statistics is not None
    top, side = (
        float(values[1])
        for values in (
            _first_corner(reference, statistics, hypothesis.alignment),
            reference.levels[-1].side,
        )
    )
    informs = agreement.informs
    if hypothesis.suspected is not None:
        # A tool agrees with neither shift.
        informs = np.where(grow_mask(hypothesis.suspected, 1), 0.0, informs)
    y = top + side * (np.arange(len(informs)) + 0.5)
    agreeing = np.asarray(np.sum(informs * ~agreement.disagrees, axis=1))
    return _Lines(np.asarray(y, dtype=np.float64), agreeing, informs.sum(axis=1))


def _is_near(alignment: Alignment, guess: Array, spread: Array) -> bool:
    innovation = alignment.shift_px - guess
    covariance = spread + alignment.covariance + np.eye(2) * SAME_SHIFT_PX**2
    return float(innovation @ np.linalg.solve(covariance, innovation)) <= NEAR_CHI2_MAX


def find_moving(
    reference: Reference, alignment: Alignment, agreement: Agreement
) -> MovingTiles | None:
    """What does not agree with an alignment; None where all does."""
    moving = _find_tiles(reference, alignment, agreement.disagrees)
    return moving if moving.share > 0.0 else None


def _find_tiles(reference: Reference, alignment: Alignment, tiles: Mask) -> MovingTiles:
    """Tiles (rows, cols) that were compared, at their place in the image."""
    statistics = alignment.tile_statistics()
    assert statistics is not None
    side = np.array(reference.levels[-1].side, dtype=np.float64)
    return MovingTiles.of(tiles, _first_corner(reference, statistics, alignment), side)


def _first_corner(reference: Reference, statistics: TileStatistics, alignment: Alignment) -> Array:
    """(2,) left and top of the first tile in the image."""
    level = reference.levels[-1]
    first = np.array([statistics.cols.start, statistics.rows.start])
    return np.array(level.origin) + first * np.array(level.side) + alignment.shift_px


def noise_beside_tools(reference: Reference, pyramid: Pyramid) -> TileNoise:
    """Noise of a reference and of an image in which something may have come in."""
    image = _estimate_least_noise(pyramid.full)
    return TileNoise.of(reference.levels[-1].sigma_px, reference.noise_variance, image)


def _estimate_least_noise(image: AnyImage) -> float:
    """Variance of the noise where it is small: a bright tool has more of it."""
    height, width = image.shape
    patches = [
        image[
            row * height // NOISE_PATCHES : (row + 1) * height // NOISE_PATCHES,
            col * width // NOISE_PATCHES : (col + 1) * width // NOISE_PATCHES,
        ]
        for row in range(NOISE_PATCHES)
        for col in range(NOISE_PATCHES)
    ]
    variances = sorted(estimate_noise_variance(patch) for patch in patches)
    return variances[NOISE_PATCHES]
