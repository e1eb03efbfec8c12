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

"""A folder of SEM TIFFs as a sequence of frames in time with one magnification scale."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import timezone
from pathlib import Path

from semcal_ros.bridge.stage import doubt_unit
from semcal_ros.config.config import StageConfig
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.errors import SemcalError, TiffError
from semcal_ros.files.plain_images import PLAIN_IMAGES
from semcal_ros.files.tiff.read import is_tiff, read_sem_settings, read_sem_tiff
from semcal_ros.files.tiff.sem_image import SemImage, VendorSettings

__all__ = [
    "MIN_SPACING_NS",
    "Skipped",
    "TiffEntry",
    "TiffFolder",
    "scan_tiff_folder",
]

_SECOND_NS = 1_000_000_000  # one second, ns
_SYNTHETIC_START_NS = 946_684_800 * _SECOND_NS  # 2000-01-01 UTC
MIN_SPACING_NS = 1_000_000
"""Least time between two images of a folder, whose files have whole seconds: 1000 images fit into one."""


@dataclass(frozen=True)
class Skipped:
    """A file that could not be used, and the reason."""

    name: str
    reason: str


@dataclass(frozen=True)
class TiffEntry:
    """One readable file of a folder.

    Parameters
    ----------
    path
        The file.
    stamp_ns
        Time of the image in ns since 1970: the file's local time taken as UTC, or 1 s apart.
    magnification
        On the folder's common display width: field width = display width / magnification exactly.
    databar_rows
        Rows to cut off at the bottom, instead of those that the metadata give.
    stage
        Where the stage was, or None where the file does not say it.
    """

    path: Path
    stamp_ns: int
    magnification: float
    databar_rows: int | None
    stage: StageReading | None = None

    def load(self) -> SemImage:
        """Load the image and its settings; raises :class:`TiffError` if the pixel data are damaged."""
        return read_sem_tiff(self.path, databar_rows=self.databar_rows)


@dataclass(frozen=True)
class TiffFolder:
    """Readable files in the order of their stamps.

    Parameters
    ----------
    entries
        At least one file.
    display_width_m
        The display width that all magnifications refer to.
    skipped
        Files that look like images and cannot be used.
    notes
        Notes for the user: where stamps and display width come from.
    """

    path: Path
    entries: tuple[TiffEntry, ...]
    display_width_m: float
    skipped: tuple[Skipped, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Found:
    path: Path
    settings: VendorSettings
    size_px: tuple[int, int]

    @property
    def field_width_m(self) -> float:
        return self.settings.pixel_size_m * self.size_px[0]


def _natural(path: Path) -> list[tuple[int, int, str]]:
    """Sort key that puts ``image_9`` before ``image_10``."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in parts if part]


def _collect(files: list[Path]) -> tuple[list[_Found], list[Skipped]]:
    found, skipped = [], []
    for path in files:
        if not is_tiff(path):
            skipped.append(Skipped(path.name, "not a TIFF, so it has no SEM metadata"))
            continue
        try:
            found.append(_Found(path, *read_sem_settings(path)))
        except SemcalError as error:
            skipped.append(Skipped(path.name, str(error)))
    return found, skipped


def _stamps(found: list[_Found]) -> tuple[list[tuple[_Found, int]], str]:
    """Order files by time with strictly increasing stamps; also say where the stamps come from."""
    if any(item.settings.time is None for item in found):
        pairs = [(item, _SYNTHETIC_START_NS + k * _SECOND_NS) for k, item in enumerate(found)]
        return pairs, "not all files have a time: stamps are 1 s apart, in the order of names"
    timed = []
    for item in found:
        time = item.settings.time
        if time is not None:
            timed.append((item, round(time.replace(tzinfo=timezone.utc).timestamp()) * _SECOND_NS))
    timed.sort(key=lambda pair: pair[1])
    spread: list[tuple[_Found, int]] = []
    for item, stamp_ns in timed:
        # Files have whole seconds; images of the same second stay in the order of their names.
        earliest = spread[-1][1] + MIN_SPACING_NS if spread else stamp_ns
        spread.append((item, max(stamp_ns, earliest)))
    return spread, "stamps are the files' local times taken as UTC"


# A stage that turns back comes back to a fraction of this, rad.
_TURNED_RAD = 1e-3


def _stages(found: list[_Found]) -> tuple[list[StageReading | None], list[str]]:
    """Return what the files say about the stage, as far as its meaning is known, and notes.

    Makers do not say in which sense they count a rotation. One that is the same in all files only adds
    to the unknown direction of the grid; one that changes is left out. With a scan rotation, the
    direction of the tilt axis in the image is not known, so the whole reading is left out.
    """
    turns = [i.settings.stage_rotation_rad for i in found]
    known = [turn for turn in turns if turn is not None]
    turned = bool(known) and max(known) - min(known) > _TURNED_RAD
    readings: list[StageReading | None] = []
    notes: list[str] = []
    scan_rotated = 0
    for item, turn in zip(found, turns, strict=True):
        settings = item.settings
        rotated = abs(settings.scan_rotation_rad or 0.0) > _TURNED_RAD
        scan_rotated += rotated and settings.stage_tilt_rad is not None
        usable = settings.stage_tilt_rad is not None and not rotated
        own = StageReading(settings.stage_tilt_rad, None if turned else turn) if usable else None
        if own is not None and (doubt := doubt_unit(own, StageConfig())):
            notes.append(f"the stage of {item.path.name} is not used: {doubt}")
            own = None
        readings.append(own)
    if turned and any(readings):
        notes.append(
            "the rotation of the stage is not used: the files do not say in which sense it counts"
        )
    if scan_rotated:
        notes.append(
            f"the stage is not used for {scan_rotated} files with a rotated scan: they do not say in which "
            "sense it counts"
        )
    tilted = any(r is not None and abs(r.tilt_rad or 0.0) > _TURNED_RAD for r in readings)
    if tilted:
        notes.append(
            "the tilts of the stage are as the files state them; stage.tilt_axis_deg of the configuration "
            "says about which axis and in which sense"
        )
    return readings, notes


def scan_tiff_folder(
    path: Path, *, display_width_m: float, databar_rows: int | None = None, stage: bool = True
) -> TiffFolder:
    """Collect the images of a folder, or a single one; only metadata are read.

    Parameters
    ----------
    path
        Folder with SEM TIFFs, not searched below, or one such file.
    display_width_m
        Display width that all magnifications are to refer to.
    databar_rows
        Rows to cut off at the bottom of every image, instead of those that the metadata give.
    stage
        Whether to read where the stage was.

    Raises
    ------
    TiffError
        No file is usable.
    """
    if not path.exists():
        raise TiffError(f"{path} does not exist", expected="a folder with SEM TIFFs")
    listed = sorted(path.iterdir(), key=_natural) if path.is_dir() else [path]
    images = [p for p in listed if p.is_file() and (is_tiff(p) or p.suffix.lower() in PLAIN_IMAGES)]
    found, skipped = _collect(images)
    if not found:
        first = f", the first ({skipped[0].name}): {skipped[0].reason}" if skipped else ""
        raise TiffError(
            f"{path} has {len(images)} image files, of which none is usable{first}",
            expected="original SEM TIFFs of Zeiss, Thermo Fisher, TESCAN or JEOL",
            do="name the folder with the microscope's own files",
        )
    width_note = f"magnifications refer to a display width of {display_width_m:g} m"
    stamped, stamp_note = _stamps(found)
    readings, stage_notes = _stages([item for item, _ in stamped])
    if not stage:
        readings, stage_notes = [None] * len(stamped), []
    entries = tuple(
        TiffEntry(item.path, stamp_ns, display_width_m / item.field_width_m, databar_rows, reading)
        for (item, stamp_ns), reading in zip(stamped, readings, strict=True)
    )
    own = dict.fromkeys(f"{i.path.name}: {note}" for i in found for note in i.settings.notes)
    return TiffFolder(
        path,
        entries,
        display_width_m,
        tuple(skipped),
        (width_note, stamp_note, *stage_notes, *own),
    )
