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

"""Write a ROS 2 recording completely or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final

from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from semcal_ros.core.errors import BagError
from semcal_ros.files.bags.errors import LIBRARY_ERRORS, one_line
from semcal_ros.files.bags.messages import jazzy_types, message_type_name, serialize_message

if TYPE_CHECKING:
    from typing_extensions import Self


_METADATA_VERSION: Final = 9  # what Jazzy and Kilted write
_NO_LIMIT = QosTime(9223372036, 854775807)  # how DDS spells an infinite duration
_BAG_SUFFIXES = {".mcap", ".db3", ".zstd", ".yaml", ".json", ".csv"}


def _qos(latched: bool, depth: int) -> Qos:
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=depth,
        reliability=QosReliability.RELIABLE,
        durability=QosDurability.TRANSIENT_LOCAL if latched else QosDurability.VOLATILE,
        deadline=_NO_LIMIT,
        lifespan=_NO_LIMIT,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=_NO_LIMIT,
        avoid_ros_namespace_conventions=False,
    )


def check_replaceable(path: Path, overwrite: bool) -> None:
    """Refuse to write to a path that exists, or that is not a recording and must not be deleted.

    Raises
    ------
    BagError
        ``path`` exists and ``overwrite`` is false, or it is something other than a recording.
    """
    if not os.path.lexists(path):
        return
    if not overwrite:
        raise BagError(
            f"{path} exists", expected="a new path", do="choose another name, or --overwrite"
        )
    if path.is_dir() and not path.is_symlink():
        names = list(path.iterdir())
        foreign = [p.name for p in names if p.is_dir() or p.suffix not in _BAG_SUFFIXES]
        if not names or ((path / "metadata.yaml").exists() and not foreign):
            return
    raise BagError(
        f"{path} is not a recording, so it is not replaced",
        expected="a new path or an existing rosbag2 folder",
        do="choose another name or remove it yourself",
    )


class BagWriter:
    """Context manager that writes a rosbag2 folder (mcap), readable by ``ros2 bag``.

    Everything goes to a temporary folder beside the target, which is renamed only when the block ends
    without an error; otherwise nothing remains and an existing recording stays as it was.

    Parameters
    ----------
    path
        Folder to make.
    overwrite
        Replace an existing recording, at the very end.
    compress
        Compress chunks with zstd inside the mcap file.

    Raises
    ------
    BagError
        The path exists (see :func:`check_replaceable`), cannot be written to, or the disk is full.
    """

    def __init__(
        self, path: str | Path, *, overwrite: bool = False, compress: bool = False
    ) -> None:
        self.path = Path(os.path.abspath(path))
        self._overwrite = overwrite
        self._compress = compress
        self._connections: dict[str, Connection] = {}
        self._scratch: Path | None = None
        self._writer: Writer | None = None

    def __enter__(self) -> Self:
        check_replaceable(self.path, self._overwrite)
        with self._writing():
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._scratch = Path(
                tempfile.mkdtemp(prefix=f".{self.path.name}.", suffix=".tmp", dir=self.path.parent)
            )
            # The library names the storage file after its folder, so this has its final name.
            writer = Writer(
                self._scratch / self.path.name,
                version=_METADATA_VERSION,
                storage_plugin=StoragePlugin.MCAP,
            )
            if self._compress:
                writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            writer.open()
        self._writer = writer
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        writer, self._writer = self._writer, None
        scratch, self._scratch = self._scratch, None
        if writer is None or scratch is None:
            return
        try:
            if kind is not None:
                with contextlib.suppress(*LIBRARY_ERRORS):
                    writer.abort()
                return
            with self._writing():
                writer.close()
                check_replaceable(self.path, self._overwrite)
                _move_into_place(scratch / self.path.name, self.path, scratch)
        finally:
            shutil.rmtree(scratch, ignore_errors=True)

    @contextlib.contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except BagError:
            raise
        except LIBRARY_ERRORS as error:
            if self._writer is None and self._scratch is not None:
                shutil.rmtree(self._scratch, ignore_errors=True)
            raise BagError(
                f"cannot write {self.path}: {one_line(error)}",
                expected="a writable folder with enough space",
                do="free space or choose another place",
            ) from error

    def _open_writer(self) -> Writer:
        if self._writer is None:
            raise BagError(
                f"the writer of {self.path} is not open", do="use it in a with statement"
            )
        return self._writer

    def add_topic(
        self, name: str, typename: str, *, latched: bool = False, depth: int = 10
    ) -> None:
        """Declare a topic; repeating it with the same type does nothing.

        Parameters
        ----------
        name
            Absolute topic name.
        typename
            Message type such as ``std_msgs/msg/Float64``.
        latched
            Offer transient-local durability, so that late subscribers of a replay get the last
            message.
        depth
            History depth that is offered.

        Raises
        ------
        BagError
            The topic exists with another type, or the type is unknown.
        """
        writer = self._open_writer()
        if name in self._connections:
            have = self._connections[name].msgtype
            if have != typename:
                raise BagError(f"topic {name} has type {have}", expected=typename)
            return
        if typename not in jazzy_types().fielddefs:
            raise BagError(f"message type {typename!r}", expected="a common ROS 2 message type")
        with self._writing():
            self._connections[name] = writer.add_connection(
                name,
                typename,
                typestore=jazzy_types(),
                offered_qos_profiles=[_qos(latched, depth)],
            )

    def write(self, topic: str, log_time_ns: int, message: Any) -> None:
        """Append a message; an undeclared topic is declared by the message's type, not latched.

        Raises
        ------
        BagError
            A value does not fit its field, the topic has another type, or the disk is full.
        """
        typename = message_type_name(message)
        self.add_topic(topic, typename)
        try:
            data = serialize_message(message)
        except LIBRARY_ERRORS as error:
            raise BagError(
                f"a {typename} for {topic} cannot be stored: {one_line(error)}",
                expected="values that fit its fields",
            ) from error
        self.write_raw(topic, log_time_ns, data)

    def write_raw(self, topic: str, log_time_ns: int, data: bytes | memoryview) -> None:
        """Append CDR bytes to a topic that :meth:`add_topic` declared."""
        writer = self._open_writer()
        if topic not in self._connections:
            raise BagError(f"topic {topic} is not declared", do="call add_topic first")
        if not 0 <= log_time_ns < 2**63:
            raise BagError(
                f"time {log_time_ns} ns on {topic}", expected="0 to 2^63 - 1 nanoseconds"
            )
        with self._writing():
            writer.write(self._connections[topic], int(log_time_ns), data)

    def write_text(self, name: str, text: str) -> None:
        """Put a text file, such as ``truth.json``, beside the storage file in the folder."""
        self._open_writer()
        if (
            self._scratch is None
            or Path(name).name != name
            or Path(name).suffix not in (".json", ".csv")
        ):
            raise BagError(
                f"sidecar {name!r}", expected="a plain file name that ends in .json or .csv"
            )
        with self._writing():
            (self._scratch / self.path.name / name).write_text(text, encoding="utf-8")


def _move_into_place(new: Path, target: Path, scratch: Path) -> None:
    """Rename ``new``; an existing recording is moved aside, and back on failure."""
    if not target.exists():
        os.rename(new, target)
        return
    aside = scratch / "replaced"
    os.rename(target, aside)
    try:
        os.rename(new, target)
    except OSError:
        os.rename(aside, target)
        raise
