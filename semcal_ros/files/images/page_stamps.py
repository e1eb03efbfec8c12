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

"""When the pages of image files were taken: in order, each at a time of its own.

Makers state the time of a file in whole seconds. Where one interval fits all of those between two pauses, it tells
when each file was taken, better than the seconds do. Where none fits, files of one second are spread over it, in the
order of their names. A drift takes a stamp for what it says: of frames 1.4 s apart that are stamped 1 s and 2 s apart,
the velocity seems to change by a factor of two from one to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import timezone
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.wording import counted
from semcal_ros.files.images.image_file import ImageFile, ImagePage

_SECOND_NS = 1_000_000_000
_SYNTHETIC_START_NS = 946_684_800 * _SECOND_NS  # 2000-01-01 UTC
MIN_SPACING_NS = 1_000_000
"""Least time between two images: 1000 images fit into a second."""
# Images of one interval are three and more: any two are.
_FITTED = 3
# By how much an image may come late, s, if all of one interval are to fit.
_LATE_S = 0.1
# Of how late they are: to a millisecond.
_LATE_STEPS = 101
# Of the median interval: what is longer is a pause, and another interval may hold after it.
_PAUSE = 3.0


@dataclass(frozen=True)
class StampedPage:
    """A page of a file, and its time in ns since 1970."""

    file: ImageFile
    page: ImagePage
    stamp_ns: int


def _local_ns(file: ImageFile) -> int | None:
    if file.time is None:
        return None
    # Microsoft's and others' epochs before 1970 would be negative.
    return max(0, round(file.time.replace(tzinfo=timezone.utc).timestamp() * 1e3) * 1_000_000)


def stamp_pages(
    files: Sequence[ImageFile], frame_interval_s: float | None
) -> tuple[list[StampedPage], list[str]]:
    """Order images by time with strictly increasing stamps; also say where the stamps come from."""
    begins = [_local_ns(file) for file in files]
    if frame_interval_s is not None:
        known = [begin for begin in begins if begin is not None]
        start_ns = min(known) if len(known) == len(files) else _SYNTHETIC_START_NS
        pages = [(file, page) for file in _in_time(files, begins) for page in file.pages]
        step_ns = 1e9 * frame_interval_s
        return [
            StampedPage(file, page, start_ns + round(k * step_ns))
            for k, (file, page) in enumerate(pages)
        ], [f"stamps are {frame_interval_s:g} s apart, as given"]
    several = sum(len(file.pages) for file in files) > 1
    without = any(begin is None for begin in begins)
    unspaced = any(page.offset_s is None for file in files for page in file.pages[1:])
    notes = []
    if without and several and (unspaced or len(files) > 1):
        notes.append(
            f"{'not all files have a time' if any(begins) else 'the files have no times'}: stamps are 1 s apart, "
            "in the order of names; --frame-interval states the true interval"
        )
    elif unspaced:
        notes.append(
            "the images of one file are taken to be 1 s apart; --frame-interval states the true interval"
        )
    elif without:
        notes.append("stamps are the times from the first image of the file" if several else "")
    else:
        notes.append("stamps are the files' local times taken as UTC")
    ordered = list(files) if without else _in_time(files, begins)
    starts: list[int | None] = [None if without else _local_ns(file) for file in ordered]
    told, told_note = _tell_apart([begin for begin in starts if begin is not None])
    if not without and all(len(file.pages) == 1 for file in files) and told_note:
        starts = [*told]
        notes.append(told_note)
    images: list[StampedPage] = []
    latest_ns = None
    for file, begin_ns in zip(ordered, starts, strict=True):
        if begin_ns is None:
            begin_ns = _SYNTHETIC_START_NS if latest_ns is None else latest_ns + _SECOND_NS
        for number, page in enumerate(file.pages):
            offset_s = float(number) if page.offset_s is None else page.offset_s
            stamp_ns = begin_ns + round(1e9 * offset_s)
            if latest_ns is not None:
                # Images of the same time stay in the order of their names.
                stamp_ns = max(stamp_ns, latest_ns + MIN_SPACING_NS)
            images.append(StampedPage(file, page, stamp_ns))
            latest_ns = stamp_ns
    return images, [note for note in notes if note]


def _in_time(files: Sequence[ImageFile], begins: Sequence[int | None]) -> list[ImageFile]:
    if any(begin is None for begin in begins):
        return list(files)
    order = sorted(range(len(files)), key=lambda k: begins[k] or 0)
    return [files[k] for k in order]


def _tell_apart(begins: Sequence[int]) -> tuple[list[int], str]:
    """Times of files that began in whole seconds, in order, and a note; the same times and none where nothing more is
    known.
    """
    if len(begins) < 2 or any(begin % _SECOND_NS for begin in begins):
        return list(begins), ""
    seconds = (np.array(begins, dtype=np.int64) - begins[0]) / _SECOND_NS
    steps = np.diff(seconds)
    if steps[0] > 0.0 and np.all(steps == steps[0]):
        return list(begins), ""
    pauses = np.flatnonzero(steps > _PAUSE * max(float(np.median(steps)), 1.0)) + 1
    times: list[float] = []
    fits: list[_Interval] = []
    spread = 0
    for part in np.split(seconds, pauses):
        fit = _fit_interval(part - part[0]) if len(part) >= _FITTED else None
        if fit is not None:
            fits.append(fit)
            times += (part[0] + fit.first_s + fit.interval_s * np.arange(len(part))).tolist()
            continue
        for second, group in groupby(part.tolist()):
            count = len(list(group))
            spread += count - 1
            times += [second + k / count for k in range(count)]
    notes = []
    if fits:
        least, most = min(fit.least_s for fit in fits), max(fit.most_s for fit in fits)
        notes.append(
            f"stamps are {fits[0].interval_s:.3g} s apart, which fits the files' whole seconds as {least:.3g} to "
            f"{most:.3g} s do"
        )
    if spread:
        notes.append(
            f"{counted(spread, 'image has', 'images have')} the second of the image before, and the images of a "
            "second are spread over it"
        )
    note = "; ".join(notes) + "; --frame-interval states the true interval" if notes else ""
    return [begins[0] + round(1e9 * time) for time in times], note


@dataclass(frozen=True)
class _Interval:
    """The interval in the middle of those that fit, and the time of the first image then; the least and the most."""

    first_s: float
    interval_s: float
    least_s: float
    most_s: float


def _fit_interval(seconds: NDArray[np.float64]) -> _Interval | None:
    """Fit images at one interval to the whole seconds in which they were taken; None where no interval fits.

    An image k of an interval d lies in its second if ``s_k <= t + k d < s_k + 1``. Some start t does for all of them if
    each two allow it: ``|s_j - s_i - (j - i) d| < 1``. Where images come late, the second is as much longer as it must.
    """
    apart = np.arange(1, len(seconds))
    steps = (seconds[k:] - seconds[:-k] for k in apart.tolist())
    longest, shortest = np.array([(step.max(), step.min()) for step in steps]).T
    for second in np.linspace(1.0, 1.0 + _LATE_S, _LATE_STEPS).tolist():
        least = max(0.0, float(np.max((longest - second) / apart)))
        most = float(np.min((shortest + second) / apart))
        if least < most:
            middle = 0.5 * (least + most)
            offsets = seconds - np.arange(len(seconds)) * middle
            return _Interval(0.5 * float(offsets.max() + offsets.min() + 1.0), middle, least, most)
    return None
