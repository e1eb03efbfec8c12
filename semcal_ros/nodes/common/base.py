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

"""What all nodes of the suite share: configuration, parameters, statistics, diagnostics, shutdown."""

from __future__ import annotations

import time
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import replace
from importlib import import_module

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter

from semcal_ros.bridge.diagnostics import (
    DiagnosticLevel,
    DiagnosticSummary,
    fill_diagnostic_status,
    join_states,
    split_states,
)
from semcal_ros.config.config import load_config
from semcal_ros.core.wording import nearest_name
from semcal_ros.nodes.common.command_line import EXECUTABLES, HelpWanted, command_line, is_quality
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.endpoints import Endpoints
from semcal_ros.nodes.common.parameters import (
    CONFIG,
    DIAGNOSTICS_PERIOD,
    ParameterDeclaration,
    Parameters,
)
from semcal_ros.nodes.common.reporter import Reporter

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
    node_context
        All of these, for inputs and outputs that are objects of their own.
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
        declared = (CONFIG, DIAGNOSTICS_PERIOD, *declarations)
        if command_line().wants_help:
            raise HelpWanted(name, declared)
        super().__init__(name, namespace=DEFAULT_NAMESPACE)
        self._executable = name
        self.parameters = Parameters(self, declared)
        unused = self._unused_parameters(of_topics=False)
        self.config = load_config(self.parameters["config"])
        self.endpoints = Endpoints(self)
        self.reporter = Reporter(self.get_logger(), self.get_clock())
        self.node_context = NodeContext(
            self, self.config, self.parameters, self.endpoints, self.reporter
        )
        if unused and not command_line().of_several:
            self.reporter.warn(f"not parameters of this node, and ignored: {', '.join(unused)}")
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

    def introduction(self) -> list[str]:
        """Return what a user who starts the node wants to know, a few words each."""
        about = EXECUTABLES.get(self._executable)
        purpose = self._executable if about is None else about.purpose.rstrip(".")
        return [purpose, f"config {self.config.name}"]

    def introduce(self) -> None:
        """Say in one line of the log what the finished node is, and where it listens and speaks; warn of names that
        were to be changed and that it does not use.
        """
        unused = self._unused_renamings()
        if unused and not command_line().of_several:
            self.reporter.warn(
                f"not topics or services of this node, and not renamed: {', '.join(unused)}"
            )
        topics = self.endpoints.describe_topics()
        self.reporter.info("; ".join([*self.introduction(), *filter(None, [topics])]))

    def begin(self) -> None:
        """Begin what does not wait for the executor, once the node has been accepted."""

    # -- parameters --------------------------------------------------------------------------------

    def _unused_parameters(self, *, of_topics: bool) -> list[str]:
        """Return what :meth:`CommandLine.unused_names` does, for the parameters of topics or for all others."""
        given = [name for name in self._parameter_overrides if is_quality(name) == of_topics]
        return command_line().unused_names(given, self._parameters, self.get_fully_qualified_name())

    def _unused_renamings(self) -> list[str]:
        """Return renamed topics and services that this node does not have, with the name that was meant, perhaps.

        A launch file may rename for all nodes of a group, so that they cannot be refused.
        """
        topics = {str(e.topic_name) for e in (*self.publishers, *self.subscriptions)}
        services = {self.resolve_service_name(e.srv_name) for e in (*self.services, *self.clients)}
        unused = []
        for name in command_line().renamed_topics(self.get_name()):
            renamed = self.resolve_topic_name(name), self.resolve_service_name(name)
            if renamed[0] not in topics and renamed[1] not in services:
                known = [t.removeprefix(f"{self.get_namespace()}/") for t in topics | services]
                near = nearest_name(name, known)
                unused.append(f"{name} ({near}, perhaps)" if near else name)
        return unused

    def unknown_parameters(self) -> set[str]:
        """Return given parameters that the finished node does not have, topics' qualities included."""
        return {*self._unused_parameters(of_topics=False), *self._unused_parameters(of_topics=True)}

    def refuse_unknown_topics(self) -> None:
        """Refuse ``qos_overrides`` of topics that the finished node does not have.

        Raises
        ------
        InvalidValueError
            As :meth:`CommandLine.unused_names`.
        """
        self._unused_parameters(of_topics=True)

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """Extend the base class: a read-only parameter accepts the value that it has.

        ``ros2 param load`` of a dump sets all parameters, those too.
        """
        changed = [p for p in parameter_list if not self._is_unchanged_constant(p)]
        if not changed and parameter_list:
            return SetParametersResult(successful=True)
        return super().set_parameters_atomically(changed)

    def _is_unchanged_constant(self, parameter: Parameter) -> bool:
        name = parameter.name
        if not self.has_parameter(name) or not self.describe_parameter(name).read_only:
            return False
        value = self.get_parameter(name).value
        return type(value) is type(parameter.value) and bool(value == parameter.value)

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
        message = join_states([*split_states(summary.message), *conditions])
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


def node_class(executable: str) -> type[SemNode]:
    """Return the class of the node that an executable runs."""
    module = import_module(f"semcal_ros.nodes.{executable}")
    (kind,) = (
        made
        for made in vars(module).values()
        if isinstance(made, type) and issubclass(made, SemNode)
        if made.__module__ == module.__name__
    )
    return kind
