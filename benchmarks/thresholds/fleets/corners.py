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

"""Pictures of grids of every kind, and of none, for the search for corners.

The narrowest of the random pictures of ``benchmarks.calibration.looks``, a replica and gratings; what must be refused
are grounds of ``benchmarks.drift.scenes``. Errors are in px, of one coordinate; of gratings, only how smoothly their
lines run is judged.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.calibration import lines, replicas
from benchmarks.calibration.looks.__main__ import judge
from benchmarks.calibration.looks.picture import Look, draw_look, render
from benchmarks.thresholds.answers import Answer, digest_of
from semcal_ros.core.corners import LatticeDetection, find_lattice

# Of seed 0, and the side to which the pictures are cut: all kinds, pitches of 18 to 58 px, 25 to 167 electrons.
LOOKS = {805: 388, 771: 280, 944: 280, 200: 200, 591: 280, 765: 200, 493: 200}
REPLICA, REPLICA_PX = (0, 10), 280
GRATINGS = (11, 10)
GROUNDS = ("gold",)
GROUND_PX, ELECTRONS = 256, 60.0


def draw() -> dict[str, Any]:
    """Draw the pictures."""
    # Not where they are searched: each run imports what it needs.
    from benchmarks.drift import scenes

    cases: dict[str, Any] = {}
    for index in LOOKS:
        look = _look(index)
        cases[f"{look.kind} {index}"] = ("look", index, render(look))
    replica = replicas.draw(*REPLICA)
    cases["replica"] = (
        "replica",
        replace(replica, image=np.ascontiguousarray(replica.image[:REPLICA_PX, :REPLICA_PX])),
    )
    for index in GRATINGS:
        cases[f"grating {index}"] = ("grating", lines.draw(0, index))
    for name in GROUNDS:
        rng = np.random.default_rng(1)
        ground = getattr(scenes, name)(rng)[:GROUND_PX, :GROUND_PX]
        counted = rng.poisson(ELECTRONS * np.clip(ground, 0.0, None)) / ELECTRONS
        cases[name] = ("nothing", np.clip(np.rint(200.0 * counted), 0, 255).astype(np.uint8))
    return cases


def run(case: Any) -> Answer:
    """Search a picture."""
    kind, *rest = case
    if kind == "look":
        return _search_look(*rest)
    image = rest[0] if kind == "nothing" else rest[0].image if kind == "replica" else rest[0][0]
    start = time.process_time()
    found = find_lattice(image, pattern="grating") if kind == "grating" else find_lattice(image)
    seconds = time.process_time() - start
    if not isinstance(found, LatticeDetection):
        return Answer(
            f"refused, {found.status.name}", digest=digest_of(found.reason), seconds=seconds
        )
    bits = digest_of(found.xy, found.covariance_px2, found.ij)
    if kind == "nothing":
        return Answer(f"{found.pattern} of nothing", wrong=1, digest=bits, seconds=seconds)
    ratio = float("nan")
    if kind == "replica":
        off = _off_replica(found, rest[0])
        ratio = float(np.sqrt(np.mean((off / found.sigma_px[:, None]) ** 2)))
    else:
        off = _off_grating(found, rest[0][2])
    error, worst = float(np.sqrt(np.mean(off**2))), float(np.abs(off).max())
    return Answer(found.pattern, len(found.xy), error, worst, ratio, 0, bits, seconds)


def _look(index: int) -> Look:
    return replace(draw_look(0, index), width=LOOKS[index], height=LOOKS[index])


def _search_look(index: int, picture: Any) -> Answer:
    found, _ = judge(_look(index), picture)
    if not found.is_found:
        # The reason has numbers.
        return Answer("refused", digest=digest_of(found.answer), seconds=found.seconds)
    wrong = not (found.is_kind_right and found.is_lattice_right)
    return Answer(
        found.answer,
        found.points,
        found.error_px,
        found.worst_sigmas,
        found.error_sigmas,
        int(wrong),
        digest_of(found.points, found.error_px, found.stated_px, found.worst_sigmas),
        found.seconds,
    )


def _off_replica(found: LatticeDetection, replica: replicas.Replica) -> Any:
    """(n, 2) px from the crossings, whose place in the cell is free."""
    at = replica.cells_of(found.xy)
    common = np.angle(np.exp(2j * np.pi * at).mean(axis=0)) / (2.0 * np.pi)
    return (at - common - np.rint(at - common)) @ replica.axes


def _off_grating(found: LatticeDetection, period: float) -> Any:
    """(n,) px from bent lines: what of the number a polynomial of the third order by the place does not follow."""
    u, v = (found.xy - found.xy.mean(axis=0)).T / np.ptp(found.xy)
    design = np.stack([u**p * v**q for p in range(4) for q in range(4 - p)], axis=1)
    number = found.ij[:, 0].astype(np.float64)
    return (number - design @ np.linalg.lstsq(design, number, rcond=None)[0]) * period
