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

"""What a slider over the magnification shows: the camera, its scale, its distortion and its uncertainty."""

from __future__ import annotations

from typing import Any

import numpy as np

from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.predicted_error import make_field_lattice, predict_shape_sigma_px
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.term_sizes import describe_term_sizes, has_terms, measure_terms
from semcal_ros.report.calibration.geometry import compute_displacements
from semcal_ros.report.html.text import format_length, format_magnification

__all__ = ["tabulate_cameras"]

# Steps of the slider: a step is less than a tenth of a factor of two over a range of 100.
_STEPS = 81
_ACROSS = 9


def tabulate_cameras(model: CalibrationModel) -> list[dict[str, Any]]:
    """Tabulate what the calibration says at magnifications over its range, ready to be shown.

    Each row has the magnification as ``g`` and in ``title``, the matrix ``K`` row by row as texts, and ``values``,
    pairs of a name and a text. The calibrated magnifications are among the rows, and marked ``calibrated``. A
    calibration of one magnification has one row.
    """
    low, high = model.magnification_range
    if low == high:
        return [_row(model.at(low), calibrated=True)]
    known = {float(g) for g in model.magnifications}
    steps = sorted({*map(float, np.clip(np.geomspace(low, high, _STEPS), low, high)), *known})
    return [_row(model.at(g), calibrated=g in known) for g in steps]


def _row(camera: ScanCamera, *, calibrated: bool) -> dict[str, Any]:
    sizes = camera.pixel_size_m
    sigmas = (None, None) if camera.covariance is None else camera.pixel_size_sigma_m
    mean_m = float(np.mean(sizes))
    moved = np.linalg.norm(compute_displacements(camera)[1], axis=1)
    field = (sizes[0] * camera.width, sizes[1] * camera.height)
    values = [
        ("Pixel, x", format_length(sizes[0], sigmas[0])),
        ("Pixel, y", format_length(sizes[1], sigmas[1])),
        ("Field", " × ".join(format_length(side) for side in field)),
        ("Largest distortion", _format_both(float(np.nanmax(moved)), mean_m)),
    ]
    if has_terms(camera):
        values.append(("Largest of each kind", describe_term_sizes(measure_terms(camera))))
    if camera.covariance is not None:
        lattice = make_field_lattice(camera.width, camera.height, _ACROSS)
        predicted = predict_shape_sigma_px(camera, lattice)
        if np.any(np.isfinite(predicted)):
            worst = _format_both(float(np.nanmax(predicted)), mean_m)
            values.append(("Predicted error at the edge, 1-sigma", worst))
    return {
        "g": camera.magnification,
        "title": format_magnification(camera.magnification),
        "calibrated": calibrated,
        "K": [[f"{value:.6g}" for value in line] for line in camera.K],
        "values": values,
    }


def _format_both(px: float, pixel_m: float) -> str:
    """A displacement in px and as a length."""
    return f"{px:.2g} px, {format_length(px * pixel_m)}"
