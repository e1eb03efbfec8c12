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

"""The drift of a recording, frame by frame and with hindsight."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.estimates import DriftPath, DriftUpdate
from semcal_ros.core.drift.frame_time import (
    estimate_frame_time,
)
from semcal_ros.core.drift.history import DriftHistory
from semcal_ros.core.drift.settings import DriftSettings
from semcal_ros.core.drift.thresholds import (
    SHEAR_OF_SHIFT_DISTORTED,
    SHEAR_OF_SHIFT_RECTIFIED,
)
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.registration.reference import RegistrationSettings
from semcal_ros.core.wording import counted
from semcal_ros.files.recordings import RecordedFrame

#: What a user can do about a timing that is not configured.
GIVE_FRAME_TIME = "give the time of one pass as --frame-time or in a configuration"


# Drift from frame to frame, px, beyond which its shear within them is worth a note: where a pass takes
# the whole interval, the rows of a frame are then displaced by 0.5 / sqrt(12) = 0.14 px RMS.
_FAST_PX = 0.5

# Stated: frames that a note names; the table has them all.
_NAMED = 3


def camera_for(
    frame: RecordedFrame, model: Calibration | None, config: MicroscopeConfig
) -> ScanCamera:
    """Return the calibrated camera of a frame, or the nominal one from the display width."""
    height, width = frame.image.shape[:2]
    if model is None:
        return ScanCamera.nominal(frame.magnification, width, height, config.display_width_m)
    return model.at(frame.magnification).resized(width, height)


def start_time_s(frame: RecordedFrame, first_stamp_ns: int, config: MicroscopeConfig) -> float:
    """Return the start of the acquisition in seconds after the first frame's stamp."""
    return (frame.stamp_ns - first_stamp_ns) * 1e-9 + config.start_offset_s


class DriftFollower:
    """Tracks the drift of a recording, and smooths it once all frames are known.

    Parameters
    ----------
    hindsight
        Whether to keep the data for smoothing; without them only the current drift is known.
    follow
        The part of the pictures that shows the specimen, as in a
        :class:`~semcal_ros.config.config.MicroscopeConfig`.
    """

    def __init__(
        self,
        *,
        hindsight: bool = True,
        follow: tuple[float, float, float, float] | None = None,
    ) -> None:
        self.history = DriftHistory() if hindsight else None
        registration = RegistrationSettings(follow=follow)
        settings = DriftSettings(registration=registration, similarity=True)
        self.tracker = DriftTracker(settings, history=self.history)
        self.updates: list[DriftUpdate] = []
        #: Lines of the latest frame.
        self.height_px = 0
        self._smoothed: DriftPath | None = None

    def update(
        self, frame: RecordedFrame, time_s: float, camera: ScanCamera, scan: ScanTiming | None
    ) -> DriftUpdate:
        """Update with the next frame and return its drift."""
        self.height_px = frame.visible.shape[0]
        update = self.tracker.update(frame.visible, time_s, camera, scan)
        if self.history is not None:
            self.updates.append(update)
        return update

    def path(self, *, live: bool) -> DriftPath:
        """Return the drift of all frames.

        Parameters
        ----------
        live
            Whether to return the drift known live at each frame, without hindsight.
        """
        if live or self.history is None:
            return DriftPath(tuple(self.updates))
        if self._smoothed is None or len(self._smoothed) != len(self.updates):
            self._smoothed = self.history.smooth()
        return self._smoothed


def estimate_timing(
    config: MicroscopeConfig, follower: DriftFollower, model: Calibration | None
) -> tuple[MicroscopeConfig, str]:
    """Estimate the time of a pass from the drift where it is not configured.

    Parameters
    ----------
    config
        The configuration.
    follower
        It has tracked the recording with that configuration.
    model
        Calibration, or None if distortion was not removed.

    Returns
    -------
    tuple
        The configuration, with ``scan`` where that could be estimated, and a note for the user,
        which may be empty.
    """
    if config.scan is not None or len(follower.updates) < 2:
        return config, ""
    path = follower.path(live=False)
    shear_of_shift = SHEAR_OF_SHIFT_DISTORTED if model is None else SHEAR_OF_SHIFT_RECTIFIED
    estimate = estimate_frame_time(path, shear_of_shift=shear_of_shift)
    if estimate.observable:
        time_s = _format_with_sigma(estimate.frame_time_s, estimate.sigma_s)
        note = (
            f"the configuration has no scan; the frames are sheared as if one pass took {time_s} s"
        )
        return replace(config, scan=ScanTiming(estimate.frame_time_s)), note
    step_px = _largest_step_px(follower.updates)
    if not step_px > _FAST_PX:
        return config, ""
    return config, (
        f"the configuration has no scan; drift of up to {step_px:.1f} px from frame to frame may shear the frames, "
        f"too, and is then wrong by up to {100.0 * step_px / follower.height_px:.2g} %, which its sigma does not "
        f"contain; {GIVE_FRAME_TIME}"
    )


def describe_untracked(path: DriftPath) -> list[str]:
    """Say that the drift of more than half of the frames is predicted, where some of it is known at all."""
    known = int(np.count_nonzero(path.accepted))
    if not path.followed or 2 * known >= len(path):
        return []
    return [
        f"only {known} of {counted(len(path), 'frame')} could be tracked: the drift of the others is predicted from "
        "these, and the rate at the end may be, too; `status` in the table says why"
    ]


def describe_beginnings(path: DriftPath) -> list[str]:
    """Describe from which frames the drift is counted, where it is not the first one for all; frames count from 1."""
    notes = []
    first = int(np.argmax(path.accepted))
    if first > 0:
        which = "frame 1" if first == 1 else f"frames 1 to {first}"
        notes.append(
            f"drift is counted from frame {first + 1}: {which} could not be used ({path[0].reason})"
        )
    back = 1 + np.flatnonzero(np.diff(path.time_s) < 0.0)
    if back.size:
        which = ", ".join(str(k + 1) for k in back[:_NAMED])
        more = f" and {back.size - _NAMED} more" if back.size > _NAMED else ""
        notes.append(
            f"time runs backwards at {'frame' if back.size == 1 else 'frames'} {which}{more}: "
            "from there on, drift is counted from that frame"
        )
    lost = np.setdiff1d(np.flatnonzero(path.restarted), [*back, *range(first + 1)]).tolist()
    for k in lost[:_NAMED]:
        sigma_px = float(np.max(path[k].sigma_px))
        known = f"known to {sigma_px:.2g} px (1-sigma)" if np.isfinite(sigma_px) else "not known"
        notes.append(
            f"tracking began again at frame {k + 1} ({path[k].reason}): how far the specimen had moved since the "
            f"frames before is {known}"
        )
    if len(lost) > _NAMED:
        notes.append(f"tracking began again {counted(len(lost) - _NAMED, 'more time')}")
    return notes


def _format_with_sigma(value: float, sigma: float) -> str:
    """Format a value with as many decimals as the first digit of its uncertainty."""
    digits = int(np.clip(-np.floor(np.log10(sigma)), 0, 9)) if sigma > 0.0 else 3
    return f"{value:.{digits}f} +- {sigma:.{digits}f}"


def _largest_step_px(updates: Sequence[DriftUpdate]) -> float:
    """Return the drift from one frame to the next, px, that a tenth of the frames exceed."""
    pairs = [
        (before, now)
        for before, now in itertools.pairwise(updates)
        if before.accepted and now.accepted
    ]
    steps = [np.hypot(*(b.px_from_unit @ (b.drift_m - a.drift_m))) for a, b in pairs]
    return float(np.quantile(steps, 0.9)) if steps else 0.0
