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

"""What a recording contains."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from semcal_ros.files.bags.reader import BagTopic
from semcal_ros.workflows.inputs import (
    ConfigSource,
    OnProgress,
    Source,
    count_frames,
    ignore_progress,
    open_source,
    resolve_config,
)

__all__ = ["RecordingSummary", "describe_recording"]


@dataclass(frozen=True)
class RecordingSummary:
    """Contents of a recording.

    Attributes
    ----------
    topics
        Topics of a bag; empty for images.
    frame_count, duration_s
        Number of usable frames, and the time from the first stamp to the last, s.
    kinds
        Number of frames by size and encoding, such as ``512 x 512 mono8``.
    magnifications
        The different magnifications, ascending.
    notes
        Notes for the user.
    """

    topics: tuple[BagTopic, ...]
    frame_count: int
    duration_s: float
    kinds: Mapping[str, int]
    magnifications: tuple[float, ...]
    notes: tuple[str, ...]


def describe_recording(
    source: Source,
    *,
    config: ConfigSource | None = None,
    on_progress: OnProgress = ignore_progress,
) -> RecordingSummary:
    """Read all frames of a recording, and count what is in it.

    Parameters
    ----------
    source
        A bag, a folder of SEM TIFF files, or (image, magnification[, time_s]) tuples in memory.
    config
        A ``msg_configs`` name or file; the default is ``generic``.
    on_progress
        Called with the stage, the number of frames done, and that of all frames.

    Raises
    ------
    SemcalError
        If configuration or recording cannot be read.
    """
    kinds: Counter[str] = Counter()
    magnifications = set()
    stamps_ns = []
    with open_source(source, resolve_config(config)) as opened:
        advance = count_frames(on_progress, "reading", opened.frame_count)
        for frame in opened.frames():
            height, width = frame.image.shape[:2]
            kinds[f"{width} x {height} {frame.encoding}"] += 1
            magnifications.add(frame.magnification)
            stamps_ns.append(frame.stamp_ns)
            advance(1)
        topics, notes = opened.topics, opened.notes
    return RecordingSummary(
        topics,
        len(stamps_ns),
        (max(stamps_ns) - min(stamps_ns)) * 1e-9,
        dict(sorted(kinds.items())),
        tuple(sorted(magnifications)),
        notes,
    )
