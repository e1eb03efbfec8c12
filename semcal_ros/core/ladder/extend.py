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

"""Extend a calibration beyond its grid by pictures of one flat, textured specimen at a ladder of magnifications.

Pictures of one magnification that are shifted tell the distortion: what is far from the middle in one is near it in the
other. A scan that is turned by a quarter exchanges the axes, and tells aspect and skew. Pictures of neighbouring
magnifications tell the ratio of their scales; the lowest (or highest) of them lie in the range of the grid, which gives
the metre. Sutton et al. (2007), doi:10.1007/s11340-007-9042-z, calibrate from a speckle pattern and unknown shifts at
one magnification; Kaynig et al. (2010), doi:10.1016/j.jsb.2010.04.012, the lenses of montages from their overlaps.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, check_positive
from semcal_ros.core.camera.calibration_model import CalibrationModel, columns_of
from semcal_ros.core.camera.records import LadderRecord, Relay
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import CalibrationError, InvalidValueError
from semcal_ros.core.ladder.adjustment import LadderFit, adjust, cost_after_few_steps
from semcal_ros.core.ladder.agreement import (
    FLIPS,
    Flip,
    Misstatement,
    find_misstatement,
    flip_match,
    measure_disagreement,
    minus_log_evidence,
)
from semcal_ros.core.ladder.matching import (
    LadderPicture,
    Match,
    RejectedPair,
    Turns,
    calibrated_xy,
    check_connected,
    check_steps,
    compare_turns,
    match_all,
)
from semcal_ros.core.ladder.residuals import Link, camera_of, make_link, pair_rows
from semcal_ros.core.ladder.thresholds import (
    CREEP_MAX,
    CREEP_SIGMAS,
    EVIDENCE_SURE,
    LINKS_USED_MIN,
    NAMED_MAX,
    POSE_SIZE,
    SETTLED_DRIFT_PX,
    STEEPEST_RAD,
    TURNED_RAD,
    VARIANCE_FACTOR_MAX,
    VARIANCE_FACTOR_NOTED,
)
from semcal_ros.core.ladder.unknowns import (
    LadderSetup,
    LadderState,
    PicturePlace,
    make_setup,
    prior_root,
    start_state,
)
from semcal_ros.core.wording import counted


@dataclass(frozen=True)
class LadderStep:
    """What a ladder has at one magnification.

    Attributes
    ----------
    magnification
        The magnification.
    pictures, turned
        Number of pictures that were used, and how many of them are turned against the others.
    pairs, pairs_below
        Number of pairs with pictures of this magnification, and with those of the next lower one.
    rms_px
        RMS of their residuals per axis.
    """

    magnification: float
    pictures: int
    turned: int
    pairs: int
    pairs_below: int
    rms_px: float


@dataclass(frozen=True, eq=False)
class LadderResult:
    """An extended calibration.

    Attributes
    ----------
    model
        The calibration over the range of the grid and of the ladder.
    steps
        What was there at each magnification, ascending.
    rejected
        Pairs of pictures that were not used.
    unused
        Names of pictures that were not used.
    tilt_rad, tilt_sigma_rad
        Slope of the specimen, and how well it is known.
    drift_px
        1-sigma of the drift within a frame at the highest magnification, px.
    variance_factor
        Mean square of the residuals over their sigmas.
    weaknesses
        What the recording lacks, in sentences.
    """

    model: CalibrationModel
    steps: tuple[LadderStep, ...]
    rejected: tuple[RejectedPair, ...]
    unused: tuple[str, ...]
    tilt_rad: float
    tilt_sigma_rad: float
    drift_px: float
    variance_factor: float
    weaknesses: tuple[str, ...]


def extend_calibration(
    model: CalibrationModel,
    pictures: Sequence[LadderPicture],
    *,
    timing: ScanTiming | None = None,
    on_progress: Callable[[str, int, int | None], object] = lambda _stage, _done, _total: None,
) -> LadderResult:
    """Extend a calibration by a ladder of pictures.

    Parameters
    ----------
    model
        A calibration by the joint method.
    pictures
        Pictures of one place of a flat specimen, untilted: at each magnification some that are shifted by a fifth to a
        third of the field, and one whose scan is turned; the magnifications no more than a factor of 1.6 apart, from
        inside the calibrated range on.
    timing
        When the pixels of a frame are scanned; only its shape matters. None: line after line.
    on_progress
        Called with the stage, how much is done, and how much there is.

    Raises
    ------
    CalibrationError
        If the ladder has a gap, pictures do not overlap, the specimen repeats, is tilted, or the pictures do not show
        one plane at rest.
    InvalidValueError
        If the pictures do not fit the calibration.
    """
    _check_model(model)
    _check_ladder(model, pictures)
    measured = measure_ladder(model, pictures, timing=timing, on_progress=on_progress)
    setup, fit = measured.setup, measured.fit
    extended = make_model(measured)
    steps = describe_steps(measured)
    tilt, tilt_sigma = _tilt(setup, fit)
    weaknesses = (*find_unrest(measured), *_find_weaknesses(model, steps, extended))
    notes = describe_ladder(measured) | {"warnings": list(weaknesses)}
    extended = replace(extended, statistics={**model.statistics, "ladder": notes})
    return LadderResult(
        extended,
        steps,
        measured.rejected,
        measured.unused,
        tilt,
        tilt_sigma,
        _drift_px(fit) / measured.scale,
        fit.variance_factor,
        weaknesses,
    )


@dataclass(frozen=True, eq=False)
class LadderMeasurement:
    """An adjusted ladder with what was measured in its pictures.

    Attributes
    ----------
    setup, fit
        The unknowns, and their values.
    links
        Correspondences of the pairs.
    scale
        Pixels of the calibration per pixel of the pictures.
    rejected, unused
        Pairs and names of pictures that were not used.
    numbers
        Which of the pictures that were given are used.
    notes
        What contradicts what is stated of the pictures, in sentences.
    """

    setup: LadderSetup
    fit: LadderFit
    links: tuple[Link, ...]
    scale: float
    rejected: tuple[RejectedPair, ...]
    unused: tuple[str, ...]
    numbers: tuple[int, ...]
    notes: tuple[str, ...] = ()


def measure_ladder(
    model: CalibrationModel,
    pictures: Sequence[LadderPicture],
    *,
    timing: ScanTiming | None = None,
    on_progress: Callable[[str, int, int | None], object] = lambda _stage, _done, _total: None,
    calibrated: bool = True,
) -> LadderMeasurement:
    """Match the pictures of a ladder and adjust them.

    Parameters
    ----------
    model, pictures, timing, on_progress
        As of :func:`extend_calibration`; its errors.
    calibrated
        Whether the model is a calibration, with which the pictures must agree, and not a mere prior.
    """
    scale = scale_of_pictures(model, pictures)
    places = tuple(_places(pictures))
    size = model.image_width, model.image_height
    setup = make_setup(model, places, size)
    matches, rejected = match_all(setup, pictures, scale, on_progress)
    times = _Times(timing or ScanTiming(1.0), model.image_height, model.image_width)
    on_progress("adjusting", 0, None)
    known = model.magnification_range if calibrated else None
    used = check_connected(pictures, matches, rejected, known=known)
    ladder = _Ladder(model, places, scale, times)
    turns = compare_turns(pictures, matches)
    fitted, notes = _adjust_as_they_lie(ladder, used, matches, turns, calibrated=calibrated)
    left_out: list[int] = []
    while (wrong := find_misstatement(fitted.setup, fitted.fit)) is not None:
        own = [k for k in used if places[k].magnification == wrong.magnification]
        notes.append(_leave_out(ladder, used, own, wrong))
        left_out += own
        used = check_connected(pictures, matches, rejected, known=known, left_out=left_out)
        fitted = ladder.adjust(used, matches)
    setup, fit, links = fitted.setup, fitted.fit, fitted.links
    disagreement = measure_disagreement(setup, fit)
    if calibrated and not disagreement.is_chance:
        notes.append(
            "in the calibrated range the pictures disagree with the calibration (chi-square "
            f"{disagreement.chi_square:.0f} for {disagreement.freedom}), which may not hold any more: check it with a "
            "grid (semcal check)"
        )
    rejected += [
        RejectedPair(
            setup.pictures[links[k].first].name,
            setup.pictures[links[k].second].name,
            "it does not agree with the other pairs",
        )
        for k in sorted(set(range(len(links))) - set(fit.kept))
    ]
    check_fit(setup, fit, links)
    names = tuple(place.name for k, place in enumerate(places) if k not in used)
    return LadderMeasurement(
        setup, fit, links, scale, tuple(rejected), names, tuple(used), tuple(notes)
    )


@dataclass(frozen=True, eq=False)
class _Fitted:
    """An adjusted ladder: its unknowns, their values, and the correspondences."""

    setup: LadderSetup
    fit: LadderFit
    links: tuple[Link, ...]

    @property
    def minus_log_evidence(self) -> float:
        """See :func:`.minus_log_evidence`."""
        return minus_log_evidence(self.setup, self.fit, self.links)


@dataclass(frozen=True, eq=False)
class _Ladder:
    """What the adjustments of one ladder have in common."""

    model: CalibrationModel
    places: tuple[PicturePlace, ...]
    scale: float
    times: _Times

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the calibration, px."""
        return self.model.image_width, self.model.image_height

    def start(
        self, used: Sequence[int], matches: Sequence[Match]
    ) -> tuple[LadderSetup, LadderState, tuple[Link, ...]]:
        """Make the setup of the pictures that are used, the first state, and the matches between them."""
        number_of = {number: k for k, number in enumerate(used)}
        setup = make_setup(self.model, tuple(self.places[k] for k in used), self.size)
        own = [match for match in matches if {match.first, match.second} <= set(number_of)]
        state = _start(setup, own, number_of, self.scale)
        links = tuple(_link(setup, match, number_of, self.scale, self.times) for match in own)
        return setup, state, links

    def adjust(self, used: Sequence[int], matches: Sequence[Match]) -> _Fitted:
        """Adjust the pictures that are used, by the matches between them."""
        setup, state, links = self.start(used, matches)
        return _Fitted(setup, adjust(setup, state, links), links)


def _adjust_as_they_lie(
    ladder: _Ladder,
    used: Sequence[int],
    matches: Sequence[Match],
    turns: Turns,
    *,
    calibrated: bool,
) -> tuple[_Fitted, list[str]]:
    """Adjust, and tell what is to be said of how the pictures lie against the calibration.

    Raises
    ------
    CalibrationError
        If they are mirrored or turned against it, or the adjustment does not converge.
    """
    opposite = turns.opposite > turns.stated
    notes: list[str] = []
    if opposite:
        notes.append(
            "scans turn against what is stated of their rotation, and were taken as the pictures show it: the "
            "microscope calls the other sense positive"
        )
    elif turns.otherwise:
        notes.append(
            f"{counted(turns.otherwise, 'pair')} of pictures whose scans are turned by another angle than is stated, "
            "and were taken as the pictures show it"
        )
    if not calibrated:
        return ladder.adjust(used, matches), notes
    fitted: _Fitted | None = None
    failure: CalibrationError | None = None
    try:
        fitted = ladder.adjust(used, matches)
        check_fit(fitted.setup, fitted.fit, fitted.links)
    except CalibrationError as error:
        failure = error
    if (
        fitted is not None
        and failure is None
        and not opposite
        and measure_disagreement(fitted.setup, fitted.fit).is_chance
    ):
        return fitted, notes
    as_it_is = np.inf if fitted is None else fitted.minus_log_evidence
    # No adjustment makes up for a start that is far worse.
    most = cost_after_few_steps(*ladder.start(used, matches)) + EVIDENCE_SURE
    others = [(_adjust_flipped(ladder, used, matches, flip, most), flip) for flip in FLIPS]
    least, likely = min(others, key=lambda one: one[0])
    if least < as_it_is - EVIDENCE_SURE:
        raise CalibrationError(
            f"pictures that are {likely.name} against those of the calibration: its distortion fits them only so",
            expected="pictures as the microscope showed them when it was calibrated",
            do=f"flip them back, or calibrate with pictures that are {likely.name}, too",
        ) from failure
    if fitted is None:
        assert failure is not None
        raise failure
    if opposite and min(cost for cost, flip in others if flip.is_mirror) < as_it_is + EVIDENCE_SURE:
        notes[-1] += ", or all pictures are mirrored, which their distortion does not tell"
    return fitted, notes


def _adjust_flipped(
    ladder: _Ladder,
    used: Sequence[int],
    matches: Sequence[Match],
    flip: Flip,
    most_cost: float,
) -> float:
    """Minus twice the log evidence of flipped pictures; infinite if they show no ladder, or the first steps leave more
    cost than ``most_cost``.
    """
    flipped = [flip_match(match, flip) for match in matches]
    if cost_after_few_steps(*ladder.start(used, flipped)) > most_cost:
        return np.inf
    try:
        fitted = ladder.adjust(used, flipped)
        check_fit(fitted.setup, fitted.fit, fitted.links)
    except CalibrationError:
        return np.inf
    return fitted.minus_log_evidence


def _leave_out(
    ladder: _Ladder, used: Sequence[int], own: Sequence[int], wrong: Misstatement
) -> str:
    """Say why pictures of a magnification are left out.

    Raises
    ------
    CalibrationError
        If the ladder has a gap without them.
    """
    kept = [ladder.places[k].magnification for k in used if k not in own]
    other = "larger" if wrong.deviation > 0.0 else "smaller"
    names = ", ".join(ladder.places[k].name for k in own[:NAMED_MAX])
    names += f" and {len(own) - NAMED_MAX} more" if len(own) > NAMED_MAX else ""
    seen = (
        f"{counted(len(own), 'picture')} at {wrong.magnification:g}x ({names}) whose magnification the others show to "
        f"be {100.0 * abs(wrong.deviation):.2g} % {other}"
    )
    try:
        _check_range(ladder.model, kept)
    except CalibrationError as error:
        raise CalibrationError(
            seen,
            expected="the magnification or pixel size that they were taken at",
            do="correct it, or record them again; the ladder needs them",
        ) from error
    return f"left out: {seen}; their magnification or pixel size is not what is stated"


def describe_ladder(measured: LadderMeasurement) -> dict[str, object]:
    """What is written about a ladder for the readers of a calibration."""
    setup, fit = measured.setup, measured.fit
    return {
        "pictures": len(setup.pictures),
        "pairs": len(fit.kept),
        "variance_factor": fit.variance_factor,
        "drift_px": _drift_px(fit) / measured.scale,
        "tilt_rad": _tilt(setup, fit)[0],
        "creep": fit.state.creep,
        "relays": [[relay.low, relay.high, relay.jump] for relay in _relays(setup, fit)],
        "magnifications": sorted({picture.magnification for picture in setup.pictures}),
    }


def _check_model(model: CalibrationModel) -> None:
    if model.method != "joint":
        raise InvalidValueError(
            f"a calibration by the method {model.method}",
            expected="one by the joint method, whose functions have a covariance together",
            do="calibrate with --method joint",
        )


def _check_ladder(model: CalibrationModel, pictures: Sequence[LadderPicture]) -> None:
    _check_range(
        model, [check_positive(picture.magnification, "magnification") for picture in pictures]
    )


def _check_range(model: CalibrationModel, magnifications: Sequence[float]) -> None:
    """Refuse a ladder that does not begin in the calibrated range, or has a gap."""
    seen = sorted(set(magnifications))
    low, high = model.magnification_range
    if not any(low * (1 - 1e-6) <= g <= high * (1 + 1e-6) for g in seen):
        listed = f"{seen[0]:g}x to {seen[-1]:g}x" if seen else "nothing"
        raise CalibrationError(
            f"a ladder of {listed} without a picture in the calibrated range",
            expected=f"one that begins between {low:g}x and {high:g}x",
            do="record pictures of the same place there, in steps of at most 1.6",
        )
    check_steps(seen, (low, high))


def scale_of_pictures(model: CalibrationModel, pictures: Sequence[LadderPicture]) -> float:
    """Pixels of the calibration per pixel of the pictures; raises :class:`InvalidValueError` for another shape."""
    shapes = {picture.image.shape for picture in pictures}
    if len(shapes) != 1 or len(next(iter(shapes))) != 2:
        sizes = " and ".join(" x ".join(map(str, shape[1::-1])) for shape in sorted(shapes))
        raise InvalidValueError(
            f"pictures of {sizes} px" if sizes else "no pictures",
            expected="grey pictures of one size",
            do="take all with the same scan, and cut all data bars off alike",
        )
    height, width = next(iter(shapes))
    ratio = model.image_width / width
    if abs(ratio * height - model.image_height) > 0.01 * model.image_height:
        raise InvalidValueError(
            f"pictures of {width} x {height} px",
            expected=f"the shape of the calibration, {model.image_width} x {model.image_height}",
        )
    return ratio


def _places(pictures: Sequence[LadderPicture]) -> list[PicturePlace]:
    places: list[PicturePlace] = []
    visit, before = -1, None
    for number, picture in enumerate(pictures):
        if picture.magnification != before:
            visit, before = visit + 1, picture.magnification
        own = visit if picture.visit is None else picture.visit
        places.append(PicturePlace(picture.name or f"picture {number}", picture.magnification, own))
    return places


@dataclass(frozen=True)
class _Times:
    """When a pixel of the calibration's size is scanned, from -1/2 to 1/2 of the frame."""

    timing: ScanTiming
    rows: int
    columns: int

    def of(self, xy: Array) -> Array:
        offset = self.timing.pixel_offset_s(xy[:, 1], xy[:, 0], self.rows, self.columns)
        # All passes show the same drift at a pixel, but for their mean time.
        middle = self.timing.pixel_offset_s(
            0.5 * (self.rows - 1), 0.5 * (self.columns - 1), self.rows, self.columns
        )
        return np.asarray((offset - middle) / self.timing.frame_time_s)


def _link(
    setup: LadderSetup,
    match: Match,
    number_of: Mapping[int, int],
    scale: float,
    times: _Times,
) -> Link:
    first_xy, second_xy = (
        calibrated_xy(xy, scale) for xy in (match.found.first_xy, match.found.second_xy)
    )
    return make_link(
        setup,
        (number_of[match.first], number_of[match.second]),
        first_xy,
        second_xy,
        scale**2 * match.found.covariance,
        [times.of(first_xy), times.of(second_xy)],
    )


def _start(
    setup: LadderSetup,
    matches: Sequence[Match],
    number_of: Mapping[int, int],
    scale: float,
) -> LadderState:
    """Poses along the matches, from the first picture on."""
    state = start_state(setup)
    cameras = [camera_of(state, k) for k in range(len(setup.pictures))]
    near: dict[int, list[tuple[int, Array, Array]]] = {k: [] for k in range(len(setup.pictures))}
    for match in matches:
        a, b = number_of[match.first], number_of[match.second]
        flat_a, flat_b = (
            cameras[k].sem_from_ideal(cameras[k].undistort(calibrated_xy(xy, scale)))[:, :2]
            for k, xy in ((a, match.found.first_xy), (b, match.found.second_xy))
        )
        near[a].append((b, flat_a, flat_b))
        near[b].append((a, flat_b, flat_a))
    values = state.values.copy()
    poses = {0: (0.0, np.zeros(2))}
    queue = deque([0])
    while queue:
        number = queue.popleft()
        angle, shift = poses[number]
        for other, own_flat, other_flat in near[number]:
            if other in poses:
                continue
            c, s = np.cos(angle), np.sin(angle)
            on_specimen = (own_flat - shift) @ np.array([[c, -s], [s, c]])
            poses[other] = _rigid(on_specimen, other_flat)
            queue.append(other)
    start = setup.bounds[5].start
    for number, (angle, shift) in poses.items():
        at = start + POSE_SIZE * number
        values[at] = angle
        values[at + 1 : at + 3] = shift / setup.pixel_m(setup.pictures[number].magnification)
    return LadderState(setup, values)


def _rigid(source: Array, target: Array) -> tuple[float, Array]:
    """Turn and shift with ``target = R source + shift`` by least squares (Umeyama 1991, doi:10.1109/34.88573)."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    cross = a.T @ b
    angle = float(np.arctan2(cross[0, 1] - cross[1, 0], cross[0, 0] + cross[1, 1]))
    c, s = np.cos(angle), np.sin(angle)
    return angle, target.mean(axis=0) - np.array([[c, -s], [s, c]]) @ source.mean(axis=0)


# -- what came out --------------------------------------------------------------------------------


def _drift_px(fit: LadderFit) -> float:
    return float(np.hypot(fit.drift.steady_px, fit.drift.change_px))


def _tilt(setup: LadderSetup, fit: LadderFit) -> tuple[float, float]:
    slopes = setup.bounds[4]
    values = fit.state.values[slopes]
    spread = np.sqrt(np.trace(fit.covariance[slopes, slopes]))
    return float(np.hypot(*values)), float(spread)


def creep_of(setup: LadderSetup, fit: LadderFit) -> tuple[float, float]:
    """Relative change of the scale from each picture to the next one, and its 1-sigma."""
    place = setup.bounds[7].start
    return fit.state.creep, float(np.sqrt(fit.covariance[place, place]))


def check_fit(setup: LadderSetup, fit: LadderFit, links: Sequence[Link]) -> None:
    """Refuse a ladder whose specimen is tilted, or whose pictures do not show one plane at rest.

    Raises
    ------
    CalibrationError
        With what was seen.
    """
    share = len(fit.kept) / len(links)
    if share < LINKS_USED_MIN or fit.variance_factor > VARIANCE_FACTOR_MAX:
        raise CalibrationError(
            f"pairs of pictures that disagree by {np.sqrt(fit.variance_factor):.1f} times what they state, "
            f"{100.0 * (1.0 - share):.0f} % of them left out",
            expected="pictures of one plane at rest",
            do="use a flat specimen that neither charges nor moves, and wait until the drift has settled",
        )
    tilt, sigma = _tilt(setup, fit)
    if tilt > STEEPEST_RAD and tilt > 3.0 * sigma:
        raise CalibrationError(
            f"a specimen that looks tilted by {np.degrees(tilt):.1f} degrees",
            expected=f"one that lies flat, to {np.degrees(STEEPEST_RAD):.0f} degrees, and is at rest",
            do="untilt the stage, or wait until nothing moves or charges, and record the ladder again",
        )
    creep, creep_sigma = creep_of(setup, fit)
    pictures = len(setup.pictures)
    if abs(creep) > CREEP_SIGMAS * creep_sigma and abs(creep) * pictures > CREEP_MAX:
        raise CalibrationError(
            f"a scale that creeps by {100.0 * creep:+.3f} +- {100.0 * creep_sigma:.3f} % from picture to picture",
            expected=f"less than {100.0 * CREEP_MAX:g} % over all {pictures} pictures",
            do="use a specimen that does not charge, and wait until the microscope has settled",
        )
    linked = {number for k in fit.kept for number in (links[k].first, links[k].second)}
    alone = [setup.pictures[k].name for k in range(len(setup.pictures)) if k not in linked]
    if alone:
        raise CalibrationError(
            f"{counted(len(alone), 'picture')} that agree with no other: {', '.join(alone[:3])}",
            expected="pictures of one plane at rest",
            do="leave them out",
        )


def _estimate_growth(setup: LadderSetup, fit: LadderFit, links: Sequence[Link]) -> float:
    """Relative 1-sigma of the scale per factor of e that the pairs across the zoom do not agree on.

    The ratio of two scales that one pair asks for differs from that of another pair by more than their noise where the
    camera is not all that its model says. What is left of their mean may be the same at every step.
    """
    by_step: dict[tuple[float, float], list[tuple[float, float]]] = {}
    for k in fit.kept:
        link = links[k]
        ends = [setup.pictures[number].magnification for number in (link.first, link.second)]
        if ends[0] == ends[1]:
            continue
        rows = pair_rows(fit.state, link)
        offset = link.second_xy - link.second_xy.mean(axis=0)
        pattern = np.einsum("nij,nj->ni", link.weight, offset).ravel()
        information = float(pattern @ pattern)
        ratio = float(pattern @ rows.values) / information
        by_step.setdefault((ends[0], ends[1]), []).append((ratio, 1.0 / information))
    steps = [np.array(values) for values in by_step.values() if len(values) > 2]
    if not steps:
        return 0.0
    excess, counts = [], []
    for values in steps:
        count = len(values)
        scatter = float(np.var(values[:, 0], ddof=1))
        noise = max(fit.variance_factor, 1.0) * float(np.mean(values[:, 1]))
        excess.append(scatter - noise)
        counts.append(count)
    common = max(float(np.mean(excess)), 0.0) / float(np.mean(counts))
    length = float(np.mean([np.log(max(pair) / min(pair)) for pair in by_step]))
    return float(np.sqrt(common)) / length


def _relays(setup: LadderSetup, fit: LadderFit) -> tuple[Relay, ...]:
    values = fit.state.values[setup.bounds[2]]
    mean = fit.state.theta[: setup.functions["scale"].size]
    level = float(setup.functions["scale"].basis(setup.pictures[-1].magnification) @ mean)
    return tuple(Relay(*setup.intervals[k], float(values[k]) / level) for k in sorted(fit.jumps))


def make_model(measured: LadderMeasurement) -> CalibrationModel:
    """The calibration that a ladder was measured with, extended by it."""
    setup, fit, model = measured.setup, measured.fit, measured.setup.model
    growth = _estimate_growth(setup, fit, measured.links)
    functions_part = setup.bounds[2].stop
    columns = setup.theta_columns
    theta = fit.state.theta
    covariance = columns @ fit.covariance[:functions_part, :functions_part] @ columns.T
    # Jumps that were not found leave the functions.
    dropped = [
        int(column) for k, column in enumerate(setup.jump_columns) if k not in set(fit.jumps)
    ]
    kept = np.setdiff1d(np.arange(len(theta)), dropped)
    functions = {}
    for name, own in columns_of(setup.functions).items():
        function = setup.functions[name]
        inside = [k for k in range(own.start, own.stop) if k not in dropped]
        breaks = function.breaks
        if name == "scale" and len(breaks):
            first = own.stop - len(breaks)
            breaks = breaks[[k for k in range(len(breaks)) if first + k not in dropped]]
        functions[name] = replace(function, coefficients=theta[inside], breaks=breaks)
    whole = covariance[np.ix_(kept, kept)]
    if model.residual is not None:
        whole = _with_field(setup, fit, columns[kept], whole)
    anchored = model.magnification_range if model.ladder is None else model.ladder.anchored
    relays = () if model.ladder is None else model.ladder.relays
    before = 0.0 if model.ladder is None else model.ladder.growth
    ladder = LadderRecord(anchored, max(growth, before), (*relays, *_relays(setup, fit)))
    seen = {picture.magnification for picture in setup.pictures}
    low, high = model.magnification_range
    outside = {g for g in seen if not low * (1 - 1e-6) <= g <= high * (1 + 1e-6)}
    return replace(
        model,
        functions=functions,
        covariance=0.5 * (whole + whole.T),
        magnifications=tuple(sorted({*model.magnifications, *outside})),
        ladder=ladder,
    )


def _with_field(setup: LadderSetup, fit: LadderFit, columns: Array, functions: Array) -> Array:
    """The covariance with the residual field, which stays as it is, and what its correlation becomes."""
    model = setup.model
    size = sum(function.size for function in model.functions.values())
    field = model.covariance[size:, size:]
    cross = (
        np.linalg.pinv(prior_root(model.covariance[:size, :size])) @ model.covariance[:size, size:]
    )
    gain = fit.covariance[: setup.bounds[2].stop, setup.bounds[0]]
    new_cross = columns @ gain @ cross
    return np.block([[functions, new_cross], [new_cross.T, field]])


def describe_steps(measured: LadderMeasurement) -> tuple[LadderStep, ...]:
    """What a ladder has at each of its magnifications, ascending."""
    setup, fit, links, scale = measured.setup, measured.fit, measured.links, measured.scale
    levels = sorted({picture.magnification for picture in setup.pictures})
    squares: dict[float, list[Array]] = {g: [] for g in levels}
    own, below = dict.fromkeys(levels, 0), dict.fromkeys(levels, 0)
    for k in fit.kept:
        link = links[k]
        ends = [setup.pictures[number].magnification for number in (link.first, link.second)]
        rows = pair_rows(fit.state, link)
        residual = np.linalg.solve(link.weight, rows.values.reshape(-1, 2)[..., None])[..., 0]
        squares[max(ends)].append(np.asarray(residual / scale))
        if ends[0] == ends[1]:
            own[ends[0]] += 1
        else:
            below[max(ends)] += 1
    steps = []
    for g in levels:
        numbers = [k for k, picture in enumerate(setup.pictures) if picture.magnification == g]
        angles = np.array([fit.state.poses[k, 0] for k in numbers])
        turned = np.abs(np.angle(np.exp(1j * (angles - angles[0])))) > TURNED_RAD
        rms = np.sqrt(np.mean(np.concatenate(squares[g]) ** 2)) if squares[g] else 0.0
        steps.append(
            LadderStep(g, len(numbers), int(np.count_nonzero(turned)), own[g], below[g], float(rms))
        )
    return tuple(steps)


def find_unrest(measured: LadderMeasurement) -> tuple[str, ...]:
    """What contradicts what is stated, and what shows that something was not quite at rest, in sentences."""
    setup, fit = measured.setup, measured.fit
    found = list(measured.notes)
    drift_px = _drift_px(fit) / measured.scale
    if drift_px > SETTLED_DRIFT_PX:
        last = max(picture.magnification for picture in setup.pictures)
        found.append(
            f"pictures agree only with a drift within a frame of {drift_px:.1f} px (1-sigma) at {last:g}x: the "
            "specimen has not settled, or something that is fixed to the scan, and no drift, distorts them"
        )
    if fit.variance_factor > VARIANCE_FACTOR_NOTED:
        found.append(
            f"pictures disagree by {np.sqrt(fit.variance_factor):.1f} times what their noise explains, which the "
            "stated uncertainty contains: a part of the specimen moves, it charges, or it is not flat"
        )
    creep, sigma = creep_of(setup, fit)
    if abs(creep) > CREEP_SIGMAS * sigma:
        found.append(
            f"the scale creeps by {100.0 * creep:+.3f} +- {100.0 * sigma:.3f} % from picture to picture, which was "
            "taken out: the specimen charges, or the microscope has not settled"
        )
    return tuple(found)


def _find_weaknesses(
    model: CalibrationModel, steps: Sequence[LadderStep], extended: CalibrationModel
) -> tuple[str, ...]:
    """What the recording lacks."""
    low, high = model.magnification_range
    beyond = [step for step in steps if not low <= step.magnification <= high]
    found = []
    if not any(step.turned for step in beyond):
        found.append(
            "no scan is turned beyond the grid, so that aspect and skew there rest on how they are at its end: "
            "turn the scan by 90 degrees for a picture at every second magnification"
        )
    single = [step.magnification for step in beyond if step.pictures < 2]
    if single:
        listed = ", ".join(f"{g:g}x" for g in single[:4])
        found.append(
            f"one picture only at {listed}: nothing tells the distortion there; move by a fifth to a third of the field"
        )
    anchors = sum(1 for step in steps if low <= step.magnification <= high)
    if anchors == 1 and model.scale_sigma.repeatability > 0.0:
        found.append(
            "one magnification only lies in the calibrated range, so that its scale of this visit is that of the "
            "whole ladder: begin two or three steps lower"
        )
    if extended.ladder is not None and extended.ladder.relays:
        found += [
            f"the scale (px per m) jumps by {100.0 * relay.jump:+.2f} % between {relay.low:g}x and {relay.high:g}x: "
            "record more magnifications there to find where"
            for relay in extended.ladder.relays
        ]
    return tuple(found)
