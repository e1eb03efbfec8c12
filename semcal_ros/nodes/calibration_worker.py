"""A calibration in a process of its own, so that the stream goes on and a stop need not wait for it."""

from __future__ import annotations

import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.errors import CalibrationError, SemcalError
from semcal_ros.pipeline import FoundView, calibrate_found

__all__ = ["CalibrationJob", "JobResult", "run_job", "serve", "without_images"]

_POLL_S = 0.1
# By name and not as a script, so that both sides pickle the same classes; this imports no ROS.
_COMMAND = "from semcal_ros.nodes.calibration_worker import serve; serve()"
# What numerics raise on degenerate views.
_NUMERIC = (ArithmeticError, ValueError, np.linalg.LinAlgError)


@dataclass(frozen=True)
class CalibrationJob:
    """Everything that a calibration needs; the images of the views are not among it."""

    views: tuple[FoundView, ...]
    display_width_m: float
    squares_m: tuple[float, ...]
    method: str
    residual: str


@dataclass(frozen=True)
class JobResult:
    """The text of the calibration file and a summary, or the reason why there is none."""

    text: str
    summary: str
    failed: bool = False


def _calibrate(job: CalibrationJob) -> JobResult:
    started_s = time.monotonic()
    try:
        done = calibrate_found(
            job.views,
            (),
            display_width_m=job.display_width_m,
            squares_m=job.squares_m,
            method=job.method,
            residual=job.residual,
        )
    except SemcalError as error:
        return JobResult("", str(error), failed=True)
    except _NUMERIC as error:
        reason = CalibrationError(
            f"views that cannot be solved for ({type(error).__name__}: {error})",
            expected="views of a grid from different directions",
            do="add tilted views",
        )
        return JobResult("", str(reason), failed=True)
    held_out = [v for v in done.result.held_out_rms_px.values() if np.isfinite(v)]
    worst = f", held-out RMS up to {max(held_out):.3f} px" if held_out else ""
    low, high = done.calibration.magnification_range
    summary = (
        f"{job.method} calibration from {len(done.collected.views)} views, {low:g}x to {high:g}x{worst}"
        f", in {time.monotonic() - started_s:.1f} s"
    )
    notes = "".join(f"; {warning}" for warning in done.result.warnings)
    return JobResult(done.calibration.dumps(), summary + notes)


def serve() -> None:
    """Read one job from stdin and write its result to stdout, both pickled."""
    job: CalibrationJob = pickle.load(sys.stdin.buffer)
    sys.stdout.buffer.write(pickle.dumps(_calibrate(job)))


def run_job(job: CalibrationJob, still_wanted: Callable[[], bool]) -> JobResult:
    """Calibrate in a new process and wait for it; it is ended when the result is no longer wanted."""
    with tempfile.TemporaryFile() as stdin:
        # Not through a pipe: communicate() with a timeout stops feeding one that was once full.
        pickle.dump(job, stdin)
        stdin.seek(0)
        # A session of its own: Ctrl-C is for the node, which decides what becomes of this process.
        process = subprocess.Popen(
            [sys.executable, "-c", _COMMAND],
            stdin=stdin,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
    try:
        while still_wanted():
            try:
                answer, _ = process.communicate(timeout=_POLL_S)
            except subprocess.TimeoutExpired:
                continue
            return _result_of(answer, process.returncode)
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()
    return JobResult("", "stopped", failed=True)


def _result_of(answer: bytes, status: int) -> JobResult:
    if status != 0:
        reason = f"the calibration process ended with status {status}"
        return JobResult("", reason, failed=True)
    result: JobResult = pickle.loads(answer)
    return result


def without_images(views: Sequence[FoundView]) -> tuple[FoundView, ...]:
    """The views with their pixels left out, which a calibration does not need."""
    nothing = np.zeros((1, 1), dtype=np.uint8)
    return tuple(FoundView(v.name, v.magnification, nothing, v.detection) for v in views)
