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

"""The unknowns of a ladder: the functions of the camera beyond the grid, and the pose of every picture.

Inside the range of the grid the functions keep their form, and the covariance of the calibration is their prior. Beyond
it they go on along their tangents, which bend at every magnification of the ladder: the second derivatives by log g
are the unknowns there (:attr:`.ContinuousFunction.extension`). Their prior is how much the functions bend where they
are known, so that nothing that the pictures do not show is made up between their magnifications.

The specimen is a plane. What lies at x on it, in m, is seen by picture i at

    X = R(turn_i) (x + drift_v tau) + shift_i + change_i tau

in the sem frame, at the height ``slope . x``; tau is the time of the pixel from -1/2 to 1/2 of the frame. The drift of
a visit turns with the specimen, and that of a picture differs from it by its change: a stretch of all pictures that
does not turn is the camera's.

The scale may creep, by the same part from each picture to the next one: a specimen that charges more and more does so,
and a lens or a high tension that warms up. Along a ladder that adds up as a wrong scale of all of its steps would; the
pictures of one magnification tell the two apart.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np

from semcal_ros.core.arrays import Array, Indices, equilibrate
from semcal_ros.core.calibration.estimator.thresholds import HELD_SIGMA
from semcal_ros.core.camera.calibration_model import (
    ALL_FUNCTIONS,
    CalibrationModel,
    columns_of,
    design_matrix,
    names_of,
    stack_coefficients,
)
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.projection import ALL_NAMES, camera_size
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.ladder.thresholds import (
    BEND_FACTOR,
    BENDS_MIN,
    JUMP_SIGMA,
    POSE_SIZE,
    SINGULAR_PART,
    SLOPE_SIGMA_RAD,
    VISIT_SIGMA_MIN,
)

# Pictures of a flat specimen from above tell nothing of these.
_UNSEEN = ("px", "py", "rho")


@dataclass(frozen=True)
class PicturePlace:
    """What is known of a picture before anything is measured in it.

    Attributes
    ----------
    name
        Its name, for messages.
    magnification
        The magnification.
    visit
        Number of the stretch of pictures between which the magnification was not set.
    """

    name: str
    magnification: float
    visit: int


@dataclass(frozen=True, eq=False)
class LadderSetup:
    """What does not change during the adjustment.

    Attributes
    ----------
    model
        The calibration of the grid.
    functions
        Its functions over the whole ladder, with zeros beyond the grid and for jumps.
    pictures
        The pictures.
    image_size
        (width, height) of the pictures, px: as in the calibration.
    root
        (K, Z) from components of the prior, each of variance one, to the coefficients of all functions.
    bend_sigmas
        (B,) prior 1-sigma of the second derivatives that are free.
    bend_columns
        (B,) which of the K coefficients they are.
    jump_columns
        (J,) which of the K coefficients are jumps of the scale.
    intervals
        The magnifications (below, above) between which each jump lies.
    visit_sigma
        Prior relative 1-sigma of the scale of a visit.
    """

    model: CalibrationModel
    functions: Mapping[str, ContinuousFunction]
    pictures: tuple[PicturePlace, ...]
    image_size: tuple[int, int]
    root: Array
    bend_sigmas: Array
    bend_columns: Array
    jump_columns: Array
    intervals: tuple[tuple[float, float], ...]
    visit_sigma: float
    _designs: dict[float, Array] = field(default_factory=dict, repr=False)

    @property
    def names(self) -> tuple[str, ...]:
        """The parameters of the camera, as many as the functions need."""
        return ALL_NAMES[: camera_size(self.functions.keys() & set(ALL_NAMES))]

    @cached_property
    def coefficients(self) -> Array:
        """(K,) coefficients of all functions in the calibration, with zeros for what is new."""
        return stack_coefficients(self.functions)

    @cached_property
    def visits(self) -> tuple[int, ...]:
        """The visits, ascending."""
        return tuple(sorted({picture.visit for picture in self.pictures}))

    @cached_property
    def visit_of(self) -> Indices:
        """(M,) place of the visit of each picture among them."""
        return np.array(
            [self.visits.index(picture.visit) for picture in self.pictures], dtype=np.intp
        )

    @cached_property
    def order(self) -> Array:
        """(M,) number of each picture, from the middle of those in the range that was calibrated before."""
        low, high = self.model.magnification_range
        g = np.array([picture.magnification for picture in self.pictures])
        inside = np.flatnonzero((g >= low * (1.0 - 1e-6)) & (g <= high * (1.0 + 1e-6)))
        middle = float(inside.mean()) if len(inside) else 0.0
        return np.arange(len(g), dtype=np.float64) - middle

    def design(self, magnification: float) -> Array:
        """(P, K) from the coefficients to the parameters of the camera."""
        if magnification not in self._designs:
            self._designs[magnification] = design_matrix(
                self.functions,
                magnification,
                self.model.nominal_px_per_m(magnification),
                rows=ALL_FUNCTIONS[: len(self.names)],
            )
        return self._designs[magnification]

    def pixel_m(self, magnification: float) -> float:
        """Nominal pixel size, m."""
        return 1.0 / self.model.nominal_px_per_m(magnification)

    @cached_property
    def bounds(self) -> tuple[slice, slice, slice, slice, slice, slice, slice, slice]:
        """Where components, bends, jumps, visits, slopes, poses, drifts and creep stand among the unknowns."""
        sizes = (
            self.root.shape[1],
            len(self.bend_columns),
            len(self.jump_columns),
            len(self.visits),
            2,
            POSE_SIZE * len(self.pictures),
            2 * len(self.visits),
            1,
        )
        ends = np.cumsum([0, *sizes]).tolist()
        one, two, three, four, five, six, seven, last = (slice(a, b) for a, b in pairwise(ends))
        return one, two, three, four, five, six, seven, last

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.bounds[-1].stop

    @cached_property
    def theta_columns(self) -> Array:
        """(K, Z + B + J) derivative of the coefficients by the unknowns of the functions."""
        columns = np.zeros((len(self.root), self.bounds[2].stop))
        columns[:, self.bounds[0]] = self.root
        columns[self.bend_columns, np.arange(self.bounds[1].start, self.bounds[1].stop)] = 1.0
        columns[self.jump_columns, np.arange(self.bounds[2].start, self.bounds[2].stop)] = 1.0
        return columns


@dataclass(frozen=True, eq=False)
class LadderState:
    """Values of the unknowns.

    Attributes
    ----------
    setup
        What they belong to.
    values
        (N,) in the order of :attr:`LadderSetup.bounds`; the components from the mean of the prior.
    """

    setup: LadderSetup
    values: Array

    @cached_property
    def theta(self) -> Array:
        """(K,) coefficients of the functions."""
        setup = self.setup
        return np.asarray(
            setup.coefficients + setup.theta_columns @ self.values[: setup.bounds[2].stop]
        )

    @cached_property
    def parameters(self) -> Array:
        """(M, P) parameters of the camera of each picture, with the scale of its visit."""
        own = [
            self.setup.design(picture.magnification) @ self.theta for picture in self.setup.pictures
        ]
        parameters = np.array(own)
        parameters[:, 0] *= 1.0 + self.visit_scales
        return parameters

    @cached_property
    def visit_scales(self) -> Array:
        """(M,) relative deviation of the scale of each picture in its visit, with the creep up to it."""
        setup = self.setup
        own = self.values[setup.bounds[3]][setup.visit_of]
        return np.asarray(own + self.creep * setup.order)

    @property
    def creep(self) -> float:
        """Relative change of the scale from each picture to the next one."""
        return float(self.values[self.setup.bounds[7]][0])

    @property
    def poses(self) -> Array:
        """(M, 5) poses of the pictures."""
        return self.values[self.setup.bounds[5]].reshape(-1, POSE_SIZE)

    @property
    def drifts(self) -> Array:
        """(M, 2) drift during a frame of the visit of each picture, on the specimen, in nominal px."""
        own = self.values[self.setup.bounds[6]].reshape(-1, 2)
        return np.asarray(own[self.setup.visit_of])

    @property
    def slope(self) -> Array:
        """(2,) slope of the specimen."""
        return self.values[self.setup.bounds[4]]


def extend_functions(
    model: CalibrationModel, knots: Array, breaks: Array
) -> dict[str, ContinuousFunction]:
    """Return the functions of a calibration with zeros for everything beyond the grid.

    Parameters
    ----------
    model
        The calibration; functions that are extended already go on where they end.
    knots
        Magnifications from one end of the range outwards.
    breaks
        Where the scale may jump.
    """
    extended = {}
    for name in names_of(model.functions):
        own = model.functions[name]
        smooth, bends = own.smooth_size, max(len(own.extension) - 1, 0)
        parts = [own.coefficients[:smooth], own.coefficients[smooth : smooth + bends]]
        jumps, where = own.coefficients[smooth + bends :], own.breaks
        old = own.extension
        if name not in _UNSEEN:
            if len(old) and (old[-1] > old[0]) != (knots[-1] > knots[0]):
                way, before = "upwards", "downwards"
                if knots[-1] < knots[0]:
                    way, before = before, way
                raise InvalidValueError(
                    f"a ladder {way} for a calibration that was extended {before} already",
                    expected=f"a calibration of a grid alone, or one that was extended {way}",
                    do="extend the calibration of the grid to this side, into a file of its own",
                )
            added = knots[1:] if len(old) else knots
            old = np.concatenate([old, added])
            parts.append(np.zeros(len(knots) - 1))
        if name == "scale":
            order = np.argsort(np.concatenate([where, breaks]), kind="stable")
            jumps = np.concatenate([jumps, np.zeros(len(breaks))])[order]
            where = np.concatenate([where, breaks])[order]
        extended[name] = replace(
            own, coefficients=np.concatenate([*parts, jumps]), breaks=where, extension=old
        )
    return extended


def make_setup(
    model: CalibrationModel,
    pictures: tuple[PicturePlace, ...],
    image_size: tuple[int, int],
) -> LadderSetup:
    """Set up a ladder: bends at each of its magnifications beyond the grid, jumps between any two of them."""
    low, high = model.magnification_range
    seen = sorted({picture.magnification for picture in pictures})
    above = [g for g in seen if g > high * (1.0 + 1e-6)]
    below = [g for g in seen if g < low * (1.0 - 1e-6)]
    if bool(above) == bool(below):
        raise InvalidValueError(
            f"a ladder from {seen[0]:g}x to {seen[-1]:g}x for a calibration of {low:g}x to {high:g}x",
            expected="one that goes beyond one end of it",
            do="make two files: one by the pictures in the range and above, one by those in the range and below"
            if above
            else "record pictures beyond it; inside, views of a grid improve a calibration (semcal update)",
        )
    outwards = above or below[::-1]
    knots = np.array([high if above else low, *outwards])
    # The last magnification inside, so that a jump at the very end of the grid is found, too.
    inner = [g for g in seen if low <= g <= high]
    inside = (max(inner) if above else min(inner)) if inner else knots[0]
    ends = [inside, *outwards]
    intervals = tuple((min(pair), max(pair)) for pair in pairwise(ends))
    breaks = np.array([np.sqrt(a * b) for a, b in intervals])
    smooth = model.functions["scale"].kind in ("chebyshev_log", "chebyshev", "legendre")
    if not smooth:
        breaks, intervals = np.empty(0), ()
    # A jump inside the grid is one that the grid would have shown.
    beyond = breaks > high if above else breaks < low
    breaks = breaks[beyond]
    intervals = tuple(pair for pair, kept in zip(intervals, beyond, strict=True) if kept)
    functions = extend_functions(model, knots, breaks)
    old_columns: list[int] = []
    bends: list[int] = []
    sigmas: list[float] = []
    jumps: list[int] = []
    for name, columns in columns_of(functions).items():
        own, before, column = functions[name], model.functions[name], columns.start
        new_bends = len(own.extension) - max(len(before.extension), 1) if len(own.extension) else 0
        kept = own.smooth_size + max(len(own.extension) - 1, 0) - new_bends
        old_columns += range(column, column + kept)
        bends += range(column + kept, column + kept + new_bends)
        sigmas += [_bend_sigma(model, name)] * new_bends
        start = column + kept + new_bends
        for number, place in enumerate(own.breaks):
            is_old = bool(np.any(np.isclose(place, before.breaks, rtol=1e-12)))
            (old_columns if is_old else jumps).append(start + number)
    known = prior_root(model.coefficient_covariance)
    root = np.zeros((sum(own.size for own in functions.values()), known.shape[1]))
    root[old_columns] = known
    return LadderSetup(
        model=model,
        functions=functions,
        pictures=pictures,
        image_size=image_size,
        root=root,
        bend_sigmas=np.array(sigmas),
        bend_columns=np.array(bends, dtype=np.intp),
        jump_columns=np.array(jumps, dtype=np.intp),
        intervals=intervals,
        visit_sigma=max(model.scale_sigma.repeatability, VISIT_SIGMA_MIN),
    )


def prior_root(covariance: Array) -> Array:
    """(K, Z) matrix whose product with its transpose is a covariance (K, K), which may be singular."""
    # Pixels beside normalised coordinates: without the scaling, rounding would take the small ones.
    scaled, scale = equilibrate(covariance)
    variances, directions = np.linalg.eigh(scaled)
    kept = variances > SINGULAR_PART * variances.max()
    return np.asarray(directions[:, kept] * np.sqrt(variances[kept]) / scale[:, None])


def _bend_sigma(model: CalibrationModel, name: str) -> float:
    """Prior 1-sigma of the second derivative of a function by log g: what it is where it is known, and a least."""
    low, high = model.magnification_range
    least = BENDS_MIN.get(name, BENDS_MIN["others"])
    if name in ("ex", "ey"):
        least *= model.image_width
    if high < 1.5 * low:
        return least
    grid = np.linspace(np.log(low), np.log(high), 65)
    values = np.array([model.functions[name](float(np.exp(x))) for x in grid])
    # Jumps are no bends.
    own = model.functions[name]
    if len(own.breaks):
        jumps = own.coefficients[own.size - len(own.breaks) :]
        for place, jump in zip(own.breaks, jumps, strict=True):
            values -= jump * (np.exp(grid) >= place)
    bends = np.diff(values, 2) / (grid[1] - grid[0]) ** 2
    return max(least, BEND_FACTOR * float(np.sqrt(np.mean(bends**2))))


def start_state(setup: LadderSetup) -> LadderState:
    """The state before anything is measured: beyond the grid the functions stay as they are at its end."""
    values = np.zeros(setup.size)
    place = {int(column): k for k, column in enumerate(setup.bend_columns)}
    for name, columns in columns_of(setup.functions).items():
        own = setup.functions[name]
        own_bends = [c for c in range(columns.start, columns.stop) if c in place]
        if own_bends:
            knots = own.extension[len(own.extension) - len(own_bends) - 1 :]
            flat = own(float(knots[0]))
            basis = np.stack([own.basis(float(g)) for g in knots[1:]])
            wanted = flat - basis @ own.coefficients
            inner = basis[:, [c - columns.start for c in own_bends]]
            bends = np.linalg.solve(inner, wanted)
            values[setup.bounds[1]][[place[c] for c in own_bends]] = bends
    return LadderState(setup, values)


def slope_sigma() -> float:
    """Prior 1-sigma of the slope of the specimen along each axis, rad."""
    return SLOPE_SIGMA_RAD


def jump_sigmas(setup: LadderSetup, active: tuple[int, ...]) -> Array:
    """(J,) prior 1-sigma of the jumps: those that were found, and the others."""
    sigmas = np.full(len(setup.jump_columns), HELD_SIGMA)
    sigmas[list(active)] = JUMP_SIGMA
    return sigmas
