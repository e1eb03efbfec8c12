"""A short soak; the long one is tests/soak/soak_nodes.py."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.node_soak import Soak
from tests.helpers.ros_process import Peer

# All nodes at once, for as long as the soak takes.
pytestmark = pytest.mark.flaky(reruns=1)

DURATION_S = 8.0


@pytest.mark.timeout(300)
def test_a_suite_that_is_broken_every_second_recovers_each_time(tmp_path: Path) -> None:
    peer = Peer()
    soak = Soak(peer, tmp_path, seed=1)
    try:
        soak.run(DURATION_S)
    finally:
        peer.close()
    assert soak.checked > 25
    assert sum(soak.faults.values()) >= 5
