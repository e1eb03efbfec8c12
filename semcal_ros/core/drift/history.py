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

"""What a tracker did with a recording, for smoothing it with hindsight."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from semcal_ros.core.arrays import Array, solve_scaled
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.camera_uncertainty import scale_covariance
from semcal_ros.core.drift.estimates import DriftPath, DriftUpdate
from semcal_ros.core.drift.filter import DriftFilter
from semcal_ros.core.drift.similarity import SimilarityEstimate, SimilarityState, turn_drift
from semcal_ros.core.drift.smoother import estimate_process_noise, separate_common, smooth
from semcal_ros.core.drift.state import DriftState
from semcal_ros.core.drift.thresholds import INNOVATION_CHI2_MAX, LARGER_SIGMAS
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.registration.failures import SEEN_AWAY


@dataclass
class _Stretch:
    """Frames since the drift was zero: what is known now, and what was known at each of them."""

    filter: DriftFilter
    similarity: SimilarityState
    updates: list[DriftUpdate] = field(default_factory=list)


class DriftHistory:
    """The frames of a tracker, in stretches that each begin with zero drift."""

    def __init__(self) -> None:
        self._stretches: list[_Stretch] = []
        self._cameras: list[ScanCamera | None] = []

    def __len__(self) -> int:
        return len(self._cameras)

    def add(
        self,
        update: DriftUpdate,
        camera: ScanCamera | None,
        drift_filter: DriftFilter,
        similarity: SimilarityState,
    ) -> None:
        """Add a frame, with the filters after it, which keep all of their events; another start begins a stretch."""
        if not self._stretches or self._stretches[-1].filter.start is not drift_filter.start:
            self._stretches.append(_Stretch(drift_filter, similarity))
        stretch = self._stretches[-1]
        stretch.filter, stretch.similarity = drift_filter, similarity
        stretch.updates.append(update)
        self._cameras.append(camera)

    def smooth(self) -> DriftPath:
        """The drift of all frames so far, each with the knowledge of all of its stretch.

        The process noise is that which makes the measurements most likely.

        Raises
        ------
        InvalidValueError
            If there was no frame.
        """
        if not self._cameras:
            raise InvalidValueError(
                "no frames", expected="at least one", do="track at least one first"
            )
        updates: list[DriftUpdate] = []
        for stretch in self._stretches:
            drift_filter, similarity = stretch.filter, stretch.similarity
            if drift_filter.measured == 0:
                # Nothing to smooth, and the prior is not knowledge.
                updates.extend(stretch.updates)
                continue
            process_noise = drift_filter.process_noise
            events, common = separate_common(drift_filter.events)
            if process_noise.psd > 0.0:
                process_noise = estimate_process_noise(
                    drift_filter.start, events, process_noise, deviations=LARGER_SIGMAS
                )
            states = smooth(drift_filter.start, events, process_noise)
            turns, first_s = similarity.smooth(), drift_filter.start.time_s
            doubts = _find_doubts(stretch.updates)
            for k, (update, state, turn) in enumerate(
                zip(stretch.updates, states, turns, strict=True)
            ):
                camera = self._cameras[len(updates)]
                if k > 0 and update.time_s == stretch.updates[k - 1].time_s:
                    # It was not taken at that time, to which the path belongs.
                    updates.append(update)
                    continue
                smoothed = _smoothed(update, state, turn, camera)
                if _contradicts(update, smoothed):
                    updates.append(update)
                    continue
                smoothed.covariance[:2, :2] += update.unseen + doubts[k] + common[k]
                if update.time_s > first_s:
                    smoothed.covariance[:2, :2] += process_noise.flicker_covariance
                updates.append(smoothed)
        return DriftPath(tuple(updates))


def _find_doubts(stretch: list[DriftUpdate]) -> list[Array]:
    """(2, 2) what is in doubt of each frame with hindsight, besides the covariance of the path.

    Nothing is where a frame after it was matched with the keyframes from before it, and the specimen had come back to
    where the path expects it. If it had not, nobody knows when it went, and by which way: the path takes the frames
    that were not used in between to be where they would be without that. The same holds for a frame that was seen at
    another place itself.
    """
    doubts: list[Array] = []
    after: Array | None = None
    for update in reversed(stretch):
        if update.restarted:
            after = None
        elif update.accepted:
            after = update.jump
        rests_on_itself = update.accepted and not update.restarted
        if rests_on_itself or after is None:
            doubts.append(update.doubt)
        else:
            is_away = update.rejection is not None and update.rejection.status in SEEN_AWAY
            is_doubted = is_away or np.any(after)
            doubts.append(after + update.doubt if is_doubted else after)
    return doubts[::-1]


def _contradicts(update: DriftUpdate, smoothed: DriftUpdate) -> bool:
    """Whether hindsight says something else than the frame did: of two estimates of one thing, the one that rests on
    more differs from the other by no more than that is uncertain (Hausman 1978, doi:10.2307/1913827).

    It does so where stamps are wrong: of two frames a millisecond apart by their stamps, which were taken a second
    apart, the path goes through the middle. It may also lose the digits of a velocity or a place that is not known at
    all.
    """
    if (
        np.any(np.diag(smoothed.covariance) < 0.0)
        or np.linalg.det(smoothed.covariance[:2, :2]) < 0.0
    ):
        return True
    apart, covariance = smoothed.drift_m - update.drift_m, update.covariance[:2, :2]
    if not (update.accepted and np.all(np.isfinite(covariance)) and np.any(covariance)):
        return False
    if np.trace(smoothed.covariance[:2, :2]) > np.trace(covariance):
        # The frame had too small a process noise: its own sigma is the wrong one.
        return False
    return float(apart @ solve_scaled(covariance, apart)) > INNOVATION_CHI2_MAX


def _smoothed(
    update: DriftUpdate,
    state: DriftState,
    turn: SimilarityEstimate | None,
    camera: ScanCamera | None,
) -> DriftUpdate:
    """The update with what is known of it with hindsight."""
    motion = state.position, state.velocity, state.acceleration
    covariance = state.drift_covariance
    if turn is not None:
        update = replace(update, similarity=turn.mean, similarity_covariance=turn.covariance)
        if np.all(np.isfinite(turn.covariance)):
            turned = turn_drift(*motion, covariance, turn)
            motion = turned.position, turned.velocity, turned.acceleration
            covariance = turned.covariance
    of_scale = scale_covariance(camera, motion[0], motion[1])
    return replace(
        update,
        drift_m=motion[0],
        velocity_m_s=motion[1],
        acceleration_m_s2=motion[2],
        covariance=covariance + of_scale,
        of_scale=of_scale[:2, :2],
    )
