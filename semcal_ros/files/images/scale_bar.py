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

"""Scale bars: a round length with its uncertainty, drawn into a picture or on a strip below it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from semcal_ros.core.arrays import check_positive

# So that the label and the pixel size find room beside it.
_PART_OF_WIDTH = 0.25
_STEPS = (1.0, 2.0, 5.0)
_UNITS = ((1e-3, "mm"), (1e-6, "µm"), (1e-9, "nm"), (1e-12, "pm"))
# Smallest letters that can be read, px.
_LEAST_TEXT_PX = 10


@dataclass(frozen=True)
class ScaleBar:
    """A bar of a round length.

    Attributes
    ----------
    length_m
        Its length on the specimen.
    length_px
        Its length in the picture.
    label
        Its length as text, with the 1-sigma.
    pixel_size
        The pixel size as text, with the 1-sigma.
    """

    length_m: float
    length_px: float
    label: str
    pixel_size: str


def format_length(length_m: float, digits: int = 3) -> str:
    """Format a length in the unit that keeps it short, such as ``500 nm`` or ``2 µm``."""
    size, unit = next((u for u in _UNITS if abs(length_m) >= 0.9995 * u[0]), _UNITS[-1])
    # Rounded first: 160 to two digits is not to be 1.6e+02.
    return f"{float(f'{length_m / size:.{digits}g}'):g} {unit}"


def _format_nm(value_m: float, sigma_m: float | None) -> str:
    """Format nm, with as many digits as two of the sigma."""
    value = 1e9 * value_m
    if sigma_m is None or not (math.isfinite(sigma_m) and sigma_m > 0.0):
        return f"{value:.4g} nm"
    sigma = 1e9 * sigma_m
    digits = min(max(1 - math.floor(math.log10(sigma)), 0), 6)
    return f"{value:.{digits}f} ± {sigma:.{digits}f} nm"


def choose_scale_bar(width_px: int, pixel_size_m: float, sigma_m: float | None = None) -> ScaleBar:
    """Choose the longest bar of 1, 2 or 5 times a power of ten that takes a quarter of the width at most.

    Parameters
    ----------
    width_px
        Width of the picture.
    pixel_size_m
        Pixel size on the specimen.
    sigma_m
        Its 1-sigma; None where only the nominal size is known, which the label says.

    Raises
    ------
    InvalidValueError
        If the width or the pixel size is not positive.
    """
    room = check_positive(width_px, "width_px =") * check_positive(pixel_size_m, "pixel_size_m =")
    room *= _PART_OF_WIDTH
    decade = 10.0 ** math.floor(math.log10(room))
    # The quotient of a room that is itself a round length can come out just below it.
    length = max(step for step in _STEPS if step * decade <= room * (1.0 + 1e-9)) * decade
    known = sigma_m is not None and math.isfinite(sigma_m)
    label = format_length(length)
    if known:
        assert sigma_m is not None
        label += f" ± {format_length(length * sigma_m / pixel_size_m, 2)}"
    else:
        label += " (nominal)"
    return ScaleBar(
        length, length / pixel_size_m, label, f"{_format_nm(pixel_size_m, sigma_m)} per px"
    )


@lru_cache(maxsize=8)
def _load_font(size_px: int) -> ImageFont.FreeTypeFont:
    # matplotlib's own font has the Greek letter and the signs, wherever it is installed.
    import matplotlib as mpl

    return ImageFont.truetype(
        str(Path(mpl.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size_px
    )


def _text_px(height_px: int) -> int:
    return max(_LEAST_TEXT_PX, round(height_px / 32))


def draw_scale_bar(picture: NDArray[np.uint8], bar: ScaleBar, *, above_px: int = 0) -> None:
    """Draw a bar with its label into the lower right corner, white with a black edge.

    Parameters
    ----------
    picture
        (h, w) grey levels, which are changed.
    bar
        As :func:`choose_scale_bar` makes it for the width of the picture.
    above_px
        Rows at the bottom that something else stands in.
    """
    height, width = picture.shape
    text = _text_px(height)
    canvas = Image.fromarray(picture)
    pen, font = ImageDraw.Draw(canvas), _load_font(text)
    edge = max(1, text // 8)
    right, bottom = width - text // 2, height - text // 2 - above_px
    thick = max(2, text // 5)
    # Both ends belong to a rectangle of Pillow.
    left = right - round(bar.length_px) + 1
    pen.rectangle((left - edge, bottom - thick - edge, right + edge, bottom + edge), fill=0)
    pen.rectangle((left, bottom - thick, right, bottom), fill=255)
    pen.text(
        (right, bottom - thick - 2 * edge),
        bar.label,
        fill=255,
        font=font,
        anchor="rs",
        stroke_width=edge,
        stroke_fill=0,
    )
    picture[...] = np.asarray(canvas)


def add_databar(image: NDArray[Any], bar: ScaleBar, *lines: str) -> NDArray[Any]:
    """Append a strip with a bar and texts below an image, as the makers of SEMs do; no pixel is changed.

    Parameters
    ----------
    image
        (h, w) or (h, w, 3) of any real type.
    bar
        As :func:`choose_scale_bar` makes it for the width of the image.
    lines
        More texts, as far as they find room.

    Returns
    -------
    (h + rows, w) or (h + rows, w, 3) of the same type; the strip has the image's least and largest grey
    levels, so that its contrast on the screen stays.
    """
    height, width = image.shape[:2]
    text = _text_px(min(height, width))
    rows = 2 * text + text // 2
    canvas = Image.new("L", (width, rows), 0)
    pen, font = ImageDraw.Draw(canvas), _load_font(text)
    middle, margin = rows // 2, text // 2
    thick = max(2, text // 5)
    end = margin + round(bar.length_px)
    # Both ends belong to a rectangle of Pillow.
    pen.rectangle((margin, middle - thick, end - 1, middle + thick), fill=255)
    left = float(end + margin)
    for line in (bar.label, bar.pixel_size, *lines):
        wide = pen.textlength(line, font=font)
        if left + wide > width:
            break
        pen.text((left, middle), line, fill=255, font=font, anchor="lm")
        left += wide + 2 * text
    strip = np.asarray(canvas, dtype=np.float64) / 255.0
    finite = image[np.isfinite(image)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    if high <= low:
        high = low + 1.0 if image.dtype.kind == "f" else float(np.iinfo(image.dtype).max)
    levels = (low + (high - low) * strip).astype(image.dtype)
    if image.ndim == 3:
        levels = np.repeat(levels[..., None], image.shape[2], axis=2)
    return np.concatenate([image, levels])
