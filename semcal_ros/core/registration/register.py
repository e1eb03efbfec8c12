"""Shift between two pictures of the same specimen, with a covariance, or a refusal with a reason.

A coarse search over all shifts by :mod:`.normalised_correlation`, then least squares at full
resolution (:mod:`.inverse_compositional`). A wrong shift is worse than none, so a result is
accepted only if the two stages agree, the halves of the overlap agree, the
pictures have most of their structure in common, and no rival shift explains the image as well.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.core.arrays import RESAMPLED_TYPES, AnyImage, Array, check_image
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.registration.ambiguity import NOTHING, choose_peak
from semcal_ros.core.registration.inverse_compositional import Alignment, align
from semcal_ros.core.registration.noise_spectrum import (
    gaussian_taps,
    noise_variance,
    picture_statistics,
)
from semcal_ros.core.registration.normalised_correlation import (
    CoarsePeak,
    CoarseReference,
    coarse_peaks,
)
from semcal_ros.core.registration.reference import Reference, Region, RegistrationSettings
from semcal_ros.core.registration.tiles import Pyramid, make_level

__all__ = [
    "Reference",
    "Region",
    "Registration",
    "RegistrationSettings",
    "gray_of",
    "prepare_reference",
    "register",
]


_SMALLEST_PX = 48
# Levels of the pyramid keep at least that many px along the shorter side.
_SMALLEST_LEVEL_PX = 160
_SATURATION_SAMPLES = 256
# Of the noise's variance; chance makes less of pictures of 96 px and more.
_LEAST_SIGNAL = 0.06


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
    joint_px, joint_covariance
        (4,) shift of the image's middle row, and by how much more the last row of the image is
        shifted than the first (what drifts during a scan is sheared and stretched), estimated
        together, and their (4, 4) covariance; NaN and infinite where too few rows are compared.
        ``shift_px`` is the better shift where there is no shear.
    gain, offset
        Image grey levels per reference grey level, and at reference level 0.
    residual_rms
        RMS of what shift, gain and offset leave unexplained, in grey levels.
    likeness
        Correlation of the two pictures over the overlap after the noise has been accounted for, at
        most 1.
    overlap
        Fraction of the smaller picture that both show.
    converged, iterations
        Of the refinement.
    accepted, reason
        Whether the shift may be used; ``reason`` is empty when it may.
    nearest_px
        (2,) the shift nearest to the prediction among those between which a refused registration
        could not decide; NaN otherwise.
    """

    shift_px: Array
    covariance: Array
    joint_px: Array
    joint_covariance: Array
    gain: float
    offset: float
    residual_rms: float
    likeness: float
    overlap: float
    converged: bool
    iterations: int
    accepted: bool
    reason: str
    nearest_px: Array = field(default_factory=lambda: np.full(2, np.nan))


def gray_of(image: ArrayLike) -> AnyImage:
    """The mean of the channels, in a type that can be compared.

    Raises
    ------
    InvalidValueError
        If it is no picture.
    """
    picture = check_image(image)
    if picture.ndim == 3:
        return picture.mean(axis=2, dtype=np.float32)
    return picture if picture.dtype.name in RESAMPLED_TYPES else picture.astype(np.float32)


def _cropped(image: ArrayLike, region: Region | None) -> tuple[AnyImage, Region]:
    gray = gray_of(image)
    height, width = gray.shape
    if region is None:
        region = (0, 0, width, height)
    left, top, right, bottom = region
    if not (0 <= left < right <= width and 0 <= top < bottom <= height):
        raise InvalidValueError(
            f"region {region} of an image of {width} x {height} px",
            expected="(left, top, right, bottom) inside of the image",
        )
    return gray[top:bottom, left:right], region


def _complaint(gray: AnyImage, settings: RegistrationSettings) -> str:
    """Why a picture alone cannot be registered, or an empty string."""
    if min(gray.shape) < _SMALLEST_PX:
        return f"only {gray.shape[1]} x {gray.shape[0]} px to compare"
    if gray.dtype.kind == "f" and not np.isfinite(np.sum(gray, dtype=np.float64)):
        return "picture holds values that are not finite"
    stride = max(1, min(gray.shape) // _SATURATION_SAMPLES)
    some = np.ascontiguousarray(gray[::stride, ::stride])
    lowest, highest = some.min(), some.max()
    if lowest == highest:
        return f"blank picture (all pixels at {highest:g})"
    for end in (lowest, highest):
        share = float(np.count_nonzero(some == end)) / some.size
        if share > settings.max_saturated:
            return f"saturated picture ({100.0 * share:.0f} % of the pixels at {end:g})"
    return ""


def prepare_reference(
    image: ArrayLike,
    *,
    region: Region | None = None,
    settings: RegistrationSettings | None = None,
    averaged: float = 1.0,
) -> Reference:
    """Precompute what :func:`register` needs of a reference that is used many times.

    Parameters
    ----------
    image
        (h, w) or (h, w, 3) picture.
    region
        Its valid rectangle; None for all of it.
    settings
        Limits of acceptance.
    averaged
        Number of pictures that ``image`` is the mean of, at least 1.

    Raises
    ------
    InvalidValueError
        If the image is no picture, or the region does not lie in it.
    """
    limits = settings or RegistrationSettings()
    gray, inside = _cropped(image, region)
    pyramid = Pyramid(gray)
    coarse = CoarseReference(pyramid, limits.min_overlap)
    complaint = _complaint(gray, limits)
    if complaint:
        return Reference(inside, coarse, (), 0.0, complaint, limits)
    statistics = picture_statistics(gray, averaged)
    if statistics.signal_variance < _LEAST_SIGNAL * statistics.noise_variance:
        return Reference(inside, coarse, (), 0.0, "featureless picture (noise only)", limits)
    levels = []
    for factor in _factors(gray.shape):
        level = make_level(pyramid, factor, statistics.sigma_px / factor)
        if level is not None:
            levels.append(level)
    if not levels:
        complaint = f"only {gray.shape[1]} x {gray.shape[0]} px to compare"
    return Reference(inside, coarse, tuple(levels), statistics.noise_variance, complaint, limits)


def _factors(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Reductions from the coarsest level to full resolution."""
    factor, factors = 1, [1]
    while min(shape) // (2 * factor) >= _SMALLEST_LEVEL_PX:
        factor *= 2
        factors.insert(0, factor)
    return tuple(factors)


def _refused(reason: str) -> Registration:
    nan = float("nan")
    nothing = np.full(2, np.nan)
    return Registration(
        shift_px=nothing,
        covariance=np.full((2, 2), np.inf),
        joint_px=np.full(4, np.nan),
        joint_covariance=np.full((4, 4), np.inf),
        gain=nan,
        offset=nan,
        residual_rms=nan,
        likeness=nan,
        overlap=0.0,
        converged=False,
        iterations=0,
        accepted=False,
        reason=reason,
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
    max_shear_px: float = 0.0,
) -> Registration:
    """Measure the shift of ``image`` against ``reference``.

    Parameters
    ----------
    reference
        AnyImage, or one prepared by :func:`prepare_reference` (then ``reference_region`` and
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
    max_shear_px
        Largest shear that may be due to drift during the scan. Up to it the upper and the lower
        half of the picture may disagree in proportion.

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
    gray, inside = _cropped(image, image_region)
    for name, complaint in (
        ("reference", prepared.complaint),
        ("image", _complaint(gray, limits)),
    ):
        if complaint:
            return _refused(f"{name}: {complaint}")
    origin = np.subtract(inside[:2], prepared.region[:2]).astype(np.float64)
    guess = np.asarray(guess_px, dtype=np.float64) - origin
    pyramid = Pyramid(gray)
    peaks = coarse_peaks(prepared.coarse, pyramid, guess)
    if not peaks:
        return _refused("no shift stands out: featureless, or another place")
    spread = None if guess_covariance is None else np.asarray(guess_covariance, dtype=np.float64)
    chosen = choose_peak(prepared, pyramid, peaks, guess, spread)
    if isinstance(chosen, str):
        away = [float(np.hypot(*(np.array(p.shift_px) - guess))) for p in peaks]
        nearest = np.array(peaks[int(np.argmin(away))].shift_px) + origin
        return replace(_refused(chosen), nearest_px=nearest)
    peak, fine = chosen
    if fine is None:
        fine = align(prepared.levels, pyramid, np.array(peak.shift_px))
    if fine is None or not fine.converged:
        # A coarse search is only good to a fraction of its pixels, and fine textures forgive less.
        found = coarse_peaks(prepared.coarse, pyramid, guess, finest=True)
        if found and np.max(np.abs(np.subtract(found[0].shift_px, peak.shift_px))) < peak.step_px:
            peak = found[0]
            levels = [level for level in prepared.levels if level.factor <= peak.step_px]
            fine = align(levels, pyramid, np.array(peak.shift_px))
    if fine is None:
        return _refused(NOTHING)
    return _judged(prepared, gray, peak, fine, origin, max_shear_px)


def _judged(
    reference: Reference,
    gray: AnyImage,
    peak: CoarsePeak,
    fine: Alignment,
    origin: Array,
    max_shear_px: float,
) -> Registration:
    likeness = _likeness(reference, gray, fine)
    reason = _objection(reference.settings, peak, fine, likeness, max_shear_px)
    return Registration(
        shift_px=fine.shift_px + origin,
        covariance=fine.covariance,
        joint_px=fine.joint_px + np.append(origin, [0.0, 0.0]),
        joint_covariance=fine.joint_covariance,
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


def _likeness(reference: Reference, gray: AnyImage, fine: Alignment) -> float:
    """Correlation that the noise-free pictures would have."""
    passed = float(np.sum(gaussian_taps(reference.levels[-1].sigma_px) ** 2)) ** 2
    noise = reference.noise_variance * passed
    image_noise = noise_variance(gray) * passed
    signal_reference = max(fine.reference_variance - noise, 0.02 * fine.reference_variance)
    signal_image = max(fine.image_variance - image_noise, 0.02 * fine.image_variance)
    return float(min(fine.common_covariance / np.sqrt(signal_reference * signal_image), 1.0))


def _objection(
    limits: RegistrationSettings,
    peak: CoarsePeak,
    fine: Alignment,
    likeness: float,
    max_shear_px: float,
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
    shear = np.abs(fine.joint_px[2:])
    if np.all(shear <= max_shear_px):
        # What is left to the second look is how far the halves are from one line.
        allowed[1] += shear
    if np.any(np.abs(fine.look_difference_px) > allowed):
        apart = float(np.max(np.abs(fine.look_difference_px)))
        return f"halves of the picture disagree by {apart:.1f} px"
    return ""
