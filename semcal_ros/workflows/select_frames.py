"""The frames of one magnification in a recording, and their drift."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NoReturn

import numpy as np

from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.estimates import DriftPath
from semcal_ros.core.errors import BagError
from semcal_ros.files.recordings import RecordedFrame, Recording
from semcal_ros.workflows.follow_drift import Follower, camera_of, start_time_s, timing_seen

__all__ = ["Job", "Survey", "surveyed"]

_LISTED = 12
# Grey levels of more than 8 bits are shown with these quantiles as black and white.
_BLACK_WHITE = (0.001, 0.999)


@dataclass(frozen=True)
class Job:
    """How the frames of a recording are to be read.

    Attributes
    ----------
    model
        Calibration, or None for nominal cameras.
    microscope
        Configuration.
    at
        The magnification to choose; None where there must be one only.
    follower
        Tracks the chosen frames; None for no drift.
    """

    model: Calibration | None
    microscope: MicroscopeConfig
    at: float | None = None
    follower: Follower | None = None

    def camera(self, frame: RecordedFrame) -> ScanCamera:
        """Of a frame."""
        return camera_of(frame, self.model, self.microscope)


@dataclass
class Survey:
    """The frames of one magnification, size and encoding in a recording, and their drift.

    Attributes
    ----------
    job
        How the frames were read.
    camera
        Of the first frame.
    dtype, size
        Type of the grey levels; (width, height) in px.
    first_stamp_ns
        Stamp of the first frame.
    chosen
        Numbers of the frames as the recording gives them.
    times_s
        Starts of their acquisitions, s after the first stamp.
    levels
        Grey levels of each that are shown as black and white, where asked for.
    other_kind
        How many frames of the magnification have another size or encoding.
    timing_note
        What there is to tell of a scan timing that is not configured.
    """

    job: Job
    camera: ScanCamera
    dtype: np.dtype[Any]
    size: tuple[int, int]
    first_stamp_ns: int
    chosen: list[int] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)
    levels: list[tuple[float, float]] = field(default_factory=list)
    other_kind: int = 0
    timing_note: str = ""

    @property
    def follower(self) -> Follower | None:
        """The drift of the frames; None where it is not wanted."""
        return self.job.follower

    @cached_property
    def path(self) -> DriftPath | None:
        """Drift of the chosen frames; None where it is not wanted. For a finished survey."""
        return None if self.follower is None else self.follower.path(live=False)


def surveyed(
    opened: Recording,
    job: Job,
    *,
    on_first: Callable[[RecordedFrame], None],
    levels: bool,
    on_frame: Callable[[], object] = lambda: None,
) -> Survey:
    """Read a recording for the first time: choose its frames and track their drift.

    Where the configuration has no scan timing and the drift tells it, they are tracked once more
    with it; the survey's job has it, then.

    Parameters
    ----------
    opened
        The recording.
    job
        What to choose.
    on_first
        Called with the first chosen frame, to refuse it before any work is done.
    levels
        Whether black and white are wanted.
    on_frame
        Called after each frame that was read, to show progress.

    Raises
    ------
    BagError
        There are several magnifications and none is chosen, the chosen one is not there, or time
        runs backwards.
    """
    survey = _surveyed_once(opened, job, on_first, levels, on_frame)
    if job.follower is None:
        return survey
    microscope, note = timing_seen(job.microscope, job.follower, job.model)
    if microscope is not job.microscope:
        again = replace(job, microscope=microscope, follower=Follower())
        survey = _surveyed_once(opened, again, on_first, levels, on_frame)
    survey.timing_note = note
    return survey


def _surveyed_once(
    opened: Recording,
    job: Job,
    on_first: Callable[[RecordedFrame], None],
    levels: bool,
    on_frame: Callable[[], object],
) -> Survey:
    counts: Counter[str] = Counter()
    wanted = None if job.at is None else _label(job.at)
    survey: Survey | None = None
    kind: tuple[object, ...] = ()
    for index, frame in enumerate(opened.frames()):
        on_frame()
        label = _label(frame.magnification)
        counts[label] += 1
        if label != (wanted or label) or (wanted is None and len(counts) > 1):
            continue  # to be refused, or of no interest: only the magnification matters
        if survey is None:
            on_first(frame)
            survey, kind = _begun(frame, job), _kind(frame)
        if _kind(frame) != kind:
            survey.other_kind += 1
            continue
        _add(survey, index, frame, job)
        if levels:
            survey.levels.append(_black_white(frame))
    if survey is None or (wanted is None and len(counts) > 1):
        _refuse_magnifications(opened, job, counts)
    return survey


def _label(magnification: float) -> str:
    """A magnification as people read it: what a topic repeats may differ in the last digits."""
    return f"{magnification:.6g}"


def _kind(frame: RecordedFrame) -> tuple[object, ...]:
    return (*frame.image.shape, frame.encoding)


def _black_white(frame: RecordedFrame) -> tuple[float, float]:
    values = frame.image[::4, ::4]
    if values.dtype.kind == "f":
        values = values[np.isfinite(values)]
    low, high = np.quantile(values, _BLACK_WHITE) if values.size else (0.0, 1.0)
    return float(low), float(high)


def _begun(frame: RecordedFrame, job: Job) -> Survey:
    height, width = frame.image.shape[:2]
    size = width, height
    return Survey(job, job.camera(frame), frame.image.dtype, size, frame.stamp_ns)


def _add(survey: Survey, index: int, frame: RecordedFrame, job: Job) -> None:
    time_s = start_time_s(frame, survey.first_stamp_ns, job.microscope)
    if survey.times_s and time_s < survey.times_s[-1]:
        raise BagError(
            f"image {index + 1} was taken {survey.times_s[-1] - time_s:g} s before the one before",
            expected="images in the order of time",
            do="record each pass of a replay to a recording of its own",
        )
    survey.chosen.append(index)
    survey.times_s.append(time_s)
    if job.follower is not None:
        job.follower.update(frame, time_s, job.camera(frame), job.microscope.scan)


def _refuse_magnifications(opened: Recording, job: Job, counts: Counter[str]) -> NoReturn:
    labels = sorted(counts, key=float)
    listed = ", ".join(labels[:_LISTED]) + (f", ... {labels[-1]}" if len(labels) > _LISTED else "")
    if job.at is None:
        raise BagError(
            f"{opened.path} has frames at {len(labels)} magnifications: {listed}",
            expected="frames of one magnification",
            do="choose one with --at G",
        )
    raise BagError(
        f"--at {job.at:g}: {opened.path} has no such frames",
        expected=f"one of {listed}",
        do="choose one of these magnifications",
    )
