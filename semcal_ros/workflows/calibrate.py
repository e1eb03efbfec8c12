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

"""From a recording to a calibration: read frames, find corners, assign squares, adjust."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from semcal_ros.bridge.conditions import Conditions
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.arrays import check_positive
from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.judgement.findings import find_all
from semcal_ros.core.calibration.method_fit import Finding
from semcal_ros.core.calibration.options import (
    METHODS,
    RESIDUAL_MODES,
    CalibrationOptions,
    MethodOptions,
)
from semcal_ros.core.calibration.pipeline import are_enough, calibrate_views
from semcal_ros.core.calibration.stage import StageAxis
from semcal_ros.core.calibration.start import check_nominal_scale, check_square_sides, is_scale_far
from semcal_ros.core.calibration.thresholds import VIEWS_MIN
from semcal_ros.core.calibration.views import (
    FoundView,
    RejectedView,
    SquareAssignment,
    assign_squares,
)
from semcal_ros.core.camera.records import Provenance
from semcal_ros.core.corners import PATTERN_NAMES
from semcal_ros.core.errors import (
    CalibrationError,
    InvalidValueError,
    SemcalError,
    UnusableCalibrationError,
)
from semcal_ros.core.wording import counted, format_length
from semcal_ros.files.recordings import RecordedFrame
from semcal_ros.workflows.find_grid import (
    PATTERN,
    UNTILTED,
    CollectedViews,
    collect_views,
    find_views,
    group_reasons,
    named_frames,
)
from semcal_ros.workflows.inputs import (
    ConfigSource,
    OnProgress,
    Source,
    check_positives,
    count_frames,
    ignore_progress,
    open_source,
    resolve_config,
)
from semcal_ros.workflows.options import (
    CONFIG,
    DASK,
    MAGNIFICATION,
    PROGRESS,
    SQUARES,
    Keyword,
    KeywordsOf,
    Option,
)
from semcal_ros.workflows.provenance import (
    describe_computation,
    describe_provenance,
    sum_up_conditions,
)
from semcal_ros.workflows.workers import open_workers

# A display width that is wrong by more than this factor is worth a warning.
_SCALE_WARNING = 1.25
# Microscopes state their pixel sizes within some per cent.
_STATED_WITHIN = 1.1
# Ratios of the scales, as logarithms, that are near enough to the square root of 2.
_ROOT_TWO = 0.03
# What numerical code raises on degenerate views.
_NUMERIC = (ArithmeticError, ValueError, np.linalg.LinAlgError)
# Views that must agree before a recording is refused without the others: three that are misread are not all misread
# to the same scale.
_FIRST_VIEWS = 3


@dataclass(frozen=True)
class RecordingCalibration:
    """A calibration with everything that a report shows.

    Attributes
    ----------
    calibration, result
        The calibration, and the adjustment it comes from.
    collected
        Views that were used, and rejected ones.
    notes
        Notes for the user about the recording.
    """

    calibration: Calibration
    result: CalibrationResult
    collected: CollectedViews
    notes: tuple[str, ...] = ()


def _check_scale(assignment: SquareAssignment, found: Sequence[FoundView], width_m: float) -> None:
    """Refuse views whose scale is far from what their magnifications, on this display, predict."""
    sizes_m = {width_m / (v.magnification * v.detection.image_size[0]) for v in found}
    check_nominal_scale(
        assignment.scale_factor,
        display_width_m=width_m,
        squares_m=[float(side) for side in assignment.square_m],
        pixel_size_m=sizes_m.pop() if len(sizes_m) == 1 else None,
    )


class _FirstViews:
    """Refuses a recording by its first views if their scale is far off whatever squares they show."""

    def __init__(self, display_width_m: float, squares_m: Sequence[float]) -> None:
        self._display_width_m = display_width_m
        self._squares_m = np.asarray(squares_m, dtype=np.float64)
        self._views: list[FoundView] = []

    def add(self, view: FoundView) -> None:
        self._views.append(view)
        if len(self._views) != _FIRST_VIEWS:
            return
        spacing = np.array([v.detection.spacing_px for v in self._views])
        width_px = np.array([v.detection.image_size[0] for v in self._views])
        nominal = (
            np.array([v.magnification for v in self._views]) * width_px / self._display_width_m
        )
        if np.all(is_scale_far((spacing / nominal)[:, None] / self._squares_m)):
            assignment = assign_squares(spacing, nominal, self._squares_m.tolist())
            _check_scale(assignment, self._views, self._display_width_m)


def _check_stated_scale(collected: CollectedViews) -> None:
    """Refuse views that all contradict the pixel sizes that their files, or the user, state.

    Raises
    ------
    UnusableCalibrationError
        If the grid of no view has the size that the pixel sizes say, within ten per cent.
    """
    factor, spread = collected.assignment.scale_factor, collected.assignment.spread
    if abs(np.log(factor)) - np.log(spread) <= np.log(_STATED_WITHIN):
        return
    seen = collected.found[0]
    side = float(collected.assignment.square_m[0])
    pattern = PATTERN_NAMES[seen.detection.pattern]
    advice = "correct --squares (squares_m), or --pixel-size"
    if abs(abs(np.log(factor)) - 0.5 * np.log(2.0)) < _ROOT_TWO:
        advice += (
            "; crosses or dots that are taken for a chess board, or the other way round, are off by the square root "
            "of 2: state --pattern"
        )
    raise UnusableCalibrationError(
        f"{pattern} {format_length(side)} apart by squares_m, and {format_length(side * factor)} apart by the stated "
        f"pixel sizes (a factor of {factor:.4g}, the same in all views within {100.0 * (spread - 1.0):.2g} %)",
        expected=f"two readings of the scale within {100.0 * (_STATED_WITHIN - 1.0):.0f} % of each other",
        do=advice
        + "; where the stated pixel sizes mean nothing, give --display-width or --magnification instead",
    )


def _remove_outliers(collected: CollectedViews, result: CalibrationResult) -> CollectedViews:
    """Return the collected views without those that the calibration left out."""
    if not result.outliers:
        return collected
    kept = {view.name for view in result.views}
    found = {view.name: view for view in collected.found}
    out = [replace(o, image=found[o.name].image) for o in result.outliers]
    return replace(
        collected,
        views=tuple(v for v in collected.views if v.name in kept),
        found=tuple(v for v in collected.found if v.name in kept),
        rejected=(*collected.rejected, *out),
    )


def options_for(
    config: MicroscopeConfig, options: CalibrationOptions | None = None
) -> CalibrationOptions:
    """Return options with what the configuration knows: the tilt axis, and the grid's certificate.

    What the options say themselves stays.
    """
    chosen = options or CalibrationOptions()
    if chosen.squares_sigma == 0.0:
        chosen = replace(chosen, squares_sigma=config.squares_sigma)
    if config.stage is not None and chosen.axis == StageAxis():
        sigma = config.stage.sigma
        axis = StageAxis(float(np.radians(config.stage.tilt_axis_deg)), sigma.tilt, sigma.rotation)
        chosen = replace(chosen, axis=axis)
    return chosen


def name_untilted(
    untilted: str | Sequence[str], found: Sequence[FoundView]
) -> str | tuple[str, ...]:
    """Return names of views for what a user may call them: by number or by file."""
    if isinstance(untilted, str):
        return untilted
    names = {view.file_name: view.name for view in found}
    names |= {view.name.removeprefix("frame "): view.name for view in found}
    names |= {view.name: view.name for view in found}
    unknown = [name for name in untilted if name not in names]
    if unknown:
        raise InvalidValueError(
            f"untilted {', '.join(map(repr, unknown[:3]))}",
            expected="numbers or file names of frames in which the grid was found, such as "
            + ", ".join(view.file_name or view.name.removeprefix("frame ") for view in found[:3]),
        )
    return tuple(names[name] for name in untilted)


def calibrate_found(
    found: Sequence[FoundView],
    rejected: Sequence[RejectedView],
    *,
    display_width_m: float,
    squares_m: Sequence[float],
    options: CalibrationOptions | None = None,
    grid_certificate: str = "",
    provenance: Provenance | None = None,
    conditions: Mapping[str, Conditions | None] | None = None,
    pixel_size_stated: bool = False,
    on_stage: Callable[[str, float], None] = lambda _name, _fraction: None,
) -> RecordingCalibration:
    """Calibrate from found corners.

    Views that ``options.untilted`` lists may be named by their number or file, too.
    ``grid_certificate`` is kept in the statistics. ``provenance`` is what is known of the origin,
    ``conditions`` how each view was taken, by its name; the names and conditions of the views that are used are
    added, and the date. ``pixel_size_stated`` says that the magnifications come from pixel sizes in the files, or
    from the user. ``on_stage`` is called with what begins and the
    fraction of the work that is done.
    """
    options = options or CalibrationOptions()
    if found:
        options = replace(options, untilted=name_untilted(options.untilted, found))
    collected = collect_views(found, rejected, display_width_m=display_width_m, squares_m=squares_m)
    if collected.rejected and not are_enough(collected.views, options):
        count = len(collected.views) + len(collected.rejected)
        raise CalibrationError(
            f"a calibration from {counted(len(collected.views), 'view')} of {counted(count, 'image')} "
            f"({group_reasons(collected.rejected)})",
            expected=f"at least {VIEWS_MIN} views of the grid in different directions, or views whose tilt is known",
            do="mend what was refused, add views, or say that the grid was not tilted (--untilted all)"
            if collected.views
            else "mend what was refused",
        )
    _check_scale(collected.assignment, collected.found, display_width_m)
    factor = collected.assignment.scale_factor
    if pixel_size_stated:
        _check_stated_scale(collected)
    check_square_sides(factor, display_width_m)

    try:
        result = calibrate_views(
            collected.views,
            image_size=collected.image_size,
            display_width_m=display_width_m,
            options=options,
            on_stage=lambda name, part: on_stage(name, 0.95 * part),
        )
    except SemcalError:
        raise
    except _NUMERIC as error:
        raise CalibrationError(
            f"views that cannot be solved for ({type(error).__name__}: {error})",
            expected="views of a grid from different directions",
            do="add tilted views, or leave out those that differ from the others",
        ) from error
    on_stage("summary", 0.95)
    collected = _remove_outliers(collected, result)
    known = list(result.findings)
    if not 1.0 / _SCALE_WARNING < factor < _SCALE_WARNING:
        known.append(
            Finding(
                f"the images show {factor:.3g} times the scale that the display width of {display_width_m:g} m "
                "predicts: check --display-width and --squares (display_width_m and squares_m of the configuration)",
                # If it is the squares that are wrong, nm per pixel is by as much.
                cost_relative=1.0 - 1.0 / factor,
            )
        )
    result = replace(result, findings=tuple(known))
    result = replace(result, findings=find_all(result, collected.rejected))
    statistics = {
        **result.model.statistics,
        "rejected_views": len(collected.rejected),
        "squares_m": sorted({float(s) for s in collected.assignment.square_m}),
        "scale_over_nominal": factor,
        **({"grid_certificate": grid_certificate} if grid_certificate else {}),
        "warnings": list(result.warnings),
    }
    taken = conditions or {}
    seen = {view.name: (taken.get(view.name), view.stage) for view in result.views}
    origin = replace(
        provenance or describe_computation(),
        views=tuple(seen),
        conditions=sum_up_conditions(seen.values()),
    )
    record = result.model.record
    if record is not None:
        record = replace(record, squares_m=tuple(statistics["squares_m"]))
    model = replace(result.model, statistics=statistics, provenance=origin, record=record)
    result = replace(result, model=model)
    return RecordingCalibration(Calibration.from_model(model), result, collected)


#: Of the fields of core's :class:`~semcal_ros.core.calibration.options.MethodOptions`.
PAPER_OPTIONS = {
    "pda_order": Option("pda: order of the differential equations.", between=(1, 4)),
    "legendre_degree": Option(
        "pda: fit Legendre polynomials of this degree instead of an ODE.",
        names=("--legendre",),
        between=(0, 20),
    ),
    "pda_step": Option(
        "pda: fit through magnifications G apart; auto tries all steps and takes that of the least error.",
        kind="step",
    ),
    "tau_px": Option("Algorithm 1: fixed threshold in px instead of a statistical test."),
}


@dataclass(frozen=True, kw_only=True)
class CalibrateOptions:
    """What is known of the grid, and how the calibration is made from it."""

    config: Annotated[ConfigSource | None, CONFIG] = None
    display_width_m: Annotated[
        float | None, Keyword("In place of that of the configuration, m.")
    ] = None
    magnification: Annotated[float | None, MAGNIFICATION] = None
    squares_m: Annotated[Sequence[float] | None, SQUARES] = None
    pattern: Annotated[str, PATTERN] = "auto"
    untilted: Annotated[str | Sequence[str | int], UNTILTED] = "auto"
    method: Annotated[
        str,
        Option("One adjustment over everything, or the ways of the paper.", choices=tuple(METHODS)),
    ] = CalibrationOptions.method
    options: Annotated[MethodOptions | None, Keyword("Options of the paper's methods.")] = None
    breakpoints: Annotated[
        Sequence[float],
        Option(
            "joint: where the microscope switches its scan range, so that the scale jumps.",
            kind="numbers",
        ),
    ] = ()
    residual: Annotated[
        str,
        Option(
            "joint: whether to add a field for what the distortion parameters cannot describe.",
            choices=tuple(RESIDUAL_MODES),
        ),
    ] = CalibrationOptions.residual
    squares_sigma: Annotated[
        float | None,
        Option(
            "Relative 1-sigma of the grid's squares, such as 0.001, instead of that of the configuration.",
            between=(0.0, 0.1),
        ),
    ] = None
    height_sigma_m: Annotated[
        float,
        Option(
            "1-sigma of the height of what is measured later above or below the untilted grid.",
            kind="length or 0",
            python="In m.",
        ),
    ] = CalibrationOptions.height_sigma_m
    dask: Annotated[str | None, DASK] = None
    on_progress: Annotated[OnProgress, PROGRESS] = ignore_progress

    def of_core(self) -> CalibrationOptions:
        """Return what core calls options; raises :class:`InvalidValueError`."""
        untilted = self.untilted
        return CalibrationOptions(
            self.method,
            self.options or MethodOptions(),
            check_positives(self.breakpoints, "breakpoints"),
            self.residual,
            untilted if isinstance(untilted, str) else tuple(str(name) for name in untilted),
            height_sigma_m=self.height_sigma_m,
        )

    def configuration(self) -> MicroscopeConfig:
        """Return the configuration, with what the options say in its place; raises :class:`SemcalError`."""
        chosen = resolve_config(self.config)
        if self.display_width_m is not None:
            width_m = check_positive(self.display_width_m, "display_width_m")
            chosen = replace(chosen, display_width_m=width_m)
        if self.squares_m is not None:
            chosen = replace(chosen, squares_m=check_positives(self.squares_m, "squares_m"))
        if self.squares_sigma is not None:
            chosen = replace(chosen, squares_sigma=self.squares_sigma)
        return chosen


def calibrate_recording(
    source: Source, asked: CalibrateOptions | None = None, *, keep_images: bool = True
) -> RecordingCalibration:
    """Calibrate, and keep the views and residuals that a report shows.

    Parameters and errors are those of :func:`calibrate`. Without ``keep_images`` the images of the
    views do not stay in memory, and a report shows none.
    """
    asked = asked or CalibrateOptions()
    options, chosen = asked.of_core(), asked.configuration()
    on_progress = asked.on_progress

    def show_stage(name: str, _fraction: float) -> None:
        on_progress(f"adjusting: {name}", 0, None)

    frames: dict[str, RecordedFrame] = {}

    def note_frame(name: str, frame: RecordedFrame) -> None:
        frames[name] = replace(frame, image=frame.image[:0])

    with (
        open_workers(asked.dask) as workers,
        open_source(source, chosen, magnification=asked.magnification) as recording,
    ):
        advance = count_frames(on_progress, "finding corners", recording.frame_count)
        found, rejected = find_views(
            named_frames(recording, note_frame),
            on_progress=advance,
            workers=workers if workers.elsewhere else None,
            keep_images=keep_images,
            pattern=asked.pattern,
            on_found=_FirstViews(chosen.display_width_m, chosen.squares_m).add,
        )
        notes, stated = recording.notes, recording.pixel_size_stated
    done = calibrate_found(
        found,
        rejected,
        display_width_m=chosen.display_width_m,
        squares_m=chosen.squares_m,
        options=options_for(chosen, options),
        grid_certificate=chosen.grid_certificate,
        pixel_size_stated=stated,
        on_stage=show_stage,
    )
    used = {view.name: frames[view.name] for view in done.result.views}
    origin = describe_provenance(source, chosen, used)
    model = replace(done.result.model, provenance=origin)
    return replace(
        done,
        calibration=Calibration.from_model(model),
        result=replace(done.result, model=model),
        notes=notes,
    )


@KeywordsOf(CalibrateOptions)
def calibrate(source: Source, asked: CalibrateOptions) -> Calibration:
    """Calibrate a microscope from a recording or from images in memory.

    ``source`` is a bag, a folder of images of the grid, or an iterable of (image, magnification)
    tuples; images are (h, w) or, in the channel order of OpenCV, (h, w, 3). Grey levels are
    processed as float32, float64 too: 24 bits, more than any detector has.

    Raises
    ------
    BagError, TiffError
        If the recording cannot be read.
    CalibrationError
        If its images do not allow a calibration.
    UnusableCalibrationError
        If their scale is off by more than a factor of 3 from what magnification, display width and squares predict,
        or the adjustment did not converge.

    Examples
    --------
    ::

        from semcal_ros import calibrate
        cal = calibrate("recordings/grid", config="jsm820")
        cal.save("jsm820.yaml")
    """
    return calibrate_recording(source, asked, keep_images=False).calibration
