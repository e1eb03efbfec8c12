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

"""Registration of two noisy images beside other libraries and the Cramer-Rao bound.

Gold on carbon, the chess grid, a fine random texture and a few bright particles, blurred by a beam of
1 px sigma, are seen at exactly known shifts (pairs.py), given white noise and rounded to 8 or
16 bits. Noise is stated in dB: 20 log10 of the image's standard deviation over that of the noise.

The bound is that of a shift between two images which both have noise, computed from the scene
alone: the inverse of sum(gradient gradient^T) / (2 sigma^2) over the pixels that overlap, sigma
containing the rounding.

Then the tracker: what a live stream costs, and what it leaves of a drift inside the frames.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.drift import methods as drift_methods
from benchmarks.drift import raster as drift_raster
from benchmarks.drift.methods import (
    METHODS,
    PREDICTION_PX,
    UNIT,
    WRONG_PX,
    Answer,
    Method,
    Score,
    phase_correlate_pictures,
)
from benchmarks.drift.pairs import (
    KINDS,
    MAGNIFICATION,
    Pair,
    Scene,
    Views,
    large_shifts,
    small_shifts,
)
from benchmarks.live.scenes import pictures
from benchmarks.table import interleaved, quick_from_command_line, show
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.synthetic import preset


@dataclass(frozen=True)
class Group:
    """Pairs of images of one size; the noise changes from row to row."""

    size: int
    large: bool
    pairs: int
    noise_db: tuple[float, ...]
    kinds: tuple[str, ...] = KINDS
    bits: int = 8


QUICK = (
    Group(512, False, 10, (30.0, 10.0)),
    Group(512, True, 6, (20.0,)),
)
FULL = (
    Group(512, False, 20, (30.0, 20.0, 10.0, 5.0)),
    Group(512, True, 10, (30.0, 20.0, 10.0, 5.0)),
    Group(512, False, 12, (30.0, 20.0), ("gold", "sparse"), 16),
    Group(1024, False, 5, (30.0, 20.0, 10.0, 5.0)),
    Group(1024, True, 4, (20.0, 5.0)),
    Group(2048, False, 3, (20.0,), ("gold", "texture")),
    Group(2048, True, 3, (20.0,), ("gold",)),
)


def scores(pairs: list[Pair]) -> list[Score]:
    """All methods on the same pairs, taking turns."""
    able = [method for method in METHODS if method.run is not None]
    prepared = {m.name: [m.prepare(p) if m.prepare else None for p in pairs] for m in able}
    answers: dict[str, list[Answer]] = {method.name: [] for method in able}

    def next_pair(method: Method) -> Callable[[], None]:
        mine, given = answers[method.name], prepared[method.name]
        return lambda: mine.append(method.run(pairs[len(mine)], given[len(mine)]))

    times = interleaved({method.name: next_pair(method) for method in able}, len(pairs))
    return [
        drift_methods.score(m, pairs, answers[m.name], times[m.name] / times[UNIT])
        if m.run is not None
        else Score(m)
        for m in METHODS
    ]


def table(group: Group, kind: str) -> list[list[Score]]:
    """Measure and print one specimen; the scores, one list per noise."""
    rng = np.random.default_rng([group.size, group.large, KINDS.index(kind)])
    if group.large:
        shifts, reach = large_shifts(group.pairs, group.size, rng), group.size / 3.0
    else:
        shifts, reach = small_shifts(group.pairs, rng), 4.0
    scene = Scene(kind, group.size, reach)
    scene.check()
    views = Views(scene, shifts)
    out: list[list[Score]] = []
    rows: list[list[object]] = []
    for db in group.noise_db:
        # Another noise for every specimen, or chance would favour the same method in all of them.
        seed = (group.size, group.large, KINDS.index(kind), round(db), group.bits)
        out.append(scores(views.pairs(db, group.bits, PREDICTION_PX, seed)))
        rows += drift_methods.rows(out[-1], f"{db:g} dB")
    show(
        f"Registration, {kind}, {group.size} x {group.size}, {group.bits} bits, shifts up to"
        f" {reach:.0f} px, {group.pairs} pairs",
        drift_methods.HEADER,
        rows,
    )
    return out


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
            seen.append(
                tracker.update(images[k % len(images)], 0.1 * k, camera, timing).status_text
            )

        def phase(images=images):
            phase_correlate_pictures(images[0], images[1])

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


def raster(timings: tuple[ScanTiming, ...], frames: int) -> None:
    """What the correction leaves of a strong drift inside the frames."""
    rows: list[list[object]] = []
    for timing in timings:
        result = drift_raster.raster_residual(timing=timing, frames=frames)
        rows += drift_raster.rows(result, f"{timing.frame_time_s:g} s, {timing.averages}")
    show(
        f"Drift inside the frame: gold at 20 000x, 512 x 512, {frames} frames without a pause",
        drift_raster.HEADER,
        rows,
        "Distance in output px between where the corrected frame puts a point and where it belongs,",
        "for points all over the field, its corners among them, with the true camera and timing.",
        "moved: most that the specimen moves within a frame. shift only: the same drift without its",
        "velocity. The first frame cannot be corrected: nothing is known of the velocity yet.",
    )


def explain() -> None:
    print(
        "RMS, bias (the larger of x and y) and bound are of one coordinate, over the pairs that were\n"
        f"neither refused nor wrong by {WRONG_PX:g} px or more. +-: standard error of the bias; one below\n"
        "three of it is no bias. err/sigma, 68 %, 95 %: RMS of the error over the 1-sigma that the\n"
        "method states, and how many errors are within 1 and 1.96 of it. time: ratio of medians to\n"
        f"{UNIT}. reference once: without the time for preparing the reference, as\n"
        f"in a stream. predicted: told the shift to within {PREDICTION_PX:g} px (1-sigma), as in a stream, which\n"
        "decides between repeats of the grid; findTransformECC and pystackreg begin at no shift, which\n"
        "decides it too where the shift is small. cost: (RMS/bound)^2 x time, the time in which averaging\n"
        "would reach the variance of the bound; a method that refuses or is wrong in more than 5 % of\n"
        "the pairs fails. wins: least cost for a single pair, and for a further image of a stream.\n"
        "The RMS of 10 pairs is itself only good to 16 %, that of 20 to 11 %."
    )


def main() -> None:
    quick = quick_from_command_line(__doc__)
    groups: list[list[Score]] = []
    for group in QUICK if quick else FULL:
        for kind in group.kinds:
            groups += table(group, kind)
    show(
        "Registration, all of the above",
        drift_methods.SUMMARY_HEADER,
        drift_methods.summary(groups),
        "groups: specimens, noises, sizes and ranges of shifts. RMS/bound, err/sigma, time and cost:",
        "medians over the groups in which the method does not fail; worst: the largest RMS/bound.",
    )
    explain()
    tracking((512, 1024), 12 if quick else 30)
    faster, averaged = ScanTiming(1.0, 1, 0.1), ScanTiming(0.5, 8, 0.1)
    timings = (faster, drift_raster.SLOW_SCAN) + (() if quick else (averaged,))
    raster(timings, 12 if quick else 30)


if __name__ == "__main__":
    main()
