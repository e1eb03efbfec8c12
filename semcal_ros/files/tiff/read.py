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

"""Read an SEM image of any known maker."""

from __future__ import annotations

import logging
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import tifffile
from numpy.typing import NDArray

from semcal_ros.core.errors import TiffError
from semcal_ros.files.tiff import tescan, thermo_fisher, zeiss
from semcal_ros.files.tiff.jeol import jeol_pairs, jeol_settings
from semcal_ros.files.tiff.pixels import check_counts, grey_image, page_size
from semcal_ros.files.tiff.sem_image import SemImage, VendorSettings

__all__ = ["is_tiff", "read_sem_settings", "read_sem_tiff"]

SUFFIXES = (".tif", ".tiff")
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


def is_tiff(path: Path) -> bool:
    """Return whether the file's name is that of a TIFF."""
    return path.suffix.lower() in SUFFIXES


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep the TIFF parsers from logging unknown tags, and what is raised as an error here."""
    logger = logging.getLogger("tifffile")
    before, opencv = logger.disabled, _OPENCV_LOG.getLogLevel()
    logger.disabled = True
    _OPENCV_LOG.setLogLevel(0)  # LOG_LEVEL_SILENT
    try:
        yield
    finally:
        logger.disabled = before
        _OPENCV_LOG.setLogLevel(opencv)


def _sidecar(path: Path, endings: tuple[str, ...]) -> Path | None:
    """The file beside ``path`` whose name is its stem and one of the endings, in either case."""
    names = [path.stem + form for ending in endings for form in (ending, ending.upper())]
    return next((path.parent / name for name in names if (path.parent / name).is_file()), None)


def _settings(path: Path, page: tifffile.TiffPage, size_px: tuple[int, int]) -> VendorSettings:
    """Read the settings from the metadata of the file's maker."""
    tags = page.tags
    if zeiss.TAG in tags and isinstance(tags[zeiss.TAG].value, dict):
        return zeiss.zeiss_settings(path, tags[zeiss.TAG].value)
    for code in thermo_fisher.TAGS:
        if code in tags and isinstance(tags[code].value, dict):
            return thermo_fisher.thermo_fisher_settings(path, tags[code].value, size_px)
    if tescan.TAG in tags:
        value = tags[tescan.TAG].value
        data = value if isinstance(value, bytes) else str(value).encode()
        return tescan.tescan_settings(path, data, size_px)
    return _sidecar_settings(path, size_px)


def _sidecar_settings(path: Path, size_px: tuple[int, int]) -> VendorSettings:
    text = _sidecar(path, (".txt",))
    if text is not None:
        pairs = jeol_pairs(text.read_bytes())
        if pairs:
            return jeol_settings(path, pairs, size_px)
    header = _sidecar(path, (".hdr", f"-{path.suffix[1:]}.hdr"))
    if header is not None:
        return tescan.tescan_settings(path, header.read_bytes(), size_px)
    raise TiffError(
        f"{path.name} has no metadata of a known SEM",
        expected="tag 34118 (Zeiss), 34680 or 34682 (Thermo Fisher), 50431 (TESCAN), "
        "or a JEOL .txt beside it",
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
def _open(path: Path) -> Iterator[tifffile.TiffFile]:
    with _parsing(path):
        check_counts(path)
        with tifffile.TiffFile(path) as file:
            yield file


def _first_page(file: tifffile.TiffFile, path: Path) -> tifffile.TiffPage:
    page = file.pages.first
    if not isinstance(page, tifffile.TiffPage):
        raise TiffError(f"{path.name} has no image", expected="an SEM image")
    return page


def read_sem_settings(path: str | Path) -> tuple[VendorSettings, tuple[int, int]]:
    """Read the settings and the stored (width, height) without decoding pixels; raises as :func:`read_sem_tiff`."""
    path = Path(path)
    with _open(path) as file:
        page = _first_page(file, path)
        size_px = page_size(path, page)
        return _settings(path, page, size_px), size_px


def read_sem_tiff(path: str | Path, *, databar_rows: int | None = None) -> SemImage:
    """Read an SEM image and its settings; its tags or the text file beside it say who made the microscope.

    Parameters
    ----------
    path
        A TIFF file of Zeiss, Thermo Fisher (FEI), TESCAN or JEOL.
    databar_rows
        Rows to cut off at the bottom, instead of those that the metadata give.

    Raises
    ------
    TiffError
        The file is missing, truncated or not a TIFF, or has no known metadata, no usable pixel size, or an absurd size.
    """
    path = Path(path)
    with _open(path) as file:
        page = _first_page(file, path)
        settings = _settings(path, page, page_size(path, page))
        image: NDArray[Any] = grey_image(path, page)
    rows = settings.databar_rows if databar_rows is None else databar_rows
    height, width = image.shape
    if not 0 <= rows < height:
        raise TiffError(f"{rows} rows of databar in {path.name}", expected=f"0 to {height - 1}")
    return SemImage(path, image[: height - rows], (width, height), rows, settings)
