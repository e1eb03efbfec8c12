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

"""Pixels of a recording that do not show the specimen: burnt-in text, reflections, dirt on the detector."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np

from semcal_ros.core.arrays import AnyImage, Array32, Mask
from semcal_ros.core.errors import BagError

# An image of a hundred million pixels, 8 bits each.
_MOST_BYTES = 2**27


def read_mask(path: str | os.PathLike[str]) -> Mask:
    """Read a mask: (h, w), true where an image pixel of any kind is not black.

    Raises
    ------
    BagError
        If the file is no image, or all of it is black.
    """
    file = Path(path)
    try:
        if file.stat().st_size > _MOST_BYTES:
            raise BagError(f"--mask {file} of {file.stat().st_size} bytes", expected="an image")
        data = np.frombuffer(file.read_bytes(), dtype=np.uint8)
    except OSError as error:
        raise BagError(
            f"--mask {file}: {error.strerror}", expected="an image (PNG, TIFF, BMP)"
        ) from error
    image = None
    if len(data):
        try:
            image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
        except cv2.error:
            image = None
    if image is None:
        raise BagError(f"--mask {file}: not an image", expected="PNG, TIFF or BMP")
    # An alpha channel says nothing about black or white.
    colours = image if image.ndim == 2 else image[..., :3].max(axis=2)
    used = np.asarray(colours != 0, dtype=bool)
    if not used.any():
        raise BagError(
            f"--mask {file} is black all over",
            expected="white where the image is used, black elsewhere",
        )
    return used


def fit_mask(used: Mask, shape: tuple[int, int]) -> Mask:
    """Return the part of a mask that belongs to images of (height, width) px, without the rows of a databar.

    Raises
    ------
    BagError
        If it is of another size.
    """
    if used.shape[1] != shape[1] or used.shape[0] < shape[0]:
        raise BagError(
            f"--mask of {used.shape[1]} x {used.shape[0]} px for images of {shape[1]} x {shape[0]} px",
            expected="a mask of the size of the images, before --roi",
        )
    return used[: shape[0]]


def fill_masked(image: AnyImage, used: Mask) -> AnyImage:
    """Return an image whose pixels outside the mask continue their surroundings smoothly, in a copy.

    What is filled in has no edges or texture of its own, so that neither corners are found there nor drift
    is measured there. It is the pull-push interpolation of Gortler et al. (1996),
    doi:10.1145/237170.237200, over a pyramid. The border of the mask stays where it is and holds the drift back
    a little.

    Parameters
    ----------
    image
        (h, w) or (h, w, 3).
    used
        (h, w) true where the image is used.
    """
    if used.all():
        return image
    levels = image.astype(np.float32)
    weight = used.astype(np.float32)
    filled: Array32 = _pull_push(
        levels * (weight if image.ndim == 2 else weight[..., None]), weight
    )
    if image.dtype.kind == "u":
        filled = np.clip(np.rint(filled), 0, float(2 ** (8 * image.dtype.itemsize) - 1))
    out = image.copy()
    out[~used] = filled[~used].astype(image.dtype)
    return out


def _pull_push(weighted: Array32, weight: Array32) -> Array32:
    """Average by weight; where there is none, interpolate from a coarser level of the pyramid."""
    some = weight if weighted.ndim == 2 else weight[..., None]
    mean = weighted / np.maximum(some, 1e-6)
    if min(weight.shape) <= 2 or float(weight.min()) > 0.5:
        return np.asarray(mean)
    coarse = _pull_push(
        np.asarray(cv2.pyrDown(weighted), np.float32), np.asarray(cv2.pyrDown(weight), np.float32)
    )
    size = (weight.shape[1], weight.shape[0])
    below = cv2.pyrUp(coarse, dstsize=size)
    share = np.clip(some, 0.0, 1.0)
    return np.asarray(share * mean + (1.0 - share) * below)
