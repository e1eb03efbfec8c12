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

"""What a recording contains: all that makes a mistake in it visible at once."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from semcal_ros.bridge.conditions import Conditions
from semcal_ros.core.errors import UnknownScaleError
from semcal_ros.files.bags.reader import BagTopic
from semcal_ros.files.recordings import FrameOutline, RecordedFiles, Recording
from semcal_ros.workflows.find_grid import count_visits
from semcal_ros.workflows.inputs import (
    ConfigSource,
    OnProgress,
    Source,
    count_frames,
    ignore_progress,
    open_source,
    resolve_config,
)
from semcal_ros.workflows.provenance import format_date, list_recording_files, sum_up

# Of longer recordings, this many images are decoded: pairs of neighbours, evenly spaced. The range of
# grey levels hardly changes with more, and 200 images of a megapixel take about a second.
_MOST_DECODED = 200
# Frames come regularly if this part of the intervals lies this close to the median.
_REGULAR_PART = 0.75
_REGULAR_WITHIN = 0.1
# An interval of a regular recording in which a frame is missing is twice the median; halfway.
_GAP = 1.5
# Depths of analogue-to-digital converters that are stored in 16 bits.
_DEPTHS = (8, 10, 12, 14, 16)
# Fewer levels may have empty bits in common by chance: each halves the chance once for each bit.
_FEW_LEVELS = 16


@dataclass(frozen=True)
class MagnificationSummary:
    """The frames of one magnification.

    Attributes
    ----------
    magnification
        The magnification.
    field_width_m, pixel_size_m
        Width of the field, and of a pixel, of the first frame.
    frames, visits
        Number of frames, and how often the magnification was set.
    """

    magnification: float
    field_width_m: float
    pixel_size_m: float
    frames: int
    visits: int


@dataclass(frozen=True)
class Intervals:
    """Times from one frame to the next.

    Attributes
    ----------
    median_s, least_s, greatest_s
        Of all intervals.
    regular
        Whether three quarters of them are within a tenth of the median.
    gaps, missing
        Number of intervals of a regular recording in which frames are missing, and of these frames.
    equal_stamps
        Number of frames whose stamp another frame has, too.
    backwards
        Number of frames that are earlier than the one before.
    """

    median_s: float
    least_s: float
    greatest_s: float
    regular: bool
    gaps: int
    missing: int
    equal_stamps: int
    backwards: int


@dataclass(frozen=True)
class GreyLevels:
    """The grey levels of the decoded frames of one depth.

    Attributes
    ----------
    stored_bits
        Bits of a stored grey level.
    used_bits
        Bits of the smallest usual converter (8, 10, 12, 14 or 16 bit) whose levels these may be; None
        for floating-point images.
    lowest, highest
        Least and greatest level.
    black_fraction, white_fraction
        Parts of the pixels at the two ends of the scale; NaN for floating-point images.
    """

    stored_bits: int
    used_bits: int | None
    lowest: float
    highest: float
    black_fraction: float
    white_fraction: float


@dataclass(frozen=True)
class RecordingSummary:
    """Contents of a recording.

    Attributes
    ----------
    topics
        Topics of a bag; empty for images.
    frame_count, duration_s
        Number of usable frames, and the time from the first stamp to the last, s.
    first_time, last_time
        Dates of these in ISO 8601: UTC, or local time where image files say no zone; None for a clock
        that is not that of a calendar.
    kinds
        Number of frames by size and encoding, such as ``512 x 512 mono8``.
    display_width_m
        Display width that the magnifications refer to.
    scale_source
        Where the pixel sizes come from, in words.
    settings
        The different magnifications, ascending; empty where the scale is not known.
    intervals
        None for a single frame.
    equal_pixels, compared
        Number of frames whose pixels are those of the frame before, and of the frames that were
        compared.
    grey_levels
        Of each depth that the frames have; none where no frame could be decoded.
    decoded
        Number of frames whose grey levels were read.
    conditions
        How the frames were taken, as far as their files say it, under the names of
        :class:`~semcal_ros.bridge.conditions.Conditions`: the different texts, or the least and the
        greatest number. The tilt of a bag is that of its stage.
    file_bytes
        Size of the recording on disk; None for images in memory.
    notes
        Notes for the user.
    """

    topics: tuple[BagTopic, ...]
    frame_count: int
    duration_s: float
    first_time: str | None
    last_time: str | None
    kinds: Mapping[str, int]
    display_width_m: float
    scale_source: str
    settings: tuple[MagnificationSummary, ...]
    intervals: Intervals | None
    equal_pixels: int
    compared: int
    grey_levels: tuple[GreyLevels, ...]
    decoded: int
    conditions: Mapping[str, tuple[Any, ...]]
    file_bytes: int | None
    notes: tuple[str, ...]

    @property
    def magnifications(self) -> tuple[float, ...]:
        """The different magnifications, ascending."""
        return tuple(setting.magnification for setting in self.settings)

    def summary(self) -> dict[str, Any]:
        """All of it as plain values for JSON, in SI units."""
        return asdict(self)


def describe_recording(
    source: Source,
    *,
    config: ConfigSource | None = None,
    on_progress: OnProgress = ignore_progress,
) -> RecordingSummary:
    """Read a recording, and tell what is in it.

    Stamps, sizes and magnifications are those of all frames. Of more than 200 frames, only 200 are decoded for
    their grey levels; the pixels of bags are compared all the same.

    Parameters
    ----------
    source
        A bag, image files of any kind, or (image, magnification[, time_s]) tuples in memory.
    config
        A ``msg_configs`` name or file; the default is ``generic``.
    on_progress
        Called with the stage, the number of frames done, and that of all frames.

    Raises
    ------
    SemcalError
        If configuration or recording cannot be read.

    Examples
    --------
    ::

        from semcal_ros import describe_recording
        found = describe_recording("recordings/grid")
        [(s.magnification, s.pixel_size_m, s.visits) for s in found.settings]
    """
    microscope = resolve_config(config)
    seen = _RecordingTally()
    try:
        recording = open_source(source, microscope)
    except UnknownScaleError as error:
        # All else can be told; the magnification only takes the place of the one that is missing.
        given = source if isinstance(source, RecordedFiles) else RecordedFiles(cast("str", source))
        recording = open_source(replace(given, magnification=1.0), microscope)
        seen.no_scale = f"not known ({error.seen}): {error.do}"
    with recording as opened:
        advance = count_frames(on_progress, "reading", opened.frame_count)
        wanted = _choose(opened.frame_count)
        for index, outline in enumerate(opened.outlines(wanted)):
            seen.add(outline, count_levels=index in wanted)
            advance(1)
        return seen.summarise(opened, list_recording_files(source))


def _choose(count: int) -> Sequence[int] | set[int]:
    """Indices of the images to decode: all, or pairs of neighbours."""
    if count <= _MOST_DECODED:
        return range(count)
    starts = np.linspace(0, count - 2, _MOST_DECODED // 2).round().astype(int)
    return {int(index) for start in starts for index in (start, start + 1)}


@dataclass
class _RecordingTally:
    """What was seen so far."""

    stamps_ns: list[int] = field(default_factory=list)
    magnifications: list[float] = field(default_factory=list)
    kinds: Counter[tuple[tuple[int, int], str]] = field(default_factory=Counter)
    widths_px: dict[float, int] = field(default_factory=dict)
    conditions: dict[str, set[Any]] = field(default_factory=lambda: defaultdict(set))
    levels: dict[int, NDArray[np.int64]] = field(default_factory=dict)
    floats: list[tuple[float, float]] = field(default_factory=list)
    decoded: int = 0
    compared: int = 0
    equal: int = 0
    last: tuple[tuple[int, int], int | None] | None = None
    no_scale: str = ""

    def add(self, outline: FrameOutline, *, count_levels: bool) -> None:
        self.stamps_ns.append(outline.stamp_ns)
        self.magnifications.append(outline.magnification)
        self.kinds[outline.size_px, outline.encoding] += 1
        self.widths_px.setdefault(outline.magnification, outline.size_px[0])
        self._add_conditions(outline)
        if outline.digest is not None and self.last is not None and self.last[1] is not None:
            self.compared += 1
            self.equal += self.last == (outline.size_px, outline.digest)
        self.last = (outline.size_px, outline.digest)
        if outline.image is not None and count_levels:
            self._add_levels(outline.image)

    def _add_conditions(self, outline: FrameOutline) -> None:
        if outline.conditions is not None:
            for item in fields(Conditions):
                value = getattr(outline.conditions, item.name)
                if item.name != "time" and value not in (None, ""):
                    self.conditions[item.name].add(value)
        known = None if outline.conditions is None else outline.conditions.stage_tilt_rad
        if known is None and outline.stage is not None and outline.stage.tilt_rad is not None:
            self.conditions["stage_tilt_rad"].add(outline.stage.tilt_rad)

    def _add_levels(self, image: NDArray[Any]) -> None:
        self.decoded += 1
        if image.dtype.kind == "f":
            finite = image[np.isfinite(image)]
            if finite.size:
                self.floats.append((float(finite.min()), float(finite.max())))
            return
        bits = 8 * image.dtype.itemsize
        counted = np.bincount(image.reshape(-1), minlength=1 << bits)
        self.levels[bits] = self.levels.get(bits, 0) + counted

    def summarise(self, opened: Recording, files: Iterable[Path]) -> RecordingSummary:
        first_ns, last_ns = min(self.stamps_ns), max(self.stamps_ns)
        encodings = {encoding for _, encoding in self.kinds if encoding}
        assumed = encodings.pop() if len(encodings) == 1 else ""
        kinds: Counter[str] = Counter()
        for ((width, height), encoding), count in self.kinds.items():
            kinds[f"{width} x {height} {encoding or assumed}".rstrip()] += count
        sizes = [file.stat().st_size for file in files]
        return RecordingSummary(
            opened.topics,
            len(self.stamps_ns),
            (last_ns - first_ns) * 1e-9,
            format_date(first_ns),
            format_date(last_ns),
            dict(sorted(kinds.items())),
            opened.config.display_width_m,
            self.no_scale or opened.scale_source,
            () if self.no_scale else self._list_settings(opened.config.display_width_m),
            _measure_intervals(self.stamps_ns),
            self.equal,
            self.compared,
            self._grey_levels(),
            self.decoded,
            {name: sum_up(values) for name, values in self.conditions.items()},
            sum(sizes) if sizes else None,
            opened.notes,
        )

    def _list_settings(self, display_width_m: float) -> tuple[MagnificationSummary, ...]:
        frames = Counter(self.magnifications)
        numbers = count_visits(self.magnifications, self.stamps_ns)
        visits: dict[float, set[int]] = defaultdict(set)
        for g, number in zip(self.magnifications, numbers, strict=True):
            visits[g].add(number)
        return tuple(
            MagnificationSummary(
                g,
                display_width_m / g,
                display_width_m / g / self.widths_px[g],
                frames[g],
                len(visits[g]),
            )
            for g in sorted(frames)
        )

    def _grey_levels(self) -> tuple[GreyLevels, ...]:
        found = [_describe_levels(bits, counts) for bits, counts in sorted(self.levels.items())]
        if self.floats:
            low, high = min(low for low, _ in self.floats), max(high for _, high in self.floats)
            found.append(GreyLevels(32, None, low, high, np.nan, np.nan))
        return tuple(found)


def _describe_levels(stored: int, counts: NDArray[np.int64]) -> GreyLevels:
    """Describe how often each level of ``stored`` bits occurs."""
    used = np.flatnonzero(counts)
    lowest, highest = int(used[0]), int(used[-1])
    # A converter of fewer bits than are stored leaves the upper ones empty, or the lower ones.
    depth, shift = next(bits for bits in _DEPTHS if highest < 1 << bits), 0
    empty = _empty_low_bits(used)
    if depth == stored and len(used) > _FEW_LEVELS and stored - empty in _DEPTHS:
        depth, shift = stored - empty, empty
    top = ((1 << depth) - 1) << shift
    total = int(counts.sum())
    return GreyLevels(
        stored, depth, lowest, highest, int(counts[0]) / total, int(counts[top]) / total
    )


def _empty_low_bits(levels: NDArray[np.intp]) -> int:
    """How many of the lowest bits are 0 in all levels; 0 where all levels are black."""
    combined = int(np.bitwise_or.reduce(levels))
    return (combined & -combined).bit_length() - 1 if combined else 0


def _measure_intervals(stamps_ns: Sequence[int]) -> Intervals | None:
    if len(stamps_ns) < 2:
        return None
    steps_s: NDArray[np.float64] = 1e-9 * np.diff(np.array(stamps_ns)).astype(np.float64)
    median = float(np.median(steps_s))
    close = np.abs(steps_s - median) <= _REGULAR_WITHIN * median
    regular = bool(median > 0.0 and close.mean() >= _REGULAR_PART)
    long = steps_s[steps_s > _GAP * median] if regular else steps_s[:0]
    return Intervals(
        median,
        float(steps_s.min()),
        float(steps_s.max()),
        regular,
        len(long),
        int((np.round(long / median) - 1.0).sum()) if regular else 0,
        len(stamps_ns) - len(set(stamps_ns)),
        int((steps_s < 0.0).sum()),
    )
