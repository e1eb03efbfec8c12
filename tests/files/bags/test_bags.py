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

"""Reading and writing of recordings: round trips, atomicity, and damaged or foreign files."""

from __future__ import annotations

import array
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

from semcal_ros.core.errors import BagError
from semcal_ros.files.bags.messages import blank_message, jazzy_types, serialize_message
from semcal_ros.files.bags.reader import BagTopic, open_bag
from semcal_ros.files.bags.writer import BagWriter

FLOAT = "std_msgs/msg/Float64"
IMAGE = "sensor_msgs/msg/Image"


def float_message(value: float) -> object:
    message = blank_message(FLOAT)
    message.data = value
    return message


def image_message(stamp_ns: int, pixels: np.ndarray) -> object:
    message = blank_message(IMAGE)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 10**9)
    message.header.frame_id = "sem"
    message.height, message.width = pixels.shape
    message.encoding, message.step = "mono8", pixels.shape[1]
    message.data = pixels.reshape(-1)
    return message


def write_small_bag(path: Path, count: int = 3, *, compress: bool = False) -> Path:
    with BagWriter(path, compress=compress) as writer:
        writer.add_topic("/sem/magnification", FLOAT, latched=True, depth=1)
        writer.write("/sem/magnification", 1_000, float_message(500.0))
        for k in range(count):
            pixels = np.full((4, 6), k, dtype=np.uint8)
            writer.write("/sem/image_raw", 2_000 + k, image_message(10**9 + k, pixels))
    return path


def library_bag(path: Path, plugin: StoragePlugin, mode: CompressionMode) -> Path:
    """A recording made by the bag library alone, in any storage and compression of ROS 2."""
    writer = Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/g", FLOAT, typestore=jazzy_types())
        for k in range(5):
            writer.write(connection, k, serialize_message(float_message(k / 3)))
    return path


def test_round_trip_keeps_topics_times_values_and_latching(tmp_path: Path) -> None:
    with open_bag(write_small_bag(tmp_path / "bag")) as bag:
        assert bag.topics == (
            BagTopic("/sem/image_raw", IMAGE, 3, False),
            BagTopic("/sem/magnification", FLOAT, 1, True),
        )
        assert bag.message_count == 4
        assert bag.start_ns == 1_000
        assert bag.duration_s == pytest.approx(1_002e-9)
        seen = list(bag)
    assert [m.log_time_ns for m in seen] == [1_000, 2_000, 2_001, 2_002]
    assert seen[0].message.data == 500.0
    assert seen[3].message.header.stamp.nanosec == 2
    assert np.array_equal(seen[3].message.data, np.full(24, 2, dtype=np.uint8))


@pytest.mark.parametrize(
    ("plugin", "mode"),
    [
        (StoragePlugin.MCAP, CompressionMode.NONE),
        (StoragePlugin.MCAP, CompressionMode.STORAGE),
        (StoragePlugin.MCAP, CompressionMode.FILE),
        (StoragePlugin.MCAP, CompressionMode.MESSAGE),
        (StoragePlugin.SQLITE3, CompressionMode.NONE),
        (StoragePlugin.SQLITE3, CompressionMode.FILE),
        (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
    ],
)
def test_every_storage_and_compression_is_read(
    tmp_path: Path, plugin: StoragePlugin, mode: CompressionMode
) -> None:
    with open_bag(library_bag(tmp_path / "bag", plugin, mode)) as bag:
        values = [m.message.data for m in bag.messages(["/g"])]
    assert values == [k / 3 for k in range(5)]


@pytest.mark.parametrize("plugin", [StoragePlugin.MCAP, StoragePlugin.SQLITE3])
def test_single_file_and_folder_without_metadata_are_read(
    tmp_path: Path, plugin: StoragePlugin
) -> None:
    folder = library_bag(tmp_path / "bag", plugin, CompressionMode.NONE)
    (folder / "metadata.yaml").unlink()
    (storage,) = folder.iterdir()
    for path in (folder, storage):
        with open_bag(path) as bag:
            assert sum(1 for _ in bag) == 5


def test_time_and_topic_filters(tmp_path: Path) -> None:
    with open_bag(write_small_bag(tmp_path / "bag")) as bag:
        picked = list(bag.raw_messages(["/sem/image_raw"], start_ns=2_001, stop_ns=2_002))
        none = list(bag.messages(["/other"]))
    assert [raw.log_time_ns for raw in picked] == [2_001]
    assert none == []


def test_array_fields_take_every_kind_of_buffer(tmp_path: Path) -> None:
    kinds = [
        b"\x01\x02",
        bytearray(b"\x01\x02"),
        array.array("B", [1, 2]),
        [1, 2],
        np.array([1, 2]),
    ]
    with BagWriter(tmp_path / "bag") as writer:
        for k, data in enumerate(kinds):
            message = image_message(0, np.zeros((1, 2), dtype=np.uint8))
            message.data = data
            writer.write("/i", k, message)
    with open_bag(tmp_path / "bag") as bag:
        assert all(list(m.message.data) == [1, 2] for m in bag)


def test_bytes_of_wider_numbers_are_reinterpreted(tmp_path: Path) -> None:
    values = np.array([1.5, -2.0])
    with BagWriter(tmp_path / "bag") as writer:
        for k, data in enumerate([values.tobytes(), array.array("d", values), values]):
            message = blank_message("std_msgs/msg/Float64MultiArray")
            message.data = data
            writer.write("/p", k, message)
    with open_bag(tmp_path / "bag") as bag:
        assert [list(m.message.data) for m in bag] == [[1.5, -2.0]] * 3


def test_path_that_appears_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="exists"), BagWriter(tmp_path / "bag") as writer:
        writer.write("/g", 1, float_message(1.0))
        (tmp_path / "bag").mkdir()
        (tmp_path / "bag" / "note.txt").write_text("mine")
    assert (tmp_path / "bag" / "note.txt").read_text() == "mine"
    assert [p.name for p in tmp_path.iterdir()] == ["bag"]


def test_blank_message_fills_nested_and_fixed_fields() -> None:
    info = blank_message("sensor_msgs/msg/CameraInfo")
    assert info.k.shape == (9,)
    assert info.k.dtype == np.float64
    assert info.d.size == 0
    assert info.header.frame_id == ""
    assert info.roi.do_rectify is False
    assert blank_message("diagnostic_msgs/msg/DiagnosticStatus").values == []
    with pytest.raises(BagError, match="no_msgs/msg/Nothing"):
        blank_message("no_msgs/msg/Nothing")


def test_error_inside_the_block_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="stop"), BagWriter(tmp_path / "bag") as writer:
        writer.write("/g", 1, float_message(1.0))
        raise RuntimeError("stop")
    assert list(tmp_path.iterdir()) == []


def test_existing_recording_is_refused_kept_on_failure_and_replaced_at_the_end(
    tmp_path: Path,
) -> None:
    path = write_small_bag(tmp_path / "bag", 3)
    before = {p.name: p.read_bytes() for p in path.iterdir()}
    with pytest.raises(BagError, match="exists"), BagWriter(path):
        pass
    with pytest.raises(KeyboardInterrupt), BagWriter(path, overwrite=True) as writer:
        writer.write("/g", 1, float_message(1.0))
        raise KeyboardInterrupt
    assert {p.name: p.read_bytes() for p in path.iterdir()} == before
    with BagWriter(path, overwrite=True) as writer:
        writer.write("/g", 1, float_message(1.0))
        assert {p.name: p.read_bytes() for p in path.iterdir()} == before
    with open_bag(path) as bag:
        assert [t.name for t in bag.topics] == ["/g"]
    assert [p.name for p in tmp_path.iterdir()] == ["bag"]


def test_overwrite_never_deletes_what_is_no_recording(tmp_path: Path) -> None:
    precious = tmp_path / "thesis"
    precious.mkdir()
    (precious / "chapter1.tex").write_text("text")
    file = tmp_path / "file"
    file.write_text("text")
    for path in (precious, file):
        with pytest.raises(BagError, match="not replaced"), BagWriter(path, overwrite=True):
            pass
    assert (precious / "chapter1.tex").read_text() == "text"
    assert file.read_text() == "text"


def test_values_that_do_not_fit_are_refused_and_the_bag_goes_on(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        bad = image_message(0, np.zeros((1, 1), dtype=np.uint8))
        bad.header.stamp.nanosec = -1
        with pytest.raises(BagError, match="cannot be stored"):
            writer.write("/i", 0, bad)
        with pytest.raises(BagError, match="nanoseconds"):
            writer.write("/g", -1, float_message(1.0))
        with pytest.raises(BagError, match="has type"):
            writer.write("/g", 1, image_message(0, np.zeros((1, 1), dtype=np.uint8)))
        writer.write("/g", 1, float_message(1.0))
    with open_bag(tmp_path / "bag") as bag:
        assert [m.message.data for m in bag.messages(["/g"])] == [1.0]


def test_sidecar_is_written_with_the_recording(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/g", 1, float_message(1.0))
        writer.write_text("truth.json", "{}")
        with pytest.raises(BagError, match="sidecar"):
            writer.write_text("../truth.json", "{}")
    assert (tmp_path / "bag" / "truth.json").read_text() == "{}"


def test_types_from_the_recording_are_used_where_jazzy_has_none(tmp_path: Path) -> None:
    definition = "float64 nm_per_px\nstring operator"
    store = Writer(tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP)
    with store as writer:
        connection = writer.add_connection(
            "/px", "lab_msgs/msg/PixelSize", msgdef=definition, rihs01="RIHS01_" + "0" * 64
        )
        text = b"me\x00"
        body = np.array([12.5]).tobytes() + len(text).to_bytes(4, "little") + text
        writer.write(connection, 1, b"\x00\x01\x00\x00" + body)
    with open_bag(tmp_path / "bag") as bag:
        (only,) = list(bag)
    assert only.message.nm_per_px == 12.5
    assert only.message.operator == "me"


def expect_one_line(error: BagError) -> None:
    assert "\n" not in str(error)
    assert len(str(error)) < 700


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("empty.mcap", b""),
        ("empty.db3", b""),
        ("foreign.mcap", b"not a recording at all" * 10),
        ("foreign.db3", b"not a recording at all" * 10),
        ("old.bag", b"#ROSBAG V2.0\n"),
        ("image.png", b"\x89PNG"),
    ],
)
def test_empty_and_foreign_files_are_one_clear_line(
    tmp_path: Path, name: str, content: bytes
) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(BagError) as caught:
        open_bag(path)
    expect_one_line(caught.value)
    assert name in str(caught.value)


def test_missing_path_empty_folder_and_foreign_database(tmp_path: Path) -> None:
    with pytest.raises(BagError, match="does not exist"):
        open_bag(tmp_path / "none")
    with pytest.raises(BagError, match=r"no metadata\.yaml"):
        open_bag(tmp_path)
    database = sqlite3.connect(tmp_path / "other.db3")
    database.execute("CREATE TABLE cats (name TEXT)")
    database.commit()
    database.close()
    with pytest.raises(BagError, match=r"other\.db3"):
        open_bag(tmp_path / "other.db3")


@pytest.mark.parametrize(
    "yaml",
    [
        "",
        "- 1",
        "rosbag2_bagfile_information: 3",
        "a: [",
        "rosbag2_bagfile_information: {version: 99}",
    ],
)
def test_broken_metadata(tmp_path: Path, yaml: str) -> None:
    path = write_small_bag(tmp_path / "bag")
    (path / "metadata.yaml").write_text(yaml)
    with pytest.raises(BagError) as caught:
        open_bag(path)
    expect_one_line(caught.value)


def test_metadata_of_another_recording_is_noticed(tmp_path: Path) -> None:
    path = write_small_bag(tmp_path / "bag")
    text = (path / "metadata.yaml").read_text()
    (path / "metadata.yaml").write_text(text.replace("/sem/image_raw", "/other/image_raw"))
    with open_bag(path) as bag, pytest.raises(BagError, match="holds none"):
        list(bag)


@pytest.mark.parametrize("keep", [0.1, 0.5, 0.9, 0.999])
def test_truncated_recordings(tmp_path: Path, keep: float) -> None:
    path = write_small_bag(tmp_path / "bag", 20)
    storage = path / "bag.mcap"
    data = storage.read_bytes()
    storage.write_bytes(data[: int(len(data) * keep)])
    with pytest.raises(BagError) as caught:
        open_bag(path)
    expect_one_line(caught.value)
    assert "mcap recover" in str(caught.value)


@pytest.fixture(scope="module")
def templates(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    folder = tmp_path_factory.mktemp("templates")
    mcap = write_small_bag(folder / "m", compress=False)
    packed = write_small_bag(folder / "z", compress=True)
    lite = library_bag(folder / "s", StoragePlugin.SQLITE3, CompressionMode.NONE)
    return {
        "a.mcap": (mcap / "m.mcap").read_bytes(),
        "b.mcap": (packed / "z.mcap").read_bytes(),
        "c.db3": (lite / "s.db3").read_bytes(),
    }


@pytest.mark.parametrize("name", ["a.mcap", "b.mcap", "c.db3"])
@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_damaged_bytes_never_raise_anything_but_bag_errors(
    tmp_path: Path, templates: dict[str, bytes], name: str, data: st.DataObject
) -> None:
    blob = bytearray(templates[name])
    for _ in range(data.draw(st.integers(1, 4))):
        blob[data.draw(st.integers(0, len(blob) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path / name
    path.write_bytes(blob[: data.draw(st.integers(len(blob) // 2, len(blob)))])
    try:
        with open_bag(path) as bag:
            for _ in bag:
                pass
    except BagError as error:
        expect_one_line(error)


@pytest.mark.parametrize("name", ["a b", "a#b", "a?b", "a%20b", "\u00fc"])
def test_odd_folder_names_read_the_right_file_or_are_refused(tmp_path: Path, name: str) -> None:
    # The library turns names of sqlite3 files into URIs, so that a%20b would open the file of a b.
    plain = library_bag(tmp_path / "a b", StoragePlugin.SQLITE3, CompressionMode.NONE)
    if name != "a b":
        # Copied, since the library's writer has the same trouble with these names.
        shutil.copytree(plain, tmp_path / name)
    if set(name) & set("?#%"):
        with pytest.raises(BagError, match="character"):
            open_bag(tmp_path / name)
    else:
        with open_bag(tmp_path / name) as bag:
            assert bag.message_count == 5
    with open_bag(write_small_bag(tmp_path / f"{name}.mcap folder")) as bag:
        assert bag.message_count == 4


def test_moved_recording_is_still_read(tmp_path: Path) -> None:
    write_small_bag(tmp_path / "bag")
    shutil.move(tmp_path / "bag", tmp_path / "renamed")
    with open_bag(tmp_path / "renamed") as bag:
        assert bag.message_count == 4
