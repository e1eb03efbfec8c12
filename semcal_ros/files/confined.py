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

"""Restricts files that are named while a program runs, such as by a service, to one folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from semcal_ros.core.errors import InvalidValueError


def _resolve(path: str, directory: str = "") -> Path:
    try:
        return Path(os.path.realpath(os.path.join(directory, os.path.expanduser(path))))
    except ValueError as error:
        raise InvalidValueError(f"file name {path!r} ({error})", expected="a path") from error


class AllowedPaths:
    """The files that may be named.

    Parameters
    ----------
    directory
        Folder in which the files must lie, and from which relative names start. Empty: the folders of
        ``trusted``, and the working directory.
    trusted
        Files named at the start, which are allowed wherever they are.

    Raises
    ------
    InvalidValueError
        ``directory`` is not a folder.
    """

    def __init__(self, directory: str = "", trusted: Sequence[str] = ()) -> None:
        self._start = str(_resolve(directory)) if directory else ""
        self._trusted = tuple(_resolve(path, self._start) for path in trusted)
        self._folders = tuple(path.parent for path in self._trusted)
        if directory:
            folder = Path(self._start)
            if not folder.is_dir():
                raise InvalidValueError(
                    f"directory {directory}, which is not a folder", expected="an existing folder"
                )
            self._folders = (folder,)

    def resolve(self, path: str) -> Path:
        """Return the file itself: ``~``, ``..`` and all symbolic links are resolved as they are now.

        Raises
        ------
        InvalidValueError
            The file lies elsewhere.
        """
        real = _resolve(path, self._start)
        if real in self._trusted or any(real.is_relative_to(folder) for folder in self._folders):
            return real
        if not self._folders:
            raise InvalidValueError(
                f"file {path}, but no folder whose files may be named while the node runs",
                expected="the parameter directory to name one",
                do="start the node with -p directory:=FOLDER",
            )
        folders = " or ".join(str(folder) for folder in dict.fromkeys(self._folders))
        behind = "" if str(real) == path else f", which is {real}"
        raise InvalidValueError(
            f"file {path}{behind}",
            expected=f"a file inside {folders}",
            do="choose one there, or start the node with another directory",
        )
