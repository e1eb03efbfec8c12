"""A calibration in a process of its own, so that the stream goes on and a stop need not wait for it."""

from __future__ import annotations

import contextlib
import json
import os
import pickle
import select
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import IO

from semcal_ros.core.errors import CalibrationError
from semcal_ros.nodes.workers.calibration_worker import CalibrationJob, JobResult, Stage

__all__ = ["CalibrationProcess"]

_POLL_S = 0.1
_OFTEN_S, _SELDOM_S = 0.2, 1.0
# A third of the weight of a live node, where both want the same processor: those keep up, and it still gets on.
_NICE = 5
# The matrices are small; threads would only take the other processors from the live nodes.
_ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OPENBLAS", "OMP", "MKL")}
# By name and not as a script, so that both sides pickle the same classes.
_COMMAND = "from semcal_ros.nodes.workers.calibration_worker import serve; serve()"


class CalibrationProcess:
    """One calibration; :meth:`run` waits for it and :meth:`cancel` ends it from another thread."""

    def __init__(self, job: CalibrationJob) -> None:
        self.job = job
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None
        self._cancelled = False
        self._started_s = time.monotonic()

    @property
    def elapsed_s(self) -> float:
        """Seconds since it was made."""
        return time.monotonic() - self._started_s

    def cancel(self) -> None:
        """End it at once; a run that has not begun will not begin."""
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
            Asked some times a second; with False the calibration is given up.
        on_progress
            Called with the stage when that changes, though at most five times a second, and once a second anyway.
        """
        with self._lock:
            if self._cancelled:
                return JobResult("", "cancelled", failed=True)
            process = self._process = _started()
        # Not here: it reads when it has imported what it needs, and may be ended before.
        feeder = threading.Thread(target=_send, args=(self.job, process))
        feeder.start()
        try:
            progress = _Progress(on_progress)
            lines = _Lines(process)
            while not lines.ended:
                if not still_wanted():
                    return JobResult("", "stopped", failed=True)
                for line in lines.wait(_POLL_S):
                    answer = json.loads(line)
                    if "text" in answer:
                        return JobResult(**answer)
                    progress.take(Stage(**answer))
                progress.tick()
            status = process.wait()
            return JobResult("", "cancelled" if self._cancelled else _end(status), failed=True)
        finally:
            process.kill()
            process.wait()
            feeder.join()
            for pipe in (process.stdin, process.stdout):
                with contextlib.suppress(BrokenPipeError):
                    _pipe(pipe).close()


class _Progress:
    """Hands on stages at a bounded rate; the fraction never goes back, even where work begins anew."""

    def __init__(self, on_progress: Callable[[Stage], None]) -> None:
        self._on_progress = on_progress
        self._told: Stage | None = None
        self._told_s = -_SELDOM_S
        self._stage = Stage("start", 0.0)

    def take(self, stage: Stage) -> None:
        self._stage = replace(stage, fraction=max(stage.fraction, self._stage.fraction))

    def tick(self) -> None:
        now_s = time.monotonic()
        if now_s - self._told_s >= (_SELDOM_S if self._stage == self._told else _OFTEN_S):
            self._told, self._told_s = self._stage, now_s
            self._on_progress(self._stage)


def _started() -> subprocess.Popen[bytes]:
    # A session of its own: Ctrl-C is for the node, which decides what becomes of this process.
    process = subprocess.Popen(
        [sys.executable, "-c", _COMMAND],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, **_ONE_THREAD},
        start_new_session=True,
    )
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, process.pid, _NICE)
    # Where the scheduler groups processes by session, priorities count inside of each group only (sched(7)).
    with contextlib.suppress(OSError):
        Path(f"/proc/{process.pid}/autogroup").write_text(str(_NICE), encoding="ascii")
    return process


def _pipe(pipe: IO[bytes] | None) -> IO[bytes]:
    if pipe is None:
        raise RuntimeError("a process without its pipes")
    return pipe


def _send(job: CalibrationJob, process: subprocess.Popen[bytes]) -> None:
    # Not closed: the end of stdin tells the process that nobody waits for it any more. If it has ended itself, its
    # exit status says so.
    with contextlib.suppress(BrokenPipeError):
        pickle.dump(job, _pipe(process.stdin))
        _pipe(process.stdin).flush()


class _Lines:
    """Complete lines from the stdout of a process."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._descriptor = _pipe(process.stdout).fileno()
        self._poll = select.poll()
        self._poll.register(self._descriptor, select.POLLIN)
        self._rest = b""
        self.ended = False

    def wait(self, seconds: float) -> list[bytes]:
        if not self._poll.poll(1e3 * seconds):
            return []
        data = os.read(self._descriptor, 1 << 16)
        self.ended = not data
        *lines, self._rest = (self._rest + data).split(b"\n")
        return lines


def _end(status: int) -> str:
    """Why there is no result, from the exit status."""
    if status >= 0:
        how, do = f"ended with status {status}", "look into the log of the node, and call again"
    else:
        how, do = f"was ended by {signal.Signals(-status).name}", "call again"
    if status == -signal.SIGKILL:
        do = "call again; if nobody ended it, memory ran out: use fewer views, or residual off"
    return str(CalibrationError(f"the calibration process {how} without a result", do=do))
