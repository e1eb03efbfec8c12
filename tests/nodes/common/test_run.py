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
