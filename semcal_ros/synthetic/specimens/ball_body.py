"""The ball on its tip: where rays meet it, and its texture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from semcal_ros.core.arrays import Array, Image

__all__ = ["BallOnTip"]


# Voxels along each side of the periodic noise: the two grain sizes take 17 MB in single precision.
_TILE = 128


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
        Size of the texture's cells.
    contrast
        1-sigma of the texture, relative.
    reflectivity, background
        Of the surface seen along its normal, and of what lies far below.
    slope_power
        The yield grows with ``1 / cos(slope)`` to this power.
    seed
        Of the texture.
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
        normal = at / (0.5 * self.diameter_m)
        on_tip = hit & (tip < ball)
        radial = at[on_tip] * np.array([0.0, 1.0, 1.0])
        length = np.linalg.norm(radial, axis=1)
        radial[:, 0] = -self.tip_slope * length
        normal[on_tip] = radial / (length * math.hypot(1.0, self.tip_slope))[:, None]
        return along, normal

    def _ball(self, origin: Array, direction: Array) -> Array:
        a = np.sum(direction**2, axis=1)
        b = np.sum(origin * direction, axis=1)
        c = np.sum(origin**2, axis=1) - (0.5 * self.diameter_m) ** 2
        inside = b * b - a * c
        root = np.sqrt(np.maximum(inside, 0.0))
        return np.where(inside > 0.0, (-b - root) / a, np.inf)

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
        ball = np.linalg.norm(points_m, axis=1) - 0.5 * self.diameter_m
        radius = self.tip_radius_m + self.tip_slope * points_m[:, 0]
        tip = (np.hypot(points_m[:, 1], points_m[:, 2]) - radius) / math.hypot(1.0, self.tip_slope)
        return np.asarray(np.where(points_m[:, 0] > 0.0, np.minimum(ball, tip), ball))

    def texture(self, points_m: Array) -> Array:
        """(n,) relative reflectivity at body-frame points (n, 3): a solid texture, mean 1."""
        cells = (points_m / self.grain_m).T
        grains = map_coordinates(_make_noise(self.seed), cells, order=1, mode="grid-wrap")
        return np.asarray(np.clip(1.0 + self.contrast * grains, 0.2, 2.0), dtype=np.float64)


@lru_cache(maxsize=2)
def _make_noise(seed: int) -> Image:
    """Make periodic noise with unit standard deviation from grains of two sizes."""
    rng = np.random.default_rng(seed)
    white = rng.standard_normal((2, _TILE, _TILE, _TILE), dtype=np.float32)
    fine, coarse = (
        gaussian_filter(w, s, mode="wrap") for w, s in zip(white, (1.2, 2.6), strict=True)
    )
    mixed = fine / fine.std() + 0.7 * coarse / coarse.std()
    return np.asarray(mixed / mixed.std(), dtype=np.float32)
