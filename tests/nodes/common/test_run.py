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

import signal
import subprocess
import sys
from collections.abc import Callable

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
# Where the parent ignores SIGINT, as a shell does for a job in the background, that is what it is afterwards.
IGNORED = ["ROS up: False", "Handlers", "Handlers"]


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("number", [2, pytest.param(15, marks=pytest.mark.long)])
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
    done = _run(moment, number, threads)
    assert done.stderr == ""
    assert done.stdout.splitlines() == [*printed, *AFTER]
    assert done.returncode == 0


@pytest.mark.parametrize("number", [2, 15])
def test_a_node_whose_parent_ignores_sigint_still_ends_in_order(number: int) -> None:
    """As `ros2 run ... &` in a script: `kill -INT` must end it, as it ends every other ROS node."""
    done = _run("waiting", number, 1, preexec=_ignore_sigint)
    assert done.stderr == ""
    assert done.stdout.splitlines() == ["waited", "destroyed, ROS up: True", *IGNORED]
    assert done.returncode == 0


def _ignore_sigint() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _run(
    moment: str, number: int, threads: int, preexec: Callable[[], None] | None = None
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", NODE, moment, str(number), str(threads)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        preexec_fn=preexec,
    )


# Two nodes in one process. One of them ends: by what its timer raises, or by itself as a recording does; or it hangs
# while the process is asked to end; or what it raises is taken for its own affair.
PARTS = """
import os, signal, sys, threading, time
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from semcal_ros.nodes.common.run import Part, Parts, run_parts

how = sys.argv[1]
left = [3]

class Other(Node):
    def __init__(self):
        super().__init__("other")
        self._timer = self.create_timer(0.05, self._tick)

    def _tick(self):
        print("tick", flush=True)
        if how in ("raises", "forgiven"):
            raise OSError("no stage")
        if how == "ends":
            raise ExternalShutdownException
        # A signal while parts still start ends them at once.
        if how == "hangs" and left[0] < 3:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(60.0)

class Worker(Node):
    def __init__(self):
        super().__init__("worker")
        self.exit_status = 3
        self._timer = self.create_timer(0.2, self._work)

    def _work(self):
        left[0] -= left[0] > 0
        if how == "forgiven" and not left[0]:
            os.kill(os.getpid(), signal.SIGINT)

def forgive(error):
    print(f"forgiven {error}", flush=True)

def make():
    other = Part(Other(), forgive if how == "forgiven" else None)
    return Parts(Node("lead"), [other, Part(Worker())], lambda: left[0] > 0)

status = run_parts(make, ["--ros-args", "--log-level", "error"])
print("left", left[0])
sys.exit(status)
"""


@pytest.mark.parametrize(
    ("how", "status", "said"),
    [
        ("raises", 1, "OSError: no stage"),
        # What waits is worked off first.
        ("ends", 3, "left 0"),
        ("hangs", 3, "still busy, and left: other"),
        ("forgiven", 3, "forgiven no stage\ntick\nforgiven no stage"),
    ],
)
def test_parts_of_a_process_end_together(how: str, status: int, said: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", PARTS, how], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == status, done.stderr
    assert said in done.stdout + done.stderr


# A node of which a subscription is destroyed at the very moment at which the executor begins to wait for it, as a
# thread of its own may do: by what the executor enters just before.
DESTROYS = """
import sys
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.waitable import NumberOfEntities, Waitable
from semcal_ros.nodes.common.run import Part, Parts, run_node, run_parts
from std_msgs.msg import Float64

alone, threads = sys.argv[1] == "alone", int(sys.argv[2])

class Destroying(Waitable):
    def __init__(self, node):
        super().__init__(ReentrantCallbackGroup())
        self._node, self.left = node, []

    def __enter__(self):
        while self.left:
            self._node.destroy_subscription(self.left.pop())
            print("destroyed", flush=True)

    def __exit__(self, *_):
        pass

    def is_ready(self, wait_set):
        return False

    def get_num_entities(self):
        return NumberOfEntities()

    def add_to_wait_set(self, wait_set):
        pass

class Short(Node):
    def __init__(self):
        super().__init__("short")
        events = SubscriptionEventCallbacks(incompatible_qos=print)
        # Before the event in the order of the node.
        waits = Destroying(self)
        self.add_waitable(waits)
        waits.left = [self.create_subscription(Float64, "x", print, 1, event_callbacks=events)]
        self._timer = self.create_timer(0.2, self._end)

    def _end(self):
        print("ticked", flush=True)
        raise ExternalShutdownException

def make():
    return Parts(Node("lead"), [Part(Short())], lambda: False)

arguments = ["--ros-args", "--log-level", "error"]
sys.exit(run_node(Short, arguments, threads=threads) if alone else run_parts(make, arguments))
"""


@pytest.mark.parametrize(("how", "threads"), [("alone", 1), ("alone", 2), ("part", 1)])
def test_what_is_destroyed_while_the_executor_begins_to_wait_ends_nothing(
    how: str, threads: int
) -> None:
    command = [sys.executable, "-c", DESTROYS, how, str(threads)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    # With two threads the timer may tick again before the executor sees how the first time ended.
    assert done.stdout.split()[:2] == ["destroyed", "ticked"], done.stderr
