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

"""The microscope of the reference recordings, whose truth is known, in the virtual SEM."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from semcal_ros.core.arrays import AnyImage
from semcal_ros.core.calibration.views import GridView
from semcal_ros.synthetic import Detector, VirtualMicroscope
from semcal_ros.synthetic.microscope import Constant, Law
from semcal_ros.synthetic.pose import Pose
from semcal_ros.synthetic.render import render_frame
from semcal_ros.synthetic.specimens.grid import ChessGrid, square_for
from semcal_ros.synthetic.stage import SimulatedStage, stage_views

__all__ = [
    "CHANGED",
    "change",
    "corners_of_sweep",
    "corners_of_visits",
    "load_microscope",
    "sweep_magnifications",
    "sweep_of",
    "visits_of",
]

Frames = list[tuple[AnyImage, float]]

#: What is changed, by how much, and the name under which `semcal check` reports it.
CHANGED: dict[str, tuple[str, float, str]] = {
    "nothing": ("scale_error", 0.0, ""),
    "scale +0.5 %": ("scale_error", 0.005, "scale"),
    "aspect +0.2 %": ("aspect", 0.002, "aspect"),
    "centre of distortion +15 px": ("ex", 15.0, "centre of distortion"),
}
# Of the views of a visit: one axis of tilt, in any direction.
_TILTS_RAD = tuple(math.radians(tilt) for tilt in (0.0, 20.0, 40.0))
_HEIGHT_SIGMA_M = 1e-5
# Of a corner, per axis: what is found in the recordings, and in drawn images.
_CORNER_SIGMA_PX = 0.04


@dataclass(frozen=True)
class Table:
    """A parameter at the magnifications of a recording, linear in log g between them, times and plus something."""

    log_g: tuple[float, ...]
    values: tuple[float, ...]

    def __call__(self, magnification: float) -> float:
        return float(np.interp(math.log(magnification), self.log_g, self.values))


@dataclass(frozen=True)
class Changed:
    """Another law plus a number."""

    law: Law
    by: float

    def __call__(self, magnification: float) -> float:
        return self.law(magnification) + self.by


def load_microscope(folder: Path) -> VirtualMicroscope:
    """The microscope of `grid_calibration` and `grid_zoom_sweep` in a folder, from the truth beside them."""
    truth = {
        name: json.loads((folder / name / "truth.json").read_text())
        for name in ("grid_calibration", "grid_zoom_sweep")
    }
    size, display_m = (
        truth["grid_calibration"]["size"],
        1e-6 * truth["grid_calibration"]["display_um"],
    )
    known: dict[float, dict[str, Any]] = {
        float(g): values for own in truth.values() for g, values in own["params"].items()
    }
    ordered = sorted(known)
    log_g = tuple(math.log(g) for g in ordered)

    def table(value) -> Table:
        return Table(log_g, tuple(float(value(g, known[g])) for g in ordered))

    return VirtualMicroscope(
        name="reference",
        display_width_m=display_m,
        scale_error=table(lambda g, p: 1e6 * p["m"] * display_m / (g * size) - 1.0),
        aspect=table(lambda g, p: p["a"]),
        skew=table(lambda g, p: p["s"] / p["m"]),
        px=table(lambda g, p: p["px"]),
        py=table(lambda g, p: p["py"]),
        rho=table(lambda g, p: 1e6 * p["rho"]),
        xi_r=table(lambda g, p: p["xr"]),
        xi_t=table(lambda g, p: p["xt"]),
        ex=table(lambda g, p: p["ex"]),
        ey=table(lambda g, p: p["ey"]),
        residual_growth=Constant(1.0),
        native_width=size,
        native_height=size,
    )


def sweep_magnifications(folder: Path) -> list[float]:
    """The magnifications of `grid_zoom_sweep`."""
    truth = json.loads((folder / "grid_zoom_sweep" / "truth.json").read_text())
    return [float(frame["magnification"]) for frame in truth["frames"]]


def change(microscope: VirtualMicroscope, kind: str) -> VirtualMicroscope:
    """The microscope after one of :data:`CHANGED`."""
    parameter, by, _ = CHANGED[kind]
    law = getattr(microscope, parameter)
    if parameter == "scale_error":
        # A relative change of the scale, which is nominal times 1 plus this law.
        nodes = tuple((1.0 + value) * (1.0 + by) - 1.0 for value in law.values)
        return replace(microscope, scale_error=Table(law.log_g, nodes))
    return replace(microscope, **{parameter: Changed(law, by)})


def sweep_of(microscope: VirtualMicroscope, magnifications: list[float], seed: int) -> Frames:
    """One frame of the flat grid at each magnification, as in `grid_zoom_sweep`; turned in another way each time."""
    rng = np.random.default_rng(seed)
    pose = Pose.flat((*rng.uniform(-2e-5, 2e-5, 2), 0.0), float(rng.uniform(-math.pi, math.pi)))
    return [
        (_draw(microscope, pose, g, (seed, index)), g) for index, g in enumerate(magnifications)
    ]


def visits_of(microscope: VirtualMicroscope, magnifications: list[float], seed: int) -> Frames:
    """Three views at each magnification, tilted by 0, 20 and 40 degrees."""
    rng = np.random.default_rng((seed, 1))
    frames: Frames = []
    for g in magnifications:
        for tilt in _TILTS_RAD:
            height = float(rng.normal(0.0, _HEIGHT_SIGMA_M))
            azimuth, turn = rng.uniform(-math.pi, math.pi, 2)
            pose = Pose.tilted(tilt, azimuth, turn, (*rng.uniform(-2e-5, 2e-5, 2), height))
            frames.append((_draw(microscope, pose, g, (seed, len(frames))), g))
    return frames


def corners_of_sweep(
    microscope: VirtualMicroscope, magnifications: list[float], seed: int
) -> list[GridView]:
    """As :func:`sweep_of`, without images."""
    flat = SimulatedStage(tilts_rad=(0.0,), height_sigma_m=0.0)
    return stage_views(
        microscope.camera_at, magnifications, flat, noise_px=_CORNER_SIGMA_PX, seed=seed
    )


def corners_of_visits(
    microscope: VirtualMicroscope, magnifications: list[float], seed: int
) -> list[GridView]:
    """As :func:`visits_of`, without images."""
    any_axis = SimulatedStage(_TILTS_RAD, None, height_sigma_m=_HEIGHT_SIGMA_M)
    return stage_views(
        microscope.camera_at, magnifications, any_axis, noise_px=_CORNER_SIGMA_PX, seed=seed
    )


def _draw(microscope: VirtualMicroscope, pose: Pose, g: float, seed: tuple[int, ...]) -> AnyImage:
    square_m = square_for(microscope.nominal_pixel_size_m(g), microscope.width)
    return render_frame(microscope, ChessGrid(square_m), pose, g, seed=seed, detector=Detector())
