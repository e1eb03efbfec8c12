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

"""A calibration beyond its grid, from a recording of one specimen at a ladder of magnifications."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from semcal_ros.bridge.conditions import Conditions
from semcal_ros.bridge.images import to_gray
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.arrays import AnyImage
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.camera.records import Provenance
from semcal_ros.core.ladder.extend import LadderResult, extend_calibration
from semcal_ros.core.ladder.matching import LadderPicture
from semcal_ros.files.recordings import RecordedFrame
from semcal_ros.workflows.inputs import (
    CalibrationSource,
    ConfigSource,
    OnProgress,
    Source,
    count_frames,
    ignore_progress,
    open_source,
    require_calibration,
    resolve_config,
)
from semcal_ros.workflows.provenance import ConditionsComparison, describe_provenance

# Digits of a magnification: the same setting is the same number, however a file rounds it.
_DIGITS = 9


@dataclass(frozen=True)
class RecordingExtension:
    """An extended calibration with what the recording said.

    Attributes
    ----------
    calibration
        The calibration over the range of the grid and of the ladder.
    result
        The ladder: its steps, pairs that were left out, and what it lacks.
    notes
        Notes for the user about the recording.
    """

    calibration: Calibration
    result: LadderResult
    notes: tuple[str, ...] = ()


def extend(
    calibration: CalibrationSource,
    source: Source,
    *,
    config: ConfigSource | None = None,
    on_progress: OnProgress = ignore_progress,
) -> RecordingExtension:
    """Extend a calibration beyond its grid by pictures of a flat, textured specimen.

    Parameters
    ----------
    calibration
        A calibration or its file.
    source
        A recording of one place of the specimen: from inside the calibrated range on, in steps of at most 1.6, at each
        magnification a few pictures that are moved by a fifth to a third of the field, and one whose scan is turned by
        90 degrees. The rotation of the scan is that of the stage or of the files; where none says it, it is found.
        Or (image, magnification) tuples in memory.
    config
        A ``msg_configs`` name or file; the default is ``generic``.
    on_progress
        Called with the stage, the number of frames or pairs done, and that of all.

    Raises
    ------
    SemcalError
        If calibration, configuration or recording cannot be read, or the ladder cannot be used.

    Examples
    --------
    ::

        from semcal_ros import extend
        done = extend("jsm820.yaml", "recordings/ladder")
        done.calibration.save("jsm820_100kx.yaml")
    """
    model = require_calibration(calibration)
    microscope = resolve_config(config, model)
    seen = read_ladder(source, microscope, model, on_progress)
    provenance = describe_provenance(source, microscope, seen.frames)
    return extend_by_pictures(
        model, seen.pictures, microscope, provenance, notes=seen.notes, on_progress=on_progress
    )


def extend_by_pictures(
    calibration: Calibration,
    pictures: Sequence[LadderPicture],
    config: MicroscopeConfig,
    provenance: Provenance,
    *,
    notes: tuple[str, ...] = (),
    on_progress: OnProgress = ignore_progress,
) -> RecordingExtension:
    """Extend a calibration by pictures that are read already; arguments and errors as of :func:`extend`.

    Parameters
    ----------
    calibration
        The calibration.
    pictures
        Those of the ladder, in the order in which they were taken.
    config
        The settings in effect.
    provenance
        Where the pictures come from.
    notes
        Notes for the user about them.
    on_progress
        As there.
    """
    result = extend_calibration(calibration, pictures, timing=config.scan, on_progress=on_progress)
    extended = Calibration.from_model(replace(result.model, provenance=provenance))
    return RecordingExtension(extended, result, notes)


@dataclass(frozen=True, eq=False)
class SeenLadder:
    """Pictures of a recording, the frames without their pixels by name, and notes for the user."""

    pictures: tuple[LadderPicture, ...]
    frames: dict[str, RecordedFrame]
    notes: tuple[str, ...]


def read_ladder(
    source: Source,
    microscope: MicroscopeConfig,
    calibration: Calibration | None,
    on_progress: OnProgress,
) -> SeenLadder:
    """Read the pictures of a ladder; the notes compare their conditions with those of a calibration.

    Raises
    ------
    SemcalError
        If the recording cannot be read.
    """
    # The scans of a ladder are turned on purpose.
    conditions = ConditionsComparison(calibration, scans_may_turn=True)
    frames: dict[str, RecordedFrame] = {}
    pictures = []
    with open_source(source, microscope, calibration) as opened:
        advance = count_frames(on_progress, "reading", opened.frame_count)
        for index, frame in enumerate(opened.frames()):
            name = frame.file_name or f"frame {index}"
            conditions.add(frame.conditions)
            grey = to_gray(frame.visible, frame.encoding)
            pictures.append(
                make_picture(grey, frame.magnification, name, frame.stage, frame.conditions)
            )
            frames[name] = replace(frame, image=frame.image[:0])
            advance(1)
        notes = (*opened.notes, *conditions.notes)
    return SeenLadder(tuple(pictures), frames, notes)


def make_picture(
    grey: AnyImage,
    magnification: float,
    name: str,
    stage: StageReading | None,
    conditions: Conditions | None,
) -> LadderPicture:
    """A picture of a ladder, with the rotation of the scan that the stage or the conditions tell.

    Parameters
    ----------
    grey
        (h, w) grey levels without a data bar.
    magnification, name
        Of the picture.
    stage, conditions
        What was told of it.
    """
    turn = None if stage is None else stage.scan_rotation_rad
    if turn is None and conditions is not None:
        turn = conditions.scan_rotation_rad
    rounded = float(f"{magnification:.{_DIGITS}g}")
    return LadderPicture(grey, rounded, name, turn)
