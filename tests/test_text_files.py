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
