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

"""Runs an acquisition in a thread of the calibration server: pictures, recording, calibrations, and how it ends."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Protocol, TypeVar

from semcal_ros.bridge.conditions import Conditions
from semcal_ros.bridge.diagnostics import DiagnosticLevel
from semcal_ros.bridge.images import to_gray
from semcal_ros.calibration import Calibration
from semcal_ros.core.calibration.acquisition import AcquisitionGoal, ViewRequest
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.corners import LatticeDetection, find_lattice
from semcal_ros.core.errors import CalibrationError, InvalidValueError, MicroscopeError, Rejection
from semcal_ros.core.ladder.acquisition import PictureRequest
from semcal_ros.core.ladder.matching import LadderPicture
from semcal_ros.core.wording import counted
from semcal_ros.files.bags.writer import ViewRecorder
from semcal_ros.files.recordings import RecordedFrame
from semcal_ros.nodes.acquisition.commands import MicroscopeCommands
from semcal_ros.nodes.acquisition.ladder import LadderGoal, LadderRun, ladder_goal_of, place_of
from semcal_ros.nodes.acquisition.recorded import read_pictures, read_views
from semcal_ros.nodes.acquisition.run import AcquisitionRun, Progress, goal_of
from semcal_ros.nodes.calibration_state import (
    CalibrationState,
    CurrentState,
    LadderSource,
    StreamPicture,
)
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.reporter import NODE_ERRORS
from semcal_ros.nodes.workers.calibration_worker import CalibrationProcess
from semcal_ros.workflows.extend import make_picture

# States of an acquisition that has ended, and how long its thread may take after it has said so.
_ENDED, _LAST_WORD_S = ("stopped", "failed", "done"), 1.0
# Pictures of an acquisition: a slow scan of 4 k x 4 k takes some minutes.
_PICTURE_S = 600.0
_POLL_S = 0.1

Goal = TypeVar("Goal", AcquisitionGoal, LadderGoal)


def _free_folder(wanted: Path) -> Path:
    """The folder, or with a number if there is one already."""
    number, free = 2, wanted
    while free.exists():
        free = wanted.with_name(f"{wanted.name}_{number}")
        number += 1
    return free


class Host(Protocol):
    """The calibration server, as an acquisition needs it."""

    def refuse_rivals(self) -> None:
        """Refuse pictures of more than one publisher; raises :class:`InvalidValueError`."""

    def take_view(self, request: ViewRequest | PictureRequest) -> str:
        """Make use of the newest picture, and say which."""

    def begin_calibration(self) -> CalibrationProcess:
        """Make a calibration from all views the one that runs."""

    def complete(self, running: CalibrationProcess) -> str:
        """Wait for a calibration, publish it, and return its summary."""

    def base_calibration(self) -> Calibration:
        """Return the calibration that is extended."""

    @property
    def stage_doubt(self) -> str:
        """What looks like degrees in the messages of the stage."""

    def report_progress(self, text: str, level: DiagnosticLevel = DiagnosticLevel.OK) -> None:
        """Publish what is known, with what has just happened."""

    def show(self, progress: Progress) -> None:
        """Tell how far the acquisition is."""


class AcquisitionDriver:
    """Begins acquisitions and goes on with them; what they ask for and what comes of it goes through the server.

    Parameters
    ----------
    context
        Of the node; among its parameters are :data:`~semcal_ros.nodes.acquisition.run.ACQUISITION`.
    state
        What the server knows.
    host
        The server.
    """

    def __init__(self, context: NodeContext, state: CurrentState, host: Host) -> None:
        self._node, self._config = context.node, context.config
        self._parameters, self._reporter = context.parameters, context.reporter
        self._state = state
        self._host = host
        self._thread: threading.Thread | None = None
        self._recorder: ViewRecorder | None = None
        name = context.parameters["microscope"]
        self._commands = MicroscopeCommands(context, name, self._still_acquiring) if name else None

    def join(self) -> None:
        """Wait until an acquisition that is not wanted any more has ended."""
        if self._thread is not None:
            self._thread.join()

    def acquire(self) -> str:
        """Begin an acquisition of a grid, or go on with one; return what was begun, in words."""
        squares_m, width_m = self._config.squares_m, self._config.display_width_m
        turn_by = self._parameters["turn_by"]
        return self._acquire_by(
            "acquisition",
            lambda: goal_of(self._parameters, squares_m, width_m),
            lambda goal: AcquisitionRun(goal, self, self._commands, turn_by, self._still_acquiring),
        )

    def extend(self) -> str:
        """Begin a ladder, or go on with one; return what was begun, in words."""
        return self._acquire_by(
            "ladder",
            lambda: ladder_goal_of(self._parameters, self._host.base_calibration()),
            lambda goal: LadderRun(goal, self, self._commands, self._still_acquiring),
        )

    def _acquire_by(
        self,
        name: str,
        read_goal: Callable[[], Goal],
        make_run: Callable[[Goal], AcquisitionRun | LadderRun],
    ) -> str:
        """Begin a run that makes an acquisition, or go on with the one that has the same goal."""
        self._host.refuse_rivals()
        ending = not self._state.now.acquisition_wanted and self.progress.state in _ENDED
        if self._thread is not None and ending:
            # It has said how it ended, and whoever heard that may call at once.
            self._thread.join(_LAST_WORD_S)
        goal = read_goal()
        if self.is_running:
            raise CalibrationError("an acquisition is running", do="call ~/cancel to end it")
        self._state.now.refuse_another_job()
        goes_on = self._state.now.can_go_on(goal)
        path = self._free_recording()
        resumed = None if goes_on else self._recording_to_resume()
        recorder = None if path is None else ViewRecorder(path, self._config)
        run = self._state.answer(
            lambda state: state.with_acquisition(goal, lambda: make_run(goal), path)
        )
        self._thread = threading.Thread(
            target=self._acquire_in_thread, args=(run, recorder, resumed), daemon=True
        )
        where = "" if resumed is None else f" with the views of {resumed}"
        where += "" if path is None else f", recorded to {path}"
        verb = "going on" if goes_on else "begun"
        text = f"{name} {verb}{where}; ~/progress shows it, ~/cancel ends it"
        # Before the start: an acquisition that fails at once has the last word.
        self._host.report_progress(text)
        self._thread.start()
        return text

    def _free_recording(self) -> Path | None:
        """The folder that an acquisition is recorded to."""
        record = self._parameters["record"]
        if not record:
            return None
        if not self._parameters["allow_writing"]:
            raise InvalidValueError(
                "writing files is switched off",
                do="start the node with allow_writing true, or record nothing",
            )
        return _free_folder(self._parameters.allowed_path(record))

    def _recording_to_resume(self) -> Path | None:
        """The recording that a new acquisition goes on with, once."""
        text = self._parameters["resume"]
        if not text:
            return None
        path = self._parameters.allowed_path(text)
        if path == self._state.now.resumed:
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

        newest = self._state.now.newest
        size = None if newest is None else newest.frame.size
        try:
            if isinstance(run, LadderRun):
                visits = self._resume_ladder(run, path, size, on_frame)
            else:
                taken = read_views(path, self._config, size, run.adopt, on_frame)
                self._state.change(lambda state: state.with_recorded_views(taken))
                visits = [one.view.visit for one in taken if one.view.visit is not None]
        except NODE_ERRORS:
            # With a part of them: the next call begins anew.
            run.discarded = True
            raise
        self._state.change(lambda state: state.with_resumed(path, visits))
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
            self._state.change(lambda state: state.with_ladder_source(name, source))
            return True

        visits = read_pictures(path, self._config, size, adopt, on_frame)
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
            self._state.change(CalibrationState.with_end_of_acquisition)
        run.progress = replace(run.progress, state=state, text=text)
        if self._node.context.ok():
            self._host.report_progress(f"acquisition {state}: {text}", level)
            last = f"{run.service}: {text}"
            (self._reporter.info if state == "done" else self._reporter.warn)(last)

    @property
    def recording(self) -> Path | None:
        """What the acquisition is recorded to."""
        return self._state.now.recording

    @property
    def is_running(self) -> bool:
        """Whether an acquisition is under way."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def unit(self) -> str:
        """What one picture of the acquisition is called."""
        run = self._state.now.acquisition
        return "view" if run is None else run.unit

    @property
    def progress(self) -> Progress:
        """How far the acquisition is, or how it has ended."""
        run = self._state.now.acquisition
        return Progress("stopped", "not begun") if run is None else run.progress

    @property
    def reached(self) -> bool:
        """Whether an acquisition has met what was asked for."""
        run = self._state.now.acquisition
        return run is not None and run.progress.state == "done" and run.reached

    def _still_acquiring(self) -> bool:
        return self._state.now.acquisition_wanted and self._node.context.ok()

    def record(self, picture: StreamPicture) -> None:
        """Record a picture, if the acquisition that runs is recorded."""
        recorder = self._recorder
        if recorder is not None:
            frame, g = picture.frame, picture.magnification
            recorder.write(
                frame.image, frame.encoding, frame.stamp_ns, g, picture.stage, picture.conditions
            )

    def wait_for_pictures(self, count: int) -> None:
        """See :class:`~semcal_ros.nodes.acquisition.run.Taker`."""
        wanted = self._state.now.pictures + count
        asked_ns = self._node.get_clock().now().nanoseconds
        self._wait_until(
            lambda: self._state.now.has_new_picture(wanted, asked_ns),
            MicroscopeError("no picture comes any more"),
            _PICTURE_S,
        )

    def find_grid(self) -> LatticeDetection | None:
        """See :class:`~semcal_ros.nodes.acquisition.run.GridFinder`."""
        newest = self._state.now.newest
        found = None if newest is None else find_lattice(newest.grey)
        return None if isinstance(found, Rejection) else found

    def newest_picture(self) -> LadderPicture | None:
        """See :class:`~semcal_ros.nodes.acquisition.ladder.LadderTaker`."""
        newest = self._state.now.newest
        return None if newest is None else newest.to_ladder_picture("")

    def extend_calibration(self, run: LadderRun) -> str:
        """See :class:`~semcal_ros.nodes.acquisition.ladder.LadderTaker`."""
        self._host.refuse_rivals()
        pictures = tuple(one.picture for one in run.taken)
        base, doubt = run.goal.calibration, self._host.stage_doubt

        def begin(state: CalibrationState) -> tuple[CalibrationState, CalibrationProcess]:
            running = CalibrationProcess(state.extension_job(self._config, base, pictures, doubt))
            return state.without_request().with_job(running), running

        return self._host.complete(self._state.answer(begin))

    def take(self, request: ViewRequest | PictureRequest) -> str:
        """See :class:`~semcal_ros.nodes.acquisition.run.Taker`."""
        try:
            return self._host.take_view(request)
        except InvalidValueError as error:
            raise CalibrationError(str(error)) from error

    def wait_for_view(self, request: ViewRequest | PictureRequest) -> str:
        """See :class:`~semcal_ros.nodes.acquisition.run.Taker`."""
        self._state.change(lambda state: state.with_request(request))
        self._wait_until(
            lambda: bool(self._state.now.taken_by_hand), CalibrationError("no view"), math.inf
        )
        return self._state.now.taken_by_hand

    def stage(self) -> StageReading | None:
        """See :class:`~semcal_ros.nodes.acquisition.run.Taker`."""
        newest = self._state.now.newest
        return None if newest is None else newest.stage

    def calibrate(self) -> Calibration:
        """See :class:`~semcal_ros.nodes.acquisition.run.ViewTaker`."""
        self._state.change(CalibrationState.without_request)
        self._host.complete(self._host.begin_calibration())
        calibration = self._state.now.calibration
        if calibration is None:
            raise CalibrationError("no calibration came of the views")
        return calibration

    def show(self, progress: Progress) -> None:
        """See :class:`~semcal_ros.nodes.acquisition.run.Taker`."""
        self._host.show(progress)

    def _wait_until(
        self,
        condition: Callable[[], bool],
        late: MicroscopeError | CalibrationError,
        limit_s: float,
    ) -> None:
        end_s = time.monotonic() + limit_s
        while not condition():
            if not self._still_acquiring():
                raise CalibrationError("stopped", do=f"call {self._state.now.service} to go on")
            if time.monotonic() > end_s:
                raise late
            time.sleep(_POLL_S)
