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

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice, starmap
from typing import Any, NamedTuple

import cv2
import numpy as np
from joblib import cpu_count
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
from semcal_ros.core.corners import (
    PATTERN_NAMES,
    PATTERNS,
    LatticeDetection,
    LatticeStatus,
    check_pattern,
    find_lattice,
)
from semcal_ros.core.errors import CalibrationError, Rejection
from semcal_ros.core.wording import counted, omit_numbers
from semcal_ros.files.recordings import RecordedFrame, Recording
from semcal_ros.workflows.options import Option
from semcal_ros.workflows.workers import Workers

PATTERN = Option(
    "What the grid consists of: chess squares, dots or holes, crosses, crossed lines, or a grating of parallel lines, "
    "which is turned and not tilted.",
    choices=PATTERNS,
    python="Of all but chess boards, ``squares_m`` is the distance from one to the next.",
)
# Of a grid that a calibration is compared with.
PATTERN_AGAIN = replace(
    PATTERN, python='``"auto"`` is a grating where the calibration was made with one.'
)
UNTILTED = Option(
    "Frames without tilt, by number or by file name, if no stage says the tilts.",
    kind="untilted",
    python='Or ``"none"``; ``"all"``; or ``"auto"``, which finds them where they can be told.',
)

#: Called with the number of frames that were done since the last call.
Progress = Callable[[int], object]

# A pause in which a magnification can have been left and set again: over the usual one within a visit,
# and over that at a change. Half an operator's pause is still the same work; three times is another.
_MUCH_LONGER, _AS_LONG = 3.0, 0.5
# Fewer images are processed before other processes have started.
_TOO_FEW_TO_SHARE = 12
# Reasons that a message about refused views gives.
_MOST_REASONS = 4
# Views that are named for each kind of reason; the report shows all.
_MOST_NAMED = 5
# Patterns that have their points in the middle of their cells.
_CELLS = {"dots", "crosses", "lines"}
# Frames that this process takes itself where a grid can end the search, before it starts others that would not end
# with it.
_FIRST_HERE = 4
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


def detect_grid(
    image: NDArray[Any], pattern: str = "auto"
) -> LatticeDetection | Rejection[LatticeStatus]:
    """Find the grid in an image; OpenCV works in one thread from now on."""
    # The images are the parallel work; threads inside OpenCV would only compete.
    cv2.setNumThreads(1)
    return find_lattice(image, pattern=pattern)


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


def named_frames(
    recording: Recording,
    on_frame: Callable[[str, RecordedFrame], object] = lambda _name, _frame: None,
) -> Iterator[NamedFrame]:
    """Each usable frame of an open recording, with the name ``frame N``; ``on_frame`` is told of each."""
    for index, frame in enumerate(recording.frames()):
        grey = to_gray(frame.visible, frame.encoding)
        on_frame(f"frame {index}", frame)
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
    workers: Workers | None = None,
    keep_images: bool = True,
    pattern: str = "auto",
    on_found: Callable[[FoundView], object] | None = None,
) -> tuple[list[FoundView], list[RejectedView]]:
    """Find the grid in frames, on all cores.

    Parameters
    ----------
    frames
        In the order of the recording, with or without a grid: they determine the visits. They are
        taken a few at a time.
    on_progress
        Called with 1 after each frame.
    processes
        Number of processes; one per core without. 1 works in this process.
    workers
        Where to work, instead.
    keep_images
        Whether the images stay in the results, for a report.
    pattern
        What the grid consists of, as in :func:`~semcal_ros.core.corners.find_lattice`.
    on_found
        Called with each grid as it is found, before its stage and visit are known. What it raises ends the search.
    """
    check_pattern(pattern)
    views: list[FoundView | RejectedView] = []
    origins: list[NamedFrame] = []
    under_way: deque[NDArray[Any]] = deque()

    def pictures() -> Iterator[tuple[NDArray[Any], str]]:
        for frame in frames:
            origin = frame if isinstance(frame, NamedFrame) else NamedFrame(*frame)
            origins.append(origin._replace(image=_NO_IMAGE))
            under_way.append(origin.image)
            yield origin.image, pattern

    iterator = pictures()
    if workers is None:
        first = list(islice(iterator, _TOO_FEW_TO_SHARE))
        few = len(first) < _TOO_FEW_TO_SHARE
        workers = Workers(1 if few else processes or cpu_count())
        iterator = chain(first, iterator)

    def detect(shared: Workers = workers) -> Iterator[LatticeDetection | Rejection[LatticeStatus]]:
        if on_found is not None:
            yield from starmap(detect_grid, islice(iterator, _FIRST_HERE))
        yield from shared.starmap(detect_grid, iterator)

    threads = cv2.getNumThreads()
    try:
        for detection in detect():
            origin, image = origins[len(views)], under_way.popleft()
            kept = image if keep_images else None
            if isinstance(detection, Rejection):
                views.append(RejectedView(origin.name, origin.magnification, detection, kept))
            else:
                view = FoundView(origin.name, origin.magnification, kept, detection)
                views.append(view)
                if on_found is not None:
                    on_found(view)
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


def group_reasons(rejected: Sequence[RejectedView]) -> str:
    """Say why views were refused, the most frequent reasons first, with the number of views and one of their names."""
    counts = Counter(view.reason for view in rejected)
    example = {view.reason: view.name for view in reversed(rejected)}
    texts = [
        f"{number} x {reason}" if number > 1 else f"{example[reason]}: {reason}"
        for reason, number in counts.most_common(_MOST_REASONS)
    ]
    left = len(counts) - len(texts)
    return "; ".join(texts) + (f"; and {counted(left, 'other reason')}" if left > 0 else "")


def name_rejected(rejected: Sequence[RejectedView]) -> list[str]:
    """Say each kind of reason once, with the names and magnifications of the views that have it."""
    kinds: dict[str, list[RejectedView]] = {}
    for view in rejected:
        kinds.setdefault(omit_numbers(view.reason), []).append(view)
    texts = []
    for views in kinds.values():
        names = [f"{view.name} at {view.magnification:g}" for view in views[:_MOST_NAMED]]
        if len(views) > _MOST_NAMED:
            names.append(f"{len(views) - _MOST_NAMED} more")
        texts.append(f"{', '.join(names)}: {views[0].reason}")
    return texts


def _without_copies(found: Sequence[FoundView]) -> tuple[list[FoundView], list[RejectedView]]:
    """Return the views of different images, and those of images that came again.

    Noise never comes twice: what has all points at the same place to the last bit is the same image, and no new view.
    """
    firsts: dict[tuple[float, bytes], FoundView] = {}
    kept, copies = [], []
    for view in found:
        first = firsts.setdefault((view.magnification, view.detection.xy.tobytes()), view)
        if first is view:
            kept.append(view)
            continue
        reason = f"the same image as {first.file_name or first.name}, and no new view"
        copies.append(
            RejectedView(
                view.name, view.magnification, Rejection(ViewStatus.COPY, reason), view.image
            )
        )
    return kept, copies


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
        other_pattern = any(r.rejection.status is LatticeStatus.OTHER_PATTERN for r in rejected)
        raise CalibrationError(
            f"no usable view among {counted(len(rejected), 'image')}"
            + (f" ({group_reasons(rejected)})" if rejected else ""),
            expected="images of a grid: a chess board, dots, crosses, crossed or parallel lines",
            do="set --pattern to what is seen, or choose the right images"
            if other_pattern
            else "check focus, contrast, and that the grid fills the image",
        )
    # A recording shows one grid. A view in which another pattern was seen was misread; but whether cells are called
    # dots, crosses or crossed lines does not move their points, which are the same place in all cells.
    pattern = Counter(v.detection.pattern for v in found).most_common(1)[0][0]
    alike = _CELLS if pattern in _CELLS else {pattern}
    misread = [
        RejectedView(
            v.name,
            v.magnification,
            Rejection(
                LatticeStatus.OTHER_PATTERN,
                f"{PATTERN_NAMES[v.detection.pattern]}, not {PATTERN_NAMES[pattern]} as in most images",
            ),
            v.image,
        )
        for v in found
        if v.detection.pattern not in alike
    ]
    found = [v for v in found if v.detection.pattern in alike]
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
    same, copies = _without_copies(same)
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
            f"{len(odd)} of {counted(len(same), 'view')} whose squares have none of the known sizes "
            f"({odd[0].name} at {odd[0].magnification:g}: {odd[0].reason})",
            expected="views of a grid whose squares have the sides squares_m",
            do="correct --squares (squares_m of the configuration), or the recorded magnifications",
        )
    if odd:
        same = [v for v, misfit in zip(same, misfits, strict=True) if not misfit]
    views, assignment = _assign_squares(same, display_width_m, squares_m)
    return CollectedViews(
        views, tuple(same), (*rejected, *misread, *other, *copies, *odd), assignment, image_size
    )


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
        f" has {_format_micrometres(squares_m)} um: wrong magnification, or a size missing in --squares",
    )
