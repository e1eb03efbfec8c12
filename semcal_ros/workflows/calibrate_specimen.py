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

"""A calibration without a grid, from a recording of a specimen and one known size."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from semcal_ros.calibration import Calibration
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.ladder.from_specimen import (
    KnownLength,
    ScaleAnchor,
    SpecimenCalibration,
    StageMoves,
    calibrate_from_specimen,
)
from semcal_ros.files.recordings import RecordedFrame
from semcal_ros.workflows.extend import read_ladder
from semcal_ros.workflows.inputs import (
    ConfigSource,
    OnProgress,
    Source,
    ignore_progress,
    resolve_config,
)
from semcal_ros.workflows.options import CONFIG, PROGRESS, Keyword, KeywordsOf, Option
from semcal_ros.workflows.provenance import describe_provenance

#: Relative 1-sigma of a size that is stated without one: what a microscope that was serviced shows.
KNOWN_SIGMA = 0.01
# A move on a stage that is tilted by as much looks 0.1 % shorter.
_FLAT_RAD = 0.045


@dataclass(frozen=True)
class RecordedSpecimenCalibration:
    """A calibration without a grid, with what the recording said.

    Attributes
    ----------
    calibration
        The calibration.
    result
        The ladder: its steps, pairs that were left out, what it lacks, and what the known size limits.
    notes
        Notes for the user about the recording.
    """

    calibration: Calibration
    result: SpecimenCalibration
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class SpecimenOptions:
    """What is known of a specimen: one of three."""

    pixel_size: Annotated[
        tuple[float, float] | None,
        Keyword("A known pixel size, m, and the magnification at which it is known."),
    ] = None
    length: Annotated[
        Sequence[float] | None,
        Option(
            "--specimen: a known length, such as 4.2um@0,110,80,300,82: in picture 0, from pixel 110,80 to 300,82.",
            kind="length in picture",
            python="In m; the number of the picture; x, y, x, y of its ends, px.",
        ),
    ] = None
    sigma: Annotated[
        float,
        Option(
            "--specimen: 1-sigma of the known pixel size or length.",
            kind="ratio",
            names=("--known-sigma",),
        ),
    ] = KNOWN_SIGMA
    stage_scale: Annotated[
        float | None,
        Option(
            "--specimen: the moves of the stage are the known lengths, with this 1-sigma, such as 0.5%.",
            kind="ratio",
            python="Its x and y are those of the recording or of the files.",
        ),
    ] = None
    config: Annotated[ConfigSource | None, CONFIG] = None
    on_progress: Annotated[OnProgress, PROGRESS] = ignore_progress


@KeywordsOf(SpecimenOptions)
def calibrate_specimen(source: Source, options: SpecimenOptions) -> RecordedSpecimenCalibration:
    """Calibrate from pictures of a flat, textured specimen, without a grid.

    ``source`` is a recording as for :func:`~semcal_ros.workflows.extend.extend`, at three magnifications or more.

    Raises
    ------
    SemcalError
        If configuration or recording cannot be read, the pictures cannot be used, or not one size is known.

    Examples
    --------
    ::

        from semcal_ros.workflows.calibrate_specimen import calibrate_specimen
        done = calibrate_specimen("recordings/gold", pixel_size=(23.1e-9, 5000.0))
        done.calibration.save("jsm820.yaml")
    """
    return calibrate_recorded_specimen(source, options)


def calibrate_recorded_specimen(
    source: Source, options: SpecimenOptions
) -> RecordedSpecimenCalibration:
    """As :func:`calibrate_specimen`, for options that are an object already."""
    pixel_size, length, stage_scale = options.pixel_size, options.length, options.stage_scale
    sigma, on_progress = options.sigma, options.on_progress
    microscope = resolve_config(options.config)
    if [pixel_size, length, stage_scale].count(None) != 2:
        raise InvalidValueError(
            "not one known size",
            expected="a pixel size and its magnification, a length and its place, or the scale of the stage",
        )
    known: ScaleAnchor | KnownLength | StageMoves | None = None
    if pixel_size is not None:
        known = ScaleAnchor(*pixel_size, sigma)
    elif length is not None:
        if len(length) != 6:
            raise InvalidValueError(
                f"a length of {len(length)} numbers", expected="a length, a picture and two pixels"
            )
        length_m, picture, *ends = length
        known = KnownLength(length_m, int(picture), (ends[0], ends[1]), (ends[2], ends[3]), sigma)
    seen = read_ladder(source, microscope, None, on_progress)
    if not seen.pictures:
        raise InvalidValueError("a recording without pictures", expected="pictures of a specimen")
    if known is None:
        assert stage_scale is not None
        known = _stage_moves(seen.frames.values(), stage_scale)
    result = calibrate_from_specimen(
        seen.pictures,
        known,
        display_width_m=microscope.display_width_m,
        timing=microscope.scan,
        on_progress=on_progress,
    )
    provenance = describe_provenance(source, microscope, seen.frames)
    calibration = Calibration.from_model(replace(result.model, provenance=provenance))
    return RecordedSpecimenCalibration(calibration, result, seen.notes)


def _stage_moves(frames: Iterable[RecordedFrame], sigma: float) -> StageMoves:
    """Where the stage was at each frame; not finite where it does not say so, or is tilted."""
    position, time = [], []
    for frame in frames:
        stage = frame.stage
        known = stage is not None and abs(stage.tilt_rad or 0.0) < _FLAT_RAD
        place = (stage.x_m, stage.y_m) if stage is not None and known else (None, None)
        position.append([np.nan if x is None else x for x in place])
        time.append(1e-9 * frame.stamp_ns)
    return StageMoves(np.array(position).reshape(-1, 2), np.array(time), sigma)
