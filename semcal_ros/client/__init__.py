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

"""For programs of your own: frames in pixels and metres, from a live stream or from a recording.

>>> from semcal_ros.client import CalibratedStream, open_frames

:class:`CalibratedStream` needs ROS; the rest does not.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from semcal_ros.client.recording import open_frames
from semcal_ros.core.camera.calibrated_frame import CalibratedFrame, Positions

if TYPE_CHECKING:
    from semcal_ros.client.stream import CalibratedStream

__all__ = ["CalibratedFrame", "CalibratedStream", "Positions", "open_frames"]


def __getattr__(name: str) -> Any:
    # On demand: a notebook without ROS has the other names.
    if name != "CalibratedStream":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from semcal_ros.client.stream import CalibratedStream

    return CalibratedStream
