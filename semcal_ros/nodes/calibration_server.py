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

import os
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup, ReentrantCallbackGroup
from sensor_msgs.msg import Image
from std_msgs.msg import String

from semcal_ros.bridge.calibration import ScaleWarnings, fill_calibration_text
from semcal_ros.bridge.conditions import Conditions
from semcal_ros.bridge.diagnostics import DiagnosticLevel, DiagnosticSummary, fill_diagnostic_status
from semcal_ros.bridge.images import fill_image
from semcal_ros.calibration import Calibration
from semcal_ros.core.calibration.acquisition import ViewRequest
from semcal_ros.core.calibration.judgement.check import Verdict
from semcal_ros.core.calibration.options import METHODS, RESIDUAL_MODES, CalibrationOptions
from semcal_ros.core.calibration.views import FoundView
from semcal_ros.core.camera.records import Provenance
from semcal_ros.core.corners import find_lattice
from semcal_ros.core.errors import CalibrationError, InvalidValueError, Rejection
from semcal_ros.core.ladder.acquisition import PictureRequest
from semcal_ros.core.wording import counted
from semcal_ros.nodes.acquisition.driver import AcquisitionDriver
from semcal_ros.nodes.acquisition.ladder import LadderRun, place_of
from semcal_ros.nodes.acquisition.run import ACQUISITION, Progress
from semcal_ros.nodes.calibration_state import (
    CalibrationState,
    CurrentState,
    RunningJob,
    StreamPicture,
)
from semcal_ros.nodes.common.parameters import CALIBRATION, ParameterDeclaration, Parameters
from semcal_ros.nodes.common.reporter import NODE_ERRORS
from semcal_ros.nodes.common.run import run_node
from semcal_ros.nodes.frames.calibration_input import calibration_digest, report_scale_warnings
from semcal_ros.nodes.frames.held_values import ConditionsInput
from semcal_ros.nodes.frames.overlay import corner_overlay
from semcal_ros.nodes.frames.stage import StageInput
from semcal_ros.nodes.frames.stream import StreamFrame, StreamNode
from semcal_ros.nodes.workers.calibration_worker import CalibrationJob, CalibrationProcess, Stage
from semcal_ros.workflows.check_and_update import check_found, update_found

_SUFFIXES = (".yaml", ".yml")

OUTPUT = ParameterDeclaration(
    "output",
    "calibration.yaml",
    "File that ~/save writes, from the folder `directory` on. The default never replaces a file that was there before:"
    " it becomes calibration_2.yaml and so on.",
    confined=True,
)

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
_GOAL = ("lowest_magnification", "highest_magnification", "target")


class OutputFile:
    """The file of the parameter :data:`OUTPUT`.

    Parameters
    ----------
    parameters
        Parameters among which is :data:`OUTPUT`.
    on_change
        Called with :attr:`plan` when another file is named.
    """

    def __init__(self, parameters: Parameters, on_change: Callable[[str], None]) -> None:
        self._parameters = parameters
        self._written: Path | None = None
        parameters.on_change(OUTPUT.name, lambda _value: on_change(self.plan), _check_suffix)

    def path(self) -> Path:
        """Return the file that would be written now; raises :class:`InvalidValueError` if none may be."""
        name = str(self._parameters[OUTPUT.name] or OUTPUT.default)
        wanted = self._parameters.allowed_path(name)
        if name != OUTPUT.default:
            return wanted
        number, free = 2, wanted
        while free.exists() and free != self._written:
            free = wanted.with_name(f"{wanted.stem}_{number}{wanted.suffix}")
            number += 1
        return free

    @property
    def plan(self) -> str:
        """What a call to save would do now, in words."""
        try:
            path = self.path()
        except InvalidValueError as error:
            return f"~/save cannot write: {error}"
        if not os.access(path.parent, os.W_OK | os.X_OK):
            return f"~/save cannot write {path}: the folder is missing or read-only; set the parameter output"
        return f"~/save will {self._verb(path)} {path}"

    def _verb(self, path: Path) -> str:
        return "replace" if path.exists() and path != self._written else "write"

    def write(self, save: Callable[[Path], object]) -> str:
        """Write the file by ``save(path)``; return what was done, in words, with the whole path."""
        path = self.path()
        replaced = self._verb(path) == "replace"
        save(path)
        self._written = path
        return f"saved to {path}" + ", in place of a file that this node had not written" * replaced


def _check_suffix(name: str) -> None:
    # Whoever may call services may name files: a calibration must not become a start-up script.
    if name and Path(name).suffix not in _SUFFIXES:
        raise InvalidValueError(
            f"parameter output = {name!r}", expected="a name that ends in .yaml"
        )


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
        self._state = CurrentState()
        self._calibrating: threading.Thread | None = None
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
        self.acquisition = AcquisitionDriver(self.node_context, self._state, self)
        quick, compared = MutuallyExclusiveCallbackGroup(), MutuallyExclusiveCallbackGroup()
        handlers = (
            ("add_view", self.add_view, quick),
            ("save", self.save, quick),
            ("clear", self._clear, quick),
            # A call during a calibration is refused at once instead of waiting for its end.
            ("calibrate", self._calibrate, ReentrantCallbackGroup()),
            ("calibrate_start", self._start_calibration, quick),
            ("acquire", self.acquisition.acquire, quick),
            ("extend", self.acquisition.extend, quick),
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
        self.report_progress("no views yet")
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
        running = self._state.change(CalibrationState.closed).running
        if running is not None:
            running.cancel()
        if self._calibrating is not None:
            self._calibrating.join()
        self.acquisition.join()

    def _tell_unused_views(self) -> None:
        """Say at the end what is lost: a replay ends all nodes with its last frame."""
        count = self._state.now.unused_views
        if count > 0:
            self.reporter.warn(
                f"{counted(count, 'view')} collected and not calibrated; call ~/calibrate before the end, "
                "or use `semcal calibrate` on the recording"
            )

    def _report_answer(self, success: bool, text: str) -> None:
        self.report_progress(text, DiagnosticLevel.OK if success else DiagnosticLevel.WARN)

    def _report_refusal(self, success: bool, text: str) -> None:
        if not success:
            self._report_answer(success, text)

    def report_progress(self, text: str, level: DiagnosticLevel = DiagnosticLevel.OK) -> None:
        """Publish on ~/progress what is known, with what has just happened."""
        settings = {name: f"{self.parameters[name]:g}" for name in _GOAL}
        settings["microscope"] = self.parameters["microscope"]
        status = DiagnosticStatus()
        name = f"{self.get_fully_qualified_name()}: calibration"
        summary = DiagnosticSummary(level, text, self._state.now.progress(settings))
        fill_diagnostic_status(status, name, self.config.name, summary)
        self._progress.publish(status)

    # -- stream ------------------------------------------------------------------------------------

    def _on_frame(self, frame: StreamFrame) -> None:
        magnification = self.known_magnification(frame)
        if magnification is None or frame.mixed:
            return
        if self.frames is not None and self.frames.has_rivals:
            self._state.change(CalibrationState.without_picture)
            self.reporter.forget("picture_stamp")
            return
        self._conditions.take_waiting()
        conditions = Conditions.from_topic(self._conditions.current)
        stage = self._position.at(frame.stamp_ns)
        self._state.change(lambda state: state.with_frame(frame, magnification, stage, conditions))
        self.reporter.note("picture_stamp", f"{1e-9 * frame.stamp_ns:.3f}")

    # -- services ----------------------------------------------------------------------------------

    def refuse_rivals(self) -> None:
        """Refuse pictures of more than one publisher; raises :class:`InvalidValueError`."""
        if self.frames is not None:
            self.frames.refuse_rivals()

    def add_view(self) -> str:
        """Make a view of the newest frame, and say which."""
        request = self._state.now.request
        text = self.take_view(request)
        if request is not None:
            self._state.change(lambda state: state.with_answer(text))
        return text

    def take_view(self, request: ViewRequest | PictureRequest | None) -> str:
        """Make use of the newest frame, which must show what was asked for."""
        self.refuse_rivals()
        if request is None and self.frames is not None:
            self.frames.refuse_unused()
        picture = self._state.now.picture_to_take()
        if request is not None:
            self.acquisition.record(picture)
            picture.require_magnification_of(request)
        if isinstance(request, PictureRequest):
            text = self._take_picture(picture, request)
        else:
            text = self._add_view(picture, request)
        self.reporter.count_published(picture.frame.stamp_ns)
        return text

    def _take_picture(self, picture: StreamPicture, request: PictureRequest) -> str:
        """Take a picture for a ladder."""
        run = self._state.now.acquisition
        assert isinstance(run, LadderRun)
        name = f"picture {len(run.taken)}"
        run.take(request, picture.to_ladder_picture(name), place_of(picture.stage))
        self._state.change(lambda state: state.with_ladder_picture(name, picture))
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
        text = self._state.answer(lambda state: state.with_view(view, picture))
        # Who collects views wants to save a calibration, and can still change where.
        return text + (f"; {self._saving}" if len(self._state.now.views) == 1 else "")

    def _clear(self) -> str:
        text = self._state.answer(CalibrationState.cleared)
        self._position.forget_doubt()
        return text

    def _calibrate(self) -> str:
        return self.complete(self.begin_calibration())

    def _start_calibration(self) -> str:
        running = self.begin_calibration()
        self._calibrating = threading.Thread(
            target=self._complete_in_thread, args=(running,), daemon=True
        )
        self._calibrating.start()
        return f"calibrating from {running.job.source}; ~/progress shows it, ~/cancel ends it"

    def _complete_in_thread(self, running: CalibrationProcess) -> None:
        """Report, in place of an answer, how a calibration has ended."""
        try:
            success, text = True, self.complete(running)
        except NODE_ERRORS as error:
            success, text = False, " ".join(str(error).split())
        if self.context.ok():
            self._report_answer(success, text)
            if success:
                self.reporter.info(f"~/calibrate_start: {text}")
            else:
                self.reporter.warn(f"~/calibrate_start: {text}")

    def complete(self, running: CalibrationProcess) -> str:
        """Wait for a calibration, publish it, and return its summary; raises :class:`CalibrationError`."""
        done = False
        try:
            result = running.run(self.context.ok, lambda stage: self._show(running, stage))
            if result.failed:
                raise CalibrationError(result.summary)
            calibration = Calibration.loads(result.text, source="the calibration process")
            done = True
        finally:
            wanted = self._state.answer(lambda state: state.with_end_of(running, done=done))
        if not wanted:
            raise CalibrationError("cancelled")
        job = running.job
        self._adopt(calibration, len(job.views) if isinstance(job, CalibrationJob) else None)
        return result.summary

    def _adopt(self, calibration: Calibration, views: int | None) -> None:
        """Publish a calibration that was made from so many views, and keep it for ~/save."""
        text = calibration.dumps()
        self._state.change(lambda state: state.with_calibration(calibration, views))
        message = String()
        fill_calibration_text(message, text)
        self._text.publish(message)
        self.reporter.note("calibration_digest", calibration_digest(text))
        self._warnings = report_scale_warnings(self.reporter, calibration)

    def begin_calibration(self) -> CalibrationProcess:
        """Make a calibration from all views the one that runs; raises :class:`CalibrationError`."""
        self.refuse_rivals()
        values, doubt = self.parameters, self._position.doubt
        options = CalibrationOptions(method=values["method"], residual=values["residual"])

        def begin(state: CalibrationState) -> tuple[CalibrationState, CalibrationProcess]:
            running = CalibrationProcess(state.calibration_job(self.config, options, doubt))
            return state.with_job(running), running

        return self._state.answer(begin)

    def _show(self, running: CalibrationProcess, stage: Stage) -> None:
        if self._state.change(lambda state: state.with_stage(running, stage)).running is running:
            self.report_progress(f"calibrating from {running.job.source}")

    def show(self, progress: Progress) -> None:
        """Tell how far an acquisition is."""
        self.report_progress(progress.text)

    @property
    def has_picture(self) -> bool:
        """Whether there is a frame with a known magnification."""
        return self._state.now.newest is not None

    @property
    def has_calibration(self) -> bool:
        """Whether there is something to save."""
        return self._state.now.calibration is not None

    @property
    def stage_doubt(self) -> str:
        """What looks like degrees in the messages of the stage; empty where nothing does."""
        return self._position.doubt

    def _cancel(self) -> str:
        def cancel(
            state: CalibrationState,
        ) -> tuple[CalibrationState, tuple[RunningJob | None, str]]:
            after, running, text = state.cancelled()
            return after, (running, text)

        running, text = self._state.answer(cancel)
        if running is not None:
            running.cancel()
        return text

    def _compared(self) -> tuple[Calibration, tuple[FoundView, ...], Provenance]:
        """The calibration that is checked or renewed, the views that say so, and their origin."""
        self.refuse_rivals()
        views, origin = self._state.now.compared(self.config, self._position.doubt)
        return self.base_calibration(), views, origin

    def base_calibration(self) -> Calibration:
        """Return the calibration that was made here, else that of the file."""
        calibration = self._state.now.calibration
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
            others = "" if result.not_renewable else "call ~/update, or "
            raise CalibrationError(result.summary, do=f"{others}calibrate anew")
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
        return self._output.write(self._state.now.calibration_to_save().save)


def main(args: Sequence[str] | None = None) -> int:
    """Run the executable."""
    return run_node(CalibrationServer, args, threads=CalibrationServer.threads)


if __name__ == "__main__":
    raise SystemExit(main())
