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

# A signal that comes while the executor is made: the middleware is down, and its constructor fails.
SCRIPT = """
import rclpy
from semcal_ros.nodes.common import run
rclpy.init()
node = rclpy.create_node("short")
rclpy.utilities.try_shutdown()
for threads in (1, 2):
    print(run._spin(node, threads))
"""


def test_an_executor_that_cannot_be_made_any_more_leaves_no_traceback() -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stdout.split() == ["0", "0"], done.stderr
    assert done.returncode == 0
    assert "Traceback" not in done.stderr


# A signal that comes between the question whether the middleware is up and its end.
BETWEEN = """
import rclpy
from semcal_ros.nodes.common import run
rclpy.init()
really = rclpy.utilities.try_shutdown
def fail():
    raise RuntimeError("out of order")
rclpy.utilities.try_shutdown = fail
try:
    run._shut_down()
except RuntimeError as error:
    print(error)
def shut_down_late():
    really()
    raise RuntimeError("rcl_shutdown already called")
rclpy.utilities.try_shutdown = shut_down_late
run._shut_down()
"""


def test_a_signal_that_shuts_down_at_the_same_moment_leaves_no_traceback() -> None:
    done = subprocess.run(
        [sys.executable, "-c", BETWEEN], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "out of order"
