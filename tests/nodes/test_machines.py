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

import subprocess
import sys

import pytest

from benchmarks.network.__main__ import Case, discovery, measured
from benchmarks.network.namespaces import Network, why_not

pytestmark = pytest.mark.skipif(bool(why_not()), reason=f"no network namespaces here: {why_not()}")


@pytest.mark.timeout(180)
@pytest.mark.long
def test_frames_cross_a_network_without_multicast() -> None:
    by_address = Case(256, 10.0, discovery="static peers", clock_ahead_s=3.0, compressed=True)
    found = measured(by_address, seconds=2.0)
    assert found["in"] == 20
    # What waits for longer than a second, as on a machine that is very busy, falls out of the queues.
    assert found["out"] >= 15
    assert found["last"] == found["sent"] - 1
    assert found["node"]["rejected"] == "0"


@pytest.mark.timeout(180)
@pytest.mark.long
def test_a_cable_that_comes_back_costs_the_viewer_some_frames_and_the_nodes_none() -> None:
    seconds, unplugged_s = 6.0, 1.5
    found = measured(Case(256, 10.0, unplugged_s=unplugged_s), seconds)
    assert found["in"] == 60
    # What was published meanwhile is gone but for the queue; what comes after is there again.
    assert 10.0 * (seconds - unplugged_s) - 15 <= found["out"] <= found["in"]
    assert found["last"] == found["sent"] - 1
    assert int(found["node"]["received"]) >= found["in"]


# A node on one machine, and one on another that ends when it has heard the first.
SAY = """
import sys, rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node(sys.argv[1])
def heard(message):
    print(message.data, flush=True)
    raise SystemExit
if sys.argv[1] == "one":
    publisher = node.create_publisher(String, "words", 10)
    timer = node.create_timer(0.1, lambda: publisher.publish(String(data="across")))
else:
    node.create_subscription(String, "words", heard, 10)
rclpy.spin(node)
"""


@pytest.mark.timeout(120)
@pytest.mark.long
def test_a_discovery_server_takes_the_place_of_multicast(monkeypatch: pytest.MonkeyPatch) -> None:
    case = Case(256, 10.0, discovery="discovery server")
    environment = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
    with (
        Network(["microscope", "nodes", "viewer"], multicast=False) as network,
        discovery(case, network, environment),
    ):
        for name, value in environment.items():
            monkeypatch.setenv(name, value)
        one, two = (
            network.command(machine, [sys.executable, "-c", SAY, name])
            for machine, name in (("microscope", "one"), ("viewer", "two"))
        )
        with subprocess.Popen(one) as speaker:
            try:
                answer = subprocess.run(
                    two, check=True, capture_output=True, text=True, timeout=60.0
                )
            finally:
                speaker.kill()
    assert answer.stdout.strip() == "across"


COUNT = """
import socket
taken = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
taken.bind(("", 5555))
# SO_RCVBUFFORCE: nothing is lost here, however busy the machine is.
taken.setsockopt(socket.SOL_SOCKET, 33, 2**24)
taken.settimeout(20.0)
print("ready", flush=True)
seen = set()
while b"end" not in seen:
    seen.add(taken.recv(2048))
print(len(seen) - 1)
"""
SEND = """
import socket, sys, time
given = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
for k in range(2000):
    given.sendto(k.to_bytes(1000, "big"), (sys.argv[1], 5555))
    time.sleep(0.0002)
for k in range(20):
    given.sendto(b"end", (sys.argv[1], 5555))
"""


@pytest.mark.timeout(120)
def test_the_relay_loses_as_many_packets_as_it_is_told() -> None:
    with Network(["microscope", "viewer"], loss={"viewer": 0.05}) as network:
        counting = network.command("viewer", [sys.executable, "-c", COUNT])
        sending = [sys.executable, "-c", SEND, network.address("viewer")]
        with subprocess.Popen(counting, stdout=subprocess.PIPE, text=True) as counter:
            assert counter.stdout is not None
            assert counter.stdout.readline() == "ready\n"
            subprocess.run(network.command("microscope", sending), check=True)
            lost = 2000 - int(counter.stdout.read())
    # 100 of them, and five times the standard deviation of a binomial draw, 9.7, to either side.
    assert 51 <= lost <= 149
