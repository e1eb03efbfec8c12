"""A frame compared with a keyframe, as often as its shear asks for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.drift_filter import DriftFilter
from semcal_ros.core.drift_map import DriftMap, Measure, Reshear
from semcal_ros.core.drift_measure import bends, keyframe_noise, measure_of
from semcal_ros.core.keyframe import Shot, make_keyframe, picture_of
from semcal_ros.core.keyframe_store import Candidate, KeyframeStore
from semcal_ros.core.rectify import Rectifier
from semcal_ros.core.registration import Region, Registration, register

__all__ = ["Found", "look"]

Array = NDArray[np.float64]

_LOOKS = 4
# Part of the picture's height by which drift may shear it.
_LARGEST_SHEAR = 0.03


@dataclass(frozen=True)
class Found:
    """A registration that holds against a keyframe.

    Attributes
    ----------
    candidate
        The keyframe.
    registration
        Shift in px.
    picture, region
        The frame as it was compared, and the part of it that was scanned.
    removed
        (2,) drift velocity whose shear was removed from it.
    measure
        What it says of the drift.
    """

    candidate: Candidate
    registration: Registration
    picture: NDArray[np.generic]
    region: Region
    removed: Array
    measure: Measure


def look(
    drift: DriftFilter, store: KeyframeStore, candidate: Candidate, shot: Shot, rectifier: Rectifier
) -> Found | Registration:
    """Register a frame, and again without the shear that was left by a velocity that was wrong.

    The noise of a keyframe that nothing was compared with before becomes known to the filter.

    Returns
    -------
    Found or Registration
        The latter where it was refused.
    """
    velocity = drift.state.velocity
    found = _once(drift, store, candidate, shot, rectifier, velocity)
    for _ in range(_LOOKS - 1):
        if isinstance(found, Registration):
            break
        state = found.measure(drift.state).state
        bent = _straightened(drift, store, candidate, state, rectifier)
        if not bent and not bends(state.velocity - found.removed, shot):
            break
        again = _once(drift, store, candidate, shot, rectifier, state.velocity)
        if isinstance(again, Registration):
            break
        found = again
    return found


def _straightened(
    drift: DriftFilter,
    store: KeyframeStore,
    candidate: Candidate,
    state: DriftMap,
    rectifier: Rectifier,
) -> bool:
    """Whether the keyframe was sheared, and now no longer is; only a single frame can be."""
    keyframe = store[candidate.key]
    left = state.where(candidate.key)[2:]
    if candidate.rescaled or keyframe.averaged > 1 or not bends(left, keyframe.shot):
        return False
    removed = keyframe.removed + left
    store.replace(candidate.key, make_keyframe(keyframe.shot, removed, rectifier, keyframe.time_s))
    drift.do(Reshear(candidate.key, left))
    return True


def _once(
    drift: DriftFilter,
    store: KeyframeStore,
    candidate: Candidate,
    shot: Shot,
    rectifier: Rectifier,
    velocity: Array,
) -> Found | Registration:
    key = candidate.key
    picture, region = picture_of(shot, velocity, rectifier)
    reference = store.carried(key, shot) if candidate.rescaled else store.reference(key)
    shift, covariance = drift.state.shift_from(key)
    px_from_unit = shot.px_from_unit
    registration = register(
        reference,
        picture,
        guess_px=px_from_unit @ shift,
        guess_covariance=px_from_unit @ covariance @ px_from_unit.T,
        image_region=region,
        max_shear_px=0.0 if shot.timing is None else _LARGEST_SHEAR * shot.size[1],
    )
    if not registration.accepted:
        return registration
    averaged = np.inf if candidate.rescaled else float(store.averaged(key))
    before = store[key].shot
    measure = measure_of(key, before, shot, registration, velocity, averaged, drift.psd)
    if drift.pending == key:
        drift.settle(keyframe_noise(measure))
    return Found(candidate, registration, picture, region, velocity, measure)
