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

"""Does it find any grid that is plainly in view? Random pictures of calibration grids, and what is found in them.

    python -m benchmarks.calibration.looks [--count 300] [--seed 0] [--largest PX] [--save DIR]
    python -m benchmarks.calibration.looks --seed 0 --only 17

A line is printed of each picture that is not *fine*. That is: **raised** or **not found**; **kind**, called another
pattern than it is; **lattice**, not that of the grid: neighbours are none of the grid, the spacing is off by a tenth,
or a quarter of the points is where there is none; **false**, more than 2 % of the points where there is none; **few**,
less than half of the points that can be seen; **error**, an RMS error of more than 2 sigmas.

Points are compared with the nearest true one, if there is one within a quarter of the pitch; none is left out of the
errors. Errors are RMS of one coordinate. Square pads of 0.6 of the pitch or more look like a mesh with wide bars, and
may be called either. What is called another pattern is compared with the points of the grid, or with those in the
middle between them, whichever fits better: of pads that are called lines, with the crossings of the gaps.

The limit, beyond which the command fails: 98 % is found, none is of a wrong kind or lattice, and the RMS of the error
over sigma of the pictures is 0.7 to 1.5.

`--only` shows the picture of this index, with all details. It is the same one whatever the count. `--largest` passes
over wider pictures, and goes on until there are as many as wanted.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial import cKDTree

from benchmarks.calibration.looks.picture import (
    KINDS,
    LEAST_WIDTH,
    Array,
    Indices,
    Look,
    Picture,
    Truth,
    draw_look,
    find_truth,
    render,
    visibility,
)
from benchmarks.table import show
from semcal_ros.core.corners import LatticeDetection, find_lattice

LEAST_FOUND = 0.98
LEAST_RATIO, LARGEST_RATIO = 0.7, 1.5
# In pitches: beyond it a point is another one.
REACH = 0.25
MOST_FALSE_OF_LATTICE, LEAST_AGREEMENT, MOST_SPACING_ERROR = 0.25, 0.95, 0.1
MOST_FALSE, LEAST_SHARE, MOST_SIGMAS = 0.02, 0.5, 2.0
# Openings are drawn from a side of 0.6 on, and pads up to 0.65; pads of more than a half are what is left open between
# bars that are narrower than they are.
LEAST_LIKE, LARGEST_LIKE = 0.5, 0.65

PATTERNS: Mapping[str, str] = {
    "chess": "chess",
    "dots": "dots",
    "holes": "dots",
    "pads": "dots",
    "lines": "lines",
    "crosses": "crosses",
    "mesh": "lines",
}
GROUPS: Mapping[str, Callable[[Look], bool]] = {
    "all": lambda _l: True,
    **{kind: (lambda look, kind=kind: look.kind == kind) for kind in KINDS},
    "below 800 px": lambda look: look.width < 800,
    "800 to 2000 px": lambda look: 800 <= look.width <= 2000,
    "above 2000 px": lambda look: look.width > 2000,
    "pitch below 20 px": lambda look: look.pitch_px < 20.0,
    "pitch 20 to 100 px": lambda look: 20.0 <= look.pitch_px <= 100.0,
    "pitch above 100 px": lambda look: look.pitch_px > 100.0,
    "tilt above 35 degrees": lambda look: look.tilt_rad > np.radians(35.0),
    "below 20 electrons": lambda look: look.electrons < 20.0,
    "contrast below 0.3": lambda look: look.contrast < 0.3,
    "blur above 0.08 of the pitch": lambda look: look.blur_px > 0.08 * look.pitch_px,
    "part of a grid": lambda look: look.is_partial,
    "jitter above 0.2 px": lambda look: look.jitter_px > 0.2,
    "rough edges above 0.4 %": lambda look: look.roughness > 0.004,
    "bright rims": lambda look: look.rim > 0.0,
    "elements missing": lambda look: look.missing > 0.0,
    "over 10 pieces of dust": lambda look: len(look.dust) > 10,
    "16 bits": lambda look: look.bits == 16,
}
HEADER = ["pictures with", "count", "found %", "kind", "lattice", "false", "few", "share"]
HEADER += ["error px", "err/sigma", "RMS", "s/Mpx"]


@dataclass(frozen=True)
class Outcome:
    """What became of one picture.

    Attributes
    ----------
    answer
        Name of the pattern, or why there is none.
    expected, points
        Number of true points that can be seen, and of those that were found.
    share
        Part of the true points that was found.
    false
        Part of what was found that is where there is no point.
    spacing_error
        Relative, of the spacing in the middle.
    agreement
        Part of the neighbours that are neighbours on the grid, all turned in the same way.
    error_px, error_sigmas, worst_sigmas
        RMS of one coordinate, in px and in stated sigmas, and the largest length of an error in sigmas.
    seconds
        Of one processor.
    """

    look: Look
    answer: str
    seconds: float
    expected: int
    is_found: bool = False
    is_raised: bool = False
    is_kind_right: bool = False
    is_lattice_right: bool = False
    points: int = 0
    share: float = 0.0
    false: float = 0.0
    spacing_error: float = float("nan")
    agreement: float = float("nan")
    error_px: float = float("nan")
    error_sigmas: float = float("nan")
    worst_sigmas: float = float("nan")
    stated_px: float = float("nan")

    @property
    def faults(self) -> tuple[str, ...]:
        """Names of what is not fine."""
        if not self.is_found:
            return ("raised" if self.is_raised else "not found",)
        wrong = {
            "kind": not self.is_kind_right,
            "lattice": not self.is_lattice_right,
            "false": self.false > MOST_FALSE,
            "few": self.share < LEAST_SHARE,
            # Not a number is no good.
            "error": not self.error_sigmas <= MOST_SIGMAS,
        }
        return tuple(name for name, has in wrong.items() if has)


def judge(look: Look, picture: Picture) -> tuple[Outcome, str]:
    """What is found in a picture, and the traceback if there is one."""
    start = time.process_time()
    trace = ""
    try:
        found = find_lattice(picture.image)
        answer = found.pattern if isinstance(found, LatticeDetection) else found.reason
    # Whatever it raises is the outcome.
    except Exception as error:
        found, answer, trace = None, f"{type(error).__name__}: {error}", traceback.format_exc()
    seconds = time.process_time() - start
    if not isinstance(found, LatticeDetection):
        expected = len(picture.truth.xy)
        return Outcome(look, answer, seconds, expected, is_raised=found is None), trace
    look_again = found.pattern != PATTERNS[look.kind] and look.kind != "chess"
    truths = [picture.truth, *([find_truth(look, between=True)] if look_again else [])]
    compared = [(len(truth.xy), _compare(found, truth)) for truth in truths]
    expected, facts = min(compared, key=lambda own: own[1]["false"])
    return Outcome(
        look,
        answer,
        seconds,
        expected,
        is_found=True,
        is_kind_right=found.pattern == PATTERNS[look.kind] or _may_be(look, found.pattern),
        **facts,
    ), trace


def _may_be(look: Look, pattern: str) -> bool:
    """Whether a picture may be called this pattern as well."""
    side = {"pads": look.size, "mesh": 1.0 - look.size}.get(look.kind, 0.0)
    return pattern in ("dots", "lines") and LEAST_LIKE <= side <= LARGEST_LIKE


def _compare(found: LatticeDetection, truth: Truth) -> dict[str, object]:
    """The fields of an :class:`Outcome` that compare points with the true ones."""
    ij = np.concatenate([truth.ij, truth.other_ij])
    xy = np.concatenate([truth.xy, truth.other_xy])
    spacing_error = found.spacing_px / truth.pitch_px - 1.0
    facts = {"points": len(found.xy), "spacing_error": float(spacing_error), "false": 1.0}
    if not len(xy):
        return facts
    distance, nearest = cKDTree(xy).query(found.xy)
    near = distance < REACH * truth.pitch_px
    false = 1.0 - float(near.mean())
    seen = nearest[near][nearest[near] < len(truth.xy)]
    share = len(np.unique(seen)) / max(1, len(truth.xy))
    facts |= {"false": false, "share": share}
    if not near.any():
        return facts
    error = found.xy[near] - xy[nearest[near]]
    covariance = found.covariance_px2[near]
    square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    turn, agreement = _turn_of(found.ij[near].astype(np.int64), ij[nearest[near]])
    is_turn = np.array_equal(turn @ turn.T, np.eye(2)) and np.linalg.det(turn) > 0.0
    return facts | {
        "agreement": agreement,
        "is_lattice_right": bool(
            is_turn
            and agreement >= LEAST_AGREEMENT
            and false <= MOST_FALSE_OF_LATTICE
            and abs(spacing_error) <= MOST_SPACING_ERROR
        ),
        "error_px": float(np.sqrt(np.mean(error**2))),
        "error_sigmas": float(np.sqrt(np.mean(square) / 2.0)),
        "worst_sigmas": float(np.sqrt(square.max())),
        "stated_px": float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).mean() / 2.0)),
    }


def _turn_of(found: Indices, true: Indices) -> tuple[Array, float]:
    """(2, 2) true steps of the columns that most steps between found neighbours are, and the part of them that are."""
    places = {(int(i), int(j)): k for k, (i, j) in enumerate(found)}
    columns, right, number = [], 0, 0
    for di, dj in ((1, 0), (0, 1)):
        pairs = [(k, places.get((i + di, j + dj))) for (i, j), k in places.items()]
        steps = np.array([true[b] - true[a] for a, b in pairs if b is not None]).reshape(-1, 2)
        if not len(steps):
            return np.zeros((2, 2)), 0.0
        values, counts = np.unique(steps, axis=0, return_counts=True)
        columns.append(values[np.argmax(counts)])
        right, number = right + int(counts.max()), number + len(steps)
    return np.stack(columns, axis=1).astype(np.float64), right / number


# -- what is printed -------------------------------------------------------------------------------


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if len(values) else float("nan")


def ratios(outcomes: Sequence[Outcome]) -> list[float]:
    """Error over sigma of each picture whose lattice is the right one."""
    return [o.error_sigmas for o in outcomes if o.is_lattice_right]


def _row(label: str, outcomes: Sequence[Outcome]) -> list[object]:
    found = [o for o in outcomes if o.is_found]
    right = [o for o in outcomes if o.is_lattice_right]
    return [
        label,
        len(outcomes),
        100.0 * len(found) / len(outcomes),
        sum(not o.is_kind_right for o in found),
        sum(not o.is_lattice_right for o in found),
        sum("false" in o.faults for o in found),
        sum("few" in o.faults for o in found),
        _median([o.share for o in right]),
        _median([o.error_px for o in right]),
        _median(ratios(outcomes)),
        _rms(ratios(outcomes)),
        _median([o.seconds / o.look.megapixels for o in outcomes]),
    ]


def tabulate(outcomes: Sequence[Outcome], seed: int) -> None:
    """Print the table by what the pictures have."""
    rows = [
        _row(label, chosen)
        for label, has in GROUPS.items()
        if (chosen := [o for o in outcomes if has(o.look)])
    ]
    show(
        f"{len(outcomes)} random pictures of calibration grids, seed {seed}",
        HEADER,
        rows,
        "kind, lattice, false, few: pictures found with the wrong kind or lattice, over 2 % false points, or less than"
        " half of the points.",
        "share of the true points, error px, err/sigma: medians of the pictures with the right lattice; RMS: of"
        " err/sigma.",
        f"processor time: {sum(o.seconds for o in outcomes):.0f} s",
    )


def failures(outcomes: Sequence[Outcome]) -> list[str]:
    """What is beyond the limit, in words."""
    count, found = len(outcomes), [o for o in outcomes if o.is_found]
    out = []
    if len(found) < LEAST_FOUND * count:
        out.append(f"{len(found)} of {count} are found, where it should be {LEAST_FOUND:.0%}")
    for label, number in (
        ("kind", sum(not o.is_kind_right for o in found)),
        ("lattice", sum(not o.is_lattice_right for o in found)),
    ):
        if number:
            out.append(f"{number} of {count} have the wrong {label}")
    if not LEAST_RATIO <= (ratio := _rms(ratios(outcomes))) <= LARGEST_RATIO:
        out.append(f"error over sigma is {ratio:.3g}, not {LEAST_RATIO} to {LARGEST_RATIO}")
    return out


def line_of(own: Outcome) -> str:
    """One line about one picture."""
    look = own.look
    text = f"{look.index:4d} {look.kind:7s} {look.width:4d} px, pitch {look.pitch_px:5.1f}, blur {look.blur_px:.1f}, "
    text += f"tilt {np.degrees(look.tilt_rad):2.0f}, {look.electrons:3.0f} e, contrast {look.contrast:.2f}"
    text += f", {look.region}" if look.is_partial else ""
    text += f"  {own.seconds:5.2f} s  {' '.join(own.faults) or 'fine'}: {own.answer[:110]}"
    if own.is_found:
        text += f", {own.points} points, {own.share:.0%} of {own.expected}, {own.false:.1%} false"
        text += f", spacing {own.spacing_error:+.1%}, {own.error_px:.4f} px, {own.error_sigmas:.2f} sigma"
    return text


def show_one(own: Outcome, trace: str) -> None:
    """Print everything about one picture."""
    for part in (own.look, own):
        for field in fields(part):
            if field.name not in ("look", "dust"):
                print(f"{field.name:18s} {getattr(part, field.name)}")
    for blob in own.look.dust:
        print(f"{'dust':18s} at ({blob.x:.0f}, {blob.y:.0f}), radius {blob.radius_px:.0f} px")
    print(f"{'visibility':18s} {visibility(own.look):.1f}")
    print(line_of(own))
    print(trace, end="")


def _save(folder: Path, own: Outcome, picture: Picture) -> None:
    name = f"{own.look.index:04d}_{own.look.kind}_{'-'.join(own.faults) or 'fine'}.png"
    cv2.imwrite(str(folder / name.replace(" ", "_")), picture.image)


def main() -> int:
    """Search all pictures, or one; 1 where the limit is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=300, help="pictures; default 300")
    parser.add_argument("--seed", type=int, default=0, help="of the pictures; default 0")
    parser.add_argument("--only", type=int, metavar="INDEX", help="one picture, in detail")
    parser.add_argument("--largest", type=int, metavar="PX", help="widest picture")
    parser.add_argument("--save", type=Path, metavar="DIR", help="where to write the pictures, PNG")
    given = parser.parse_args()
    if given.largest is not None and given.largest < LEAST_WIDTH:
        parser.error(f"--largest {given.largest}: no picture is narrower than {LEAST_WIDTH} px")
    if given.save is not None:
        given.save.mkdir(parents=True, exist_ok=True)
    # Times are those of one processor.
    cv2.setNumThreads(1)
    outcomes: list[Outcome] = []
    index = 0 if given.only is None else given.only
    while len(outcomes) < (given.count if given.only is None else 1):
        look = draw_look(given.seed, index)
        index += 1
        if given.only is None and given.largest is not None and look.width > given.largest:
            continue
        picture = render(look)
        own, trace = judge(look, picture)
        outcomes.append(own)
        if given.save is not None:
            _save(given.save, own, picture)
        if given.only is not None:
            show_one(own, trace)
        elif own.faults:
            print(line_of(own), flush=True)
    if given.only is not None:
        return 0
    tabulate(outcomes, given.seed)
    found = failures(outcomes)
    print("\n".join(f"beyond the limit: {text}" for text in found) or "within the limit")
    return 1 if found else 0


if __name__ == "__main__":
    raise SystemExit(main())
