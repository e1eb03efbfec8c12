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

"""The node behind ``semcal acquire``: a calibration server that begins at once, tells its progress, saves, and ends."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Sequence

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.executors import ExternalShutdownException

from semcal_ros.calibration import Calibration
from semcal_ros.core.errors import MicroscopeError
from semcal_ros.core.wording import counted, group_by_kind
from semcal_ros.nodes.acquisition.run import Progress
from semcal_ros.nodes.calibration_server import CalibrationServer
from semcal_ros.nodes.common.reporter import NODE_ERRORS
from semcal_ros.nodes.common.run import run_node

# As long as a slow scan may take, and the middleware to find a microscope; after a few seconds the wait is said.
_FIRST_PICTURE_S, _QUIET_S = 60.0, 3.0
_POLL_S = 0.1
# What missed the target or failed, and what a signal ended, as shells tell SIGINT.
_MISSED, _INTERRUPTED = 1, 130


class _Acquirer(CalibrationServer):
    def __init__(self, say: Callable[[str], None], ask: Callable[[str], None]) -> None:
        super().__init__()
        self._told_end = False
        # Held while the first line is said, which tells where the recording is.
        self._begins = threading.Lock()
        self._say = say
        self._ask = ask
        self._ended = self._interrupted = False
        self.exit_status = _MISSED
        self._timer = self.create_timer(
            _POLL_S, self._end_if_done, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self._driver = threading.Thread(target=self._drive, daemon=True)
        self._driver.start()

    def _end_if_done(self) -> None:
        if self._ended:
            # Once: what a second thread raised nobody would hear.
            self._timer.cancel()
            raise ExternalShutdownException

    def destroy_node(self) -> None:
        """Extend the base class: say how to go on with what Ctrl-C has interrupted, now that it is on the disk."""
        if not self._ended:
            # Before the acquisition ends: the thread that follows it leaves the last word to this one.
            self._interrupted = True
            self.exit_status = _INTERRUPTED
        super().destroy_node()
        self._tell_end()

    def _tell_end(self) -> None:
        if self._told_end or self.acquisition.recording is None:
            return
        self._told_end = True
        if self.acquisition.progress.state == "done":
            self._say(f"all pictures: {self.acquisition.recording}")
        elif self.acquisition.recording.exists():
            views = counted(self.acquisition.progress.views, self.acquisition.unit)
            self._say(
                f"ended with {views}; the same command with --resume {self.acquisition.recording} goes on"
            )

    def _tell_doubts(self, calibration: Calibration) -> None:
        """Say on stderr what `semcal calibrate` would say of the same views."""
        rejected = calibration.statistics.get("rejected_views")
        extended = self.parameters["extend_to"] > 0.0
        if isinstance(rejected, int) and rejected > 0 and not extended:
            named = (
                f"; `semcal calibrate {self.acquisition.recording}` names "
                + ("it" if rejected == 1 else "them")
                if self.acquisition.recording is not None
                else ""
            )
            print(f"rejected: {counted(rejected, 'view')}{named}", file=sys.stderr)
        for text in group_by_kind(calibration.warnings):
            print(f"warning: {text}", file=sys.stderr)

    def show(self, progress: Progress) -> None:
        """Extend the base class: also on the terminal."""
        super().show(progress)
        with self._begins:
            pass
        if progress.state != "waiting":
            self._say(f"{progress.views}/{progress.planned}: {progress.text}")

    def _drive(self) -> None:
        try:
            self._begin_acquisition()
            self._follow()
        except NODE_ERRORS as error:
            print("semcal:", *str(error).split(), file=sys.stderr)
        finally:
            self._ended = True

    def _begin_acquisition(self) -> None:
        start_s, said = time.monotonic(), False
        while not self.has_picture:
            waited_s = time.monotonic() - start_s
            if waited_s > _QUIET_S and not said:
                said = True
                topic = self.resolve_topic_name("image_raw")
                self._say(
                    f"waiting for pictures on {topic} and their magnification, for up to {_FIRST_PICTURE_S:g} s"
                )
            if waited_s > _FIRST_PICTURE_S:
                raise MicroscopeError(
                    f"no picture with a known magnification for {_FIRST_PICTURE_S:g} s",
                    do="check that the microscope publishes, by `semcal doctor`",
                )
            time.sleep(_POLL_S)
        with self._begins:
            self._say(
                self.acquisition.extend()
                if self.parameters["extend_to"] > 0.0
                else self.acquisition.acquire()
            )

    def _follow(self) -> None:
        asked = ""
        while self.acquisition.is_running:
            progress = self.acquisition.progress
            if progress.state == "waiting" and progress.text != asked:
                asked = progress.text
                self._ask(f"{progress.views}/{progress.planned}: {progress.text}, then press Enter")
                try:
                    self.add_view()
                except NODE_ERRORS as error:
                    self._say(f"not taken: {error}")
                    asked = ""
            time.sleep(_POLL_S)
        if self._interrupted:
            return
        progress = self.acquisition.progress
        self._say(progress.text)
        self._tell_end()
        if self.has_calibration:
            self._say(self.save())
            self._tell_doubts(self.base_calibration())
        if self.acquisition.reached:
            self.exit_status = 0


def run_acquisition(
    args: Sequence[str], say: Callable[[str], None], ask: Callable[[str], None]
) -> int:
    """Run the node.

    Parameters
    ----------
    args
        ROS arguments of the node ``calibration_server``.
    say
        Called with each line of progress.
    ask
        Called with what a person has to do; returns when that is done.

    Returns
    -------
    Exit status: 0 if the target is met, 1 if not, 2 if the node cannot start, 130 after Ctrl-C.
    """
    return run_node(lambda: _Acquirer(say, ask), args, threads=_Acquirer.threads)
