"""Principal differential analysis of separate calibrations: appendix A of the paper (method "pda").

Each parameter x(g) is taken to obey a linear differential equation with constant coefficients,
``D^k x + w_(k-1) D^(k-1) x + ... + w_0 x = 0`` (16)-(18). Derivatives come from finite differences,
the weights w from weighted least squares (19)-(21), and the equation is solved through fitted
boundary values. Equation (21) is printed as ``(A'A)^-1 A b``; this module uses ``-(A'A)^-1 A' b``.
The paper keeps order 2 and finds 3 and 4 worse, and Legendre polynomials of degree 3 and 5 prone to
oscillate; all of these can be selected here so that the comparison can be repeated.
"""

from __future__ import annotations

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.discrete import DiscreteFit
from semcal_ros.core.camera.calibration_model import FUNCTION_NAMES
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.errors import CalibrationError, InvalidValueError

__all__ = ["ode_weights", "pda_functions"]


def ode_weights(position: Array, values: Array, weight: Array, order: int) -> Array:
    """Estimate the coefficients w_0 ... w_(order-1) of the equation that the samples obey best.

    Parameters
    ----------
    position
        (n,) increasing positions, n > order.
    values, weight
        (n,) samples and their least-squares weights (1 / sigma).
    """
    derivatives = [values]
    for _ in range(order):
        derivatives.append(np.gradient(derivatives[-1], position, edge_order=1))
    a = np.stack(derivatives[:order], axis=1) * weight[:, None]
    b = derivatives[order] * weight
    # Column scaling: the derivatives differ by orders of magnitude, and lstsq cuts small singular
    # values.
    scale = np.maximum(np.linalg.norm(a, axis=0), 1e-300)
    return -np.linalg.lstsq(a / scale, b, rcond=1e-10)[0] / scale


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
            do='use method "joint" or a lower order',
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
            f"{len(g)} magnifications",
            expected=f"at least {needed} for this method",
            do='record more magnifications or use method "joint"',
        )
    position = (g - g[0]) / (g[-1] - g[0])
    functions: dict[str, ContinuousFunction] = {}
    blocks = []
    for i, name in enumerate(FUNCTION_NAMES):
        values = discrete.parameters[:, i]
        # Parameters held by their prior have no scatter of their own; all nodes then count equally.
        sigma = np.maximum(np.sqrt(discrete.covariances[:, i, i]), 1e-8 * (1.0 + np.abs(values)))
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
