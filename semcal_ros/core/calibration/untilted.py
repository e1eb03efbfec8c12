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

"""Which views show the specimen untilted, where no stage says so."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.priors import Setup
from semcal_ros.core.calibration.initial_values import initial_values
from semcal_ros.core.errors import InvalidValueError

__all__ = ["UNTILTED_MODES", "look_untilted", "mark_untilted"]

UNTILTED_MODES = ("auto", "all", "none")

# Apparent tilt below which a view may be untilted: an aspect ratio that is 1 % off looks like 8
# degrees. Views up to twice as much could be either.
_FLAT_RAD, _CLEARLY_TILTED_RAD = np.radians(8.0), np.radians(16.0)


def mark_untilted(setup: Setup, untilted: str | Sequence[str]) -> Setup:
    """Return the setup with views that are known not to be tilted.

    Parameters
    ----------
    untilted
        Names of such views, ``"all"``, ``"none"``, or ``"auto"``: the view with the least apparent tilt of
        each visit, if it looks untilted and every other view of the visit is clearly tilted.

    Raises
    ------
    InvalidValueError
        If there is no view of that name, or a mode is not known.
    """
    if isinstance(untilted, str):
        if untilted not in UNTILTED_MODES:
            raise InvalidValueError(
                f"untilted {untilted!r}",
                expected=f"{', '.join(UNTILTED_MODES)}, or a list of names of views",
            )
        if untilted == "none" or (
            untilted == "auto" and any(v.has_stage_tilt for v in setup.views)
        ):
            return setup
        chosen = set(range(len(setup.views))) if untilted == "all" else _apparently_untilted(setup)
    else:
        names = {view.name for view in setup.views}
        unknown = [name for name in untilted if name not in names]
        if unknown:
            raise InvalidValueError(
                f"untilted {', '.join(map(repr, unknown[:3]))}",
                expected="names of views that were used, such as " + ", ".join(sorted(names)[:3]),
            )
        chosen = {i for i, view in enumerate(setup.views) if view.name in set(untilted)}
    views = tuple(
        replace(view, untilted=True) if i in chosen else view for i, view in enumerate(setup.views)
    )
    return replace(setup, views=views)


def look_untilted(setup: Setup) -> bool:
    """Whether every view looks tilted by no more than an aspect ratio that is not 1 makes it look."""
    return bool(np.all(_apparent_tilts(setup) < _CLEARLY_TILTED_RAD))


def _apparent_tilts(setup: Setup) -> Array:
    """Return the (V,) tilts, rad, under a camera with square pixels and no distortion."""
    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in setup.views]))
    start = initial_values(setup.views, nominal, setup.centre_px, setup.priors.rho_mean)
    return np.arccos(np.clip(start.rotations[:, 2, 2], -1.0, 1.0))


def _apparently_untilted(setup: Setup) -> set[int]:
    tilt = _apparent_tilts(setup)
    visit, groups = setup.visits
    chosen = set()
    for own in (np.flatnonzero(visit == j) for j in range(len(groups))):
        least = own[np.argmin(tilt[own])]
        others = own[own != least]
        if len(others) and tilt[least] < _FLAT_RAD and np.all(tilt[others] > _CLEARLY_TILTED_RAD):
            chosen.add(int(least))
    return chosen
