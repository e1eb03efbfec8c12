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

"""TIFF files without a microscope's metadata: plain, OME-TIFF, stacks of ImageJ and of this package; OME-TIFF written.

Written are images of any depth with their pixel size and times, page by page.
"""

from __future__ import annotations

import contextlib
import json
import os
import struct
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import tifffile
from numpy.typing import NDArray

from semcal_ros.core.errors import BagError, InvalidValueError, TiffError
from semcal_ros.files.images.metadata import parse_xml, quantity
from semcal_ros.files.tiff.read import MAX_PIXELS, MAX_SIDE_PX, grey_image, open_tiff

# What files say that this package has written them.
_SOFTWARE = "semcal_ros"

_MAX_PAGES = 100_000
_MAX_BYTES = 8

#: Key of the description for the rows at the bottom that are not part of the scan.
DATABAR_ROWS = "databar_rows"

# Offsets of a classic TIFF have 32 bits; what remains is for the tags.
_CLASSIC_BYTES = 2**32 - 2**25


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


class OmeTiffWriter:
    """An OME-TIFF that is being written, one page for each image.

    The resolution tags hold the pixel size, too: ImageJ, which does not read OME-XML, shows it in um.

    Parameters
    ----------
    path
        File to write.
    big
        Whether it may grow beyond 4 GB.
    """

    def __init__(self, path: Path, *, big: bool) -> None:
        self._path = path
        self._file = tifffile.TiffWriter(path, bigtiff=big)
        self._stamps_ns: list[int] = []
        self._pixel_size_m = 0.0
        self._shape: tuple[int, ...] = ()
        self._dtype: np.dtype[Any] = np.dtype(np.uint8)

    def write(self, image: NDArray[Any], stamp_ns: int, pixel_size_m: float) -> None:
        """Add an image.

        Parameters
        ----------
        image
            (h, w) or (h, w, 3), uint8, uint16 or float32.
        stamp_ns
            Its time, ns since 1970.
        pixel_size_m
            Size of its square pixels.

        Raises
        ------
        InvalidValueError
            If size, type or pixel size are not those of the first image: a file has one of each.
        OSError
            If the file cannot be written.
        """
        if not self._stamps_ns:
            self._shape, self._dtype, self._pixel_size_m = image.shape, image.dtype, pixel_size_m
        if (image.shape, image.dtype) != (self._shape, self._dtype):
            raise InvalidValueError(
                f"images of {_describe(self._shape, self._dtype)} and of {_describe(image.shape, image.dtype)}",
                expected="images of one kind for one TIFF",
                do="write a folder of TIFFs: end its name with /",
            )
        if not np.isclose(pixel_size_m, self._pixel_size_m, rtol=1e-9, atol=0.0):
            raise InvalidValueError(
                f"images of {1e9 * self._pixel_size_m:.6g} and {1e9 * pixel_size_m:.6g} nm per px",
                expected="one pixel size, thus one magnification, for one TIFF",
                do="write a folder of TIFFs: end its name with /",
            )
        per_cm = 0.01 / pixel_size_m
        self._file.write(
            image,
            photometric="rgb" if image.ndim == 3 else "minisblack",
            contiguous=bool(self._stamps_ns),
            description=None if self._stamps_ns else "-",
            datetime=None if self._stamps_ns else _utc(stamp_ns),
            software=None if self._stamps_ns else _SOFTWARE,
            resolution=(per_cm, per_cm),
            resolutionunit="CENTIMETER",
            metadata=None,
        )
        self._stamps_ns.append(stamp_ns)

    def finish(self, name: str, notes: Mapping[str, object]) -> None:
        """Write the description; no images may follow.

        Parameters
        ----------
        name
            Name of the image.
        notes
            What else is known, for the element ``Description``, as JSON.
        """
        self._file.close()
        count = len(self._stamps_ns)
        height, width = self._shape[:2]
        samples = self._shape[2] if len(self._shape) == 3 else 1
        xml = tifffile.OmeXml(Creator=_SOFTWARE)
        xml.addimage(
            self._dtype,
            (count, *self._shape),
            (count, 1, 1, height, width, samples),
            axes="TYXS" if samples > 1 else "TYX",
            Name=name,
            Description=json.dumps({"stamp_ns": self._stamps_ns[0], **notes}),
            PhysicalSizeX=1e6 * self._pixel_size_m,
            PhysicalSizeXUnit="µm",
            PhysicalSizeY=1e6 * self._pixel_size_m,
            PhysicalSizeYUnit="µm",
            **_describe_times(self._stamps_ns),
        )
        tifffile.tiffcomment(self._path, xml.tostring(declaration=True).encode("utf-8"))

    def release(self) -> None:
        """Close the file, finished or not."""
        with contextlib.suppress(OSError):
            self._file.close()


def is_from_semcal(path: Path) -> bool:
    """Whether a TIFF says that this package has written it; not so if it cannot be read."""
    try:
        with tifffile.TiffFile(path) as file:
            tag = file.pages.first.tags.get("Software")
    except (OSError, ValueError, struct.error, tifffile.TiffFileError):
        return False
    return tag is not None and tag.value == _SOFTWARE


def _describe(shape: tuple[int, ...], dtype: np.dtype[Any]) -> str:
    colours = " colour" if len(shape) == 3 else ""
    return f"{shape[1]} x {shape[0]}{colours} {dtype}"


def _utc(stamp_ns: int) -> datetime:
    return datetime.fromtimestamp(stamp_ns // 10**9, tz=timezone.utc).replace(tzinfo=None)


def _describe_times(stamps_ns: Sequence[int]) -> dict[str, Any]:
    """Attributes of OME-XML that say when each image was taken."""
    if len(stamps_ns) < 2:
        return {}
    offsets = [1e-9 * (stamp - stamps_ns[0]) for stamp in stamps_ns]
    return {
        "TimeIncrement": offsets[-1] / (len(offsets) - 1),
        "TimeIncrementUnit": "s",
        "Plane": {"DeltaT": offsets, "DeltaTUnit": ["s"] * len(offsets)},
    }


@contextmanager
def open_ome_tiff(path: Path, *, expected_bytes: int) -> Iterator[OmeTiffWriter]:
    """Write a file that gets its name only once it is complete; the caller finishes it.

    Parameters
    ----------
    path
        File to write.
    expected_bytes
        Size of all images together, as far as it is known.

    Raises
    ------
    BagError
        If it cannot be written.
    """
    target = Path(os.path.realpath(path))
    try:
        with tempfile.TemporaryDirectory(
            prefix=f".{target.name[:100]}.", suffix=".tmp", dir=target.parent
        ) as scratch:
            file = Path(scratch) / "images.tif"
            writer = OmeTiffWriter(file, big=expected_bytes > _CLASSIC_BYTES)
            try:
                yield writer
            finally:
                writer.release()
            os.replace(file, target)
    except OSError as error:
        raise BagError(
            f"{path} cannot be written: {error.strerror or error}",
            expected="a folder with space for the images",
            do="free space or choose another place",
        ) from error
