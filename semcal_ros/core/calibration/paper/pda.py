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

"""Principal differential analysis of separate calibrations: appendix A of the paper (method "pda").

Each parameter x(g) is taken to obey a linear differential equation with constant coefficients,
``D^k x + w_(k-1) D^(k-1) x + ... + w_0 x = 0`` (16)-(18). Derivatives come from finite differences,
the weights w from weighted least squares (19)-(21), and the equation is solved through fitted
boundary values. Equation (21) is printed as ``(A'A)^-1 A b``; this module uses ``-(A'A)^-1 A' b``.
The paper keeps order 2 and finds 3 and 4 worse, and Legendre polynomials of degree 3 and 5 prone to
oscillate; all of these can be selected here so that the comparison can be repeated.

The paper takes the step G between magnifications "so that we obtain the lowest least square error" (section 4.1,
appendix A). A small step brings the noise of the separate calibrations into the finite differences, a large one misses
the curve. Here each step selects some of the recorded magnifications, and the error is the reprojection error of *all*
views, those between the steps too, with the poses fitted. The least-squares error of (19) is listed beside it, but does
not choose: it compares an equation with its own samples only, of which a large step leaves few.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.calibration.paper.discrete import DiscreteFit
from semcal_ros.core.camera.calibration_model import FUNCTION_NAMES, CalibrationModel
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.errors import CalibrationError, InvalidValueError
from semcal_ros.core.wording import counted


@dataclass(frozen=True)
class FittedEquation:
    """The differential equation of one parameter x, and the solution of it that was fitted.

    ``D^k x = -w_(k-1) D^(k-1) x - ... - w_0 x``, (17)-(18), with D = d/du. The magnification is
    rescaled: ``u = (g - low) / (high - low)`` goes from 0 to 1, so that the weights are plain
    numbers. For derivatives with respect to g, divide w_j by ``(high - low)^(k - j)``. ``str``
    gives the equation with six significant digits.

    Attributes
    ----------
    name
        The parameter, one of ``FUNCTION_NAMES``; ``scale`` is m over its nominal value.
    weights
        w_0 ... w_(k-1).
    g_range
        (low, high) magnification.
    start
        x and its first k - 1 derivatives with respect to u at ``low``.
    end
        x at ``high``.
    """

    name: str
    weights: tuple[float, ...]
    g_range: tuple[float, float]
    start: tuple[float, ...]
    end: float

    @property
    def order(self) -> int:
        """Order k of the equation."""
        return len(self.weights)

    def __str__(self) -> str:
        terms = [f"{-w:+.6g} {prime(j)}" for j, w in enumerate(self.weights)]
        return f"{prime(self.order)} = {' '.join(reversed(terms))}"


def list_equations(functions: Mapping[str, ContinuousFunction]) -> tuple[FittedEquation, ...]:
    """List the equations of those functions that solve one, in the order of ``FUNCTION_NAMES``."""
    return tuple(
        FittedEquation(
            name,
            tuple(float(w) for w in function.shape),
            function.g_range,
            tuple(float(c) for c in function.coefficients),
            function(function.g_range[1]),
        )
        for name in FUNCTION_NAMES
        if (function := functions[name]).kind == "ode"
    )


def focal_length_and_skew(model: CalibrationModel, g: float) -> tuple[float, float]:
    """Return the paper's f = m / rho and s = skew f of (9) at the magnification ``g``, px.

    They are infinite for a parallel projection, rho = 0, and negative below.
    """
    camera = model.at(g)
    f = camera.m / camera.rho if camera.rho != 0.0 else float("inf")
    return f, camera.skew * f


def prime(order: int) -> str:
    """Return the derivative of x of this order as text: x, x', x'' and so on."""
    return "x" + "'" * order


def _equation_system(
    position: Array, values: Array, weight: Array, order: int
) -> tuple[Array, Array]:
    """Return A and b of (20), each row times its weight: (n, order) and (n,)."""
    derivatives = [values]
    for _ in range(order):
        derivatives.append(np.gradient(derivatives[-1], position, edge_order=1))
    a = np.stack(derivatives[:order], axis=1) * weight[:, None]
    return a, derivatives[order] * weight


def ode_weights(position: Array, values: Array, weight: Array, order: int) -> Array:
    """Estimate the coefficients w_0 ... w_(order-1) of the equation that the samples obey best.

    Parameters
    ----------
    position
        (n,) increasing positions, n > order.
    values, weight
        (n,) samples and their least-squares weights (1 / sigma).
    """
    a, b = _equation_system(position, values, weight, order)
    # Column scaling: the derivatives differ by orders of magnitude, and lstsq cuts small singular
    # values.
    scale = np.maximum(np.linalg.norm(a, axis=0), 1e-300)
    return -np.linalg.lstsq(a / scale, b, rcond=1e-10)[0] / scale


def equation_error(discrete: DiscreteFit, order: int) -> float:
    """Return the least-squares error of (19), relative: 1 if the equations explain nothing.

    For each parameter it is ``|A w + b| / |b|``, with n - order degrees of freedom in the first
    and n in the second norm; the result is its RMS over the parameters. A parameter whose
    derivative of this order is zero everywhere counts as zero.
    """
    position = _rescale(discrete.magnifications)
    count = len(position)
    squares = []
    for values, sigma in _list_samples(discrete):
        a, b = _equation_system(position, values, 1.0 / sigma, order)
        left = b + a @ ode_weights(position, values, 1.0 / sigma, order)
        size = float(b @ b)
        squares.append(float(left @ left) / size * count / (count - order) if size > 0.0 else 0.0)
    return float(np.sqrt(np.mean(squares)))


def _rescale(magnifications: Array) -> Array:
    """Return (n,) positions from 0 to 1."""
    low, high = magnifications[0], magnifications[-1]
    return (magnifications - low) / (high - low)


def _list_samples(discrete: DiscreteFit) -> list[tuple[Array, Array]]:
    """Return (n,) values and (n,) sigmas of each parameter, in the order of ``FUNCTION_NAMES``."""
    out = []
    for i in range(len(FUNCTION_NAMES)):
        values = discrete.parameters[:, i]
        # Parameters held by their prior have no scatter of their own; all nodes then count equally.
        floor = 1e-8 * (1.0 + np.abs(values))
        out.append((values, np.maximum(np.sqrt(discrete.covariances[:, i, i]), floor)))
    return out


def _fit_curve(
    name: str,
    kind: str,
    size: int,
    shape: Array,
    magnifications: Array,
    values: Array,
    sigma: Array,
) -> tuple[ContinuousFunction, Array]:
    g_range = (float(magnifications[0]), float(magnifications[-1]))
    blank = ContinuousFunction(kind, np.zeros(size), g_range, shape)
    rows = np.stack([blank.basis(float(g)) for g in magnifications])
    if not np.all(np.isfinite(rows)):
        raise CalibrationError(
            f"a differential equation for {name} whose solution diverges",
            expected="smooth calibration results",
            do="use --method joint, or a lower --pda-order",
        )
    whitened = rows / sigma[:, None]
    inverse = np.linalg.pinv(whitened.T @ whitened, rcond=1e-12, hermitian=True)
    coefficients = inverse @ whitened.T @ (values / sigma)
    misfit = np.sum(((values - rows @ coefficients) / sigma) ** 2) / max(len(values) - size, 1)
    function = ContinuousFunction(kind, coefficients, g_range, shape)
    return function, np.asarray(inverse * max(float(misfit), 1.0), dtype=np.float64)


def pda_functions(
    discrete: DiscreteFit, *, order: int = 2, legendre_degree: int | None = None
) -> tuple[dict[str, ContinuousFunction], Array]:
    """Fit continuous functions through separate calibrations.

    Parameters
    ----------
    order
        Order of the differential equation, 1 to 4.
    legendre_degree
        With a value, Legendre polynomials of this degree in g replace the differential equation.

    Returns
    -------
    functions, covariance
        One function per parameter and the covariance of all coefficients. Correlations between
        parameters are not known to this method and are left at zero.

    Raises
    ------
    InvalidValueError
        For an order outside 1 to 4 or a negative degree.
    CalibrationError
        If there are too few magnifications for the order, or a solution diverges.
    """
    if order not in (1, 2, 3, 4):
        raise InvalidValueError(f"order {order}", expected="1, 2, 3 or 4")
    if legendre_degree is not None and legendre_degree < 0:
        raise InvalidValueError(f"Legendre degree {legendre_degree}", expected="0 or more")
    needed = order + 2 if legendre_degree is None else legendre_degree + 2
    g = discrete.magnifications
    if len(g) < needed:
        raise CalibrationError(
            counted(len(g), "magnification"),
            expected=f"at least {needed} for this method",
            do="record more magnifications, or use --method joint",
        )
    position = _rescale(g)
    functions: dict[str, ContinuousFunction] = {}
    blocks = []
    for name, (values, sigma) in zip(FUNCTION_NAMES, _list_samples(discrete), strict=True):
        if legendre_degree is None:
            weights = ode_weights(position, values, 1.0 / sigma, order)
            fitted = _fit_curve(name, "ode", order, weights, g, values, sigma)
        else:
            fitted = _fit_curve(
                name, "legendre", legendre_degree + 1, np.empty(0), g, values, sigma
            )
        functions[name], block = fitted
        blocks.append(block)
    size = sum(len(b) for b in blocks)
    covariance = np.zeros((size, size))
    start = 0
    for block in blocks:
        stop = start + len(block)
        covariance[start:stop, start:stop] = block
        start = stop
    return functions, covariance


# Derived: magnifications beyond the order (or degree), 2 that a fit needs and 1 that can be left out of it for the
# held-out error.
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
