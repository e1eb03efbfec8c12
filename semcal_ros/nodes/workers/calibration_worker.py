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

"""A calibration in a separate process, so that the stream continues and a shutdown need not wait for it.

The process does not import ROS.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from semcal_ros.core.calibration.judgement.plan import judge_calibration
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.views import FoundView
from semcal_ros.core.camera.provenance import Provenance
from semcal_ros.core.errors import CalibrationError, SemcalError
from semcal_ros.core.wording import counted
from semcal_ros.files.tiff.sem_image import Conditions
from semcal_ros.nodes.workers.child_process import Channel, ChildProcess, ChildProcessEnded
from semcal_ros.workflows.calibrate import calibrate_found

__all__ = [
    "CalibrationJob",
    "CalibrationProcess",
    "JobResult",
    "Stage",
    "serve",
    "without_images",
]

# How often a running calibration asks whether it is still wanted: a person notices no delay at a stop.
_POLL_S = 0.1
# A stage is published when it changes, though not more often than can be read, and as a sign of life in between.
_OFTEN_S, _SELDOM_S = 0.2, 1.0
# A third of the weight of a live node (sched(7)) where both want the same processor: live nodes keep up, and the
# calibration still advances.
_NICE = 5


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


def _calibrate(job: CalibrationJob, on_stage: Callable[[str, float], None]) -> JobResult:
    started_s = time.monotonic()
    try:
        done = calibrate_found(
            job.views,
            (),
            display_width_m=job.display_width_m,
            squares_m=job.squares_m,
            options=job.options,
            grid_certificate=job.grid_certificate,
            provenance=job.provenance,
            conditions=job.conditions,
            on_stage=on_stage,
        )
    except SemcalError as error:
        return _refuse(error)
    except MemoryError:
        what = f"not enough memory for a calibration from {counted(len(job.views), 'view')}"
        return _refuse(CalibrationError(what, do="use fewer views, or residual off"))
    held_out = [v for v in done.result.held_out_rms_px.values() if np.isfinite(v)]
    worst = f", held-out RMS up to {max(held_out):.3f} px" if held_out else ""
    low, high = done.calibration.magnification_range
    summary = (
        f"{job.options.method} calibration from {counted(len(done.collected.views), 'view')}, "
        f"{low:g}x to {high:g}x{worst}, in {time.monotonic() - started_s:.1f} s"
    )
    summary += f"; {judge_calibration(done.calibration).describe()}"
    notes = "".join(f"; {warning}" for warning in (*job.notes, *done.result.warnings))
    return JobResult(done.calibration.dumps(), summary + notes)


def serve(channel: Channel) -> None:
    """Receive one job; answer with its stages and finally with its result."""
    job: CalibrationJob = channel.receive()
    channel.send(_calibrate(job, lambda name, fraction: channel.send(Stage(name, fraction))))


def without_images(views: Sequence[FoundView]) -> tuple[FoundView, ...]:
    """Return the views without their pixels, which a calibration does not need."""
    nothing = np.zeros((1, 1), dtype=np.uint8)
    return tuple(replace(view, image=nothing) for view in views)


class CalibrationProcess:
    """One calibration; :meth:`run` waits for it and :meth:`cancel` ends it from another thread."""

    def __init__(self, job: CalibrationJob) -> None:
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
            return self._result(process, still_wanted, _Progress(on_progress))
        except ChildProcessEnded as error:
            text = "cancelled" if self._cancelled else _describe(error)
            return JobResult("", text, failed=True)
        finally:
            with self._lock:
                self._process = None
            process.close()

    @staticmethod
    def _result(
        process: ChildProcess, still_wanted: Callable[[], bool], progress: _Progress
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


class _Progress:
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


def _describe(error: ChildProcessEnded) -> str:
    """Say why there is no result, and what to do."""
    do = "call again"
    if error.status == -signal.SIGKILL:
        do = "call again; if nobody ended it, memory ran out: use fewer views, or residual off"
    elif error.status is None or error.status >= 0:
        do = "see the log of the node, and call again"
    return str(CalibrationError(f"the calibration process {error} without a result", do=do))
