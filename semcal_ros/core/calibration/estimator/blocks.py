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

"""The unknowns of an adjustment: named blocks, what is known of them beforehand, and their values.

They are nested:

- one vector ``theta``, from which the camera of each magnification and what all views share (the
  shape of the grid, the errors of the stage) follow linearly (``design @ theta``);
- for each visit of a magnification, how far the scale and the height did not come back;
- for each view, its pose, the drift within the image, and, where the lattices of the views do not
  have the same axes, how far the stretch and shear of its lattice differ from the shared ones.

One view depends on the camera of its magnification, on what is shared, on its visit and on its own
unknowns. :class:`Layout` says in which columns each of these blocks stands: residuals and solver
ask it by name.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from semcal_ros.core.arrays import Array, Indices, Mask
from semcal_ros.core.calibration.stage import OFFSET_NAMES, Attitudes
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.plane_geometry import rotations_from_vectors
from semcal_ros.core.camera.projection import ALL_NAMES, PARAMETER_NAMES, camera_size
from semcal_ros.core.camera.scan_distortion import Raster
from semcal_ros.core.errors import CalibrationError

GRID_NAMES: tuple[str, ...] = ("grid_stretch", "grid_shear", "grid_curvature_m")
"""Stretch (x longer and y shorter by half of it), shear (x moves with y), and curvature in 1/m."""
MISS_NAMES: tuple[str, ...] = ("axis_x_m", "axis_y_m", "axis_z_m")
"""Where the tilt axis lies, as in :func:`~semcal_ros.core.calibration.stage.height_of_tilt`."""


@dataclass(frozen=True)
class Block:
    """Unknowns that stand side by side.

    Attributes
    ----------
    name
        ``camera``, ``grid.shape``, ``grid.squares``, ``stage.axis``, ``stage.offset``, ``visit.scale``,
        ``visit.height``, ``view.turn``, ``view.shift``, ``view.drift`` or ``view.lattice``.
    unknowns
        The name of each.
    unit
        Their unit.
    """

    name: str
    unknowns: tuple[str, ...]
    unit: str


_VISIT_BLOCKS = (Block("visit.scale", ("scale",), "1"), Block("visit.height", ("height",), "m"))
# A turn is a rotation vector in the sem frame; a pixel is that of the view's magnification.
_POSE_BLOCKS = (
    Block("view.turn", ("x", "y", "z"), "rad"),
    Block("view.shift", ("x", "y", "z"), "pixels' worth of m"),
)
_DRIFT_BLOCK = Block("view.drift", ("x", "y"), "px")
_LATTICE_BLOCK = Block("view.lattice", ("stretch", "shear"), "1")


@dataclass(frozen=True)
class Layout:
    """The columns of blocks of unknowns, in their order: those of a magnification, of a visit and of a view."""

    blocks: tuple[Block, ...]

    @cached_property
    def _columns(self) -> dict[str, slice]:
        stops = np.cumsum([len(block.unknowns) for block in self.blocks])
        return {
            block.name: slice(int(stop) - len(block.unknowns), int(stop))
            for block, stop in zip(self.blocks, stops, strict=True)
        }

    def __getitem__(self, name: str) -> slice:
        """Return the columns of a block."""
        return self._columns[name]

    def __contains__(self, name: str) -> bool:
        """Whether there is such a block."""
        return name in self._columns

    @property
    def size(self) -> int:
        """The number of unknowns."""
        return sum(len(block.unknowns) for block in self.blocks)

    def only(self, names: Iterable[str]) -> Layout:
        """Return the layout of some of the blocks alone; names that are not there are ignored."""
        wanted = frozenset(names)
        return Layout(tuple(block for block in self.blocks if block.name in wanted))

    def columns(self, part: Layout) -> Indices:
        """Return where the unknowns of a part stand among all."""
        every = np.arange(self.size)
        own = [every[self[block.name]] for block in part.blocks]
        return np.concatenate(own) if own else every[:0]

    def _level(self, prefix: str) -> Layout:
        return self.only(block.name for block in self.blocks if block.name.startswith(prefix))

    @cached_property
    def of_view(self) -> Layout:
        """The blocks that each view has."""
        return self._level("view.")

    @cached_property
    def of_visit(self) -> Layout:
        """The blocks that each visit has."""
        return self._level("visit.")

    @property
    def magnification(self) -> slice:
        """The columns of the camera of a magnification, and of what all views share: the first ones."""
        return slice(0, self.size - self.of_visit.size - self.of_view.size)

    @property
    def visit(self) -> slice:
        """The columns of the unknowns of a visit."""
        return slice(self.magnification.stop, self.size - self.of_view.size)

    @property
    def view(self) -> slice:
        """The columns of the unknowns of a view: the last ones."""
        return slice(self.size - self.of_view.size, self.size)


@dataclass(frozen=True)
class Effects:
    """What varies from visit to visit and from view to view, besides the poses.

    Attributes
    ----------
    visit
        (V,) index of each view's visit.
    visit_group
        (J,) index of each visit's magnification.
    scale_sigma, height_sigma_m
        Prior 1-sigma of a visit's relative scale, and of the height that its views share.
    drift_sigma_px
        (V,) prior 1-sigma per axis of the drift during one frame.
    frame_time
        (N,) when each point was scanned, in frames from the middle of the frame.
    lattice_sigma
        (2,) prior 1-sigma of a view's own stretch and shear of the grid, or None where all lattices
        have the same axes.
    """

    visit: Indices
    visit_group: Indices
    scale_sigma: float
    height_sigma_m: float
    drift_sigma_px: Array
    frame_time: Array
    lattice_sigma: Array | None = None

    @property
    def visit_sigmas(self) -> Array:
        """(2,) prior 1-sigma of the unknowns of a visit."""
        return np.array([self.scale_sigma, self.height_sigma_m])


@dataclass(frozen=True)
class Problem:
    """Observations and priors of one adjustment.

    A magnification has C unknowns: the ``parameters`` of its camera, then those in ``shared``.

    Attributes
    ----------
    board_m, observed_px
        (N, 3) and (N, 2): grid points, and observed raw pixels (corrected by the residual field
        where there is one).
    whitening
        (N, 3): the lower triangle (xx, yx, yy) that turns a residual into one of unit covariance.
    starts
        (V + 1,) offsets of the views in these arrays.
    group
        (V,) index of each view's magnification in ``designs``.
    designs
        (M, C, K): unknowns of each magnification per unit of theta.
    unit_m
        (V,) metres per pose unit (about one pixel), which keeps the equations well scaled.
    raster
        Where the raster lies in the pictures.
    prior_mean, prior_sigma
        (K,) prior of theta; an infinite sigma stands for no prior.
    height_sigma_m
        (V,) prior 1-sigma of each view's height about the reference plane.
    parameters
        Names of the parameters of the camera that the designs give; the others are zero.
    shared
        Names of the unknowns that all views share: of the grid's shape (``GRID_NAMES`` and
        ``square_1``...), of the miss of the tilt axis (``MISS_NAMES``), and of the stage.
    square_class
        (V,) which size of squares each view shows; 0 is the one without a ``square_`` unknown.
    effects
        What varies besides the poses, or None where nothing does.
    attitudes
        What is known about the orientations of the views, or None.
    across
        (N, 2) the only direction in which each point is known, if it lies on a line of a grating; None where both are.
    """

    board_m: Array
    observed_px: Array
    whitening: Array
    starts: Indices
    group: Indices
    designs: Array
    unit_m: Array
    raster: Raster
    prior_mean: Array
    prior_sigma: Array
    height_sigma_m: Array
    parameters: tuple[str, ...] = PARAMETER_NAMES
    shared: tuple[str, ...] = ()
    square_class: Indices | None = None
    effects: Effects | None = None
    attitudes: Attitudes | None = None
    across: Array | None = None

    @property
    def dimensions(self) -> int:
        """In how many directions each point is known."""
        return 2 if self.across is None else 1

    def known_part(self, residuals_px: Array) -> Array:
        """Return residuals (N, 2) without the direction along lines, in which nothing was observed."""
        if self.across is None:
            return residuals_px
        return self.across * np.sum(residuals_px * self.across, axis=1, keepdims=True)

    @cached_property
    def layout(self) -> Layout:
        """Where the unknowns on which one view depends stand."""
        blocks = [Block("camera", self.parameters, "")]
        squares = tuple(name for name in self.shared if name.startswith("square_"))
        for name, members, unit in (
            ("grid.shape", GRID_NAMES, "1, 1, 1/m"),
            ("grid.squares", squares, "1"),
            ("stage.axis", MISS_NAMES, "m"),
            ("stage.offset", OFFSET_NAMES, "rad"),
        ):
            own = tuple(unknown for unknown in self.shared if unknown in members)
            blocks += [Block(name, own, unit)] if own else []
        if self.effects is None:
            return Layout((*blocks, *_POSE_BLOCKS))
        lattice = () if self.effects.lattice_sigma is None else (_LATTICE_BLOCK,)
        return Layout((*blocks, *_VISIT_BLOCKS, *_POSE_BLOCKS, _DRIFT_BLOCK, *lattice))

    @cached_property
    def view_of_point(self) -> Indices:
        """(N,) view index of every point."""
        return np.repeat(np.arange(len(self.group)), np.diff(self.starts))

    @cached_property
    def points_of_views(self) -> tuple[slice, ...]:
        """Where the points of each view stand."""
        pairs = zip(self.starts[:-1].tolist(), self.starts[1:].tolist(), strict=True)
        return tuple(slice(first, last) for first, last in pairs)

    @cached_property
    def points_on_squares(self) -> dict[str, Mask]:
        """The unknowns of sizes of squares, and for each the (N,) points on squares of that size."""
        out = {}
        for name in self.shared:
            if name.startswith("square_"):
                assert self.square_class is not None
                own = self.square_class == int(name.removeprefix("square_"))
                out[name] = own[self.view_of_point]
        return out

    @cached_property
    def parameter_index(self) -> Indices:
        """(P,) place of each of ``parameters`` among those of a camera."""
        return np.array([ALL_NAMES.index(name) for name in self.parameters], dtype=np.intp)

    def column(self, name: str) -> int:
        """Return the column of a parameter of the camera, or of a shared unknown."""
        return (*self.parameters, *self.shared).index(name)

    def cameras(self, theta: Array) -> Array:
        """Return the parameters of the cameras, (M, P), P as small of ``CAMERA_SIZES`` as holds them all."""
        own = self.designs[:, : len(self.parameters)] @ theta
        if self.parameters == PARAMETER_NAMES:
            return own
        out = np.zeros((len(self.designs), camera_size(self.parameters)))
        out[:, self.parameter_index] = own
        return out

    def shared_values(self, theta: Array, names: Sequence[str]) -> Array:
        """Return the values of shared unknowns, zero for those that the problem does not have."""
        known = dict(zip(self.shared, theta[len(theta) - len(self.shared) :], strict=True))
        return np.array([known.get(name, 0.0) for name in names])


@dataclass(frozen=True)
class State:
    """Values of the unknowns.

    Attributes
    ----------
    theta
        (K,) coefficients of the cameras, then the shared unknowns.
    rotations, translations_m
        (V, 3, 3) and (V, 3) sem frame from grid.
    visits
        (J, 2) relative scale and height in m of each visit; empty without effects.
    drift_px
        (V, 2) drift during the frame; empty without effects.
    lattices
        (V, 2) own stretch and shear of each view; empty where all lattices have the same axes.
    """

    theta: Array
    rotations: Array
    translations_m: Array
    visits: Array = field(default_factory=lambda: np.zeros((0, 2)))
    drift_px: Array = field(default_factory=lambda: np.zeros((0, 2)))
    lattices: Array = field(default_factory=lambda: np.zeros((0, 2)))


def make_problem(
    views: Sequence[GridView],
    magnifications: Array,
    designs: Array,
    *,
    raster: Raster,
    nominal_px_per_m: Array,
    prior_mean: Array,
    prior_sigma: Array,
    height_sigma_m: Array | float,
    parameters: tuple[str, ...] = PARAMETER_NAMES,
) -> Problem:
    """Arrange views for an adjustment; ``magnifications`` (M,) are the distinct ones, in order.

    ``height_sigma_m`` is one number, or one for each view.
    """
    counts = [len(v.board_xy_m) for v in views]
    group = np.searchsorted(magnifications, [v.magnification for v in views]).astype(np.intp)
    board = np.concatenate([v.board_xy_m for v in views])
    return Problem(
        board_m=np.column_stack([board, np.zeros(len(board))]),
        observed_px=np.concatenate([v.image_xy for v in views]),
        whitening=np.concatenate([v.whitening for v in views]),
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.intp),
        group=group,
        designs=designs,
        unit_m=1.0 / nominal_px_per_m[group],
        raster=raster,
        parameters=parameters,
        prior_mean=prior_mean,
        prior_sigma=prior_sigma,
        height_sigma_m=np.broadcast_to(np.asarray(height_sigma_m, dtype=np.float64), len(views)),
        across=_directions(views),
    )


def _directions(views: Sequence[GridView]) -> Array | None:
    known = [v.across for v in views if v.across is not None]
    if not known:
        return None
    if len(known) < len(views):
        raise CalibrationError(
            "views of a grating and of another grid", expected="views of one grid"
        )
    return np.concatenate(known)


def retract(problem: Problem, state: State, change: Array, views: Array, visits: Array) -> State:
    """Return the state after changes of theta (K,), of the views (V, p) and of the visits (J, w)."""
    at = problem.layout.of_view

    def moved(values: Array, name: str) -> Array:
        return values + views[:, at[name]] if len(values) else values

    shift = views[:, at["view.shift"]] * problem.unit_m[:, None]
    return State(
        state.theta + change,
        rotations_from_vectors(views[:, at["view.turn"]]) @ state.rotations,
        state.translations_m + shift,
        state.visits + visits if len(state.visits) else state.visits,
        moved(state.drift_px, "view.drift"),
        moved(state.lattices, "view.lattice"),
    )


def pick_views(pick: Mask, chosen: State, other: State) -> State:
    """Return ``other`` with what ``chosen`` has of the views in ``pick`` (V,)."""
    return with_states_of(other, pick, states_of(chosen, pick))


def states_of(state: State, chosen: Mask) -> State:
    """Return the state of some of the views (V,)."""
    return replace(
        state,
        rotations=state.rotations[chosen],
        translations_m=state.translations_m[chosen],
        drift_px=state.drift_px[chosen] if len(state.drift_px) else state.drift_px,
        lattices=state.lattices[chosen] if len(state.lattices) else state.lattices,
    )


def with_states_of(state: State, chosen: Mask, own: State) -> State:
    """Return the state with that of some of the views (V,), as :func:`states_of` gives it."""
    out = {}
    for name in ("rotations", "translations_m", "drift_px", "lattices"):
        values = getattr(state, name).copy()
        if len(values):
            values[chosen] = getattr(own, name)
        out[name] = values
    return replace(state, **out)


def empty_effects(problem: Problem, state: State) -> State:
    """Return the state with effects of zero, as many as the problem has."""
    effects, none = problem.effects, np.zeros((0, 2))
    if effects is None:
        return replace(state, visits=none, drift_px=none, lattices=none)
    visits, own = np.zeros((len(effects.visit_group), 2)), np.zeros((len(problem.group), 2))
    lattices = none if effects.lattice_sigma is None else own
    return replace(state, visits=visits, drift_px=own, lattices=lattices)


def select_views(problem: Problem, chosen: Mask) -> Problem:
    """Return the problem with only some of its views."""
    points = chosen[problem.view_of_point]
    counts = np.diff(problem.starts)[chosen]
    effects = problem.effects
    if effects is not None:
        effects = replace(
            effects,
            visit=effects.visit[chosen],
            drift_sigma_px=effects.drift_sigma_px[chosen],
            frame_time=effects.frame_time[points],
        )
    return replace(
        problem,
        board_m=problem.board_m[points],
        observed_px=problem.observed_px[points],
        whitening=problem.whitening[points],
        across=None if problem.across is None else problem.across[points],
        starts=np.concatenate([[0], np.cumsum(counts)]).astype(np.intp),
        group=problem.group[chosen],
        unit_m=problem.unit_m[chosen],
        height_sigma_m=problem.height_sigma_m[chosen],
        square_class=None if problem.square_class is None else problem.square_class[chosen],
        attitudes=None if problem.attitudes is None else problem.attitudes.chosen(chosen),
        effects=effects,
    )
