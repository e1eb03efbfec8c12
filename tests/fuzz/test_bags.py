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

"""Recordings: whatever the files hold, messages of the declared types or one clear line."""

from __future__ import annotations

import contextlib
import json
import shutil
import sqlite3
import struct
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import lz4.frame
import numpy as np
import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from semcal_ros.bridge.images import fill_image
from semcal_ros.core.errors import BagError, SemcalError
from semcal_ros.files.bags.messages import blank_message, jazzy_types, serialize_message
from semcal_ros.files.bags.reader import BagReader, RawMessage, open_bag
from semcal_ros.files.recordings import open_recording
from tests.helpers.fuzz_inputs import (
    YAML_PIECES,
    alias_bombs,
    changed,
    damaged,
    edited_text,
    edited_tree,
    odd_leaves,
)
from tests.helpers.fuzz_support import attempt, check_refusal, fuzz, run_semcal

IMAGE, FLOAT, STRING = "sensor_msgs/msg/Image", "std_msgs/msg/Float64", "std_msgs/msg/String"
_TOPICS = {FLOAT: "/sem/magnification", IMAGE: "/sem/image_raw", STRING: "/sem/calibration"}


def _message(kind: str, index: int) -> Any:
    message = blank_message(kind)
    if kind == IMAGE:
        header = blank_message("std_msgs/msg/Header")
        header.stamp.sec, header.frame_id = 1_700_000_000 + index, "sem"
        fill_image(message, np.full((4, 6), index, np.uint8), "mono8", header)
    else:
        message.data = 500.0 + index if kind == FLOAT else "format: none"
    return message


def _payload(kind: str, index: int) -> bytes:
    return bytes(serialize_message(_message(kind, index)))


def _written(folder: Path, plugin: StoragePlugin, mode: CompressionMode) -> Path:
    path = folder / f"{plugin.name}_{mode.name}".lower()
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        for kind, topic in _TOPICS.items():
            connection = writer.add_connection(topic, kind, typestore=jazzy_types())
            for index in range(2):
                writer.write(connection, 1_000 + index, _payload(kind, index))
    return path


@lru_cache(maxsize=1)
def _templates() -> dict[str, dict[str, bytes]]:
    """Files of recordings in every storage and compression, by the kind of recording."""
    found = {}
    with TemporaryDirectory() as name:
        for plugin in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
            for mode in (CompressionMode.NONE, CompressionMode.STORAGE, CompressionMode.MESSAGE):
                if (plugin, mode) == (StoragePlugin.SQLITE3, CompressionMode.STORAGE):
                    continue
                path = _written(Path(name), plugin, mode)
                found[path.name] = {p.name: p.read_bytes() for p in path.iterdir()}
    return found


def _storage(kind: str) -> tuple[str, bytes]:
    return next((n, d) for n, d in _templates()[kind].items() if n != "metadata.yaml")


def _put(folder: Path, files: dict[str, bytes]) -> Path:
    path = folder / "bag"
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir()
    for name, data in files.items():
        (path / name).write_bytes(data)
    return path


def _check_fields(message: Any) -> None:
    for value in vars(message).values():
        if isinstance(value, np.ndarray):
            assert not value.flags.writeable or value.size == 0
        elif hasattr(value, "__msgtype__"):
            _check_fields(value)


def _decode(bag: BagReader, raw: RawMessage) -> None:
    with _refusing():
        message = bag.decode(raw)
        assert message.__msgtype__.replace("__", "/") == raw.type
        _check_fields(message)


@contextlib.contextmanager
def _refusing() -> Iterator[None]:
    """One message may be refused where others are fine."""
    try:
        yield
    except SemcalError as error:
        check_refusal(error)


def _read(path: Path) -> int:
    """Everything that a recording has."""
    with open_bag(path) as bag:
        assert all(isinstance(t.name, str) and isinstance(t.type, str) for t in bag.topics)
        assert all(isinstance(t.count, int) for t in bag.topics)
        assert isinstance(bag.start_ns, int)
        assert bag.duration_s >= 0.0
        count = 0
        for raw in bag.raw_messages():
            assert isinstance(raw.log_time_ns, int)
            _decode(bag, raw)
            count += 1
    return count + 1


def test_the_valid_recordings_are_accepted(folder: Path) -> None:
    for files in _templates().values():
        path = _put(folder, files)
        assert attempt(lambda path=path: _read(path)) == 7
    assert attempt(lambda: _read(_file(folder, _mcap(_records())))) == 7


@fuzz(0.7)
@given(kind=st.sampled_from(sorted(_templates())), data=st.data())
def test_damaged_storage(folder: Path, kind: str, data: st.DataObject) -> None:
    name, whole = _storage(kind)
    others = [_storage(other)[1] for other in sorted(_templates()) if other[:3] == kind[:3]]
    files = dict(_templates()[kind])
    files[name] = data.draw(damaged([whole, *others]))
    if data.draw(st.booleans()):
        del files["metadata.yaml"]
    path = _put(folder, files)
    attempt(lambda: _read(path))


_METADATA = _templates()["mcap_none"]["metadata.yaml"].decode()
_METADATA_LITE = _templates()["sqlite3_message"]["metadata.yaml"].decode()


def _with_metadata(folder: Path, kind: str, text: str) -> Path:
    data = text.encode("utf-8", errors="surrogatepass")
    return _put(folder, {**_templates()[kind], "metadata.yaml": data})


@fuzz(0.7)
@given(text=edited_text([_METADATA], YAML_PIECES))
@example(text="&a " + changed(_METADATA, "duration:\n", "duration: &a\n"))
@example(text=changed(_METADATA, "/sem/image_raw", "/" + "x" * 3000))
@example(text=changed(_METADATA, "  files:\n", "  files: ''\n  other:\n"))
@example(text=changed(_METADATA, "nanoseconds_since_epoch: 1000", "nanoseconds_since_epoch: .nan"))
def test_edited_metadata(folder: Path, text: str) -> None:
    path = _with_metadata(folder, "mcap_none", text)
    attempt(lambda: _read(path))


@fuzz(0.3)
@given(text=alias_bombs(_METADATA.replace("version: 9", "version: {}")))
def test_metadata_that_stands_for_much_more(folder: Path, text: str) -> None:
    path = _with_metadata(folder, "mcap_none", text)
    attempt(lambda: _read(path))


@fuzz(0.5)
@given(
    tree=edited_tree([json.dumps(yaml.safe_load(text)) for text in (_METADATA, _METADATA_LITE)]),
    kind=st.sampled_from(["mcap_none", "sqlite3_none", "sqlite3_message"]),
)
def test_edited_values_of_the_metadata(folder: Path, tree: Any, kind: str) -> None:
    path = _with_metadata(folder, kind, yaml.dump(tree))
    attempt(lambda: _read(path))


def _text(value: str) -> bytes:
    data = value.encode("utf-8", errors="surrogatepass")
    return struct.pack("<I", len(data)) + data


_DEFINITIONS = {
    IMAGE: "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
    "uint8 is_bigendian\nuint32 step\nuint8[] data\n"
    + "=" * 80
    + "\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
    + "=" * 80
    + "\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n",
    FLOAT: "float64 data\n",
    STRING: "string data\n",
}
_QOS = yaml.dump(
    [
        {
            "history": "keep_last",
            "depth": 1,
            "reliability": "reliable",
            "durability": "transient_local",
            "liveliness": "automatic",
            "deadline": {"sec": 0, "nsec": 0},
            "lifespan": {"sec": 0, "nsec": 0},
            "liveliness_lease_duration": {"sec": 0, "nsec": 0},
            "avoid_ros_namespace_conventions": False,
        }
    ]
)
Record = tuple[int, bytes]


def _records(definitions: dict[str, str] = _DEFINITIONS, qos: str = _QOS) -> list[Record]:
    """Schemas, channels and messages of an MCAP file (https://mcap.dev/spec), one after the other."""
    found: list[Record] = []
    messages: list[Record] = []
    for number, (kind, topic) in enumerate(_TOPICS.items(), start=1):
        schema = struct.pack("<H", number) + _text(kind) + _text("ros2msg")
        found.append((0x03, schema + _text(definitions[kind])))
        metadata = _text("offered_qos_profiles") + _text(qos)
        channel = struct.pack("<HH", number, number) + _text(topic) + _text("cdr")
        found.append((0x04, channel + struct.pack("<I", len(metadata)) + metadata))
        for index in range(2):
            time = 1_000 + len(messages)
            head = struct.pack("<HIQQ", number, index, time, time)
            messages.append((0x05, head + _payload(kind, index)))
    return found + messages


def _joined(records: Sequence[Record]) -> bytes:
    return b"".join(struct.pack("<BQ", op, len(data)) + data for op, data in records)


def _mcap(records: Sequence[Record]) -> bytes:
    """An MCAP file without an index."""
    magic = b"\x89MCAP0\r\n"
    header, end = (0x01, _text("ros2") + _text("")), (0x0F, struct.pack("<I", 0))
    footer = (0x02, struct.pack("<QQI", 0, 0, 0))
    return magic + _joined([header, *records, end, footer]) + magic


def _file(folder: Path, data: bytes) -> Path:
    path = folder / "one.mcap"
    path.write_bytes(data)
    return path


_PACKERS = {"": bytes, "lz4": lz4.frame.compress, "zstd": bytes, "lzma": bytes}


@st.composite
def _odd_mcaps(draw: st.DrawFn) -> bytes:
    """Whole records changed, doubled, dropped, exchanged, or packed into chunks that tell wrong sizes."""
    records = _records()
    for _ in range(draw(st.integers(1, 4))):
        index = draw(st.integers(0, len(records) - 1))
        op, data = records[index]
        how = draw(st.sampled_from(["damage", "damage", "double", "drop", "move", "op", "chunk"]))
        if how == "damage":
            records[index] = op, draw(damaged([data]))
        elif how == "double":
            records.insert(draw(st.integers(0, len(records))), records[index])
        elif how == "drop" and len(records) > 1:
            del records[index]
        elif how == "move":
            records.insert(draw(st.integers(0, len(records) - 1)), records.pop(index))
        elif how == "op":
            records[index] = draw(st.integers(0, 0x10) | st.sampled_from([0x80, 0xFF])), data
        elif how == "chunk":
            name = draw(st.sampled_from(sorted(_PACKERS)))
            inner = _joined(records[index:])
            packed = _PACKERS[name](inner)
            sizes = st.sampled_from([len(inner), len(inner), 0, 1, 2**32, 2**63, 2**64 - 1])
            head = struct.pack("<QQQI", 0, 2_000, draw(sizes), draw(st.sampled_from([0, 0, 1])))
            length = draw(st.sampled_from([len(packed), len(packed), 0, 2**40, 2**64 - 1]))
            chunk = head + _text(name) + struct.pack("<Q", length) + packed
            records[index:] = [(0x06, chunk)]
    return _mcap(records)


@fuzz(0.7)
@given(data=_odd_mcaps())
def test_odd_records(folder: Path, data: bytes) -> None:
    path = _file(folder, data)
    attempt(lambda: _read(path))


_DEFINITION_PIECES = [
    *(
        "float64 x\n",
        "string x\n",
        "string[3] x\n",
        "uint8[] x\n",
        "bool[<=2] x\n",
        "string<=3 x\n",
    ),
    *(
        "std_msgs/Header[2] x\n",
        "std_msgs/Header[] x\n",
        "Header x\n",
        "Image[] x\n",
        "int32 A=1\n",
    ),
    *("uint8[4000000000] x\n", "string[4000000000] x\n", "std_msgs/Header[4000000000] x\n"),
    *("string[9999] x\n", "float64[0] x\n", "wstring x\n", "char x\n", "byte x\n", "int32 x 5\n"),
    *("no_msgs/Nothing x\n", "sensor_msgs/Image x\n", "float64 import\n", "float64 __class__\n"),
    *(
        "[]",
        "[3]",
        "[-1]",
        "[<=]",
        "64",
        "#",
        "=",
        "=" * 80 + "\n",
        "MSG: a/B\n",
        "\t",
        "\r",
        "\u0665",
    ),
    *(
        "string ",
        "float64 ",
        "uint64 ",
        "int64 ",
        "float32[] ",
        "a_b ",
        "A",
        "'",
        '"',
        "\\",
        "\x00",
    ),
    "a" * 2000,
]


@fuzz(0.5)
@given(
    kind=st.sampled_from(sorted(_TOPICS)),
    data=st.data(),
    qos=st.just(_QOS) | edited_text([_QOS], [p for p in YAML_PIECES if "&" not in p]),
)
def test_definitions_of_the_recording(
    folder: Path, kind: str, data: st.DataObject, qos: str
) -> None:
    """A recording that defines the known types in another way, read as a person's command would."""
    definition = data.draw(edited_text([_DEFINITIONS[kind]], _DEFINITION_PIECES))
    path = _file(folder, _mcap(_records({**_DEFINITIONS, kind: definition}, qos)))

    def read() -> int:
        count = _read(path)
        with _refusing(), open_recording(path) as recording:
            for frame in recording.frames():
                assert frame.image.ndim in (2, 3)
                assert frame.magnification > 0.0
        return count

    attempt(read)


def _described(definition: str) -> bytes:
    return _mcap(_records({**_DEFINITIONS, FLOAT: definition}))


def test_a_header_of_another_kind(folder: Path) -> None:
    definition = changed(_DEFINITIONS[IMAGE], "string frame_id", "string other")
    path = _file(folder, _mcap(_records({**_DEFINITIONS, IMAGE: definition})))
    with open_recording(path) as recording, pytest.raises(BagError, match="frame_id"):
        list(recording.frames())


@pytest.mark.parametrize(
    "definition",
    ["string[4000000000] x\n", "std_msgs/Header[4000000000] x\n"],
    ids=["texts", "messages"],
)
def test_a_definition_of_an_enormous_array(folder: Path, definition: str) -> None:
    path = _file(folder, _described(definition))
    attempt(lambda: _read(path))


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BagReader]:
    path = tmp_path_factory.mktemp("intact") / "intact.mcap"
    path.write_bytes(_mcap(_records()))
    with open_bag(path) as bag:
        yield bag


@fuzz(3.0)
@given(kind=st.sampled_from(sorted(_TOPICS)), body=damaged([_payload(kind, 1) for kind in _TOPICS]))
@example(kind=STRING, body=b"\x00\x01\x00\x00\xff\xff\xff\xff")
def test_damaged_messages(intact: BagReader, kind: str, body: bytes) -> None:
    """Bytes of one message in an intact recording."""

    def decode() -> bool:
        _check_fields(intact.decode(RawMessage(_TOPICS[kind], kind, 0, body)))
        return True

    attempt(decode)


_TABLES = {
    "topics": ["id", "name", "type", "serialization_format", "offered_qos_profiles"],
    "messages": ["id", "topic_id", "timestamp", "data"],
    "schema": ["schema_version", "ros_distro"],
    "metadata": ["metadata_version", "metadata"],
    "message_definitions": ["topic_type", "encoding", "encoded_message_definition"],
}
_SQL_VALUES = st.one_of(
    odd_leaves.filter(lambda v: isinstance(v, (float, str, bytes, type(None)))),
    st.integers(-(2**63), 2**63 - 1),
    st.sampled_from([*_TOPICS, *_TOPICS.values(), 0, 1, 4, _QOS, "ros2msg", "ros2idl", "cdr"]),
    st.binary(max_size=30),
    edited_text([_DEFINITIONS[IMAGE]], _DEFINITION_PIECES),
    edited_text([_QOS], [piece for piece in YAML_PIECES if "&" not in piece]),
)


@st.composite
def _statements(draw: st.DrawFn) -> list[tuple[str, tuple[Any, ...]]]:
    """SQL that leaves a readable database with something wrong in it."""
    found: list[tuple[str, tuple[Any, ...]]] = []
    for _ in range(draw(st.integers(1, 3))):
        table = draw(st.sampled_from(sorted(_TABLES)))
        column = draw(st.sampled_from(_TABLES[table]))
        how = draw(st.integers(0, 9))
        if how < 6:
            which = draw(st.sampled_from(["", " WHERE rowid = 1", " WHERE rowid = 2"]))
            value = draw(_SQL_VALUES)
            found.append((f"UPDATE OR IGNORE {table} SET {column} = ?{which}", (value,)))
        elif how == 6:
            found.append((f"DELETE FROM {table} WHERE rowid > {draw(st.integers(0, 2))}", ()))
        elif how == 7:
            found.append((f"DROP TABLE {table}", ()))
        elif how == 8:
            found.append((f"ALTER TABLE {table} RENAME COLUMN {column} TO other", ()))
        else:
            found.append((f"INSERT INTO {table} SELECT * FROM {table}", ()))
    return found


@fuzz(0.7)
@given(statements=_statements(), kind=st.sampled_from(["sqlite3_none", "sqlite3_message"]))
@example(
    statements=[("UPDATE messages SET timestamp = 'x' WHERE rowid = 1", ())], kind="sqlite3_none"
)
@example(statements=[("UPDATE topics SET name = x'00'", ())], kind="sqlite3_none")
@example(
    statements=[("UPDATE topics SET serialization_format = ?", ("x" * 5000,))], kind="sqlite3_none"
)
@example(statements=[("UPDATE topics SET serialization_format = 1.5", ())], kind="sqlite3_none")
def test_odd_databases(
    folder: Path, statements: list[tuple[str, tuple[Any, ...]]], kind: str
) -> None:
    _name, data = _storage(kind)
    path = folder / "one.db3"
    path.write_bytes(data)
    database = sqlite3.connect(path, isolation_level=None)
    database.execute("PRAGMA synchronous = OFF")
    database.execute("PRAGMA journal_mode = MEMORY")
    for statement, values in statements:
        with contextlib.suppress(sqlite3.Error, UnicodeError):
            database.execute(statement, values)
    database.close()
    attempt(lambda: _read(path))


@fuzz(0.3)
@given(data=damaged([_mcap(_records())]) | _odd_mcaps())
def test_the_command_line(folder: Path, capfd: pytest.CaptureFixture[str], data: bytes) -> None:
    path = _file(folder, data)
    attempt(lambda: run_semcal(capfd, "info", path))


def test_what_is_no_recording(folder: Path) -> None:
    for name in ("x.mcap", "x.db3", "x.bag"):
        path = folder / name
        path.write_bytes(b"\x00" * 100)
        with pytest.raises(BagError):
            open_bag(path)
