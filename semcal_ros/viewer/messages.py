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

"""The messages between page and server: what goes out with a picture, and what comes in."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass, field, replace
from typing import Any

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.images.scale_bar import choose_scale_bar, format_length
from semcal_ros.files.images.write import pixel_scale
from semcal_ros.viewer.measure import (
    PICTURES,
    Distance,
    digits_of,
    format_with_sigma,
    measure_distance,
)
from semcal_ros.viewer.pictures import (
    Contrast,
    Levels,
    Region,
    choose_levels,
    choose_region,
    encode_picture,
)
from semcal_ros.viewer.source import View

# A page that asks for more gets this: the longest side of a screen with room to spare.
_LARGEST_WIDTH_PX = 4096


@dataclass(frozen=True)
class PageRequest:
    """What a page wants to see.

    Attributes
    ----------
    pictures
        Which of :data:`~semcal_ros.viewer.measure.PICTURES`.
    width_px
        How many pixels it has for each.
    contrast, zoom, centre
        As :mod:`semcal_ros.viewer.pictures` takes them.
    """

    pictures: tuple[str, ...] = PICTURES
    width_px: int = 640
    contrast: Contrast = field(default_factory=Contrast)
    zoom: float = 1.0
    centre: tuple[float, float] = (0.5, 0.5)


def _number(value: Any, name: str) -> float:
    # JSON has no other numbers; true and false are ints to Python.
    if type(value) not in (int, float) or not math.isfinite(value):
        raise InvalidValueError(f"{name} = {value!r}", expected="a finite number")
    return float(value)


def read_value(value: Any) -> float | tuple[float, ...] | None:
    """Read the value of an action: nothing, a number, or several.

    Raises
    ------
    InvalidValueError
        It is something else, or a number is not finite.
    """
    if value is None:
        return None
    if isinstance(value, list):
        return tuple(_number(one, "value") for one in value)
    return _number(value, "value")


def _pair(value: Any, name: str) -> tuple[float, float]:
    if not isinstance(value, list) or len(value) != 2:
        raise InvalidValueError(f"{name} = {value!r}", expected="two numbers")
    return _number(value[0], name), _number(value[1], name)


def read_page_request(message: dict[str, Any], before: PageRequest) -> PageRequest:
    """Read what a page wants; what the message leaves out stays as before.

    Raises
    ------
    InvalidValueError
        A value is of another kind or out of its range.
    """
    request = before
    if "pictures" in message:
        named = message["pictures"]
        if not isinstance(named, list) or not all(name in PICTURES for name in named):
            raise InvalidValueError(f"pictures = {named!r}", expected=" or ".join(PICTURES))
        request = replace(request, pictures=tuple(name for name in PICTURES if name in named))
    if "width" in message:
        width = _number(message["width"], "width")
        request = replace(request, width_px=int(min(max(width, 16.0), _LARGEST_WIDTH_PX)))
    if "contrast" in message:
        given = message["contrast"]
        if not isinstance(given, dict):
            raise InvalidValueError(f"contrast = {given!r}", expected="mode, low and high")
        mode = str(given.get("mode", "auto"))
        contrast = Contrast(mode)
        if mode == "fixed":
            low, high = (_number(given.get(name), name) for name in ("low", "high"))
            contrast = Contrast(mode, low, high)
        request = replace(request, contrast=contrast)
    if "zoom" in message:
        request = replace(request, zoom=_number(message["zoom"], "zoom"))
    if "centre" in message:
        request = replace(request, centre=_pair(message["centre"], "centre"))
    return request


def _pack(header: dict[str, object], blobs: list[bytes]) -> bytes:
    """Length of the header, header as JSON, then the pictures one after the other."""
    text = json.dumps(header, allow_nan=False).encode()
    return b"".join([struct.pack("<I", len(text)), text, *blobs])


def _scale(view: View, width_px: int) -> dict[str, object] | None:
    if view.camera is None:
        return None
    scale = pixel_scale(view.camera)
    bar = choose_scale_bar(width_px, scale.size_m, scale.sigma_m)
    return {
        "nm_per_px": 1e9 * scale.size_m,
        "pixel_size": bar.pixel_size,
        "bar_px": bar.length_px,
        "bar_label": bar.label,
        "calibrated": view.calibrated,
    }


def encode_view(view: View, request: PageRequest, *, age_s: float | None = None) -> bytes:
    """Encode a frame as one message: a header in JSON, and its pictures as JPEG.

    All pictures are stretched by the levels of the first one, so that they can be compared.

    Parameters
    ----------
    view, request
        What there is, and what the page wants of it.
    age_s
        Time since the stamp, where both are of one clock.
    """
    levels: Levels | None = None
    pictures, blobs = [], []
    # By the raw picture, also where it is not shown: the levels must not jump as the page blinks.
    for name in PICTURES:
        if (image := view.pictures.get(name)) is None:
            continue
        if levels is None:
            levels = choose_levels(image, request.contrast)
        if name not in request.pictures:
            continue
        height, width = image.shape[:2]
        region = choose_region((width, height), request.zoom, request.centre)
        data, shown = encode_picture(image, levels, region, request.width_px)
        blobs.append(data)
        pictures.append(
            {
                "name": name,
                "size": [width, height],
                "region": _corners(region),
                "shown": list(shown),
                "bytes": len(data),
                "scale": _scale(view, region.width),
            }
        )
    header: dict[str, object] = {
        "type": "view",
        "number": view.number,
        "name": view.name,
        "stamp_s": view.stamp_ns * 1e-9,
        "age_ms": None if age_s is None else round(1e3 * age_s, 1),
        "drift_px": None if view.drift_px is None else [round(v, 3) for v in view.drift_px],
        "moving": view.moving,
        "levels": None
        if levels is None
        else [levels.low, levels.high, levels.least, levels.greatest],
        "available": [name for name in PICTURES if name in view.pictures],
        "pictures": pictures,
    }
    return _pack(header, blobs)


def _corners(region: Region) -> list[int]:
    return [region.x, region.y, region.width, region.height]


def encode_overlay(number: int, image: Any, width_px: int) -> bytes:
    """Encode the picture with the corners of the grid, as :func:`encode_view` does."""
    height, width = image.shape[:2]
    region = Region(0, 0, width, height)
    data, shown = encode_picture(image, Levels(0.0, 255.0, 0.0, 255.0), region, width_px)
    header: dict[str, object] = {"type": "overlay", "number": number, "shown": list(shown)}
    return _pack(header, [data])


def describe_distance(distance: Distance, *, calibrated: bool) -> dict[str, object]:
    """Describe a length in words, with its uncertainty and where that comes from.

    Parameters
    ----------
    distance
        As measured.
    calibrated
        Whether its scale is of a calibration; otherwise it is that of a display width.
    """
    sigma_m = distance.sigma_m
    text = format_with_sigma(distance.length_m, sigma_m)
    placing = format_length(distance.placing_sigma_m, 2)
    if distance.calibration_sigma_m is None:
        why = f"the scale is nominal, so its uncertainty is not known; placing the ends: {placing}"
    else:
        scale = format_length(distance.calibration_sigma_m, 2)
        cause = "calibration" if calibrated else "nominal scale, not calibrated"
        why = f"1-sigma; {cause}: {scale}, placing the ends on the screen: {placing}"
    return {
        "text": text,
        "why": why,
        "x": _coordinate(distance.x_m, sigma_m),
        "y": _coordinate(distance.y_m, sigma_m),
        "length_nm": 1e9 * distance.length_m,
        "sigma_nm": None if sigma_m is None else 1e9 * sigma_m,
        "angle_deg": math.degrees(math.atan2(distance.y_m, distance.x_m)),
    }


def _coordinate(value_m: float, sigma_m: float | None) -> str:
    return f"{1e6 * value_m:.{digits_of(0.0 if sigma_m is None else 1e6 * sigma_m)}f}"


def measure(view: View | None, message: dict[str, Any]) -> dict[str, object]:
    """Answer what a page measures: ``picture``, ``start``, ``end``, ``placed_to``; px of the image.

    Raises
    ------
    InvalidValueError
        Something is missing, or cannot be measured.
    """
    if view is None or view.camera is None:
        raise InvalidValueError(
            "no picture with a known magnification",
            expected="one to measure in",
            do="check that the magnification is published",
        )
    picture = str(message.get("picture"))
    image = view.pictures.get(picture)
    if image is None:
        raise InvalidValueError(f"a picture {picture!r}", expected=" or ".join(view.pictures))
    height, width = image.shape[:2]
    camera = view.camera.resized(width, height)
    start = message.get("start")
    # Coordinates count from the middle: the optical axis, where the sem frame begins, is known far worse.
    begin = (0.5 * (width - 1), 0.5 * (height - 1)) if start is None else _pair(start, "start")
    distance = measure_distance(
        camera,
        picture,
        begin,
        _pair(message.get("end"), "end"),
        placed_to_px=_number(message.get("placed_to", 1.0), "placed_to"),
    )
    return describe_distance(distance, calibrated=view.calibrated)
