"""Executable ``calibration_server``: collects views of the grid from the live stream and calibrates from them."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from sensor_msgs.msg import Image
from std_msgs.msg import String
from std_srvs.srv import Trigger

from semcal_ros.bridge import (
    DiagnosticLevel,
    DiagnosticSummary,
    fill_calibration_text,
    fill_diagnostic_status,
    fill_image,
    to_gray,
)
from semcal_ros.bridge.overlay import corner_overlay
from semcal_ros.calibration import Calibration
from semcal_ros.core.calibrate import METHODS, RESIDUAL_MODES
from semcal_ros.core.corners import find_lattice
from semcal_ros.core.errors import CalibrationError, InvalidValueError
from semcal_ros.nodes.base import NODE_ERRORS
from semcal_ros.nodes.calibration_worker import CalibrationJob, run_job, without_images
from semcal_ros.nodes.run import run_node
from semcal_ros.nodes.settings import Setting
from semcal_ros.nodes.stream import Frame, FrameInput, StreamNode
from semcal_ros.pipeline import FoundView

__all__ = ["CalibrationServer", "main"]

_SETTINGS = (
    Setting("method", "joint", "Calibration method.", choices=tuple(METHODS)),
    Setting(
        "residual",
        "auto",
        "Field for what the distortion parameters cannot describe (joint).",
        choices=tuple(RESIDUAL_MODES),
    ),
    Setting("output", "", "File that ~/save writes."),
)
_THREADS = 4


class CalibrationServer(StreamNode):
    """Services ~/add_view, ~/calibrate, ~/save and ~/clear; topics ``calibration``, ~/progress and ~/overlay.

    ~/calibrate answers when the calibration is done; views can be added meanwhile for the next one.
    """

    def __init__(self) -> None:
        super().__init__("calibration_server", _SETTINGS)
        self._lock = threading.Lock()
        self._newest: Frame | None = None
        self._added: Frame | None = None
        self._views: list[FoundView] = []
        self._calibration: Calibration | None = None
        self._stopping = False
        self._text = self.latched_publisher(String, "calibration")
        self._progress = self.latched_publisher(DiagnosticStatus, "~/progress")
        self._overlay = self.stream_publisher(Image, "~/overlay")
        self._input = FrameInput(self, self._on_frame, group=MutuallyExclusiveCallbackGroup())
        quick, slow = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        handlers = (
            ("add_view", self._add_view, quick),
            ("save", self._save, quick),
            ("clear", self._clear, quick),
            ("calibrate", self._calibrate, slow),
        )
        self._answers = [
            self.create_service(
                Trigger, f"~/{name}", self._answering(handler), callback_group=group
            )
            for name, handler, group in handlers
        ]
        self._report_progress("no views yet")

    def destroy_node(self) -> None:
        """Give up a running calibration first."""
        self._stopping = True
        super().destroy_node()

    def _answering(self, handler: Any) -> Any:
        def answer(_request: Any, response: Any) -> Any:
            try:
                response.message = handler()
                response.success = True
            except NODE_ERRORS as error:
                response.message = " ".join(str(error).split())
                response.success = False
                self.get_logger().warning(response.message)
            level = DiagnosticLevel.OK if response.success else DiagnosticLevel.WARN
            self._report_progress(response.message, level)
            return response

        return answer

    def _report_progress(self, text: str, level: DiagnosticLevel = DiagnosticLevel.OK) -> None:
        with self._lock:
            views = list(self._views)
        values = [("views", str(len(views)))]
        values.append(("corners", str(sum(len(view.detection.xy) for view in views))))
        counts = Counter(view.magnification for view in views)
        values += [(f"views at {g:g}x", str(counts[g])) for g in sorted(counts)]
        status = DiagnosticStatus()
        name = f"{self.get_fully_qualified_name()}: calibration"
        summary = DiagnosticSummary(level, text, tuple(values))
        fill_diagnostic_status(status, name, self.config.name, summary)
        self._progress.publish(status)

    # -- stream ------------------------------------------------------------------------------------

    def _on_frame(self, frame: Frame) -> None:
        if self.known_magnification(frame) is not None:
            with self._lock:
                self._newest = frame

    # -- services ----------------------------------------------------------------------------------

    def _add_view(self) -> str:
        with self._lock:
            frame, name = self._newest, f"view {len(self._views)}"
        if frame is None or frame.magnification is None:
            raise InvalidValueError(
                "no frame with a known magnification yet", do="check that the microscope publishes"
            )
        if frame is self._added:
            raise InvalidValueError("the same frame as before", do="wait for the next one")
        grey = to_gray(frame.image, frame.encoding)
        detection = find_lattice(grey)
        message = Image()
        picture = corner_overlay(grey, detection.xy, detection.reason)
        fill_image(message, picture, "bgr8", frame.header)
        self._overlay.publish(message)
        if not detection.accepted:
            raise CalibrationError(
                f"no grid found at {frame.magnification:g}x: {detection.reason}",
                expected="an image filled by the chess grid",
            )
        view = without_images([FoundView(name, frame.magnification, grey, detection)])[0]
        with self._lock:
            self._views.append(view)
            self._added = frame
            count = len(self._views)
        self.count_published(frame.stamp_ns)
        return f"view {count} at {frame.magnification:g}x with {len(detection.xy)} corners"

    def _clear(self) -> str:
        with self._lock:
            count = len(self._views)
            self._views.clear()
            self._added = None
        return f"{count} views removed"

    def _calibrate(self) -> str:
        with self._lock:
            views = tuple(replace(v, name=f"view {i}") for i, v in enumerate(self._views))
        self._report_progress(f"calibrating from {len(views)} views")
        config = self.config
        job = CalibrationJob(
            views,
            config.display_width_m,
            config.squares_m,
            self.settings["method"],
            self.settings["residual"],
        )
        result = run_job(job, lambda: self.context.ok() and not self._stopping)
        if result.failed:
            raise CalibrationError(result.summary)
        calibration = Calibration.loads(result.text, source="the calibration process")
        message = String()
        fill_calibration_text(message, result.text)
        self._text.publish(message)
        with self._lock:
            self._calibration = calibration
        return result.summary

    def _save(self) -> str:
        with self._lock:
            calibration = self._calibration
        path = self.settings["output"]
        if calibration is None:
            raise InvalidValueError("no calibration to save", do="call ~/calibrate first")
        if not path:
            raise InvalidValueError("no file to save to", do="set the parameter output")
        calibration.save(Path(path).expanduser())
        return f"saved to {path}"


def main(args: Sequence[str] | None = None) -> int:
    """Run the executable."""
    return run_node(CalibrationServer, args, threads=_THREADS)


if __name__ == "__main__":
    raise SystemExit(main())
