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

"""The line phase of a bidirectional scan: odd lines are shifted against even ones.

Lines that are scanned to the right and back to the left in turn lag behind the beam in opposite directions. A frame is
freed of that before anything else sees it: even and odd lines move by half of the phase each, towards each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import RESAMPLED_TYPES, AnyImage, Array, Array32
from semcal_ros.core.rectification.thresholds import (
    LANCZOS_LOBES,
    LINE_GROUPS,
    LINES_COMPARED,
    PHASE_CONVERGED,
    PHASE_EVERY,
    PHASE_FIRST_FRAMES,
    PHASE_MAX_PART,
    PHASE_MEMORY,
    PHASE_MIN_PX,
    PHASE_OF_PERIOD,
    PHASE_SIGMAS,
    PHASE_STEPS_MAX,
    REPEATED_PEAK,
    REPEATED_VALLEY,
    SMOOTHING_PX,
    STRUCTURE_SIGMAS,
    UNDECLARED_EVERY,
    UNDECLARED_FIRST_FRAMES,
)


@dataclass(frozen=True)
class LinePhase:
    """What lies at x in even lines is seen at ``x + shift_px`` in odd ones, 0 being even.

    Attributes
    ----------
    shift_px, sigma_px
        The phase and its 1-sigma; infinite where the image does not tell it.
    """

    shift_px: float
    sigma_px: float

    @property
    def is_seen(self) -> bool:
        """Whether there is one beyond chance."""
        return abs(self.shift_px) > max(PHASE_SIGMAS * self.sigma_px, PHASE_MIN_PX)


def estimate_line_phase(image: AnyImage) -> LinePhase:
    """Estimate the phase from one image, by lines against the mean of their neighbours.

    Edges at any slant have the same mean in the neighbours as in the line between them. It fails, with an infinite
    sigma, on images without structure along the lines, and on what repeats along all of them, unless the phase nearest
    to zero is below a quarter of the period. Then that one is taken, and one above three quarters is mistaken for it.

    Parameters
    ----------
    image
        (h, w) or (h, w, 3), at least 16 lines of 32 px.
    """
    height, width = image.shape[:2]
    largest = max(2, int(PHASE_MAX_PART * width))
    if height < 16 or width < 32:
        return LinePhase(0.0, np.inf)
    step = 2 * max(1, height // 2 // LINES_COMPARED)
    first = np.arange(1, height - 1, step)
    compared = [image[first + k] for k in (0, -1, 1)]
    if not all(np.all(np.isfinite(lines)) for lines in compared):
        return LinePhase(0.0, np.inf)
    line, above, below = (_prepare(lines) for lines in compared)
    mean = 0.5 * (above + below)
    window = np.hanning(width + 2)[1:-1].astype(np.float32)
    spectrum, other = np.fft.rfft(line * window), np.fft.rfft(mean * window)
    correlation = np.fft.irfft(np.sum(spectrum * np.conj(other), axis=0), width)
    lags = np.arange(-largest, largest + 1)
    chosen = _choose_lag(correlation[lags], lags)
    if chosen is None:
        return LinePhase(0.0, np.inf)
    shift = float(chosen)
    frequency = np.asarray(2j * np.pi * np.fft.rfftfreq(width), dtype=np.complex64)
    margin = slice(largest + 2, width - largest - 2)
    groups = np.arange(len(first)) * min(LINE_GROUPS, len(first)) // len(first)
    whole = np.fft.rfft(line)
    # The noise of the two has nothing in common, so that their gradients tell the structure's alone.
    fixed = np.fft.irfft(np.fft.rfft(mean) * frequency, width)[:, margin]
    sigma = np.inf
    for _ in range(PHASE_STEPS_MAX):
        moved = whole * np.exp(frequency * np.float32(shift))
        left = (np.fft.irfft(moved, width) - mean)[:, margin]
        slope = np.fft.irfft(moved * frequency, width)[:, margin]
        scores, common = np.sum(slope * left, axis=1), np.sum(slope * fixed, axis=1)
        total = float(common.sum())
        if total <= STRUCTURE_SIGMAS * _scatter(common, groups):
            return LinePhase(0.0, np.inf)
        step = float(scores.sum()) / total
        shift -= step
        sigma = _scatter(scores, groups) / total
        if abs(shift) > largest:
            return LinePhase(0.0, np.inf)
        if abs(step) < PHASE_CONVERGED * sigma:
            break
    # Lines that are all alike, as of a test picture, do not scatter.
    return LinePhase(shift, max(sigma, 1e-6))


def _choose_lag(correlation: Array, lags: NDArray[np.int_]) -> int | None:
    """The highest peak of the correlation; of several that are as high, the one nearest to zero if near enough."""
    top = int(np.argmax(correlation))
    highest = float(correlation[top])
    inner = correlation[1:-1]
    is_peak = (
        (inner >= correlation[:-2]) & (inner >= correlation[2:]) & (inner > REPEATED_PEAK * highest)
    )
    rivals = [top]
    for k in (np.flatnonzero(is_peak) + 1).tolist():
        between = correlation[min(k, top) : max(k, top) + 1]
        if float(between.min()) < REPEATED_VALLEY * highest:
            rivals.append(k)
    rivals.sort(key=lambda k: abs(int(lags[k])))
    nearest = int(lags[rivals[0]])
    period = min((abs(int(lags[k]) - nearest) for k in rivals[1:]), default=0)
    return None if len(rivals) > 1 and abs(nearest) >= PHASE_OF_PERIOD * period else nearest


def _scatter(values: Array, groups: NDArray[np.int_]) -> float:
    """1-sigma of the sum of values of single lines, from that of the sums of groups of them."""
    sums = np.bincount(groups, weights=values)
    return float(np.std(sums, ddof=1) * np.sqrt(len(sums)))


def _prepare(lines: AnyImage) -> Array32:
    """Grey lines without their mean, smoothed along themselves."""
    grey = lines.mean(axis=2) if lines.ndim == 3 else lines
    smooth = cv2.GaussianBlur(
        np.asarray(grey, dtype=np.float32), (0, 0), sigmaX=SMOOTHING_PX, sigmaY=1e-6
    )
    return np.asarray(smooth - smooth.mean(axis=1, keepdims=True))


def remove_line_phase(image: AnyImage, shift_px: float) -> AnyImage:
    """Return the image with even and odd lines moved towards each other, by half of the phase each.

    Parameters
    ----------
    image
        (h, w) or (h, w, 3); of another type than 8 or 16 bits and float32, it becomes float32.
    shift_px
        As in :class:`LinePhase`.
    """
    if image.dtype.name not in RESAMPLED_TYPES:
        image = image.astype(np.float32)
    out = np.empty_like(image)
    for parity, moved in ((0, 0.5 * shift_px), (1, -0.5 * shift_px)):
        lines: Any = np.ascontiguousarray(image[parity::2])
        # OpenCV's own resampling rounds positions to 1/32 px.
        reach = int(np.ceil(abs(moved))) + LANCZOS_LOBES
        distance = np.arange(-reach, reach + 1) + moved
        taps = (
            np.sinc(distance)
            * np.sinc(distance / LANCZOS_LOBES)
            * (np.abs(distance) < LANCZOS_LOBES)
        )
        out[parity::2] = cv2.sepFilter2D(
            lines, -1, taps / taps.sum(), np.array([1.0]), borderType=cv2.BORDER_REPLICATE
        )
    return out


class LinePhaseCorrector:
    """Frees the frames of a stream of their line phase, or says that they have one that nobody declared.

    Parameters
    ----------
    declared
        Whether the scan is bidirectional. If not, frames stay as they are.
    """

    def __init__(self, declared: bool) -> None:
        self.declared = declared
        self.phase = LinePhase(0.0, np.inf)
        self._frames = 0
        self._size: tuple[int, ...] = ()

    def correct(self, image: AnyImage) -> AnyImage:
        """Return the frame without its line phase, in which :attr:`phase` is the mean of the last estimates."""
        if image.shape != self._size:
            self._size, self._frames, self.phase = image.shape, 0, LinePhase(0.0, np.inf)
        first, every = (
            (PHASE_FIRST_FRAMES, PHASE_EVERY)
            if self.declared
            else (UNDECLARED_FIRST_FRAMES, UNDECLARED_EVERY)
        )
        if self._frames < first or self._frames % every == 0:
            self._add(estimate_line_phase(image))
        self._frames += 1
        if not self.declared or not np.isfinite(self.phase.sigma_px):
            return image
        return remove_line_phase(image, self.phase.shift_px)

    @property
    def note(self) -> str:
        """The phase that was removed, or that nobody declared, or that is not known; empty if there is none."""
        if self.declared and self._frames and not np.isfinite(self.phase.sigma_px):
            return "these pictures do not tell by how much odd lines are shifted against even ones: they were not moved"
        if not self.phase.is_seen:
            return ""
        size = f"{self.phase.shift_px:.2f} +- {self.phase.sigma_px:.1g} px"
        if self.declared:
            return f"odd lines, which were shifted against even ones by {size}, were moved back"
        return (
            f"odd lines are shifted against even ones by {size}, as in a bidirectional scan or an interlaced video: "
            "declare bidirectional: true under scan in the configuration"
        )

    def _add(self, found: LinePhase) -> None:
        old = self.phase
        if not np.isfinite(found.sigma_px):
            return
        apart = abs(found.shift_px - old.shift_px)
        if not apart < PHASE_SIGMAS * np.hypot(found.sigma_px, old.sigma_px):
            # Another dwell or magnification has another lag.
            self.phase = found
            return
        if not np.isfinite(old.sigma_px):
            self.phase = found
            return
        weights = np.array([PHASE_MEMORY * old.sigma_px**-2.0, found.sigma_px**-2.0])
        shift = float(weights @ [old.shift_px, found.shift_px] / weights.sum())
        self.phase = LinePhase(shift, float(weights.sum() ** -0.5))
