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

"""Saddle points of a smoothed image: the candidates for checkerboard corners at one scale."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcal_ros.core.arrays import Array, Image, check_image
from semcal_ros.core.corners.thresholds import (
    IMAGE_SIDE_MIN_PX,
    SADDLE_AREA,
    SADDLE_THRESHOLD,
    SADDLES_MIN,
    SATURATED_MAX,
    STRONG_RANK,
)
from semcal_ros.core.errors import InvalidValueError, Rejection


class LatticeStatus(Enum):
    """Why an image gives no lattice."""

    NOT_FINITE = "values that are not finite"
    BLANK = "blank"
    SATURATED = "saturated"
    NO_LATTICE = "no grid"
    TWO_BOARDS = "two boards"
    TOO_FEW_CORNERS = "too few corners"
    OTHER_PATTERN = "another pattern"


@dataclass(frozen=True)
class SaddlePoints:
    """Saddle points, strongest first.

    Attributes
    ----------
    xy
        (n, 2) positions, px, accurate to a few tenths.
    hessian
        (n, 2, 2) Hessian of the smoothed image at the points.
    response
        (n,) minus the determinant of the Hessian, normalised by the scale.
    """

    xy: Array
    hessian: Array
    response: Array


def find_saddles(image: Image, scale_px: float) -> SaddlePoints:
    """Find local maxima of ``-det(Hessian)`` of the image smoothed by a Gaussian.

    Parameters
    ----------
    image
        (h, w) float32.
    scale_px
        Standard deviation of the Gaussian, px; a quarter of the spacing of the corners is a good
        choice.
    """
    smooth = cv2.GaussianBlur(image, (0, 0), scale_px, borderType=cv2.BORDER_REFLECT_101)
    kernel_2 = np.array([1.0, -2.0, 1.0], dtype=np.float32)
    kernel_1 = np.array([-0.5, 0.0, 0.5], dtype=np.float32)
    kernel_0 = np.ones(1, dtype=np.float32)

    def derive(kernel_x: Image, kernel_y: Image) -> NDArray[np.float32]:
        return cv2.sepFilter2D(
            smooth, cv2.CV_32F, kernel_x, kernel_y, borderType=cv2.BORDER_REPLICATE
        ).astype(np.float32, copy=False)

    xx, yy, xy = derive(kernel_2, kernel_0), derive(kernel_0, kernel_2), derive(kernel_1, kernel_1)
    response = (xy * xy - xx * yy) * np.float32(scale_px**4)
    most = max(SADDLES_MIN, int(image.size / (SADDLE_AREA * scale_px**2)))
    rows, columns = _strong_maxima(response, scale_px, most)
    hessian = np.empty((len(rows), 2, 2))
    hessian[:, 0, 0] = xx[rows, columns]
    hessian[:, 1, 1] = yy[rows, columns]
    hessian[:, 0, 1] = hessian[:, 1, 0] = xy[rows, columns]
    gradient = np.stack(
        [derive(kernel_1, kernel_0)[rows, columns], derive(kernel_0, kernel_1)[rows, columns]],
        axis=1,
    ).astype(np.float64)
    # One Newton step to where the gradient vanishes; it is small at a true saddle.
    across = np.stack(
        [
            hessian[:, 1, 1] * gradient[:, 0] - hessian[:, 0, 1] * gradient[:, 1],
            hessian[:, 0, 0] * gradient[:, 1] - hessian[:, 0, 1] * gradient[:, 0],
        ],
        axis=1,
    )
    determinant = hessian[:, 0, 0] * hessian[:, 1, 1] - hessian[:, 0, 1] ** 2
    step = -across / determinant[:, None]
    step *= np.minimum(1.0, 1.0 / np.maximum(np.linalg.norm(step, axis=1, keepdims=True), 1e-12))
    points = np.stack([columns, rows], axis=1) + step
    return SaddlePoints(points, hessian, response[rows, columns].astype(np.float64))


def _strong_maxima(
    response: Image, scale_px: float, most: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    radius = max(1, round(1.2 * scale_px))
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
    peaks = (response >= cv2.dilate(response, kernel)) & (response > 0)
    # The second derivative is undefined on the rim of the frame.
    peaks[[0, -1], :] = False
    peaks[:, [0, -1]] = False
    rows, columns = np.nonzero(peaks)
    strength = response[rows, columns]
    order = np.argsort(-strength, kind="stable")
    if len(order):
        strong = strength[order[min(STRONG_RANK, len(order)) - 1]]
        order = order[strength[order] > SADDLE_THRESHOLD * strong][:most]
    return rows[order].astype(np.int64), columns[order].astype(np.int64)


def prepare_image(image: ArrayLike, databar_rows: int) -> NDArray[np.float32]:
    """Return the image as (h, w) float32 without its databar.

    Raises
    ------
    InvalidValueError
        If it is not a two-dimensional image of numbers, or is too small.
    """
    values = check_image(image, channels=(1,), do="convert colour images to grey first")
    if (
        not 0 <= databar_rows <= values.shape[0] - IMAGE_SIDE_MIN_PX
        or values.shape[1] < IMAGE_SIDE_MIN_PX
    ):
        raise InvalidValueError(
            f"an image of {values.shape[1]} x {values.shape[0]} px"
            f" with {databar_rows} databar rows",
            expected=f"at least {IMAGE_SIDE_MIN_PX} x {IMAGE_SIDE_MIN_PX} px without the databar",
        )
    rows = values.shape[0] - databar_rows
    return np.ascontiguousarray(values[:rows], dtype=np.float32)


def screen_image(image: Image) -> Image | Rejection[LatticeStatus]:
    """Scale the image to a contrast of about 1, or reject it as blank or saturated."""
    sample = image[::2, ::2]
    if not np.all(np.isfinite(image)):
        return Rejection(LatticeStatus.NOT_FINITE, "the image has values that are not finite")
    low, high = (float(v) for v in np.percentile(sample, [1.0, 99.0]))
    top, bottom = float(image.max()), float(image.min())
    if top - bottom <= 0.0:
        return Rejection(LatticeStatus.BLANK, "the image is blank: every pixel has the same value")
    at_limit = max(float(np.mean(sample >= top)), float(np.mean(sample <= bottom)))
    if high <= low or at_limit > 0.9:
        return Rejection(
            LatticeStatus.BLANK,
            "the image is blank or saturated: nearly all pixels have the same value",
        )
    if float(np.mean((sample >= top) | (sample <= bottom))) > SATURATED_MAX and _two_levels(sample):
        return (image - np.float32(low)) / np.float32(high - low)
    if at_limit > SATURATED_MAX:
        part = round(100.0 * at_limit)
        return Rejection(
            LatticeStatus.SATURATED,
            f"the image is saturated: {part} % of the pixels are at a limit",
        )
    return (image - np.float32(low)) / np.float32(high - low)


def _two_levels(sample: NDArray[np.float32]) -> bool:
    """Return whether both limits are common: a clean two-level board is not saturated."""
    top = float(np.mean(sample >= sample.max()))
    bottom = float(np.mean(sample <= sample.min()))
    return min(top, bottom) > 0.2
