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

"""The suite broken every second for a long time, over three machines where they can be made.

    python -m pytest -q tests/soak/soak_nodes.py
    SEMCAL_SOAK_S=1800 SEMCAL_SOAK_SEED=7 python -m pytest -q tests/soak/soak_nodes.py

The machines are network namespaces, for which it takes root; without, all runs on one. Not collected with the other
tests, for its name does not begin with ``test_``: it has to be named.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.network.namespaces import Network, why_not
from tests.helpers.node_soak import MACHINES, Soak
from tests.helpers.ros_process import REPOSITORY, Peer

DURATION_S = float(os.environ.get("SEMCAL_SOAK_S", "600"))
SEED = int(os.environ.get("SEMCAL_SOAK_SEED", "0"))
# Set in the process on the microscope's machine, which does the work: the stem of the network.
STEM = "SEMCAL_SOAK_NETWORK"
LONGEST_S = 1.5 * DURATION_S + 600.0


# Starting, recovering and the last quiet interval are not part of the duration.
@pytest.mark.timeout(LONGEST_S + 60.0)
def test_a_suite_that_is_broken_every_second_recovers_for_long(tmp_path: Path) -> None:
    reason = why_not()
    if STEM in os.environ or reason:
        network = None if reason else Network(MACHINES, stem=os.environ[STEM])
        print("three machines" if network else f"one machine: {reason}", file=sys.stderr)
        _soak(tmp_path, network)
        return
    with Network(MACHINES) as network:
        environment = {**os.environ, STEM: network.stem}
        command = [sys.executable, "-m", "pytest", "-q", "-s", "-W", "error", __file__]
        made = subprocess.run(
            network.command(MACHINES[0], command),
            check=False,
            cwd=REPOSITORY,
            env=environment,
            timeout=LONGEST_S,
        )
        assert made.returncode == 0


def _soak(folder: Path, network: Network | None) -> None:
    if network is not None:
        # Tests otherwise keep to their own machine; this network ends at its switch.
        os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "SUBNET"
    peer = Peer()
    soak = Soak(peer, folder, SEED, network)
    try:
        soak.run(DURATION_S)
    finally:
        peer.close()
        print(f"faults {dict(soak.faults)}; frames checked {soak.checked}", file=sys.stderr)
    assert soak.checked > DURATION_S / 2.0
    assert set(soak.restarts) >= {"/sem/rectifier", "/sem/stream_corrector"}
