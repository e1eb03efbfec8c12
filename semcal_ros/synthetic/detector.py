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

"""From reflectivity to grey values: beam spot, line jitter, shading, shot noise, amplifier and quantisation."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array, Image
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic.thresholds import (
    JITTER_MAX_PX,
    POISSON_MAX,
    RIDGE_PX,
    SHIFT_REACH,
    TOOL_CORNERS,
    TOOL_LEVEL,
    TOOL_RIDGES,
)

Grey = NDArray[np.uint8] | NDArray[np.uint16]


def _cover(reflectivity: Image, part: float) -> Image:
    """What is seen where a tip is in front of the specimen."""
    height, width = reflectivity.shape
    corners = np.rint(16.0 * TOOL_CORNERS * [part * width, height]).astype(np.int32)
    mask = np.zeros(reflectivity.shape, dtype=np.uint8)
    cv2.fillPoly(mask, [corners], 255, cv2.LINE_AA, 4)
    shown = mask.astype(np.float32) / np.float32(255.0)
    rows = np.arange(height, dtype=np.float32)[:, None] / np.float32(RIDGE_PX)
    tip = np.float32(TOOL_LEVEL) + np.float32(TOOL_RIDGES) * np.sin(rows)
    return np.asarray(reflectivity * (1.0 - shown) + tip * shown, dtype=np.float32)


@dataclass(frozen=True)
class Detector:
    """Image formation after the scan.

    The yield of reflectivity r is ``dark_yield + (1 - dark_yield) r``, times the shading.
    ``electrons`` times it is the mean number of electrons in a pixel; what arrives is Poisson
    distributed. The grey value is ``offset + gain * arrived / electrons + noise`` of full scale.

    Parameters
    ----------
    blur_px
        Sigma of the beam spot, px.
    line_jitter_px
        1-sigma of the shift of each line along x, in the average of all passes.
    electrons
        Electrons per pixel and averaged frame at yield 1; 0 switches shot noise off.
    noise
        1-sigma of the amplifier noise, of full scale.
    dark_yield
        Yield at reflectivity 0.
    offset, gain
        Brightness and contrast, of full scale.
    shading
        Relative change (x, y) of the yield from one border of the frame to the other.
    vignetting
        Relative loss of yield at the corners.
    inverted
        Bright becomes dark.
    bits
        8 or 16.
    databar_rows
        Rows of a data bar that are appended below the scanned field.
    tip
        Part of the field's width that a bright tip from the left covers where it reaches farthest; 0 for none.
    """

    blur_px: float = 0.8
    electrons: float = 300.0
    noise: float = 0.006
    dark_yield: float = 0.2
    offset: float = 0.05
    gain: float = 0.75
    shading: tuple[float, float] = (0.06, -0.04)
    vignetting: float = 0.03
    inverted: bool = False
    bits: int = 8
    databar_rows: int = 0
    line_jitter_px: float = 0.0
    tip: float = 0.0

    def __post_init__(self) -> None:
        if self.bits not in (8, 16):
            raise InvalidValueError(f"{self.bits} bits", expected="8 or 16")
        if self.blur_px < 0 or self.electrons < 0 or self.noise < 0 or self.databar_rows < 0:
            raise InvalidValueError(
                f"detector {self}", expected="no negative blur, dose, noise or rows"
            )

        if not 0.0 <= self.tip <= 1.0:
            raise InvalidValueError(
                f"a tip over {self.tip:g} of the field", expected="a part of it, 0 to 1"
            )
        if not 0.0 <= self.line_jitter_px <= JITTER_MAX_PX:
            raise InvalidValueError(
                f"a line jitter of {self.line_jitter_px:g} px",
                expected=f"0 to {JITTER_MAX_PX:g} px",
            )

    @property
    def pad_px(self) -> int:
        """Border in px that the beam spot reaches."""
        return round(4.0 * self.blur_px + 0.5) if self.blur_px > 0 else 0

    def expose(self, reflectivity: Image, rng: np.random.Generator) -> Grey:
        """Compute the grey image of a reflectivity that extends ``pad_px`` px beyond the frame on every side.

        Returns
        -------
        (h + databar_rows, w) uint8 or uint16.
        """
        if self.tip > 0.0:
            reflectivity = _cover(reflectivity, self.tip)
        signal = self._spot(reflectivity)
        if self.line_jitter_px > 0:
            shifts = self.line_jitter_px * rng.standard_normal(len(signal))
            signal = _shift_lines(signal, shifts)
        signal = signal * np.float32(1.0 - self.dark_yield)
        signal += np.float32(self.dark_yield)
        self._shade(signal)
        if self.electrons > 0:
            signal = self._count(signal, rng)
        signal *= np.float32(self.gain)
        signal += np.float32(self.offset)
        if self.noise > 0:
            noise = rng.standard_normal(signal.shape, dtype=np.float32)
            noise *= np.float32(self.noise)
            signal += noise
        if self.inverted:
            signal = np.float32(1.0) - signal
        return self._quantise(signal)

    def _spot(self, reflectivity: Image) -> Image:
        pad = self.pad_px
        if pad == 0:
            return reflectivity
        kernel = (2 * pad + 1, 2 * pad + 1)
        blurred = cv2.GaussianBlur(reflectivity, kernel, self.blur_px)
        return np.ascontiguousarray(blurred[pad:-pad, pad:-pad], dtype=np.float32)

    def _shade(self, signal: Image) -> None:
        y = np.linspace(-1.0, 1.0, signal.shape[0], dtype=np.float32)[:, None]
        x = np.linspace(-1.0, 1.0, signal.shape[1], dtype=np.float32)[None, :]
        across, along, corner = (np.float32(0.5 * v) for v in (*self.shading, self.vignetting))
        signal *= 1.0 + across * x + along * y - corner * (x * x + y * y)

    def _count(self, signal: Image, rng: np.random.Generator) -> Image:
        mean = np.maximum(signal, 0.0) * np.float32(self.electrons)
        if float(mean.min()) < POISSON_MAX:
            counted = rng.poisson(mean).astype(np.float32)
        else:
            counted = rng.standard_normal(mean.shape, dtype=np.float32)
            counted *= np.sqrt(mean)
            counted += mean
        counted /= np.float32(self.electrons)
        return counted

    def _quantise(self, signal: Image) -> Grey:
        top = 2**self.bits - 1
        signal *= np.float32(top)
        np.rint(signal, out=signal)
        np.clip(signal, 0, top, out=signal)
        if self.databar_rows > 0:
            signal = np.concatenate(
                [signal, _draw_databar(self.databar_rows, signal.shape[1], top)]
            )
        if self.bits == 8:
            return signal.astype(np.uint8)
        return signal.astype(np.uint16)


def _draw_databar(rows: int, width: int, top: int) -> Image:
    """Draw a black bar with a scale line and tick marks; their corners must not be taken for the specimen's."""
    bar = np.zeros((rows, width), dtype=np.float32)
    middle = rows // 2
    bar[middle : middle + 1, width // 16 : width // 4] = top
    bar[max(middle - 3, 0) : middle + 4, width // 16 : width // 4 : max(width // 64, 2)] = top
    bar[0] = top
    return bar


# Every disturbance is off; 16 bits keep the rounding of grey values small.
NOISE_FREE = Detector(
    blur_px=0.0, electrons=0.0, noise=0.0, shading=(0.0, 0.0), vignetting=0.0, bits=16
)


def _shift_lines(image: Image, shifts_px: Array) -> Image:
    """Shift each line along x: what was at column c is at c + shift. Borders are continued.

    Lagrange interpolation over the eight nearest samples.
    """
    whole = np.floor(shifts_px)
    part = shifts_px - whole
    # A value is wanted at column c - whole - part, between the samples -1 and 0 from c - whole.
    taps = np.arange(-SHIFT_REACH, SHIFT_REACH)
    weights = np.ones((len(taps), len(shifts_px)))
    for row, tap in zip(weights, taps, strict=True):
        for other in taps[taps != tap]:
            row *= (-part - other) / (tap - other)
    # All lines at once, one multiply-add per column offset: gathering each line for itself takes 21 ms
    # at 512 x 512, this 4 ms.
    whole_px = whole.astype(np.intp)
    first, last = -SHIFT_REACH - int(whole_px.max()), SHIFT_REACH - 1 - int(whole_px.min())
    reach, width = max(-first, last), image.shape[1]
    padded = np.pad(image, ((0, 0), (reach, reach)), mode="edge")
    lines = np.arange(len(image))
    by_offset = np.zeros((last - first + 1, len(image)), dtype=np.float32)
    for weight, tap in zip(weights, taps, strict=True):
        by_offset[tap - whole_px - first, lines] = weight
    shifted: Image = np.zeros_like(image)
    for offset, factors in enumerate(by_offset, start=first + reach):
        shifted += factors[:, None] * padded[:, offset : offset + width]
    return shifted
