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
from pathlib import Path

import numpy as np
import tifffile

__all__ = ["PIXEL_M", "number_in", "numbered_image", "save_sem_tiff", "thermo_fisher_tag"]

PIXEL_M = 5e-9
# Tag of Thermo Fisher (FEI).
_TAG = 34682
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
