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

"""The microscope, the calibration and the images of the live benchmarks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from semcal_ros import Calibration
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.residual_field import ResidualField, zero_field
from semcal_ros.core.camera.scan_timing import ScanTiming


@dataclass(frozen=True)
class Config:
    """A microscope that scans a frame in ``frame_time_s``."""

    frame_time_s: float

    @property
    def scan(self) -> ScanTiming:
        return ScanTiming(self.frame_time_s)

    @property
    def text(self) -> str:
        return (
            "name: benchmark\ndisplay_width_m: 0.12\n"
            "magnification: {quantity: magnification}\n"
            f"scan: {{frame_time_s: {self.frame_time_s}}}\n"
        )


CONFIG = Config(0.08)


def settling_field(limits: tuple[float, float]) -> ResidualField:
    """A beam that settles by 2 px at the start of the lines, and a spiral of 1 px, at 512 x 512."""
    zero = zero_field((512, 512), limits, 3)
    coefficients = zero.coefficients.copy()
    # Near enough to where each basis function has its maximum.
    x, y = (
        np.array([np.mean(knots[k + 1 : k + 4]) for k in range(len(knots) - 4)])
        for knots in (zero.knots_x, zero.knots_y)
    )
    px = np.array([1.0, 1.2, 0.8])[:, None, None] / 256.0
    coefficients[..., 0] = px * (2.0 * np.exp(-(x + 1.0) / 0.15) + np.sin(3.0 * y)[:, None])
    coefficients[..., 1] = px * np.sin(3.0 * x) * np.cos(2.0 * y)[:, None]
    return replace(zero, coefficients=coefficients)


# A spiral of 1 px, coils that depart by 1.5 px, and a beam that settles by 2 px over some 14 columns of 512.
TERMS = {
    "xi_s": 0.004,
    "coil_x3": -0.006,
    "coil_y2": 0.002,
    "settling_3": 0.006,
    "settling_4": 0.002,
}


def calibration(*, with_field: bool = False, with_terms: bool = False) -> Calibration:
    """A calibration with a little of every distortion, for 512 x 512."""
    limits = (500.0, 20000.0)
    values = {"scale": 1.01, "aspect": 1.004, "skew": 0.001, "px": 250.0, "py": 262.0, "rho": 50.0}
    values |= {"xi_r": 0.01, "xi_t": 0.001, "ex": 235.0, "ey": 268.0}
    values |= TERMS if with_terms else {}
    functions = {
        name: ContinuousFunction("chebyshev_log", np.array([value]), limits)
        for name, value in values.items()
    }
    field = settling_field(limits) if with_field else None
    size = len(values) + (0 if field is None else field.size)
    return Calibration(
        functions=functions,
        covariance=np.eye(size) * 1e-8,
        image_width=512,
        image_height=512,
        display_width_m=0.12,
        magnifications=limits,
        method="joint",
        residual=field,
    )


def pictures(size: int, depth: int = 8, count: int = 16) -> list[np.ndarray]:
    """A random texture that drifts slowly on a circle, with noise.

    A fifth of a pixel of 512 per frame, so that every frame can be tracked.
    """
    rng = np.random.default_rng(0)
    wide = rng.standard_normal((size + 16, size + 16), dtype=np.float32)
    wide = cv2.GaussianBlur(wide, (0, 0), 2.5)
    wide *= 40.0 / wide.std()
    # One noise, rolled: drawing it anew is slow at 4096.
    noise = rng.standard_normal((size, size), dtype=np.float32) * 5.0
    radius = 0.5 * size / 512
    scale, kind = (1.0, np.uint8) if depth == 8 else (257.0, np.uint16)
    out = []
    for k in range(count):
        angle = 2.0 * np.pi * k / count
        x, y = radius * np.cos(angle) - 8.0, radius * np.sin(angle) - 8.0
        moved = cv2.warpAffine(
            wide, np.array([[1.0, 0.0, x], [0.0, 1.0, y]]), (size, size), flags=cv2.INTER_CUBIC
        )
        grey = np.clip(128.0 + moved + np.roll(noise, 37 * k), 0, 255)
        out.append((scale * grey).astype(kind))
    return out
