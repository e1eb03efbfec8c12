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

"""Shift between two images of the same specimen, with a covariance, or a rejection with a reason.

A coarse search over all shifts by :mod:`.normalised_correlation` is followed by least squares at
full resolution (:mod:`.inverse_compositional`). A wrong shift is worse than none. A result is
therefore accepted only if the two stages agree, the halves of the overlap agree, the images have
most of their structure in common, and no competing shift explains the image as well.

Where not all of the image moves by one shift, the specimen is what moves as predicted, or nearly all of the structure
(:mod:`.specimen`); the rest is left out. A periodic specimen is registered by its defects (:mod:`.defects`).

Of lines in one direction only the shift across them is measured (:mod:`.one_direction`).

It fails, and says so, on images without structure, on fine lattices without defects, where two
parts move differently and nothing says which is the specimen, and on images whose scales differ by more than about 1 %.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.core.arrays import RESAMPLED_TYPES, AnyImage, Array, Mask, check_image
from semcal_ros.core.errors import InvalidValueError, Rejection
from semcal_ros.core.registration.acceptance import find_failure
from semcal_ros.core.registration.agreement import MovingTiles, TileNoise
from semcal_ros.core.registration.ambiguity import choose_peak, compare_residuals
from semcal_ros.core.registration.defects import ChosenShift, choose_period
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.registration.fixed_pixels import drop_fixed_pixels
from semcal_ros.core.registration.illumination import measure_illumination
from semcal_ros.core.registration.inverse_compositional import (
    Alignment,
    SimilarityFit,
    align,
    tile_residual_energies,
    unmeasured_alignment,
)
from semcal_ros.core.registration.mismatch import explain_deformation, explain_mismatch
from semcal_ros.core.registration.noise_spectrum import (
    estimate_noise_variance,
    measure_image,
    measure_richest_parts,
    passed_variance,
)
from semcal_ros.core.registration.normalised_correlation import (
    CoarsePeak,
    CoarseReference,
    find_coarse_peaks,
)
from semcal_ros.core.registration.one_direction import OneDirection, align_across
from semcal_ros.core.registration.periodicity import is_fine
from semcal_ros.core.registration.reference import Reference, Region, RegistrationSettings
from semcal_ros.core.registration.specimen import (
    are_edges,
    find_moving,
    keep_across,
    keep_specimen,
    look_at_whole,
    noise_beside_tools,
    refuse_other_motions,
    refuse_unless_followed,
)
from semcal_ros.core.registration.thresholds import (
    CONTRAST_CHANGE,
    DROPPED_MAX,
    DROPPED_WITHIN_PX,
    FAINT_SPECTRUM_PX,
    FARTHER_PX,
    GREY_LEVEL_MAX,
    LEVEL_PX_MIN,
    LIGHT_GUESS_PX_MAX,
    LIGHT_KEPT_LEAST,
    LIGHT_KEPT_MIN,
    NOISE_ERROR,
    PARTS_SIGNAL_MIN,
    PULL_PX_MAX,
    SIDE_PX_MIN,
    SIGNAL_MIN,
    SIGNAL_SHARE_MIN,
    SIGNIFICANCE_MIN,
    TEXTURE_PX_MIN,
    WEAK_SIGNAL_MIN,
)
from semcal_ros.core.registration.tiles import Pyramid, find_structure, make_level

# How an image appears that fits part by part, but not by one shift. (That its halves disagree says it already.)
_SIGNS_OF_DEFORMATION = frozenset(
    {
        MatchFailure.UNDETERMINED,
        MatchFailure.NOT_CONVERGED,
        MatchFailure.STAGES_DISAGREE,
        MatchFailure.DISSIMILAR,
    }
)

# What another light would not mend: it does not say which of several motions is the specimen's.
_WHATEVER_THE_LIGHT = frozenset(
    {MatchFailure.UNUSABLE_REFERENCE, MatchFailure.UNUSABLE_IMAGE, MatchFailure.AMBIGUOUS}
)


@dataclass(frozen=True)
class Registration:
    """Shift of an image against a reference.

    Attributes
    ----------
    alignment
        The shift with its covariance, and how well it explains the image: what lay at x in the
        reference is seen at ``x + shift_px`` in the image. NaN and infinite where nothing could be
        measured.
    correlation
        Correlation of the two images over the overlap after their noise has been accounted for,
        at most 1; NaN where nothing could be measured.
    contrast
        Standard deviation of the image over that of the reference after their noise has been accounted for; NaN where
        nothing could be measured. Noise of the reference lowers the gain of the alignment, and not this ratio.
    rejection
        Why the shift must not be used; None where it may.
    nearest_px
        (2,) the shift nearest to the prediction among those between which a rejected registration
        could not decide; NaN otherwise.
    moving
        What does not move with the specimen and was left out; None where all does.
    share
        Part of the structure that agrees with the shift; where something moved otherwise in the image before, that is
        left out, if it is not most.
    along
        (2,) the direction of lines along which the shift is the predicted one, since they do not tell it, and its
        covariance means nothing; None where both directions are measured.
    suggested_px
        (2,) another shift than the predicted one with which much of a rejected image agrees, where it may be that of
        something else; NaN otherwise.
    """

    alignment: Alignment
    correlation: float
    rejection: Rejection[MatchFailure] | None
    nearest_px: Array = field(default_factory=lambda: np.full(2, np.nan))
    moving: MovingTiles | None = None
    share: float = 1.0
    along: Array | None = None
    contrast: float = float("nan")
    suggested_px: Array = field(default_factory=lambda: np.full(2, np.nan))

    _image_noise: float = field(default=float("nan"), repr=False)
    _middle_px: Array = field(default_factory=lambda: np.zeros(2), repr=False)
    _origin_px: Array = field(default_factory=lambda: np.zeros(2), repr=False)

    def fit_similarity(self) -> SimilarityFit | None:
        """Shift, shear, rotation and scale together, about the middle of the whole image; None where too
        little is compared for them.
        """
        fit = self.alignment.fit_similarity()
        if fit is None:
            return None
        about = fit.about(self._middle_px)
        return replace(about, values=about.values + np.append(self._origin_px, np.zeros(4)))

    def widened(self, covariance: Array) -> Registration:
        """The same with a shift that is less certain by a covariance (2, 2)."""
        return replace(self, alignment=self.alignment.widened(covariance))

    @property
    def accepted(self) -> bool:
        """Whether the shift may be used."""
        return self.rejection is None

    @property
    def reason(self) -> str:
        """Why it may not; empty where it may."""
        return "" if self.rejection is None else self.rejection.reason

    @property
    def shift_px(self) -> Array:
        """(2,) shift, px."""
        return self.alignment.shift_px

    @property
    def covariance(self) -> Array:
        """(2, 2) covariance of the shift, px^2."""
        return self.alignment.covariance


def to_gray(image: ArrayLike) -> AnyImage:
    """The mean of the channels, in a type that can be compared.

    Raises
    ------
    InvalidValueError
        If it is not an image.
    """
    pixels = check_image(image)
    if pixels.ndim == 3:
        return pixels.mean(axis=2, dtype=np.float32)
    return pixels if pixels.dtype.name in RESAMPLED_TYPES else pixels.astype(np.float32)


def _crop(image: ArrayLike, region: Region | None) -> tuple[AnyImage, Region]:
    gray = to_gray(image)
    height, width = gray.shape
    if region is None:
        region = (0, 0, width, height)
    left, top, right, bottom = region
    if not (0 <= left < right <= width and 0 <= top < bottom <= height):
        raise InvalidValueError(
            f"region {region} of an image of {width} x {height} px",
            expected="(left, top, right, bottom) inside the image",
        )
    return gray[top:bottom, left:right], region


def _find_defect(gray: AnyImage) -> str:
    """Why an image alone cannot be registered, or an empty string."""
    if min(gray.shape) < SIDE_PX_MIN:
        return f"only {gray.shape[1]} x {gray.shape[0]} px to compare"
    lowest, highest = gray.min(), gray.max()
    if gray.dtype.kind == "f":
        if not (np.isfinite(lowest) and np.isfinite(highest)):
            return "values that are not finite"
        if max(-lowest, highest) > GREY_LEVEL_MAX:
            return f"values beyond {GREY_LEVEL_MAX:g}"
    return f"blank (all pixels at {highest:g})" if lowest == highest else ""


def prepare_reference(
    image: ArrayLike,
    *,
    region: Region | None = None,
    settings: RegistrationSettings | None = None,
    averaged: float = 1.0,
    raw: AnyImage | None = None,
    fixed: Mask | None = None,
) -> Reference:
    """Precompute what :func:`register` needs of a reference that is used many times.

    Parameters
    ----------
    image
        (h, w) or (h, w, 3) image.
    region
        Its valid rectangle; None for all of it.
    settings
        Limits of acceptance.
    averaged
        Number of images that ``image`` is the mean of, at least 1.
    raw
        One of these images, grey and of the same size, before it was resampled, whose noise is white;
        None if they were not.
    fixed
        (h, w) True at pixels that do not show the specimen, whose place is filled from around; None where all do.

    Raises
    ------
    InvalidValueError
        If the shape or type is not that of an image, or the region does not lie in it.
    """
    limits = settings or RegistrationSettings()
    gray, inside = _crop(image, region)
    pyramid = Pyramid(gray)
    coarse = CoarseReference(pyramid, limits.min_overlap)
    defect = _find_defect(gray)
    if defect:
        return Reference(inside, coarse, (), 0.0, defect, limits)
    before = None if raw is None else raw[inside[1] : inside[3], inside[0] : inside[2]]
    statistics = measure_image(
        _texture(gray, inside, limits),
        averaged,
        None if before is None else _texture(before, inside, limits),
    )
    if statistics.signal_to_noise < SIGNAL_MIN:
        # A sparse specimen need not show anything there; the whole image decides.
        statistics = measure_image(gray, averaged, before)
    is_sparse = False
    if statistics.signal_to_noise < WEAK_SIGNAL_MIN:
        # A few particles are a small part of the variance, and tell a shift as well as many.
        found = measure_richest_parts(gray, averaged, before)
        is_sparse = found.signal_to_noise > 1.0
        if statistics.signal_to_noise < SIGNAL_MIN:
            is_sparse = found.signal_to_noise >= PARTS_SIGNAL_MIN
        if not is_sparse:
            # What is faint everywhere is told by many pixels.
            statistics = measure_image(gray, averaged, before, FAINT_SPECTRUM_PX)
            if statistics.significance < SIGNIFICANCE_MIN:
                return Reference(inside, coarse, (), 0.0, "featureless (noise only)", limits)
        # Of one or two of them in its middle, chance tells the smoothing as much as they do.
        if is_sparse:
            statistics = replace(found, noise_variance=statistics.noise_variance)
    levels = []
    for factor in _reduction_factors(gray.shape):
        level = make_level(pyramid, factor, statistics.sigma_px / factor)
        if level is not None:
            noise = statistics.noise_variance / factor**2 * passed_variance(level.sigma_px)
            levels.append(replace(level, noise_variance=noise))
    if is_sparse and levels:
        # Tiles are judged at full resolution alone.
        levels[-1] = replace(levels[-1], shows_structure=find_structure(levels[-1]))
    if not levels:
        defect = f"only {gray.shape[1]} x {gray.shape[0]} px to compare"
    left, top, right, bottom = inside
    return Reference(
        inside,
        coarse,
        tuple(levels),
        statistics.noise_variance,
        defect,
        limits,
        is_sparse,
        None if fixed is None else fixed[top:bottom, left:right],
    )


def _texture(gray: AnyImage, inside: Region, limits: RegistrationSettings) -> AnyImage:
    """The part of a cropped image in which noise and structure are measured."""
    if limits.texture_region is None:
        return gray
    left, top, right, bottom = np.subtract(limits.texture_region, np.tile(inside[:2], 2))
    part = gray[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]
    return part if min(part.shape) >= TEXTURE_PX_MIN else gray


def _reduction_factors(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Reductions from the coarsest level to full resolution."""
    factor, factors = 1, [1]
    while min(shape) // (2 * factor) >= LEVEL_PX_MIN:
        factor *= 2
        factors.insert(0, factor)
    return tuple(factors)


def register_pair(
    reference: ArrayLike,
    image: ArrayLike,
    *,
    guess_px: ArrayLike = (0.0, 0.0),
    guess_covariance: ArrayLike | None = None,
    reference_region: Region | None = None,
    image_region: Region | None = None,
    settings: RegistrationSettings | None = None,
) -> Registration:
    """Measure the shift of ``image`` against an image that is used once.

    Parameters
    ----------
    reference
        (h, w) or (h, w, 3) image.
    reference_region
        Its valid rectangle; None for all of it.
    settings
        Limits of acceptance.
    image, guess_px, guess_covariance, image_region
        As for :func:`register`.

    Raises
    ------
    InvalidValueError
        If the shape or type of an argument is not that of an image, or a region does not lie in it.
    """
    return register(
        prepare_reference(reference, region=reference_region, settings=settings),
        image,
        guess_px=guess_px,
        guess_covariance=guess_covariance,
        image_region=image_region,
    )


def register(
    reference: Reference,
    image: ArrayLike,
    *,
    guess_px: ArrayLike = (0.0, 0.0),
    guess_covariance: ArrayLike | None = None,
    image_region: Region | None = None,
    max_shear_px: float = 0.0,
    max_stretch: float = 0.0,
    suspected: MovingTiles | None = None,
    takes_lines: bool = False,
    fixed: Mask | None = None,
) -> Registration:
    """Measure the shift of ``image`` against a prepared reference.

    Parameters
    ----------
    reference
        Made by :func:`prepare_reference`; its settings are the limits of acceptance.
    image
        (h, w) or (h, w, 3) image at the same scale; its size may differ.
    guess_px, guess_covariance
        Predicted shift (2,) and its covariance (2, 2). They decide between competing peaks, and which of
        several motions is the specimen's; without a covariance such images are rejected.
    image_region
        Valid rectangle of the image; None for all of it.
    max_shear_px
        Largest shear that may be due to drift during the scan. Up to it the upper and the lower
        half of the image may disagree in proportion.
    max_stretch
        Largest part by which the scales may differ. Up to it the halves of the image may disagree in proportion.
    suspected
        Where something moved apart from the specimen in the image before, and may still do so; None where nothing did.
        It is found without, which takes twice as long, and a slow one later.
    takes_lines
        Whether a shift across lines is of use, with the predicted one along them (:attr:`Registration.along`). It is
        measured only where there is a covariance of the prediction.
    fixed
        (h, w) True at pixels of the image that do not show the specimen, whose place is filled from around, so that it
        does not show in the search over all shifts; None where all do. They take no part in the shift.

    Returns
    -------
    Registration
        With a rejection where the shift must not be used.

    Raises
    ------
    InvalidValueError
        If the shape or type is not that of an image, or the region does not lie in it.
    """
    dropped_at = np.asarray(guess_px, dtype=np.float64)
    for _ in range(DROPPED_MAX):
        part = drop_fixed_pixels(reference, fixed, image_region, dropped_at)
        measure = partial(
            _register,
            part,
            guess_px=guess_px,
            guess_covariance=guess_covariance,
            image_region=image_region,
            max_shear_px=max_shear_px,
            max_stretch=max_stretch,
            suspected=suspected,
            fixed=fixed,
        )
        found = _register_in_its_light(
            part, image, measure, guess_px, guess_covariance, image_region
        )
        away_px = np.abs(found.shift_px - dropped_at)
        if part is reference or not np.any(away_px > DROPPED_WITHIN_PX):
            break
        dropped_at = found.shift_px
    reference = part
    if reference.defect or guess_covariance is None or reference.lines is None:
        return found
    # A shift along lines may be one of noise.
    if found.accepted and _is_seen_along(reference, reference.lines, image, image_region, found):
        return found
    if takes_lines:
        across = _register_across(
            reference, reference.lines, image, guess_px, guess_covariance, image_region
        )
        if across.accepted:
            return across
    if not found.accepted:
        return found
    reason = "one direction is not determined: it shows lines, and fits as well farther along them"
    return replace(found, rejection=Rejection(MatchFailure.UNDETERMINED, reason))


def _is_seen_along(
    reference: Reference,
    lines: OneDirection,
    image: ArrayLike,
    image_region: Region | None,
    found: Registration,
) -> bool:
    """Whether an image tells a shift along lines: whether it fits clearly worse farther on either way."""
    gray, inside = _crop(image, image_region)
    level, pyramid = reference.levels[-1], Pyramid(gray)
    origin = np.subtract(inside[:2], reference.region[:2]).astype(np.float64)
    shift = found.shift_px - origin
    here = tile_residual_energies(level, pyramid, shift, lines.along)
    farther = [
        tile_residual_energies(level, pyramid, shift + length * lines.along, lines.along)
        for length in (-FARTHER_PX, FARTHER_PX)
    ]
    least = reference.settings.min_deviations
    return all(compare_residuals(here, there) > least for there in farther)


def _register_across(
    reference: Reference,
    lines: OneDirection,
    image: ArrayLike,
    guess_px: ArrayLike,
    guess_covariance: ArrayLike,
    image_region: Region | None,
) -> Registration:
    """Measure the shift across the lines of a reference that shows nothing else, at the predicted place along them."""
    gray, inside = _crop(image, image_region)
    defect = _find_defect(gray)
    if defect:
        return _reject(MatchFailure.UNUSABLE_IMAGE, f"image: {defect}")
    origin = np.subtract(inside[:2], reference.region[:2]).astype(np.float64)
    limits, pyramid = reference.settings, Pyramid(gray)
    guess = np.asarray(guess_px, dtype=np.float64) - origin
    spread = np.asarray(guess_covariance, dtype=np.float64)
    found = align_across(
        reference.coarse,
        reference.levels,
        pyramid,
        lines,
        guess,
        spread,
        limits.min_competing_height,
    )
    if isinstance(found, Rejection) and found.status is MatchFailure.AMBIGUOUS:
        # Lines at equal distances agree with any multiple of these.
        return Registration(unmeasured_alignment(), float("nan"), found)
    image_noise = estimate_noise_variance(_texture(gray, inside, limits))
    whole = None
    if not isinstance(found, Rejection):
        whole = look_at_whole(reference, found[1], image_noise)
    kept = None
    if whole is None or not (whole.is_complete or are_edges(whole)):
        kept = keep_across(reference, pyramid, lines, guess, spread)
    moving, share = None, 1.0
    if kept is not None:
        assert isinstance(kept.alignment, Alignment)
        peak, alignment = kept.peak, kept.alignment
        moving, share, whole = kept.moving, kept.share, None
    elif isinstance(found, Rejection):
        return Registration(unmeasured_alignment(), float("nan"), found)
    else:
        peak, alignment = found
    signals = _measure_signals(reference, image_noise, alignment)
    correlation = signals.correlation
    # Only the direction across is judged.
    sigma2 = float(lines.across @ alignment.covariance @ lines.across)
    rejection = find_failure(
        limits, peak, replace(alignment, covariance=sigma2 * np.eye(2)), correlation, 0.0
    )
    if rejection is None and whole is not None:
        rejection = refuse_other_motions(whole)
        if rejection is None and np.any(whole.odd.largest):
            # Lines run through an image. These are the edges of a thing, and what lies beside it tells both directions.
            reason = (
                "one direction is not determined: the lines end in the image, beside other bodies"
            )
            rejection = Rejection(MatchFailure.UNDETERMINED, reason)
    follow_px = limits.follow_px((np.shape(image)[1], np.shape(image)[0]), inside)
    if rejection is None and follow_px is not None:
        rejection = refuse_unless_followed(reference, alignment, image_noise, follow_px)
    moved = replace(alignment, shift_px=alignment.shift_px + origin)
    if moving is not None:
        moving = replace(moving, corner_px=moving.corner_px + np.array(inside[:2]))
    return Registration(
        moved,
        correlation,
        rejection,
        moving=moving,
        share=share,
        along=lines.along,
        contrast=signals.contrast,
    )


def _register_in_its_light(
    reference: Reference,
    image: ArrayLike,
    measure: Callable[[ArrayLike], Registration],
    guess_px: ArrayLike,
    guess_covariance: ArrayLike | None,
    image_region: Region | None,
) -> Registration:
    """Measure a shift in both directions, also of an image that is lit otherwise than the reference."""
    found = measure(image)
    if found.rejection is not None and found.rejection.status in _WHATEVER_THE_LIGHT:
        return found
    gray, inside = _crop(image, image_region)
    level, pyramid = reference.levels[-1], Pyramid(gray)
    origin = np.subtract(inside[:2], reference.region[:2]).astype(np.float64)
    image_noise = found._image_noise
    if not np.isfinite(image_noise):
        image_noise = estimate_noise_variance(_texture(gray, inside, reference.settings))
    noise = TileNoise.of(level.sigma_px, reference.noise_variance, image_noise)
    compared, light = found.alignment.compared_tiles(), None
    sigma_px = np.inf
    if guess_covariance is not None:
        values = np.linalg.eigvalsh(np.asarray(guess_covariance, dtype=np.float64))
        sigma_px = float(np.sqrt(values[-1]))
    if compared is not None and (found.accepted or sigma_px >= LIGHT_GUESS_PX_MAX):
        at_px = compared[2]
        light = measure_illumination(level, pyramid, at_px, noise, compared[:2])
    elif sigma_px < LIGHT_GUESS_PX_MAX:
        at_px = np.asarray(guess_px, dtype=np.float64) - origin
        light = measure_illumination(level, pyramid, at_px, noise)
    if light is None:
        return found
    gray = to_gray(image)
    evened = measure(light.even_out(gray, inside))
    if not np.all(np.isfinite(evened.shift_px)):
        return found if found.accepted else evened
    # Light took its part of the way to the right shift.
    moved = (evened.shift_px - origin - at_px) / np.maximum(light.kept, LIGHT_KEPT_LEAST)
    if np.min(light.kept) < LIGHT_KEPT_MIN or not light.is_sure:
        return _allow_for_light(found, moved)
    light_there = measure_illumination(level, pyramid, at_px + moved, noise)
    if light_there is not None:
        light, evened = light_there, measure(light_there.even_out(gray, inside))
    if found.accepted and not evened.accepted:
        return found
    kept = np.maximum(light.kept, LIGHT_KEPT_MIN)
    more = evened.covariance * (1.0 / np.sqrt(np.outer(kept, kept)) - 1.0)
    # By how much the next light would move it.
    remaining = (evened.shift_px - origin - at_px - moved) * (1.0 / kept - 1.0)
    return evened.widened(more + np.outer(remaining, remaining))


def _allow_for_light(found: Registration, moved_px: Array) -> Registration:
    """A registration with a covariance that has by how much another light would move it; a rejection where that is too
    much.
    """
    widened, size = found.widened(np.outer(moved_px, moved_px)), float(np.hypot(*moved_px))
    if size <= PULL_PX_MAX or not found.accepted:
        return widened
    reason = f"ambiguous: if its light has changed, the shift is another one by {size:.1f} px"
    return replace(widened, rejection=Rejection(MatchFailure.AMBIGUOUS, reason))


def _register(
    reference: Reference,
    image: ArrayLike,
    *,
    guess_px: ArrayLike,
    guess_covariance: ArrayLike | None,
    image_region: Region | None,
    max_shear_px: float,
    max_stretch: float,
    suspected: MovingTiles | None,
    fixed: Mask | None,
    by_defects: bool = False,
) -> Registration:
    """Measure a shift in both directions; of what repeats, by its defects where several shifts stand out, or where
    ``by_defects`` says so.
    """
    gray, inside = _crop(image, image_region)
    if reference.defect:
        return _reject(MatchFailure.UNUSABLE_REFERENCE, f"reference: {reference.defect}")
    defect = _find_defect(gray)
    if defect:
        return _reject(MatchFailure.UNUSABLE_IMAGE, f"image: {defect}")
    origin = np.subtract(inside[:2], reference.region[:2]).astype(np.float64)
    guess = np.asarray(guess_px, dtype=np.float64) - origin
    pyramid = Pyramid(gray)
    moving: MovingTiles | None = None
    share = 1.0
    of_parts = reference.is_sparse or suspected is not None
    peaks = find_coarse_peaks(reference.coarse, pyramid, guess)
    if not peaks:
        found = explain_mismatch(reference.coarse, pyramid, guess)
        return _reject(
            MatchFailure.NO_PEAK, found or "no shift stands out: featureless, or another place"
        )
    spread = None if guess_covariance is None else np.asarray(guess_covariance, dtype=np.float64)
    repeats = by_defects or _shows_lattice(reference, peaks)
    follow_px = reference.settings.follow_px((np.shape(image)[1], np.shape(image)[0]), inside)
    if repeats and follow_px is not None:
        # What moves otherwise would choose the period, and the lattice agrees with any.
        return _reject(
            MatchFailure.AMBIGUOUS,
            "ambiguous: a specimen that repeats, so that a part of it does not say by how many periods it moved",
        )
    chosen: tuple[CoarsePeak, Alignment | None] | Rejection[MatchFailure]
    suggested_px = np.full(2, np.nan)
    if repeats:
        finest = find_coarse_peaks(reference.coarse, pyramid, guess, finest=True) or peaks
        # Periods are not known well enough to be counted far.
        high = reference.settings.min_competing_height * finest[0].correlation
        start = min(
            (p for p in finest if p.correlation >= high),
            key=lambda p: float(np.hypot(*(np.array(p.shift_px) - guess))),
        )
        told = choose_period(
            reference.levels,
            pyramid,
            reference.periods,
            np.array(start.shift_px),
            np.array(finest[0].shift_px),
            guess,
            spread,
            noise_beside_tools(reference, pyramid),
            (reference.repeats, reference.find_repeating(pyramid.centred(1))),
            None if fixed is None else fixed[inside[1] : inside[3], inside[0] : inside[2]],
        )
        if isinstance(told, ChosenShift):
            chosen = _peak_at(start, told.alignment), told.alignment
            moving = find_moving(reference, told.alignment, told.agreement)
            share = told.agreement.share
        else:
            chosen, suggested_px = told.rejection, told.suggested_px + origin
    elif of_parts:
        chosen = peaks[0], None
    else:
        chosen = choose_peak(reference, pyramid, peaks, guess, spread)
    alignment: Alignment | Rejection[MatchFailure]
    peak, refined = (peaks[0], chosen) if isinstance(chosen, Rejection) else chosen
    if refined is not None:
        alignment = refined
    elif of_parts:
        # The rest would add noise, or pull.
        alignment = Rejection(MatchFailure.DISSIMILAR, "too little of the specimen in common")
    else:
        alignment = align(reference.levels, pyramid, np.array(peak.shift_px))
        if isinstance(alignment, Rejection) or not alignment.converged:
            # A coarse search is only good to a fraction of its pixels, and fine textures forgive less.
            peak, alignment = _align_at_finest(reference, pyramid, guess, peak, alignment)
    texture = _texture(gray, inside, reference.settings)
    image_noise = estimate_noise_variance(texture)
    stretch_px = 0.5 * max_stretch * np.array(gray.shape[1::-1], dtype=np.float64)
    # A tile with a defect is no tile that moves.
    whole = None
    if not (repeats or of_parts):
        whole = look_at_whole(reference, alignment, image_noise, float(stretch_px[0]))
    kept = None
    is_part = not repeats and (whole is None or not whole.is_complete)
    if is_part and _has_fine_lattice(reference):
        # A tool that outshines a lattice stands out alone.
        return _register(
            reference,
            image,
            guess_px=guess_px,
            guess_covariance=guess_covariance,
            image_region=image_region,
            max_shear_px=max_shear_px,
            max_stretch=max_stretch,
            suspected=suspected,
            fixed=fixed,
            by_defects=True,
        )
    if is_part:
        if suspected is not None:
            suspected = replace(suspected, corner_px=suspected.corner_px - np.array(inside[:2]))
        kept = keep_specimen(
            reference,
            pyramid,
            alignment,
            peak,
            peaks,
            guess,
            spread,
            follow_px,
            suspected,
            float(stretch_px[0]),
        )
    if kept is None and isinstance(chosen, Rejection):
        distances = [float(np.hypot(*(np.array(p.shift_px) - guess))) for p in peaks]
        nearest = np.array(peaks[int(np.argmin(distances))].shift_px) + origin
        return Registration(
            unmeasured_alignment(), float("nan"), chosen, nearest, suggested_px=suggested_px
        )
    if whole is not None:
        share = whole.share
    if kept is not None:
        alignment, peak, moving, share = kept.alignment, kept.peak, kept.moving, kept.share
    if kept is not None:
        suggested_px = kept.other_px + origin
    if moving is not None:
        moving = replace(moving, corner_px=moving.corner_px + np.array(inside[:2]))
    if isinstance(alignment, Rejection):
        named = _name_deformation(alignment, reference, pyramid)
        if kept is None and named is not alignment:
            # Most of its parts fit there.
            suggested_px = np.array(peak.shift_px) + origin
        return Registration(unmeasured_alignment(), float("nan"), named, suggested_px=suggested_px)
    signals = _measure_signals(reference, image_noise, alignment)
    correlation = signals.correlation
    rejection = find_failure(
        reference.settings, peak, alignment, correlation, max_shear_px, stretch_px
    )
    if rejection is not None:
        named = _name_deformation(rejection, reference, pyramid)
        if kept is None and named is not rejection:
            suggested_px = np.array(peak.shift_px) + origin
        rejection = named
    elif kept is None and whole is not None:
        rejection = refuse_other_motions(whole)
    if rejection is None:
        alignment, rejection = _allow_for_pull(alignment)
    moved = replace(
        alignment,
        shift_px=alignment.shift_px + origin,
        joint_px=alignment.joint_px + np.append(origin, [0.0, 0.0]),
    )
    height, width = np.shape(image)[:2]
    middle = 0.5 * (np.array([width, height]) - np.add(inside[:2], inside[2:]))
    if rejection is None:
        suggested_px = np.full(2, np.nan)
    elif rejection.status is MatchFailure.STAGES_DISAGREE:
        suggested_px = moved.shift_px
    return Registration(
        moved,
        correlation,
        rejection,
        suggested_px=suggested_px,
        moving=moving,
        share=share,
        contrast=signals.contrast,
        _image_noise=image_noise,
        _middle_px=middle.astype(np.float64),
        _origin_px=origin,
    )


def _allow_for_pull(
    alignment: Alignment,
) -> tuple[Alignment, Rejection[MatchFailure] | None]:
    """The alignment with a covariance that has what a part which may move by itself pulls; a rejection where that is
    too much.
    """
    pulled = alignment.with_pull()
    sigma = float(np.sqrt(np.max(np.linalg.eigvalsh(pulled.covariance))))
    if sigma <= PULL_PX_MAX:
        return pulled, None
    reason = (
        f"ambiguous: without a part of the structure, the shift is another one by {sigma:.1f} px"
    )
    return pulled, Rejection(MatchFailure.AMBIGUOUS, reason)


def _align_at_finest(
    reference: Reference,
    pyramid: Pyramid,
    guess: Array,
    peak: CoarsePeak,
    before: Alignment | Rejection[MatchFailure],
) -> tuple[CoarsePeak, Alignment | Rejection[MatchFailure]]:
    """Search again at the finest resolution near a peak, and align there; what was found before if there is none."""
    finest = find_coarse_peaks(reference.coarse, pyramid, guess, finest=True)
    if not finest or np.max(np.abs(np.subtract(finest[0].shift_px, peak.shift_px))) >= peak.step_px:
        return peak, before
    levels = [level for level in reference.levels if level.factor <= finest[0].step_px]
    return finest[0], align(levels, pyramid, np.array(finest[0].shift_px))


def _has_fine_lattice(reference: Reference) -> bool:
    return len(reference.periods) > 0 and is_fine(reference.periods, reference.levels[-1].size)


def _shows_lattice(reference: Reference, peaks: list[CoarsePeak]) -> bool:
    """Whether several shifts stand out, as those of a lattice do; of a fine one, even where a tool outshines it."""
    if len(peaks) < 2 or not len(reference.periods):
        return False
    least = reference.settings.min_competing_height * peaks[0].correlation
    return peaks[1].correlation >= least or _has_fine_lattice(reference)


def _peak_at(peak: CoarsePeak, alignment: Alignment) -> CoarsePeak:
    x, y = alignment.shift_px.tolist()
    return replace(peak, shift_px=(x, y))


def _name_deformation(
    rejection: Rejection[MatchFailure], reference: Reference, pyramid: Pyramid
) -> Rejection[MatchFailure]:
    """The same rejection, with another reason where that is only how a deformation shows."""
    if rejection.status not in _SIGNS_OF_DEFORMATION:
        return rejection
    found = explain_deformation(reference.coarse.pyramid, pyramid)
    return replace(rejection, reason=found) if found else rejection


def _reject(failure: MatchFailure, reason: str) -> Registration:
    return Registration(unmeasured_alignment(), float("nan"), Rejection(failure, reason))


@dataclass(frozen=True)
class _Signals:
    """Correlation of the images without their noise, and the ratio of their standard deviations."""

    correlation: float
    contrast: float


def _measure_signals(reference: Reference, variance: float, alignment: Alignment) -> _Signals:
    """What the noise-free images would have in common; ``variance`` is that of the image's noise."""
    passed = passed_variance(reference.levels[-1].sigma_px)
    noise = reference.noise_variance * passed
    image_noise = variance * passed
    whole, image_whole = alignment.reference_variance, alignment.image_variance
    signal = max(whole - noise, SIGNAL_SHARE_MIN * whole)
    image_signal = max(image_whole - image_noise, SIGNAL_SHARE_MIN * image_whole)
    correlation = alignment.common_covariance / np.sqrt(signal * image_signal)
    # Where the noise is most of what is seen, its error decides over the ratio, and the contrast is rather that before.
    errors = NOISE_ERROR * np.array([noise / signal, image_noise / image_signal])
    spread = CONTRAST_CHANGE**2
    trust = spread / (spread + 0.25 * float(errors @ errors))
    contrast = (image_signal / signal) ** (0.5 * trust)
    return _Signals(float(min(correlation, 1.0)), float(contrast))
