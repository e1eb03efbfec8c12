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

"""A Python process that works for a node and ends with it, however the node ends."""

from __future__ import annotations

import contextlib
import fcntl
import io
import multiprocessing
import multiprocessing.resource_tracker
import os
import pickle
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from operator import is_
from types import FunctionType
from typing import Any

# A fork would copy the threads' locks of rclpy and of the middleware in whatever state they are.
_SPAWN = multiprocessing.get_context("spawn")
# The matrices are small; more threads would only take processors away from the live nodes.
_ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in ("OPENBLAS", "OMP", "MKL")}
# A killed process is gone within milliseconds; longer means that the kernel cannot end it, and waiting does not help.
_END_S = 2.0
# As much as Linux allows any user (pipe(7)); at the usual 64 KiB, both sides take dozens of turns for a frame.
_PIPE_BYTES = 1024 * 1024


class ChildProcessEnded(Exception):
    """The process ended, or was stopped, before it answered; ``status`` is its exit status."""

    def __init__(self, status: int | None) -> None:
        if status is None:
            how = "does not answer"
        elif status >= 0:
            how = f"ended with status {status}"
        else:
            how = f"was ended by {signal.Signals(-status).name}"
        super().__init__(how)
        self.status = status


# What a class says of its own pickling, unless it leaves that to `object`.
_REDUCERS = {name: getattr(object, name) for name in ("__reduce_ex__", "__reduce__")}


class _Pickler(pickle.Pickler):
    """Pickles objects that other threads are using.

    A camera or a calibration fills its cached properties in when they are first asked for. If another thread does that
    while its attributes are written, ``pickle`` raises "dictionary changed size during iteration".
    """

    def reducer_override(self, item: Any) -> Any:
        reducers = (getattr(type(item), name) for name in _REDUCERS)
        if not all(map(is_, reducers, _REDUCERS.values())) or isinstance(item, type | FunctionType):
            return NotImplemented
        make, arguments, state, *rest = item.__reduce_ex__(pickle.HIGHEST_PROTOCOL)
        # With slots, the attributes are the first of two dictionaries, and the second is a copy already.
        if isinstance(state, tuple):
            state = (state[0] and dict(state[0]), *state[1:])
        elif isinstance(state, dict):
            state = dict(state)
        return make, arguments, state, *rest


class Channel:
    """One end of a pair of pipes that carry any picklable object; for one thread at a time and direction.

    Objects are pickled straight into the pipe and out of it. ``Connection.send`` and ``recv`` would make two more
    copies and read in pieces: handing over a frame of 1536 x 1536 took 2.3 to 2.8 ms instead of 1.5 to 1.9, and getting
    its tracker back 250 to 500 ms instead of 50 to 100.
    """

    def __init__(self, reader: Any, writer: Any) -> None:
        self._ends = reader, writer
        # With a buffer of one byte, nothing of the next object waits where poll() does not see it.
        raw = io.FileIO(reader.fileno(), "rb", closefd=False)
        self._input = io.BufferedReader(raw, buffer_size=1)
        self._output = io.BufferedWriter(io.FileIO(writer.fileno(), "wb", closefd=False))

    def __reduce__(self) -> tuple[Any, ...]:
        return Channel, self._ends

    def send(self, item: Any) -> None:
        """Send an object; raises :class:`OSError` if the other side has ended."""
        _Pickler(self._output, protocol=pickle.HIGHEST_PROTOCOL).dump(item)
        self._output.flush()

    def receive(self) -> Any:
        """Receive the next object; raises :class:`EOFError` or :class:`OSError` if the other side has ended."""
        try:
            return pickle.load(self._input)
        except pickle.UnpicklingError as error:
            raise EOFError("the other side has ended in the middle of an object") from error

    def poll(self, seconds: float) -> bool:
        """Return whether, within this time, there is something to receive or the other side has ended."""
        return bool(self._ends[0].poll(seconds))

    def close(self) -> None:
        """Close this end."""
        for part in (self._output, self._input, *self._ends):
            # What can no longer be sent is dropped.
            with contextlib.suppress(OSError):
                part.close()


def _pipe() -> tuple[Any, Any]:
    """Return the reading and the writing end of a pipe with a large buffer."""
    reader, writer = _SPAWN.Pipe(duplex=False)
    with contextlib.suppress(OSError):
        fcntl.fcntl(writer.fileno(), fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
    return reader, writer


class ChildProcess:
    """Runs ``serve(channel)`` in a separate process, with one thread of linear algebra and a low priority.

    Ctrl-C does not reach the process: the node handles it and decides what happens to the process.

    Parameters
    ----------
    serve
        A function of a module; the process imports that module, and ends when the function returns.
    nice
        Added to the nice value of the node, 0 to 19.
    """

    def __init__(self, serve: Callable[[Channel], None], nice: int) -> None:
        answers, theirs_to_write = _pipe()
        theirs_to_read, requests = _pipe()
        theirs = Channel(theirs_to_read, theirs_to_write)
        self._channel = Channel(answers, requests)
        self._process = _SPAWN.Process(target=_run, args=(theirs, nice), daemon=True)
        with _without_interrupts():
            self._process.start()
        # Only the process keeps its ends of the pipes, so that this side notices when the process ends.
        theirs.close()
        self.send(serve)

    @property
    def pid(self) -> int | None:
        """Process id."""
        return self._process.pid

    def send(self, item: Any) -> None:
        """Send an object to the process; raises :class:`ChildProcessEnded`."""
        try:
            self._channel.send(item)
        except OSError:
            raise self._ended() from None

    def receive(self) -> Any:
        """Wait for the next object from the process; raises :class:`ChildProcessEnded`."""
        try:
            return self._channel.receive()
        except (EOFError, OSError):
            raise self._ended() from None

    def poll(self, seconds: float) -> bool:
        """Return whether, within this time, :meth:`receive` has something to return or to raise."""
        return self._channel.poll(seconds)

    def kill(self) -> None:
        """Kill the process at once; any thread may call this."""
        self._process.kill()

    def close(self) -> None:
        """End the process and free its resources; not while another thread sends or receives."""
        self._process.kill()
        self._process.join(_END_S)
        self._channel.close()

    def _ended(self) -> ChildProcessEnded:
        self._process.join(_END_S)
        return ChildProcessEnded(self._process.exitcode)


@contextmanager
def _without_interrupts() -> Iterator[None]:
    """Start a process in which SIGINT is blocked until it has chosen to ignore it."""
    # Otherwise started with the first process, which would unblock the signal.
    multiprocessing.resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _run(channel: Channel, nice: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, (signal.SIGINT,))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.nice(nice)
    # Before the first message, which causes numpy to be imported.
    os.environ.update(_ONE_THREAD)
    # The node may have ended meanwhile.
    with contextlib.suppress(EOFError, OSError):
        channel.receive()(channel)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
