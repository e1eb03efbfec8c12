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

"""The microscopes of the fleet, recorded in pictures: their points are those that the finder finds.

Pictures are smaller than those of the fleet and fewer, since each is drawn with 9 samples a pixel. Grids are
checkerboards in half of them, else dots, crosses or crossed lines; 100 to 1000 electrons a pixel, blurred by 0.7 to
1.3 px.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.calibration.draws import Draws
from benchmarks.calibration.fleet.microscope import (
    DISPLAY_WIDTH_M,
    SQUARES_M,
    Array,
    Microscope,
    Shot,
    take_shots,
)
from semcal_ros.core.calibration.views import GridView, views_from_detections
from semcal_ros.core.corners import LatticeDetection, find_lattice

LARGEST_WIDTH = 640
MOST_MAGNIFICATIONS, MOST_VIEWS = 5, 4
SAMPLES = 3
# From where something is blurred into the picture.
MARGIN_PX = 6
PATTERNS = ("chess", "chess", "chess", "dots", "crosses", "lines")
# The lens moves a pixel by some percent of the others' moves, so that an error falls tenfold in each round.
_LENS_ROUNDS, _AXIS_ROUNDS = 12, 60


def shrink(own: Microscope) -> Microscope:
    """The same microscope with smaller pictures, and with fewer of them."""
    width = min(own.width, LARGEST_WIDTH)
    by = width / own.width

    def moved(px: tuple[float, float]) -> tuple[float, float]:
        return (px[0] + 0.5) * by - 0.5, (px[1] + 0.5) * by - 0.5

    return replace(
        own,
        width=width,
        height=round(own.height * by),
        magnifications=own.magnifications[:MOST_MAGNIFICATIONS],
        views=min(own.views, MOST_VIEWS),
        principal_px=moved(own.principal_px),
        centre_px=moved(own.centre_px),
        coil_px=(own.coil_px[0] * by, own.coil_px[1] * by),
        settling_px=own.settling_px * by,
        settling_columns=own.settling_columns * by,
    )


def views_of_pictures(own: Microscope) -> tuple[GridView, ...]:
    """The views that are found in the pictures of a recording."""
    rng = np.random.default_rng((own.seed, own.index, 5))
    pattern = PATTERNS[int(rng.integers(len(PATTERNS)))]
    found: list[tuple[Shot, LatticeDetection]] = []
    last_g = 0.0
    for shot in take_shots(own, rng):
        if shot.magnification != last_g:
            last_g = shot.magnification
            ideal = ideal_from_raw(own, last_g)
        seen = find_lattice(draw_picture(own, shot, ideal, pattern, rng))
        if isinstance(seen, LatticeDetection):
            found.append((shot, seen))
    views, _ = views_from_detections(
        [seen for _, seen in found],
        [shot.magnification for shot, _ in found],
        display_width_m=DISPLAY_WIDTH_M,
        squares_m=SQUARES_M,
        visits=[shot.visit for shot, _ in found],
    )
    return views


def ideal_from_raw(own: Microscope, g: float) -> Array:
    """(rows, columns, 2) pixels before lens, coils and settling, of all samples of a picture and a margin of it."""
    column, row = (
        (np.arange(-MARGIN_PX * SAMPLES, (n + MARGIN_PX) * SAMPLES) + 0.5) / SAMPLES - 0.5
        for n in (own.width, own.height)
    )
    x, y = _before_coil(own, _before_settling(own, column), 0), _before_coil(own, row, 1)
    # The lens alone: what is left is found by going back by what it moves too far.
    lens = replace(own, coil_px=(0.0, 0.0), settling_px=0.0)
    target = np.stack(np.meshgrid(x, y), axis=2).reshape(-1, 2)
    at = target.copy()
    for _ in range(_LENS_ROUNDS):
        at += target - lens.deflect(g, at)
    return at.reshape(len(row), len(column), 2)


def _before_settling(own: Microscope, column: Array) -> Array:
    push, length = own.settling_px, own.settling_columns
    if push == 0.0:
        return column
    if own.settles_late:
        return np.asarray(column - push * np.exp(-np.maximum(column, -length) / length))
    x = column.copy()
    for _ in range(_AXIS_ROUNDS):
        slope = np.where(
            x > -length, -push / length * np.exp(-np.maximum(x, -length) / length), 0.0
        )
        x += (column - own.settle(x)) / (1.0 + slope)
    return x


def _before_coil(own: Microscope, pixel: Array, axis: int) -> Array:
    at = pixel.copy()
    for _ in range(_AXIS_ROUNDS):
        z = 2.0 * (at - own.middle[axis]) / own.size[axis]
        at += pixel - at - own.coil_px[axis] * (own.add_to_ramp(z) + 0.4 * z * z)
    return at


def draw_picture(
    own: Microscope, shot: Shot, ideal_px: Array, pattern: str, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """(h, w) grey values of a grid whose origin lies anywhere near the axis."""
    draws = Draws(rng)
    g, normal = shot.magnification, shot.rotation[:, 2]
    linear = shot.factor * own.linear(g)
    x, y = np.moveaxis((ideal_px - np.array(own.principal_px)) @ np.linalg.inv(linear).T, 2, 0)
    # Where the ray through a pixel meets the grid: X = x (1 + Z / pivot), and the same in y.
    across = normal[0] * x + normal[1] * y
    z = (normal[2] * shot.height_m - across) / (normal[2] + across / own.pivot_m)
    w = 1.0 + z / own.pivot_m
    point = np.stack([x * w, y * w, z - shot.height_m], axis=2)
    u, v = np.moveaxis(
        point @ shot.rotation[:, :2] / own.square_m(g) + rng.uniform(-0.5, 0.5, 2), 2, 0
    )
    # Edges as wide as a sample: half of one, in squares.
    soft = 0.5 / (SAMPLES * own.scale(g) * own.square_m(g))
    bright = _PATTERNS[pattern](u, v, soft)
    blur_px, electrons = draws.between(0.7, 1.3), draws.ratio(100.0, 1000.0)
    smooth = ndimage.gaussian_filter(bright, SAMPLES * blur_px)
    inner = slice(MARGIN_PX * SAMPLES, -MARGIN_PX * SAMPLES)
    pixels = smooth[inner, inner].reshape(own.height, SAMPLES, own.width, SAMPLES).mean((1, 3))
    shade = 1.0 + draws.between(-0.1, 0.1) * np.linspace(-1.0, 1.0, own.width)
    detected = rng.poisson(electrons * (0.25 + 0.5 * pixels) * shade) / electrons
    return np.clip(np.rint(220.0 * detected), 0.0, 255.0).astype(np.uint8)


def _off(t: Array) -> Array:
    return t - np.round(t)


def _chess(u: Array, v: Array, soft: float) -> Array:
    both = [np.clip(_off(t) / soft, -1.0, 1.0) * (1.0 - 2.0 * (np.round(t) % 2.0)) for t in (u, v)]
    return np.asarray(0.5 + 0.5 * both[0] * both[1])


def _inside(distance: Array, soft: float) -> Array:
    """1 where a distance from an outline is negative, 0 outside of it."""
    return np.asarray(np.clip(0.5 - 0.5 * distance / soft, 0.0, 1.0))


def _dots(u: Array, v: Array, soft: float) -> Array:
    return _inside(np.hypot(_off(u), _off(v)) - 0.28, soft)


def _lines(u: Array, v: Array, soft: float) -> Array:
    return _inside(np.minimum(np.abs(_off(u)), np.abs(_off(v))) - 0.1, soft)


def _crosses(u: Array, v: Array, soft: float) -> Array:
    a, b = np.abs(_off(u)), np.abs(_off(v))
    bars = [np.maximum(a - 0.32, b - 0.08), np.maximum(a - 0.08, b - 0.32)]
    return _inside(np.minimum(*bars), soft)


_PATTERNS: Mapping[str, Callable[[Array, Array, float], Array]] = {
    "chess": _chess,
    "dots": _dots,
    "lines": _lines,
    "crosses": _crosses,
}
