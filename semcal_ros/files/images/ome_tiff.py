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

"""Write OME-TIFF files: images of any depth with their pixel size and times, page by page."""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from semcal_ros.core.errors import BagError, InvalidValueError

#: Key of the description for the rows at the bottom that are not part of the scan.
DATABAR_ROWS = "databar_rows"

# Offsets of a classic TIFF have 32 bits; what remains is for the tags.
_CLASSIC_BYTES = 2**32 - 2**25


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
            software=None if self._stamps_ns else "semcal_ros",
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
        xml = tifffile.OmeXml(Creator="semcal_ros")
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
