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

"""Reads the pictures that an interrupted acquisition has recorded, to go on with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from semcal_ros.bridge.conditions import Conditions
from semcal_ros.bridge.images import to_gray
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.calibration.views import FoundView
from semcal_ros.core.corners import LatticeDetection, find_lattice
from semcal_ros.core.errors import InvalidValueError, Rejection
from semcal_ros.files.recordings import RecordedFrame, open_recording
from semcal_ros.workflows.find_grid import count_visits

#: Says whether a picture is one of the views: its magnification, grey levels, corners, and the stage.
Judge = Callable[[float, NDArray[Any], LatticeDetection, StageReading | None], bool]


@dataclass(frozen=True)
class RecordedView:
    """A view without its picture, with the stamp (ns) and what was known of how it was taken."""

    view: FoundView
    stamp_ns: int
    conditions: Conditions


def read_views(
    path: Path,
    config: MicroscopeConfig,
    size: tuple[int, int] | None,
    judge: Judge,
    on_frame: Callable[[RecordedFrame], object],
) -> list[RecordedView]:
    """Read the views of a recording; their visits count from 0.

    Parameters
    ----------
    path
        A recording of :class:`~semcal_ros.files.bags.writer.ViewRecorder`.
    config
        How to read it.
    size
        (width, height) of the pictures that will follow, px; None where it is not known.
    judge
        Asked of each picture in which the grid is found.
    on_frame
        Called with each picture before that.

    Raises
    ------
    BagError
        It cannot be read.
    InvalidValueError
        Its pictures have another size.
    """
    taken: list[tuple[FoundView, RecordedFrame]] = []

    def adopt(frame: RecordedFrame) -> bool:
        grey = to_gray(frame.visible, frame.encoding)
        found = find_lattice(grey)
        g, stage = frame.magnification, frame.stage
        if isinstance(found, Rejection) or not judge(g, grey, found, stage):
            return False
        view = FoundView(view_name(len(taken)), g, None, found, stage)
        taken.append((view, replace(frame, image=frame.image[:0])))
        return True

    visits = read_pictures(path, config, size, adopt, on_frame)
    return [
        RecordedView(replace(view, visit=visit), frame.stamp_ns, frame.conditions or Conditions())
        for (view, frame), visit in zip(taken, visits, strict=True)
    ]


def view_name(index: int) -> str:
    """Return what the view of this index is called, as people count: view 1 is the first."""
    return f"view {index + 1}"


def read_pictures(
    path: Path,
    config: MicroscopeConfig,
    size: tuple[int, int] | None,
    adopt: Callable[[RecordedFrame], bool],
    on_frame: Callable[[RecordedFrame], object],
) -> list[int]:
    """Read the pictures of a recording; return the visits, from 0 on, of those that were taken.

    Parameters
    ----------
    path, config, size, on_frame
        As of :func:`read_views`; its errors.
    adopt
        Asked of each picture whether it is taken.
    """
    magnifications: list[float] = []
    stamps_ns: list[int | None] = []
    taken: list[int] = []
    with open_recording(path, config) as recording:
        for number, frame in enumerate(recording.frames()):
            on_frame(frame)
            height, width = frame.visible.shape[:2]
            if size is not None and (width, height) != size:
                raise InvalidValueError(
                    f"{width} x {height} px pictures in {path}",
                    expected="{} x {} px, as live".format(*size),
                    do="set the scan as it was, or begin anew without resume",
                )
            magnifications.append(frame.magnification)
            stamps_ns.append(frame.stamp_ns)
            if adopt(frame):
                taken.append(number)
    visits = count_visits(magnifications, stamps_ns)
    return [visits[number] for number in taken]
