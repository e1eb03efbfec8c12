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

"""How every executable starts, spins and ends."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, TypeVar

import rclpy.utilities
from rclpy.exceptions import (
    InvalidHandle,
    InvalidNamespaceException,
    InvalidNodeNameException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
)
from rclpy.executors import (
    Executor,
    ExternalShutdownException,
    MultiThreadedExecutor,
    ShutdownException,
    SingleThreadedExecutor,
)
from rclpy.node import Node
from rclpy.qos_overriding_options import InvalidQosOverridesError
from rclpy.signals import SignalHandlerOptions

from semcal_ros.core.errors import ConfigError, SemcalError
from semcal_ros.middleware import add_environment_prefix, check_security
from semcal_ros.nodes.common.base import SemNode
from semcal_ros.nodes.common.command_line import CommandLine, HelpWanted, format_help, starting_with

Made = TypeVar("Made")


class _EndRequest:
    """Notes SIGINT and SIGTERM, from its creation until it is closed.

    The handlers of rclpy 7.1 would shut the middleware down in a thread of their own, beside the threads that use it.
    If the executor is destroyed at that moment, the process crashes in ``rcl_trigger_guard_condition``: two or three
    processes did in a run of all tests. A process that crashes can leave a lock in shared memory that holds up every
    other node of the machine. Nothing could be published at the end, either. Here, the main thread alone ends a node.
    """

    def __init__(self) -> None:
        self.asked = False
        self._spinning = False
        signals = (signal.SIGINT, signal.SIGTERM)
        self._before = {number: signal.signal(number, self._note) for number in signals}

    def _note(self, _number: int, _frame: Any) -> None:
        self.asked = True
        # A node that starts may wait for something. Later, an exception would surface in the middle of a callback.
        if not self._spinning:
            raise KeyboardInterrupt

    @contextmanager
    def waking(self, executor: Executor) -> Iterator[None]:
        """From now on only note a signal, and let ``executor.spin_once`` return on one."""
        self._spinning = True
        # Python runs a handler between two steps of the main thread, which may wait for a message for ever. What the
        # system itself does at once is to write to this socket.
        reader, writer = socket.socketpair()
        writer.setblocking(False)

        def wake() -> None:
            while reader.recv(1):
                executor.create_task(lambda: None)

        waker = threading.Thread(target=wake, daemon=True)
        waker.start()
        signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        try:
            yield
        finally:
            signal.set_wakeup_fd(-1)
            writer.close()
            waker.join()
            reader.close()

    def close(self) -> None:
        """Leave signals to whom they belonged before."""
        for number, handler in self._before.items():
            signal.signal(number, handler)


# A thread that computes beside the stream must not hold the interpreter for long when a frame arrives.
_SWITCH_S = 5e-4

# A callback that is running when a node ends: as long as a frame may take.
_CALLBACKS_S = 2.0
# Where the source has ended: how long nothing may have been waiting, and how long the rest may take.
_QUIET_S, _REST_S = 1.0, 30.0
_LOOK_S = 0.05

_START_ERRORS = (
    SemcalError,
    InvalidNamespaceException,
    InvalidNodeNameException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
    InvalidQosOverridesError,
)


def run_node(
    factory: Callable[[], Node], args: Sequence[str] | None = None, threads: int = 1
) -> int:
    """Run one node until SIGINT, SIGTERM or its own shutdown.

    Parameters
    ----------
    factory
        Makes the node.
    args
        Command line; the process's own by default.
    threads
        Number of callbacks that may run at once.

    Returns
    -------
    Exit status: 0, or 2 after one line on stderr if the node cannot start with what it was given.
    """
    with starting_with(sys.argv[1:] if args is None else args) as line:
        return _run(lambda: _make(factory), line, lambda node, end: _spin(node, threads, end))


class _Patient(Executor):
    """An executor that waits again where something was destroyed by another thread while it began to wait.

    rclpy then raises, before anything was taken: it passes over the event of a subscription that is being destroyed
    when it enters what it waits for, and adds it all the same. Nodes create and destroy subscriptions in threads of
    their own, such as that which plays a recording.
    """

    def wait_for_ready_callbacks(self, *args: Any, **kwargs: Any) -> Any:
        """Return the next callback as the base class does."""
        while True:
            # What was destroyed is not in the next set.
            with suppress(InvalidHandle):
                return super().wait_for_ready_callbacks(*args, **kwargs)


class _Alone(_Patient, SingleThreadedExecutor):
    """An executor of one thread."""


class _OneAtATime(_Alone):
    """An executor whose callbacks run while it holds a lock.

    Parameters
    ----------
    lock
        The lock.
    """

    def __init__(self, lock: threading.Lock) -> None:
        super().__init__()
        self._lock = lock

    def turn(self) -> None:
        """Wait for a callback that is ready, and run it."""
        try:
            handler, _, _ = self.wait_for_ready_callbacks()
        except ShutdownException:
            raise ExternalShutdownException from None
        with self._lock:
            handler()
        if handler.exception() is not None:
            raise handler.exception()


class Part:
    """One of several nodes in a process.

    Two threads run its callbacks, one at a time: an executor, and one for what other nodes of the process hand over in
    memory. The executor of rclpy needs 0.2 to 0.7 ms to begin a callback, by the number of its node's topics; a frame
    would wait for that at every node.

    Parameters
    ----------
    node
        The node.
    on_error
        Called with what a callback of the node raised, and the node goes on. Without it the process ends.
    """

    def __init__(self, node: Node, on_error: Callable[[Exception], None] | None = None) -> None:
        self.node = node
        self.error: BaseException | None = None
        self.has_ended = False
        self._on_error = on_error
        self._stopping = False
        self._posted: deque[Callable[[], None]] = deque()
        self._arrival = threading.Condition()
        self._lock = threading.Lock()
        self._threads = [
            threading.Thread(target=self._run, args=(turn,), name=node.get_name(), daemon=True)
            for turn in (self._turn, self._take_posted)
        ]
        if isinstance(node, SemNode):
            node.endpoints.run_guards_by(self.post)

    def post(self, callback: Callable[[], None]) -> None:
        """Run a callback soon; once, if it has been posted already and not begun."""
        with self._arrival:
            if callback not in self._posted:
                self._posted.append(callback)
                self._arrival.notify()

    def start(self, on_end: Callable[[], None]) -> None:
        """Begin to run callbacks; ``on_end`` is called when the node has ended by itself."""
        self._on_end = on_end
        self._executor = _OneAtATime(self._lock)
        self._executor.add_node(self.node)
        for thread in self._threads:
            thread.start()

    def _run(self, turn: Callable[[], None]) -> None:
        try:
            while not self._stopping:
                self._guarded(turn)
        except ExternalShutdownException:
            pass
        except BaseException as error:  # raised again by the main thread
            self.error = error
        finally:
            self.has_ended = True
            self._on_end()

    def _guarded(self, turn: Callable[[], None]) -> None:
        try:
            turn()
        except ExternalShutdownException:
            raise
        except Exception as error:
            if self._on_error is None:
                raise
            self._on_error(error)

    def _turn(self) -> None:
        self._executor.turn()

    def _take_posted(self) -> None:
        with self._arrival:
            while not (self._posted or self._stopping):
                self._arrival.wait()
            callback = self._posted.popleft() if self._posted else None
        if callback is not None:
            with self._lock:
                callback()

    def stop(self) -> bool:
        """End the threads; return whether they have ended."""
        self._stopping = True
        with self._arrival:
            self._arrival.notify()
        started = [thread for thread in self._threads if thread.ident is not None]
        if not started:
            return True
        self._executor.create_task(lambda: None)
        end_s = time.monotonic() + _CALLBACKS_S
        for thread in started:
            thread.join(max(0.0, end_s - time.monotonic()))
        if any(thread.is_alive() for thread in started):
            return False
        self._executor.shutdown(timeout_sec=1.0)
        return True


@dataclass(frozen=True)
class Parts:
    """The nodes of one process.

    Attributes
    ----------
    lead
        That of the main thread.
    others
        The others, which are destroyed in reverse order.
    has_work
        Whether anything waits that was handed over in memory: when a node has ended by itself, such as a recording at
        its end, the others finish that.
    """

    lead: Node
    others: Sequence[Part]
    has_work: Callable[[], bool]


def run_parts(make: Callable[[], Parts], args: Sequence[str] | None = None) -> int:
    """Run several nodes in one process until SIGINT, SIGTERM or the end of one of them.

    Parameters
    ----------
    make
        Makes the nodes.
    args
        Command line; the process's own by default.

    Returns
    -------
    Exit status: 0, that of a node which has ended by itself, or 2 as :func:`run_node`.
    """
    given = sys.argv[1:] if args is None else args
    with starting_with(given, of_several=True) as line:
        return _run(make, line, _spin_together)


def _run(make: Callable[[], Made], line: CommandLine, spin: Callable[[Made, Any], int]) -> int:
    sys.setswitchinterval(_SWITCH_S)
    add_environment_prefix()
    end = _EndRequest()
    try:
        try:
            if line.wants_help:
                return _print_help(make)
            line.refuse_foreign()
            check_security()
            with _refusals():
                rclpy.init(
                    args=[sys.argv[0], *line.arguments],
                    signal_handler_options=SignalHandlerOptions.NO,
                )
                made = make()
        except _START_ERRORS as error:
            print(" ".join(str(error).split()), file=sys.stderr)
            return 2
        # Errors from here on are not caused by the node's arguments.
        return spin(made, end)
    except KeyboardInterrupt:
        return 0
    finally:
        rclpy.utilities.try_shutdown()
        end.close()


@contextmanager
def _refusals() -> Iterator[None]:
    """Turn what ROS refuses at start, such as a process without its enclave, into an error of the suite."""
    try:
        yield
    except RuntimeError as error:
        raise ConfigError(f"ROS refuses to start: {error}") from error


def _make(factory: Callable[[], Node]) -> Node:
    node = factory()
    if isinstance(node, SemNode):
        with _destroyed_if_refused(node):
            node.refuse_unknown_topics()
        node.introduce()
    return node


@contextmanager
def _destroyed_if_refused(node: Node) -> Iterator[None]:
    try:
        yield
    except SemcalError:
        node.destroy_node()
        raise


def _print_help(make: Callable[[], object]) -> int:
    try:
        make()
    except HelpWanted as wanted:
        try:
            print(format_help(wanted.name, wanted.declarations), flush=True)
        except BrokenPipeError:
            # `--help | head` has read enough. What is left in the buffer must not fail at the exit either.
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    raise AssertionError("a node that starts in spite of --help")


class _Threads(_Patient, MultiThreadedExecutor):
    """An executor that can be waited for."""

    def wait_for_callbacks(self, limit_s: float) -> None:
        """Wait for those that are running: what they use is about to be destroyed."""
        end_s = time.monotonic() + limit_s
        while time.monotonic() < end_s and not all(f.done() for f in list(self._futures)):
            time.sleep(0.01)


def _spin(node: Node, threads: int, end: _EndRequest) -> int:
    executor = _Threads(num_threads=threads) if threads > 1 else _Alone()
    try:
        executor.add_node(node)
        if isinstance(node, SemNode):
            node.begin()
        with end.waking(executor), suppress(ExternalShutdownException):
            while rclpy.utilities.ok() and not end.asked:
                executor.spin_once()
    finally:
        if isinstance(executor, _Threads):
            if isinstance(node, SemNode):
                # Ends what a callback may be waiting for.
                node.closing.close()
            executor.wait_for_callbacks(_CALLBACKS_S)
        executor.shutdown(timeout_sec=1.0)
        node.destroy_node()
    return int(getattr(node, "exit_status", 0))


def _spin_together(made: Parts, end: _EndRequest) -> int:
    lead, parts = made.lead, made.others
    executor = _Alone()
    executor.add_node(lead)
    busy: list[str] = []
    try:
        for part in parts:
            part.start(lambda: executor.create_task(lambda: None))
        for node in (lead, *(part.node for part in parts)):
            if isinstance(node, SemNode):
                node.begin()
        with end.waking(executor), suppress(ExternalShutdownException):
            while rclpy.utilities.ok() and not end.asked and not any(p.has_ended for p in parts):
                executor.spin_once()
            if not any(part.error for part in parts):
                _finish(executor, made.has_work, end)
    finally:
        for part in parts:
            if isinstance(part.node, SemNode):
                # Ends what a callback may be waiting for.
                part.node.closing.close()
        # All of them: what one uses must not be destroyed while another runs.
        busy = [part.node.get_name() for part in parts if not part.stop()]
        executor.shutdown(timeout_sec=1.0)
        if not busy:
            for node in (*(part.node for part in reversed(parts)), lead):
                node.destroy_node()
    for part in parts:
        if part.error is not None:
            raise part.error
    status = max([int(getattr(part.node, "exit_status", 0)) for part in parts], default=0)
    if busy:
        # A callback that does not return uses the middleware, which cannot be taken down beneath it.
        print(f"still busy, and left: {', '.join(busy)}", file=sys.stderr, flush=True)
        os._exit(status)
    return status


def _finish(executor: Executor, has_work: Callable[[], bool], end: _EndRequest) -> None:
    """Let the nodes that are left finish what was handed over to them."""
    begun_s = busy_s = time.monotonic()
    while rclpy.utilities.ok() and not end.asked:
        now_s = time.monotonic()
        if has_work():
            busy_s = now_s
        if now_s - busy_s > _QUIET_S or now_s - begun_s > _REST_S:
            return
        executor.spin_once(timeout_sec=_LOOK_S)
