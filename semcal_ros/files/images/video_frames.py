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

"""Videos as sequences of grey images."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.errors import BagError

__all__ = ["VIDEO_SUFFIXES", "VideoDescription", "describe_video", "read_video"]

#: Suffixes of files that are opened as videos.
VIDEO_SUFFIXES = frozenset(
    {".mp4", ".avi", ".mov", ".mkv", ".mpg", ".mpeg", ".m4v", ".webm", ".wmv"}
)
# Bits per pixel from which a format has more than 8 grey levels worth keeping: such as gray16le, yuv420p10le.
_MOST_BITS_OF_8 = 8


@dataclass(frozen=True)
class VideoDescription:
    """What a video says without being decoded.

    Attributes
    ----------
    size_px
        (width, height).
    times_s
        Times of the frames from the first, ascending.
    """

    size_px: tuple[int, int]
    times_s: tuple[float, ...]


@contextmanager
def _open(path: Path) -> Iterator[tuple[Any, Any]]:
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise BagError(f"{path} has no video stream", expected="a video")
            yield container, container.streams.video[0]
    except (av.FFmpegError, OSError, ValueError) as error:
        raise BagError(
            f"{path} cannot be read: {' '.join(str(error).split())}",
            expected="an intact video that FFmpeg decodes",
        ) from error


def describe_video(path: Path) -> VideoDescription:
    """Read size and times of a video.

    Raises
    ------
    BagError
        The file cannot be read, or has no frames.
    """
    with _open(path) as (container, stream):
        size_px = int(stream.width), int(stream.height)
        packets = [p for p in container.demux(stream) if p.pts is not None and not p.is_discard]
        times_s = sorted(float(p.pts * p.time_base) for p in packets)
    if not times_s or min(size_px) <= 0:
        raise BagError(f"{path} has no frames", expected="a video with frames")
    return VideoDescription(size_px, tuple(time_s - times_s[0] for time_s in times_s))


def read_video(path: Path) -> Iterator[NDArray[Any]]:
    """Yield (h, w) grey frames in the order in which they are shown, uint8 or, of deeper formats, uint16.

    Raises
    ------
    BagError
        The file is damaged.
    """
    with _open(path) as (container, stream):
        stream.thread_type = "AUTO"
        bits = max(component.bits for component in stream.format.components)
        form, dtype = ("gray16le", np.uint16) if bits > _MOST_BITS_OF_8 else ("gray", np.uint8)
        for frame in container.decode(stream):
            yield np.ascontiguousarray(frame.to_ndarray(format=form), dtype=dtype)
