"""What the process of a calibration does; it imports no ROS."""

from __future__ import annotations

import json
import os
import pickle
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from semcal_ros.core.errors import CalibrationError, SemcalError
from semcal_ros.workflows.calibrate import calibrate_found
from semcal_ros.workflows.find_grid import FoundView

__all__ = ["CalibrationJob", "JobResult", "Stage", "serve", "without_images"]

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
class Stage:
    """What a calibration is at, and the fraction of the work that is done."""

    name: str
    fraction: float


@dataclass(frozen=True)
class JobResult:
    """The text of the calibration file and a summary, or the reason why there is none."""

    text: str
    summary: str
    failed: bool = False


def _refused(error: SemcalError) -> JobResult:
    return JobResult("", str(error), failed=True)


def _calibrate(job: CalibrationJob, on_stage: Callable[[str, float], None]) -> JobResult:
    started_s = time.monotonic()
    try:
        done = calibrate_found(
            job.views,
            (),
            display_width_m=job.display_width_m,
            squares_m=job.squares_m,
            method=job.method,
            residual=job.residual,
            on_stage=on_stage,
        )
    except SemcalError as error:
        return _refused(error)
    except MemoryError:
        what = f"not enough memory for a calibration from {len(job.views)} views"
        return _refused(CalibrationError(what, do="use fewer views, or residual off"))
    except _NUMERIC as error:
        reason = CalibrationError(
            f"views that cannot be solved for ({type(error).__name__}: {error})",
            expected="views of a grid from different directions",
            do="add tilted views",
        )
        return _refused(reason)
    held_out = [v for v in done.result.held_out_rms_px.values() if np.isfinite(v)]
    worst = f", held-out RMS up to {max(held_out):.3f} px" if held_out else ""
    low, high = done.calibration.magnification_range
    summary = (
        f"{job.method} calibration from {len(done.collected.views)} views, {low:g}x to {high:g}x{worst}"
        f", in {time.monotonic() - started_s:.1f} s"
    )
    notes = "".join(f"; {warning}" for warning in done.result.warnings)
    return JobResult(done.calibration.dumps(), summary + notes)


def _end_with_the_node() -> None:
    # The node holds the other end open for as long as it lives, however it ends.
    # Not through sys.stdin, whose lock would be missing at the end of the interpreter.
    os.read(sys.stdin.fileno(), 1)
    os._exit(1)


def serve() -> None:
    """Read one pickled job from stdin; write stages and at last the result to stdout, one JSON object per line."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    # Whatever else prints shall not get among the answers.
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    job: CalibrationJob = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_end_with_the_node, daemon=True).start()

    def tell(answer: Stage | JobResult) -> None:
        print(json.dumps(asdict(answer)), file=answers, flush=True)

    tell(_calibrate(job, lambda name, fraction: tell(Stage(name, fraction))))


def without_images(views: Sequence[FoundView]) -> tuple[FoundView, ...]:
    """The views with their pixels left out, which a calibration does not need."""
    nothing = np.zeros((1, 1), dtype=np.uint8)
    return tuple(FoundView(v.name, v.magnification, nothing, v.detection) for v in views)
