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
