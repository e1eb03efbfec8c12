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

"""Records pictures of the grid as they are taken: a bag that `semcal calibrate` reads."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

import numpy as np

from semcal_ros.bridge.conditions import CONDITIONS_TYPE
from semcal_ros.bridge.fields import fill_header
from semcal_ros.bridge.images import fill_image
from semcal_ros.config.config import IMAGE_TYPE, MicroscopeConfig
from semcal_ros.core.arrays import AnyImage
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.errors import BagError
from semcal_ros.files.bags.conditions import CONDITIONS_TOPIC
from semcal_ros.files.bags.messages import (
    blank_message,
    check_recordable,
    conditions_message,
    magnification_message,
    microscope_topic,
    stage_message,
)
from semcal_ros.files.bags.writer import BagWriter
from semcal_ros.files.tiff.sem_image import Conditions

if TYPE_CHECKING:
    from typing_extensions import Self


class ViewRecorder:
    """Context manager; the bag appears when the block ends without an error, as that of :class:`BagWriter`.

    Parameters
    ----------
    path
        Folder to make; it must not exist.
    config
        Topics and types of the recording.

    Raises
    ------
    BagError
        The path exists or cannot be written to, or the configuration has messages that cannot be made.
    """

    def __init__(self, path: Path, config: MicroscopeConfig) -> None:
        check_recordable(config)
        self._config = config
        self._writer = BagWriter(path)
        self._written: dict[str, dict[str, float | str] | StageReading | float] = {}
        self._last_ns = -1

    @property
    def path(self) -> Path:
        """The folder that is made."""
        return self._writer.path

    def __enter__(self) -> Self:
        self._writer.__enter__()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.__exit__(kind, error, trace)

    def write(
        self,
        image: AnyImage,
        encoding: str,
        stamp_ns: int,
        magnification: float,
        stage: StageReading | None,
        conditions: Conditions,
    ) -> None:
        """Append a picture, and what has changed since the one before.

        Parameters
        ----------
        image
            (h, w) or (h, w, 3) without data bar; the recording has a black one where the configuration states one.
        encoding
            As in sensor_msgs/Image.
        stamp_ns
            Stamp of the image; must rise.
        magnification, stage, conditions
            Under which it was taken.
        """
        if stamp_ns <= self._last_ns:
            raise BagError(
                f"a picture of {stamp_ns} ns after one of {self._last_ns} ns",
                expected="stamps that rise",
            )
        config = self._config
        changed_ns = max(self._last_ns + 1, stamp_ns - 1)
        self._last_ns = stamp_ns
        if self._is_news("magnification", magnification):
            number = magnification_message(config, magnification, image.shape[1])
            self._write(config.magnification.topic, changed_ns, number, config.magnification.type)
        if config.stage is not None and self._is_news("stage", stage):
            joints = stage_message(config.stage, stage, changed_ns)
            self._write(config.stage.topic, changed_ns, joints, config.stage.type)
        if self._is_news("conditions", conditions.topic_values()):
            stated = conditions_message(conditions, config.name)
            self._write(CONDITIONS_TOPIC, changed_ns, stated, CONDITIONS_TYPE)
        message, header = blank_message(IMAGE_TYPE), blank_message("std_msgs/msg/Header")
        fill_header(header, stamp_ns, config.frame_id)
        fill_image(message, self._with_databar(image), encoding, header)
        self._writer.write(microscope_topic(config.image.topic), stamp_ns, message)

    def _with_databar(self, image: AnyImage) -> AnyImage:
        rows = self._config.image.databar_rows or 0
        blank = np.zeros((rows, *image.shape[1:]), dtype=image.dtype)
        return np.concatenate([image, blank]) if rows else image

    def _is_news(self, key: str, value: Any) -> bool:
        news = bool(self._written.get(key) != value)
        self._written[key] = value
        return news

    def _write(self, topic: str, time_ns: int, message: Any, kind: str) -> None:
        name = microscope_topic(topic)
        self._writer.add_topic(name, kind, latched=True, depth=1)
        self._writer.write(name, time_ns, message)
