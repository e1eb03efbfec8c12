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

"""A calibration, or an extension of one, in a process of its own: the stream goes on, and a shutdown need not wait.

The process does not import ROS.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from semcal_ros.bridge.conditions import Conditions
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.calibration.judgement.plan import judge_calibration
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.views import FoundView
from semcal_ros.core.camera.records import Provenance
from semcal_ros.core.errors import CalibrationError, SemcalError
from semcal_ros.core.ladder.matching import LadderPicture
from semcal_ros.core.wording import counted
from semcal_ros.nodes.workers.child_process import Channel, ChildProcess, ChildProcessEnded
from semcal_ros.workflows.calibrate import calibrate_found
from semcal_ros.workflows.extend import extend_by_pictures
from semcal_ros.workflows.find_grid import name_rejected

# How often a running calibration asks whether it is still wanted: a person notices no delay at a stop.
_POLL_S = 0.1
# A stage is published when it changes, though not more often than can be read, and as a sign of life in between.
_OFTEN_S, _SELDOM_S = 0.2, 1.0
# A third of the weight of a live node (sched(7)) where both want the same processor: live nodes keep up, and the
# calibration still advances.
_NICE = 5
# Part of the work of an extension after which all pictures are matched.
_MATCHED = 0.8

#: Called with the name of a stage, and the fraction of the work that is done.
OnStage = Callable[[str, float], None]


@dataclass(frozen=True)
class CalibrationJob:
    """Everything that a calibration needs; the images of the views are not needed. Notes go into the summary,
    provenance and conditions (by the names of the views) into the file.
    """

    views: tuple[FoundView, ...]
    display_width_m: float
    squares_m: tuple[float, ...]
    options: CalibrationOptions
    grid_certificate: str = ""
    notes: tuple[str, ...] = ()
    provenance: Provenance | None = None
    conditions: Mapping[str, Conditions | None] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """What it is, in words."""
        return f"{self.options.method} calibration from {self.source}"

    @property
    def source(self) -> str:
        """What it is made from, in words."""
        return counted(len(self.views), "view")

    @property
    def do_with_less(self) -> str:
        """What to do where memory runs out."""
        return "use fewer views, or residual off"

    def compute(self, on_stage: OnStage) -> tuple[Calibration, str, tuple[str, ...]]:
        """Calibrate; return the calibration, a summary, and notes. Raises :class:`SemcalError`."""
        done = calibrate_found(
            self.views,
            (),
            display_width_m=self.display_width_m,
            squares_m=self.squares_m,
            options=self.options,
            grid_certificate=self.grid_certificate,
            provenance=self.provenance,
            conditions=self.conditions,
            on_stage=on_stage,
        )
        held_out = [v for v in done.result.held_out_rms_px.values() if np.isfinite(v)]
        worst = f", held-out RMS up to {max(held_out):.3f} px" if held_out else ""
        low, high = done.calibration.magnification_range
        used = counted(len(done.collected.views), "view")
        left_out = done.collected.rejected
        if left_out:
            used += f" of {len(self.views)}"
        summary = f"{self.options.method} calibration from {used}, {low:g}x to {high:g}x{worst}"
        notes = [f"left out: {text}" for text in name_rejected(left_out)]
        return done.calibration, summary, (*notes, *self.notes, *done.result.warnings)


@dataclass(frozen=True, eq=False)
class ExtensionJob:
    """A calibration, and the pictures of a ladder by which it is extended. Notes go into the summary, provenance into
    the file.
    """

    calibration: Calibration
    pictures: tuple[LadderPicture, ...]
    config: MicroscopeConfig
    provenance: Provenance
    notes: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """What it is, in words."""
        return f"extension by {self.source}"

    @property
    def source(self) -> str:
        """What it is made from, in words."""
        return counted(len(self.pictures), "picture")

    @property
    def do_with_less(self) -> str:
        """What to do where memory runs out."""
        return "take smaller pictures"

    def compute(self, on_stage: OnStage) -> tuple[Calibration, str, tuple[str, ...]]:
        """Extend; return the calibration, a summary, and notes. Raises :class:`SemcalError`."""
        done = extend_by_pictures(
            self.calibration,
            self.pictures,
            self.config,
            self.provenance,
            notes=self.notes,
            on_progress=lambda name, count, total: on_stage(
                name, _MATCHED * count / total if total else _MATCHED
            ),
        )
        low, high = done.calibration.magnification_range
        used = counted(sum(step.pictures for step in done.result.steps), "picture")
        summary = f"extended to {low:g}x to {high:g}x by {used}"
        return done.calibration, summary, (*self.notes, *done.result.weaknesses)


@dataclass(frozen=True)
class Stage:
    """The current stage of a calibration, and the fraction of the work that is done."""

    name: str
    fraction: float


@dataclass(frozen=True)
class JobResult:
    """The text of the calibration file and a summary, or the reason of the failure."""

    text: str
    summary: str
    failed: bool = False


def _refuse(error: SemcalError) -> JobResult:
    return JobResult("", str(error), failed=True)


def _compute(job: CalibrationJob | ExtensionJob, on_stage: OnStage) -> JobResult:
    started_s = time.monotonic()
    try:
        calibration, summary, notes = job.compute(on_stage)
    except SemcalError as error:
        return _refuse(error)
    except MemoryError:
        return _refuse(
            CalibrationError(f"not enough memory for the {job.title}", do=job.do_with_less)
        )
    summary += f", in {time.monotonic() - started_s:.1f} s"
    summary += f"; {judge_calibration(calibration).describe()}"
    return JobResult(calibration.dumps(), summary + "".join(f"; {note}" for note in notes))


def serve(channel: Channel) -> None:
    """Receive one job; answer with its stages and finally with its result."""
    job: CalibrationJob | ExtensionJob = channel.receive()
    channel.send(_compute(job, lambda name, fraction: channel.send(Stage(name, fraction))))


def without_images(views: Sequence[FoundView]) -> tuple[FoundView, ...]:
    """Return the views without their pixels, which a calibration does not need."""
    nothing = np.zeros((1, 1), dtype=np.uint8)
    return tuple(replace(view, image=nothing) for view in views)


class CalibrationProcess:
    """One calibration; :meth:`run` waits for it and :meth:`cancel` ends it from another thread."""

    def __init__(self, job: CalibrationJob | ExtensionJob) -> None:
        self.job = job
        self._lock = threading.Lock()
        self._process: ChildProcess | None = None
        self._cancelled = False
        self._started_s = time.monotonic()

    @property
    def elapsed_s(self) -> float:
        """Seconds since this object was created."""
        return time.monotonic() - self._started_s

    def cancel(self) -> None:
        """Stop the calibration at once; a run that has not begun will not begin."""
        with self._lock:
            self._cancelled = True
            if self._process is not None:
                self._process.kill()

    def run(
        self, still_wanted: Callable[[], bool], on_progress: Callable[[Stage], None]
    ) -> JobResult:
        """Calibrate.

        Parameters
        ----------
        still_wanted
            Called a few times a second; if it returns False, the calibration is cancelled.
        on_progress
            Called with the stage when it changes, at most five times a second, and at least once a second.
        """
        with self._lock:
            if self._cancelled:
                return JobResult("", "cancelled", failed=True)
            process = self._process = ChildProcess(serve, _NICE)
        try:
            process.send(self.job)
            return self._result(process, still_wanted, _ProgressRelay(on_progress))
        except ChildProcessEnded as error:
            text = "cancelled" if self._cancelled else _describe(error, self.job.do_with_less)
            return JobResult("", text, failed=True)
        finally:
            with self._lock:
                self._process = None
            process.close()

    @staticmethod
    def _result(
        process: ChildProcess, still_wanted: Callable[[], bool], progress: _ProgressRelay
    ) -> JobResult:
        while still_wanted():
            progress.publish()
            while process.poll(_POLL_S):
                answer: Stage | JobResult = process.receive()
                if isinstance(answer, JobResult):
                    return answer
                progress.take(answer)
                progress.publish()
        return JobResult("", "stopped", failed=True)


class _ProgressRelay:
    """Forwards stages at a bounded rate; the fraction never decreases, even if work starts again."""

    def __init__(self, on_progress: Callable[[Stage], None]) -> None:
        self._on_progress = on_progress
        self._published: Stage | None = None
        self._published_s = -_SELDOM_S
        self._stage = Stage("start", 0.0)

    def take(self, stage: Stage) -> None:
        self._stage = replace(stage, fraction=max(stage.fraction, self._stage.fraction))

    def publish(self) -> None:
        now_s = time.monotonic()
        wait_s = _SELDOM_S if self._stage == self._published else _OFTEN_S
        if now_s - self._published_s >= wait_s:
            self._published, self._published_s = self._stage, now_s
            self._on_progress(self._stage)


def _describe(error: ChildProcessEnded, do_with_less: str) -> str:
    """Say why there is no result, and what to do."""
    do = "call again"
    if error.status == -signal.SIGKILL:
        do = f"call again; if nobody ended it, memory ran out: {do_with_less}"
    elif error.status is None or error.status >= 0:
        do = "see the log of the node, and call again"
    return str(CalibrationError(f"the calibration process {error} without a result", do=do))
