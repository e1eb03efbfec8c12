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

"""Image files as the software of a microscope saves them."""

from __future__ import annotations

import os
from datetime import datetime
from pathlib import Path

import numpy as np
import tifffile

__all__ = [
    "PIXEL_M",
    "number_in",
    "numbered_image",
    "save_sem_tiff",
    "save_zeiss_tiff",
    "thermo_fisher_tag",
    "zeiss_text",
]

PIXEL_M = 5e-9
# Tag of Thermo Fisher (FEI).
_TAG, _ZEISS_TAG = 34682, 34118
# Bits of a number that are drawn as squares, which any later step keeps.
_BITS, _SIDE = 16, 8


def thermo_fisher_tag(
    pixel_m: float, size_px: tuple[int, int], *, hv: float = 5000.0, tilt_rad: float = 0.1
) -> bytes:
    """Metadata of a Thermo Fisher microscope with its electron beam."""
    return "\r\n".join(
        [
            "[System]", "SystemType=Quanta", "Dnumber=9922000", "DisplayWidth=0.320",
            "[Beam]", "Beam=EBeam", "Scan=EScan",
            "[EBeam]", f"HV={hv:g}", "WD=0.01", "ScanRotation=0",
            "[EScan]", "Dwell=1e-06", f"PixelWidth={pixel_m!r}", f"PixelHeight={pixel_m!r}",
            "FrameTime=0.05",
            "[Image]", f"ResolutionX={size_px[0]}", f"ResolutionY={size_px[1]}",
            "[Detectors]", "Name=ETD",
            "[Stage]", "StageR=0.2", f"StageT={tilt_rad:g}",
            "[PrivateFei]", "DatabarHeight=0",
        ]
    ).encode("ascii") + b"\x00"  # fmt: skip


def numbered_image(number: int, size_px: tuple[int, int] = (128, 96)) -> np.ndarray:
    """(h, w) uint8 noise with a number in the squares of its first rows."""
    image = np.random.default_rng(number).integers(40, 200, size_px[::-1]).astype(np.uint8)
    for bit in range(_BITS):
        image[:_SIDE, bit * _SIDE : (bit + 1) * _SIDE] = 255 * (number >> bit & 1)
    return image


def number_in(image: np.ndarray) -> int:
    """The number of such an image."""
    squares = image[:_SIDE, : _BITS * _SIDE].reshape(_SIDE, _BITS, _SIDE).mean(axis=(0, 2))
    return sum(1 << bit for bit, level in enumerate(squares) if level > 127)


def save_sem_tiff(path: Path, image: np.ndarray, **tag: float) -> Path:
    """Write a TIFF with metadata straight to its name, as most programs of microscopes do."""
    size_px = image.shape[1], image.shape[0]
    data = thermo_fisher_tag(PIXEL_M, size_px, **tag)
    # Not by way of a library's own temporary file: others see it grow.
    with open(path, "wb") as stream:
        tifffile.imwrite(stream, image, extratags=[(_TAG, 2, 0, data, True)])
        stream.flush()
        os.fsync(stream.fileno())
    return path


def zeiss_text(
    pixel: str = "593.3 nm",
    mag: str = "188 X",
    head: tuple[str, str] = ("1.854025625e-08", "188.19"),
    tilt: str = "2.0 \u00b0",
    changes: dict[str, str] | None = None,
) -> bytes:
    """CZ_SEM tag: unnamed numbers, then keys in capitals, each followed by name = value unit.

    By default the image has 32 columns and the screen 1024, so a pixel of the screen is 1/32 of one of the image.
    """
    lines = ["0", "0", "0", *head, "6", "5.0e+03", "2.27", "2.0e-10", "5.243416e-03", "829"]
    named = {
        "AP_PIXEL_SIZE": "Pixel Size = 18.54 nm",
        "AP_IMAGE_PIXEL_SIZE": f"Image Pixel Size = {pixel}",
        "AP_MAG": f"Mag = {mag}",
        "AP_WD": "WD = 5.2 mm",
        "AP_SCANROTATION": "Scan Rotation = 30.0 \u00b0",
        "DP_SCAN_ROT": "Scan Rot = On",
        "AP_STAGE_AT_T": f"Stage at T = {tilt}",
        "AP_STAGE_AT_R": "Stage at R = 233.5 \u00b0",
        "DP_DWELL_TIME": "Dwell Time = 50 ns",
        "DP_SCANRATE": "Scan Speed = 4",
        "AP_LINE_TIME": "Line Time = 949 \u00b5s",
        "AP_FRAME_TIME": "Cycle Time = 752.76 ms",
        "AP_ACTUALKV": "EHT = 5.00 kV",
        "DP_SEM": "Sem = Auriga 60",
        "SV_SERIAL_NUMBER": "Serial No. = Auriga 60-46-17",
        "DP_DETECTOR_CHANNEL": "Signal A = InLens",
        "AP_DATE": "Date :11 Apr 2023",
        "AP_TIME": "Time :8:40:47",
    }
    for key, value in {**named, **(changes or {})}.items():
        lines += [key, value] if value else []
    return "\r\n".join(lines).encode("cp1252") + b"\x00"


def save_zeiss_tiff(
    path: Path,
    image: np.ndarray,
    pixel_m: float,
    *,
    magnification: float = 1000.0,
    tilt_deg: float = 0.0,
    rotation_deg: float = 0.0,
    at: datetime = datetime(2026, 5, 4, 9, 30),
) -> Path:
    """Write an image as SmartSEM does; the pixel size has four digits, and more in the unnamed numbers."""
    screen_m = pixel_m * image.shape[1] / 1024
    data = zeiss_text(
        f"{1e9 * pixel_m:.4g} nm",
        f"{magnification:.4g} X",
        (f"{screen_m:.9e}", f"{magnification:.8g}"),
        f"{tilt_deg:.1f} °",
        {
            "AP_PIXEL_SIZE": f"Pixel Size = {1e9 * screen_m:.4g} nm",
            "DP_SCAN_ROT": "Scan Rot = Off",
            "AP_STAGE_AT_R": f"Stage at R = {rotation_deg:.1f} °",
            "AP_DATE": f"Date :{at:%d %b %Y}",
            "AP_TIME": f"Time :{at:%H:%M:%S}",
        },
    )
    tifffile.imwrite(path, image, extratags=[(_ZEISS_TAG, 2, len(data), data, True)])
    return path
