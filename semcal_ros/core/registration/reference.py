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

"""A reference image prepared for registration, and the limits of what is accepted against it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from semcal_ros.core.arrays import Array, Image, Mask
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.registration.normalised_correlation import CoarseReference
from semcal_ros.core.registration.one_direction import OneDirection, find_direction
from semcal_ros.core.registration.periodicity import find_periods, find_repeating
from semcal_ros.core.registration.thresholds import (
    COMPETING_HEIGHT_MIN,
    CORRELATION_MIN,
    DEVIATIONS_MIN,
    OVERLAP_MIN,
    REPEATING_SHARE_MIN,
    SIGMA_PX_MAX,
)
from semcal_ros.core.registration.tiles import PyramidLevel

#: Valid rectangle (left, top, right, bottom) in px, right and bottom exclusive.
Region = tuple[int, int, int, int]


@dataclass(frozen=True)
class RegistrationSettings:
    """Limits of :func:`~semcal_ros.core.registration.register.register`; the defaults have their sources in
    :mod:`semcal_ros.core.registration.thresholds`.

    Attributes
    ----------
    min_overlap
        Least fraction of the smaller image that must overlap. Shifts beyond it are not searched.
    max_sigma_px
        Largest acceptable 1-sigma of the shift in its worst direction.
    min_correlation
        Least correlation of the two images after their noise has been accounted for.
    min_competing_height
        Correlation peaks higher than this fraction of the highest compete with it.
    min_deviations
        By how many standard errors a peak must explain the image better than its competitors.
    texture_region
        Part of the images, in px of the whole, in which their noise and structure are measured;
        None: their middle. For images whose middle shows something else, such as a covered area.
    follow
        Left, top, right and bottom of a part of the images that shows the specimen, as parts of their width and height;
        what moves as it does is followed. None: what moves as predicted, or nearly all.
    """

    min_overlap: float = OVERLAP_MIN
    max_sigma_px: float = SIGMA_PX_MAX
    min_correlation: float = CORRELATION_MIN
    min_competing_height: float = COMPETING_HEIGHT_MIN
    min_deviations: float = DEVIATIONS_MIN
    texture_region: Region | None = None
    follow: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        if self.follow is not None:
            left, top, right, bottom = self.follow
            if not (0.0 <= left < right <= 1.0 and 0.0 <= top < bottom <= 1.0):
                raise InvalidValueError(
                    f"a part to follow of {self.follow}",
                    expected="left, top, right and bottom from 0 to 1, in this order",
                )

    def follow_px(self, size: tuple[int, int], region: Region) -> Region | None:
        """The part to follow of images of (width, height), in px of their ``region``; None where there is none."""
        if self.follow is None:
            return None
        left, top, right, bottom = (
            round(part * side) for part, side in zip(self.follow, 2 * size, strict=True)
        )
        return left - region[0], top - region[1], right - region[0], bottom - region[1]


@dataclass(frozen=True)
class Reference:
    """A reference image with everything about it that does not depend on the other image.

    Made by :func:`~semcal_ros.core.registration.register.prepare_reference`.

    Attributes
    ----------
    region
        The part of the image that is compared.
    coarse
        Its side of the search over all shifts.
    levels
        Its tiles from the coarsest resolution to the finest; empty where it has a defect.
    noise_variance
        Variance of its white noise per pixel, in squared grey levels.
    defect
        Why nothing can be registered against it, or an empty string.
    settings
        Limits of acceptance.
    is_sparse
        Whether most of it has no structure.
    fixed
        (h, w) of its region, True at pixels that do not show the specimen; None where all do.
    whole
        The reference with all of its pixels, of which this one is a part
        (:func:`~semcal_ros.core.registration.fixed_pixels.drop_fixed_pixels`); None where it is the whole.
    """

    region: Region
    coarse: CoarseReference
    levels: tuple[PyramidLevel, ...]
    noise_variance: float
    defect: str
    settings: RegistrationSettings = field(default_factory=RegistrationSettings)
    is_sparse: bool = False
    fixed: Mask | None = None
    whole: Reference | None = field(default=None, repr=False)

    @cached_property
    def lines(self) -> OneDirection | None:
        """The direction of its lines, if it shows nothing else; looked for when first asked."""
        if self.whole is not None:
            return self.whole.lines
        if not self.levels:
            return None
        return find_direction(self.levels, self.coarse.pyramid, self.noise_variance)

    @property
    def periods(self) -> Array:
        """(k, 2) periods of what repeats in most of it, px; looked for when first asked."""
        return self._lattice[0]

    @property
    def repeats(self) -> Mask:
        """(h, w) of its region, where it shows its lattice; there must be :attr:`periods`."""
        return self._lattice[1]

    @cached_property
    def _lattice(self) -> tuple[Array, Mask]:
        if self.whole is not None:
            return self.whole._lattice
        image = self.coarse.pyramid.centred(1)
        periods = find_periods(image, self.noise_variance)
        if not len(periods) or not self.levels:
            return periods, np.zeros(image.shape, dtype=bool)
        repeats = self._find_repeating(image, periods)
        if repeats.mean() < REPEATING_SHARE_MIN:
            # A few particles, with a tool or without, have periods by chance.
            return periods[:0], repeats
        return periods, repeats

    def find_repeating(self, image: Image) -> Mask:
        """(h, w) where an image shows the lattice; there must be :attr:`periods`."""
        return self._find_repeating(image, self.periods)

    def _find_repeating(self, image: Image, periods: Array) -> Mask:
        level = self.levels[-1]
        return find_repeating(image, periods, level.sigma_px, max(level.side))
