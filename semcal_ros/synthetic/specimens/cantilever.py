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

"""A cantilever that is pushed sideways, after section 4.3 of Malti et al. (2012).

A beam leaves a holder and ends over a textured background. A plane comes from one side, pushes its
end and is drawn back, while the specimen as a whole drifts. Coordinates of the scene: the base is
the origin, the beam at rest lies along +x, and the pusher moves it towards +y, or towards -y if it
comes from there. Beams, substrates and pushes of many looks can be drawn at random, so that nothing is tuned to one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic.detector import Detector
from semcal_ros.synthetic.drift import NO_DRIFT, Drift, DriftFunction
from semcal_ros.synthetic.microscope import VirtualMicroscope
from semcal_ros.synthetic.pose import Pose
from semcal_ros.synthetic.render import render_frame
from semcal_ros.synthetic.specimens.gold import GoldOnCarbon
from semcal_ros.synthetic.specimens.substrate import SUBSTRATES, Substrate
from semcal_ros.synthetic.thresholds import (
    CANTILEVER_MAGNIFICATIONS,
    CANTILEVER_PUSHES,
    FREE_GAP_M,
)

#: Names of the outlines of a free end.
TIPS = ("square", "semicircular", "tapered", "chamfered")


@dataclass(frozen=True)
class BeamTip:
    """The outline of the free end: a facet across the axis, and a flank from either of its ends to the sides.

    The length of the beam runs to the facet, or to the apex where there is none.

    Parameters
    ----------
    length_m
        How far from the end the beam begins to narrow; zero for a square end.
    facet
        Width of the facet, as a fraction of the width of the beam.
    flank
        ``"straight"``: a taper, or chamfered corners. ``"elliptic"``: a quarter of an ellipse, so that
        a tip without a facet and half a width long is a semicircle.
    """

    length_m: float = 0.0
    facet: float = 1.0
    flank: Literal["straight", "elliptic"] = "straight"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.length_m) and self.length_m >= 0.0 and 0.0 <= self.facet <= 1.0):
            raise InvalidValueError(
                f"a tip of {self.length_m} m with a facet of {self.facet} widths",
                expected="a length from zero and a facet of 0 to 1",
            )

    def distance(self, before_end: Array, across: Array, width_m: float) -> Array | None:
        """Return the distance, positive outside, from the flanks; None for a square end.

        Parameters
        ----------
        before_end, across
            Distance from the end towards the base, and from the centre line, m.
        """
        facet_m = 0.5 * self.facet * width_m
        depth_m = 0.5 * width_m - facet_m
        if self.length_m <= 0.0 or depth_m <= 0.0:
            return None
        if self.flank == "straight":
            away = (across - facet_m) * self.length_m - before_end * depth_m
            return np.asarray(away / math.hypot(self.length_m, depth_m))
        # Measured from where the ellipses meet the straight sides; before it and between them nothing is cut off.
        u = np.maximum(1.0 - before_end / self.length_m, 0.0)
        v = np.maximum((across - facet_m) / depth_m, 0.0)
        radius = np.maximum(np.hypot(u, v), 1e-9)
        # To first order in the distance; exact for circles.
        slope = np.hypot(u / self.length_m, v / depth_m) / radius
        return np.asarray((radius - 1.0) / np.maximum(slope, 1e-3 / self.length_m))


SQUARE_TIP = BeamTip()


@dataclass(frozen=True)
class Charging:
    """What charge does to the brightness of an insulating specimen.

    Parameters
    ----------
    gradient_per_m
        (x, y) relative change of the brightness along the specimen; it levels off at one half.
    halo, halo_m
        By how much the ground is brighter right beside a body (darker if negative: the shadow of a
        high one), in reflectivity, and how far that reaches.
    """

    gradient_per_m: tuple[float, float] = (0.0, 0.0)
    halo: float = 0.0
    halo_m: float = 1e-6

    def __post_init__(self) -> None:
        if not (
            self.halo_m > 0.0
            and math.isfinite(self.halo)
            and all(map(math.isfinite, self.gradient_per_m))
        ):
            raise InvalidValueError(f"{self}", expected="finite numbers and a positive halo_m")

    def shade(self, x_m: Array, y_m: Array) -> Array:
        """Return the factor of the brightness at points of the specimen."""
        slope = self.gradient_per_m[0] * x_m + self.gradient_per_m[1] * y_m
        return np.asarray(1.0 + 0.5 * np.tanh(2.0 * slope))


NO_CHARGING = Charging()


@dataclass(frozen=True)
class CantileverScene:
    """The beam, its holder, the pusher and the background at one moment.

    Parameters
    ----------
    length_m, width_m
        Of the beam as it is seen.
    deflection_m
        Of the end of the beam, towards +y.
    shape
        ``"beam"``: a clamped beam that is loaded where the pusher begins, or at its end if that is
        farther out (Euler and Bernoulli: ``3 a u^2 - u^3`` up to the load at a, straight beyond);
        ``"parabola"``: ``u^2``. u is the arc length over the length.
    gap_m
        Distance of the pusher from the beam; None takes the pusher away.
    pusher_m
        First and last arc length under the pusher.
    beam, holder, pusher, background
        Reflectivities; that of the background is the largest of its texture of gold on carbon.
    rim, rim_m
        By how much the edges are brighter than the rest, and how far that reaches.
    seed
        Of the texture.
    tip
        Outline of the free end.
    substrate
        What lies behind the beam, in place of gold on carbon.
    charging
        Slow changes of the brightness.
    push_direction
        1: the pusher comes from -y and bends the beam towards +y; -1: the other way round.
    """

    length_m: float = 35e-6
    width_m: float = 3.5e-6
    deflection_m: float = 0.0
    shape: Literal["beam", "parabola"] = "beam"
    gap_m: float | None = None
    pusher_m: tuple[float, float] = (33.2e-6, 38e-6)
    beam: float = 0.72
    holder: float = 0.6
    pusher: float = 0.5
    background: float = 0.3
    rim: float = 0.12
    rim_m: float = 150e-9
    seed: int = 0
    tip: BeamTip = SQUARE_TIP
    substrate: Substrate | None = None
    charging: Charging = NO_CHARGING
    push_direction: Literal[1, -1] = 1

    def __post_init__(self) -> None:
        sizes = (self.length_m, self.width_m, self.rim_m)
        if not (
            all(math.isfinite(s) and s > 0 for s in sizes) and math.isfinite(self.deflection_m)
        ):
            raise InvalidValueError(
                f"a cantilever of {self.length_m} x {self.width_m} m",
                expected="finite sizes above 0",
            )
        if abs(self.deflection_m) > 0.1 * self.length_m:
            raise InvalidValueError(
                f"a deflection of {self.deflection_m} m", expected="at most a tenth of the length"
            )
        if self.push_direction not in (1, -1):
            raise InvalidValueError(f"a push towards {self.push_direction}", expected="1 or -1")

    @property
    def supersampling(self) -> int:
        """One: edges and texture are filtered to the size of a pixel."""
        return 1

    @property
    def load(self) -> float:
        """Where the pusher touches, as a fraction of the length."""
        return min(max(self.pusher_m[0] / self.length_m, 0.1), 1.0)

    def bending(self, u: Array) -> Array:
        """Deflection at fractions of the length relative to that of the end; straight beyond it."""
        inside = np.clip(u, 0.0, 1.0)
        beyond = np.maximum(u - 1.0, 0.0)
        if self.shape == "parabola":
            return np.asarray(inside**2 + 2.0 * beyond)
        a = self.load
        # Beyond the load the slope is constant.
        whole = 3.0 * a - 1.0 + (1.0 - a) ** 3
        deflection = 3.0 * a * inside**2 - inside**3 + np.maximum(inside - a, 0.0) ** 3
        return np.asarray((deflection + 3.0 * a**2 * beyond) / whole)

    @property
    def end_x_m(self) -> float:
        """Position of the end along the axis at rest: the arc length is conserved."""
        u = np.linspace(0.0, 1.0, 401)
        slope = np.gradient(self.bending(u), u)
        share = 0.5 * float(np.mean(slope[:-1] ** 2 + slope[1:] ** 2)) / 2.0
        return self.length_m - share * self.deflection_m**2 / self.length_m

    def reflectivity(self, x_m: Array, y_m: Array, footprint_m: Array) -> NDArray[np.floating]:
        """See :class:`~semcal_ros.synthetic.specimens.grid.Specimen`."""
        seen = self._draw_ground(x_m, y_m, footprint_m)
        x_width, y_width = np.hypot(footprint_m[:, 0], footprint_m[:, 1])
        line = self.deflection_m * self.bending(x_m / self.end_x_m)
        across, before_end = np.abs(y_m - line), self.end_x_m - x_m
        cover = _soften_edge(across - 0.5 * self.width_m, y_width)
        cover *= _soften_edge(-before_end, x_width)
        inside = np.minimum(0.5 * self.width_m - across, before_end)
        flank = self.tip.distance(before_end, across, self.width_m)
        if flank is not None:
            # Not the product: the flank of a round tip goes on as the straight side.
            cover = np.minimum(cover, _soften_edge(flank, math.sqrt(x_width * y_width)))
            inside = np.minimum(inside, -flank)
        if self.charging.halo != 0.0:
            outside = np.maximum(np.minimum(-inside, x_m), 0.0)
            seen += self.charging.halo * np.exp(-outside / self.charging.halo_m)
            np.maximum(seen, 0.0, out=seen)
        self._lay(seen, self.beam, [cover], inside)
        # The beam continues inside the holder, so that no seam is visible.
        self._lay(seen, self.holder, [_soften_edge(x_m, x_width)], -x_m)
        if self.gap_m is not None:
            self._lay_pusher(seen, x_m, y_m, x_width, y_width)
        if self.charging.gradient_per_m != (0.0, 0.0):
            seen *= self.charging.shade(x_m, y_m)
        return seen

    def _draw_ground(self, x_m: Array, y_m: Array, footprint_m: Array) -> Array:
        if self.substrate is not None:
            ground = self.substrate.reflectivity(x_m, y_m, footprint_m)
            return np.asarray(ground, dtype=np.float64)
        gold = GoldOnCarbon(self.seed, largest_m=6e-6, octaves=4)
        grains = np.asarray(gold.reflectivity(x_m, y_m, footprint_m), dtype=np.float64)
        return np.asarray(self.background * grains)

    def _lay_pusher(self, seen: Array, x: Array, y: Array, x_width: float, y_width: float) -> None:
        assert self.gap_m is not None
        first, last = self.pusher_m
        sign = float(self.push_direction)
        touched = self.deflection_m * float(self.bending(np.array([self.load]))[0])
        front = sign * touched - 0.5 * self.width_m - self.gap_m
        ahead = sign * y
        parts = [
            _soften_edge(ahead - front, y_width),
            _soften_edge(first - x, x_width),
            _soften_edge(x - last, x_width),
        ]
        inside = np.minimum(front - ahead, np.minimum(x - first, last - x))
        self._lay(seen, self.pusher, parts, inside)

    def _lay(self, seen: Array, level: float, parts: Sequence[Array], inside: Array) -> None:
        """Draw a bright shape over the image; ``inside`` is the distance from its edges."""
        cover = parts[0]
        for part in parts[1:]:
            cover = cover * part
        light = level + self.rim * np.exp(-np.maximum(inside, 0.0) / self.rim_m)
        seen *= 1.0 - cover
        seen += cover * light


def _soften_edge(distance: Array, width: float) -> Array:
    """1 where the distance is negative, averaged over a box of that width."""
    return np.asarray(np.clip(0.5 - distance / max(width, 1e-15), 0.0, 1.0))


@dataclass(frozen=True)
class CantileverFrame:
    """One frame of a bending experiment.

    Attributes
    ----------
    start_time_s
        Start of the first pass.
    magnification
        Magnification g.
    pose
        Number of the pose, from 0.
    scene
        The specimen.
    """

    start_time_s: float
    magnification: float
    pose: int
    scene: CantileverScene


@dataclass(frozen=True, eq=False)
class CantileverPlan:
    """A bending experiment to be recorded.

    Attributes
    ----------
    microscope, frames, drift, detector, seed
        What is recorded.
    placed
        The scene in the sem frame without drift, for each magnification.
    """

    microscope: VirtualMicroscope
    frames: tuple[CantileverFrame, ...]
    placed: dict[float, Pose]
    drift: DriftFunction
    detector: Detector = field(default_factory=Detector)
    seed: int = 0

    def __len__(self) -> int:
        return len(self.frames)

    def render(self, index: int) -> NDArray[np.uint8] | NDArray[np.uint16]:
        """Image of a frame; raises as :func:`~semcal_ros.synthetic.render.render_frame`."""
        frame = self.frames[index]
        return render_frame(
            self.microscope,
            frame.scene,
            self.placed[frame.magnification],
            frame.magnification,
            start_time_s=frame.start_time_s,
            drift=self.drift,
            seed=(self.seed, index),
            detector=self.detector,
        )

    def pixel_of(self, index: int, x_m: float, y_m: float = 0.0) -> Array:
        """(2,) raw pixel of a point of the scene in a frame, drift left out."""
        frame = self.frames[index]
        xyz = self.placed[frame.magnification].sem_from_specimen(np.array([[x_m, y_m]]))
        return self.microscope.project(frame.magnification, xyz)[0]

    def drift_at_centre_m(self, index: int) -> Array:
        """(2,) drift in m at the centre of a frame's acquisition."""
        centre = self.frames[index].start_time_s + self.microscope.timing.centre_offset_s
        return np.asarray(self.drift(np.array([centre])), dtype=np.float64).reshape(2)

    def truth(self) -> dict[str, Any]:
        """What the recording shows, as plain values in SI units."""
        return {
            "schema": "semcal_ros/cantilever_truth/1",
            "microscope": self.microscope.name,
            "display_width_m": self.microscope.display_width_m,
            "frames": [
                {
                    "start_time_s": frame.start_time_s,
                    "magnification": frame.magnification,
                    "pose": frame.pose,
                    "deflection_m": frame.scene.deflection_m,
                    "length_m": frame.scene.length_m,
                    "width_m": frame.scene.width_m,
                    "shape": frame.scene.shape,
                    "drift_m": self.drift_at_centre_m(index).tolist(),
                    "base_px": self.pixel_of(index, 0.0).tolist(),
                    "end_px": self.pixel_of(index, frame.scene.length_m).tolist(),
                }
                for index, frame in enumerate(self.frames)
            ],
        }


def cantilever_plan(
    microscope: VirtualMicroscope,
    *,
    scene: CantileverScene | None = None,
    magnifications: Sequence[float] = CANTILEVER_MAGNIFICATIONS,
    pushes: Sequence[float] = CANTILEVER_PUSHES,
    largest_deflection_m: float = 250e-9,
    frames_per_pose: int = 1,
    view: Literal["whole", "end", "base"] = "whole",
    rotation_rad: float = math.radians(-9.0),
    interval_s: float = 1.5,
    drift: DriftFunction = NO_DRIFT,
    detector: Detector | None = None,
    seed: int = 0,
) -> CantileverPlan:
    """Plan the experiment of the paper: in each pose, frames at all magnifications one after the other.

    Parameters
    ----------
    microscope
        What records it.
    scene
        The beam; its deflection and the gap of the pusher are set in each pose.
    magnifications, pushes, largest_deflection_m, frames_per_pose
        The poses: fractions of the largest deflection (towards the push direction of the scene), and
        frames of each at each magnification. At a fraction of 0 the pusher does not touch the beam.
    view
        What lies in the middle of the field: the middle of the beam, its last two thirds of a field
        with the end, or the first with the base.
    rotation_rad
        Of the beam in the image.
    interval_s
        Time from frame to frame; at least the acquisition time.
    drift, detector, seed
        As for other recordings.

    Raises
    ------
    InvalidValueError
        If there are no frames.
    """
    if frames_per_pose < 1 or not pushes or not magnifications:
        raise InvalidValueError("a bending experiment without frames", expected="at least one")
    base = scene or CantileverScene()
    step_s = max(interval_s, microscope.timing.acquisition_time_s)
    planned: list[CantileverFrame] = []
    for number, push in enumerate(pushes):
        gap = 0.0 if push > 0.0 else FREE_GAP_M
        deflection_m = push * base.push_direction * largest_deflection_m
        pushed = replace(base, deflection_m=deflection_m, gap_m=gap)
        for g in magnifications:
            for _ in range(frames_per_pose):
                planned.append(CantileverFrame(step_s * len(planned), float(g), number, pushed))
    placed = {
        float(g): _place_specimen(microscope, float(g), base, view, rotation_rad)
        for g in magnifications
    }
    return CantileverPlan(microscope, tuple(planned), placed, drift, detector or Detector(), seed)


def _place_specimen(
    microscope: VirtualMicroscope, g: float, scene: CantileverScene, view: str, turn: float
) -> Pose:
    field_m = microscope.nominal_pixel_size_m(g) * microscope.width
    along = {"whole": 0.5 * scene.length_m, "end": scene.length_m - 0.27 * field_m}
    middle = along.get(view, 0.3 * field_m)
    camera = microscope.camera_at(g)
    centre = 0.5 * np.array([[microscope.width - 1.0, microscope.height - 1.0]])
    seen = camera.sem_from_ideal(centre)[0, :2]
    c, s = math.cos(turn), math.sin(turn)
    at = seen - middle * np.array([c, s])
    return Pose.flat((float(at[0]), float(at[1]), 0.0), turn)


@dataclass(frozen=True)
class CantileverExperiment:
    """What is recorded, and how it is pushed and drifts.

    Attributes
    ----------
    tip, substrate
        Names, for tables.
    scene, largest_deflection_m, rotation_rad, drift
        As :func:`~semcal_ros.synthetic.specimens.cantilever.cantilever_plan` takes them.
    """

    tip: str
    substrate: str
    scene: CantileverScene
    largest_deflection_m: float
    rotation_rad: float
    drift: Drift

    @property
    def is_dark(self) -> bool:
        """Whether the beam is darker than the ground."""
        assert self.scene.substrate is not None
        return self.scene.beam < self.scene.substrate.level


def make_tip(name: str, width_m: float, rng: np.random.Generator) -> BeamTip:
    """Make a tip of a kind in :data:`TIPS` for a beam of a width; sizes are drawn where a kind has several."""
    if name == "semicircular":
        return BeamTip(0.5 * width_m, 0.0, "elliptic")
    if name == "tapered":
        return BeamTip(width_m * rng.uniform(0.4, 1.0), rng.uniform(0.15, 0.5))
    if name == "chamfered":
        cut = rng.uniform(0.12, 0.3)
        return BeamTip(cut * width_m, 1.0 - 2.0 * cut)
    return SQUARE_TIP


def random_cantilever(seed: int, *, base_in_view: bool = False) -> CantileverExperiment:
    """Draw an experiment.

    Tips, substrates and contrast take turns with the seed, so that ten seeds hold all of each; sizes,
    levels, texture, charging, direction and push are drawn. What is drawn is what published images of
    microcantilevers show: beams of 30 to 40 um by 2.5 to 4.5 um, pushed by 150 to 300 nm.

    Parameters
    ----------
    seed
        Seed, from 0.
    base_in_view
        Whether the holder will be in view. Without it there is no smooth substrate, on which nothing
        would show the drift.
    """
    rng = np.random.default_rng([seed, 816])
    kinds = SUBSTRATES if base_in_view else SUBSTRATES[:-1]
    # Four tips against five or four substrates: the shift keeps pairs from repeating.
    tip = TIPS[seed % len(TIPS)]
    kind = kinds[(seed + seed // len(kinds)) % len(kinds)]
    dark = seed % 3 == 2
    length_m, width_m = rng.uniform(30e-6, 40e-6), rng.uniform(2.5e-6, 4.5e-6)
    levels = _draw_dark(rng) if dark else _draw_bright(rng)
    contrast = rng.uniform(0.04, 0.1)
    size_m = float(np.exp(rng.uniform(*np.log([0.8e-6, 4e-6]))))
    outline = make_tip(tip, width_m, rng)
    # The pusher touches the straight side, just before the tip.
    touched = length_m - outline.length_m - rng.uniform(0.01, 0.05) * length_m
    turn = rng.uniform(0.0, 2.0 * math.pi)
    halo = rng.uniform(-0.06, 0.1)
    scene = CantileverScene(
        length_m=length_m,
        width_m=width_m,
        pusher_m=(touched, touched + rng.uniform(3e-6, 6e-6)),
        rim=levels["rim"],
        rim_m=rng.uniform(80e-9, 250e-9),
        beam=levels["beam"],
        holder=levels["holder"],
        pusher=levels["pusher"],
        tip=outline,
        substrate=Substrate(_kind(kind), levels["ground"], contrast, size_m, seed),
        charging=Charging(
            (5e3 * math.cos(turn), 5e3 * math.sin(turn)), halo, rng.uniform(0.3e-6, 1.5e-6)
        ),
        push_direction=1 if rng.uniform() < 0.5 else -1,
    )
    drift = Drift(
        velocity_m_s=tuple(rng.normal(0.0, 1e-9, 2)),
        settling_m=tuple(rng.normal(0.0, 80e-9, 2)),
        wander_m=12e-9,
        seed=seed,
    )
    pushed_m, rotation = rng.uniform(150e-9, 300e-9), rng.uniform(-math.pi, math.pi)
    return CantileverExperiment(tip, kind, scene, pushed_m, rotation, drift)


def _kind(name: str) -> Any:
    """Narrow a name to the literal that a substrate takes; the substrate checks it."""
    return name


def _draw_bright(rng: np.random.Generator) -> dict[str, float]:
    beam = rng.uniform(0.55, 0.8)
    return {
        "beam": beam,
        "holder": beam * rng.uniform(0.8, 1.1),
        "pusher": rng.uniform(0.4, 0.7),
        "ground": rng.uniform(0.1, 0.28),
        "rim": rng.uniform(0.05, 0.18),
    }


def _draw_dark(rng: np.random.Generator) -> dict[str, float]:
    """A light element on a heavy one: the rim of a dark beam is weak, or it would outshine the ground."""
    beam = rng.uniform(0.06, 0.16)
    return {
        "beam": beam,
        "holder": beam * rng.uniform(0.9, 1.5),
        "pusher": rng.uniform(0.1, 0.3),
        "ground": rng.uniform(0.55, 0.7),
        "rim": rng.uniform(0.0, 0.06),
    }
