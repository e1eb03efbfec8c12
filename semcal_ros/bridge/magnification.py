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

"""The magnification of this calibration from whatever the microscope publishes.

With display width D of the calibration and field width W, the magnification is ``g = D / W``. A
pixel size p over an image of n pixels means ``W = n p``; a magnification g' that refers to another
display width D' means ``W = D' / g'``. Why a magnification alone says little: ``doc/conventions.md``.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from numbers import Real
from typing import Any

from semcal_ros.bridge.fields import optional_stamp_ns
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.errors import InvalidValueError, MessageError

MAGNIFICATION_LIMITS = (1.0, 1e8)
"""No SEM shows less than life size; at the upper limit a display of 0.12 m would show 1.2 nm."""

_SEGMENT = re.compile(r"([A-Za-z_]\w*)(?:\[(\d+)\])?")


@dataclass(frozen=True)
class MagnificationReading:
    """One message of the magnification topic, in SI units.

    Parameters
    ----------
    value
        The number: a magnification, or a length in m.
    stamp_ns
        Stamp of the message, or None where its type has no header.
    config
        The configuration it was read with.
    """

    value: float
    stamp_ns: int | None
    config: MicroscopeConfig

    @property
    def needs_image_width(self) -> bool:
        """True if :meth:`magnification` depends on the width of the frames."""
        source = self.config.magnification
        return source.quantity == "pixel_size" and source.image_width_px is None

    def field_width_m(self, image_width_px: int | None = None) -> float:
        """Width of the field of view in m.

        Parameters
        ----------
        image_width_px
            Width of the frames in px; required where :attr:`needs_image_width`, not used otherwise.
        """
        source = self.config.magnification
        if source.quantity == "field_width":
            return self.value
        if source.quantity == "magnification":
            return (source.display_width_m or self.config.display_width_m) / self.value
        width = source.image_width_px or image_width_px
        if width is None or width < 1:
            raise InvalidValueError(
                f"a pixel size with an image width of {width} px",
                expected="the width of the frames",
                do="wait for the first image or set magnification.image_width_px",
            )
        return self.value * width

    def magnification(self, image_width_px: int | None = None) -> float:
        """Magnification with respect to the calibration's display width.

        The argument is that of :meth:`field_width_m`.

        Raises
        ------
        MessageError
            The result is outside :data:`MAGNIFICATION_LIMITS`: most often a wrong unit or
            quantity in the configuration.
        """
        source = self.config.magnification
        if source.quantity == "magnification" and source.display_width_m is None:
            return check_magnification(self.value)
        field_width_m = self.field_width_m(image_width_px)
        if field_width_m <= 0.0:  # underflow of an absurd value
            return check_magnification(math.inf)
        return check_magnification(self.config.display_width_m / field_width_m)


def check_magnification(magnification: float) -> float:
    """Return the argument; raise :class:`MessageError` outside :data:`MAGNIFICATION_LIMITS`."""
    low, high = MAGNIFICATION_LIMITS
    if not low <= magnification <= high:
        raise MessageError(
            f"a magnification of {magnification:g}",
            expected=f"a number from {low:g} to {high:g}",
            do="check quantity and unit in the configuration",
        )
    return float(magnification)


def published_number(config: MicroscopeConfig, field_width_m: float, image_width_px: int) -> float:
    """Return the number from which a reader with this configuration computes the field width.

    Parameters
    ----------
    config
        What the topic carries.
    field_width_m
        Width of the field of view.
    image_width_px
        Width of the frames.
    """
    source = config.magnification
    if source.quantity == "magnification":
        return (source.display_width_m or config.display_width_m) / field_width_m
    if source.quantity == "field_width":
        return field_width_m / source.si_per_unit
    return field_width_m / (source.image_width_px or image_width_px) / source.si_per_unit


def read_magnification(message: Any, config: MicroscopeConfig) -> MagnificationReading:
    """Read the number that the configuration points to.

    Raises
    ------
    MessageError
        The field does not exist or holds no finite positive number.
    """
    source = config.magnification
    value = _number(_field(message, source.field, source.type), source.field)
    value_si = value * source.si_per_unit
    if not (math.isfinite(value_si) and value_si > 0.0):
        raise MessageError(
            f"a {source.quantity.replace('_', ' ')} of {value:g} in field {source.field}",
            expected="a finite number above 0",
            do="check the node that publishes it",
        )
    reading = MagnificationReading(value_si, optional_stamp_ns(message), config)
    if not reading.needs_image_width:
        reading.magnification()
    return reading


def _field(message: Any, path: str, type_name: str) -> Any:
    value = message
    for segment in path.split("."):
        match = _SEGMENT.fullmatch(segment)
        name, index = match.groups() if match else (segment, None)
        if not hasattr(value, name):
            raise MessageError(
                f"a message of type {type(message).__name__} without the field {path}",
                expected=f"{type_name}, as the configuration says",
                do="correct magnification.type or magnification.field",
            )
        value = getattr(value, name)
        if index is not None:
            value = _element(value, int(index), path)
    return value


def _element(values: Any, index: int, path: str) -> Any:
    try:
        return values[index]
    except (LookupError, TypeError, OverflowError) as error:
        size = len(values) if hasattr(values, "__len__") else "no"
        raise MessageError(
            f"field {path} with {size} elements", expected=f"at least {index + 1} elements"
        ) from error


def _number(value: Any, path: str) -> float:
    if isinstance(value, bool) or not isinstance(value, Real):
        raise MessageError(
            f"field {path} of type {type(value).__name__}",
            expected="a number",
            do="correct magnification.field in the configuration",
        )
    return float(value)
