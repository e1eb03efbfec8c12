"""The magnification that was valid at each image of a recording."""

from __future__ import annotations

from typing import Any

from semcal_ros.bridge.headers import optional_stamp_ns
from semcal_ros.bridge.magnification import MagnificationReading, read_magnification
from semcal_ros.bridge.zero_order_hold import ZeroOrderHold
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.errors import SemcalError
from semcal_ros.files.bags.reader import BagReader, RawMessage

__all__ = ["MagnificationTrack"]


class MagnificationTrack:
    """All magnification messages of a topic, each valid until the next one.

    Times are header stamps if every message has one, else the times of the recorder. A message with
    a bad value ends the validity of the one before it, so that no image gets a magnification that the
    microscope may have left.

    Attributes
    ----------
    bad
        Reasons why messages were ignored.
    usable
        Number of messages with a usable value.
    by_stamp
        Whether header stamps are compared with those of the images, not the times of the recorder.
    """

    def __init__(self, reader: BagReader, topic: str, config: MicroscopeConfig) -> None:
        self.bad: list[str] = []
        self.usable = 0
        rows = [self._row(reader, raw, config) for raw in reader.raw_messages([topic])]
        self.by_stamp = bool(rows) and all(stamp_ns for stamp_ns, _, _ in rows)
        self._hold = ZeroOrderHold[Any](max_length=max(1, len(rows)))
        timed = [(stamp_ns if self.by_stamp else logged, value) for stamp_ns, logged, value in rows]
        for time_ns, value in sorted(timed, key=lambda pair: pair[0] or 0):
            self._hold.insert(time_ns or 0, value)

    def _row(
        self, reader: BagReader, raw: RawMessage, config: MicroscopeConfig
    ) -> tuple[int | None, int, MagnificationReading | None]:
        """Header stamp (None without one), receive time, and the reading (None if it is bad)."""
        stamp_ns = None
        try:
            message = reader.decode(raw)
            stamp_ns = optional_stamp_ns(message)
            reading = read_magnification(message, config)
        except SemcalError as error:
            self.bad.append(str(error))
            return stamp_ns, raw.log_time_ns, None
        self.usable += 1
        return stamp_ns, raw.log_time_ns, reading

    def at(self, stamp_ns: int, log_time_ns: int, image_width_px: int) -> float | None:
        """Return the magnification at an image, or None before the first message and after a bad one.

        Raises
        ------
        MessageError
            A pixel size gives no credible magnification for an image of this width.
        """
        reading = self._hold.at(stamp_ns if self.by_stamp else log_time_ns)
        return None if reading is None else float(reading.magnification(image_width_px))
