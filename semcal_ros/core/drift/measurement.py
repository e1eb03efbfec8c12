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

"""From a registration in pixels to a measurement of the filter's state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semcal_ros.core.arrays import Array, equilibrate
from semcal_ros.core.drift.camera_uncertainty import (
    apparent_zoom_shift,
    relative_scale_sigma,
    visit_stretch_covariance,
    zoom_covariance,
)
from semcal_ros.core.drift.frame import ScanFrame
from semcal_ros.core.drift.operations import CloneKeyframe, Measure
from semcal_ros.core.drift.state import DriftState
from semcal_ros.core.drift.thresholds import (
    DISTORTION_OF_SCALE,
    LEAST_EIGENVALUE,
    SHEAR_COPY_NOISE,
    SHEAR_FLOOR_PX,
    SHEAR_LEFT_PX,
    SHEAR_MAX,
    SHEAR_OF_SHIFT,
    SHIFT_FLOOR_PX,
)
from semcal_ros.core.registration.register import Registration


def exceeds_tolerance(motion: Array, frame: ScanFrame) -> bool:
    """Whether drift with a velocity and an acceleration (4,) shears or bends a frame noticeably."""
    if frame.timing is None:
        return False
    time_s = frame.timing.frame_time_s
    shear_px = np.abs(frame.px_from_unit @ motion[:2]) * time_s
    bend_px = np.abs(frame.px_from_unit @ motion[2:]) * time_s**2 / 8.0
    return float(np.max(np.maximum(shear_px, bend_px))) > SHEAR_LEFT_PX


def is_removable(motion: Array, frame: ScanFrame) -> bool:
    """Whether a motion, of which the first two numbers are a velocity, can be that of a specimen during a frame."""
    if frame.timing is None:
        return True
    shear_px = np.abs(frame.px_from_unit @ motion[:2]) * frame.timing.frame_time_s
    return float(np.max(shear_px)) <= SHEAR_MAX * frame.size[1]


def make_measurement(
    key: int,
    before: ScanFrame,
    now: ScanFrame,
    registration: Registration,
    removed: Array,
    averaged: float,
    *,
    is_other_visit: bool = False,
) -> Measure:
    """Measurement from a registration of ``now`` against a keyframe that began with ``before``.

    Parameters
    ----------
    key
        Number of the keyframe.
    before, now
        The frames.
    registration
        The registration, in px of ``now``.
    removed
        (4,) drift velocity and acceleration that were removed from ``now``.
    averaged
        Number of frames in the keyframe's mean. Its noise is the keyframe's own and not part of
        the measurement's.
    is_other_visit
        Whether the magnification was changed in between, so that the scales differ by what a visit does.
    """
    unit = np.linalg.inv(now.px_from_unit)
    share = averaged / (averaged + 1.0) if np.isfinite(averaged) else 1.0
    covariance = share * registration.covariance + np.eye(2) * SHIFT_FLOOR_PX**2
    term_s2, scan_s = now.acceleration_term_s2, now.acquisition_time_s
    pull = unit @ registration.alignment.pull_px
    common = np.outer(pull, pull)
    if now.timing is None or not np.all(np.isfinite(registration.alignment.joint_px)):
        shift = unit @ registration.shift_px + term_s2 * removed[2:]
        covariance = unit @ covariance @ unit.T
        measure = Measure(key, shift, covariance, acceleration_term_s2=term_s2, scan_s=scan_s)
        return _tell_apart(measure, share, common)
    frame_s = now.timing.frame_time_s
    both = np.kron(np.diag([1.0, 1.0 / frame_s]), unit)
    part = max(SHEAR_OF_SHIFT, DISTORTION_OF_SCALE * relative_scale_sigma(now.camera))
    distance = float(np.hypot(*registration.shift_px))
    shear_floor = SHEAR_FLOOR_PX**2 + (part * distance) ** 2
    floor = np.diag([SHIFT_FLOOR_PX**2] * 2 + [shear_floor] * 2)
    joint = share * registration.alignment.joint_covariance + floor
    if is_other_visit and before.camera is not None and now.camera is not None:
        stretch = visit_stretch_covariance(before.camera, now.camera, float(now.size[1]))
        joint[2:, 2:] += now.px_from_unit @ stretch @ now.px_from_unit.T
    shift = both @ registration.alignment.joint_px + np.append(term_s2 * removed[2:], removed[:2])
    ratio = 1.0
    if before.timing is not None:
        # What is left of the keyframe's shear is over its field; this frame shows a part of it.
        part_of_field = now.field_height / before.field_height
        ratio = part_of_field * before.timing.frame_time_s / frame_s
    covariance = both @ joint @ both.T
    return _tell_apart(Measure(key, shift, covariance, ratio, term_s2, scan_s), share, common)


def _tell_apart(measure: Measure, share: float, common: Array) -> Measure:
    """The measurement with the covariance (2, 2) of a pull, of which its own has a ``share``, told apart from the rest;
    as it is without a pull, and where its covariance does not contain it, as that of a specimen that turns.
    """
    if not np.any(common):
        return measure
    independent = measure.covariance.copy()
    independent[:2, :2] -= share * common
    is_one = np.all(np.diag(independent) > 0.0)
    if is_one and float(np.linalg.eigvalsh(equilibrate(independent)[0])[0]) > LEAST_EIGENVALUE:
        return replace(measure, independent=independent, common=common)
    return measure


def keyframe_noise(measure: Measure) -> Array:
    """(4, 4) noise as a keyframe of a single frame like the one that was measured."""
    noise = np.zeros((4, 4))
    count = measure.shift.size
    noise[:count, :count] = measure.covariance
    return noise


def add_zoom_uncertainty(measure: Measure, before: ScanFrame, now: ScanFrame) -> Measure:
    """The measurement with the uncertainty that a change of magnification adds."""
    if before.camera is None or now.camera is None:
        return measure
    covariance = measure.covariance.copy()
    covariance[:2, :2] += zoom_covariance(before.camera, now.camera)
    return replace(
        measure, covariance=covariance, zoom=apparent_zoom_shift(before.camera, now.camera)
    )


def clone_keyframe(
    key: int, state: DriftState, measure: Measure, removed: Array, noise: Array
) -> CloneKeyframe:
    """Operation by which the measured frame becomes keyframe ``key``.

    ``removed`` (4,) is the motion that was taken out of it; ``noise`` (2, 2) is the covariance of
    its position as a keyframe about the measured one.
    """
    full = np.zeros((4, 4))
    full[:2, :2] = noise
    bend = measure.acceleration_term_s2 * removed[2:]
    if measure.shift.size == 4:
        shift = measure.shift - np.append(bend, removed[:2])
        full[2:, 2:] = measure.covariance[2:, 2:] * SHEAR_COPY_NOISE
    else:
        shift = np.append(measure.shift - bend, np.zeros(2))
        full[2:, 2:] = state.drift_covariance[2:, 2:]
    return CloneKeyframe(key, measure.key, shift, measure.shear_ratio, full, measure.zoom)


def measure_itself(key: int, measure: Measure, removed: Array) -> Measure:
    """Measurement of the frame that became keyframe ``key`` against itself: it lies there up to its
    noise.
    """
    shift = np.append(measure.acceleration_term_s2 * removed[2:], removed[:2])[: measure.shift.size]
    return replace(measure, key=key, shift=shift, shear_ratio=1.0, zoom=np.zeros((2, 2)))
