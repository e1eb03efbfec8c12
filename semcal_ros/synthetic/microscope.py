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

"""Virtual microscopes: a camera for every magnification, with its scan timing and conditions; some have names.

Its parameters change with the magnification by laws. None of them is a polynomial in g or in log g: a calibration that
fits such polynomials meets a curve that it can only approximate, as with a real microscope, so that a test against it
is meaningful.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from semcal_ros.core.arrays import Array, check_positive
from semcal_ros.core.camera.scan_camera import ScanCamera, as_points
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import did_you_mean
from semcal_ros.synthetic.thresholds import (
    FIXED_POINT_STEPS,
    FIXED_POINT_TOLERANCE_PX,
    SIMULATED_VOLTAGE_V,
    SIMULATED_WORKING_DISTANCE_M,
)


@dataclass(frozen=True)
class Residual:
    """Displacements that the two distortion parameters of the camera model cannot describe.

    They are added to the raw pixel as functions of the undistorted one. With ``q = (x_u - centre of
    the image) / (width / 2)``, ``r2 = |q|^2`` and ``n = width / 2``:

    Parameters
    ----------
    spiral
        ``n spiral r2 (-q_y, q_x)``, dimensionless.
    sine
        Scan-coil non-linearity ``n sine sin(2 pi sine_cycles (q_x + 1) / 2)`` along x,
        dimensionless.
    sine_cycles
        Number of periods of the sine over the image width.
    settling
        Deflection at the left border that decays along the scan line, ``n settling exp(-(q_x + 1) /
        settling_length)`` along x, dimensionless.
    settling_length
        Decay length of the settling in half image widths.
    """

    spiral: float = 0.0
    sine: float = 0.0
    sine_cycles: float = 2.0
    settling: float = 0.0
    settling_length: float = 0.05

    @property
    def is_zero(self) -> bool:
        """True when no point is displaced."""
        return self.spiral == 0.0 and self.sine == 0.0 and self.settling == 0.0

    def displacement_px(self, xy: Array, width: int, height: int) -> Array:
        """Return the displacement (n, 2) in px at undistorted pixels (n, 2) of an image of this size."""
        n = 0.5 * width
        q = (xy - 0.5 * np.array([width - 1.0, height - 1.0])) / n
        r2 = np.sum(q * q, axis=1)
        shift: Array = self.spiral * r2[:, None] * np.stack([-q[:, 1], q[:, 0]], axis=1)
        shift[:, 0] += self.sine * np.sin(math.pi * self.sine_cycles * (q[:, 0] + 1.0))
        # Bounded far left of the field, where the exponential would have no inverse.
        along = np.maximum(q[:, 0] + 1.0, -2.0 * self.settling_length)
        shift[:, 0] += self.settling * np.exp(-along / self.settling_length)
        shift *= n
        return shift


@dataclass(frozen=True)
class VirtualMicroscope:
    """A microscope whose camera parameters are continuous functions of the magnification.

    Pixel-valued parameters refer to the native image size; :meth:`camera_at` converts them to
    ``width`` x ``height``.

    Parameters
    ----------
    name
        Name of the preset.
    display_width_m
        Width of the display that magnifications refer to: the field is ``display_width_m / g``
        wide.
    scale_error
        Law of the relative deviation of the true scale m from ``g width / display_width_m``.
    aspect, skew, rho, xi_r, xi_t
        Laws of the parameters of :class:`~semcal_ros.core.camera.scan_camera.ScanCamera`; rho in 1/m.
    px, py, ex, ey
        Laws of the principal point and of the distortion centre, in native pixels.
    residual
        Displacements that the camera model does not contain.
    residual_growth
        Law of a factor on the residual.
    timing
        Raster timing.
    native_width, native_height
        Image size that the pixel-valued laws refer to.
    width, height
        Size of the images taken; 0 means the native size.
    visit_scale
        Factor on the image about its centre: how the magnification came back this time.
    """

    name: str
    display_width_m: float
    scale_error: Law
    aspect: Law
    skew: Law
    px: Law
    py: Law
    rho: Law
    xi_r: Law
    xi_t: Law
    ex: Law
    ey: Law
    residual: Residual = field(default_factory=Residual)
    residual_growth: Law = field(default_factory=lambda: Constant(1.0))
    timing: ScanTiming = field(default_factory=lambda: ScanTiming(1.0 / 15.0, 8, 0.1))
    native_width: int = 512
    native_height: int = 512
    width: int = 0
    height: int = 0
    visit_scale: float = 1.0

    def __post_init__(self) -> None:
        if self.width == 0:
            object.__setattr__(self, "width", self.native_width)
        if self.height == 0:
            object.__setattr__(self, "height", self.native_height)

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) of the scanned field in px, without a data bar."""
        return self.width, self.height

    def with_image_size(self, width: int, height: int) -> VirtualMicroscope:
        """Return the same microscope with another image size over the same field width."""
        return replace(self, width=width, height=height)

    def with_timing(self, timing: ScanTiming) -> VirtualMicroscope:
        """Return the same microscope with another raster timing."""
        return replace(self, timing=timing)

    def during_visit(self, visit_scale: float) -> VirtualMicroscope:
        """Return the microscope whose magnification came back with this factor."""
        return replace(self, visit_scale=visit_scale)

    def nominal_pixel_size_m(self, magnification: float) -> float:
        """Return the pixel size that the microscope would display, from the display width alone."""
        return self.display_width_m / (_check_magnification(magnification) * self.width)

    def camera_at(self, magnification: float) -> ScanCamera:
        """Return the true camera at a magnification in this visit, without the residual.

        Raises
        ------
        InvalidValueError
            If the magnification is not a positive finite number.
        """
        g = _check_magnification(magnification)
        nominal = g * self.native_width / self.display_width_m
        middle_x, middle_y = 0.5 * (self.native_width - 1.0), 0.5 * (self.native_height - 1.0)
        camera = ScanCamera(
            magnification=g,
            m=nominal * (1.0 + self.scale_error(g)) * self.visit_scale,
            aspect=self.aspect(g),
            skew=self.skew(g),
            px=middle_x + self.visit_scale * (self.px(g) - middle_x),
            py=middle_y + self.visit_scale * (self.py(g) - middle_y),
            rho=self.rho(g),
            xi_r=self.xi_r(g),
            xi_t=self.xi_t(g),
            ex=self.ex(g),
            ey=self.ey(g),
            norm_px=0.5 * self.native_width,
            width=self.native_width,
            height=self.native_height,
        )
        return camera.resized(self.width, self.height)

    # -- the camera together with the residual ----------------------------------------------------

    def _residual_px(self, magnification: float, xy_ideal: Array) -> Array:
        growth = self.residual_growth(magnification)
        return growth * self.residual.displacement_px(xy_ideal, self.width, self.height)

    def distort(self, magnification: float, xy_ideal: ArrayLike) -> Array:
        """Map undistorted pixels (n, 2) to raw pixels (n, 2), with the residual."""
        xy = as_points(xy_ideal, 2)
        raw = self.camera_at(magnification).distort(xy)
        return raw if self.residual.is_zero else raw + self._residual_px(magnification, xy)

    def project(self, magnification: float, xyz_m: ArrayLike) -> Array:
        """Project sem-frame points (n, 3) in m to raw pixels (n, 2), with the residual."""
        return self.distort(magnification, self.camera_at(magnification).project_ideal(xyz_m))

    def undistort(self, magnification: float, xy_raw: ArrayLike) -> Array:
        """Map raw pixels (n, 2) to undistorted pixels (n, 2); NaN where the inverse does not exist.

        The residual is small and smooth, so a fixed-point iteration around the camera's own inverse
        contracts.

        Raises
        ------
        InvalidValueError
            If the residual is so strong that the iteration does not converge.
        """
        raw = as_points(xy_raw, 2)
        camera = self.camera_at(magnification)
        xy = camera.undistort(raw)
        if self.residual.is_zero:
            return xy
        for _ in range(FIXED_POINT_STEPS):
            better = camera.undistort(raw - self._residual_px(magnification, xy))
            change = float(np.nanmax(np.abs(better - xy), initial=0.0))
            xy = better
            if change < FIXED_POINT_TOLERANCE_PX:
                return xy
        raise InvalidValueError(
            f"residual {self.residual}, whose inverse still moves by {change:.2g} px",
            expected="a residual with derivatives well below 1",
        )


def _check_magnification(magnification: float) -> float:
    return check_positive(magnification, "magnification")


def conditions_of(
    microscope: VirtualMicroscope,
    *,
    voltage_v: float = SIMULATED_VOLTAGE_V,
    working_distance_m: float = SIMULATED_WORKING_DISTANCE_M,
    scan_rotation_rad: float = 0.0,
) -> dict[str, float | str]:
    """Return the conditions as the topic ``conditions`` names them, in SI units.

    Parameters
    ----------
    microscope
        With its image size and timing.
    voltage_v, working_distance_m, scan_rotation_rad
        What it is set to.
    """
    timing = microscope.timing
    line_share = (1.0 - timing.flyback_fraction) / timing.line_averages
    return {
        "accelerating_voltage_v": voltage_v,
        "working_distance_m": working_distance_m,
        "scan_rotation_rad": scan_rotation_rad,
        "frame_time_s": timing.frame_time_s,
        "dwell_s": timing.frame_time_s * line_share / (microscope.width * microscope.height),
        "detector": "simulated",
        "maker": "semcal_ros",
        "model": microscope.name,
    }


class Law(Protocol):
    """A parameter as a function of g; hashable, because the rendered geometry is cached."""

    def __call__(self, magnification: float) -> float:
        """Value at a magnification."""
        ...

    def __hash__(self) -> int:
        """Equal laws have equal hashes."""
        ...


@dataclass(frozen=True)
class Constant:
    """The same value at every magnification."""

    value: float

    def __call__(self, magnification: float) -> float:
        """Value at a magnification."""
        return self.value


@dataclass(frozen=True)
class Exponential:
    """``high + (low - high) exp(-g / scale)``: ``low`` at g = 0, ``high`` far above ``scale``."""

    low: float
    high: float
    scale: float

    def __call__(self, magnification: float) -> float:
        """Value at a magnification."""
        return self.high + (self.low - self.high) * math.exp(-magnification / self.scale)


@dataclass(frozen=True)
class Saturation:
    """``low + (high - low) g^n / (g^n + half^n)``: half way between the ends at ``g = half``."""

    low: float
    high: float
    half: float
    exponent: float = 1.0

    def __call__(self, magnification: float) -> float:
        """Value at a magnification."""
        fraction = 1.0 / (1.0 + (self.half / magnification) ** self.exponent)
        return float(self.low + (self.high - self.low) * fraction)


@dataclass(frozen=True)
class Logistic:
    """``low + (high - low) / (1 + exp(-(g - middle) / width))``."""

    low: float
    high: float
    middle: float
    width: float

    def __call__(self, magnification: float) -> float:
        """Value at a magnification."""
        fraction = 0.5 * (1.0 + math.tanh(0.5 * (magnification - self.middle) / self.width))
        return float(self.low + (self.high - self.low) * fraction)


def _jsm820() -> VirtualMicroscope:
    # Only the distortion centre has the values of the tables of Malti et al. (2012),
    # doi:10.1117/1.JEI.21.3.033020 (section 4.1.1). The others have the shapes that its text
    # states, and values of a plausible microscope: doc/paper.md lists both.
    return VirtualMicroscope(
        name="jsm820",
        display_width_m=0.12,
        scale_error=Saturation(0.018, 0.011, 2600.0),
        aspect=Exponential(1.002, 1.012, 9000.0),
        skew=Saturation(0.0005, 0.0032, 6500.0, 1.4),
        px=Constant(249.3),
        py=Constant(262.8),
        rho=Constant(1.0 / 0.020),
        xi_r=Exponential(0.0071, 0.0007, 3600.0),
        xi_t=Saturation(0.0004, 0.0016, 4200.0, 1.2),
        ex=Exponential(230.1, 224.6, 4300.0),
        ey=Exponential(270.1, 264.6, 4900.0),
    )


def _build() -> dict[str, VirtualMicroscope]:
    base = _jsm820()
    zero = Constant(0.0)
    middle = Constant(255.5)
    table = {
        "jsm820": base,
        "no_distortion": replace(base, xi_r=zero, xi_t=zero),
        "strong_perspective": replace(base, rho=Constant(1.0 / 0.008), px=Constant(262.0)),
        "parallel": replace(base, rho=zero, px=middle, py=middle),
        "off_centre": replace(
            base,
            px=Constant(205.0),
            py=Constant(301.0),
            ex=Exponential(322.0, 309.0, 3000.0),
            ey=Saturation(188.0, 203.0, 2500.0),
        ),
        "pincushion": replace(
            base,
            display_width_m=0.2,
            xi_r=Logistic(-0.012, -0.002, 2500.0, 1400.0),
            xi_t=Exponential(-0.0011, 0.0003, 2800.0),
            scale_error=Logistic(-0.03, 0.01, 3000.0, 2500.0),
        ),
        "spiral": replace(base, residual=Residual(spiral=0.004)),
        "scan_nonlinear": replace(
            base,
            residual=Residual(sine=0.003, sine_cycles=1.7, settling=0.006, settling_length=0.08),
        ),
        "ideal": replace(
            base,
            scale_error=zero,
            aspect=Constant(1.0),
            skew=zero,
            px=middle,
            py=middle,
            xi_r=zero,
            xi_t=zero,
            ex=middle,
            ey=middle,
        ),
    }
    return {name: replace(microscope, name=name) for name, microscope in table.items()}


PRESETS: Mapping[str, VirtualMicroscope] = MappingProxyType(_build())


def preset(name: str) -> VirtualMicroscope:
    """Return the microscope with this name.

    Raises
    ------
    InvalidValueError
        If there is no such preset.
    """
    if name not in PRESETS:
        raise InvalidValueError(
            f"microscope preset '{name}'",
            expected=f"one of {', '.join(PRESETS)}",
            do=did_you_mean(name, PRESETS),
        )
    return PRESETS[name]
