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

"""Frames with their magnification, from a recording or from a folder of SEM TIFFs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from semcal_ros.bridge.compressed import decoded_image
from semcal_ros.bridge.fields import require_fields
from semcal_ros.bridge.headers import stamp_ns_from_msg
from semcal_ros.bridge.images import without_databar
from semcal_ros.config.config import MagnificationConfig, MicroscopeConfig, load_config
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.camera.calibration_model import checked_magnification
from semcal_ros.core.errors import BagError, SemcalError
from semcal_ros.files.bags.errors import reading
from semcal_ros.files.bags.magnifications import MagnificationTrack
from semcal_ros.files.bags.reader import BagTopic, RawMessage, is_bag, open_bag
from semcal_ros.files.bags.stage import find_stage
from semcal_ros.files.bags.topics import find_image_topic, find_topic
from semcal_ros.files.plain_images import plain_image_paths, read_plain_image
from semcal_ros.files.tiff.folder import TiffFolder, scan_tiff_folder
from semcal_ros.files.tiff.read import is_tiff

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["RecordedFrame", "Recording", "RejectedFrame", "open_recording"]


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
    """

    image: NDArray[Any]
    stamp_ns: int
    log_time_ns: int
    magnification: float
    frame_id: str
    encoding: str
    stage: StageReading | None = None
    file_name: str = ""


@dataclass(frozen=True)
class RejectedFrame:
    """A message or file that was left out, and the reason."""

    log_time_ns: int
    reason: str


class Recording(ABC):
    """An open recording; use :func:`open_recording`, and close it or use it as a context manager.

    Attributes
    ----------
    path
        What was opened.
    config
        The microscope's configuration that says how to read it.
    """

    def __init__(self, path: Path, config: MicroscopeConfig) -> None:
        self.path = path
        self.config = config
        self._notes: list[str] = []
        self._pass_notes: list[str] = []
        self._rejected: list[RejectedFrame] = []

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
        for frame in self._frames():
            count += 1
            yield frame
        if self._rejected:
            first = self._rejected[0].reason
            self._pass_notes.append(
                f"{len(self._rejected)} images were left out, the first: {first}"
            )
        if count == 0:
            raise BagError(
                f"no image of {self.frame_count} in {self.path} is usable: "
                + (" / ".join(self._pass_notes) or "there are no images"),
                expected="at least one image of a known encoding with a valid magnification",
            )

    @abstractmethod
    def _frames(self) -> Iterator[RecordedFrame]: ...


class _BagRecording(Recording):
    """Images and magnifications of a rosbag2 recording."""

    def __init__(self, path: Path, config: MicroscopeConfig) -> None:
        super().__init__(path, config)
        self._reader = open_bag(path)
        try:
            self._image_topic, notes = find_image_topic(path, self._reader.topics, config.image)
            self._notes.extend(notes)
            magnification_topic = self._find_magnification(config.magnification)
            self._track = MagnificationTrack(self._reader, magnification_topic.name, config)
        except BaseException:
            self._reader.close()
            raise
        self._note_bad_magnifications(magnification_topic)
        self._stage, notes = find_stage(self._reader, config, self._image_topic.name)
        self._notes.extend(notes)
        self._moved = 0

    def _find_magnification(self, source: MagnificationConfig) -> BagTopic:
        topic, note = find_topic(
            self.path,
            self._reader.topics,
            what="magnification",
            wanted=source.topic,
            type_name=source.type,
        )
        if note:
            self._notes.append(note)
        return topic

    def _note_bad_magnifications(self, topic: BagTopic) -> None:
        bad = self._track.bad
        if self._track.usable == 0:
            self._reader.close()
            reason = f", the first: {bad[0]}" if bad else ""
            raise BagError(
                f"{topic.name} in {self.path} has {len(bad)} messages and no valid magnification"
                f"{reason}",
                expected="at least one message with a finite value above 0",
                do="record the magnification topic together with the images",
            )
        if bad:
            self._notes.append(
                f"{len(bad)} messages on {topic.name} are ignored, the first: {bad[0]}"
            )

    def close(self) -> None:
        self._reader.close()

    @property
    def topics(self) -> tuple[BagTopic, ...]:
        return self._reader.topics

    @property
    def frame_count(self) -> int:
        return self._image_topic.count

    def _frames(self) -> Iterator[RecordedFrame]:
        without, unstamped, images = 0, 0, 0
        self._moved = 0
        for raw in self._reader.raw_messages([self._image_topic.name]):
            if raw.type != self._image_topic.type:
                continue
            images += 1
            try:
                frame, stamped = self._frame(raw)
            except SemcalError as error:
                self._rejected.append(RejectedFrame(raw.log_time_ns, str(error)))
                continue
            unstamped += not stamped
            if frame is None:
                without += 1
                continue
            yield frame
        if without:
            self._pass_notes.append(f"{without} images have no valid magnification at their time")
        if unstamped:
            self._pass_notes.append(
                f"{unstamped} images have no header stamp: the recorder's time is used"
            )
        if self._moved:
            self._pass_notes.append(
                f"the stage moved during {self._moved} images: its readings are not used for them"
            )
        if images < self.frame_count:
            self._pass_notes.append(
                f"the recording declares {self.frame_count} images but holds {images}"
            )

    def _frame(self, raw: RawMessage) -> tuple[RecordedFrame | None, bool]:
        """The frame of a message (``None`` without magnification); whether it has a stamp."""
        message = self._reader.decode(raw)
        pixels, encoding = decoded_image(message)
        image = without_databar(pixels, self.config.image.databar_rows)
        stamp_ns = stamp_ns_from_msg(message)
        require_fields(message.header, ("frame_id",), "std_msgs/msg/Header")
        magnification = self._track.at(stamp_ns or raw.log_time_ns, raw.log_time_ns, image.shape[1])
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
            ),
            stamp_ns != 0,
        )


class _TiffRecording(Recording):
    """Images of a folder of SEM TIFFs, with magnifications that refer to one display width."""

    def __init__(self, path: Path, config: MicroscopeConfig, folder: TiffFolder) -> None:
        super().__init__(path, config)
        self._folder = folder
        self._notes.extend(folder.notes)
        self._notes.extend(f"{s.name} is skipped: {s.reason}" for s in folder.skipped)

    @property
    def frame_count(self) -> int:
        return len(self._folder.entries)

    def _frames(self) -> Iterator[RecordedFrame]:
        for entry in self._folder.entries:
            try:
                loaded = entry.load()
            except SemcalError as error:
                self._rejected.append(RejectedFrame(entry.stamp_ns, str(error)))
                continue
            yield RecordedFrame(
                image=loaded.image,
                stamp_ns=entry.stamp_ns,
                log_time_ns=entry.stamp_ns,
                magnification=entry.magnification,
                frame_id=self.config.frame_id,
                encoding="mono8" if loaded.image.dtype.itemsize == 1 else "mono16",
                stage=entry.stage,
                file_name=entry.path.name,
            )


class _PlainRecording(Recording):
    """Ordinary image files, all of one magnification."""

    def __init__(self, path: Path, config: MicroscopeConfig, magnification: float) -> None:
        super().__init__(path, config)
        self._paths = plain_image_paths(path)
        self._magnification = magnification

    @property
    def frame_count(self) -> int:
        return len(self._paths)

    def _frames(self) -> Iterator[RecordedFrame]:
        for index, path in enumerate(self._paths):
            # The files have no times: any spacing would do.
            stamp_ns = (index + 1) * 1_000_000_000
            try:
                image = without_databar(read_plain_image(path), self.config.image.databar_rows)
            except SemcalError as error:
                self._rejected.append(RejectedFrame(stamp_ns, str(error)))
                continue
            yield RecordedFrame(
                image=image,
                stamp_ns=stamp_ns,
                log_time_ns=stamp_ns,
                magnification=self._magnification,
                frame_id=self.config.frame_id,
                encoding="mono8" if image.dtype.itemsize == 1 else "mono16",
                file_name=path.name,
            )


def open_recording(
    path: str | Path, config: MicroscopeConfig | None = None, *, magnification: float | None = None
) -> Recording:
    """Open a recording or a folder of SEM TIFFs for reading frames.

    Parameters
    ----------
    path
        A rosbag2 folder, an ``.mcap`` or ``.db3`` file, a folder of SEM TIFFs or one TIFF.
    config
        How the microscope's topics are named and what they carry; ``generic`` by default. For
        TIFFs, its display width is what magnifications refer to, and its databar rows, if not
        0, are used in place of what the files say.
    magnification
        Magnification of all images of a folder of ordinary image files, which do not contain it. It is
        refused for recordings and SEM TIFFs, which contain theirs.

    Raises
    ------
    BagError
        The recording is missing, damaged, of another kind, or without images or magnification.
    TiffError
        No TIFF of a folder is usable.
    """
    path = Path(path)
    used = load_config("generic") if config is None else config
    with reading(path):
        kind = _frame_kind(path, magnification)
    if kind == "plain" and magnification is not None:
        return _PlainRecording(path, used, checked_magnification(magnification))
    if kind == "tiff":
        folder = scan_tiff_folder(
            path,
            display_width_m=used.display_width_m,
            databar_rows=used.image.databar_rows or None,
            stage=used.stage is not None,
        )
        return _TiffRecording(path, used, folder)
    return _BagRecording(path, used)


def _frame_kind(path: Path, magnification: float | None) -> str:
    """Return ``tiff``, ``plain`` or ``bag``; the bag reader reports what is wrong with anything else."""
    kind = "bag"
    if path.exists() and not is_bag(path):
        names = list(path.iterdir()) if path.is_dir() else [path]
        images = plain_image_paths(path)
        if any(is_tiff(name) for name in names):
            kind = "tiff"
        elif images and magnification is None:
            raise BagError(
                f"{path} has {len(images)} plain images such as {images[0].name}",
                expected="a rosbag2 folder, or SEM TIFFs, whose metadata have the pixel size",
                do="use the microscope's original TIFF files, or state the magnification of all images",
            )
        elif images:
            kind = "plain"
    if magnification is not None and kind != "plain":
        raise BagError(
            f"a magnification stated for {path}",
            expected="a folder of ordinary images: recordings and SEM TIFFs contain theirs",
        )
    return kind
