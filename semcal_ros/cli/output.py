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

"""What several commands print: notes, tables, JSON, progress."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from tqdm import tqdm

__all__ = [
    "echo_json",
    "echo_nominal_unit",
    "echo_notes",
    "echo_paths",
    "echo_states",
    "echo_table",
    "show_progress",
]


@contextmanager
def show_progress() -> Iterator[Callable[[str, int, int | None], None]]:
    """Make the ``on_progress`` of a workflow: bars on stderr, on terminals, for work of over a second."""
    # Imported here, so that quick commands do not wait for it.
    from tqdm import tqdm

    bar: tqdm[Any] | None = None
    shown = ""

    def show(stage: str, done: int, total: int | None) -> None:
        nonlocal bar, shown
        if bar is None or stage != shown or done < bar.n:
            if bar is not None:
                bar.close()
            bar, shown = (
                tqdm(total=total, desc=stage, unit="frame", disable=None, delay=1, leave=False),
                stage,
            )
        bar.update(done - bar.n)

    try:
        yield show
    finally:
        if bar is not None:
            bar.close()


def echo_notes(notes: Iterable[str]) -> None:
    """Print notes for the user to stderr."""
    for note in notes:
        click.echo(f"note: {note}", err=True)


def echo_states(states: Mapping[str, int]) -> None:
    """Print how many frames had which kind of drift."""
    for kind, count in states.items():
        click.echo(f"{count} frames {kind}")


def echo_nominal_unit(display_width_m: float, what: str) -> None:
    """Say that lengths rest on the display width only."""
    click.echo(
        f"note: without --calibration {what} of the display width {display_width_m:g} m", err=True
    )


def echo_paths(paths: Mapping[str, Path | None]) -> None:
    """Print which outputs were written where."""
    for name, path in paths.items():
        if path is not None:
            click.echo(f"{name}: {path}")


def echo_table(headers: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table with right-aligned columns."""
    table = [list(headers), *[list(r) for r in rows]]
    widths = [max(len(row[i]) for row in table) for i in range(len(headers))]
    for row in table:
        click.echo("  ".join(cell.rjust(w) for cell, w in zip(row, widths, strict=True)))


def echo_json(value: Any) -> None:
    """Print plain data as JSON; infinite values become null."""

    def plain(item: Any) -> Any:
        if isinstance(item, dict):
            return {str(k): plain(v) for k, v in item.items()}
        if isinstance(item, (list, tuple)):
            return [plain(v) for v in item]
        if isinstance(item, float) and item - item != 0.0:
            return None
        return item

    click.echo(json.dumps(plain(value), indent=2))
