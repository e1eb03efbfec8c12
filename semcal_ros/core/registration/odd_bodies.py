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

"""Which bodies of a sparse image move otherwise than all others, such as a tool at rest over particles that drift.

A tool may have more structure than all particles together, and a least-squares shift is its own. But it is one body,
and they are many: each body that lies apart from the others is a witness of its own. Where the shifts of bodies differ
by more than their noise, their scatter is estimated as well (random effects, DerSimonian and Laird 1986,
doi:10.1016/0197-2456(86)90046-2), so that none of them outweighs the rest, and the one is left out that differs from
all others by more than those do among themselves.

It fails where less than five bodies lie apart from each other, as on a continuous ground, and where as many move in one
way as in the other. Where two bodies or more move otherwise than one that outweighs them, or are not seen where it is,
it says that either may be the specimen; where that one reaches from edge to edge, as a ground does and two tools that
meet, four and more all over the field. Those that tell nothing by themselves are witnesses together.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.registration.thresholds import (
    AGREEMENT_SIGMAS,
    ODD_BODIES_LEFT_MIN,
    ODD_BODIES_SPREAD_MIN,
    ODD_BODY_CHI2_MIN,
    ODD_BODY_STAYS,
    SHEAR_OF_BODIES_PX,
    TELLING_SIGMA_PX_MAX,
    TILE_SHIFT_PX_MAX,
    WITNESSES_MIN,
)


@dataclass(frozen=True)
class OddBodies:
    """Which bodies move otherwise than all others.

    Attributes
    ----------
    tiles
        (rows, cols) True in the tiles of these.
    in_doubt
        Whether either of the others may be the specimen: a body that has more of the information than the rest, and
        does not reach from edge to edge, or these.
    largest
        (rows, cols) True in the tiles of such a body, if there are others beside it, however they move.
    others_px
        (2,) shift of those others that tell one; NaN where none does.
    """

    tiles: Mask
    in_doubt: bool
    largest: Mask
    others_px: Array


@dataclass(frozen=True)
class _Bodies:
    """Shifts (n, 2) of n bodies with their covariances (n, 2, 2), and their numbers among the labels (rows, cols)."""

    shifts: Array
    covariances: Array
    numbers: NDArray[np.intp]
    labels: NDArray[np.int32]

    def of(self, kept: Mask) -> _Bodies:
        """Some of them (n,)."""
        return _Bodies(self.shifts[kept], self.covariances[kept], self.numbers[kept], self.labels)

    def without(self, index: int) -> _Bodies:
        return self.of(np.arange(len(self.numbers)) != index)

    def beside(self, others: _Bodies) -> _Bodies:
        """These and others, of other tiles."""
        most = int(np.max(self.labels))
        labels = np.where(others.labels > 0, others.labels + most, self.labels)
        return _Bodies(
            np.concatenate([self.shifts, others.shifts]),
            np.concatenate([self.covariances, others.covariances]),
            np.concatenate([self.numbers, others.numbers + most]),
            labels,
        )

    @property
    def precisions(self) -> Array:
        """(n,) how well the shift of each is known, 1 / px^2."""
        return np.asarray(1.0 / np.trace(self.covariances, axis1=1, axis2=2))

    @property
    def middles(self) -> Array:
        """(n,) lines of their middles, in parts of the height."""
        rows = len(self.labels)
        return np.array([np.nonzero(self.labels == k)[0].mean() / rows for k in self.numbers])


def find_odd_bodies(
    informs: Mask,
    information: Array,
    pulls: Array,
    variances: Array,
    before: Mask | None = None,
    *,
    lost: Mask | None = None,
    lack: tuple[Array, Array] | None = None,
    looks_for_odd: bool = True,
) -> OddBodies:
    """Find the bodies of tiles that move otherwise than all others.

    Parameters
    ----------
    informs
        (rows, cols) True in tiles with structure; those that touch are one body.
    information, pulls
        (rows, cols, 2, 2) and (rows, cols, 2) normal matrices of the tiles and their right sides, whose solution is a
        shift in px.
    variances
        (rows, cols, 2, 2) covariances of the right sides.
    before
        (rows, cols) True in those that were odd at the shift before. They stay so unless they agree clearly, so that a
        shift that is refined step by step comes to an end.
    lost
        (rows, cols) True in tiles with structure that the image does not show at this shift; they do not inform.
        ``information`` and ``variances`` are what they would have; none by default.
    lack
        (rows, cols) by how much tiles miss more of their structure than they may, and its sigma: of bodies that tell
        nothing by themselves, together they do. None where nothing is known of it.
    looks_for_odd
        Whether any is to be found; if not, it is said whether there is doubt, alone.

    Returns
    -------
    Those bodies. One that has more of the information than all others is among them only where it lies at an edge of
    the image, over which a tool comes in, and does not reach the opposite one.
    """
    odd = np.zeros(informs.shape, dtype=bool)
    bodies = _measure_bodies(informs, information, pulls, variances)
    most = len(bodies.numbers) - ODD_BODIES_LEFT_MIN if looks_for_odd else 0
    for _ in range(min(most, len(bodies.numbers) // 2)):
        limits = np.full(len(bodies.numbers), ODD_BODY_CHI2_MIN)
        if before is not None:
            known = np.isin(bodies.numbers, bodies.labels[before])
            limits[known] *= ODD_BODY_STAYS
        # Nearly always, all move alike. By one that outweighs the rest, each of the others is off.
        if np.all(_compare_alike(bodies) < limits):
            break
        agreeing = _find_majority(bodies)
        chi2 = np.array([_compare_one(bodies, agreeing, k) for k in range(len(bodies.numbers))])
        index = int(np.argmax(chi2 / limits))
        if chi2[index] < limits[index]:
            break
        body, rest = bodies.labels == bodies.numbers[index], bodies.without(index)
        outweighs = bodies.precisions[index] > 0.5 * bodies.precisions.sum()
        if outweighs and not _may_come_in(body):
            break
        if not _are_spread(rest) and not (outweighs and _are_inside(rest)):
            break
        odd |= body
        bodies = rest
    nothing = OddBodies(odd, False, np.zeros_like(odd), np.full(2, np.nan))
    largest = _find_largest(bodies)
    if largest is None:
        return nothing
    missing = 0
    if lost is not None and np.any(lost):
        missing = _count_lost(informs | lost, lost, np.trace(information, axis1=2, axis2=3))
    faint = informs & ~odd & ~np.isin(bodies.labels, bodies.numbers)
    together, witnesses = _measure_together(faint, information, pulls, variances)
    seen = bodies.beside(together)
    if witnesses and lack is not None:
        missed, sigma = lack[0][faint], lack[1][faint]
        if missed.sum() > AGREEMENT_SIGMAS * np.sqrt(np.sum(sigma**2)):
            missing, witnesses, seen = missing + witnesses, 0, bodies
    if len(bodies.numbers) + missing + witnesses < 2:
        return nothing
    rest = bodies.without(largest)
    return OddBodies(
        odd,
        _is_in_doubt(seen, largest, missing, witnesses),
        bodies.labels == bodies.numbers[largest],
        _mean_shift(rest)[0] if len(rest.numbers) else np.full(2, np.nan),
    )


def _count_lost(structure: Mask, lost: Mask, information: Array) -> int:
    """Number of bodies that are not seen, but for less than half of their ``information`` (rows, cols)."""
    count, labels = cv2.connectedComponents(structure.astype(np.uint8), connectivity=8)
    whole, missing = (
        np.bincount(labels.ravel(), (information * part).ravel(), count)[1:]
        for part in (structure, lost)
    )
    return int(np.count_nonzero(missing > 0.5 * whole))


def _find_largest(bodies: _Bodies) -> int | None:
    """The one of the bodies that outweighs all others; None where none does, or where it reaches from edge to edge and
    the others are too few, or too close together, to be the specimen.
    """
    if not len(bodies.numbers):
        return None
    index = int(np.argmax(bodies.precisions))
    if bodies.precisions[index] <= 0.5 * bodies.precisions.sum():
        return None
    if not _reaches_across(bodies.labels == bodies.numbers[index]):
        return index
    rest = bodies.without(index)
    return index if len(rest.numbers) >= ODD_BODIES_LEFT_MIN and _are_spread(rest) else None


def _is_in_doubt(bodies: _Bodies, index: int, missing: int, faint: int) -> bool:
    """Whether the bodies beside that of an index move alike, but otherwise than it, or as many as they are,
    ``missing``, are not seen.

    The last of the bodies are as many as ``faint`` that tell a shift together, if there are any. By as much as the
    drift may shear the image, and as tiles are off, they may differ.
    """
    rest = bodies.without(index)
    others = len(rest.numbers) + max(faint - 1, 0)
    if missing >= max(WITNESSES_MIN, others):
        return True
    if not others or others + missing < WITNESSES_MIN:
        return False
    if len(rest.numbers) > 1 and np.any(_compare_alike(rest) >= ODD_BODY_CHI2_MIN):
        return False
    mean, of_mean = _mean_shift(rest)
    off = bodies.shifts[index] - mean
    apart = bodies.middles[index] - np.average(rest.middles, weights=rest.precisions)
    allowed = TILE_SHIFT_PX_MAX**2 + (SHEAR_OF_BODIES_PX * apart) ** 2
    covariance = bodies.covariances[index] + of_mean + allowed * np.eye(2)
    return bool(off @ np.linalg.solve(covariance, off) >= ODD_BODY_CHI2_MIN)


def _mean_shift(bodies: _Bodies) -> tuple[Array, Array]:
    """(2,) weighted mean of the shifts of bodies, and its covariance (2, 2)."""
    weights = np.linalg.inv(bodies.covariances)
    covariance = np.linalg.inv(weights.sum(axis=0))
    return covariance @ np.einsum("nij,nj->i", weights, bodies.shifts), covariance


def bodies_at_edges(found: Mask) -> Mask:
    """The bodies of a mask (rows, cols) that lie at an edge, over which a tool comes in."""
    _, labels = cv2.connectedComponents(found.astype(np.uint8), connectivity=8)
    at_edges = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    return np.asarray(np.isin(labels, at_edges[at_edges > 0]))


def _may_come_in(body: Mask) -> bool:
    """Whether a body lies at an edge or a corner of the image, and ends in it: a ground may reach from edge to edge."""
    return _lies_at_edge(body) and not _reaches_across(body)


def _lies_at_edge(found: Mask) -> bool:
    """Whether any of a mask (rows, cols) lies at an edge of the image."""
    return bool(np.any(found[[0, -1]]) or np.any(found[:, [0, -1]]))


def _reaches_across(body: Mask) -> bool:
    """Whether a body lies at two opposite edges of the image."""
    sides = ((body[0], body[-1]), (body[:, 0], body[:, -1]))
    return any(bool(np.any(one) and np.any(other)) for one, other in sides)


def _are_spread(bodies: _Bodies) -> bool:
    """Whether bodies lie over half of the image in both directions: those of a tool lie together."""
    found = np.isin(bodies.labels, bodies.numbers)
    extents = [np.ptp(np.flatnonzero(found.any(axis=axis))) + 1 for axis in (1, 0)]
    return bool(np.all(np.array(extents) >= ODD_BODIES_SPREAD_MIN * np.array(found.shape)))


def _are_inside(bodies: _Bodies) -> bool:
    """Whether none of the bodies lies at an edge, from where the parts of a tool come."""
    return not _lies_at_edge(np.isin(bodies.labels, bodies.numbers))


def _measure_together(
    faint: Mask, information: Array, pulls: Array, variances: Array
) -> tuple[_Bodies, int]:
    """The shift of all tiles ``faint`` as one body, and of how many it is; no body and 0 where they tell none."""
    own = faint.astype(np.uint8)
    found = _measure_labels(own.astype(np.int32), information, pulls, variances, np.inf)
    count = cv2.connectedComponents(own, connectivity=8)[0] - 1
    return found, count if len(found.numbers) else 0


def _measure_bodies(informs: Mask, information: Array, pulls: Array, variances: Array) -> _Bodies:
    """The shifts of bodies that tell one in both directions."""
    labels = cv2.connectedComponents(informs.astype(np.uint8), connectivity=8)[1]
    return _measure_labels(labels.astype(np.int32), information, pulls, variances)


def _measure_labels(
    labels: NDArray[np.int32],
    information: Array,
    pulls: Array,
    variances: Array,
    sigma_px: float = TELLING_SIGMA_PX_MAX,
) -> _Bodies:
    """The same of bodies with labels (rows, cols) from 1 on, with a sigma of their shift below ``sigma_px``."""
    count = int(np.max(labels)) + 1

    def sum_up(values: Array) -> Array:
        flat = values.reshape(labels.size, -1)
        sums = np.stack([np.bincount(labels.ravel(), one, count) for one in flat.T], axis=-1)
        return np.asarray(sums, dtype=np.float64).reshape(count, *values.shape[2:])[1:]

    normal, right, scatter = (sum_up(values) for values in (information, pulls, variances))
    trace = np.trace(normal, axis1=1, axis2=2)
    determinant = normal[:, 0, 0] * normal[:, 1, 1] - normal[:, 0, 1] ** 2
    # A straight edge tells one direction alone.
    solvable = np.flatnonzero(determinant > 1e-6 * trace**2)
    inverse = np.linalg.inv(normal[solvable])
    shifts = np.einsum("nij,nj->ni", inverse, right[solvable])
    covariances = inverse @ scatter[solvable] @ inverse
    largest = covariances[:, 0, 0] + covariances[:, 1, 1]
    tells = (largest < sigma_px**2) & (largest > 0.0)
    return _Bodies(shifts[tells], covariances[tells], solvable[tells] + 1, labels)


def _compare_alike(bodies: _Bodies) -> Array:
    """(n,) squared distances of each body from the mean of all others, in units of their noise."""
    precisions = np.linalg.inv(bodies.covariances)
    weighted = np.einsum("nij,nj->ni", precisions, bodies.shifts)
    others = np.linalg.inv(precisions.sum(axis=0) - precisions)
    means = np.einsum("nij,nj->ni", others, weighted.sum(axis=0) - weighted)
    apart = bodies.shifts - means
    solved = np.linalg.solve(bodies.covariances + others, apart[..., None])[..., 0]
    return np.asarray(np.einsum("ni,ni->n", apart, solved))


def _find_majority(bodies: _Bodies) -> Mask:
    """(n,) the bodies that may have the shift of that with which most do, if these are more than half; else all.

    Two tools that move apart would each hide behind the scatter that the other brings.
    """
    apart = bodies.shifts[:, None] - bodies.shifts
    chi2 = np.einsum("mni,nij,mnj->mn", apart, np.linalg.inv(bodies.covariances), apart)
    agree = chi2 < ODD_BODY_CHI2_MIN
    counts = agree.sum(axis=1)
    most = agree[np.argmax(counts)]
    is_majority = 2 * counts.max() > len(counts) and counts.max() >= ODD_BODIES_LEFT_MIN
    return most if is_majority else np.ones(len(counts), dtype=bool)


def _compare_one(bodies: _Bodies, agreeing: Mask, index: int) -> float:
    """Squared distance of one body from the mean of all others that agree, in units of what is expected of it if it
    moves as they do, their scatter included.
    """
    kept = agreeing.copy()
    kept[index] = False
    others = bodies.of(kept)
    precisions = np.linalg.inv(others.covariances)
    information = precisions.sum(axis=0)
    weighted = np.einsum("nij,nj->ni", precisions, others.shifts)
    mean = np.linalg.solve(information, weighted.sum(axis=0))
    apart = others.shifts - mean
    chi2 = float(np.einsum("ni,nij,nj->", apart, precisions, apart))
    freedom = 2.0 * (len(others.numbers) - 1)
    squared = (precisions @ precisions).sum(axis=0)
    scale = np.trace(information) - np.trace(np.linalg.solve(information, squared))
    spread = np.eye(2) * max(0.0, (chi2 - freedom) / float(scale))
    mean, of_mean = _mean_shift(replace(others, covariances=others.covariances + spread))
    off = bodies.shifts[index] - mean
    return float(off @ np.linalg.solve(bodies.covariances[index] + spread + of_mean, off))
