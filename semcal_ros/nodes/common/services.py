"""Services that do something and answer with a sentence."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.qos import QoSProfile
from std_srvs.srv import Trigger

from semcal_ros.nodes.common.base import NODE_ERRORS, SemNode

__all__ = ["service_queue", "trigger_service"]

# As many as parameter services keep: of the usual ten, requests of busy clients would be lost and never answered.
_WAITING = 1000


def service_queue() -> QoSProfile:
    """Quality of a service that keeps all requests of busy clients."""
    return QoSProfile(depth=_WAITING)


def trigger_service(
    node: SemNode,
    name: str,
    handler: Callable[[], str],
    group: Any = None,
    on_answer: Callable[[bool, str], None] | None = None,
) -> Any:
    """A std_srvs/Trigger service.

    Parameters
    ----------
    node, name, group
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
            node.get_logger().warning(f"{name}: {response.message}")
        if on_answer is not None:
            on_answer(response.success, response.message)
        return response

    return node.create_service(
        Trigger, name, answer, qos_profile=service_queue(), callback_group=group
    )
