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

"""Named virtual microscopes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import did_you_mean
from semcal_ros.synthetic.microscope import (
    Constant,
    Exponential,
    Logistic,
    Residual,
    Saturation,
    VirtualMicroscope,
)


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
