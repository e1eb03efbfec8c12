"""Frames with their magnification, as the stream nodes take them in."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import rclpy
from numpy.typing import NDArray

from semcal_ros.bridge.compressed import decoded_image
from semcal_ros.bridge.headers import stamp_ns_from_msg
from semcal_ros.bridge.images import without_databar
from semcal_ros.config.config import IMAGE_TYPE
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.middleware.message_types import message_class
from semcal_ros.middleware.transport_advice import transport_advice
from semcal_ros.nodes.common.base import NODE_ERRORS, SemNode
from semcal_ros.nodes.common.parameters import Setting
from semcal_ros.nodes.common.qos import image_input
from semcal_ros.nodes.common.subscription import MessageInfo, published_ns
from semcal_ros.nodes.frames.magnification import MagnificationInput
from semcal_ros.nodes.frames.publication_times import SourceTimestamps

__all__ = ["FrameInput", "StreamFrame", "StreamNode", "nominal_camera"]

# The same from frame to frame as long as nobody turns the knob.
nominal_camera = lru_cache(maxsize=4)(ScanCamera.nominal)

# Images that have waited for longer, in s and in intervals between frames, make way for newer ones.
_LATE_S, _LATE_INTERVALS = 0.04, 1.5
# Then timers and services have their turn.
_AT_ONCE = 8

_MIXED = Setting(
    "mixed_frames",
    "drop",
    "What becomes of frames that were being scanned while the magnification changed. flag: published, uncorrected for"
    " drift, with a camera_info that says uncalibrated.",
    choices=("drop", "flag"),
)


@dataclass(frozen=True)
class StreamFrame:
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
    mixed
        Whether the magnification changed while the frame was being scanned.
    interval_s
        Since the frame before was published, lost ones counted; None where there was none.
    """

    image: NDArray[Any]
    encoding: str
    header: Any
    stamp_ns: int
    magnification: float | None
    mixed: bool = False
    interval_s: float | None = None

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
        on_frame: Callable[[StreamFrame], None],
        topic: str | None = None,
        databar_rows: int | None = None,
        group: Any = None,
    ) -> None:
        source = node.config.image
        self._node = node
        self._on_frame = on_frame
        self._databar_rows = source.databar_rows if databar_rows is None else databar_rows
        # Before the images, so that a late-joining node knows the magnification of its first frame.
        self._magnification = MagnificationInput(node, group=group)
        # What another node of the suite made from the microscope's images is not compressed.
        kind = message_class(IMAGE_TYPE if topic else source.type)
        self._sent = SourceTimestamps(node, source if topic else None)
        self._images = node.listen(
            kind, topic or source.topic, self._on_images, image_input(), group
        )
        self._hurries = self._images.depth <= image_input().depth
        self._lost = 0
        self._passed_over = 0
        self._restarts = 0
        self._sent_ns: int | None = None
        self._last_interval_s = 0.0
        self._mixed = 0

    def _on_images(self, message: Any, info: MessageInfo) -> None:
        """Work on the images that have come, oldest first, but go on to newer ones from those that are late.

        Images that wait are taken without going back to the executor, whose turns cost more than that. Who has chosen a
        longer queue wants none passed over.
        """
        taken: tuple[Any, MessageInfo] | None = (message, info)
        for _ in range(_AT_ONCE):
            if taken is None:
                return
            while (
                self._hurries
                and self._is_late(taken[1])
                and (newer := self._images.take()) is not None
            ):
                self._passed_over += 1
                taken = newer
            self._on_image(*taken)
            taken = self._images.take()
        if taken is not None:
            self._on_image(*taken)

    def _is_late(self, info: MessageInfo) -> bool:
        received_ns = info["received_timestamp"]
        waited_s = (time.time_ns() - received_ns) * 1e-9 if received_ns else 0.0
        return waited_s > max(_LATE_S, _LATE_INTERVALS * self._last_interval_s)

    def _on_image(self, message: Any, info: MessageInfo) -> None:
        node = self._node
        started_s = time.monotonic()
        node.statistics.receive(started_s)
        node.check_transport(len(message.data))
        missed = self._images.lost + self._passed_over - self._lost
        self._lost += missed
        node.statistics.drop(missed)
        if self._images.restarts != self._restarts and self._sent_ns is not None:
            self._magnification.doubt(self._sent_ns)
        self._restarts = self._images.restarts
        interval_s = self._interval_s(published_ns(info), missed)
        try:
            frame = self._frame(message, info, interval_s)
            if not (frame.mixed and node.settings["mixed_frames"] == "drop"):
                self._on_frame(frame)
        except NODE_ERRORS as error:
            node.reject(error)
        node.statistics.note("processing_ms", 1e3 * (time.monotonic() - started_s))

    def _interval_s(self, sent_ns: int, missed: int) -> float | None:
        before, self._sent_ns = self._sent_ns, sent_ns
        if before is None or sent_ns < before:
            return None
        self._last_interval_s = (sent_ns - before) * 1e-9 / (missed + 1)
        return self._last_interval_s

    def _frame(self, message: Any, info: MessageInfo, interval_s: float | None) -> StreamFrame:
        node = self._node
        pixels, encoding = decoded_image(message)
        image = without_databar(pixels, self._databar_rows)
        stamp_ns = stamp_ns_from_msg(message)
        sent_ns = self._sent.of(stamp_ns, info)
        g = self._magnification.at(stamp_ns, sent_ns, image.shape[1], node.effective_config)
        mixed = self._magnification.changed_during(stamp_ns, sent_ns)
        self._mixed += mixed
        node.statistics.note("magnification", "unknown" if g is None else g)
        node.statistics.note("frames_mixed", self._mixed)
        return StreamFrame(image, encoding, message.header, stamp_ns, g, mixed, interval_s)


class StreamNode(SemNode):
    """A node that consumes frames."""

    def __init__(self, name: str, settings: Iterable[Setting] = ()) -> None:
        # What is to be ended with the node; one that could not be made completely is destroyed, too.
        self.closing = ExitStack()
        super().__init__(name, (_MIXED, *settings))
        self._waiting = 0
        self._is_waiting = False
        self._image_bytes = 0
        self._transport = ""

    def destroy_node(self) -> None:
        """As in the base class, after what is to be ended first."""
        self.closing.close()
        super().destroy_node()

    @property
    def effective_config(self) -> Any:
        """The configuration by which magnifications are read."""
        return self.config

    def known_magnification(self, frame: StreamFrame) -> float | None:
        """The magnification of a frame; counts a frame without."""
        self._is_waiting = frame.magnification is None
        if frame.magnification is None:
            self._waiting += 1
            self.statistics.note("frames_without_magnification", self._waiting)
            self.warn_seldom(
                f"waiting for a magnification on {self.config.magnification.topic}: frames before it are not used"
            )
        return frame.magnification

    def check_transport(self, image_bytes: int) -> None:
        """See whether this process is set up for images of that size."""
        if image_bytes != self._image_bytes:
            self._image_bytes = image_bytes
            rmw = rclpy.get_rmw_implementation_identifier()
            self._transport = transport_advice(image_bytes, os.environ, rmw)

    def conditions(self) -> list[str]:
        """As in the base class; also a missing magnification, and images too large for the transport."""
        waiting = ["waiting for magnification"] if self._is_waiting else []
        return super().conditions() + waiting + [self._transport] * bool(self._transport)
