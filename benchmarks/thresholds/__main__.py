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

"""What does a number do? Each row of a room's table of thresholds is changed, and the room's fleet run with it.

    python -m benchmarks.thresholds ROOM [--names A,B] [--factor 1.5] [--kinds stated,measured] [--json FILE]

A row is multiplied and divided by the factor. Whole numbers change by one at least; parts of a whole above a half stay
below one, since what they lack is divided. Only the cases are run that enter a function which uses the row; there may
be none.

A row is *alike* if no case is decided otherwise, the error and its ratio to the stated sigma change by 5 % at most (one
case alone by 30 %), and the number of points or frames by 2 %; else it *matters*. If nothing changes to the last bit, a
thousand times the value and a thousandth are tried: where they change nothing either, the fleet does not *reach* the
row, or the row guards against what the fleet does not show.

Each run is a process that was copied before the package was imported, so that all that follows from a row follows. The
pictures are drawn once, by unchanged code. Errors are compared on the same pictures, so that there is no noise in them.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import importlib
import json
import multiprocessing
import pickle
import resource
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2

from benchmarks.table import show
from benchmarks.thresholds.answers import Answer, Difference, compare
from benchmarks.thresholds.reach import find_users, names_read
from benchmarks.thresholds.variation import Change, install, is_numeric

EXTREME = 1000.0
# A change may make a search endless, or an array huge.
TIMES_LONGER, SECONDS_LONGER, MEMORY_BYTES = 6, 20, 4 << 30
LIBRARIES = ("numpy", "scipy", "cv2")


@dataclass(frozen=True)
class Room:
    """The module of a table, and the one of the fleet that uses it."""

    table: str
    fleet: str


ROOMS = {
    "corners": Room("core.corners", "corners"),
    "registration": Room("core.registration", "registration"),
    "calibration": Room("core.calibration", "calibration"),
    "estimator": Room("core.calibration.estimator", "calibration"),
    "judgement": Room("core.calibration.judgement", "calibration"),
    "drift": Room("core.drift", "drift"),
    "ladder": Room("core.ladder", "ladder"),
    "rectification": Room("core.rectification", "rectification"),
    "camera": Room("core.camera", "rectification"),
    "servoing": Room("applications.servoing", "servoing"),
    "reconstruction": Room("applications.reconstruction", "reconstruction"),
    "cantilever": Room("applications.cantilever", "cantilever"),
}


@dataclass(frozen=True)
class Row:
    """A row of a table, and what became of it.

    Attributes
    ----------
    cases
        Number of the cases that enter a function which uses it; only these are run.
    reached
        Whether an extreme value changes anything; None where it need not be asked.
    """

    name: str
    value: str
    unit: str
    kind: str
    cases: int = 0
    larger: Difference | None = None
    smaller: Difference | None = None
    reached: bool | None = None

    @property
    def verdict(self) -> str:
        if self.larger is None or self.smaller is None:
            return "not entered"
        if self.reached is False:
            return "not reached"
        return "alike" if self.larger.is_alike and self.smaller.is_alike else "matters"


# -- in a process of its own -------------------------------------------------------------------------


def _prepare(table: str, fleet: str) -> tuple[list[Row], dict[str, bytes], list[str]]:
    """The rows of a table, the cases of a fleet, and the libraries that they need."""
    cases = {name: pickle.dumps(case) for name, case in _fleet(fleet).draw().items()}
    rows = [
        Row(row.name, _short(row.value), row.unit, row.source.value)
        for row in importlib.import_module(table).TABLE
        if is_numeric(row.value)
    ]
    return rows, cases, [name for name in sys.modules if name.partition(".")[0] in LIBRARIES]


def _run(
    table: str,
    fleet: str,
    change: Change | None,
    cases: Mapping[str, bytes],
    until_differs_from: Mapping[str, Answer] | None = None,
) -> dict[str, Answer]:
    """The answers of a fleet, or those up to the first that differs."""
    install(table, change)
    run = _fleet(fleet).run
    answers: dict[str, Answer] = {}
    for name, case in cases.items():
        try:
            answers[name] = run(pickle.loads(case))
        except Exception as error:
            answers[name] = Answer(f"raised {type(error).__name__}")
        usual = (until_differs_from or {}).get(name)
        if usual is not None and usual.digest != answers[name].digest:
            break
    return answers


def _names_read(table: str, fleet: str, case: bytes) -> set[str]:
    """Names in the functions that a case enters."""
    run = _fleet(fleet).run
    return names_read(lambda: run(pickle.loads(case)))


def _fleet(name: str) -> Any:
    return importlib.import_module(f"benchmarks.thresholds.fleets.{name}")


def _short(value: object) -> str:
    text = " ".join(str(value).split())
    return text if len(text) <= 40 else f"{text[:37]}..."


# -- in this process ---------------------------------------------------------------------------------


def _call(limit_s: float, function: Callable[..., Any], *arguments: Any) -> Any:
    """The result of a function in a copy of this process, or a word for what ended it."""
    context = multiprocessing.get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(theirs, limit_s, function, arguments))
    process.start()
    theirs.close()
    try:
        result = ours.recv()
    except EOFError:
        result = "ended, or took too long"
    process.join()
    return result


def _answer(
    pipe: Connection, limit_s: float, function: Callable[..., Any], arguments: tuple[Any, ...]
) -> None:
    seconds = int(limit_s) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    with open(os.devnull, "w") as nothing:
        # What libraries print of senseless values.
        os.dup2(nothing.fileno(), 2)
        try:
            pipe.send(function(*arguments))
        except Exception as error:
            pipe.send(f"raised {type(error).__name__}: {error}")


def study(
    room: Room, names: list[str], factor: float, kinds: list[str], report: Callable[[Row], None]
) -> tuple[list[Row], dict[str, Answer]]:
    """Change the rows of a room in turn; ``report`` is called with each."""
    table = f"semcal_ros.{room.table}.thresholds"
    prepared = _call(3600.0, _prepare, table, room.fleet)
    if isinstance(prepared, str):
        raise SystemExit(f"the fleet cannot be drawn: {prepared}")
    rows, cases, libraries = prepared
    # A copy has them already.
    for library in libraries:
        importlib.import_module(library)
    start = time.perf_counter()
    usual = _call(3600.0, _run, table, room.fleet, None, cases)
    if isinstance(usual, str):
        raise SystemExit(f"the fleet cannot be run: {usual}")
    limit_s = TIMES_LONGER * sum(a.seconds for a in usual.values()) + SECONDS_LONGER
    if raised := [name for name, answer in usual.items() if answer.decision.startswith("raised")]:
        raise SystemExit(f"without a change, {', '.join(raised)}: {usual[raised[0]].decision}")
    again = _call(limit_s, _run, table, room.fleet, None, cases)
    if not compare(usual, again).identical:
        raise SystemExit("the fleet answers differently without a change")
    print(f"{len(cases)} cases, {0.5 * (time.perf_counter() - start):.1f} s a run", flush=True)
    for name, answer in usual.items():
        print(f"  {name}: {answer}", flush=True)

    read = {
        name: _call(3600.0, _names_read, table, room.fleet, case) for name, case in cases.items()
    }
    users = find_users(table)

    def change(own: Mapping[str, bytes], name: str, by: float, first: bool = False) -> Difference:
        until = usual if first else None
        found = _call(limit_s, _run, table, room.fleet, Change(name, by), own, until)
        return Difference(False, raised=found) if isinstance(found, str) else compare(usual, found)

    def cases_of(name: str) -> dict[str, bytes]:
        by = users[name]
        return {case: cases[case] for case in cases if by is None or read[case] & by}

    chosen = [row for row in rows if (row.name in names if names else row.kind in kinds)]
    # The quickest first.
    chosen.sort(key=lambda row: sum(usual[case].seconds for case in cases_of(row.name)))
    done = []
    for row in chosen:
        own = cases_of(row.name)
        larger = smaller = reached = None
        if own:
            larger, smaller = (change(own, row.name, f) for f in (factor, 1.0 / factor))
            if larger.identical and smaller.identical:
                far = (change(own, row.name, f, True) for f in (EXTREME, 1.0 / EXTREME))
                reached = not all(found.identical for found in far)
        done.append(replace(row, cases=len(own), larger=larger, smaller=smaller, reached=reached))
        report(done[-1])
    return done, usual


def _report(row: Row) -> None:
    print(f"{row.name} = {row.value} {row.unit} [{row.kind}]: {row.verdict}, {row.cases} cases")
    if row.larger is not None:
        print(f"    larger   {row.larger}\n    smaller  {row.smaller}")
    sys.stdout.flush()


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("room", choices=ROOMS)
    parser.add_argument("--names", default="", help="rows, separated by commas")
    parser.add_argument("--factor", type=float, default=1.5, help="above 1; default 1.5")
    parser.add_argument("--kinds", default="stated,measured", help="of sources of rows")
    parser.add_argument("--json", type=Path, metavar="FILE", help="where to write the results")
    given = parser.parse_args()
    if not 1.0 < given.factor < 100.0:
        parser.error(f"--factor {given.factor}: between 1 and 100")
    cv2.setNumThreads(1)
    names = [name for name in given.names.split(",") if name]
    kinds = given.kinds.split(",")
    found: list[Row] = []

    def report(row: Row) -> None:
        found.append(row)
        _report(row)
        if given.json is not None:
            written = [{"verdict": row.verdict, **asdict(row)} for row in found]
            about = {"room": given.room, "factor": given.factor, "rows": written}
            given.json.write_text(json.dumps(about, indent=1))

    rows, usual = study(ROOMS[given.room], names, given.factor, kinds, report)
    if missing := set(names) - {row.name for row in rows}:
        parser.error(f"no numbers {', '.join(sorted(missing))} in {given.room}")
    verdicts = ("alike", "matters", "not reached", "not entered")
    counts: list[list[object]] = [
        [v, sum(row.verdict == v for row in rows)]
        for v in verdicts
        if any(r.verdict == v for r in rows)
    ]
    show(
        f"{given.room}: {len(usual)} cases, factor {given.factor:g}", ["rows that are", ""], counts
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
