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

"""Writes simulated frames to a bag, with their ground truth beside it."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from semcal_ros.bridge.conditions import CONDITIONS_TYPE, fill_conditions
from semcal_ros.bridge.fields import fill_header
from semcal_ros.bridge.images import fill_image
from semcal_ros.config.config import STAGE_TYPE
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.files.bags.writer import BagWriter

SIMULATED_START_NS = 1_700_000_000_000_000_000
"""Stamp of time zero, ns: arbitrary but fixed, which keeps recordings of one seed identical."""

# 1 ms: magnification and stage are recorded just before the scan of the first frame they belong to.
_LEAD_NS = 1_000_000
_FRAME_ID = "sem_optical"


class SimulatedFrame(Protocol):
    """What is known of a frame before it is drawn."""

    @property
    def start_time_s(self) -> float:
        """When the scan of the frame begins."""

    @property
    def magnification(self) -> float:
        """Magnification at which it is scanned."""


@runtime_checkable
class StagedFrame(Protocol):
    """A frame of a stage that says where it is."""

    @property
    def joints(self) -> Mapping[str, float] | None:
        """Positions of its joints by name, rad and m; None for a stage that says nothing."""


def write_simulated(
    folder: Path,
    frames: Iterable[SimulatedFrame],
    images: Iterable[NDArray[Any]],
    truth: Any,
    *,
    conditions: Mapping[str, float | str] | None = None,
    delay_s: float = 0.0,
    overwrite: bool = False,
) -> None:
    """Write frames to a bag with the topics of ``virtual_sem``, and ``truth.json``.

    Parameters
    ----------
    folder
        The bag.
    frames, images
        The same number of both; images of 8 or 16 bit, rendered while they are written. Frames that are
        :class:`StagedFrame` say where the stage is.
    truth
        Plain data in SI units.
    conditions
        How all frames are taken, by the keys of :mod:`semcal_ros.bridge.conditions`; None for a bag that says nothing.
    delay_s
        Delay from the stamp of a frame to its publication.
    overwrite
        Whether an existing bag may be replaced.

    Raises
    ------
    BagError
        The folder exists and ``overwrite`` is not set, or it cannot be written; then no part of it remains.
    """
    magnification, joints = None, None
    with BagWriter(folder, overwrite=overwrite) as writer:
        writer.add_topic("/sem/magnification", "std_msgs/msg/Float64", latched=True, depth=1)
        for frame, pixels in zip(frames, images, strict=True):
            stamp_ns = SIMULATED_START_NS + round(frame.start_time_s * 1e9)
            if conditions and magnification is None:
                message = blank_message(CONDITIONS_TYPE)
                fill_conditions(message, conditions, "virtual SEM")
                writer.add_topic("/sem/conditions", CONDITIONS_TYPE, latched=True, depth=1)
                writer.write("/sem/conditions", stamp_ns - _LEAD_NS, message)
            if frame.magnification != magnification:
                magnification = frame.magnification
                value = blank_message("std_msgs/msg/Float64")
                value.data = magnification
                writer.write("/sem/magnification", stamp_ns - _LEAD_NS, value)
            said = frame.joints if isinstance(frame, StagedFrame) else None
            if said is not None and said != joints:
                joints = said
                writer.add_topic("/sem/stage", STAGE_TYPE, latched=True, depth=1)
                writer.write("/sem/stage", stamp_ns - _LEAD_NS, _stage_message(said, stamp_ns))
            header = blank_message("std_msgs/msg/Header")
            fill_header(header, stamp_ns, _FRAME_ID)
            image = blank_message("sensor_msgs/msg/Image")
            fill_image(image, pixels, "mono8" if pixels.dtype.itemsize == 1 else "mono16", header)
            writer.write("/sem/image_raw", stamp_ns + round(delay_s * 1e9), image)
        writer.write_text("truth.json", json.dumps(truth, indent=1))


def _stage_message(joints: Mapping[str, float], stamp_ns: int) -> Any:
    message = blank_message(STAGE_TYPE)
    fill_header(message.header, stamp_ns - _LEAD_NS, "")
    message.name = list(joints)
    message.position = np.array(list(joints.values()), dtype=np.float64)
    return message
