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

"""Read ROS 2 recordings (rosbag2) without ROS.

Both storage formats (mcap, sqlite3), compressed or not, as a folder with ``metadata.yaml`` or as a
single file. What the bag library and its backends raise on damaged or foreign files becomes one error.

``AnyReader`` of rosbags would choose the message types too. But it registers the definitions of all
topics when it opens a recording, so that a damaged definition on an unused topic would make the
recording unreadable, and it generates code for arrays of any fixed length before they can be refused.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple

import apsw
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinitionFormat,
    Nodetype,
    QosDurability,
)
from rosbags.rosbag2 import Reader, ReaderError, WriterError
from rosbags.serde import SerdeError
from rosbags.typesys import (
    Stores,
    TypesysError,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)
from rosbags.typesys.store import Typestore
from ruamel.yaml.error import YAMLError

from semcal_ros.config.config import COMPRESSED_IMAGE_TYPE, IMAGE_TYPE, ImageConfig
from semcal_ros.core.errors import BagError, CalibrationFileError
from semcal_ros.core.wording import counted
from semcal_ros.files.bags.messages import jazzy_types
from semcal_ros.files.plain_yaml import check_plain_yaml
from semcal_ros.text_files import name_similar_file, read_text_file

if TYPE_CHECKING:
    from typing_extensions import Self


STORAGE_SUFFIXES = (".mcap", ".db3")
_ACCEPTED = "a rosbag2 folder with metadata.yaml, or one .mcap or .db3 file"
# One file with three topics takes 1.4 kB.
_MAX_METADATA = 16 * 1024 * 1024
# The library writes and compiles code for each element of such an array: this bounds the time and
# the memory that a recording's definition can ask for.
_MAX_UNROLLED = 1000
_IDL_RULE = "=" * 80 + "\n"

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

_MAX_LISTED = 8  # topics in one line of an error


@dataclass(frozen=True)
class BagTopic:
    """One topic of a recording.

    Parameters
    ----------
    name
        Absolute topic name as recorded, such as ``/sem/image_raw``.
    type
        Message type such as ``sensor_msgs/msg/Image``.
    count
        Number of messages that the recording declares.
    latched
        Whether the recorded publisher offered transient-local durability.
    """

    name: str
    type: str
    count: int
    latched: bool = False


class RawMessage(NamedTuple):
    """One message as stored: CDR bytes, and when the recorder received it (ns since 1970)."""

    topic: str
    type: str
    log_time_ns: int
    data: bytes


class BagMessage(NamedTuple):
    """One decoded message, and when the recorder received it (ns since 1970)."""

    topic: str
    log_time_ns: int
    message: Any


def is_bag(path: Path) -> bool:
    """Return whether ``path`` looks like a recording: a folder with bag files or a single storage file."""
    if path.is_dir():
        return (path / "metadata.yaml").exists() or bool(_storage_files(path))
    return path.suffix in STORAGE_SUFFIXES


def _storage_files(folder: Path) -> list[Path]:
    return sorted(p for p in folder.iterdir() if p.suffix in STORAGE_SUFFIXES and p.is_file())


def _locate(path: Path) -> Path:
    """Return the path that the library opens for ``path``."""
    if not path.exists():
        raise BagError(
            f"{path} does not exist",
            expected=_ACCEPTED,
            do=name_similar_file(path) or "check the path",
        )
    if not path.is_dir():
        if path.suffix not in STORAGE_SUFFIXES:
            raise BagError(
                f"{path} does not have the name of a ROS 2 recording",
                expected=_ACCEPTED,
                do="convert a ROS 1 .bag with rosbags-convert; name the folder of a compressed one",
            )
        return _checked_name(path, [path])
    files = _storage_files(path)
    metadata = path / "metadata.yaml"
    if metadata.exists():
        text = read_text_file(
            metadata, _MAX_METADATA, error=BagError, expected="metadata as a recorder writes them"
        )
        try:
            check_plain_yaml(text, str(metadata))
        except CalibrationFileError as error:
            raise BagError(error.seen, expected="metadata as a recorder writes them") from error
        return _checked_name(path, files)
    if len(files) == 1:
        return _checked_name(files[0], files)
    raise BagError(
        f"folder {path} has no metadata.yaml and {len(files)} .mcap or .db3 files",
        expected=_ACCEPTED,
        do="name the right folder, or make the missing file with 'ros2 bag reindex'",
    )


def _checked_name(path: Path, files: list[Path]) -> Path:
    """Return ``path`` unless the library would misread it: it opens sqlite3 files by URI."""
    odd = [character for character in "?#%" if character in str(path)]
    if odd and any(file.suffix == ".db3" for file in files):
        raise BagError(
            f"the path {path} of a sqlite3 recording has the character {odd[0]}",
            expected="a path without ? # %",
            do="rename the folder or move the recording",
        )
    return path


class BagReader:
    """An open recording; use :func:`open_bag`, and close it or use it as a context manager.

    Attributes
    ----------
    path
        What was opened.
    topics
        Topics in the order of their names.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with reading(path):
            self._reader = Reader(_locate(path))
            self._reader.open()
            try:
                check_types(self._reader)
                self._connections = list(self._reader.connections)
                self.topics: tuple[BagTopic, ...] = _topic_table(self._connections)
                self._start_ns = int(self._reader.start_time)
                self._end_ns = int(self._reader.end_time)
                self.message_count = int(self._reader.message_count)
            except BaseException:
                self._reader.close()
                raise
        self._stores: dict[str, Typestore] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; calling it again does nothing."""
        if self._reader.is_open:
            with reading(self.path):
                self._reader.close()

    @property
    def start_ns(self) -> int:
        """Receive time of the first message in ns, 0 if there is none."""
        return self._start_ns if self.message_count else 0

    @property
    def duration_s(self) -> float:
        """Seconds from the first to the last message."""
        # The library counts one nanosecond past the last message.
        return max(0, self._end_ns - self._start_ns - 1) * 1e-9 if self.message_count else 0.0

    def raw_messages(
        self,
        topics: Iterable[str] | None = None,
        *,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[RawMessage]:
        """Yield undecoded messages in the order of their receive times; they are read on demand.

        Parameters
        ----------
        topics
            Names of topics to read; by default all.
        start_ns, stop_ns
            Half-open interval of receive times.

        Raises
        ------
        BagError
            The file is damaged, or declares messages on a topic and holds none.
        """
        wanted = None if topics is None else set(topics)
        chosen = [c for c in self._connections if wanted is None or c.topic in wanted]
        if not chosen:
            return
        seen: dict[str, int] = {}
        source = self._guarded(chosen, start_ns, stop_ns)
        for connection, log_time_ns, data in source:
            seen[connection.topic] = seen.get(connection.topic, 0) + 1
            yield RawMessage(connection.topic, connection.msgtype, log_time_ns, data)
        if start_ns is None and stop_ns is None:
            self._check_delivered(chosen, seen)

    def _guarded(
        self, chosen: list[Connection], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[Connection, int, bytes]]:
        with reading(self.path):
            source = iter(self._reader.messages(chosen, start_ns, stop_ns))
        while True:
            try:
                item = next(source)
            except StopIteration:
                return
            except LIBRARY_ERRORS as error:
                raise unreadable(self.path, error) from error
            if not (isinstance(item[1], int) and isinstance(item[2], bytes)):
                raise BagError(
                    f"a message on {item[0].topic} in {self.path} of type {type(item[2]).__name__} "
                    f"at a time of type {type(item[1]).__name__}",
                    expected="bytes and whole nanoseconds",
                    do="copy the recording again",
                )
            yield item

    def _check_delivered(self, chosen: list[Connection], seen: dict[str, int]) -> None:
        for topic in _topic_table(chosen):
            if topic.count and not seen.get(topic.name):
                raise BagError(
                    f"{self.path} declares {counted(topic.count, 'message')} on {topic.name} and holds none",
                    expected="metadata.yaml that describes the files beside it",
                    do="make it again with 'ros2 bag reindex'",
                )

    def messages(
        self,
        topics: Iterable[str] | None = None,
        *,
        start_ns: int | None = None,
        stop_ns: int | None = None,
    ) -> Iterator[BagMessage]:
        """Yield decoded messages; see :meth:`raw_messages` and :meth:`decode`."""
        for raw in self.raw_messages(topics, start_ns=start_ns, stop_ns=stop_ns):
            yield BagMessage(raw.topic, raw.log_time_ns, self.decode(raw))

    def __iter__(self) -> Iterator[BagMessage]:
        return self.messages()

    def decode(self, raw: RawMessage) -> Any:
        """Decode a message: its fields become attributes, its arrays read-only NumPy arrays.

        Raises
        ------
        BagError
            The bytes do not fit the type, or the type is neither known nor described in the recording.
        """
        store = self._store_for(raw)
        try:
            return store.deserialize_cdr(raw.data, raw.type)
        except LIBRARY_ERRORS as error:
            raise BagError(
                f"a message on {raw.topic} in {self.path} cannot be decoded: {one_line(error)}",
                expected=f"an intact {raw.type}",
            ) from error

    def _store_for(self, raw: RawMessage) -> Typestore:
        if raw.type not in self._stores:
            connection = next(
                c for c in self._connections if c.topic == raw.topic and c.msgtype == raw.type
            )
            with reading(self.path, f"the definition of {raw.type}"):
                self._stores[raw.type] = _find_typestore(connection, self.path)
        return self._stores[raw.type]


def _topic_table(connections: Iterable[Connection]) -> tuple[BagTopic, ...]:
    counts: dict[tuple[str, str], int] = {}
    latched: dict[tuple[str, str], bool] = {}
    for connection in connections:
        key = (connection.topic, connection.msgtype)
        counts[key] = counts.get(key, 0) + int(connection.msgcount)
        latched[key] = latched.get(key, False) or _is_latched(connection)
    return tuple(BagTopic(*key, counts[key], latched[key]) for key in sorted(counts))


def _is_latched(connection: Connection) -> bool:
    if not isinstance(connection.ext, ConnectionExtRosbag2):
        return False
    profiles = connection.ext.offered_qos_profiles
    return any(profile.durability == QosDurability.TRANSIENT_LOCAL for profile in profiles)


def _find_typestore(connection: Connection, path: Path) -> Typestore:
    """Find the types to decode a topic with: the recording's own where they differ from Jazzy's."""
    encoding = getattr(connection.ext, "serialization_format", "cdr")
    if encoding != "cdr":
        raise BagError(
            f"messages on {connection.topic} in {path} are {str(encoding)[:40]!r}", expected="'cdr'"
        )
    jazzy = jazzy_types()
    known = connection.msgtype in jazzy.fielddefs
    if known and connection.digest and connection.digest == jazzy.hash_rihs01(connection.msgtype):
        return jazzy
    defined = _defined_types(connection)
    _check_arrays(defined, f"{connection.msgtype} on {connection.topic} in {path}")
    if not defined:
        if known:
            return jazzy
        raise BagError(
            f"message type {connection.msgtype} on {connection.topic} in {path}",
            expected="a common ROS 2 type, or its definition inside the recording",
            do="record with mcap, which stores definitions",
        )
    if all(
        name in jazzy.fielddefs and jazzy.fielddefs[name][1] == defined[name][1] for name in defined
    ):
        return jazzy
    store = get_typestore(Stores.EMPTY)
    store.register(defined)
    return store


def _defined_types(connection: Connection) -> dict[str, Any]:
    text = connection.msgdef.data
    if connection.msgdef.format == MessageDefinitionFormat.MSG:
        return dict(get_types_from_msg(text, connection.msgtype))
    if connection.msgdef.format == MessageDefinitionFormat.IDL:
        types: dict[str, Any] = {}
        parts = text.split(_IDL_RULE)[1:] if text.startswith(_IDL_RULE) else [text]
        for part in parts:
            types.update(
                get_types_from_idl(part.split("\n", 1)[1] if part.startswith("IDL: ") else part)
            )
        return types
    return {}


def _check_arrays(types: dict[str, Any], what: str) -> None:
    """Refuse arrays of texts or messages of a large fixed length: the library writes code for each element."""
    for _, fields in types.values():
        for name, (kind, detail) in fields:
            if kind != Nodetype.ARRAY:
                continue
            (inner_kind, inner), length = detail
            if length > _MAX_UNROLLED and (inner_kind != Nodetype.BASE or "string" in inner[0]):
                raise BagError(
                    f"{length} elements in field {name} of {what}",
                    expected=f"at most {_MAX_UNROLLED} texts or messages in an array of fixed length",
                )


def open_bag(path: str | Path) -> BagReader:
    """Open a recording for reading.

    Parameters
    ----------
    path
        A rosbag2 folder, or a single ``.mcap`` or ``.db3`` file. A folder without
        ``metadata.yaml`` is accepted if it holds exactly one storage file.

    Raises
    ------
    BagError
        The recording is missing, empty, truncated, or not a ROS 2 recording.
    """
    return BagReader(Path(path))


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


def topic_matches(wanted: str, recorded: str) -> bool:
    """Return whether a recorded topic is the wanted one: relative names match by their last parts."""
    if wanted.startswith("/"):
        return recorded == wanted
    return recorded == wanted or recorded.endswith("/" + wanted)


def _list_topics(topics: Sequence[BagTopic]) -> str:
    shown = [f"{t.name} ({t.type}, {t.count})" for t in topics[:_MAX_LISTED]]
    more = len(topics) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "") if shown else "no topics"


def find_topic(
    path: Path, topics: Sequence[BagTopic], *, what: str, wanted: str, type_name: str
) -> tuple[BagTopic, str]:
    """Find the topic to read; also return a note, empty if the topic has the configured name.

    Parameters
    ----------
    topics
        All topics of the recording.
    what
        What the topic carries, for messages to the user.
    wanted, type_name
        Name and message type from the configuration.

    Raises
    ------
    BagError
        No topic fits, several do, or the topic has another type.
    """
    named = [t for t in topics if topic_matches(wanted, t.name)]
    fitting = [t for t in named if t.type == type_name]
    if len(fitting) == 1:
        return fitting[0], ""
    if named and not fitting:
        raise BagError(
            f"topic {named[0].name} in {path} has type {named[0].type}",
            expected=f"{type_name} for the {what}",
            do="set topic and type in the msg_configs file and name it with --config",
        )
    candidates = fitting or [t for t in topics if t.type == type_name and t.count > 0]
    if len(candidates) == 1:
        return candidates[
            0
        ], f"the {what} is read from {candidates[0].name}: there is no topic {wanted}"
    seen = _list_topics(candidates) if candidates else _list_topics(topics)
    problem = "several topics could be" if candidates else "no topic is"
    raise BagError(
        f"in {path} {problem} the {what}; the topics are {seen}",
        expected=f"one topic {wanted} of type {type_name}",
        do="name the topic in a msg_configs file and pass it with --config",
    )


# Images that are matrices, and no pictures (doc/nodes.md).
_MATRICES = ("projection_stamped", "projection_covariance_stamped")

# What image_transport appends to the name of a topic for its compressed images.
_SUFFIX = "/compressed"


def find_image_topic(
    path: Path, topics: Sequence[BagTopic], image: ImageConfig
) -> tuple[BagTopic, list[str]]:
    """Find the topic of images to read; also return notes. ``projection_stamped`` is not one unless it is configured.

    A recorder often takes only one of ``image_raw`` and ``image_raw/compressed``, which show the same; if that is not
    the configured one, the other is read, with a note.

    Raises
    ------
    BagError
        As :func:`~semcal_ros.files.bags.reader.find_topic`.
    """
    for matrix in _MATRICES:
        if not topic_matches(matrix, image.topic):
            topics = [topic for topic in topics if not topic_matches(matrix, topic.name)]
    wanted, type_name = _source(image, [topic for topic in topics if topic.count])
    found, note = find_topic(path, topics, what="image", wanted=wanted, type_name=type_name)
    notes = [note] if note else []
    if type_name != image.type:
        notes.append(f"the images on {found.name} are {type_name}, not {image.type}")
    return found, notes


def _source(image: ImageConfig, filled: Sequence[BagTopic]) -> tuple[str, str]:
    """Return the name and type to search for."""
    other_name, other_type = f"{image.topic}{_SUFFIX}", COMPRESSED_IMAGE_TYPE
    if image.type == COMPRESSED_IMAGE_TYPE:
        other_name, other_type = image.topic.removesuffix(_SUFFIX), IMAGE_TYPE
    for source in (
        (image.topic, image.type),
        (other_name, other_type),
        (image.topic, other_type),
    ):
        if any((t.type, topic_matches(source[0], t.name)) == (source[1], True) for t in filled):
            return source
    types = {topic.type for topic in filled}
    only_other = other_type in types and image.type not in types
    return image.topic, other_type if only_other else image.type
