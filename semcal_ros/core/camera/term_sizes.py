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

"""How large each kind of distortion is in the picture of a camera."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.distortion import LENS_NAMES, distort_normalised
from semcal_ros.core.camera.projection import PARAMETER_NAMES
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_distortion import SCAN_NAMES, SETTLING, deflection_shift
from semcal_ros.core.camera.thresholds import TERM_SIZES_ACROSS

TERM_KINDS: tuple[str, ...] = (
    "radial",
    "decentring",
    "spiral",
    "coils",
    "settling",
    "residual field",
)
"""The kinds of distortion: of the lens, of the scan, and what both leave."""
_LENS_KINDS = {
    "radial": ("xi_r", "xi_r4"),
    "decentring": ("xi_t", "xi_u", "xi_v", "xi_w"),
    "spiral": ("xi_s",),
}


def has_terms(camera: ScanCamera) -> bool:
    """Whether a camera has further terms beside the parameters that every camera has."""
    return camera.names != PARAMETER_NAMES


def displace_by(camera: ScanCamera, kind: str, xy: Array) -> Array:
    """Return the displacement (n, 2), px, that a kind of distortion alone adds at pixels (n, 2).

    A kind of the lens moves an undistorted pixel by it, as in :mod:`semcal_ros.core.camera.distortion`; coils, settling
    and residual field move a raw one to where it would be without, as in
    :mod:`semcal_ros.core.camera.scan_distortion` and :mod:`semcal_ros.core.camera.residual_field`. NaN where the lens
    has no answer.

    Parameters
    ----------
    camera
        The camera.
    kind
        One of :data:`TERM_KINDS`.
    xy
        (n, 2) pixels.
    """
    if kind == "residual field":
        return camera.without_residual(xy) - xy
    if kind in ("coils", "settling"):
        amplitudes = camera.scan_amplitudes
        chosen = np.zeros(len(SCAN_NAMES), dtype=bool)
        chosen[SETTLING] = True
        if kind == "coils":
            chosen = ~chosen
        return deflection_shift(xy, np.where(chosen, amplitudes, 0.0), camera.raster)
    lens = [getattr(camera, n) if n in _LENS_KINDS[kind] else 0.0 for n in LENS_NAMES]
    q = (xy - [camera.ex, camera.ey]) / camera.norm_px
    return camera.norm_px * (distort_normalised(q, *lens) - q)


def measure_terms(camera: ScanCamera) -> dict[str, float]:
    """Return the largest displacement, px, in the picture by each of :data:`TERM_KINDS` alone; 0 where it has none.

    It is that of a lattice of 33 x 33 pixels, from border to border. Shift, scale and rotation of the picture are taken
    out of the functions of the scan and of the residual field, and not out of the terms of the lens.
    """
    return {
        kind: _largest(np.linalg.norm(_displace_lattice(camera, kind), axis=1))
        for kind in TERM_KINDS
    }


def measure_along_axes(camera: ScanCamera, kind: str) -> tuple[float, float]:
    """Return the largest displacement, px, along the lines and across them by one of :data:`TERM_KINDS` alone."""
    moved = np.abs(_displace_lattice(camera, kind))
    return _largest(moved[:, 0]), _largest(moved[:, 1])


def _displace_lattice(camera: ScanCamera, kind: str) -> Array:
    x, y = (np.linspace(0.0, n - 1.0, TERM_SIZES_ACROSS) for n in (camera.width, camera.height))
    return displace_by(camera, kind, np.stack([a.ravel() for a in np.meshgrid(x, y)], axis=1))


def _largest(values: Array) -> float:
    return float(np.max(values[np.isfinite(values)], initial=0.0))


def largest_term_sizes(cameras: Iterable[ScanCamera]) -> dict[str, float]:
    """Return the largest of :func:`measure_terms` over some cameras."""
    largest = dict.fromkeys(TERM_KINDS, 0.0)
    for camera in cameras:
        for kind, size in measure_terms(camera).items():
            largest[kind] = max(largest[kind], size)
    return largest


def describe_term_sizes(sizes: Mapping[str, float]) -> str:
    """Return sizes in words, to two digits, such as ``radial 1.8 px, spiral 12 px``, without those that are 0."""
    return ", ".join(
        f"{kind} {size:{'.0f' if size >= 10.0 else '.2g'}} px"
        for kind, size in sizes.items()
        if size > 0.0
    )
