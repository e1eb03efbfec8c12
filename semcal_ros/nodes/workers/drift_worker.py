"""The drift tracker in a process of its own, for streams that must not wait for it.

A thread would do its work under the interpreter's lock, which the frames need.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import IO, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.tracker import DriftPredictor, DriftTracker, DriftUpdate
from semcal_ros.core.errors import SemcalError

__all__ = ["DriftProcess", "Measured", "measured", "serve"]

# By name and not as a script, so that both sides pickle the same classes; this imports no ROS.
_COMMAND = "from semcal_ros.nodes.workers.drift_worker import serve; serve()"
_ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OPENBLAS", "OMP", "MKL")}
_NICE = 10
_END_S = 2.0


@dataclass(frozen=True)
class Measured:
    """What a frame told, what is to be expected from then on, and the time that it took."""

    update: DriftUpdate
    outlook: DriftPredictor
    cost_s: float


@dataclass(frozen=True)
class _Frame:
    """What :func:`measured` takes."""

    image: NDArray[np.generic]
    camera: ScanCamera
    time_s: float
    timing: ScanTiming | None


def measured(
    tracker: DriftTracker,
    image: NDArray[np.generic],
    camera: ScanCamera,
    time_s: float,
    timing: ScanTiming | None,
) -> Measured:
    """Measure a frame here and now; raises as :meth:`DriftTracker.update`."""
    started_s = time.monotonic()
    update = tracker.update(image, time_s, camera, timing)
    return Measured(update, tracker.outlook(), time.monotonic() - started_s)


class DriftProcess:
    """Holds a tracker elsewhere; requests are worked on one after the other, in the order in which they came.

    The process is started with the first request, which takes a second or two, and anew after one that failed for want
    of it. It ends with this one, however that ends. Futures raise what the tracker raised, or :class:`OSError`,
    :class:`EOFError` or :class:`pickle.PickleError` if the process has died; the tracker is lost then.
    """

    def __init__(self) -> None:
        self._queue = ThreadPoolExecutor(1, thread_name_prefix="drift")
        self._process: subprocess.Popen[bytes] | None = None
        self._warming: Future[DriftTracker] | None = None
        self._ended = False

    def is_ready(self) -> bool:
        """Whether the process has begun to answer; with the first question it is started."""
        if self._warming is None:
            self._warming = self.fetch()
        return self._warming.done() and self._warming.exception() is None

    def measure(
        self,
        tracker: DriftTracker | None,
        image: NDArray[np.generic],
        camera: ScanCamera,
        time_s: float,
        timing: ScanTiming | None,
    ) -> Future[Measured]:
        """Measure a frame, with ``tracker`` from now on if there is one, else with the one that is there."""
        frame = _Frame(image, camera, time_s, timing)
        return self._queue.submit(self._ask, tracker, frame)

    def fetch(self) -> Future[DriftTracker]:
        """The tracker as it is after everything before."""
        return self._queue.submit(self._ask, None, None)

    def close(self) -> None:
        """End the process."""
        self._ended = True
        self._queue.shutdown(wait=False, cancel_futures=True)
        process = self._process
        if process is not None:
            process.kill()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_END_S)

    def _ask(self, tracker: DriftTracker | None, frame: _Frame | None) -> Any:
        process = self._running()
        stdin, stdout = process.stdin, process.stdout
        assert stdin is not None and stdout is not None
        try:
            pickle.dump((tracker, frame), stdin, protocol=pickle.HIGHEST_PROTOCOL)
            stdin.flush()
            answer = pickle.load(stdout)
        except (OSError, EOFError, pickle.PickleError):
            process.kill()
            process.wait()
            self._process = None
            self._warming = None
            raise
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _running(self) -> subprocess.Popen[bytes]:
        if self._ended:
            raise EOFError("the node has ended")
        if self._process is None:
            # Without the node its input ends, and so does it.
            self._process = subprocess.Popen(
                [sys.executable, "-c", _COMMAND],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=os.environ | _ONE_THREAD,
            )
        return self._process


def serve() -> None:
    """Answer requests on stdin until it ends."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    # What libraries print must not get in between.
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    # Ctrl-C is for the node.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # The stream goes first, and has the other processors.
    os.nice(_NICE)
    cv2.setNumThreads(1)
    _answer_all(sys.stdin.buffer, answers)


def _answer_all(requests: IO[bytes], answers: IO[bytes]) -> None:
    held = DriftTracker()
    while True:
        try:
            tracker, frame = pickle.load(requests)
        except EOFError:
            return
        held = held if tracker is None else tracker
        answer: Any = held
        if frame is not None:
            try:
                answer = measured(held, frame.image, frame.camera, frame.time_s, frame.timing)
            except (SemcalError, cv2.error) as error:
                answer = SemcalError(str(error))
        try:
            pickle.dump(answer, answers, protocol=pickle.HIGHEST_PROTOCOL)
            answers.flush()
        except BrokenPipeError:
            return
