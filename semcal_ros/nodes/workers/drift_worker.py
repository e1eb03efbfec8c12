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

"""The drift tracker in a separate process, for streams that must not wait for it.

A thread would hold the interpreter's lock, which the frames need.
"""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.estimates import DriftPredictor, DriftUpdate
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.errors import SemcalError
from semcal_ros.nodes.workers.child_process import Channel, ChildProcess, ChildProcessEnded

# A tenth of the weight of a live node (sched(7): each step is a factor of 1.25): the stream goes first.
_NICE = 10


@dataclass(frozen=True)
class Measurement:
    """The update from a frame, the predictor from then on, and the time that the measurement took, s."""

    update: DriftUpdate
    predictor: DriftPredictor
    cost_s: float


@dataclass(frozen=True)
class _Frame:
    """The arguments of :func:`measure_frame`."""

    image: NDArray[np.generic]
    camera: ScanCamera
    time_s: float
    timing: ScanTiming | None


def measure_frame(
    tracker: DriftTracker,
    image: NDArray[np.generic],
    camera: ScanCamera,
    time_s: float,
    timing: ScanTiming | None,
) -> Measurement:
    """Measure a frame in this process; raises as :meth:`DriftTracker.update`."""
    started_s = time.monotonic()
    update = tracker.update(image, time_s, camera, timing)
    return Measurement(update, tracker.predictor(), time.monotonic() - started_s)


class DriftProcess:
    """Holds a tracker in another process, which handles requests one after the other, in order of arrival.

    The process is started by the first request, which takes a second or two, and again by the first request after it
    has died. Futures raise what the tracker raised, or :class:`ChildProcessEnded` if the process has died; the
    tracker is lost then. After :meth:`close`, all futures raise that.
    """

    def __init__(self) -> None:
        self._queue = ThreadPoolExecutor(1, thread_name_prefix="drift")
        self._process: ChildProcess | None = None
        self._warming: Future[DriftTracker] | None = None
        self._ended = False

    def is_ready(self) -> bool:
        """Whether the process has begun to answer; the first call starts it."""
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
    ) -> Future[Measurement]:
        """Measure a frame, from now on with ``tracker``; None stands for the tracker that the process has."""
        frame = _Frame(image, camera, time_s, timing)
        return self._submit(tracker, frame)

    def fetch(self) -> Future[DriftTracker]:
        """Request the tracker in its state after all earlier requests."""
        return self._submit(None, None)

    def abandon(self) -> None:
        """Kill the process that does not answer; its futures raise, and the next request starts another one."""
        if self._process is not None:
            self._process.kill()

    def close(self) -> None:
        """End the process."""
        self._ended = True
        self._queue.shutdown(wait=False, cancel_futures=True)
        if self._process is not None:
            # This also ends requests that wait for an answer.
            self._process.kill()
        self._queue.shutdown(wait=True)
        if self._process is not None:
            self._process.close()

    def _submit(self, tracker: DriftTracker | None, frame: _Frame | None) -> Future[Any]:
        try:
            return self._queue.submit(self._ask, tracker, frame)
        except RuntimeError:
            if not self._ended:
                raise
            # A node that ends may still be at work on a frame.
            none: Future[Any] = Future()
            none.set_exception(ChildProcessEnded(None))
            return none

    def _ask(self, tracker: DriftTracker | None, frame: _Frame | None) -> Any:
        if self._process is None and not self._ended:
            self._process = ChildProcess(serve, _NICE)
        if self._process is None or self._ended:
            raise ChildProcessEnded(None)
        try:
            self._process.send((tracker, frame))
            answer = self._process.receive()
        except ChildProcessEnded:
            self._process.close()
            self._process = None
            self._warming = None
            raise
        if isinstance(answer, Exception):
            raise answer
        return answer


def serve(channel: Channel) -> None:
    """Answer requests until the node closes its end."""
    # The other processors are left to the stream.
    cv2.setNumThreads(1)
    held = DriftTracker()
    while True:
        tracker, frame = channel.receive()
        held = held if tracker is None else tracker
        answer: Any = held
        if frame is not None:
            try:
                answer = measure_frame(held, frame.image, frame.camera, frame.time_s, frame.timing)
            except (SemcalError, cv2.error) as error:
                answer = SemcalError(str(error))
        channel.send(answer)
