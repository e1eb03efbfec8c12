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

"""Text files of a bounded size: configurations, calibrations, profiles."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path

from semcal_ros.core.errors import SemcalError
from semcal_ros.core.wording import did_you_mean

CONSTRUCTOR_ERRORS = (
    ValueError,
    TypeError,
    LookupError,
    AttributeError,
    OverflowError,
    RecursionError,
    AssertionError,
)
"""What libraries for YAML raise, beside their own errors, where a value does not fit its tag (``!!bool maybe``)."""


def read_text_file(
    path: Path, max_bytes: int, *, error: type[SemcalError], expected: str, do: str = ""
) -> str:
    """Text of a regular file in UTF-8, with line ends as ``\\n``.

    A pipe or a device, which may have no end, is refused without waiting for it.

    Parameters
    ----------
    path
        The file.
    max_bytes
        What is longer is refused before all of it is read.
    error, expected, do
        The class of errors, and what they say was expected and is to be done.

    Raises
    ------
    SemcalError
        Of the class ``error``: the file is missing, unreadable, not a regular file, too large, or
        not UTF-8 text.
    """
    try:
        # A pipe without a writer would not even open otherwise.
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise error(f"{path}: not a file", expected="a regular file", do=do)
            data = file.read(max_bytes + 1)
        if len(data) > max_bytes:
            raise error(
                f"{path}: more than {max_bytes} bytes", expected=f"at most {max_bytes} bytes", do=do
            )
        return data.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as reason:
        raise error(f"{path}: not UTF-8 text", expected=expected, do=do) from reason
    except (OSError, ValueError) as reason:  # a name with a null byte is a ValueError
        seen = (isinstance(reason, OSError) and reason.strerror) or reason
        if isinstance(reason, FileNotFoundError):
            do = name_similar_file(path) or do
        raise error(f"{path}: {seen}", expected=expected, do=do) from reason


def name_similar_file(path: Path) -> str:
    """Return the question whether a file of a similar name is meant; empty if there is none."""
    with suppress(OSError, ValueError):
        return did_you_mean(path.name, (other.name for other in path.absolute().parent.iterdir()))
    return ""
