"""What all nodes of the suite share: configuration, parameters, counters, diagnostics."""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import cv2
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile

from semcal_ros.bridge.diagnostics import (
    DiagnosticLevel,
    DiagnosticSummary,
    StreamStatistics,
    fill_diagnostic_status,
)
from semcal_ros.config.config import load_config
from semcal_ros.core.errors import SemcalError
from semcal_ros.nodes.common.parameters import CONFIG, Setting, Settings
from semcal_ros.nodes.common.qos import latched, overridable, stream_output
from semcal_ros.nodes.common.subscription import AdaptiveSubscription

__all__ = ["NODE_ERRORS", "SemNode"]

NODE_ERRORS = (SemcalError, cv2.error)
"""What a message can cause; a node counts it, reports it and goes on."""

_LOG_AGAIN_S = 10.0
# Different warnings within that time, so that one whose numbers change does not flood the log.
_LOGGED_AT_ONCE = 100
# A stamp further away than this is that of another clock, such as a replay without simulated time.
_OTHER_CLOCK_S = 3600.0


class SemNode(Node):
    """A node with the parameter ``config``, statistics, and a report on ``/diagnostics`` once a second.

    Parameters
    ----------
    name
        Name of the node; its namespace is ``/sem`` unless it is remapped.
    settings
        Further parameters.

    Raises
    ------
    SemcalError
        A parameter or the configuration is wrong.
    """

    def __init__(self, name: str, settings: Iterable[Setting] = ()) -> None:
        super().__init__(name, namespace="sem")
        self.settings = Settings(self, (CONFIG, *settings))
        self.config = load_config(self.settings["config"])
        self.statistics = StreamStatistics()
        self.adaptive: list[AdaptiveSubscription] = []
        self._logged: dict[str, float] = {}
        self._outputs: dict[str, Any] = {}
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._report_timer = self.create_timer(
            1.0,
            self._report,
            callback_group=MutuallyExclusiveCallbackGroup(),
            # A simulated clock may stand still; the report must not.
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )

    # -- entities ----------------------------------------------------------------------------------

    def listen(
        self,
        message_type: Any,
        topic: str,
        callback: Any,
        profile: QoSProfile,
        group: Any = None,
        *,
        raw: bool = False,
    ) -> AdaptiveSubscription:
        """Subscribe; the callback takes the message, or its bytes if ``raw``, and its information."""
        subscription = AdaptiveSubscription(
            self, message_type, topic, callback, profile, group, raw=raw
        )
        self.adaptive.append(subscription)
        return subscription

    def stream_publisher(self, message_type: Any, topic: str) -> Any:
        """Publisher of what belongs to single frames."""
        return self._publisher(message_type, topic, stream_output())

    def latched_publisher(self, message_type: Any, topic: str) -> Any:
        """Publisher whose last message reaches those who come later."""
        return self._publisher(message_type, topic, latched())

    def _publisher(self, message_type: Any, topic: str, profile: QoSProfile) -> Any:
        options = overridable()
        publisher = self.create_publisher(
            message_type, topic, profile, qos_overriding_options=options
        )
        self._outputs[topic] = publisher
        return publisher

    # -- counting ----------------------------------------------------------------------------------

    def reject(self, error: Exception) -> None:
        """Count an unusable message and log its reason, though not again and again."""
        reason = " ".join(str(error).split())
        self.statistics.reject(reason)
        self.warn_seldom(reason)

    def warn_seldom(self, text: str) -> None:
        """Log a warning unless the same was logged in the last seconds."""
        now_s = time.monotonic()
        if now_s - self._logged.get(text, -_LOG_AGAIN_S) < _LOG_AGAIN_S:
            return
        if len(self._logged) >= _LOGGED_AT_ONCE:
            recent = {t: s for t, s in self._logged.items() if now_s - s < _LOG_AGAIN_S}
            self._logged = recent
            if len(recent) >= _LOGGED_AT_ONCE:
                return
        self._logged[text] = now_s
        self.get_logger().warning(text)

    def count_published(self, stamp_ns: int | None) -> None:
        """Count a result, with its latency where the stamp is one of this clock."""
        latency_s: float | None = None
        if stamp_ns is not None:
            latency_s = (self.get_clock().now().nanoseconds - stamp_ns) * 1e-9
            if abs(latency_s) > _OTHER_CLOCK_S:
                latency_s = None
        self.statistics.publish(time.monotonic(), latency_s)

    # -- diagnostics -------------------------------------------------------------------------------

    def conditions(self) -> list[str]:
        """What is not as it should be at present, in a few words each."""
        weak = [f"{s.topic} without {s.downgraded}" for s in self.adaptive if s.downgraded]
        foreign = [(s.topic, s.foreign_types) for s in self.adaptive if s.foreign_types]
        return weak + [f"{types} on {topic}" for topic, types in foreign]

    def idle(self) -> bool:
        """Whether this node has no stream whose silence would be news."""
        return False

    def _summary(self) -> DiagnosticSummary:
        for topic, publisher in self._outputs.items():
            count = publisher.get_subscription_count()
            self.statistics.note(f"subscribers.{topic}", count)
        summary = self.statistics.summary(time.monotonic())
        if self.idle() and summary.level == DiagnosticLevel.STALE:
            summary = replace(summary, level=DiagnosticLevel.OK, message="ready")
        conditions = self.conditions()
        if not conditions:
            return summary
        message = "; ".join([summary.message, *conditions])
        level = DiagnosticLevel(max(summary.level, DiagnosticLevel.WARN))
        return replace(summary, level=level, message=message)

    def status(self) -> DiagnosticStatus:
        """The current state as a message."""
        status = DiagnosticStatus()
        name = f"{self.get_fully_qualified_name()}: stream"
        fill_diagnostic_status(status, name, self.config.name, self._summary())
        return status

    def _report(self) -> None:
        for subscription in self.adaptive:
            subscription.tend()
        array = DiagnosticArray()
        array.header.stamp = self.get_clock().now().to_msg()
        array.status = [self.status()]
        self._diagnostics.publish(array)
