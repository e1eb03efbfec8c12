"""Shifts that explain a picture equally well, as on a lattice: which one to believe."""

from __future__ import annotations

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.registration.inverse_compositional import Alignment, align, residual_energies
from semcal_ros.core.registration.normalised_correlation import CoarsePeak
from semcal_ros.core.registration.reference import Reference
from semcal_ros.core.registration.tiles import Pyramid

__all__ = ["NOTHING", "choose_peak"]


NOTHING = "nothing to compare: featureless in one direction, or too little overlap"
# Part of the residual by which two shifts must differ to be told apart.
_DIFFERENT = 0.05
# The same for a picture to contradict a prediction: sharp lattices look a little different wherever
# their pixels fall.
_CONTRADICTING = 0.3


def choose_peak(
    reference: Reference,
    pyramid: Pyramid,
    peaks: list[CoarsePeak],
    guess: Array,
    spread: Array | None,
) -> tuple[CoarsePeak, Alignment | None] | str:
    """The peak to believe with its alignment, or the reason why none can be believed.

    The alignment is None where there was no need to compare.

    Parameters
    ----------
    reference, pyramid
        The two pictures.
    peaks
        Of their correlation, the best first.
    guess, spread
        (2,) predicted shift and its covariance (2, 2), or None.

    Notes
    -----
    Rivals are compared at full resolution: reduced pictures differ by how their pixels happen to
    fall.
    """
    limits, level = reference.settings, reference.levels[-1]
    rivals = [p for p in peaks if p.correlation >= limits.rival_height * peaks[0].correlation]
    near: list[CoarsePeak] = []
    if len(rivals) > 1 and spread is not None:
        near = [p for p in rivals if _within(p, guess, spread)]
        if near and rivals[0] not in near:
            # The prediction decides between equals; it does not override the picture.
            return _uncontradicted(reference, pyramid, near[0], rivals[0])
        rivals = near or rivals
    if len(rivals) == 1:
        return rivals[0], None
    best: tuple[CoarsePeak, Alignment, Array | None] | None = None
    for peak in rivals:
        found = align(reference.levels, pyramid, np.array(peak.shift_px))
        if found is None or not found.converged:
            continue
        theirs = found, residual_energies(level, pyramid, found.shift_px)
        if best is None:
            best = (peak, *theirs)
            continue
        shift, other = best[1].shift_px, found.shift_px
        if float(np.max(np.abs(other - shift))) < 0.5:
            continue
        verdict = _paired(best[2], theirs[1])
        if abs(verdict) < limits.rival_deviations:
            return (
                f"ambiguous: shifts ({shift[0]:.1f}, {shift[1]:.1f}) and"
                f" ({other[0]:.1f}, {other[1]:.1f}) px explain the picture equally well"
            )
        if verdict < 0.0:
            best = (peak, *theirs)
    return NOTHING if best is None else best[:2]


def _uncontradicted(
    reference: Reference, pyramid: Pyramid, near: CoarsePeak, far: CoarsePeak
) -> tuple[CoarsePeak, Alignment | None] | str:
    """The peak near the prediction, unless the best one explains the picture clearly better."""
    aligned = [align(reference.levels, pyramid, np.array(p.shift_px)) for p in (near, far)]
    energies = [
        None
        if found is None or not found.converged
        else residual_energies(reference.levels[-1], pyramid, found.shift_px)
        for found in aligned
    ]
    verdict = _paired(energies[0], energies[1], _CONTRADICTING)
    if verdict < -reference.settings.rival_deviations:
        x, y = far.shift_px
        return f"ambiguous: the picture says ({x:.1f}, {y:.1f}) px, far from the prediction"
    return near, aligned[0]


def _within(peak: CoarsePeak, guess: Array, spread: Array) -> bool:
    """Whether a peak lies within three deviations of the prediction."""
    away = np.asarray(peak.shift_px) - guess
    widened = spread + np.eye(2) * (0.5 * peak.step_px) ** 2
    return float(away @ np.linalg.solve(widened, away)) <= 9.0


def _paired(first: Array | None, second: Array | None, matters: float = _DIFFERENT) -> float:
    """By how many standard errors the second shift explains the common tiles worse than the first;
    0 where the difference does not matter.
    """
    if second is None:
        return np.inf
    if first is None:
        return -np.inf
    difference = (second - first).ravel()
    common = np.isfinite(difference)
    if np.count_nonzero(common) < 16:
        return 0.0
    difference = difference[common]
    mean = float(difference.mean())
    smaller = min(float(first.ravel()[common].mean()), float(second.ravel()[common].mean()))
    if abs(mean) < matters * smaller:
        # The interpolation is not perfect, and differs between shifts.
        return 0.0
    error = difference.std(ddof=1) / np.sqrt(difference.size)
    return mean / max(float(error), 1e-30)
