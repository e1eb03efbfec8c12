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

"""One SEM image with the settings that its file declares: scale, databar and conditions."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcal_ros.bridge.conditions import Conditions


@dataclass(frozen=True, kw_only=True)
class VendorSettings(Conditions):
    """Conditions and scale from a maker's metadata in SI units; None where a file does not have one.

    Parameters
    ----------
    pixel_size_m
        Width of a pixel of the stored image on the specimen.
    pixel_size_y_m
        Height of such a pixel.
    displayed_magnification
        The magnification that the microscope showed, which depends on its display width.
    databar_rows
        Rows at the bottom of the file that are not part of the scan.
    display_width_assumed
        Whether the pixel size rests on the maker's usual display width, not on a value in the
        file.
    notes
        Remarks on these values for the user.
    """

    pixel_size_m: float
    pixel_size_y_m: float
    displayed_magnification: float | None = None
    databar_rows: int = 0
    display_width_assumed: bool = False
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class SemImage:
    """An SEM image without its databar, and its settings.

    Parameters
    ----------
    path
        The file.
    image
        (h, w) uint8 or uint16, grey.
    full_size_px
        (width, height) of the stored image, databar included.
    databar_rows
        Rows that were cut off at the bottom.
    settings
        The maker's metadata.
    page
        Index of the image in a file of several.
    """

    path: Path
    image: NDArray[Any]
    full_size_px: tuple[int, int]
    databar_rows: int
    settings: VendorSettings = field(repr=False)
    page: int = 0

    @property
    def maker(self) -> str:
        """The maker; see :class:`Conditions`."""
        return self.settings.maker

    @property
    def pixel_size_m(self) -> float:
        """Width of a pixel on the specimen."""
        return self.settings.pixel_size_m

    @property
    def pixel_size_y_m(self) -> float:
        """Height of a pixel on the specimen."""
        return self.settings.pixel_size_y_m

    @property
    def field_width_m(self) -> float:
        """Width of the scanned field."""
        return self.settings.pixel_size_m * self.full_size_px[0]

    @property
    def displayed_magnification(self) -> float | None:
        """Magnification that the microscope showed, if the file has it."""
        return self.settings.displayed_magnification

    @property
    def display_width_m(self) -> float | None:
        """Display width of the shown magnification: pixel size x columns x magnification."""
        shown = self.settings.displayed_magnification
        width_m = None if shown is None else self.field_width_m * shown
        return width_m if width_m is not None and math.isfinite(width_m) else None

    @property
    def working_distance_m(self) -> float | None:
        """Working distance."""
        return self.settings.working_distance_m

    @property
    def scan_rotation_rad(self) -> float | None:
        """Scan rotation, in the maker's sense of rotation."""
        return self.settings.scan_rotation_rad

    @property
    def stage_tilt_rad(self) -> float | None:
        """Tilt of the stage, in the maker's sense."""
        return self.settings.stage_tilt_rad

    @property
    def stage_rotation_rad(self) -> float | None:
        """Rotation of the stage, in the maker's sense of rotation."""
        return self.settings.stage_rotation_rad

    @property
    def dwell_s(self) -> float | None:
        """Time on each pixel."""
        return self.settings.dwell_s

    @property
    def frame_time_s(self) -> float | None:
        """Time of one pass over the frame."""
        return self.settings.frame_time_s

    @property
    def detector(self) -> str:
        """Detector name, empty if unknown."""
        return self.settings.detector

    @property
    def time(self) -> datetime | None:
        """Local time of the recording, without a time zone."""
        return self.settings.time

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on these values for the user."""
        return self.settings.notes

    def magnification(self, display_width_m: float) -> float:
        """Magnification of this field of view on a display of the given width."""
        return display_width_m / self.field_width_m

    def metadata(self) -> dict[str, Any]:
        """All settings as plain values for JSON (SI units)."""
        s = self.settings
        return {
            "file": self.path.name,
            "page": self.page,
            "full_size_px": list(self.full_size_px),
            "databar_rows": self.databar_rows,
            "pixel_size_m": s.pixel_size_m,
            "pixel_size_y_m": s.pixel_size_y_m,
            "field_width_m": self.field_width_m,
            "displayed_magnification": s.displayed_magnification,
            "display_width_m": self.display_width_m,
            "display_width_assumed": s.display_width_assumed,
            **s.conditions(),
            "bits": int(8 * np.dtype(self.image.dtype).itemsize),
            "notes": list(s.notes),
        }
