"""What all nodes of the suite share: configuration, parameters, statistics, diagnostics, shutdown."""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import replace

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from semcal_ros.bridge.diagnostics import (
    DiagnosticLevel,
    DiagnosticSummary,
    fill_diagnostic_status,
)
from semcal_ros.config.config import load_config
from semcal_ros.nodes.common.endpoints import Endpoints
from semcal_ros.nodes.common.parameters import (
    CONFIG,
    DIAGNOSTICS_PERIOD,
    ParameterDeclaration,
    Parameters,
)
from semcal_ros.nodes.common.reporter import Reporter

__all__ = ["DEFAULT_NAMESPACE", "SemNode"]

DEFAULT_NAMESPACE = "sem"
"""Namespace of a node that is started without one. All topics have relative names, and the nodes of one microscope
find each other in one namespace; `-r __ns:=/lab/sem` or the argument `namespace` of the launch files changes it."""


class SemNode(Node):
    """A node with the parameter ``config``, and a report on ``/diagnostics``, usually once a second.

    Parameters
    ----------
    name
        Name of the node; its namespace is :data:`DEFAULT_NAMESPACE` unless it is remapped.
    declarations
        Further parameters.

    Attributes
    ----------
    config
        The configuration that the parameter names.
    parameters, endpoints, reporter
        The values of the parameters; the factory of publishers, subscriptions and services; the counters and
        the log.
    closing
        What to close before the node is destroyed, in reverse order. A node whose constructor failed is destroyed
        too, and closes what it had opened.

    Raises
    ------
    SemcalError
        A parameter or the configuration is wrong.
    """

    def __init__(self, name: str, declarations: Iterable[ParameterDeclaration] = ()) -> None:
        # First: the middleware may destroy a node whose constructor is still running.
        self.closing = ExitStack()
        super().__init__(name, namespace=DEFAULT_NAMESPACE)
        self.parameters = Parameters(self, (CONFIG, DIAGNOSTICS_PERIOD, *declarations))
        self.config = load_config(self.parameters["config"])
        self.endpoints = Endpoints(self)
        self.reporter = Reporter(self.get_logger(), self.get_clock())
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._report_timer = self.create_timer(
            self.parameters["diagnostics_period"],
            self._report,
            callback_group=MutuallyExclusiveCallbackGroup(),
            # A simulated clock may stand still; the report must not.
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )

    def destroy_node(self) -> None:
        """Close what :attr:`closing` holds, then destroy the node as the base class does."""
        self.closing.close()
        super().destroy_node()

    # -- diagnostics -------------------------------------------------------------------------------

    def conditions(self) -> list[str]:
        """Return what is wrong at present, a few words each."""
        return self.endpoints.conditions()

    def idle(self) -> bool:
        """Return whether this node has no stream whose silence would be worth reporting."""
        return False

    def _summary(self) -> DiagnosticSummary:
        statistics = self.reporter.statistics
        for topic, count in self.endpoints.subscriber_counts().items():
            statistics.note(f"subscribers.{topic}", count)
        summary = statistics.summary(time.monotonic())
        if self.idle() and summary.level == DiagnosticLevel.STALE:
            summary = replace(summary, level=DiagnosticLevel.OK, message="ready")
        conditions = self.conditions()
        if not conditions:
            return summary
        message = "; ".join([summary.message, *conditions])
        level = DiagnosticLevel(max(summary.level, DiagnosticLevel.WARN))
        return replace(summary, level=level, message=message)

    def status(self) -> DiagnosticStatus:
        """Return the current state as a message."""
        status = DiagnosticStatus()
        name = f"{self.get_fully_qualified_name()}: stream"
        fill_diagnostic_status(status, name, self.config.name, self._summary())
        return status

    def _report(self) -> None:
        self.endpoints.check_publishers()
        array = DiagnosticArray()
        array.header.stamp = self.get_clock().now().to_msg()
        array.status = [self.status()]
        self._diagnostics.publish(array)
