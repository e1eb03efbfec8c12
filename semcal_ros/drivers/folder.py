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

"""A folder into which the microscope's own software saves: each finished file is a frame, with what it says of itself.

Which files have been published is kept over the end of the process, in a journal.
"""

from __future__ import annotations

import contextlib
import fcntl
import fnmatch
import hashlib
import json
import logging
import os
import stat
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semcal_ros.bridge.stage import doubt_unit
from semcal_ros.config.config import StageConfig
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.errors import MicroscopeError, SemcalError, UnusableFrameError
from semcal_ros.drivers.source import SourceFrame
from semcal_ros.files.atomic import atomic_write_text
from semcal_ros.files.images.image_file import ImagePage, describe_image_file, is_image_file
from semcal_ros.files.images.sem_image import VendorSettings
from semcal_ros.files.video import VIDEO_SUFFIXES

# A file that was closed or renamed into place is most often complete; a program that opens it once more, to append its
# metadata, does so within milliseconds.
_CLOSED_S = 0.05
# Between two tries of a file that does not decode yet.
_RETRY_S = 0.2
# JEOL, Hitachi and TESCAN write a text file beside a picture, after it.
_SIDE_FILE_S = 2.0
# A share of the time of the source's thread that looking through the folder may take: folders of 100 000 files on a
# network share take seconds.
_LOOKING = 0.1
# All pages of a file are decoded before the first is published.
_MOST_PIXELS = 500_000_000
# Two pictures with one stamp could not be told apart.
_STAMP_STEP_NS = 1000

# What two numbers of one angle may differ by, and what counts as not rotated: rounding of a file's text.
_TURNED_RAD = 1e-3

# Months of a busy microscope, in 15 MB. Older entries are forgotten when the journal is opened.
_KEPT = 100_000
_SECOND_NS = 1_000_000_000
_HEADER = {"semcal_ros": "journal of a folder", "version": 1}


@dataclass
class _Candidate:
    """A file that is not done with.

    Attributes
    ----------
    state
        As it was seen last.
    since_s
        Since when it is like that, on a steady clock.
    closed
        Whether its writer has closed it since.
    next_s
        When to try it.
    reason
        Why it could not be read.
    """

    state: FileState
    since_s: float
    closed: bool = False
    next_s: float = 0.0
    reason: str = ""


@dataclass(frozen=True)
class _Token:
    """What the journal gets once the last picture of a file has been published."""

    state: FileState
    picture: str


class FolderSource:
    """Reads the image files of one folder, each once, in the order in which they were finished.

    A file is finished once size and time have not changed for ``settle_s`` (a shorter time after its writer has closed
    it or given it its name, where the system tells) and it decodes. Where watchdog is installed and the folder is on
    this computer, the system tells of changes at once; in any case the folder is looked through every ``poll_s``, which
    is what finds files on network shares.

    Parameters
    ----------
    folder
        The folder; those in it are not looked at.
    journal
        File that keeps which files are done with.
    pattern
        Which names count, such as ``*.tif``; several are separated by spaces. Names that begin with a dot never do.
    settle_s, poll_s
        See above.
    give_up_s
        A file that does not decode is refused once it has not changed for this long.
    backlog
        Which of the files that are there at the start are published: ``resume``, those that came since the journal was
        written last, and none the first time; ``all`` that the journal does not have; ``skip``, none.
    stamps
        ``file``: a frame was finished when its file was written last, by the clock of its file system; ``arrival``:
        when the file was found to be complete, for shares whose clock differs.
    field_width_m
        Returns the field width of files that do not say it; 0 leaves it unknown.
    keep_databar
        Whether the data bar stays in the image, for receivers that cut it off.
    """

    streams = False
    lossless = True

    def __init__(
        self,
        folder: Path,
        journal: Path,
        *,
        pattern: str = "*",
        settle_s: float = 0.3,
        poll_s: float = 0.5,
        give_up_s: float = 10.0,
        backlog: str = "resume",
        stamps: str = "file",
        field_width_m: Callable[[], float] = float,
        keep_databar: bool = False,
    ) -> None:
        self._folder = folder
        self._journal_path = journal
        self._patterns = pattern.split() or ["*"]
        self._settle_s, self._poll_s, self._give_up_s = settle_s, poll_s, give_up_s
        self._backlog = backlog
        self._stamps = stamps
        self._field_width_m = field_width_m
        self._keep_databar = keep_databar
        self._journal: Journal | None = None
        self._observer: Any = None
        self._lock = threading.Lock()  # of the journal, which confirm() uses too
        self._event = threading.Condition()
        self._touched: dict[str, bool] = {}
        self._candidates: dict[str, _Candidate] = {}
        self._taken: set[FileState] = set()
        self._frames: deque[SourceFrame] = deque()
        self._next_scan_s = 0.0
        self._last_stamp_ns = 0
        self._first_rotation_rad: float | None = None

    # -- connection --------------------------------------------------------------------------------

    def open(self) -> str:
        """Look through the folder and watch it; see :meth:`FrameSource.open`."""
        self.close()
        present = self._list()
        with self._lock:
            if self._journal is None:
                self._journal = Journal(self._journal_path)
            if self._backlog == "skip" or (self._backlog == "resume" and self._journal.is_new):
                self._journal.begin(present)
            elif self._journal.is_new:
                self._journal.begin([])
            waiting = sum(not self._journal.knows(state) for state in present)
        # What comes from now on is published, whatever happens to the connection.
        self._backlog = "resume"
        self._next_scan_s = 0.0
        watched = self._watch()
        ahead = f"; {waiting} files to be published first" if waiting else ""
        return f"folder {self._folder}, {watched}{ahead}"

    def close(self) -> None:
        """Watch no longer, and let the journal go unless pictures are on their way that it must know of."""
        observer, self._observer = self._observer, None
        if observer is not None:
            with contextlib.suppress(Exception):
                observer.stop()
        with self._lock:
            if self._journal is not None and not self._taken:
                self._journal.close()
                self._journal = None
        self._touched.clear()
        self._candidates.clear()

    def _watch(self) -> str:
        """Ask the system to tell of changes; returns in words whether it does."""
        polled = f"looked through every {self._poll_s:g} s"
        try:
            from watchdog.events import FileSystemEvent, FileSystemEventHandler
            from watchdog.observers import Observer
        except ImportError:
            return f"{polled} (watchdog is not installed)"
        source = self
        logging.getLogger("watchdog").setLevel(logging.WARNING)

        class Handler(FileSystemEventHandler):
            def on_any_event(self, event: FileSystemEvent) -> None:
                source._on_event(event)

        observer = Observer()
        try:
            observer.schedule(Handler(), str(self._folder), recursive=False)
            observer.daemon = True
            observer.start()
        except (OSError, RuntimeError) as error:
            return f"{polled} (the system does not tell of changes: {error})"
        self._observer = observer
        return f"watched, and {polled}"

    def _on_event(self, event: Any) -> None:
        """Note what the system tells; runs in a thread of watchdog."""
        if event.is_directory or event.event_type in ("opened", "closed_no_write", "deleted"):
            return
        moved = event.event_type == "moved"
        name = os.path.basename(os.fsdecode(event.dest_path if moved else event.src_path))
        closed = moved or event.event_type == "closed"
        with self._event:
            self._touched[name] = closed or (
                event.event_type != "modified" and self._touched.get(name, False)
            )
            self._event.notify_all()

    # -- frames ------------------------------------------------------------------------------------

    def read(self, timeout_s: float) -> SourceFrame | None:
        """Return the next picture; see :meth:`FrameSource.read`."""
        until_s = time.monotonic() + timeout_s
        while True:
            if self._frames:
                return self._frames.popleft()
            self._scan()
            candidate = self._ready()
            if candidate is not None:
                self._decode(candidate)
                continue
            left_s = until_s - time.monotonic()
            if left_s <= 0.0:
                return None
            with self._event:
                if not self._touched:
                    self._event.wait(min(left_s, self._until_next_s()))

    def confirm(self, frame: SourceFrame) -> None:
        """Write into the journal that a file has been published, with the last of its pictures."""
        if not isinstance(frame.token, _Token):
            return
        state, picture = frame.token.state, frame.token.picture
        with self._lock:
            if self._journal is not None:
                self._journal.add(state, "published", picture)
            self._taken.discard(state)

    def _until_next_s(self) -> float:
        now_s = time.monotonic()
        times = [self._next_scan_s, *(c.next_s for c in self._candidates.values())]
        return max(min(times) - now_s, 0.005)

    def _list(self) -> list[FileState]:
        try:
            with os.scandir(self._folder) as entries:
                found = [entry for entry in entries if self._counts(entry.name)]
                states = []
                for entry in found:
                    # Renamed meanwhile, a link to nowhere, or not to be read: the others are.
                    with contextlib.suppress(OSError):
                        if entry.is_file():
                            about = entry.stat()
                            states.append(FileState(entry.name, about.st_size, about.st_mtime_ns))
                return states
        except OSError as error:
            raise MicroscopeError(
                f"the folder {self._folder} cannot be read: {error.strerror or error}",
                expected="the folder into which the microscope saves",
                do="check the path, and that its share is mounted",
            ) from error

    def _counts(self, name: str) -> bool:
        path = Path(name)
        return (
            not name.startswith(".")
            and is_image_file(path)
            and path.suffix.lower() not in VIDEO_SUFFIXES
            and any(fnmatch.fnmatch(name, pattern) for pattern in self._patterns)
        )

    def _scan(self) -> None:
        """Take note of what has changed: of what the system tells at once, of all of it now and then."""
        with self._event:
            touched, self._touched = self._touched, {}
        now_s = time.monotonic()
        for name, closed in touched.items():
            if self._counts(name):
                self._stat(name, closed, now_s)
        if now_s < self._next_scan_s:
            return
        states = self._list()
        for state in states:
            self._see(state, False, now_s)
        present = {state.name for state in states}
        for name in self._candidates.keys() - present:
            del self._candidates[name]
        end_s = time.monotonic()
        self._next_scan_s = end_s + max(self._poll_s, (end_s - now_s) / _LOOKING)

    def _stat(self, name: str, closed: bool, now_s: float) -> None:
        try:
            about = os.stat(self._folder / name)
        except OSError:
            about = None
        if about is None or not stat.S_ISREG(about.st_mode):
            self._candidates.pop(name, None)
            return
        self._see(FileState(name, about.st_size, about.st_mtime_ns), closed, now_s)

    def _see(self, state: FileState, closed: bool, now_s: float) -> None:
        with self._lock:
            if self._journal is None or self._journal.knows(state) or state in self._taken:
                self._candidates.pop(state.name, None)
                return
        candidate = self._candidates.get(state.name)
        if candidate is None or candidate.state != state:
            candidate = self._candidates[state.name] = _Candidate(state, now_s)
        candidate.closed = candidate.closed or closed
        quiet_s = min(_CLOSED_S, self._settle_s) if candidate.closed else self._settle_s
        if not candidate.reason:
            candidate.next_s = candidate.since_s + quiet_s

    def _ready(self) -> _Candidate | None:
        now_s = time.monotonic()
        ready = [c for c in self._candidates.values() if c.next_s <= now_s]
        return min(ready, key=lambda c: (c.state.mtime_ns, c.state.name), default=None)

    def _decode(self, candidate: _Candidate) -> None:
        """Read a file into frames, or put it off, or refuse it."""
        state, path = candidate.state, self._folder / candidate.state.name
        try:
            file = describe_image_file(path)
            _check_size(state.name, file.pages)
            images = [np.ascontiguousarray(image) for image in file.read()]
            frames = self._frames_of(state, file.pages, images)
        except (SemcalError, OSError) as error:
            reason = " ".join(str(error).split())
        else:
            reason = ""
        now_s = time.monotonic()
        before = dict(self._candidates)
        self._stat(state.name, False, now_s)
        after = self._candidates.get(state.name)
        if after is not before[state.name]:
            return  # it is being written, or is gone
        if reason:
            self._put_off(candidate, reason, now_s)
            return
        if frames[0].field_width_m is None and now_s - candidate.since_s < _SIDE_FILE_S:
            candidate.reason, candidate.next_s = file.no_scale, now_s + _RETRY_S
            return
        del self._candidates[state.name]
        picture = _digest(images)
        with self._lock:
            if self._journal is None:
                return
            if self._journal.knows_picture(state, picture):
                self._journal.add(state, "the same again", picture)
                return
            self._taken.add(state)
        last = frames[-1]
        frames[-1] = replace(last, token=_Token(state, picture))
        self._frames.extend(frames)

    def _put_off(self, candidate: _Candidate, reason: str, now_s: float) -> None:
        candidate.reason = reason
        candidate.next_s = now_s + _RETRY_S
        if now_s - candidate.since_s < self._give_up_s:
            return
        del self._candidates[candidate.state.name]
        with self._lock:
            if self._journal is not None:
                self._journal.add(candidate.state, "refused")
        raise UnusableFrameError(reason)

    def _frames_of(
        self, state: FileState, pages: tuple[ImagePage, ...], images: list[NDArray[Any]]
    ) -> list[SourceFrame]:
        if len(images) != len(pages):
            raise UnusableFrameError(
                f"{state.name}: only {len(images)} of {len(pages)} pages can be read"
            )
        written_ns = state.mtime_ns if self._stamps == "file" else time.time_ns()
        return [
            self._frame(state.name, page, image, written_ns, pages[-1])
            for page, image in zip(pages, images, strict=True)
        ]

    def _frame(
        self, name: str, page: ImagePage, stored: NDArray[Any], written_ns: int, last: ImagePage
    ) -> SourceFrame:
        settings = page.settings
        if settings is not None and self._first_rotation_rad is None:
            self._first_rotation_rad = settings.stage_rotation_rad
        rows = 0 if self._keep_databar else page.databar_rows
        acquisition_s = None if settings is None else settings.frame_time_s
        # The file was written after the last of its pictures.
        before_s = (last.offset_s or 0.0) - (page.offset_s or 0.0) + (acquisition_s or 0.0)
        start_ns = max(written_ns - round(before_s * 1e9), 0)
        if abs(start_ns - self._last_stamp_ns) < _STAMP_STEP_NS:
            start_ns = self._last_stamp_ns + _STAMP_STEP_NS
        self._last_stamp_ns = start_ns
        width_m = None if page.pixel_size_m is None else page.pixel_size_m * page.size_px[0]
        return SourceFrame(
            np.ascontiguousarray(stored[: stored.shape[0] - rows]),
            start_ns,
            acquisition_s,
            width_m or self._field_width_m() or None,
            file_conditions(settings),
            file_stage(settings, self._first_rotation_rad),
            name,
        )


def _check_size(name: str, pages: tuple[ImagePage, ...]) -> None:
    """Refuse a stack that would fill the memory: it is a recording, not a frame."""
    pixels = sum(page.size_px[0] * page.size_px[1] for page in pages)
    if len(pages) > 1 and pixels > _MOST_PIXELS:
        raise UnusableFrameError(
            f"{name} has {len(pages)} pages",
            expected=f"at most {_MOST_PIXELS // 1_000_000} million pixels in one file",
            do="read it as a recording, by semcal import",
        )


def _digest(images: list[NDArray[Any]]) -> str:
    found = hashlib.blake2b(digest_size=16)
    for image in images:
        found.update(str((image.shape, image.dtype.str)).encode())
        found.update(image.data)
    return found.hexdigest()


def file_conditions(settings: VendorSettings | None) -> dict[str, float | str]:
    """Return how an image was taken, by the keys of the topic ``conditions``; what is not known is missing."""
    return {} if settings is None else settings.topic_values()


def file_stage(
    settings: VendorSettings | None, first_rotation_rad: float | None
) -> dict[str, float]:
    """Return the joints of the stage, as far as it is known what a file means by them.

    Makers do not say in which sense they count a rotation: one that is the same in all files only adds to the unknown
    direction of the specimen, and one that has changed is left out. With a scan rotation the direction of the tilt axis
    in the image is not known, so that nothing is left.

    Parameters
    ----------
    settings
        Of the file.
    first_rotation_rad
        The rotation of the first file, or None.
    """
    if settings is None or settings.stage_tilt_rad is None:
        return {}
    if abs(settings.scan_rotation_rad or 0.0) > _TURNED_RAD:
        return {}
    if doubt_unit(
        StageReading(settings.stage_tilt_rad, settings.stage_rotation_rad), StageConfig()
    ):
        return {}
    joints = {"tilt": settings.stage_tilt_rad}
    turn, first = settings.stage_rotation_rad, first_rotation_rad
    if turn is not None and first is not None and abs(turn - first) <= _TURNED_RAD:
        joints["rotation"] = turn
    return joints


class FileState(NamedTuple):
    """A file as it is at one moment.

    Attributes
    ----------
    name
        Without its folder.
    size
        Bytes.
    mtime_ns
        When it was last written, by the clock of its file system.
    """

    name: str
    size: int
    mtime_ns: int


def default_journal(folder: Path) -> Path:
    """Return where the journal of a folder is kept: with what else ROS keeps for the user.

    It is not in the folder itself, which often is a share of the microscope's computer that may only be read.
    """
    home = Path(os.environ.get("ROS_HOME") or Path.home() / ".ros")
    digest = hashlib.sha256(os.fsencode(folder)).hexdigest()[:12]
    return home / "semcal_ros" / f"{folder.name or 'root'}-{digest}.journal"


class Journal:
    """The files of a folder that are done with: published, refused, or there before the start.

    A file is known by name, size and time, which costs no look into it; else by its picture, under the same name (it
    was saved again as it was) or with the same size and time (it was renamed). One that was never looked into, since it
    was there before the start, is known after a rename by size and time. One line of JSON for each file is
    appended as soon as the file is done. What was appended outlives the end of the process, ``kill -9`` too; after a
    power failure the last files may be published once more. A line that was cut off is ignored.

    Parameters
    ----------
    path
        The journal.

    Raises
    ------
    MicroscopeError
        It cannot be written, or another process has it open.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._states: set[FileState] = set()
        self._pictures: set[tuple[object, ...]] = set()
        self._unread: set[tuple[int, int]] = set()
        self._handle = -1
        with self._writing():
            path.parent.mkdir(parents=True, exist_ok=True)
            self._lock = os.open(f"{path}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            os.close(self._lock)
            raise MicroscopeError(
                f"the journal {path} is in use by another process",
                expected="one node for one folder",
                do="end the other one, or name another journal",
            ) from error
        self.is_new = not path.exists()
        try:
            with self._writing():
                self._load()
        except MicroscopeError:
            self.close()
            raise

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise MicroscopeError(
                f"the journal {self.path} cannot be written: {error.strerror or error}",
                expected="a file in a folder that may be written to",
                do="name another one by the parameter journal",
            ) from error

    def _load(self) -> None:
        if self.is_new:
            return
        # Damaged bytes cost their own line only.
        lines = self.path.read_text(encoding="utf-8", errors="surrogateescape").splitlines()
        for line in lines[-_KEPT:]:
            with contextlib.suppress(ValueError, KeyError, TypeError):
                entry = json.loads(line)
                state = FileState(str(entry["name"]), int(entry["size"]), int(entry["mtime_ns"]))
                self._remember(state, str(entry.get("picture", "")))
        if len(lines) > 2 * _KEPT:
            atomic_write_text(self.path, "\n".join([json.dumps(_HEADER), *lines[-_KEPT:], ""]))

    def _remember(self, state: FileState, picture: str) -> None:
        self._states.add(state)
        if picture:
            self._pictures.add((state.name, picture))
            self._pictures.add((state.size, state.mtime_ns, picture))
        elif state.mtime_ns % _SECOND_NS:
            # Where times are whole seconds, another file may well have the same.
            self._unread.add((state.size, state.mtime_ns))

    def __len__(self) -> int:
        return len(self._states)

    def knows(self, state: FileState) -> bool:
        """Return whether this file is done with, without a look into it."""
        return state in self._states or (state.size, state.mtime_ns) in self._unread

    def knows_picture(self, state: FileState, picture: str) -> bool:
        """Return whether this picture is done with under this name, or was before it was renamed."""
        same_file = (state.size, state.mtime_ns, picture)
        return (state.name, picture) in self._pictures or same_file in self._pictures

    def begin(self, states: Iterable[FileState]) -> None:
        """Make a new journal, completely or not at all, in which these files are done with.

        Raises
        ------
        MicroscopeError
            It cannot be written.
        """
        listed = list(states)
        lines = [json.dumps(_HEADER), *(_line(state, "there before", "") for state in listed)]
        with self._writing():
            atomic_write_text(self.path, "\n".join([*lines, ""]))
        for state in listed:
            self._remember(state, "")
        self.is_new = False

    def add(self, state: FileState, what: str, picture: str = "") -> None:
        """Append a file that is done with.

        Raises
        ------
        MicroscopeError
            It cannot be written.
        """
        self._remember(state, picture)
        with self._writing():
            if self._handle < 0:
                flags = os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
                self._handle = os.open(self.path, flags, 0o644)
                # After a line that was cut off, this one begins its own.
                size = os.fstat(self._handle).st_size
                if size and os.pread(self._handle, 1, size - 1) != b"\n":
                    os.write(self._handle, b"\n")
            os.write(self._handle, f"{_line(state, what, picture)}\n".encode())

    def close(self) -> None:
        """Let another process have it."""
        for handle in (self._handle, self._lock):
            if handle >= 0:
                os.close(handle)
        self._handle = self._lock = -1


def _line(state: FileState, what: str, picture: str) -> str:
    # Names that are no UTF-8 are written by their escapes, and read back as they were.
    entry = {**state._asdict(), "what": what, **({"picture": picture} if picture else {})}
    return json.dumps(entry)
