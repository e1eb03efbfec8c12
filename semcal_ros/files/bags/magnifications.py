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

"""The magnification that was valid at each image of a recording."""

from __future__ import annotations

from semcal_ros.bridge.magnification import MagnificationReading, read_magnification
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.files.bags.held_values import HeldValues
from semcal_ros.files.bags.reader import BagReader

__all__ = ["MagnificationTrack"]


class MagnificationTrack(HeldValues[MagnificationReading]):
    """All magnification messages of a topic, each valid until the next one."""

    def __init__(self, reader: BagReader, topic: str, config: MicroscopeConfig) -> None:
        super().__init__(reader, topic, lambda message: read_magnification(message, config))

    def at(self, stamp_ns: int, log_time_ns: int, image_width_px: int) -> float | None:
        """Return the magnification at an image, or None before the first message and after a bad one.

        Raises
        ------
        MessageError
            A pixel size gives no credible magnification for an image of this width.
        """
        reading = self.held_at(stamp_ns, log_time_ns)
        return None if reading is None else float(reading.magnification(image_width_px))
