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

"""Does it hold on microscopes that nobody drew? A fleet of random ones, calibrated from their corners.

    python -m benchmarks.calibration.fleet [--count 300] [--seed 0] [--jobs 1] [--json FILE]
    python -m benchmarks.calibration.fleet --seed 0 --only 17
    python -m benchmarks.calibration.fleet --misstate [...]
    python -m benchmarks.calibration.fleet --other-physics [...]
    python -m benchmarks.calibration.fleet --pictures --count 40 [...]

A microscope is *raised* if its calibration raises anything, *warned* if it prints a warning of numpy, and *wrong* if
at a magnification between the calibrated ones the error after a pose fit is beyond both 0.1 px and 4 stated sigmas, or
nm per pixel are beyond 4 stated sigmas. The limit, beyond which the command fails: none raises, none warns, at most 1 %
is wrong, and the RMS of the error over sigma of the fleet is 0.7 to 1.4, in pixels as in nm.

`--only` repeats the one of this index, with all details. It is the same one whatever the count. With `--misstate` one
view of each states a wrong magnification. The limit is the same, and no view may be left out but that one. That it is
left out is no limit: what a height or a repeatability of the scale explains does no harm. With `--other-physics` the
same microscopes have lenses and amplifiers of other forms than the calibration's. With `--pictures` their corners are
found in pictures, which are smaller and fewer; it takes a minute for each, and one in which none is found raises.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import itertools
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed

from benchmarks.calibration.fleet.microscope import Microscope, draw_microscope
from benchmarks.calibration.fleet.pictures import shrink
from benchmarks.calibration.fleet.score import Outcome, judge
from benchmarks.table import show

MOST_WRONG = 0.01
LEAST_RATIO, LARGEST_RATIO = 0.7, 1.4
# Limits of the rows of :func:`tabulate_misstated`: factors, either way.
MISSTATED_BY = (1.0, 1.05, 1.1, 1.2, 2.5)

KINDS: Mapping[str, Callable[[Microscope], bool]] = {
    "all": lambda _m: True,
    "none of spiral, coil, settling": lambda m: m.is_plain,
    "spiral": lambda m: m.spiral != 0.0,
    "coil": lambda m: m.has_coil,
    "settling": lambda m: m.settling_px != 0.0,
    "all three": lambda m: m.spiral != 0.0 and m.has_coil and m.settling_px != 0.0,
    "2 views": lambda m: m.views == 2,
    "3 or 4 views": lambda m: m.views in (3, 4),
    "5 or 6 views": lambda m: m.views > 4,
    "one visit": lambda m: m.visits == 1,
    "two visits": lambda m: m.visits == 2,
    "3 to 5 magnifications": lambda m: len(m.magnifications) <= 5,
    "over 10 magnifications": lambda m: len(m.magnifications) > 10,
    "one tilt axis": lambda m: m.axis_rad is not None,
    "tilts in any direction": lambda m: m.axis_rad is None,
    "no untilted view": lambda m: not m.has_untilted,
    "tilts below 25 degrees": lambda m: m.largest_tilt_rad < np.radians(25.0),
    "tilts above 35 degrees": lambda m: m.largest_tilt_rad > np.radians(35.0),
    "outliers": lambda m: m.outliers > 0.0,
    "noise below 0.03 px": lambda m: m.noise_px < 0.03,
    "noise above 0.12 px": lambda m: m.noise_px > 0.12,
    "below 800 px": lambda m: m.width < 800,
    "above 3000 px": lambda m: m.width > 3000,
    "pivot below 10 mm": lambda m: m.pivot_m < 10e-3,
    "heights of 40 um": lambda m: m.height_sigma_m > 3e-5,
    "visits of 0.3 %": lambda m: m.visit_sigma > 2e-3,
}
OF_CORNERS = ("outliers", "noise below 0.03 px", "noise above 0.12 px")
HEADER = ["microscopes with", "count", "raised", "warned", "wrong", "px", "nm"]
HEADER += ["median px", "95 % px", "px/sigma", "median", "nm/sigma", "median"]


def _rms(values: Iterable[float]) -> float:
    own = np.array(list(values))
    return float(np.sqrt(np.mean(own**2))) if len(own) else float("nan")


def ratios(outcomes: Sequence[Outcome]) -> tuple[list[float], list[float]]:
    """RMS of error over sigma of each calibrated microscope, in pixels and in nm, both of the next visit."""
    calibrated = [o for o in outcomes if not o.raised]
    return (
        [_rms(o.next_px_over_sigma) for o in calibrated],
        [_rms(o.next_nm_over_sigma.ravel()) for o in calibrated],
    )


def _row(label: str, outcomes: Sequence[Outcome]) -> list[object]:
    calibrated = [o for o in outcomes if not o.raised]
    px, nm = ratios(outcomes)
    worst = np.array([o.worst_px for o in calibrated])
    row: list[object] = [label, len(outcomes), sum(bool(o.raised) for o in outcomes)]
    row += [sum(bool(o.numpy_warnings) for o in outcomes)]
    row += [sum(o.verdict == "wrong" for o in outcomes)]
    row += [sum(o.is_wrong_px for o in calibrated), sum(o.is_wrong_nm for o in calibrated)]
    if not calibrated:
        return row + [None] * 6
    for values in (px, nm):
        row += [_rms(values), float(np.median(values))]
    row[7:7] = [float(np.median(worst)), float(np.quantile(worst, 0.95, method="higher"))]
    return row


def tabulate(outcomes: Sequence[Outcome], seed: int, *, pictures: bool) -> None:
    """Print the table by what the microscopes have."""
    owners = {o.index: draw_microscope(seed, o.index) for o in outcomes}
    owners = {index: shrink(own) if pictures else own for index, own in owners.items()}
    # In pictures, noise and outliers are what the finder makes of them.
    unknown = OF_CORNERS if pictures else ()
    rows = [
        _row(label, chosen)
        for label, has in KINDS.items()
        if label not in unknown
        if (chosen := [o for o in outcomes if has(owners[o.index])])
    ]
    show(
        f"Fleet of {len(outcomes)} random microscopes, seed {seed}",
        HEADER,
        rows,
        "wrong: of these px and nm; median and 95 % px: of the worst magnification's error after a pose fit.",
        "px/sigma, nm/sigma: RMS of the microscopes' errors over the stated sigmas, and the median microscope.",
        f"processor time: {sum(o.seconds for o in outcomes):.0f} s",
    )


def tabulate_misstated(outcomes: Sequence[Outcome]) -> None:
    """Print how many of the views with a wrong magnification are left out, by how wrong it is."""
    rows: list[list[object]] = []
    for low, high in itertools.pairwise(MISSTATED_BY):
        own = [
            o
            for o in outcomes
            if low <= max(o.misstated, 1.0 / o.misstated) < high and not o.raised
        ]
        kept = [o for o in own if not o.has_found]
        row: list[object] = [f"{100.0 * (low - 1.0):.0f} to {100.0 * (high - 1.0):.0f} %"]
        row += [len(own), len(own) - len(kept), sum(o.views_left_out for o in own)]
        row += [max((float(np.max(np.abs(o.nm_over_sigma))) for o in kept), default=None)]
        rows.append(row)
    header = ["magnification wrong by", "count", "left out", "sound ones too", "nm/sigma, kept"]
    show("Views with a wrong magnification", header, rows)


def failures(outcomes: Sequence[Outcome]) -> list[str]:
    """What is beyond the limit, in words."""
    count = len(outcomes)
    out = []
    for label, number, most in (
        ("raise", sum(bool(o.raised) for o in outcomes), 0.0),
        ("print a numpy warning", sum(bool(o.numpy_warnings) for o in outcomes), 0.0),
        ("are wrong", sum(o.verdict == "wrong" for o in outcomes), MOST_WRONG * count),
    ):
        if number > most:
            out.append(f"{number} of {count} {label}, where at most {most:g} may")
    lost = sum(o.views_left_out for o in outcomes if o.misstated != 1.0)
    if lost:
        out.append(f"{lost} sound views are left out with those of a wrong magnification")
    for label, values in zip(("px", "nm"), ratios(outcomes), strict=True):
        if not LEAST_RATIO <= (ratio := _rms(values)) <= LARGEST_RATIO:
            out.append(f"error over sigma in {label} is {ratio:.3g}, not {LEAST_RATIO} to 1.4")
    return out


def line_of(own: Outcome) -> str:
    """One line about one microscope."""
    text = f"{own.index:4d} {own.verdict:6s} {own.seconds:6.1f} s {own.corners:6d} corners"
    if own.raised:
        text += f"  {own.raised[:110]}"
    else:
        text += f"  {own.worst_px:8.4f} px  {np.max(own.px_over_sigma):6.2f} sigma"
        text += f"  nm {np.max(np.abs(own.nm_over_sigma)):6.2f} sigma"
        text += "  field" if own.has_field else ""
        text += f"  {own.views_left_out} views left out" if own.views_left_out else ""
    if own.misstated != 1.0:
        text += f"  magnification of a view x {own.misstated:.3f}, "
        text += "left out" if own.has_found else "kept"
    if own.numpy_warnings:
        text += f"  [{len(own.numpy_warnings)} warnings]"
    return text


def show_one(seed: int, index: int, **kind: bool) -> None:
    """Print everything about one microscope; ``kind`` as for :func:`judge`."""
    own, trace = judge(seed, index, **kind)
    for name, value in own.microscope.items():
        print(f"{name:18s} {value}")
    print(line_of(own))
    for number, g in enumerate(own.between):
        print(
            f"  {g:8.1f}x  {own.error_px[number]:.4f} +- {own.sigma_px[number]:.4f} px   nm x, y: "
            + ", ".join(
                f"{100.0 * e:+.4f} +- {100.0 * s:.4f} %"
                for e, s in zip(own.nm_error[number], own.nm_sigma[number], strict=True)
            )
        )
    for number, (x, y) in enumerate(own.literal_sigmas):
        print(f"  {own.between[number]:8.1f}x  pixel_size_m: x {x:+.2f} sigma, y {y:+.2f} sigma")
    for name in ("excess_px", "repeatability", "has_field", "views_left_out"):
        print(f"{name:18s} {getattr(own, name)}")
    for message in (*own.messages, *own.numpy_warnings):
        print(f"  - {message}")
    print(trace)


def main() -> int:
    """Run the fleet, or one of it; 1 where the limit is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=300, help="microscopes; default 300")
    parser.add_argument("--seed", type=int, default=0, help="of the fleet; default 0")
    parser.add_argument("--only", type=int, metavar="INDEX", help="one microscope, in detail")
    parser.add_argument("--misstate", action="store_true", help="one wrong magnification in each")
    parser.add_argument("--other-physics", action="store_true", help="lenses of other forms")
    parser.add_argument("--pictures", action="store_true", help="corners are found in pictures")
    parser.add_argument("--jobs", type=int, default=1, help="processes; default 1")
    parser.add_argument("--json", type=Path, metavar="FILE", help="results of each microscope")
    given = parser.parse_args()
    kind = {name: getattr(given, name) for name in ("misstate", "other_physics", "pictures")}
    if given.only is not None:
        show_one(given.seed, given.only, **kind)
        return 0
    outcomes = []
    jobs = Parallel(n_jobs=given.jobs, return_as="generator")
    tasks = (delayed(judge)(given.seed, index, **kind) for index in range(given.count))
    for own, _ in jobs(tasks):
        outcomes.append(own)
        print(line_of(own), flush=True)
        if given.json is not None:
            _save(given.json, given.seed, outcomes)
    tabulate(outcomes, given.seed, pictures=given.pictures)
    if given.misstate:
        tabulate_misstated(outcomes)
    found = failures(outcomes)
    print("\n".join(f"beyond the limit: {text}" for text in found) or "within the limit")
    return 1 if found else 0


def _save(path: Path, seed: int, outcomes: Sequence[Outcome]) -> None:
    rows = [{"verdict": own.verdict, **asdict(own)} for own in outcomes]
    path.write_text(json.dumps({"seed": seed, "microscopes": rows}, indent=1))


if __name__ == "__main__":
    raise SystemExit(main())
