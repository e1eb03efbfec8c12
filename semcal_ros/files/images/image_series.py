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

"""Image files as a sequence of frames in time with one magnification scale."""

from __future__ import annotations

import glob
import re
import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcal_ros.bridge.conditions import Conditions
from semcal_ros.bridge.stage import doubt_unit
from semcal_ros.config.config import StageConfig
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.errors import BagError, SemcalError, UnknownScaleError
from semcal_ros.core.wording import counted, omit_numbers
from semcal_ros.files.bags.reader import is_bag
from semcal_ros.files.images.databar import DatabarFinder
from semcal_ros.files.images.image_file import (
    ImageFile,
    ImagePage,
    describe_image_file,
    is_image_file,
)
from semcal_ros.files.images.page_stamps import StampedPage, stamp_pages
from semcal_ros.files.images.sem_image import VendorSettings
from semcal_ros.text_files import name_similar_file

# What a maker's file and a user say about a pixel may differ in their last digits.
_SAME_SCALE = 5e-3
# Files in which a bar of text is looked for.
_EXAMINED = 3
# A stage that turns back comes back to a fraction of this, rad.
_TURNED_RAD = 1e-3

_STAMP_S = 1.0  # makers give whole seconds
# Relative difference of two magnifications that is that of rounding, and no other setting.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Skipped:
    """A file that could not be used, and the reason."""

    name: str
    reason: str


@dataclass(frozen=True)
class SeriesImage:
    """One image of a series.

    Parameters
    ----------
    file
        The file that it comes from.
    page
        What the file says about it.
    stamp_ns
        Time of the image in ns since 1970: the file's local time taken as UTC, or as the user says.
    magnification
        On the common display width: width of the stored image = display width / magnification exactly.
    databar_rows
        Rows to cut off at the bottom.
    stage
        Where the stage was, or None where the file does not say it.
    """

    file: ImageFile
    page: ImagePage
    stamp_ns: int
    magnification: float
    databar_rows: int
    stage: StageReading | None = None

    @property
    def name(self) -> str:
        """Name of its file."""
        return self.file.path.name

    @property
    def conditions(self) -> Conditions | None:
        """How it was taken, where the file says it."""
        return self.page.settings

    def cut(self, stored: NDArray[Any]) -> NDArray[Any]:
        """Cut the databar off.

        Raises
        ------
        BagError
            If the image is of another size than the file said, or all of it is databar.
        """
        if stored.shape != self.page.size_px[::-1]:
            raise BagError(
                f"{self.name}: an image of {stored.shape[1]} x {stored.shape[0]} px",
                expected=f"{self.page.size_px[0]} x {self.page.size_px[1]} px, as the file says",
            )
        rows = stored.shape[0] - self.databar_rows
        if rows <= 0:
            raise BagError(
                f"{self.databar_rows} rows of databar in {self.name}",
                expected=f"0 to {stored.shape[0] - 1}",
                do="correct --databar-rows",
            )
        return stored[:rows]


@dataclass(frozen=True)
class ImageSeries:
    """Images in the order of their stamps.

    Parameters
    ----------
    images
        At least one; those of one file follow each other.
    display_width_m
        The display width that all magnifications refer to.
    skipped
        Files that look like images and cannot be used.
    notes
        Notes for the user: where stamps, scale and display width come from.
    """

    images: tuple[SeriesImage, ...]
    display_width_m: float
    skipped: tuple[Skipped, ...]
    notes: tuple[str, ...]

    def read(
        self, images: Sequence[SeriesImage] | None = None
    ) -> Iterator[tuple[SeriesImage, NDArray[Any] | SemcalError]]:
        """Yield each image with its pixels, or with the reason why it has none; files are opened once.

        Parameters
        ----------
        images
            Those to read, in their order and without gaps in a file; by default all.
        """
        chosen = self.images if images is None else images
        for _, group in groupby(chosen, key=lambda image: id(image.file)):
            images = list(group)
            pixels = images[0].file.read()
            for number, image in enumerate(images):
                try:
                    stored = next(pixels)
                    yield image, image.cut(stored)
                except StopIteration:  # noqa: PERF203  # each image may fail
                    missing = len(images) - number
                    reason = BagError(
                        f"{image.name} ends {counted(missing, 'image')} early",
                        expected="an intact file",
                    )
                    yield from ((lost, reason) for lost in images[number:])
                    break
                except SemcalError as error:
                    yield image, error


def _settings_of(image: StampedPage) -> Conditions:
    return image.page.settings or Conditions()


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Sort key that puts ``image_9`` before ``image_10``."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part]


def find_image_files(path: Path) -> list[Path]:
    """Image files in a folder, of a pattern such as ``scans/*.tif``, or the one file; images in natural order.

    Raises
    ------
    BagError
        There are none, or the path is that of a bag.
    """
    if is_bag(path):
        raise BagError(
            f"{path} is a bag",
            expected="image files: an image (TIFF, PNG, JPEG, BMP), a video, or a folder or pattern of them",
            do="give a bag alone: every command reads it as it is",
        )
    if path.is_dir():
        listed = [p for p in path.iterdir() if p.is_file() and is_image_file(p)]
        what = f"{path} has no image file"
    elif path.is_file():
        listed = [path] if is_image_file(path) else []
        what = f"{path} does not have the name of an image or a video"
    elif path.exists():
        # A pipe would be waited for.
        listed, what = [], f"{path} is no regular file"
    elif glob.has_magic(str(path)):
        found = (Path(name) for name in glob.glob(str(path), recursive=True))
        listed = [p for p in found if p.is_file() and is_image_file(p)]
        what = f"no image file is called {path}"
    else:
        listed, what = [], f"{path} does not exist"
    if not listed:
        instead = _name_folder_below(path) if path.is_dir() else ""
        if not path.exists():
            instead = name_similar_file(path)
        raise BagError(
            what,
            expected="a rosbag2 folder, an image (TIFF, PNG, JPEG, BMP), a video, or a folder or pattern of them",
            do=instead or "check the path",
        )
    return sorted(listed, key=_natural)


def _name_folder_below(path: Path) -> str:
    """Advice where the images are in folders of the one given; empty where they are not."""
    folders = sorted((p for p in path.iterdir() if p.is_dir()), key=_natural)
    for folder in folders:
        if is_bag(folder) or any(is_image_file(p) for p in folder.iterdir()):
            return f"folders below are not read: give one, such as {folder}"
    return ""


def refuse_images(path: Path) -> None:
    """Refuse images for what needs a bag, with the command that makes one; all else is for the reader of bags.

    Raises
    ------
    BagError
        The path is that of images, and of no bag.
    """
    if is_bag(path):
        return
    if path.is_dir():
        files = list(path.iterdir())
    else:
        files = [Path(name) for name in glob.glob(str(path))] if not path.exists() else [path]
    if any(is_image_file(file) for file in files):
        raise BagError(
            f"{path} has images, and no bag",
            expected="a rosbag2 folder, or an .mcap or .db3 file",
            do=f"make one with `semcal import {shlex.quote(str(path))} BAG`, and give that",
        )


def _collect(paths: Sequence[Path]) -> tuple[list[ImageFile], list[Skipped]]:
    found, skipped = [], []
    for path in paths:
        try:
            found.append(describe_image_file(path))
        except SemcalError as error:  # noqa: PERF203  # each file may fail
            skipped.append(Skipped(path.name, str(error)))
    return found, skipped


def _stages(found: Sequence[StampedPage]) -> tuple[list[StageReading | None], list[str]]:
    """Return what the files say about the stage, as far as its meaning is known, and notes.

    Makers do not say in which sense they count a rotation. One that is the same in all files only adds
    to the unknown direction of the grid; one that changes is left out. With a scan rotation, the
    direction of the tilt axis in the image is not known, so the whole reading is left out.
    """
    turns = [_settings_of(image).stage_rotation_rad for image in found]
    known = [turn for turn in turns if turn is not None]
    turned = bool(known) and max(known) - min(known) > _TURNED_RAD
    readings: list[StageReading | None] = []
    doubts: dict[str, list[str]] = {}
    scan_rotated = 0
    for item, turn in zip(found, turns, strict=True):
        settings = _settings_of(item)
        rotated = abs(settings.scan_rotation_rad or 0.0) > _TURNED_RAD
        scan_rotated += rotated and settings.stage_tilt_rad is not None
        usable = settings.stage_tilt_rad is not None and not rotated
        reading = (
            StageReading(settings.stage_tilt_rad, None if turned else turn) if usable else None
        )
        if reading is not None and (doubt := doubt_unit(reading, StageConfig())):
            doubts.setdefault(doubt, []).append(item.file.path.name)
            reading = None
        readings.append(reading)
    notes = [
        f"the stage of {_some(names, 'image')} is not used: {doubt}"
        for doubt, names in doubts.items()
    ]
    if turned and any(readings):
        notes.append(
            "the rotation of the stage is not used: the files do not say in which sense it counts"
        )
    if scan_rotated:
        notes.append(
            f"the stage is not used for {counted(scan_rotated, 'file')} with a rotated scan: it is not known in "
            "which sense it counts"
        )
    tilted = any(r is not None and abs(r.tilt_rad or 0.0) > _TURNED_RAD for r in readings)
    if tilted:
        notes.append(
            "the tilts of the stage are as the files state them; stage.tilt_axis_deg of the configuration "
            "says about which axis and in which sense"
        )
    return readings, notes


def _one_detector(files: Sequence[ImageFile]) -> tuple[list[ImageFile], list[str]]:
    """Files without those of further detectors that saw the same scan, and a note about them."""
    known = [file for file in files if file.pages[0].settings is not None]
    first = [(file.pages[0].settings, file.pages[0].size_px) for file in known]
    groups = group_by_scan([(settings, size) for settings, size in first if settings is not None])
    shared = [[known[k] for k in group] for group in groups if len(group) > 1]
    if not shared:
        return list(files), []
    count = Counter(_detector(file) for group in shared for file in group)
    used = max(count, key=lambda name: count[name])
    left_out = set()
    for group in shared:
        kept = next((file for file in group if _detector(file) == used), group[0])
        left_out |= {file.path for file in group if file is not kept}
    others = sorted({_detector(file) for file in known if file.path in left_out})
    note = (
        f"several detectors saw the same scan: of {counted(len(shared), 'scan')} the image of {used} is used; "
        f"{counted(len(left_out), 'image')} of {', '.join(others)} left out"
    )
    return [file for file in files if file.path not in left_out], [note]


def _detector(file: ImageFile) -> str:
    settings = file.pages[0].settings
    return "" if settings is None else settings.detector


def _some(names: Sequence[str], kind: str) -> str:
    """One name, or how many there are with the first."""
    return names[0] if len(names) == 1 else f"{counted(len(names), kind)} such as {names[0]}"


def _group_notes(files: Sequence[ImageFile]) -> list[str]:
    """The notes of files, each kind once: with the numbers of the first file."""
    kinds: dict[str, dict[str, str]] = {}
    for file in files:
        for note in file.notes:
            kinds.setdefault(omit_numbers(note), {}).setdefault(file.path.name, note)
    return [f"{_some(list(kind), 'file')}: {next(iter(kind.values()))}" for kind in kinds.values()]


def group_skipped(skipped: Sequence[Skipped]) -> list[str]:
    """Why files are skipped, each kind of reason once; a reason may name the file."""
    kinds: dict[str, list[Skipped]] = {}
    for item in skipped:
        kinds.setdefault(omit_numbers(item.reason.replace(item.name, "")), []).append(item)
    return [
        f"{_some([item.name for item in kind], 'file')} {'is' if len(kind) == 1 else 'are'} skipped: {kind[0].reason}"
        for kind in kinds.values()
    ]


def _scale(
    files: Sequence[ImageFile],
    display_width_m: float,
    pixel_size_m: float | None,
    magnification: float | None,
) -> tuple[list[ImageFile], list[Skipped], list[str]]:
    """Files whose scale is known, the others, and notes."""
    stated = [file for file in files if file.pixel_size_m is not None]
    if magnification is not None and stated:
        raise BagError(
            f"a magnification stated for {_some([file.path.name for file in stated], 'file')}, which "
            f"{'contains its own' if len(stated) == 1 else 'contain theirs'}",
            expected="--magnification only for images without a pixel size",
            do="leave it out; --pixel-size replaces what files say",
        )
    if pixel_size_m is not None:
        other = [
            file.pixel_size_m
            for file in stated
            if file.pixel_size_m and abs(file.pixel_size_m / pixel_size_m - 1.0) > _SAME_SCALE
        ]
        said = f"the pixel size is {1e9 * pixel_size_m:g} nm, as given"
        contradicted = (
            f", instead of {1e9 * other[0]:g} nm, which {counted(len(other), 'file says', 'files say')}"
            if other
            else ""
        )
        return list(files), [], [said + contradicted]
    if magnification is not None:
        return list(files), [], []
    unknown = [file for file in files if file.pixel_size_m is None]
    if not stated:
        first = unknown[0]
        raise UnknownScaleError(
            f"{_some([file.path.name for file in unknown], 'image file')} without a pixel size: {first.no_scale}",
            expected="the microscope's own files, or the scale",
            do="state it with --pixel-size such as 43.9nm, or with --magnification (which refers to a display width "
            f"of {1e3 * display_width_m:g} mm; --display-width states another)",
        )
    skipped = [
        Skipped(file.path.name, f"no pixel size, which others have: {file.no_scale}")
        for file in unknown
    ]
    return stated, skipped, []


def _cut_databars(
    images: tuple[SeriesImage, ...], display_width_m: float
) -> tuple[tuple[SeriesImage, ...], list[str]]:
    """Return the images without the bars of text that their files do not tell of, and a note.

    Some of the images are looked at. Those of one size have bars of one height, if they have any.
    """
    # The first one of a file, since others of it may be far into a video.
    firsts = {id(image.file): image for image in reversed(images)}
    untold = [image for image in firsts.values() if image.databar_rows == 0]
    examined = untold[:: max(1, len(untold) // _EXAMINED)][:_EXAMINED]
    finders: dict[tuple[int, int], DatabarFinder] = {}
    stored = ImageSeries(tuple(examined), display_width_m, (), ())
    for image, pixels in stored.read():
        if isinstance(pixels, np.ndarray):
            finders.setdefault(image.page.size_px, DatabarFinder()).find_rows(pixels)
    bars = {size: finder.candidate for size, finder in finders.items() if finder.candidate}
    if not bars:
        return images, []
    cut = tuple(
        replace(image, databar_rows=bars.get(image.page.size_px, 0))
        if image.databar_rows == 0
        else image
        for image in images
    )
    heights = " and ".join(str(height) for height in sorted(set(bars.values())))
    return cut, [
        f"the lowest {heights} rows are a data bar and are cut off; --databar-rows 0 keeps them"
    ]


def list_image_series(
    paths: Sequence[Path],
    *,
    display_width_m: float,
    databar_rows: int | None = None,
    pixel_size_m: float | None = None,
    magnification: float | None = None,
    frame_interval_s: float | None = None,
    stage: bool = True,
) -> ImageSeries:
    """Collect image files as one series; only what they say about themselves is read.

    Parameters
    ----------
    paths
        Image files, such as those of :func:`find_image_files`.
    display_width_m
        Display width that all magnifications are to refer to.
    databar_rows
        Rows to cut off at the bottom of every image, instead of those that the metadata give.
    pixel_size_m
        Pixel size of all images, instead of what files say.
    magnification
        Magnification of all images, of which no file gives the pixel size.
    frame_interval_s
        Time from one image to the next, instead of what files say.
    stage
        Whether to read where the stage was.

    Raises
    ------
    BagError
        No file is usable, or their scale is not known, or known twice.
    """
    found, skipped = _collect(paths)
    if not found and len(paths) == 1:
        name, reason = skipped[0].name, skipped[0].reason
        raise BagError(reason if name in reason else f"{name}: {reason}")
    if not found:
        raise BagError(
            f"{counted(len(paths), 'image file')}, none usable, the first "
            f"({skipped[0].name}): {skipped[0].reason}",
            expected="at least one intact image",
        )
    files, unscaled, scale_notes = _scale(found, display_width_m, pixel_size_m, magnification)
    files, detector_notes = _one_detector(files)
    stamped, stamp_notes = stamp_pages(files, frame_interval_s)
    readings, stage_notes = _stages(stamped)
    if not stage:
        readings, stage_notes = [None] * len(stamped), []
    if magnification is None and pixel_size_m is None:
        scale_notes.append(f"magnifications refer to a display width of {display_width_m:g} m")

    settings: list[float] = []

    def magnify(page: ImagePage) -> float:
        if magnification is not None:
            return magnification
        pixel_m = pixel_size_m or page.pixel_size_m or 0.0
        found = display_width_m / (pixel_m * page.size_px[0])
        # The same setting, where one file says 100 nm and the next one 0.1 um.
        known = next((g for g in settings if abs(found / g - 1.0) < _ROUNDING), None)
        if known is None:
            settings.append(found)
        return found if known is None else known

    images = tuple(
        SeriesImage(
            item.file,
            item.page,
            item.stamp_ns,
            magnify(item.page),
            item.page.databar_rows if databar_rows is None else databar_rows,
            reading,
        )
        for item, reading in zip(stamped, readings, strict=True)
    )
    left_out = (*skipped, *unscaled)
    bar_notes: list[str] = []
    if databar_rows is None:
        images, bar_notes = _cut_databars(images, display_width_m)
    return ImageSeries(
        images,
        display_width_m,
        left_out,
        (
            *scale_notes,
            *stamp_notes,
            *detector_notes,
            *stage_notes,
            *bar_notes,
            *_group_notes(files),
            *group_skipped(left_out),
        ),
    )


def _can_be_one_scan(first: VendorSettings, other: VendorSettings) -> bool:
    """Whether the same pass of the beam can have made two images.

    Scan, stage and microscope must be the same, and the second image must have come before a second pass can have
    ended: within a frame time, or within the whole second that the stamps resolve.
    """
    same = (
        "maker", "model", "serial_number", "beam", "acceleration_voltage_v", "pixel_size_m", "pixel_size_y_m",
        "working_distance_m", "scan_rotation_rad", "stage_tilt_rad", "stage_rotation_rad", "dwell_s", "frame_time_s",
    )  # fmt: skip
    if first.time is None or other.time is None:
        return False
    apart_s = abs((other.time - first.time).total_seconds())
    in_one_pass = apart_s == 0.0 or apart_s + _STAMP_S <= (first.frame_time_s or 0.0)
    return in_one_pass and all(getattr(first, name) == getattr(other, name) for name in same)


def group_by_scan(
    images: Sequence[tuple[VendorSettings, tuple[int, int]]],
) -> tuple[tuple[int, ...], ...]:
    """Group images whose detectors saw the same pass of the beam.

    Images without a detector or a time stand alone, and so does each of two images of one detector, which are two
    scans even in the same second.

    Parameters
    ----------
    images
        Settings and stored (width, height) of each image.

    Returns
    -------
    tuple
        Indices of each scan's images, in the order of the first of them; each index once.
    """
    groups: list[list[int]] = []
    for index, (settings, size_px) in enumerate(images):
        for group in groups:
            first, first_size_px = images[group[0]]
            detectors = {images[member][0].detector for member in group}
            if (
                settings.detector
                and "" not in detectors
                and settings.detector not in detectors
                and size_px == first_size_px
                and _can_be_one_scan(first, settings)
            ):
                group.append(index)
                break
        else:
            groups.append([index])
    return tuple(tuple(group) for group in groups)
