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

"""Ways to find the shift between two images, all called alike, and what their answers are worth.

A method is given a :class:`~benchmarks.drift.pairs.Pair` and answers with the shift (x, y) and its 1-sigma
where it states one, or None where it refuses. Libraries that are not installed leave a method
without a function.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
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

# Farther off than this is no measurement but another place.
WRONG_PX = 1.0
# A method that fails more often than this in a group cannot win it.
MOST_FAILURES = 0.05

HEADER = ["noise  method", "RMS px", "bound px", "RMS/bound", "bias px", "+-", "refused", "wrong"]
HEADER += ["err/sigma", "68 %", "95 %", "time", "cost", "wins"]


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


@dataclass(frozen=True)
class Score:
    """One row. Accuracy is of one coordinate, over the pairs that were neither refused nor wrong.

    Attributes
    ----------
    rms_px, bound_px
        RMS of the error and of the Cramer-Rao bound.
    bias_px, bias_sigma_px
        Mean error of the coordinate where it is larger, and the standard error of that mean.
    refused, wrong, pairs
        Counts.
    normalised, within_68, within_95
        RMS of the error over the stated sigma; fraction of errors within 1 and 1.96 sigma.
    time
        Ratio to phase correlation.
    """

    method: Method
    rms_px: float = np.nan
    bound_px: float = np.nan
    bias_px: float = np.nan
    bias_sigma_px: float = np.nan
    refused: int = 0
    wrong: int = 0
    pairs: int = 0
    normalised: float = np.nan
    within_68: float = np.nan
    within_95: float = np.nan
    time: float = np.nan

    @property
    def ratio(self) -> float:
        return self.rms_px / self.bound_px

    @property
    def fails(self) -> bool:
        return self.refused + self.wrong > MOST_FAILURES * self.pairs

    @property
    def cost(self) -> float:
        """Time to reach the variance of the bound by averaging; NaN for a method that fails."""
        return np.nan if self.fails else self.ratio**2 * self.time

    def row(self, label: str, wins: str) -> list[object]:
        """Cells under :data:`HEADER`."""
        if self.pairs == 0:
            return [label, "not installed", *[None] * (len(HEADER) - 2)]
        cells = [label, self.rms_px, self.bound_px, self.ratio, self.bias_px, self.bias_sigma_px]
        cells += [self.refused or None, self.wrong or None]
        cells += [self.normalised, self.within_68, self.within_95, self.time]
        return [*cells, "fails" if self.fails else self.cost, wins]


def score(method: Method, pairs: Sequence[Pair], answers: Sequence[Answer], time: float) -> Score:
    """Score of a method that ran."""
    errors, sigmas, bounds, refused, wrong = [], [], [], 0, 0
    for pair, answer in zip(pairs, answers, strict=True):
        if answer is None:
            refused += 1
            continue
        error = answer[0] - pair.shift
        # NaN is wrong too.
        if not np.max(np.abs(error)) < WRONG_PX:
            wrong += 1
            continue
        errors.append(error)
        bounds.append(pair.bound_px)
        if answer[1] is not None:
            sigmas.append(answer[1])
    counts = {"refused": refused, "wrong": wrong, "pairs": len(pairs), "time": time}
    if not errors:
        return Score(method, **counts)
    bias, deviation = _bias(np.array(errors))
    return Score(
        method,
        rms_px=_rms(errors),
        bound_px=_rms(bounds),
        bias_px=bias,
        bias_sigma_px=deviation,
        **counts,
        **(_stated(np.abs(np.array(errors) / np.array(sigmas))) if sigmas else {}),
    )


def _rms(values: Sequence[object]) -> float:
    return float(np.sqrt(np.mean(np.square(np.asarray(values, dtype=np.float64)))))


def _bias(errors: np.ndarray) -> tuple[float, float]:
    mean = errors.mean(axis=0)
    axis = int(np.argmax(np.abs(mean)))
    if len(errors) < 2:
        return float(abs(mean[axis])), np.nan
    return float(abs(mean[axis])), float(errors[:, axis].std(ddof=1) / np.sqrt(len(errors)))


def _stated(normalised: np.ndarray) -> dict[str, float]:
    return {
        "normalised": _rms(normalised),
        "within_68": float(np.mean(normalised < 1.0)),
        "within_95": float(np.mean(normalised < 1.96)),
    }


def winners(scores: Iterable[Score]) -> dict[str, Method]:
    """Whose cost is least, for a single ``pair`` and for a further image of a ``stream``."""
    able = [s for s in scores if s.cost == s.cost]
    tasks = {"pair": [s for s in able if not s.method.stream_only], "stream": able}
    return {task: min(few, key=lambda s: s.cost).method for task, few in tasks.items() if few}


def rows(scores: Sequence[Score], label: str) -> list[list[object]]:
    """Rows of one group of pairs, the winners marked."""
    best = winners(scores)
    return [
        s.row(f"{label}  {s.method.name}", ", ".join(t for t, m in best.items() if m is s.method))
        for s in scores
    ]


SUMMARY_HEADER = ["method", "groups", "fails in", "pair won", "stream won", "refused", "wrong"]

SUMMARY_HEADER += ["RMS/bound", "worst", "err/sigma", "time", "cost"]


def summary(groups: Sequence[Sequence[Score]]) -> list[list[object]]:
    """One row per method over all groups; medians are over the groups in which it does not fail."""
    best = [winners(group) for group in groups]
    out: list[list[object]] = []
    for method in METHODS:
        mine = [s for group in groups for s in group if s.method is method and s.pairs]
        if not mine:
            out.append([method.name, "not installed", *[None] * (len(SUMMARY_HEADER) - 2)])
            continue
        good = [s for s in mine if not s.fails]
        won = [sum(b.get(task) is method for b in best) for task in ("pair", "stream")]
        out.append(
            [method.name, len(mine), len(mine) - len(good)]
            + [None if method.stream_only else won[0], won[1]]
            + [sum(s.refused for s in mine), sum(s.wrong for s in mine)]
            + [_median([s.ratio for s in good]), max((s.ratio for s in good), default=np.nan)]
            + [_median([s.normalised for s in good])]
            + [_median([s.time for s in good]), _median([s.cost for s in good])]
        )
    return out


def _median(values: Sequence[float]) -> float:
    known = [value for value in values if value == value]
    return float(np.median(known)) if known else np.nan
