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

"""Evidence of radial distortion and its centre (Algorithm 1 of the paper).

The centre is the common left epipole of the radial fundamental matrices between a plane and its
images (Hartley and Kang 2007, doi:10.1109/TPAMI.2007.1147). Without distortion the matrices are
arbitrary. The paper detects that by an error below 1e-3 px, which no real corner reaches; here an
F-test asks whether the plane's homography leaves anything but noise, and the fixed threshold stays
as an option.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.plane_geometry import (
    fit_homography,
    normalising_similarity,
    transform_points,
)

__all__ = ["DistortionCentre", "find_distortion_centre"]

# The cubic has 10 terms per coordinate.
_FEWEST_CORNERS = 12


# Level of the F-test: seven magnifications without distortion are all recognised in 99 % of cases.
_SIGNIFICANCE = 1e-3


@dataclass(frozen=True)
class DistortionCentre:
    """Result of Algorithm 1.

    Attributes
    ----------
    degenerate
        True when homographies alone explain the views: no distortion, and no centre.
    centre_px
        (2,) centre of the distortion; the image points' mean when degenerate.
    homography_rms_px
        RMS residual of the homographies.
    noise_rms_px
        RMS residual beside a smooth part (cubic in the image): the noise of the corners.
    p_value
        Probability of residuals as smooth as these without distortion.
    """

    degenerate: bool
    centre_px: Array
    homography_rms_px: float
    noise_rms_px: float
    p_value: float


def _radial_fundamental(board: Array, image: Array, from_image: Array) -> Array:
    """Return the (3, 3) F with image' F board = 0 in normalised coordinates; unit norm, rank 2.

    Normalised 8-point algorithm. ``from_image`` normalises the image of all views alike, so that
    their matrices share the left epipole.
    """
    b = np.column_stack(
        [transform_points(normalising_similarity(board), board), np.ones(len(board))]
    )
    x = np.column_stack([transform_points(from_image, image), np.ones(len(image))])
    rows = (x[:, :, None] * b[:, None, :]).reshape(len(b), 9)
    _, vectors = np.linalg.eigh(rows.T @ rows)
    u, s, vt = np.linalg.svd(vectors[:, 0].reshape(3, 3))
    return u @ np.diag([s[0], s[1], 0.0]) @ vt


def _cubic_basis(image: Array) -> Array:
    x, y = ((image - image.mean(axis=0)) / (np.ptp(image) / 2.0)).T
    return np.stack([x**i * y**j for i in range(4) for j in range(4 - i)], axis=1)


def _smooth_part(view: GridView) -> tuple[Array, Array, int]:
    """Return homography residuals, these without their cubic part, and the number of its terms."""
    h = fit_homography(view.board_xy_m, view.image_xy)
    residual = view.image_xy - transform_points(h, view.board_xy_m)
    basis = _cubic_basis(view.image_xy)
    smooth = basis @ np.linalg.lstsq(basis, residual, rcond=None)[0]
    return residual, residual - smooth, 2 * basis.shape[1]


def find_distortion_centre(
    views: Sequence[GridView], *, tau_px: float | None = None
) -> DistortionCentre:
    """Run Algorithm 1 on the views of one magnification.

    Parameters
    ----------
    views
        Views; those with fewer than 12 corners are ignored, since the cubic needs 10.
    tau_px
        With a value, the paper's threshold on the RMS homography error decides instead of the
        F-test.
    """
    usable = [v for v in views if len(v.board_xy_m) >= _FEWEST_CORNERS]
    mean = np.mean([v.image_xy.mean(axis=0) for v in views], axis=0)
    if not usable:
        return DistortionCentre(True, mean, float("nan"), float("nan"), 1.0)
    residual_sum = noise_sum = 0.0
    corners = smooth_freedom = 0
    for view in usable:
        residual, noise, coefficients = _smooth_part(view)
        residual_sum += float(np.sum(residual**2))
        noise_sum += float(np.sum(noise**2))
        corners += len(residual)
        # 8 of the coefficients describe what the homography has already fitted.
        smooth_freedom += coefficients - 8
    noise_freedom = max(2 * corners - 8 * len(usable) - smooth_freedom, 1)
    ratio = ((residual_sum - noise_sum) / smooth_freedom) / max(noise_sum / noise_freedom, 1e-300)
    p_value = float(fdtrc(smooth_freedom, noise_freedom, max(ratio, 0.0)))
    rms = float(np.sqrt(residual_sum / corners))
    degenerate = rms <= tau_px if tau_px is not None else p_value > _SIGNIFICANCE
    centre = mean
    if not degenerate:
        from_image = normalising_similarity(np.concatenate([v.image_xy for v in usable]))
        stack = np.hstack(
            [_radial_fundamental(v.board_xy_m, v.image_xy, from_image) for v in usable]
        )
        epipole = np.linalg.solve(from_image, np.linalg.svd(stack)[0][:, -1])
        centre = epipole[:2] / epipole[2]
    return DistortionCentre(
        degenerate, centre, rms, float(np.sqrt(2.0 * noise_sum / noise_freedom)), p_value
    )
