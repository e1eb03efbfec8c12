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

"""What a person at the microscope may have done meanwhile, seen from its frames."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semcal_ros.drivers.source import SourceFrame

# Rows that are looked at: a blanked beam blanks all of them, and a large image costs no more than a small one.
_ROWS = 64
# A blanked beam leaves the dark level and its noise, four grey levels of 8 bit at most; a picture of anything has more,
# since contrast is set so that the specimen uses the range.
_BLANK_SPREAD = 4.5 / 255.0
# One dark frame may be a beam that was blanked for a moment, as some microscopes do between two scans.
_BLANK_FRAMES = 2
# Two numbers for one setting agree to rounding; a person changes the magnification by more.
_SAME_WIDTH = 1e-3
# Supplies are stable to far better, and no one chooses voltages that are closer.
_SAME_VOLTAGE = 0.01


def is_blank(image: NDArray[Any]) -> bool:
    """Return whether an image shows nothing: its grey levels lie within a sixtieth of the range.

    Floats have no range: an image of them shows nothing where all are the same, or none is finite.

    Parameters
    ----------
    image
        (h, w) of any type.
    """
    rows = image[:: max(1, image.shape[0] // _ROWS)]
    # Single bright pixels, as of cosmic rays or of a marker, are no picture.
    low, high = np.percentile(rows, (0.5, 99.5))
    if image.dtype.kind == "f":
        return not high > low
    return bool(high - low <= _BLANK_SPREAD * np.iinfo(image.dtype).max)


@dataclass
class FrameWatch:
    """Follows frames; what it finds stays until it is over, or until :meth:`acknowledge`.

    Attributes
    ----------
    asked_width_m
        Field width that was last set from here, or None.
    """

    asked_width_m: float | None = None
    _asked_ns: int = 0
    _blank: int = 0
    _width_m: float | None = None
    _voltage_v: float | None = None
    _first_voltage_v: float | None = None

    def asked(self, width_m: float, now_ns: int) -> None:
        """Take note of a field width that was set from here; frames that began before may show another."""
        self.asked_width_m, self._asked_ns, self._width_m = width_m, now_ns, None

    def acknowledge(self) -> None:
        """Take what is now for what is wanted."""
        self.asked_width_m, self._asked_ns = None, 0
        self._first_voltage_v = self._voltage_v

    def see(self, frame: SourceFrame) -> list[str]:
        """Look at a frame; returns what is new, in words."""
        news = []
        blank = is_blank(frame.image)
        self._blank = self._blank + 1 if blank else 0
        if self._blank == _BLANK_FRAMES:
            news.append("the frames are blank: is the beam blanked, or off?")
        turned_before, voltage_before = self._turned(), self._other_voltage()
        if frame.start_ns >= self._asked_ns:
            self._width_m = frame.field_width_m
        voltage_v = _number(frame.conditions, "accelerating_voltage_v")
        if voltage_v is not None:
            self._voltage_v = voltage_v
            self._first_voltage_v = self._first_voltage_v or voltage_v
        news += [
            now
            for before, now in (
                (turned_before, self._turned()),
                (voltage_before, self._other_voltage()),
            )
            if now and now != before
        ]
        return news

    def _turned(self) -> str:
        if self.asked_width_m is None or self._width_m is None:
            return ""
        if math.isclose(self.asked_width_m, self._width_m, rel_tol=_SAME_WIDTH):
            return ""
        return (
            f"magnification turned at the microscope: field width {self._width_m:.4g} m, "
            f"{self.asked_width_m:.4g} m asked for"
        )

    def _other_voltage(self) -> str:
        now_v, first_v = self._voltage_v, self._first_voltage_v
        if now_v is None or first_v is None:
            return ""
        if math.isclose(now_v, first_v, rel_tol=_SAME_VOLTAGE):
            return ""
        return f"accelerating voltage {now_v:g} V, {first_v:g} V at the start"

    def conditions(self) -> list[str]:
        """Return what is wrong now, a few words each."""
        blank = ["blank frames"] if self._blank >= _BLANK_FRAMES else []
        return blank + [text for text in (self._turned(), self._other_voltage()) if text]


def _number(values: Mapping[str, float | str], key: str) -> float | None:
    value = values.get(key)
    return float(value) if isinstance(value, (int, float)) else None
