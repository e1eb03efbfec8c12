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

"""A short soak; the long one is tests/soak/soak_nodes.py."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.node_soak import Soak
from tests.helpers.ros_process import Peer

DURATION_S = 8.0


@pytest.mark.timeout(300)
@pytest.mark.long
def test_a_suite_that_is_broken_every_second_recovers_each_time(tmp_path: Path) -> None:
    peer = Peer()
    soak = Soak(peer, tmp_path, seed=1)
    try:
        soak.run(DURATION_S)
    finally:
        peer.close()
    assert soak.checked > 25
    assert sum(soak.faults.values()) >= 5
