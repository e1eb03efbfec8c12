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

"""The frames of one magnification in a recording, and their drift."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, NoReturn

import numpy as np

from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.estimates import DriftPath
from semcal_ros.core.errors import BagError
from semcal_ros.files.recordings import RecordedFrame, Recording
from semcal_ros.workflows.follow_drift import (
    DriftFollower,
    camera_for,
    estimate_timing,
    start_time_s,
)
from semcal_ros.workflows.inputs import OnProgress, count_frames, ignore_progress

# Magnifications that an error lists: as many as fit two lines of a terminal.
_LISTED = 12
# Grey levels of more than 8 bits are shown with these quantiles as black and white: one pixel in a
# thousand may be clipped at either end.
_BLACK_WHITE = (0.001, 0.999)
# Step between the pixels of a row and between the rows that are used for an image's quantiles.
_SPARSE = 4


@dataclass(frozen=True, eq=False)
class FrameSelection:
    """The n frames of one magnification, size and encoding in a recording, and their drift.

    Attributes
    ----------
    config
        The configuration that was used; its ``scan`` may have been estimated from the drift.
    camera
        Camera of the first frame.
    dtype, size
        Type of the grey levels; (width, height) in px.
    indices
        n numbers of the frames as the recording gives them.
    stamps_ns
        n header stamps, ns since 1970.
    times_s
        n starts of their acquisitions, s after the first stamp.
    levels
        n pairs of grey levels that are shown as black and white; empty where not asked for.
    other_kind
        Number of frames of the magnification that have another size or encoding.
    path
        Drift of the frames; None where it is not wanted.
    states
        Number of frames by the kind of drift known live, the most frequent first.
    timing_note
        Note on a scan timing that is not configured; may be empty.
    """

    config: MicroscopeConfig
    camera: ScanCamera
    dtype: np.dtype[Any]
    size: tuple[int, int]
    indices: tuple[int, ...]
    stamps_ns: tuple[int, ...]
    times_s: tuple[float, ...]
    levels: tuple[tuple[float, float], ...]
    other_kind: int
    path: DriftPath | None
    states: dict[str, int]
    timing_note: str = ""


def select_frames(
    opened: Recording,
    config: MicroscopeConfig,
    calibration: Calibration | None,
    *,
    at: float | None = None,
    drift: bool = True,
    levels: bool = False,
    on_first: Callable[[RecordedFrame], object] = lambda _frame: None,
    on_progress: OnProgress = ignore_progress,
) -> FrameSelection:
    """Read a recording for the first time: choose its frames and track their drift.

    Where the configuration has no scan timing and the drift shows it, the frames are tracked once
    more with it.

    Parameters
    ----------
    opened
        The recording.
    config
        How to read it.
    calibration
        The calibration; None for nominal cameras.
    at
        The magnification to choose; None where the recording must have only one.
    drift
        Whether to track the frames.
    levels
        Whether black and white are wanted.
    on_first
        Called with the first chosen frame, to refuse it before any work is done.
    on_progress
        Called with the stage, the number of frames done, and that of all frames.

    Raises
    ------
    BagError
        There are several magnifications and none is chosen, the chosen one is not there, or time
        runs backwards.
    """
    reading = _Reading(opened, config, calibration, at, drift, levels)
    taken, selection = reading.run(on_first, on_progress)
    if taken.follower is None:
        return selection
    timed, note = estimate_timing(config, taken.follower, calibration)
    if timed is not config:
        _, selection = replace(reading, config=timed).run(on_first, on_progress)
    return replace(selection, timing_note=note)


@dataclass
class _Taken:
    """Frames that were taken so far."""

    follower: DriftFollower | None
    frames: list[tuple[int, int, float]] = field(default_factory=list)  # index, stamp, start
    levels: list[tuple[float, float]] = field(default_factory=list)
    other_kind: int = 0


@dataclass(frozen=True)
class _Reading:
    """One reading of a recording."""

    opened: Recording
    config: MicroscopeConfig
    calibration: Calibration | None
    at: float | None
    drift: bool
    levels: bool

    def run(
        self,
        on_first: Callable[[RecordedFrame], object],
        on_progress: OnProgress,
    ) -> tuple[_Taken, FrameSelection]:
        counts: Counter[str] = Counter()
        wanted = None if self.at is None else _format_magnification(self.at)
        follow = self.opened.config.follow
        taken = _Taken(DriftFollower(follow=follow) if self.drift else None)
        first: RecordedFrame | None = None
        stage = "drift" if self.drift else "reading"
        advance = count_frames(on_progress, stage, self.opened.frame_count)
        for index, frame in enumerate(self.opened.frames()):
            advance(1)
            label = _format_magnification(frame.magnification)
            counts[label] += 1
            if label != (wanted or label) or (wanted is None and len(counts) > 1):
                continue  # the frame will be refused or ignored: only the magnification matters
            if first is None:
                on_first(frame)
                first = frame
            if _get_kind(frame) != _get_kind(first):
                taken.other_kind += 1
                continue
            self._take(taken, index, frame, first)
        if first is None or (wanted is None and len(counts) > 1):
            self._refuse_magnifications(counts)
        if self.drift:
            on_progress("smoothing", 0, None)
        return taken, self._select(taken, first)

    def _take(self, taken: _Taken, index: int, frame: RecordedFrame, first: RecordedFrame) -> None:
        time_s = start_time_s(frame, first.stamp_ns, self.config)
        if taken.frames and time_s < taken.frames[-1][2]:
            raise BagError(
                f"image {index + 1} was taken {taken.frames[-1][2] - time_s:g} s before the "
                "previous one",
                expected="images in the order of time",
                do="record each pass of a replay to a recording of its own",
            )
        taken.frames.append((index, frame.stamp_ns, time_s))
        if taken.follower is not None:
            camera = camera_for(frame, self.calibration, self.config)
            taken.follower.update(frame, time_s, camera, self.config.scan)
        if self.levels:
            taken.levels.append(_estimate_black_white(frame))

    def _select(self, taken: _Taken, first: RecordedFrame) -> FrameSelection:
        height, width = first.image.shape[:2]
        follower = taken.follower
        indices, stamps_ns, times_s = zip(*taken.frames, strict=True)
        kinds = Counter(update.kind for update in follower.updates) if follower else Counter()
        return FrameSelection(
            config=self.config,
            camera=camera_for(first, self.calibration, self.config),
            dtype=first.image.dtype,
            size=(width, height),
            indices=indices,
            stamps_ns=stamps_ns,
            times_s=times_s,
            levels=tuple(taken.levels),
            other_kind=taken.other_kind,
            path=None if follower is None else follower.path(live=False),
            states=dict(kinds.most_common()),
        )

    def _refuse_magnifications(self, counts: Counter[str]) -> NoReturn:
        labels = sorted(counts, key=float)
        listed = ", ".join(labels[:_LISTED])
        listed += f", ... {labels[-1]}" if len(labels) > _LISTED else ""
        if self.at is None:
            raise BagError(
                f"{self.opened.path} has frames at {len(labels)} magnifications: {listed}",
                expected="frames of one magnification",
                do="choose one with --at G",
            )
        raise BagError(
            f"no frames at magnification {self.at:g} in {self.opened.path}",
            expected=f"one of {listed}",
            do="choose one of these magnifications",
        )


def _format_magnification(magnification: float) -> str:
    """Format a magnification for the user: repeated values of a topic may differ in the last digits."""
    return f"{magnification:.6g}"


def _get_kind(frame: RecordedFrame) -> tuple[object, ...]:
    return (*frame.image.shape, frame.encoding)


def _estimate_black_white(frame: RecordedFrame) -> tuple[float, float]:
    values = frame.image[::_SPARSE, ::_SPARSE]
    if values.dtype.kind == "f":
        values = values[np.isfinite(values)]
    low, high = np.quantile(values, _BLACK_WHITE) if values.size else (0.0, 1.0)
    return float(low), float(high)
