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

"""From views of the grid to a calibration, by any of the methods, with its held-out errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.calibration.bundle_adjustment import BundleResult
from semcal_ros.core.calibration.discrete import DiscreteFit, fit_discrete, table_functions
from semcal_ros.core.calibration.evaluate import ViewPose, fit_poses, rms_by_magnification
from semcal_ros.core.calibration.finding import Finding, rank_findings
from semcal_ros.core.calibration.grid_orientation import align_lattices
from semcal_ros.core.calibration.joint import (
    RESIDUAL_MODES,
    JointFit,
    adapt_priors,
    add_shared_unknowns,
    fit_joint,
    without_magnification,
)
from semcal_ros.core.calibration.nominal_scale import (
    advise_scale,
    check_nominal_scale,
    observed_scale_factor,
)
from semcal_ros.core.calibration.outliers import (
    find_change_point,
    find_outliers,
    find_wrong_tilts,
    measure_deviations,
)
from semcal_ros.core.calibration.pda import pda_functions
from semcal_ros.core.calibration.pda_step import (
    StepTrial,
    choose_step,
    select_magnifications,
    try_steps,
)
from semcal_ros.core.calibration.priors import Priors, Setup
from semcal_ros.core.calibration.problem import variance_factor
from semcal_ros.core.calibration.residual_field_fit import undo_field
from semcal_ros.core.calibration.scale_checks import (
    estimate_repeatability,
    find_scale_weaknesses,
    measure_excess,
)
from semcal_ros.core.calibration.stage import StageAxis
from semcal_ros.core.calibration.summary import (
    collect_statistics,
    describe_field,
    describe_shares,
    describe_stage,
    list_undetermined,
)
from semcal_ros.core.calibration.untilted import mark_untilted
from semcal_ros.core.calibration.views import GridView, RejectedView, ViewStatus
from semcal_ros.core.camera.calibration_model import CalibrationModel, ScaleSigma
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.residual_field import ResidualField
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import (
    CalibrationError,
    InvalidValueError,
    Rejection,
    UnusableCalibrationError,
)
from semcal_ros.core.wording import counted

__all__ = [
    "METHODS",
    "RESIDUAL_MODES",
    "CalibrationOptions",
    "CalibrationResult",
    "MethodOptions",
    "calibrate_views",
]

Functions = Mapping[str, ContinuousFunction]

METHODS = ("joint", "pda", "discrete")
# Twice as many as determine a homography, so that there are residuals to judge a view by. Less than
# the corner finder accepts (MINIMUM_CORNERS), since views may also come from other corner finders.
_MIN_CORNERS = 8
# A parallel view gives one equation beyond its own pose; scale, aspect and skew are three unknowns.
_MIN_VIEWS = 3
# Ratio of residuals to the sigmas of the corners beyond which the misfit is due to the model or the
# grid: the sigmas of the corners themselves are right to a tenth (benchmarks, "Corner finding").
_MISFIT = 1.3


@dataclass(frozen=True)
class MethodOptions:
    """Options of the paper's methods.

    Attributes
    ----------
    pda_order
        Order of the differential equation of ``"pda"``, 1 to 4.
    legendre_degree
        With a value, ``"pda"`` fits Legendre polynomials of this degree instead.
    tau_px
        With a value, Algorithm 1 uses this fixed threshold instead of a statistical test.
    pda_step
        With a value G, ``"pda"`` fits through the magnifications nearest to multiples of G above
        the lowest one, instead of through all; ``"auto"`` takes the G with the least error.

    Raises
    ------
    InvalidValueError
        For a step that is neither positive nor ``"auto"``.
    """

    pda_order: int = 2
    legendre_degree: int | None = None
    tau_px: float | None = None
    pda_step: float | str | None = None

    def __post_init__(self) -> None:
        step = self.pda_step
        if step is None or step == "auto":
            return
        if isinstance(step, str) or not (np.isfinite(step) and step > 0.0):
            raise InvalidValueError(
                f"pda_step {step!r}", expected='"auto" or a finite step in magnification above 0'
            )


@dataclass(frozen=True)
class CalibrationOptions:
    """The choices that a user has for a calibration.

    Attributes
    ----------
    method
        ``"joint"`` (one adjustment over everything), ``"discrete"`` (each magnification by itself,
        linear between) or ``"pda"`` (the paper's differential equations through the discrete
        results).
    method_options
        Options of the paper's methods.
    breakpoints
        Magnifications at which the microscope switches its scan range, so that scale, aspect and
        skew jump (only ``"joint"``). A jump that the views indicate elsewhere is reported as a
        warning.
    residual
        Whether a residual field adds to the distortion parameters (only
        ``"joint"``): ``"on"``, ``"off"``, or ``"auto"``, where cross-validation decides.
    untilted
        Names of views in which the specimen is not tilted, ``"none"``, or ``"auto"`` (see
        :func:`~semcal_ros.core.calibration.untilted.mark_untilted`). The readings of a stage take
        precedence over ``"auto"``.
    squares_sigma
        Relative 1-sigma of the size of the grid's squares, from its certificate.
    height_sigma_m
        1-sigma of the height of what is measured later about the plane of the untilted grid: a
        focus that is set by eye repeats to the depth of field, which is 10 um for a resolution of
        0.1 um and an aperture angle of 10 mrad.
    axis
        The tilt axis of the stage, and how far its readings are trusted.

    Raises
    ------
    InvalidValueError
        For an unknown method or mode, or an option that the method does not support.
    """

    method: str = "joint"
    method_options: MethodOptions = MethodOptions()
    breakpoints: tuple[float, ...] = ()
    residual: str = "auto"
    untilted: str | tuple[str, ...] = "auto"
    squares_sigma: float = 0.0
    height_sigma_m: float = 1e-5
    axis: StageAxis = field(default_factory=StageAxis)

    def __post_init__(self) -> None:
        ScaleSigma(0.0, self.squares_sigma, self.height_sigma_m)
        if self.method not in METHODS:
            raise InvalidValueError(f"method {self.method!r}", expected=" or ".join(METHODS))
        if self.residual not in RESIDUAL_MODES:
            raise InvalidValueError(
                f"residual {self.residual!r}", expected=" or ".join(RESIDUAL_MODES)
            )
        if self.method == "joint":
            return
        if self.breakpoints:
            raise InvalidValueError(
                f"breakpoints with method {self.method}",
                expected='method "joint"',
                do="use --method joint",
            )
        if self.residual == "on":
            raise InvalidValueError(
                f"a residual field with method {self.method}",
                expected='method "joint"',
                do="use --method joint",
            )


@dataclass(frozen=True)
class CalibrationResult:
    """A calibration with the views from which it was computed.

    Attributes
    ----------
    model
        The continuous calibration.
    views
        The views that were used.
    fit
        Poses and residuals of these views under the model.
    held_out_rms_px
        RMS reprojection error of each magnification's views under a calibration from all others;
        the two outermost ones are extrapolated.
    findings
        What the data could not determine, or do not agree on.
    outliers
        Views that were left out because they disagree with the others (``"joint"``).
    """

    model: CalibrationModel
    views: tuple[GridView, ...]
    fit: ViewPose
    held_out_rms_px: Mapping[float, float]
    findings: tuple[Finding, ...]
    outliers: tuple[RejectedView, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """The findings as plain sentences, the most costly in nm first."""
        return tuple(own.tell(self.model) for own in rank_findings(self.findings, self.model))


@dataclass(frozen=True)
class _MethodFit:
    """The common result of all methods.

    ``without`` gives it without one magnification; ``failure`` says how it did not converge.
    """

    functions: Functions
    covariance: Array
    without: Callable[[int], tuple[Functions, ResidualField | None]]
    height_sigma_m: Array
    poses: tuple[Array, Array] | None
    details: dict[str, Any]
    findings: tuple[Finding, ...]
    residual: ResidualField | None = None
    repeatability: float = 0.0
    failure: str = ""


def _check_views(views: Sequence[GridView]) -> tuple[GridView, ...]:
    """Return the views in the order of their magnifications, or raise if they are too few."""
    if not views:
        raise CalibrationError(
            "no usable view",
            expected="images of a chess grid",
            do="check focus and contrast, and that the grid fills the image",
        )
    if len(views) < _MIN_VIEWS:
        raise CalibrationError(
            f"a calibration from {counted(len(views), 'view')}",
            expected=f"at least {_MIN_VIEWS} views of the grid in different directions",
            do="add tilted views",
        )
    for view in views:
        if (count := len(view.board_xy_m)) < _MIN_CORNERS:
            raise CalibrationError(
                f"view {view.name} with {counted(count, 'corner')}",
                expected=f"at least {_MIN_CORNERS} in every view",
                do="leave this view out",
            )
    return tuple(sorted(views, key=lambda v: v.magnification))


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
        to 1 (``"joint"`` starts again after leaving out views).

    Raises
    ------
    CalibrationError
        If the views do not allow a calibration.
    UnusableCalibrationError
        If their scale is off by more than a factor of 3 from the nominal one, or the adjustment
        did not converge.
    InvalidValueError
        For breakpoints outside the magnifications of the views.
    """
    options = options or CalibrationOptions()
    ordered = _check_views(views)
    magnifications = np.unique([v.magnification for v in ordered])
    breaks = _check_breakpoints(options.breakpoints, magnifications)
    setup = Setup(ordered, magnifications, image_size, display_width_m, priors or Priors(), breaks)
    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in ordered]))
    factor = observed_scale_factor(ordered, nominal)
    _check_scale(setup, factor)
    if priors is None:
        setup = adapt_priors(setup)
    if options.method == "joint":
        setup = replace(setup, axis=options.axis)
        setup = add_shared_unknowns(align_lattices(mark_untilted(setup, options.untilted)))
    outliers: tuple[RejectedView, ...] = ()
    if options.method == "joint":
        joint, setup, outliers, notes = _fit_without_outliers(setup, options.residual, on_stage)
        fit = _fit_joint(setup, joint)
        fit = replace(fit, findings=(*notes, *fit.findings))
    else:
        on_stage("one magnification after the other", 0.0)
        fit = _fit_discrete(setup, options.method, options.method_options)
    _check_converged(setup, fit, factor)

    on_stage("held-out magnifications", 0.95)
    scale = ScaleSigma(fit.repeatability, options.squares_sigma, options.height_sigma_m)
    model = _make_model(setup, fit.functions, fit.covariance, options.method, fit.residual, scale)
    poses = fit_poses(setup.views, model.at, height_sigma_m=fit.height_sigma_m, starts=fit.poses)
    held_out = _predict_held_out(setup, fit, options.method)
    findings, details = (*fit.findings, *list_undetermined(setup, model)), fit.details
    if options.method == "joint":
        findings = (*findings, *find_scale_weaknesses(setup, joint, model))
        details = {**details, "scale_shares": describe_shares(model, joint.parts)}
    result = CalibrationResult(model, setup.views, poses, held_out, findings, outliers)
    statistics = collect_statistics(
        setup, details, fit.height_sigma_m, poses, held_out, result.warnings
    )
    return replace(result, model=replace(model, statistics=statistics))


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


def _check_scale(setup: Setup, factor: float) -> None:
    check_nominal_scale(factor, **_units(setup))


# Display widths and squares that are stated are right to some per cent, and tilts shorten lengths by as much.
_TELLING_FACTOR = 1.2


def _check_converged(setup: Setup, fit: _MethodFit, factor: float) -> None:
    """Refuse a fit that is not at a minimum, or that ended far from the nominal scale."""
    if fit.failure:
        advice = "leave out what are not such views"
        if not 1.0 / _TELLING_FACTOR < factor < _TELLING_FACTOR:
            advice += "; " + advise_scale(factor, **_units(setup))
        raise UnusableCalibrationError(
            f"an adjustment that did not converge ({fit.failure}), where the images show {factor:.3g} "
            "times the scale that magnification, display width and squares predict",
            expected="views of one flat grid, by one microscope, at the magnifications that are stated",
            do=advice,
        )
    _check_scale(setup, float(np.median([fit.functions["scale"](g) for g in setup.magnifications])))


def _check_breakpoints(breakpoints: Sequence[float], magnifications: Array) -> tuple[float, ...]:
    low, high = magnifications[0], magnifications[-1]
    breaks = tuple(sorted({float(b) for b in breakpoints}))
    if not all(low < b <= high for b in breaks):
        raise InvalidValueError(
            f"breakpoints {', '.join(f'{b:g}' for b in breaks)}",
            expected=f"magnifications above {low:g} and up to {high:g}",
        )
    return breaks


def _make_model(
    setup: Setup,
    functions: Functions,
    covariance: Array,
    method: str,
    residual: ResidualField | None = None,
    scale_sigma: ScaleSigma | None = None,
) -> CalibrationModel:
    return CalibrationModel(
        functions=functions,
        covariance=covariance,
        image_width=setup.image_size[0],
        image_height=setup.image_size[1],
        display_width_m=setup.display_width_m,
        magnifications=tuple(float(g) for g in setup.magnifications),
        method=method,
        residual=residual,
        scale_sigma=scale_sigma or ScaleSigma(),
    )


def _fit_without_outliers(
    setup: Setup, residual: str, on_stage: Callable[[str, float], None]
) -> tuple[JointFit, Setup, tuple[RejectedView, ...], list[Finding]]:
    """Fit without the views, and the readings of tilts, that disagree with the others.

    Also returns those views, and a finding for each reading.
    """
    outliers: list[RejectedView] = []
    notes: list[Finding] = []
    while True:
        fit = fit_joint(setup, residual, on_stage)
        wrong = find_wrong_tilts(fit.adjustment.problem, fit.adjustment.result)
        if wrong:
            setup, own = _without_tilts(setup, wrong)
            notes += own
            continue
        found = _find_masked_outlier(setup, fit) or find_outliers(
            fit.adjustment.problem, fit.adjustment.result
        )
        if not found:
            return fit, setup, tuple(outliers), notes
        outliers += [
            RejectedView(setup.views[v].name, setup.views[v].magnification, rejection)
            for v, rejection in found.items()
        ]
        # At least two views of every magnification stay, so this loop ends.
        views = tuple(v for i, v in enumerate(setup.views) if i not in found)
        setup = replace(setup, views=views)


# A grid that seems to be so many times less regular than lithography makes it: perhaps one view is wrong.
_IRREGULAR = 4.0
# Views that are left out to see.
_SUSPECTS = 3


def _find_masked_outlier(setup: Setup, fit: JointFit) -> Mapping[int, Rejection[ViewStatus]]:
    """Find the one view without which the grid is regular.

    Where the projection is parallel, one view at a wrong scale is imitated by a tilt of a stretched grid, so
    all views are given stretched grids, and that view stands out little. Leaving it out makes the stretch of the
    others collapse, which leaving out another does not.
    """
    usual = setup.priors.grid_stretch_sigma
    lattice = fit.adjustment.spread.lattice_sigma
    if lattice is None or float(np.max(lattice)) < _IRREGULAR * usual:
        return {}
    deviations = measure_deviations(fit.adjustment.problem, fit.adjustment.result)
    count = {g: sum(v.magnification == g for v in setup.views) for g in setup.magnifications}
    suspects = [
        int(v)
        for v in np.argsort(-deviations.sigmas)[:_SUSPECTS]
        if count[setup.views[int(v)].magnification] > 2
    ]
    left = {}
    # The field is that of all views: one of them hardly changes it.
    plain = setup if fit.field is None else undo_field(setup, fit.field.field)
    for suspect in suspects:
        views = tuple(view for i, view in enumerate(plain.views) if i != suspect)
        other = fit_joint(replace(setup, views=views), "off").adjustment.spread.lattice_sigma
        left[suspect] = np.inf if other is None else float(np.max(other))
    best = min(left, key=lambda v: left[v], default=None)
    if best is None or left[best] > float(np.max(lattice)) / _IRREGULAR:
        return {}
    return {best: deviations.reject(best)}


def _without_tilts(setup: Setup, wrong: Mapping[int, float]) -> tuple[Setup, list[Finding]]:
    """Return the setup without the tilts of some views, and a finding for each of them."""
    views, notes = list(setup.views), []
    for index, sigmas in wrong.items():
        view = views[index]
        told = "the tilt of the stage" if view.stage is not None else "untilted"
        notes.append(
            Finding(
                f"scale: view {view.name} at magnification {view.magnification:g} contradicts {told} by "
                f"{sigmas:.0f} sigma; its tilt is not used"
            )
        )
        views[index] = replace(view, stage=None, untilted=False)
    return add_shared_unknowns(replace(setup, views=tuple(views))), notes


def _fit_joint(setup: Setup, fit: JointFit) -> _MethodFit:
    adjustment, result = fit.adjustment, fit.adjustment.result
    factor = variance_factor(adjustment.problem, result)
    findings = []
    own_px = float(np.median(np.concatenate([v.sigma_px for v in setup.views])))
    misfit = np.sqrt(factor) * np.hypot(1.0, fit.excess_px / own_px)
    if misfit > _MISFIT:
        excess_px, excess_at = measure_excess(setup, fit)
        findings.append(
            Finding(
                f"scale: residuals are {misfit:.1f} times what the uncertainty of the corners explains: the functions "
                "do not follow the microscope everywhere, or the grid is not regular"
                + ("; record more magnifications" if len(setup.magnifications) > 1 else ""),
                excess_px,
                magnification=excess_at,
            )
        )
    change = find_change_point(setup, adjustment.problem, result)
    if change is not None:
        findings.append(
            Finding(
                f"the scale seems to jump by {100.0 * change.relative:.2g} +- {100.0 * change.sigma:.1g} % between "
                f"magnifications {change.below:g} and {change.above:g}: if the microscope switches its scan range "
                "there, calibrate with this breakpoint",
                # A smooth curve through a jump is off by half of it on either side.
                cost_relative=0.5 * change.relative,
                magnification=change.below,
            )
        )
    if not adjustment.converged:
        findings.append(Finding("the choice of the number of coefficients did not converge"))
    details = {
        "iterations": result.iterations,
        "converged": result.converged,
        "reason": result.status.value,
        "selection_rounds": adjustment.rounds,
        "variance_factor": factor,
        "excess_sigma_px": fit.excess_px,
        "coefficients": {name: [f.kind, f.smooth_size] for name, f in adjustment.functions.items()},
        "breakpoints": list(setup.breakpoints),
        "residual_field": describe_field(fit.field),
        **describe_stage(setup, fit),
    }
    return _MethodFit(
        fit.padded,
        fit.covariance,
        lambda index: without_magnification(fit, index),
        adjustment.problem.height_sigma_m,
        (result.state.rotations, result.state.translations_m),
        details,
        tuple(findings),
        None if fit.field is None else fit.field.field,
        estimate_repeatability(setup, fit),
        "" if result.converged else result.status.value,
    )


def _fit_discrete(setup: Setup, method: str, options: MethodOptions) -> _MethodFit:
    discrete = fit_discrete(setup, tau_px=options.tau_px)

    def functions_of(keep: Mask) -> tuple[Functions, Array]:
        part = discrete.select(keep)
        if method == "discrete":
            return table_functions(part.magnifications, part.parameters, part.covariances)
        return pda_functions(part, order=options.pda_order, legendre_degree=options.legendre_degree)

    count = len(setup.magnifications)
    used = np.ones(count, dtype=bool)
    chosen: dict[str, Any] = {}
    if method == "pda" and options.pda_step is not None:
        used, chosen = _select_by_step(setup, discrete, options)
    functions, covariance = functions_of(used)
    failed = [
        f"{g:g}"
        for g, r in zip(setup.magnifications, discrete.results, strict=True)
        if not r.converged
    ]
    details = {
        "converged": not failed,
        "options": asdict(options),
        **chosen,
        "separate": [
            _describe_separate(float(g), centre, result)
            for g, centre, result in zip(
                setup.magnifications, discrete.centres, discrete.results, strict=True
            )
        ],
    }
    return _MethodFit(
        functions,
        covariance,
        lambda index: (functions_of(used & (np.arange(count) != index))[0], None),
        np.full(len(setup.views), setup.priors.height_sigma_m),
        None,
        details,
        (),
        failure=f"at magnification {', '.join(failed)}" if failed else "",
    )


def _select_by_step(
    setup: Setup, discrete: DiscreteFit, options: MethodOptions
) -> tuple[Mask, dict[str, Any]]:
    """Return which magnifications the step selects, and how it was chosen, for the statistics."""

    def rms_px(functions: Functions, covariance: Array) -> float:
        model = _make_model(setup, functions, covariance, "pda")
        height_m = setup.priors.height_sigma_m
        return fit_poses(setup.views, model.at, height_sigma_m=height_m).rms_px()

    trials: tuple[StepTrial, ...] = ()
    step = options.pda_step
    if step is None or isinstance(step, str):
        trials = try_steps(
            discrete, rms_px, order=options.pda_order, legendre_degree=options.legendre_degree
        )
        step = choose_step(trials)
    used = select_magnifications(setup.magnifications, step)
    return used, {"step": step, "steps": [asdict(trial) for trial in trials]}


def _describe_separate(g: float, centre: Any, result: BundleResult) -> dict[str, Any]:
    return {
        "magnification": g,
        "distortion": not centre.degenerate,
        "epipole_px": [float(x) for x in centre.centre_px],
        "p_value": centre.p_value,
        "rms_px": result.rms_px(),
        "iterations": result.iterations,
        "reason": result.status.value,
    }


def _predict_held_out(setup: Setup, fit: _MethodFit, method: str) -> dict[float, float]:
    """Return the error at each magnification under a calibration from all others.

    The result is empty for a single magnification.
    """
    out: dict[float, float] = {}
    count = len(setup.magnifications)
    if count < 2:
        return out
    for index, g in enumerate(setup.magnifications):
        mine = [i for i, v in enumerate(setup.views) if v.magnification == g]
        own = [setup.views[i] for i in mine]
        starts = None if fit.poses is None else (fit.poses[0][mine], fit.poses[1][mine])
        try:
            camera_at = _make_predictor(setup, *fit.without(index), index, method)
            height = fit.height_sigma_m[mine]
            poses = fit_poses(own, camera_at, height_sigma_m=height, starts=starts)
        except (CalibrationError, InvalidValueError):
            # The method has no answer there: the error is infinite, not missing.
            out[float(g)] = float("inf")
            continue
        out.update(rms_by_magnification(poses))
    return out


def _make_predictor(
    setup: Setup, functions: Functions, residual: ResidualField | None, index: int, method: str
) -> Callable[[float], ScanCamera]:
    size = sum(f.size for f in functions.values()) + (0 if residual is None else residual.size)
    rest = replace(setup, magnifications=np.delete(setup.magnifications, index))
    return _make_model(rest, functions, np.zeros((size, size)), method, residual).at
