"""The suite broken every second for a long time.

    python -m pytest -q tests/soak/soak_nodes.py
    SEMCAL_SOAK_S=1800 SEMCAL_SOAK_SEED=7 python -m pytest -q tests/soak/soak_nodes.py

Not collected with the other tests, for its name does not begin with ``test_``: it has to be named.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from tests.helpers.node_soak import Soak
from tests.helpers.ros_process import Peer

DURATION_S = float(os.environ.get("SEMCAL_SOAK_S", "600"))
SEED = int(os.environ.get("SEMCAL_SOAK_SEED", "0"))


# Starting, recovering and the last quiet interval are not part of the duration.
@pytest.mark.timeout(1.5 * DURATION_S + 600.0)
def test_a_suite_that_is_broken_every_second_recovers_for_long(tmp_path: Path) -> None:
    peer = Peer()
    soak = Soak(peer, tmp_path, SEED)
    try:
        soak.run(DURATION_S)
    finally:
        peer.close()
        print(f"faults {dict(soak.faults)}; frames checked {soak.checked}", file=sys.stderr)
    assert soak.checked > DURATION_S / 2.0
    assert set(soak.restarts) >= {"/sem/rectifier", "/sem/stream_corrector"}
