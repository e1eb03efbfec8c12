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

"""Affine alignment of two images, with its covariance: how one is scaled, stretched and sheared against the other.

The enhanced correlation coefficient (Evangelidis and Psarakis 2008, doi:10.1109/TPAMI.2008.113) is maximised with
OpenCV, from a shift found by normalised correlation. The covariance is that of the least-squares problem at the
optimum, for residuals that are correlated over some pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from semcal_ros.core.arrays import Array, Array32
from semcal_ros.core.errors import InvalidValueError, SemcalError
from semcal_ros.core.registration.thresholds import (
    AFFINE_BORDER_PX,
    AFFINE_CONVERGED,
    AFFINE_CORRELATION_MIN,
    AFFINE_FLOOR_PX,
    AFFINE_LAGS_PX,
    AFFINE_SMOOTHED_PX,
    AFFINE_STEPS_MAX,
)


class NotAlignedError(SemcalError):
    """Two images do not show the same specimen, or too little of it."""


@dataclass(frozen=True, eq=False)
class AffineAlignment:
    """Where the pixels of a template lie in an image: ``x_image = matrix x_template + shift``.

    Attributes
    ----------
    matrix, shift_px
        (2, 2) and (2,).
    covariance
        (4, 4) of the matrix, row by row.
    correlation
        Correlation of both, 0 to 1.
    """

    matrix: Array
    shift_px: Array
    covariance: Array
    correlation: float


def align_affine(template: Array32, image: Array32) -> AffineAlignment:
    """Align a template, which shows part of an image, with it.

    Parameters
    ----------
    template, image
        (h, w) grey levels; the template is not larger, and nearly of the same scale and orientation (to 5 %).

    Raises
    ------
    NotAlignedError
        If they do not show the same.
    InvalidValueError
        If the template is larger than the image, or smaller than 48 px.
    """
    if min(template.shape) < 48 or any(
        t > i for t, i in zip(template.shape, image.shape, strict=True)
    ):
        raise InvalidValueError(
            f"a template of {template.shape[1]} x {template.shape[0]} px for an image of "
            f"{image.shape[1]} x {image.shape[0]} px",
            expected="at least 48 px, and not more than the image",
        )
    small, large = (
        np.asarray(cv2.GaussianBlur(part, (0, 0), AFFINE_SMOOTHED_PX), dtype=np.float32)
        for part in (template, image)
    )
    border = AFFINE_BORDER_PX
    inner = np.ascontiguousarray(small[border:-border, border:-border])
    scores = cv2.matchTemplate(large, inner, cv2.TM_CCOEFF_NORMED)
    _, best, _, (left, top) = cv2.minMaxLoc(scores)
    if not best >= 0.5 * AFFINE_CORRELATION_MIN:
        raise NotAlignedError(
            f"images that correlate by {best:.2f} at most",
            expected="two images of one place, with texture, no more than a factor of 4 apart",
        )
    warp = np.array([[1.0, 0.0, left], [0.0, 1.0, top]], dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, AFFINE_STEPS_MAX, AFFINE_CONVERGED)
    try:
        correlation, warp = cv2.findTransformECC(
            inner,
            large,
            warp,
            cv2.MOTION_AFFINE,
            criteria,
            None,
            1,  # type: ignore[call-overload,unused-ignore]  # OpenCV takes no mask, its stubs want one
        )
    except cv2.error as error:
        raise NotAlignedError(
            "images whose alignment does not converge",
            expected="two images of one place, with texture",
        ) from error
    if not correlation >= AFFINE_CORRELATION_MIN:
        raise NotAlignedError(
            f"images that correlate by {correlation:.2f}",
            expected="two images of one place, with texture",
        )
    matrix = np.asarray(warp[:, :2], dtype=np.float64)
    shift = np.asarray(warp[:, 2], dtype=np.float64) - matrix @ np.full(2, float(border))
    covariance = _estimate_covariance(inner, large, warp)
    return AffineAlignment(matrix, shift, covariance, float(correlation))


def _estimate_covariance(template: Array32, image: Array32, warp: Array32) -> Array:
    """Estimate the (4, 4) covariance of the matrix of a warp."""
    size = (template.shape[1], template.shape[0])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    seen = np.asarray(cv2.warpAffine(image, warp, size, flags=flags), dtype=np.float64)
    wanted = template.astype(np.float64)
    # Gain and offset of the grey levels are free.
    gain, offset = np.polyfit(seen.ravel(), wanted.ravel(), 1)
    residual = wanted - (gain * seen + offset)
    slope_y, slope_x = (gain * slope for slope in np.gradient(seen))
    y, x = np.mgrid[0 : size[1], 0 : size[0]].astype(np.float64)
    x, y = x - x.mean(), y - y.mean()
    columns = [slope_x * x, slope_x * y, slope_x, slope_y * x, slope_y * y, slope_y]
    design = np.stack([column.ravel() for column in (*columns, seen, np.ones_like(seen))], axis=1)
    scale = np.linalg.norm(design, axis=0)
    inverse = np.linalg.pinv((design / scale).T @ (design / scale))
    variance = float(np.mean(residual**2)) * _sum_correlation(residual)
    covariance = variance * inverse / np.outer(scale, scale)
    keep = [0, 1, 3, 4]
    floor = np.tile((AFFINE_FLOOR_PX / (0.5 * np.array(size))) ** 2, 2)
    return np.asarray(covariance[np.ix_(keep, keep)] + np.diag(floor), dtype=np.float64)


def _sum_correlation(residual: Array) -> float:
    """Sum the autocorrelation of residuals: the number of pixels that share their error."""
    centred = residual - residual.mean()
    power = float(np.mean(centred**2)) or 1.0
    total = 0.0
    for dy in range(-AFFINE_LAGS_PX, AFFINE_LAGS_PX + 1):
        for dx in range(-AFFINE_LAGS_PX, AFFINE_LAGS_PX + 1):
            first = centred[
                max(dy, 0) : centred.shape[0] + min(dy, 0),
                max(dx, 0) : centred.shape[1] + min(dx, 0),
            ]
            second = centred[
                max(-dy, 0) : centred.shape[0] + min(-dy, 0),
                max(-dx, 0) : centred.shape[1] + min(-dx, 0),
            ]
            total += float(np.mean(first * second))
    return max(total / power, 1.0)
