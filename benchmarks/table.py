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

"""Plain text tables, and times measured turn by turn."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from statistics import median

NONE = "-"


def show(title: str, header: list[str], rows: list[list[object]], *notes: str) -> None:
    """Print a table; floats get three significant digits, the first column is left-aligned."""
    cells = [[text(value) for value in row] for row in rows]
    widths = [max(len(line[k]) for line in [header, *cells]) for k in range(len(header))]

    def line(values: list[str]) -> str:
        parts = [values[0].ljust(widths[0])]
        parts += [v.rjust(w) for v, w in zip(values[1:], widths[1:], strict=True)]
        return "  ".join(parts).rstrip()

    print(f"\n{title}")
    print(line(header))
    print("  ".join("-" * width for width in widths))
    for row in cells:
        print(line(row))
    for note in notes:
        print(f"  {note}")
    print(flush=True)


def text(value: object) -> str:
    """A cell: numbers short, None as a dash."""
    if value is None or (isinstance(value, float) and value != value):
        return NONE
    if not isinstance(value, float):
        return str(value)
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def interleaved(
    actions: Mapping[str, Callable[[], object]],
    rounds: int,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, float]:
    """Median seconds of each action; all take their turn in every round, so that a busy machine
    slows all of them alike. ``clock`` may count processor time instead.
    """
    times: dict[str, list[float]] = {name: [] for name in actions}
    for _ in range(rounds):
        for name, action in actions.items():
            start = clock()
            action()
            times[name].append(clock() - start)
    return {name: median(values) for name, values in times.items()}


def quick_from_command_line(description: str | None) -> bool:
    """Whether --quick was given."""
    parser = argparse.ArgumentParser(description=(description or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="less of everything")
    return bool(parser.parse_args().quick)
