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

"""Random microscopes, stages and grids, and the corners that they see.

Nothing here is shared with the calibration: the equations are written down once more, in the order in which the beam
meets them, so that an error in one of the two shows. A microscope depends on nothing but the seed and its index.

    point          X, Y, Z in m about the point where the optical axis meets the reference plane
    projection     w = 1 + Z / pivot,  x = p + m(g) [[a, s], [0, 1/a]] (X, Y) / w
    lens           about e, with q = (x - e) / n, n half the width: 2 q / (1 + sqrt(1 - 4 k r2)) + t (r2 + 2 q*q)
                   + c r2 (-q_y, q_x), each of k, t, c falling as exp(-g / decay)
    coils          x += A (z^3 - z + 0.4 z^2) along each axis, z from -1 to 1 across the raster
    settling       x += B exp(-column / L) along the lines: column of the picture, or of where the beam should be

These are the forms that the calibration knows. Those of the other physics are not all: the lens is displaced in some
direction d (Brown 1966: d r2 + 2 q (q . d)), its radial distortion is tan(b r) / (b r) or atan(b r) / (b r), and in
half of them has a part of the fifth order, h r4 q, that falls as the square of the third; and the amplifiers of the
coils saturate (a tanh curve, as large).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.calibration.draws import Draws

Array = NDArray[np.float64]

DISPLAY_WIDTH_M = 0.12
# Lengths in pixels are given for pictures of this width, and grow with it.
REFERENCE_WIDTH = 512
LOWEST, HIGHEST = 60.0, 20000.0
LARGEST_RATIO = 2.1
SQUARES_M = (50e-6, 25e-6, 10e-6, 5e-6, 2e-6, 1e-6, 0.5e-6)
FEWEST_ACROSS, MOST_ACROSS = 8.0, 40.0
# A corner is found by its surroundings.
BORDER_PX = 4.0
FEWEST_CORNERS = 20
# How well a stage goes to a tilt.
TILT_ERROR_RAD = np.radians(0.1)
OUTLIER_PX = 1.5


@dataclass(frozen=True)
class Microscope:
    """A microscope, its stage, and how a recording was made with it.

    Lengths in m and px, angles in rad. ``coil_px`` is along columns and rows; ``settles_late`` says that the settling
    is a function of the column of the picture, which is the time since the line began. The last four are of the other
    physics: in which direction the lens is displaced, whether the radial distortion is that of an angle, how far into
    saturation the amplifiers go, and the radial distortion of the fifth order.
    """

    seed: int
    index: int
    width: int
    height: int
    magnifications: tuple[float, ...]
    views: int
    visits: int
    largest_tilt_rad: float
    axis_rad: float | None
    has_untilted: bool
    turn_rad: float
    squares_across: float
    noise_px: float
    outliers: float
    height_sigma_m: float
    visit_sigma: float
    pivot_m: float
    scale_bias: float
    wave: float
    wave_decades: float
    wave_phase: float
    aspect: float
    skew: float
    principal_px: tuple[float, float]
    centre_px: tuple[float, float]
    radial: float
    radial_decay: float
    decentring: float
    decentring_decay: float
    spiral: float
    spiral_decay: float
    coil_px: tuple[float, float]
    settling_px: float
    settling_columns: float
    settles_late: bool
    displaced_rad: float | None = None
    by_angle: bool = False
    saturation: float = 0.0
    fifth: float = 0.0

    @property
    def size(self) -> Array:
        return np.array([self.width, self.height], dtype=np.float64)

    @property
    def middle(self) -> Array:
        return 0.5 * (self.size - 1.0)

    @property
    def has_coil(self) -> bool:
        return any(value != 0.0 for value in self.coil_px)

    @property
    def is_plain(self) -> bool:
        """Whether it has neither spiral, coil nor settling."""
        return self.spiral == self.settling_px == 0.0 and not self.has_coil

    def nominal_px_per_m(self, g: float) -> float:
        return g * self.width / DISPLAY_WIDTH_M

    def scale(self, g: float) -> float:
        """Px per m at the reference plane."""
        turns = np.log10(g / LOWEST) / self.wave_decades
        wave = self.wave * np.sin(2.0 * np.pi * turns + self.wave_phase)
        return float(self.nominal_px_per_m(g) * (1.0 + self.scale_bias) * (1.0 + wave))

    def linear(self, g: float) -> Array:
        """(2, 2) px per m on the reference plane, without lens, coils and settling."""
        shape = np.array([[self.aspect, self.skew], [0.0, 1.0 / self.aspect]])
        return self.scale(g) * shape

    def project_ideal(self, g: float, points_m: Array, visit: float = 1.0) -> Array:
        """(n, 2) pixels of points (n, 3) before lens, coils and settling; ``visit`` is a factor on the scale."""
        w = 1.0 + points_m[:, 2:] / self.pivot_m
        seen = visit * points_m[:, :2] @ self.linear(g).T / w
        out = np.array(self.principal_px) + seen
        return np.where(w > 0.0, out, np.nan)

    def deflect(self, g: float, ideal_px: Array) -> Array:
        """(n, 2) pixels after lens, coils and settling."""
        norm = 0.5 * self.width
        q = (ideal_px - np.array(self.centre_px)) / norm
        r2 = np.sum(q * q, axis=1, keepdims=True)
        k = self.radial * np.exp(-g / self.radial_decay)
        t = self.decentring * np.exp(-g / self.decentring_decay)
        c = self.spiral * np.exp(-g / self.spiral_decay)
        h = self.fifth * np.exp(-2.0 * g / self.radial_decay)
        lens = q * (self._radial(k, r2) + h * r2 * r2)
        if self.displaced_rad is None:
            lens = lens + t * (r2 + 2.0 * q * q)
        else:
            d = (
                t
                * np.sqrt(2.0)
                * np.array([np.cos(self.displaced_rad), np.sin(self.displaced_rad)])
            )
            lens = lens + d * r2 + 2.0 * q * (q @ d)[:, None]
        lens = lens + c * r2 * np.stack([-q[:, 1], q[:, 0]], axis=1)
        out = np.array(self.centre_px) + norm * lens
        z = 2.0 * (out - self.middle) / self.size
        out = out + np.array(self.coil_px) * (self.add_to_ramp(z) + 0.4 * z * z)
        out[:, 0] = self.settle(out[:, 0])
        return out

    def _radial(self, k: float, r2: Array) -> Array:
        """By what factor a point is farther out."""
        if not self.by_angle:
            root = 1.0 - 4.0 * k * r2
            return np.asarray(2.0 / (1.0 + np.sqrt(np.where(root > 0.0, root, np.nan))))
        angle = np.sqrt(3.0 * abs(k) * r2) + 1e-9
        return np.asarray((np.tan(angle) if k > 0.0 else np.arctan(angle)) / angle)

    def add_to_ramp(self, z: Array) -> Array:
        """What an amplifier adds to a ramp, 0 at both ends and 0.385 at most in between."""
        if self.saturation == 0.0:
            return z**3 - z
        slope = np.tanh(self.saturation) / self.saturation
        most = np.arccosh(slope**-0.5) / self.saturation
        top = np.tanh(self.saturation * most) / np.tanh(self.saturation) - most
        bent = np.tanh(self.saturation * z) / np.tanh(self.saturation) - z
        return np.asarray(-2.0 / 27.0**0.5 * bent / top)

    def settle(self, x: Array) -> Array:
        """Columns of the picture where the beam should be at these ones."""
        if self.settling_px == 0.0:
            return x
        # Left of the picture there is no time in which it could grow.
        length, push = self.settling_columns, self.settling_px
        if not self.settles_late:
            return x + push * np.exp(-np.maximum(x, -length) / length)
        column = x + push * np.exp(-np.maximum(x, 0.0) / length)
        for _ in range(60):
            late = push * np.exp(-np.maximum(column, -length) / length)
            slope = np.where(column > -length, late / length, 0.0)
            column = column - (column - late - x) / (1.0 + slope)
        return column

    def project(self, g: float, points_m: Array, visit: float = 1.0) -> Array:
        """(n, 2) raw pixels of points (n, 3); NaN where there is none."""
        return self.deflect(g, self.project_ideal(g, points_m, visit))

    def is_inside(self, xy: Array, border_px: float = 0.0) -> NDArray[np.bool_]:
        """(n,) whether pixels lie in the picture."""
        with np.errstate(invalid="ignore"):
            low, high = xy >= border_px, xy <= self.size - 1.0 - border_px
        return np.all(low & high, axis=1)

    def square_m(self, g: float) -> float:
        """Side of the squares in view: of the allowed sizes the one that comes nearest to what is wanted."""
        across = DISPLAY_WIDTH_M / g / np.array(SQUARES_M)
        allowed = (across >= FEWEST_ACROSS) & (across <= MOST_ACROSS)
        off = np.abs(np.log(across / self.squares_across))
        return SQUARES_M[int(np.argmin(np.where(allowed, off, np.inf)))]

    @property
    def between(self) -> tuple[float, ...]:
        """Magnifications in the middle between neighbouring calibrated ones."""
        g = np.array(self.magnifications)
        return tuple(float(value) for value in np.sqrt(g[1:] * g[:-1]))


@dataclass(frozen=True)
class SeenGrid:
    """What a detector reports of one picture: (n, 2) places on the grid in m, and in the picture in px."""

    magnification: float
    board_m: Array
    xy: Array
    square_m: float
    visit: int
    name: str


def draw_microscope(seed: int, index: int, *, other_physics: bool = False) -> Microscope:
    """The microscope of this index in the fleet of this seed, or the same one with the other physics."""
    own = _draw_known(seed, index)
    if not other_physics:
        return own
    draws = Draws(np.random.default_rng((seed, index, 4)))
    return replace(
        own,
        displaced_rad=draws.between(-np.pi, np.pi),
        by_angle=draws.either(0.5),
        saturation=draws.between(0.8, 2.4),
        fifth=draws.between(-5e-3, 5e-3) * draws.either(0.5),
    )


def _draw_known(seed: int, index: int) -> Microscope:
    rng = np.random.default_rng((seed, index, 0))
    draws = Draws(rng)
    between, ratio, either = draws.between, draws.ratio, draws.either

    width = round(ratio(384, 6144) / 4.0) * 4
    height = width if either(0.5) else round(0.75 * width)
    relative = width / REFERENCE_WIDTH
    middle = 0.5 * (np.array([width, height]) - 1.0)
    # Values are drawn whether they are used or not: what follows is the same then.
    axis, has_axis = between(-np.pi, np.pi), either(0.5)
    coils = rng.uniform(-2.5, 2.5, 2) * [1.0, float(either(0.5))] * relative
    spiral, settling, settles_late = between(-0.008, 0.008), between(-3.0, 3.0), either(0.5)
    return Microscope(
        seed=seed,
        index=index,
        width=width,
        height=height,
        magnifications=_draw_magnifications(rng),
        views=int(rng.integers(2, 7)),
        visits=int(rng.integers(1, 3)),
        largest_tilt_rad=np.radians(between(15.0, 45.0)),
        axis_rad=axis if has_axis else None,
        has_untilted=either(0.75),
        turn_rad=np.pi if either(0.5) else 0.2,
        squares_across=ratio(10.0, 32.0),
        noise_px=ratio(0.015, 0.25),
        outliers=0.01 if either(0.5) else 0.0,
        height_sigma_m=float(rng.choice([1e-6, 2e-5, 4e-5])),
        visit_sigma=float(rng.choice([0.0, 1e-3, 3e-3])),
        pivot_m=ratio(4e-3, 60e-3),
        scale_bias=between(-0.08, 0.08),
        wave=between(0.0, 0.02),
        wave_decades=between(1.5, 4.0),
        wave_phase=between(-np.pi, np.pi),
        aspect=1.0 + between(-0.02, 0.02),
        skew=between(-4e-3, 4e-3),
        principal_px=_pair(middle + rng.uniform(-0.06, 0.06, 2) * width),
        centre_px=_pair(middle + rng.uniform(-0.1, 0.1, 2) * width),
        radial=between(-0.012, 0.012),
        radial_decay=ratio(800.0, 8000.0),
        decentring=between(-1.5e-3, 1.5e-3),
        decentring_decay=ratio(800.0, 8000.0),
        spiral=spiral if either(0.5) else 0.0,
        spiral_decay=ratio(800.0, 8000.0),
        coil_px=_pair(coils if either(0.5) else np.zeros(2)),
        settling_px=settling * relative if either(0.5) else 0.0,
        settling_columns=between(8.0, 40.0) * relative,
        settles_late=settles_late,
    )


def _pair(values: Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _draw_magnifications(rng: np.random.Generator) -> tuple[float, ...]:
    """3 to 15 magnifications, neighbours at most a factor of 2.1 apart."""
    steps = np.log(rng.uniform(1.2, LARGEST_RATIO, int(rng.integers(2, 15))))
    whole = np.log(HIGHEST / LOWEST)
    steps *= min(1.0, whole * rng.uniform(0.7, 1.0) / steps.sum())
    first = np.log(LOWEST) + rng.uniform(0.0, whole - steps.sum())
    values = np.exp(first + np.concatenate([[0.0], np.cumsum(steps)]))
    return tuple(float(f"{value:.5g}") for value in values)


def _turn_about(axis: Array, angle: float) -> Array:
    """(3, 3) rotation by an angle about a unit vector."""
    x, y, z = axis
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)


def tilted(tilt_rad: float, axis_rad: float, turn_rad: float = 0.0) -> Array:
    """(3, 3) of a specimen that is turned about its normal, then tilted about an axis in the reference plane."""
    axis = np.array([np.cos(axis_rad), np.sin(axis_rad), 0.0])
    return _turn_about(axis, tilt_rad) @ _turn_about(np.array([0.0, 0.0, 1.0]), turn_rad)


def _draw_tilts(own: Microscope, rng: np.random.Generator) -> tuple[Array, Array]:
    """Tilts of the views of one visit, and the directions of their axes."""
    if own.axis_rad is not None:
        tilts = own.largest_tilt_rad * np.linspace(0.0, 1.0, own.views)
        axes = np.full(own.views, own.axis_rad)
    else:
        tilts = own.largest_tilt_rad * rng.uniform(0.4, 1.0, own.views)
        axes = rng.uniform(-np.pi, np.pi, own.views)
    tilts[0] = 0.0
    if not own.has_untilted:
        tilts = own.largest_tilt_rad * rng.uniform(0.0, 1.0, own.views)
    return tilts + TILT_ERROR_RAD * rng.normal(size=own.views), axes


@dataclass(frozen=True)
class Shot:
    """How a picture is taken: the turn and the height (m) of the grid, and the factor on the scale of this visit."""

    magnification: float
    rotation: Array
    height_m: float
    factor: float
    visit: int


def take_shots(own: Microscope, rng: np.random.Generator) -> Iterator[Shot]:
    """The pictures of a recording: upwards through all magnifications, on a second visit down again."""
    order = [g for k in range(own.visits) for g in own.magnifications[:: 1 if k == 0 else -1]]
    visit = -1
    for stop, g in enumerate(order):
        # At the turning point the magnification is not set anew.
        if stop == 0 or g != order[stop - 1]:
            visit += 1
            factor = 1.0 + own.visit_sigma * rng.normal()
        tilts, axes = _draw_tilts(own, rng)
        for tilt, axis in zip(tilts, axes, strict=True):
            turn = rng.uniform(-own.turn_rad, own.turn_rad)
            rotation = tilted(tilt, axis, turn)
            yield Shot(g, rotation, own.height_sigma_m * rng.normal(), factor, visit)


def record(own: Microscope) -> list[SeenGrid]:
    """The corners of a recording."""
    rng = np.random.default_rng((own.seed, own.index, 1))
    return [_see(own, shot, number, rng) for number, shot in enumerate(take_shots(own, rng))]


def _see(own: Microscope, shot: Shot, number: int, rng: np.random.Generator) -> SeenGrid:
    """The corners in one picture; the numbers of the lattice start near the middle, in any of its four directions."""
    g = shot.magnification
    side = own.square_m(g)
    # So many squares that a strongly tilted grid fills the picture from corner to corner.
    reach = int(np.ceil(1.8 * DISPLAY_WIDTH_M / g / side)) + 2
    i, j = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1))
    ij = np.stack([i.ravel(), j.ravel()], axis=1)
    flat = ij * side + side * rng.uniform(-0.5, 0.5, 2)
    points = flat @ shot.rotation[:, :2].T + [0.0, 0.0, shot.height_m]
    # Far outside the equations of the lens mean nothing.
    ideal = own.project_ideal(g, points, shot.factor)
    with np.errstate(invalid="ignore"):
        near = np.all(np.abs(ideal - own.middle) < 0.7 * own.size, axis=1)
    ij, true = ij[near], own.deflect(g, ideal[near])
    xy = true + own.noise_px * rng.normal(size=true.shape)
    angle = rng.uniform(-np.pi, np.pi, len(xy))
    wrong = rng.uniform(size=len(xy)) < own.outliers
    xy += OUTLIER_PX * wrong[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    inside = own.is_inside(xy, BORDER_PX)
    ij, xy = ij[inside], xy[inside]
    if len(xy) < FEWEST_CORNERS:
        raise ValueError(f"microscope {own.index} sees {len(xy)} corners at magnification {g:g}")
    ij = ij - ij[np.argmin(np.sum((xy - own.middle) ** 2, axis=1))]
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[rng.integers(4)]
    board = side * (ij @ np.array([[c, s], [-s, c]])).astype(np.float64)
    return SeenGrid(g, board, xy, side, shot.visit, f"{number}")
