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

"""The frames of the microscope that do not change with the picture, for tf2 (tf2_msgs/msg/TFMessage)."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from semcal_ros.bridge.headers import fill_stamp
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.camera.scan_camera import ScanCamera

_ROOT = "sem"


@dataclass(frozen=True)
class StaticFrame:
    """A frame in the sem frame.

    Attributes
    ----------
    name
        Its name.
    z_m
        Its origin on the optical axis, m.
    yaw_rad
        By how much it is turned about z, from x towards y, rad.
    """

    name: str
    z_m: float = 0.0
    yaw_rad: float = 0.0


def static_frames(config: MicroscopeConfig, camera: ScanCamera | None) -> tuple[StaticFrame, ...]:
    """Return the frames whose parent is the sem frame.

    ``specimen`` is where the specimen was in the first frame, to which corrected images are corrected. ``stage`` has
    its x along the tilt axis of the configuration. The frame of the images has its origin at the pivot of the scan,
    and is missing without a camera or for a parallel projection.
    """
    stage = config.stage
    yaw_rad = 0.0 if stage is None else math.radians(stage.tilt_axis_deg)
    found = [StaticFrame("specimen"), StaticFrame("stage", yaw_rad=yaw_rad)]
    if camera is not None and camera.rho > 0.0:
        # A point at the height Z has the depth 1 / rho + Z.
        found.append(StaticFrame(config.frame_id, z_m=-1.0 / camera.rho))
    return tuple(found)


def fill_static_frames(
    message: Any,
    frames: Iterable[StaticFrame],
    stamp_ns: int,
    new_transform: Callable[[], Any],
) -> None:
    """Set a tf2_msgs/msg/TFMessage.

    Parameters
    ----------
    message
        What to set.
    frames
        What it tells.
    stamp_ns
        From when on, ns.
    new_transform
        Makes an empty geometry_msgs/msg/TransformStamped of the same family of classes.
    """
    transforms = []
    for frame in frames:
        stamped = new_transform()
        fill_stamp(stamped.header.stamp, stamp_ns)
        stamped.header.frame_id, stamped.child_frame_id = _ROOT, frame.name
        stamped.transform.translation.z = frame.z_m
        stamped.transform.rotation.z = math.sin(0.5 * frame.yaw_rad)
        stamped.transform.rotation.w = math.cos(0.5 * frame.yaw_rad)
        transforms.append(stamped)
    message.transforms = transforms
