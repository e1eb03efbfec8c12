"""An end that leaves time for a last message."""

from __future__ import annotations

import signal
from typing import Any

from rclpy.executors import ExternalShutdownException
from rclpy.signals import uninstall_signal_handlers

__all__ = ["OrderlyEnd"]


class OrderlyEnd:
    """From now on SIGINT and SIGTERM are only noted, until :meth:`follow` is called.

    ROS itself would shut the middleware down at once, and ``destroy_node`` could publish nothing any more. To be made
    in the main thread, once ROS is up.
    """

    def __init__(self) -> None:
        self._asked = False
        uninstall_signal_handlers()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._note)

    def _note(self, _number: int, _frame: Any) -> None:
        # Raised here, it would come out anywhere, where something else may swallow it.
        self._asked = True

    def follow(self) -> None:
        """End the spinning if that was asked for; to be called by a timer, which also lets Python hear of signals."""
        if self._asked:
            raise ExternalShutdownException
