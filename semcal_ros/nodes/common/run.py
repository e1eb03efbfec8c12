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

import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import rclpy.utilities
from rclpy.exceptions import (
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
    SingleThreadedExecutor,
)
from rclpy.node import Node
from rclpy.qos_overriding_options import InvalidQosOverridesError
from rclpy.signals import uninstall_signal_handlers

from semcal_ros.core.errors import ConfigError, SemcalError
from semcal_ros.middleware.ament_prefix import add_environment_prefix
from semcal_ros.middleware.security import check_security
from semcal_ros.nodes.common.base import SemNode
from semcal_ros.nodes.common.command_line import CommandLine, HelpWanted, starting_with
from semcal_ros.nodes.common.help import format_help

__all__ = ["DeferredSignals", "run_node"]


class DeferredSignals:
    """Notes SIGINT and SIGTERM from its creation on; :meth:`follow` acts on them.

    ROS itself would shut the middleware down at once, and ``destroy_node`` could no longer publish anything. Create it
    in the main thread after ROS has been initialised.
    """

    def __init__(self) -> None:
        self._asked = False
        uninstall_signal_handlers()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def _note(self, _number: int, _frame: Any) -> None:
        # An exception raised here would surface at an arbitrary place, where other code may swallow it.
        self._asked = True

    def follow(self) -> None:
        """Stop spinning if a signal asked for it. A timer calls this, which also lets Python handle signals."""
        if self._asked:
            raise ExternalShutdownException


# A thread that computes beside the stream must not hold the interpreter for long when a frame arrives.
_SWITCH_S = 5e-4

# A callback that is running when a node ends: as long as a frame may take.
_CALLBACKS_S = 2.0

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
        return _run(factory, line, threads)


def _run(factory: Callable[[], Node], line: CommandLine, threads: int) -> int:
    sys.setswitchinterval(_SWITCH_S)
    add_environment_prefix()
    try:
        try:
            if line.wants_help:
                return _print_help(factory)
            line.refuse_foreign()
            check_security()
            with _refusals():
                rclpy.init(args=[sys.argv[0], *line.arguments])
            node = _make(factory)
        except _START_ERRORS as error:
            print(" ".join(str(error).split()), file=sys.stderr)
            return 2
        # Errors from here on are not caused by the node's arguments.
        return 0 if node is None else _spin(node, threads)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    finally:
        _shut_down()


def _shut_down() -> None:
    """Shut the middleware down, which a signal may do at the same moment."""
    try:
        rclpy.utilities.try_shutdown()
    except RuntimeError:
        # It asks whether the middleware is up before it shuts it down, and the signal's thread comes between.
        if rclpy.utilities.ok():
            raise


@contextmanager
def _refusals() -> Iterator[None]:
    """Turn what ROS refuses at start, such as a process without its enclave, into an error of the suite."""
    was_up = rclpy.utilities.ok()
    try:
        yield
    except RuntimeError as error:
        if was_up and not rclpy.utilities.ok():
            raise  # a signal has shut the middleware down
        raise ConfigError(f"ROS refuses to start: {error}") from error


def _make(factory: Callable[[], Node]) -> Node | None:
    """Make the node; return None if a signal shut the middleware down meanwhile."""
    try:
        with _refusals():
            node = factory()
            if isinstance(node, SemNode):
                with _destroyed_if_refused(node):
                    node.refuse_unknown_topics()
                node.introduce()
            return node
    except RuntimeError:
        # All others have become errors of the suite.
        return None


@contextmanager
def _destroyed_if_refused(node: Node) -> Iterator[None]:
    try:
        yield
    except SemcalError:
        node.destroy_node()
        raise


def _print_help(factory: Callable[[], Node]) -> int:
    try:
        factory()
    except HelpWanted as wanted:
        print(format_help(wanted.name, wanted.declarations))
        return 0
    raise AssertionError("a node that starts in spite of --help")


class _Thread(SingleThreadedExecutor):
    """The executor of rclpy, which may fail while it is made.

    A signal can shut the middleware down at that moment. The destructor of what is half made then
    misses an attribute, and prints a traceback.
    """

    _sigint_gc: Any = None


class _Threads(MultiThreadedExecutor):
    """The same with several threads."""

    _sigint_gc: Any = None

    def wait_for_callbacks(self, limit_s: float) -> None:
        """Wait for those that are running: what they use is about to be destroyed."""
        end_s = time.monotonic() + limit_s
        while time.monotonic() < end_s and not all(f.done() for f in list(self._futures)):
            time.sleep(0.01)


def _spin(node: Node, threads: int) -> int:
    executor: Executor | None = None
    try:
        executor = _Threads(num_threads=threads) if threads > 1 else _Thread()
        executor.add_node(node)
        executor.spin()
    except ExternalShutdownException:
        pass
    except (RuntimeError, TypeError):
        # A signal can shut the middleware down at any moment; rclpy then raises one or the other.
        if rclpy.utilities.ok():
            raise
    finally:
        if isinstance(executor, _Threads):
            if isinstance(node, SemNode):
                # Ends what a callback may be waiting for.
                node.closing.close()
            executor.wait_for_callbacks(_CALLBACKS_S)
        if executor is not None:
            executor.shutdown(timeout_sec=1.0)
        node.destroy_node()
    return int(getattr(node, "exit_status", 0))
