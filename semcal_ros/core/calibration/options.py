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

"""The choices that a user has for a calibration."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from semcal_ros.core.calibration.stage import StageAxis
from semcal_ros.core.camera.calibration_model import ScaleSigma
from semcal_ros.core.errors import InvalidValueError

METHODS = ("joint", "pda", "discrete")
RESIDUAL_MODES = ("auto", "off", "on")


@dataclass(frozen=True)
class MethodOptions:
    """Options of the paper's methods.

    Attributes
    ----------
    pda_order
        Order of the differential equation of ``"pda"``, 1 to 4.
    legendre_degree
        With a value, ``"pda"`` fits Legendre polynomials of this degree instead.
    tau_px
        With a value, Algorithm 1 uses this fixed threshold instead of a statistical test.
    pda_step
        With a value G, ``"pda"`` fits through the magnifications nearest to multiples of G above
        the lowest one, instead of through all; ``"auto"`` takes the G with the least error.

    Raises
    ------
    InvalidValueError
        For a step that is neither positive nor ``"auto"``.
    """

    pda_order: int = 2
    legendre_degree: int | None = None
    tau_px: float | None = None
    pda_step: float | str | None = None

    def __post_init__(self) -> None:
        step = self.pda_step
        if step is None or step == "auto":
            return
        if isinstance(step, str) or not (np.isfinite(step) and step > 0.0):
            raise InvalidValueError(
                f"pda_step {step!r}", expected='"auto" or a finite step in magnification above 0'
            )


@dataclass(frozen=True)
class CalibrationOptions:
    """The choices that a user has for a calibration.

    Attributes
    ----------
    method
        ``"joint"`` (one adjustment over everything), ``"discrete"`` (each magnification by itself,
        linear between) or ``"pda"`` (the paper's differential equations through the discrete
        results).
    method_options
        Options of the paper's methods.
    breakpoints
        Magnifications at which the microscope switches its scan range, so that scale, aspect and
        skew jump (only ``"joint"``). A jump that the views indicate elsewhere is reported as a
        warning.
    residual
        Whether a residual field adds to the distortion parameters (only
        ``"joint"``): ``"on"``, ``"off"``, or ``"auto"``, where cross-validation decides.
    untilted
        Names of views in which the specimen is not tilted, ``"none"``, or ``"auto"`` (see
        :func:`~semcal_ros.core.calibration.start.mark_untilted`). The readings of a stage take
        precedence over ``"auto"``.
    squares_sigma
        Relative 1-sigma of the size of the grid's squares, from its certificate.
    height_sigma_m
        1-sigma of the height of what is measured later about the plane of the untilted grid: a
        focus that is set by eye repeats to the depth of field, which is 10 um for a resolution of
        0.1 um and an aperture angle of 10 mrad.
    axis
        The tilt axis of the stage, and how far its readings are trusted.

    Raises
    ------
    InvalidValueError
        For an unknown method or mode, or an option that the method does not support.
    """

    method: str = "joint"
    method_options: MethodOptions = MethodOptions()
    breakpoints: tuple[float, ...] = ()
    residual: str = "auto"
    untilted: str | tuple[str, ...] = "auto"
    squares_sigma: float = 0.0
    height_sigma_m: float = 1e-5
    axis: StageAxis = field(default_factory=StageAxis)

    def __post_init__(self) -> None:
        ScaleSigma(0.0, self.squares_sigma, self.height_sigma_m)
        if self.method not in METHODS:
            raise InvalidValueError(f"method {self.method!r}", expected=" or ".join(METHODS))
        if self.residual not in RESIDUAL_MODES:
            raise InvalidValueError(
                f"residual {self.residual!r}", expected=" or ".join(RESIDUAL_MODES)
            )
        if self.method == "joint":
            return
        if self.breakpoints:
            raise InvalidValueError(
                f"breakpoints with method {self.method}",
                expected='method "joint"',
                do="use --method joint",
            )
        if self.residual == "on":
            raise InvalidValueError(
                f"a residual field with method {self.method}",
                expected='method "joint"',
                do="use --method joint",
            )
