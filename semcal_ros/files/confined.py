"""Files that are named from afar, such as by a service: only inside of one folder, and only plain ones."""

from __future__ import annotations

import os
import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from semcal_ros.core.errors import CalibrationFileError, InvalidValueError

__all__ = ["AllowedPaths", "check_plain_yaml", "read_plain_text"]


def _resolved(path: str) -> Path:
    try:
        return Path(os.path.realpath(os.path.expanduser(path)))
    except ValueError as error:
        raise InvalidValueError(f"file name {path!r} ({error})", expected="a path") from error


class AllowedPaths:
    """Which files may be named while a program runs.

    Parameters
    ----------
    directory
        Folder in which they must lie. Empty: the folders of ``trusted``.
    trusted
        Files named at the start, which are allowed wherever they are.

    Raises
    ------
    InvalidValueError
        ``directory`` is no folder.
    """

    def __init__(self, directory: str = "", trusted: Sequence[str] = ()) -> None:
        self._trusted = tuple(_resolved(path) for path in trusted)
        self._folders = tuple(path.parent for path in self._trusted)
        if directory:
            folder = _resolved(directory)
            if not folder.is_dir():
                raise InvalidValueError(
                    f"directory {directory}, which is no folder", expected="an existing folder"
                )
            self._folders = (folder,)

    def resolve(self, path: str) -> Path:
        """The file itself, behind ``~``, ``..`` and all symbolic links as they are now.

        Raises
        ------
        InvalidValueError
            It lies elsewhere.
        """
        real = _resolved(path)
        if real in self._trusted or any(real.is_relative_to(folder) for folder in self._folders):
            return real
        if not self._folders:
            raise InvalidValueError(
                f"file {path}, and no folder whose files may be named while the node runs",
                expected="the parameter directory to name one",
                do="start the node with -p directory:=FOLDER",
            )
        folders = " or ".join(str(folder) for folder in dict.fromkeys(self._folders))
        behind = "" if str(real) == path else f", which is {real}"
        raise InvalidValueError(
            f"file {path}{behind}",
            expected=f"a file inside of {folders}",
            do="choose one there, or start the node with another directory",
        )


def read_plain_text(path: Path, max_bytes: int) -> str:
    """Text of a regular file in UTF-8.

    A pipe or a device, which may have no end, is refused without waiting for it.

    Raises
    ------
    CalibrationFileError
        The file is missing, unreadable, no regular file, too large, or no text.
    """
    try:
        # A pipe without a writer would not even open otherwise.
        with os.fdopen(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise CalibrationFileError(f"{path}: not a file", expected="a regular file")
            data = file.read(max_bytes + 1)
        if len(data) > max_bytes:
            raise CalibrationFileError(
                f"{path}: more than {max_bytes} bytes", expected=f"at most {max_bytes}"
            )
        # Line ends as when reading text.
        return data.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    except OSError as error:
        raise CalibrationFileError(
            f"{path}: {error.strerror or error}",
            expected="a readable calibration file",
            do="check the path, or make one with `semcal calibrate`",
        ) from error
    except UnicodeDecodeError as error:
        raise CalibrationFileError(
            f"{path}: not a text file", expected="a calibration written by semcal"
        ) from error


_MAX_DEPTH = 32
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_OPENING = (yaml.SequenceStartEvent, yaml.MappingStartEvent)
_CLOSING = (yaml.SequenceEndEvent, yaml.MappingEndEvent)


def _where(mark: Any) -> str:
    return "" if mark is None else f" at line {mark.line + 1}"


def check_plain_yaml(text: str, source: str) -> None:
    """Refuse what a calibration never has and what a safe loader does not survive.

    libyaml's composer calls itself for every level, so that some hundred thousand brackets overrun the stack and end
    the process; and nodes that refer to each other or to themselves become exponentially many when they are written
    again.

    Raises
    ------
    CalibrationFileError
        The text is nested more than 32 deep, has anchors or aliases, or is no YAML.
    """
    depth = 0
    try:
        for event in yaml.parse(text, Loader=_Loader):
            if isinstance(event, _OPENING):
                depth += 1
            elif isinstance(event, _CLOSING):
                depth -= 1
            if depth > _MAX_DEPTH or getattr(event, "anchor", None) is not None:
                what = (
                    f"nested more than {_MAX_DEPTH} deep"
                    if depth > _MAX_DEPTH
                    else "an anchor or alias"
                )
                raise CalibrationFileError(
                    f"{source}: {what}{_where(event.start_mark)}",
                    expected="a calibration written by semcal",
                )
    except (yaml.YAMLError, ValueError, OverflowError) as error:
        raise CalibrationFileError(
            f"{source}: not valid YAML{_where(getattr(error, 'problem_mark', None))}",
            expected="a complete calibration file",
            do="restore the file or calibrate again",
        ) from error
