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

"""Turns image files into a bag."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from semcal_ros.bridge.conditions import CONDITIONS_TYPE, Conditions
from semcal_ros.bridge.fields import fill_header
from semcal_ros.bridge.images import fill_image
from semcal_ros.config.config import IMAGE_TYPE, MicroscopeConfig, StageConfig, load_config
from semcal_ros.core.errors import BagError, SemcalError
from semcal_ros.core.wording import counted
from semcal_ros.files.bags.held_values import CONDITIONS_TOPIC
from semcal_ros.files.bags.messages import (
    blank_message,
    check_recordable,
    conditions_message,
    magnification_message,
    microscope_topic,
    stage_message,
)
from semcal_ros.files.bags.writer import BagWriter, check_replaceable
from semcal_ros.files.images.image_series import (
    ImageSeries,
    SeriesImage,
    Skipped,
    group_skipped,
)
from semcal_ros.files.images.page_stamps import MIN_SPACING_NS
from semcal_ros.files.images.sem_image import SemImage
from semcal_ros.files.recordings import ENCODINGS, RecordedFiles, open_image_series

METADATA_TOPIC = "metadata"
"""Topic with the settings of each image as JSON text (std_msgs/String)."""

SIDECAR = "import.json"
"""File in the recording's folder with the same settings, the notes and the skipped files."""

# A tenth of the least spacing: after the image before, whatever their order in the folder.
_BEFORE_IMAGE_NS = MIN_SPACING_NS // 10


@dataclass(frozen=True)
class ImportSummary:
    """What an import did.

    Parameters
    ----------
    path
        The recording.
    imported
        Number of images.
    display_width_m
        The display width that all magnifications refer to.
    skipped
        Files that could not be used, with reasons.
    notes
        Notes for the user about the values and the skipped files.
    damaged
        Those of the skipped files whose images turned out to be damaged.
    """

    path: Path
    imported: int
    display_width_m: float
    skipped: tuple[Skipped, ...]
    notes: tuple[str, ...]
    damaged: tuple[Skipped, ...] = ()

    def lines(self) -> list[str]:
        """The summary for the user, one fact per line."""
        return [
            f"{counted(self.imported, 'image')} in {self.path}",
            *(f"note: {note}" for note in self.notes),
            *(f"note: {text}" for text in group_skipped(self.damaged)),
        ]


def _describe(image: SeriesImage, pixels: NDArray[Any]) -> dict[str, Any]:
    """What is known of an image, as plain values for JSON (SI units)."""
    settings, rows = image.page.settings, image.databar_rows
    if settings is not None:
        sem = SemImage(image.file.path, pixels, image.page.size_px, rows, settings)
        return sem.metadata()
    return {
        "file": image.name,
        "full_size_px": list(image.page.size_px),
        "databar_rows": rows,
        "pixel_size_m": image.page.pixel_size_m,
        "bits": int(8 * pixels.dtype.itemsize),
        "notes": [],
    }


def _text_message(text: str) -> Any:
    message = blank_message("std_msgs/msg/String")
    message.data = text
    return message


def _write_image(
    writer: BagWriter,
    config: MicroscopeConfig,
    entry: SeriesImage,
    pixels: NDArray[Any],
    stage: StageConfig | None,
) -> dict[str, Any]:
    number = magnification_message(config, entry.magnification, pixels.shape[1])
    # A player that keeps the recording's order then announces the magnification before its image.
    before_ns = max(0, entry.stamp_ns - _BEFORE_IMAGE_NS)
    writer.write(microscope_topic(config.magnification.topic), before_ns, number)
    if stage is not None:
        joints = stage_message(stage, entry.stage, before_ns)
        writer.write(microscope_topic(stage.topic), before_ns, joints)
    message = blank_message(IMAGE_TYPE)
    header = blank_message("std_msgs/msg/Header")
    fill_header(header, entry.stamp_ns, config.frame_id)
    fill_image(message, pixels, ENCODINGS[pixels.dtype.name], header)
    writer.write(microscope_topic(config.image.topic), entry.stamp_ns, message)
    settings = {"stamp_ns": entry.stamp_ns, "published": number.data, **_describe(entry, pixels)}
    text = json.dumps(settings, sort_keys=True, allow_nan=False)
    writer.write(microscope_topic(METADATA_TOPIC), entry.stamp_ns, _text_message(text))
    return settings


def _write_all(
    writer: BagWriter,
    config: MicroscopeConfig,
    series: ImageSeries,
    on_progress: Callable[[int, int], object] | None,
) -> tuple[list[dict[str, Any]], list[Skipped]]:
    written, skipped = [], []
    written_conditions: dict[str, float | str] = {}
    stage = config.stage if any(image.stage is not None for image in series.images) else None
    for number, (image, pixels) in enumerate(series.read(), 1):
        if on_progress is not None:
            on_progress(number, len(series.images))
        if isinstance(pixels, SemcalError):
            skipped.append(Skipped(image.name, str(pixels)))
            continue
        conditions = image.conditions or Conditions()
        if conditions.topic_values() != written_conditions:
            written_conditions = conditions.topic_values()
            before_ns = max(0, image.stamp_ns - _BEFORE_IMAGE_NS)
            topic = microscope_topic(CONDITIONS_TOPIC)
            writer.add_topic(topic, CONDITIONS_TYPE, latched=True, depth=1)
            writer.write(topic, before_ns, conditions_message(conditions, config.name))
        written.append(_write_image(writer, config, image, pixels, stage))
    if not written:
        raise BagError(
            f"{counted(len(series.images), 'image')}, none of which can be decoded, the first: {skipped[0].reason}",
            expected="at least one intact image",
        )
    return written, skipped


def import_images(
    source: str | os.PathLike[str] | RecordedFiles,
    out_bag: str | Path,
    *,
    config: MicroscopeConfig | None = None,
    overwrite: bool = False,
    on_progress: Callable[[int, int], object] | None = None,
) -> ImportSummary:
    """Write a bag with images, their magnification and all that their files say.

    Parameters
    ----------
    source
        Image files: one, a folder (not searched below) or a pattern. Sizes and makers may differ.
    out_bag
        Recording to make.
    config
        Topics, and the display width that all magnifications refer to; ``generic`` by default. Read
        the recording with the same configuration: the field widths, and with them the pixel sizes,
        are then exactly those of the files.
    overwrite
        Replace an existing recording.
    on_progress
        Called with the number of images done, and that of all images.

    Raises
    ------
    BagError
        No file is usable, or their scale is not known; the recording cannot be written, or exists.
    """
    used = load_config("generic") if config is None else config
    check_recordable(used)
    check_replaceable(Path(os.path.abspath(out_bag)), overwrite)
    given = source if isinstance(source, RecordedFiles) else RecordedFiles(source)
    if given.roi is not None:
        raise BagError(
            "a region of the images for an import",
            expected="whole images",
            do="give --roi to the command that reads the bag",
        )
    series = open_image_series(given, used)
    with BagWriter(out_bag, overwrite=overwrite) as writer:
        written, damaged = _write_all(writer, used, series, on_progress)
        skipped = (*series.skipped, *damaged)
        report = {
            "display_width_m": used.display_width_m,
            "configuration": used.name,
            "notes": list(series.notes),
            "skipped": [{"file": s.name, "reason": s.reason} for s in skipped],
            "images": written,
        }
        writer.write_text(SIDECAR, json.dumps(report, indent=2, allow_nan=False) + "\n")
    return ImportSummary(
        writer.path, len(written), used.display_width_m, skipped, series.notes, tuple(damaged)
    )
