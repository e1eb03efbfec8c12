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

"""An image file of any kind, and what it says about each of its images.

TIFF files and videos have modules of their own; files of one image (PNG, JPEG, BMP, GIF, WebP) are read here.
Another format begins in :func:`is_image_file` and :func:`describe_image_file`.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from semcal_ros.core.errors import BagError, SemcalError, TiffError
from semcal_ros.files.images.sem_image import VendorSettings
from semcal_ros.files.images.tiff_stack import list_tiff_stack, read_tiff_stack
from semcal_ros.files.tiff.read import (
    is_tiff,
    read_page_settings,
    read_sem_pages,
    side_file_settings,
)
from semcal_ros.files.video import VIDEO_SUFFIXES, describe_video, read_video

#: Suffixes of these files.
PLAIN_IMAGES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".gif", ".webp"})

# EXIF: the directory of the camera, and in it the time of the exposure.
_CAMERA, _TAKEN = 0x8769, 0x9003
# The rows of the sensor, however the camera was held.
_AS_STORED = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION


@dataclass(frozen=True)
class ImagePage:
    """What a file says about one of its images.

    Attributes
    ----------
    size_px
        (width, height) as stored, databar included.
    databar_rows
        Rows at the bottom that are not part of the scan.
    pixel_size_m
        Pixel size on the specimen, or None where the file does not say it.
    offset_s
        Time from the first image of the file, or None.
    settings
        The settings of the microscope, or None.
    """

    size_px: tuple[int, int]
    databar_rows: int = 0
    pixel_size_m: float | None = None
    offset_s: float | None = None
    settings: VendorSettings | None = None


@dataclass(frozen=True)
class ImageFile:
    """A readable file and its images, in the order of time.

    Attributes
    ----------
    path
        The file.
    pages
        At least one.
    read
        Yields the stored images of the pages, (h, w) grey levels with the databar. It raises where it yields, so that
        what is wrong with one image counts for that image only.
    time
        Local time of the first image, or None.
    notes
        Notes for the user, which do not name the file.
    no_scale
        Why the file has no pixel size, where it has none.
    """

    path: Path
    pages: tuple[ImagePage, ...]
    read: Callable[[], Iterator[NDArray[Any]]]
    time: datetime | None = None
    notes: tuple[str, ...] = ()
    no_scale: str = ""

    @property
    def pixel_size_m(self) -> float | None:
        """Pixel size of the first image."""
        return self.pages[0].pixel_size_m


def is_image_file(path: Path) -> bool:
    """Whether the name is that of an image, a stack of them, or a video."""
    suffix = path.suffix.lower()
    return is_tiff(path) or suffix in PLAIN_IMAGES or suffix in VIDEO_SUFFIXES


def describe_image_file(path: Path) -> ImageFile:
    """Read what a file says about its images, without decoding them.

    Raises
    ------
    BagError, TiffError
        The file is missing or damaged, or none of the known formats.
    """
    if is_tiff(path):
        return _describe_tiff(path)
    if path.suffix.lower() in VIDEO_SUFFIXES:
        return _describe_video(path)
    return _describe_plain(path)


def _describe_tiff(path: Path) -> ImageFile:
    try:
        return _describe_sem(path)
    except TiffError as error:
        reason = error.seen
    stack = list_tiff_stack(path)
    pages = tuple(
        ImagePage(
            size,
            stack.databar_rows if stack.databar_rows < size[1] else 0,
            stack.pixel_size_m,
            None if stack.offsets_s is None else stack.offsets_s[k],
        )
        for k, size in enumerate(stack.sizes_px)
    )
    return ImageFile(
        path,
        pages,
        lambda: read_tiff_stack(path, stack.pages),
        stack.taken,
        stack.notes,
        no_scale="" if stack.pixel_size_m else reason,
    )


def _describe_sem(path: Path) -> ImageFile:
    listed, channel_notes = _first_detector(read_page_settings(path))
    pages = tuple(
        _page_of(settings, size, k * interval if (interval := _interval_s(settings)) else None)
        for k, (_, settings, size) in enumerate(listed)
    )
    first = listed[0][1]
    notes = tuple(dict.fromkeys(note for _, settings, _ in listed for note in settings.notes))
    wanted = frozenset(index for index, _, _ in listed)
    return ImageFile(
        path, pages, lambda: _read_sem(path, wanted), first.time, (*notes, *channel_notes)
    )


_Listed = tuple[int, VendorSettings, tuple[int, int]]


def _first_detector(listed: tuple[_Listed, ...]) -> tuple[list[_Listed], tuple[str, ...]]:
    """Images of the first of several detectors that a file has equally many images of, and a note."""
    count = Counter(settings.detector for _, settings, _ in listed)
    if len(count) == 1 or len(set(count.values())) > 1:
        return list(listed), ()
    first = listed[0][1].detector
    note = f"the first of {len(count)} channels is used" + (f" ({first})" if first else "")
    return [one for one in listed if one[1].detector == first], (note,)


def _page_of(
    settings: VendorSettings, size_px: tuple[int, int], offset_s: float | None = None
) -> ImagePage:
    return ImagePage(size_px, settings.databar_rows, settings.pixel_size_m, offset_s, settings)


def _interval_s(settings: VendorSettings) -> float | None:
    return settings.frame_interval_s or settings.frame_time_s


def _read_sem(path: Path, wanted: frozenset[int]) -> Iterator[NDArray[Any]]:
    pages = read_sem_pages(path, databar_rows=0)
    return (page.image for page in pages if page.page in wanted)


def _describe_video(path: Path) -> ImageFile:
    video = describe_video(path)
    pages = tuple(ImagePage(video.size_px, offset_s=time_s) for time_s in video.times_s)
    return ImageFile(path, pages, lambda: read_video(path), no_scale="a video does not contain it")


def _describe_plain(path: Path) -> ImageFile:
    size, taken = describe_plain_image(path)
    why = f"{path.suffix[1:].upper()} files do not contain it"
    settings = None
    try:
        settings = side_file_settings(path, size)
    except SemcalError as error:
        why = str(error)
    page = ImagePage(size) if settings is None else _page_of(settings, size)

    def read() -> Iterator[NDArray[Any]]:
        yield read_plain_image(path)

    return ImageFile(
        path,
        (page,),
        read,
        taken if settings is None else settings.time,
        () if settings is None else settings.notes,
        "" if page.pixel_size_m else why,
    )


def describe_plain_image(path: Path) -> tuple[tuple[int, int], datetime | None]:
    """Return the (width, height) of an image, and when it was taken, where a camera wrote that down.

    Raises
    ------
    BagError
        The file cannot be read, or is no image.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of odd metadata, and of large images
            with Image.open(path) as image:
                taken = image.getexif().get_ifd(_CAMERA).get(_TAKEN)
                size = image.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        reason = getattr(error, "strerror", None)
        raise BagError(
            f"{path}: {reason}" if reason else f"{path}: not a readable image",
            expected="an intact 8 or 16 bit image file",
        ) from error
    try:
        return size, datetime.strptime(str(taken), "%Y:%m:%d %H:%M:%S")  # local time
    except ValueError:
        return size, None


def read_plain_image(path: Path) -> NDArray[Any]:
    """Read the grey values of an image file, 8 or 16 bit.

    Raises
    ------
    BagError
        The file cannot be read or decoded, or has another depth.
    """
    try:
        data = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise BagError(f"{path}: {error.strerror or error}", expected="a readable image") from error
    try:
        image = cv2.imdecode(data, _AS_STORED) if len(data) else None
    except cv2.error:
        image = None  # OpenCV raises for absurd sizes
    if image is None or image.dtype.name not in ("uint8", "uint16"):
        raise BagError(f"{path}: not a readable image", expected="an intact 8 or 16 bit image file")
    return image
