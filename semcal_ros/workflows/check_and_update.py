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

"""Whether a calibration still holds, from a few views of the grid, and its renewal by them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated, NamedTuple

from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.calibration.judgement.check import CalibrationCheck, check_calibration
from semcal_ros.core.calibration.judgement.thresholds import DEFAULT_AGEING
from semcal_ros.core.calibration.judgement.update import CalibrationUpdate, update_calibration
from semcal_ros.core.calibration.stage import StageAxis
from semcal_ros.core.calibration.views import FoundView, GridView, RejectedView
from semcal_ros.core.camera.records import Provenance
from semcal_ros.files.recordings import RecordedFrame
from semcal_ros.workflows.calibrate import name_untilted, options_for
from semcal_ros.workflows.find_grid import (
    PATTERN_AGAIN,
    UNTILTED,
    collect_views,
    find_views,
    named_frames,
)
from semcal_ros.workflows.inputs import (
    CalibrationSource,
    ConfigSource,
    OnProgress,
    Source,
    check_positives,
    choose_pattern,
    count_frames,
    ignore_progress,
    open_source,
    require_calibration,
    resolve_config,
)
from semcal_ros.workflows.options import CONFIG, PROGRESS, SQUARES, KeywordsOf, Option
from semcal_ros.workflows.provenance import (
    ConditionsComparison,
    describe_computation,
    describe_provenance,
)


@dataclass(frozen=True)
class RecordingCheck:
    """A check with what the recording said.

    Attributes
    ----------
    result
        Verdict, changes and tests.
    rejected
        Number of images that could not be used.
    notes
        Notes for the user about the recording.
    rejections
        These images, each with the reason.
    """

    result: CalibrationCheck
    rejected: int
    notes: tuple[str, ...] = ()
    rejections: tuple[RejectedView, ...] = ()


@dataclass(frozen=True, kw_only=True)
class CheckOptions:
    """What the grid is that a calibration is compared with."""

    config: Annotated[ConfigSource | None, CONFIG] = None
    squares_m: Annotated[Sequence[float] | None, SQUARES] = None
    pattern: Annotated[str, PATTERN_AGAIN] = "auto"
    untilted: Annotated[str | Sequence[str], UNTILTED] = "auto"
    on_progress: Annotated[OnProgress, PROGRESS] = ignore_progress


@dataclass(frozen=True, kw_only=True)
class UpdateOptions(CheckOptions):
    """What the grid is by which a calibration is renewed, and how old the calibration is."""

    ageing: Annotated[
        float,
        Option(
            "1-sigma of a change of the scale since the calibration that the views need not prove.",
            kind="ratio",
        ),
    ] = DEFAULT_AGEING


@KeywordsOf(CheckOptions)
def check(calibration: CalibrationSource, source: Source, options: CheckOptions) -> RecordingCheck:
    """Test views of the grid against a calibration, within the uncertainty of both.

    ``calibration`` is one or its file; ``source`` a recording of the grid, of one view or more, or
    (image, magnification) tuples in memory.

    Raises
    ------
    SemcalError
        If calibration, configuration or recording cannot be read, no view can be used, or none lies in the
        calibrated range.

    Examples
    --------
    ::

        from semcal_ros import check
        done = check("jsm820.yaml", "recordings/grid_today")
        done.result.verdict, done.result.changes
    """
    return check_recording(calibration, source, options)


def check_recording(
    calibration: CalibrationSource, source: Source, options: CheckOptions
) -> RecordingCheck:
    """As :func:`check`, for options that are an object already."""
    model = require_calibration(calibration)
    seen = _see(model, source, options)
    options.on_progress("comparing", 0, None)
    return RecordingCheck(_check(model, seen), len(seen.rejected), seen.notes, seen.rejected)


def check_found(
    calibration: Calibration, found: Sequence[FoundView], config: MicroscopeConfig
) -> CalibrationCheck:
    """As :func:`check`, from found corners."""
    return _check(calibration, _arrange(found, (), config, config.squares_m, "auto", ()))


def _check(model: Calibration, seen: _GridRecording) -> CalibrationCheck:
    return check_calibration(
        model, seen.views, image_size=seen.image_size, untilted=seen.untilted, axis=seen.axis
    )


@dataclass(frozen=True)
class RecordingUpdate:
    """A renewed calibration with what the recording said.

    Attributes
    ----------
    calibration
        The renewed calibration.
    result
        What had changed, and the adjustment.
    rejected
        Number of images that could not be used.
    notes
        Notes for the user about the recording.
    rejections
        These images, each with the reason.
    """

    calibration: Calibration
    result: CalibrationUpdate
    rejected: int
    notes: tuple[str, ...] = ()
    rejections: tuple[RejectedView, ...] = ()


@KeywordsOf(UpdateOptions)
def update(
    calibration: CalibrationSource, source: Source, options: UpdateOptions
) -> RecordingUpdate:
    """Renew a calibration with a few views of the grid; the old one, with its covariance, is the prior.

    ``calibration`` and ``source`` are those of :func:`check`.

    Raises
    ------
    SemcalError
        As :func:`check`, or if the views contradict the calibration.

    Examples
    --------
    ::

        from semcal_ros import update
        update("jsm820.yaml", "recordings/grid_today").calibration.save("jsm820_today.yaml")
    """
    return update_by_recording(calibration, source, options)


def update_by_recording(
    calibration: CalibrationSource, source: Source, options: UpdateOptions
) -> RecordingUpdate:
    """As :func:`update`, for options that are an object already."""
    model = require_calibration(calibration)
    seen = _see(model, source, options)
    options.on_progress("adjusting", 0, None)
    used = {view.name: seen.frames[view.name] for view in seen.views}
    origin = describe_provenance(source, seen.config, used)
    result = _update(model, seen, options.ageing, origin)
    renewed = Calibration.from_model(result.model)
    return RecordingUpdate(renewed, result, len(seen.rejected), seen.notes, seen.rejected)


def update_found(
    calibration: Calibration,
    found: Sequence[FoundView],
    config: MicroscopeConfig,
    provenance: Provenance | None = None,
) -> CalibrationUpdate:
    """As :func:`update`, from found corners; ``provenance`` is that of the views."""
    seen = _arrange(found, (), config, config.squares_m, "auto", ())
    return _update(calibration, seen, DEFAULT_AGEING, provenance or describe_computation())


def _update(
    model: Calibration, seen: _GridRecording, ageing: float, provenance: Provenance
) -> CalibrationUpdate:
    result = update_calibration(
        model,
        seen.views,
        image_size=seen.image_size,
        untilted=seen.untilted,
        axis=seen.axis,
        ageing=ageing,
    )
    # Recording and conditions of the old one are not those of the new one.
    return replace(result, model=replace(result.model, provenance=provenance))


class _GridRecording(NamedTuple):
    """The views of a recording, and what goes with them."""

    views: tuple[GridView, ...]
    image_size: tuple[int, int]
    untilted: str | tuple[str, ...]
    axis: StageAxis
    rejected: tuple[RejectedView, ...]
    notes: tuple[str, ...]
    config: MicroscopeConfig
    # Without their pixels, by the names of the views; none for views that were found elsewhere.
    frames: Mapping[str, RecordedFrame]


def _see(model: Calibration, source: Source, options: CheckOptions) -> _GridRecording:
    """Find the grid in a recording."""
    squares_m, untilted, pattern = options.squares_m, options.untilted, options.pattern
    microscope = resolve_config(options.config, model)
    sizes = microscope.squares_m if squares_m is None else check_positives(squares_m, "squares_m")
    frames: dict[str, RecordedFrame] = {}
    conditions = ConditionsComparison(model)

    def note_frame(name: str, frame: RecordedFrame) -> None:
        conditions.add(frame.conditions)
        frames[name] = replace(frame, image=frame.image[:0])

    with open_source(source, microscope, model) as opened:
        advance = count_frames(options.on_progress, "finding corners", opened.frame_count)
        found, rejected = find_views(
            named_frames(opened, note_frame),
            on_progress=advance,
            keep_images=False,
            pattern=choose_pattern(pattern, model),
        )
        notes = (*opened.notes, *conditions.notes)
    return _arrange(found, rejected, microscope, sizes, untilted, notes, frames)


def _arrange(
    found: Sequence[FoundView],
    rejected: Sequence[RejectedView],
    microscope: MicroscopeConfig,
    squares_m: Sequence[float],
    untilted: str | Sequence[str],
    notes: tuple[str, ...],
    frames: Mapping[str, RecordedFrame] = MappingProxyType({}),
) -> _GridRecording:
    """Give found corners their places on the grid."""
    collected = collect_views(
        found, rejected, display_width_m=microscope.display_width_m, squares_m=squares_m
    )
    return _GridRecording(
        tuple(collected.views),
        collected.image_size,
        name_untilted(untilted, found),
        options_for(microscope).axis,
        collected.rejected,
        notes,
        microscope,
        frames,
    )
