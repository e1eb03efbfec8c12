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

"""The ball on its tip: where rays meet it, and its texture.

A body that is no ball has other semi-axes or a bump; the texture has one of several statistics, so that
nothing can be tuned to one look.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial import cKDTree

from semcal_ros.core.arrays import Array, Image
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import did_you_mean
from semcal_ros.synthetic.specimens.thresholds import BODY_ROOM, BODY_STEPS, BODY_TILE, GRAIN_VOXELS

#: Statistics of the texture: noise of two grain sizes; Voronoi cells, each of one brightness; bright cells
#: with dark seams; a narrow band of wavelengths; bright spots on a dark ground.
TEXTURES = ("noise", "islands", "cracks", "speckle", "spots")


@dataclass(frozen=True)
class BallOnTip:
    """A ball at the origin of the body frame on a conical tip along +x.

    Parameters
    ----------
    diameter_m
        Of the ball.
    tip_radius_m, tip_slope
        Radius of the tip at the ball's centre and its growth per length.
    tip_length_m
        Distance of the tip's end from the ball's centre.
    grain_m
        Size of the grains: mean distance of islands, cracks or spots, wavelength of the speckle; of the
        noise, whose smaller grains are some 3 voxels wide, the size of a voxel.
    contrast
        1-sigma of the texture, relative.
    reflectivity, background
        Of the surface seen along its normal, and of what lies far below.
    slope_power
        The yield grows with ``1 / cos(slope)`` to this power.
    seed
        Of the texture.
    texture_name
        One of :data:`TEXTURES`.
    least_cosine
        Cosine of the slope below which the yield grows no more: the exit depth is not zero.
    most_yield
        Reflectivity at which the bright limb levels off.
    detector_side
        (x, y) relative change of the yield with the normal's x and y in the sem frame: a detector on one
        side, or charge that shadows the other.
    charging, charging_length_m
        A line darkens by this part of the excess brightness just scanned, fading over this length.
    stretch
        (3,) semi-axes of an ellipsoid, relative to the radius.
    bump_m, bump_width_m, bump_towards
        Height, 1-sigma of the width and direction in the body frame of a bump.
    substrate_contrast, substrate_grain_m
        1-sigma of the texture of what lies far below, relative to its reflectivity; it drifts with the
        ball, but does not turn.
    """

    diameter_m: float = 900e-9
    tip_radius_m: float = 70e-9
    tip_slope: float = 0.03
    tip_length_m: float = 5e-6
    grain_m: float = 9e-9
    contrast: float = 0.25
    reflectivity: float = 0.3
    background: float = 0.05
    slope_power: float = 0.9
    seed: int = 0
    texture_name: str = "noise"
    least_cosine: float = 0.08
    most_yield: float = 1.0
    detector_side: tuple[float, float] = (0.0, 0.0)
    charging: float = 0.0
    charging_length_m: float = 300e-9
    stretch: tuple[float, float, float] = (1.0, 1.0, 1.0)
    bump_m: float = 0.0
    bump_width_m: float = 90e-9
    bump_towards: tuple[float, float, float] = (0.0, 0.0, -1.0)
    substrate_contrast: float = 0.0
    substrate_grain_m: float = 60e-9

    def __post_init__(self) -> None:
        if self.texture_name not in TEXTURES:
            raise InvalidValueError(
                f"texture '{self.texture_name}'",
                expected=f"one of {', '.join(TEXTURES)}",
                do=did_you_mean(self.texture_name, TEXTURES),
            )

    @property
    def is_ball(self) -> bool:
        """Whether the body departs nowhere from a sphere, the tip aside."""
        return self.stretch == (1.0, 1.0, 1.0) and self.bump_m == 0.0

    @property
    def reach_m(self) -> float:
        """Radius of a sphere about the origin that holds the body without the tip, m."""
        return 0.5 * self.diameter_m * max(self.stretch) + max(self.bump_m, 0.0)

    def meet(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Find where rays first meet the surface.

        Parameters
        ----------
        origin, direction
            (n, 3) rays in the body frame, m; direction need not be of unit length.

        Returns
        -------
        (n,) multiples of the direction, inf where nothing is met, and (n, 3) outward normals.
        """
        ball = self._ball(origin, direction)
        tip = self._tip(origin, direction)
        along = np.minimum(ball, tip)
        hit = np.isfinite(along)
        at = origin + np.where(hit, along, 0.0)[:, None] * direction
        normal = at / (0.5 * self.diameter_m) if self.is_ball else self._slope(at)
        on_tip = hit & (tip < ball)
        radial = at[on_tip] * np.array([0.0, 1.0, 1.0])
        length = np.linalg.norm(radial, axis=1)
        radial[:, 0] = -self.tip_slope * length
        normal[on_tip] = radial / (length * math.hypot(1.0, self.tip_slope))[:, None]
        return along, normal

    def _ball(self, origin: Array, direction: Array) -> Array:
        a = np.sum(direction**2, axis=1)
        b = np.sum(origin * direction, axis=1)
        c = np.sum(origin**2, axis=1) - self.reach_m**2
        inside = b * b - a * c
        root = np.sqrt(np.maximum(inside, 0.0))
        along = np.where(inside > 0.0, (-b - root) / a, np.inf)
        return along if self.is_ball else self._descend(along, origin, direction, -b / a)

    def _descend(self, along: Array, origin: Array, direction: Array, middle: Array) -> Array:
        """Go from the enclosing sphere along rays to the surface; inf for those that miss it."""
        hit = np.flatnonzero(np.isfinite(along))
        o, d, t = origin[hit], direction[hit], along[hit].copy()
        for _ in range(BODY_STEPS):
            at = o + t[:, None] * d
            fall = -np.sum(self._slope(at, unit=False) * d, axis=1)
            # A ray that grazes the surface takes steps that are too long: a part of the height at most.
            t += self._height(at) / np.maximum(fall, 0.2 * np.linalg.norm(d, axis=1))
        error = np.abs(self._height(o + t[:, None] * d))
        met = (error < 1e-4 * self.diameter_m) & (t < middle[hit])
        out = np.full_like(along, np.inf)
        out[hit[met]] = t[met]
        return out

    def _height(self, at: Array) -> Array:
        """Compute the height over the surface along the radius of the ellipsoid's unit sphere, m."""
        length = np.linalg.norm(at / np.array(self.stretch), axis=1)
        return np.asarray(length - 0.5 * self.diameter_m - self._bump(at), dtype=np.float64)

    def _bump(self, at: Array) -> Array:
        if self.bump_m == 0.0:
            return np.zeros(len(at))
        towards = np.array(self.bump_towards) / np.linalg.norm(self.bump_towards)
        cosine = at @ towards / np.linalg.norm(at, axis=1)
        # 2 - 2 cos is the squared chord on the unit sphere.
        chord = (2.0 - 2.0 * cosine) * (0.5 * self.diameter_m / self.bump_width_m) ** 2
        return np.asarray(self.bump_m * np.exp(-0.5 * chord), dtype=np.float64)

    def _slope(self, at: Array, *, unit: bool = True) -> Array:
        """Compute the gradient of the height, or the outward unit normal."""
        stretch = np.array(self.stretch)
        length = np.linalg.norm(at / stretch, axis=1)
        gradient = at / stretch**2 / length[:, None]
        if self.bump_m != 0.0:
            towards = np.array(self.bump_towards) / np.linalg.norm(self.bump_towards)
            far = np.linalg.norm(at, axis=1)[:, None]
            cosine = (at @ towards)[:, None] / far
            sharp = (0.5 * self.diameter_m / self.bump_width_m) ** 2
            gradient -= self._bump(at)[:, None] * sharp * (towards - cosine * at / far) / far
        if not unit:
            return np.asarray(gradient, dtype=np.float64)
        return np.asarray(gradient / np.linalg.norm(gradient, axis=1)[:, None], dtype=np.float64)

    def _tip(self, origin: Array, direction: Array) -> Array:
        k, r0 = self.tip_slope, self.tip_radius_m
        growth = 1.0 + k * k
        o, d = origin, direction
        a = np.sum(d * d, axis=1) - growth * d[:, 0] ** 2
        b = np.sum(o * d, axis=1) - growth * o[:, 0] * d[:, 0] - r0 * k * d[:, 0]
        c = np.sum(o * o, axis=1) - growth * o[:, 0] ** 2 - 2.0 * r0 * k * o[:, 0] - r0**2
        inside = b * b - a * c
        root = np.sqrt(np.maximum(inside, 0.0))
        along = (-b - root) / a
        reach = o[:, 0] + along * d[:, 0]
        met = (inside > 0.0) & (a > 0.0) & (reach > 0.0) & (reach < self.tip_length_m)
        return np.where(met, along, np.inf)

    def distance_m(self, points_m: Array) -> Array:
        """(n,) distance of body-frame points (n, 3) from the surface, positive outside."""
        ball = self._height(points_m)
        radius = self.tip_radius_m + self.tip_slope * points_m[:, 0]
        tip = (np.hypot(points_m[:, 1], points_m[:, 2]) - radius) / math.hypot(1.0, self.tip_slope)
        return np.asarray(np.where(points_m[:, 0] > 0.0, np.minimum(ball, tip), ball))

    def texture(self, points_m: Array) -> Array:
        """(n,) relative reflectivity at body-frame points (n, 3): a solid texture, mean 1."""
        voxel = self.grain_m
        if self.texture_name != "noise":
            voxel = max(self.grain_m / GRAIN_VOXELS, BODY_ROOM * self.diameter_m / BODY_TILE)
        tile = _make_texture(self.texture_name, self.grain_m / voxel, self.seed)
        grains = map_coordinates(tile, (points_m / voxel).T, order=1, mode="grid-wrap")
        return np.asarray(np.clip(1.0 + self.contrast * grains, 0.2, 2.0), dtype=np.float64)

    def substrate(self, x_m: Array, y_m: Array) -> Array:
        """Reflectivity of what lies far below at sem-frame X, Y."""
        if self.substrate_contrast == 0.0:
            return np.full(x_m.shape, self.background)
        voxel = self.substrate_grain_m / GRAIN_VOXELS
        layer = _make_texture("speckle", GRAIN_VOXELS, self.seed + 1)[0]
        grains = map_coordinates(layer, [x_m / voxel, y_m / voxel], order=1, mode="grid-wrap")
        lit = 1.0 + self.substrate_contrast * np.clip(grains, -2.0, 2.0)
        return np.asarray(self.background * np.maximum(lit, 0.0), dtype=np.float64)


@lru_cache(maxsize=2)
def _make_texture(name: str, grain: float, seed: int) -> Image:
    """Make a periodic texture with unit standard deviation; the grain in voxels (1 for the noise)."""
    rng = np.random.default_rng(seed)
    if name == "noise":
        made = _make_noise(rng)
    elif name == "speckle":
        white = rng.standard_normal((BODY_TILE, BODY_TILE, BODY_TILE), dtype=np.float32)
        # In three dimensions k^2 (k^2 s^2 exp(-k^2 s^2 / 2))^2 is largest at k s = 1.7, 3.6 s long.
        fine = grain / 3.6
        made = gaussian_filter(white, fine, mode="wrap")
        made -= gaussian_filter(white, 1.6 * fine, mode="wrap")
    elif name == "spots":
        made = np.zeros((BODY_TILE, BODY_TILE, BODY_TILE), dtype=np.float32)
        seeds = tuple(rng.integers(0, BODY_TILE, (3, _count_grains(grain))))
        np.add.at(made, seeds, rng.uniform(0.5, 1.5, len(seeds[0])).astype(np.float32))
        made = gaussian_filter(made, 0.25 * grain, mode="wrap")
    else:
        made = _make_cells(name, grain, rng)
    made -= made.mean()
    return np.asarray(made / made.std(), dtype=np.float32)


def _count_grains(grain: float) -> int:
    return max(8, round((BODY_TILE / grain) ** 3))


def _make_cells(name: str, grain: float, rng: np.random.Generator) -> Image:
    """Make Voronoi cells of random brightness; with dark seams for cracks."""
    seeds = rng.uniform(0.0, BODY_TILE, (_count_grains(grain), 3))
    tree = cKDTree(seeds, boxsize=BODY_TILE)
    axis = np.arange(BODY_TILE, dtype=np.float64)
    at = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    distance, index = tree.query(at, k=2)
    bright = rng.uniform(-1.0, 1.0, len(seeds))[index[:, 0]]
    if name == "cracks":
        seam = np.exp(-0.5 * ((distance[:, 1] - distance[:, 0]) / (0.2 * grain)) ** 2)
        bright = 0.4 * bright - 2.0 * seam
    return np.asarray(bright.reshape(BODY_TILE, BODY_TILE, BODY_TILE), dtype=np.float32)


def _make_noise(rng: np.random.Generator) -> Image:
    """Make noise with grains of two sizes."""
    white = rng.standard_normal((2, BODY_TILE, BODY_TILE, BODY_TILE), dtype=np.float32)
    fine, coarse = (
        gaussian_filter(w, s, mode="wrap") for w, s in zip(white, (1.2, 2.6), strict=True)
    )
    return np.asarray(fine / fine.std() + 0.7 * coarse / coarse.std(), dtype=np.float32)
