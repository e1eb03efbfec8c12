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

"""What a caller may choose of the tracking of drift."""

from __future__ import annotations

from dataclasses import dataclass, field

from semcal_ros.core.drift.thresholds import (
    FIRST_STEP_PX,
    JUMP_MAX,
    KEYFRAME_BYTES_MAX,
    KEYFRAMES_MAX,
    LOST_AFTER,
    RATIO_MAX,
    REKEY_OVERLAP,
)
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.registration.reference import RegistrationSettings


@dataclass(frozen=True)
class DriftSettings:
    """How drift is tracked; the defaults have their sources in :mod:`semcal_ros.core.drift.thresholds`.

    Attributes
    ----------
    registration
        Limits of a single registration.
    rekey_overlap
        The keyframe is replaced when less than this fraction of the image still overlaps with it.
    max_jump
        A shift between frames beyond this fraction of the field is a move of the stage, not
        drift.
    first_step_px
        Expected drift (1-sigma) between the first two frames, px.
    max_ratio
        Largest change of magnification across which the keyframe is carried by resampling.
    lost_after
        Number of frames in a row that cannot be matched after which tracking starts again at the
        predicted drift.
    acceleration_psd
        Process noise, m^2/s^3 (px^2/s^3 without a camera); None adapts it to the stream.
    average
        Whether frames are added to their keyframe, so that its noise does not limit what follows.
    max_keyframes, max_keyframe_bytes
        Number of images that are kept to come back to, and their memory.
    interpolation
        Interpolation of the rectification before registration.
    similarity
        Whether a rotation and a change of scale are looked for, and removed as drift. Not where what the specimen
        does is the point, as for a servo that turns it.
    """

    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    rekey_overlap: float = REKEY_OVERLAP
    max_jump: float = JUMP_MAX
    first_step_px: float = FIRST_STEP_PX
    max_ratio: float = RATIO_MAX
    lost_after: int = LOST_AFTER
    acceleration_psd: float | None = None
    average: bool = True
    max_keyframes: int = KEYFRAMES_MAX
    max_keyframe_bytes: int = KEYFRAME_BYTES_MAX
    interpolation: str = "cubic"
    similarity: bool = False

    def __post_init__(self) -> None:
        checks = (
            ("rekey_overlap", 0.0 < self.rekey_overlap < 1.0, "a fraction between 0 and 1"),
            ("max_jump", 0.0 < self.max_jump <= 1.0, "a fraction between 0 and 1"),
            ("first_step_px", self.first_step_px > 0.0, "a positive number of px"),
            ("max_ratio", self.max_ratio >= 1.0, "at least 1"),
            ("lost_after", self.lost_after >= 2, "at least 2 frames"),
            ("max_keyframes", self.max_keyframes >= 2, "at least 2"),
            ("acceleration_psd", (self.acceleration_psd or 0.0) >= 0.0, "a number >= 0 or None"),
        )
        for name, good, expected in checks:
            if not good:
                raise InvalidValueError(f"{name} = {getattr(self, name)}", expected=expected)
