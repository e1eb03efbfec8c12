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

"""Operating conditions: what each is called, how it reads, and whether those now are those of a calibration."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from semcal_ros.core.camera.thresholds import (
    CONDITION_TOLERANCE,
    DISTANCE_TOLERANCE,
    ROTATION_TOLERANCE_RAD,
    VOLTAGE_TOLERANCE,
)
from semcal_ros.core.wording import printable

FILE_NAMES: Mapping[str, str] = {
    "accelerating_voltage_v": "acceleration_voltage_v",
    "serial": "serial_number",
}
"""What image and calibration files call conditions that have another name on the topic."""


def format_time(time_s: float) -> str:
    """A time in the unit that suits it."""
    for unit, scale in (("s", 1.0), ("ms", 1e3), ("us", 1e6)):
        if abs(time_s) * scale >= 1.0:
            return f"{time_s * scale:.4g} {unit}"
    return f"{time_s * 1e9:.4g} ns" if time_s else "0 s"


def _format_current(current_a: float) -> str:
    for unit, scale in (("A", 1.0), ("mA", 1e3), ("uA", 1e6), ("nA", 1e9)):
        if abs(current_a) * scale >= 1.0:
            return f"{current_a * scale:.4g} {unit}"
    return f"{current_a * 1e12:.4g} pA"


def _format_angle(angle_rad: float) -> str:
    return f"{math.degrees(angle_rad):.4g} deg"


_SHOWN: Mapping[str, tuple[str, Callable[[float], str]]] = {
    "maker": ("maker", str),
    "model": ("model", str),
    "serial_number": ("serial number", str),
    "beam": ("beam", str),
    "detector": ("detector", str),
    "acceleration_voltage_v": ("voltage", lambda v: f"{1e-3 * v:g} kV"),
    "working_distance_m": ("working distance", lambda v: f"{1e3 * v:.4g} mm"),
    "beam_current_a": ("beam current", _format_current),
    "dwell_s": ("dwell", format_time),
    "frame_time_s": ("frame time", format_time),
    "frame_interval_s": ("frame interval", format_time),
    "scan_rotation_rad": ("scan rotation", _format_angle),
    "stage_tilt_rad": ("stage tilt", _format_angle),
    "stage_rotation_rad": ("stage rotation", _format_angle),
}
# Another microscope, voltage, distance or rotation of the scan has another scale or distortion. Noise, contrast and
# speed depend on the others, and the distortion does not, as far as a calibration can tell.
_DECISIVE = (
    *("maker", "model", "serial_number"),
    *("acceleration_voltage_v", "working_distance_m", "scan_rotation_rad"),
)
_COMPARED = (*_DECISIVE, "detector", "beam_current_a", "dwell_s", "frame_time_s")
# A copy that ImageJ saved does not say which microscope it comes from.
_NO_MAKER = "imagej"


def describe_condition(name: str, values: Sequence[str | float]) -> tuple[str, str]:
    """Say a condition for people.

    Parameters
    ----------
    name
        Of the condition, as on the topic or in a file.
    values
        The different texts, or the least and the greatest number, SI units.

    Returns
    -------
    What it is called, and its value or values with a unit.
    """
    label, show = _SHOWN.get(FILE_NAMES.get(name, name), (name.replace("_", " "), str))
    if all(isinstance(value, str) for value in values):
        return label, printable(", ".join(map(str, values)), 300)
    return label, " to ".join(dict.fromkeys(show(float(value)) for value in values))


@dataclass(frozen=True)
class ConditionDifference:
    """A condition that differs from that of a calibration.

    Attributes
    ----------
    name
        Of the condition, as in the calibration file.
    seen, calibrated
        Its values now and then, for people.
    decisive
        Whether the calibration may no longer hold; else only what an image looks like has changed.
    """

    name: str
    seen: str
    calibrated: str
    decisive: bool

    @property
    def text(self) -> str:
        """Say the difference in a few words."""
        label = describe_condition(self.name, ())[0]
        return f"{label} {self.seen}, calibrated at {self.calibrated}"


def compare_conditions(
    calibrated: Mapping[str, Sequence[str] | Sequence[float]],
    seen: Mapping[str, float | str],
    *,
    height_sigma_m: float = 0.0,
) -> tuple[ConditionDifference, ...]:
    """Compare the conditions now with those of a calibration; what one of them does not tell is not compared.

    Parameters
    ----------
    calibrated
        The different texts, or the least and the greatest number, by name, SI units.
    seen
        The conditions now, by name. What is no text, or no finite number, counts as not known.
    height_sigma_m
        1-sigma of the height that the calibration allows for, m: a working distance that differs by less is within
        its stated uncertainty.

    Returns
    -------
    The differences beyond the tolerances, decisive ones first. Tolerances are 1 % of a voltage, current or time, the
    larger of 1 % and ``height_sigma_m`` for the working distance, and 0.5 degrees for the scan rotation.

    Examples
    --------
    >>> then = {"acceleration_voltage_v": (5000.0, 5000.0), "detector": ("SE",)}
    >>> [d.text for d in compare_conditions(then, {"accelerating_voltage_v": 1e4, "detector": "SE"})]
    ['voltage 10 kV, calibrated at 5 kV']
    """
    then: dict[str, Sequence[str] | Sequence[float]] = {
        FILE_NAMES.get(name, name): values for name, values in calibrated.items()
    }
    now = {FILE_NAMES.get(name, name): value for name, value in seen.items()}
    found = []
    for name in _COMPARED:
        values, value = then.get(name, ()), now.get(name)
        if not values or value is None:
            continue
        if _differs(name, values, value, height_sigma_m):
            value_text = describe_condition(name, (value,))[1]
            found.append(
                ConditionDifference(
                    name, value_text, describe_condition(name, values)[1], name in _DECISIVE
                )
            )
    return tuple(found)


def _differs(
    name: str, values: Sequence[str] | Sequence[float], value: float | str, height_sigma_m: float
) -> bool:
    if isinstance(value, str) or any(isinstance(known, str) for known in values):
        texts = {known.strip().casefold() for known in values if isinstance(known, str)}
        if not isinstance(value, str) or len(texts) < len(values):
            return False
        word = value.strip().casefold()
        if name == "maker" and _NO_MAKER in (word, *texts):
            return False
        return bool(word) and word not in texts
    numbers = [float(known) for known in values]
    low, high, number = min(numbers), max(numbers), float(value)
    if not all(map(math.isfinite, (low, high, number))):
        return False
    if name == "scan_rotation_rad":
        # The whole turn that brings it next to the middle of the range.
        middle = 0.5 * (low + high)
        number = middle + math.remainder(number - middle, 2.0 * math.pi)
        return not low - ROTATION_TOLERANCE_RAD <= number <= high + ROTATION_TOLERANCE_RAD
    relative = {
        "acceleration_voltage_v": VOLTAGE_TOLERANCE,
        "working_distance_m": DISTANCE_TOLERANCE,
    }.get(name, CONDITION_TOLERANCE)
    if name == "acceleration_voltage_v":
        # Some programs show the negative voltage of the cathode.
        low, high, number = (*sorted((abs(low), abs(high))), abs(number))
    least = height_sigma_m if name == "working_distance_m" else 0.0
    return number < low - max(relative * abs(low), least) or number > high + max(
        relative * abs(high), least
    )
