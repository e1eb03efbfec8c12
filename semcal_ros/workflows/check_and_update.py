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
from typing import NamedTuple

from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.calibration.judgement.check import CalibrationCheck, check_calibration
from semcal_ros.core.calibration.judgement.thresholds import DEFAULT_AGEING
from semcal_ros.core.calibration.judgement.update import CalibrationUpdate, update_calibration
from semcal_ros.core.calibration.stage import StageAxis
from semcal_ros.core.calibration.views import FoundView, GridView, RejectedView
from semcal_ros.core.camera.provenance import Provenance
from semcal_ros.files.recordings import RecordedFrame
from semcal_ros.workflows.calibrate import name_untilted, options_for
from semcal_ros.workflows.conditions import ConditionsComparison
from semcal_ros.workflows.find_grid import collect_views, find_views, named_frames
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
from semcal_ros.workflows.provenance import describe_computation, describe_provenance

__all__ = ["RecordingCheck", "RecordingUpdate", "check", "check_found", "update", "update_found"]


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


def check(
    calibration: CalibrationSource,
    source: Source,
    *,
    config: ConfigSource | None = None,
    squares_m: Sequence[float] | None = None,
    untilted: str | Sequence[str] = "auto",
    pattern: str = "auto",
    on_progress: OnProgress = ignore_progress,
) -> RecordingCheck:
    """Test views of the grid against a calibration, within the uncertainty of both.

    Parameters
    ----------
    calibration
        A calibration or its file.
    source
        A recording of the grid, of one view or more, or (image, magnification) tuples in memory.
    config
        A ``msg_configs`` name or file; the default is ``generic``.
    squares_m
        Sizes of the grid's squares, in place of those of the configuration.
    untilted
        Views without tilt, by number or by file name; ``"auto"`` or ``"none"``.
    pattern
        What the grid consists of, as in :func:`~semcal_ros.workflows.calibrate.calibrate`;
        ``"auto"`` is a grating where the calibration was made with one.
    on_progress
        Called with the stage, the number of frames done, and that of all frames.

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
    model = require_calibration(calibration)
    seen = _see(model, source, config, squares_m, untilted, pattern, on_progress)
    on_progress("comparing", 0, None)
    return RecordingCheck(_check(model, seen), len(seen.rejected), seen.notes, seen.rejected)


def check_found(
    calibration: Calibration, found: Sequence[FoundView], config: MicroscopeConfig
) -> CalibrationCheck:
    """As :func:`check`, from found corners."""
    return _check(calibration, _arrange(found, (), config, config.squares_m, "auto", ()))


def _check(model: Calibration, seen: _Seen) -> CalibrationCheck:
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


def update(
    calibration: CalibrationSource,
    source: Source,
    *,
    config: ConfigSource | None = None,
    squares_m: Sequence[float] | None = None,
    untilted: str | Sequence[str] = "auto",
    pattern: str = "auto",
    ageing: float = DEFAULT_AGEING,
    on_progress: OnProgress = ignore_progress,
) -> RecordingUpdate:
    """Renew a calibration with a few views of the grid; the old one, with its covariance, is the prior.

    Parameters
    ----------
    calibration, source, config, squares_m, untilted, pattern, on_progress
        As for :func:`check`.
    ageing
        As for :func:`~semcal_ros.core.calibration.judgement.update.update_calibration`.

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
    model = require_calibration(calibration)
    seen = _see(model, source, config, squares_m, untilted, pattern, on_progress)
    on_progress("adjusting", 0, None)
    used = {view.name: seen.frames[view.name] for view in seen.views}
    result = _update(model, seen, ageing, describe_provenance(source, seen.config, used))
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
    model: Calibration, seen: _Seen, ageing: float, provenance: Provenance
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


class _Seen(NamedTuple):
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


def _see(
    model: Calibration,
    source: Source,
    config: ConfigSource | None,
    squares_m: Sequence[float] | None,
    untilted: str | Sequence[str],
    pattern: str,
    on_progress: OnProgress,
) -> _Seen:
    """Find the grid in a recording."""
    microscope = resolve_config(config, model)
    sizes = microscope.squares_m if squares_m is None else check_positives(squares_m, "squares_m")
    frames: dict[str, RecordedFrame] = {}
    conditions = ConditionsComparison(model)

    def note_frame(name: str, frame: RecordedFrame) -> None:
        conditions.add(frame.conditions)
        frames[name] = replace(frame, image=frame.image[:0])

    with open_source(source, microscope) as opened:
        advance = count_frames(on_progress, "finding corners", opened.frame_count)
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
) -> _Seen:
    """Give found corners their places on the grid."""
    collected = collect_views(
        found, rejected, display_width_m=microscope.display_width_m, squares_m=squares_m
    )
    return _Seen(
        tuple(collected.views),
        collected.image_size,
        name_untilted(untilted, found),
        options_for(microscope).axis,
        collected.rejected,
        notes,
        microscope,
        frames,
    )
