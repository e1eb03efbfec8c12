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

"""Publication times, at the microscope, of frames that another node has processed."""

from __future__ import annotations

import struct
from collections import OrderedDict

from semcal_ros.config.config import ImageConfig
from semcal_ros.middleware.message_types import message_class
from semcal_ros.nodes.common.endpoints import Endpoints
from semcal_ros.nodes.common.qos import stream_output
from semcal_ros.nodes.common.subscription import MessageInfo, published_ns

__all__ = ["SourceTimestamps"]

# Number of frames: seconds of any stream, longer than another node holds a frame.
_KEPT = 256
# Bytes of the encapsulation; after it comes the stamp, with which std_msgs/Header and so every image begins.
_ENCAPSULATION = 4
_NS_PER_S = 1_000_000_000  # nanoseconds per second


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
        order = "<" if serialized[1] & 1 else ">"
        seconds, nanoseconds = struct.unpack_from(f"{order}iI", serialized, _ENCAPSULATION)
        self._times[seconds * _NS_PER_S + nanoseconds] = published_ns(info)
        while len(self._times) > _KEPT:
            self._times.popitem(last=False)

    def published_ns(self, stamp_ns: int, info: MessageInfo) -> int:
        """Return when the original of a frame was published, ns; if it did not arrive, when the frame itself was."""
        if self._originals is not None:
            # The frame may be handled before originals that arrived ahead of it.
            self._originals.take_waiting()
        return self._times.get(stamp_ns) or published_ns(info)
