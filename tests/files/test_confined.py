"""Paths that lead elsewhere, files that are none, and YAML that bites."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from semcal_ros.core.errors import CalibrationFileError, InvalidValueError
from semcal_ros.files.atomic import atomic_write_bytes
from semcal_ros.files.confined import AllowedPaths, check_plain_yaml, read_plain_text


def test_only_what_really_lies_inside_is_allowed(tmp_path: Path) -> None:
    inside = tmp_path / "inside"
    (inside / "deep").mkdir(parents=True)
    (tmp_path / "inside2").mkdir()
    (inside / "door").symlink_to(tmp_path)
    (tmp_path / "way_in").symlink_to(inside)
    allowed = AllowedPaths(str(inside))
    for good in (inside / "a", inside / "deep" / ".." / "a", tmp_path / "way_in" / "a"):
        assert allowed.resolve(str(good)) == inside / "a"
    for bad in (
        inside / ".." / "a",
        inside / "door" / "a",
        inside / "deep" / ".." / ".." / "inside2" / "a",
        tmp_path / "inside2" / "a",
        "a",
        "",
        "nul\0byte",
    ):
        with pytest.raises(InvalidValueError):
            allowed.resolve(str(bad))


def test_the_start_is_trusted_with_its_file_and_its_folder(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    start = tmp_path / "start.yaml"
    by_folder = AllowedPaths("", [str(start)])
    assert by_folder.resolve(str(tmp_path / "other" / "a")) == tmp_path / "other" / "a"
    # A directory of its own takes the place of that folder, not of the file.
    by_directory = AllowedPaths(str(tmp_path / "other"), [str(start)])
    assert by_directory.resolve(str(start)) == start
    with pytest.raises(InvalidValueError, match="inside of"):
        by_directory.resolve(str(tmp_path / "b.yaml"))
    with pytest.raises(InvalidValueError, match="directory"):
        AllowedPaths().resolve(str(start))


def test_only_plain_text_files_are_read(tmp_path: Path) -> None:
    text = tmp_path / "text"
    text.write_bytes("µm\r\nnm\n".encode())
    assert read_plain_text(text, 100) == "µm\nnm\n"
    with pytest.raises(CalibrationFileError, match="more than 5 bytes"):
        read_plain_text(text, 5)
    text.write_bytes(b"\xff")
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path, reason in (
        (text, "not a text file"),
        (pipe, "not a file"),
        (Path("/dev/zero"), "not a file"),
        (tmp_path, "Is a directory|not a file"),
        (tmp_path / "missing", "No such file"),
    ):
        with pytest.raises(CalibrationFileError, match=reason):
            read_plain_text(path, 100)


def test_only_files_are_replaced(tmp_path: Path) -> None:
    """As root, too: a device or a pipe is gone for everybody once a file is moved over it."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for name in ("pipe", "folder"):
        before = (tmp_path / name).lstat()
        with pytest.raises(OSError, match="regular file|directory"):
            atomic_write_bytes(tmp_path / name, b"new")
        assert (tmp_path / name).lstat() == before
    # No file can be made in /proc, whoever asks.
    with pytest.raises(OSError, match="/proc"):
        atomic_write_bytes(Path("/proc/semcal.yaml"), b"new")
    assert len(list(tmp_path.iterdir())) == 2


def test_a_name_as_long_as_file_systems_take_is_written(tmp_path: Path) -> None:
    path = tmp_path / ("x" * 250 + ".yaml")
    atomic_write_bytes(path, b"new")
    assert path.read_bytes() == b"new"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        # These many brackets overrun the stack of libyaml's composer, which ends the process.
        (200_000 * "[", "nested more than 32 deep at line 1"),
        ("a: &own\n  - *own\n", "an anchor or alias at line 1"),
        ("a: &x [1]\nb: [*x, *x]\n", "an anchor or alias at line 1"),
        ("a: b: c", "not valid YAML at line 1"),
        ("a: \x01", "not valid YAML"),
    ],
)
def test_yaml_that_no_calibration_has_is_refused(text: str, reason: str) -> None:
    with pytest.raises(CalibrationFileError, match=reason):
        check_plain_yaml(text, "text")


def test_plain_yaml_passes() -> None:
    check_plain_yaml("a: [1, {b: [2.5]}]\nc: '*not an alias'\n", "text")
