"""From views of the grid to a calibration, by any of the methods, with its held-out errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.calibration.bundle_adjustment import BundleResult
from semcal_ros.core.calibration.discrete import DiscreteFit, fit_discrete, table_functions
from semcal_ros.core.calibration.evaluate import ViewPose, fit_poses, rms_by_magnification
from semcal_ros.core.calibration.joint import (
    RESIDUAL_MODES,
    JointFit,
    fit_joint,
    suited_to_views,
    without_magnification,
)
from semcal_ros.core.calibration.outliers import find_change_point, find_outliers
from semcal_ros.core.calibration.pda import pda_functions
from semcal_ros.core.calibration.priors import Priors, Setup
from semcal_ros.core.calibration.problem import variance_factor
from semcal_ros.core.calibration.summary import about_field, data_warnings, statistics_of
from semcal_ros.core.calibration.views import GridView, RejectedView
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.residual_field import ResidualField
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import CalibrationError, InvalidValueError

__all__ = ["METHODS", "RESIDUAL_MODES", "CalibrationResult", "MethodOptions", "calibrate_views"]

Functions = Mapping[str, ContinuousFunction]

METHODS = ("joint", "pda", "discrete")
_MIN_CORNERS = 8
# A parallel view gives one equation beyond its own pose; scale, aspect and skew are three unknowns.
_MIN_VIEWS = 3
# Residuals over the corners' sigmas beyond which the misfit is the model's and not a matter of these.
_MISFIT = 3.0


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
    """

    pda_order: int = 2
    legendre_degree: int | None = None
    tau_px: float | None = None


@dataclass(frozen=True)
class CalibrationResult:
    """A calibration with what it was computed from.

    Attributes
    ----------
    model
        The continuous calibration.
    views
        The views that were used.
    fit
        Poses and residuals of these views under the model.
    held_out_rms_px
        RMS reprojection error of each magnification's views under a calibration from all others; the two outermost
        ones are extrapolated.
    warnings
        Plain sentences about what the data could not determine.
    outliers
        Views that were left out because they disagree with the others (``"joint"``).
    """

    model: CalibrationModel
    views: tuple[GridView, ...]
    fit: ViewPose
    held_out_rms_px: Mapping[float, float]
    warnings: tuple[str, ...]
    outliers: tuple[RejectedView, ...] = ()


@dataclass(frozen=True)
class _Fitted:
    """What the methods have in common: functions, covariance, and the same without one magnification."""

    functions: Functions
    covariance: Array
    without: Callable[[int], tuple[Functions, ResidualField | None]]
    height_sigma_m: Array
    poses: tuple[Array, Array] | None
    details: dict[str, Any]
    warnings: tuple[str, ...]
    residual: ResidualField | None = None


def _checked(views: Sequence[GridView], method: str) -> tuple[GridView, ...]:
    if method not in METHODS:
        raise InvalidValueError(f"method {method!r}", expected=" or ".join(METHODS))
    if not views:
        raise CalibrationError(
            "no usable view",
            expected="images of a chess grid",
            do="check focus and contrast, and that the grid fills the image",
        )
    if len(views) < _MIN_VIEWS:
        raise CalibrationError(
            f"a calibration from {len(views)} views",
            expected=f"at least {_MIN_VIEWS} views of the grid in different directions",
            do="add tilted views",
        )
    for view in views:
        if (count := len(view.board_xy_m)) < _MIN_CORNERS:
            raise CalibrationError(
                f"view {view.name} with {count} corners",
                expected=f"at least {_MIN_CORNERS} in every view",
                do="leave this view out",
            )
    return tuple(sorted(views, key=lambda v: v.magnification))


def calibrate_views(
    views: Sequence[GridView],
    *,
    image_size: tuple[int, int],
    display_width_m: float,
    method: str = "joint",
    priors: Priors | None = None,
    options: MethodOptions | None = None,
    breakpoints: Sequence[float] = (),
    residual: str = "auto",
    on_stage: Callable[[str, float], None] = lambda _name, _fraction: None,
) -> CalibrationResult:
    """Calibrate the microscope from views of a planar grid.

    Parameters
    ----------
    views
        Views at one or more magnifications; three per magnification with different tilts are enough.
    image_size
        (width, height) of the images, px.
    display_width_m
        Display width to which the magnifications refer, m.
    method
        ``"joint"`` (one adjustment over everything), ``"discrete"`` (each magnification by itself, linear between) or
        ``"pda"`` (the paper's differential equations through the discrete results).
    priors
        Weak prior knowledge; the defaults suit any SEM, and follow the views where their perspective is that of a
        photograph.
    options
        Of the paper's methods.
    breakpoints
        Magnifications at which the microscope switches its scan range, so that scale, aspect and skew jump (only
        ``"joint"``). A jump that the views ask for elsewhere is reported as a warning.
    residual
        Whether a residual field describes what the distortion parameters cannot (only ``"joint"``): ``"on"``,
        ``"off"``, or ``"auto"``, where cross-validation decides.
    on_stage
        Called with the name of what begins and the fraction of the work that is done, 0 to 1 (only ``"joint"``, which
        begins anew after leaving out views).

    Raises
    ------
    CalibrationError
        If the views do not allow a calibration.
    InvalidValueError
        For an unknown method or option.
    """
    ordered = _checked(views, method)
    magnifications = np.unique([v.magnification for v in ordered])
    breaks = _checked_breakpoints(breakpoints, magnifications, method)
    setup = Setup(ordered, magnifications, image_size, display_width_m, priors or Priors(), breaks)
    if priors is None:
        setup = suited_to_views(setup)
    options = options or MethodOptions()
    if residual not in RESIDUAL_MODES:
        raise InvalidValueError(f"residual {residual!r}", expected=" or ".join(RESIDUAL_MODES))
    outliers: tuple[RejectedView, ...] = ()
    if method == "joint":
        fit, setup, outliers = _fit_joint(setup, residual, on_stage)
        fitted = _about_joint(setup, fit)
    elif residual == "on":
        raise InvalidValueError(f"a residual field with method {method}", expected='method "joint"')
    else:
        fitted = _fit_discrete(setup, method, options)

    model = _model(setup, fitted.functions, fitted.covariance, method, fitted.residual)
    poses = fit_poses(
        setup.views, model.at, height_sigma_m=fitted.height_sigma_m, starts=fitted.poses
    )
    held_out = _held_out(setup, fitted, method)
    warnings = (*fitted.warnings, *data_warnings(setup, model))
    statistics = statistics_of(
        setup, fitted.details, fitted.height_sigma_m, poses, held_out, warnings
    )
    return CalibrationResult(
        replace(model, statistics=statistics), setup.views, poses, held_out, warnings, outliers
    )


def _checked_breakpoints(
    breakpoints: Sequence[float], magnifications: Array, method: str
) -> tuple[float, ...]:
    low, high = magnifications[0], magnifications[-1]
    breaks = tuple(sorted({float(b) for b in breakpoints}))
    if breaks and method != "joint":
        raise InvalidValueError(f"breakpoints with method {method}", expected='method "joint"')
    if not all(low < b <= high for b in breaks):
        raise InvalidValueError(
            f"breakpoints {', '.join(f'{b:g}' for b in breaks)}",
            expected=f"magnifications above {low:g} and up to {high:g}",
        )
    return breaks


def _model(
    setup: Setup,
    functions: Functions,
    covariance: Array,
    method: str,
    residual: ResidualField | None = None,
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
    )


def _fit_joint(
    setup: Setup, residual: str, on_stage: Callable[[str, float], None]
) -> tuple[JointFit, Setup, tuple[RejectedView, ...]]:
    """The adjustment without the views that disagree with the others, and these."""
    outliers: list[RejectedView] = []
    while True:
        fit = fit_joint(setup, residual, on_stage)
        found = find_outliers(fit.problem, fit.result)
        if not found:
            return fit, setup, tuple(outliers)
        outliers += [
            RejectedView(setup.views[v].name, setup.views[v].magnification, rejection)
            for v, rejection in found.items()
        ]
        # At least two views of every magnification stay, so that this ends.
        views = tuple(v for i, v in enumerate(setup.views) if i not in found)
        setup = replace(setup, views=views)


def _about_joint(setup: Setup, fit: JointFit) -> _Fitted:
    factor = variance_factor(fit.problem, fit.result)
    warnings = []
    if not fit.result.converged:
        warnings.append(f"the adjustment did not converge: {fit.result.status.value}")
    own_px = float(np.median(np.concatenate([v.sigma_px for v in setup.views])))
    misfit = np.sqrt(factor) * np.hypot(1.0, fit.excess_px / own_px)
    if misfit > _MISFIT:
        warnings.append(
            f"residuals are {misfit:.1f} times what the uncertainty of the corners explains: the functions "
            "do not follow the microscope everywhere, or the grid is not regular"
            + ("; record more magnifications" if len(setup.magnifications) > 1 else "")
        )
    jump = find_change_point(setup, fit.problem, fit.result)
    if jump is not None:
        warnings.append(
            f"the scale seems to jump by {100.0 * jump.relative:.2g} +- {100.0 * jump.sigma:.1g} % between "
            f"magnifications {jump.below:g} and {jump.above:g}: if the microscope switches its scan range there, "
            "calibrate with this breakpoint"
        )
    if not fit.settled:
        warnings.append("the choice of the number of coefficients did not settle")
    details = {
        "iterations": fit.result.iterations,
        "converged": fit.result.converged,
        "reason": fit.result.status.value,
        "selection_rounds": fit.rounds,
        "variance_factor": factor,
        "excess_sigma_px": fit.excess_px,
        "coefficients": {name: [f.kind, f.smooth_size] for name, f in fit.functions.items()},
        "breakpoints": list(setup.breakpoints),
        "residual_field": about_field(fit.field),
    }
    return _Fitted(
        fit.padded,
        fit.covariance * factor,
        lambda index: without_magnification(fit, index),
        fit.problem.height_sigma_m,
        (fit.result.state.rotations, fit.result.state.translations_m),
        details,
        tuple(warnings),
        None if fit.field is None else fit.field.field,
    )


def _fit_discrete(setup: Setup, method: str, options: MethodOptions) -> _Fitted:
    discrete = fit_discrete(setup, tau_px=options.tau_px)

    def functions_of(keep: Mask) -> tuple[Functions, Array]:
        part = DiscreteFit(
            discrete.magnifications[keep],
            discrete.parameters[keep],
            discrete.covariances[keep],
            discrete.centres,
            discrete.results,
        )
        if method == "discrete":
            return table_functions(part.magnifications, part.parameters, part.covariances)
        return pda_functions(part, order=options.pda_order, legendre_degree=options.legendre_degree)

    count = len(setup.magnifications)
    functions, covariance = functions_of(np.ones(count, dtype=bool))
    failed = [
        f"{g:g}"
        for g, r in zip(setup.magnifications, discrete.results, strict=True)
        if not r.converged
    ]
    warnings = [f"no convergence at magnification {', '.join(failed)}"] if failed else []
    details = {
        "converged": not failed,
        "options": asdict(options),
        "separate": [
            _separate(float(g), centre, result)
            for g, centre, result in zip(
                setup.magnifications, discrete.centres, discrete.results, strict=True
            )
        ],
    }
    return _Fitted(
        functions,
        covariance,
        lambda index: (functions_of(np.arange(count) != index)[0], None),
        np.full(len(setup.views), setup.priors.height_sigma_m),
        None,
        details,
        tuple(warnings),
    )


def _separate(g: float, centre: Any, result: BundleResult) -> dict[str, Any]:
    return {
        "magnification": g,
        "distortion": not centre.degenerate,
        "epipole_px": [float(x) for x in centre.centre_px],
        "p_value": centre.p_value,
        "rms_px": result.rms_px(),
        "iterations": result.iterations,
        "reason": result.status.value,
    }


def _held_out(setup: Setup, fitted: _Fitted, method: str) -> dict[float, float]:
    """Error at each magnification under a calibration from all others; empty for a single magnification."""
    out: dict[float, float] = {}
    count = len(setup.magnifications)
    if count < 2:
        return out
    for index, g in enumerate(setup.magnifications):
        mine = [i for i, v in enumerate(setup.views) if v.magnification == g]
        own = [setup.views[i] for i in mine]
        starts = None if fitted.poses is None else (fitted.poses[0][mine], fitted.poses[1][mine])
        try:
            camera_at = _predictor(setup, *fitted.without(index), index, method)
            height = fitted.height_sigma_m[mine]
            fit = fit_poses(own, camera_at, height_sigma_m=height, starts=starts)
        except (CalibrationError, InvalidValueError):
            # The method has no answer there: that is an infinite error, not a missing one.
            out[float(g)] = float("inf")
            continue
        out.update(rms_by_magnification(fit))
    return out


def _predictor(
    setup: Setup, functions: Functions, residual: ResidualField | None, index: int, method: str
) -> Callable[[float], ScanCamera]:
    size = sum(f.size for f in functions.values()) + (0 if residual is None else residual.size)
    rest = replace(setup, magnifications=np.delete(setup.magnifications, index))
    return _model(rest, functions, np.zeros((size, size)), method, residual).at
