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

"""What makes nanometres per pixel uncertain, in words: warnings that begin with ``scale:``."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import stdtrit

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.joint import JointFit
from semcal_ros.core.calibration.priors import Setup
from semcal_ros.core.camera.calibration_model import CalibrationModel

__all__ = ["Hysteresis", "estimate_hysteresis", "estimate_repeatability", "scale_warnings"]

# Ratio of the smaller to the larger spread of the tilts: tilts of 30 degrees about one axis, with 3
# degrees about the other.
_ONE_DIRECTION = 0.01
# Part of the prior's 1-sigma of its change above which a parameter is not determined.
_UNDETERMINED = 0.8
# Fewer visits than this that show their effect do not tell a spread: its own 1-sigma is a third of it.
_ENOUGH_VISITS = 4.0
# Constant error of a stage, in 1-sigmas of its prior, that says that the configuration is wrong.
_SURPRISING = 4.0
# Probability with which chance alone gives as large a hysteresis: a false alarm in 3000 calibrations.
_CHANCE = 3e-4


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
        limit = float(stdtrit(self.pairs - 1, 1.0 - 0.5 * _CHANCE))
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
    if len(order) < 2 or number.min() < 0:
        return None
    effects = fit.adjustment.result.state.visits[:, 0]
    upward: dict[int, list[float]] = {}
    downward: dict[int, list[float]] = {}
    for before, own in pairwise(order):
        if groups[before] != groups[own]:
            kind = upward if groups[own] > groups[before] else downward
            kind.setdefault(int(groups[own]), []).append(float(effects[own]))
    both = sorted(set(upward) & set(downward))
    if len(both) < 2:
        return None
    difference = np.array([np.mean(upward[k]) - np.mean(downward[k]) for k in both])
    sigma = np.std(difference, ddof=1) / np.sqrt(len(both))
    return Hysteresis(float(np.mean(difference)), float(sigma), len(both))


def _is_repeatability_known(fit: JointFit) -> bool:
    return fit.adjustment.spread.scale.visible >= _ENOUGH_VISITS


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
    return bool(values[0] < _ONE_DIRECTION * values[1])


def _stage_warnings(setup: Setup, fit: JointFit, model: CalibrationModel) -> list[str]:
    """List what the readings of the stage and the images do not agree on."""
    out: list[str] = []
    if not any(v.has_stage_tilt for v in setup.views):
        return out
    errors = (
        ("stage_tilt", "tilt", setup.priors.stage_tilt_sigma),
        ("stage_axis", "direction of the tilt axis", setup.priors.stage_axis_sigma),
    )
    adjustment = fit.adjustment
    for name, label, sigma in errors:
        (value,) = adjustment.problem.shared_values(adjustment.result.state.theta, [name])
        if abs(value) > _SURPRISING * sigma:
            out.append(
                f"scale: the {label} of the stage is {np.degrees(value):+.1f} degrees off from what "
                "the configuration says: check stage.tilt_axis_deg and the unit of the readings"
            )
    camera = model.at(float(setup.magnifications[0]))
    assert camera.covariance is not None
    if camera.rho < -_SURPRISING * np.sqrt(camera.covariance[5, 5]):
        out.append(
            "scale: the images look as if the beam diverged upwards, so the tilts of the stage have "
            "the wrong sign: add 180 to stage.tilt_axis_deg"
        )
    return out


def scale_warnings(setup: Setup, fit: JointFit, model: CalibrationModel) -> list[str]:
    """List what makes the scale less certain than the residuals suggest, with the remedy."""
    out: list[str] = []
    rotations = fit.adjustment.result.state.rotations
    known = any(v.has_stage_tilt for v in setup.views)
    if not known and _tilts_span_one_direction(rotations):
        out.append(
            "scale: all tilts are about one axis, so the images alone do not tell the aspect ratio "
            "from the tilt; record the stage's tilt, or some views with the scan rotated by 90 degrees"
        )
    out += _stage_warnings(setup, fit, model)
    weak: dict[str, list[float]] = {}
    for g in setup.magnifications:
        camera = model.at(float(g))
        assert camera.covariance is not None
        sigma = np.sqrt(np.diag(camera.covariance))
        for index, name, label in ((1, "aspect", "aspect ratio"), (2, "skew", "skew")):
            if sigma[index] > _UNDETERMINED * setup.change_prior_of(name):
                weak.setdefault(label, []).append(float(g))
    for label, where in weak.items():
        out.append(
            f"scale: the views do not determine the {label} at magnification "
            f"{', '.join(f'{g:g}' for g in where)}, where it is held by its prior; record also with "
            "the scan rotated by 90 degrees, or give the stage's tilt"
        )
    if setup.shared and not _is_repeatability_known(fit):
        out.append(
            "scale: the views do not tell how well the magnification comes back; "
            f"{100.0 * estimate_repeatability(setup, fit):.2g} % is presumed. Visit some "
            "magnifications twice"
        )
    if fit.pattern is not None:
        out.append(
            "scale: the corners are displaced in a pattern that turns with the grid: the grid is not "
            "regular. No residual field is added for it; use another part of the grid, or another one"
        )
    hysteresis = estimate_hysteresis(setup, fit)
    if hysteresis and hysteresis.is_significant:
        out.append(
            f"scale: magnifications reached from below show {100.0 * hysteresis.relative:+.2g} +- "
            f"{100.0 * hysteresis.sigma:.1g} % of the scale of those reached from above (hysteresis); "
            "always approach a magnification from the same side"
        )
    return out
