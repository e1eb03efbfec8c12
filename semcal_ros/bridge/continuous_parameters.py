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

"""Continuous parameters: names such as ``p@5250``, valid at any magnification in the range."""

from __future__ import annotations

import re
from typing import NamedTuple, Protocol

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError

PARAMETER_KINDS = (
    *("p", "k", "d", "e", "p_affine", "p_affine_covariance"),
    *("pixel_size", "sigma"),
)
"""Projection, K, distortion, its centre, affine-safe projection and its covariance, pixel size, predicted error."""

_NUMBER = re.compile(r"[0-9]+(\.[0-9]+)?([eE][+-]?[0-9]+)?")
# Characters of a wrong name that an error repeats: the error stays one line.
_MAX_SHOWN = 60


class ParameterRequest(NamedTuple):
    """A parsed name: which value, at which magnification."""

    kind: str
    magnification: float


class CameraSource(Protocol):
    """What a calibration offers."""

    @property
    def magnification_range(self) -> tuple[float, float]:
        """Lowest and highest calibrated magnification."""

    def at(self, magnification: float, /) -> ScanCamera:
        """Return the camera at a magnification."""


def is_continuous_parameter(name: str) -> bool:
    """True for names that are meant as ``kind@magnification``, well-formed or not."""
    return "@" in name


def parse_parameter_name(name: str) -> ParameterRequest:
    """Split ``"p@5250"`` into ``("p", 5250.0)``.

    Raises
    ------
    InvalidValueError
        The kind is unknown or the magnification is not a positive finite decimal number.
    """
    kind, separator, number = name.partition("@")
    if not separator or kind not in PARAMETER_KINDS:
        raise InvalidValueError(
            f"parameter name {name[:_MAX_SHOWN]!r}",
            expected="one of " + ", ".join(f"{known}@<magnification>" for known in PARAMETER_KINDS),
        )
    magnification = float(number) if _NUMBER.fullmatch(number) else float("nan")
    if not 0.0 < magnification < float("inf"):
        raise InvalidValueError(
            f"magnification {number[:_MAX_SHOWN]!r} in parameter {kind}@",
            expected="a finite number above 0 such as 5250 or 2345.6",
        )
    return ParameterRequest(kind, magnification)


def continuous_value(kind: str, camera: ScanCamera) -> list[float]:
    """Return the value of one kind at the magnification of ``camera``.

    Returns
    -------
    ``p``, ``p_affine``: 12 numbers, 3 x 4 row by row. ``p_affine_covariance``: 144, row by row, the
    covariance of the 12 numbers of ``p_affine``. ``k``: 9, row by row. ``d``: [xi_r, xi_t].
    ``e``: [ex, ey] in px. ``pixel_size``: [x, y] in m. ``sigma``: length of the predicted 1-sigma
    error in px at the image centre and at the corners (top left, top right, bottom left, bottom
    right).

    Raises
    ------
    InvalidValueError
        The kind is unknown, or this camera has no such value (``p`` and ``k`` of a parallel
        projection, ``sigma`` and ``p_affine_covariance`` of a camera without covariance).
    """
    values: Array
    if kind == "p":
        values = camera.P.reshape(-1)
    elif kind == "k":
        values = camera.K.reshape(-1)
    elif kind == "d":
        values = np.array([camera.xi_r, camera.xi_t])
    elif kind == "e":
        values = np.array([camera.ex, camera.ey])
    elif kind == "p_affine":
        values = camera.P_affine.reshape(-1)
    elif kind == "p_affine_covariance":
        values = camera.P_affine_covariance.reshape(-1)
    elif kind == "pixel_size":
        values = np.array(camera.pixel_size_m)
    elif kind == "sigma":
        values = _sigma_px(camera)
    else:
        raise InvalidValueError(f"parameter kind {kind!r}", expected=", ".join(PARAMETER_KINDS))
    return [float(value) for value in values]


def _sigma_px(camera: ScanCamera) -> Array:
    right, bottom = camera.width - 1.0, camera.height - 1.0
    pixels = np.array(
        [[0.5 * right, 0.5 * bottom], [0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]]
    )
    sigma = np.linalg.norm(camera.project_sigma(camera.sem_from_ideal(pixels)), axis=1)
    if not np.all(np.isfinite(sigma)):
        raise InvalidValueError(
            "a distortion that is undefined at an image corner", expected="4 xi_r r2 below 1"
        )
    return np.asarray(sigma, dtype=np.float64)


def read_parameter(name: str, calibration: CameraSource) -> list[float]:
    """Read a continuous parameter.

    Raises
    ------
    InvalidValueError
        The name is malformed, the magnification is outside the calibrated range, or the camera
        has no such value.
    """
    kind, magnification = parse_parameter_name(name)
    low, high = calibration.magnification_range
    if not low <= magnification <= high:
        raise InvalidValueError(
            f"parameter {name}",
            expected=f"a magnification within the calibrated range, {low:g} to {high:g}",
        )
    return continuous_value(kind, calibration.at(magnification))
