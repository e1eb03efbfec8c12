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

"""Ladders of small pictures of grains, drawn by ``benchmarks.calibration.ladder``, and of what must not pass for one.

Ladders are compared with the truth between their magnifications, by relative errors of nm per pixel: beyond the grid,
with a relay, a visit that is misstated, scans of unknown rotation with dust that moves, and a scale that creeps; and
without a grid, by a length and by a stage whose moves are as planned, to 2 % of the field. Places of single pictures
in others are errors in px. The rest is plans and refusals.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.calibration.grains import Grains, take_picture
from benchmarks.calibration.ladder import (
    FIRST,
    Case,
    camera_at,
    compare,
    draw_case,
    draw_microscope,
    record,
)
from benchmarks.thresholds.answers import Answer, digest_of, refusal
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.errors import SemcalError
from semcal_ros.core.ladder import acquisition
from semcal_ros.core.ladder.acquisition import PictureRequest, plan_pictures
from semcal_ros.core.ladder.extend import extend_calibration
from semcal_ros.core.ladder.from_specimen import (
    KnownLength,
    StageMoves,
    calibrate_from_specimen,
)
from semcal_ros.core.ladder.matching import LadderPicture

Floats = NDArray[np.float64]

SIZE, LAST, PICTURES = 224, 14800.0, 4
# Of the generator: a relay between the last two magnifications; without one.
RELAY_SEED, SEED = 22, 0
WRONG_SIGMAS = 4.0
MISSTATED, DUST_AT = 1.05, 6
PLACED_AT, LENGTH_SIGMA = 7000.0, 0.004


@dataclass(frozen=True)
class Drawn:
    """A microscope, its pictures, and what is done with them.

    Attributes
    ----------
    action
        What is done.
    seed, with_relay
        Of the microscope, whose law cannot be copied to another process.
    calibration
        Its calibration from a grid.
    pictures
        Of the ladder, or one to find in another.
    offset_px
        (2,) where the second picture shows the middle of the first, off its own middle.
    """

    action: str
    seed: int
    with_relay: bool
    calibration: CalibrationModel
    pictures: tuple[LadderPicture, ...] = ()
    offset_px: tuple[float, float] = (0.0, 0.0)

    @property
    def case(self) -> Case:
        """The microscope with its calibration."""
        scope, relay, rng = draw_microscope(self.seed, SIZE, self.with_relay)
        return Case(scope, self.calibration, relay, rng)


def draw() -> dict[str, Any]:
    """Draw the pictures."""
    plain = draw_case(SEED, SIZE, with_relay=False)
    taken = tuple(record(plain, LAST, PICTURES))
    drawn = Drawn("extend", SEED, False, plain.calibration, taken)
    cases: dict[str, Any] = {}
    relay = draw_case(RELAY_SEED, SIZE, with_relay=True)
    pictures = tuple(record(relay, LAST, PICTURES))
    cases["relay"] = Drawn("extend", RELAY_SEED, True, relay.calibration, pictures)
    third = sorted({one.magnification for one in taken})[2]
    wrong = tuple(
        replace(one, magnification=MISSTATED * third) if one.magnification == third else one
        for number, one in enumerate(taken)
        if number % PICTURES != 2
    )
    cases["misstated"] = replace(drawn, pictures=wrong)
    # Scans of unknown rotation, one of which shows dust that has moved.
    dusty = [replace(one, scan_rotation_rad=None) for one in taken]
    dusty[DUST_AT] = replace(dusty[DUST_AT], image=_with_dust(np.asarray(dusty[DUST_AT].image)))
    cases["dust"] = replace(drawn, pictures=tuple(dusty))
    creeping = draw_case(SEED + 1, SIZE, with_relay=False)
    pictures = tuple(_record_creeping(creeping))
    cases["creep"] = Drawn("extend", SEED + 1, False, creeping.calibration, pictures)
    # Fewer pictures, of three magnifications.
    upper = taken[PICTURES:]
    few = tuple(one for number, one in enumerate(upper) if number % PICTURES != 2)
    cases["by a length"] = replace(drawn, action="length", pictures=few)
    cases["by a stage"] = replace(drawn, action="stage", pictures=upper)
    grains = Grains(int(plain.rng.integers(1 << 30)))
    for name, move in (("near", (0.2, -0.1)), ("far", (0.6, 0.55)), ("elsewhere", (7.0, 3.0))):
        cases[f"place {name}"] = _draw_place(plain, grains, move)
    lattice = _draw_place(plain, grains, (0.2, -0.1))
    cases["place on a lattice"] = replace(
        lattice, pictures=tuple(replace(p, image=_lattice(plain.rng)) for p in lattice.pictures)
    )
    noise = _draw_place(plain, grains, (0.2, -0.1))
    cases["place in noise"] = replace(
        noise,
        pictures=tuple(
            replace(p, image=plain.rng.normal(100.0, 9.0, (SIZE, SIZE))) for p in noise.pictures
        ),
    )
    cases["plan"] = replace(drawn, action="plan", pictures=())
    return cases


def _with_dust(image: Floats) -> Floats:
    """The same with a part of it shifted, as of a flake that moved."""
    moved = image.copy()
    part = slice(40, 110)
    moved[part, part] = np.roll(image, (3, -2), axis=(0, 1))[part, part]
    return moved


def _record_creeping(case: Case) -> list[LadderPicture]:
    """A ladder whose scale grows from picture to picture, as that of a specimen that comes nearer."""
    scope, rng = case.scope, case.rng
    grains = Grains(int(rng.integers(1 << 30)))
    taken: list[LadderPicture] = []
    ladder = np.geomspace(FIRST, LAST, 4)
    moves = ((0.0, 0.0), (0.25, 0.08), (-0.07, 0.26), (0.03, -0.02))
    for number, g in enumerate(ladder.tolist()):
        field = scope.display_m / g
        for k, move in enumerate(moves):
            turn = 0.5 * math.pi * (-1.0) ** number if k == 3 else 0.0
            image = take_picture(
                scope,
                grains,
                g,
                at_m=(field * move[0], field * move[1]),
                turn_rad=turn + float(rng.normal(0.0, 0.002)),
                drift_m=lambda t: np.zeros((len(t), 2)),
                start_s=0.0,
                rng=rng,
                visit_scale=1.0 + 3e-4 * len(taken),
            )
            taken.append(LadderPicture(image, g, f"{g:.0f}x/{k}", turn))
    return taken


def _draw_place(case: Case, grains: Grains, move: tuple[float, float]) -> Drawn:
    """Two pictures at one magnification, the second moved by so many fields of view."""
    scope, field = case.scope, case.scope.display_m / PLACED_AT
    pictures = [
        LadderPicture(
            take_picture(
                scope,
                grains,
                PLACED_AT,
                at_m=(field * x, field * y),
                turn_rad=0.0,
                drift_m=lambda t: np.zeros((len(t), 2)),
                start_s=0.0,
                rng=case.rng,
                visit_scale=1.0,
            ),
            PLACED_AT,
            "",
            0.0,
        )
        for x, y in ((0.0, 0.0), move)
    ]
    camera = camera_at(scope, PLACED_AT)
    middle = np.full((1, 2), 0.5 * (SIZE - 1.0))
    at_m = camera.sem_from_ideal(camera.undistort(middle))
    at_m[:, :2] -= np.multiply(field, move)
    offset = camera.project(at_m)[0] - middle[0]
    xy = float(offset[0]), float(offset[1])
    return Drawn("place", SEED, False, case.calibration, tuple(pictures), xy)


def _lattice(rng: np.random.Generator) -> Floats:
    y, x = np.indices((SIZE, SIZE))
    waves = 100.0 + 30.0 * np.cos(x * 2.0 * np.pi / 14.0) * np.cos(y * 2.0 * np.pi / 14.0)
    return np.asarray(waves + rng.normal(0.0, 5.0, waves.shape))


def run(case: Drawn) -> Answer:
    """Extend or make a calibration, find a place, or plan."""
    start = time.process_time()
    try:
        return _ACTIONS[case.action](case, start)
    except SemcalError as error:
        return refusal(error, time.process_time() - start)


def _extend(case: Drawn, start: float) -> Answer:
    done = extend_calibration(case.calibration, case.pictures)
    relays = 0 if done.model.ladder is None else len(done.model.ladder.relays)
    decision = (
        f"{relays} relays, {len(done.weaknesses)} weaknesses, {len(done.unused)} pictures unused"
    )
    pairs = sum(step.pairs + step.pairs_below for step in done.steps)
    return _judge(case.case, done.model, decision, pairs, start)


def _without_grid(case: Drawn, start: float) -> Answer:
    scope, at = case.case.scope, case.pictures[0].magnification
    known: KnownLength | StageMoves
    if case.action == "length":
        ends = np.array([[40.0, 60.0], [190.0, 170.0]])
        x, y = scope.metres(at, *ends.T)
        length_m = math.hypot(x[1] - x[0], y[1] - y[0])
        known = KnownLength(length_m, 0, (40.0, 60.0), (190.0, 170.0), LENGTH_SIGMA)
    else:
        moves = np.tile([(0.0, 0.0), (0.25, 0.08), (-0.07, 0.26), (0.03, -0.02)], (3, 1))
        fields = np.array([scope.display_m / one.magnification for one in case.pictures])
        known = StageMoves(
            fields[:, None] * moves, 12.0 * np.arange(len(case.pictures)), LENGTH_SIGMA
        )
    done = calibrate_from_specimen(case.pictures, known, display_width_m=scope.display_m)
    decision = f"{len(done.weaknesses)} weaknesses, {len(done.unused)} pictures unused"
    pairs = sum(step.pairs + step.pairs_below for step in done.steps)
    return _judge(case.case, done.model, decision, pairs, start)


def _judge(case: Case, model: CalibrationModel, decision: str, count: int, start: float) -> Answer:
    seconds = time.process_time() - start
    seen = compare(case, model, np.geomspace(FIRST, LAST, 4).tolist())
    score = np.abs(seen.relative) / seen.sigma
    return Answer(
        decision,
        count,
        float(np.sqrt(np.mean(seen.relative**2))),
        float(np.abs(seen.relative).max()),
        float(np.sqrt(np.mean(score**2))),
        int(score.max() > WRONG_SIGMAS),
        digest_of(seen.relative, seen.sigma, seen.model_px, seen.model_sigma_px),
        seconds,
    )


def _place(case: Drawn, start: float) -> Answer:
    """As an acquisition does: the picture in the middle, and one that is moved."""
    model = case.calibration
    first, second = case.pictures
    asked = PictureRequest(0, PLACED_AT, (0.0, 0.0), 0.0)
    middle = acquisition.take_picture(model, [], asked, first)
    moved = acquisition.take_picture(
        model, [middle], replace(asked, move=(0.25, 0.08)), second, (1e-6, 0.0)
    )
    assert moved.offset_px is not None
    off = moved.offset_px - case.offset_px
    seconds = time.process_time() - start
    error = float(np.hypot(*off))
    return Answer("found", 1, error, error, digest=digest_of(off), seconds=seconds)


def _plan(case: Drawn, start: float) -> Answer:
    model = case.calibration
    plans = [plan_pictures(model, g) for g in (2e4, 8e4, 200.0)]
    numbers = [(p.magnification, *p.move, p.turn_rad) for plan in plans for p in plan]
    seconds = time.process_time() - start
    decision = ", ".join(f"{len(plan)} pictures" for plan in plans)
    bits = digest_of(np.array(numbers))
    return Answer(decision, len(numbers), digest=bits, seconds=seconds)


_ACTIONS: dict[str, Callable[[Drawn, float], Answer]] = {
    "extend": _extend,
    "length": _without_grid,
    "stage": _without_grid,
    "place": _place,
    "plan": _plan,
}
