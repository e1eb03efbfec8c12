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

"""What most tests of the nodes need: somebody to talk to them, and a calibration."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.node_scenes import make_calibration
from tests.helpers.ros_process import Peer


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let what needs several processes at once be tried once more: a busy machine may stop one of them for seconds.

    A run may try four tests again (Makefile), and shows why.
    """
    for item in items:
        if item.path.parent == Path(__file__).parent:
            item.add_marker(pytest.mark.flaky(reruns=1))


@pytest.fixture
def peer() -> Iterator[Peer]:
    made = Peer()
    yield made
    made.close()


@pytest.fixture
def calibration_file(tmp_path: Path) -> Path:
    make_calibration().save(tmp_path / "cal.yaml")
    return tmp_path / "cal.yaml"
