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

"""Ways to find the shift between two images, all called alike.

A method is given a :class:`~benchmarks.drift.pairs.Pair` and answers with the shift (x, y) and its 1-sigma
where it states one, or None where it refuses. Libraries that are not installed leave a method
without a function.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.drift.pairs import Array, Gray, Pair
from semcal_ros.core.registration.reference import Reference
from semcal_ros.core.registration.register import (
    Registration,
    prepare_reference,
    register,
    register_pair,
)

try:
    from skimage import registration as skimage_registration
except ImportError:
    skimage_registration = None
try:
    import imreg_dft
except ImportError:
    imreg_dft = None
try:
    from pystackreg import StackReg
except ImportError:
    StackReg = None

Answer = tuple[Array, Array | None] | None

# How far the prediction is off, 1-sigma, and said to be; it decides between repeats of the grid.
PREDICTION_PX = 4.0


@dataclass(frozen=True)
class Method:
    """A method.

    Attributes
    ----------
    name
        As printed.
    run
        Shift of a pair, given what ``prepare`` made of it; None where the library is missing.
    prepare
        Work that a stream does once for its reference; its time does not count.
    stream_only
        The time is that of a further image of a stream, not that of a pair.
    """

    name: str
    run: Callable[[Pair, Any], Answer] | None
    prepare: Callable[[Pair], Any] | None = None
    stream_only: bool = False


# -- ours ---------------------------------------------------------------------------------------------


def _answer(result: Registration) -> Answer:
    return (result.shift_px, np.sqrt(np.diag(result.covariance))) if result.accepted else None


def ours(pair: Pair, prepared: None) -> Answer:
    return _answer(register_pair(pair.reference, pair.image))


def reference_of(pair: Pair) -> Reference:
    return prepare_reference(pair.reference)


def ours_prepared(pair: Pair, prepared: Reference) -> Answer:
    return _answer(register(prepared, pair.image))


def ours_predicted(pair: Pair, prepared: Reference) -> Answer:
    known = np.eye(2) * PREDICTION_PX**2
    return _answer(register(prepared, pair.image, guess_px=pair.guess_px, guess_covariance=known))


# -- OpenCV -------------------------------------------------------------------------------------------


@lru_cache(maxsize=2)
def _hann(shape: tuple[int, int]) -> NDArray[np.float32]:
    return cv2.createHanningWindow(shape[::-1], cv2.CV_32F)


def phase_correlate_pictures(reference: Gray, image: Gray, window: bool = True) -> Array:
    a, b = reference.astype(np.float32), image.astype(np.float32)
    if not window:
        return np.array(cv2.phaseCorrelate(a, b)[0])
    return np.array(cv2.phaseCorrelate(a, b, _hann(image.shape))[0])


def phase_correlate(pair: Pair, prepared: None) -> Answer:
    return phase_correlate_pictures(pair.reference, pair.image), None


def phase_correlate_bare(pair: Pair, prepared: None) -> Answer:
    return phase_correlate_pictures(pair.reference, pair.image, window=False), None


def ecc(pair: Pair, prepared: None) -> Answer:
    pictures = [pair.reference, pair.image]
    if pair.image.dtype != np.uint8:
        pictures = [picture.astype(np.float32) for picture in pictures]
    warp = np.eye(2, 3, dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-6)
    try:
        _, warp = cv2.findTransformECC(*pictures, warp, cv2.MOTION_TRANSLATION, criteria, None, 5)
    except cv2.error:
        return None
    return warp[:, 2].astype(np.float64), None


# -- others -------------------------------------------------------------------------------------------


def _skimage(normalization: str | None) -> Callable[[Pair, None], Answer]:
    def method(pair: Pair, prepared: None) -> Answer:
        shift = skimage_registration.phase_cross_correlation(
            pair.reference, pair.image, upsample_factor=100, normalization=normalization
        )[0]
        return -np.asarray(shift, dtype=np.float64)[::-1], None

    return method


def imreg(pair: Pair, prepared: None) -> Answer:
    # Odds of 0: the image is never upside down, as its authors leave to be decided by the data.
    found = imreg_dft.translation(pair.reference, pair.image, odds=0)
    return -np.asarray(found["tvec"], dtype=np.float64)[::-1], None


def stackreg(pair: Pair, prepared: None) -> Answer:
    matrix = StackReg(StackReg.TRANSLATION).register_pair(pair.reference, pair.image)
    return matrix[:2, 2], None


UNIT = "cv2.phaseCorrelate, Hann"
METHODS = (
    Method("semcal", ours),
    Method("semcal, reference once", ours_prepared, reference_of, stream_only=True),
    Method("semcal, once + predicted", ours_predicted, reference_of, stream_only=True),
    Method(UNIT, phase_correlate),
    Method("cv2.phaseCorrelate", phase_correlate_bare),
    Method("cv2.findTransformECC", ecc),
    Method("skimage, default", _skimage("phase") if skimage_registration else None),
    Method("skimage, no normalization", _skimage(None) if skimage_registration else None),
    Method("imreg_dft", imreg if imreg_dft else None),
    Method("pystackreg", stackreg if StackReg else None),
)
