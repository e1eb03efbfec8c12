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

"""Statistics of a calibration for its file, and what its views do not determine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.adjustment import FittedField
from semcal_ros.core.calibration.estimator.posterior import CovarianceParts
from semcal_ros.core.calibration.estimator.priors import Setup
from semcal_ros.core.calibration.judgement.evaluate import ViewPose, rms_by_magnification
from semcal_ros.core.calibration.judgement.finding import Finding
from semcal_ros.core.calibration.solve import JointFit
from semcal_ros.core.camera.calibration_model import CalibrationModel, pixel_size_gradient
from semcal_ros.core.camera.fit_record import ScaleShares

__all__ = [
    "collect_statistics",
    "describe_field",
    "describe_shares",
    "describe_stage",
    "list_undetermined",
]


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
        "line_jitter_px": fit.jitter.sigma_px,
    }


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
