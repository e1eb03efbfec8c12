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

"""Turns the errors that the bag library and its backends raise on damaged or foreign files into one."""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import apsw
from rosbags.rosbag2 import Reader, ReaderError, WriterError
from rosbags.serde import SerdeError
from rosbags.typesys import TypesysError
from ruamel.yaml.error import YAMLError

from semcal_ros.core.errors import BagError

if sys.version_info >= (3, 14):
    from compression.zstd import ZstdError
else:
    from backports.zstd import ZstdError


# Damaged bytes surface from the parsers as errors of many kinds: lengths that overflow, unknown
# keys, failed internal checks. The lz4 backend raises plain RuntimeError. These errors are only ever
# caught around calls of the library.
LIBRARY_ERRORS: tuple[type[Exception], ...] = (
    ReaderError,
    WriterError,
    SerdeError,
    TypesysError,
    YAMLError,
    ZstdError,
    apsw.Error,
    struct.error,
    OSError,
    EOFError,
    ValueError,
    TypeError,
    AttributeError,
    LookupError,
    ArithmeticError,
    MemoryError,
    RuntimeError,
    AssertionError,
)

_MAX_REASON = 200  # characters: an error is one line
_MAX_NAME = 255  # of DDS


def one_line(error: BaseException) -> str:
    """Describe a library's error briefly, without line breaks and never empty."""
    text = " ".join(str(error).split()).rstrip(".") or type(error).__name__
    return text if len(text) <= _MAX_REASON else text[: _MAX_REASON - 3] + "..."


def check_types(reader: Reader) -> None:
    """Check values of an open reader that the library accepts unchecked.

    Columns of sqlite3 and values of YAML can have any type and length.

    Raises
    ------
    TypeError, ValueError
        A name is not text or too long, or the list of files is not a list.
    """
    files = getattr(reader.storage, "files", [])
    if not isinstance(files, list):
        # Otherwise the library could not close what it opened.
        setattr(reader.storage, "files", [])  # noqa: B010
        raise TypeError(f"the list of files is a {type(files).__name__}")
    for connection in reader.connections:
        if not (isinstance(connection.topic, str) and isinstance(connection.msgtype, str)):
            raise TypeError(f"topic {connection.topic!r} of type {connection.msgtype!r}")
        longest = max(len(connection.topic), len(connection.msgtype))
        if longest > _MAX_NAME:
            raise ValueError(f"a name of a topic or type of {longest} characters")


def unreadable(path: Path, error: BaseException, what: str = "") -> BagError:
    """Make the error for a recording that the library could not read."""
    subject = f"{what} of {path}" if what else str(path)
    return BagError(
        f"cannot read {subject}: {one_line(error)}",
        expected="an intact ROS 2 recording (mcap or sqlite3)",
        do="if its recorder was interrupted, repair it with 'mcap recover' or 'ros2 bag reindex', "
        "else copy it again",
    )


@contextmanager
def reading(path: Path, what: str = "") -> Iterator[None]:
    """Turn errors of the bag library inside the block into one :class:`BagError`."""
    try:
        yield
    except BagError:
        raise
    except LIBRARY_ERRORS as error:
        raise unreadable(path, error, what) from error
