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

"""How well a calibration predicts the views of another recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from semcal_ros.core.calibration.judgement.evaluate import (
    compare_scales,
    fit_poses,
    rms_by_magnification,
)
from semcal_ros.core.calibration.views import RejectedView, refuse_tilted_lines
from semcal_ros.core.camera.records import FitRecord
from semcal_ros.workflows.find_grid import PATTERN_AGAIN, collect_views, find_views, named_frames
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
from semcal_ros.workflows.options import CONFIG, DASK, MAGNIFICATION, PROGRESS, SQUARES, KeywordsOf
from semcal_ros.workflows.provenance import ConditionsComparison
from semcal_ros.workflows.workers import open_workers

# 1-sigma of the heights on a stage if the calibration does not contain it.
_HEIGHT_SIGMA_M = 1e-4


@dataclass(frozen=True)
class MagnificationError:
    """Reprojection error at one magnification.

    Attributes
    ----------
    magnification, views
        The magnification, and the number of its views.
    rms_px
        Root of the mean square distance of the corners, px.
    scale_error, scale_sigma
        The calibration's nm per pixel over that of these images, minus 1, and its 1-sigma: of the
        images, of their heights, and of the calibration.
    in_range
        Whether the calibration covers the magnification.
    """

    magnification: float
    views: int
    rms_px: float
    scale_error: float
    scale_sigma: float
    in_range: bool


@dataclass(frozen=True)
class Evaluation:
    """Reprojection error of a calibration on a recording.

    Attributes
    ----------
    rms_px
        Error over all corners, px.
    views, rejected
        Numbers of images that were used, and that were rejected.
    by_magnification
        The same for each magnification, ascending.
    rejections
        The images that were rejected, each with the reason.
    notes
        Notes for the user about the recording.
    """

    rms_px: float
    views: int
    rejected: int
    by_magnification: tuple[MagnificationError, ...]
    rejections: tuple[RejectedView, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions:
    """What the grid of a recording is."""

    config: Annotated[ConfigSource | None, CONFIG] = None
    magnification: Annotated[float | None, MAGNIFICATION] = None
    squares_m: Annotated[Sequence[float] | None, SQUARES] = None
    pattern: Annotated[str, PATTERN_AGAIN] = "auto"
    dask: Annotated[str | None, DASK] = None
    on_progress: Annotated[OnProgress, PROGRESS] = ignore_progress


@KeywordsOf(EvaluateOptions)
def evaluate(
    calibration: CalibrationSource, source: Source, options: EvaluateOptions
) -> Evaluation:
    """Fit a pose to each view of the grid, not the camera, and compare.

    The reprojection error does not show a wrong scale, because the heights of the views imitate
    it; so the scale is compared by itself, with heights that are as usual as in the calibration.

    ``calibration`` is one or its file; ``source`` a recording that was not used for it, or (image, magnification)
    tuples in memory.

    Raises
    ------
    SemcalError
        If calibration, configuration or recording cannot be read, or no view can be used.
    """
    return evaluate_recording(calibration, source, options)


def evaluate_recording(
    calibration: CalibrationSource, source: Source, options: EvaluateOptions
) -> Evaluation:
    """As :func:`evaluate`, for options that are an object already."""
    squares_m, on_progress = options.squares_m, options.on_progress
    model = require_calibration(calibration)
    microscope = resolve_config(options.config, model)
    conditions = ConditionsComparison(model)
    with (
        open_workers(options.dask) as workers,
        open_source(source, microscope, model, magnification=options.magnification) as opened,
    ):
        advance = count_frames(on_progress, "finding corners", opened.frame_count)
        found, rejected = find_views(
            named_frames(opened, lambda _, frame: conditions.add(frame.conditions)),
            on_progress=advance,
            workers=workers if workers.elsewhere else None,
            keep_images=False,
            pattern=choose_pattern(options.pattern, model),
        )
        notes = (*opened.notes, *conditions.notes)
    collected = collect_views(
        found,
        rejected,
        display_width_m=microscope.display_width_m,
        squares_m=microscope.squares_m
        if squares_m is None
        else check_positives(squares_m, "squares_m"),
    )
    refuse_tilted_lines(collected.views)
    on_progress("fitting the views", 0, None)
    record = model.record or FitRecord(_HEIGHT_SIGMA_M)
    height_m = record.height_sigma_m
    fit = fit_poses(
        collected.views,
        lambda g: model.at(g).resized(*collected.image_size),
        height_sigma_m=height_m,
    )
    scales = compare_scales(
        collected.views,
        lambda g: model.at(g).resized(*collected.image_size),
        fit,
        height_sigma_m=height_m,
        visit_height_sigma_m=record.visit_height_sigma_m or 0.0,
    )
    errors = (
        MagnificationError(
            magnification=g,
            views=int((fit.magnifications == g).sum()),
            rms_px=rms,
            scale_error=scales[g].relative,
            scale_sigma=scales[g].sigma,
            in_range=model.at(g).in_range,
        )
        for g, rms in rms_by_magnification(fit).items()
    )
    views, rejections = len(collected.views), collected.rejected
    return Evaluation(fit.rms_px(), views, len(rejections), tuple(errors), rejections, notes)
