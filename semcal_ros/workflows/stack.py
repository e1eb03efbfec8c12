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

"""The drift-corrected average of a recording, and its stabilised video, from its frames of one magnification."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from semcal_ros.bridge.images import to_gray
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.arrays import AnyImage, Mask, check_positive
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.estimates import DriftPath
from semcal_ros.core.drift.scan_pairs import (
    ScanPairDrift,
    TurnedScan,
    average_scans,
    measure_scan_pairs,
)
from semcal_ros.core.errors import BagError, InvalidValueError
from semcal_ros.core.rectification.raw_positions import RasterDrift
from semcal_ros.core.rectification.stack import Stack, StackedImage, StackSums
from semcal_ros.core.wording import counted, omit_numbers
from semcal_ros.files.images.scale_bar import choose_scale_bar
from semcal_ros.files.images.write import IMAGE_SUFFIXES, TIFF_SUFFIXES, pixel_scale, write_image
from semcal_ros.files.recordings import RecordedFrame, Recording
from semcal_ros.files.video import BLACK_WHITE, FPS_RANGE, check_video, open_video, shade
from semcal_ros.workflows.follow_drift import (
    DriftFollower,
    camera_for,
    estimate_timing,
    start_time_s,
)
from semcal_ros.workflows.inputs import (
    CalibrationSource,
    ConfigSource,
    OnProgress,
    Source,
    count_frames,
    ignore_progress,
    open_source,
    resolve_calibration,
    resolve_config,
)
from semcal_ros.workflows.options import (
    CONFIG,
    DASK,
    FRAME_TIME,
    INTERPOLATION,
    MAGNIFICATION,
    PROGRESS,
    KeywordsOf,
    Option,
)
from semcal_ros.workflows.workers import open_workers

# Magnifications that an error lists: as many as fit two lines of a terminal.
_LISTED = 12
# Step between the pixels of a row and between the rows that are used for an image's quantiles.
_SPARSE = 4

# Frames that are added up by themselves before their sums are added to the others'. Of 8-bit
# frames, so many have the size of their sums, which come back from a cluster.
_FRAMES_PER_PART = 20
# Turned scans: each is compared with all of the other kind, and all are held in memory.
_MOST_SCANS = 12
# 1-sigma of the drift beyond which the average of scans is visibly blurred, px.
_UNKNOWN_PX = 1.0


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
    low, high = np.quantile(values, BLACK_WHITE) if values.size else (0.0, 1.0)
    return float(low), float(high)


@dataclass(frozen=True, eq=False)
class StackResult:
    """Average of the frames of one magnification.

    Attributes
    ----------
    image
        Mean, standard error, and number of frames in each pixel.
    camera
        Camera of the average: the ``rectified`` one of the first frame; nominal without a calibration. Of scan pairs,
        the average is the square in the middle of its image.
    dtype
        Type of the grey levels of the recording.
    stamps_ns
        n header stamps of the frames of that magnification, size and encoding.
    used
        (n,) bool: whether the frame is in the average.
    path
        Drift of the n frames; None where it was left in, or is that of scan pairs.
    states
        Number of frames by the kind of drift known live, the most frequent first.
    other_kind
        Number of frames of another size or encoding, which are left out.
    config
        The configuration that was used; its ``scan`` may have been estimated from the drift.
    notes
        Notes for the user.
    scan_drift
        Drift during each of the scans, where they were turned against each other.
    is_calibrated
        Whether there is a calibration.
    """

    image: StackedImage
    camera: ScanCamera
    dtype: np.dtype[Any]
    stamps_ns: tuple[int, ...]
    used: Mask
    path: DriftPath | None
    states: Mapping[str, int]
    other_kind: int
    config: MicroscopeConfig
    notes: tuple[str, ...]
    scan_drift: ScanPairDrift | None = None
    is_calibrated: bool = False

    @property
    def lost(self) -> int:
        """Number of frames left out because tracking had been lost before them."""
        return 0 if self.path is None else int((self.path.accepted & ~self.used).sum())

    @property
    def reasons(self) -> Mapping[str, int]:
        """Number of frames left out by the reason, the most frequent first."""
        if self.path is None:
            return {}
        left_out = Counter(
            omit_numbers(update.reason) or "after tracking was lost"
            for update, used in zip(self.path.updates, self.used, strict=True)
            if not used
        )
        return dict(left_out.most_common())

    @property
    def warnings(self) -> tuple[str, ...]:
        """What makes the average doubtful, as sentences."""
        out = []
        if self.is_calibrated and not self.camera.in_range:
            out.append("the frames are outside the calibrated range")
        left_out = len(self.used) - self.image.frames
        if 2 * self.image.frames <= len(self.used):
            # Half of the frames: more of the recording is missing than is in the average.
            reasons = "; ".join(
                f"{counted(count, 'frame')}: {kind}" for kind, count in self.reasons.items()
            )
            out.append(f"{left_out} of {counted(len(self.used), 'frame')} left out: {reasons}")
        if self.scan_drift is not None and float(self.scan_drift.sigma_px.max()) > _UNKNOWN_PX:
            out.append(
                "parts of the scans have too little structure to tell their drift; look at the average there"
            )
        return tuple(out)

    @property
    def typical_error(self) -> float | None:
        """Median of the standard error over the pixels, grey levels; None where there is none."""
        error = self.image.standard_error
        known = np.isfinite(error)
        return float(np.median(error[known])) if known.any() else None

    def save(self, path: str | os.PathLike[str], *, scale_bar: bool = False) -> None:
        """Write the mean: ``.tif`` (32-bit, with the size of its square pixels) or ``.png`` (as deep as the
        recording).

        Parameters
        ----------
        path
            The file.
        scale_bar
            Whether to append a strip with a scale bar and its 1-sigma.

        Raises
        ------
        InvalidValueError
            If the suffix is not one of these, or a PNG cannot hold the grey levels.
        OSError, BagError
            If the file cannot be written; an existing one is untouched.
        """
        file, levels = Path(path), self.image.mean
        if file.suffix.lower() == ".png" and self.dtype.kind == "u":
            top = np.iinfo(self.dtype).max
            levels = np.clip(np.rint(np.nan_to_num(levels)), 0, top).astype(self.dtype)
        self._write(file, levels, scale_bar)

    def save_sigma(self, path: str | os.PathLike[str]) -> None:
        """Write the standard error of the mean to a ``.tif``; raises as :meth:`save`."""
        self._write(Path(path), self.image.standard_error, scale_bar=False)

    def _write(self, path: Path, image: AnyImage, scale_bar: bool) -> None:
        scale = pixel_scale(self.camera)
        notes = {"magnification": self.camera.magnification, "frames": self.image.frames}
        write_image(path, image, scale, stamp_ns=self.stamps_ns[0], databar=scale_bar, notes=notes)


@dataclass(frozen=True, kw_only=True)
class StackOptions:
    """Which frames are averaged, how, and what is written."""

    calibration: Annotated[
        CalibrationSource | None,
        Option("Undo distortion, too.", kind="path", python="A calibration or its file."),
    ] = None
    config: Annotated[ConfigSource | None, CONFIG] = None
    frame_time_s: Annotated[float | None, FRAME_TIME] = None
    magnification: Annotated[float | None, MAGNIFICATION] = None
    output: Annotated[
        str | os.PathLike[str] | None,
        Option(
            "Average: .tif (32-bit, with the pixel size) or .png (as deep as the recording).",
            kind="path",
            names=("-o", "--output"),
            required=True,
            python="As :meth:`StackResult.save` writes it.",
        ),
    ] = None
    sigma: Annotated[
        str | os.PathLike[str] | None,
        Option("Standard error of the average: .tif.", kind="path"),
    ] = None
    video: Annotated[
        str | os.PathLike[str] | None, Option("Stabilised video: .mp4 or .avi.", kind="path")
    ] = None
    fps: Annotated[float, Option("Frames per second of the video.", between=FPS_RANGE)] = 10.0
    at: Annotated[
        float | None,
        Option(
            "Take the frames of this magnification.",
            metavar="G",
            python="None where there is only one.",
        ),
    ] = None
    scale_bar: Annotated[
        bool,
        Option(
            "Append a strip with a scale bar and its uncertainty below the average.",
            python="The video has one in any case.",
        ),
    ] = False
    drift: Annotated[
        bool,
        Option(
            "Average the frames where they are.",
            names=("--no-drift",),
            python="That is what False does.",
        ),
    ] = True
    scan_pairs_deg: Annotated[
        float | None,
        Option(
            "Of 2 to 12 frames, every second one was scanned with a scan rotation of 90 or -90 degrees (90: it shows "
            "the specimen turned clockwise): undo the drift within the scans, and average the square that all show.",
            kind="quarter turn",
            python="See :mod:`~semcal_ros.core.drift.scan_pairs`. Neither stamps nor a frame time are used; no video, "
            "no Dask, no other interpolation.",
        ),
    ] = None
    interpolation: Annotated[str, INTERPOLATION] = "cubic"
    dask: Annotated[str | None, DASK] = None
    on_progress: Annotated[OnProgress, PROGRESS] = ignore_progress

    @property
    def quarter_turns(self) -> int | None:
        """By how many quarters of a turn every second scan was turned; None where none was.

        Raises
        ------
        InvalidValueError
            It is no quarter of a turn, or another option does not go with it.
        """
        if self.scan_pairs_deg is None:
            return None
        others = {
            "--no-drift": not self.drift,
            "--video": self.video is not None,
            "--dask": self.dask is not None,
            "--interpolation": self.interpolation != "cubic",
        }
        if abs(abs(self.scan_pairs_deg) - 90.0) > 1e-9:
            raise InvalidValueError(
                f"--scan-pairs {self.scan_pairs_deg:g}",
                expected="90 or -90, the scan rotation of every second frame in degrees",
            )
        for name, given in others.items():
            if given:
                raise InvalidValueError(
                    f"--scan-pairs together with {name}", expected="one of the two"
                )
        return round(self.scan_pairs_deg / 90.0)


@KeywordsOf(StackOptions)
def stack(source: Source, options: StackOptions) -> StackResult:
    """Average frames, each shifted to the specimen's position in the first frame.

    Frames whose drift is not known are left out. ``source`` is a bag, a folder of images, or
    (image, magnification[, time_s]) tuples in memory.

    Raises
    ------
    SemcalError
        If calibration, configuration or recording cannot be read; there are several magnifications
        and none is chosen; the drift of no frame is known; or an output cannot hold the result.
    OSError
        If an output cannot be written.

    Examples
    --------
    ::

        from semcal_ros import stack
        average = stack("recordings/gold", calibration="jsm820.yaml")
        average.image.mean, average.image.standard_error      # (h, w) each
        average.save("gold.tif")
    """
    return stack_recording(source, options)


def stack_recording(source: Source, options: StackOptions) -> StackResult:
    """As :func:`stack`, for options that are an object already."""
    model = resolve_calibration(options.calibration)
    microscope = resolve_config(options.config, model, options.frame_time_s)
    film_path = None if options.video is None else Path(options.video)
    if film_path is not None:
        check_video(film_path, options.fps)
    at = None if options.at is None else check_positive(options.at, "at =")
    _check_suffix(options.output, IMAGE_SUFFIXES)
    _check_suffix(options.sigma, TIFF_SUFFIXES)
    quarter = options.quarter_turns
    on_progress = options.on_progress
    with (
        open_workers(options.dask) as workers,
        open_source(source, microscope, model, magnification=options.magnification) as opened,
    ):
        selection = select_frames(
            opened,
            microscope,
            model,
            at=at,
            drift=options.drift and quarter is None,
            levels=film_path is not None,
            on_first=lambda frame: _check_output(options.output, frame),
            on_progress=on_progress,
        )
        used = _choose_usable(selection)
        if quarter is not None:
            average, scan_drift = _average_pairs(
                opened, model, selection, used, quarter, on_progress
            )
            result = StackResult(
                average,
                selection.camera.rectified,
                selection.dtype,
                selection.stamps_ns,
                used,
                None,
                {},
                selection.other_kind,
                selection.config,
                opened.notes,
                scan_drift,
                is_calibrated=model is not None,
            )
            return _save(result, options)
        summed = Stack(selection.size, options.interpolation)
        grey = _choose_video_levels(selection)
        count = len(selection.indices)
        with open_video(film_path, selection.size, count, options.fps) as film:
            advance = count_frames(on_progress, "averaging", int(used.sum()))
            frames = _read_chosen(opened, model, selection, used, film is not None)
            levels = None if film is None else grey
            scale = pixel_scale(selection.camera)
            bar = choose_scale_bar(selection.size[0], scale.size_m, scale.sigma_m)
            # In this process, a part is read frame by frame while it is added up.
            orders = (
                (list(part) if workers.elsewhere else part, selection.config.scan)
                + (selection.size, options.interpolation, levels)
                for _, part in groupby(frames, lambda frame: frame.number // _FRAMES_PER_PART)
            )
            for sums, images in workers.starmap(add_part, orders):
                summed.merge(sums)
                for number, image in images:
                    assert film is not None
                    caption = _format_caption(selection.times_s, number, bool(used[number]))
                    film.write(image, caption, bar)
                advance(sums.frames)
        notes = opened.notes
    if selection.timing_note:
        notes = (*notes, selection.timing_note)
    on_progress("finishing", 0, None)
    result = StackResult(
        summed.result(),
        selection.camera.rectified,
        selection.dtype,
        selection.stamps_ns,
        used,
        selection.path,
        selection.states,
        selection.other_kind,
        selection.config,
        notes,
        is_calibrated=model is not None,
    )
    return _save(result, options)


def _save(result: StackResult, options: StackOptions) -> StackResult:
    if options.sigma is not None:
        result.save_sigma(options.sigma)
    if options.output is not None:
        result.save(options.output, scale_bar=options.scale_bar)
    return result


def _average_pairs(
    opened: Recording,
    model: Calibration | None,
    selection: FrameSelection,
    used: Mask,
    quarter_turns: int,
    on_progress: OnProgress,
) -> tuple[StackedImage, ScanPairDrift]:
    """Average scans, all of which are used, and of which every second one was turned."""
    count = len(selection.indices)
    if not 2 <= count <= _MOST_SCANS:
        raise InvalidValueError(
            f"{counted(count, 'frame')} for --scan-pairs",
            expected=f"2 to {_MOST_SCANS} of one magnification, every second one turned",
        )
    if selection.other_kind:
        raise InvalidValueError(
            f"--scan-pairs with {counted(selection.other_kind, 'frame')} of another size or encoding",
            expected="frames of one kind, every second one turned",
        )
    scans = [
        TurnedScan(frame.image, quarter_turns * (frame.number % 2), frame.camera, frame.mask)
        for frame in _read_chosen(opened, model, selection, used, unused_too=False, masks=True)
    ]
    on_progress("matching scans", 0, None)
    found = measure_scan_pairs(scans)
    on_progress("averaging", 0, None)
    return average_scans(scans, found), found


def _check_suffix(output: str | os.PathLike[str] | None, suffixes: Sequence[str]) -> None:
    if output is not None and Path(output).suffix.lower() not in suffixes:
        raise InvalidValueError(
            f"output {os.fspath(output)}", expected="a name that ends in " + ", ".join(suffixes)
        )


def _check_output(output: str | os.PathLike[str] | None, frame: RecordedFrame) -> None:
    """Refuse what :meth:`StackResult.save` could not write, before any work is done for it."""
    if output is None or Path(output).suffix.lower() in TIFF_SUFFIXES:
        return
    if frame.image.dtype.kind != "u":
        raise InvalidValueError(
            f"{os.fspath(output)} for {frame.encoding} frames",
            expected="a .tif, which holds grey levels of 32 bits",
        )


def _choose_usable(selection: FrameSelection) -> Mask:
    """Return which of the chosen frames go into the average, (n,) bool."""
    if selection.path is None:
        return np.ones(len(selection.indices), dtype=bool)
    usable = selection.path.trusted
    if not usable.any():
        raise BagError(
            f"{counted(len(usable), 'frame')}, none of them with a known drift; the first: "
            f"{selection.path[0].status_text}",
            expected="a specimen with structure",
            do="check with `semcal drift`, or average the frames where they are with --no-drift",
        )
    return usable


class _ChosenFrame(NamedTuple):
    """A chosen frame: its number among them, and what it needs to be added."""

    number: int
    image: NDArray[Any]
    camera: ScanCamera
    drift: RasterDrift | None
    used: bool
    mask: Mask | None = None


def _read_chosen(
    opened: Recording,
    model: Calibration | None,
    selection: FrameSelection,
    used: Mask,
    unused_too: bool,
    masks: bool = False,
) -> Iterator[_ChosenFrame]:
    """Read the chosen frames, of which a video shows those, too, that are not used; with masks where they are wanted,
    which a frame would else carry to the workers for nothing.
    """
    number_of = {index: number for number, index in enumerate(selection.indices)}
    for index, frame in enumerate(opened.frames()):
        number = number_of.get(index)
        if number is None or not (used[number] or unused_too):
            continue
        drift = None if selection.path is None else selection.path[number].raster
        grey = to_gray(frame.image, frame.encoding)
        camera = camera_for(frame, model, selection.config)
        yield _ChosenFrame(
            number, grey, camera, drift, bool(used[number]), frame.mask if masks else None
        )


def add_part(
    frames: Iterable[_ChosenFrame],
    scan: ScanTiming | None,
    size: tuple[int, int],
    interpolation: str,
    levels: tuple[float, float] | None,
) -> tuple[StackSums, list[tuple[int, NDArray[np.uint8]]]]:
    """Add up some frames, away from all others.

    Returns
    -------
    Their sums; number and image of each for a video, where ``levels`` are shown as black and white.
    """
    summed, images = Stack(size, interpolation), []
    for frame in frames:
        image, valid = summed.rectify(frame.image, frame.camera, frame.drift, scan)
        if frame.used:
            summed.add(image, valid)
        if levels is not None:
            images.append((frame.number, shade(image, levels)))
    return summed.sums(), images


def _choose_video_levels(selection: FrameSelection) -> tuple[float, float]:
    """Return the grey levels that are shown as black and white."""
    if selection.dtype == np.uint8 or not selection.levels:
        return 0.0, 255.0
    low, high = np.median(selection.levels, axis=0)
    return float(low), float(high)


def _format_caption(times_s: tuple[float, ...], number: int, used: bool) -> str:
    """Format the number and time of a frame."""
    text = f"{number + 1}/{len(times_s)}  {times_s[number] - times_s[0]:.1f} s"
    return text if used else f"{text}  not tracked"
