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

"""How a node's process ends."""

from __future__ import annotations

import subprocess
import sys

import pytest

# A node that says whether it could still publish when it was destroyed, and asks its own process to end:
# while it is made, in a callback, or from a thread while it waits for a message that never comes.
NODE = """
import os, signal, sys, threading, time
import rclpy
from rclpy.node import Node
from semcal_ros.nodes.common.run import run_node

moment, number, threads = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])

def ask():
    os.kill(os.getpid(), number)

def ask_later():
    time.sleep(0.5)
    print("waited", flush=True)
    ask()

class Ending(Node):
    def __init__(self):
        super().__init__("ending")
        if moment == "making":
            ask()
            time.sleep(60.0)
        self._timer = self.create_timer(0.01, self._begin)

    def _begin(self):
        self._timer.cancel()
        if moment == "callback":
            ask()
            time.sleep(0.1)
            print("finished", flush=True)
        else:
            threading.Thread(target=ask_later).start()

    def destroy_node(self):
        print("destroyed, ROS up:", rclpy.ok(), flush=True)
        super().destroy_node()

status = run_node(Ending, ["--ros-args", "--log-level", "error"], threads=threads)
print("ROS up:", rclpy.ok())
for number in (signal.SIGINT, signal.SIGTERM):
    print(signal.getsignal(number).__class__.__name__)
sys.exit(status)
"""
AFTER = ["ROS up: False", "builtin_function_or_method", "Handlers"]


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("number", [2, 15])
@pytest.mark.parametrize(
    ("moment", "printed"),
    [
        ("making", []),
        ("callback", ["finished", "destroyed, ROS up: True"]),
        ("waiting", ["waited", "destroyed, ROS up: True"]),
    ],
)
def test_a_signal_ends_the_node_in_order(
    moment: str, printed: list[str], number: int, threads: int
) -> None:
    done = subprocess.run(
        [sys.executable, "-c", NODE, moment, str(number), str(threads)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.stderr == ""
    assert done.stdout.splitlines() == [*printed, *AFTER]
    assert done.returncode == 0
