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

"""Ladders of grains with known truth: from the generator that shares no code with the method."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np

from benchmarks.calibration.grains import Grains, Scope, draw_scope, take_picture
from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.ladder.matching import LadderPicture
from semcal_ros.synthetic.stage import grid_views
from tests.helpers.made_once import made_once

__all__ = [
    "REPEATABILITY",
    "SIZE",
    "Disturbance",
    "aligned_rms_px",
    "calibration_of",
    "camera_at",
    "ladder_of",
    "make_scope",
    "place_in",
    "take",
]

SIZE = 256
#: Relative 1-sigma of the scale of a visit.
REPEATABILITY = 2e-4
_GRAINS = Grains(3)


@cache
def make_scope(seed: int = 1, relay: tuple[float, float] | None = None) -> Scope:
    """A microscope."""
    return draw_scope(np.random.default_rng([seed, 7]), SIZE, relay)


def camera_at(scope: Scope, g: float) -> ScanCamera:
    """Its camera in the terms of the package."""
    mx, my, skew, radial, tangential, ex, ey = scope.law(g)
    m, middle = math.sqrt(mx * my), 0.5 * (scope.width - 1)
    values = (m, math.sqrt(mx / my), skew / m, middle, middle, 50.0, radial, tangential, ex, ey)
    return ScanCamera(g, *values, 0.5 * scope.width, scope.width, scope.height)


@cache
def calibration_of(scope: Scope) -> CalibrationModel:
    """Its calibration by a grid up to 8000x."""
    rng = np.random.default_rng(5)
    views = []
    # Every magnification is visited twice, so that the calibration knows how repeatable it is.
    for visit, g in enumerate((1000.0, 2000.0, 4000.0, 8000.0) * 2):
        camera = camera_at(scope, g)
        back = replace(camera, m=camera.m * (1.0 + REPEATABILITY * float(rng.normal())))
        seen = grid_views(
            partial(_same, back), [g], views=5, noise_px=0.05, square_px=25.0, seed=visit
        )
        views += [replace(view, visit=visit) for view in seen]
    size = (scope.width, scope.height)
    numbers = [scope.display_m, *scope.law(1000.0), *scope.law(8000.0)]
    name = hashlib.sha256(repr(numbers).encode()).hexdigest()[:16]
    return made_once(
        f"ladder-{name}",
        lambda: calibrate_views(views, image_size=size, display_width_m=scope.display_m).model,
    )


def _same(camera: ScanCamera, _magnification: float) -> ScanCamera:
    return camera


def take(
    scope: Scope,
    g: float,
    place: tuple[float, float] = (0.0, 0.0),
    turn_rad: float = 0.0,
    *,
    seed: int = 0,
    drift_m: Sequence[float] = (0.0, 0.0),
    grains: Grains = _GRAINS,
    visit_scale: float = 1.0,
) -> np.ndarray:
    """A picture at a place in fields of view; ``drift_m`` is the drift during a frame."""
    field = scope.display_m / g
    return take_picture(
        scope,
        grains,
        g,
        at_m=(field * place[0], field * place[1]),
        turn_rad=turn_rad,
        drift_m=lambda t: np.outer(t / scope.frame_s, drift_m),
        start_s=0.0,
        rng=np.random.default_rng([seed, 1]),
        visit_scale=visit_scale,
    )


#: Where the beam lands (n,) x and y, m, when it should land at x and y: of a picture by its number, and by the place
#: (x, y) of the specimen on the axis, m.
Disturbance = Callable[[int, tuple[float, float], Array, Array], tuple[Array, Array]]


@dataclass(frozen=True)
class Disturbed(Grains):
    """Grains that are seen elsewhere."""

    landing: Callable[[Array, Array], tuple[Array, Array]] | None = None

    def brightness(self, x: Array, y: Array, beam_m: float) -> Array:
        """As of all grains."""
        assert self.landing is not None
        return super().brightness(*self.landing(x, y), beam_m)


def ladder_of(
    scope: Scope,
    magnifications: Sequence[float],
    seed: int = 0,
    *,
    turned: bool = True,
    disturb: Disturbance | None = None,
    grains: Grains = _GRAINS,
) -> list[LadderPicture]:
    """Three pictures at each magnification, of which the last one is turned."""
    rng = np.random.default_rng([seed, 2])
    pictures = []
    for number, g in enumerate(magnifications):
        visited = 1.0 + REPEATABILITY * float(rng.normal())
        for k, move in enumerate([(0.0, 0.0), (0.22, 0.1), (-0.05, 0.2)]):
            turn = 0.5 * math.pi * (-1.0) ** number if turned and k == 2 else 0.0
            place = np.array(move) + rng.normal(0.0, 0.02, 2)
            where = float(place[0]), float(place[1])
            seen = grains
            if disturb is not None:
                field = scope.display_m / g
                axis = field * where[0], field * where[1]
                landing = partial(disturb, len(pictures), axis)
                seen = Disturbed(grains.seed, grains.sigmas_m, landing=landing)
            image = take(
                scope,
                g,
                where,
                turn + float(rng.normal(0.0, 0.002)),
                seed=seed * 100 + len(pictures),
                visit_scale=visited,
                drift_m=(rng.normal(0.0, 0.3, 2) * scope.display_m / g / SIZE).tolist(),
                grains=seen,
            )
            pictures.append(LadderPicture(image, float(g), f"{g:.0f}x/{k}", turn))
    return pictures


def place_in(
    scope: Scope, g: float, place: tuple[float, float], turn_rad: float, xy: Array
) -> Array:
    """Places on the specimen, m, of raw pixels (n, 2)."""
    x, y = scope.metres(g, xy[:, 0], xy[:, 1])
    c, s, field = math.cos(turn_rad), math.sin(turn_rad), scope.display_m / g
    return np.stack([c * x + s * y + field * place[0], -s * x + c * y + field * place[1]], axis=1)


def aligned_rms_px(model: CalibrationModel, scope: Scope, g: float) -> float:
    """RMS distance, px, of a model from the truth after the best shift, turn and scale."""
    x, y = np.meshgrid(np.linspace(5, SIZE - 6, 9), np.linspace(5, SIZE - 6, 9))
    xy = np.stack([x.ravel(), y.ravel()], axis=1)
    camera = model.at(g)
    found = camera.sem_from_ideal(camera.undistort(xy))[:, :2] @ [1.0, 1j]
    truth = np.stack(scope.metres(g, *xy.T), axis=1) @ [1.0, 1j]
    found, truth = found - found.mean(), truth - truth.mean()
    factor = np.vdot(truth, found) / np.vdot(truth, truth)
    return float(np.sqrt(np.mean(np.abs(found - factor * truth) ** 2))) * camera.m
