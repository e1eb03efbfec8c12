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

"""Write a file completely or not at all."""

from __future__ import annotations

import contextlib
import errno
import os
import stat
import tempfile
from pathlib import Path

# What open() asks for; the umask takes its bits away.
_NEW_FILE_MODE = 0o666
# File systems take names of 255 bytes, and the temporary one is longer than the name itself.
_NAME_PART = 100


def _mode_for(path: Path) -> int:
    """Return the permission bits of the finished file: those of the file it replaces, else the usual ones."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        mask = os.umask(0)
        os.umask(mask)
        return _NEW_FILE_MODE & ~mask
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        # Moving a file over a device or a pipe would remove it for everybody.
        raise OSError(errno.EINVAL, "Not a regular file", str(path))
    return stat.S_IMODE(mode)


def atomic_write_bytes(path: Path, data: bytes) -> None:
    """Write ``data`` to ``path``: afterwards the file is either complete or what it was before.

    The bytes go to a temporary file in the same folder, are flushed to the disk and then moved
    over ``path`` in one step. If ``path`` is a symbolic link, its target is replaced.

    Raises
    ------
    OSError
        The folder is missing or not writable, the disk is full, or ``path`` is a folder, a device
        or a pipe. An existing file is untouched.
    """
    target = Path(os.path.realpath(path))
    mode = _mode_for(target)
    handle, name = tempfile.mkstemp(
        prefix=f".{target.name[:_NAME_PART]}.", suffix=".tmp", dir=target.parent
    )
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.write(data)
            stream.flush()
            os.fsync(stream.fileno())
        os.chmod(name, mode)
        os.replace(name, target)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(name)
        raise


def atomic_write_text(path: Path, text: str) -> None:
    """Write ``text`` as UTF-8 with ``\\n`` line ends; see :func:`atomic_write_bytes`."""
    atomic_write_bytes(path, text.encode("utf-8"))
