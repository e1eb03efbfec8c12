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

"""What the stream nodes publish for each frame, with the header of the frame."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, Image

from semcal_ros.bridge.drift import fill_drift, fill_drift_velocity, rotation_of, rotation_rate_of
from semcal_ros.bridge.fields import copy_header
from semcal_ros.bridge.images import fill_image, pixel_memory
from semcal_ros.bridge.projection import (
    fill_camera_info,
    fill_raw_camera_info,
    fill_stamped_projection,
    fill_stamped_projection_covariance,
)
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.rectification.raw_positions import RasterDrift
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.parameters import INTERPOLATION
from semcal_ros.nodes.frames.compressed import CompressedOutput
from semcal_ros.nodes.frames.stream import StreamFrame

if TYPE_CHECKING:  # the filter behind it needs scipy.optimize, which a node without drift does not
    from semcal_ros.core.drift.estimates import DriftUpdate
    from semcal_ros.nodes.frames.live_drift import FrameDrift


class ImageOutput:
    """Publishes images on one topic, from memory that is reused for each image, and compressed copies beside it.

    The node declares :data:`~semcal_ros.nodes.common.parameters.INTERPOLATION` and the parameters of
    :func:`~semcal_ros.nodes.frames.compressed.compressed_parameters`.

    Attributes
    ----------
    pixels
        The memory of the last image.
    reuses_memory
        Whether it is; not where the pixels are handed over to others of this process.
    """

    def __init__(self, context: NodeContext, topic: str) -> None:
        self._reporter = context.reporter
        self._message = Image()
        self._publisher = context.endpoints.stream_publisher(Image, topic)
        self._compressed = CompressedOutput(context, topic)
        self._scan = context.config.scan
        self._set_interpolation(context.parameters[INTERPOLATION.name])
        context.parameters.on_change(INTERPOLATION.name, self._set_interpolation)
        self.pixels: NDArray[Any] = np.empty(0)
        self.reuses_memory = True

    def render(
        self, frame: StreamFrame, camera: ScanCamera | None, drift: RasterDrift | None = None
    ) -> None:
        """Rectify a frame into the memory, in one interpolation; raises as :meth:`Rectifier.rectify`.

        Parameters
        ----------
        frame
            The raw image, and its header.
        camera
            Whose distortion is taken out; None for none.
        drift
            What is taken out with it.
        """
        if not self.reuses_memory:
            self._message = Image()
        self.pixels = pixel_memory(self._message, frame.image, frame.encoding, frame.header)
        self._rectifier.rectify(frame.image, camera, drift, self._scan, out=self.pixels)

    def _set_interpolation(self, value: str) -> None:
        self._rectifier = Rectifier(value)

    def publish(self, frame: StreamFrame) -> None:
        """Publish the image in the memory."""
        if self._publisher.is_awaited:
            self._publisher.publish(self._message)
        self._reporter.count_published(frame.stamp_ns)
        self._compressed.publish(self.pixels, frame)

    def close(self) -> None:
        """Wait for the compressing thread; call it before the node is destroyed."""
        self._compressed.close()


class _CameraOutput:
    """A message about the camera of a frame, filled again only where another camera or size is due."""

    def __init__(
        self, message: Any, fill: Callable[[Any, ScanCamera | None, Any, int, int], None]
    ) -> None:
        self._message = message
        self._fill = fill
        # What the message describes, apart from its header.
        self._described: tuple[ScanCamera | None, tuple[int, int]] | None = None

    def message_for(self, camera: ScanCamera | None, frame: StreamFrame) -> Any:
        """Return the message with the header of a frame."""
        known = self._described
        if known is None or known[0] is not camera or known[1] != frame.size:
            self._fill(self._message, camera, frame.header, *frame.size)
            self._described = camera, frame.size
        else:
            copy_header(self._message.header, frame.header)
        return self._message


class RectifiedOutput:
    """Publishes ``image_rect`` with ``camera_info``, ``projection_stamped`` and ``projection_covariance_stamped``,
    which have its header.

    The same camera_info goes out on ``image_rect/camera_info``; that of the raw image, as image_pipeline means it, on
    ``image_raw/camera_info``.

    Parameters
    ----------
    context
        Of the node.
    """

    def __init__(self, context: NodeContext) -> None:
        endpoints = context.endpoints
        self._reporter = context.reporter
        self._databar_rows = 0
        self._image = ImageOutput(context, "image_rect")
        sibling, below = endpoints.beside("camera_info", "image_rect"), "image_rect/camera_info"
        matrix = "projection_stamped"
        covariance = "projection_covariance_stamped"
        raw = context.config.image.topic
        info = _CameraOutput(CameraInfo(), fill_camera_info)
        projection = _CameraOutput(Image(), fill_stamped_projection)
        spread = _CameraOutput(Image(), fill_stamped_projection_covariance)
        raw_info = _CameraOutput(CameraInfo(), self._fill_raw)
        # These take microseconds and are latched: a subscriber that comes after the last frame gets its camera.
        self._always = (
            (endpoints.camera_publisher(CameraInfo, "camera_info", sibling), info),
            (
                endpoints.camera_publisher(
                    CameraInfo, below, endpoints.below("image_rect", "camera_info")
                ),
                info,
            ),
        )
        self._where_awaited = (
            (
                endpoints.camera_publisher(
                    CameraInfo, f"{raw}/camera_info", endpoints.below(raw, "camera_info")
                ),
                raw_info,
            ),
            (
                endpoints.stream_publisher(
                    Image, covariance, endpoints.beside(covariance, "image_rect")
                ),
                spread,
            ),
            (
                endpoints.stream_publisher(Image, matrix, endpoints.beside(matrix, "image_rect")),
                projection,
            ),
        )

    def render(
        self, frame: StreamFrame, camera: ScanCamera | None, drift: RasterDrift | None = None
    ) -> None:
        """As :meth:`ImageOutput.render`."""
        self._image.render(frame, camera, drift)

    def close(self) -> None:
        """As :meth:`ImageOutput.close`."""
        self._image.close()

    @property
    def pixels(self) -> NDArray[Any]:
        """The memory of the last image."""
        return self._image.pixels

    def give_memory_away(self) -> None:
        """Take new memory for each image from now on; others of this process keep it."""
        self._image.reuses_memory = False

    def publish(self, camera: ScanCamera | None, frame: StreamFrame) -> None:
        """Publish the rectified image; ``camera`` is None if the image has no camera."""
        self._databar_rows = frame.databar_rows
        # The camera first: a subscriber that has the image can then use it at once.
        for publisher, output in self._where_awaited:
            if publisher.is_awaited:
                publisher.publish(output.message_for(camera, frame))
        for publisher, output in self._always:
            publisher.publish(output.message_for(camera, frame))
        self._image.publish(frame)

    def _fill_raw(
        self, message: Any, camera: ScanCamera | None, header: Any, width: int, height: int
    ) -> None:
        # For a subscriber that most streams do not have: scipy.optimize takes 20 MB and tenths of a second.
        from semcal_ros.core.camera.pinhole_model import fit_plumb_bob

        model = None if camera is None else fit_plumb_bob(camera, width, height)
        if model is not None:
            self._reporter.note("raw_camera_info_error_px", model.worst_px)
        fill_raw_camera_info(message, model, header, width, height + self._databar_rows)


class DriftOutput:
    """Publishes ``drift``, ``drift_velocity`` and ``~/moving``, and notes the state of the tracking."""

    def __init__(self, context: NodeContext) -> None:
        endpoints = context.endpoints
        self._reporter = context.reporter
        self._drift = endpoints.stream_publisher(PoseWithCovarianceStamped, "drift")
        self._velocity = endpoints.stream_publisher(TwistWithCovarianceStamped, "drift_velocity")
        self._moving = endpoints.stream_publisher(Image, "~/moving")
        self._messages = PoseWithCovarianceStamped(), TwistWithCovarianceStamped()
        self._mask = Image()
        self._coasting = 0
        self._forecast = 0
        self.trouble = ""

    def publish(self, drift: FrameDrift, frame: StreamFrame) -> None:
        """Publish the drift, in m, at the centre of a frame."""
        pose, twist = self._messages
        # A few matrices per frame, filled only where they are awaited.
        if self._drift.is_awaited:
            fill_drift(
                pose,
                drift.estimate.drift_m,
                drift.estimate.covariance,
                frame.header,
                rotation_of(drift.estimate),
            )
            self._drift.publish(pose)
        if self._velocity.is_awaited:
            fill_drift_velocity(
                twist,
                drift.estimate.velocity_m_s,
                drift.estimate.covariance,
                frame.header,
                rotation_rate_of(drift.estimate),
            )
            self._velocity.publish(twist)
        if self._moving.is_awaited:
            fill_image(self._mask, drift.draw_moving(frame.size), "mono8", frame.header)
            self._moving.publish(self._mask)
        measured = drift.measured
        self._coasting += not (measured.accepted or drift.is_forecast)
        self._forecast += drift.is_forecast
        self.trouble = "" if measured.accepted else f"drift {measured.status_text}"
        notes: tuple[tuple[str, float | str], ...] = (
            ("drift_status", measured.status_text),
            ("drift_residual", float(measured.residual)),
            ("drift_overlap", float(measured.overlap)),
            ("drift_moving_share", 0.0 if measured.moving is None else measured.moving.share),
            *_own_motion_notes(measured),
            ("drift_fixed_share", measured.fixed_share),
            ("drift_stripes", str(measured.stripes)),
            ("drift_frames_coasted", self._coasting),
            ("drift_frames_forecast", self._forecast),
        )
        for key, value in notes:
            self._reporter.note(key, value)


def _own_motion_notes(measured: DriftUpdate) -> tuple[tuple[str, float], ...]:
    """Velocity of what moves by itself and its 1-sigma along the worse direction; not a number where not determined."""
    own = measured.own_motion
    vx, vy = (math.nan, math.nan) if own is None else own.velocity_m_s.tolist()
    sigma = math.nan
    if own is not None:
        sigma = math.sqrt(float(np.linalg.eigvalsh(own.covariance)[-1]))
    return (
        ("drift_moving_velocity_x", vx),
        ("drift_moving_velocity_y", vy),
        ("drift_moving_velocity_sigma", sigma),
    )
