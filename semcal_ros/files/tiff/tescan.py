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

"""TESCAN: tag 50431 with a thumbnail and ``key=value`` lines, or a ``.hdr`` file.

Lengths are in metres; the angles ``ScanRotation``, ``StageTilt`` and ``StageRotation`` are in degrees, as in
TESCAN's remote interface (SharkSEM).
"""

from __future__ import annotations

import math
import struct
from pathlib import Path

from semcal_ros.core.errors import TiffError
from semcal_ros.files.images.metadata import (
    check_pixel_size,
    decode_text,
    first_date,
    plain_number,
    positive,
    tilt_correction_note,
)
from semcal_ros.files.images.sem_image import VendorSettings

# TESCAN's private TIFF tag.
TAG = 50431
_LENGTH_BYTES, _TYPE_BYTES = 4, 2
# Type of the record that holds a preview instead of text.
_THUMBNAIL = 1


def _text_records(data: bytes) -> list[str]:
    """Texts of the tag: each record is its length (uint32), a type (uint16) and the contents."""
    texts, position = [], 0
    while position + _LENGTH_BYTES + _TYPE_BYTES <= len(data):
        (length,) = struct.unpack_from("<I", data, position)
        (kind,) = struct.unpack_from("<H", data, position + _LENGTH_BYTES)
        start, stop = position + _LENGTH_BYTES + _TYPE_BYTES, position + _LENGTH_BYTES + length
        if length < _TYPE_BYTES or stop > len(data):
            break
        if kind != _THUMBNAIL:
            texts.append(data[start:stop].decode("utf-8", errors="replace"))
        position = stop
    return texts


def tescan_pairs(path: Path, data: bytes, where: str = "tag 50431") -> dict[str, str]:
    """Return all ``key=value`` pairs of the tag's bytes or of a ``.hdr`` file's text.

    Raises
    ------
    TiffError
        There are no pairs, or the pixel size is missing: the tag is damaged.
    """
    texts = _text_records(data) or [decode_text(data)]
    pairs: dict[str, str] = {}
    for line in "\n".join(texts).replace("\x00", "\n").splitlines():
        key, equals, value = line.partition("=")
        if equals and key.strip().isidentifier():
            pairs.setdefault(key.strip(), value.strip())
    if "PixelSizeX" not in pairs:
        raise TiffError(
            f"{path.name}: {where} holds {len(pairs)} settings and no PixelSizeX",
            expected="the key=value lines of TESCAN",
            do="export the image again with its metadata",
        )
    return pairs


def tescan_settings(
    path: Path, data: bytes, size_px: tuple[int, int], where: str = "tag 50431"
) -> VendorSettings:
    """Read the settings from the raw bytes of the tag or file (lengths in metres, angles in degrees).

    Raises
    ------
    TiffError
        The pixel size is missing or unusable, or the databar is higher than the image.
    """
    pairs = tescan_pairs(path, data, where)

    def number(key: str) -> float | None:
        return plain_number(pairs.get(key, ""))

    pixel_m = check_pixel_size(path, number("PixelSizeX"), "PixelSizeX", pairs.get("PixelSizeX"))
    pixel_y_m = number("PixelSizeY") or pixel_m
    check_pixel_size(path, pixel_y_m, "PixelSizeY", pairs.get("PixelSizeY"))
    strip = number("ImageStripSize") or 0.0
    if not 0 <= strip < size_px[1]:
        raise TiffError(
            f"{path.name}: ImageStripSize is {strip:g} in an image of {size_px[1]} rows",
            expected="fewer rows of databar than of the image",
            do="use the original file, not a cropped copy",
        )

    def angle(key: str) -> float | None:
        value = number(key)
        return None if value is None else math.radians(value)

    voltage = number("HV")
    correction = number("TiltCorrection")
    notes = (tilt_correction_note(math.radians(correction)),) if correction else ()
    stamp = f"{pairs.get('Date', '')} {pairs.get('Time', '')}"
    return VendorSettings(
        maker="tescan",
        beam="electron",
        pixel_size_m=pixel_m,
        pixel_size_y_m=pixel_y_m,
        displayed_magnification=positive(number("Magnification")),
        databar_rows=int(strip),
        working_distance_m=number("WD"),
        scan_rotation_rad=angle("ScanRotation"),
        stage_tilt_rad=angle("StageTilt"),
        stage_rotation_rad=angle("StageRotation"),
        dwell_s=positive(number("DwellTime")),
        detector=pairs.get("Detector") or pairs.get("Detector0", ""),
        model=pairs.get("DeviceModel") or pairs.get("Device", ""),
        serial_number=pairs.get("SerialNumber", ""),
        acceleration_voltage_v=None if voltage is None else abs(voltage),
        time=first_date([(stamp, "%Y-%m-%d %H:%M:%S")]),
        notes=notes,
    )
