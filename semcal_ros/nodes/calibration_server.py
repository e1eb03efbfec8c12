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
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import replace
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
)
from semcal_ros.core.calibration.judgement.check import Verdict
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
from semcal_ros.nodes.calibration_state import (
    CalibrationState,
    LadderSource,
    RunningJob,
    StreamPicture,
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
from semcal_ros.nodes.workers.calibration_worker import CalibrationJob, CalibrationProcess, Stage
from semcal_ros.workflows.check_and_update import check_found, update_found
from semcal_ros.workflows.extend import make_picture

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
# Pictures of an acquisition: a slow scan of 4 k x 4 k takes some minutes.
_PICTURE_S = 600.0
_POLL_S = 0.1

Goal = TypeVar("Goal", AcquisitionGoal, LadderGoal)
Answer = TypeVar("Answer")


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
        # Frozen: it is read without the lock, and changed by _change.
        self._state = CalibrationState()
        self._calibrating: threading.Thread | None = None
        self._acquiring: threading.Thread | None = None
        self._recorder: ViewRecorder | None = None
        self._warnings = ScaleWarnings()
        self._output = OutputFile(self.parameters, self.reporter.info)
        self._text = self.endpoints.latched_publisher(String, "calibration")
        self._progress = self.endpoints.latched_publisher(DiagnosticStatus, "~/progress")
        self._overlay = self.endpoints.stream_publisher(Image, "~/overlay")
        stream = MutuallyExclusiveCallbackGroup()
        # Before the images, as the magnification.
        self._position = StageInput(self.node_context, stream)
        self._conditions = ConditionsInput(self.node_context, group=stream)
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

    def _change(self, event: Callable[[CalibrationState], CalibrationState]) -> CalibrationState:
        """Go on to the state that an event leads to, and return it; a refusal leaves it as it is."""
        with self._lock:
            self._state = event(self._state)
            return self._state

    def _step(self, event: Callable[[CalibrationState], tuple[CalibrationState, Answer]]) -> Answer:
        """As :meth:`_change`, for an event that also answers; return the answer."""
        with self._lock:
            self._state, answer = event(self._state)
            return answer

    def conditions(self) -> list[str]:
        """Extend the base class: also report what is wrong with the stage and with the last calibration."""
        doubts = [self._warnings.summary] if self._warnings.count else []
        return super().conditions() + self._position.conditions() + doubts

    @property
    def _saving(self) -> str:
        """What ~/save would do now, in words."""
        return self._output.plan if self.parameters["allow_writing"] else "~/save is switched off"

    def _end_calibration(self) -> None:
        running = self._change(CalibrationState.closed).running
        if running is not None:
            running.cancel()
        for thread in (self._calibrating, self._acquiring):
            if thread is not None:
                thread.join()

    def _tell_unused_views(self) -> None:
        """Say at the end what is lost: a replay ends all nodes with its last frame."""
        count = self._state.unused_views
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
        settings = {name: f"{self.parameters[name]:g}" for name in _GOAL}
        settings["microscope"] = self.parameters["microscope"]
        status = DiagnosticStatus()
        name = f"{self.get_fully_qualified_name()}: calibration"
        summary = DiagnosticSummary(level, text, self._state.progress(settings))
        fill_diagnostic_status(status, name, self.config.name, summary)
        self._progress.publish(status)

    # -- stream ------------------------------------------------------------------------------------

    def _on_frame(self, frame: StreamFrame) -> None:
        magnification = self.known_magnification(frame)
        if magnification is None or frame.mixed:
            return
        if self.frames is not None and self.frames.has_rivals:
            self._change(CalibrationState.without_picture)
            return
        self._conditions.take_waiting()
        conditions = Conditions.from_topic(self._conditions.current)
        stage = self._position.at(frame.stamp_ns)
        self._change(lambda state: state.with_frame(frame, magnification, stage, conditions))

    # -- services ----------------------------------------------------------------------------------

    def _refuse_rivals(self) -> None:
        if self.frames is not None:
            self.frames.refuse_rivals()

    def add_view(self) -> str:
        """Make a view of the newest frame, and say which."""
        request = self._state.request
        text = self._take_view(request)
        if request is not None:
            self._change(lambda state: state.with_answer(text))
        return text

    def _take_view(self, request: ViewRequest | PictureRequest | None) -> str:
        """Make use of the newest frame, which must show what was asked for."""
        self._refuse_rivals()
        picture = self._state.picture_to_take()
        if request is not None:
            self._record(picture)
            picture.require_magnification_of(request)
        if isinstance(request, PictureRequest):
            text = self._take_picture(picture, request)
        else:
            text = self._add_view(picture, request)
        self.reporter.count_published(picture.frame.stamp_ns)
        return text

    def _take_picture(self, picture: StreamPicture, request: PictureRequest) -> str:
        """Take a picture for a ladder."""
        run = self._state.acquisition
        assert isinstance(run, LadderRun)
        name = f"picture {len(run.taken)}"
        run.take(request, picture.to_ladder_picture(name), place_of(picture.stage))
        self._change(lambda state: state.with_ladder_picture(name, picture))
        return f"picture {len(run.taken)} at {picture.magnification:g}x"

    def _add_view(self, picture: StreamPicture, request: ViewRequest | None) -> str:
        """Make a view of the grid, and show what was found of it."""
        grey = picture.grey
        detection = find_lattice(grey)
        message = Image()
        if isinstance(detection, Rejection):
            image = corner_overlay(grey, np.empty((0, 2)), detection.reason)
        else:
            image = corner_overlay(grey, detection.xy, "")
        fill_image(message, image, "bgr8", picture.frame.header)
        self._overlay.publish(message)
        view = picture.to_view(detection, request)
        text = self._step(lambda state: state.with_view(view, picture))
        # Who collects views wants to save a calibration, and can still change where.
        return text + (f"; {self._saving}" if len(self._state.views) == 1 else "")

    def _clear(self) -> str:
        text = self._step(CalibrationState.cleared)
        self._position.forget_doubt()
        return text

    def _calibrate(self) -> str:
        return self._complete(self._begin())

    def _start_calibration(self) -> str:
        running = self._begin()
        self._calibrating = threading.Thread(
            target=self._complete_in_thread, args=(running,), daemon=True
        )
        self._calibrating.start()
        return f"calibrating from {running.job.source}; ~/progress shows it, ~/cancel ends it"

    def _complete_in_thread(self, running: CalibrationProcess) -> None:
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
            wanted = self._step(lambda state: state.with_end_of(running, done=done))
        if not wanted:
            raise CalibrationError("cancelled")
        job = running.job
        self._adopt(calibration, len(job.views) if isinstance(job, CalibrationJob) else None)
        return result.summary

    def _adopt(self, calibration: Calibration, views: int | None) -> None:
        """Publish a calibration that was made from so many views, and keep it for ~/save."""
        text = calibration.dumps()
        self._change(lambda state: state.with_calibration(calibration, views))
        message = String()
        fill_calibration_text(message, text)
        self._text.publish(message)
        self.reporter.note("calibration_digest", calibration_digest(text))
        self._warnings = report_scale_warnings(self.reporter, calibration)

    def _begin(self) -> CalibrationProcess:
        self._refuse_rivals()
        values, doubt = self.parameters, self._position.doubt
        options = CalibrationOptions(method=values["method"], residual=values["residual"])

        def begin(state: CalibrationState) -> tuple[CalibrationState, CalibrationProcess]:
            running = CalibrationProcess(state.calibration_job(self.config, options, doubt))
            return state.with_job(running), running

        return self._step(begin)

    def _show(self, running: CalibrationProcess, stage: Stage) -> None:
        if self._change(lambda state: state.with_stage(running, stage)).running is running:
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
        ending = not self._state.acquisition_wanted and self.acquisition_progress.state in _ENDED
        if self._acquiring is not None and ending:
            # It has said how it ended, and whoever heard that may call at once.
            self._acquiring.join(_LAST_WORD_S)
        goal = read_goal()
        if self.acquiring:
            raise CalibrationError("an acquisition is running", do="call ~/cancel to end it")
        self._state.refuse_another_job()
        goes_on = self._state.can_go_on(goal)
        path = self._free_recording()
        resumed = None if goes_on else self._recording_to_resume()
        run = self._step(lambda state: state.with_acquisition(goal, lambda: make_run(goal), path))
        recorder = None if path is None else ViewRecorder(path, self.config)
        self._acquiring = threading.Thread(
            target=self._acquire_in_thread, args=(run, recorder, resumed), daemon=True
        )
        where = "" if resumed is None else f" with the views of {resumed}"
        where += "" if path is None else f", recorded to {path}"
        verb = "going on" if goes_on else "begun"
        text = f"{name} {verb}{where}; ~/progress shows it, ~/cancel ends it"
        # Before the start: an acquisition that fails at once has the last word.
        self._report_progress(text)
        self._acquiring.start()
        return text

    def _free_recording(self) -> Path | None:
        """The folder that an acquisition is recorded to."""
        record = self.parameters["record"]
        if not record:
            return None
        if not self.parameters["allow_writing"]:
            raise InvalidValueError(
                "writing files is switched off",
                do="start the node with allow_writing true, or record nothing",
            )
        return _free_folder(self.parameters.allowed_path(record))

    def _recording_to_resume(self) -> Path | None:
        """The recording that a new acquisition goes on with, once."""
        text = self.parameters["resume"]
        if not text:
            return None
        path = self.parameters.allowed_path(text)
        if path == self._state.resumed:
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

        def on_frame(frame: RecordedFrame) -> None:
            if not self._still_acquiring():
                raise CalibrationError("stopped", do=f"call {run.service} to go on")
            if self._recorder is not None:
                known = frame.conditions or Conditions()
                g, stage = frame.magnification, frame.stage
                self._recorder.write(frame.image, frame.encoding, frame.stamp_ns, g, stage, known)

        newest = self._state.newest
        size = None if newest is None else newest.frame.size
        try:
            if isinstance(run, LadderRun):
                visits = self._resume_ladder(run, path, size, on_frame)
            else:
                taken = read_views(path, self.config, size, run.adopt, on_frame)
                self._change(lambda state: state.with_recorded_views(taken))
                visits = [one.view.visit for one in taken if one.view.visit is not None]
        except NODE_ERRORS:
            # With a part of them: the next call begins anew.
            run.discarded = True
            raise
        self._change(lambda state: state.with_resumed(path, visits))
        run.report(f"{counted(len(visits), run.unit)} taken over from {path}")

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
            source = LadderSource(frame.stamp_ns, known, frame.stage)
            self._change(lambda state: state.with_ladder_source(name, source))
            return True

        visits = read_pictures(path, self.config, size, adopt, on_frame)
        run.number_visits(visits)
        return visits

    def _acquire_in_thread(
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
            self._recorder = None
            self._change(CalibrationState.with_end_of_acquisition)
        run.progress = replace(run.progress, state=state, text=text)
        if self.context.ok():
            self._report_progress(f"acquisition {state}: {text}", level)
            last = f"{run.service}: {text}"
            (self.reporter.info if state == "done" else self.reporter.warn)(last)

    @property
    def has_picture(self) -> bool:
        """Whether there is a frame with a known magnification."""
        return self._state.newest is not None

    @property
    def has_calibration(self) -> bool:
        """Whether there is something to save."""
        return self._state.calibration is not None

    @property
    def recording(self) -> Path | None:
        """What the acquisition is recorded to."""
        return self._state.recording

    @property
    def acquiring(self) -> bool:
        """Whether an acquisition is under way."""
        return self._acquiring is not None and self._acquiring.is_alive()

    @property
    def acquisition_unit(self) -> str:
        """What one picture of the acquisition is called."""
        run = self._state.acquisition
        return "view" if run is None else run.unit

    @property
    def acquisition_progress(self) -> Progress:
        """How far the acquisition is, or how it has ended."""
        run = self._state.acquisition
        return Progress("stopped", "not begun") if run is None else run.progress

    @property
    def acquisition_reached(self) -> bool:
        """Whether an acquisition has met what was asked for."""
        run = self._state.acquisition
        return run is not None and run.progress.state == "done" and run.reached

    def _still_acquiring(self) -> bool:
        return self._state.acquisition_wanted and self.context.ok()

    def _record(self, picture: StreamPicture) -> None:
        recorder = self._recorder
        if recorder is not None:
            frame, g = picture.frame, picture.magnification
            recorder.write(
                frame.image, frame.encoding, frame.stamp_ns, g, picture.stage, picture.conditions
            )

    def wait_for_pictures(self, count: int) -> None:
        """See :class:`~semcal_ros.nodes.acquisition.run.Taker`."""
        wanted = self._state.pictures + count
        asked_ns = self.get_clock().now().nanoseconds
        self._wait_until(
            lambda: self._state.has_new_picture(wanted, asked_ns),
            MicroscopeError("no picture comes any more"),
            _PICTURE_S,
        )

    def find_grid(self) -> LatticeDetection | None:
        """See :class:`~semcal_ros.nodes.acquisition.follow.GridFinder`."""
        newest = self._state.newest
        found = None if newest is None else find_lattice(newest.grey)
        return None if isinstance(found, Rejection) else found

    def newest_picture(self) -> LadderPicture | None:
        """See :class:`~semcal_ros.nodes.acquisition.ladder.LadderTaker`."""
        newest = self._state.newest
        return None if newest is None else newest.to_ladder_picture("")

    def extend_calibration(self, run: LadderRun) -> str:
        """See :class:`~semcal_ros.nodes.acquisition.ladder.LadderTaker`."""
        self._refuse_rivals()
        pictures = tuple(one.picture for one in run.taken)
        base, doubt = run.goal.calibration, self._position.doubt

        def begin(state: CalibrationState) -> tuple[CalibrationState, CalibrationProcess]:
            running = CalibrationProcess(state.extension_job(self.config, base, pictures, doubt))
            return state.without_request().with_job(running), running

        return self._complete(self._step(begin))

    def take(self, request: ViewRequest | PictureRequest) -> str:
        """See :class:`~semcal_ros.nodes.acquisition.run.Taker`."""
        try:
            return self._take_view(request)
        except InvalidValueError as error:
            raise CalibrationError(str(error)) from error

    def wait_for_view(self, request: ViewRequest | PictureRequest) -> str:
        """See :class:`~semcal_ros.nodes.acquisition.run.Taker`."""
        self._change(lambda state: state.with_request(request))
        self._wait_until(
            lambda: bool(self._state.taken_by_hand), CalibrationError("no view"), math.inf
        )
        return self._state.taken_by_hand

    def stage(self) -> StageReading | None:
        """See :class:`~semcal_ros.nodes.acquisition.run.Taker`."""
        newest = self._state.newest
        return None if newest is None else newest.stage

    def calibrate(self) -> Calibration:
        """See :class:`~semcal_ros.nodes.acquisition.run.ViewTaker`."""
        self._change(CalibrationState.without_request)
        self._complete(self._begin())
        calibration = self._state.calibration
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
                raise CalibrationError("stopped", do=f"call {self._state.service} to go on")
            if time.monotonic() > end_s:
                raise late
            time.sleep(_POLL_S)

    def _cancel(self) -> str:
        def cancel(
            state: CalibrationState,
        ) -> tuple[CalibrationState, tuple[RunningJob | None, str]]:
            after, running, text = state.cancelled()
            return after, (running, text)

        running, text = self._step(cancel)
        if running is not None:
            running.cancel()
        return text

    def _compared(self) -> tuple[Calibration, tuple[FoundView, ...], Provenance]:
        """The calibration that is checked or renewed, the views that say so, and their origin."""
        self._refuse_rivals()
        views, origin = self._state.compared(self.config, self._position.doubt)
        return self._base(), views, origin

    def _base(self) -> Calibration:
        """The calibration that was made here, else that of the file."""
        calibration = self._state.calibration
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
        self._adopt(Calibration.from_model(done.model), len(views))
        return f"updated; before, it was {done.check.summary}"

    def save(self) -> str:
        """Write the calibration, and say where."""
        if not self.parameters["allow_writing"]:
            raise InvalidValueError(
                "writing files is switched off", do="start the node with allow_writing true"
            )
        return self._output.write(self._state.calibration_to_save().save)


def main(args: Sequence[str] | None = None) -> int:
    """Run the executable."""
    return run_node(CalibrationServer, args, threads=CalibrationServer.threads)


if __name__ == "__main__":
    raise SystemExit(main())
