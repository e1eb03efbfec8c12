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

"""Bending of a cantilever in one or more recordings."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from semcal_ros.applications.cantilever import (
    SHAPES,
    Repeatability,
    Series,
    SeriesSettings,
    compare_series,
    describe_disagreement,
    group_frames,
    measure_series,
)
from semcal_ros.bridge.images import to_gray
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import BagError, InvalidValueError
from semcal_ros.files.recordings import RecordedFiles, RecordedFrame
from semcal_ros.files.tables import write_table
from semcal_ros.workflows.follow_drift import GIVE_FRAME_TIME, camera_for, start_time_s
from semcal_ros.workflows.inputs import (
    CalibrationSource,
    ConfigSource,
    OnProgress,
    Source,
    count_frames,
    ignore_progress,
    open_source,
    require_calibration,
    resolve_config,
)
from semcal_ros.workflows.options import (
    CONFIG,
    FRAME_TIME,
    MAGNIFICATION,
    PROGRESS,
    Keyword,
    KeywordsOf,
    Option,
)
from semcal_ros.workflows.provenance import ConditionsComparison

#: Columns of the table of ``semcal measure cantilever``.
CANTILEVER_COLUMNS = (
    "recording",
    "stamp_ns",
    "magnification",
    "pose",
    "deflection_m",
    "sigma_m",
    "deflection_by_length_m",
    "sigma_by_length_m",
    "tip_x_px",
    "tip_y_px",
    "rms_m",
    "edges_used",
    "drift_status",
)

Pixel = tuple[float, float]


@dataclass(frozen=True, eq=False)
class CantileverSeries:
    """The n frames of one magnification in one recording, and what was measured in them.

    Attributes
    ----------
    recording
        Name of the recording.
    images
        n grey images, (h, w).
    stamps_ns
        n header stamps, ns since 1970.
    poses
        n numbers of the poses, from 1.
    camera
        Camera of the magnification.
    measured
        Deflections, reference, shape and drift.
    """

    recording: str
    images: tuple[NDArray[Any], ...]
    stamps_ns: tuple[int, ...]
    poses: tuple[int, ...]
    camera: ScanCamera
    measured: Series


@dataclass(frozen=True, eq=False)
class CantileverMeasurement:
    """Deflections of a cantilever at one or more magnifications.

    Attributes
    ----------
    series
        One for each magnification and recording, in the order in which these first appear.
    repeatability
        Means by magnification and pose, and how well the magnifications agree.
    poses
        Number of poses; None if each frame is a pose.
    notes
        Notes for the user.
    """

    series: tuple[CantileverSeries, ...]
    repeatability: Repeatability
    poses: int | None
    notes: tuple[str, ...]

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the table of ``semcal measure cantilever``, one row for each frame.

        The suffix is ``.csv``, ``.parquet`` or ``.xlsx``.

        Raises
        ------
        InvalidValueError
            If it is another one, or its library is missing.
        OSError
            If the file cannot be written; an existing one is untouched.
        """
        rows = (
            (
                one.recording,
                one.stamps_ns[k],
                float(one.measured.magnification),
                one.poses[k],
                float(frame.deflection_m),
                float(frame.sigma_m),
                float(frame.by_length_m),
                float(frame.by_length_sigma_m),
                *(float(v) for v in frame.tip_px),
                float(frame.bending.rms_m),
                int(np.count_nonzero(frame.bending.used)),
                one.measured.drift[k].status_text,
            )
            for one in self.series
            for k, frame in enumerate(one.measured.frames)
        )
        write_table(Path(path), CANTILEVER_COLUMNS, rows)


@dataclass(frozen=True, kw_only=True)
class CantileverOptions:
    """What is known of a cantilever, and how its frames belong together."""

    calibration: Annotated[
        CalibrationSource,
        Option("Calibration.", kind="path", required=True, python="Or its file."),
    ]
    length_m: Annotated[
        float,
        Option(
            "Length of the cantilever, such as 35um; a bare number is in m.",
            kind="length",
            required=True,
        ),
    ]
    poses: Annotated[
        int | None,
        Option(
            "Number of poses at each magnification, with equally many frames each; by default, each frame is a pose.",
            between=(1, None),
            metavar="N",
        ),
    ] = None
    shape: Annotated[
        str,
        Option(
            "Shape of the bent beam: terms of second and third order; a beam loaded at its end; second order.",
            choices=tuple(SHAPES),
        ),
    ] = "free"
    bases: Annotated[
        Sequence[Pixel],
        Option(
            "Base of the cantilever in the first frame, if it is not found automatically; once, or once for each "
            "magnification in the order of the recording.",
            kind="pixel",
            names=("--base",),
            repeated=True,
            python="(x, y), px.",
        ),
    ] = ()
    tips: Annotated[
        Sequence[Pixel],
        Option(
            "Free end of the cantilever, likewise.", kind="pixel", names=("--tip",), repeated=True
        ),
    ] = ()
    config: Annotated[ConfigSource | None, CONFIG] = None
    frame_time_s: Annotated[float | None, FRAME_TIME] = None
    magnification: Annotated[float | None, MAGNIFICATION] = None
    on_progress: Annotated[
        OnProgress,
        Keyword(f"{PROGRESS.text} Each frame counts twice."),
    ] = ignore_progress


@KeywordsOf(CantileverOptions)
def measure_cantilever(
    source: Source | Sequence[str | os.PathLike[str] | RecordedFiles], options: CantileverOptions
) -> CantileverMeasurement:
    """Measure the deflection of the free end of a cantilever in each frame.

    The first pose is the reference: there, nothing touches the cantilever. All magnifications may
    be in one recording or each in its own; their k-th poses are compared. Deflections are positive
    to the right as seen from the base. ``source`` is a recording, several of them, or
    (image, magnification[, time_s]) tuples in memory.

    Raises
    ------
    SemcalError
        If calibration, configuration or recording cannot be read, no cantilever is found, or the
        frames cannot be cut into poses.

    Examples
    --------
    ::

        from semcal_ros import measure_cantilever
        bending = measure_cantilever("bending", calibration="jsm820.yaml", length_m=35e-6)
        bending.repeatability.deflection_m          # (magnifications, poses)
        bending.save("bending.csv")
    """
    return measure_recorded_cantilever(source, options)


def measure_recorded_cantilever(
    source: Source | Sequence[str | os.PathLike[str] | RecordedFiles], options: CantileverOptions
) -> CantileverMeasurement:
    """As :func:`measure_cantilever`, for options that are an object already."""
    length_m, poses, shape = options.length_m, options.poses, options.shape
    on_progress = options.on_progress
    model = require_calibration(options.calibration)
    microscope = resolve_config(options.config, model, options.frame_time_s)
    runs, notes = _read(
        _list_sources(source), model, microscope, options.magnification, on_progress
    )
    _check_counts(runs)
    ends = _pair_ends(options.bases, options.tips, len(runs))
    total = 2 * sum(len(run.images) for run in runs)
    advance = count_frames(on_progress, "bending", total)
    series = []
    for run, (base, tip) in zip(runs, ends, strict=True):
        settings = SeriesSettings(length_m, shape, base, tip)
        groups = group_frames(len(run.images), poses)
        measured = measure_series(
            run.images,
            run.times_s,
            run.camera,
            microscope.scan,
            settings,
            reference=groups[0],
            on_frame=lambda: advance(1),
        )
        numbers = tuple(number for number, group in enumerate(groups, 1) for _ in group)
        series.append(
            CantileverSeries(
                run.recording,
                tuple(run.images),
                tuple(run.stamps_ns),
                numbers,
                run.camera,
                measured,
            )
        )
    if microscope.scan is None:
        notes.append(f"the configuration has no scan: frames are instants; {GIVE_FRAME_TIME}")
    if not all(one.camera.in_range for one in series):
        notes.append("frames outside the calibrated range")
    compared = [one.measured for one in series]
    agreement = compare_series(compared, poses)
    notes += describe_disagreement(compared, agreement)
    return CantileverMeasurement(tuple(series), agreement, poses, tuple(notes))


@dataclass
class _Run:
    """Frames of one magnification in one recording, as they are read."""

    recording: str
    camera: ScanCamera
    images: list[NDArray[Any]] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)
    times_s: list[float] = field(default_factory=list)

    def add(self, frame: RecordedFrame, microscope: MicroscopeConfig) -> None:
        first_ns = self.stamps_ns[0] if self.stamps_ns else frame.stamp_ns
        self.images.append(np.array(to_gray(frame.visible, frame.encoding)))
        self.stamps_ns.append(frame.stamp_ns)
        self.times_s.append(start_time_s(frame, first_ns, microscope))


_PATHS = (str, os.PathLike, RecordedFiles)


def _list_sources(
    source: Source | Sequence[str | os.PathLike[str] | RecordedFiles],
) -> list[Source]:
    """Recordings, each on its own; images in memory are one."""
    if isinstance(source, _PATHS) or not isinstance(source, Iterable):
        return [source]
    entries = list(source)
    paths = [entry for entry in entries if isinstance(entry, _PATHS)]
    if paths and len(paths) == len(entries):
        return list(paths)
    if paths:
        raise InvalidValueError(
            "recordings and images in memory in one call", expected="one or the other"
        )
    return [[entry for entry in entries if isinstance(entry, tuple)]]


def _read(
    sources: Iterable[Source],
    model: Calibration,
    microscope: MicroscopeConfig,
    magnification: float | None,
    on_progress: OnProgress,
) -> tuple[list[_Run], list[str]]:
    """Frames by recording and magnification, in the order in which these first appear."""
    found: dict[tuple[Path, str], _Run] = {}
    notes: list[str] = []
    conditions = ConditionsComparison(model)
    for source in sources:
        with open_source(source, microscope, model, magnification=magnification) as opened:
            path = opened.path
            advance = count_frames(on_progress, "reading", opened.frame_count)
            for frame in opened.frames():
                advance(1)
                conditions.add(frame.conditions)
                label = f"{frame.magnification:.6g}"
                if (path, label) not in found:
                    camera = camera_for(frame, model, microscope)
                    found[path, label] = _Run(path.name, camera)
                run = found[path, label]
                if run.images and run.images[0].shape != frame.image.shape[:2]:
                    raise BagError(
                        f"{path}: frames of {run.images[0].shape} and {frame.image.shape} px "
                        f"at {label}x",
                        expected="one size for each magnification",
                    )
                run.add(frame, microscope)
                if len(run.times_s) > 1 and run.times_s[-1] < run.times_s[-2]:
                    raise BagError(
                        f"{path}: time runs backwards at {label}x",
                        expected="frames in the order of time",
                    )
            notes += [f"{path}: {note}" for note in opened.notes]
    return list(found.values()), [*notes, *conditions.notes]


def _check_counts(runs: Sequence[_Run]) -> None:
    """Refuse a magnification with a reference only: nothing bends in it."""
    for run in runs:
        if len(run.images) < 2:
            raise BagError(
                f"{run.recording}: 1 frame at {run.camera.magnification:g}x",
                expected="2 frames or more at each magnification: the first is the reference without a load",
                do="record the cantilever once without a load and then under it, at the same magnification",
            )


def _pair_ends(
    bases: Sequence[Pixel], tips: Sequence[Pixel], count: int
) -> list[tuple[Pixel | None, Pixel | None]]:
    """Base and tip for each of ``count`` magnifications."""
    for pixel in (*bases, *tips):
        position = np.asarray(pixel)
        if position.shape != (2,) or position.dtype.kind not in "iuf":
            raise InvalidValueError(f"base or tip {pixel}", expected="two numbers, x and y in px")
    if len(bases) != len(tips) or len(bases) not in (0, 1, count):
        raise InvalidValueError(
            f"{len(bases)} bases and {len(tips)} tips for {count} magnifications",
            expected="neither, one of each, or one of each for every magnification",
            do=f"give neither --base nor --tip, both once, or both {count} times",
        )
    if not bases:
        return [(None, None)] * count
    pairs = list(zip(bases, tips, strict=True))
    return [*pairs] * (count if len(pairs) == 1 else 1)
