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

"""What the rectifying nodes share."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.calibrated_frame import (
    CalibratedFrame,
    describe_missing_camera,
    rectified_projection,
)
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.nodes.common.parameters import (
    CALIBRATION,
    INTERPOLATION,
    REPLAYED_CALIBRATION,
    ParameterDeclaration,
)
from semcal_ros.nodes.frames.calibration_input import OUT_OF_RANGE, CalibrationInput, RangeWatch
from semcal_ros.nodes.frames.compressed import compressed_parameters
from semcal_ros.nodes.frames.held_values import ON_MISMATCH, ConditionsWatch
from semcal_ros.nodes.frames.outputs import RectifiedOutput
from semcal_ros.nodes.frames.stream import StreamFrame, StreamNode

if TYPE_CHECKING:  # the filter behind it needs scipy.optimize, which a node without drift does not
    from semcal_ros.nodes.frames.live_drift import FrameDrift

_WITHOUT_CAMERA = (
    ParameterDeclaration(
        "uncalibrated",
        "pass",
        "What happens to frames while there is no calibration. pass: they go out unrectified, with a camera_info"
        " of zeros that says so. drop: image_rect stays silent.",
        choices=("pass", "drop"),
    ),
    OUT_OF_RANGE,
    ON_MISMATCH,
)


class CalibratedStreamNode(StreamNode):
    """A stream node with a calibration, and the outputs of :class:`RectifiedOutput`."""

    def __init__(self, name: str, declarations: Iterable[ParameterDeclaration] = ()) -> None:
        super().__init__(
            name,
            (
                CALIBRATION,
                REPLAYED_CALIBRATION,
                INTERPOLATION,
                *_WITHOUT_CAMERA,
                *compressed_parameters("image_rect"),
                *declarations,
            ),
        )
        self.calibration = CalibrationInput(self.node_context, on_change=self.on_calibration)
        self.output = RectifiedOutput(self.node_context)
        # After the last compressed image.
        self.closing.callback(self.output.close)
        self._range = RangeWatch(self.reporter)
        self._watch = ConditionsWatch(self.node_context, lambda: self.calibration.current)
        self._dropped = 0
        self._refused = 0
        # Only the latest: most frames have the magnification of the frame before.
        self._camera: tuple[object, tuple[float, int, int], ScanCamera | None] | None = None
        self._receivers: list[Callable[[CalibratedFrame], None]] = []
        self._projection: tuple[ScanCamera | None, tuple[Array, Array]] | None = None

    def on_calibration(self) -> None:
        """React to a new calibration in force; not called for the calibration given at start."""

    def receive_frames(self, on_frame: Callable[[StreamFrame], None], **options: Any) -> None:
        """Extend the base class: magnifications are on the scale of the calibration in force."""
        super().receive_frames(
            on_frame, magnification_config=lambda: self.calibration.config, **options
        )

    def camera(self, frame: StreamFrame, magnification: float) -> ScanCamera | None:
        """Return the calibrated camera of a frame, or None while there is no calibration."""
        current, seen_at = self.calibration.current, (magnification, *frame.size)
        if self._camera is None or self._camera[0] is not current or self._camera[1] != seen_at:
            self._camera = current, seen_at, self.calibration.camera(*seen_at)
        camera = self._camera[2]
        self._range.check(current, camera, magnification)
        return camera

    def hand_to(self, receive: Callable[[CalibratedFrame], None]) -> None:
        """Call ``receive`` with each frame that is published, in the thread of this node, before others get it."""
        self._receivers.append(receive)
        self.output.give_memory_away()

    def publish(
        self,
        camera: ScanCamera | None,
        frame: StreamFrame,
        drift: FrameDrift | None = None,
    ) -> None:
        """Publish the image in the memory of the output, with its camera if it has one that counts.

        Parameters
        ----------
        camera, frame
            Of the image.
        drift
            What was taken out of it.
        """
        if self.calibration.current is None and self.parameters["uncalibrated"] == "drop":
            self._dropped += 1
            self.reporter.note("frames_uncalibrated", self._dropped)
            return
        self._watch.check()
        if self._watch.differs and self.parameters["on_mismatch"] == "refuse":
            self._refused += 1
            self.reporter.note("frames_refused", self._refused)
            return
        extrapolated = camera is not None and not camera.in_range
        if frame.mixed or (extrapolated and self.parameters["out_of_range"] == "flag"):
            camera = None
        if self._receivers:
            handed_on = self._calibrated(camera, frame, drift)
            for receive in self._receivers:
                receive(handed_on)
        self.output.publish(camera, frame)

    def _calibrated(
        self,
        camera: ScanCamera | None,
        frame: StreamFrame,
        drift: FrameDrift | None,
    ) -> CalibratedFrame:
        if self._projection is None or self._projection[0] is not camera:
            self._projection = camera, rectified_projection(camera)
        image = self.output.pixels.view()
        image.setflags(write=False)
        drift_m, covariance = np.zeros(2), np.zeros((2, 2))
        if drift is not None:
            drift_m, covariance = drift.estimate.drift_m, drift.estimate.covariance[:2, :2]
        has_camera = camera is not None
        return CalibratedFrame(
            image,
            frame.stamp_ns,
            frame.magnification,
            *self._projection[1],
            drift_m,
            covariance,
            "" if has_camera else describe_missing_camera(frame.magnification, mixed=frame.mixed),
        )

    def introduction(self) -> list[str]:
        """Extend the base class: also the calibration."""
        return [*super().introduction(), self.calibration.introduction]

    def conditions(self) -> list[str]:
        """Extend the base class: also report a calibration that is missing, or that does not cover the
        magnification, or whose scale is in doubt, or that was made under other conditions.
        """
        found = super().conditions()
        if self.calibration.current is not None and self._range.is_outside:
            found.append("magnification outside the calibrated range")
        return found + self.calibration.conditions() + self._watch.conditions()
