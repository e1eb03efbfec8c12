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

"""What the page asks of a stream or a recording."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

from numpy.typing import NDArray

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.viewer.pictures import Outlines

ACTIONS = (
    *("start", "stop", "reset"),
    *("add_view", "calibrate", "acquire", "cancel", "check", "save", "clear"),
    *("play", "pause", "seek"),
)
"""What the page can ask for. ``seek`` has the number of the frame as its value; ``acquire`` the least and greatest
magnification and the relative 1-sigma of nm per pixel to reach, or no value for those that the node has."""


@dataclass(frozen=True)
class View:
    """One frame as it is shown.

    Attributes
    ----------
    number
        Larger for each that is new.
    stamp_ns
        Its stamp, ns since 1970.
    pictures
        ``raw`` and ``corrected``, as far as there are; (h, w), or (h, w, 3) in the channel order of OpenCV.
    camera
        Its camera in the size of the pictures; None where the magnification is not known.
    calibrated
        Whether the camera is of a calibration, and the corrected picture is corrected with it.
    drift_px
        By how much the specimen has moved in the picture since the drift was zero, (x, y) px; None where not known.
    name
        Of the file or frame, for a recording.
    notes
        What a snapshot's file says beside scale and time.
    moving
        Outlines, px of the corrected picture, of what does not move with the specimen.
    """

    number: int
    stamp_ns: int
    pictures: dict[str, NDArray[Any]]
    camera: ScanCamera | None
    calibrated: bool
    drift_px: tuple[float, float] | None = None
    name: str = ""
    notes: dict[str, object] = field(default_factory=dict)
    moving: Outlines = ()


@dataclass(frozen=True)
class Magnification:
    """The magnification in words, and whether the calibration covers it: ``ok``, ``outside`` or ``unknown``."""

    text: str
    state: str
    explanation: str


@dataclass(frozen=True)
class Rate:
    """Frames per second of one node, and their latency: mean and longest, ms, None where not known."""

    name: str
    rate_hz: float
    latency_ms: float | None = None
    longest_ms: float | None = None


@dataclass(frozen=True)
class Note:
    """One state in plain words: ``ok``, ``warn`` or ``error``; who says it; what to do, which may be empty."""

    level: str
    who: str
    text: str
    do: str = ""


@dataclass(frozen=True)
class DriftPanel:
    """The drift: a sentence, its way as (x, y) in nm, oldest first, where on it the frame that is shown stands, and the
    1-sigma of the newest (0: not known), below which the way is noise.
    """

    text: str
    trace_nm: tuple[tuple[float, float], ...] = ()
    at_nm: tuple[float, float] | None = None
    sigma_nm: float = 0.0


@dataclass(frozen=True)
class Bar:
    """How far something has come: 0 to 1, with its name and its words."""

    name: str
    fraction: float
    text: str


@dataclass(frozen=True)
class AcquisitionPanel:
    """A calibration that records itself, or tells a person what to set.

    Attributes
    ----------
    state
        ``ready``, ``running``, ``waiting`` for a person, ``stopped``, ``failed`` or ``done``.
    who
        What moves the microscope, in words.
    request
        What happens, or is to be done, or why it has ended; may be empty.
    bars
        Views taken, and how far nm per pixel is known.
    magnifications
        Least and greatest; None where they are not known yet.
    target
        Relative 1-sigma of nm per pixel to reach.
    """

    state: str
    who: str
    request: str = ""
    bars: tuple[Bar, ...] = ()
    magnifications: tuple[float, float] | None = None
    target: float | None = None


@dataclass(frozen=True)
class CalibrationPanel:
    """The state of a calibration in the making."""

    answer: str
    level: str
    bars: tuple[Bar, ...] = ()
    running: Bar | None = None
    overlay: int = 0  # number of the picture with the corners that was found last; 0: none yet
    overlay_text: str = ""
    acquisition: AcquisitionPanel | None = None


@dataclass(frozen=True)
class Timeline:
    """Where a recording stands: number of frames, index of this one, seconds since the first, and of all."""

    count: int
    index: int
    time_s: float
    duration_s: float
    playing: bool


@dataclass(frozen=True)
class Status:
    """Everything that the page shows beside the pictures."""

    title: str
    kind: str
    magnification: Magnification
    rates: tuple[Rate, ...]
    notes: tuple[Note, ...]
    drift: DriftPanel
    actions: tuple[str, ...]
    calibration: CalibrationPanel | None = None
    timeline: Timeline | None = None


class ViewSource(Protocol):
    """A stream or a recording. Its methods are called from the thread of the server."""

    def watch(self, pages: int) -> None:
        """Take note of how many pages are open now; without any, nothing has to be kept up to date."""
        ...

    def newest(self) -> View | None:
        """Return what is to be shown now."""
        ...

    def overlay(self) -> NDArray[Any] | None:
        """Return the picture with the corners that were found last, (h, w, 3) in OpenCV's order."""
        ...

    def describe(self) -> Status:
        """Return the state of everything else."""
        ...

    def act(self, action: str, value: float | tuple[float, ...] | None) -> str:
        """Do one of :data:`ACTIONS` and return what has come of it in a sentence; may take its time.

        Called from a thread of its own. Raises a :class:`~semcal_ros.core.errors.SemcalError` that says why it could
        not be done.
        """
        ...
