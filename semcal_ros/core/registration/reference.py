"""A reference picture, prepared, and the limits of what may be registered against it."""

from __future__ import annotations

from dataclasses import dataclass, field

from semcal_ros.core.registration.normalised_correlation import CoarseReference
from semcal_ros.core.registration.tiles import PyramidLevel

__all__ = ["Reference", "Region", "RegistrationSettings"]

#: Valid rectangle (left, top, right, bottom) in px, right and bottom exclusive.
Region = tuple[int, int, int, int]


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
class Reference:
    """A reference picture with everything about it that does not depend on the image.

    Made by :func:`prepare_reference`.

    Attributes
    ----------
    region
        The part of the picture that is compared.
    coarse
        Its side of the search over all shifts.
    levels
        Its tiles from the coarsest resolution to the finest.
    noise_variance
        Of its white part per pixel.
    complaint
        Why nothing can be registered against it, or an empty string.
    """

    region: Region
    coarse: CoarseReference
    levels: tuple[PyramidLevel, ...]
    noise_variance: float
    complaint: str
    settings: RegistrationSettings = field(default_factory=RegistrationSettings)
