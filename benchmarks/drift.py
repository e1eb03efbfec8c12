"""Registration of two noisy pictures beside OpenCV's, scikit-image's and the Cramer-Rao bound.

Gold on carbon and the chess grid are rendered without noise at known sub-pixel shifts, blurred by
the beam, given white noise of known strength and rounded to 8 bits. Noise is stated in dB: 20 log10
of the picture's standard deviation over that of the noise.

The bound is that of a shift between two pictures which both have white noise, computed from the
rendered scene alone: the inverse of sum(gradient gradient^T) / (2 sigma^2) over the pixels that
overlap, the gradient being a central difference of renderings half a pixel apart and sigma
containing the rounding.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from live import pictures
from numpy.typing import NDArray
from table import interleaved, quick_from_command_line, show

from semcal_ros.core.drift import DriftTracker
from semcal_ros.core.raster import ScanTiming
from semcal_ros.core.registration import prepare_reference, register
from semcal_ros.synthetic import (
    ChessGrid,
    GoldOnCarbon,
    Pose,
    Specimen,
    preset,
    render_reflectivity,
    square_for,
)

try:
    from skimage.registration import phase_cross_correlation
except ImportError:
    phase_cross_correlation = None

Array = NDArray[np.float64]
Shift = tuple[float, float]

MAGNIFICATION = 5000.0
BLUR_PX = 1.0
PAD = 5
CONTRAST = 36.0  # standard deviation in grey levels
# Farther off than this is no measurement but another place.
FAILURE_PX = 1.0
# How far a prediction of the drift may be off, 1-sigma; decides between repeats of the grid.
PREDICTION_PX = 8.0


class Scene:
    """A specimen at any shift, in grey levels without noise."""

    def __init__(self, kind: str, size: int) -> None:
        self._microscope = preset("ideal").with_image_size(size, size)
        self._camera = self._microscope.camera_at(MAGNIFICATION)
        pixel_m = self._microscope.nominal_pixel_size_m(MAGNIFICATION)
        self._specimen: Specimen = (
            GoldOnCarbon(1) if kind == "gold" else ChessGrid(square_for(pixel_m, size))
        )
        first = self._rendered((0.0, 0.0))
        self._mean, self._deviation = float(first.mean()), float(first.std())

    def _rendered(self, shift: Shift) -> Array:
        offset = np.array([*shift, 0.0]) / self._camera.m
        pose = Pose.flat(offset + [0.3e-6, -0.2e-6, 0.0], rotation_rad=0.3)
        picture = render_reflectivity(
            self._microscope, self._specimen, pose, MAGNIFICATION, pad=PAD, supersampling=2
        )
        blurred = cv2.GaussianBlur(picture.astype(np.float64), (2 * PAD + 1, 2 * PAD + 1), BLUR_PX)
        return blurred[PAD:-PAD, PAD:-PAD]

    def view(self, shift: Shift) -> Array:
        """What lay at x is seen at x + shift."""
        unit = (self._rendered(shift) - self._mean) / self._deviation
        return 110.0 + CONTRAST * unit

    def gradient(self) -> Array:
        """(2, h, w) derivatives by x and y."""
        h = 0.25
        by_x = (self.view((-h, 0.0)) - self.view((h, 0.0))) / (2.0 * h)
        by_y = (self.view((0.0, -h)) - self.view((0.0, h))) / (2.0 * h)
        return np.stack([by_x, by_y])


def bound_px(gradient: Array, shift: Shift, sigma: float) -> float:
    """Cramer-Rao bound of one coordinate of the shift, RMS over both."""
    x, y = (round(s) for s in shift)
    height, width = gradient.shape[1:]
    part = gradient[:, max(0, -y) : height - max(0, y), max(0, -x) : width - max(0, x)]
    flat = part.reshape(2, -1)
    information = flat @ flat.T / (2.0 * sigma**2)
    return float(np.sqrt(np.trace(np.linalg.inv(information)) / 2.0))


@dataclass
class Pair:
    """Two noisy pictures and the shift between them."""

    reference: NDArray[np.uint8]
    image: NDArray[np.uint8]
    shift: Shift
    bound_px: float


def noisy(picture: Array, sigma: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    return np.clip(np.rint(picture + rng.normal(0.0, sigma, picture.shape)), 0, 255).astype(
        np.uint8
    )


# -- methods: shift (x, y) of a pair and 1-sigma if there is one, or None where they refuse ----------

Answer = tuple[Array, Array | None] | None


def ours(pair: Pair) -> Answer:
    result = register(pair.reference, pair.image)
    return (result.shift_px, np.sqrt(np.diag(result.covariance))) if result.accepted else None


def ours_predicted(pair: Pair) -> Answer:
    result = register(
        pair.reference,
        pair.image,
        guess_px=(0.0, 0.0),
        guess_covariance=np.eye(2) * PREDICTION_PX**2,
    )
    return (result.shift_px, np.sqrt(np.diag(result.covariance))) if result.accepted else None


@lru_cache(maxsize=2)
def hann(shape: tuple[int, int]) -> NDArray[np.float32]:
    return cv2.createHanningWindow(shape[::-1], cv2.CV_32F)


def phase_correlate(pair: Pair) -> Answer:
    window = hann(pair.image.shape)
    a, b = pair.reference.astype(np.float32), pair.image.astype(np.float32)
    return np.array(cv2.phaseCorrelate(a, b, window)[0]), None


def ecc(pair: Pair) -> Answer:
    warp = np.eye(2, 3, dtype=np.float32)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-6)
    try:
        _, warp = cv2.findTransformECC(
            pair.reference, pair.image, warp, cv2.MOTION_TRANSLATION, criteria, None, 5
        )
    except cv2.error:
        return None
    return warp[:, 2].astype(np.float64), None


def skimage_method(normalization: str | None) -> Callable[[Pair], Answer]:
    def method(pair: Pair) -> Answer:
        shift = phase_cross_correlation(
            pair.reference, pair.image, upsample_factor=100, normalization=normalization
        )[0]
        return -np.asarray(shift, dtype=np.float64)[::-1], None

    return method


METHODS: dict[str, Callable[[Pair], Answer]] = {
    "semcal": ours,
    "semcal, predicted": ours_predicted,
    "cv2.phaseCorrelate, Hann": phase_correlate,
    "cv2.findTransformECC": ecc,
}
if phase_cross_correlation is not None:
    METHODS["skimage, default"] = skimage_method("phase")
    METHODS["skimage, no normalisation"] = skimage_method(None)


def summary(name: str, pairs: list[Pair], answers: list[Answer]) -> list[object]:
    """RMS and its ratio to the bound, bias, counts of refused and wrong, stated sigma."""
    errors, stated, bounds, refused, wrong = [], [], [], 0, 0
    for pair, answer in zip(pairs, answers, strict=True):
        if answer is None:
            refused += 1
            continue
        error = answer[0] - pair.shift
        if not np.max(np.abs(error)) < FAILURE_PX:
            wrong += 1
            continue
        errors.append(error)
        bounds.append(pair.bound_px)
        if answer[1] is not None:
            stated.append(error / answer[1])
    if not errors:
        return [name, None, None, None, None, refused, wrong, None]
    rms = float(np.sqrt(np.mean(np.square(errors))))
    bound = float(np.sqrt(np.mean(np.square(bounds))))
    bias = float(np.max(np.abs(np.mean(errors, axis=0))))
    ratio = float(np.sqrt(np.mean(np.square(stated)))) if stated else None
    return [name, rms, bound, rms / bound, bias, refused, wrong, ratio]


def table(kind: str, size: int, shifts: list[Shift], decibels: tuple[float, ...], trials: int):
    scene = Scene(kind, size)
    gradient = scene.gradient()
    still, views = scene.view((0.0, 0.0)), [scene.view(s) for s in shifts]
    rows: list[list[object]] = []
    for db in decibels:
        sigma = CONTRAST * 10.0 ** (-db / 20.0)
        rng = np.random.default_rng(int(db))
        with_rounding = float(np.hypot(sigma, np.sqrt(1.0 / 12.0)))
        pairs = [
            Pair(
                noisy(still, sigma, rng),
                noisy(views[k % len(views)], sigma, rng),
                shifts[k % len(shifts)],
                bound_px(gradient, shifts[k % len(shifts)], with_rounding),
            )
            for k in range(trials)
        ]
        answers: dict[str, list[Answer]] = {name: [] for name in METHODS}

        def once(name: str, pairs=pairs, answers=answers) -> Callable[[], None]:
            return lambda: answers[name].append(METHODS[name](pairs[len(answers[name])]))

        times = interleaved({name: once(name) for name in METHODS}, trials)
        unit = times["cv2.phaseCorrelate, Hann"]
        for name in METHODS:
            row = summary(f"{db:g} dB  {name}", pairs, answers[name])
            rows.append([*row, times[name] / unit])
    prepared_note = prepared_ratio(pairs)
    reach = max(max(abs(x), abs(y)) for x, y in shifts)
    if phase_cross_correlation is None:
        rows.append(["scikit-image: not installed", *[None] * 8])
    show(
        f"Registration, {kind}, {size} x {size}, shifts up to {reach:.0f} px, {trials} pairs",
        ["noise  method", "RMS px", "bound px", "RMS/bound", "bias px"]
        + ["refused", "wrong", "err/sigma", "time"],
        rows,
        prepared_note,
    )


def prepared_ratio(pairs: list[Pair]) -> str:
    """Time with a reference that was prepared once, as in a stream."""
    prepared = prepare_reference(pairs[0].reference)
    guess = np.eye(2) * PREDICTION_PX**2
    image = pairs[0].image
    times = interleaved(
        {
            "prepared": lambda: register(prepared, image, guess_covariance=guess),
            "phase": lambda: phase_correlate(pairs[0]),
        },
        min(len(pairs), 12),
    )
    return f"With the reference prepared once: time {times['prepared'] / times['phase']:.2f}."


def tracking(sizes: tuple[int, ...], frames: int) -> None:
    """What a live stream costs, beside phase correlation of each frame with the first."""
    rows: list[list[object]] = []
    timing = ScanTiming(0.08)
    for size in sizes:
        images = pictures(size)
        camera = preset("jsm820").with_image_size(size, size).camera_at(MAGNIFICATION)
        tracker, stamps = DriftTracker(), itertools.count()
        statuses: list[str] = []

        def update(images=images, camera=camera, tracker=tracker, stamps=stamps, seen=statuses):
            k = next(stamps)
            seen.append(tracker.update(images[k % len(images)], 0.1 * k, camera, timing).status)

        def phase(images=images):
            phase_correlate(Pair(images[0], images[1], (0.0, 0.0), 0.0))

        interleaved({"track": update, "phase": phase}, 3)
        times = interleaved({"track": update, "phase": phase}, frames)
        tracked = sum(status == "tracked" for status in statuses[-frames:])
        rows.append([str(size), times["track"] / times["phase"], f"{tracked} of {frames}"])
    show(
        "DriftTracker.update on a slowly drifting stream: time as ratio to cv2.phaseCorrelate",
        ["size", "time", "tracked"],
        rows,
        "With distortion and raster timing, so that every frame is rectified before it is registered.",
    )


def main() -> None:
    quick = quick_from_command_line(__doc__)
    rng = np.random.default_rng(7)
    small = [tuple(rng.uniform(-4.0, 4.0, 2)) for _ in range(3 if quick else 6)]
    large = [tuple(rng.uniform(10.0, 18.0, 2) * rng.choice([-1, 1], 2)) for _ in range(3)]
    decibels = (30.0, 10.0) if quick else (30.0, 10.0, 3.0)
    for size in (512,) if quick else (512, 1024):
        for kind in ("gold", "grid"):
            table(kind, size, small, decibels, 24 if size == 512 and not quick else 16)
            if size == 512:
                table(kind, size, large, decibels[-1:] if quick else (20.0,), 12)
    tracking((512, 1024), 12 if quick else 30)
    print(
        "RMS, bias (the larger of x and y) and bound are of one coordinate, over the pairs that were\n"
        f"neither refused nor wrong by {FAILURE_PX:g} px or more. err/sigma: RMS of the error over the\n"
        "1-sigma that the method states. time: ratio of medians to cv2.phaseCorrelate, with the\n"
        f"reference prepared anew for every pair. predicted: told that the shift is 0 +- {PREDICTION_PX:g} px,\n"
        "which decides between repeats of the grid. The RMS of 16 pairs is itself only good to 13 %."
    )


if __name__ == "__main__":
    main()
