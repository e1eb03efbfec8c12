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

"""The parts of the corner finder: edge model, priors and local maps."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.arrays import Array
from semcal_ros.core.corners import edge_model
from semcal_ros.core.corners.corner_fit import Learnt, learn, loose_prior
from semcal_ros.core.corners.edge_model import PixelWindows, gather_windows
from semcal_ros.core.corners.local_map import fit_local_maps

AXES = np.array([[[14.0, 3.0], [-4.0, 11.0]], [[30.0, -5.0], [6.0, 33.0]]])
BEND = np.array([[[0.4, -0.2], [0.1, 0.3]], [[-0.3, 0.5], [0.6, -0.1]]])


def windows() -> PixelWindows:
    picture = np.random.default_rng(0).random((200, 200)).astype(np.float32)
    return gather_windows(picture, np.array([[100.2, 90.7], [60.0, 60.0]]), AXES, BEND, 6.0)


def parameters() -> Array:
    out = np.zeros((2, 15))
    out[:, :2] = 0.3
    out[:, edge_model.ANGLES] = np.arctan2(AXES[:, :, 1], AXES[:, :, 0])
    out[:, edge_model.LOG_BLUR] = np.log([1.7, 2.5])
    out[:, edge_model.SAGITTAS] = 0.1
    out[:, 7:13] = np.random.default_rng(1).normal(0.0, 0.1, (2, 6))
    out[:, edge_model.CONTRAST] = 0.5
    return out


@pytest.mark.parametrize("column", range(15))
def test_derivatives_of_the_edge_model(column: int) -> None:
    # Without growth: its own pull on position and blur is left out of the derivatives.
    pixels, geometry = windows(), edge_model.EdgeGeometry.from_map(AXES, BEND)
    at = parameters()
    step = np.zeros(15)
    step[column] = 0.01
    exact = edge_model.evaluate(pixels, geometry, at[:, :7], at[:, 7:])[0][:, column]
    after, before = (
        edge_model.evaluate(pixels, geometry, p[:, :7], p[:, 7:])[1] for p in (at + step, at - step)
    )
    numeric = (after - before) / 0.02 * pixels.valid
    # Third order of the step, and single precision over it.
    assert np.abs(numeric - exact * pixels.valid).max() < 1e-3 * max(1.0, np.abs(exact).max())


def test_windows_of_joined_sets_are_those_of_their_parts() -> None:
    pixels = windows()
    parts = [pixels.select(slice(0, 1)), pixels.select(slice(1, 2))]
    joined = PixelWindows.join(parts)
    assert np.array_equal(joined.value, pixels.value)
    assert np.array_equal(joined.valid, pixels.valid)
    assert np.array_equal(joined.origin, pixels.origin)


@pytest.mark.parametrize("factor", [0.04, 0.4])
def test_spread_of_a_nuisance_parameter_is_learnt(factor: float) -> None:
    rng = np.random.default_rng(4)
    n = 160
    ij = np.stack(np.meshgrid(np.arange(16), np.arange(10), indexing="ij"), axis=-1).reshape(-1, 2)
    xy = ij @ np.array([[30.0, 4.0], [-5.0, 28.0]])
    maps = fit_local_maps(ij, ij, xy, leave_out_self=False)
    prior = loose_prior(maps, edge_model.EdgeGeometry.from_map(maps.axes, maps.bend), 1.0)
    column = edge_model.GRADIENTS[1]
    own = 0.2 * prior.deviation[:, column]
    shown = rng.normal(0.0, factor, (n, 2)) * prior.deviation[:, column] + rng.normal(0.0, own)
    # What a fit under the prior makes of it.
    held = 1.0 / prior.deviation[:, column] ** 2
    values = prior.mean.copy()
    values[:, column] = shown * (1.0 / own**2) / (1.0 / own**2 + held)
    normal = np.tile(np.eye(15), (n, 1, 1)) * 1e6
    normal[:, range(11, 13), range(11, 13)] = 1.0 / own**2 + held
    learnt = learn(values, normal, prior, 1.0, 1.0)
    assert isinstance(learnt, Learnt)
    spread = learnt.spread[11]
    # The largest spread that 320 values with an error of 0.2 do not contradict, on a grid of 1.35.
    assert factor / 1.35 < spread < max(1.5 * factor, 0.15)


def test_local_maps_follow_a_quadratic_exactly_and_leave_a_corner_out() -> None:
    ij = np.stack(np.meshgrid(np.arange(20), np.arange(20), indexing="ij"), axis=-1).reshape(-1, 2)
    xy = ij @ np.array([[20.0, 2.0], [-3.0, 19.0]]) + 0.05 * ij[:, ::-1] ** 2
    inner = np.all((ij > 2) & (ij < 17), axis=1)
    spoilt = xy.copy()
    spoilt[210] += 5.0
    maps = fit_local_maps(ij, ij, spoilt)
    around = np.abs(ij - ij[210]).max(axis=1) <= 2
    miss = np.linalg.norm(maps.xy - xy, axis=1)
    # The ridge on the second order takes off a thousandth of a bend of 0.1 px.
    assert miss[inner & ~around].max() < 0.01
    assert miss[210] < 0.01
    assert miss[around & (np.arange(400) != 210)].max() > 0.3
