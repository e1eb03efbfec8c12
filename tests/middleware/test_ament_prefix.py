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

"""Which prefixes the ament index is searched under."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from semcal_ros.middleware.ament_prefix import add_environment_prefix


@pytest.fixture
def prefix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    marker = tmp_path / "share" / "ament_index" / "resource_index" / "packages" / "semcal_ros"
    marker.parent.mkdir(parents=True)
    marker.touch()
    return tmp_path


def test_the_environment_comes_first_and_only_once(
    prefix: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", "/opt/ros/jazzy")
    for _ in range(2):
        add_environment_prefix()
        assert os.environ["AMENT_PREFIX_PATH"] == f"{prefix}{os.pathsep}/opt/ros/jazzy"


def test_an_empty_variable_adds_no_empty_prefix(
    prefix: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AMENT_PREFIX_PATH", "")
    add_environment_prefix()
    assert os.environ["AMENT_PREFIX_PATH"] == str(prefix)


def test_an_environment_without_the_suite_is_not_added(
    prefix: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "prefix", str(prefix / "other"))
    add_environment_prefix()
    assert "AMENT_PREFIX_PATH" not in os.environ
