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

"""Which way the lattice of a chess grid lies: the axes of all views, made the same.

A chess grid looks the same after a quarter turn, so that the lattice of a view has one of four
directions by chance. Where the stage says how far it turned, the lattices of all views can be given
the same axes, which what belongs to the grid (its stretch and shear) needs.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.priors import Setup
from semcal_ros.core.calibration.initial_values import initial_values
from semcal_ros.core.calibration.stage import Attitudes, attitudes, stage_rotations
from semcal_ros.core.calibration.views import GridView

__all__ = ["align_lattices"]

_QUARTER = 0.5 * np.pi


def align_lattices(setup: Setup) -> Setup:
    """Return the setup with lattices of the same axes, and with the start of the stage's rotation.

    Views of which the stage does not say the rotation stay as they are.
    """
    known = attitudes(
        [v.stage for v in setup.views],
        [False] * len(setup.views),
        setup.axis,
        setup.priors.untilted_sigma_rad,
    )
    turn = _turns(setup, known)
    told = np.isfinite(known.sigma_rad[:, 2])
    if not np.any(told):
        return setup
    # The mean of angles that are known up to quarter turns.
    offset = float(np.angle(np.mean(np.exp(4j * turn[told])))) / 4.0
    quarters = np.where(told, np.round((turn - offset) / _QUARTER), 0.0).astype(int)
    views = tuple(_turned(v, int(k)) for v, k in zip(setup.views, quarters, strict=True))
    return replace(setup, views=views, stage_rotation_rad=offset)


def _turns(setup: Setup, known: Attitudes) -> Array:
    """Return the (V,) angles about the normal by which the views differ from the stage's."""
    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in setup.views]))
    start = initial_values(setup.views, nominal, setup.centre_px, setup.priors.rho_mean)
    expected, _ = stage_rotations(known, np.zeros(5))
    # The sign of the tilt is not known yet. What it changes about the turn is small.
    left = np.swapaxes(expected, 1, 2) @ start.rotations
    return np.arctan2(left[:, 1, 0] - left[:, 0, 1], left[:, 0, 0] + left[:, 1, 1])


def _turned(view: GridView, quarters: int) -> GridView:
    """Return the view with a grid that is turned by so many quarters, and its pose turned back."""
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters % 4]
    x, y = view.board_xy_m.T
    return replace(view, board_xy_m=np.stack([c * x - s * y, s * x + c * y], axis=1))
