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

"""Files are written completely or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from semcal_ros.files.atomic import atomic_write_bytes, atomic_write_text


def test_text_is_utf8_and_replaces(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    atomic_write_text(path, "µm\n")
    atomic_write_text(path, "nm\n")
    assert path.read_bytes() == b"nm\n"
    assert [p.name for p in tmp_path.iterdir()] == ["a.yaml"]


def test_failed_replacement_keeps_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.yaml"
    path.write_text("old")

    def full_disk(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full_disk)
    with pytest.raises(OSError, match="No space"):
        atomic_write_text(path, "new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.yaml"]


def test_mode_of_the_old_file_and_symlinks_are_kept(tmp_path: Path) -> None:
    target = tmp_path / "real.csv"
    target.write_text("old")
    target.chmod(0o640)
    link = tmp_path / "link.csv"
    link.symlink_to(target)
    atomic_write_bytes(link, b"new")
    assert link.is_symlink()
    assert target.read_bytes() == b"new"
    assert target.stat().st_mode & 0o777 == 0o640


def test_missing_folder_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        atomic_write_text(tmp_path / "no" / "a.yaml", "x")


def test_only_files_are_replaced(tmp_path: Path) -> None:
    """As root, too: a device or a pipe is gone for everybody once a file is moved over it."""
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "folder").mkdir()
    for name in ("pipe", "folder"):
        before = (tmp_path / name).lstat()
        with pytest.raises(OSError, match=r"regular file|directory"):
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
