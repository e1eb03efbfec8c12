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

"""What is checked before anything at a microscope moves."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from semcal_ros.core.errors import MicroscopeError
from semcal_ros.drivers.source import JOINTS

# Rounding of a position that is asked for at a limit itself.
_ROUNDING = 1e-9


def joint_unit(joint: str) -> str:
    """Return ``m`` or ``rad``."""
    return "m" if joint in ("x", "y", "z") else "rad"


def describe_target(target: Mapping[str, float]) -> str:
    """Return joints and positions in words, such as ``tilt 0.1 rad, x 2e-06 m``."""
    return ", ".join(f"{joint} {value:.6g} {joint_unit(joint)}" for joint, value in target.items())


@dataclass(frozen=True)
class MotionLimits:
    """Soft limits of the stage and of the magnification.

    Attributes
    ----------
    soft
        Least and greatest position of each joint of :data:`~semcal_ros.drivers.source.JOINTS`; a joint whose two
        limits are equal is not moved at all.
    steps
        The longest way of each joint in one command.
    magnification
        Least and greatest.
    """

    soft: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    steps: Mapping[str, float] = field(default_factory=dict)
    magnification: tuple[float, float] = (1.0, 1e8)

    def check_target(self, target: Mapping[str, float]) -> None:
        """Refuse positions that are not allowed, wherever the stage is.

        Raises
        ------
        MicroscopeError
            A joint has no name of a joint, no finite position, or one outside of its soft limits.
        """
        if not target:
            raise MicroscopeError("a move of no joint", expected=f"one of {', '.join(JOINTS)}")
        for joint, position in target.items():
            if joint not in JOINTS:
                raise MicroscopeError(
                    f"a move of the joint {joint}", expected=f"one of {', '.join(JOINTS)}"
                )
            if not math.isfinite(position):
                raise MicroscopeError(
                    f"{joint} to {position} {joint_unit(joint)}", expected="a finite position"
                )
            low, high = self.soft.get(joint, (0.0, 0.0))
            if low == high:
                raise MicroscopeError(
                    f"{joint}, which is locked",
                    expected="a joint with limits",
                    do=f"set min_{joint} and max_{joint}",
                )
            _check_range(joint, position, low, high, "soft limits", f"min_{joint} and max_{joint}")

    def check_way(
        self,
        target: Mapping[str, float],
        position: Mapping[str, float],
        of_microscope: Mapping[str, tuple[float, float]],
    ) -> None:
        """Refuse a move that is too long from where the stage is, or that the microscope itself excludes.

        Parameters
        ----------
        target
            Where to.
        position
            Where the stage is now.
        of_microscope
            Limits of the microscope.

        Raises
        ------
        MicroscopeError
            Also where the present position is not known.
        """
        for joint, wanted in target.items():
            if joint in of_microscope:
                _check_range(joint, wanted, *of_microscope[joint], "limits of the microscope", "")
            now = position.get(joint)
            if now is None or not math.isfinite(now):
                raise MicroscopeError(
                    f"{joint}, whose position the microscope does not say",
                    expected="a joint whose position is known",
                )
            way, step = abs(wanted - now), self.steps.get(joint, 0.0)
            if way > step * (1.0 + _ROUNDING):
                unit = joint_unit(joint)
                raise MicroscopeError(
                    f"{joint} by {way:.6g} {unit}, from {now:.6g} to {wanted:.6g}",
                    expected=f"at most {step:g} {unit} in one command",
                    do=f"move in steps, or set step_{joint}",
                )

    def check_magnification(self, magnification: float) -> None:
        """Raise :class:`MicroscopeError` for a magnification outside of the limits."""
        low, high = self.magnification
        if not (math.isfinite(magnification) and low <= magnification <= high):
            raise MicroscopeError(
                f"a magnification of {magnification:g}",
                expected=f"{low:g} to {high:g}",
                do="set min_magnification and max_magnification",
            )


def _check_range(
    joint: str, position: float, low: float, high: float, whose: str, parameters: str
) -> None:
    slack = _ROUNDING * max(abs(low), abs(high))
    if not low - slack <= position <= high + slack:
        unit = joint_unit(joint)
        raise MicroscopeError(
            f"{joint} to {position:.6g} {unit}",
            expected=f"{low:g} to {high:g} {unit}, the {whose}",
            do=f"set {parameters}" if parameters else "",
        )
