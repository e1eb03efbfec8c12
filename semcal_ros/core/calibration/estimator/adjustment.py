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

"""Continuous functions as they are adjusted to views: their sizes, and the residual field beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.calibration.estimator.blocks import Problem
from semcal_ros.core.calibration.estimator.bundle_adjustment import BundleResult
from semcal_ros.core.calibration.estimator.problem import Functions
from semcal_ros.core.calibration.estimator.residual_field_fit import FieldChoice, FieldSystem
from semcal_ros.core.calibration.estimator.variance_components import VarianceComponents
from semcal_ros.core.camera.calibration_model import ALL_FUNCTIONS
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.residual_field import ResidualField

__all__ = ["SMOOTH", "Adjustment", "FittedField", "GridPattern", "refit_functions"]

SMOOTH = ("scale", "aspect", "skew", "xi_r", "xi_t", "ex", "ey")


@dataclass(frozen=True)
class FittedField:
    """The residual field of a :class:`JointFit`.

    Attributes
    ----------
    field
        The field itself.
    choice
        Its strength, and the result of cross-validation.
    system
        The reduced system at the solution, from which magnifications can be left out.
    converged
        Whether camera and field stopped changing.
    """

    field: ResidualField
    choice: FieldChoice
    system: FieldSystem
    converged: bool


@dataclass(frozen=True)
class GridPattern:
    """Displacements of the corners that turn with the grid: it is not regular.

    Attributes
    ----------
    system
        The reduced system with the pattern as unknowns.
    choice
        Its strength, and the result of cross-validation.
    """

    system: FieldSystem
    choice: FieldChoice


@dataclass(frozen=True)
class Adjustment:
    """Continuous functions with a chosen number of coefficients, adjusted to the views.

    Attributes
    ----------
    functions
        The functions.
    problem, result
        The adjustment that gave their coefficients.
    spread
        Its variance components.
    rounds
        Number of times that the numbers of coefficients were chosen.
    converged
        Whether the last choice was the same as that of the round before.
    """

    functions: Functions
    problem: Problem
    result: BundleResult
    spread: VarianceComponents
    rounds: int
    converged: bool


def refit_functions(
    functions: Functions, sizes: Mapping[str, tuple[str, int]]
) -> dict[str, ContinuousFunction]:
    """Fit functions of other kinds and sizes to the values of the given ones, by least squares."""
    out: dict[str, ContinuousFunction] = {}
    none = replace(functions["scale"], coefficients=np.zeros(1), breaks=np.zeros(0))
    for name in ALL_FUNCTIONS:
        function = functions.get(name, none)
        kind, size = sizes.get(
            name, (function.kind, function.smooth_size if name in functions else 0)
        )
        if size == 0:
            continue
        zeros = np.zeros(size + len(function.breaks))
        blank = ContinuousFunction(kind, zeros, function.g_range, breaks=function.breaks)
        grid = np.union1d(np.geomspace(*function.g_range, 64), function.breaks)
        basis = np.stack([blank.basis(float(g)) for g in grid])
        values = np.array([function(float(g)) for g in grid])
        out[name] = replace(blank, coefficients=np.linalg.lstsq(basis, values, rcond=None)[0])
    return out
