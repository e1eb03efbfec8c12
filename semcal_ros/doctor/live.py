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

"""Listens to the running system for a while; the only module of this folder that imports ROS."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import GetParameters
from rclpy.context import Context
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions

from semcal_ros.bridge.conditions import read_conditions
from semcal_ros.bridge.fields import optional_stamp_ns
from semcal_ros.bridge.magnification import MagnificationReading, read_magnification
from semcal_ros.bridge.stage import read_stage, require_radians
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.errors import SemcalError
from semcal_ros.doctor.graph_checks import CONDITIONS, Topic
from semcal_ros.doctor.observations import Arrival, Endpoint, Graph, NodeStatus, Session
from semcal_ros.doctor.stream_checks import describe_image
from semcal_ros.middleware import message_class

# Time for discovery, before which nothing is known.
_DISCOVERY_S = 1.0
# Longest wait for the parameter services, and again for their answers: a busy node answers late, a
# stuck one never. Chosen, not measured.
_ANSWER_S = 5.0
# Longest wait in one step of the executor: how late the end of the listening time is noticed.
_STEP_S = 0.05
# Messages that may wait while others are handled. Chosen, not measured.
_DEPTH = 50
# As many images as tell whether they have a data bar.
_KEPT_IMAGES = 2
_PARAMETERS = ("use_sim_time", "config")


def observe(
    config: MicroscopeConfig, topics: tuple[Topic, ...], namespace: str, seconds: float
) -> Session:
    """Observe the running system for some seconds.

    Parameters
    ----------
    config
        The microscope.
    topics
        The topics to check, image and magnification first; it subscribes to the images among them, to the stage
        and to `calibration`.
    namespace
        Namespace of the suite.
    seconds
        How long to listen, s.

    Raises
    ------
    RuntimeError
        The middleware does not start.
    SemcalError
        The configuration names a message type that is not installed.
    """
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = Node(f"semcal_doctor_{os.getpid()}", context=context, namespace=namespace)
        try:
            return _Observer(node, config, topics, namespace).session(seconds)
        finally:
            node.destroy_node()
    finally:
        rclpy.shutdown(context=context)


class _Observer:
    def __init__(
        self, node: Node, config: MicroscopeConfig, topics: tuple[Topic, ...], namespace: str
    ) -> None:
        self._node = node
        self._config = config
        self._topics = topics
        self._namespace = namespace
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)
        self._arrivals: dict[str, list[Arrival]] = {}
        self._images: deque[Any] = deque(maxlen=_KEPT_IMAGES)
        self._magnification: Any = None
        self._stage: Any = None
        self._conditions: dict[str, float | str] | None = None
        self._calibration: str | None = None
        self._statuses: dict[str, NodeStatus] = {}
        images, magnification = topics[:2]
        # What to do with a message, by topic, in addition to recording its arrival.
        self._takes: dict[str, Callable[[Any], None]] = {
            images.name: self._take_image,
            magnification.name: self._take_magnification,
            f"{namespace}/calibration": self._take_calibration,
            f"{namespace}/image_rect": lambda _message: None,
            f"{namespace}/image_stabilized": lambda _message: None,
            f"{namespace}/projection_stamped": lambda _message: None,
            f"{namespace}/projection_covariance_stamped": lambda _message: None,
        }
        self._takes.update({t.name: self._take_stage for t in topics if t.keys == "stage"})
        self._takes.update({t.name: self._take_conditions for t in topics if t.what == CONDITIONS})
        self._classes = {t.name: message_class(t.type) for t in topics if t.name in self._takes}
        self._subscribed: set[str] = set()
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, _DEPTH)

    def session(self, seconds: float) -> Session:
        """Listen, query the nodes, and return the result."""
        self._spin(lambda: False, _DISCOVERY_S + seconds, each=self._subscribe)
        graph = self._graph()
        answers = self._ask(graph.suite(self._namespace))
        values = {
            name: None if answer is None else (answer[0].bool_value, answer[1].string_value)
            for name, answer in answers.items()
            # A node without these parameters merely has the name of a node of the suite.
            if answer is None or len(answer) == len(_PARAMETERS)
        }
        reading, trouble = self._reading()
        stage, stage_trouble = self._stage_reading()
        return Session(
            seconds=seconds,
            graph=replace(graph, parameters=values),
            arrivals={name: tuple(heard) for name, heard in self._arrivals.items()},
            image=describe_image(self._images, self._config),
            reading=reading,
            reading_trouble=trouble,
            stage=stage,
            stage_trouble=stage_trouble,
            conditions=self._conditions,
            calibration_text=self._calibration,
            statuses=tuple(self._statuses.values()),
        )

    def _spin(
        self, done: Callable[[], bool], seconds: float, each: Callable[[], None] | None = None
    ) -> None:
        deadline = time.monotonic() + seconds
        while not done() and time.monotonic() < deadline:
            if each is not None:
                each()
            self._executor.spin_once(timeout_sec=_STEP_S)

    # -- messages ----------------------------------------------------------------------------------

    def _subscribe(self) -> None:
        """Listen to what has a publisher by now, with no more demands than all publishers meet."""
        for topic in self._topics:
            if topic.name not in self._takes or topic.name in self._subscribed:
                continue
            senders = [p for p in self._publishers(topic.name) if p.type == topic.type]
            if senders:
                self._subscribed.add(topic.name)
                quality = _least(senders)
                taking = self._taking(topic.name)
                self._node.create_subscription(
                    self._classes[topic.name],
                    topic.name,
                    taking,
                    quality,
                    # The checks report incompatibilities; the default handler would log them as well.
                    event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
                )

    def _taking(self, name: str) -> Any:
        # rclpy also accepts callbacks with the message's info, though its annotations do not.
        arrivals = self._arrivals.setdefault(name, [])

        def take(message: Any, info: Any) -> None:
            arrivals.append(
                Arrival(
                    info["received_timestamp"] or time.time_ns(),
                    info["source_timestamp"] or None,
                    optional_stamp_ns(message),
                )
            )
            self._takes[name](message)

        return take

    def _take_image(self, message: Any) -> None:
        self._images.append(message)

    def _take_magnification(self, message: Any) -> None:
        self._magnification = message

    def _take_stage(self, message: Any) -> None:
        self._stage = message

    def _take_conditions(self, message: Any) -> None:
        self._conditions = read_conditions(message)

    def _take_calibration(self, message: Any) -> None:
        self._calibration = message.data

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            name = status.name.removesuffix(": stream")
            if name != status.name and name.rpartition("/")[0] == self._namespace:
                level = int.from_bytes(status.level, "little")
                self._statuses[name] = NodeStatus(name, level, status.message)

    def _reading(self) -> tuple[MagnificationReading | None, str]:
        if self._magnification is None:
            return None, ""
        try:
            return read_magnification(self._magnification, self._config), ""
        except SemcalError as error:
            return None, str(error)

    def _stage_reading(self) -> tuple[StageReading | None, str]:
        source = self._config.stage
        if self._stage is None or source is None:
            return None, ""
        try:
            reading = read_stage(self._stage, source)
            require_radians(reading, source)
        except SemcalError as error:
            return None, str(error)
        return reading, ""

    # -- graph -------------------------------------------------------------------------------------

    def _graph(self) -> Graph:
        this_node = self._node.get_fully_qualified_name()
        names = [
            f"{namespace.rstrip('/')}/{name}"
            for name, namespace in self._node.get_node_names_and_namespaces()
        ]
        known = [name for name, _ in self._node.get_topic_names_and_types()]
        return Graph(
            nodes=tuple(sorted(name for name in names if name != this_node)),
            publishers={name: self._publishers(name) for name in known},
            subscriptions={
                name: self._endpoints(self._node.get_subscriptions_info_by_topic(name))
                for name in known
            },
        )

    def _publishers(self, topic: str) -> tuple[Endpoint, ...]:
        return self._endpoints(self._node.get_publishers_info_by_topic(topic))

    def _endpoints(self, infos: Iterable[Any]) -> tuple[Endpoint, ...]:
        this_node = self._node.get_fully_qualified_name()
        found = [
            Endpoint(
                f"{info.node_namespace.rstrip('/')}/{info.node_name}",
                info.topic_type,
                info.qos_profile.reliability == ReliabilityPolicy.RELIABLE,
                info.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL,
            )
            for info in infos
        ]
        return tuple(end for end in found if end.node != this_node)

    def _ask(self, nodes: tuple[str, ...]) -> dict[str, Any]:
        """Ask for the values of :data:`_PARAMETERS` by node; None for nodes that do not answer."""
        clients = {n: self._node.create_client(GetParameters, f"{n}/get_parameters") for n in nodes}
        self._spin(lambda: all(c.service_is_ready() for c in clients.values()), _ANSWER_S)
        request = GetParameters.Request(names=list(_PARAMETERS))
        futures = {n: c.call_async(request) for n, c in clients.items() if c.service_is_ready()}
        self._spin(lambda: all(future.done() for future in futures.values()), _ANSWER_S)
        return {
            n: futures[n].result().values if n in futures and futures[n].done() else None
            for n in nodes
        }


def _least(senders: list[Endpoint]) -> QoSProfile:
    reliable = all(sender.reliable for sender in senders)
    lasting = all(sender.transient_local for sender in senders)
    return QoSProfile(
        depth=_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if lasting else DurabilityPolicy.VOLATILE,
    )
