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

from dataclasses import replace

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.camera_uncertainty import scale_covariance
from semcal_ros.core.drift.estimates import DriftPath, DriftUpdate
from semcal_ros.core.drift.filter import DriftFilter
from semcal_ros.core.drift.smoother import estimate_process_noise, smooth
from semcal_ros.core.errors import InvalidValueError

__all__ = ["DriftHistory"]


class DriftHistory:
    """The frames of a tracker, in stretches that each begin with zero drift."""

    def __init__(self) -> None:
        self._stretches: list[tuple[DriftFilter, list[DriftUpdate]]] = []
        self._cameras: list[ScanCamera | None] = []

    def __len__(self) -> int:
        return len(self._cameras)

    def begin(self, drift_filter: DriftFilter) -> None:
        """Begin a new stretch."""
        self._stretches.append((drift_filter, []))

    def add(self, update: DriftUpdate, camera: ScanCamera | None) -> None:
        """Add a frame."""
        self._stretches[-1][1].append(update)
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
        for drift_filter, stretch in self._stretches:
            process_noise = drift_filter.process_noise
            if process_noise.psd > 0.0:
                process_noise = estimate_process_noise(
                    drift_filter.start, drift_filter.events, process_noise
                )
            states = smooth(drift_filter.start, drift_filter.events, process_noise)
            for update, state in zip(stretch, states, strict=True):
                camera = self._cameras[len(updates)]
                scale = scale_covariance(camera, state.position, state.velocity)
                updates.append(
                    replace(
                        update,
                        drift_m=state.position,
                        velocity_m_s=state.velocity,
                        acceleration_m_s2=state.acceleration,
                        covariance=state.drift_covariance + scale,
                    )
                )
        return DriftPath(tuple(updates))
