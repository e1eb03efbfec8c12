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

"""A frame grabber, a network stream or a video file."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import numpy as np

from semcal_ros.core.errors import MicroscopeError, UnusableFrameError
from semcal_ros.drivers.source import SourceFrame

# A grabber without a signal, or a stream whose server is gone, is given up after this time.
_TIMEOUT_S = 5.0
# From more bits than this a component has grey levels worth 16 bit.
_BITS_OF_8 = 8
# How often the side file is looked at: a person who saves it waits no longer than for the next frames.
_EXAMINE_S = 0.2
# A video file that is played later than this does not hurry to catch up.
_LATE_S = 1.0
_LINE = re.compile(r"\s*(?:(magnification|field_width_m)\s*[:=])?\s*([0-9.eE+-]+)\s*(?:#.*)?")
_LONGEST = 10_000


class SideFile:
    """A text file that says the magnification: ``magnification: 5000``, ``field_width_m: 2.4e-5``, or a number alone.

    Parameters
    ----------
    path
        The file; it may come later, and change.
    display_width_m
        To which the magnification refers.
    """

    def __init__(self, path: Path, display_width_m: float) -> None:
        self._path = path
        self._display_width_m = display_width_m
        self._examined_s = -_EXAMINE_S
        self._seen: tuple[int, int] | None = None
        self._width_m: float | None = None

    def field_width_m(self) -> float | None:
        """Return the field width that the file states now; None without a file.

        Raises
        ------
        UnusableFrameError
            It has changed, and holds no magnification. What it said before holds no longer.
        """
        now_s = time.monotonic()
        if now_s - self._examined_s < _EXAMINE_S:
            return self._width_m
        self._examined_s = now_s
        try:
            about = self._path.stat()
            seen = about.st_mtime_ns, about.st_size
            if seen == self._seen:
                return self._width_m
            self._seen, self._width_m = seen, None
            with self._path.open(encoding="utf-8", errors="replace") as stream:
                text = stream.read(_LONGEST)
        except OSError:
            self._seen, self._width_m = None, None
            return None
        self._width_m = self._read(text)
        return self._width_m

    def _read(self, text: str) -> float:
        for line in text.splitlines():
            if not line.strip() or line.lstrip().startswith("#"):
                continue
            if match := _LINE.fullmatch(line):
                key, number = match.groups()
                try:
                    value = float(number)
                except ValueError:
                    break
                if 0.0 < value < float("inf"):
                    return value if key == "field_width_m" else self._display_width_m / value
            break
        raise UnusableFrameError(
            f"{self._path} begins with {text.strip()[:40]!r}",
            expected="a line such as magnification: 5000 or field_width_m: 2.4e-5",
        )


class VideoSource:
    """Decodes frames with FFmpeg. Their stamps are those of their arrival: a video does not tell more.

    Parameters
    ----------
    name
        Device such as ``/dev/video0``, address, or file. A file is played at its own rate.
    field_width_m
        Returns the field width now, or None.
    form
        FFmpeg's name of the format; empty: ``v4l2`` for a device, else found out.
    """

    streams = True
    lossless = False

    def __init__(
        self, name: str, field_width_m: Callable[[], float | None], *, form: str = ""
    ) -> None:
        self._name = name
        self._field_width_m = field_width_m
        self._form = form or ("v4l2" if name.startswith("/dev/") else "")
        self._container: Any = None
        self._frames: Any = None
        self._is_file = False
        self._ended = False
        self._begun: tuple[float, float] | None = None
        self._waiting: tuple[float, Any] | None = None

    def open(self) -> str:
        """Open device, address or file; see :meth:`FrameSource.open`."""
        self.close()
        self._is_file = Path(self._name).is_file()
        try:
            self._container = av.open(self._name, format=self._form or None, timeout=_TIMEOUT_S)
            stream = self._container.streams.video[0]
        except (av.FFmpegError, OSError, ValueError, IndexError) as error:
            raise self._failed(error) from error
        self._ended, self._begun = False, None
        # With several threads the decoder holds back as many frames.
        stream.thread_type = "NONE" if not self._is_file else "AUTO"
        bits = max((part.bits for part in stream.format.components), default=0)
        self._pixels = ("gray16le", np.uint16) if bits > _BITS_OF_8 else ("gray", np.uint8)
        self._time_base = float(stream.time_base or 0.0)
        self._frames = self._container.decode(stream)
        return (
            f"video {self._name}, {stream.width} x {stream.height} px; stamps are those of arrival"
        )

    def close(self) -> None:
        """Let the device go."""
        container, self._container, self._frames = self._container, None, None
        self._waiting = None
        if container is not None:
            container.close()

    def _failed(self, error: Exception) -> MicroscopeError:
        reason = " ".join(str(error).split())
        return MicroscopeError(
            f"video {self._name}: {reason}",
            expected="a device, an address or a file that FFmpeg reads",
            do="check its name, and that no other program uses it",
        )

    def read(self, timeout_s: float) -> SourceFrame | None:
        """Return the next frame; see :meth:`FrameSource.read`."""
        if self._ended:
            time.sleep(timeout_s)
            return None
        if self._waiting is None:
            self._waiting = self._decode()
        due_s, frame = self._waiting
        wait_s = due_s - time.monotonic()
        if wait_s > timeout_s:
            time.sleep(timeout_s)
            return None
        if wait_s > 0.0:
            time.sleep(wait_s)
        self._waiting = None
        arrived_ns = time.time_ns()
        form, dtype = self._pixels
        image = np.ascontiguousarray(frame.to_ndarray(format=form), dtype=dtype)
        return SourceFrame(image, arrived_ns, None, self._field_width_m())

    def _decode(self) -> tuple[float, Any]:
        """The next frame, and when it is due."""
        try:
            frame = next(self._frames)
        except StopIteration:
            self._ended = self._is_file
            # A device does not end: it has been taken away.
            error = UnusableFrameError if self._is_file else MicroscopeError
            raise error(
                f"video {self._name} has ended", do="call ~/stop and ~/start to play it again"
            ) from None
        except (av.FFmpegError, OSError, ValueError) as error:
            raise self._failed(error) from error
        now_s = time.monotonic()
        if not self._is_file or frame.pts is None:
            return now_s, frame
        at_s = float(frame.pts) * self._time_base
        if self._begun is None or now_s - self._begun[0] - (at_s - self._begun[1]) > _LATE_S:
            self._begun = now_s, at_s
        return self._begun[0] + at_s - self._begun[1], frame
