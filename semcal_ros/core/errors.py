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

"""The one exception tree of the suite.

Every error that a user can cause says three things on one line: what was seen, what was expected, and what to do.
Programs catch :class:`SemcalError`; the command line prints ``str(error)`` and exits with status 2, or 1 where
the input was read but gave nothing to rely on.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Generic, TypeVar

Status = TypeVar("Status", bound=Enum)


@dataclass(frozen=True)
class Rejection(Generic[Status]):
    """Why data were not used: the answer for data that nothing is wrong with but their contents.

    Misuse raises an error; an image without a grid, or a shift that cannot be believed, is an
    answer like any other.

    Attributes
    ----------
    status
        What kind of reason it is. Programs decide by this.
    reason
        The reason in words, with its numbers, for people.
    """

    status: Status
    reason: str


class SemcalError(Exception):
    """Base of all errors raised on purpose.

    Parameters
    ----------
    seen
        What was found, with its value.
    expected
        What would have been accepted.
    do
        The next step for the user.
    """

    def __init__(self, seen: str, *, expected: str = "", do: str = "") -> None:
        self.seen = seen
        self.expected = expected
        self.do = do
        parts = [seen]
        if expected:
            parts.append(f"expected {expected}")
        if do:
            parts.append(do)
        super().__init__(" ".join("; ".join(parts).split()))


class InvalidValueError(SemcalError, ValueError):
    """An argument is outside of what the function is defined for."""


class CalibrationError(SemcalError):
    """The data do not allow a calibration."""


class UnusableCalibrationError(CalibrationError):
    """The views give a calibration that must not be used: its scale is far off, or it did not converge."""


class CalibrationFileError(SemcalError):
    """A calibration file is corrupt, foreign or from a newer version."""


class ConfigError(SemcalError):
    """A ``msg_configs`` file is wrong."""


class MessageError(SemcalError):
    """A ROS message has contents that cannot be used."""


class BagError(SemcalError):
    """A recording cannot be read or written."""


class UnknownScaleError(BagError):
    """A recording has neither a magnification nor a pixel size, and none was given."""


class MicroscopeError(SemcalError):
    """A microscope, or what its pictures come from, does not answer, is not there, or refuses."""


class UnusableFrameError(MicroscopeError):
    """One picture of a microscope cannot be used; the next one may be."""


class StructureError(SemcalError):
    """The views do not allow a reconstruction."""


class TiffError(SemcalError):
    """An SEM TIFF file cannot be understood."""
