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

"""A process that has imported all executables and copies itself for every node that a test starts.

Two seconds of processor time go into the imports of a node, and the tests start hundreds of nodes. A copy is a process
like any other, with its own middleware, signals, memory and end; only what Python reads from disk is there already.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

__all__ = ["Copy", "Template"]

_REPOSITORY = Path(__file__).resolve().parents[2]
_STATUS_BYTES = 4
# Those of LTTng in rclpy only wait for a tracing session, without a lock that a node would need.
_TRACING_THREADS = 2
# More than the variables and arguments of any process here; a packet cannot be longer.
_PACKET_BYTES = 2**17


class Copy:
    """A running copy, with the part of :class:`subprocess.Popen` that tests use.

    Parameters
    ----------
    statuses
        Where the template writes the process id, and the exit status as soon as it has ended.
    """

    def __init__(self, statuses: int) -> None:
        self._statuses = statuses
        self.returncode: int | None = None
        self.pid = self._read()

    def _read(self) -> int:
        data = os.read(self._statuses, _STATUS_BYTES)
        if len(data) != _STATUS_BYTES:
            raise RuntimeError("the template of the nodes has ended")
        return int.from_bytes(data, "little", signed=True)

    def poll(self) -> int | None:
        """Exit status, as far as it has ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self.wait(0.0)
        return None

    def wait(self, timeout: float | None = None) -> int:
        """Exit status; minus the number of the signal that has ended it."""
        if self.returncode is None:
            if not select.select([self._statuses], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
            self.returncode = self._read()
            os.close(self._statuses)
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send a signal unless it is known to have ended."""
        if self.poll() is None:
            # It may have ended just now.
            with contextlib.suppress(ProcessLookupError):
                os.kill(self.pid, number)

    def kill(self) -> None:
        """End it at once."""
        self.send_signal(signal.SIGKILL)


class Template:
    """The side of the tests: starts the template with the first node, and asks it for copies."""

    def __init__(self) -> None:
        self._socket: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None

    def _end(self) -> None:
        assert self._socket is not None and self._process is not None
        self._socket.close()
        self._process.wait()

    def _connected(self) -> socket.socket:
        if self._socket is None:
            self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            paths = [str(_REPOSITORY), os.environ.get("PYTHONPATH", "")]
            # It ends when this process, and with it the socket, is gone.
            self._process = subprocess.Popen(
                [sys.executable, "-m", "tests.helpers.node_template", str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))},
                pass_fds=[theirs.fileno()],
            )
            theirs.close()
            atexit.register(self._end)
        return self._socket

    def copy(
        self, name: str, arguments: Sequence[str], environment: Mapping[str, str], output: int
    ) -> Copy:
        """Start an executable with arguments and an environment; ``output`` is a file for what it writes."""
        request = {
            "name": name,
            "arguments": list(arguments),
            "environment": dict(environment),
            "folder": str(Path.cwd()),
        }
        ours, theirs = os.pipe()
        try:
            socket.send_fds(self._connected(), [json.dumps(request).encode()], [output, theirs])
        finally:
            os.close(theirs)
        return Copy(ours)


# -- the template --------------------------------------------------------------------------------------


def _import_everything() -> None:
    for path in sorted((_REPOSITORY / "semcal_ros" / "nodes").glob("*.py")):
        importlib.import_module(f"semcal_ros.nodes.{path.stem}".removesuffix(".__init__"))


def _serve(requests: socket.socket) -> tuple[dict[str, Any], int] | None:
    """Copy this process for every request; returns it in the copies, and None when nobody is left to ask."""
    running: dict[int, tuple[int, int]] = {}
    while True:
        ready = select.select([requests, *running], [], [])[0]
        for watched in ready:
            if watched is requests:
                continue
            pid, statuses = running.pop(watched)
            status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            _tell(statuses, status)
            os.close(statuses)
            os.close(watched)
        if requests not in ready:
            continue
        packet, descriptors, _, _ = socket.recv_fds(requests, _PACKET_BYTES, 2)
        if not packet:
            return None
        output, statuses = descriptors
        pid = os.fork()
        if pid == 0:
            for watched, (_, other) in running.items():
                os.close(watched)
                os.close(other)
            os.close(statuses)
            requests.close()
            return json.loads(packet), output
        os.close(output)
        _tell(statuses, pid)
        running[os.pidfd_open(pid)] = pid, statuses


def _tell(statuses: int, number: int) -> None:
    # The test may not care any more.
    with contextlib.suppress(BrokenPipeError):
        os.write(statuses, number.to_bytes(_STATUS_BYTES, "little", signed=True))


def _run(request: dict[str, Any], output: int) -> int:
    """Be the executable, as ``python -m semcal_ros.nodes.<name>`` would be."""
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.close(output)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"])
    time.tzset()
    gc.enable()
    module = importlib.import_module(f"semcal_ros.nodes.{request['name']}")
    # Processes that it starts import it under the name that it would have had.
    sys.modules["__main__"] = module
    sys.argv = [str(module.__file__), *request["arguments"]]
    return int(module.main())


def main() -> int:
    # Ctrl-C is for the tests, which then end this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    requests = socket.socket(fileno=int(sys.argv[1]))
    _import_everything()
    threads = len(list(Path("/proc/self/task").iterdir()))
    if threads > 1 + _TRACING_THREADS:
        raise RuntimeError(f"{threads} threads, whose locks a copy could never open")
    # Nothing of this is garbage; looking for it would only copy memory.
    gc.disable()
    gc.freeze()
    request = _serve(requests)
    return 0 if request is None else _run(*request)


if __name__ == "__main__":
    raise SystemExit(main())
