"""From a registration in pixels to a measurement of the drift map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.camera_uncertainty import carry_covariance, relative_scale_sigma, zoom_of
from semcal_ros.core.drift.frame import ScanFrame
from semcal_ros.core.drift.operations import CloneKeyframe, Measure
from semcal_ros.core.drift.state import DriftState
from semcal_ros.core.registration.register import Registration

__all__ = [
    "acceleration_term_s2",
    "at_itself",
    "becoming_keyframe",
    "exceeds_tolerance",
    "keyframe_noise",
    "loosened",
    "measure_of",
]


# What the registration's model does not know, 1-sigma: of a shift, of a shear, and of a shear as a
# part of the shift; the last is larger where distortion is left in.
_SHIFT_FLOOR_PX = 1e-3
_SHEAR_FLOOR_PX = 0.02
_SHEAR_OF_SHIFT = 1e-3
# The shear that a wrong velocity leaves is worth another look from here on.
_SHEAR_PX = 0.1


def exceeds_tolerance(motion: Array, shot: ScanFrame) -> bool:
    """Whether drift with a velocity and an acceleration (4,) bends a frame by more than its shift
    is to be known to.
    """
    if shot.timing is None:
        return False
    time_s = shot.timing.frame_time_s
    shear_px = np.abs(shot.px_from_unit @ motion[:2]) * time_s
    bow_px = np.abs(shot.px_from_unit @ motion[2:]) * time_s**2 / 8.0
    return float(np.max(np.maximum(shear_px, bow_px))) > _SHEAR_PX


def acceleration_term_s2(shot: ScanFrame) -> float:
    """By how much the mean of an accelerated drift over a frame is from its middle, per unit of
    acceleration.
    """
    return 0.0 if shot.timing is None else shot.timing.acquisition_time_s**2 / 24.0


def measure_of(
    key: int,
    before: ScanFrame,
    now: ScanFrame,
    registration: Registration,
    removed: Array,
    averaged: float,
) -> Measure:
    """Measurement by a registration of ``now`` against a keyframe that began with ``before``.

    Parameters
    ----------
    key
        Number of the keyframe.
    before, now
        The frames.
    registration
        Shift in px of ``now``.
    removed
        (4,) drift velocity and acceleration that were removed from ``now``.
    averaged
        Number of frames in the keyframe's mean. Its noise is the keyframe's own and not part of
        the measurement's.
    """
    unit = np.linalg.inv(now.px_from_unit)
    share = averaged / (averaged + 1.0) if np.isfinite(averaged) else 1.0
    covariance = share * registration.covariance + np.eye(2) * _SHIFT_FLOOR_PX**2
    bow = acceleration_term_s2(now)
    scan_s = 0.0 if now.timing is None else now.timing.acquisition_time_s
    if now.timing is None or not np.all(np.isfinite(registration.alignment.joint_px)):
        shift = unit @ registration.shift_px + bow * removed[2:]
        return Measure(key, shift, unit @ covariance @ unit.T, bow=bow, scan_s=scan_s)
    frame_s = now.timing.frame_time_s
    both = np.kron(np.diag([1.0, 1.0 / frame_s]), unit)
    part = max(_SHEAR_OF_SHIFT, relative_scale_sigma(now.camera) / 3.0)
    distance = float(np.hypot(*registration.shift_px))
    shear_floor = _SHEAR_FLOOR_PX**2 + (part * distance) ** 2
    floor = np.diag([_SHIFT_FLOOR_PX**2] * 2 + [shear_floor] * 2)
    joint = share * registration.alignment.joint_covariance + floor
    shift = both @ registration.alignment.joint_px + np.append(bow * removed[2:], removed[:2])
    ratio = 1.0 if before.timing is None else before.timing.frame_time_s / frame_s
    return Measure(key, shift, both @ joint @ both.T, ratio, bow, scan_s)


def keyframe_noise(measure: Measure) -> Array:
    """(4, 4) noise of a single frame like the one that was measured, as keyframe."""
    noise = np.zeros((4, 4))
    count = measure.shift.size
    noise[:count, :count] = measure.covariance
    return noise


def loosened(measure: Measure, before: ScanFrame, now: ScanFrame) -> Measure:
    """The measurement with what a change of magnification leaves open."""
    if before.camera is None or now.camera is None:
        return measure
    covariance = measure.covariance.copy()
    covariance[:2, :2] += carry_covariance(before.camera, now.camera)
    return replace(measure, covariance=covariance, zoom=zoom_of(before.camera, now.camera))


def becoming_keyframe(
    key: int, state: DriftState, measure: Measure, removed: Array, noise: Array
) -> CloneKeyframe:
    """The measured frame becomes keyframe ``key``.

    ``removed`` (4,) is what was taken out of it; by ``noise`` (2, 2) its position as a keyframe may
    differ from the measured one.
    """
    full = np.zeros((4, 4))
    full[:2, :2] = noise
    bow = measure.bow * removed[2:]
    if measure.shift.size == 4:
        shift = measure.shift - np.append(bow, removed[:2])
        full[2:, 2:] = measure.covariance[2:, 2:] * 0.01
    else:
        shift = np.append(measure.shift - bow, np.zeros(2))
        full[2:, 2:] = state.own[2:, 2:]
    return CloneKeyframe(key, measure.key, shift, measure.time_ratio, full, measure.zoom)


def at_itself(key: int, measure: Measure, removed: Array) -> Measure:
    """What the frame that became keyframe ``key`` says of its own drift: it lies there but for its
    noise.
    """
    shift = np.append(measure.bow * removed[2:], removed[:2])[: measure.shift.size]
    return replace(measure, key=key, shift=shift, time_ratio=1.0, zoom=np.zeros((2, 2)))
