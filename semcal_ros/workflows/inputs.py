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

"""The inputs of every workflow: a recording, a calibration, a configuration; and how it reports progress."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import NDArray

from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig, load_config
from semcal_ros.core.arrays import check_positive
from semcal_ros.core.camera.calibration_model import checked_magnification
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.recordings import RecordedFiles, RecordedFrame, Recording, open_recording

#: A bag or image files, with :class:`.RecordedFiles` where they do not say everything themselves; or images in
#: memory: (image, magnification) or (image, magnification, time in s of its stamp), in the order of time.
Source = str | os.PathLike[str] | RecordedFiles | Iterable[tuple[Any, ...]]
#: A calibration, or its file.
CalibrationSource = Calibration | str | os.PathLike[str]
#: A configuration, or the name or file of one.
ConfigSource = MicroscopeConfig | str | os.PathLike[str]
#: Called with the current stage, the number of frames done, and that of all frames; None if
#: unknown.
OnProgress = Callable[[str, int, int | None], object]

# Type and, where there is one, number of channels -> ROS name of the pixel format.
_ENCODINGS: dict[tuple[Any, ...], str] = {
    ("uint8",): "mono8",
    ("uint16",): "mono16",
    ("float32",): "32FC1",
    ("uint8", 3): "bgr8",
}
_GREY_TYPES = ("uint8", "uint16", "float32")


def check_positives(values: Iterable[float], name: str) -> tuple[float, ...]:
    """Return numbers as floats.

    Raises
    ------
    InvalidValueError
        If one is not finite and positive, or there is no list of them.
    """
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise InvalidValueError(f"{name} {values}", expected="a list of numbers")
    return tuple(check_positive(value, f"{name}:") for value in values)


def ignore_progress(_stage: str, _done: int, _total: int | None) -> None:
    """Do not report progress."""


def count_frames(on_progress: OnProgress, stage: str, total: int | None) -> Callable[[int], None]:
    """Begin a stage; call what is returned with the number of frames done since the last call."""
    done = 0

    def advance(frames: int = 1) -> None:
        nonlocal done
        done += frames
        on_progress(stage, done, total)

    advance(0)
    return advance


@overload
def resolve_calibration(calibration: CalibrationSource) -> Calibration: ...


@overload
def resolve_calibration(calibration: CalibrationSource | None) -> Calibration | None: ...


def resolve_calibration(calibration: CalibrationSource | None) -> Calibration | None:
    """Return the calibration itself, read if it is a file.

    Raises
    ------
    CalibrationFileError
        If it cannot be read.
    InvalidValueError
        If it is neither a calibration nor a path.
    """
    return None if calibration is None else require_calibration(calibration)


def require_calibration(calibration: CalibrationSource) -> Calibration:
    """Return the calibration itself; raises as :func:`resolve_calibration`, for None too."""
    if isinstance(calibration, Calibration):
        return calibration
    if isinstance(calibration, (str, os.PathLike)):
        return Calibration.load(calibration)
    raise InvalidValueError(
        f"a calibration of type {type(calibration).__name__}",
        expected="a Calibration, or the path of its file",
    )


def resolve_config(
    config: ConfigSource | None,
    calibration: Calibration | None = None,
    frame_time_s: float | None = None,
) -> MicroscopeConfig:
    """Return the configuration that a workflow uses.

    Parameters
    ----------
    config
        ``generic`` where there is none.
    calibration
        Its display width is what magnifications refer to. Its squares are the grid's, where the configuration does
        not have them all.
    frame_time_s
        Seconds of one pass over a frame, in place of what the configuration says.

    Raises
    ------
    ConfigError
        If it cannot be read.
    InvalidValueError
        If the time is not finite and positive, or ``config`` is of another type.
    """
    if isinstance(config, MicroscopeConfig):
        chosen = config
    elif config is None or isinstance(config, (str, os.PathLike)):
        chosen = load_config("generic" if config is None else os.fspath(config))
    else:
        raise InvalidValueError(
            f"a configuration of type {type(config).__name__}",
            expected="a MicroscopeConfig, or the name or path of a configuration",
        )
    if calibration is not None:
        chosen = replace(
            chosen,
            display_width_m=calibration.display_width_m,
            squares_m=_squares_of(calibration, chosen.squares_m),
        )
    if frame_time_s is None:
        return chosen
    if chosen.scan is None:
        return replace(chosen, scan=ScanTiming(frame_time_s))
    return replace(chosen, scan=replace(chosen.scan, frame_time_s=frame_time_s))


def _squares_of(calibration: Calibration, configured_m: tuple[float, ...]) -> tuple[float, ...]:
    """Return the squares of the configuration, or of the calibration if that was made with others."""
    used_m = () if calibration.record is None else calibration.record.squares_m
    known = all(np.any(np.isclose(side, configured_m, rtol=1e-6, atol=0.0)) for side in used_m)
    return configured_m if known else used_m


def choose_pattern(pattern: str, calibration: Calibration) -> str:
    """Return what to look for: ``"auto"`` is a grating where the calibration was made with one.

    ``auto`` by itself does not take a grating.
    """
    of_grating = calibration.record is not None and calibration.record.is_grating
    return "grating" if pattern == "auto" and of_grating else pattern


def open_source(
    source: Source,
    config: MicroscopeConfig,
    calibration: Calibration | None = None,
    *,
    magnification: float | None = None,
) -> Recording:
    """Open a recording, or images in memory as if they were one.

    Parameters
    ----------
    source
        See :data:`Source`. Images are (h, w) grey levels without a databar, or (h, w, 3) of uint8
        in the channel order of OpenCV. Grey levels of other types than uint8, uint16 and float32
        become float32, in which all images are processed: 24 bits, more than any detector has.
        Where images have no times, they are taken to be a second apart.
    config
        How to read it.
    calibration
        The calibration that its images are to be seen with, if any.
    magnification
        As for :func:`~semcal_ros.files.recordings.open_recording`.

    Raises
    ------
    BagError
        If the recording cannot be read, or only a part of each image is used, for which the calibration was not made.
    InvalidValueError
        If an image in memory cannot be used.
    """
    if isinstance(source, (str, os.PathLike, RecordedFiles)):
        recording = open_recording(source, config, magnification=magnification)
        if calibration is not None:
            try:
                recording.expect_size(calibration.image_size)
            except BaseException:
                recording.close()
                raise
        return recording
    if magnification is not None:
        raise InvalidValueError(
            "a magnification stated for images in memory", expected="one beside each image"
        )
    if not isinstance(source, Iterable):
        raise InvalidValueError(
            f"a source of type {type(source).__name__}",
            expected="a path, RecordedFiles, or (image, magnification) tuples",
        )
    return _ImagesInMemory(source, config)


class _ImagesInMemory(Recording):
    """Images and their magnifications, which can be read as often as those of a file."""

    def __init__(self, source: Iterable[tuple[Any, ...]], config: MicroscopeConfig) -> None:
        super().__init__(Path("memory"), config)
        self._recorded = [_make_frame(index, entry, config) for index, entry in enumerate(source)]

    @property
    def frame_count(self) -> int:
        return len(self._recorded)

    def _frames(self) -> Iterator[RecordedFrame]:
        yield from self._recorded


def _make_frame(index: int, entry: tuple[Any, ...], config: MicroscopeConfig) -> RecordedFrame:
    if not isinstance(entry, tuple | list) or len(entry) not in (2, 3):
        raise InvalidValueError(
            f"image {index} without a magnification",
            expected="(image, magnification) or (image, magnification, time_s)",
        )
    try:
        image: NDArray[Any] = np.asarray(entry[0])
        # Files without times are also read as if they were a second apart.
        time_s = float(entry[2]) if len(entry) == 3 else index + 1.0
    except (TypeError, ValueError) as error:
        raise InvalidValueError(
            f"image {index}: {error}", expected="an array of grey levels, and a time in s"
        ) from error
    if image.ndim == 2 and image.dtype.kind in "iuf" and image.dtype.name not in _GREY_TYPES:
        image = image.astype(np.float32)
    encoding = _ENCODINGS.get((image.dtype.name, *image.shape[2:]))
    if encoding is None or image.ndim not in (2, 3) or image.size == 0:
        raise InvalidValueError(
            f"image {index} of shape {image.shape} and type {image.dtype}",
            expected="(h, w) grey levels, or (h, w, 3) of uint8",
        )
    if not np.isfinite(time_s):
        raise InvalidValueError(f"image {index} at {time_s} s", expected="a finite time")
    stamp_ns = round(1e9 * time_s)
    magnification = checked_magnification(entry[1])
    return RecordedFrame(image, stamp_ns, stamp_ns, magnification, config.frame_id, encoding)
