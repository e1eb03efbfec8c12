"""Videos of grey frames with a caption."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.errors import BagError, InvalidValueError

__all__ = ["VIDEO_CODECS", "Film", "film_of"]

#: Suffix of a video's name, and how it is encoded.
VIDEO_CODECS: Mapping[str, str] = MappingProxyType({".mp4": "mp4v", ".avi": "MJPG"})


class Film:
    """A video that is being written.

    Parameters
    ----------
    path
        File with one of the suffixes of :data:`VIDEO_CODECS`.
    size
        (width, height) of the frames, px.
    fps
        Frames per second.
    grey
        Grey levels that are shown as black and white.

    Raises
    ------
    InvalidValueError
        If OpenCV has no encoder for it.
    """

    def __init__(
        self, path: Path, size: tuple[int, int], fps: float, grey: tuple[float, float]
    ) -> None:
        self._low, self._high = grey[0], max(grey[1], grey[0] + 1e-6)
        # Encoders want even numbers.
        even = size[0] + size[0] % 2, size[1] + size[1] % 2
        self._border = even[0] - size[0], even[1] - size[1]
        codec = VIDEO_CODECS[path.suffix.lower()]
        before = cv2.utils.logging.getLogLevel()
        cv2.utils.logging.setLogLevel(0)  # what it would print is said below in one line
        try:
            self._writer = cv2.VideoWriter(
                str(path), cv2.VideoWriter.fourcc(*codec), fps, even, True
            )
        finally:
            cv2.utils.logging.setLogLevel(before)
        if not self._writer.isOpened():
            raise InvalidValueError(
                f"no encoder {codec} for {path.suffix} in OpenCV {cv2.__version__}",
                expected="a build of OpenCV with FFmpeg",
                do="try the other of " + " and ".join(VIDEO_CODECS),
            )

    def write(self, picture: NDArray[np.float32], caption: str) -> None:
        """A frame (h, w), NaN shown as 0, with a line of text at the bottom."""
        scale = 255.0 / (self._high - self._low)
        grey = np.clip(np.rint((np.nan_to_num(picture) - self._low) * scale), 0, 255)
        right, bottom = self._border
        padded = cv2.copyMakeBorder(
            grey.astype(np.uint8), 0, bottom, 0, right, cv2.BORDER_CONSTANT, value=0
        )
        frame = cv2.cvtColor(padded, cv2.COLOR_GRAY2BGR)
        _label(frame, caption)
        self._writer.write(frame)

    def close(self) -> None:
        """No more frames follow."""
        self._writer.release()


def _label(frame: NDArray[Any], text: str) -> None:
    scale = max(0.35, 0.5 * frame.shape[0] / 512)
    place = (round(12 * scale), frame.shape[0] - round(14 * scale))
    thin = max(1, round(1.5 * scale))
    # White with a black edge can be read on any specimen.
    for color, width in (((0, 0, 0), thin + 2), ((255, 255, 255), thin)):
        cv2.putText(frame, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, color, width, cv2.LINE_AA)


@contextmanager
def film_of(
    path: Path | None, size: tuple[int, int], frames: int, fps: float, grey: tuple[float, float]
) -> Iterator[Film | None]:
    """A video that gets its name only once it is complete; None where no ``path`` is given.

    Parameters
    ----------
    path, size, fps, grey
        As for :class:`Film`.
    frames
        How many are going to be written.

    Raises
    ------
    InvalidValueError
        If OpenCV has no encoder for it.
    BagError
        If it did not come out with all of its frames.
    """
    if path is None:
        yield None
        return
    target = path.resolve()
    with tempfile.TemporaryDirectory(
        prefix=f".{target.name}.", suffix=".tmp", dir=target.parent
    ) as scratch:
        file = Path(scratch) / f"video{target.suffix.lower()}"
        film = Film(file, size, fps, grey)
        try:
            yield film
        finally:
            film.close()
        _check(file, path, frames)
        os.replace(file, target)


def _check(file: Path, path: Path, frames: int) -> None:
    """The encoder reports no errors, such as a full disk: look whether all is there."""
    reader = cv2.VideoCapture(str(file))
    found = int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) if reader.isOpened() else 0
    reader.release()
    if found != frames:
        raise BagError(
            f"{path} came out with {found} of {frames} frames",
            expected="space for the whole video",
            do="free space or choose another place",
        )
