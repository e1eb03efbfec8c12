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

:func:`ball_plan` records one look; :func:`draw_ball_plan` draws another for every seed.

Every sample of a frame is a ray of the true camera, distortion included, that meets the ball or the tip where they are
when its line is scanned. The yield grows with the slope as that of secondary electrons does, so the limb is bright and
the shading stays while the texture turns with the ball.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from semcal_ros.core.arrays import Array, Image, Mask
from semcal_ros.core.camera.plane_geometry import rotations_from_vectors
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic.detector import Detector
from semcal_ros.synthetic.drift import NO_DRIFT, DriftFunction
from semcal_ros.synthetic.microscope import VirtualMicroscope
from semcal_ros.synthetic.presets import preset
from semcal_ros.synthetic.specimens.ball_body import TEXTURES, BallOnTip
from semcal_ros.synthetic.specimens.ray_lattice import RayLattice, trace_ray_lattice
from semcal_ros.synthetic.specimens.thresholds import BALL_MARGIN_M, BALL_SAMPLES
from semcal_ros.synthetic.truth import parameters_of

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
