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

"""Executable ``calibration_server``: collects views of the grid from the live stream and calibrates from them."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from sensor_msgs.msg import Image
from std_msgs.msg import String

from semcal_ros.bridge.calibration_text import fill_calibration_text
from semcal_ros.bridge.calibration_warnings import ScaleWarnings
from semcal_ros.bridge.diagnostics import DiagnosticLevel, DiagnosticSummary, fill_diagnostic_status
from semcal_ros.bridge.images import fill_image, to_gray
from semcal_ros.calibration import Calibration
from semcal_ros.core.calibration.calibrate import METHODS, RESIDUAL_MODES, CalibrationOptions
from semcal_ros.core.calibration.check import Verdict
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.calibration.view_coverage import measure_view_coverage
from semcal_ros.core.calibration.views import FoundView
from semcal_ros.core.camera.provenance import Provenance
from semcal_ros.core.corners import find_lattice
from semcal_ros.core.errors import CalibrationError, InvalidValueError, Rejection
from semcal_ros.core.wording import counted
from semcal_ros.files.tiff.sem_image import Conditions
from semcal_ros.nodes.common.output_file import OUTPUT, OutputFile
from semcal_ros.nodes.common.parameters import CALIBRATION, ParameterDeclaration
from semcal_ros.nodes.common.reporter import NODE_ERRORS
from semcal_ros.nodes.common.run import run_node
from semcal_ros.nodes.frames.calibration_input import calibration_digest, report_scale_warnings
from semcal_ros.nodes.frames.conditions import ConditionsInput
from semcal_ros.nodes.frames.overlay import corner_overlay
from semcal_ros.nodes.frames.stage import StageInput
from semcal_ros.nodes.frames.stream import StreamFrame, StreamNode
from semcal_ros.nodes.workers.calibration_worker import (
    CalibrationJob,
    CalibrationProcess,
    Stage,
    without_images,
)
from semcal_ros.workflows.calibrate import options_for
from semcal_ros.workflows.check_and_update import check_found, update_found
from semcal_ros.workflows.provenance import describe_views

__all__ = ["CalibrationServer", "main"]

_PARAMETERS = (
    ParameterDeclaration("method", "joint", "Calibration method.", choices=tuple(METHODS)),
    ParameterDeclaration(
        "residual",
        "auto",
        "Field for what the distortion parameters cannot describe (joint).",
        choices=tuple(RESIDUAL_MODES),
    ),
    replace(
        CALIBRATION,
        description="Calibration that ~/check and ~/update start from, until one is made here.",
    ),
    OUTPUT,
    ParameterDeclaration("allow_writing", True, "Whether ~/save may write files.", fixed=True),
)
# Frames, the report, parameters, views, a calibration, a call that cancels it, and a check.
_THREADS = 7


@dataclass(frozen=True)
class _Candidate:
    """A frame that may become a view, with what was known when it arrived."""

    frame: StreamFrame
    visit: int
    stage: StageReading | None
    conditions: Conditions


class CalibrationServer(StreamNode):
    """Services ~/add_view, ~/calibrate, ~/calibrate_start, ~/cancel, ~/check, ~/update, ~/save, ~/clear; topics
    ``calibration``, ~/progress, ~/overlay.

    ~/calibrate answers when the calibration is done, ~/calibrate_start when it has begun; views can be added meanwhile
    for the next one.
    """

    def __init__(self) -> None:
        super().__init__("calibration_server", _PARAMETERS)
        self._lock = threading.Lock()
        self._newest: _Candidate | None = None
        self._added: StreamFrame | None = None
        self._views: list[FoundView] = []
        # Of the same views: their stamps, ns, and how they were taken.
        self._taken: list[tuple[int, Conditions]] = []
        self._calibration: Calibration | None = None
        self._running: CalibrationProcess | None = None
        self._stage: Stage | None = None
        self._beside: threading.Thread | None = None
        self._warnings = ScaleWarnings()
        self._output = OutputFile(self.parameters, self.reporter.info)
        self._text = self.endpoints.latched_publisher(String, "calibration")
        self._progress = self.endpoints.latched_publisher(DiagnosticStatus, "~/progress")
        self._overlay = self.endpoints.stream_publisher(Image, "~/overlay")
        stream = MutuallyExclusiveCallbackGroup()
        # Before the images, as the magnification.
        self._position = StageInput(self.config.stage, self.endpoints, self.reporter, stream)
        self._known = ConditionsInput(self.endpoints, self.reporter, group=stream)
        self.receive_frames(self._on_frame, group=stream)
        quick, compared = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        handlers = (
            ("add_view", self._add_view, quick),
            ("save", self._save, quick),
            ("clear", self._clear, quick),
            # A call during a calibration is refused at once instead of waiting for its end.
            ("calibrate", self._calibrate, ReentrantCallbackGroup()),
            ("calibrate_start", self._start_calibration, quick),
            ("cancel", self._cancel, MutuallyExclusiveCallbackGroup()),
            ("check", self._check, compared),
            ("update", self._update, compared),
        )
        self._answers = [
            self.endpoints.trigger_service(f"~/{name}", handler, group, self._report_answer)
            for name, handler, group in handlers
        ]
        self.closing.callback(self._end_calibration)
        self._report_progress("no views yet")
        self.reporter.info(self._saving)

    def conditions(self) -> list[str]:
        """Extend the base class: also report what is wrong with the stage and with the last calibration."""
        doubts = [self._warnings.summary] if self._warnings.count else []
        return super().conditions() + self._position.conditions() + doubts

    @property
    def _saving(self) -> str:
        """What ~/save would do now, in words."""
        return self._output.plan if self.parameters["allow_writing"] else "~/save is switched off"

    def _end_calibration(self) -> None:
        with self._lock:
            running = self._running
        if running is not None:
            running.cancel()
        if self._beside is not None:
            self._beside.join()

    def _report_answer(self, success: bool, text: str) -> None:
        self._report_progress(text, DiagnosticLevel.OK if success else DiagnosticLevel.WARN)

    def _report_progress(self, text: str, level: DiagnosticLevel = DiagnosticLevel.OK) -> None:
        with self._lock:
            views, stage = list(self._views), self._stage
        values = [("views", str(len(views)))]
        values.append(("corners", str(sum(len(view.detection.xy) for view in views))))
        counts = Counter(view.magnification for view in views)
        values += [(f"views at {g:g}x", str(counts[g])) for g in sorted(counts)]
        coverage = measure_view_coverage(views)
        values.append(("field_share", f"{coverage.field_share:.3f}"))
        if coverage.tilts_deg:
            values.append(("least_tilt_deg", f"{min(coverage.tilts_deg):.1f}"))
            values.append(("largest_tilt_deg", f"{max(coverage.tilts_deg):.1f}"))
        if stage is not None:
            values += [("stage", stage.name), ("fraction", f"{stage.fraction:.3f}")]
        status = DiagnosticStatus()
        name = f"{self.get_fully_qualified_name()}: calibration"
        summary = DiagnosticSummary(level, text, tuple(values))
        fill_diagnostic_status(status, name, self.config.name, summary)
        self._progress.publish(status)

    # -- stream ------------------------------------------------------------------------------------

    def _on_frame(self, frame: StreamFrame) -> None:
        magnification = self.known_magnification(frame)
        if magnification is None or frame.mixed:
            return
        if self.frames is not None and self.frames.has_rivals:
            with self._lock:
                self._newest = None
            return
        self._known.take_waiting()
        conditions = Conditions.from_topic(self._known.current)
        with self._lock:
            before = self._newest
            visit = 0 if before is None else before.visit
            visit += before is not None and before.frame.magnification != magnification
            self._newest = _Candidate(frame, visit, self._position.at(frame.stamp_ns), conditions)

    # -- services ----------------------------------------------------------------------------------

    def _refuse_rivals(self) -> None:
        if self.frames is not None:
            self.frames.refuse_rivals()

    def _add_view(self) -> str:
        self._refuse_rivals()
        with self._lock:
            newest, name = self._newest, f"view {len(self._views)}"
        frame = None if newest is None else newest.frame
        if newest is None or frame is None or frame.magnification is None:
            raise InvalidValueError(
                "no frame with a known magnification yet", do="check that the microscope publishes"
            )
        if frame is self._added:
            raise InvalidValueError("the same frame as before", do="wait for the next one")
        grey = to_gray(frame.image, frame.encoding)
        detection = find_lattice(grey)
        message = Image()
        if isinstance(detection, Rejection):
            image = corner_overlay(grey, np.empty((0, 2)), detection.reason)
        else:
            image = corner_overlay(grey, detection.xy, "")
        fill_image(message, image, "bgr8", frame.header)
        self._overlay.publish(message)
        if isinstance(detection, Rejection):
            raise CalibrationError(
                f"no grid found at {frame.magnification:g}x: {detection.reason}",
                expected="an image filled by the chess grid",
            )
        found = FoundView(name, frame.magnification, grey, detection, newest.stage, newest.visit)
        view = without_images([found])[0]
        with self._lock:
            self._views.append(view)
            self._taken.append((frame.stamp_ns, newest.conditions))
            self._added = frame
            count = len(self._views)
        self.reporter.count_published(frame.stamp_ns)
        tilt = None if newest.stage is None else newest.stage.tilt_rad
        text = (
            f"view {count} at {frame.magnification:g}x with {counted(len(detection.xy), 'corner')}"
        )
        text += "" if tilt is None else f", tilted by {np.degrees(tilt):.1f} degrees"
        # Who collects views wants to save a calibration, and can still change where.
        return text + (f"; {self._saving}" if count == 1 else "")

    def _clear(self) -> str:
        with self._lock:
            count = len(self._views)
            self._views.clear()
            self._taken.clear()
            self._added = None
            self._position.forget_doubt()
        return f"{counted(count, 'view')} removed"

    def _calibrate(self) -> str:
        return self._complete(self._begin())

    def _start_calibration(self) -> str:
        running = self._begin()
        self._beside = threading.Thread(target=self._complete_beside, args=(running,), daemon=True)
        self._beside.start()
        return f"calibrating from {counted(len(running.job.views), 'view')}; ~/progress shows it, ~/cancel ends it"

    def _complete_beside(self, running: CalibrationProcess) -> None:
        """Report, in place of an answer, how a calibration has ended."""
        try:
            success, text = True, self._complete(running)
        except NODE_ERRORS as error:
            success, text = False, " ".join(str(error).split())
        if self.context.ok():
            self._report_answer(success, text)
            if success:
                self.reporter.info(f"~/calibrate_start: {text}")
            else:
                self.reporter.warn(f"~/calibrate_start: {text}")

    def _complete(self, running: CalibrationProcess) -> str:
        done = False
        try:
            result = running.run(self.context.ok, lambda stage: self._show(running, stage))
            if result.failed:
                raise CalibrationError(result.summary)
            calibration = Calibration.loads(result.text, source="the calibration process")
            done = True
        finally:
            wanted = self._finish(running, done=done)
        if not wanted:
            raise CalibrationError("cancelled")
        self._adopt(calibration)
        return result.summary

    def _adopt(self, calibration: Calibration) -> None:
        """Publish a calibration, and keep it for ~/save."""
        text = calibration.dumps()
        with self._lock:
            self._calibration = calibration
        message = String()
        fill_calibration_text(message, text)
        self._text.publish(message)
        self.reporter.note("calibration_digest", calibration_digest(text))
        self._warnings = report_scale_warnings(self.reporter, calibration)

    def _begin(self) -> CalibrationProcess:
        self._refuse_rivals()
        with self._lock:
            if self._running is not None:
                raise CalibrationError(
                    "a calibration is running", do="wait for its end, or call ~/cancel"
                )
            if not self._views:
                raise CalibrationError("no usable view yet", do="call ~/add_view first")
            views = tuple(replace(v, name=f"view {i}") for i, v in enumerate(self._views))
            notes: tuple[str, ...] = ()
            if (doubt := self._position.doubt) and any(v.stage is not None for v in views):
                # As from a recording: small angles in degrees have passed for radians.
                views = tuple(replace(v, stage=None) for v in views)
                notes = (f"stage: {doubt} looks like degrees: the stage is not used",)
            config, values = self.config, self.parameters
            job = CalibrationJob(
                views,
                config.display_width_m,
                config.squares_m,
                options_for(
                    config,
                    CalibrationOptions(method=values["method"], residual=values["residual"]),
                ),
                config.grid_certificate,
                notes,
                self._describe(views),
                {v.name: told for v, (_, told) in zip(views, self._taken, strict=True)},
            )
            self._running = CalibrationProcess(job)
            return self._running

    def _describe(self, views: Sequence[FoundView]) -> Provenance:
        """Where a calibration from these views, all that there are, comes from; call it with the lock."""
        seen = {v.name: (told, v.stage) for v, (_, told) in zip(views, self._taken, strict=True)}
        return describe_views(self.config, seen, [stamp_ns for stamp_ns, _ in self._taken])

    def _finish(self, running: CalibrationProcess, *, done: bool) -> bool:
        """Allow the next calibration; return False if this one was cancelled."""
        with self._lock:
            wanted = self._running is running
            if wanted:
                self._running = None
                self._stage = Stage("done", 1.0) if done else None
            return wanted

    def _show(self, running: CalibrationProcess, stage: Stage) -> None:
        with self._lock:
            if self._running is not running:
                return
            self._stage = stage
        self._report_progress(f"calibrating from {counted(len(running.job.views), 'view')}")

    def _cancel(self) -> str:
        with self._lock:
            running, self._running, self._stage = self._running, None, None
        if running is None:
            raise CalibrationError("no calibration is running")
        running.cancel()
        job = running.job
        return (
            f"cancelled the {job.options.method} calibration from {counted(len(job.views), 'view')}"
            f" after {running.elapsed_s:.1f} s"
        )

    def _compared(self) -> tuple[Calibration, tuple[FoundView, ...], Provenance]:
        """The calibration that is checked or renewed, the views that say so, and their origin."""
        self._refuse_rivals()
        with self._lock:
            calibration = self._calibration
            views = tuple(replace(v, name=f"view {i}") for i, v in enumerate(self._views))
            if self._position.doubt:
                views = tuple(replace(v, stage=None) for v in views)
            origin = self._describe(views)
        if not views:
            raise CalibrationError("no usable view yet", do="call ~/add_view first")
        if calibration is None:
            path = self.parameters["calibration"]
            if not path:
                raise InvalidValueError(
                    "no calibration to compare with",
                    expected="the parameter calibration to name a file, or one made here",
                    do="set it, or call ~/calibrate",
                )
            calibration = Calibration.load(self.parameters.allowed_path(path))
        return calibration, views, origin

    def _check(self) -> str:
        calibration, views, _ = self._compared()
        result = check_found(calibration, views, self.config)
        if result.verdict is not Verdict.VALID:
            raise CalibrationError(result.summary, do="call ~/update, or calibrate anew")
        return result.summary

    def _update(self) -> str:
        calibration, views, origin = self._compared()
        done = update_found(calibration, views, self.config, origin)
        self._adopt(Calibration.from_model(done.model))
        return f"updated; before, it was {done.check.summary}"

    def _save(self) -> str:
        if not self.parameters["allow_writing"]:
            raise InvalidValueError(
                "writing files is switched off", do="start the node with allow_writing true"
            )
        with self._lock:
            calibration = self._calibration
        if calibration is None:
            raise InvalidValueError("no calibration to save", do="call ~/calibrate first")
        return self._output.write(calibration.save)


def main(args: Sequence[str] | None = None) -> int:
    """Run the executable."""
    return run_node(CalibrationServer, args, threads=_THREADS)


if __name__ == "__main__":
    raise SystemExit(main())
