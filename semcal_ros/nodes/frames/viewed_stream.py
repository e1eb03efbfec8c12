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

"""The stream as a viewer sees it: the newest pictures now and then, while somebody looks."""

from __future__ import annotations

import math
import struct
import time
from collections import deque
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import EventHandler
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image

from semcal_ros.bridge.compressed import decoded_image
from semcal_ros.files.images.databar import DatabarCutter
from semcal_ros.middleware.message_types import message_class
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.endpoints import Endpoints
from semcal_ros.nodes.common.qos import stream_output
from semcal_ros.nodes.common.subscription import AdaptiveSubscription, published_ns
from semcal_ros.viewer.pictures import Outlines, outline

# Raw images that wait for their corrected ones: registration takes some frames in a fast stream.
_RAW_DEPTH = 4
_KEPT_RAW = 6
# And no more memory than this, which is four images of 4096 x 4096.
_KEPT_BYTES = 64 << 20
# A corrected image that is older than the newest raw one by more belongs to a corrector that has stopped.
_STALE_S = 3.0
# For so long events are waited for; the executor needs some milliseconds to begin.
_EVENTS_S = 0.02


class PolledGroup(MutuallyExclusiveCallbackGroup):
    """Subscriptions whose messages wait until they are taken; the executor leaves them alone.

    An executor that woke for every image would cost a part of a core in a fast stream, for pictures that nobody sees.
    Events of the subscriptions, such as of their quality of service, are handled just after :meth:`open_events`. At
    other times they must not be waited for either: Fast DDS signals a message and an event by one condition, so that
    with messages waiting the executor would not sleep at all.
    """

    def __init__(self) -> None:
        super().__init__()
        self._open_until_s = -math.inf

    def open_events(self) -> None:
        """Let events be handled now; call it when the messages have been taken."""
        self._open_until_s = time.monotonic() + _EVENTS_S

    def can_execute(self, entity: Any) -> bool:
        """Extend the base class: never for a subscription, seldom for an event."""
        if isinstance(entity, Subscription):
            return False
        if isinstance(entity, EventHandler) and time.monotonic() > self._open_until_s:
            return False
        return super().can_execute(entity)


@dataclass(frozen=True)
class ViewedFrame:
    """The newest pictures of one frame.

    Attributes
    ----------
    stamp_ns, sent_ns
        Its stamp, and when the raw image was published (the corrected one, where that is all there is).
    pictures
        ``raw``, ``corrected`` or both; without data bar.
    moving
        Outlines of what does not move with the specimen, in the corrected picture.
    """

    stamp_ns: int
    sent_ns: int
    pictures: dict[str, NDArray[Any]]
    moving: Outlines = ()


@dataclass(frozen=True)
class _Waiting:
    """A serialized image that has arrived."""

    stamp_ns: int
    sent_ns: int
    data: bytes


def _stamp_of(data: bytes) -> int:
    """Read the stamp of a serialized message that begins with a header."""
    # Four bytes of encapsulation, the second of which says the byte order.
    order = "<" if data[1] & 1 else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", data, 4)
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


class ViewedImages:
    """Takes the newest raw and corrected image when asked, and only then unpacks them.

    Parameters
    ----------
    context
        Of the node.
    group
        Of the subscriptions.
    """

    def __init__(self, context: NodeContext, group: PolledGroup) -> None:
        config, endpoints = context.config, context.endpoints
        self._databar = DatabarCutter(config.image.databar_rows)
        self._raw_type = message_class(config.image.type)
        self._raw = self._subscribe(
            endpoints, self._raw_type, config.image.topic, stream_output(_RAW_DEPTH), group
        )
        self._corrected = {
            topic: self._subscribe(endpoints, Image, topic, stream_output(1), group)
            for topic in ("image_rect", "image_stabilized")
        }
        self._moving = {
            node: self._subscribe(endpoints, Image, f"{node}/moving", stream_output(1), group)
            for node in ("stream_corrector", "drift_compensator")
        }
        self._mask: _Waiting | None = None
        self._masked_s = 0.0
        self._kept: deque[_Waiting] = deque()
        self._newest: _Waiting | None = None
        self._seen_s = 0.0
        self._shown: tuple[int, int] | None = None

    @staticmethod
    def _subscribe(
        endpoints: Endpoints, kind: Any, topic: str, profile: QoSProfile, group: PolledGroup
    ) -> AdaptiveSubscription:
        return endpoints.subscribe(kind, topic, lambda *_: None, profile, group, raw=True)

    @property
    def subscriptions(self) -> list[AdaptiveSubscription]:
        """What is to be paused while nobody looks."""
        return [self._raw, *self._corrected.values(), *self._moving.values()]

    def publishers(self, picture: str) -> list[str]:
        """Return the full names of the nodes that publish the raw or the corrected images."""
        chosen = [self._raw] if picture == "raw" else list(self._corrected.values())
        return [name for one in chosen for name in one.publishers() if name]

    def forget(self) -> None:
        """Forget all images."""
        self._kept.clear()
        self._newest = self._shown = self._mask = None

    def take(self) -> ViewedFrame | None:
        """Return the newest frame, or None if it is the same as before.

        Raises
        ------
        SemcalError
            An image cannot be unpacked.
        """
        self._take_raw()
        now_s = time.monotonic()
        for subscription in self._corrected.values():
            while (taken := subscription.take()) is not None:
                self._newest, self._seen_s = _waiting(taken), now_s
                break
        for subscription in self._moving.values():
            while (taken := subscription.take()) is not None:
                self._mask, self._masked_s = _waiting(taken), now_s
        corrected = self._newest if now_s - self._seen_s < _STALE_S else None
        raw = self._raw_of(corrected)
        if raw is None and corrected is None:
            return None
        numbers = (
            0 if raw is None else raw.stamp_ns,
            0 if corrected is None else corrected.stamp_ns,
        )
        if numbers == self._shown:
            return None
        self._shown = numbers
        pictures = {}
        if raw is not None:
            image = self._unpack(raw, self._raw_type)
            cut = self._databar.cut(image)
            pictures["raw"] = image if cut is None else cut
        if corrected is not None:
            pictures["corrected"] = self._unpack(corrected, Image)
        first = raw or corrected
        assert first is not None
        moving: Outlines = ()
        if corrected and self._mask and now_s - self._masked_s < _STALE_S:
            # The mask follows its picture; that of the frame before is as good for the eye.
            moving = outline(self._unpack(self._mask, Image))
        return ViewedFrame((corrected or first).stamp_ns, first.sent_ns, pictures, moving)

    def _take_raw(self) -> None:
        while (taken := self._raw.take()) is not None:
            self._kept.append(_waiting(taken))
        while len(self._kept) > _KEPT_RAW or (
            len(self._kept) > 1 and sum(len(one.data) for one in self._kept) > _KEPT_BYTES
        ):
            self._kept.popleft()

    def _raw_of(self, corrected: _Waiting | None) -> _Waiting | None:
        """The raw image of a corrected one if it is still there, else the newest."""
        if not self._kept:
            return None
        if corrected is not None:
            for one in self._kept:
                if one.stamp_ns == corrected.stamp_ns:
                    return one
        return self._kept[-1]

    @staticmethod
    def _unpack(waiting: _Waiting, kind: Any) -> NDArray[Any]:
        image, encoding = decoded_image(deserialize_message(waiting.data, kind))
        # The page draws in OpenCV's order of the channels.
        return image[..., ::-1] if encoding.startswith("rgb") else image


def _waiting(taken: tuple[Any, Any]) -> _Waiting:
    data, info = taken
    return _Waiting(_stamp_of(data), published_ns(info), data)
