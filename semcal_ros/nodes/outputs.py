"""What the stream nodes publish for each frame, with the header of the frame."""

from __future__ import annotations

from typing import Any

from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image

from semcal_ros.bridge import fill_camera_info, fill_drift, fill_drift_velocity, fill_image
from semcal_ros.core.camera import ScanCamera
from semcal_ros.core.drift import DriftUpdate
from semcal_ros.nodes.base import SemNode
from semcal_ros.nodes.stream import Frame

__all__ = ["DriftOutput", "ImageOutput", "RectifiedOutput"]


class ImageOutput:
    """Publishes images on one topic."""

    def __init__(self, node: SemNode, topic: str) -> None:
        self._node = node
        self._publisher = node.stream_publisher(Image, topic)

    def publish(self, image: NDArray[Any], frame: Frame) -> None:
        """Publish an image made from ``frame``."""
        message = Image()
        fill_image(message, image, frame.encoding, frame.header)
        self._publisher.publish(message)
        self._node.count_published(frame.stamp_ns)


class RectifiedOutput:
    """Publishes ``image_rect`` and ``camera_info`` in pairs."""

    def __init__(self, node: SemNode) -> None:
        self._image = ImageOutput(node, "image_rect")
        self._info = node.stream_publisher(CameraInfo, "camera_info")

    def publish(self, image: NDArray[Any], camera: ScanCamera | None, frame: Frame) -> None:
        """Publish a rectified image; ``camera`` is None while there is no calibration."""
        info = CameraInfo()
        fill_camera_info(info, camera, frame.header, image.shape[1], image.shape[0])
        # The description first: a consumer that has the image can then use it at once.
        self._info.publish(info)
        self._image.publish(image, frame)


class DriftOutput:
    """Publishes ``drift`` and ``drift_velocity``, and notes how the tracking goes."""

    def __init__(self, node: SemNode) -> None:
        self._node = node
        self._drift = node.stream_publisher(PoseWithCovarianceStamped, "drift")
        self._velocity = node.stream_publisher(TwistWithCovarianceStamped, "drift_velocity")
        self._coasting = 0
        self.trouble = ""

    def publish(self, drift: DriftUpdate, frame: Frame) -> None:
        """Publish the drift, in m, at the centre of a frame."""
        pose, twist = PoseWithCovarianceStamped(), TwistWithCovarianceStamped()
        fill_drift(pose, drift.drift_m, drift.covariance, frame.header)
        fill_drift_velocity(twist, drift.velocity_m_s, drift.covariance, frame.header)
        self._drift.publish(pose)
        self._velocity.publish(twist)
        self._coasting += 0 if drift.accepted else 1
        self.trouble = "" if drift.accepted else f"drift {drift.status}"
        notes = (
            ("drift_status", drift.status),
            ("drift_residual", float(drift.residual)),
            ("drift_overlap", float(drift.overlap)),
            ("drift_frames_coasted", self._coasting),
        )
        for key, value in notes:
            self._node.statistics.note(key, value)
