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

"""Frames with their magnification, from a bag or from image files of any kind."""

from __future__ import annotations

import os
import zlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Container, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, islice
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from semcal_ros.bridge.compressed import decoded_image, describe_compressed
from semcal_ros.bridge.conditions import Conditions
from semcal_ros.bridge.fields import require_fields, stamp_ns_from_msg
from semcal_ros.bridge.images import without_databar
from semcal_ros.bridge.magnification import MAGNIFICATION_LIMITS
from semcal_ros.config.config import MagnificationConfig, MicroscopeConfig, load_config
from semcal_ros.core.arrays import Mask, check_range
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.calibration.thresholds import DISPLAY_WIDTH_LIMITS_M
from semcal_ros.core.errors import BagError, InvalidValueError, SemcalError, UnknownScaleError
from semcal_ros.core.rectification.line_phase import LinePhaseCorrector
from semcal_ros.core.wording import counted
from semcal_ros.files.bags.held_values import MagnificationTrack, find_conditions, find_stage
from semcal_ros.files.bags.reader import (
    BagTopic,
    RawMessage,
    find_image_topic,
    find_topic,
    is_bag,
    open_bag,
    reading,
)
from semcal_ros.files.images.databar import DatabarFinder
from semcal_ros.files.images.image_series import (
    ImageSeries,
    SeriesImage,
    find_image_files,
    list_image_series,
)
from semcal_ros.files.images.mask import fill_masked, fit_mask, read_mask

if TYPE_CHECKING:
    from typing_extensions import Self


T = TypeVar("T")

#: ROS names of the pixel formats of image files.
ENCODINGS = {"uint8": "mono8", "uint16": "mono16", "float32": "32FC1"}


# The first images of a bag, in which a data bar is looked for until one can be told.
_AMONG = 30
# A height that rounding has changed by this is that of the same shape, px.
_SHAPE_PX = 1.5
# Beyond these, a unit was forgotten: from a tenth of a picometre, far below an atom, to a metre for
# the pixel of a photograph; from a photographed wall to what bags accept; from a microsecond, which
# no raster scan reaches, to the time limit of a configuration's frame.
_RANGES = {
    "pixel_size_m": (1e-13, 1.0, "m", "state the unit, as in --pixel-size 43.9nm"),
    "magnification": (1e-3, MAGNIFICATION_LIMITS[1], "", "correct --magnification"),
    "frame_interval_s": (1e-6, 1e6, "s", "state the unit, as in --frame-interval 533ms"),
    "display_width_m": (
        *DISPLAY_WIDTH_LIMITS_M,
        "m",
        "state the unit, as in --display-width 127mm",
    ),
}


@dataclass(frozen=True)
class RecordedFiles:
    """A recording on disk, and what it does not say about itself.

    Parameters
    ----------
    path
        A bag; an image (TIFF, PNG, JPEG, BMP), a stack of them, or a video; a folder of these; a pattern such as
        ``scans/*.tif``; or a sequence of image files.
    pixel_size_m
        Pixel size of all images on the specimen, instead of what files say.
    magnification
        Magnification of all images, on the display width of the configuration, where the files do not say it.
    frame_interval_s
        Time from one image to the next, instead of what files say; not for bags, whose images have stamps.
    databar_rows
        Rows to cut off at the bottom, instead of those that the configuration or the files give.
    roi
        (x, y, width, height) of the part of each image that is used, px. The magnification grows with the field's
        width, so that the pixel size stays.
    display_width_m
        Display width that ``magnification`` refers to, where it is not that of the configuration or calibration.
    mask
        An image of the size of the images before ``roi``, black where they do not show the specimen. There, no grid is
        looked for and no drift measured; images that are written keep these pixels.

    Raises
    ------
    InvalidValueError
        If a number is out of its range, or both pixel size and magnification are given.
    """

    path: str | os.PathLike[str] | Sequence[str | os.PathLike[str]]
    pixel_size_m: float | None = None
    magnification: float | None = None
    frame_interval_s: float | None = None
    databar_rows: int | None = None
    roi: tuple[int, int, int, int] | None = None
    display_width_m: float | None = None
    mask: str | os.PathLike[str] | None = None

    def __post_init__(self) -> None:
        for name, (low, high, unit, do) in _RANGES.items():
            if (value := getattr(self, name)) is not None:
                check_range(value, f"{name} =", low, high, unit, do)
        if self.pixel_size_m is not None and self.magnification is not None:
            raise InvalidValueError(
                "a pixel size and a magnification",
                expected="one of them: either follows from the other",
            )
        if self.databar_rows is not None and self.databar_rows < 0:
            raise InvalidValueError(f"databar_rows = {self.databar_rows}", expected="0 or more")
        if self.roi is not None:
            x, y, width, height = self.roi
            if min(x, y) < 0 or min(width, height) <= 0:
                raise InvalidValueError(
                    f"roi = {self.roi}", expected="(x, y, width, height) in px, the size above 0"
                )

    @property
    def name(self) -> str:
        """Name of the bag, folder or file, or of the folder of several files."""
        first, *others = self.paths
        return (first.absolute().parent if others else first.absolute()).name

    def magnify(self, display_width_m: float) -> float | None:
        """The stated magnification, for a display of another width."""
        if self.magnification is None or self.display_width_m is None:
            return self.magnification
        return self.magnification * display_width_m / self.display_width_m

    @property
    def paths(self) -> tuple[Path, ...]:
        """The path, or the several."""
        if isinstance(self.path, (str, os.PathLike)):
            return (Path(self.path),)
        return tuple(Path(path) for path in self.path)


@dataclass(frozen=True)
class RecordedFrame:
    """One usable image of a recording, with its time and magnification.

    Parameters
    ----------
    image
        (h, w) or (h, w, 3) array without the databar.
    stamp_ns
        Header stamp as it is, in ns since 1970; the configuration says which moment it means.
        The recorder's time if the stamp is not set.
    log_time_ns
        When the recorder received the image.
    magnification
        Magnification of this frame, for the display width of the configuration.
    frame_id
        Coordinate frame that the header names.
    encoding
        ROS name of the pixel format, such as ``mono8``.
    stage
        What the stage said last before the frame, or None where it is not known.
    file_name
        Name of the file that the frame comes from, for a folder of images; else empty.
    conditions
        How the image was taken, where its file or the recording says it.
    mask
        (h, w) true where the image shows the specimen, or None for all of it.
    """

    image: NDArray[Any]
    stamp_ns: int
    log_time_ns: int
    magnification: float
    frame_id: str
    encoding: str
    stage: StageReading | None = None
    file_name: str = ""
    conditions: Conditions | None = None
    mask: Mask | None = None

    @property
    def visible(self) -> NDArray[Any]:
        """The image to measure in: outside the mask, its surroundings continue without texture."""
        return self.image if self.mask is None else fill_masked(self.image, self.mask)


@dataclass(frozen=True)
class RejectedFrame:
    """A message or file that was left out, and the reason."""

    log_time_ns: int
    reason: str


@dataclass(frozen=True)
class FrameOutline:
    """What is known of a frame without decoding it.

    Parameters
    ----------
    stamp_ns, magnification, encoding, stage, file_name, conditions
        As of :class:`RecordedFrame`; ``encoding`` is empty where only the pixels tell it.
    size_px
        (width, height) without the databar.
    image
        The pixels, where they were asked for or cost nothing.
    digest
        Checksum of the pixels as they are stored, where they were read.
    """

    stamp_ns: int
    magnification: float
    size_px: tuple[int, int]
    encoding: str
    stage: StageReading | None = None
    file_name: str = ""
    conditions: Conditions | None = None
    image: NDArray[Any] | None = None
    digest: int | None = None


def _outline_of(frame: RecordedFrame, digest: int | None = None) -> FrameOutline:
    return FrameOutline(
        frame.stamp_ns,
        frame.magnification,
        (frame.image.shape[1], frame.image.shape[0]),
        frame.encoding,
        frame.stage,
        frame.file_name,
        frame.conditions,
        frame.image,
        zlib.crc32(np.ascontiguousarray(frame.image).data) if digest is None else digest,
    )


def _first(count: int) -> str:
    return ", the first" if count > 1 else ""


class Recording(ABC):
    """An open recording; use :func:`open_recording`, and close it or use it as a context manager.

    Attributes
    ----------
    path
        What was opened.
    config
        The microscope's configuration that says how to read it.
    """

    def __init__(
        self,
        path: Path,
        config: MicroscopeConfig,
        *,
        roi: tuple[int, int, int, int] | None = None,
        mask: str | os.PathLike[str] | None = None,
    ) -> None:
        self.path = path
        self.config = config
        self._roi = roi
        self._mask = None if mask is None else read_mask(mask)
        self._notes: list[str] = []
        self._pass_notes: list[str] = []
        self._rejected: list[RejectedFrame] = []
        self._expected_px: tuple[int, int] | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:  # noqa: B027  # a folder has nothing to close
        """Close the files."""

    @property
    def topics(self) -> tuple[BagTopic, ...]:
        """Topics of the recording; none for a folder of TIFFs."""
        return ()

    @property
    @abstractmethod
    def frame_count(self) -> int:
        """Number of images, including bad ones."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user; complete after :meth:`frames` was read to its end."""
        return (*self._notes, *self._pass_notes)

    @property
    def rejected(self) -> tuple[RejectedFrame, ...]:
        """Damaged or unknown images that the last reading of :meth:`frames` left out."""
        return tuple(self._rejected)

    def frames(self) -> Iterator[RecordedFrame]:
        """Yield usable frames in the order of the recording, read on demand; can be called again.

        Raises
        ------
        BagError
            No frame is usable (with the first reason), or the file is damaged.
        """
        self._rejected.clear()
        self._pass_notes.clear()
        count = 0
        lines = self._line_phase()
        for frame in self._frames():
            cut = self._cut(replace(frame, image=lines.correct(frame.image)))
            if cut is not None:
                if count == 0:
                    self._note_shape(cut.image.shape)
                count += 1
                yield cut
        if lines.note:
            self._pass_notes.append(lines.note)
        self._end_pass(count)

    def frames_from(self, start: int) -> Iterator[tuple[int, RecordedFrame]]:
        """Yield usable frames with their numbers among all images, from the one with number ``start`` on.

        What comes before is skipped without being decoded, as far as the files allow. Nothing is noted, and a
        recording may end before.
        """
        lines = self._line_phase()
        for number, frame in self._frames_from(start):
            cut = self._cut(replace(frame, image=lines.correct(frame.image)))
            if cut is not None:
                yield number, cut

    def expect_size(self, size_px: tuple[int, int]) -> None:
        """Say of what size (width, height) the images are that a calibration was made of, which these are seen with.

        Images of another shape are noted.

        Raises
        ------
        BagError
            If a region of another size is used: a calibration does not know where in the raster it lies.
        """
        if self._roi is not None and self._roi[2:] != size_px:
            raise BagError(
                f"a region of {self._roi[2]} x {self._roi[3]} px, with a calibration of images of "
                f"{size_px[0]} x {size_px[1]} px",
                expected="whole images, or a calibration that was made of the same region",
                do="leave --roi out; --mask leaves parts of the images out, and the result can be cropped",
            )
        self._expected_px = size_px

    def _note_shape(self, shape: tuple[int, ...]) -> None:
        """Note an image (h, w) of which a calibration does not know where in the raster it lies."""
        if self._expected_px is None:
            return
        (height, width), (calibrated_width, calibrated_height) = shape[:2], self._expected_px
        if abs(height - width * calibrated_height / calibrated_width) <= _SHAPE_PX:
            return
        self._pass_notes.append(
            f"images of {width} x {height} px are seen with a calibration of images of {calibrated_width} x "
            f"{calibrated_height} px: their middles are taken for the same place of the raster, which is wrong if rows "
            "are missing on one side, as under a data bar"
        )

    def _line_phase(self) -> LinePhaseCorrector:
        scan = self.config.scan
        return LinePhaseCorrector(scan is not None and scan.bidirectional)

    def _cut(self, frame: RecordedFrame) -> RecordedFrame | None:
        """The frame with its mask, and the part of it that is used; None if it is too small for that."""
        if self._mask is not None:
            height, width = frame.image.shape[:2]
            frame = replace(frame, mask=fit_mask(self._mask, (height, width)))
        if self._roi is not None:
            try:
                return _crop(frame, self._roi)
            except BagError as error:
                self._rejected.append(RejectedFrame(frame.log_time_ns, str(error)))
                return None
        return frame

    def _end_pass(self, count: int) -> None:
        """Note what was left out; refuse a recording without a usable frame."""
        if self._rejected:
            number = len(self._rejected)
            self._pass_notes.append(
                f"{counted(number, 'image was', 'images were')} left out{_first(number)}: "
                + self._rejected[0].reason
            )
        if count == 0:
            # The reason of an image says what was expected.
            raise BagError(
                f"{self.path} has {counted(self.frame_count, 'image')}, none usable: "
                + (" / ".join(self._pass_notes) or "there are no images"),
                expected=""
                if self._rejected
                else "at least one image of a known encoding with a valid magnification",
            )

    @abstractmethod
    def _frames(self) -> Iterator[RecordedFrame]: ...

    def _frames_from(self, start: int) -> Iterator[tuple[int, RecordedFrame]]:
        for number, frame in enumerate(self._frames()):
            if number >= start:
                yield number, frame

    @property
    def scale_source(self) -> str:
        """Where the pixel size comes from, in words."""
        return self._describe_display()

    @property
    def pixel_size_stated(self) -> bool:
        """Whether files or user state the size of a pixel, rather than a magnification on some display."""
        return False

    def _describe_display(self, *, given: bool = False) -> str:
        source = "as given" if given else f"of the configuration {self.config.name}"
        return f"display width {self.config.display_width_m:g} m {source}"

    def outlines(self, wanted: Container[int]) -> Iterator[FrameOutline]:
        """Yield what is known of each usable frame, decoding only some; can be called again.

        Parameters
        ----------
        wanted
            Indices of the images, counted with the bad ones, whose pixels are wanted. Others may
            have theirs as well.

        Raises
        ------
        BagError
            As of :meth:`frames`; damaged images that are not decoded are not noticed.
        """
        self._rejected.clear()
        self._pass_notes.clear()
        count = 0
        for outline in self._outlines(wanted):
            if self._roi is not None:
                try:
                    outline = _crop_outline(outline, self._roi)
                except BagError as error:
                    self._rejected.append(RejectedFrame(outline.stamp_ns, str(error)))
                    continue
            count += 1
            yield outline
        self._end_pass(count)

    def _outlines(self, wanted: Container[int]) -> Iterator[FrameOutline]:
        del wanted  # the pixels are here anyway
        return (_outline_of(frame) for frame in self._frames())


def _check_region(roi: tuple[int, int, int, int], size_px: tuple[int, int]) -> None:
    x, y, width, height = roi
    if x + width > size_px[0] or y + height > size_px[1]:
        raise BagError(
            f"a region from ({x}, {y}) to ({x + width}, {y + height}) px in an image of "
            f"{size_px[0]} x {size_px[1]} px",
            expected="a region within the image",
            do="choose --roi X,Y,WIDTH,HEIGHT within it",
        )


def _crop_outline(outline: FrameOutline, roi: tuple[int, int, int, int]) -> FrameOutline:
    _check_region(roi, outline.size_px)
    x, y, width, height = roi
    image = outline.image
    return replace(
        outline,
        size_px=(width, height),
        magnification=outline.magnification * outline.size_px[0] / width,
        image=None if image is None else image[y : y + height, x : x + width],
    )


def _crop(frame: RecordedFrame, roi: tuple[int, int, int, int]) -> RecordedFrame:
    """Part of a frame, whose field is narrower."""
    x, y, width, height = roi
    full = frame.image.shape[:2]
    _check_region(roi, (full[1], full[0]))
    image = frame.image[y : y + height, x : x + width]
    mask = None if frame.mask is None else frame.mask[y : y + height, x : x + width]
    magnification = frame.magnification * full[1] / width
    return replace(frame, image=image, magnification=magnification, mask=mask)


class _BagRecording(Recording):
    """Images and magnifications of a rosbag2 recording."""

    def __init__(self, path: Path, config: MicroscopeConfig, given: RecordedFiles) -> None:
        super().__init__(path, config, roi=given.roi, mask=given.mask)
        self._given = given
        rows = given.databar_rows
        stated = config.image.databar_rows if rows is None else rows
        self._databar_rows = stated or 0
        self._reader = open_bag(path)
        self._track: MagnificationTrack | None = None
        try:
            self._image_topic, notes = find_image_topic(path, self._reader.topics, config.image)
            self._notes.extend(notes)
            magnification_topic = self._find_magnification(config.magnification)
            if magnification_topic is not None:
                self._track = MagnificationTrack(self._reader, magnification_topic.name, config)
        except BaseException:
            self._reader.close()
            raise
        if magnification_topic is not None and self._track is not None:
            self._note_bad_magnifications(magnification_topic, self._track)
        self._stage, notes = find_stage(self._reader, config, self._image_topic.name)
        self._notes.extend(notes)
        self._conditions = find_conditions(self._reader, self._image_topic.name)
        self._moved = 0
        if stated is None:
            self._cut_databar()

    def _cut_databar(self) -> None:
        """Find a bar of text that nobody stated as a node does that receives these images, and note it."""
        finder = DatabarFinder()
        for raw in islice(self._reader.raw_messages([self._image_topic.name]), _AMONG):
            try:
                pixels, _ = decoded_image(self._reader.decode(raw))
            except SemcalError:
                continue
            finder.find_rows(pixels)
            if finder.rows is not None:
                break
        if finder.candidate:
            self._databar_rows = finder.candidate
            self._notes.append(
                f"the lowest {finder.candidate} rows are a data bar and are cut off; --databar-rows 0 keeps them"
            )

    def _find_magnification(self, source: MagnificationConfig) -> BagTopic | None:
        """The topic of the magnification; None where the user states it."""
        stated = self._given.magnification is not None or self._given.pixel_size_m is not None
        exists = any(t.type == source.type and t.count for t in self._reader.topics)
        if stated and not exists:
            return None
        try:
            topic, note = self._find_number(source)
        except BagError as error:
            if exists:
                raise
            raise UnknownScaleError(
                error.seen,
                expected=error.expected,
                do=f"{error.do}, or state --pixel-size or --magnification",
            ) from error
        if stated:
            raise BagError(
                f"a magnification or pixel size stated for {self.path}, which has the topic {topic.name}",
                expected="one source of the magnification",
                do="leave --magnification and --pixel-size out",
            )
        if note:
            self._notes.append(note)
        return topic

    def _find_number(self, source: MagnificationConfig) -> tuple[BagTopic, str]:
        return find_topic(
            self.path,
            self._reader.topics,
            what="magnification",
            wanted=source.topic,
            type_name=source.type,
        )

    def _note_bad_magnifications(self, topic: BagTopic, track: MagnificationTrack) -> None:
        bad = track.bad
        if track.usable == 0:
            self._reader.close()
            reason = f"{_first(len(bad))}: {bad[0]}" if bad else ""
            raise BagError(
                f"{topic.name} in {self.path} has {counted(len(bad), 'message')} and no valid magnification"
                f"{reason}",
                expected="at least one message with a finite value above 0",
                do="record the magnification topic together with the images",
            )
        if bad:
            self._notes.append(
                f"{counted(len(bad), 'message')} on {topic.name} ignored{_first(len(bad))}: {bad[0]}"
            )

    def close(self) -> None:
        self._reader.close()

    @property
    def topics(self) -> tuple[BagTopic, ...]:
        return self._reader.topics

    @property
    def frame_count(self) -> int:
        return self._image_topic.count

    @property
    def scale_source(self) -> str:
        if self._given.pixel_size_m is not None:
            return "the pixel size given"
        if self._given.magnification is not None:
            return f"the magnification given, {self._describe_display(given=self._given.display_width_m is not None)}"
        if self.config.magnification.quantity == "magnification":
            return f"recorded magnifications, {self._describe_display(given=self._given.display_width_m is not None)}"
        return f"the recorded {self.config.magnification.quantity.replace('_', ' ')}"

    @property
    def pixel_size_stated(self) -> bool:
        return self._given.pixel_size_m is not None

    def _frames(self) -> Iterator[RecordedFrame]:
        return self._read(lambda raw, _index: self._frame(raw))

    def _frames_from(self, start: int) -> Iterator[tuple[int, RecordedFrame]]:
        def make(raw: RawMessage, index: int) -> tuple[tuple[int, RecordedFrame] | None, bool]:
            if index < start:
                return None, True
            frame, stamped = self._frame(raw)
            return (None if frame is None else (index, frame)), stamped

        return self._read(make)

    def _outlines(self, wanted: Container[int]) -> Iterator[FrameOutline]:
        return self._read(lambda raw, index: self._outline(raw, index in wanted))

    def _read(self, make: Callable[[RawMessage, int], tuple[T | None, bool]]) -> Iterator[T]:
        """Make something of each image; what is left out is noted."""
        without, unstamped, images = 0, 0, 0
        self._moved = 0
        for raw in self._reader.raw_messages([self._image_topic.name]):
            if raw.type != self._image_topic.type:
                continue
            images += 1
            try:
                frame, stamped = make(raw, images - 1)
            except SemcalError as error:
                self._rejected.append(RejectedFrame(raw.log_time_ns, str(error)))
                continue
            unstamped += not stamped
            if frame is None:
                without += 1
                continue
            yield frame
        if without:
            self._pass_notes.append(
                f"{counted(without, 'image has', 'images have')} no valid magnification at their time"
            )
        if unstamped:
            self._pass_notes.append(
                f"{counted(unstamped, 'image has', 'images have')} no header stamp: the recorder's time is used"
            )
        if self._moved:
            self._pass_notes.append(
                f"the stage moved during {counted(self._moved, 'image')}: its readings are not used there"
            )
        if images < self.frame_count:
            self._pass_notes.append(
                f"the recording declares {counted(self.frame_count, 'image')} but holds {images}"
            )

    def _magnify(self, stamp_ns: int, log_time_ns: int, width_px: int) -> float | None:
        if self._track is not None:
            return self._track.at(stamp_ns, log_time_ns, width_px)
        if self._given.pixel_size_m is not None:
            return self.config.display_width_m / (self._given.pixel_size_m * width_px)
        return self._given.magnify(self.config.display_width_m)

    def _outline(self, raw: RawMessage, decode: bool) -> tuple[FrameOutline | None, bool]:
        """As :meth:`_frame`; a compressed image is only decoded on demand."""
        message = self._reader.decode(raw)
        digest = zlib.crc32(message.data)
        compressed = hasattr(message, "format")
        if compressed and not decode:
            (width, height), encoding = describe_compressed(message)
            blank = np.broadcast_to(np.uint8(0), (height, width))  # takes no memory
            image = without_databar(blank, self._databar_rows)
            frame, stamped = self._place(raw, message, image, encoding)
        else:
            frame, stamped = self._frame(raw)
        if frame is None:
            return None, stamped
        outline = _outline_of(frame, digest)
        return (replace(outline, image=None) if compressed and not decode else outline), stamped

    def _frame(self, raw: RawMessage) -> tuple[RecordedFrame | None, bool]:
        """The frame of a message (``None`` without magnification); whether it has a stamp."""
        message = self._reader.decode(raw)
        pixels, encoding = decoded_image(message)
        return self._place(raw, message, without_databar(pixels, self._databar_rows), encoding)

    def _conditions_at(self, stamp_ns: int, log_time_ns: int) -> Conditions | None:
        return None if self._conditions is None else self._conditions.at(stamp_ns, log_time_ns)

    def _place(
        self, raw: RawMessage, message: Any, image: NDArray[Any], encoding: str
    ) -> tuple[RecordedFrame | None, bool]:
        """The frame of an image, with what other topics say at its time."""
        stamp_ns = stamp_ns_from_msg(message)
        require_fields(message.header, ("frame_id",), "std_msgs/msg/Header")
        magnification = self._magnify(stamp_ns or raw.log_time_ns, raw.log_time_ns, image.shape[1])
        if magnification is None:
            return None, stamp_ns != 0
        stage, moved = None, False
        if self._stage is not None:
            stage, moved = self._stage.at(stamp_ns or raw.log_time_ns, raw.log_time_ns)
        self._moved += moved
        return (
            RecordedFrame(
                image=image,
                stamp_ns=stamp_ns or raw.log_time_ns,
                log_time_ns=raw.log_time_ns,
                magnification=magnification,
                frame_id=str(message.header.frame_id),
                encoding=encoding,
                stage=stage,
                conditions=self._conditions_at(stamp_ns or raw.log_time_ns, raw.log_time_ns),
            ),
            stamp_ns != 0,
        )


class _ImageRecording(Recording):
    """Image files, with magnifications that refer to one display width."""

    def __init__(
        self, path: Path, config: MicroscopeConfig, series: ImageSeries, given: RecordedFiles
    ) -> None:
        super().__init__(path, config, roi=given.roi, mask=given.mask)
        self._given = given
        self._series = series
        self._notes.extend(series.notes)

    @property
    def frame_count(self) -> int:
        return len(self._series.images)

    @property
    def scale_source(self) -> str:
        if self._given.pixel_size_m is not None:
            return "the pixel size given"
        if self._given.magnification is not None:
            return f"the magnification given, {self._describe_display(given=self._given.display_width_m is not None)}"
        return "the pixel size in the files"

    @property
    def pixel_size_stated(self) -> bool:
        if self._given.pixel_size_m is not None or self._given.magnification is not None:
            return self._given.pixel_size_m is not None
        # An OME-TIFF or a picture that ImageJ saved has a pixel size, but no settings of a microscope.
        pages = [image.page for image in self._series.images]
        assumed = (p.settings is not None and p.settings.display_width_assumed for p in pages)
        return all(p.pixel_size_m is not None for p in pages) and not any(assumed)

    def _outlines(self, wanted: Container[int]) -> Iterator[FrameOutline]:
        chosen = {id(image) for k, image in enumerate(self._series.images) if k in wanted}
        for _, group in groupby(self._series.images, key=lambda image: id(image.file)):
            images = list(group)
            ends = [k for k, image in enumerate(images, 1) if id(image) in chosen]
            read = images[: ends[-1] if ends else 0]
            for image, pixels in self._series.read(read):
                if isinstance(pixels, SemcalError):
                    self._rejected.append(RejectedFrame(image.stamp_ns, str(pixels)))
                    continue
                yield _outline_of(self._frame(image, pixels))
            for image in images[len(read) :]:
                width, height = image.page.size_px
                yield FrameOutline(
                    image.stamp_ns,
                    image.magnification,
                    (width, height - image.databar_rows),
                    "",
                    image.stage,
                    image.name,
                    image.conditions,
                )

    def _frames(self) -> Iterator[RecordedFrame]:
        for image, pixels in self._series.read():
            if isinstance(pixels, SemcalError):
                self._rejected.append(RejectedFrame(image.stamp_ns, str(pixels)))
                continue
            yield self._frame(image, pixels)

    def _frames_from(self, start: int) -> Iterator[tuple[int, RecordedFrame]]:
        images = self._series.images
        first = min(start, len(images))
        # A file of several is read from its beginning.
        while 0 < first < len(images) and images[first - 1].file is images[first].file:
            first -= 1
        for number, (image, pixels) in enumerate(self._series.read(images[first:]), first):
            if number >= start and not isinstance(pixels, SemcalError):
                yield number, self._frame(image, pixels)

    def _frame(self, image: SeriesImage, pixels: NDArray[Any]) -> RecordedFrame:
        return RecordedFrame(
            image=pixels,
            stamp_ns=image.stamp_ns,
            log_time_ns=image.stamp_ns,
            magnification=image.magnification,
            frame_id=self.config.frame_id,
            encoding=ENCODINGS[pixels.dtype.name],
            stage=image.stage,
            file_name=image.name,
            conditions=image.conditions,
        )


def open_image_series(given: RecordedFiles, config: MicroscopeConfig) -> ImageSeries:
    """Collect image files as one series, read with this configuration.

    Its display width is what magnifications refer to, and its databar rows, if it states them, are used in place of
    what the files say.

    Raises
    ------
    BagError
        No file is usable, or their scale is not known, or known twice.
    """
    paths = [path for pattern in given.paths for path in find_image_files(pattern)]
    rows = given.databar_rows
    return list_image_series(
        paths,
        display_width_m=config.display_width_m,
        databar_rows=config.image.databar_rows if rows is None else rows,
        pixel_size_m=given.pixel_size_m,
        magnification=given.magnify(config.display_width_m),
        frame_interval_s=given.frame_interval_s,
        stage=config.stage is not None,
    )


def open_recording(
    source: str | os.PathLike[str] | RecordedFiles,
    config: MicroscopeConfig | None = None,
    *,
    magnification: float | None = None,
) -> Recording:
    """Open a recording or image files for reading frames.

    Parameters
    ----------
    source
        A rosbag2 folder, an ``.mcap`` or ``.db3`` file, or image files; :class:`RecordedFiles` says which, and
        what they do not say themselves.
    config
        How the microscope's topics are named and what they carry; ``generic`` by default. For
        image files, its display width is what magnifications refer to, and its databar rows, if not
        0, are used in place of what the files say.
    magnification
        As of :class:`RecordedFiles`.

    Raises
    ------
    BagError
        The recording is missing, damaged, of another kind, or without images or magnification.
    """
    given = source if isinstance(source, RecordedFiles) else RecordedFiles(source)
    if magnification is not None:
        given = replace(given, magnification=magnification)
    used = load_config("generic") if config is None else config
    path, *others = given.paths or (Path(),)
    with reading(path):
        bag = not others and is_bag(path)
    if not bag:
        for other in others:
            if other.is_dir() or is_bag(other):
                raise BagError(
                    f"{other} besides {path}",
                    expected="one bag, one folder, or several image files",
                )
        with reading(path):
            return _ImageRecording(path, used, open_image_series(given, used), given)
    if given.frame_interval_s is not None:
        raise BagError(
            f"a frame interval stated for {path}",
            expected="image files: the images of a bag have stamps",
            do="leave --frame-interval out",
        )
    return _BagRecording(path, used, given)
