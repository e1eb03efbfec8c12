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

"""The step G between the magnifications through which the differential equations are fitted.

The paper takes the step "so that we obtain the lowest least square error" (section 4.1, appendix
A). A small step brings the noise of the separate calibrations into the finite differences, a large
one misses the curve. Here each step selects some of the recorded magnifications, and the error is
the reprojection error of *all* views, those between the steps too, with the poses fitted. The
least-squares error of (19) is listed beside it, but does not choose: it compares an equation with
its own samples only, of which a large step leaves few.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.calibration.paper.discrete import DiscreteFit
from semcal_ros.core.calibration.paper.pda import equation_error, pda_functions
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.errors import CalibrationError, InvalidValueError
from semcal_ros.core.wording import counted

__all__ = ["StepTrial", "choose_step", "select_magnifications", "try_steps"]

# Magnifications beyond the order (or degree): 2 that a fit needs, and 1 that can be left out of it
# for the held-out error.
_SPARE = 3


@dataclass(frozen=True)
class StepTrial:
    """What became of one step.

    Attributes
    ----------
    step
        G.
    magnifications
        How many of the recorded magnifications it selects.
    equation_error
        Relative least-squares error of (19), see
        :func:`~semcal_ros.core.calibration.paper.pda.equation_error`; None for Legendre polynomials.
    rms_px
        RMS reprojection error of all views, poses fitted; infinite where the fit failed.
    """

    step: float
    magnifications: int
    equation_error: float | None
    rms_px: float


def select_magnifications(magnifications: Array, step: float) -> Mask:
    """Select the recorded magnifications nearest to g_0, g_0 + G, g_0 + 2 G, ..., and the last one.

    Parameters
    ----------
    magnifications
        (M,) ascending.
    step
        G, positive.

    Returns
    -------
    (M,) bool. Both ends are always selected.
    """
    used = np.zeros(len(magnifications), dtype=bool)
    used[[0, -1]] = True
    low, high = float(magnifications[0]), float(magnifications[-1])
    for g in magnifications:
        # Only the multiples on both sides of a magnification can select it.
        below = np.floor((g - low) / step)
        for target in low + step * np.array([below, below + 1.0]):
            if target <= high:
                used[np.argmin(np.abs(magnifications - target))] = True
    return used


def _list_steps(magnifications: Array, needed: int) -> dict[float, Mask]:
    """Return the steps to try, ascending, each with the magnifications that it selects.

    They are multiples of the usual spacing, and the finest spacing, which selects everything. Of
    steps that select the same magnifications only one is listed, and none that selects fewer than
    ``needed``.
    """
    spacings = np.diff(magnifications)
    usual, span = float(np.median(spacings)), float(np.sum(spacings))
    steps = [k * usual for k in range(1, int(span / usual) + 1)]
    out: dict[float, Mask] = {}
    for step in (*steps, float(np.min(spacings))):
        used = select_magnifications(magnifications, step)
        if used.sum() >= needed and not any(np.array_equal(used, known) for known in out.values()):
            out[step] = used
    return dict(sorted(out.items()))


def try_steps(
    discrete: DiscreteFit,
    rms_px: Callable[[dict[str, ContinuousFunction], Array], float],
    *,
    order: int = 2,
    legendre_degree: int | None = None,
) -> tuple[StepTrial, ...]:
    """Fit with each step that the recorded magnifications allow.

    Parameters
    ----------
    discrete
        Separate calibrations of all magnifications.
    rms_px
        Reprojection error of all views under functions with their covariance; it may raise
        CalibrationError or InvalidValueError.
    order, legendre_degree
        As for :func:`~semcal_ros.core.calibration.paper.pda.pda_functions`.

    Raises
    ------
    CalibrationError
        If there are too few magnifications.
    """
    needed = _SPARE + (order if legendre_degree is None else legendre_degree)
    if len(discrete.magnifications) < needed:
        raise CalibrationError(
            counted(len(discrete.magnifications), "magnification"),
            expected=f"at least {needed} to choose a step",
            do="record more magnifications, or leave --pda-step out",
        )
    trials = []
    for step, used in _list_steps(discrete.magnifications, needed).items():
        part = discrete.select(used)
        try:
            error = rms_px(*pda_functions(part, order=order, legendre_degree=legendre_degree))
        except (CalibrationError, InvalidValueError):
            error = float("inf")
        own = None if legendre_degree is not None else equation_error(part, order)
        trials.append(StepTrial(step, int(used.sum()), own, error))
    return tuple(trials)


def choose_step(trials: Sequence[StepTrial]) -> float:
    """Return the step with the least reprojection error.

    Raises
    ------
    CalibrationError
        If none has a finite one.
    """
    best = min(trials, key=lambda trial: trial.rms_px)
    if not np.isfinite(best.rms_px):
        raise CalibrationError(
            f"no finite error with any of {len(trials)} steps",
            expected="smooth calibration results",
            do="use --method joint, or a lower --pda-order",
        )
    return best.step
