"""Frames with their magnification, as the stream nodes take them in."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray
from sensor_msgs.msg import Image

from semcal_ros.bridge import (
    image_from_message,
    stamp_ns_from_msg,
    without_databar,
)
from semcal_ros.core.errors import ConfigError
from semcal_ros.nodes.base import NODE_ERRORS, SemNode
from semcal_ros.nodes.magnification import MagnificationInput
from semcal_ros.nodes.qos import image_input
from semcal_ros.nodes.sending_times import SendingTimes
from semcal_ros.nodes.settings import Setting
from semcal_ros.nodes.subscription import MessageInfo

__all__ = ["Frame", "FrameInput", "StreamNode"]

_IMAGE_TYPE = "sensor_msgs/msg/Image"


@dataclass(frozen=True)
class Frame:
    """One frame.

    Attributes
    ----------
    image
        (h, w) or (h, w, 3) without data bar, read-only.
    encoding, header
        As received.
    stamp_ns
        Stamp of the header.
    magnification
        Magnification, or None while it is not known.
    """

    image: NDArray[Any]
    encoding: str
    header: Any
    stamp_ns: int
    magnification: float | None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in px."""
        return self.image.shape[1], self.image.shape[0]


class FrameInput:
    """Subscribes to image and magnification and hands on each frame with the magnification it was taken at.

    Parameters
    ----------
    node
        The node.
    on_frame
        Called with each frame; what it raises of :data:`NODE_ERRORS` is counted.
    topic, databar_rows
        Where the images are, if they are not the microscope's own but made from these, and how many rows at the
        bottom are text; those of the configuration without.
    group
        Callback group of both subscriptions.
    """

    def __init__(
        self,
        node: StreamNode,
        on_frame: Callable[[Frame], None],
        topic: str | None = None,
        databar_rows: int | None = None,
        group: Any = None,
    ) -> None:
        source = node.config.image
        if source.type != _IMAGE_TYPE:
            raise ConfigError(f"image type {source.type}", expected=_IMAGE_TYPE)
        self._node = node
        self._on_frame = on_frame
        self._databar_rows = source.databar_rows if databar_rows is None else databar_rows
        # Before the images, so that a late-joining node knows the magnification of its first frame.
        self._magnification = MagnificationInput(node, group=group)
        self._sent = SendingTimes(node, source.topic if topic else None)
        self._images = node.listen(
            Image, topic or source.topic, self._on_image, image_input(), group
        )
        self._lost = 0

    def _on_image(self, message: Any, info: MessageInfo) -> None:
        node = self._node
        started_s = time.monotonic()
        node.statistics.receive(started_s)
        node.statistics.drop(self._images.lost - self._lost)
        self._lost = self._images.lost
        try:
            image = without_databar(image_from_message(message), self._databar_rows)
            stamp_ns = stamp_ns_from_msg(message)
            sent_ns = self._sent.of(stamp_ns, info)
            g = self._magnification.at(stamp_ns, sent_ns, image.shape[1], node.effective_config)
            node.statistics.note("magnification", "unknown" if g is None else g)
            self._on_frame(Frame(image, message.encoding, message.header, stamp_ns, g))
        except NODE_ERRORS as error:
            node.reject(error)
        node.statistics.note("processing_ms", 1e3 * (time.monotonic() - started_s))


class StreamNode(SemNode):
    """A node that consumes frames."""

    def __init__(self, name: str, settings: Iterable[Setting] = ()) -> None:
        super().__init__(name, settings)
        self._waiting = 0
        self._is_waiting = False

    @property
    def effective_config(self) -> Any:
        """The configuration by which magnifications are read."""
        return self.config

    def known_magnification(self, frame: Frame) -> float | None:
        """The magnification of a frame; counts a frame without."""
        self._is_waiting = frame.magnification is None
        if frame.magnification is None:
            self._waiting += 1
            self.statistics.note("frames_without_magnification", self._waiting)
            self.warn_seldom(
                f"waiting for a magnification on {self.config.magnification.topic}: frames before it are not used"
            )
        return frame.magnification

    def conditions(self) -> list[str]:
        """As in the base class; also whether the magnification is missing."""
        waiting = ["waiting for magnification"] if self._is_waiting else []
        return super().conditions() + waiting
