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

"""From a fit to a calibration: its model, its held-out errors, its statistics, and what is to be said of it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.blocks import GRID_NAMES
from semcal_ros.core.calibration.estimator.bundle_adjustment import variance_factor
from semcal_ros.core.calibration.estimator.posterior import CovarianceParts, certify
from semcal_ros.core.calibration.estimator.problem import Functions, Setup
from semcal_ros.core.calibration.estimator.residual_field_fit import FittedField
from semcal_ros.core.calibration.judgement.evaluate import ViewPose, fit_poses, rms_by_magnification
from semcal_ros.core.calibration.judgement.outliers import ChangePoint, find_change_point
from semcal_ros.core.calibration.judgement.scale_checks import (
    estimate_repeatability,
    find_scale_weaknesses,
    measure_excess,
)
from semcal_ros.core.calibration.judgement.thresholds import VIEWS_MIN
from semcal_ros.core.calibration.method_fit import Finding, MethodFit, make_model, rank_findings
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.solve import JointFit, without_magnification
from semcal_ros.core.calibration.thresholds import GRID_STRETCH_MAX, MISFIT_MAX
from semcal_ros.core.calibration.views import GridView, RejectedView, median_sigma_px, show_lines
from semcal_ros.core.camera.calibration_model import (
    CalibrationModel,
    ScaleSigma,
    pixel_size_gradient,
)
from semcal_ros.core.camera.records import FitRecord, ScaleShares
from semcal_ros.core.camera.residual_field import ResidualField
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import CalibrationError, InvalidValueError


def describe_field(fitted: FittedField | None) -> dict[str, Any] | None:
    """Describe how the residual field was chosen, or return None without one."""
    if fitted is None:
        return None
    choice = fitted.choice
    return {
        "strength_px": choice.strength_px,
        "held_out_gain": choice.gain,
        "held_out_gain_sigma": choice.gain_sigma,
        "worthwhile": choice.worthwhile,
        "converged": fitted.converged,
    }


def describe_stage(setup: Setup, fit: JointFit) -> dict[str, Any]:
    """Describe what the views tell about the stage, the grid and the repeatability.

    Each value has its 1-sigma in the key that ends in ``_sigma``.
    """
    if not setup.shared:
        return {}
    adjustment = fit.adjustment
    count = len(setup.shared)
    values = adjustment.result.state.theta[-count:]
    sigmas = np.sqrt(np.maximum(np.diag(adjustment.result.covariance)[-count:], 0.0))
    shared: dict[str, float] = {}
    for name, value, sigma in zip(setup.shared, values, sigmas, strict=True):
        shared[name], shared[f"{name}_sigma"] = float(value), float(sigma)
    spread = adjustment.spread
    return {
        "grid_and_stage": shared,
        "repeatability": spread.scale.sigma,
        "repeatability_sigma": _finite_or_none(spread.scale.sigma_of_sigma),
        "visit_height_sigma_m": spread.visit_height.sigma,
        "drift_sigma_px": [float(spread.drift_sigma_px.min()), float(spread.drift_sigma_px.max())],
        "lattice_sigma": None if spread.lattice_sigma is None else spread.lattice_sigma.tolist(),
        "line_jitter_px": fit.padded.jitter.sigma_px,
    }


def _measure_grid_stretch(fit: JointFit) -> float:
    """Return by how much the cells of the grid are longer along one axis than along the other, relative.

    A grid looks the same after a quarter turn. Where nothing tells its axes apart, the views have stretches of their
    own, whose signs mean nothing.
    """
    problem, state = fit.adjustment.problem, fit.adjustment.result.state
    if not problem.shared:
        return 0.0
    (common,) = problem.shared_values(state.theta, GRID_NAMES[:1])
    own = state.lattices[:, 0] if len(state.lattices) else np.zeros(1)
    return float(np.sqrt(np.mean((common + own) ** 2)))


def describe_shares(model: CalibrationModel, parts: CovarianceParts) -> ScaleShares:
    """Return the parts of the variance of nm per pixel at each calibrated magnification, of the less certain axis.

    What is missing to 1 is the form of the functions: coefficients that were left out, and what would move with them.
    """
    size = len(parts.corners)
    corners, visits = [], []
    for g in model.magnifications:
        rows = pixel_size_gradient(model, g)
        whole = np.einsum("ai,ij,aj->a", rows, model.covariance[:size, :size], rows)
        row, variance = rows[int(np.argmax(whole))], float(np.max(whole))
        own = [max(float(row @ part @ row), 0.0) for part in (parts.corners, parts.visits)]
        # A residual field takes over some of what the functions alone would have to explain.
        most = max(variance, sum(own), np.finfo(np.float64).tiny)
        corners.append(own[0] / most)
        visits.append(own[1] / most)
    return ScaleShares(model.magnifications, tuple(corners), tuple(visits))


def _finite_or_none(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def list_undetermined(setup: Setup, model: CalibrationModel) -> list[Finding]:
    """List parameters that the views do not determine beyond their priors."""
    found: list[Finding] = []
    covariance = model.at(float(np.sqrt(np.prod(model.magnification_range)))).covariance
    assert covariance is not None
    sigma = np.sqrt(np.diag(covariance))
    # A fitted pose takes up an error of the principal point; at another pivot a height counts differently.
    costs = {"px": np.nan, "rho": float(sigma[5]) * model.scale_sigma.height_m}
    for index, name, label in (
        (3, "px", "principal point"),
        (5, "rho", "distance of the scan pivot"),
    ):
        if sigma[index] > 0.8 * setup.prior_of(name)[1]:
            text = f"the views do not determine the {label}; it is held by its prior"
            found.append(Finding(text, cost_relative=costs[name]))
    counts = {g: sum(v.magnification == g for v in setup.views) for g in setup.magnifications}
    few = [f"{g:g}" for g, n in counts.items() if n < 3]
    if few:
        found.append(Finding(f"fewer than 3 views at magnification {', '.join(few)}"))
    return found


def collect_statistics(
    setup: Setup,
    details: Mapping[str, Any],
    height_sigma_m: Array,
    poses: ViewPose,
    held_out: Mapping[float, float],
    warnings: Sequence[str],
) -> dict[str, Any]:
    """Collect the plain numbers and sentences that the calibration file keeps."""
    inner = [held_out[float(g)] for g in setup.magnifications[1:-1] if float(g) in held_out]
    rms = rms_by_magnification(poses)
    return {
        "views": len(setup.views),
        "corners": int(sum(len(v.board_xy_m) for v in setup.views)),
        "rms_px": poses.rms_px(),
        "held_out_rms_px": float(np.sqrt(np.mean(np.square(inner)))) if inner else None,
        "by_magnification": [
            {
                "magnification": float(g),
                "views": int(sum(v.magnification == g for v in setup.views)),
                "rms_px": rms[float(g)],
                "held_out_rms_px": held_out.get(float(g)),
                "held_out_extrapolated": bool(
                    g in (setup.magnifications[0], setup.magnifications[-1])
                ),
            }
            for g in setup.magnifications
        ],
        "gauge": "the reference plane is that of the untilted views: their heights have zero prior mean",
        "priors": {
            **asdict(setup.priors),
            "height_sigma_m": float(np.max(height_sigma_m)),
            "least_height_sigma_m": float(np.min(height_sigma_m)),
        },
        "fit": dict(details),
        "warnings": list(warnings),
    }


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
        Poses and residuals of these views under the model; of ``"joint"`` the residuals that its adjustment leaves,
        which knows besides the poses of the shape of the grid, of visits and of drift.
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
        return tuple(own.sentence(self.model) for own in rank_findings(self.findings, self.model))


def _ask_views_at(setup: Setup, g: float) -> str:
    names = [v.name for v in setup.views if v.magnification == g]
    return f"{' and '.join(names)} {'was' if len(names) == 1 else 'were'} taken at {g:g}"


def _name_few_beside(setup: Setup, change: ChangePoint) -> str:
    """Return that the few views beside a jump may have a wrong magnification, or nothing if they are not few."""
    counts = Counter(v.magnification for v in setup.views)
    least = min((change.below, change.above), key=lambda g: counts[g])
    if counts[least] >= min(VIEWS_MIN, float(np.median(list(counts.values())))):
        return ""
    asked = _ask_views_at(setup, least)
    return f"look first whether {asked}, where there are fewer views than elsewhere; else, "


def _name_squares_beside(setup: Setup, change: ChangePoint) -> str:
    """Say that the squares below a jump are other ones than above, since a wrong size looks alike; else empty."""
    below, above = (
        {v.square_m for v in setup.views if v.magnification == g}
        for g in (change.below, change.above)
    )
    if below & above:
        return ""
    sizes = (" and ".join(f"{1e6 * m:g} um" for m in sorted(s)) for s in (below, above))
    return (
        f"the squares are of {' below, and of '.join(sizes)} above, and a wrong size of either looks the same: check "
        "them first, since a breakpoint would hide it; only "
    )


def _describe_change(setup: Setup, change: ChangePoint) -> Finding:
    size = f"by {100.0 * change.relative:.2g} +- {100.0 * change.sigma:.1g} %"
    if change.below == change.above:
        text = (
            f"the scale at magnification {change.below:g} departs {size} from what the others lead to expect: look "
            f"whether {_ask_views_at(setup, change.below)}"
        )
        return Finding(text, cost_relative=change.relative, magnification=change.below)
    text = (
        f"the scale seems to jump {size} between magnifications {change.below:g} and {change.above:g}: "
        f"{_name_few_beside(setup, change)}{_name_squares_beside(setup, change)}if the microscope switches its scan "
        "range there, calibrate with this breakpoint"
    )
    # A smooth curve through a jump is off by half of it on either side.
    return Finding(text, cost_relative=0.5 * change.relative, magnification=change.below)


def describe_fit(setup: Setup, fit: JointFit) -> MethodFit:
    """Return the joint fit as that of any method, with what is to be said of it."""
    adjustment, result = fit.adjustment, fit.adjustment.result
    factor = variance_factor(adjustment.problem, result)
    findings = []
    own_px = median_sigma_px(setup.views)
    # By scores: a few outliers are no misfit of functions.
    misfit = np.sqrt(factor) * np.hypot(1.0, fit.excess_px / own_px)
    excess_px, excess_at = measure_excess(setup, fit)
    if fit.shared_px > 0.0:
        each_px = np.hypot(own_px, fit.shared_px)
        findings.append(
            Finding(
                f"scale: neighbouring corners are off alike, by {excess_px:.2g} px, in each view otherwise, so that "
                f"each counts as uncertain by {each_px:.2g} px: by charging, by a drift that changes within an image, "
                "or since the grid is not regular. Let stage and lenses settle, scan faster, or record more views",
                excess_px,
                magnification=excess_at,
            )
        )
    elif misfit > MISFIT_MAX:
        findings.append(
            Finding(
                f"scale: residuals are {misfit:.1f} times what the uncertainty of the corners explains: the functions "
                "do not follow the microscope everywhere, the grid is not regular, or the corners are less certain "
                "than stated"
                + ("; record more magnifications" if len(setup.magnifications) > 1 else ""),
                excess_px,
                magnification=excess_at,
            )
        )
    stretch = _measure_grid_stretch(fit)
    if stretch > GRID_STRETCH_MAX:
        findings.append(
            Finding(
                f"scale: the cells of the grid seem to be longer along one axis than along the other by "
                f"{100.0 * stretch:.1f} %, and nm per pixel are those of squares of the same area: check the pitch of "
                "the grid along both axes",
                cost_relative=0.5 * stretch,
            )
        )
    change = find_change_point(setup, adjustment)
    if change is not None:
        findings.append(_describe_change(setup, change))
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
    return MethodFit(
        fit.padded.functions,
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


def _predict_held_out(setup: Setup, fit: MethodFit, method: str) -> dict[float, float]:
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
    return make_model(rest, functions, np.zeros((size, size)), method, residual).at


def judge(
    setup: Setup,
    fit: MethodFit,
    options: CalibrationOptions,
    joint: JointFit | None,
    outliers: tuple[RejectedView, ...],
) -> CalibrationResult:
    """Make the calibration of a fit, predict every magnification from the others, and list what is weak.

    Parameters
    ----------
    setup
        The views that were used.
    fit
        Their fit by any method.
    options
        The choices of the user.
    joint
        The same fit where the method is ``"joint"``, or None.
    outliers
        Views that were left out because they disagree with the others.

    Raises
    ------
    UnusableCalibrationError
        If the joint fit is not at a minimum, so that it gets no certificate.
    """
    scale = ScaleSigma(fit.repeatability, options.squares_sigma, options.height_sigma_m)
    model = make_model(setup, fit.functions, fit.covariance, options.method, fit.residual, scale)
    poses = fit_poses(setup.views, model.at, height_sigma_m=fit.height_sigma_m, starts=fit.poses)
    held_out = _predict_held_out(setup, fit, options.method)
    findings = (*fit.findings, *list_undetermined(setup, model))
    record = FitRecord(
        float(np.max(fit.height_sigma_m)),
        is_wide=setup.priors.is_wide,
        is_grating=show_lines(setup.views),
    )
    if joint is not None:
        own = joint.adjustment
        certificate = certify(own.functions, own.problem, own.result)
        # Under poses alone, a fine picture would show the shape of its grid: 1 part in 10 000 is 0.2 px at 2000 px from
        # the middle.
        left = np.split(own.result.residuals_px, own.problem.starts[1:-1])
        poses = replace(poses, residuals_px=tuple(left))
        findings = (*findings, *find_scale_weaknesses(setup, joint, model))
        record = replace(
            record,
            visit_height_sigma_m=own.spread.visit_height.sigma if setup.shared else None,
            scale_shares=describe_shares(model, joint.parts),
            certificate=certificate,
        )
    model = replace(model, record=record)
    result = CalibrationResult(model, setup.views, poses, held_out, findings, outliers)
    statistics = collect_statistics(
        setup, fit.details, fit.height_sigma_m, poses, held_out, result.warnings
    )
    return replace(result, model=replace(model, statistics=statistics))
