"""Which magnification a frame was taken at."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from semcal_ros.bridge import (
    MagnificationReading,
    MicroscopeConfig,
    ZeroOrderHold,
    optional_stamp_ns,
    read_magnification,
)
from semcal_ros.core.errors import SemcalError
from semcal_ros.nodes.base import SemNode
from semcal_ros.nodes.message_types import message_class
from semcal_ros.nodes.qos import value_input
from semcal_ros.nodes.subscription import MessageInfo, published_ns

__all__ = ["MagnificationInput"]

_KEPT = 4096


class MagnificationInput:
    """History of the magnification topic.

    A value is valid from its stamp on. Message types without a header count from when they were
    published, as do then the frames: the order in which the microscope publishes decides, whatever
    the order of arrival and the rate of a replay. A message that cannot be used makes the
    magnification unknown until the next good one.

    Parameters
    ----------
    node
        The node; its configuration says what the topic carries.
    on_reading
        Called with each good reading.
    """

    def __init__(self, node: SemNode, on_reading: Any = None, group: Any = None) -> None:
        source = node.config.magnification
        self._node = node
        self._on_reading = on_reading
        self._history: ZeroOrderHold[MagnificationReading | None] = ZeroOrderHold(_KEPT)
        message_type = message_class(source.type)
        self._has_stamp = optional_stamp_ns(message_type()) is not None
        self._subscription = node.listen(
            message_type, source.topic, self._on_message, value_input(), group
        )
        self.received = 0

    def _on_message(self, message: Any, info: MessageInfo) -> None:
        self.received += 1
        key_ns = published_ns(info)
        reading: MagnificationReading | None = None
        try:
            if self._has_stamp:
                key_ns = optional_stamp_ns(message) or 0
            reading = read_magnification(message, self._node.config)
        except SemcalError as error:
            self._node.reject(error)
        self._history.insert(key_ns, reading)
        if reading is not None and self._on_reading is not None:
            self._on_reading(reading)

    def at(
        self, stamp_ns: int, sent_ns: int, image_width_px: int, config: MicroscopeConfig
    ) -> float | None:
        """Magnification of a frame, or None while it is not known.

        Parameters
        ----------
        stamp_ns, sent_ns
            Header stamp of the frame, and when the microscope published it.
        image_width_px
            Width of the frame.
        config
            The configuration in force, whose display width is that of the calibration.

        Raises
        ------
        MessageError
            The magnification is out of all reason for frames of this width.
        """
        self._subscription.take_waiting()
        reading = self._history.at(stamp_ns if self._has_stamp else sent_ns)
        if reading is None:
            return None
        return replace(reading, config=config).magnification(image_width_px)
