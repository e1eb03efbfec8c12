"""What most tests of the nodes need: somebody to talk to them, and a calibration."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.helpers.node_scenes import make_calibration
from tests.helpers.ros_process import Peer


@pytest.fixture
def peer() -> Iterator[Peer]:
    made = Peer()
    yield made
    made.close()


@pytest.fixture
def calibration_file(tmp_path: Path) -> Path:
    make_calibration().save(tmp_path / "cal.yaml")
    return tmp_path / "cal.yaml"
