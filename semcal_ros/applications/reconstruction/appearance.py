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

"""Shading and texture of the specimen: images without shading, and how brightness depends on the normal.

The yield of secondary electrons grows with the slope of the surface, so shading stays with the
slope while the texture turns with the specimen: tracked features would be pulled against the
movement, most of all near the limb. Texture multiplies shading; after a square root (which also
makes shot noise uniform) and with the local mean and contrast divided out, only texture remains.

Patches keep the logarithm of their grey levels, and the shading in them is estimated. It grows with the angle
between beam and normal, and depends on the side of the detector: one function of the normal's direction in all views.
Within a patch this function has a slope, which pulls the patch against the movement of its texture: measured positions
move less than the specimen does, and a ball comes out too small.

The patches of a point are its texture plus this function along the normals that each view sees. Taking
the mean of every patch and of every sample over the views removes the texture; what is left is linear in
the coefficients of the function (a two-way analysis of variance).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.applications.reconstruction.thresholds import (
    COSINE2_MIN,
    LIMB_TERMS,
    SECOND_DIFFERENCE,
    SHADING_CONDITION,
    SHADING_DEGREE,
    SHADING_NODES,
    SHADING_OUTLIER,
)
from semcal_ros.core.arrays import Array, Image, Indices, mad_sigma


@dataclass(frozen=True, eq=False)
class Appearance:
    """An image prepared for comparison with others.

    Attributes
    ----------
    smooth
        (h, w) square root of the grey level, slightly smoothed.
    texture
        (h, w) the same less its local mean, over its local contrast.
    noise
        1-sigma of the noise of a pixel before smoothing, in the unit of ``smooth``.
    smoothing_px
        Sigma of the smoothing.
    """

    smooth: Image
    texture: Image
    noise: float
    smoothing_px: float

    def corner_response(self, block: int = 7) -> tuple[Image, float]:
        """Compute the smaller eigenvalue of the structure tensor, and its mean for noise alone."""
        response = cv2.cornerMinEigenVal(self.smooth, block, ksize=3)
        # Sobel of size 3 is 8 derivatives; OpenCV divides by 4 and the block, and sums over the
        # block.
        gradient = self.noise**2 / (8.0 * math.pi * self.smoothing_px**4)
        return np.asarray(response, dtype=np.float32), 4.0 * gradient


def prepare_appearance(
    image: NDArray[Any], *, smoothing_px: float = 1.0, local_px: float = 6.0
) -> Appearance:
    """Extract the texture of a grey image (h, w) of any depth."""
    grey = np.sqrt(np.maximum(image.astype(np.float32), 0.0))
    noise = _estimate_noise(grey)
    smooth = np.asarray(cv2.GaussianBlur(grey, (0, 0), smoothing_px), dtype=np.float32)
    high = smooth - _blur_widely(smooth, local_px)
    power = _blur_widely(high * high, local_px)
    # Where there is only noise, it must not be amplified to look like texture.
    floor = noise**2 / (4.0 * math.pi * smoothing_px**2)
    texture = high / np.sqrt(power + np.float32(floor + 1e-12))
    return Appearance(smooth, np.asarray(texture, dtype=np.float32), noise, smoothing_px)


def compute_log_grey(image: NDArray[Any]) -> Image:
    """Compute the logarithm of a grey image (h, w) of any depth: shading adds to texture.

    Grey levels below what noise alone gives are raised to it: their logarithm has no bound.
    """
    grey = np.sqrt(np.maximum(image.astype(np.float32), 0.0))
    least = np.float32(max(_estimate_noise(grey), 1e-3))
    return np.asarray(2.0 * np.log(np.maximum(grey, least)), dtype=np.float32)


def convert_for_tracking(appearance: Appearance) -> NDArray[np.uint8]:
    """Convert the texture to an 8-bit image for OpenCV's tracker."""
    levels = np.rint(128.0 + 40.0 * appearance.texture)
    return np.asarray(np.clip(levels, 0, 255), dtype=np.uint8)


def _blur_widely(image: Image, sigma_px: float) -> Image:
    """Apply two running means, close to a Gaussian of this sigma; any width costs the same."""
    side = 2 * round(0.5 * math.sqrt(6.0 * sigma_px**2)) + 1
    once = cv2.blur(image, (side, side))
    return np.asarray(cv2.blur(once, (side, side)), dtype=np.float32)


def _estimate_noise(grey: Image) -> float:
    """Estimate pixel noise from second differences, free of most texture (Immerkaer 1996)."""
    rough = cv2.filter2D(grey, cv2.CV_32F, SECOND_DIFFERENCE)[1:-1, 1:-1]
    return mad_sigma(rough)


@dataclass(frozen=True, eq=False)
class Shading:
    """Brightness as a function of the normal.

    Attributes
    ----------
    table
        (nodes, nodes) over Y and X of the unit normal in the sem frame, both from -1 to 1; grey levels in
        the unit of the patches, up to a constant.
    """

    table: Image

    def evaluate(self, slope: Array) -> Image:
        """Evaluate at X and Y of unit normals, (n, samples, 2) -> (n, samples)."""
        at = ((slope + 1.0) * (0.5 * (len(self.table) - 1))).astype(np.float32)
        if not at.size:
            # A view that no point faces: OpenCV refuses an empty picture.
            return np.zeros(at.shape[:2], dtype=np.float32)
        out = cv2.remap(
            self.table, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return np.asarray(out, dtype=np.float32).reshape(at.shape[:2])


def fit_shading(slope: Array, grey: Array, point: Indices) -> Shading:
    """Fit the brightness that patches of the same points share as a function of the normal.

    Parameters
    ----------
    slope
        (patches, samples, 2) X and Y of the unit normals in the sem frame.
    grey
        (patches, samples) grey levels; sample k of a point is the same place of the surface in all of its
        patches.
    point
        (patches,) number of the point.
    """
    terms = (SHADING_DEGREE + 1) * (SHADING_DEGREE + 2) // 2 - 1 + LIMB_TERMS
    solution = np.zeros(terms)
    if len(point):
        basis = _evaluate_basis(slope)
        basis -= basis.mean(axis=1, keepdims=True)
        value = grey - grey.mean(axis=1, keepdims=True)
        keep = np.ones(len(point), dtype=bool)
        for _ in range(2):
            rows = _subtract_means(basis[keep], point[keep])
            right = _subtract_means(value[keep][..., None], point[keep])[..., 0]
            flat = rows.reshape(-1, terms)
            scale = np.sqrt(np.mean(flat**2, axis=0)) + 1e-12
            found = np.linalg.lstsq(flat / scale, right.ravel(), rcond=SHADING_CONDITION)[0]
            solution = found / scale
            error = np.sqrt(np.mean((right - rows @ solution) ** 2, axis=1))
            keep[np.flatnonzero(keep)[error > SHADING_OUTLIER * np.median(error)]] = False
    axis = np.linspace(-1.0, 1.0, SHADING_NODES)
    nodes = np.stack(np.meshgrid(axis, axis), axis=-1)
    return Shading(np.asarray(_evaluate_basis(nodes) @ solution, dtype=np.float32))


def _evaluate_basis(slope: Array) -> Array:
    """Evaluate (..., terms) functions of the normal's X and Y."""
    x, y = slope[..., 0], slope[..., 1]
    cosine = np.sqrt(np.maximum(1.0 - x * x - y * y, COSINE2_MIN))
    limb = np.log(cosine)
    powers = [
        (i, j) for i in range(SHADING_DEGREE + 1) for j in range(SHADING_DEGREE + 1 - i) if i + j
    ]
    terms = [x**i * y**j for i, j in powers]
    return np.stack([*terms, limb, limb * x, limb * y, 1.0 / cosine], axis=-1)


def _subtract_means(values: Array, point: Indices) -> Array:
    """Subtract from (patches, samples, terms) the mean over the patches of the same point."""
    _, index, count = np.unique(point, return_inverse=True, return_counts=True)
    order = np.argsort(index, kind="stable")
    starts = np.concatenate([[0], np.cumsum(count)[:-1]])
    sums = np.add.reduceat(values[order], starts, axis=0)
    return np.asarray(values - (sums / count[:, None, None])[index], dtype=np.float64)
