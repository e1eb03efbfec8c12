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

"""The suite over three machines on a network: the microscope's, that of the nodes, and a viewer's."""

from __future__ import annotations

import pytest

from benchmarks.network.__main__ import Case, measured
from benchmarks.network.namespaces import why_not

pytestmark = pytest.mark.skipif(bool(why_not()), reason=f"no network namespaces here: {why_not()}")


@pytest.mark.timeout(180)
def test_frames_cross_a_network_without_multicast() -> None:
    by_address = Case(256, 10.0, discovery="static peers", clock_ahead_s=3.0)
    found = measured(by_address, seconds=2.0)
    assert found["in"] == 20
    # What waits for longer than a second, as on a machine that is very busy, falls out of the queues.
    assert found["out"] >= 15
    assert found["last"] == found["sent"] - 1
    assert found["node"]["rejected"] == "0"


@pytest.mark.timeout(180)
def test_a_cable_that_comes_back_costs_the_viewer_some_frames_and_the_nodes_none() -> None:
    seconds, unplugged_s = 6.0, 1.5
    found = measured(Case(256, 10.0, unplugged_s=unplugged_s), seconds)
    assert found["in"] == 60
    # What was published meanwhile is gone but for the queue; what comes after is there again.
    assert 10.0 * (seconds - unplugged_s) - 15 <= found["out"] <= found["in"]
    assert found["last"] == found["sent"] - 1
    assert int(found["node"]["received"]) >= found["in"]
