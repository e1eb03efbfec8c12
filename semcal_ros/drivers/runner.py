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

"""Runs a source in a thread of its own, so that nothing that it does can hold up a node."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from semcal_ros.core.errors import MicroscopeError, SemcalError, UnusableFrameError
from semcal_ros.drivers.source import FrameSource, SourceFrame

# How long one call of the source waits for a frame; ~/stop is noticed within this time.
_READ_S = 0.2
# A source that has gone away is tried again after these times. The last one repeats: a person who switches the
# microscope's server on again waits no longer than this.
_RETRY_S = (0.5, 1.0, 2.0, 5.0)
# Frames that wait for the node. More than two only make a live picture late; a source whose frames all count waits.
_WAITING = 2
# How long the end of the process waits for the source to let go.
_JOIN_S = 2.0


@dataclass(frozen=True)
class RunnerState:
    """What a source is doing.

    Attributes
    ----------
    phase
        ``stopped``, ``connecting``, ``open`` or ``lost``.
    reason
        Why it is lost; what it is connected with.
    silent_s
        Time since the last frame, or since it was opened.
    blocked_s
        How long the present call of the source has taken.
    skipped
        Frames that were overtaken by newer ones.
    """

    phase: str
    reason: str
    silent_s: float
    blocked_s: float
    skipped: int


class SourceRunner:
    """Opens, reads and reopens a source.

    Parameters
    ----------
    source
        The source; all of its methods of :class:`FrameSource` are called in one thread.
    wake
        Called from that thread whenever something has happened.
    """

    def __init__(self, source: FrameSource, wake: Callable[[], None]) -> None:
        self._source = source
        self._wake = wake
        self._changed = threading.Condition()
        self._frames: deque[SourceFrame] = deque()
        self._problems: deque[SemcalError] = deque(maxlen=100)
        self._wanted = False
        self._ended = False
        self._phase, self._reason = "stopped", ""
        self._skipped = 0
        self._worked = False
        self._since_s = self._called_s = time.monotonic()
        # A daemon: a call of a microscope that never returns must not keep the process alive.
        self._thread = threading.Thread(target=self._run, name="source", daemon=True)
        self._thread.start()

    # -- for the node ------------------------------------------------------------------------------

    def start(self) -> None:
        """Open the source, and keep it open."""
        with self._changed:
            self._wanted = True
            self._changed.notify_all()

    def stop(self) -> None:
        """Close the source as soon as its present call returns.

        Frames that wait are forgotten, unless each of them counts: those wait for the next start.
        """
        with self._changed:
            self._wanted = False
            if not self._source.lossless:
                self._frames.clear()
            self._changed.notify_all()

    @property
    def wanted(self) -> bool:
        """Whether the source is to be open."""
        return self._wanted

    def close(self) -> None:
        """End the thread, and the source with it."""
        with self._changed:
            self._wanted, self._ended = False, True
            self._changed.notify_all()
        self._thread.join(_JOIN_S)

    def take(self) -> SourceFrame | None:
        """Return the oldest frame that waits."""
        with self._changed:
            if not self._frames:
                return None
            self._changed.notify_all()
            return self._frames.popleft()

    @property
    def waiting(self) -> int:
        """Number of frames that wait."""
        return len(self._frames)

    def problems(self) -> list[SemcalError]:
        """Return what has gone wrong since the last call, oldest first."""
        with self._changed:
            found = list(self._problems)
            self._problems.clear()
        return found

    def state(self) -> RunnerState:
        """Return what the source is doing."""
        now_s = time.monotonic()
        with self._changed:
            return RunnerState(
                self._phase,
                self._reason,
                now_s - self._since_s,
                now_s - self._called_s,
                self._skipped,
            )

    # -- the thread --------------------------------------------------------------------------------

    def _run(self) -> None:
        failures = 0
        while self._wait_until_wanted():
            error = self._use()
            self._close()
            if error is None:
                self._enter("stopped", "")
                failures = 0
                continue
            # It worked for a while: what failed now may well work at once.
            failures = 0 if self._worked else failures + 1
            self._lose(error)
            self._pause(_RETRY_S[min(failures, len(_RETRY_S) - 1)])
        self._close()

    def _use(self) -> Exception | None:
        """Open the source and read until it is no longer wanted; returns why it has gone away."""
        self._worked = False
        try:
            self._enter("connecting", "")
            self._enter("open", self._source.open())
            while self._wanted:
                self._read()
        except Exception as error:
            # Libraries of makers raise what they like; whatever it is, the source is gone.
            return error
        return None

    def _wait_until_wanted(self) -> bool:
        with self._changed:
            while not (self._wanted or self._ended):
                if self._phase != "stopped":
                    self._phase, self._reason = "stopped", ""
                self._called_s = time.monotonic()
                self._changed.wait(1.0)
            return not self._ended

    def _enter(self, phase: str, reason: str) -> None:
        with self._changed:
            self._phase, self._reason = phase, reason
            self._since_s = self._called_s = time.monotonic()
        self._wake()

    def _read(self) -> None:
        self._called_s = time.monotonic()
        try:
            frame = self._source.read(_READ_S)
        except UnusableFrameError as error:
            self._note(error)
            return
        if frame is not None:
            self._worked = True
            self._hand_over(frame)

    def _hand_over(self, frame: SourceFrame) -> None:
        with self._changed:
            self._since_s = time.monotonic()
            if self._source.lossless:
                while len(self._frames) >= _WAITING and self._wanted:
                    # The node waits for subscribers, not the source for the microscope.
                    self._called_s = time.monotonic()
                    self._changed.wait(1.0)
            elif not self._wanted:
                return
            elif len(self._frames) >= _WAITING:
                self._frames.popleft()
                self._skipped += 1
            self._frames.append(frame)
        self._wake()

    def _note(self, error: SemcalError) -> None:
        with self._changed:
            self._problems.append(error)
        self._wake()

    def _lose(self, error: Exception) -> None:
        if not isinstance(error, SemcalError):
            text = " ".join(str(error).split()) or "no reason given"
            error = MicroscopeError(f"{type(error).__name__}: {text[:200]}")
        self._enter("lost", str(error))
        self._note(error)

    def _pause(self, seconds: float) -> None:
        until_s = time.monotonic() + seconds
        with self._changed:
            while self._wanted and (left_s := until_s - time.monotonic()) > 0.0:
                self._called_s = time.monotonic()
                self._changed.wait(left_s)

    def _close(self) -> None:
        self._called_s = time.monotonic()
        try:
            self._source.close()
        except Exception as error:
            self._note(MicroscopeError(f"the source does not close: {error}"))
