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

"""A process that works for a node: what it answers, what it leaves alone, and how it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semcal_ros.nodes.workers.child_process import Channel, ChildProcess, ChildProcessEnded

ROOT = Path(__file__).resolve().parents[3]
NICE = 3
# Many times what a start takes on a busy machine.
TIMEOUT_S = 60.0


def answer(channel: Channel) -> None:
    """What the processes of these tests do."""
    while True:
        request = channel.receive()
        if request == "describe":
            names = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
            channel.send((os.getpid(), os.nice(0), [os.environ.get(name) for name in names]))
        elif request == "print":
            print("printed", flush=True)
            channel.send("done")
        elif request == "leave":
            return
        elif request == "work":
            # As a calibration does, it does not listen meanwhile.
            channel.send("at work")
            time.sleep(10 * TIMEOUT_S)
        elif request == "fail":
            os._exit(7)
        elif request == "several":
            for number in range(5):
                channel.send(number)
        else:
            channel.send(request)


@dataclass
class Described:
    """Something whose cached property another thread asks for while it is sent."""

    name: str
    user: Any = None

    @cached_property
    def length(self) -> int:
        return len(self.name)


class User:
    """Uses a described thing at the moment at which it is pickled itself."""

    def __init__(self, used: Described) -> None:
        self.used = used

    def __reduce__(self) -> tuple[Any, ...]:
        return str, (f"{self.used.length}",)


@pytest.fixture(scope="module")
def process() -> Iterator[ChildProcess]:
    made = ChildProcess(answer, NICE)
    yield made
    made.close()


def _ask(process: ChildProcess, request: Any) -> Any:
    process.send(request)
    return process.receive()


def _is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def _wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + TIMEOUT_S
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_objects_larger_than_any_pipe_come_back_as_they_were(process: ChildProcess) -> None:
    image = np.random.default_rng(1).integers(0, 256, (2048, 2048), dtype=np.uint8)
    sent, array, text = _ask(process, ("x" * 100, image, "ends here"))
    assert (sent, text) == ("x" * 100, "ends here")
    assert np.array_equal(array, image)


def test_what_another_thread_uses_meanwhile_is_sent(process: ChildProcess) -> None:
    """As the camera of a stream: without a copy of its attributes, their number changes while they are written."""
    used = Described("gold")
    used.user = User(used)
    came = _ask(process, used)
    assert (came.name, came.user, vars(used)["length"]) == ("gold", "4", 4)


def test_it_has_one_thread_of_linear_algebra_and_little_weight(process: ChildProcess) -> None:
    pid, nice, threads = _ask(process, "describe")
    assert pid != os.getpid()
    assert nice == os.nice(0) + NICE
    assert threads == ["1", "1", "1"]


def test_what_it_prints_does_not_get_among_the_answers(process: ChildProcess) -> None:
    assert _ask(process, "print") == "done"
    assert _ask(process, "more") == "more"


def test_poll_sees_each_of_several_answers(process: ChildProcess) -> None:
    assert not process.poll(0.0)
    process.send("several")
    for number in range(5):
        assert process.poll(TIMEOUT_S)
        assert process.receive() == number
    assert not process.poll(0.0)


def test_ctrl_c_is_for_the_node(process: ChildProcess) -> None:
    pid = _ask(process, "describe")[0]
    os.kill(pid, signal.SIGINT)
    assert _ask(process, "still here") == "still here"


@pytest.mark.parametrize(
    ("end", "status", "text"),
    [
        ("leave", 0, "ended with status 0"),
        ("fail", 7, "ended with status 7"),
        ("kill", -signal.SIGKILL, "was ended by SIGKILL"),
    ],
)
def test_its_end_is_told(end: str, status: int, text: str) -> None:
    process = ChildProcess(answer, NICE)
    if end == "kill":
        process.kill()
    else:
        process.send(end)
    with pytest.raises(ChildProcessEnded, match=text) as caught:
        process.receive()
    assert caught.value.status == status
    assert process.poll(0.0)
    with pytest.raises(ChildProcessEnded, match=text):
        process.send(np.zeros(10**6))
    process.close()


def test_an_interrupt_while_it_starts_does_not_end_it() -> None:
    process = ChildProcess(answer, NICE)
    pid = process.pid
    assert pid is not None
    os.kill(pid, signal.SIGINT)
    assert _ask(process, "describe")[0] == pid
    process.close()


PARENT = """
    import sys
    from semcal_ros.nodes.workers.child_process import ChildProcess
    sys.path.insert(0, {root!r})
    from tests.nodes.workers.test_child_process import answer
    process = ChildProcess(answer, 0)
    process.send("describe")
    print(process.receive()[0], flush=True)
    process.send("work")
    process.receive()
    print("at work", flush=True)
    sys.stdin.read()
"""


@pytest.mark.parametrize("how", [signal.SIGKILL, None], ids=["killed", "at its end"])
def test_it_ends_with_the_process_that_started_it(how: signal.Signals | None) -> None:
    program = textwrap.dedent(PARENT.format(root=str(ROOT)))
    parent = subprocess.Popen(
        [sys.executable, "-c", program],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )
    assert parent.stdout is not None
    worker = int(parent.stdout.readline())
    assert parent.stdout.readline() == "at work\n"
    assert _is_alive(worker)
    if how is not None:
        parent.send_signal(how)
    _, errors = parent.communicate(timeout=TIMEOUT_S)
    _wait_until(lambda: not _is_alive(worker))
    assert errors == ""
