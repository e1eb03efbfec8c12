"""A frame compared with a keyframe, as often as its shear asks for."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.filter import DriftFilter
from semcal_ros.core.drift.frame import MotionCorrector, ScanFrame
from semcal_ros.core.drift.keyframe import keyframe_of
from semcal_ros.core.drift.keyframe_store import Candidate, KeyframeStore
from semcal_ros.core.drift.measurement import (
    acceleration_term_s2,
    exceeds_tolerance,
    keyframe_noise,
    measure_of,
)
from semcal_ros.core.drift.operations import CorrectShear, Measure
from semcal_ros.core.drift.state import DriftState
from semcal_ros.core.registration.reference import Region
from semcal_ros.core.registration.register import Registration, register

__all__ = ["Match", "is_mergeable", "match_keyframe"]


_LOOKS = 4
# What frames must be like to become part of their keyframe's mean.
_LIKE_ENOUGH, _GAINS, _LARGEST_SHEAR_PX = 0.85, (0.5, 2.0), 0.1
# Part of the picture's height by which drift may shear it.
_LARGEST_SHEAR = 0.1


@dataclass(frozen=True)
class Match:
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
        (4,) drift velocity and acceleration that were removed from it.
    measure
        What it says of the drift.
    keyframe_time_s
        Time of the keyframe.
    """

    candidate: Candidate
    registration: Registration
    picture: NDArray[np.generic]
    region: Region
    removed: Array
    measure: Measure
    keyframe_time_s: float


def match_keyframe(
    drift: DriftFilter,
    store: KeyframeStore,
    candidate: Candidate,
    shot: ScanFrame,
    stills: MotionCorrector,
) -> Match | Registration:
    """Register a frame, and again without the shear that was left by a velocity that was wrong.

    The noise of a keyframe that nothing was compared with before becomes known to the filter.

    Returns
    -------
    Found or Registration
        The latter where it was refused.
    """
    motion = drift.state.motion
    first = motion if _removable(motion, shot) else np.zeros(4)
    found = _once(drift, store, candidate, shot, stills, first)
    for _ in range(_LOOKS - 1):
        if isinstance(found, Registration):
            break
        state = found.measure(drift.state, drift.restlessness).state
        if not _removable(state.motion, shot):
            # A jump, not a drift: it is for the filter to judge.
            break
        bent = _straightened(drift, store, candidate, state, stills)
        if not bent and not exceeds_tolerance(state.motion - found.removed, shot):
            break
        again = _once(drift, store, candidate, shot, stills, state.motion)
        if isinstance(again, Registration):
            break
        found = again
    return found


def _removable(motion: Array, shot: ScanFrame) -> bool:
    """Whether a motion can be that of a specimen during a frame."""
    if shot.timing is None:
        return True
    way_px = np.abs(shot.px_from_unit @ motion[:2]) * shot.timing.frame_time_s
    return float(np.max(way_px)) <= _LARGEST_SHEAR * shot.size[1]


def _straightened(
    drift: DriftFilter,
    store: KeyframeStore,
    candidate: Candidate,
    state: DriftState,
    stills: MotionCorrector,
) -> bool:
    """Whether the keyframe was sheared, and now no longer is; only a single frame can be."""
    keyframe = store[candidate.key]
    left = np.append(state.where(candidate.key)[2:], np.zeros(2))
    if candidate.rescaled or keyframe.averaged > 1 or not exceeds_tolerance(left, keyframe.shot):
        return False
    removed = keyframe.removed + left
    store.replace(
        candidate.key,
        keyframe_of(keyframe.shot, removed, *stills.of(keyframe.shot, removed), keyframe.time_s),
    )
    drift.do(CorrectShear(candidate.key, left, acceleration_term_s2(keyframe.shot)))
    return True


def _once(
    drift: DriftFilter,
    store: KeyframeStore,
    candidate: Candidate,
    shot: ScanFrame,
    stills: MotionCorrector,
    motion: Array,
) -> Match | Registration:
    key = candidate.key
    picture, region = stills.of(shot, motion)
    reference = store.carried(key, shot) if candidate.rescaled else store.reference(key)
    shift, covariance = drift.state.shift_from(key)
    px_from_unit = shot.px_from_unit
    registration = register(
        reference,
        picture,
        guess_px=px_from_unit @ shift,
        guess_covariance=px_from_unit @ covariance @ px_from_unit.T,
        image_region=region,
        max_shear_px=_LARGEST_SHEAR * shot.size[1],
    )
    if not registration.accepted:
        return registration
    averaged = np.inf if candidate.rescaled else float(store.averaged(key))
    keyframe = store[key]
    measure = measure_of(key, keyframe.shot, shot, registration, motion, averaged)
    if drift.pending == key:
        drift.settle(keyframe_noise(measure), measure.scan_s)
    time_s = keyframe.time_s
    return Match(candidate, registration, picture, region, motion, measure, time_s)


def is_mergeable(found: Match, store: KeyframeStore) -> bool:
    """Whether a frame makes the mean of its keyframe better."""
    registration, candidate = found.registration, found.candidate
    shear = np.nan_to_num(registration.alignment.joint_px[2:], nan=0.0)
    return (
        not candidate.rescaled
        and store.wants(candidate.key, registration.alignment.overlap)
        and registration.correlation > _LIKE_ENOUGH
        and _GAINS[0] < registration.alignment.gain < _GAINS[1]
        and float(np.max(np.abs(shear))) < _LARGEST_SHEAR_PX
    )
