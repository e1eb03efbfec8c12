"""Finds the grid in the images of a recording and the size of its squares."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from typing import Any

import cv2
from joblib import Parallel, cpu_count, delayed
from numpy.typing import NDArray

from semcal_ros.bridge.images import to_gray
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
    "Progress",
    "collect_views",
    "find_views",
    "named_frames",
]

#: Called with the number of frames that were done since the last call.
Progress = Callable[[int], object]

# Fewer images are processed before other processes have started.
_TOO_FEW_TO_SHARE = 12


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


def _detect(name: str, image: NDArray[Any], magnification: float) -> FoundView | RejectedView:
    # The images are the parallel work; threads inside OpenCV would only compete.
    cv2.setNumThreads(1)
    detection = find_lattice(image)
    if isinstance(detection, Rejection):
        return RejectedView(name, magnification, detection, image)
    return FoundView(name, magnification, image, detection)


def named_frames(recording: Recording) -> Iterator[tuple[str, NDArray[Any], float]]:
    """(name, grey image, magnification) of each usable frame of an open recording."""
    for index, frame in enumerate(recording.frames()):
        yield f"frame {index}", to_gray(frame.image, frame.encoding), frame.magnification


def find_views(
    frames: Iterable[tuple[str, NDArray[Any], float]],
    *,
    on_progress: Progress | None = None,
    processes: int | None = None,
) -> tuple[list[FoundView], list[RejectedView]]:
    """Find the grid in (name, grey image, magnification) frames, on all cores.

    Parameters
    ----------
    frames
        Taken a few at a time. Their images stay in the results, which a report shows.
    on_progress
        Called with 1 after each frame.
    processes
        Number of processes; one per core without. 1 works in this process.
    """
    found: list[FoundView] = []
    rejected: list[RejectedView] = []
    iterator = iter(frames)
    first = list(islice(iterator, _TOO_FEW_TO_SHARE))
    if len(first) < _TOO_FEW_TO_SHARE:
        processes = 1
    work = Parallel(n_jobs=processes or cpu_count(), return_as="generator")
    threads = cv2.getNumThreads()
    try:
        for view in work(delayed(_detect)(*frame) for frame in chain(first, iterator)):
            if isinstance(view, FoundView):
                found.append(view)
            else:
                rejected.append(view)
            if on_progress is not None:
                on_progress(1)
    finally:
        cv2.setNumThreads(threads)
    return found, rejected


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
    )


def _format_micrometres(sides_m: Iterable[float]) -> str:
    return ", ".join(f"{float(f'{1e6 * side:.3g}'):.6g}" for side in sides_m)


def _explain_misfit(apparent_m: float, squares_m: Sequence[float]) -> Rejection[ViewStatus]:
    return Rejection(
        ViewStatus.UNKNOWN_SQUARES,
        f"according to the other views its squares are {_format_micrometres([apparent_m])} um, but squares_m"
        f" has {_format_micrometres(squares_m)} um: wrong magnification, or a size missing in squares_m",
    )
