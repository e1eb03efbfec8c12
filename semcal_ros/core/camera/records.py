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

"""What a calibration keeps of how it was made: where it comes from, its fit, and the ladder that extended it.

The statistics of a calibration are notes for people, which may be edited. What programs read back is here, with types
and units, and is checked when a file is read.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from semcal_ros.core.camera.conditions import describe_condition
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import printable

NOT_RECORDED = "not recorded"
"""What people read in the place of what is not known."""

# The microscope is named by these alone, without a label.
_MICROSCOPE = ("maker", "model", "serial_number")
# What changes the scale of any microscope.
_ESSENTIAL = ("acceleration_voltage_v", "working_distance_m")
# Of interest with the views, not with the microscope.
_OF_VIEWS = ("beam", "stage_tilt_rad", "stage_rotation_rad", "frame_interval_s")


@dataclass(frozen=True)
class Provenance:
    """Origin of a calibration; an empty text or collection where it is not recorded.

    Attributes
    ----------
    calibrated
        When it was computed: date and time (UTC).
    recorded
        Date and time (UTC) of the first and the last view, where the stamps are dates.
    software_version
        Version of the software that computed it.
    recording, recording_sha256
        Name of the recording, and the digest of its data files.
    configuration, configuration_sha256
        Name of the configuration, and the digest of the settings in effect.
    views
        Names of the views used.
    conditions
        How the views were taken, in SI units: the different texts, or the least and the greatest number.
    """

    calibrated: str = ""
    recorded: tuple[str, ...] = ()
    software_version: str = ""
    recording: str = ""
    recording_sha256: str = ""
    configuration: str = ""
    configuration_sha256: str = ""
    views: tuple[str, ...] = ()
    conditions: Mapping[str, tuple[str, ...] | tuple[float, ...]] = field(default_factory=dict)

    def describe_origin(self) -> str:
        """When, with what, and from what it was computed, in one line."""
        parts = [
            f"{self.calibrated} UTC" if self.calibrated else "",
            f"recording {self.recording}" if self.recording else "",
            f"configuration {self.configuration}" if self.configuration else "",
            f"semcal_ros {self.software_version}" if self.software_version else "",
        ]
        return printable(", ".join(filter(None, parts))) or NOT_RECORDED

    def describe_microscope(self) -> str:
        """Maker, model and serial number of the microscope, in one line."""
        known = [" or ".join(map(str, self.conditions.get(name, ()))) for name in _MICROSCOPE]
        return printable(" ".join(filter(None, known))) or NOT_RECORDED

    def describe_conditions(self) -> str:
        """The conditions of the beam and the scan, in one line."""
        parts = [
            " ".join(describe_condition(name, values))
            for name, values in self.conditions.items()
            if name not in (*_MICROSCOPE, *_OF_VIEWS)
        ]
        return ", ".join(parts) or NOT_RECORDED

    def describe_essentials(self) -> str:
        """What a calibration holds for, in a few words: voltage, working distance and the days of its views."""
        days = tuple(dict.fromkeys(date[:10] for date in self.recorded))
        parts = {
            describe_condition(name, ())[0]: describe_condition(
                name, self.conditions.get(name, ())
            )[1]
            for name in _ESSENTIAL
        } | {"date": " to ".join(days)}
        if not any(parts.values()):
            return f"conditions {NOT_RECORDED}"
        return printable(
            ", ".join(f"{name} {value or NOT_RECORDED}" for name, value in parts.items())
        )

    def describe(self) -> str:
        """All three, in one line for a log."""
        parts = (self.describe_origin(), self.describe_microscope(), self.describe_conditions())
        known = [part for part in parts if part != NOT_RECORDED]
        return printable(", ".join(known), 300) or NOT_RECORDED


@dataclass(frozen=True)
class Certificate:
    """That an adjustment ended at a minimum, and how well its equations determine it.

    Attributes
    ----------
    remaining_sigmas
        The largest of the changes that one more Newton step would make, in sigmas of the unknown.
    last_decrease
        Relative decrease of the cost in the last step.
    condition
        Condition number of the equations, scaled to ones on the diagonal.
    held
        Functions of which a prior, and not the views, determines the constant part.
    """

    remaining_sigmas: float
    last_decrease: float
    condition: float
    held: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("remaining_sigmas", "last_decrease", "condition"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise InvalidValueError(
                    f"a certificate with {name} {value}", expected="a number of at least 0"
                )


@dataclass(frozen=True)
class ScaleShares:
    """Parts of the variance of nm per pixel at each calibrated magnification, of the less certain axis.

    Attributes
    ----------
    magnifications
        Ascending.
    corners
        What the errors of the corners add.
    visits
        What visits, poses, heights, grid and stage add; the rest is the form of the functions.
    """

    magnifications: tuple[float, ...]
    corners: tuple[float, ...]
    visits: tuple[float, ...]

    def __post_init__(self) -> None:
        count = len(self.magnifications)
        as_many = count > 0 and len(self.corners) == len(self.visits) == count
        parts = np.array([*self.corners, *self.visits])
        if not (
            as_many
            and np.all(parts >= 0.0)
            and np.all(np.add(self.corners, self.visits) < 1.0 + 1e-9)
        ):
            raise InvalidValueError(
                f"shares {self.corners} and {self.visits} of a variance",
                expected="one of each for every magnification, at least 0, and at most 1 together",
            )


@dataclass(frozen=True)
class FitRecord:
    """What a fit leaves in its calibration.

    Attributes
    ----------
    height_sigma_m
        1-sigma of the height of a view about the plane of the untilted grid, m.
    visit_height_sigma_m
        1-sigma of the height that all views of a visit share, m; None where the fit has none.
    squares_m
        Sides of the squares of the grid, m; empty where they are not known.
    is_wide
        Whether the views are photographs: at one magnification, by a camera close to the grid.
    is_grating
        Whether the grid consists of parallel lines, which are turned and not tilted.
    scale_shares
        What the variance of nm per pixel consists of, or None where that is not known.
    certificate
        That the fit ended at a minimum; None for calibrations that were not adjusted as a whole.
    """

    height_sigma_m: float
    visit_height_sigma_m: float | None = None
    squares_m: tuple[float, ...] = ()
    is_wide: bool = False
    is_grating: bool = False
    scale_shares: ScaleShares | None = None
    certificate: Certificate | None = None

    def __post_init__(self) -> None:
        lengths = [self.height_sigma_m, *self.squares_m]
        if self.visit_height_sigma_m is not None:
            lengths.append(self.visit_height_sigma_m)
        if not all(np.isfinite(length) and length > 0.0 for length in lengths):
            raise InvalidValueError(
                f"lengths {lengths} m in the record of a fit", expected="finite numbers above 0"
            )


@dataclass(frozen=True)
class Relay:
    """A jump of the scale somewhere between two magnifications of a ladder.

    Attributes
    ----------
    low, high
        The magnifications between which it lies.
    jump
        Relative change of the scale from below to above.
    """

    low: float
    high: float
    jump: float

    def __post_init__(self) -> None:
        if not (0.0 < self.low < self.high < np.inf and np.isfinite(self.jump)):
            raise InvalidValueError(
                f"a relay of {self.jump} between {self.low} and {self.high}",
                expected="a finite jump between two increasing magnifications",
            )

    def sigma(self, magnification: float) -> float:
        """Relative 1-sigma of the scale at a magnification that may lie on either side; 0 outside.

        The relay lies anywhere between both with the same probability per log g, and the calibration has it in the
        middle. So the side is wrong with the probability f up to the middle, and 1 - f above, where f is the part of
        the way from ``low`` to ``high``.
        """
        if not self.low < magnification < self.high:
            return 0.0
        part = float(np.log(magnification / self.low) / np.log(self.high / self.low))
        return abs(self.jump) * float(np.sqrt(min(part, 1.0 - part)))


@dataclass(frozen=True)
class LadderRecord:
    """What a ladder leaves in its calibration.

    Attributes
    ----------
    anchored
        (lowest, highest) magnification that was calibrated without it.
    growth
        Relative 1-sigma of the scale that each factor of e beyond these adds, common to all of the ladder: what no
        adjustment of the pictures can tell.
    relays
        Jumps of the scale that were found.
    """

    anchored: tuple[float, float]
    growth: float
    relays: tuple[Relay, ...] = ()

    def __post_init__(self) -> None:
        low, high = self.anchored
        if not (0.0 < low <= high < np.inf and np.isfinite(self.growth) and self.growth >= 0.0):
            raise InvalidValueError(
                f"a ladder from {self.anchored} that adds {self.growth}",
                expected="an increasing range, and a number of at least 0",
            )

    def beyond(self, magnification: float) -> float:
        """Distance of a magnification from the range that was calibrated without the ladder, in log g; 0 inside."""
        low, high = self.anchored
        return float(max(np.log(magnification / high), np.log(low / magnification), 0.0))

    def growth_sigma(self, magnification: float) -> float:
        """Relative 1-sigma of the scale that the steps of the ladder add at a magnification."""
        return self.growth * self.beyond(magnification)

    def relay_sigma(self, magnification: float) -> float:
        """Relative 1-sigma of the scale that the unknown places of the relays add at a magnification."""
        return float(np.hypot.reduce([0.0, *(relay.sigma(magnification) for relay in self.relays)]))
