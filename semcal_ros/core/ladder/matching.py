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

"""Which pictures of a ladder show the same: pairs of one magnification, and of neighbouring ones."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise, product

import numpy as np

from semcal_ros.core.arrays import AnyImage, Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import CalibrationError, Rejection
from semcal_ros.core.ladder.correspondences import (
    Correspondences,
    PairFailure,
    Prepared,
    match_pictures,
)
from semcal_ros.core.ladder.residuals import camera_of
from semcal_ros.core.ladder.thresholds import (
    CORRELATION_SURE,
    QUARTER_TURNS_RAD,
    ROUNDING_RATIO,
    SAME_ANGLE_RAD,
    SETTING_RATIO,
    STEP_MAX,
    TURNED_RAD,
)
from semcal_ros.core.ladder.unknowns import LadderSetup, start_state


@dataclass(frozen=True, eq=False)
class LadderPicture:
    """A picture of the specimen.

    Attributes
    ----------
    image
        (h, w) grey levels, without a data bar.
    magnification
        Its magnification.
    name
        For messages.
    scan_rotation_rad
        By how much the scan was turned, where that is known: a positive angle turns the specimen in the picture from
        +x to +y.
    visit
        Number of the stretch between which the magnification was not set; None: it changes with the magnification.
    """

    image: AnyImage
    magnification: float
    name: str = ""
    scan_rotation_rad: float | None = None
    visit: int | None = None


@dataclass(frozen=True)
class RejectedPair:
    """Two pictures that were not matched, or do not agree with the others."""

    first: str
    second: str
    reason: str


@dataclass(frozen=True, eq=False)
class Match:
    """Two pictures that show the same: by their numbers, the one with the larger pixels first."""

    first: int
    second: int
    found: Correspondences


def calibrated_xy(xy: Array, scale: float) -> Array:
    """Pixels of the calibration's size (n, 2) of those of a picture (n, 2); ``scale`` of the former per latter."""
    return scale * (xy + 0.5) - 0.5


def picture_xy(xy: Array, scale: float) -> Array:
    """Back from :func:`calibrated_xy`."""
    return (xy + 0.5) / scale - 0.5


def _is_gap(below: float, above: float) -> bool:
    """Whether a step between two magnifications is too large to match their pictures."""
    return above > STEP_MAX * ROUNDING_RATIO * below


def check_steps(magnifications: Iterable[float], known: tuple[float, float] | None = None) -> None:
    """Refuse a ladder with a gap.

    Parameters
    ----------
    magnifications
        Those of the pictures.
    known
        A range in which a gap does no harm, since a calibration tells its scales.

    Raises
    ------
    CalibrationError
        With the gap and what to record.
    """
    for below, above in pairwise(sorted(set(magnifications))):
        inside = known is not None and known[0] <= below and above <= known[1]
        if _is_gap(below, above) and not inside:
            raise CalibrationError(
                f"a gap in the ladder from {below:g}x to {above:g}x, a factor of {above / below:.2f}",
                expected=f"steps of at most {STEP_MAX:g}",
                do=f"record pictures at {np.sqrt(below * above):.0f}x, too",
            )


def _candidates(pictures: Sequence[LadderPicture]) -> list[tuple[int, int]]:
    """Pairs of one magnification, and of neighbouring ones, the lower magnification first.

    Magnifications that hardly differ count as one: a wrong one must not part its neighbours.
    """
    ascending = sorted(range(len(pictures)), key=lambda k: (pictures[k].magnification, k))
    settings: list[list[int]] = []
    for number in ascending:
        g = pictures[number].magnification
        if settings and g < SETTING_RATIO * pictures[settings[-1][0]].magnification:
            settings[-1].append(number)
        else:
            settings.append([number])
    pairs = [pair for own in settings for pair in combinations(own, 2)]
    for below, above in pairwise(settings):
        pairs += [
            (a, b)
            for a, b in product(below, above)
            if not _is_gap(pictures[a].magnification, pictures[b].magnification)
        ]
    return pairs


def match_all(
    setup: LadderSetup,
    pictures: Sequence[LadderPicture],
    scale: float,
    on_progress: Callable[[str, int, int | None], object],
) -> tuple[list[Match], list[RejectedPair]]:
    """Match all pairs that may overlap.

    Scans are taken to be turned as is stated. Pictures that are left alone by that are tried at the other quarters,
    first in the other sense: some microscopes call the rotation positive that others call negative.
    """
    start = start_state(setup)
    cameras = [camera_of(start, k) for k in range(len(pictures))]
    prepared = [Prepared(np.asarray(p.image, dtype=np.float32)) for p in pictures]
    pairs = _candidates(pictures)
    matches: dict[tuple[int, int], Match] = {}
    reasons: dict[tuple[int, int], str] = {}

    def attempt(pair: tuple[int, int], turns: Sequence[float]) -> None:
        first, second = pair
        best: tuple[float, Correspondences] | None = None
        for turn in turns:
            predict = make_predictor(cameras[first], cameras[second], turn, scale)
            found = match_pictures(prepared[first], prepared[second], predict)
            if isinstance(found, Rejection):
                if pair not in reasons or found.status is PairFailure.PERIODIC:
                    reasons[pair] = found.reason
                continue
            if best is None or found.correlation * np.sqrt(len(found)) > best[0]:
                best = (found.correlation * float(np.sqrt(len(found))), found)
            if found.correlation > CORRELATION_SURE:
                break
        if best is not None:
            matches[pair] = Match(first, second, best[1])

    for done, pair in enumerate(pairs):
        on_progress("matching pictures", done, len(pairs))
        attempt(pair, _turns_to_try(*(pictures[k] for k in pair)))
    groups = _groups(len(pictures), matches)
    for group in groups[1:]:
        apart = [pair for pair in pairs if (pair[0] in group) != (pair[1] in group)]
        for pair in apart:
            stated = _stated_turn(*(pictures[k] for k in pair))
            if stated is not None:
                attempt(pair, _other_turns(stated))
    on_progress("matching pictures", len(pairs), len(pairs))
    rejected = [
        RejectedPair(setup.pictures[a].name, setup.pictures[b].name, reasons[a, b])
        for a, b in pairs
        if (a, b) not in matches
    ]
    return [matches[pair] for pair in pairs if pair in matches], rejected


def _stated_turn(first: LadderPicture, second: LadderPicture) -> float | None:
    """By how much the second scan is turned against the first, as far as both say it."""
    if first.scan_rotation_rad is None or second.scan_rotation_rad is None:
        return None
    return second.scan_rotation_rad - first.scan_rotation_rad


def _turns_to_try(first: LadderPicture, second: LadderPicture) -> tuple[float, ...]:
    stated = _stated_turn(first, second)
    return QUARTER_TURNS_RAD if stated is None else (stated,)


def _other_turns(stated: float) -> tuple[float, ...]:
    """Turns beside the stated one: the other sense first."""
    others = (-stated, *(stated + quarter for quarter in QUARTER_TURNS_RAD[1:]))
    kept: list[float] = []
    for turn in others:
        if all(
            abs(math.remainder(turn - one, 2.0 * math.pi)) > SAME_ANGLE_RAD
            for one in (stated, *kept)
        ):
            kept.append(turn)
    return tuple(kept)


@dataclass(frozen=True)
class Turns:
    """What turned scans say about the stated rotations: numbers of pairs that differ by a quarter or more.

    Attributes
    ----------
    stated, opposite, otherwise
        Pairs that are turned as stated, by the opposite angle, and by neither.
    """

    stated: int
    opposite: int
    otherwise: int


def compare_turns(pictures: Sequence[LadderPicture], matches: Sequence[Match]) -> Turns:
    """Compare how scans are turned with what was stated."""
    counts = {"stated": 0, "opposite": 0, "otherwise": 0}
    for match in matches:
        stated = _stated_turn(pictures[match.first], pictures[match.second])
        if stated is None:
            continue
        width, height = match.found.map.size
        linear = match.found.map.jacobian(np.array([[0.5 * width, 0.5 * height]]))[0]
        seen = math.atan2(linear[1, 0] - linear[0, 1], linear[0, 0] + linear[1, 1])

        def is_close(angle: float, seen: float = seen) -> bool:
            return abs(math.remainder(seen - angle, 2.0 * math.pi)) < TURNED_RAD

        if is_close(stated):
            # Half a turn, and none, look the same in both senses.
            counts["stated"] += not is_close(-stated)
        else:
            counts["opposite" if is_close(-stated) else "otherwise"] += 1
    return Turns(**counts)


def make_predictor(
    first: ScanCamera, second: ScanCamera, turn: float, scale: float
) -> Callable[[Array], Array]:
    """Where the second picture would show a pixel of the first if their middles showed the same.

    Parameters
    ----------
    first, second
        The cameras of both.
    turn
        By how much the scan of the second is turned against that of the first, rad.
    scale
        Pixels of the calibration per pixel of the pictures.
    """
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s], [s, c]])

    def middle(camera: ScanCamera) -> Array:
        at = 0.5 * np.array([[camera.width - 1.0, camera.height - 1.0]])
        return camera.sem_from_ideal(camera.undistort(at))[0, :2]

    here, there = middle(first), middle(second)

    def predict(xy: Array) -> Array:
        ideal = first.undistort(calibrated_xy(xy, scale))
        flat = (first.sem_from_ideal(ideal)[:, :2] - here) @ rotation.T + there
        seen = second.project(np.column_stack([flat, np.zeros(len(flat))]))
        return picture_xy(seen, scale)

    return predict


def _groups(count: int, matched: Iterable[tuple[int, int]]) -> list[set[int]]:
    """Groups of pictures that hang together by pairs, the largest first."""
    near: dict[int, set[int]] = {k: set() for k in range(count)}
    for first, second in matched:
        near[first].add(second)
        near[second].add(first)
    groups: list[set[int]] = []
    left = set(near)
    while left:
        group, queue = set(), deque([min(left)])
        while queue:
            number = queue.popleft()
            if number not in group:
                group.add(number)
                queue.extend(near[number] - group)
        groups.append(group)
        left -= group
    return sorted(groups, key=len, reverse=True)


def _is_whole(
    present: Sequence[float], levels: Sequence[float], known: tuple[float, float] | None
) -> bool:
    """Whether magnifications reach as far as all, without a gap."""
    try:
        check_steps(present, known)
    except CalibrationError:
        return False
    return present[0] == levels[0] and present[-1] == levels[-1]


def check_connected(
    pictures: Sequence[LadderPicture],
    matches: Sequence[Match],
    rejected: Sequence[RejectedPair],
    *,
    known: tuple[float, float] | None,
    left_out: Sequence[int] = (),
) -> list[int]:
    """Numbers of the pictures that hang together.

    Parameters
    ----------
    pictures, matches, rejected
        All pictures, and which pairs were matched and were not.
    known
        A range in which a gap does no harm.
    left_out
        Pictures that are not used, for other reasons.

    Raises
    ------
    CalibrationError
        If they do not reach from one end of the ladder to the other.
    """
    near = [(m.first, m.second) for m in matches if not {m.first, m.second} & set(left_out)]
    largest = _groups(len(pictures), near)[0]
    levels = sorted({p.magnification for k, p in enumerate(pictures) if k not in left_out})
    present = sorted({pictures[k].magnification for k in largest})
    missing = [g for g in levels if g not in present]
    if len(largest) < 2 or (missing and not _is_whole(present, levels, known)):
        reasons = [pair.reason for pair in rejected]
        most = max(set(reasons), key=reasons.count) if reasons else "too few pictures"
        where = f"{missing[0]:g}x" if missing else f"{levels[0]:g}x"
        nearest = (
            min(present, key=lambda g: abs(np.log(g / missing[0]))) if missing and present else 0.0
        )
        rest = f" and those at {nearest:g}x" if nearest and len(largest) > 1 else ""
        if any("repeats" in reason for reason in reasons):
            most = "a specimen that repeats"
        raise CalibrationError(
            f"pictures at {where}{rest} that were not matched: {most}",
            expected="pictures of one place with texture that does not repeat, which overlap by a fifth at least",
            do="keep the place in the middle from step to step, and move by a fifth to a third of the field",
        )
    return sorted(largest)
