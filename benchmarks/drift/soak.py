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

"""A long stream that drifts out and back: does the estimate wander, does the memory grow?

    python -m benchmarks.drift.soak [--frames 20000]

A periodic random texture is shifted exactly, by the phase of its Fourier coefficients. The path
leads out by 300 px of images that are 128 px wide, and back to where it began: over new ground,
over some ten keyframes, and over the old ground again. Every image has noise of its own.
"""

from __future__ import annotations

import argparse
import resource

import numpy as np
from numpy.typing import NDArray

from benchmarks.table import show
from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.estimates import DriftStatus
from semcal_ros.core.drift.tracker import DriftTracker

SIZE, SCENE = 128, 512
FAR_PX = 300.0
# Standard deviations of the noise and of the texture, grey levels: 14 dB.
NOISE, CONTRAST = 8.0, 40.0
INTERVAL_S = 0.1
WARM = 500


def texture(rng: np.random.Generator) -> NDArray[np.complex128]:
    """Fourier coefficients of a texture of unit variance, blurred by 1.5 px."""
    w = 2.0 * np.pi * np.hypot(np.fft.fftfreq(SCENE)[:, None], np.fft.rfftfreq(SCENE)[None, :])
    amplitude = np.exp(-0.5 * (1.5 * w) ** 2) / (1.0 + (4.0 * w) ** 2)
    spectrum = amplitude * np.fft.rfft2(rng.standard_normal((SCENE, SCENE)))
    spectrum[0, 0] = 0.0
    return np.asarray(spectrum / np.fft.irfft2(spectrum, (SCENE, SCENE)).std())


def view(spectrum: NDArray[np.complex128], shift: Array) -> Array:
    """What lay at x is seen at x + shift."""
    down = np.exp(-2j * np.pi * np.fft.fftfreq(SCENE) * shift[1])
    along = np.exp(-2j * np.pi * np.fft.rfftfreq(SCENE) * shift[0])
    picture = np.fft.irfft2(spectrum * down[:, None] * along, (SCENE, SCENE))
    return np.asarray(picture[:SIZE, :SIZE])


def place(share: float) -> Array:
    """(2,) drift in px after that share of the stream; zero at both ends."""
    out = 1.0 - abs(2.0 * share - 1.0)
    sway = 20.0 * np.sin(4.0 * np.pi * share) * 4.0 * share * (1.0 - share)
    return np.array([FAR_PX * out, 0.3 * FAR_PX * np.sin(6.0 * out) + sway])


def memory_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--frames", type=int, default=20_000)
    frames = parser.parse_args().frames
    rng = np.random.default_rng(3)
    spectrum = texture(rng)
    tracker = DriftTracker()
    errors, sigmas, rows = np.zeros((frames, 2)), np.zeros((frames, 2)), []
    keyframes = refused = 0
    warm = memory_mb()
    for k in range(frames):
        truth = place(k / (frames - 1))
        gray = 128.0 + CONTRAST * view(spectrum, truth) + rng.normal(0.0, NOISE, (SIZE, SIZE))
        image = np.clip(np.rint(gray), 0, 255).astype(np.uint8)
        update = tracker.update(image, INTERVAL_S * k)
        errors[k] = update.drift_px - truth
        sigmas[k] = np.sqrt(np.diag(update.covariance)[:2])
        keyframes += update.status is DriftStatus.KEYFRAME
        refused += not update.accepted
        if k == min(WARM, frames - 1):
            warm = memory_mb()
        if k in {frames // 4, frames // 2, 3 * frames // 4, frames - 1}:
            rows.append([str(k), *truth, *errors[k], *sigmas[k], memory_mb() - warm])
    show(
        f"{frames} frames out and back ({refused} refused, {keyframes} keyframes)",
        ["frame", "x px", "y px", "error x", "error y", "sigma x", "sigma y", "memory MB"],
        rows,
        f"Memory: peak beyond that after {WARM} frames, {warm:.0f} MB."
        f" Error over sigma, RMS: {np.sqrt(np.mean((errors[1:] / sigmas[1:]) ** 2)):.2f}.",
    )


if __name__ == "__main__":
    main()
