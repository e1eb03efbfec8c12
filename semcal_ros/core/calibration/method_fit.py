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

"""The result that all methods have in common."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.priors import Setup
from semcal_ros.core.calibration.estimator.problem import Functions
from semcal_ros.core.calibration.judgement.finding import Finding
from semcal_ros.core.camera.calibration_model import CalibrationModel, ScaleSigma
from semcal_ros.core.camera.residual_field import ResidualField

__all__ = ["MethodFit", "make_model"]


@dataclass(frozen=True)
class MethodFit:
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


def make_model(
    setup: Setup,
    functions: Functions,
    covariance: Array,
    method: str,
    residual: ResidualField | None = None,
    scale_sigma: ScaleSigma | None = None,
) -> CalibrationModel:
    """Make the calibration of some functions and their covariance."""
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
