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

"""Peak disambiguation: which of several shifts that explain an image about equally well to use.

On a lattice every period gives a peak. Competing peaks are refined and compared tile by tile at
full resolution; what the tiles cannot tell apart, a prediction may decide.
"""

from __future__ import annotations

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.acceptance import find_divergence
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.registration.inverse_compositional import (
    Alignment,
    align,
    tile_residual_energies,
)
from semcal_ros.core.registration.normalised_correlation import CoarsePeak
from semcal_ros.core.registration.reference import Reference
from semcal_ros.core.registration.thresholds import (
    COMMON_TILES_MIN,
    CONTRADICTION_MIN,
    PREDICTED_CHI2_MAX,
    RESIDUAL_DIFFERENCE_MIN,
    SAME_SHIFT_PX,
)
from semcal_ros.core.registration.tiles import Pyramid


def choose_peak(
    reference: Reference,
    pyramid: Pyramid,
    peaks: list[CoarsePeak],
    guess: Array,
    guess_covariance: Array | None,
) -> tuple[CoarsePeak, Alignment | None] | Rejection[MatchFailure]:
    """The peak to use.

    Parameters
    ----------
    reference, pyramid
        The two images.
    peaks
        Peaks of their correlation, the highest first; at least one.
    guess, guess_covariance
        (2,) predicted shift and its covariance (2, 2), or None.

    Returns
    -------
    The peak with its alignment, which is None where there was no need to refine it; or a rejection
    where the image does not tell which one, or with the reason why the highest of them cannot be
    refined where none can.

    Notes
    -----
    Peaks are compared at full resolution: reduced images differ by how their pixels happen to
    fall.
    """
    limits, level = reference.settings, reference.levels[-1]
    least = limits.min_competing_height * peaks[0].correlation
    competitors = [p for p in peaks if p.correlation >= least]
    if len(competitors) > 1 and guess_covariance is not None:
        predicted = [p for p in competitors if _is_predicted(p, guess, guess_covariance)]
        if predicted and competitors[0] not in predicted:
            # The prediction decides between equals; it does not override the image.
            return _prefer_prediction(reference, pyramid, predicted[0], competitors[0])
        competitors = predicted or competitors
    if len(competitors) == 1:
        return competitors[0], None
    best: tuple[CoarsePeak, Alignment, Array | None] | None = None
    rejections: list[Rejection[MatchFailure]] = []
    for peak in competitors:
        alignment = _refine(reference, pyramid, peak)
        if isinstance(alignment, Rejection):
            rejections.append(alignment)
            continue
        energies = tile_residual_energies(level, pyramid, alignment.shift_px)
        if best is None:
            best = peak, alignment, energies
            continue
        shift, other = best[1].shift_px, alignment.shift_px
        if float(np.max(np.abs(other - shift))) < SAME_SHIFT_PX:
            continue
        deviations = compare_residuals(best[2], energies)
        if abs(deviations) < limits.min_deviations:
            return Rejection(
                MatchFailure.AMBIGUOUS,
                f"ambiguous: shifts ({shift[0]:.1f}, {shift[1]:.1f}) and"
                f" ({other[0]:.1f}, {other[1]:.1f}) px explain the image equally well",
            )
        if deviations < 0.0:
            best = peak, alignment, energies
    if best is None:
        # The same for all of them, or else that of the shift that is the likeliest by correlation.
        return rejections[0]
    return best[:2]


def _refine(
    reference: Reference, pyramid: Pyramid, peak: CoarsePeak
) -> Alignment | Rejection[MatchFailure]:
    """Align at a peak; a rejection where that does not converge."""
    alignment = align(reference.levels, pyramid, np.array(peak.shift_px))
    if isinstance(alignment, Rejection):
        return alignment
    return find_divergence(alignment) or alignment


def _prefer_prediction(
    reference: Reference, pyramid: Pyramid, predicted: CoarsePeak, highest: CoarsePeak
) -> tuple[CoarsePeak, Alignment | None] | Rejection[MatchFailure]:
    """The predicted peak, unless the highest one explains the image clearly better."""
    alignments = [_refine(reference, pyramid, p) for p in (predicted, highest)]
    energies = [
        None
        if isinstance(alignment, Rejection)
        else tile_residual_energies(reference.levels[-1], pyramid, alignment.shift_px)
        for alignment in alignments
    ]
    deviations = compare_residuals(energies[0], energies[1], CONTRADICTION_MIN)
    if deviations < -reference.settings.min_deviations:
        x, y = highest.shift_px
        return Rejection(
            MatchFailure.AMBIGUOUS,
            f"ambiguous: the image shows a shift of ({x:.1f}, {y:.1f}) px, far from the prediction",
        )
    return predicted, None if isinstance(alignments[0], Rejection) else alignments[0]


def _is_predicted(peak: CoarsePeak, guess: Array, guess_covariance: Array) -> bool:
    """Whether a peak lies within three deviations of the prediction."""
    innovation = np.asarray(peak.shift_px) - guess
    covariance = guess_covariance + np.eye(2) * (0.5 * peak.step_px) ** 2
    return float(innovation @ np.linalg.solve(covariance, innovation)) <= PREDICTED_CHI2_MAX


def compare_residuals(
    first: Array | None, second: Array | None, least: float = RESIDUAL_DIFFERENCE_MIN
) -> float:
    """By how many standard errors the second shift explains the common tiles worse than the first.

    0 where the difference is less than the part ``least`` of the residual. ``first`` and ``second`` are those of
    :func:`~semcal_ros.core.registration.inverse_compositional.tile_residual_energies`.
    """
    if second is None:
        return np.inf
    if first is None:
        return -np.inf
    difference = (second - first).ravel()
    common = np.isfinite(difference)
    if np.count_nonzero(common) < COMMON_TILES_MIN:
        return 0.0
    difference = difference[common]
    mean = float(difference.mean())
    smaller = min(float(first.ravel()[common].mean()), float(second.ravel()[common].mean()))
    if abs(mean) < least * smaller:
        return 0.0
    error = difference.std(ddof=1) / np.sqrt(difference.size)
    return mean / max(float(error), 1e-30)
