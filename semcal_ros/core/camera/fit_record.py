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

"""What a fit leaves in its calibration for those that go on from it: checks, updates, plans and budgets.

The statistics of a calibration are notes for people, which may be edited. What programs read back is here, with types
and units, and is checked when a file is read.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semcal_ros.core.errors import InvalidValueError


@dataclass(frozen=True)
class Certificate:
    """That an adjustment ended at a minimum, and how well its equations determine it.

    Attributes
    ----------
    remaining_sigmas
        The largest of the changes that one more Newton step would make, in sigmas of the unknown.
    last_decrease
        Relative decrease of the cost in the last step.
    condition
        Condition number of the equations, scaled to ones on the diagonal.
    held
        Functions of which a prior, and not the views, determines the constant part.
    """

    remaining_sigmas: float
    last_decrease: float
    condition: float
    held: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("remaining_sigmas", "last_decrease", "condition"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise InvalidValueError(
                    f"a certificate with {name} {value}", expected="a number of at least 0"
                )


@dataclass(frozen=True)
class ScaleShares:
    """Parts of the variance of nm per pixel at each calibrated magnification, of the less certain axis.

    Attributes
    ----------
    magnifications
        Ascending.
    corners
        What the errors of the corners add.
    visits
        What visits, poses, heights, grid and stage add; the rest is the form of the functions.
    """

    magnifications: tuple[float, ...]
    corners: tuple[float, ...]
    visits: tuple[float, ...]

    def __post_init__(self) -> None:
        count = len(self.magnifications)
        as_many = count > 0 and len(self.corners) == len(self.visits) == count
        parts = np.array([*self.corners, *self.visits])
        if not (
            as_many
            and np.all(parts >= 0.0)
            and np.all(np.add(self.corners, self.visits) < 1.0 + 1e-9)
        ):
            raise InvalidValueError(
                f"shares {self.corners} and {self.visits} of a variance",
                expected="one of each for every magnification, at least 0, and at most 1 together",
            )


@dataclass(frozen=True)
class FitRecord:
    """What a fit leaves in its calibration.

    Attributes
    ----------
    height_sigma_m
        1-sigma of the height of a view about the plane of the untilted grid, m.
    visit_height_sigma_m
        1-sigma of the height that all views of a visit share, m; None where the fit has none.
    squares_m
        Sides of the squares of the grid, m; empty where they are not known.
    is_wide
        Whether the views are those of a camera close to the grid, such as a photograph.
    is_grating
        Whether the grid consists of parallel lines, which are turned and not tilted.
    scale_shares
        What the variance of nm per pixel consists of, or None where that is not known.
    certificate
        That the fit ended at a minimum; None for calibrations that were not adjusted as a whole.
    """

    height_sigma_m: float
    visit_height_sigma_m: float | None = None
    squares_m: tuple[float, ...] = ()
    is_wide: bool = False
    is_grating: bool = False
    scale_shares: ScaleShares | None = None
    certificate: Certificate | None = None

    def __post_init__(self) -> None:
        lengths = [self.height_sigma_m, *self.squares_m]
        if self.visit_height_sigma_m is not None:
            lengths.append(self.visit_height_sigma_m)
        if not all(np.isfinite(length) and length > 0.0 for length in lengths):
            raise InvalidValueError(
                f"lengths {lengths} m in the record of a fit", expected="finite numbers above 0"
            )
