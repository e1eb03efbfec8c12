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

"""Write images for people and other programs: TIFF with pixel size and time, PNG, and folders of them."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import BagError, InvalidValueError
from semcal_ros.files.atomic import atomic_write_bytes
from semcal_ros.files.images.scale_bar import add_databar, choose_scale_bar
from semcal_ros.files.images.tiff_stack import (
    DATABAR_ROWS,
    OmeTiffWriter,
    is_from_semcal,
    open_ome_tiff,
)

TIFF_SUFFIXES = (".tif", ".tiff")
IMAGE_SUFFIXES = (*TIFF_SUFFIXES, ".png")
_NO_NOTES: Mapping[str, object] = MappingProxyType({})


@dataclass(frozen=True)
class PixelScale:
    """Size of the square pixels of an image.

    Attributes
    ----------
    size_m
        Size on the specimen.
    sigma_m
        Its 1-sigma; None for a nominal size, of which it is not known.
    """

    size_m: float
    sigma_m: float | None = None


def pixel_scale(camera: ScanCamera) -> PixelScale:
    """The pixel size of what a camera's images are rectified to; the larger 1-sigma of both axes."""
    rectified = camera.rectified
    sigma = None if camera.covariance is None else max(rectified.pixel_size_sigma_m)
    return PixelScale(rectified.pixel_size_m[0], sigma)


def _describe(scale: PixelScale, databar_rows: int) -> dict[str, object]:
    said: dict[str, object] = {"pixel_size_m": scale.size_m}
    if scale.sigma_m is not None:
        said["pixel_size_sigma_m"] = scale.sigma_m
    if databar_rows:
        said[DATABAR_ROWS] = databar_rows
    return said


def _with_databar(
    image: NDArray[Any], scale: PixelScale, databar: bool
) -> tuple[NDArray[Any], int]:
    """An image with its strip below, if wanted, and how many rows that has."""
    if not databar:
        return image, 0
    bar = choose_scale_bar(image.shape[1], scale.size_m, scale.sigma_m)
    out = add_databar(image, bar)
    return out, len(out) - len(image)


def write_image(
    path: Path,
    image: NDArray[Any],
    scale: PixelScale,
    *,
    stamp_ns: int = 0,
    databar: bool = False,
    notes: Mapping[str, object] = _NO_NOTES,
) -> None:
    """Write one image completely or not at all.

    Parameters
    ----------
    path
        ``.tif`` or ``.tiff`` for an OME-TIFF of any of the types, ``.png`` for 8 and 16 bits.
    image
        (h, w) grey levels or (h, w, 3) in the order red, green, blue; uint8, uint16 or float32.
    scale
        Its pixel size; a PNG holds it in the databar only.
    stamp_ns
        Its time, ns since 1970; a PNG does not hold it.
    databar
        Whether to append a strip with a scale bar below the image.
    notes
        What else is known; a PNG does not hold it.

    Raises
    ------
    InvalidValueError
        If a PNG is wanted of other grey levels, or the suffix is not one of these.
    BagError, OSError
        If the file cannot be written; an existing one is untouched.
    """
    suffix = path.suffix.lower()
    if suffix in TIFF_SUFFIXES:
        with open_tiff_stack(path, databar=databar, notes=notes) as stack:
            stack.write(image, stamp_ns, scale)
    elif suffix == ".png" and image.dtype in (np.uint8, np.uint16):
        shown, _ = _with_databar(image, scale, databar)
        if shown.ndim == 3:
            shown = shown[..., ::-1]
        done, data = cv2.imencode(".png", np.ascontiguousarray(shown))
        assert done
        atomic_write_bytes(path, bytes(data))
    else:
        raise InvalidValueError(
            f"{path} for grey levels of type {image.dtype}",
            expected="a .tif, which holds grey levels of 32 bits, or a .png of 8 or 16 bits",
        )


@dataclass
class TiffStackWriter:
    """Pages of one TIFF; see :func:`open_tiff_stack`."""

    _file: OmeTiffWriter
    _databar: bool
    _first: dict[str, object] = field(default_factory=dict)

    def write(self, image: NDArray[Any], stamp_ns: int, scale: PixelScale) -> None:
        """Add an image, as for :func:`write_image`; raises as :meth:`.OmeTiffWriter.write`."""
        shown, rows = _with_databar(image, scale, self._databar)
        self._file.write(shown, stamp_ns, scale.size_m)
        self._first = self._first or _describe(scale, rows)


@contextmanager
def open_tiff_stack(
    path: Path,
    *,
    expected_bytes: int = 0,
    databar: bool = False,
    notes: Mapping[str, object] = _NO_NOTES,
) -> Iterator[TiffStackWriter]:
    """Write images of one kind and pixel size as the pages of an OME-TIFF, completely or not at all.

    Parameters
    ----------
    path
        The file.
    expected_bytes
        Size of all images together, which a TIFF of the usual kind may not be able to hold.
    databar, notes
        As for :func:`write_image`.

    Raises
    ------
    BagError
        If it cannot be written.
    """
    with open_ome_tiff(path, expected_bytes=expected_bytes) as file:
        stack = TiffStackWriter(file, databar)
        yield stack
        file.finish(path.stem, {**stack._first, **notes})


class FolderWriter:
    """One TIFF for each image; see :func:`open_image_folder`."""

    def __init__(self, folder: Path, databar: bool) -> None:
        self._folder = folder
        self._databar = databar
        self._taken: set[str] = set()

    def write(
        self,
        image: NDArray[Any],
        stamp_ns: int,
        scale: PixelScale,
        *,
        source_name: str = "",
        notes: Mapping[str, object] = _NO_NOTES,
    ) -> None:
        """Write an image under the name of the file that it comes from, else under its number."""
        stem = Path(source_name).stem if source_name else f"frame_{len(self._taken) + 1:06d}"
        name, number = stem, 1
        while name in self._taken:
            number += 1
            name = f"{stem}_{number:06d}"
        self._taken.add(name)
        path = self._folder / f"{name}.tif"
        write_image(path, image, scale, stamp_ns=stamp_ns, databar=self._databar, notes=notes)


@contextmanager
def open_image_folder(
    path: Path, *, overwrite: bool = False, databar: bool = False
) -> Iterator[FolderWriter]:
    """Make a folder of TIFFs completely or not at all.

    Parameters
    ----------
    path
        The folder.
    overwrite
        Whether to replace an existing folder that holds nothing but TIFFs which this package has written.
    databar
        As for :func:`write_image`.

    Raises
    ------
    BagError
        If the folder exists and may not be replaced, or cannot be written.
    """
    target = Path(os.path.abspath(path))
    _check_replaceable(target, overwrite)
    try:
        with tempfile.TemporaryDirectory(
            prefix=f".{target.name[:100]}.", suffix=".tmp", dir=target.parent
        ) as scratch:
            made = Path(scratch) / "images"
            made.mkdir()
            yield FolderWriter(made, databar)
            _check_replaceable(target, overwrite)
            if target.exists():
                # Until the new one has its name, the old one is only set aside.
                os.rename(target, Path(scratch) / "old")
            os.rename(made, target)
    except OSError as error:
        raise BagError(
            f"{path} cannot be written: {error.strerror or error}",
            expected="a folder with space for the images",
            do="free space or choose another place",
        ) from error


def _check_replaceable(path: Path, overwrite: bool) -> None:
    if not os.path.lexists(path):
        return
    if not overwrite:
        raise BagError(
            f"{path} exists", expected="a new folder", do="choose another name, or --overwrite"
        )
    replaceable = path.is_dir() and all(
        item.is_file() and item.suffix.lower() in TIFF_SUFFIXES and is_from_semcal(item)
        for item in path.iterdir()
    )
    if path.is_symlink() or not replaceable:
        raise BagError(
            f"{path} holds something other than TIFFs of semcal, so it is not replaced",
            expected="a new path, or a folder of TIFFs that semcal has written",
            do="choose another name or remove it yourself",
        )
