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

"""Read SEM images of any known maker: one page of a TIFF, or all of them, with its grey pixels.

Whose file it is, its tags say, else a text beside it (:func:`side_file_settings`); each maker has a module beside this
one.
"""

from __future__ import annotations

import logging
import struct
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from semcal_ros.bridge.codec_headers import MAX_PIXELS as MAX_MESSAGE_PIXELS
from semcal_ros.core.errors import TiffError
from semcal_ros.files.images.metadata import (
    XML_TAG,
    decode_text,
    find_side_file,
    parse_xml,
    read_side_file,
)
from semcal_ros.files.images.sem_image import SemImage, VendorSettings
from semcal_ros.files.tiff import hitachi, jeol, olympus, phenom, tescan, thermo_fisher, zeiss
from semcal_ros.files.tiff.imagej import (
    imagej_channels,
    imagej_entries,
    imagej_images,
    imagej_info,
    imagej_settings,
)

# These limits bound the memory that a damaged header can request.
MAX_SIDE_PX = 65_536
# Twice the largest image of a message, 1 GiB at 16 bits: the largest frame may have a data bar below
# it, and a user chooses files, whereas messages come from anyone.
MAX_PIXELS = 2 * MAX_MESSAGE_PIXELS
_MAX_SAMPLES = 4  # red, green, blue, alpha
# Above what Deflate (1032) and LZW reach: beyond, the pixels are not in the file.
_MAX_PACKING = 4096
# Tags of one number: sizes, compression, photometric, orientation, samples, rows per strip, planes, predictor, tiles.
_SINGLE = frozenset({256, 257, 259, 262, 266, 274, 277, 278, 284, 317, 322, 323})
# Offset of the first directory, number of its entries, and an entry's code, type, count and value.
_LAYOUTS = {42: (4, "I", "H", "HHI4x"), 43: (8, "Q", "Q", "HHQ8x")}
# OpenCV decodes other kinds, too, but shows damaged parts as black, without a word.
_DECODED_HERE = (
    tifffile.COMPRESSION.NONE,
    tifffile.COMPRESSION.ADOBE_DEFLATE,
    tifffile.COMPRESSION.DEFLATE,
)
_LUMA = np.array([0.299, 0.587, 0.114])  # ITU-R BT.601

SUFFIXES = (".tif", ".tiff")
# Bounds what a damaged chain of directories can request; a series of this length fills a day at 1 Hz.
_MAX_PAGES = 100_000
_REDUCED = 1  # bit of NewSubfileType that marks a preview
# What the TIFF parser raises on damaged bytes; caught only around calls of it.
_PARSER_ERRORS: tuple[type[Exception], ...] = (
    tifffile.TiffFileError,
    ValueError,
    TypeError,
    AttributeError,
    LookupError,
    ArithmeticError,
    MemoryError,
    RuntimeError,
    OSError,
    EOFError,
    struct.error,
    zlib.error,
    cv2.error,
)

# OpenCV 4.6, which rosdep installs on Ubuntu 24.04, has these functions elsewhere than later versions.
_OPENCV_LOG: Any = getattr(cv2.utils, "logging", cv2)


def check_directories(path: Path, *, pages: int = 1) -> int:
    """Return the number of directories, of ``pages`` at most, after a check that they can be parsed.

    Refused are several values in a single-value tag, which the parser would multiply, and directories in a loop, of
    which it would drop all but the first. Other damage is left to the parser, ``struct.error`` and ``OSError``
    included.
    """
    with path.open("rb") as file:
        head = file.read(16)
        order = {b"II": "<", b"MM": ">"}.get(head[:2])
        layout = _LAYOUTS.get(struct.unpack_from(order + "H", head, 2)[0]) if order else None
        if order is None or layout is None:
            return pages
        place, offset_code, number_code, entry_code = layout
        (offset,) = struct.unpack_from(order + offset_code, head, place)
        number_size, size = (struct.calcsize(order + code) for code in (number_code, entry_code))
        seen: set[int] = set()
        while offset and len(seen) < pages:
            if offset in seen:
                raise TiffError(
                    f"{path.name} has {len(seen)} directories in a loop",
                    expected="a last one",
                    do="copy it again from the microscope",
                )
            seen.add(offset)
            file.seek(offset)
            (number,) = struct.unpack(order + number_code, file.read(number_size))
            entries = file.read(min(number, 2**16) * size)
            for code, _, count in struct.iter_unpack(
                order + entry_code, entries[: len(entries) // size * size]
            ):
                if code in _SINGLE and count != 1:
                    raise TiffError(f"{path.name} has {count} values in tag {code}", expected="one")
            if len(seen) < pages:
                file.seek(offset + number_size + number * size)
                (offset,) = struct.unpack(
                    order + offset_code, file.read(struct.calcsize(order + offset_code))
                )
    return len(seen)


def page_size(path: Path, page: tifffile.TiffPage) -> tuple[int, int]:
    """Return the (width, height) of a page, checked before anything is allocated.

    Raises
    ------
    TiffError
        The page is empty, too large to be an SEM image, or larger than its file can hold.
    """
    width, height = int(page.imagewidth), int(page.imagelength)
    if not (
        0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX and width * height <= MAX_PIXELS
    ):
        raise TiffError(
            f"{path.name} declares {width} x {height} pixels",
            expected=f"at most {MAX_SIDE_PX} a side and {MAX_PIXELS} in all",
            do="check that the file is complete",
        )
    bits, samples = page.bitspersample, int(page.samplesperpixel)
    if (bits not in (8, 16) and not _is_float(page)) or page.imagedepth != 1:
        raise TiffError(
            f"{path.name} has {bits} bits per sample",
            expected="8 or 16, or grey levels of 32 bits with a decimal point",
            do="save it with 16 bits, in ImageJ by Image > Type > 16-bit",
        )
    if not 1 <= samples <= _MAX_SAMPLES:
        raise TiffError(
            f"{path.name} has {samples} samples per pixel", expected=f"1 to {_MAX_SAMPLES}"
        )
    size, needed = path.stat().st_size, width * height * samples * bits // 8
    if needed > size * (1 if page.compression == tifffile.COMPRESSION.NONE else _MAX_PACKING):
        raise TiffError(
            f"{path.name} declares {width} x {height} pixels in a file of {size} bytes",
            expected="a file that holds its pixels",
            do="copy it again from the microscope",
        )
    return width, height


def _is_float(page: tifffile.TiffPage) -> bool:
    """Whether the page has the grey levels with a decimal point that ImageJ writes as 32-bit."""
    return page.dtype == np.float32 and int(page.samplesperpixel) == 1


def _lookup(image: NDArray[Any], colormap: NDArray[Any]) -> NDArray[Any]:
    """Return the grey values of a palette image; the usual grey ramp leaves the indices as they are."""
    table = _LUMA @ np.asarray(colormap, dtype=np.float64) / 257.0
    ramp = np.linspace(0.0, 255.0, table.size)
    if image.dtype == np.uint8 and np.allclose(table, ramp, atol=1.0):
        return image
    return np.asarray(np.rint(table).astype(np.uint8)[image])


def _to_grey(image: NDArray[Any], page: tifffile.TiffPage) -> NDArray[Any]:
    if page.colormap is not None and image.ndim == 2:
        return _lookup(image, page.colormap)
    if image.ndim == 3:
        if page.planarconfig == tifffile.PLANARCONFIG.SEPARATE:
            image = np.moveaxis(image, 0, -1)
        mixed = image[..., :3].astype(np.float64) @ _LUMA
        return np.asarray(np.rint(mixed).astype(image.dtype))
    if page.photometric == tifffile.PHOTOMETRIC.MINISWHITE:
        # Grey levels with a decimal point have no largest value.
        white = 0 if image.dtype.kind == "f" else np.iinfo(image.dtype).max
        return np.asarray(white - image)
    return image


def _decode_by_opencv(path: Path, index: int) -> NDArray[Any]:
    """Decode a grey image with OpenCV's TIFF decoder, which needs no further packages for LZW."""
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
    if index == 0:
        image = cv2.imdecode(np.fromfile(path, dtype=np.uint8), flags)
    else:
        _, images = cv2.imreadmulti(str(path), index, 1, flags=flags)
        image = images[0] if images else None
    if image is None:
        raise ValueError("the compressed image cannot be decoded")
    return np.asarray(image)


def grey_image(path: Path, page: tifffile.TiffPage) -> NDArray[Any]:
    """Decode the (h, w) uint8, uint16 or float32 image of a page whose size was checked.

    Raises
    ------
    ValueError, OSError
        The pixel data are truncated or damaged.
    """
    size = (int(page.imagelength), int(page.imagewidth))
    if page.compression in _DECODED_HERE:
        image = _to_grey(np.asarray(page.asarray()), page)
    else:
        image = _decode_by_opencv(path, page.index)
    if image.shape != size or image.dtype not in (np.uint8, np.uint16, np.float32):
        raise ValueError(f"the decoded image is {image.dtype} {image.shape}")
    return np.ascontiguousarray(image)


def is_tiff(path: Path) -> bool:
    """Return whether the file's name is that of a TIFF."""
    return path.suffix.lower() in SUFFIXES


class _Quiet:
    """Keeps the TIFF parsers from logging unknown tags, and what is raised as an error here.

    Their logs are those of the process: of threads that overlap, the first one turns them off, and the last one
    restores what was there before the first.
    """

    def __init__(self) -> None:
        self._lock, self._count = threading.Lock(), 0
        self._before = False, 0

    @contextmanager
    def __call__(self) -> Iterator[None]:
        logger = logging.getLogger("tifffile")
        with self._lock:
            if self._count == 0:
                self._before = logger.disabled, _OPENCV_LOG.getLogLevel()
                logger.disabled = True
                _OPENCV_LOG.setLogLevel(0)  # LOG_LEVEL_SILENT
            self._count += 1
        try:
            yield
        finally:
            with self._lock:
                self._count -= 1
                if self._count == 0:
                    logger.disabled, level = self._before
                    _OPENCV_LOG.setLogLevel(level)


_quiet = _Quiet()


def _tag_settings(
    path: Path, page: tifffile.TiffPage, size_px: tuple[int, int]
) -> VendorSettings | None:
    """Read the settings from the tags of the file's maker; None without them."""
    tags = page.tags
    if zeiss.TAG in tags and isinstance(tags[zeiss.TAG].value, dict):
        return zeiss.zeiss_settings(path, tags[zeiss.TAG].value, size_px)
    for code in thermo_fisher.TAGS:
        value = tags[code].value if code in tags else None
        # Tag 34680 of newer programs holds something else, which has no sections.
        if isinstance(value, dict) and value:
            return thermo_fisher.thermo_fisher_settings(path, value, size_px)
    if olympus.TAG in tags and isinstance(tags[olympus.TAG].value, dict):
        return olympus.olympus_settings(path, tags[olympus.TAG].value)
    if XML_TAG in tags:
        return _xml_settings(path, tags[XML_TAG].value, size_px)
    if tescan.TAG in tags:
        value = tags[tescan.TAG].value
        data = value if isinstance(value, bytes) else str(value).encode()
        return tescan.tescan_settings(path, data, size_px)
    return None


def _xml_settings(path: Path, document: Any, size_px: tuple[int, int]) -> VendorSettings:
    root = parse_xml(path, document if isinstance(document, bytes) else str(document))
    if root.tag == phenom.ROOT:
        return phenom.phenom_settings(path, root, size_px)
    if root.tag == thermo_fisher.ROOT:
        return thermo_fisher.thermo_fisher_xml_settings(path, root, size_px)
    raise TiffError(
        f"{path.name}: tag {XML_TAG} holds XML with the root {str(root.tag)[:40]!r}",
        expected=f"{thermo_fisher.ROOT} (Thermo Fisher) or {phenom.ROOT} (Phenom)",
        do="export the image again with its metadata",
    )


def _text_settings(path: Path, text: str, size_px: tuple[int, int]) -> VendorSettings | None:
    """Read the settings from a maker's text in a side file or in what another program kept; None without them."""
    pairs = jeol.jeol_pairs(text)
    if pairs:
        return jeol.jeol_settings(path, pairs, size_px)
    pairs = hitachi.hitachi_pairs(text)
    if pairs:
        return hitachi.hitachi_settings(path, pairs, size_px)
    return None


def side_file_settings(path: str | Path, size_px: tuple[int, int]) -> VendorSettings | None:
    """Read the settings from the text file that JEOL, Hitachi or TESCAN wrote beside an image of any format.

    Parameters
    ----------
    path
        The image.
    size_px
        (width, height) of the stored image, databar included.

    Returns
    -------
    VendorSettings or None
        None if there is no such file.

    Raises
    ------
    TiffError
        The file contradicts the image or has no usable pixel size.
    """
    path = Path(path)
    text = find_side_file(path, (".txt",))
    if text is not None:
        settings = _text_settings(path, decode_text(read_side_file(text)), size_px)
        if settings is not None:
            return settings
    header = find_side_file(path, (".hdr", f"-{path.suffix[1:]}.hdr"))
    if header is not None:
        return tescan.tescan_settings(path, read_side_file(header), size_px, header.name)
    return None


def _kept_text_settings(path: Path, info: str, size_px: tuple[int, int]) -> VendorSettings | None:
    """Read the settings from a maker's text in the ``Info`` of ImageJ; None without one that fits the image."""
    try:
        if "AP_" in info and (entries := zeiss.zeiss_entries(info)):
            return zeiss.zeiss_settings(path, entries, size_px)
        if "[Scan]" in info or "[EScan]" in info:
            sections = thermo_fisher.thermo_fisher_sections(info)
            return thermo_fisher.thermo_fisher_settings(path, sections, size_px)
        if info.lstrip().startswith("<"):
            return _xml_settings(path, info, size_px)
        return _text_settings(path, info, size_px) or side_file_settings(path, size_px)
    except TiffError:
        # The copy may be cropped or scaled; what the original said of itself does not hold for it then.
        return None


def _settings(path: Path, page: tifffile.TiffPage, size_px: tuple[int, int]) -> VendorSettings:
    """Read the settings from the metadata of the file's maker."""
    settings = _tag_settings(path, page, size_px)
    if settings is not None:
        return settings
    if imagej_entries(page):
        kept = _kept_text_settings(path, imagej_info(page), size_px)
        return imagej_settings(path, page, kept)
    settings = side_file_settings(path, size_px)
    if settings is not None:
        return settings
    raise TiffError(
        f"{path.name} has no metadata of a known SEM",
        expected="tag 34118 (Zeiss), 34680, 34682 or 34683 (Thermo Fisher, Phenom), 50431 (TESCAN), 33560 (Olympus), "
        "the scale of ImageJ, or a .txt (JEOL, Hitachi) or .hdr (TESCAN) file beside it",
        do="use the microscope's original file, not a converted copy",
    )


@contextmanager
def _parsing(path: Path) -> Iterator[None]:
    """Turn the parser's errors in the block into a :class:`TiffError`, and keep it quiet."""
    try:
        with _quiet():
            yield
    except TiffError:
        raise
    except _PARSER_ERRORS as error:
        reason = " ".join(str(error).split())[:160] or type(error).__name__
        raise TiffError(
            f"{path} cannot be read: {reason}",
            expected="an intact TIFF of an SEM",
            do="copy it again from the microscope",
        ) from error


@contextmanager
def open_tiff(path: Path, *, pages: int = 1) -> Iterator[tifffile.TiffFile]:
    """Open a TIFF; its first ``pages`` directories are checked, and the parser raises only TiffErrors."""
    with _parsing(path):
        check_directories(path, pages=pages)
        with tifffile.TiffFile(path) as file:
            yield file


def _page(file: tifffile.TiffFile, path: Path, index: int) -> tifffile.TiffPage:
    page = file.pages.first if index == 0 else file.pages[index]
    if not isinstance(page, tifffile.TiffPage):
        raise TiffError(f"{path.name} has no image", expected="an SEM image")
    return page


def _list_pages(
    file: tifffile.TiffFile, path: Path, directories: int
) -> list[tuple[tifffile.TiffPage, VendorSettings, tuple[int, int]]]:
    """All images of a file but previews, with their settings: their own, or those of the first of the same size.

    The channels of ImageJ are detectors: they are no time series.
    """
    first = _page(file, path, 0)
    images, number = imagej_images(imagej_entries(first)), len(file.pages)
    if number < directories:
        raise TiffError(
            f"{path.name} has {directories} directories, of which only {number} can be read",
            expected="an intact TIFF of an SEM",
            do="copy it again from the microscope",
        )
    if images > number:
        raise TiffError(
            f"{path.name} declares {images} images in {number} directories, as ImageJ writes files above 4 GB",
            expected="one directory for each image",
            do="save the images from ImageJ by File > Save As > Image Sequence",
        )
    listed: list[tuple[tifffile.TiffPage, VendorSettings, tuple[int, int]]] = []
    for index in range(min(number, _MAX_PAGES)):
        page = _page(file, path, index)
        if index and int(page.subfiletype) & _REDUCED:
            continue
        size_px = page_size(path, page)
        settings = _tag_settings(path, page, size_px) if index else _settings(path, page, size_px)
        if settings is None:
            _check_size_of_first(path, index, size_px, listed[0][2])
            settings = listed[0][1]
        listed.append((page, settings, size_px))
    return [
        (page, _of_channel(settings, first, page.index), size) for page, settings, size in listed
    ]


def _check_size_of_first(
    path: Path, index: int, size_px: tuple[int, int], first_px: tuple[int, int]
) -> None:
    """Refuse an image that has neither metadata of its own nor the size of the first, whose scale it would get."""
    if size_px != first_px:
        raise TiffError(
            f"image {index + 1} in {path.name} is {size_px[0]} x {size_px[1]} pixels without metadata",
            expected=f"{first_px[0]} x {first_px[1]} pixels as the first, or metadata of its own",
            do="save the images of one size in a file of their own",
        )


def _of_channel(settings: VendorSettings, first: tifffile.TiffPage, index: int) -> VendorSettings:
    """Name the detector by the channel if ImageJ wrote several, one after the other for each slice."""
    channels = imagej_channels(imagej_entries(first))
    if channels == 1:
        return settings
    name = f"{settings.detector} channel {1 + index % channels}".strip()
    return replace(settings, detector=name)


def _sem_image(
    path: Path, page: tifffile.TiffPage, settings: VendorSettings, databar_rows: int | None
) -> SemImage:
    image: NDArray[Any] = grey_image(path, page)
    rows = settings.databar_rows if databar_rows is None else databar_rows
    height, width = image.shape
    if not 0 <= rows < height:
        raise TiffError(f"{rows} rows of databar in {path.name}", expected=f"0 to {height - 1}")
    return SemImage(path, image[: height - rows], (width, height), rows, settings, page.index)


def read_page_settings(
    path: str | Path,
) -> tuple[tuple[int, VendorSettings, tuple[int, int]], ...]:
    """Read the page index, settings and stored (width, height) of all images of a file without decoding pixels.

    Previews are left out. A page without metadata of its own has those of the first.

    Raises
    ------
    TiffError
        As :func:`read_sem_tiff`, for any of the images.
    """
    path = Path(path)
    with _parsing(path):
        directories = check_directories(path, pages=_MAX_PAGES)
        with tifffile.TiffFile(path) as file:
            listed = _list_pages(file, path, directories)
    return tuple((page.index, settings, size_px) for page, settings, size_px in listed)


def read_sem_pages(path: str | Path, *, databar_rows: int | None = None) -> Iterator[SemImage]:
    """Yield all images of a file, which is opened once; parameters and errors as :func:`read_sem_tiff`."""
    path = Path(path)
    with _parsing(path):
        directories = check_directories(path, pages=_MAX_PAGES)
        opened = tifffile.TiffFile(path)
    with opened as file:
        with _parsing(path):
            listed = _list_pages(file, path, directories)
        for page, settings, _ in listed:
            with _parsing(path):  # not around the yield: it silences loggers
                image = _sem_image(path, page, settings, databar_rows)
            yield image


def read_sem_tiff(path: str | Path, *, databar_rows: int | None = None, page: int = 0) -> SemImage:
    """Read an SEM image and its settings; its tags or the text file beside it say who made the microscope.

    Parameters
    ----------
    path
        A TIFF file of Zeiss, Thermo Fisher (FEI), TESCAN, JEOL, Hitachi or Phenom, or a copy of one that ImageJ saved.
    databar_rows
        Rows to cut off at the bottom, instead of those that the metadata give.
    page
        Index of the image in a file of several, as of :func:`read_page_settings`.

    Raises
    ------
    TiffError
        The file is missing, truncated or not a TIFF, or has no known metadata, no usable pixel size, or an absurd size.
    """
    path = Path(path)
    with open_tiff(path, pages=page + 1) as file:
        listed, first = _page(file, path, page), _page(file, path, 0)
        size_px = page_size(path, listed)
        settings = _tag_settings(path, listed, size_px) if page else None
        if settings is None:
            first_px = page_size(path, first)
            _check_size_of_first(path, page, size_px, first_px)
            settings = _settings(path, first, first_px)
        return _sem_image(path, listed, _of_channel(settings, first, page), databar_rows)
