"""Where the stage was when a frame was taken."""

from __future__ import annotations

from typing import Any

from rclpy.callback_groups import CallbackGroup

from semcal_ros.bridge.headers import stamp_ns_from_msg
from semcal_ros.bridge.stage import doubt_unit, read_stage
from semcal_ros.bridge.zero_order_hold import ZeroOrderHold
from semcal_ros.config.config import StageConfig
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.errors import MessageError, SemcalError
from semcal_ros.middleware.message_types import message_class
from semcal_ros.nodes.common.endpoints import Endpoints
from semcal_ros.nodes.common.qos import value_input
from semcal_ros.nodes.common.reporter import Reporter
from semcal_ros.nodes.common.subscription import MessageInfo, published_ns

__all__ = ["StageInput"]

# More changes than can precede a late frame.
_KEPT = 4096


class StageInput:
    """History of the topic of the stage; a reading is valid from its stamp to the next one.

    Messages without a stamp count when they arrive. An unusable message makes the stage unknown until
    the next usable one.

    Parameters
    ----------
    source
        What the topic carries; None for no stage.
    endpoints, reporter
        Where to subscribe, and the counter of unusable messages.
    group
        Callback group of the subscription.
    """

    def __init__(
        self,
        source: StageConfig | None,
        endpoints: Endpoints,
        reporter: Reporter,
        group: CallbackGroup | None = None,
    ) -> None:
        self._source = source
        self._reporter = reporter
        self._history: ZeroOrderHold[StageReading | None] = ZeroOrderHold(_KEPT)
        self._stamped = True
        if source is not None:
            self._subscription = endpoints.subscribe(
                message_class(source.type), source.topic, self._on_message, value_input(), group
            )

    def _on_message(self, message: Any, info: MessageInfo) -> None:
        reading, stamp_ns = None, 0
        try:
            stamp_ns = stamp_ns_from_msg(message)
            reading = self._read(message)
        except SemcalError as error:
            self._reporter.reject(error)
        stamped = stamp_ns != 0
        if stamped != self._stamped:
            self._history.clear()
            self._stamped = stamped
        self._history.insert(stamp_ns or published_ns(info), reading)

    def _read(self, message: Any) -> StageReading | None:
        if self._source is None:
            return None
        reading = read_stage(message, self._source)
        if doubt := doubt_unit(reading, self._source):
            raise MessageError(
                f"a stage with {doubt}",
                expected="radians; this looks like degrees",
                do="publish radians",
            )
        return reading

    def at(self, stamp_ns: int) -> StageReading | None:
        """Return the reading of a frame with this stamp, or None while it is unknown."""
        if self._source is None:
            return None
        self._subscription.take_waiting()
        newest_ns = self._history.newest_ns
        reading = None
        if newest_ns is not None:
            reading = self._history.at(stamp_ns if self._stamped else newest_ns)
        tilt = None if reading is None else reading.tilt_rad
        self._reporter.note("stage_tilt_rad", "unknown" if tilt is None else tilt)
        return reading
