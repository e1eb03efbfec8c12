"""Shift between two pictures of the same specimen, with a covariance, or a refusal with a reason.

Coarse search over all shifts by normalised correlation (:mod:`semcal_ros.core.correlation`), then
least squares at full resolution (:mod:`semcal_ros.core.alignment`). A wrong shift is worse than
none, so a result is accepted only if the two stages agree, the halves of the overlap agree, the
pictures have most of their structure in common, and no rival shift explains the image as well.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcal_ros.core.alignment import Alignment, align, block_energies
from semcal_ros.core.correlation import CoarsePeak, coarse_peaks
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.prefilter import (
    gaussian_taps,
    noise_variance,
    picture_statistics,
    smoothed,
)
from semcal_ros.core.subpixel import derivative_taps, gradients
from semcal_ros.core.template import Template

__all__ = [
    "Reference",
    "Region",
    "Registration",
    "RegistrationSettings",
    "prepare_reference",
    "register",
]

Array = NDArray[np.float64]
Image = NDArray[np.float32]
#: Valid rectangle (left, top, right, bottom) in px, right and bottom exclusive.
Region = tuple[int, int, int, int]

_SMALLEST_PX = 48


@dataclass(frozen=True)
class RegistrationSettings:
    """Limits of :func:`register`.

    Attributes
    ----------
    min_overlap
        Least fraction of the smaller picture that must overlap.
    max_sigma_px
        Largest acceptable 1-sigma of the shift in its worst direction.
    min_likeness
        Least correlation of the two pictures after the noise has been accounted for.
    max_saturated
        Largest fraction of pixels at either end of the grey scale.
    rival_height
        Correlation peaks higher than this fraction of the best are examined as rivals.
    rival_deviations
        How many standard errors a rival must be worse by.
    """

    min_overlap: float = 0.3
    max_sigma_px: float = 0.5
    min_likeness: float = 0.6
    max_saturated: float = 0.5
    rival_height: float = 0.7
    rival_deviations: float = 5.0


@dataclass(frozen=True)
class Registration:
    """Shift of an image against a reference.

    Attributes
    ----------
    shift_px
        (2,) ``(x, y)``: what lay at x in the reference is seen at ``x + shift_px`` in the image.
        NaN where nothing could be measured.
    covariance
        (2, 2) of ``shift_px`` in px^2, from the noise of both pictures; infinite where nothing
        could be measured.
    gain, offset
        Image grey levels per reference grey level, and at reference level 0.
    residual_rms
        RMS of what shift, gain and offset leave unexplained, in grey levels.
    likeness
        Correlation of the two pictures over the overlap after the noise has been accounted for, at
        most 1.
    overlap
        Compared fraction of the smaller picture.
    converged, iterations
        Of the refinement.
    accepted, reason
        Whether the shift may be used; ``reason`` is empty when it may.
    """

    shift_px: Array
    covariance: Array
    gain: float
    offset: float
    residual_rms: float
    likeness: float
    overlap: float
    converged: bool
    iterations: int
    accepted: bool
    reason: str


@dataclass(frozen=True)
class Reference:
    """A reference picture with everything about it that does not depend on the image.

    Made by :func:`prepare_reference`.
    """

    region: Region
    plain: Image
    template: Template | None
    noise_variance: float
    complaint: str
    settings: RegistrationSettings = field(default_factory=RegistrationSettings)


def _gray(image: ArrayLike) -> tuple[Image, NDArray[np.generic]]:
    picture = np.asarray(image)
    if picture.ndim == 3 and picture.shape[2] == 3:
        return picture.mean(axis=2, dtype=np.float32), picture
    if picture.ndim != 2 or picture.dtype.kind not in "uif":
        raise InvalidValueError(
            f"an image of shape {picture.shape} and type {picture.dtype}",
            expected="a 2-D image, or one with three channels, of numbers",
        )
    return np.asarray(picture, dtype=np.float32), picture


def _cropped(image: ArrayLike, region: Region | None) -> tuple[Image, NDArray[np.generic], Region]:
    gray, picture = _gray(image)
    height, width = gray.shape
    if region is None:
        region = (0, 0, width, height)
    left, top, right, bottom = region
    if not (0 <= left < right <= width and 0 <= top < bottom <= height):
        raise InvalidValueError(
            f"region {region} of an image of {width} x {height} px",
            expected="(left, top, right, bottom) inside of the image",
        )
    return gray[top:bottom, left:right], picture[top:bottom, left:right], region


def _complaint(gray: Image, picture: NDArray[np.generic], settings: RegistrationSettings) -> str:
    """Why a picture alone cannot be registered, or an empty string."""
    if min(gray.shape) < _SMALLEST_PX:
        return f"only {gray.shape[1]} x {gray.shape[0]} px to compare"
    lowest, highest = float(gray.min()), float(gray.max())
    if not np.isfinite(lowest + highest):
        return "picture holds values that are not finite"
    if highest == lowest:
        return f"blank picture (all pixels at {highest:g})"
    for end in (lowest, highest):
        share = float(np.count_nonzero(gray == np.float32(end))) / gray.size
        if share > settings.max_saturated:
            return f"saturated picture ({100.0 * share:.0f} % of the pixels at {end:g})"
    return ""


def prepare_reference(
    image: ArrayLike, *, region: Region | None = None, settings: RegistrationSettings | None = None
) -> Reference:
    """Precompute what :func:`register` needs of a reference that is used many times.

    Raises
    ------
    InvalidValueError
        If the image is no picture, or the region does not lie in it.
    """
    limits = settings or RegistrationSettings()
    gray, picture, inside = _cropped(image, region)
    complaint = _complaint(gray, picture, limits)
    if complaint:
        return Reference(inside, gray, None, 0.0, complaint, limits)
    statistics = picture_statistics(gray)
    sigma = statistics.sigma_px
    smooth = smoothed(gray, sigma)
    dx, dy = gradients(smooth)
    taps = gaussian_taps(sigma)
    sloped = np.convolve(taps, derivative_taps())
    gradient_noise = statistics.noise_variance * float(np.sum(sloped**2) * np.sum(taps**2))
    noise = statistics.noise_variance * float(np.sum(taps**2)) ** 2
    template = Template(smooth, dx, dy, sigma, noise, gradient_noise)
    return Reference(inside, gray, template, statistics.noise_variance, "", limits)


def _refused(reason: str) -> Registration:
    nan = float("nan")
    nothing = np.full(2, np.nan)
    return Registration(
        nothing, np.full((2, 2), np.inf), nan, nan, nan, nan, 0.0, False, 0, False, reason
    )


def register(
    reference: Reference | ArrayLike,
    image: ArrayLike,
    *,
    guess_px: ArrayLike = (0.0, 0.0),
    guess_covariance: ArrayLike | None = None,
    reference_region: Region | None = None,
    image_region: Region | None = None,
    settings: RegistrationSettings | None = None,
) -> Registration:
    """Measure the shift of ``image`` against ``reference``.

    Parameters
    ----------
    reference
        Picture, or one prepared by :func:`prepare_reference` (then ``reference_region`` and
        ``settings`` are its own).
    image
        (h, w) or (h, w, 3) picture at the same scale; its size may differ.
    guess_px, guess_covariance
        Predicted shift (2,) and its covariance (2, 2). They only decide between rivals on periodic
        specimens; without a covariance a picture with rivals is refused.
    reference_region, image_region
        Valid rectangles; None for all of the picture.
    settings
        Limits of acceptance.

    Returns
    -------
    Registration
        With ``accepted`` false and a reason where the shift must not be used.

    Raises
    ------
    InvalidValueError
        If an argument is no picture, or a region does not lie in it.
    """
    if isinstance(reference, Reference):
        prepared = reference
    else:
        prepared = prepare_reference(reference, region=reference_region, settings=settings)
    limits = prepared.settings
    gray, picture, inside = _cropped(image, image_region)
    for name, complaint in (
        ("reference", prepared.complaint),
        ("image", _complaint(gray, picture, limits)),
    ):
        if complaint:
            return _refused(f"{name}: {complaint}")
    template = prepared.template
    assert template is not None
    origin = np.subtract(inside[:2], prepared.region[:2]).astype(np.float64)
    guess = np.asarray(guess_px, dtype=np.float64) - origin
    peaks = coarse_peaks(prepared.plain, gray, limits.min_overlap, guess)
    if not peaks:
        return _refused("no shift stands out: featureless, or another place")
    smooth = smoothed(gray, template.sigma_px)
    spread = None if guess_covariance is None else np.asarray(guess_covariance, dtype=np.float64)
    found = _choose(template, limits, smooth, peaks, guess, spread)
    if isinstance(found, str):
        return _refused(found)
    return _judged(prepared, gray, *found, origin)


def _judged(
    reference: Reference, gray: Image, peak: CoarsePeak, fine: Alignment, origin: Array
) -> Registration:
    likeness = _likeness(reference, gray, fine)
    reason = _objection(reference.settings, peak, fine, likeness)
    return Registration(
        shift_px=fine.shift_px + origin,
        covariance=fine.covariance,
        gain=fine.gain,
        offset=fine.offset,
        residual_rms=fine.residual_rms,
        likeness=likeness,
        overlap=fine.overlap,
        converged=fine.converged,
        iterations=fine.iterations,
        accepted=not reason,
        reason=reason,
    )


def _likeness(reference: Reference, gray: Image, fine: Alignment) -> float:
    """Correlation that the noise-free pictures would have."""
    assert reference.template is not None
    passed = float(np.sum(gaussian_taps(reference.template.sigma_px) ** 2)) ** 2
    noise = reference.template.noise
    image_noise = noise_variance(gray) * passed
    signal_reference = max(fine.reference_variance - noise, 0.02 * fine.reference_variance)
    signal_image = max(fine.image_variance - image_noise, 0.02 * fine.image_variance)
    return float(min(fine.common_covariance / np.sqrt(signal_reference * signal_image), 1.0))


def _objection(
    limits: RegistrationSettings, peak: CoarsePeak, fine: Alignment, likeness: float
) -> str:
    worst = float(np.sqrt(np.max(np.linalg.eigvalsh(fine.covariance))))
    if not worst <= limits.max_sigma_px:
        return f"featureless in one direction (sigma {worst:.2f} px)"
    if not fine.converged:
        return f"refinement did not settle in {fine.iterations} steps"
    apart = float(np.max(np.abs(fine.shift_px - peak.shift_px)))
    if apart > peak.step_px + 1.0:
        return f"coarse and fine shift differ by {apart:.1f} px"
    if fine.overlap < limits.min_overlap:
        return f"overlap {100.0 * fine.overlap:.0f} % of the picture"
    if likeness < limits.min_likeness:
        return f"pictures differ (likeness {likeness:.2f})"
    # Halves of a picture whose distortion is not removed differ by more than their noise.
    allowed = 5.0 * np.sqrt(fine.look_variance) + 0.3
    if np.any(np.abs(fine.look_difference_px) > allowed):
        apart = float(np.max(np.abs(fine.look_difference_px)))
        return f"halves of the picture disagree by {apart:.1f} px"
    return ""


def _choose(
    template: Template,
    limits: RegistrationSettings,
    smooth: Image,
    peaks: list[CoarsePeak],
    guess: Array,
    spread: Array | None,
) -> tuple[CoarsePeak, Alignment] | str:
    """The peak to believe with its refinement, or the reason why none can be believed."""
    rivals = [p for p in peaks if p.correlation >= limits.rival_height * peaks[0].correlation]
    if len(rivals) > 1 and spread is not None:
        near = [p for p in rivals if _within(p, guess, spread)]
        # Only rivals that the prediction allows count, as long as it allows any.
        rivals = near or rivals
    first = align(template, smooth, np.array(rivals[0].shift_px))
    if first is None:
        return "nothing to compare: featureless in one direction, or too little overlap"
    best = (rivals[0], first)
    for peak in rivals[1:]:
        other = align(template, smooth, np.array(peak.shift_px))
        if other is None or _same(best[1], other):
            continue
        verdict = _paired(*(block_energies(template, smooth, a) for a in (best[1], other)))
        if abs(verdict) < limits.rival_deviations:
            a, b = best[1].shift_px, other.shift_px
            return (
                f"ambiguous: shifts ({a[0]:.1f}, {a[1]:.1f}) and ({b[0]:.1f}, {b[1]:.1f}) px"
                " explain the picture equally well"
            )
        if verdict < 0.0:
            best = (peak, other)
    return best


def _within(peak: CoarsePeak, guess: Array, spread: Array) -> bool:
    """Whether a peak lies within three deviations of the prediction."""
    away = np.asarray(peak.shift_px) - guess
    widened = spread + np.eye(2) * (0.5 * peak.step_px) ** 2
    return float(away @ np.linalg.solve(widened, away)) <= 9.0


def _same(a: Alignment, b: Alignment) -> bool:
    return float(np.max(np.abs(a.shift_px - b.shift_px))) < 0.5


def _paired(first: Array | None, second: Array | None) -> float:
    """By how many standard errors the second shift explains the common blocks worse than the
    first.
    """
    if second is None:
        return np.inf
    if first is None:
        return -np.inf
    difference = (second - first).ravel()
    difference = difference[np.isfinite(difference)]
    if difference.size < 16:
        return 0.0
    error = float(difference.std(ddof=1)) / np.sqrt(difference.size)
    return float(difference.mean() / max(error, 1e-30))
