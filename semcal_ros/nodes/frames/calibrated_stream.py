"""What the rectifying nodes share."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.nodes.common.parameters import CALIBRATION, INTERPOLATION, ParameterDeclaration
from semcal_ros.nodes.frames.calibration_input import CalibrationInput
from semcal_ros.nodes.frames.compressed import compressed_parameters
from semcal_ros.nodes.frames.outputs import RectifiedOutput
from semcal_ros.nodes.frames.stream import StreamFrame, StreamNode

__all__ = ["CalibratedStreamNode"]


class CalibratedStreamNode(StreamNode):
    """A stream node with a calibration, a rectifier, and the outputs ``image_rect`` and ``camera_info``."""

    def __init__(self, name: str, declarations: Iterable[ParameterDeclaration] = ()) -> None:
        super().__init__(
            name, (CALIBRATION, INTERPOLATION, *compressed_parameters("image_rect"), *declarations)
        )
        self.rectifier = Rectifier(self.parameters["interpolation"])
        self.parameters.on_change("interpolation", self._set_interpolation)
        self.calibration = CalibrationInput(
            self.config,
            self.parameters,
            self.endpoints,
            self.reporter,
            on_change=self.on_calibration,
        )
        self.output = RectifiedOutput(self.parameters, self.endpoints, self.reporter)
        # After the last compressed image.
        self.closing.callback(self.output.close)
        self._out_of_range = False
        # The latest: most frames have the magnification of the one before.
        self._camera: tuple[object, tuple[float, int, int], ScanCamera | None] | None = None

    def on_calibration(self) -> None:
        """Called when another calibration has come into force, but not for the one given at start."""

    def receive_frames(self, on_frame: Callable[[StreamFrame], None], **options: Any) -> None:
        """As in the base class, with magnifications on the scale of the calibration in force."""
        super().receive_frames(
            on_frame, magnification_config=lambda: self.calibration.config, **options
        )

    def _set_interpolation(self, value: str) -> None:
        self.rectifier = Rectifier(value)

    def camera(self, frame: StreamFrame, magnification: float) -> ScanCamera | None:
        """Calibrated camera of a frame, or None while there is no calibration."""
        current, seen_at = self.calibration.current, (magnification, *frame.size)
        if self._camera is None or self._camera[0] is not current or self._camera[1] != seen_at:
            self._camera = current, seen_at, self.calibration.camera(*seen_at)
        camera = self._camera[2]
        self._out_of_range = camera is not None and not camera.in_range
        self.reporter.note("in_calibrated_range", camera is not None and camera.in_range)
        return camera

    def conditions(self) -> list[str]:
        """As in the base class; also whether the calibration is missing or does not reach."""
        found = super().conditions()
        if self.calibration.current is None:
            found.append("uncalibrated")
        elif self._out_of_range:
            found.append("magnification outside of the calibrated range")
        return found
