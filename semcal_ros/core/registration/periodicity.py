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

"""Shift of a periodic specimen: its period leaves a class of shifts, among which only defects can tell.

All shifts that differ by a period show a perfect lattice alike. Defects decide: at a wrong shift, every defect
disagrees twice, where it is and where it should be. What no defect tells is refused where the lattice is fine, since a
prediction would only hide a jump by a period. Where a period is a good part of the field, a jump by one is a move of
the stage and no drift, and a prediction that is good to a tenth of it decides.
"""

from __future__ import annotations

import cv2
import numpy as np
import scipy.fft

from semcal_ros.core.arrays import Array, Image, mad_sigma
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.registration.inverse_compositional import (
    Alignment,
    align,
    tile_residual_energies,
)
from semcal_ros.core.registration.normalised_correlation import parabola_vertex, remove_shading
from semcal_ros.core.registration.thresholds import (
    COARSE_PERIOD_MIN,
    DEFECT_EVIDENCE_MAX,
    DEFECT_SIGMAS,
    DIP_MAX,
    EVIDENCE_MIN,
    HALF_PERIOD_SIGMAS,
    PERIOD_PX_MIN,
    PERIODS_COMPARED_MAX,
    PERIODS_REACH_SIGMAS,
    PERIODS_SIDE_PX_MAX,
    PERIODS_SINE_MIN,
    REPEATED_MIN,
    SAME_SHIFT_PX,
)
from semcal_ros.core.registration.tiles import Pyramid, PyramidLevel


def find_periods(image: Image, noise_variance: float) -> Array:
    """(k, 2) periods (x, y) of an image, px, the shortest first; k is 0 where nothing repeats, 1 for lines.

    Parameters
    ----------
    image
        (h, w) grey levels.
    noise_variance
        Variance of its white noise.
    """
    rows, cols = (min(n, PERIODS_SIDE_PX_MAX) for n in image.shape)
    top, left = (image.shape[0] - rows) // 2, (image.shape[1] - cols) // 2
    part = remove_shading(np.asarray(image[top : top + rows, left : left + cols]))
    part = part - part.mean()
    size = (
        scipy.fft.next_fast_len(2 * rows, real=True),
        scipy.fft.next_fast_len(2 * cols, real=True),
    )
    spectrum = scipy.fft.rfft2(part, size)
    whole = scipy.fft.irfft2(np.abs(spectrum) ** 2, size)
    high, wide = rows // 2, cols // 2
    # Lags of one half plane; the other one is its mirror image.
    lags = np.concatenate([whole[: high + 1, -wide:], whole[: high + 1, : wide + 1]], axis=1)
    y, x = np.arange(high + 1)[:, None], np.arange(-wide, wide + 1)[None, :]
    surface = lags / ((rows - y) * (cols - np.abs(x)))
    structure = float(surface[0, wide]) - noise_variance
    if structure <= 0.0:
        return np.zeros((0, 2))
    surface = surface / structure
    peaks = _find_repeats(surface, wide)
    if not peaks:
        return np.zeros((0, 2))
    first = peaks[0]
    for second in peaks[1:]:
        across = abs(first[0] * second[1] - first[1] * second[0])
        if across > PERIODS_SINE_MIN * np.hypot(*first) * np.hypot(*second):
            return np.array([first, second])
    return np.array([first])


def _find_repeats(surface: Array, wide: int) -> list[tuple[float, float]]:
    """Lags at which the structure repeats, the shortest first."""
    inner = surface[1:-1, 1:-1]
    is_peak = inner >= REPEATED_MIN
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            if dy or dx:
                rows, cols = surface.shape
                is_peak &= inner >= surface[1 + dy : rows - 1 + dy, 1 + dx : cols - 1 + dx]
    found = []
    for row, col in zip(*np.nonzero(is_peak), strict=True):
        y, x = float(row + 1), float(col + 1 - wide)
        length = np.hypot(x, y)
        if length < PERIOD_PX_MIN:
            continue
        steps = np.linspace(0.0, 1.0, int(2 * length) + 1)[1:-1]
        way = surface[np.rint(steps * y).astype(int), np.rint(steps * x).astype(int) + wide]
        if float(way.min()) > DIP_MAX * surface[row + 1, col + 1]:
            continue
        found.append(
            (
                length,
                x + parabola_vertex(*surface[row + 1, col : col + 3]),
                y + parabola_vertex(*surface[row : row + 3, col + 1]),
            )
        )
    # Lags along the first row have their mirror image in it.
    mirrored = surface[0]
    for col in range(wide + int(PERIOD_PX_MIN), len(mirrored) - 1):
        x = float(col - wide)
        if mirrored[col] < REPEATED_MIN or mirrored[col] < max(
            mirrored[col - 1], mirrored[col + 1]
        ):
            continue
        if mirrored[col] < max(surface[1, col - 1 : col + 2]):
            continue
        if float(mirrored[wide + 1 : col].min()) <= DIP_MAX * mirrored[col]:
            found.append((x, x + parabola_vertex(*mirrored[col - 1 : col + 2]), 0.0))
    return [(x, y) for _, x, y in sorted(found)]


def choose_period(
    levels: tuple[PyramidLevel, ...],
    pyramid: Pyramid,
    periods: Array,
    start_px: Array,
    guess: Array,
    spread: Array | None,
) -> Alignment | Rejection[MatchFailure]:
    """The shift of a periodic specimen that its defects tell, or why it is not told.

    Parameters
    ----------
    levels, pyramid
        Reference and image.
    periods
        As found by :func:`find_periods`.
    start_px
        (2,) any shift that explains the image.
    guess, spread
        (2,) predicted shift and its covariance (2, 2), or None.
    """
    fine = levels[-1:]
    first = align(fine, pyramid, start_px)
    if isinstance(first, Rejection):
        return first
    shifts = _list_shifts(first.shift_px, periods, guess, spread, fine[0].size)
    compared: list[tuple[Alignment, Array]] = []
    for shift in shifts:
        found = align(fine, pyramid, shift)
        if isinstance(found, Rejection) or not found.converged:
            continue
        if any(np.max(np.abs(found.shift_px - a.shift_px)) < SAME_SHIFT_PX for a, _ in compared):
            continue
        energies = tile_residual_energies(fine[0], pyramid, found.shift_px)
        if energies is not None:
            compared.append((found, energies))
    if not compared:
        return Rejection(MatchFailure.NOT_CONVERGED, "refinement did not converge at any period")
    best = compared[0]
    for other in compared[1:]:
        pro, contra = _weigh(best[1], other[1])
        if pro < contra:
            best = other
    predicted = _find_predicted(compared, periods, guess, spread, fine[0].size)
    if predicted is not None and (predicted is best or not _tells(best[1], predicted[1])):
        return predicted[0]
    x, y = best[0].shift_px.tolist()
    for other in compared:
        if other is not best and not _tells(best[1], other[1]):
            a, b = other[0].shift_px.tolist()
            return Rejection(
                MatchFailure.AMBIGUOUS,
                f"ambiguous: a specimen that repeats every {np.hypot(*periods[0]):.1f} px, whose defects do not tell "
                f"shifts ({x:.1f}, {y:.1f}) and ({a:.1f}, {b:.1f}) px apart",
            )
    if len(compared) == 1:
        return Rejection(
            MatchFailure.AMBIGUOUS,
            f"ambiguous: a specimen that repeats every {np.hypot(*periods[0]):.1f} px, and only one shift to compare",
        )
    return best[0]


def _find_predicted(
    compared: list[tuple[Alignment, Array]],
    periods: Array,
    guess: Array,
    spread: Array | None,
    size: tuple[int, int],
) -> tuple[Alignment, Array] | None:
    """The shift that a prediction tells; None where the lattice is fine, or the prediction not good enough."""
    shortest = float(np.min(np.hypot(*periods.T)))
    if spread is None or shortest < COARSE_PERIOD_MIN * min(size):
        return None
    sigma = float(np.sqrt(np.max(np.linalg.eigvalsh(spread))))
    if HALF_PERIOD_SIGMAS * sigma > 0.5 * shortest:
        return None
    distances = [float(np.hypot(*(a.shift_px - guess))) for a, _ in compared]
    nearest = int(np.argmin(distances))
    return compared[nearest] if distances[nearest] < 0.25 * shortest else None


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


def _tells(first: Array, second: Array) -> bool:
    """Whether the defects are where the first of two shifts says, and none where the second does."""
    pro, contra = _weigh(first, second)
    return pro >= EVIDENCE_MIN and contra < DEFECT_EVIDENCE_MAX


def _weigh(first: Array, second: Array) -> tuple[float, float]:
    """Evidence for the first of two shifts and for the second, by the residual energies (rows, cols) of their tiles.

    What lies together counts as one defect, however large and clear it is: the outline of a tool must not outvote the
    defects of a lattice.
    """
    difference = second - first
    finite = np.isfinite(difference)
    if not np.any(finite):
        return 0.0, 0.0
    middle = float(np.median(difference[finite]))
    deviations = (difference - middle) / max(mad_sigma(difference[finite] - middle), 1e-30)
    deviations = np.where(finite, deviations, 0.0)
    return _count_defects(deviations), _count_defects(-deviations)


def _count_defects(deviations: Array) -> float:
    """Sum of the squares of clear deviations above zero, of each body of tiles that of one defect at most."""
    clear = deviations > DEFECT_SIGMAS
    labels, bodies = cv2.connectedComponents(clear.astype(np.uint8), connectivity=8)
    sums = np.bincount(bodies.ravel(), weights=(deviations**2).ravel(), minlength=labels)
    return float(np.minimum(sums[1:], DEFECT_EVIDENCE_MAX).sum())
