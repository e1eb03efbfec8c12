"""What most tests of the nodes need: somebody to talk to them, and a calibration."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.node_scenes import make_calibration
from tests.helpers.ros_process import Peer

HERE = Path(__file__).parent


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """One more try for what depends on several processes getting their turns; each is listed at the end of the run.

    A shared machine may stop any of them for seconds, which no node can be built against. What fails twice is wrong.
    """
    for item in items:
        if HERE in item.path.parents:
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
