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

"""What makes nanometres per pixel uncertain, in words that begin with ``scale:``, with what it costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import stdtrit

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.problem import Setup
from semcal_ros.core.calibration.estimator.thresholds import HELD_PART, SPREAD_COUNT_MIN
from semcal_ros.core.calibration.judgement.thresholds import (
    HYSTERESIS_FALSE_ALARMS,
    ONE_DIRECTION,
    SURPRISING_SIGMAS,
    UNUSUAL_SIGMAS,
)
from semcal_ros.core.calibration.method_fit import Finding
from semcal_ros.core.calibration.solve import JointFit
from semcal_ros.core.calibration.views import show_lines
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.wording import counted


@dataclass(frozen=True)
class Hysteresis:
    """Relative difference of the scale when a magnification is reached from below or from above.

    Attributes
    ----------
    relative, sigma
        Scale from below minus scale from above: the mean over the magnifications, and its 1-sigma
        from their scatter.
    pairs
        Number of magnifications that were reached from both.
    """

    relative: float
    sigma: float
    pairs: int

    @property
    def is_significant(self) -> bool:
        """Whether chance hardly explains it, by Student's t-test."""
        limit = float(stdtrit(self.pairs - 1, 1.0 - 0.5 * HYSTERESIS_FALSE_ALARMS))
        return bool(abs(self.relative) > limit * self.sigma)


def estimate_hysteresis(setup: Setup, fit: JointFit) -> Hysteresis | None:
    """Compare the visits of magnifications that were reached from below and from above.

    The scatter is that of the differences about their mean, since the spread of the visits holds the
    hysteresis itself. Returns None where fewer than two magnifications were reached from both.
    """
    visit, groups = setup.visits
    number = np.zeros(len(groups), dtype=int)
    number[visit] = [v.visit for v in setup.views]
    order = np.argsort(number)
    # Photographs have no effects of visits.
    if len(order) < 2 or number.min() < 0 or not setup.shared:
        return None
    own = fit.adjustment
    rho = own.problem.cameras(own.result.state.theta)[groups, 5]
    # A height of a visit is told from its scale by the priors alone: together they are what its images show.
    scale, height_m = own.result.state.visits.T
    effects = scale - rho * height_m
    upward: dict[int, list[float]] = {}
    downward: dict[int, list[float]] = {}
    for before, now in pairwise(order):
        if groups[before] != groups[now]:
            kind = upward if groups[now] > groups[before] else downward
            kind.setdefault(int(groups[now]), []).append(float(effects[now]))
    both = sorted(set(upward) & set(downward))
    if len(both) < 2:
        return None
    difference = np.array([np.mean(upward[k]) - np.mean(downward[k]) for k in both])
    sigma = np.std(difference, ddof=1) / np.sqrt(len(both))
    return Hysteresis(float(np.mean(difference)), float(sigma), len(both))


def _is_repeatability_known(fit: JointFit) -> bool:
    return fit.adjustment.spread.scale.visible >= SPREAD_COUNT_MIN


def estimate_repeatability(setup: Setup, fit: JointFit) -> float:
    """Return the relative 1-sigma of the scale of the next visit about its function.

    Where the views do not tell, it is at least the usual one; 0 without visits, as for photographs.
    """
    if not setup.shared:
        return 0.0
    sigma = fit.adjustment.spread.scale.sigma
    return sigma if _is_repeatability_known(fit) else max(sigma, setup.priors.visit_scale_sigma)


def _tilts_span_one_direction(rotations: Array) -> bool:
    lean = rotations[:, :2, 2]
    values = np.linalg.eigvalsh(lean.T @ lean)
    return bool(values[0] < ONE_DIRECTION * values[1])


def _find_stage_errors(setup: Setup, fit: JointFit) -> list[Finding]:
    """List what the readings of the stage and the images do not agree on.

    A constant error is estimated and so costs nothing by itself; what a configuration that is wrong costs is not known.
    """
    out: list[Finding] = []
    if not any(v.has_stage_tilt for v in setup.views):
        return out
    out += _find_tilted_untilted(setup)
    errors = (
        ("stage_tilt", "tilt", setup.priors.stage_tilt_sigma),
        ("stage_axis", "direction of the tilt axis", setup.priors.stage_axis_sigma),
    )
    adjustment = fit.adjustment
    for name, label, sigma in errors:
        (value,) = adjustment.problem.shared_values(adjustment.result.state.theta, [name])
        if name == "stage_axis" and abs(value) > 0.5 * np.pi:
            out.append(
                Finding(
                    f"scale: the tilt axis of the stage is {np.degrees(value):+.1f} degrees off from what the "
                    "configuration says, so its tilts have the wrong sign: add 180 to stage.tilt_axis_deg"
                )
            )
        elif abs(value) > SURPRISING_SIGMAS * sigma:
            out.append(
                Finding(
                    f"scale: the {label} of the stage is {np.degrees(value):+.1f} degrees off from what "
                    "the configuration says: check stage.tilt_axis_deg and the unit of the readings"
                )
            )
    return out


def _find_tilted_untilted(setup: Setup) -> list[Finding]:
    """Say which views are named untilted and are tilted as the stage says, by more than its zero may be off."""
    sigma = float(np.hypot(setup.priors.untilted_sigma_rad, setup.priors.stage_tilt_sigma))
    tilts = {
        v.name: v.stage.tilt_rad
        for v in setup.views
        if v.untilted and v.stage is not None and v.stage.tilt_rad is not None
    }
    tilted = {name: t for name, t in tilts.items() if abs(t) > SURPRISING_SIGMAS * sigma}
    if not tilted:
        return []
    most = max(tilted, key=lambda name: abs(tilted[name]))
    return [
        Finding(
            f"scale: {counted(len(tilted), 'view is', 'views are')} named untilted (--untilted), but tilted as the "
            f"stage says, by {np.degrees(tilted[most]):.1f} degrees in {most}: the stage is believed. Leave out "
            "--untilted, or mend the readings of the stage"
        )
    ]


def _find_unusual_scan(setup: Setup, model: CalibrationModel) -> list[Finding]:
    """List by how much the pixels are less square than those of any usual microscope.

    Wrong tilts of a few views pass for such pixels, and nothing else shows it.
    """
    out = []
    for name, what, index in (("aspect", "aspect ratio", 1), ("skew", "skew", 2)):
        mean, sigma = setup.prior_of(name)
        values = [float(model.at(float(g)).parameters[index]) for g in setup.magnifications]
        worst = max(values, key=lambda value: abs(value - mean))
        if abs(worst - mean) > UNUSUAL_SIGMAS * sigma:
            out.append(
                Finding(
                    f"scale: the pixels have {what} {worst:.3f}, where {mean:g} +- {sigma:g} is usual: check the "
                    "tilts of the stage and the untilted views, and that the pictures were not stretched",
                    cost_relative=abs(worst - mean),
                )
            )
    return out


def measure_excess(setup: Setup, fit: JointFit) -> tuple[float, float]:
    """RMS in px by which corners are off beyond their own noise, where that is most nm, and the magnification there."""
    problem, result = fit.adjustment.problem, fit.adjustment.result
    square = np.sum(result.residuals_px**2, axis=1)
    expected = np.concatenate([v.dimensions * v.sigma_px**2 for v in setup.views])
    own = np.array([v.magnification for v in setup.views])[problem.view_of_point]
    inlier = result.huber_weight >= 1.0
    excess = {}
    for g in setup.magnifications:
        mine = inlier & (own == g)
        beyond = float(np.mean((square - expected)[mine])) if np.any(mine) else 0.0
        excess[float(g)] = float(np.sqrt(max(beyond, 0.0)))
    return _worst(excess)


def _worst(sigmas: Mapping[float, float]) -> tuple[float, float]:
    """The error in px, or relative, that costs most nm of those at some magnifications, and where it is."""
    g = max(sigmas, key=lambda own: sigmas[own] / own)
    return sigmas[g], g


def find_scale_weaknesses(setup: Setup, fit: JointFit, model: CalibrationModel) -> list[Finding]:
    """List what makes the scale less certain than the residuals suggest, with the remedy."""
    out: list[Finding] = []
    rotations = fit.adjustment.result.state.rotations
    known = any(v.has_stage_tilt for v in setup.views)
    sigmas: dict[str, dict[float, float]] = {"aspect": {}, "skew": {}}
    for g in setup.magnifications:
        covariance = model.at(float(g)).covariance
        assert covariance is not None
        for index, name in ((1, "aspect"), (2, "skew")):
            sigmas[name][float(g)] = float(np.sqrt(covariance[index, index]))
    if not known and _tilts_span_one_direction(rotations):
        cost, where = _worst(sigmas["aspect"])
        out.append(
            Finding(
                "scale: all tilts are about one axis, so the images alone do not tell the aspect ratio "
                "from the tilt; record the stage's tilt, or some views with the scan rotated by 90 degrees",
                cost_relative=cost,
                magnification=where,
            )
        )
    out += _find_stage_errors(setup, fit)
    out += _find_unusual_scan(setup, model)
    remedy = (
        "add views with the grating turned to other directions"
        if show_lines(setup.views)
        else "record also with the scan rotated by 90 degrees, or give the stage's tilt"
    )
    for name, label in (("aspect", "aspect ratio"), ("skew", "skew")):
        limit = HELD_PART * setup.change_prior_of(name)
        weak = {g: sigma for g, sigma in sigmas[name].items() if sigma > limit}
        if not weak:
            continue
        cost, where = _worst(weak)
        out.append(
            Finding(
                f"scale: the views do not determine the {label} at magnification "
                f"{', '.join(f'{g:g}' for g in weak)}, where it is held by its prior; {remedy}",
                cost_relative=cost,
                magnification=where,
            )
        )
    if setup.shared and not _is_repeatability_known(fit):
        sigma = estimate_repeatability(setup, fit)
        groups = setup.visits[1]
        which = "more" if len(np.unique(groups)) < len(groups) else "some"
        why = f"{100.0 * sigma:.2g} % is presumed"
        if sigma > setup.priors.visit_scale_sigma:
            why = f"{100.0 * sigma:.2g} % is seen, of which all may be a course of the scale that is not smooth"
        out.append(
            Finding(
                f"scale: the views do not show how repeatable the magnification is; {why}. Visit {which} "
                "magnifications twice",
                cost_relative=sigma,
            )
        )
    if fit.pattern is not None:
        excess_px, excess_at = measure_excess(setup, fit)
        out.append(
            Finding(
                "scale: the corners are displaced in a pattern that turns with the grid: the grid is not "
                "regular. No residual field is added for it; use another part of the grid, or another one",
                excess_px,
                magnification=excess_at,
            )
        )
    hysteresis = estimate_hysteresis(setup, fit)
    if hysteresis and hysteresis.is_significant:
        out.append(
            Finding(
                f"scale: magnifications reached from below show {100.0 * hysteresis.relative:+.2g} +- "
                f"{100.0 * hysteresis.sigma:.1g} % of the scale of those reached from above (hysteresis); "
                "always approach a magnification from the same side",
                cost_relative=hysteresis.relative,
            )
        )
    return out
