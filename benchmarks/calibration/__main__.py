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

"""Calibration methods judged at magnifications that none of them saw; corners beside OpenCV's.

Five simulated microscopes of different kinds record the grid; its corners are projected by the true microscope and
given Gaussian noise. In the reference recordings they are found in the images. Every calibration then meets other
views, of magnifications in between, and only their poses are fitted: once with noise, as one would measure it, and once
without noise, which shows the error of the model alone. A pose absorbs much of a wrong scale, so that the pixel size is
judged by itself.
"""

from __future__ import annotations

import os

# Small matrices: more threads only wait for each other, all the more on a busy machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import sys
from collections.abc import Mapping
from statistics import median

from benchmarks.calibration.cases import (
    DRIFT,
    DRIFT_FRAMES,
    HEIGHT_SIGMA_M,
    MICROSCOPES,
    NOISE_PX,
    RECORDINGS,
    Case,
    reference,
    reference_folder,
    simulated,
)
from benchmarks.calibration.corners import corners
from benchmarks.calibration.methods import JOINT, JOINT_FIELD, METHODS, Judged, Work, judged
from benchmarks.table import quick_from_command_line, show, text

Results = Mapping[str, Judged]
Column = dict[str, float | None]

TIME, NOISY = "time", "+noise"
ERROR_NOTES = (
    "RMS of the corners' distances over the magnifications, under fitted poses: without noise, which is the error of",
    f"the model alone, then with {NOISE_PX} px per coordinate or, of the reference images, as found. bound: what",
    "the noise leaves when the poses are fitted, from the sigmas of the corners.",
    "no correction: the nominal camera, and every view is followed under the pose of its first frame for",
    f'{DRIFT_FRAMES} frames of the drift "{DRIFT}"; poses of their own would absorb it. All other rows are free of',
    "drift, so that drift only is the nominal camera; drift.py shows how well drift can be removed. The reference",
    "sweep has no drift: there both are the same.",
    "discrete: the separate calibration of the nearest magnification, the scale in proportion to g. Between separate",
    'calibrations: linear (the suite\'s own "discrete"), PCHIP and polynomial in log g, Legendre polynomial in g,',
    "with their degrees. OpenCV's parameters are interpolated linearly in log g.",
    "inf: no camera at one of the magnifications; -: no calibration, for a reason given above.",
    "With noise, and among errors far below it, differences of a few percent are chance.",
)
SCALE_NOTES = (
    "Largest relative error of the pixel sizes x and y over the magnifications. Untilted views lie in the reference",
    f"plane; the heights of the others are unknown, {HEIGHT_SIGMA_M * 1e6:g} um (1-sigma), and change their scales by",
    "that over the working distance, so that a part of every error here is chance.",
    "OpenCV's reference plane is at the mean distance of the views.",
    "time: of the calibration, as ratio to joint's, which includes its held-out checks; median over the microscopes.",
)


def cases(quick: bool) -> list[Case]:
    """What the methods are judged by; quickly, the first and the last of the simulated microscopes."""
    labels = list(MICROSCOPES)
    out = [simulated(label, quick) for label in ((labels[0], labels[-1]) if quick else labels)]
    folder = reference_folder()
    missing = [str(folder / name) for name in RECORDINGS if not (folder / name).is_dir()]
    if not missing:
        return [*out, reference(folder, quick)]
    print(
        f"Reference recordings skipped: no {' and no '.join(missing)} (set SEMCAL_REFERENCE_DATA)\n"
    )
    return out


def verdict(ours: str, columns: Mapping[str, Column]) -> list[str]:
    """Where a joint method is beaten by the best one of another kind."""
    lost = []
    for label, column in columns.items():
        own = column[ours]
        others = {
            n: v for n, v in column.items() if v is not None and n not in (JOINT, JOINT_FIELD)
        }
        name = min(others, key=lambda n: others[n])
        if own is None:
            lost.append(f"{label}: no answer")
        elif others[name] < own:
            by = 100.0 * (1.0 - others[name] / own)
            lost.append(f"{label}: {text(own)}, {name} is {by:.2g} % below it")
    if not lost:
        return [f"{ours} wins every column."]
    return [f"{ours} does not win:", *(f"  {line}" for line in lost)]


def show_columns(title: str, columns: Mapping[str, Column], bounds: Column, *notes: str) -> None:
    """The methods as rows; below, what the joint ones do not win."""
    labels = [NOISY if label.endswith(NOISY) else label for label in columns]
    rows: list[list[object]] = [
        [name, *(column.get(name) for column in columns.values())] for name in METHODS
    ]
    if bounds:
        rows.append(["bound", *(bounds.get(label) for label in columns)])
    errors = {label: column for label, column in columns.items() if label != TIME}
    verdicts = [line for ours in (JOINT, JOINT_FIELD) for line in verdict(ours, errors)]
    show(title, ["method", *labels], rows, *notes, *verdicts)


def value(results: Results, what: str) -> Column:
    return {name: getattr(judged, what) for name, judged in results.items()}


def show_errors(results: Mapping[str, Results], every: list[Case]) -> None:
    columns: dict[str, Column] = {}
    bounds: Column = {}
    for case in every:
        columns[case.name] = value(results[case.name], "clean_px")
        noisy = f"{case.name} {NOISY}"
        columns[noisy] = value(results[case.name], "noisy_px")
        bounds[noisy] = case.bound_px()
    worst = [f"{text(own[JOINT].worst_at)} ({label})" for label, own in results.items()]
    note = f"Without noise, joint is worst at the magnification {', '.join(worst)}."
    show_columns("Held-out RMS px", columns, bounds, *ERROR_NOTES, note)


def show_scales(results: Mapping[str, Results], every: list[Case]) -> None:
    columns = {case.name: value(results[case.name], "scale_percent") for case in every}
    columns[TIME] = {name: relative_time(name, results) for name in METHODS}
    show_columns(
        "Largest error of a pixel size at these magnifications, percent; time",
        columns,
        {},
        *SCALE_NOTES,
    )


def relative_time(name: str, results: Mapping[str, Results]) -> float | None:
    """Median over the microscopes of the time as ratio to joint's."""
    seconds = [(own[name].seconds, own[JOINT].seconds) for own in results.values()]
    ratios = [own / joint for own, joint in seconds if own is not None and joint is not None]
    return median(ratios) if ratios else None


def calibrated(case: Case) -> Results:
    """All methods in one case; prints what it consists of, and what a reader should know."""
    work = Work(case)
    results = {name: judged(name, work) for name in METHODS}
    corners_seen = sum(len(v.image_xy) for v in case.seen)
    magnifications = len({v.magnification for v in case.seen})
    print(
        f"{case.name}, {case.source}: {len(case.seen)} views, {corners_seen} corners, {magnifications} magnifications; "
        f"judged at {len(case.pixel_size_m)} others"
    )
    for remark in dict.fromkeys(r for one in results.values() for r in one.remarks):
        print(f"  {remark}")
    sys.stdout.flush()
    return results


def main() -> None:
    quick = quick_from_command_line(__doc__)
    corners(quick)
    every = cases(quick)
    results = {case.name: calibrated(case) for case in every}
    show_errors(results, every)
    show_scales(results, every)


if __name__ == "__main__":
    main()
