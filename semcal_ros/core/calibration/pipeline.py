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

"""How a calibration runs: detect, assign, start, select, solve, judge.

Each stage is a function from what the one before it returns, which is frozen.

- *detect* (:func:`~semcal_ros.core.corners.find_lattice`): an image -> the corners of the grid in it, with their
  covariances, or why there are none.
- *assign* (:func:`~semcal_ros.core.calibration.views.views_from_detections`): corners -> views, with the size of the
  squares that each shows.
- *start* (:func:`~semcal_ros.core.calibration.start.start`): views -> poses and a camera that hardly depends on the
  magnification.
- *select* (:func:`~semcal_ros.core.calibration.select.select`): which terms and how many coefficients the views ask
  for, as the corners come to be believed; the residual field.
- *solve* (:func:`~semcal_ros.core.calibration.solve.solve`): the exact adjustment and its covariance.
- *judge* (:func:`~semcal_ros.core.calibration.judge.judge`): the calibration, its certificate, its held-out errors,
  and its weaknesses.

Around start, select and solve goes the search for views that disagree with the others. After it the bias of the corners
by the scan within their windows, which only a fit tells, is taken out of them, and the three are gone through again
(:mod:`~semcal_ros.core.calibration.window_bias`). The first two stages see images, and :func:`calibrate_views` does the
rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.special import chdtri

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.bundle_adjustment import variance_factor
from semcal_ros.core.calibration.estimator.poses import adjust_with_other_poses
from semcal_ros.core.calibration.estimator.problem import Priors, Setup, build_problem
from semcal_ros.core.calibration.estimator.residual_field_fit import undo_field
from semcal_ros.core.calibration.estimator.thresholds import (
    MAGNIFICATIONS_MIN,
    SPREAD_COUNT_MIN,
    SPREAD_MAX,
)
from semcal_ros.core.calibration.judge import CalibrationResult, describe_fit, judge
from semcal_ros.core.calibration.judgement.outliers import (
    find_outliers,
    find_wrong_tilts,
    measure_deviations,
)
from semcal_ros.core.calibration.judgement.thresholds import SURPRISING_SIGMAS, TILT_SIGMAS
from semcal_ros.core.calibration.method_fit import Finding, MethodFit, make_model
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.paper.methods import fit_separately
from semcal_ros.core.calibration.select import select
from semcal_ros.core.calibration.solve import JointFit, add_common_tilt, solve
from semcal_ros.core.calibration.stage import (
    OFFSET_NAMES,
    StageAxis,
    attitude_residuals,
    attitudes,
    stage_rotations,
)
from semcal_ros.core.calibration.start import (
    adapt_priors,
    add_shared_unknowns,
    advise_scale,
    align_lattices,
    check_nominal_scale,
    is_scale_far,
    look_untilted,
    mark_untilted,
    observed_scale_factor,
    start,
    with_excess,
)
from semcal_ros.core.calibration.thresholds import (
    APART_RAD,
    DETERMINED_PART,
    IRREGULAR_RATIO,
    NARROWEST_PART,
    NEARER_PART,
    OUTSIDE_PART,
    REFUSED_PART,
    SCALE_FACTOR_TOLD,
    SUSPECTS_MAX,
    UNTILTED_CONFIDENCE,
    VIEWS_MIN,
    WINDOW_BIAS_LEFT,
    WINDOW_BIAS_ROUNDS,
    WINDOW_BIAS_SETTLED,
    WORTHWHILE_PART,
)
from semcal_ros.core.calibration.views import (
    GridView,
    RejectedView,
    ViewStatus,
    refuse_tilted_lines,
)
from semcal_ros.core.calibration.window_bias import approach_window_bias, undo_window_bias
from semcal_ros.core.camera.scan_distortion import SCAN_NAMES
from semcal_ros.core.corners.thresholds import MINIMUM_CORNERS
from semcal_ros.core.errors import (
    CalibrationError,
    InvalidValueError,
    Rejection,
    UnusableCalibrationError,
)
from semcal_ros.core.wording import counted

_UNUSED_STAGE = (
    "the stage is not used; check the unit of its angles, its rotation, its stamps, and the direction of its tilt axis "
    "(stage.tilt_axis_deg)"
)


def calibrate_views(
    views: Sequence[GridView],
    *,
    image_size: tuple[int, int],
    display_width_m: float,
    options: CalibrationOptions | None = None,
    priors: Priors | None = None,
    on_stage: Callable[[str, float], None] = lambda _name, _fraction: None,
) -> CalibrationResult:
    """Calibrate the microscope from views of a planar grid.

    Parameters
    ----------
    views
        Views at one or more magnifications; three per magnification with different tilts are
        enough.
    image_size
        (width, height) of the images, px.
    display_width_m
        Display width to which the magnifications refer, m.
    options
        Method, breakpoints and residual field; None for the defaults.
    priors
        Weak prior knowledge; the defaults suit any SEM, and follow the views where their
        perspective is that of a photograph.
    on_stage
        Called with the name of the stage that begins and the fraction of the work that is done, 0
        to 1 (it starts again after views were left out, or corners freed of a bias).

    Raises
    ------
    CalibrationError
        If the views do not allow a calibration, or cannot be views in images of this size.
    UnusableCalibrationError
        If their scale is off by more than a factor of 3 from the nominal one, or the adjustment
        did not converge.
    InvalidValueError
        For breakpoints outside the magnifications of the views.
    """
    options = options or CalibrationOptions()
    views, options, lines = _prepare_lines(views, options)
    setup, factor = _prepare(views, image_size, display_width_m, options, priors)
    if options.method != "joint":
        on_stage("one magnification after the other", 0.0)
        fit = fit_separately(setup, options.method, options.method_options)
        _check_converged(setup, fit, factor)
        return judge(setup, fit, options, None, ())
    bare = [replace(view, stage=None) for view in views]
    is_optional = any(view.has_stage_tilt for view in views) and are_enough(bare, options)
    failed: CalibrationError | None = None
    try:
        joint, setup, outliers, notes = _fit_without_outliers(setup, options, on_stage)
        contradiction = _find_contradicted_stage(views, setup) or _find_mirrored_beam(setup, joint)
        if not contradiction:
            joint, setup, told = _fit_with_corner_errors(joint, setup, options, on_stage)
            notes += [*told, *_find_turned_axis(views, setup, joint), *lines]
            return _conclude(setup, factor, options, joint, outliers, notes, on_stage)
    except CalibrationError as error:
        if not is_optional:
            raise
        failed = error
        contradiction = [
            Finding(f"scale: with the tilts of the stage there is {error.seen}: {_UNUSED_STAGE}")
        ]
    if not is_optional:
        raise CalibrationError(
            f"{counted(len(views), 'view')} that contradict the tilt of the stage",
            expected=f"tilts that the images agree with, or at least {VIEWS_MIN} views, which need none",
            do="check the unit of the stage's angles, its stamps and stage.tilt_axis_deg, or record more views",
        )
    try:
        setup, factor = _prepare(bare, image_size, display_width_m, options, priors)
        joint, setup, outliers, notes = _fit_without_outliers(setup, options, on_stage)
        joint, setup, told = _fit_with_corner_errors(joint, setup, options, on_stage)
        notes += [*told, *contradiction, *_find_turned_axis(views, setup, joint), *lines]
        return _conclude(setup, factor, options, joint, outliers, notes, on_stage)
    except CalibrationError as error:
        # Without the stage it is no better: that was not what is wrong.
        raise failed or error from None


def _conclude(
    setup: Setup,
    factor: float,
    options: CalibrationOptions,
    joint: JointFit,
    outliers: tuple[RejectedView, ...],
    notes: Sequence[Finding],
    on_stage: Callable[[str, float], None],
) -> CalibrationResult:
    """Judge a joint fit; ``notes`` are the findings so far."""
    joint = add_common_tilt(joint)
    fit = describe_fit(setup, joint)
    if options.untilted == "auto":
        notes = [*notes, *_propose_untilted(setup, joint, fit)]
    fit = replace(fit, findings=(*notes, *fit.findings))
    _check_converged(setup, fit, factor)
    on_stage("held-out magnifications", 0.95)
    return judge(setup, fit, options, joint, outliers)


def prepare(
    views: Sequence[GridView],
    *,
    image_size: tuple[int, int],
    display_width_m: float,
    options: CalibrationOptions | None = None,
) -> Setup:
    """Return what is known before a fit, from where :func:`fit_joint` goes on; as for :func:`calibrate_views`."""
    views, options, _ = _prepare_lines(views, options or CalibrationOptions())
    return _prepare(views, image_size, display_width_m, options, None)[0]


def _prepare(
    views: Sequence[GridView],
    image_size: tuple[int, int],
    display_width_m: float,
    options: CalibrationOptions,
    priors: Priors | None,
) -> tuple[Setup, float]:
    """Return what is known before a fit, and the ratio of the observed to the nominal scale."""
    ordered = _check_views(views, options, image_size)
    magnifications = np.unique([v.magnification for v in ordered])
    breaks = _check_breakpoints(options.breakpoints, magnifications)
    setup = Setup(ordered, magnifications, image_size, display_width_m, priors or Priors(), breaks)
    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in ordered]))
    factor = observed_scale_factor(ordered, nominal)
    check_nominal_scale(factor, **_units(setup))
    if priors is None:
        setup = adapt_priors(setup)
    if ordered[0].across is not None:
        # Axes are compared between views here, so that a height counts as a difference of the axes. Turning a grating
        # changes the height by what the focus leaves, and a tilt has no part in it.
        own = replace(setup.priors, height_sigma_m=options.height_sigma_m)
        setup = replace(setup, priors=own)
    if options.method == "joint":
        setup = replace(setup, axis=options.axis)
        setup = add_shared_unknowns(align_lattices(mark_untilted(setup, options.untilted)))
    return setup, factor


def fit_joint(
    setup: Setup,
    residual: str = "off",
    on_stage: Callable[[str, float], None] = lambda _name, _fraction: None,
    *,
    count_shared: bool = True,
) -> JointFit:
    """Calibrate from views and nominal values alone: start, select, solve.

    ``on_stage`` is that of :func:`calibrate_views`, ``count_shared`` that of
    :func:`~semcal_ros.core.calibration.solve.solve`.
    """
    on_stage("start values", 0.0)
    started = start(setup)
    on_stage("terms and coefficients", 0.3)
    return solve(select(started, residual), on_stage, count_shared=count_shared)


def are_enough(views: Sequence[GridView], options: CalibrationOptions) -> bool:
    """Whether there are as many views as a calibration needs: :data:`VIEWS_MIN`, or one if all tilts are known."""
    if len(views) >= VIEWS_MIN:
        return True
    named = set() if isinstance(options.untilted, str) else set(options.untilted)
    known = options.untilted == "all" or all(v.has_stage_tilt or v.name in named for v in views)
    return bool(views) and known and options.method == "joint"


def _prepare_lines(
    views: Sequence[GridView], options: CalibrationOptions
) -> tuple[Sequence[GridView], CalibrationOptions, list[Finding]]:
    """Take views of a grating as untilted, since lines do not tell a tilt, and say what their directions leave open."""
    if not any(view.across is not None for view in views):
        return views, options, []
    if options.method != "joint" or options.untilted == "none":
        raise CalibrationError(
            f"views of parallel lines, with method {options.method} and untilted {options.untilted}",
            expected="method joint, and views that are not tilted",
            do="turn the grating instead of tilting it, or use a grid of two directions",
        )
    refuse_tilted_lines(views)
    flat = tuple(replace(view, stage=None) for view in views)
    open_directions = _find_open_directions(flat)
    if options.residual == "auto" and len({v.magnification for v in views}) < MAGNIFICATIONS_MIN:
        # A view that is left out has a direction of its own, which the others do not predict.
        options = replace(options, residual="off")
    return flat, replace(options, untilted="all"), open_directions


def _find_open_directions(views: Sequence[GridView]) -> list[Finding]:
    """Return a finding if the directions of lines leave a part of the linear distortion to its prior.

    Raises
    ------
    CalibrationError
        If all lines run in one direction, or nearly so.
    """
    across = np.stack([np.mean(view.across, axis=0) for view in views if view.across is not None])
    x, y = (across / np.linalg.norm(across, axis=1, keepdims=True)).T
    # The distance of lines changes with the stretch along both axes, and with the shear.
    values = np.linalg.svd(np.stack([x * x, y * y, x * y], axis=1), compute_uv=False)
    known = int(np.sum(values > DETERMINED_PART * values[0]))
    apart = float(np.max(np.arccos(np.clip(np.abs(np.outer(x, x) + np.outer(y, y)), 0.0, 1.0))))
    if apart < APART_RAD:
        raise CalibrationError(
            f"parallel lines that run in one direction in all views, within {np.degrees(apart):.0f} degrees, so that "
            "lengths along them are not known",
            expected=f"lines in at least two directions, {np.degrees(APART_RAD):.0f} degrees apart, best in three",
            do="add views with the grating turned by 90 and by 45 degrees",
        )
    if known >= 3:
        return []
    text = (
        "scale: the lines run in two directions only, which leaves a combination of pixel sizes and skew to its "
        "prior: add views with the grating turned to a third direction, best by 45 degrees"
    )
    return [Finding(text)]


def _check_views(
    views: Sequence[GridView], options: CalibrationOptions, image_size: tuple[int, int]
) -> tuple[GridView, ...]:
    """Return the views in the order of their magnifications, or raise if they are too few or impossible.

    One is enough if its tilt is known.
    """
    if not views:
        raise CalibrationError(
            "no usable view",
            expected="images of a chess grid",
            do="check focus and contrast, and that the grid fills the image",
        )
    if not are_enough(views, options):
        raise CalibrationError(
            f"a calibration from {counted(len(views), 'view')}",
            expected=f"at least {VIEWS_MIN} views of the grid in different directions, or views whose tilt is known",
            do="add tilted views, or say that the grid was not tilted (--untilted all)",
        )
    for view in views:
        if (count := len(view.board_xy_m)) < MINIMUM_CORNERS:
            raise CalibrationError(
                f"{view.name} with {counted(count, 'corner')}",
                expected=f"at least {MINIMUM_CORNERS} in every view",
                do="leave this view out",
            )
        _refuse_impossible_corners(view, image_size)
    return tuple(sorted(views, key=lambda v: v.magnification))


def _refuse_impossible_corners(view: GridView, image_size: tuple[int, int]) -> None:
    """Refuse corners on one line of the grid, which tell no pose, and corners outside the images."""
    sides = np.linalg.svd(view.board_xy_m - view.board_xy_m.mean(axis=0), compute_uv=False)
    if view.across is None and sides[1] <= NARROWEST_PART * sides[0]:
        raise CalibrationError(
            f"{view.name} with corners on one line only",
            expected="corners on several lines of the grid in every view",
            do="leave this view out",
        )
    width, height = image_size
    size = np.array(image_size)
    low, high = view.image_xy.min(axis=0), view.image_xy.max(axis=0)
    if np.any(low < -OUTSIDE_PART * size) or np.any(high > (1.0 + OUTSIDE_PART) * size):
        raise CalibrationError(
            f"{view.name} with corners from ({low[0]:.0f}, {low[1]:.0f}) to ({high[0]:.0f}, {high[1]:.0f}) px, outside "
            f"images of {width} x {height} px",
            expected="corners in the images, in whose pixels they are stated",
            do="state the width and the height of the images in which the corners were measured",
        )


def _units(setup: Setup) -> dict[str, Any]:
    """Return what the nominal scale of the views is made of."""
    known = tuple(side for side in setup.squares_m if side > 0.0)
    pixel_size_m = None
    if len(setup.magnifications) == 1:
        pixel_size_m = 1.0 / float(setup.nominal_px_per_m(setup.magnifications)[0])
    return {
        "display_width_m": setup.display_width_m,
        "squares_m": known,
        "pixel_size_m": pixel_size_m,
    }


def _check_converged(setup: Setup, fit: MethodFit, factor: float) -> None:
    """Refuse a fit that is not at a minimum, or that ended far from the nominal scale.

    The images themselves show a scale near it (:func:`_prepare`): where the fit alone left it, nothing follows for the
    display width.
    """
    ended = float(np.median([fit.functions["scale"](g) for g in setup.magnifications]))
    failure = fit.failure
    if not failure and is_scale_far(np.array(ended)):
        failure = f"it ended at {ended:.3g} times the predicted scale"
    if failure:
        advice = "leave out what are not such views"
        if not 1.0 / SCALE_FACTOR_TOLD < factor < SCALE_FACTOR_TOLD:
            advice += "; " + advise_scale(factor, **_units(setup))
        raise UnusableCalibrationError(
            f"an adjustment that did not converge ({failure}), where the images show {factor:.3g} "
            "times the scale that magnification, display width and squares predict",
            expected="views of one flat grid, by one microscope, at the magnifications that are stated",
            do=advice,
        )


def _check_breakpoints(breakpoints: Sequence[float], magnifications: Array) -> tuple[float, ...]:
    low, high = magnifications[0], magnifications[-1]
    breaks = tuple(sorted({float(b) for b in breakpoints}))
    if not all(low < b <= high for b in breaks):
        raise InvalidValueError(
            f"breakpoints {', '.join(f'{b:g}' for b in breaks)}",
            expected=f"magnifications above {low:g} and up to {high:g}",
        )
    return breaks


def _fit_with_corner_errors(
    joint: JointFit,
    setup: Setup,
    options: CalibrationOptions,
    on_stage: Callable[[str, float], None],
) -> tuple[JointFit, Setup, list[Finding]]:
    """Fit again with the errors of corners that only a fit tells: what neighbouring ones share, and their bias.

    That by the scan within their windows is taken out until it no longer changes. It is some tenths of a pixel at most,
    by which no view is left out.
    """
    if joint.shared_px > 0.0:
        # Views that are wrong have been left out.
        joint = fit_joint(setup, options.residual, on_stage)
    found = setup.views
    removed = [np.zeros_like(view.image_xy) for view in found]
    left = 0.0
    for rounds in range(WINDOW_BIAS_ROUNDS + 1):
        functions = joint.adjustment.functions
        amplitudes = {
            g: np.array([functions[name](g) if name in functions else 0.0 for name in SCAN_NAMES])
            for g in setup.magnifications.tolist()
        }
        steps = [
            approach_window_bias(view, before, amplitudes[view.magnification], setup.raster)
            for view, before in zip(found, removed, strict=True)
        ]
        left = max(
            float(np.max(np.linalg.norm(rest, axis=1) / view.sigma_px))
            for view, (_, rest) in zip(found, steps, strict=True)
        )
        if left < WINDOW_BIAS_SETTLED or rounds == WINDOW_BIAS_ROUNDS:
            break
        removed = [bias for bias, _ in steps]
        views = tuple(undo_window_bias(v, b) for v, b in zip(found, removed, strict=True))
        again = replace(setup, views=views)
        try:
            joint, setup = fit_joint(again, options.residual, on_stage), again
        except CalibrationError:
            # What was found before holds as well as it did.
            break
    if left <= WINDOW_BIAS_LEFT:
        return joint, setup, []
    text = (
        f"distortion: where the beam settles, corners are found off by up to {left:.0f} sigma more than was taken out: "
        "leave out what lies near the left border (--roi), or use smaller squares"
    )
    return joint, setup, [Finding(text)]


def _fit_without_outliers(
    setup: Setup, options: CalibrationOptions, on_stage: Callable[[str, float], None]
) -> tuple[JointFit, Setup, tuple[RejectedView, ...], list[Finding]]:
    """Fit without the views, and the readings of tilts, that disagree with the others.

    Also returns those views, and a finding for each reading; that a view is no longer guessed to be untilted is none.
    It ends before that where the views contradict most of the stage's tilts, since those that are left are wrong as
    well, by less.
    """
    outliers: list[RejectedView] = []
    notes: dict[str, Finding] = {}
    given = {view.name: view for view in setup.views}
    believed_again: set[str] = set()

    def say(found: Mapping[str, Finding]) -> list[Finding]:
        is_told = options.untilted != "auto"
        return [note for name, note in found.items() if is_told or given[name].has_stage_tilt]

    while True:
        fit = fit_joint(setup, options.residual, on_stage, count_shared=False)
        wrong = find_wrong_tilts(fit.adjustment.problem, fit.adjustment.result)
        found = _find_outlier_of_few(setup) if wrong or _is_irregular(setup, fit) else {}
        if wrong and not found:
            setup, own = _without_tilts(setup, wrong)
            notes |= own
            if _find_contradicted_stage(list(given.values()), setup):
                return fit, setup, tuple(outliers), say(notes)
            continue
        found = (
            found
            or _find_masked_outlier(setup, fit)
            or find_outliers(
                fit.adjustment.problem, fit.adjustment.result, setup.priors.height_sigma_m
            )
        )
        if not found:
            again = _find_agreeing_tilts(given, setup, fit, set(notes) - believed_again)
            if again:
                believed_again.update(again)
                views = tuple(given[v.name] if v.name in again else v for v in setup.views)
                setup = add_shared_unknowns(replace(setup, views=views))
                notes = {name: note for name, note in notes.items() if name not in again}
                continue
            return fit, setup, tuple(outliers), say(notes)
        outliers += [
            RejectedView(setup.views[v].name, setup.views[v].magnification, rejection)
            for v, rejection in found.items()
        ]
        # Views become fewer, and a reading is believed again once, so this loop ends.
        views = tuple(v for i, v in enumerate(setup.views) if i not in found)
        if not views:
            return fit, setup, tuple(outliers), say(notes)
        # A magnification of which no view is left is not calibrated.
        magnifications = np.unique([v.magnification for v in views])
        setup = replace(setup, views=views, magnifications=magnifications)


def _propose_untilted(setup: Setup, joint: JointFit, fit: MethodFit) -> list[Finding]:
    """Return a finding if zero tilts explain all views, and would make the scale much more certain.

    They do where half the chi-square of the adjustment rises by no more than that of so many unknowns does by chance
    once in twenty. They are not taken for granted: all views of a specimen on a slanted stub are tilted alike.
    """
    told = any(v.untilted or v.has_stage_tilt for v in setup.views) or joint.field is not None
    if told or not setup.shared or not look_untilted(setup):
        return []
    flat = add_shared_unknowns(mark_untilted(setup, "all"))
    # The same functions, from which only the tilts are taken.
    own = joint.adjustment
    noisy = with_excess(flat, joint.excess_px)
    problem = build_problem(noisy, own.functions, noisy.views, own.spread)
    result, _ = adjust_with_other_poses(noisy, own.functions, own.spread, problem, own.result.state)
    rise = (
        2.0 * (result.cost - own.result.cost) / max(variance_factor(own.problem, own.result), 1.0)
    )
    limit = float(chdtri(2 * len(setup.views), 1.0 - UNTILTED_CONFIDENCE))
    if rise > limit:
        return []
    try:
        other = fit_joint(flat, "off")
    except CalibrationError:
        return []
    now, then = (_worst_sigma(setup, one) for one in (fit, describe_fit(flat, other)))
    if then > WORTHWHILE_PART * now:
        return []
    return [
        Finding(
            f"scale: none of the {counted(len(setup.views), 'view')} looks tilted (zero tilts raise chi-square by "
            f"{max(rise, 0.0):.0f}, by chance up to {limit:.0f}): if none is, --untilted all lowers the uncertainty "
            f"of nm per px from {100.0 * now:.2g} % to {100.0 * then:.2g} %",
            cost_relative=now,
        )
    ]


def _worst_sigma(setup: Setup, fit: MethodFit) -> float:
    """Return the largest relative 1-sigma of the pixel sizes at the magnifications of the views."""
    model = make_model(setup, fit.functions, fit.covariance, "joint", fit.residual)
    sigmas = [
        np.array(camera.pixel_size_sigma_m) / np.array(camera.pixel_size_m)
        for camera in (model.at(float(g)) for g in setup.magnifications)
    ]
    return float(np.max(sigmas))


def _find_agreeing_tilts(
    given: Mapping[str, GridView], setup: Setup, fit: JointFit, refused: set[str]
) -> set[str]:
    """Return which of the views whose tilts were refused agree with the stage as the others know it.

    A wrong reading moves the constant offsets of the stage, and a sound one may be refused with it. What the pose of
    such a view is uncertain by does not count for it: a reading that agrees by chance alone stays refused.
    """
    chosen = [k for k, v in enumerate(setup.views) if v.name in refused]
    problem, state = fit.adjustment.problem, fit.adjustment.result.state
    if not chosen or problem.attitudes is None:
        return set()
    views = [given[setup.views[k].name] for k in chosen]
    known = attitudes(
        [v.stage for v in views],
        [v.untilted for v in views],
        setup.axis,
        setup.priors.untilted_sigma_rad,
    )
    offsets = problem.shared_values(state.theta, OFFSET_NAMES)
    left, _, _ = attitude_residuals(known, offsets, state.rotations[chosen])
    agrees = np.max(np.abs(left), axis=1) <= TILT_SIGMAS
    return {v.name for v, own in zip(views, agrees, strict=True) if own}


def _find_contradicted_stage(given: Sequence[GridView], setup: Setup) -> list[Finding]:
    """Return a finding if the tilts of most views that have one were refused."""
    told = {v.name for v in given if v.has_stage_tilt}
    refused = sum(v.name in told and v.stage is None for v in setup.views)
    if refused <= REFUSED_PART * len(told):
        return []
    return [
        Finding(
            f"scale: {refused} of {counted(len(told), 'view')} contradict the tilt of the stage: {_UNUSED_STAGE}"
        )
    ]


def _find_mirrored_beam(setup: Setup, fit: JointFit) -> list[Finding]:
    """Return a finding if tilts of the stage make the perspective that of a beam that spreads upwards."""
    functions, lowest = fit.padded.functions, float(setup.magnifications[0])
    if functions["rho"](lowest) >= 0.0 or not any(v.has_stage_tilt for v in setup.views):
        return []
    field = None if fit.field is None else fit.field.field
    camera = make_model(setup, functions, fit.covariance, "joint", field).at(lowest)
    assert camera.covariance is not None
    if camera.rho >= -SURPRISING_SIGMAS * np.sqrt(camera.covariance[5, 5]):
        return []
    return [
        Finding(
            f"scale: with the tilts of the stage, the images look as if the beam spread upwards: {_UNUSED_STAGE}"
        )
    ]


def _find_turned_axis(given: Sequence[GridView], setup: Setup, fit: JointFit) -> list[Finding]:
    """Return a finding if most tilts of the stage were refused, and are right about an axis the other way round."""
    told = {v.name: v.stage for v in given if v.has_stage_tilt}
    refused = [k for k, v in enumerate(setup.views) if v.stage is None and v.name in told]
    if len(refused) < max(REFUSED_PART * len(told), 1.0):
        return []
    readings = [told[setup.views[k].name] for k in refused]
    seen = fit.adjustment.result.state.rotations[refused, :, 2]

    def median_angle(axis: StageAxis) -> float:
        known = attitudes(readings, [False] * len(refused), axis, np.inf)
        expected = stage_rotations(known, np.zeros(len(OFFSET_NAMES)))[0][:, :, 2]
        return float(np.median(np.linalg.norm(expected - seen, axis=1)))

    turned = replace(setup.axis, tilt_axis_rad=setup.axis.tilt_axis_rad + np.pi)
    if median_angle(turned) > NEARER_PART * median_angle(setup.axis):
        return []
    return [
        Finding(
            "scale: the tilts of the stage have the wrong sign, so they are not used: add 180 to stage.tilt_axis_deg"
        )
    ]


def _is_irregular(setup: Setup, fit: JointFit) -> bool:
    """Whether the views were given stretched grids."""
    lattice = fit.adjustment.spread.lattice_sigma
    usual = setup.priors.grid_stretch_sigma
    return lattice is not None and float(np.max(lattice)) >= IRREGULAR_RATIO * usual


def _find_outlier_of_few(setup: Setup) -> Mapping[int, Rejection[ViewStatus]]:
    """Find the view of three that does not agree with the two others.

    So few views do not widen the spread of heights, and tilts and grids take the place of a wrong scale. Here they are
    given heights that can.

    Raises
    ------
    CalibrationError
        If there are two views, which do not agree: nothing tells which is wrong.
    """
    if not 1 < len(setup.views) < SPREAD_COUNT_MIN:
        return {}
    usual = setup.priors.height_sigma_m
    priors = replace(setup.priors, height_sigma_m=SPREAD_MAX * usual)
    try:
        adjusted = fit_joint(replace(setup, priors=priors), "off").adjustment
    except CalibrationError:
        return {}
    if len(setup.views) > 2:
        return find_outliers(adjusted.problem, adjusted.result, usual)
    found = measure_deviations(adjusted.problem, adjusted.result, usual)
    if np.max(found.of_limit) < 1.0:
        return {}
    first, second = (f"{v.name} (at {v.magnification:g})" for v in setup.views)
    apart_um = 1e6 * float(np.max(np.abs(found.height_m)))
    raise CalibrationError(
        f"{first} and {second} that do not agree: their heights would differ by {apart_um:.0f} um",
        expected="two views of one grid, at magnifications and with squares that are stated rightly",
        do="check the magnifications and the squares of both, or record a third view, which tells which is wrong",
    )


def _find_masked_outlier(setup: Setup, fit: JointFit) -> Mapping[int, Rejection[ViewStatus]]:
    """Find the one view without which the grid is regular.

    Where the projection is parallel, one view at a wrong scale is imitated by a tilt of a stretched grid, so
    all views are given stretched grids, and that view stands out little. Leaving it out makes the stretch of the
    others collapse, which leaving out another does not. Its own is beyond doubt: where hardly any is determined, their
    spread may be large by chance.
    """
    lattice = fit.adjustment.spread.lattice_sigma
    if lattice is None or not _is_irregular(setup, fit):
        return {}
    deviations = measure_deviations(
        fit.adjustment.problem, fit.adjustment.result, setup.priors.height_sigma_m
    )
    count = {g: sum(v.magnification == g for v in setup.views) for g in setup.magnifications}
    result = fit.adjustment.result
    sigmas = lattice * np.sqrt(result.prior_variance["lattice"])
    is_sure = np.max(np.abs(result.state.lattices) / sigmas, axis=1) > SURPRISING_SIGMAS
    suspects = [
        int(v)
        for v in np.argsort(-deviations.of_limit)[:SUSPECTS_MAX]
        if count[setup.views[int(v)].magnification] > 2 and is_sure[v]
    ]
    left = {}
    # The field is that of all views: one of them hardly changes it.
    plain = setup if fit.field is None else undo_field(setup, fit.field.field)
    for suspect in suspects:
        views = tuple(view for i, view in enumerate(plain.views) if i != suspect)
        other = fit_joint(replace(setup, views=views), "off").adjustment.spread.lattice_sigma
        left[suspect] = np.inf if other is None else float(np.max(other))
    best = min(left, key=lambda v: left[v], default=None)
    if best is None or left[best] > float(np.max(lattice)) / IRREGULAR_RATIO:
        return {}
    return {best: deviations.reject(best)}


def _without_tilts(setup: Setup, wrong: Mapping[int, float]) -> tuple[Setup, dict[str, Finding]]:
    """Return the setup without the tilts of some views, and a finding for each of them by its name."""
    views, notes = list(setup.views), {}
    for index, sigmas in wrong.items():
        view = views[index]
        told = "the tilt of the stage" if view.stage is not None else "untilted"
        notes[view.name] = Finding(
            f"scale: {view.name} at magnification {view.magnification:g} contradicts {told} by "
            f"{sigmas:.0f} sigma; its tilt is not used"
        )
        views[index] = replace(view, stage=None, untilted=False)
    return add_shared_unknowns(replace(setup, views=tuple(views))), notes
