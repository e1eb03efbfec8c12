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

"""Input of frames with their magnification for the stream nodes."""

from __future__ import annotations

import math
import os
import time
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from numpy.typing import NDArray
from rclpy.callback_groups import CallbackGroup
from rclpy.utilities import get_rmw_implementation_identifier

from semcal_ros.bridge.compressed import decoded_image
from semcal_ros.bridge.fields import stamp_ns_from_msg
from semcal_ros.config.config import IMAGE_TYPE, ImageConfig, MicroscopeConfig
from semcal_ros.core.arrays import AnyImage
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError, MessageError
from semcal_ros.core.rectification.line_phase import LinePhaseCorrector
from semcal_ros.files.images.databar import DatabarCutter
from semcal_ros.middleware import message_class, transport_advice
from semcal_ros.nodes.common.base import SemNode
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.endpoints import Endpoints, read_stamp_ns
from semcal_ros.nodes.common.parameters import ParameterDeclaration
from semcal_ros.nodes.common.qos import image_input, stream_output
from semcal_ros.nodes.common.reporter import NODE_ERRORS
from semcal_ros.nodes.common.subscription import MessageInfo, published_ns
from semcal_ros.nodes.frames.held_values import MagnificationInput

# The camera stays the same from frame to frame as long as the magnification does.
nominal_camera = lru_cache(maxsize=4)(ScanCamera.nominal)

# Images that have waited longer than both are skipped for newer ones. 1.5 intervals: the next image has arrived by
# then, and the node is not merely half an interval behind. 40 ms: a person does not notice such a delay, and in a fast
# stream the scheduling of other processes delays images by as much without the node being too slow.
_LATE_S, _LATE_INTERVALS = 0.04, 1.5
# How often an image is looked at whether it shows anything, and at how many of its pixels: cheap, and soon enough.
_CHECK_S, _CHECKED_PIXELS = 0.5, 1 << 14
# Grey levels, by bytes per pixel, that the noise of a detector without a beam may reach: of 8 bits two, and as much of
# the 10 bits or more that fill the lower part of 16.
_DARKEST = {1: 2, 2: 8}
# Images per turn of the executor; then timers and services get their turn.
_AT_ONCE = 8
# While a person zooms, some frames in a row are.
_MANY_MIXED = 10

_MIXED = ParameterDeclaration(
    "mixed_frames",
    "drop",
    "What happens to frames that were being scanned while the magnification changed. flag: published, uncorrected for"
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
    databar_rows
        Rows that the microscope's image has below this one.
    stamp_ns
        Stamp of the header.
    magnification
        Magnification, or None while it is not known.
    mixed
        Whether the magnification changed while the frame was being scanned.
    interval_s
        Mean interval between publications since the frame before, lost frames included; None for the first frame.
    """

    image: NDArray[Any]
    encoding: str
    header: Any
    stamp_ns: int
    magnification: float | None
    mixed: bool = False
    interval_s: float | None = None
    databar_rows: int = 0

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in px."""
        return self.image.shape[1], self.image.shape[0]


def describe_blank_image(image: AnyImage) -> str:
    """Say that an image shows nothing at all; empty if it shows something.

    Parameters
    ----------
    image
        (h, w) or (h, w, 3) grey levels. Of a large one, a part of the pixels is looked at.
    """
    step = max(1, math.isqrt(image.shape[0] * image.shape[1] // _CHECKED_PIXELS))
    sample = image[::step, ::step]
    least, greatest = sample.min(), sample.max()
    if least == greatest:
        return f"the image is even: all grey levels are {greatest:g}"
    if image.dtype.kind == "u" and greatest <= _DARKEST.get(image.dtype.itemsize, 0):
        return f"the image is dark: no grey level above {greatest:g}"
    return ""


def is_late(waited_s: float, interval_s: float) -> bool:
    """Return whether a waiting image is skipped for a newer one, given the interval between frames.

    The image must have waited for more than 40 ms *and* for more than 1.5 intervals.
    """
    return waited_s > max(_LATE_S, _LATE_INTERVALS * interval_s)


# Number of frames: seconds of any stream, longer than another node holds a frame.
_KEPT = 256


class SourceTimestamps:
    """Publication times of original frames, by header stamp.

    A magnification without a stamp is matched by the order of publication. A frame that another node made, such as
    ``image_stabilized``, was published later than its original, perhaps after the next magnification. So this class
    subscribes to the originals, but reads only their first bytes.

    Parameters
    ----------
    endpoints
        Where to subscribe.
    source
        The originals, whose type begins with a header; None if the frames are the originals.
    """

    def __init__(self, endpoints: Endpoints, source: ImageConfig | None) -> None:
        self._times: OrderedDict[int, int] = OrderedDict()
        self._originals = (
            None
            if source is None
            else endpoints.subscribe(
                message_class(source.type),
                source.topic,
                self._on_original,
                stream_output(10),
                raw=True,
            )
        )

    def _on_original(self, serialized: bytes, info: MessageInfo) -> None:
        try:
            stamp_ns = read_stamp_ns(serialized)
        except MessageError:
            # The node that made a frame of it, or could not, says so.
            return
        self._times[stamp_ns] = published_ns(info)
        while len(self._times) > _KEPT:
            self._times.popitem(last=False)

    def published_ns(self, stamp_ns: int, info: MessageInfo) -> int:
        """Return when the original of a frame was published, ns; if it did not arrive, when the frame itself was."""
        if self._originals is not None:
            # The frame may be handled before originals that arrived ahead of it.
            self._originals.take_waiting()
        return self._times.get(stamp_ns) or published_ns(info)


class FrameInput:
    """Subscribes to image and magnification and hands on each frame with the magnification it was taken at.

    Parameters
    ----------
    context
        Of the node; among its parameters is ``mixed_frames`` unless ``keep_mixed`` is set.
    on_frame
        Called with each frame; its exceptions are counted.
    magnification_config
        Returns the configuration with which magnifications are read; by default that of the node.
    topic, databar_rows
        Topic of the images if they are derived from the microscope's, and the number of text rows at their bottom;
        by default those of the configuration, which may be to find them in the first two images.
    group
        Callback group of both subscriptions.
    keep_mixed
        Hand on frames that were being scanned while the magnification changed, whatever the parameter says.
    """

    def __init__(
        self,
        context: NodeContext,
        on_frame: Callable[[StreamFrame], None],
        *,
        magnification_config: Callable[[], MicroscopeConfig] | None = None,
        topic: str | None = None,
        databar_rows: int | None = None,
        group: CallbackGroup | None = None,
        keep_mixed: bool = False,
    ) -> None:
        config, endpoints = context.config, context.endpoints
        source = config.image
        self._parameters = context.parameters
        self._reporter = context.reporter
        self._keep_mixed = keep_mixed
        self._on_frame = on_frame
        self._magnification_config = magnification_config or (lambda: config)
        self._databar = DatabarCutter(source.databar_rows if databar_rows is None else databar_rows)
        # Before the images, so that a late-joining node knows the magnification of its first frame.
        self._magnification = MagnificationInput(context, group=group)
        # Images that another node of the suite derives from the microscope's are not compressed.
        kind = message_class(IMAGE_TYPE if topic else source.type)
        self._source = SourceTimestamps(endpoints, source if topic else None)
        self._images = endpoints.subscribe(
            kind,
            topic or source.topic,
            self._on_images,
            image_input(),
            group,
            source="image",
            streams=True,
        )
        # Images that are derived from the microscope's are free of it.
        self._lines: LinePhaseCorrector | None = None
        if topic is None:
            scan = config.scan
            self._lines = LinePhaseCorrector(scan is not None and scan.bidirectional)
        self._undeclared = ""
        self._said_rows = 0
        # What another node has cut off it does not tell.
        self._rows_before = 0 if topic is None else source.databar_rows or 0
        self._skips_late = self._images.depth <= image_input().depth
        self._transport = ""
        self._image_bytes = 0
        self._lost = 0
        self._passed_over = 0
        self._restarts = 0
        self._sent_ns: int | None = None
        self._last_interval_s = 0.0
        self._mixed = 0
        self._mixed_in_a_row = 0
        self._dark = ""
        self._checked_s = -_CHECK_S
        self._unused = ""

    def _on_images(self, message: Any, info: MessageInfo) -> None:
        """Process the images that have arrived, oldest first, but skip late ones if there are newer ones.

        Waiting images are taken without returning to the executor, whose turns cost more. A user who has chosen a
        longer queue wants every image.
        """
        taken: tuple[Any, MessageInfo] | None = (message, info)
        for _ in range(_AT_ONCE):
            if taken is None:
                return
            while (
                self._skips_late
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
        return is_late(waited_s, self._last_interval_s)

    def _on_image(self, message: Any, info: MessageInfo) -> None:
        started_s = time.monotonic()
        self._reporter.count_received()
        self._check_transport(len(message.data))
        missed = self._images.lost + self._passed_over - self._lost
        self._lost += missed
        self._reporter.statistics.drop(missed)
        if self._images.restarts != self._restarts and self._sent_ns is not None:
            self._magnification.doubt(self._sent_ns)
        self._restarts = self._images.restarts
        interval_s = self._interval_s(published_ns(info), missed)
        unused = ""
        try:
            frame = self._frame(message, info, interval_s)
            if frame and (not frame.mixed or self._takes_mixed()):
                self._on_frame(frame)
            if frame and frame.mixed:
                unused = "it was scanned while the magnification changed"
            elif frame and frame.magnification is None:
                unused = "its magnification is not known"
        except NODE_ERRORS as error:
            self._reporter.reject(error)
            unused = str(error)
        except Exception as error:
            # Whatever is wrong with one frame, the next one may be measured.
            self._reporter.blame_itself(error)
            unused = str(error)
        self._unused = unused
        self._reporter.note("processing_ms", 1e3 * (time.monotonic() - started_s))

    def _takes_mixed(self) -> bool:
        return self._keep_mixed or self._parameters[_MIXED.name] != "drop"

    def _interval_s(self, sent_ns: int, missed: int) -> float | None:
        before, self._sent_ns = self._sent_ns, sent_ns
        if before is None or sent_ns < before:
            return None
        self._last_interval_s = (sent_ns - before) * 1e-9 / (missed + 1)
        return self._last_interval_s

    def _frame(
        self, message: Any, info: MessageInfo, interval_s: float | None
    ) -> StreamFrame | None:
        """Return the frame of a message, None for the first one of a stream with a data bar: the next decides."""
        pixels, encoding = decoded_image(message)
        image = self._without_databar(pixels)
        # The text of a bar is no light: while it is not known whether there is one, the upper half has none.
        self._check_for_contrast(pixels[: (len(pixels) + 1) // 2] if image is None else image)
        if image is None:
            return None
        stamp_ns = stamp_ns_from_msg(message)
        sent_ns = self._source.published_ns(stamp_ns, info)
        g = self._magnification.at(stamp_ns, sent_ns, image.shape[1], self._magnification_config())
        mixed = self._magnification.changed_during(stamp_ns, sent_ns)
        self._mixed += mixed
        self._mixed_in_a_row = self._mixed_in_a_row + 1 if mixed else 0
        if self._mixed_in_a_row >= _MANY_MIXED:
            self._reporter.warn_seldom(
                "every frame was scanned while the magnification changed (frames_mixed); see mixed_frames, and"
                " whether image.stamp and scan in the configuration hold"
            )
        self._reporter.note("magnification", "unknown" if g is None else g)
        self._reporter.note("frames_mixed", self._mixed)
        image = self._without_line_phase(image)
        rows = self._rows_before + self._databar.rows
        return StreamFrame(image, encoding, message.header, stamp_ns, g, mixed, interval_s, rows)

    def _without_databar(self, pixels: AnyImage) -> AnyImage | None:
        """Cut the data bar off; say it where the configuration does not."""
        image = self._databar.cut(pixels)
        rows = self._databar.rows if self._databar.has_found else 0
        if rows != self._said_rows:
            self._said_rows = rows
            if rows:
                self._reporter.warn(
                    f"the lowest {rows} rows are a data bar and are cut off; image.databar_rows: {rows} in the"
                    " configuration says so, 0 keeps them"
                )
        self._reporter.note("databar_rows", self._databar.rows)
        return image

    def _without_line_phase(self, image: AnyImage) -> AnyImage:
        """Move the lines of a bidirectional scan to where they belong; warn of one that nobody declared."""
        lines = self._lines
        if lines is None:
            return image
        image = lines.correct(image)
        if lines.declared:
            self._reporter.note("line_phase_px", lines.phase.shift_px)
            self._reporter.note("line_phase_sigma_px", lines.phase.sigma_px)
            return image
        if not lines.note:
            self._undeclared = ""
        elif not self._undeclared:
            self._undeclared = lines.note
            self._reporter.warn(self._undeclared)
        return image

    def _check_for_contrast(self, image: AnyImage) -> None:
        """Check now and then whether there is any picture: a blanked beam still gives frames."""
        now_s = time.monotonic()
        if now_s - self._checked_s < _CHECK_S:
            return
        self._checked_s = now_s
        before, self._dark = self._dark, describe_blank_image(image)
        if self._dark and not before:
            self._reporter.warn(f"{self._dark}; check beam blank, shutter and detector")
        elif before and not self._dark:
            self._reporter.info("the image has contrast again")

    def _check_transport(self, image_bytes: int) -> None:
        """Check whether this process is set up for images of this size."""
        if image_bytes != self._image_bytes and not self._images.in_memory:
            self._image_bytes = image_bytes
            rmw = get_rmw_implementation_identifier()
            self._transport = transport_advice(image_bytes, os.environ, rmw)

    def refuse_rivals(self) -> None:
        """Refuse images or magnifications from more than one publisher; raises :class:`InvalidValueError`."""
        found = self._images.find_rivals() or self._magnification.find_rivals()
        if found:
            raise InvalidValueError(
                found, expected="one", do="end the others; remove views taken meanwhile by ~/clear"
            )

    def refuse_unused(self) -> None:
        """Refuse to go on with an older frame where the newest one is of no use; raises :class:`InvalidValueError`."""
        if self._unused:
            raise InvalidValueError(
                f"the newest frame cannot be used: {self._unused}",
                expected="one of a known encoding and magnification",
                do="check the publishers of images and magnification",
            )

    @property
    def has_rivals(self) -> bool:
        """Whether the last check found more than one publisher of images or of magnifications."""
        return bool(self._images.rivals or self._magnification.rivals)

    def conditions(self) -> list[str]:
        """Return, in a few words, what is odd about the images: their size, no light, shifted lines."""
        return [text for text in (self._transport, self._dark, self._undeclared) if text]


class StreamNode(SemNode):
    """A node that consumes frames.

    Attributes
    ----------
    frames
        Where the frames come from, once :meth:`receive_frames` was called.
    """

    def __init__(self, name: str, declarations: Iterable[ParameterDeclaration] = ()) -> None:
        super().__init__(name, (_MIXED, *declarations))
        self.frames: FrameInput | None = None
        self._without_magnification = 0
        # Of them, those since the last frame that had one.
        self._waiting = 0

    def receive_frames(self, on_frame: Callable[[StreamFrame], None], **options: Any) -> None:
        """Start receiving frames, at the end of the constructor; ``options`` are those of :class:`FrameInput`."""
        self.frames = FrameInput(self.node_context, on_frame, **options)

    def known_magnification(self, frame: StreamFrame) -> float | None:
        """Return the magnification of a frame; count a frame without one."""
        if frame.magnification is None:
            self._waiting += 1
            self._without_magnification += 1
            self.reporter.note("frames_without_magnification", self._without_magnification)
        elif self._waiting:
            # Not a warning: where nodes have just met, the first image often comes before the magnification. The watch
            # over that topic warns if none comes.
            self.reporter.info(
                f"images not used because their magnification was not known: {self._waiting}"
            )
            self._waiting = 0
        return frame.magnification

    def conditions(self) -> list[str]:
        """Extend the base class: also report a missing magnification and images too large for the transport."""
        waiting = ["waiting for magnification"] if self._waiting else []
        transport = [] if self.frames is None else self.frames.conditions()
        return super().conditions() + waiting + transport
