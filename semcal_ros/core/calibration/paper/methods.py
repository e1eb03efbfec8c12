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

"""A calibration by the methods of the paper, as any other method gives it."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

import numpy as np

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.calibration.estimator.bundle_adjustment import BundleResult
from semcal_ros.core.calibration.estimator.problem import Functions, Setup
from semcal_ros.core.calibration.judgement.evaluate import fit_poses
from semcal_ros.core.calibration.method_fit import MethodFit, make_model
from semcal_ros.core.calibration.options import MethodOptions
from semcal_ros.core.calibration.paper.discrete import DiscreteFit, fit_discrete, table_functions
from semcal_ros.core.calibration.paper.pda import (
    StepTrial,
    choose_step,
    pda_functions,
    select_magnifications,
    try_steps,
)


def fit_separately(setup: Setup, method: str, options: MethodOptions) -> MethodFit:
    """Calibrate each magnification by itself, and make continuous functions of the results."""
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
    return MethodFit(
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
        model = make_model(setup, functions, covariance, "pda")
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
