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

"""The bars of the calibration panel: what the views cover, beside what a good calibration wants."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from semcal_ros.viewer.source import AcquisitionPanel, Bar

__all__ = ["describe_acquisition", "describe_coverage", "describe_run"]

# What doc/calibration.md asks for: five views at each magnification, tilts that differ by 20 to 40 degrees, and nine
# magnifications.
_VIEWS, _TILT_DEG, _MAGNIFICATIONS = 5, 30.0, 9


def _number(values: Mapping[str, str], key: str) -> float | None:
    try:
        number = float(values[key])
    except (KeyError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _views(values: Mapping[str, str]) -> dict[float, int]:
    found = {}
    for key, value in values.items():
        if (match := re.fullmatch(r"views at (\S+)x", key)) and value.isdigit():
            found[float(match[1])] = int(value)
    return dict(sorted(found.items()))


def describe_coverage(values: Mapping[str, str]) -> tuple[Bar, ...]:
    """Describe what the views cover.

    Parameters
    ----------
    values
        The key-value pairs of ``calibration_server/progress``.
    """
    views = _views(values)
    most, least = max(views.values(), default=0), min(views.values(), default=0)
    each = f"{least}" if least == most else f"{least} to {most}"
    field = _number(values, "field_share") or 0.0
    least_deg, most_deg = _number(values, "least_tilt_deg"), _number(values, "largest_tilt_deg")
    if least_deg is None or most_deg is None:
        spread_deg, tilts = 0.0, f"none; spread over {_TILT_DEG:.0f}° is good"
    else:
        spread_deg = most_deg - least_deg
        tilts = f"{least_deg:.0f}° to {most_deg:.0f}°; spread over {_TILT_DEG:.0f}° is good"
    covered = "none"
    if views:
        low, high = min(views), max(views)
        reach = f"at {low:g}×" if low == high else f"from {low:g}× to {high:g}×"
        covered = f"{len(views)} {reach}"
    return (
        Bar("Field with corners", field, f"{field:.0%}"),
        Bar("Tilts", min(spread_deg / _TILT_DEG, 1.0), tilts),
        Bar(
            "Magnifications",
            min(len(views) / _MAGNIFICATIONS, 1.0),
            f"{covered}; {_MAGNIFICATIONS} or more are good",
        ),
        Bar(
            "Views of each",
            min(least / _VIEWS, 1.0),
            f"{each}; {_VIEWS} are good" if views else f"none; {_VIEWS} are good",
        ),
    )


def describe_run(values: Mapping[str, str]) -> Bar | None:
    """Describe a calibration that is running; None without one."""
    fraction = _number(values, "fraction")
    if fraction is None or "stage" not in values or values["stage"] == "done":
        return None
    return Bar("Calibrating", min(max(fraction, 0.0), 1.0), values["stage"])


def describe_acquisition(values: Mapping[str, str]) -> AcquisitionPanel | None:
    """Describe a calibration that records itself; None from a server that does not tell of it."""
    microscope = values.get("microscope")
    if microscope is None:
        return None
    low, high = _number(values, "lowest_magnification"), _number(values, "highest_magnification")
    target, sigma = _number(values, "target"), _number(values, "largest_sigma")
    taken, planned = _number(values, "taken"), _number(values, "planned")
    bars: tuple[Bar, ...] = ()
    if taken is not None and planned:
        left_out = _number(values, "left_out") or 0.0
        text = f"{taken:.0f} of {planned:.0f} so far" + f", {left_out:.0f} left out" * bool(
            left_out
        )
        bars = (Bar("Views of the plan", min(taken / planned, 1.0), text),)
    if target and bars:
        known = "not known yet" if sigma is None else f"{100.0 * sigma:.2g} %"
        share = 0.0 if not sigma else min(target / sigma, 1.0)
        bars += (Bar("Certainty of nm per px", share, f"{known}; {100.0 * target:.2g} % wanted"),)
    return AcquisitionPanel(
        values.get("acquisition", "ready"),
        f"{microscope} moves by itself" if microscope else "you set each view, step by step",
        values.get("request", ""),
        bars,
        (low, high) if low and high else None,
        target,
    )
