"""Start, spin and end of every executable."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

import rclpy
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

from semcal_ros.core.errors import SemcalError

__all__ = ["run_node"]

_START_ERRORS = (
    SemcalError,
    InvalidNamespaceException,
    InvalidNodeNameException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
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
        Command line; that of the process without it.
    threads
        Number of callbacks that may run at once.

    Returns
    -------
    Exit status: 0, or 2 after one line on stderr if the node cannot start with what it was given.
    """
    try:
        rclpy.init(args=None if args is None else [sys.argv[0], *args])
        return _spin(factory, threads)
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except _START_ERRORS as error:
        print(" ".join(str(error).split()), file=sys.stderr)
        return 2
    finally:
        rclpy.try_shutdown()


def _spin(factory: Callable[[], Node], threads: int) -> int:
    node: Node | None = None
    executor: Executor | None = None
    try:
        node = factory()
        executor = (
            MultiThreadedExecutor(num_threads=threads) if threads > 1 else SingleThreadedExecutor()
        )
        executor.add_node(node)
        executor.spin()
    except ExternalShutdownException:
        pass
    except RuntimeError:
        # A signal can shut the middleware down at any moment, even while the node is being made.
        if rclpy.ok():
            raise
    finally:
        if executor is not None:
            executor.shutdown(timeout_sec=1.0)
        if node is not None:
            node.destroy_node()
    return int(getattr(node, "exit_status", 0))
