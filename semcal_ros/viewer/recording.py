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

"""A recording as the page shows it: any frame at once, corrected with what is known of the drift by then."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.drift.estimates import DriftEstimate, DriftUpdate
from semcal_ros.core.errors import InvalidValueError, SemcalError
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.core.wording import counted
from semcal_ros.files.recordings import RecordedFrame, Recording
from semcal_ros.viewer.measure import format_with_sigma
from semcal_ros.viewer.pictures import Outlines, outline
from semcal_ros.viewer.source import DriftPanel, Note, Rate, Status, Timeline, View
from semcal_ros.viewer.state import DriftTrace, describe_magnification, drift_in_pixels
from semcal_ros.workflows.follow_drift import DriftFollower, camera_for, start_time_s

# A frame that is further ahead is looked up; the frames up to it are read, as a video is.
_SKIPPED = 16
# Longest wait between two frames while playing: somebody who looks through a slow series does not want to wait.
_LONGEST_WAIT_S = 0.5
_IDLE_S = 1.0


class RecordingSource:
    """Reads the frames that are wanted, plays them, and follows the drift of all of them beside that.

    Parameters
    ----------
    open_it
        Opens the recording anew; each thread reads its own.
    calibration
        None: pictures are corrected for drift alone, on the nominal scale.
    config
        How the recording was read, with the display width of the calibration.
    drift
        Whether to follow the drift.

    Raises
    ------
    SemcalError
        The recording cannot be read, or has no usable frame.
    """

    def __init__(
        self,
        open_it: Callable[[], Recording],
        calibration: Calibration | None,
        config: MicroscopeConfig,
        *,
        drift: bool = True,
    ) -> None:
        self._open = open_it
        self._calibration = calibration
        self._config = config
        self._follows = drift
        self._rectifier = Rectifier()
        self._trace = DriftTrace()
        self._known: dict[int, DriftUpdate] = {}
        self._stamps: list[int] = []
        self._followed = 0
        self._complete = False
        self._problem = ""
        self._changed = threading.Condition()
        self._wanted = 0
        self._playing = self._ended = False
        self._renew = False
        self._view: View | None = None
        self._number = 0
        with open_it() as recording:
            self.name = recording.path.name or str(recording.path)
            self._count = recording.frame_count
            _, first = next(iter(recording.frames_from(0)), (0, None))
            if first is None:
                # It says what is the matter with the frames.
                next(iter(recording.frames()))
            assert first is not None
            self._notes = recording.notes
        self._first_ns = first.stamp_ns
        self._index = 0
        self._magnification = first.magnification
        self._threads = [
            threading.Thread(target=run, name=f"view-{name}", daemon=True)
            for name, run in (("frames", self._show_frames), ("drift", self._follow))
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """End both threads."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()

    # -- what the server asks --------------------------------------------------------------------------

    def watch(self, pages: int) -> None:
        """Stop to play when nobody looks."""
        if not pages:
            self._play(False)

    def newest(self) -> View | None:
        """Return the frame that is shown."""
        return self._view

    def overlay(self) -> NDArray[Any] | None:
        """Return None: nothing is calibrated here."""
        return None

    def act(self, action: str, value: float | tuple[float, ...] | None) -> str:
        """Play, pause, or go to the frame with the number ``value``."""
        if action == "seek" and isinstance(value, float):
            with self._changed:
                self._wanted = int(min(max(value, 0), self._count - 1))
                self._changed.notify_all()
            return f"frame {self._wanted + 1}"
        if action == "play":
            with self._changed:
                if self._index >= self._count - 1:
                    self._wanted = 0
            self._play(True)
            return "playing"
        if action == "pause":
            self._play(False)
            return "paused"
        raise InvalidValueError(f"{action!r} of a recording", expected="play, pause or seek")

    def _play(self, playing: bool) -> None:
        with self._changed:
            self._playing = playing
            self._changed.notify_all()

    def describe(self) -> Status:
        """Return where the recording stands."""
        stamps, view = self._stamps, self._view
        shown_ns = self._first_ns if view is None else view.stamp_ns
        duration_s = (max([shown_ns, *stamps[-1:]]) - self._first_ns) * 1e-9
        timeline = Timeline(
            self._count,
            self._index,
            (shown_ns - self._first_ns) * 1e-9,
            duration_s,
            self._playing,
        )
        return Status(
            title=self.name,
            kind="recording",
            magnification=describe_magnification(self._magnification, self._calibration),
            rates=self._describe_rate(),
            notes=self._describe_notes(),
            drift=self._describe_drift(),
            actions=("play", "pause", "seek"),
            timeline=timeline,
        )

    def _describe_rate(self) -> tuple[Rate, ...]:
        stamps = self._stamps[:]
        if len(stamps) < 2 or stamps[-1] <= stamps[0]:
            return ()
        return (Rate("as recorded", (len(stamps) - 1) / ((stamps[-1] - stamps[0]) * 1e-9)),)

    def _describe_notes(self) -> tuple[Note, ...]:
        notes = [Note("warn", "recording", text) for text in self._notes]
        if self._problem:
            notes.insert(0, Note("error", "recording", self._problem))
        if self._calibration is None:
            text = "there is no calibration: lengths are nominal, and the distortion stays"
            notes.append(Note("warn", "recording", text, "give one by --calibration"))
        if self._complete:
            text = (
                "all frames were read" if not self._follows else "the drift of all frames is known"
            )
            notes.append(Note("ok", "recording", text))
        elif self._follows:
            text = (
                f"the drift is known of {self._followed} of {counted(self._count, 'frame')} so far"
            )
            notes.append(Note("ok", "recording", text, "later frames are shown with their drift"))
        return tuple(notes)

    def _describe_drift(self) -> DriftPanel:
        """The way of all frames, and the drift of the one that is shown."""
        panel = self._trace.panel("not followed" if not self._follows else "not known yet")
        shown = self._known.get(self._index)
        if shown is None:
            return replace(panel, text="not known yet") if self._follows else panel
        x_m, y_m = (float(v) for v in shown.drift_m)
        text = f"{format_with_sigma(math.hypot(x_m, y_m), _sigma_m(shown))} since the first frame"
        return replace(panel, text=text, at_nm=(1e9 * x_m, 1e9 * y_m))

    # -- frames ------------------------------------------------------------------------------------------

    def _show_frames(self) -> None:
        try:
            with self._open() as recording:
                self._serve(recording)
        except SemcalError as error:
            self._problem = " ".join(str(error).split())

    def _serve(self, recording: Recording) -> None:
        frames: Iterator[tuple[int, RecordedFrame]] = iter(())
        following = -1  # number of the frame that the iterator gives next; -1: it gives none
        current: RecordedFrame | None = None
        shown = -1
        due_s, due_ns = 0.0, 0
        while True:
            with self._changed:
                while not self._ended and self._wanted == shown and not self._playing:
                    if self._renew and current is not None:
                        break
                    self._changed.wait(_IDLE_S)
                if self._ended:
                    return
                asked = wanted = self._wanted
                playing = self._playing
                renew, self._renew = self._renew, False
            if wanted == shown and not playing:
                if renew and current is not None:
                    self._show(shown, current)
                continue
            if wanted == shown:
                wanted = shown + 1
                if wanted >= self._count:
                    self._play(False)
                    continue
            if not 0 <= wanted - following <= _SKIPPED or following < 0:
                frames = recording.frames_from(wanted)
            number, found = next(((n, f) for n, f in frames if n >= wanted), (self._count, None))
            following = number + 1 if found is not None else -1
            if found is None:
                # The last images are damaged, or missing.
                with self._changed:
                    self._count = max(1, wanted)
                    self._playing = False
                    self._wanted = min(self._wanted, self._count - 1)
                continue
            if playing and current is not None and number > shown >= 0:
                step_s = min(max((found.stamp_ns - due_ns) * 1e-9, 0.0), _LONGEST_WAIT_S)
                due_s = max(due_s + step_s, time.monotonic() - _LONGEST_WAIT_S)
                self._wait_until(due_s, asked)
            else:
                due_s = time.monotonic()
            due_ns = found.stamp_ns
            # Somebody may have gone elsewhere meanwhile.
            with self._changed:
                if self._wanted != asked:
                    continue
                self._wanted = number
            shown, current = number, found
            self._show(number, found)

    def _wait_until(self, due_s: float, asked: int) -> None:
        """Wait for a moment of the monotonic clock, or until another frame is wanted, or none."""
        with self._changed:
            while not self._ended and self._playing and self._wanted == asked:
                left_s = due_s - time.monotonic()
                if left_s <= 0.0:
                    return
                self._changed.wait(left_s)

    def _show(self, index: int, frame: RecordedFrame) -> None:
        try:
            camera = camera_for(frame, self._calibration, self._config)
            estimate = self._known.get(index)
            # What is not known yet is not corrected; the picture is shown again when it is.
            raster = None if estimate is None else estimate.raster
            corrected = self._rectifier.rectify(frame.image, camera, raster, self._config.scan)
        except SemcalError as error:
            self._problem = f"frame {index + 1}: {error}"
            return
        notes: dict[str, object] = {"recording": self.name, "frame": index}
        drift_px: tuple[float, float] | None = None
        moving: Outlines = ()
        if estimate is not None:
            moving = _outline_moving(estimate, corrected)
            drift_px = drift_in_pixels(camera, estimate.drift_m)
            notes.update(drift_x_m=float(estimate.drift_m[0]), drift_y_m=float(estimate.drift_m[1]))
        pictures = {"raw": frame.image, "corrected": corrected}
        if frame.encoding.startswith("rgb"):
            pictures = {name: image[..., ::-1] for name, image in pictures.items()}
        self._number += 1
        self._index, self._magnification = index, frame.magnification
        self._view = View(
            self._number,
            frame.stamp_ns,
            pictures,
            camera,
            self._calibration is not None,
            drift_px,
            frame.file_name or f"frame {index + 1}",
            notes,
            moving,
        )

    # -- drift -------------------------------------------------------------------------------------------

    def _follow(self) -> None:
        follower = DriftFollower(hindsight=False, follow=self._config.follow)
        # The recording was readable; what is damaged further on is told by the other thread.
        with suppress(SemcalError), self._open() as recording:
            for number, frame in recording.frames_from(0):
                if self._ended:
                    return
                self._stamps.append(frame.stamp_ns)
                if self._follows:
                    self._follow_one(follower, number, frame)
        self._complete = True

    def _follow_one(self, follower: DriftFollower, number: int, frame: RecordedFrame) -> None:
        camera = camera_for(frame, self._calibration, self._config)
        time_s = start_time_s(frame, self._first_ns, self._config)
        update = follower.update(frame, time_s, camera, self._config.scan)
        self._known[number] = update
        self._followed += 1
        x_m, y_m = (float(v) for v in update.drift_m)
        self._trace.add(frame.stamp_ns, x_m, y_m, _sigma_m(update))
        if number == self._index:
            with self._changed:
                self._renew = True
                self._changed.notify_all()


def _outline_moving(update: DriftUpdate, corrected: NDArray[Any]) -> Outlines:
    """Outlines of what did not move with the specimen, in the corrected picture."""
    if update.moving is None and update.fixed is None:
        return ()
    height, width = corrected.shape[:2]
    return outline(update.draw_apart((width, height)))


def _sigma_m(estimate: DriftEstimate) -> float:
    """1-sigma of a drift along its worse direction."""
    block = estimate.covariance[:2, :2]
    if not np.all(np.isfinite(block)):
        return math.inf
    return math.sqrt(max(float(np.linalg.eigvalsh(block)[-1]), 0.0))
