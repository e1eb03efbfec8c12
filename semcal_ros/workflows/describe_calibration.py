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

"""What a calibration file tells about itself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from semcal_ros.calibration import Calibration
from semcal_ros.core.calibration.judgement.plan import judge_calibration


def describe_calibration(calibration: Calibration) -> dict[str, Any]:
    """Return what is known of a calibration, as ``semcal info cal.yaml --json`` prints it; SI units, or None.

    Parameters
    ----------
    calibration
        Of any age.
    """
    statistics = calibration.statistics
    known = asdict(calibration.provenance)
    conditions = {name: list(values) for name, values in known.pop("conditions").items()}
    origin = {
        name: (list(value) if isinstance(value, tuple) else value) or None
        for name, value in known.items()
    }

    def number(name: str) -> float | None:
        # Statistics may be anything.
        value = statistics.get(name) if isinstance(statistics, Mapping) else None
        return value if type(value) in (int, float) else None

    def several(name: str, kind: tuple[type, ...]) -> list[Any] | None:
        value = statistics.get(name) if isinstance(statistics, Mapping) else None
        if not isinstance(value, (list, tuple)) or any(type(v) not in kind for v in value):
            return None
        return list(value)

    return {
        "method": calibration.method,
        "magnification_range": list(calibration.magnification_range),
        "magnifications": list(calibration.magnifications),
        "ladder": None if calibration.ladder is None else asdict(calibration.ladder),
        "image_width_px": calibration.image_width,
        "image_height_px": calibration.image_height,
        "display_width_m": calibration.display_width_m,
        "verdict": judge_calibration(calibration).describe(),
        **origin,
        "conditions": conditions or None,
        "views_used": number("views"),
        "corners": number("corners"),
        "rms_px": number("rms_px"),
        "held_out_rms_px": number("held_out_rms_px"),
        "squares_m": several("squares_m", (int, float)),
        "grid_certificate": statistics.get("grid_certificate"),
        "scale_sigma": asdict(calibration.scale_sigma),
        "warnings": several("warnings", (str,)),
    }
