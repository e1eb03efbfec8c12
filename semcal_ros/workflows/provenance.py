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

"""Where a calibration comes from: its recording, configuration and conditions; and whether another recording was taken
under the same conditions.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, fields, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import semcal_ros
from semcal_ros.bridge.conditions import Conditions
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.camera.conditions import compare_conditions
from semcal_ros.core.camera.records import Provenance
from semcal_ros.core.wording import printable
from semcal_ros.files.images.image_series import find_image_files
from semcal_ros.files.recordings import RecordedFiles, RecordedFrame
from semcal_ros.workflows.inputs import Source

# Stamps before 2001 count from the start of a recording, not from 1970.
_FIRST_DATE_NS = 978_307_200_000_000_000
# Endings of a bag's data files, before that of a compressed one.
_BAG_DATA = frozenset({".mcap", ".db3"})
# The longest text of the calibration file.
_MOST_CHARACTERS = 1000

# Differences that a note names: those of a recording whose conditions change from frame to frame are no list to read.
_MOST_NAMED = 4


def describe_computation() -> Provenance:
    """When, and with which software, a calibration is computed: all that is known without its recording."""
    now = datetime.now(timezone.utc).replace(tzinfo=None)
    return Provenance(
        calibrated=now.isoformat(sep=" ", timespec="seconds"),
        software_version=semcal_ros.__version__,
    )


def describe_provenance(
    source: Source, config: MicroscopeConfig, views: Mapping[str, RecordedFrame]
) -> Provenance:
    """Tell where a calibration comes from.

    Parameters
    ----------
    source
        The recording; images in memory have no name and no digest.
    config
        The settings in effect.
    views
        The frames used, by the names of the views; their pixels are not looked at.
    """
    stamps = [frame.stamp_ns for frame in views.values()]
    seen = {name: (frame.conditions, frame.stage) for name, frame in views.items()}
    path = source.path if isinstance(source, RecordedFiles) else source
    name = Path(path).resolve().name if isinstance(path, (str, os.PathLike)) else ""
    return replace(
        describe_views(config, seen, stamps),
        recording=name[:_MOST_CHARACTERS],
        recording_sha256=_digest(list_recording_files(source)),
    )


def describe_views(
    config: MicroscopeConfig,
    views: Mapping[str, tuple[Conditions | None, StageReading | None]],
    stamps_ns: Sequence[int] = (),
) -> Provenance:
    """Tell where a calibration from live frames comes from, which have no file.

    Parameters
    ----------
    config
        The settings in effect.
    views
        Conditions and stage of the views used, by their names.
    stamps_ns
        Stamps of the views.
    """
    dates = [format_date(stamp) for stamp in (min(stamps_ns), max(stamps_ns))] if stamps_ns else []
    settings = json.dumps(asdict(config), sort_keys=True, default=str)
    return replace(
        describe_computation(),
        recorded=tuple(date for date in dates if date),
        configuration=config.name,
        configuration_sha256=hashlib.sha256(settings.encode()).hexdigest(),
        views=tuple(views),
        conditions=sum_up_conditions(views.values()),
    )


def list_recording_files(source: Source) -> list[Path]:
    """Files of a recording on disk; none for images in memory."""
    if isinstance(source, (str, os.PathLike)):
        source = RecordedFiles(source)
    if not isinstance(source, RecordedFiles):
        return []
    files: list[Path] = []
    for path in source.paths:
        if path.is_dir() and (path / "metadata.yaml").exists():
            files += [file for file in path.rglob("*") if file.is_file()]
        elif path.is_file():
            files.append(path)
        else:
            files += find_image_files(path)
    return files


def format_date(stamp_ns: int) -> str | None:
    """Date and time (UTC) of a stamp; None if it is none."""
    if stamp_ns < _FIRST_DATE_NS:
        return None
    date = datetime.fromtimestamp(stamp_ns // 1_000_000_000, tz=timezone.utc)
    return date.replace(tzinfo=None).isoformat(sep=" ")


def sum_up(values: set[Any]) -> tuple[Any, ...]:
    """The different texts, or the least and the greatest number."""
    if all(isinstance(value, str) for value in values):
        return tuple(sorted(values))
    return (min(values), max(values))


def _digest(files: Sequence[Path]) -> str:
    """SHA-256 of the one data file, or of the lines that ``sha256sum`` prints of several by name."""
    # Other files in a bag's folder, such as metadata.yaml and notes, change without any change of the data.
    data_files = [file for file in files if _BAG_DATA.intersection(file.suffixes)]
    data = sorted(data_files or files, key=lambda file: file.name)
    digests = []
    for file in data:
        found = hashlib.sha256()
        with file.open("rb") as stream:
            while block := stream.read(1 << 20):
                found.update(block)
        digests.append(found.hexdigest())
    if len(data) < 2:
        return digests[0] if digests else ""
    lines = (f"{digest}  {file.name}\n" for digest, file in zip(digests, data, strict=True))
    return hashlib.sha256("".join(lines).encode("utf-8", "surrogateescape")).hexdigest()


def sum_up_conditions(
    views: Iterable[tuple[Conditions | None, StageReading | None]],
) -> dict[str, tuple[Any, ...]]:
    """Conditions of all views, for a :class:`Provenance`: the different texts, or the least and the greatest number."""
    found: dict[str, set[Any]] = {}
    for conditions, stage in views:
        if conditions is not None:
            for item in fields(Conditions):
                value = getattr(conditions, item.name)
                if item.name != "time" and value not in (None, ""):
                    found.setdefault(item.name, set()).add(value)
        tilted = None if conditions is None else conditions.stage_tilt_rad
        if tilted is None and stage is not None and stage.tilt_rad is not None:
            found.setdefault("stage_tilt_rad", set()).add(stage.tilt_rad)
    return {name: sum_up(values) for name, values in found.items()}


class ConditionsComparison:
    """Compares the conditions of frames with those of a calibration; what one of them does not tell is not compared.

    Parameters
    ----------
    calibration
        None: nothing is compared.
    scans_may_turn
        Whether a rotation of the scan is no other condition.
    """

    def __init__(self, calibration: Calibration | None, *, scans_may_turn: bool = False) -> None:
        self._calibration = calibration
        self._scans_may_turn = scans_may_turn
        self._last: Conditions | None = None
        self._found: dict[str, bool] = {}

    def add(self, conditions: Conditions | None) -> None:
        """Take the conditions of a frame."""
        if conditions is not None and self._scans_may_turn:
            conditions = replace(conditions, scan_rotation_rad=None)
        if self._calibration is None or conditions is None or conditions == self._last:
            return
        self._last = conditions
        found = compare_conditions(
            self._calibration.provenance.conditions,
            {name: value for name, value in asdict(conditions).items() if value not in (None, "")},
            height_sigma_m=self._calibration.scale_sigma.height_m,
        )
        self._found |= {difference.text: difference.decisive for difference in found}

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user: one of what may change the scale, one of what does not."""
        decisive = self._name(True)
        others = self._name(False)
        out = []
        if decisive:
            out.append(
                f"other conditions than those of the calibration: {decisive}; check it (semcal check), or use one that "
                "was made under these conditions"
            )
        if others:
            out.append(f"different from the calibration: {others}")
        return tuple(printable(note) for note in out)

    def _name(self, decisive: bool) -> str:
        texts = [text for text, is_decisive in self._found.items() if is_decisive is decisive]
        more = len(texts) - _MOST_NAMED
        return ", ".join(texts[:_MOST_NAMED]) + (f" and {more} more" if more > 0 else "")
