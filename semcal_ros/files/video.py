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

"""Videos: read as sequences of grey images, and written with a caption and a scale bar."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from types import MappingProxyType
from typing import Any

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import check_positive
from semcal_ros.core.errors import BagError, InvalidValueError
from semcal_ros.core.wording import counted
from semcal_ros.files.images.scale_bar import ScaleBar, draw_scale_bar

#: Grey levels of more than 8 bits are shown with these quantiles as black and white: one pixel in a thousand may be
#: clipped at either end.
BLACK_WHITE = (0.001, 0.999)
#: Frames per second that can be asked for: a frame in ten seconds, and the fastest common displays.
FPS_RANGE = (0.1, 240.0)
#: Suffixes of files that are opened as videos.
VIDEO_SUFFIXES = frozenset(
    {".mp4", ".avi", ".mov", ".mkv", ".mpg", ".mpeg", ".m4v", ".webm", ".wmv"}
)
# Bits per pixel from which a format has more than 8 grey levels worth keeping: such as gray16le, yuv420p10le.
_MOST_BITS_OF_8 = 8


@dataclass(frozen=True)
class VideoCodec:
    """How a video is encoded.

    Attributes
    ----------
    encoder, pixel_format
        Their names in FFmpeg.
    options
        Options of the encoder.
    container_options
        Options of the file format.
    """

    encoder: str
    pixel_format: str
    options: Mapping[str, str]
    container_options: Mapping[str, str]


#: Codec by the suffix of the name of a video.
#:
#: H.264 in 4:2:0 with the index in front is what browsers play. Measured with 60 frames of 512 x
#: 512 px and noise of 3 (25) grey levels: constant quality 20 with the preset "veryfast" takes 660
#: kB (6.1 MB) and 1.7 s (2.6 s) and comes back within 3.3 (5.4) levels RMS; the default preset takes
#: 4 to 5 s (8 to 14 s) at qualities 23 to 18. OpenCV's mp4v took 570 kB (4.1 MB) and 0.9 s (1.5 s), and came back 4
#: levels too dark and within 5.3 (12.9) levels RMS. Motion JPEG is for programs that edit frames: the
#: quantiser 2 to 3 leaves 2.8 (4.1) levels RMS.
VIDEO_CODECS: Mapping[str, VideoCodec] = MappingProxyType(
    {
        ".mp4": VideoCodec(
            "libx264",
            "yuv420p",
            {"crf": "20", "preset": "veryfast"},
            {"movflags": "+faststart"},
        ),
        ".avi": VideoCodec("mjpeg", "yuvj420p", {"qmin": "2", "qmax": "3"}, {}),
    }
)


def check_video(path: Path, fps: float) -> None:
    """Refuse a video that :class:`VideoWriter` cannot write, before any work is done for it.

    Raises
    ------
    InvalidValueError
        If the suffix is not one of :data:`VIDEO_CODECS`, or ``fps`` is no rate of a video.
    """
    if path.suffix.lower() not in VIDEO_CODECS:
        raise InvalidValueError(
            f"video {path}", expected="a name that ends in " + " or ".join(VIDEO_CODECS)
        )
    low, high = FPS_RANGE
    if not low <= check_positive(fps, "fps") <= high:
        raise InvalidValueError(f"fps {fps}", expected=f"{low:g} to {high:g}")


class VideoWriter:
    """A video that is being written.

    Parameters
    ----------
    path
        File with one of the suffixes of :data:`VIDEO_CODECS`.
    size
        (width, height) of the frames, px.
    fps
        Frames per second.

    Raises
    ------
    InvalidValueError
        As :func:`check_video`, or if FFmpeg has no encoder for it.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: float) -> None:
        # Colour is stored for blocks of 2 x 2 px, so that both numbers must be even.
        even = size[0] + size[0] % 2, size[1] + size[1] % 2
        self._border = even[0] - size[0], even[1] - size[1]
        check_video(path, fps)
        codec = VIDEO_CODECS[path.suffix.lower()]
        if codec.encoder not in av.codecs_available:
            raise InvalidValueError(
                f"no encoder {codec.encoder} for {path.suffix} in the FFmpeg of PyAV {av.__version__}",
                expected=f"an FFmpeg with {codec.encoder}",
                do="try the other of " + " and ".join(VIDEO_CODECS),
            )
        self._container = av.open(str(path), "w", options=dict(codec.container_options))
        # Rates such as 29.97 are fractions in a file; this denominator holds all common ones.
        rate = Fraction(fps).limit_denominator(1001)
        stream = self._container.add_stream(codec.encoder, rate=rate, options=dict(codec.options))
        assert isinstance(stream, av.VideoStream)
        self._stream = stream
        self._stream.width, self._stream.height = even
        self._stream.pix_fmt = codec.pixel_format

    def write(self, image: NDArray[np.uint8], caption: str, bar: ScaleBar | None = None) -> None:
        """Add a frame (h, w) as :func:`shade` makes it, with a line of text at the bottom and a scale bar.

        Raises
        ------
        av.FFmpegError
            If the file cannot be written.
        """
        right, bottom = self._border
        frame = np.pad(image, ((0, bottom), (0, right)))
        end, top = _draw_caption(frame, caption)
        if bar is not None:
            room = frame.shape[1] - end
            draw_scale_bar(frame, bar, above_px=0 if room > 0.5 * frame.shape[1] else top)
        self._container.mux(self._stream.encode(av.VideoFrame.from_ndarray(frame, format="gray")))

    def finish(self) -> None:
        """Write the frames that the encoder still holds, and the index; no frames may follow.

        Raises
        ------
        av.FFmpegError
            If the file cannot be written.
        """
        self._container.mux(self._stream.encode(None))
        self._container.close()

    def release(self) -> None:
        """Close the file, finished or not."""
        with suppress(av.FFmpegError):
            self._container.close()


def shade(image: NDArray[np.float32], grey: tuple[float, float]) -> NDArray[np.uint8]:
    """An image as a video shows it.

    Parameters
    ----------
    image
        (h, w); NaN is shown as 0.
    grey
        Grey levels that are shown as black and white.
    """
    low, high = grey[0], max(grey[1], grey[0] + 1e-6)
    scaled = (np.nan_to_num(image) - low) * (255.0 / (high - low))
    return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


def _draw_caption(frame: NDArray[np.uint8], text: str) -> tuple[int, int]:
    """Draw a line of text; returns where it ends to the right, and its height from the bottom."""
    scale = max(0.35, 0.5 * frame.shape[0] / 512)
    place = (round(12 * scale), frame.shape[0] - round(14 * scale))
    thin = max(1, round(1.5 * scale))
    # White with a black edge can be read on any specimen.
    for level, width in ((0, thin + 2), (255, thin)):
        cv2.putText(frame, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, level, width, cv2.LINE_AA)
    (wide, high), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thin + 2)
    return place[0] + wide, frame.shape[0] - place[1] + high


@contextmanager
def open_video(
    path: Path | None, size: tuple[int, int], frames: int, fps: float
) -> Iterator[VideoWriter | None]:
    """Write a video that gets its name only once it is complete; None where no ``path`` is given.

    Parameters
    ----------
    path, size, fps
        As for :class:`VideoWriter`.
    frames
        Number of frames that will be written.

    Raises
    ------
    InvalidValueError
        If FFmpeg has no encoder for it.
    BagError
        If it cannot be written with all of its frames.
    """
    if path is None:
        yield None
        return
    target = path.resolve()
    with tempfile.TemporaryDirectory(
        prefix=f".{target.name}.", suffix=".tmp", dir=target.parent
    ) as scratch:
        file = Path(scratch) / f"video{target.suffix.lower()}"
        video = VideoWriter(file, size, fps)
        try:
            yield video
            video.finish()
        except av.FFmpegError as error:
            raise _incomplete(path, error.strerror or str(error)) from error
        finally:
            video.release()
        found = _count_frames(file)
        if found != frames:
            raise _incomplete(path, f"{found} of {counted(frames, 'frame')} encoded")
        os.replace(file, target)


def _incomplete(path: Path, what: str) -> BagError:
    return BagError(
        f"{path} cannot be written: {what}",
        expected="space for the whole video",
        do="free space or choose another place",
    )


def _count_frames(file: Path) -> int:
    with av.open(str(file)) as container:
        return sum(1 for packet in container.demux(video=0) if packet.size)


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
