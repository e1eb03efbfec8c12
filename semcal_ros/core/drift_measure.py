"""From a registration in pixels to a measurement of the drift map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.drift_map import Carry, DriftMap, Measure
from semcal_ros.core.drift_uncertainty import carry_covariance, relative_scale_sigma
from semcal_ros.core.keyframe import Shot
from semcal_ros.core.registration import Registration

__all__ = [
    "at_itself",
    "becoming_keyframe",
    "bends",
    "keyframe_noise",
    "loosened",
    "measure_of",
]

Array = NDArray[np.float64]

# What the registration's model does not know, 1-sigma: of a shift, of a shear, and of a shear as a
# part of the shift; the last is larger where distortion is left in.
_SHIFT_FLOOR_PX = 1e-3
_SHEAR_FLOOR_PX = 0.02
_SHEAR_OF_SHIFT = 1e-3
# The shear that a wrong velocity leaves is worth another look from here on.
_SHEAR_PX = 0.1


def bends(velocity: Array, shot: Shot) -> bool:
    """Whether drift at a velocity bends a frame by more than its shift is to be known to."""
    if shot.timing is None:
        return False
    bend_px = np.abs(shot.px_from_unit @ velocity) * shot.timing.frame_time_s
    return float(np.max(bend_px)) > _SHEAR_PX


def measure_of(
    key: int,
    before: Shot,
    now: Shot,
    registration: Registration,
    removed: Array,
    averaged: float,
    acceleration_psd: float,
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
        (2,) drift velocity whose shear was removed from ``now``.
    averaged
        Number of frames in the keyframe's mean. Its noise is the keyframe's own and not part of
        the measurement's.
    acceleration_psd
        How restless the drift is. While the frame is scanned it leaves the straight line: a random
        acceleration of density q over the time T moves the mean of the drift by ``q T^3 / 320``
        (variance) from the drift at the middle, and the mean of the velocity by ``q T / 12``.
    """
    unit = np.linalg.inv(now.px_from_unit)
    share = averaged / (averaged + 1.0) if np.isfinite(averaged) else 1.0
    covariance = share * registration.covariance + np.eye(2) * _SHIFT_FLOOR_PX**2
    scan_s = 0.0 if now.timing is None else now.timing.acquisition_time_s
    restless = np.eye(2) * acceleration_psd * scan_s
    if now.timing is None or not np.all(np.isfinite(registration.joint_px)):
        return Measure(
            key,
            unit @ registration.shift_px,
            unit @ covariance @ unit.T + restless * scan_s**2 / 320.0,
        )
    frame_s = now.timing.frame_time_s
    both = np.kron(np.diag([1.0, 1.0 / frame_s]), unit)
    part = max(_SHEAR_OF_SHIFT, relative_scale_sigma(now.camera) / 3.0)
    distance = float(np.hypot(*registration.shift_px))
    shear_floor = _SHEAR_FLOOR_PX**2 + (part * distance) ** 2
    floor = np.diag([_SHIFT_FLOOR_PX**2] * 2 + [shear_floor] * 2)
    joint = share * registration.joint_covariance + floor
    shift = both @ registration.joint_px + np.append(np.zeros(2), removed)
    ratio = 1.0 if before.timing is None else before.timing.frame_time_s / frame_s
    total = both @ joint @ both.T
    total[:2, :2] += restless * scan_s**2 / 320.0
    total[2:, 2:] += restless / 12.0
    return Measure(key, shift, total, ratio)


def keyframe_noise(measure: Measure) -> Array:
    """(4, 4) noise of a single frame like the one that was measured, as keyframe."""
    noise = np.zeros((4, 4))
    count = measure.shift.size
    noise[:count, :count] = measure.covariance
    return noise


def loosened(measure: Measure, before: Shot, now: Shot) -> Measure:
    """The measurement with what a change of magnification leaves open."""
    covariance = measure.covariance.copy()
    if before.camera is not None and now.camera is not None:
        covariance[:2, :2] += carry_covariance(before.camera, now.camera)
    return replace(measure, covariance=covariance)


def becoming_keyframe(
    key: int, state: DriftMap, measure: Measure, removed: Array, noise: Array
) -> Carry:
    """The measured frame becomes keyframe ``key``.

    ``noise`` (2, 2) is what its position as a keyframe may differ from the measured one.
    """
    full = np.zeros((4, 4))
    full[:2, :2] = noise
    if measure.shift.size == 4:
        shift = measure.shift - np.append(np.zeros(2), removed)
        full[2:, 2:] = measure.covariance[2:, 2:] * 0.01
    else:
        shift = np.append(measure.shift, np.zeros(2))
        full[2:, 2:] = state.own[2:, 2:]
    return Carry(key, measure.key, shift, measure.time_ratio, full)


def at_itself(key: int, measure: Measure, removed: Array) -> Measure:
    """What the frame that became keyframe ``key`` says of its own drift: it lies there but for its
    noise.
    """
    shift = np.append(np.zeros(2), removed)[: measure.shift.size]
    return replace(measure, key=key, shift=shift, time_ratio=1.0)
