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

"""Files outside the folder in which a running program may read."""

from __future__ import annotations

from pathlib import Path

import pytest

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.confined import AllowedPaths


def test_only_what_really_lies_inside_is_allowed(tmp_path: Path) -> None:
    inside = tmp_path / "inside"
    (inside / "deep").mkdir(parents=True)
    (tmp_path / "inside2").mkdir()
    (inside / "door").symlink_to(tmp_path)
    (tmp_path / "way_in").symlink_to(inside)
    allowed = AllowedPaths(str(inside))
    good_ones = (inside / "a", inside / "deep" / ".." / "a", tmp_path / "way_in" / "a", "a")
    for good in good_ones:
        assert allowed.resolve(str(good)) == inside / "a"
    for bad in (
        inside / ".." / "a",
        inside / "door" / "a",
        inside / "deep" / ".." / ".." / "inside2" / "a",
        tmp_path / "inside2" / "a",
        "../a",
        "door/a",
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
    with pytest.raises(InvalidValueError, match="inside"):
        by_directory.resolve(str(tmp_path / "b.yaml"))
    with pytest.raises(InvalidValueError, match="directory"):
        AllowedPaths().resolve(str(start))
