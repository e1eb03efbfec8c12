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

"""Noise level of an image, and the smoothing that makes its shift best determined.

For two images with the same signal spectrum S and white noise N and M, the variance of a shift
estimated through the power weighting ``psi`` is (Knapp and Carter 1976,
doi:10.1109/TASSP.1976.1162830)

    var(psi)  ~  integral w^2 psi^2 (S (N + M) + N M)  /  (integral w^2 psi S)^2

A Gaussian of width sigma applied to both images is ``psi = exp(-w^2 sigma^2)``; the best sigma is
looked up on the radial spectrum. S is only known as the difference of what is seen and of the noise, and where it is
small, chance decides over it: most at high frequencies, which count by w^2. So the smallest integral that the scatter
of the spectrum allows is what divides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from statistics import NormalDist
from typing import TypeAlias

import cv2
import numpy as np
import scipy.fft

from semcal_ros.core.arrays import AnyImage, Array, Image, Indices
from semcal_ros.core.registration.thresholds import (
    GAUSSIAN_SIGMAS,
    NOISE_BAND,
    NOISE_ERROR,
    NOISE_SPECTRUM_PX,
    RICH_PART_PX,
    RICH_PARTS,
    RICH_VARIANCE_MAX,
    SIGNAL_SIGMAS,
    SMOOTHING_FREQUENCIES,
    SMOOTHING_SIGMAS,
    SMOOTHINGS_PX,
    SPECTRUM_PX,
    SPECTRUM_RINGS,
)

# Derived: the deviation that half of all normal ones do not reach; robust sigmas are those of the median.
_MEDIAN = NormalDist().inv_cdf(0.75)


@dataclass(frozen=True)
class ImageStatistics:
    """What an image's radial spectrum says.

    Attributes
    ----------
    noise_variance
        Variance of the white part per pixel, in squared grey levels.
    signal_variance
        Variance of the rest.
    signal_to_noise
        That over the variance of the noise before it was resampled, where such an image is known.
    sigma_px
        Width of the Gaussian that minimises the variance of a shift; 0 for none.
    significance
        By how many standard errors its gradient is more than that of white noise, at the width where it is most.
    """

    noise_variance: float
    signal_variance: float
    signal_to_noise: float
    sigma_px: float
    significance: float


@lru_cache(maxsize=8)
def _rings(rows: int, cols: int) -> tuple[Array, Indices, Array, Array]:
    """Window, ring of each coefficient, radial frequency (rad/px) and size of each ring."""
    window = np.outer(np.hanning(rows + 2)[1:-1], np.hanning(cols + 2)[1:-1])
    radius = np.hypot(np.fft.fftfreq(rows)[:, None], np.fft.rfftfreq(cols)[None, :])
    ring = np.minimum(
        (radius / np.sqrt(0.5) * SPECTRUM_RINGS).astype(int), SPECTRUM_RINGS - 1
    ).ravel()
    count = np.bincount(ring, minlength=SPECTRUM_RINGS).astype(np.float64)
    middle = 2.0 * np.pi * np.sqrt(0.5) * (np.arange(SPECTRUM_RINGS) + 0.5) / SPECTRUM_RINGS
    return window, ring, middle, count


@lru_cache(maxsize=8)
def _corners(rows: int, cols: int) -> tuple[Array, Array, Indices, float]:
    """Window, the same with the sum 1, indices of the coefficients that hold noise only, and the window's
    energy.
    """
    window, ring, middle, _ = _rings(rows, cols)
    corners = np.flatnonzero(middle[ring] > NOISE_BAND * np.pi)
    return window, window / window.sum(), corners, float(np.sum(window**2))


def _cut_middle(image: AnyImage, crop_px: int) -> Array:
    rows, cols = min(image.shape[0], crop_px), min(image.shape[1], crop_px)
    top, left = (image.shape[0] - rows) // 2, (image.shape[1] - cols) // 2
    return image[top : top + rows, left : left + cols].astype(np.float64)


# Radial frequency (rad/px), mean power per pixel and number of coefficients of each ring.
_Spectrum: TypeAlias = tuple[Array, Array, Array]


def _radial_spectrum(image: AnyImage, crop_px: int) -> _Spectrum:
    """The spectrum of the middle of an image."""
    crop = _cut_middle(image, crop_px)
    window, ring, middle, count = _rings(*crop.shape)
    crop = (crop - float(np.sum(crop * window) / window.sum())) * window
    spectrum = scipy.fft.rfft2(crop).ravel()
    power = (spectrum.real**2 + spectrum.imag**2) / float(np.sum(window**2))
    total = np.bincount(ring, weights=power, minlength=SPECTRUM_RINGS)
    filled = count > 0
    return middle[filled], (total[filled] / count[filled]), count[filled]


def _noise_floor(w: Array, power: Array, count: Array) -> float:
    """Mean power in the corners of the spectrum."""
    corners = w > NOISE_BAND * np.pi
    return float(np.average(power[corners], weights=count[corners]))


def estimate_noise_variance(image: AnyImage) -> float:
    """Variance of the white part of ``image`` per pixel, from its middle."""
    crop = _cut_middle(image, NOISE_SPECTRUM_PX)
    # Of the spectrum, only its corners.
    window, weights, corners, energy = _corners(*crop.shape)
    crop = (crop - float(np.vdot(crop, weights))) * window
    noise = scipy.fft.rfft2(crop).take(corners)
    return float(np.vdot(noise, noise).real) / (len(corners) * energy)


def measure_richest_parts(
    image: AnyImage, averaged: float = 1.0, raw: AnyImage | None = None
) -> ImageStatistics:
    """The same as :func:`measure_image` of those parts of a sparse image that show most, by their mean spectrum.

    The smoothing is the strongest of those nearly as good as the best: tiles show more of themselves.
    """
    height, width = image.shape
    steps = [np.arange(0, n - RICH_PART_PX + 1, RICH_PART_PX // 2) for n in (height, width)]
    places = [(int(y), int(x)) for y in steps[0] for x in steps[1]]
    small = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0)
    variances = [float(small[y : y + RICH_PART_PX, x : x + RICH_PART_PX].var()) for y, x in places]
    richest = [places[k] for k in np.argsort(variances)[::-1]]
    chosen: list[tuple[int, int]] = []
    for y, x in richest:
        if all(max(abs(y - b), abs(x - a)) >= RICH_PART_PX for b, a in chosen):
            chosen.append((y, x))
        if len(chosen) == RICH_PARTS:
            break
    parts = [np.s_[y : y + RICH_PART_PX, x : x + RICH_PART_PX] for y, x in chosen]

    def spectrum(whole: AnyImage) -> _Spectrum:
        return _mean_spectrum([_radial_spectrum(whole[part], RICH_PART_PX) for part in parts])

    before = None if raw is None else spectrum(raw)
    return _judge_spectrum(spectrum(image), averaged, before, RICH_VARIANCE_MAX)


def measure_image(
    image: AnyImage,
    averaged: float = 1.0,
    raw: AnyImage | None = None,
    side_px: int = SPECTRUM_PX,
) -> ImageStatistics:
    """Noise, signal and the best smoothing of ``image`` (at least 16 x 16 px).

    Parameters
    ----------
    image
        (h, w) grey levels.
    averaged
        Number of images that ``image`` is the mean of: a single image has this many times its noise
        variance.
    raw
        One of these images before it was resampled. Interpolation takes noise away at high frequencies
        and leaves it at lower ones, where the signal is; only the noise of the raw image is white.
    side_px
        Largest side of the part that is looked at, from the middle.

    The noise is read from the corners of the spectrum beyond 0.45 cycles per px; an image with
    texture up to there is taken for a noisier one, which costs a little precision and no bias.
    """
    before = None if raw is None else _radial_spectrum(raw, side_px)
    return _judge_spectrum(_radial_spectrum(image, side_px), averaged, before)


def _mean_spectrum(spectra: Sequence[_Spectrum]) -> _Spectrum:
    """Return the spectrum of several parts of one size."""
    w, _, count = spectra[0]
    return w, np.mean([power for _, power, _ in spectra], axis=0), len(spectra) * count


def _judge_spectrum(
    spectrum: _Spectrum, averaged: float, raw: _Spectrum | None, variance_max: float = 1.0
) -> ImageStatistics:
    """Return what :func:`measure_image` does, from the spectra of the image and of the one before it was resampled.

    ``variance_max`` is by what a stronger smoothing than the best may raise the variance of a shift.
    """
    w, power, count = spectrum
    noise = white = _noise_floor(w, power, count)
    corners = float(np.sum(count[w > NOISE_BAND * np.pi]))
    # The error of the noise is common to all rings.
    error2 = 2.0 / corners
    if averaged > 1.0:
        error2 += NOISE_ERROR**2
    if raw is not None:
        white = max(noise, _noise_floor(*raw) / averaged)
    signal_variance = float(np.sum(_find_signal(power, white, count) * count) / np.sum(count))
    if white <= 0.0:
        return ImageStatistics(noise, signal_variance, float("inf"), 0.0, float("inf"))
    ratio = signal_variance / white
    scatter = np.sqrt(2.0 / count)
    signal = power - white
    # Interpolation took noise away where little is left of it: that is no signal below zero.
    signal = np.where(signal < -SIGNAL_SIGMAS * scatter * white, 0.0, signal)
    psi = np.exp(-np.outer(SMOOTHINGS_PX**2, w**2))
    steep = count * w**2
    gradient = psi @ (steep * signal)
    common = error2 * (psi @ steep * white) ** 2
    by_chance = np.sqrt(psi**2 @ (steep * scatter * white) ** 2 + common)
    significance = float(np.max(gradient / by_chance))
    least = gradient - SMOOTHING_SIGMAS * np.sqrt(psi**2 @ (steep * scatter * power) ** 2 + common)
    is_known = least > 0.0
    if not np.any(is_known):
        return ImageStatistics(
            noise, signal_variance, ratio, float(SMOOTHINGS_PX[-1]), significance
        )
    single = white * averaged
    noisy = (white + single) * np.maximum(signal, 0.0) + white * single
    variances = (psi**2 @ (steep * noisy))[is_known] / least[is_known] ** 2
    best = SMOOTHINGS_PX[is_known][variances <= variance_max * np.min(variances)][-1]
    return ImageStatistics(noise, signal_variance, ratio, float(best), significance)


def _find_signal(power: Array, noise: float, count: Array) -> Array:
    """Power of each ring above white noise; zero where it is not clearly above."""
    # A ring's estimate scatters; what is not clearly above the noise is not signal.
    scatter = noise * np.sqrt(2.0 / count)
    return np.where(power - noise > SIGNAL_SIGMAS * scatter, power - noise, 0.0)


@lru_cache(maxsize=32)
def gaussian_taps(sigma_px: float) -> Array:
    """Odd number of weights of a Gaussian, summing to one; ``[1]`` for sigma 0."""
    if sigma_px <= 0.0:
        return np.array([1.0])
    reach = max(1, int(np.ceil(GAUSSIAN_SIGMAS * sigma_px)))
    taps = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma_px) ** 2)
    return np.asarray(taps / taps.sum())


def passed_variance(sigma_px: float) -> float:
    """What :func:`smooth` leaves of a variance of white noise of one."""
    return float(np.sum(gaussian_taps(sigma_px) ** 2)) ** 2


def passed_gradient(sigma_px: float) -> float:
    """Variance, per px^2, of the gradient along each axis of white noise of variance one after :func:`smooth`."""
    frequency = 2.0 * np.pi * np.fft.fftfreq(SMOOTHING_FREQUENCIES)
    power = np.abs(np.fft.fft(gaussian_taps(sigma_px), SMOOTHING_FREQUENCIES)) ** 2
    return float(np.mean(frequency**2 * power) * np.mean(power))


def shared_pixels(sigma_px: float) -> float:
    """How many pixels of white noise have one error in common after :func:`smooth`."""
    return float(1.0 + 4.0 * np.pi * sigma_px**2)


def normal_deviations(deviations: Array, products: float) -> Array:
    """Return the normal deviations that are as rare as those of a difference of two mean squares, in robust sigmas.

    The squares of two residuals differ by ``(a - b) (a + b)``, and a sum of ``products`` such products has longer tails
    than a normal one: of 15, a deviation of 5 is as likely as one of 4.1. This is the saddlepoint approximation
    (Lugannani and Rice 1980, doi:10.2307/1426607) in the form of a normal root (Barndorff-Nielsen 1986,
    doi:10.1093/biomet/73.2.307): up to 0.04 too large of 8 products and more, 0.1 of 4, and 0.2 of one, at 5 sigmas.
    """
    median_of_sums = np.array(_MEDIAN)
    for _ in range(6):
        median_of_sums = median_of_sums * _MEDIAN / _normal_root(median_of_sums, products)
    # Within a robust sigma the two are alike, and towards zero the root is a difference of infinities.
    far = np.abs(deviations) > 1.0
    sizes = np.where(far, np.abs(deviations), 1.0) * median_of_sums / _MEDIAN
    return np.where(far, np.sign(deviations) * _normal_root(sizes, products), deviations)


def _normal_root(deviations: Array, products: float) -> Array:
    """Return the normal deviations of the same probability as those of a sum of products of normal values, which are
    above zero and in its standard deviations; its cumulant function is ``-products / 2 log(1 - t^2)``.
    """
    root = np.sqrt(products)
    tilt = (np.sqrt(products + 4.0 * deviations**2) - root) / (2.0 * deviations)
    cumulant = -0.5 * products * np.log1p(-(tilt**2))
    signed = np.sqrt(2.0 * (tilt * deviations * root - cumulant))
    curved = tilt * root * np.sqrt(1.0 + tilt**2) / (1.0 - tilt**2)
    return np.asarray(signed + np.log(curved / signed) / signed)


def smooth(image: Image, sigma_px: float) -> Image:
    """``image`` after the Gaussian of :func:`gaussian_taps`."""
    if sigma_px <= 0.0:
        return image
    taps = gaussian_taps(sigma_px)
    out = cv2.sepFilter2D(image, cv2.CV_32F, taps, taps, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(out, dtype=np.float32)
