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

"""Corrected frames as a bag, one message of each kind per frame."""

from __future__ import annotations

from typing import Any

from semcal_ros.bridge.calibration import fill_calibration_text
from semcal_ros.bridge.camera import fill_camera_info, fill_projection, fill_stamped_projection
from semcal_ros.bridge.drift import (
    fill_drift,
    fill_drift_velocity,
    rotation_of,
    rotation_rate_of,
)
from semcal_ros.bridge.fields import fill_header
from semcal_ros.bridge.images import fill_image
from semcal_ros.core.arrays import AnyImage
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.estimates import DriftUpdate
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.files.bags.writer import BagWriter
from semcal_ros.files.recordings import RecordedFrame

_TOPICS = {
    "image_rect": "sensor_msgs/msg/Image",
    "camera_info": "sensor_msgs/msg/CameraInfo",
    "magnification": "std_msgs/msg/Float64",
    "drift": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "drift_velocity": "geometry_msgs/msg/TwistWithCovarianceStamped",
    "projection": "std_msgs/msg/Float64MultiArray",
    "projection_stamped": "sensor_msgs/msg/Image",
    "calibration": "std_msgs/msg/String",
}
_LATCHED = ("projection", "calibration")


class CorrectedBagWriter:
    """Writes what ``stream_corrector`` and ``parameter_server`` would publish.

    Parameters
    ----------
    writer
        An open bag.
    namespace
        Namespace of the topics, without a trailing slash.
    calibration_text
        Text of the calibration file, for the topic ``calibration``.
    """

    def __init__(self, writer: BagWriter, namespace: str, calibration_text: str) -> None:
        self._writer = writer
        self._namespace = namespace
        self._calibration_text = calibration_text
        self._magnification: float | None = None

    def write(
        self, frame: RecordedFrame, image: AnyImage, camera: ScanCamera, update: DriftUpdate | None
    ) -> None:
        """Write one frame.

        Parameters
        ----------
        frame
            The frame as recorded.
        image
            The corrected image.
        camera
            Its camera.
        update
            Its drift; None if the drift was not removed.
        """
        header = blank_message("std_msgs/msg/Header")
        fill_header(header, frame.stamp_ns, frame.frame_id)
        when = frame.log_time_ns
        if frame.magnification != self._magnification:
            self._write_magnification(frame, camera)
        rectified = blank_message(_TOPICS["image_rect"])
        fill_image(rectified, image, frame.encoding, header)
        self._write("image_rect", when, rectified)
        info = blank_message(_TOPICS["camera_info"])
        fill_camera_info(info, camera, header, image.shape[1], image.shape[0])
        self._write("camera_info", when, info)
        matrix = blank_message(_TOPICS["projection_stamped"])
        fill_stamped_projection(matrix, camera, header, image.shape[1], image.shape[0])
        self._write("projection_stamped", when, matrix)
        if update is not None:
            drift = blank_message(_TOPICS["drift"])
            fill_drift(drift, update.drift_m, update.covariance, header, rotation_of(update))
            self._write("drift", when, drift)
            velocity = blank_message(_TOPICS["drift_velocity"])
            fill_drift_velocity(
                velocity, update.velocity_m_s, update.covariance, header, rotation_rate_of(update)
            )
            self._write("drift_velocity", when, velocity)

    def _write_magnification(self, frame: RecordedFrame, camera: ScanCamera) -> None:
        if self._magnification is None:
            text = blank_message(_TOPICS["calibration"])
            fill_calibration_text(text, self._calibration_text)
            self._write("calibration", frame.log_time_ns, text)
        self._magnification = frame.magnification
        magnification = blank_message(_TOPICS["magnification"])
        magnification.data = frame.magnification
        self._write("magnification", frame.log_time_ns, magnification)
        projection = blank_message(_TOPICS["projection"])
        fill_projection(projection, camera)
        self._write("projection", frame.log_time_ns, projection)

    def _write(self, topic: str, log_time_ns: int, message: Any) -> None:
        name = f"{self._namespace}/{topic}"
        latched = topic in _LATCHED
        self._writer.add_topic(name, _TOPICS[topic], latched=latched, depth=1 if latched else 10)
        self._writer.write(name, log_time_ns, message)
