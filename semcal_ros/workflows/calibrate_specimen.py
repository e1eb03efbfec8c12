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

from collections.abc import Sequence
from dataclasses import dataclass, replace

from semcal_ros.calibration import Calibration
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.ladder.from_specimen import (
    KnownLength,
    ScaleAnchor,
    SpecimenCalibration,
    calibrate_from_specimen,
)
from semcal_ros.workflows.extend import read_ladder
from semcal_ros.workflows.inputs import (
    ConfigSource,
    OnProgress,
    Source,
    ignore_progress,
    resolve_config,
)
from semcal_ros.workflows.provenance import describe_provenance

__all__ = ["KNOWN_SIGMA", "RecordedSpecimenCalibration", "calibrate_specimen"]

#: Relative 1-sigma of a size that is stated without one: what a microscope that was serviced shows.
KNOWN_SIGMA = 0.01


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


def calibrate_specimen(
    source: Source,
    *,
    pixel_size: tuple[float, float] | None = None,
    length: Sequence[float] | None = None,
    sigma: float = KNOWN_SIGMA,
    config: ConfigSource | None = None,
    on_progress: OnProgress = ignore_progress,
) -> RecordedSpecimenCalibration:
    """Calibrate from pictures of a flat, textured specimen, without a grid.

    Parameters
    ----------
    source
        A recording as for :func:`~semcal_ros.workflows.extend.extend`, at three magnifications or more.
    pixel_size
        A known pixel size, m, and the magnification at which it is known.
    length
        Or a known length, m, the number of a picture, and x, y, x, y of its ends there, px.
    sigma
        Relative 1-sigma of the known size.
    config
        A ``msg_configs`` name or file; the default is ``generic``.
    on_progress
        Called with the stage, the number of frames or pairs done, and that of all.

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
    microscope = resolve_config(config)
    known: ScaleAnchor | KnownLength
    if pixel_size is not None and length is None:
        known = ScaleAnchor(*pixel_size, sigma)
    elif length is not None and pixel_size is None and len(length) == 6:
        length_m, picture, *ends = length
        known = KnownLength(length_m, int(picture), (ends[0], ends[1]), (ends[2], ends[3]), sigma)
    else:
        raise InvalidValueError(
            "not one known size",
            expected="a pixel size and its magnification, or a length, a picture and two pixels",
        )
    seen = read_ladder(source, microscope, None, on_progress)
    if not seen.pictures:
        raise InvalidValueError("a recording without pictures", expected="pictures of a specimen")
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
