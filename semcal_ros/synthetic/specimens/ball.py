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

"""A textured ball on a tip that turns while it is recorded, with its truth.

:func:`ball_plan` records one look; :func:`draw_ball_plan` draws another for every seed. A body that is no ball has
other semi-axes or a bump; the texture has one of several statistics, so that nothing can be tuned to one look.

Every sample of a frame is a ray of the true camera, distortion included, that meets the ball or the tip where they are
when its line is scanned. The yield grows with the slope as that of secondary electrons does, so the limb is bright and
the shading stays while the texture turns with the ball.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.signal import lfilter
from scipy.spatial import cKDTree

from semcal_ros.core.arrays import Array, Image, Mask
from semcal_ros.core.camera.plane_geometry import rotations_from_vectors
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import did_you_mean
from semcal_ros.synthetic.detector import Detector
from semcal_ros.synthetic.drift import NO_DRIFT, DriftFunction
from semcal_ros.synthetic.microscope import VirtualMicroscope, preset
from semcal_ros.synthetic.plans import parameters_of
from semcal_ros.synthetic.render import RayLattice, trace_ray_lattice
from semcal_ros.synthetic.thresholds import (
    BALL_MARGIN_M,
    BALL_SAMPLES,
    BODY_ROOM,
    BODY_STEPS,
    BODY_TILE,
    GRAIN_VOXELS,
)

#: Statistics of the texture: noise of two grain sizes; Voronoi cells, each of one brightness; bright cells
#: with dark seams; a narrow band of wavelengths; bright spots on a dark ground.
TEXTURES = ("noise", "islands", "cracks", "speckle", "spots")

__all__ = [
    "BALL_TRUTH_SCHEMA",
    "BallFrame",
    "BallOnTip",
    "BallPlan",
    "Turning",
    "ball_microscope",
    "ball_plan",
    "draw_ball_plan",
]

#: Magnifications of section 4.4 of Malti et al. (2012).
BALL_MAGNIFICATIONS = tuple(9000.0 + 100.0 * step for step in range(11))


BALL_TRUTH_SCHEMA = "semcal_ros/ball_truth/1"


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


@dataclass(frozen=True)
class Turning:
    """How the manipulator moves the ball.

    Parameters
    ----------
    duration_s
        Duration of one period of the whole movement, s.
    roll_rad, yaw_rad
        Amplitudes of the turn about the tip's axis and about y.
    rolls, yaws
        Number of their periods in this time; they differ, so that the directions fill an area.
    travel_m
        Amplitude of the remaining shift, x, y and z.
    centre_m
        (3,) mean place of the ball in the sem frame.
    mount_rad
        (3,) rotation vector that turns tip and axes from x and y to where they are.
    wobble_rad
        Amplitude of a slow turn about the third axis.
    off_centre_m
        (3,) of the ball's centre from the point on the axes about which the manipulator turns, in the
        body frame.
    """

    duration_s: float
    roll_rad: float = math.radians(35.0)
    yaw_rad: float = math.radians(15.0)
    rolls: float = 2.0
    yaws: float = 3.0
    travel_m: tuple[float, float, float] = (0.25e-6, 0.12e-6, 0.4e-6)
    centre_m: tuple[float, float, float] = (3.4e-6, 0.0, 8e-6)
    mount_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    wobble_rad: float = 0.0
    off_centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def pose_at(self, time_s: Array) -> tuple[Array, Array]:
        """(n, 3, 3) sem_from_body and (n, 3) places in m at times (n,)."""
        turn = 2.0 * np.pi * np.asarray(time_s, dtype=np.float64) / self.duration_s
        zero = np.zeros_like(turn)
        roll = self.roll_rad * np.sin(self.rolls * turn)
        yaw = self.yaw_rad * np.sin(self.yaws * turn + 0.7)
        about_x = rotations_from_vectors(np.stack([roll, zero, zero], axis=1))
        about_y = rotations_from_vectors(np.stack([zero, yaw, zero], axis=1))
        third = self.wobble_rad * np.sin(1.3 * turn + 0.4)
        about_z = rotations_from_vectors(np.stack([zero, zero, third], axis=1))
        mount = rotations_from_vectors(np.array([self.mount_rad]))[0]
        rotation = mount @ about_z @ about_y @ about_x
        phases = np.stack([np.sin(turn + 0.3), np.sin(2.0 * turn + 1.1), np.cos(turn)], axis=1)
        swing = (rotation - mount) @ np.array(self.off_centre_m)
        return rotation, np.array(self.centre_m) + phases * np.array(self.travel_m) + swing


@dataclass(frozen=True)
class BallFrame:
    """One frame: its start time, s, and its magnification."""

    start_time_s: float
    magnification: float


@dataclass(frozen=True, eq=False)
class BallPlan:
    """A recording of the ball; frames are rendered one at a time and do not depend on each other.

    Attributes
    ----------
    microscope, specimen, motion, drift, detector, seed
        What is recorded.
    frames
        Start times and magnifications.
    """

    microscope: VirtualMicroscope
    specimen: BallOnTip
    motion: Callable[[Array], tuple[Array, Array]]
    frames: tuple[BallFrame, ...]
    drift: DriftFunction
    detector: Detector
    seed: int

    def __len__(self) -> int:
        return len(self.frames)

    def pose_at(self, time_s: Array) -> tuple[Array, Array]:
        """(n, 3, 3) sem_from_body and (n, 3) m, drift included."""
        rotation, place = self.motion(time_s)
        place = place.copy()
        place[:, :2] += np.asarray(self.drift(time_s), dtype=np.float64).reshape(-1, 2)
        return rotation, place

    def render(self, index: int) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """(height + databar_rows, width) image of a frame, every line at its own time."""
        frame = self.frames[index]
        pad = self.detector.pad_px
        rays = trace_ray_lattice(self.microscope, float(frame.magnification), BALL_SAMPLES, pad)
        seen = self._reflectivity(rays, frame.start_time_s)
        return self.detector.expose(seen, np.random.default_rng((self.seed, index)))

    def _reflectivity(self, rays: RayLattice, start_time_s: float) -> Image:
        camera, pad = rays.camera, rays.pad
        shape = (camera.height + 2 * pad, camera.width + 2 * pad)
        total = self._draw_substrate(rays, start_time_s, shape)
        box = self._box(rays, start_time_s)
        if box is None:
            return total
        (top, bottom), (left, right) = box
        lines = slice(top * BALL_SAMPLES, bottom * BALL_SAMPLES)
        basis = rays.basis[:, left * BALL_SAMPLES : right * BALL_SAMPLES]
        x, y = rays.x_m[lines] @ basis, rays.y_m[lines] @ basis
        left_s, right_s = _compute_line_times(rays, self.microscope.timing)
        rotation, place = self.pose_at(start_time_s + 0.5 * (left_s + right_s)[lines])
        yields = _compute_yield(self.specimen, x, y, camera.rho, rotation, place)
        bare = ~np.isfinite(yields)
        if self.specimen.substrate_contrast == 0.0:
            yields[bare] = self.specimen.background
        else:
            drift = np.asarray(self.drift(start_time_s + 0.5 * (left_s + right_s)[lines]))
            line = np.nonzero(bare)[0]
            yields[bare] = self.specimen.substrate(
                x[bare] - drift[line, 0], y[bare] - drift[line, 1]
            )
        fine = yields.reshape(bottom - top, BALL_SAMPLES, right - left, BALL_SAMPLES)
        total[top:bottom, left:right] = fine.mean(axis=(1, 3))
        if self.specimen.charging:
            total = _darken_lines(total, self.specimen, float(np.mean(camera.pixel_size_m)))
        return total

    def _draw_substrate(
        self, rays: RayLattice, start_time_s: float, shape: tuple[int, int]
    ) -> Image:
        """Draw what lies below, one sample per pixel: the box about the ball is drawn anew."""
        if self.specimen.substrate_contrast == 0.0:
            return np.full(shape, self.specimen.background, dtype=np.float32)
        left_s, right_s = _compute_line_times(rays, self.microscope.timing)
        drift = np.asarray(self.drift(start_time_s + 0.5 * (left_s + right_s)))[::BALL_SAMPLES]
        basis = rays.basis[:, ::BALL_SAMPLES]
        x = rays.x_m[::BALL_SAMPLES] @ basis - drift[:, :1]
        y = rays.y_m[::BALL_SAMPLES] @ basis - drift[:, 1:]
        return np.asarray(self.specimen.substrate(x, y), dtype=np.float32)

    def _box(
        self, rays: RayLattice, start_time_s: float
    ) -> tuple[tuple[int, int], tuple[int, int]] | None:
        """Return the rows and columns (padded) outside which there is only background."""
        timing, body = self.microscope.timing, self.specimen
        times = start_time_s + np.linspace(0.0, timing.acquisition_time_s, 3)
        corners = []
        for reach in np.linspace(0.0, body.tip_length_m, 9):
            wide = body.tip_radius_m + body.tip_slope * reach
            wide = body.reach_m if reach == 0.0 else wide
            corners.append(np.array([reach, 0.0, 0.0]) + wide * _CUBE)
        rotation, place = self.pose_at(times)
        sem = np.einsum("tij,nj->tni", rotation, np.concatenate(corners)) + place[:, None]
        camera = rays.camera
        xy = camera.project_ideal(sem.reshape(-1, 3))
        # Distortion moves the field by a few per cent, its middle hardly at all.
        low, high = xy.min(axis=0), xy.max(axis=0)
        size = np.array([camera.width, camera.height])
        margin = 4.0 + 0.03 * size[0]
        first = np.clip(np.floor(low - margin), -rays.pad, size + rays.pad).astype(int)
        last = np.clip(np.ceil(high + margin), -rays.pad, size + rays.pad).astype(int)
        if np.any(last <= first):
            return None
        first, last = first + rays.pad, last + rays.pad
        return (int(first[1]), int(last[1])), (int(first[0]), int(last[0]))

    def truth(self) -> dict[str, Any]:
        """What the recording shows, as plain values for a file beside it; SI units.

        Rotations and places are those at the centre of the acquisition: ``X = rotation x +
        translation_m``, drift included.
        """
        timing, microscope = self.microscope.timing, self.microscope
        times = np.array([f.start_time_s for f in self.frames]) + timing.centre_offset_s
        rotation, place = self.pose_at(times)
        return {
            "schema": BALL_TRUTH_SCHEMA,
            "microscope": microscope.name,
            "image_width_px": microscope.width,
            "image_height_px": microscope.height,
            "display_width_m": microscope.display_width_m,
            "scan": {
                "frame_time_s": timing.frame_time_s,
                "averages": timing.averages,
                "flyback_fraction": timing.flyback_fraction,
            },
            "ball_diameter_m": self.specimen.diameter_m,
            "stretch": list(self.specimen.stretch),
            "bump_m": self.specimen.bump_m,
            "bump_towards": list(self.specimen.bump_towards),
            "tip_radius_m": self.specimen.tip_radius_m,
            "tip_slope": self.specimen.tip_slope,
            "frames": [
                {
                    "start_time_s": frame.start_time_s,
                    "magnification": frame.magnification,
                    "rotation": turned.tolist(),
                    "translation_m": moved.tolist(),
                }
                for frame, turned, moved in zip(self.frames, rotation, place, strict=True)
            ],
            "parameters": [
                parameters_of(microscope, g) for g in sorted({f.magnification for f in self.frames})
            ],
        }


# Corners of the cube from -1 to 1, (8, 3).
_CUBE = np.array([[a, b, c] for a in (-1.0, 1.0) for b in (-1.0, 1.0) for c in (-1.0, 1.0)])


def _compute_line_times(rays: RayLattice, timing: ScanTiming) -> tuple[Array, Array]:
    """Mean times over the passes, after the stamp, at both ends of every line of samples."""
    rows = np.rint(rays.lines)
    size = (rays.camera.height, rays.camera.width)
    return (
        timing.pixel_offset_s(rows, 0.0, *size),
        timing.pixel_offset_s(rows, rays.camera.width - 1.0, *size),
    )


def _compute_yield(
    body: BallOnTip, x: Array, y: Array, rho: float, rotation: Array, place: Array
) -> Array:
    """Reflectivity (lines, columns) of rays through (x, y) at height 0, one pose per line; NaN where
    they miss the body.
    """
    out = np.full(x.shape, np.nan)
    line, column = np.nonzero(_find_near(body, x, y, rho, rotation, place))
    x, y = x[line, column], y[line, column]
    origin = np.stack([x, y, np.zeros_like(x)], axis=1) - place[line]
    direction = np.stack([rho * x, rho * y, np.ones_like(x)], axis=1)
    turn = rotation[line]
    # Transposed: body_from_sem.
    origin = np.einsum("nji,nj->ni", turn, origin)
    direction = np.einsum("nji,nj->ni", turn, direction)
    along, normal = body.meet(origin, direction)
    hit = np.isfinite(along)
    unit = direction[hit] / np.linalg.norm(direction[hit], axis=1)[:, None]
    cosine = np.maximum(-np.sum(unit * normal[hit], axis=1), body.least_cosine)
    at = origin[hit] + along[hit, None] * direction[hit]
    bright = body.reflectivity * body.texture(at) / cosine**body.slope_power
    if body.detector_side != (0.0, 0.0):
        across = np.einsum("nij,nj->ni", turn[hit][:, :2], normal[hit])
        bright *= np.maximum(1.0 + across @ np.array(body.detector_side), 0.0)
    # The bright limb levels off below the full yield.
    out[line[hit], column[hit]] = np.minimum(bright, body.most_yield)
    return out


def _darken_lines(image: Image, body: BallOnTip, pixel_m: float) -> Image:
    """Darken every line after bright parts: charge that the beam has left behind and that leaks away."""
    keep = math.exp(-pixel_m / body.charging_length_m)
    charge = lfilter([1.0 - keep], [1.0, -keep], image - body.background, axis=1)
    return np.asarray(np.maximum(image - body.charging * charge, 0.0), dtype=np.float32)


def _find_near(
    body: BallOnTip, x: Array, y: Array, rho: float, rotation: Array, place: Array
) -> Mask:
    """Find the rays that can meet the body, by the distance from its outline in parallel projection."""
    w = (1.0 + rho * place[:, 2])[:, None]
    dx, dy = x - place[:, :1] / w, y - place[:, 1:2] / w
    axis = rotation[:, :2, 0]
    length = np.maximum(np.linalg.norm(axis, axis=1), 1e-6)[:, None]
    along = (dx * axis[:, :1] + dy * axis[:, 1:]) / length
    across = np.abs(dx * axis[:, 1:] - dy * axis[:, :1]) / length
    radius = body.tip_radius_m + body.tip_slope * np.maximum(along, 0.0) / length
    tip = (across < radius + BALL_MARGIN_M) & (along > -radius)
    ball = dx * dx + dy * dy < (body.reach_m + BALL_MARGIN_M) ** 2
    return np.asarray(ball | (tip & (along < body.tip_length_m * length + radius)))


def ball_microscope(
    name: str = "jsm820", width: int = 2048, height: int = 320
) -> VirtualMicroscope:
    """A preset that scans a strip of its field, ten frames per second.

    At 9000x the field of the JSM-820 is 13.3 um wide: 512 px would show the ball 35 px across, which is too
    few for some hundred points. 2048 px show it at 138 px (6.5 nm per px). A reduced raster of 320 lines
    leaves a pixel 140 ns at 10 frames/s; a square one would leave 22 ns.
    """
    timing = ScanTiming(0.1, 1, 0.1)
    return preset(name).with_image_size(width, height).with_timing(timing)


def ball_plan(
    microscope: VirtualMicroscope | None = None,
    *,
    frames: int = 2000,
    interval_s: float | None = None,
    magnifications: tuple[float, ...] = BALL_MAGNIFICATIONS,
    specimen: BallOnTip | None = None,
    motion: Turning | None = None,
    drift: DriftFunction = NO_DRIFT,
    detector: Detector | None = None,
    seed: int = 0,
) -> BallPlan:
    """Plan the recording of section 4.4 of Malti et al. (2012): a 900 nm ball from 9000x to 10 000x.

    The magnification rises in equal parts of the recording; the movement fills its duration once. Without
    ``interval_s`` there is no pause between frames.

    Raises
    ------
    InvalidValueError
        For fewer frames than magnifications.
    """
    if frames < max(len(magnifications), 1):
        raise InvalidValueError(f"{frames} frames", expected=f"at least {len(magnifications)}")
    used = microscope or ball_microscope()
    period_s = used.timing.acquisition_time_s if interval_s is None else interval_s
    planned = tuple(
        BallFrame(period_s * k, float(magnifications[k * len(magnifications) // frames]))
        for k in range(frames)
    )
    path = motion or Turning(frames * period_s)
    # 100 pA for 140 ns are some 90 electrons.
    exposed = detector or Detector(electrons=90.0)
    return BallPlan(
        used, specimen or BallOnTip(seed=seed), path.pose_at, planned, drift, exposed, seed
    )


def draw_ball_plan(
    seed: int,
    *,
    frames: int = 100,
    pixel_m: float = 6.5e-9,
    grain_m: float | None = None,
    drift: DriftFunction = NO_DRIFT,
    **given: Any,
) -> BallPlan:
    """Draw a recording whose texture, grains, limb, detector, charging, substrate, tip and axes are random.

    Parameters
    ----------
    seed
        Of all that is drawn.
    frames
        Number of frames; their magnification rises by 2 % in the middle of the recording.
    pixel_m
        Pixel size, m; the frame has just room for the ball and its movement.
    grain_m
        Size of the grains; between 15 and 60 nm by default, but not less than 2.5 pixels.
    drift
        Drift of the specimen.
    given
        Fields of the specimen (:class:`.BallOnTip`) that are not drawn.
    """
    rng = np.random.default_rng([seed, 900])
    grain = float(np.exp(rng.uniform(np.log(15e-9), np.log(60e-9))))
    grain = max(grain, 2.5 * pixel_m) if grain_m is None else grain_m
    texture = TEXTURES[int(rng.integers(len(TEXTURES)))]
    side = rng.uniform(0.0, 0.25)
    azimuth = rng.uniform(0.0, 2.0 * np.pi)
    drawn: dict[str, Any] = {
        "texture_name": texture,
        "contrast": float(rng.uniform(0.2, 0.4)),
        "slope_power": float(rng.uniform(0.5, 1.2)),
        "least_cosine": float(rng.uniform(0.05, 0.25)),
        "detector_side": (float(side * np.cos(azimuth)), float(side * np.sin(azimuth))),
        "charging": float(rng.choice([0.0, rng.uniform(0.0, 0.2)])),
        "substrate_contrast": float(rng.choice([0.0, rng.uniform(0.1, 0.25)])),
        "tip_length_m": float(rng.choice([0.0, 5e-6])),
        "tip_radius_m": float(rng.uniform(50e-9, 120e-9)),
    } | given
    name = drawn["texture_name"]
    # The noise has its smaller grains some 3 voxels wide, the larger ones 6.
    specimen = BallOnTip(grain_m=grain / 4.0 if name == "noise" else grain, seed=seed, **drawn)
    mount = np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.3, 0.3), rng.uniform(-np.pi, np.pi)])
    off = rng.uniform(-120e-9, 120e-9, 2)
    interval_s = 2.0
    motion = Turning(
        frames * interval_s,
        roll_rad=math.radians(rng.uniform(28.0, 42.0)),
        yaw_rad=math.radians(rng.uniform(10.0, 22.0)),
        rolls=1.0,
        yaws=float(rng.choice([1.0, 2.0])),
        travel_m=(60e-9, 50e-9, 400e-9),
        centre_m=(0.0, 0.0, float(rng.normal(0.0, 10e-6))),
        mount_rad=(float(mount[0]), float(mount[1]), float(mount[2])),
        wobble_rad=math.radians(rng.uniform(0.0, 6.0)),
        off_centre_m=(0.0, float(off[0]), float(off[1])),
    )
    side_px = 16 * math.ceil((specimen.diameter_m + 0.55e-6) / pixel_m / 16.0)
    microscope = ball_microscope(width=side_px, height=side_px)
    magnification = microscope.display_width_m / side_px / pixel_m
    return ball_plan(
        microscope,
        frames=frames,
        interval_s=interval_s,
        magnifications=(magnification, 1.02 * magnification),
        specimen=specimen,
        motion=motion,
        drift=drift,
        detector=Detector(electrons=float(rng.uniform(80.0, 300.0)), noise=0.01),
        seed=seed,
    )
