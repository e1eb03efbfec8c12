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

"""The interface between a microscope and the node that publishes its frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

from numpy.typing import NDArray

JOINTS = ("tilt", "rotation", "x", "y", "z", "scan_rotation")
"""Joints of a stage, with the scan rotation; angles in rad, lengths in m."""


@dataclass(frozen=True, eq=False)
class SourceFrame:
    """One picture, and what its source says about it.

    Attributes
    ----------
    image
        (h, w) uint8 or uint16, grey.
    start_ns
        When its acquisition began, ns since 1970; the time of arrival where the source does not know it.
    acquisition_s
        How long the acquisition took, or None.
    field_width_m
        Width of the field of view that the image shows, or None.
    conditions
        How it was taken, in SI units, with the keys of the topic ``conditions``.
    stage
        Where the stage was, by the names of :data:`JOINTS`; those that the source does not know are missing.
    name
        What to call it in messages, such as the name of its file.
    token
        For the source's own use, such as in :meth:`ConfirmsFrames.confirm`.
    """

    image: NDArray[Any]
    start_ns: int
    acquisition_s: float | None = None
    field_width_m: float | None = None
    conditions: Mapping[str, float | str] = field(default_factory=dict)
    stage: Mapping[str, float] = field(default_factory=dict)
    name: str = ""
    token: object = None


class FrameSource(Protocol):
    """What every source has. One thread calls all of these methods, which may block and may raise.

    Attributes
    ----------
    streams
        Whether silence is a fault: true for a microscope that scans all the time, false for a folder.
    lossless
        Whether each frame counts: they wait for subscribers, and none is skipped for a newer one.
    """

    streams: bool
    lossless: bool

    def open(self) -> str:
        """Connect, and say in a few words with what. Called again after a failure or a pause.

        Raises
        ------
        MicroscopeError
            It is not there. It is tried again later.
        """

    def read(self, timeout_s: float) -> SourceFrame | None:
        """Return the next frame, or None if none has come within ``timeout_s``.

        Raises
        ------
        UnusableFrameError
            This one cannot be used.
        MicroscopeError
            The source has gone away; it is closed, and opened again later.
        """

    def close(self) -> None:
        """Disconnect. Must not fail, and may be called twice."""


@runtime_checkable
class ConfirmsFrames(Protocol):
    """A source that wants to know which of its frames have been published."""

    def confirm(self, frame: SourceFrame) -> None:
        """Take notice that a frame has been published; called from another thread than the rest."""


@runtime_checkable
class SetsFieldWidth(Protocol):
    """A source whose magnification can be set. Called from another thread than the frames."""

    def set_field_width(self, width_m: float) -> None:
        """Set the width of the field of view, and return once it is set.

        Raises
        ------
        MicroscopeError
            The microscope refuses it.
        """


@runtime_checkable
class MovesStage(Protocol):
    """A source whose stage can be moved. Called from another thread than the frames."""

    def stage_position(self) -> Mapping[str, float]:
        """Return where the stage is, by the names of :data:`JOINTS`.

        Raises
        ------
        MicroscopeError
            The microscope does not answer.
        """

    def stage_limits(self) -> Mapping[str, tuple[float, float]]:
        """Return what the microscope itself allows, as far as it says so.

        Raises
        ------
        MicroscopeError
            The microscope does not answer.
        """

    def move_stage(self, target: Mapping[str, float]) -> None:
        """Move the named joints to positions, and return once they are there.

        Raises
        ------
        MicroscopeError
            The microscope refuses, or the stage has not arrived.
        """
