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

"""The frames of a recording as a live stream would give them, without ROS."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from semcal_ros.core.camera.calibrated_frame import CalibratedFrame, rectified_projection
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.workflows.follow_drift import DriftFollower, camera_for, start_time_s
from semcal_ros.workflows.inputs import (
    CalibrationSource,
    ConfigSource,
    Source,
    open_source,
    require_calibration,
    resolve_config,
)


def open_frames(
    source: Source,
    *,
    calibration: CalibrationSource | None = None,
    config: ConfigSource | None = None,
    drift: bool = True,
) -> Iterator[CalibratedFrame]:
    """Yield the frames of a recording, free of distortion and drift, one after the other.

    Parameters
    ----------
    source
        A bag, a folder of images, or an iterable of (image, magnification) tuples.
    calibration
        A calibration or its file. Without one, frames are not :attr:`~.CalibratedFrame.valid`.
    config
        A ``msg_configs`` name or file; that of the calibration without.
    drift
        Whether the drift is followed and taken out, as known live at each frame.

    Raises
    ------
    SemcalError
        If the recording or the calibration cannot be read.
    """
    model = None if calibration is None else require_calibration(calibration)
    microscope = resolve_config(config, model)
    rectifier = Rectifier()
    follower = DriftFollower(hindsight=False, follow=microscope.follow) if drift else None
    with open_source(source, microscope) as recording:
        first_ns: int | None = None
        for frame in recording.frames():
            first_ns = frame.stamp_ns if first_ns is None else first_ns
            camera = camera_for(frame, model, microscope)
            raster, drift_m, covariance = None, np.zeros(2), np.zeros((2, 2))
            if follower is not None:
                time_s = start_time_s(frame, first_ns, microscope)
                update = follower.update(frame, time_s, camera, microscope.scan)
                raster, drift_m, covariance = (
                    update.raster,
                    update.drift_m,
                    update.covariance[:2, :2],
                )
            image = rectifier.rectify(frame.image, camera, raster, microscope.scan)
            image.setflags(write=False)
            yield CalibratedFrame(
                image,
                frame.stamp_ns,
                frame.magnification,
                *rectified_projection(camera),
                drift_m,
                covariance,
                _explain(camera, calibrated=model is not None),
            )


def _explain(camera: ScanCamera, *, calibrated: bool) -> str:
    if not calibrated:
        return "no calibration"
    if not camera.in_range:
        return f"magnification {camera.magnification:g} outside the calibrated range"
    return ""
