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

"""TIFF files without a microscope's metadata: plain, OME-TIFF, stacks of ImageJ and of this package."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import tifffile
from numpy.typing import NDArray

from semcal_ros.core.errors import TiffError
from semcal_ros.files.images.metadata import parse_xml, quantity
from semcal_ros.files.images.ome_tiff import DATABAR_ROWS
from semcal_ros.files.tiff.pixels import MAX_PIXELS, MAX_SIDE_PX, grey_image
from semcal_ros.files.tiff.read import open_tiff

_MAX_PAGES = 100_000
_MAX_BYTES = 8
_GREY = ("minisblack", "miniswhite", "rgb", "palette", "ycbcr")


@dataclass(frozen=True)
class TiffStack:
    """What a file says without being decoded.

    Attributes
    ----------
    pages
        Indices of its images in the order of time: those of the first channel.
    sizes_px
        (width, height) of each.
    pixel_size_m
        Pixel size on the specimen, where the file is an OME-TIFF that gives it.
    offsets_s
        Times of the images since the first one, s, where it gives them.
    notes
        Notes for the user.
    taken
        Local time of the first image, where the file says it.
    databar_rows
        Rows at the bottom that this package appended.
    """

    pages: tuple[int, ...]
    sizes_px: tuple[tuple[int, int], ...]
    pixel_size_m: float | None
    offsets_s: tuple[float, ...] | None
    notes: tuple[str, ...]
    taken: datetime | None = None
    databar_rows: int = 0


def _first_channel(file: tifffile.TiffFile) -> tuple[list[int], tuple[str, ...]]:
    """Indices of the images of the first channel, in the order of the file; and notes about the others."""
    count = len(file.pages)
    everything = list(range(count))
    if not (file.is_ome or file.is_imagej):
        return everything, ()
    series = file.series[0]
    places = [(k, axis) for k, axis in enumerate(series.axes) if axis in "TZCQIR"]
    shape = [series.shape[k] for k, _ in places]
    channels = [at for at, (_, axis) in enumerate(places) if axis == "C" and shape[at] > 1]
    if not channels or int(np.prod(shape)) != count:
        return everything, ()
    order = np.take(np.arange(count).reshape(shape), 0, axis=channels[0]).ravel()
    return order.tolist(), (f"the first of {shape[channels[0]]} channels is used",)


def list_tiff_stack(path: Path) -> TiffStack:
    """List the images of a TIFF of any kind.

    Raises
    ------
    TiffError
        The file is missing, damaged, or not a TIFF of grey or colour images.
    """
    with open_tiff(path, pages=_MAX_PAGES) as file:
        sizes = {}
        for index in range(min(len(file.pages), _MAX_PAGES)):
            page = file.pages[index]
            if isinstance(page, tifffile.TiffPage) and not (index and page.is_reduced):
                sizes[index] = _check_page(path, page)
        # Listing what the series are replaces the pages by shorter ones.
        wanted, notes = _first_channel(file)
        pages = [index for index in wanted if index in sizes]
        if not pages:
            raise TiffError(f"{path.name} has no image", expected="a TIFF with an image")
        said = _Description()
        if file.is_ome and file.ome_metadata:
            said = _read_ome(path, file.ome_metadata, len(pages))
        taken = said.taken or _read_time(file)
    return TiffStack(
        tuple(pages),
        tuple(sizes[k] for k in pages),
        said.pixel_size_m,
        said.offsets_s,
        notes,
        taken,
        said.databar_rows,
    )


def _check_page(path: Path, page: tifffile.TiffPage) -> tuple[int, int]:
    """(width, height) of a page that can be decoded within bounds."""
    width, height = int(page.imagewidth), int(page.imagelength)
    samples, kind = int(page.samplesperpixel), page.dtype
    if not (
        0 < width <= MAX_SIDE_PX and 0 < height <= MAX_SIDE_PX and width * height <= MAX_PIXELS
    ):
        raise TiffError(
            f"{path.name} declares {width} x {height} pixels",
            expected=f"at most {MAX_SIDE_PX} a side and {MAX_PIXELS} in all",
            do="check that the file is complete",
        )
    numbers = kind is not None and kind.kind in "uif" and kind.itemsize <= _MAX_BYTES
    if not numbers or page.imagedepth != 1 or not 1 <= samples <= 4:
        raise TiffError(
            f"{path.name} has {samples} samples of type {kind} per pixel",
            expected="grey levels, or red, green and blue",
        )
    if samples == 4 and page.planarconfig == tifffile.PLANARCONFIG.SEPARATE:
        # What programs write for a stack of four images unless they are told that these are grey.
        raise TiffError(
            f"{path.name} has 4 planes, which are 4 images or the colours of one",
            expected="one page for each image",
            do='save the stack as pages (tifffile: photometric="minisblack")',
        )
    return width, height


class _Description(NamedTuple):
    """What an OME-XML says about its first image."""

    pixel_size_m: float | None = None
    offsets_s: tuple[float, ...] | None = None
    taken: datetime | None = None
    databar_rows: int = 0


def _read_ome(path: Path, text: str, count: int) -> _Description:
    root = parse_xml(path, text)
    pixels = _first(root, "Pixels")
    if pixels is None:
        return _Description()
    offsets = [
        _attribute(plane, "DeltaT", "s", "s")
        for plane in pixels.iter()
        if plane.tag.rpartition("}")[2] == "Plane" and plane.get("TheC", "0") == "0"
    ]
    times = tuple(t - (offsets[0] or 0.0) for t in offsets if t is not None)
    interval = _attribute(pixels, "TimeIncrement", "s", "s")
    if len(times) != count or any(b <= a for a, b in pairwise(times)):
        times = tuple(k * interval for k in range(count)) if interval else ()
    size = _attribute(pixels, "PhysicalSizeX", "m", "um")
    taken, rows = _read_description(_first(root, "Description"))
    return _Description(size or None, times or None, taken, rows)


def _first(root: ElementTree.Element, name: str) -> ElementTree.Element | None:
    return next((item for item in root.iter() if item.tag.rpartition("}")[2] == name), None)


def _read_description(description: ElementTree.Element | None) -> tuple[datetime | None, int]:
    """The time and the rows of a databar that this package wrote; None and 0 where it did not."""
    try:
        said = json.loads((description is not None and description.text) or "")
    except ValueError:
        return None, 0
    stamp, rows = (
        (said.get("stamp_ns"), said.get(DATABAR_ROWS)) if isinstance(said, dict) else (0, 0)
    )
    taken = None
    if isinstance(stamp, int) and 0 < stamp < 2**63:
        taken = datetime(1970, 1, 1) + timedelta(microseconds=stamp // 1000)
    return taken, rows if isinstance(rows, int) and 0 < rows < MAX_SIDE_PX else 0


def _read_time(file: tifffile.TiffFile) -> datetime | None:
    """The tag DateTime of the first page, which has whole seconds."""
    page = file.pages[0]
    tag = page.tags.get("DateTime") if isinstance(page, tifffile.TiffPage) else None
    try:
        return datetime.strptime(str(tag.value), "%Y:%m:%d %H:%M:%S") if tag is not None else None
    except ValueError:
        return None


def _attribute(pixels: ElementTree.Element, name: str, unit: str, default: str) -> float | None:
    text = pixels.get(name)
    if text is None:
        return None
    value = quantity(f"{text} {pixels.get(f'{name}Unit', default)}", unit)
    return value if value is not None and value >= 0.0 else None


def read_tiff_stack(path: Path, pages: Sequence[int]) -> Iterator[NDArray[Any]]:
    """Yield (h, w) grey images: uint8 and uint16 as they are, others as float32.

    Raises
    ------
    TiffError
        The file is damaged.
    """
    with open_tiff(path, pages=_MAX_PAGES) as file:
        for index in pages:
            page = file.pages[index]
            assert isinstance(page, tifffile.TiffPage)
            if page.dtype is not None and page.dtype.name in ("uint8", "uint16"):
                yield grey_image(path, page)
                continue
            image = np.asarray(page.asarray(), dtype=np.float32)
            if image.ndim == 3 and page.planarconfig == tifffile.PLANARCONFIG.SEPARATE:
                image = np.moveaxis(image, 0, -1)
            yield np.ascontiguousarray(image if image.ndim == 2 else image[..., :3].mean(axis=-1))
