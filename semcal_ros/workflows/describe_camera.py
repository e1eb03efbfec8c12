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

"""The camera at a magnification as plain numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from semcal_ros.bridge.continuous_parameters import continuous_value
from semcal_ros.calibration import Calibration
from semcal_ros.core.camera.scan_camera import RectifiedCamera, ScanCamera
from semcal_ros.core.camera.term_sizes import measure_terms


def parameter_sigma(camera: ScanCamera) -> dict[str, float]:
    """Return the 1-sigma of each parameter of a calibrated camera."""
    assert camera.covariance is not None
    # Rounding may make the variance of an exactly known parameter negative.
    sigma = np.sqrt(np.maximum(np.diag(camera.covariance), 0.0))
    return dict(zip(camera.names, sigma.tolist(), strict=True))


def describe_camera(calibration: Calibration, magnification: float) -> dict[str, Any]:
    """Return K, P, distortion, pixel size and their uncertainty in SI units, as ``semcal at --json`` prints them.

    ``terms_px`` is the largest displacement by each kind of distortion
    (:func:`~semcal_ros.core.camera.term_sizes.measure_terms`).

    Raises
    ------
    InvalidValueError
        As :meth:`~semcal_ros.calibration.Calibration.at`.
    """
    camera = calibration.at(magnification)
    perspective = camera.rho > 0.0
    return {
        "magnification": camera.magnification,
        "in_range": camera.in_range,
        "magnification_range": list(calibration.magnification_range),
        "image_width_px": camera.width,
        "image_height_px": camera.height,
        "pixel_size_m": list(camera.pixel_size_m),
        "pixel_size_sigma_m": list(camera.pixel_size_sigma_m),
        "mean_pixel_size_m": 1.0 / camera.m,
        "K": camera.K.tolist() if perspective else None,
        "P": camera.P.tolist() if perspective else None,
        "P_affine": camera.P_affine.tolist(),
        "rectified": _describe_rectified(camera.rectified),
        "distortion": {"xi_r": camera.xi_r, "xi_t": camera.xi_t, "norm_px": camera.norm_px},
        "distortion_centre_px": [camera.ex, camera.ey],
        "terms_px": measure_terms(camera),
        "parameters": dict(zip(camera.names, camera.parameters.tolist(), strict=True)),
        "parameter_sigma": parameter_sigma(camera),
        "projection_sigma_px": continuous_value("sigma", camera),
    }


def _describe_rectified(camera: RectifiedCamera) -> dict[str, Any]:
    """Return the camera of ``image_rect``, whose pixels are square."""
    perspective = camera.rho > 0.0
    return {
        "pixel_size_m": camera.pixel_size_m[0],
        "pixel_size_sigma_m": list(camera.pixel_size_sigma_m),
        "principal_point_px": [camera.px, camera.py],
        "K": camera.K.tolist() if perspective else None,
        "P": camera.P.tolist() if perspective else None,
        "P_affine": camera.P_affine.tolist(),
    }
