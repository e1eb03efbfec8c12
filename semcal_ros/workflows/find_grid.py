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

"""Finds the grid in the images of a recording and the size of its squares."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice
from typing import Any, NamedTuple

import cv2
import numpy as np
from joblib import Parallel, cpu_count, delayed
from numpy.typing import NDArray

from semcal_ros.bridge.images import to_gray
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.calibration.views import (
    FoundView,
    GridView,
    RejectedView,
    SquareAssignment,
    ViewStatus,
    views_from_detections,
)
from semcal_ros.core.corners import find_lattice
from semcal_ros.core.errors import CalibrationError, Rejection
from semcal_ros.files.recordings import Recording

__all__ = [
    "CollectedViews",
    "NamedFrame",
    "Progress",
    "collect_views",
    "count_visits",
    "find_views",
    "named_frames",
]

#: Called with the number of frames that were done since the last call.
Progress = Callable[[int], object]

# A pause in which a magnification can have been left and set again: over the usual one within a visit,
# and over that at a change. Half an operator's pause is still the same work; three times is another.
_MUCH_LONGER, _AS_LONG = 3.0, 0.5
# Fewer images are processed before other processes have started.
_TOO_FEW_TO_SHARE = 12
# In place of an image that is on its way.
_NO_IMAGE = np.zeros((0, 0), dtype=np.uint8)


@dataclass(frozen=True)
class CollectedViews:
    """Accepted views in metres, with their sources.

    ``found[i]`` belongs to ``views[i]``.
    """

    views: tuple[GridView, ...]
    found: tuple[FoundView, ...]
    rejected: tuple[RejectedView, ...]
    assignment: SquareAssignment
    image_size: tuple[int, int]


class NamedFrame(NamedTuple):
    """A frame in which a grid is to be found.

    Attributes
    ----------
    name, image, magnification
        Its name, grey image and magnification.
    stage
        What the stage said about it, or None.
    stamp_ns
        When it was taken, or None.
    file_name
        The file that it comes from, or empty.
    """

    name: str
    image: NDArray[Any]
    magnification: float
    stage: StageReading | None = None
    stamp_ns: int | None = None
    file_name: str = ""


def _detect(name: str, image: NDArray[Any], magnification: float) -> FoundView | RejectedView:
    # The images are the parallel work; threads inside OpenCV would only compete.
    cv2.setNumThreads(1)
    detection = find_lattice(image)
    if isinstance(detection, Rejection):
        return RejectedView(name, magnification, detection, image)
    return FoundView(name, magnification, image, detection)


def count_visits(magnifications: Sequence[float], stamps_ns: Sequence[int | None]) -> list[int]:
    """Number the visits of magnifications: stretches of a recording in which nothing was changed.

    A visit ends where the magnification changes. A magnification may also be left and set again
    between two images. That takes as long as the changes of the magnification that the recording shows,
    so a visit also ends at a pause that is as long as these and much longer than the usual ones.
    Without stamps there are no pauses.
    """
    count = len(magnifications)
    changed = np.array([magnifications[i] != magnifications[i + 1] for i in range(count - 1)], bool)
    times = np.array([stamp for stamp in stamps_ns if stamp is not None], dtype=np.float64)
    if len(times) == count and np.any(changed) and not np.all(changed):
        pauses = np.diff(times)
        usual, at_change = np.median(pauses[~changed]), np.median(pauses[changed])
        changed |= (pauses >= _MUCH_LONGER * usual) & (pauses >= _AS_LONG * at_change)
    return [0, *(int(number) for number in np.cumsum(changed))][:count]


def named_frames(recording: Recording) -> Iterator[NamedFrame]:
    """Each usable frame of an open recording, with the name ``frame N``."""
    for index, frame in enumerate(recording.frames()):
        grey = to_gray(frame.image, frame.encoding)
        yield NamedFrame(
            f"frame {index}",
            grey,
            frame.magnification,
            frame.stage,
            frame.stamp_ns,
            frame.file_name,
        )


def find_views(
    frames: Iterable[NamedFrame | tuple[str, NDArray[Any], float]],
    *,
    on_progress: Progress | None = None,
    processes: int | None = None,
) -> tuple[list[FoundView], list[RejectedView]]:
    """Find the grid in frames, on all cores.

    Parameters
    ----------
    frames
        In the order of the recording, with or without a grid: they determine the visits. They are
        taken a few at a time. Their images stay in the results, which a report shows.
    on_progress
        Called with 1 after each frame.
    processes
        Number of processes; one per core without. 1 works in this process.
    """
    views: list[FoundView | RejectedView] = []
    origins: list[NamedFrame] = []

    def pictures() -> Iterator[tuple[str, NDArray[Any], float]]:
        for frame in frames:
            origin = frame if isinstance(frame, NamedFrame) else NamedFrame(*frame)
            origins.append(origin._replace(image=_NO_IMAGE))
            yield origin.name, origin.image, origin.magnification

    iterator = pictures()
    first = list(islice(iterator, _TOO_FEW_TO_SHARE))
    if len(first) < _TOO_FEW_TO_SHARE:
        processes = 1
    work = Parallel(n_jobs=processes or cpu_count(), return_as="generator")
    threads = cv2.getNumThreads()
    try:
        for view in work(delayed(_detect)(*picture) for picture in chain(first, iterator)):
            views.append(view)
            if on_progress is not None:
                on_progress(1)
    finally:
        cv2.setNumThreads(threads)
    visits = count_visits([o.magnification for o in origins], [o.stamp_ns for o in origins])
    found = [
        replace(view, stage=origin.stage, visit=visit, file_name=origin.file_name)
        for view, origin, visit in zip(views, origins, visits, strict=True)
        if isinstance(view, FoundView)
    ]
    return found, [view for view in views if isinstance(view, RejectedView)]


def collect_views(
    found: Sequence[FoundView],
    rejected: Sequence[RejectedView],
    *,
    display_width_m: float,
    squares_m: Sequence[float],
) -> CollectedViews:
    """Collect the views of one image size, with their square sizes assigned.

    Raises
    ------
    CalibrationError
        If no view is left; the message gives the most frequent reason.
    """
    if not found:
        reasons = Counter(r.reason for r in rejected).most_common(1)
        raise CalibrationError(
            f"no usable view among {len(rejected)} images"
            + (f" (mostly: {reasons[0][0]})" if reasons else ""),
            expected="images of a chess grid",
            do="check focus, contrast, and that the grid fills the image",
        )
    sizes = Counter(v.detection.image_size for v in found)
    image_size = sizes.most_common(1)[0][0]
    same = [v for v in found if v.detection.image_size == image_size]
    other = [
        RejectedView(
            v.name,
            v.magnification,
            Rejection(
                ViewStatus.OTHER_IMAGE_SIZE,
                f"image size {v.detection.image_size} is not the {image_size} of most images",
            ),
        )
        for v in found
        if v.detection.image_size != image_size
    ]
    views, assignment = _assign_squares(same, display_width_m, squares_m)
    # At a single magnification only heights differ, and those of a photographed board may differ by much.
    judged = len({v.magnification for v in same}) > 1
    misfits = assignment.misfits & judged
    odd = [
        RejectedView(v.name, v.magnification, _explain_misfit(apparent, squares_m), v.image)
        for v, apparent, misfit in zip(same, assignment.apparent_m, misfits, strict=True)
        if misfit
    ]
    if 2 * len(odd) > len(same):
        raise CalibrationError(
            f"{len(odd)} of {len(same)} views whose squares have none of the known sizes "
            f"({odd[0].name} at {odd[0].magnification:g}: {odd[0].reason})",
            expected="views of a grid whose squares have the sides squares_m",
            do="correct squares_m in msg_configs, or the recorded magnifications",
        )
    if odd:
        same = [v for v, misfit in zip(same, misfits, strict=True) if not misfit]
        views, assignment = _assign_squares(same, display_width_m, squares_m)
    return CollectedViews(views, tuple(same), (*rejected, *other, *odd), assignment, image_size)


def _assign_squares(
    found: Sequence[FoundView], display_width_m: float, squares_m: Sequence[float]
) -> tuple[tuple[GridView, ...], SquareAssignment]:
    return views_from_detections(
        [v.detection for v in found],
        [v.magnification for v in found],
        display_width_m=display_width_m,
        squares_m=squares_m,
        names=[v.name for v in found],
        stages=[v.stage for v in found],
        visits=[v.visit for v in found],
    )


def _format_micrometres(sides_m: Iterable[float]) -> str:
    return ", ".join(f"{float(f'{1e6 * side:.3g}'):.6g}" for side in sides_m)


def _explain_misfit(apparent_m: float, squares_m: Sequence[float]) -> Rejection[ViewStatus]:
    return Rejection(
        ViewStatus.UNKNOWN_SQUARES,
        f"according to the other views its squares are {_format_micrometres([apparent_m])} um, but squares_m"
        f" has {_format_micrometres(squares_m)} um: wrong magnification, or a size missing in squares_m",
    )
