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

"""Continuous functions of the magnification."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.errors import InvalidValueError

RANGE = (100.0, 10000.0)


def test_chebyshev_log_known_answer():
    # T0 + 2 T1 + 3 T2 at the middle of log g (u = 0): 1 + 0 - 3
    function = ContinuousFunction("chebyshev_log", np.array([1.0, 2.0, 3.0]), RANGE)
    assert function(1000.0) == pytest.approx(-2.0)
    assert function(100.0) == pytest.approx(1 - 2 + 3)
    assert function(10000.0) == pytest.approx(6.0)


def test_chebyshev_and_legendre_run_in_g():
    middle = 0.5 * (RANGE[0] + RANGE[1])
    coefficients = np.array([0.0, 0.0, 1.0])
    assert ContinuousFunction("chebyshev", coefficients, RANGE)(middle) == pytest.approx(-1.0)
    assert ContinuousFunction("legendre", coefficients, RANGE)(middle) == pytest.approx(-0.5)


def test_linear_log_interpolates_its_knots():
    knots = np.array([100.0, 1000.0, 10000.0])
    function = ContinuousFunction("linear_log", np.array([1.0, 3.0, 2.0]), RANGE, knots)
    assert [function(g) for g in knots] == pytest.approx([1.0, 3.0, 2.0])
    assert function(np.sqrt(1e5)) == pytest.approx(2.0)


def test_ode_solves_the_harmonic_oscillator():
    # x'' = -w^2 x with x(0) = 1, x'(0) = 0 on the unit interval is cos(w u)
    w = 3.0
    function = ContinuousFunction("ode", np.array([1.0, 0.0]), RANGE, np.array([w * w, 0.0]))
    for u in (0.0, 0.3, 1.0):
        assert function(100.0 + u * 9900.0) == pytest.approx(np.cos(w * u), abs=1e-12)


@pytest.mark.parametrize("kind", ["chebyshev_log", "chebyshev", "legendre", "linear_log", "ode"])
@given(factor=st.floats(1.01, 5.0))
def test_out_of_range_follows_the_tangent_in_log_g(kind, factor):
    coefficients = np.array([1.0, 0.5, -0.2])
    shape = {"linear_log": np.array([100.0, 2000.0, 10000.0]), "ode": np.array([0.1, 0.2, 0.3])}
    function = ContinuousFunction(kind, coefficients, RANGE, shape.get(kind, np.empty(0)))
    for edge, sign in ((RANGE[0], -1), (RANGE[1], 1)):
        outside = edge * factor**sign
        slope = (function(edge) - function(edge * 1.001 ** (-sign))) / (sign * np.log(1.001))
        expected = function(edge) + slope * np.log(outside / edge)
        # The tangent comes from a one-sided difference of another width: equal to first order.
        assert function(outside) == pytest.approx(expected, abs=2e-2 * np.log(factor) + 1e-9)


@pytest.mark.parametrize("upwards", [True, False])
def test_extension_bends_the_tangent_by_its_second_derivatives(upwards: bool) -> None:
    edge = RANGE[1] if upwards else RANGE[0]
    sign = 1.0 if upwards else -1.0
    knots = edge * np.exp(sign * np.array([0.0, 0.4, 0.9, 1.3]))
    base = ContinuousFunction("chebyshev_log", np.array([1.0, 0.2, -0.1]), RANGE)
    bends = np.array([0.3, -0.5, 0.2])
    function = ContinuousFunction(
        "chebyshev_log", np.append(base.coefficients, bends), RANGE, extension=knots
    )
    # Inside, and at the edge with its slope, nothing changes.
    for g in (150.0, 3000.0, edge):
        assert function(g) == pytest.approx(base(g), abs=1e-14)
    near = edge * np.exp(sign * 1e-4)
    assert function(near) == pytest.approx(base(near), abs=1e-8)
    # Numerical second derivatives by log g are the hats' values: at the knots, between them, and beyond the last.
    step = 1e-3
    for at, expected in ((0.4, -0.5), (0.65, -0.15), (0.9, 0.2), (1.1, 0.1), (1.6, 0.0)):
        left, middle, right = (
            function(edge * np.exp(sign * x)) for x in (at - step, at, at + step)
        )
        # The mean of the hats over the step differs from their value at a knot by a quarter of the change of slope.
        assert (left - 2.0 * middle + right) / step**2 == pytest.approx(expected, abs=2e-3)


def test_breaks_may_lie_in_the_extension() -> None:
    function = ContinuousFunction(
        "chebyshev_log",
        np.array([1.0, 0.5, 0.02]),
        RANGE,
        breaks=np.array([15000.0]),
        extension=np.array([10000.0, 20000.0]),
    )
    assert function.smooth_size == 1
    assert function.full_range == (100.0, 20000.0)
    before = function(15000.0 * (1.0 - 1e-9))
    assert function(15000.0) - before == pytest.approx(0.02, abs=1e-6)


@pytest.mark.parametrize(
    "knots", [[10000.0], [9000.0, 20000.0], [10000.0, 5000.0], [10000.0, np.inf]]
)
def test_an_extension_begins_at_an_end_and_goes_outwards(knots: list[float]) -> None:
    with pytest.raises(InvalidValueError, match=r"extension|coefficient"):
        ContinuousFunction("chebyshev_log", np.array([1.0, 0.1]), RANGE, extension=np.array(knots))


def test_single_magnification_is_a_constant():
    function = ContinuousFunction("chebyshev_log", np.array([7.0]), (500.0, 500.0))
    assert function(100.0) == function(500.0) == function(9000.0) == 7.0


@pytest.mark.parametrize(
    ("kind", "coefficients", "g_range", "shape"),
    [
        ("spline", [1.0], RANGE, []),
        ("chebyshev", [], RANGE, []),
        ("chebyshev", [np.nan], RANGE, []),
        ("chebyshev", [1.0], (0.0, 10.0), []),
        ("chebyshev", [1.0], (10.0, 1.0), []),
        ("linear_log", [1.0, 2.0], RANGE, [100.0]),
        ("linear_log", [1.0, 2.0], RANGE, [1000.0, 100.0]),
        ("ode", [1.0, 2.0], RANGE, [1.0]),
    ],
)
def test_meaningless_functions_are_refused(kind, coefficients, g_range, shape):
    with pytest.raises(InvalidValueError):
        ContinuousFunction(kind, np.array(coefficients), g_range, np.array(shape))
