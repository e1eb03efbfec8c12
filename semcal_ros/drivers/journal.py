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

"""Which files of a folder have been published, kept over the end of the process."""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from semcal_ros.core.errors import MicroscopeError
from semcal_ros.files.atomic import atomic_write_text

# Months of a busy microscope, in 15 MB. Older entries are forgotten when the journal is opened.
_KEPT = 100_000
_SECOND_NS = 1_000_000_000
_HEADER = {"semcal_ros": "journal of a folder", "version": 1}


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
