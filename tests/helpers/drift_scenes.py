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

"""Images whose shift is known exactly, for the tests of drift."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.estimates import DriftStatus, DriftUpdate


class Texture:
    """Random band-limited periodic scene of n x n px, unit variance, shifted exactly."""

    def __init__(self, seed: int = 0, n: int = 512, blur: float = 1.5, grain: float = 4.0) -> None:
        self.n = n
        self.ky = np.fft.fftfreq(n)[:, None]
        self.kx = np.fft.rfftfreq(n)[None, :]
        w = 2.0 * np.pi * np.hypot(self.kx, self.ky)
        amplitude = np.exp(-0.5 * (w * blur) ** 2) / (1.0 + (w * grain) ** 2)
        white = np.random.default_rng(seed).standard_normal((n, n))
        spectrum = amplitude * np.fft.rfft2(white)
        spectrum[0, 0] = 0.0
        self.spectrum = spectrum / np.fft.irfft2(spectrum, (n, n)).std()

    def view(self, shift: tuple[float, float], size: int, factor: Array | complex = 1.0) -> Array:
        """(size, size) view in which the scene has moved by ``shift`` (x, y)."""
        phase = np.exp(-2j * np.pi * (self.kx * shift[0] + self.ky * shift[1]))
        picture = np.fft.irfft2(self.spectrum * phase * factor, (self.n, self.n))
        start = (self.n - size) // 2
        return np.asarray(picture[start : start + size, start : start + size])

    def gradient(self, shift: tuple[float, float], size: int) -> tuple[Array, Array]:
        """Exact derivatives by x and y of :meth:`view`."""
        x = self.view(shift, size, 2j * np.pi * self.kx)
        return x, self.view(shift, size, 2j * np.pi * self.ky)


def noisy(
    picture: Array, sigma: float, seed: int, mean: float = 128.0, contrast: float = 40.0
) -> Array:
    """Grey levels with white noise."""
    rng = np.random.default_rng(seed)
    return mean + contrast * picture + sigma * rng.standard_normal(picture.shape)


def cramer_rao_px(texture: Texture, shift: tuple[float, float], size: int, sigma: float) -> Array:
    """(2,) 1-sigma bounds of a shift between two views with white noise each (contrast 40)."""
    whole = np.rint(shift).astype(int)
    rows = slice(max(0, whole[1]), size + min(0, whole[1]))
    cols = slice(max(0, whole[0]), size + min(0, whole[0]))
    gx, gy = (40.0 * g[rows, cols] for g in texture.gradient(shift, size))
    cross = float(np.sum(gx * gy))
    information = np.array([[np.sum(gx * gx), cross], [cross, np.sum(gy * gy)]]) / (2.0 * sigma**2)
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(information))))


def lattice(size: int, period: float, shift: tuple[float, float], angle: float = 0.2) -> Array:
    """Tilted chess-like lattice whose squares measure ``period`` px."""
    y, x = np.mgrid[:size, :size].astype(np.float64)
    x, y = x - shift[0], y - shift[1]
    u = np.pi * (np.cos(angle) * x + np.sin(angle) * y) / period
    v = np.pi * (-np.sin(angle) * x + np.cos(angle) * y) / period
    return np.asarray(np.tanh(3.0 * np.sin(u) * np.sin(v)))


def small_camera(magnification: float, size: int = 192) -> ScanCamera:
    """A camera with every kind of distortion; 0.25 um per px at 1000x and 192 px."""
    k, s = magnification / 1000.0, size / 192.0
    return ScanCamera(
        magnification=magnification,
        m=4e6 * k * s,
        aspect=1.005,
        skew=0.02,
        px=90.0 * s,
        py=105.0 * s,
        rho=50.0,
        xi_r=0.004,
        xi_t=0.001,
        ex=94.0 * s,
        ey=98.0 * s,
        norm_px=96.0 * s,
        width=size,
        height=size,
    )


def make_drift_update(**values: Any) -> DriftUpdate:
    """A tracked frame without drift; ``values`` replace its own."""
    usual: dict[str, Any] = {
        "time_s": 0.0,
        "drift_m": np.zeros(2),
        "velocity_m_s": np.zeros(2),
        "acceleration_m_s2": np.zeros(2),
        "covariance": np.zeros((4, 4)),
        "status": DriftStatus.TRACKED,
        "rejection": None,
        "residual": 5.0,
        "px_from_unit": np.eye(2),
        "overlap": 0.7,
        "calibrated": True,
        "restarted": False,
        "shear_px": np.full(2, np.nan),
        "shear_covariance": np.full((2, 2), np.inf),
        "keyframe_time_s": float("nan"),
        "merged": False,
    }
    return DriftUpdate(**usual | values)


class DriftingSpecimen:
    """A textured plane seen by a scanning camera, each pixel at its own time."""

    def __init__(
        self, pitch_m: float, seed: int = 0, blur: float = 2.0, grain: float = 6.0
    ) -> None:
        self.pitch_m = pitch_m
        self.n = 1024
        texture = Texture(seed, self.n, blur, grain)
        self.picture = texture.view((0.0, 0.0), self.n).astype(np.float32)

    def frame(
        self,
        camera: ScanCamera,
        timing: ScanTiming,
        drift_m: Array,
        velocity_m_s: Array,
        seed: int,
        noise: float = 5.0,
    ) -> NDArray[np.uint8]:
        """Raw frame whose centre has the drift ``drift_m``; single pass."""
        height, width = camera.height, camera.width
        y, x = np.mgrid[:height, :width].astype(np.float64)
        raw = np.stack([x.ravel(), y.ravel()], axis=1)
        offset = timing.pixel_offset_s(raw[:, 1], raw[:, 0], height, width) - timing.centre_offset_s
        seen = camera.sem_from_ideal(camera.undistort(raw))[:, :2]
        specimen = seen - drift_m - offset[:, None] * velocity_m_s
        at = (specimen / self.pitch_m + self.n / 2).astype(np.float32).reshape(height, width, 2)
        picture = cv2.remap(
            self.picture,
            np.ascontiguousarray(at[..., 0]),
            np.ascontiguousarray(at[..., 1]),
            cv2.INTER_LANCZOS4,
            borderMode=cv2.BORDER_WRAP,
        )
        gray = noisy(np.asarray(picture, dtype=np.float64), noise, seed)
        return np.clip(np.rint(gray), 0, 255).astype(np.uint8)
