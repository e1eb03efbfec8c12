"""Only regular text files of a bounded size are read."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from semcal_ros.core.errors import ConfigError
from semcal_ros.text_files import read_text_file


def test_only_plain_text_files_are_read(tmp_path: Path) -> None:
    text = tmp_path / "text"
    text.write_bytes("µm\r\nnm\n".encode())
    assert read_text_file(text, 100, error=ConfigError, expected="x") == "µm\nnm\n"
    with pytest.raises(ConfigError, match="more than 5 bytes"):
        read_text_file(text, 5, error=ConfigError, expected="x")
    text.write_bytes(b"\xff")
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path, reason in (
        (text, "not UTF-8 text"),
        (pipe, "not a file"),
        (Path("/dev/zero"), "not a file"),
        (tmp_path, "Is a directory|not a file"),
        (tmp_path / "missing", "No such file"),
        (tmp_path / "null\0byte", "null"),
    ):
        with pytest.raises(ConfigError, match=reason):
            read_text_file(path, 100, error=ConfigError, expected="x")
