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

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

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
from semcal_ros.core.calibration.acquisition import (
    AcquisitionGoal,
    ViewRequest,
    find_picture_fault,
    is_same_magnification,
)
from semcal_ros.core.calibration.judgement.check import Verdict
from semcal_ros.core.calibration.judgement.findings import measure_view_coverage
from semcal_ros.core.calibration.options import METHODS, RESIDUAL_MODES, CalibrationOptions
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.calibration.views import FoundView
from semcal_ros.core.camera.provenance import Provenance
from semcal_ros.core.corners import LatticeDetection, find_lattice
from semcal_ros.core.errors import (
    CalibrationError,
    InvalidValueError,
    MicroscopeError,
    Rejection,
)
from semcal_ros.core.ladder.acquisition import PictureRequest
from semcal_ros.core.ladder.matching import LadderPicture
from semcal_ros.core.wording import counted
from semcal_ros.files.bags.view_recorder import ViewRecorder
from semcal_ros.files.recordings import RecordedFrame
from semcal_ros.files.tiff.sem_image import Conditions
from semcal_ros.nodes.acquisition.commands import MicroscopeCommands
from semcal_ros.nodes.acquisition.ladder import LadderGoal, LadderRun, ladder_goal_of, place_of
from semcal_ros.nodes.acquisition.recorded import read_pictures, read_views
from semcal_ros.nodes.acquisition.run import (
    ACQUISITION,
    AcquisitionRun,
    Progress,
    goal_of,
)
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
    ExtensionJob,
    Stage,
    without_images,
)
from semcal_ros.workflows.calibrate import options_for
from semcal_ros.workflows.check_and_update import check_found, update_found
from semcal_ros.workflows.conditions import ConditionsComparison
from semcal_ros.workflows.extend import make_picture
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
        description="Calibration that ~/check, ~/update and ~/extend start from, until one is made here.",
    ),
    OUTPUT,
    ParameterDeclaration(
        "allow_writing", True, "Whether ~/save, ~/acquire and ~/extend may write files.", fixed=True
    ),
    *ACQUISITION,
)
# States of an acquisition that has ended, and how long its thread may take after it has said so.
_ENDED, _LAST_WORD_S = ("stopped", "failed", "done"), 1.0
_GOAL = ("lowest_magnification", "highest_magnification", "target")
# Stamps that are behind by more are of another clock, or of so slow a scan that one follows the other.
_OTHER_CLOCK_NS = 30 * 10**9
# Pictures of an acquisition: a slow scan of 4 k x 4 k takes some minutes.
_PICTURE_S = 600.0
_POLL_S = 0.1

Goal = TypeVar("Goal", AcquisitionGoal, LadderGoal)


@dataclass(frozen=True)
class _Candidate:
    """A frame that may become a view, with what was known when it arrived."""

    frame: StreamFrame
    visit: int
    stage: StageReading | None
    conditions: Conditions


def _free_folder(wanted: Path) -> Path:
    """The folder, or with a number if there is one already."""
    number, free = 2, wanted
    while free.exists():
        free = wanted.with_name(f"{wanted.name}_{number}")
        number += 1
    return free


class CalibrationServer(StreamNode):
    """Services ~/add_view, ~/calibrate, ~/calibrate_start, ~/acquire, ~/extend, ~/cancel, ~/check, ~/update, ~/save,
    ~/clear; topics ``calibration``, ~/progress, ~/overlay.

    ~/calibrate answers when the calibration is done, ~/calibrate_start when it has begun; views can be added meanwhile
    for the next one. ~/acquire begins, or goes on with, an acquisition of a grid, ~/extend that of a ladder: see
    :mod:`semcal_ros.nodes.acquisition`.
    """

    # Frames, the report, parameters, views, a calibration, a call that cancels it, a check, and a microscope's answers.
    threads = 8

    def __init__(self) -> None:
        super().__init__("calibration_server", _PARAMETERS)
        self._lock = threading.Lock()
        self._newest: _Candidate | None = None
        self._added: StreamFrame | None = None
        self._views: list[FoundView] = []
        # How many of them, the first ones, a calibration was made from.
        self._calibrated_views = 0
        # Of the same views: their stamps, ns, and how they were taken.
        self._taken: list[tuple[int, Conditions]] = []
        self._calibration: Calibration | None = None
        self._running: CalibrationProcess | None = None
        self._stage: Stage | None = None
        self._beside: threading.Thread | None = None
        # An acquisition, its thread while it runs, and what a person took for its request.
        self._acquisition: AcquisitionRun | LadderRun | None = None
        self._acquiring: threading.Thread | None = None
        self._acquisition_wanted = False
        self._request: ViewRequest | PictureRequest | None = None
        # Of the pictures of a ladder: their stamps, ns, and how they were taken.
        self._told: dict[str, tuple[int, Conditions, StageReading | None]] = {}
        self._taken_by_hand = ""
        self._recorder: ViewRecorder | None = None
        # What the acquisition is recorded to, and the recording that it went on with.
        self.recording: Path | None = None
        self._resumed: Path | None = None
        self._first_visit = 0
        self._pictures = 0
        self._warnings = ScaleWarnings()
        self._output = OutputFile(self.parameters, self.reporter.info)
        self._text = self.endpoints.latched_publisher(String, "calibration")
        self._progress = self.endpoints.latched_publisher(DiagnosticStatus, "~/progress")
        self._overlay = self.endpoints.stream_publisher(Image, "~/overlay")
        stream = MutuallyExclusiveCallbackGroup()
        # Before the images, as the magnification.
        self._position = StageInput(self.node_context, stream)
        self._known = ConditionsInput(self.node_context, group=stream)
        self.receive_frames(self._on_frame, group=stream)
        name = self.parameters["microscope"]
        self._commands = (
            MicroscopeCommands(self.node_context, name, self._still_acquiring) if name else None
        )
        quick, compared = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        handlers = (
            ("add_view", self.add_view, quick),
            ("save", self.save, quick),
            ("clear", self._clear, quick),
            # A call during a calibration is refused at once instead of waiting for its end.
            ("calibrate", self._calibrate, ReentrantCallbackGroup()),
            ("calibrate_start", self._start_calibration, quick),
            ("acquire", self.acquire, quick),
            ("extend", self.extend, quick),
            ("cancel", self._cancel, MutuallyExclusiveCallbackGroup()),
            ("check", self._check, compared),
            ("update", self._update, compared),
        )
        self._answers = [
            self.endpoints.trigger_service(
                f"~/{name}",
                handler,
                group,
                self._report_refusal if name in ("acquire", "extend") else self._report_answer,
            )
            for name, handler, group in handlers
        ]
        self.closing.callback(self._end_calibration)
        self.closing.callback(self._tell_unused_views)
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
            self._acquisition_wanted = False
        if running is not None:
            running.cancel()
        for thread in (self._beside, self._acquiring):
            if thread is not None:
                thread.join()

    def _tell_unused_views(self) -> None:
        """Say at the end what is lost: a replay ends all nodes with its last frame."""
        with self._lock:
            count = len(self._views) - self._calibrated_views
        if count > 0:
            self.reporter.warn(
                f"{counted(count, 'view')} collected and not calibrated; call ~/calibrate before the end, "
                "or use `semcal calibrate` on the recording"
            )

    def _report_answer(self, success: bool, text: str) -> None:
        self._report_progress(text, DiagnosticLevel.OK if success else DiagnosticLevel.WARN)

    def _report_refusal(self, success: bool, text: str) -> None:
        if not success:
            self._report_answer(success, text)

    def _report_progress(self, text: str, level: DiagnosticLevel = DiagnosticLevel.OK) -> None:
        with self._lock:
            views, stage, acquisition = list(self._views), self._stage, self._acquisition
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
        # What ~/acquire would do, and with what: a viewer shows it before it begins.
        values += [(name, f"{self.parameters[name]:g}") for name in _GOAL]
        values.append(("microscope", self.parameters["microscope"]))
        if acquisition is not None:
            progress = acquisition.progress
            values += [("acquisition", progress.state), ("request", progress.text)]
            values += [("taken", str(progress.views)), ("planned", str(progress.planned))]
            values += [("left_out", str(progress.left_out))]
            values += [("largest_sigma", f"{progress.largest:.3g}")]
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
            visit = self._first_visit if before is None else before.visit
            visit += before is not None and before.frame.magnification != magnification
            self._newest = _Candidate(frame, visit, self._position.at(frame.stamp_ns), conditions)
            self._pictures += 1

    # -- services ----------------------------------------------------------------------------------

    def _refuse_rivals(self) -> None:
        if self.frames is not None:
            self.frames.refuse_rivals()

    def add_view(self) -> str:
        """Make a view of the newest frame, and say which."""
        with self._lock:
            request = self._request
        text = self._take_view(request)
        if request is not None:
            with self._lock:
                self._taken_by_hand = text
        return text

    def _take_view(self, request: ViewRequest | PictureRequest | None) -> str:
        """Make use of the newest frame, which must show what was asked for."""
        self._refuse_rivals()
        with self._lock:
            newest = self._newest
        frame = None if newest is None else newest.frame
        if newest is None or frame is None or frame.magnification is None:
            raise InvalidValueError(
                "no frame with a known magnification yet", do="check that the microscope publishes"
            )
        if frame is self._added:
            raise InvalidValueError("the same frame as before", do="wait for the next one")
        if request is not None:
            self._record(newest, frame.magnification)
            if not is_same_magnification(request.magnification, frame.magnification):
                raise CalibrationError(
                    f"a picture at {frame.magnification:g}x",
                    expected=f"{request.magnification:.0f}x",
                )
        if isinstance(request, PictureRequest):
            text = self._take_picture(newest, request)
        else:
            text = self._add_view(newest, frame.magnification, request)
        with self._lock:
            self._added = frame
        self.reporter.count_published(frame.stamp_ns)
        return text

    def _take_picture(self, newest: _Candidate, request: PictureRequest) -> str:
        """Take a picture for a ladder."""
        run = self._acquisition
        assert isinstance(run, LadderRun)
        picture = self._ladder_picture(newest, f"picture {len(run.taken)}")
        run.take(request, picture, place_of(newest.stage))
        told = newest.frame.stamp_ns, newest.conditions, newest.stage
        with self._lock:
            self._told[picture.name] = told
        return f"picture {len(run.taken)} at {picture.magnification:g}x"

    @staticmethod
    def _ladder_picture(candidate: _Candidate, name: str) -> LadderPicture:
        frame = candidate.frame
        assert frame.magnification is not None
        # A copy: the memory of a message is used again.
        grey = np.array(to_gray(frame.image, frame.encoding))
        picture = make_picture(
            grey, frame.magnification, name, candidate.stage, candidate.conditions
        )
        return replace(picture, visit=candidate.visit)

    def _add_view(
        self, newest: _Candidate, magnification: float, request: ViewRequest | None
    ) -> str:
        """Make a view of the grid."""
        frame = newest.frame
        with self._lock:
            name = f"view {len(self._views)}"
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
                f"no grid found at {magnification:g}x: {detection.reason}",
                expected="an image filled by the chess grid",
            )
        if request is not None and (
            fault := find_picture_fault(grey, detection, request, newest.stage)
        ):
            raise CalibrationError(f"not usable at {magnification:g}x: {fault}")
        found = FoundView(name, magnification, grey, detection, newest.stage, newest.visit)
        view = without_images([found])[0]
        with self._lock:
            self._views.append(view)
            self._taken.append((frame.stamp_ns, newest.conditions))
            count = len(self._views)
        tilt = None if newest.stage is None else newest.stage.tilt_rad
        text = f"view {count} at {magnification:g}x with {counted(len(detection.xy), 'corner')}"
        text += "" if tilt is None else f", tilted by {np.degrees(tilt):.1f} degrees"
        # Who collects views wants to save a calibration, and can still change where.
        return text + (f"; {self._saving}" if count == 1 else "")

    def _clear(self) -> str:
        with self._lock:
            count = len(self._views)
            self._views.clear()
            self._calibrated_views = 0
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
        return f"calibrating from {running.job.source}; ~/progress shows it, ~/cancel ends it"

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
        if isinstance(running.job, CalibrationJob):
            with self._lock:
                self._calibrated_views = len(running.job.views)
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
        self._report_progress(f"calibrating from {running.job.source}")

    # -- a calibration that records itself -----------------------------------------------------------

    def acquire(self) -> str:
        """Begin an acquisition of a grid, or go on with one; return what was begun, in words."""
        squares_m, width_m = self.config.squares_m, self.config.display_width_m
        turn_by = self.parameters["turn_by"]
        return self._acquire_by(
            "acquisition",
            lambda: goal_of(self.parameters, squares_m, width_m),
            lambda goal: AcquisitionRun(goal, self, self._commands, turn_by, self._still_acquiring),
        )

    def extend(self) -> str:
        """Begin a ladder, or go on with one; return what was begun, in words."""
        return self._acquire_by(
            "ladder",
            lambda: ladder_goal_of(self.parameters, self._base()),
            lambda goal: LadderRun(goal, self, self._commands, self._still_acquiring),
        )

    def _acquire_by(
        self,
        name: str,
        read_goal: Callable[[], Goal],
        make_run: Callable[[Goal], AcquisitionRun | LadderRun],
    ) -> str:
        """Begin a run that makes an acquisition, or go on with the one that has the same goal."""
        self._refuse_rivals()
        ending = not self._acquisition_wanted and self.acquisition_progress.state in _ENDED
        if self._acquiring is not None and ending:
            # It has said how it ended, and whoever heard that may call at once.
            self._acquiring.join(_LAST_WORD_S)
        goal = read_goal()
        with self._lock:
            if self.acquiring:
                raise CalibrationError("an acquisition is running", do="call ~/cancel to end it")
            if self._running is not None:
                raise CalibrationError(
                    "a calibration is running", do="wait for its end, or call ~/cancel"
                )
            run, verb = self._acquisition, "going on"
            ended = run is None or run.discarded or run.progress.state == "done"
            if run is None or ended or run.goal != goal:
                verb, run = "begun", make_run(goal)
                self._told.clear()
            record = self.parameters["record"]
            if record and not self.parameters["allow_writing"]:
                raise InvalidValueError(
                    "writing files is switched off",
                    do="start the node with allow_writing true, or record nothing",
                )
            path = _free_folder(self.parameters.allowed_path(record)) if record else None
            before = self._recording_to_resume(run)
            recorder = None if path is None else ViewRecorder(path, self.config)
            self._acquisition, self._acquisition_wanted, self.recording = run, True, path
            self._acquiring = threading.Thread(
                target=self._acquire_beside, args=(run, recorder, before), daemon=True
            )
        where = "" if before is None else f" with the views of {before}"
        where += "" if path is None else f", recorded to {path}"
        text = f"{name} {verb}{where}; ~/progress shows it, ~/cancel ends it"
        # Before the start: an acquisition that fails at once has the last word.
        self._report_progress(text)
        self._acquiring.start()
        return text

    def _recording_to_resume(self, run: AcquisitionRun | LadderRun) -> Path | None:
        """The recording that a new acquisition goes on with, once."""
        text = self.parameters["resume"]
        if not text or run is self._acquisition:
            return None
        path = self.parameters.allowed_path(text)
        if path == self._resumed:
            return None
        if not path.exists():
            raise InvalidValueError(
                f"parameter resume: there is no {path}",
                expected="the recording of an interrupted acquisition",
                do="correct it, or leave it empty to begin anew",
            )
        return path

    def _resume(self, run: AcquisitionRun | LadderRun, path: Path) -> None:
        """Take over the pictures of a recording, and record them again, so that the new recording has all."""
        with self._lock:
            newest = self._newest

        def on_frame(frame: RecordedFrame) -> None:
            if not self._still_acquiring():
                raise CalibrationError("stopped", do=f"call {run.service} to go on")
            if self._recorder is not None:
                known = frame.conditions or Conditions()
                g, stage = frame.magnification, frame.stage
                self._recorder.write(frame.image, frame.encoding, frame.stamp_ns, g, stage, known)

        size = None if newest is None else newest.frame.size
        try:
            if isinstance(run, LadderRun):
                visits = self._resume_ladder(run, path, size, on_frame)
            else:
                visits = self._resume_views(run, path, size, on_frame)
        except NODE_ERRORS:
            # With a part of them: the next call begins anew.
            run.discarded = True
            raise
        with self._lock:
            self._resumed = path
            # What comes now was set anew.
            self._first_visit = 1 + max(visits, default=-1)
            if self._newest is not None:
                self._newest = replace(self._newest, visit=self._newest.visit + self._first_visit)
        run.report(f"{counted(len(visits), run.unit)} taken over from {path}")

    def _resume_views(
        self,
        run: AcquisitionRun,
        path: Path,
        size: tuple[int, int] | None,
        on_frame: Callable[[RecordedFrame], object],
    ) -> list[int]:
        """Take over views of a grid; return their visits."""
        taken = read_views(path, self.config, size, run.adopt, on_frame)
        with self._lock:
            self._views += without_images([one.view for one in taken])
            self._taken += [(one.stamp_ns, one.conditions) for one in taken]
        return [one.view.visit for one in taken if one.view.visit is not None]

    def _resume_ladder(
        self,
        run: LadderRun,
        path: Path,
        size: tuple[int, int] | None,
        on_frame: Callable[[RecordedFrame], object],
    ) -> list[int]:
        """Take over pictures of a ladder; return their visits."""

        def adopt(frame: RecordedFrame) -> bool:
            known = frame.conditions or Conditions()
            name = f"picture {len(run.taken)}"
            grey = to_gray(frame.visible, frame.encoding)
            picture = make_picture(grey, frame.magnification, name, frame.stage, known)
            if not run.adopt(picture, place_of(frame.stage)):
                return False
            with self._lock:
                self._told[name] = frame.stamp_ns, known, frame.stage
            return True

        visits = read_pictures(path, self.config, size, adopt, on_frame)
        run.number_visits(visits)
        return visits

    def _acquire_beside(
        self, run: AcquisitionRun | LadderRun, recorder: ViewRecorder | None, resumed: Path | None
    ) -> None:
        """Run an acquisition, and say how it has ended."""
        level, state = DiagnosticLevel.OK, "done"
        try:
            with recorder or nullcontext():
                self._recorder = recorder
                try:
                    if resumed is not None:
                        self._resume(run, resumed)
                    text = run.run()
                except NODE_ERRORS as error:
                    # What was recorded is kept: the error is told, not raised.
                    text = " ".join(str(error).split())
                    level = DiagnosticLevel.WARN
                    state = "failed" if self._still_acquiring() else "stopped"
        except NODE_ERRORS as error:
            text, level, state = " ".join(str(error).split()), DiagnosticLevel.WARN, "failed"
        finally:
            with self._lock:
                self._recorder, self._request = None, None
                self._acquisition_wanted = False
        run.progress = replace(run.progress, state=state, text=text)
        if self.context.ok():
            self._report_progress(f"acquisition {state}: {text}", level)
            told = f"{run.service}: {text}"
            (self.reporter.info if state == "done" else self.reporter.warn)(told)

    @property
    def has_picture(self) -> bool:
        """Whether there is a frame with a known magnification."""
        return self._newest is not None

    @property
    def has_calibration(self) -> bool:
        """Whether there is something to save."""
        return self._calibration is not None

    @property
    def acquiring(self) -> bool:
        """Whether an acquisition is under way."""
        return self._acquiring is not None and self._acquiring.is_alive()

    @property
    def acquisition_progress(self) -> Progress:
        """How far the acquisition is, or how it has ended."""
        return (
            Progress("stopped", "not begun")
            if self._acquisition is None
            else self._acquisition.progress
        )

    @property
    def acquisition_reached(self) -> bool:
        """Whether an acquisition has met what was asked for."""
        run = self._acquisition
        return run is not None and run.progress.state == "done" and run.reached

    @property
    def _service(self) -> str:
        """What goes on with the acquisition."""
        return "~/acquire" if self._acquisition is None else self._acquisition.service

    def _still_acquiring(self) -> bool:
        return self._acquisition_wanted and self.context.ok()

    def _record(self, newest: _Candidate, magnification: float) -> None:
        recorder = self._recorder
        if recorder is not None:
            frame = newest.frame
            recorder.write(
                frame.image,
                frame.encoding,
                frame.stamp_ns,
                magnification,
                newest.stage,
                newest.conditions,
            )

    def wait_for_pictures(self, count: int) -> None:
        """See :class:`~semcal_ros.nodes.acquisition.run.Taker`."""
        with self._lock:
            wanted = self._pictures + count
        asked_ns = self.get_clock().now().nanoseconds

        def there() -> bool:
            with self._lock:
                newest = self._newest
                if self._pictures < wanted or newest is None:
                    return False
            # Pictures of a scan that began before may still come, more than one where they overlap.
            late_ns = asked_ns - newest.frame.stamp_ns
            return late_ns <= 0 or late_ns > _OTHER_CLOCK_NS

        self._wait_until(there, MicroscopeError("no picture comes any more"), _PICTURE_S)

    def look(self) -> LatticeDetection | None:
        """See :class:`~semcal_ros.nodes.acquisition.follow.Lookout`."""
        with self._lock:
            newest = self._newest
        if newest is None:
            return None
        found = find_lattice(to_gray(newest.frame.image, newest.frame.encoding))
        return None if isinstance(found, Rejection) else found

    def newest_picture(self) -> LadderPicture | None:
        """See :class:`~semcal_ros.nodes.acquisition.ladder.LadderTaker`."""
        with self._lock:
            newest = self._newest
        return None if newest is None else self._ladder_picture(newest, "")

    def extend_calibration(self, run: LadderRun) -> str:
        """See :class:`~semcal_ros.nodes.acquisition.ladder.LadderTaker`."""
        self._refuse_rivals()
        calibration = run.goal.calibration
        pictures = tuple(one.picture for one in run.taken)
        compared = ConditionsComparison(calibration, scans_may_turn=True)
        with self._lock:
            self._request = None
            told = [self._told[picture.name] for picture in pictures]
            for _, conditions, _ in told:
                compared.add(conditions)
            seen = {
                picture.name: (conditions, stage)
                for picture, (_, conditions, stage) in zip(pictures, told, strict=True)
            }
            notes = compared.notes
            if doubt := self._position.doubt:
                # As from a recording: small angles in degrees have passed for radians.
                pictures = tuple(replace(picture, scan_rotation_rad=None) for picture in pictures)
                notes = (*notes, f"stage: {doubt} looks like degrees: the stage is not used")
            origin = describe_views(self.config, seen, [stamp_ns for stamp_ns, _, _ in told])
            running = CalibrationProcess(
                ExtensionJob(calibration, pictures, self.config, origin, notes)
            )
            self._running = running
        return self._complete(running)

    def take(self, request: ViewRequest | PictureRequest) -> str:
        """See :class:`~semcal_ros.nodes.acquisition.run.Taker`."""
        try:
            return self._take_view(request)
        except InvalidValueError as error:
            raise CalibrationError(str(error)) from error

    def wait_for_view(self, request: ViewRequest | PictureRequest) -> str:
        """See :class:`~semcal_ros.nodes.acquisition.run.Taker`."""
        with self._lock:
            self._request, self._taken_by_hand = request, ""
        self._wait_until(lambda: bool(self._taken_by_hand), CalibrationError("no view"), math.inf)
        return self._taken_by_hand

    def stage(self) -> StageReading | None:
        """See :class:`~semcal_ros.nodes.acquisition.run.Taker`."""
        with self._lock:
            return None if self._newest is None else self._newest.stage

    def calibrate(self) -> Calibration:
        """See :class:`~semcal_ros.nodes.acquisition.run.ViewTaker`."""
        with self._lock:
            self._request = None
        self._complete(self._begin())
        with self._lock:
            calibration = self._calibration
        if calibration is None:
            raise CalibrationError("no calibration came of the views")
        return calibration

    def show(self, progress: Progress) -> None:
        """See :class:`~semcal_ros.nodes.acquisition.run.Taker`."""
        self._report_progress(progress.text)

    def _wait_until(
        self,
        condition: Callable[[], bool],
        late: MicroscopeError | CalibrationError,
        limit_s: float,
    ) -> None:
        end_s = time.monotonic() + limit_s
        while not condition():
            if not self._still_acquiring():
                raise CalibrationError("stopped", do=f"call {self._service} to go on")
            if time.monotonic() > end_s:
                raise late
            time.sleep(_POLL_S)

    def _cancel(self) -> str:
        with self._lock:
            acquiring = self._acquisition_wanted
            self._acquisition_wanted = False
            running, self._running, self._stage = self._running, None, None
        if acquiring:
            if running is not None:
                running.cancel()
            return f"the acquisition ends as soon as nothing moves; {self._service} goes on with it"
        if running is None:
            raise CalibrationError("no calibration is running")
        running.cancel()
        return f"cancelled the {running.job.title} after {running.elapsed_s:.1f} s"

    def _compared(self) -> tuple[Calibration, tuple[FoundView, ...], Provenance]:
        """The calibration that is checked or renewed, the views that say so, and their origin."""
        self._refuse_rivals()
        with self._lock:
            views = tuple(replace(v, name=f"view {i}") for i, v in enumerate(self._views))
            if self._position.doubt:
                views = tuple(replace(v, stage=None) for v in views)
            origin = self._describe(views)
        if not views:
            raise CalibrationError("no usable view yet", do="call ~/add_view first")
        calibration = self._base()
        return calibration, views, origin

    def _base(self) -> Calibration:
        """The calibration that was made here, else that of the file."""
        with self._lock:
            calibration = self._calibration
        if calibration is not None:
            return calibration
        path = self.parameters["calibration"]
        if not path:
            raise InvalidValueError(
                "no calibration to begin with",
                expected="the parameter calibration to name a file, or one made here",
                do="set it, or call ~/calibrate",
            )
        return Calibration.load(self.parameters.allowed_path(path))

    def _check(self) -> str:
        calibration, views, _ = self._compared()
        result = check_found(calibration, views, self.config)
        if result.verdict is not Verdict.VALID:
            raise CalibrationError(result.summary, do="call ~/update, or calibrate anew")
        return result.summary

    def _update(self) -> str:
        calibration, views, origin = self._compared()
        done = update_found(calibration, views, self.config, origin)
        with self._lock:
            self._calibrated_views = len(views)
        self._adopt(Calibration.from_model(done.model))
        return f"updated; before, it was {done.check.summary}"

    def save(self) -> str:
        """Write the calibration, and say where."""
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
    return run_node(CalibrationServer, args, threads=CalibrationServer.threads)


if __name__ == "__main__":
    raise SystemExit(main())
