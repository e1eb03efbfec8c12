"""The publishers, subscriptions and services of a node, made alike and watched together."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.guard_condition import GuardCondition
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from semcal_ros.nodes.common.qos import latched, overridable, service_queue, stream_output
from semcal_ros.nodes.common.reporter import NODE_ERRORS
from semcal_ros.nodes.common.subscription import AdaptiveSubscription, MessageInfo

__all__ = ["Endpoints"]


class Endpoints:
    """Makes what connects a node with others; everything that it makes lives as long as the node.

    Parameters
    ----------
    node
        The ROS node that owns what is made.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._subscriptions: list[AdaptiveSubscription] = []
        self._publishers: dict[str, Any] = {}

    def subscribe(
        self,
        message_type: Any,
        topic: str,
        callback: Callable[[Any, MessageInfo], None],
        profile: QoSProfile,
        group: CallbackGroup | None = None,
        *,
        raw: bool = False,
    ) -> AdaptiveSubscription:
        """Subscribe; the callback takes the message, or its bytes if ``raw``, and its information."""
        subscription = AdaptiveSubscription(
            self._node, message_type, topic, callback, profile, group, raw=raw
        )
        self._subscriptions.append(subscription)
        return subscription

    def stream_publisher(self, message_type: Any, topic: str) -> Any:
        """Publisher of what belongs to single frames."""
        return self._publisher(message_type, topic, stream_output())

    def latched_publisher(self, message_type: Any, topic: str) -> Any:
        """Publisher whose last message reaches late subscribers too."""
        return self._publisher(message_type, topic, latched())

    def _publisher(self, message_type: Any, topic: str, profile: QoSProfile) -> Any:
        publisher = self._node.create_publisher(
            message_type, topic, profile, qos_overriding_options=overridable()
        )
        self._publishers[topic] = publisher
        return publisher

    def guard(self, callback: Callable[[], None]) -> GuardCondition:
        """A condition that any thread may trigger, and whose callback the executor of the node runs."""
        return self._node.create_guard_condition(callback)

    def trigger_service(
        self,
        name: str,
        handler: Callable[[], str],
        group: CallbackGroup | None = None,
        on_answer: Callable[[bool, str], None] | None = None,
    ) -> Any:
        """A std_srvs/Trigger service, which does something and answers with a sentence.

        Parameters
        ----------
        name, group
            Where it is served.
        handler
            Does the work and returns the answer; what it raises of :data:`NODE_ERRORS` is the reason of a refusal.
        on_answer
            Called with success and answer.
        """

        def answer(_request: Any, response: Any) -> Any:
            try:
                response.message = handler()
                response.success = True
            except NODE_ERRORS as error:
                response.message = " ".join(str(error).split())
                response.success = False
                self._node.get_logger().warning(f"{name}: {response.message}")
            if on_answer is not None:
                on_answer(response.success, response.message)
            return response

        return self._node.create_service(
            Trigger, name, answer, qos_profile=service_queue(), callback_group=group
        )

    # -- watching ----------------------------------------------------------------------------------

    def check_publishers(self) -> None:
        """See who publishes on the topics subscribed to; to be called now and then."""
        for subscription in self._subscriptions:
            subscription.check_publishers()

    def subscriber_counts(self) -> dict[str, int]:
        """How many subscribers each topic of this node has."""
        return {topic: p.get_subscription_count() for topic, p in self._publishers.items()}

    def conditions(self) -> list[str]:
        """What is not as it should be with the topics subscribed to, in a few words each."""
        weak = [f"{s.topic} without {s.downgraded}" for s in self._subscriptions if s.downgraded]
        foreign = [(s.topic, s.foreign_types) for s in self._subscriptions if s.foreign_types]
        return weak + [f"{types} on {topic}" for topic, types in foreign]
