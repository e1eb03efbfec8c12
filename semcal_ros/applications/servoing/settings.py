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

"""Settings of visual servoing."""

from __future__ import annotations

from dataclasses import dataclass

from semcal_ros.core.errors import InvalidValueError


@dataclass(frozen=True)
class ServoSettings:
    """Settings of :class:`~semcal_ros.applications.servoing.law.Servo`.

    Attributes
    ----------
    gain_hz
        Part of the error that is removed per second, 1/s.
    speed_limit_m_s, turn_limit_rad_s
        Largest commanded speeds.
    travel_limit_px
        Largest movement of a feature within a frame, whose acquisition blurs it by that much.
    tolerance_px
        Distance to the goal, RMS over the features, below which the servo has converged; the
        distance must be known to half of it (1-sigma).
    settle_frames
        Number of successive frames in which this must hold.
    scale_tolerance
        Largest relative difference between the size of the target and the size that the camera of
        the frame predicts: beyond it, frame and camera are of different magnifications.
    max_sigma_px
        Largest 1-sigma of a pose that is used.
    feed_forward
        Whether motion that the commands do not explain (drift) is estimated and compensated.
    drift_sigma_m_s, drift_change_m_s
        Expected drift (1-sigma), and its change within a second.
    axis_sigma_px, axis_change_px
        Error of the cameras in the position of the optical axis (1-sigma), and its change from one
        magnification to the next. Changes of magnification serve to correct it; 0 disables the
        correction.
    slip
        Relative error of the stage's travel (1-sigma), which is not taken for drift.
    """

    gain_hz: float = 1.0
    speed_limit_m_s: float = 50e-6
    turn_limit_rad_s: float = 0.1
    travel_limit_px: float = 12.0
    tolerance_px: float = 0.5
    settle_frames: int = 3
    scale_tolerance: float = 0.05
    max_sigma_px: float = 1.0
    feed_forward: bool = True
    drift_sigma_m_s: float = 50e-9
    drift_change_m_s: float = 5e-9
    axis_sigma_px: float = 15.0
    axis_change_px: float = 0.3
    slip: float = 0.03

    def __post_init__(self) -> None:
        for name in (
            "gain_hz",
            "speed_limit_m_s",
            "turn_limit_rad_s",
            "travel_limit_px",
            "tolerance_px",
            "settle_frames",
            "scale_tolerance",
            "max_sigma_px",
        ):
            if not getattr(self, name) > 0:
                raise InvalidValueError(
                    f"{name} = {getattr(self, name)}", expected="a positive number"
                )
        for name in (
            "drift_sigma_m_s",
            "drift_change_m_s",
            "axis_sigma_px",
            "axis_change_px",
            "slip",
        ):
            if not getattr(self, name) >= 0:
                raise InvalidValueError(f"{name} = {getattr(self, name)}", expected="a number >= 0")
