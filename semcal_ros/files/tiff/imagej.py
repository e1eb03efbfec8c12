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

"""Copies that ImageJ saved: ``ImageDescription`` with ``ImageJ=`` and the scale in the resolution tags.

ImageJ does not copy the makers' tags. It keeps the scale that was set (``unit`` of the description, pixels per unit in
``XResolution``) and, in ``Info`` of its own tag 50839, the text that the program which opened the image put there. That
text, or a side file, then gives the conditions; the scale of ImageJ counts, since the image may have been scaled or
cropped since.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import tifffile

from semcal_ros.core.errors import TiffError
from semcal_ros.files.images.metadata import (
    check_pixel_size,
    duration,
    plain_number,
    positive,
    quantity,
)
from semcal_ros.files.images.sem_image import VendorSettings

# ImageJ's private TIFF tag, IJMetadata.
_TAG = 50839
_UNITS = {"micron": "um", "microns": "um", "nanometer": "nm", "millimeter": "mm", "meter": "m"}
# A pixel of 1200 dots per inch, the finest that printers have: a larger one in cm is the size of a print.
_PRINTED_PIXEL_M = 0.0254 / 1200.0
# Two sizes that differ by more are not the same scale in other words.
_SCALE_TOLERANCE = 5e-3
# ImageJ stores pixels per unit as a whole number of millionths or thousandths; a coarser rounding than this is
# remarked upon.
_DENOMINATORS = (1_000, 1_000_000)
_COARSE_ROUNDING = 1e-4


def imagej_entries(page: tifffile.TiffPage) -> dict[str, str]:
    """Entries of ImageJ's description; empty if ImageJ did not write the page."""
    text = page.description
    if not text.startswith("ImageJ="):
        return {}
    return {
        key.strip(): value.strip()
        for key, _, value in (line.partition("=") for line in text.splitlines())
    }


def imagej_info(page: tifffile.TiffPage) -> str:
    """Text that the program which opened the original left in ImageJ's ``Info``."""
    value = page.tags[_TAG].value if _TAG in page.tags else None
    return str(value.get("Info", "")) if isinstance(value, Mapping) else ""


def _count(entries: Mapping[str, str], name: str) -> int:
    number = plain_number(entries.get(name, "1"))
    return max(1, int(number)) if number is not None and number < 1e9 else 1


def imagej_images(entries: Mapping[str, str]) -> int:
    """Number of images that the description declares."""
    return _count(entries, "images")


def imagej_channels(entries: Mapping[str, str]) -> int:
    """Number of channels; ImageJ writes all channels of a slice one after the other."""
    return _count(entries, "channels")


def _unit(text: str) -> str:
    decoded = re.sub(r"\\u([0-9A-Fa-f]{4})", lambda match: chr(int(match.group(1), 16)), text)
    return _UNITS.get(decoded.lower(), decoded)


def _read_size(page: tifffile.TiffPage, name: str, unit: str) -> tuple[float, float] | None:
    """Return the size of a pixel in m and its rounding, relative; None if the image has no scale of a specimen."""
    value = page.tags[name].value if name in page.tags else None
    if not isinstance(value, tuple) or len(value) != 2 or not value[0] or not value[1]:
        return None
    if unit == "cm":
        size_m = 1e-2 * value[1] / value[0]
        size_m = size_m if size_m < _PRINTED_PIXEL_M else 0.0
    else:
        size_m = (quantity(f"1 {unit}", "m") or 0.0) * value[1] / value[0]
    rounded = 0.5 / value[0] if value[1] in _DENOMINATORS else 0.0
    return (size_m, rounded) if size_m > 0 else None


def _frame_interval(entries: Mapping[str, str]) -> float | None:
    number = plain_number(entries.get("finterval", ""))
    return None if number is None else positive(duration(f"{number} {entries.get('tunit', 'sec')}"))


def imagej_settings(
    path: Path, page: tifffile.TiffPage, original: VendorSettings | None
) -> VendorSettings:
    """Read the scale of a page that ImageJ wrote, and take the conditions from the original's metadata.

    Parameters
    ----------
    original
        Settings from the text of the maker that the copy kept, if it kept one.

    Raises
    ------
    TiffError
        Neither ImageJ nor the maker's text gives a pixel size.
    """
    entries = imagej_entries(page)
    interval_s = _frame_interval(entries)
    unit = _unit(entries.get("unit", ""))
    across = _read_size(page, "XResolution", unit)
    if across is None and original is not None:
        return replace(original, frame_interval_s=interval_s)
    if across is None:
        raise TiffError(
            f"{path.name} was saved by ImageJ without a scale (its unit is {unit[:20] or 'missing'!r})",
            expected="a pixel size in m, mm, um, nm or pm",
            do="set it in ImageJ by Analyze > Set Scale",
        )
    down = _read_size(page, "YResolution", _unit(entries["yunit"]) if "yunit" in entries else unit)
    size_m = check_pixel_size(path, across[0], "ImageJ's pixel width", across[0])
    size_y_m = check_pixel_size(
        path, (down or across)[0], "ImageJ's pixel height", (down or across)[0]
    )
    notes = [] if original is None else [*original.notes]
    if across[1] > _COARSE_ROUNDING:
        notes.append(f"ImageJ rounded the pixel size to {100 * across[1]:.1g} %")
    if original is None:
        return VendorSettings(
            maker="imagej",
            pixel_size_m=size_m,
            pixel_size_y_m=size_y_m,
            frame_interval_s=interval_s,
            notes=tuple(notes),
        )
    if abs(original.pixel_size_m / size_m - 1.0) > max(_SCALE_TOLERANCE, 2.0 * across[1]):
        notes.append(
            f"the pixel size is ImageJ's, {size_m:g} m; the maker's text says {original.pixel_size_m:g} m"
        )
    return replace(
        original,
        pixel_size_m=size_m,
        pixel_size_y_m=size_y_m,
        frame_interval_s=interval_s,
        notes=tuple(notes),
    )
