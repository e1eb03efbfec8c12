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
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from semcal_ros.core.wording import counted, group_by_kind

if TYPE_CHECKING:
    from tqdm import tqdm

    from semcal_ros.core.calibration.views import RejectedView
    from semcal_ros.core.camera.calibration_model import CalibrationModel


# Work of less than this, s, needs no bar.
_SHOWN_AFTER_S = 1.0
# How often the time of a stage is shown that reports nothing, s.
_TICK_S = 0.5
_COUNTED = "{desc}: {percentage:3.0f}%|{bar}| {n_fmt} of {total_fmt} [{elapsed}<{remaining}]"
_NOT_COUNTED = "{desc} [{elapsed}]"


@contextmanager
def show_progress(first: str = "opening") -> Iterator[Callable[[str, int, int | None], None]]:
    """Make the ``on_progress`` of a workflow: a bar on stderr, on terminals, for each stage of over a second.

    A stage that does not count anything shows its name and its time.

    Parameters
    ----------
    first
        What is done before the workflow names a stage.
    """
    # Closed, it is None.
    if sys.stderr is None or not sys.stderr.isatty():
        yield lambda _stage, _done, _total: None
        return
    shown = _ProgressBar(first)
    try:
        yield shown.show
    finally:
        shown.close()


class _ProgressBar:
    """The bar of the current stage; a thread keeps it alive while nothing is reported."""

    def __init__(self, first: str) -> None:
        # Imported here, so that quick commands do not wait for it.
        from tqdm import tqdm

        self._make = tqdm
        self._lock = threading.Lock()
        self._stage = first
        self._bar = self._begin(first, None)
        self._ended = threading.Event()
        self._ticker = threading.Thread(target=self._tick, daemon=True)
        self._ticker.start()

    def show(self, stage: str, done: int, total: int | None) -> None:
        with self._lock:
            if stage != self._stage or done < self._bar.n:
                self._end()
                self._stage, self._bar = stage, self._begin(stage, total)
            self._bar.update(done - self._bar.n)

    def close(self) -> None:
        self._ended.set()
        self._ticker.join()
        self._end()

    def _begin(self, stage: str, total: int | None) -> tqdm[Any]:
        return self._make(
            total=total,
            desc=stage,
            bar_format=_COUNTED if total else _NOT_COUNTED,
            delay=_SHOWN_AFTER_S,
            leave=False,
        )

    def _end(self) -> None:
        self._bar.clear()  # close() leaves what only the ticker has shown
        self._bar.close()

    def _tick(self) -> None:
        while not self._ended.wait(_TICK_S):
            with self._lock:
                if time.time() - self._bar.start_t > _SHOWN_AFTER_S:
                    self._bar.refresh()


def echo_notes(notes: Iterable[str]) -> None:
    """Print notes for the user to stderr, one of each kind."""
    for note in group_by_kind(notes):
        click.echo(f"note: {note}", err=True)


def echo_states(states: Mapping[str, int]) -> None:
    """Print how many frames had which kind of drift."""
    for kind, count in states.items():
        is_key = kind == "keyframe"  # without an import that all commands would wait for
        click.echo(counted(count, "key frame") if is_key else f"{counted(count, 'frame')} {kind}")


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


def echo_verdict(calibration: CalibrationModel) -> None:
    """Print how well a calibration knows nm per pixel, and what would improve that."""
    # Imported here, so that commands without a calibration do not wait for it.
    from semcal_ros.core.calibration.judgement.plan import judge_calibration

    verdict = judge_calibration(calibration)
    for line in (verdict.describe(), verdict.advise()):
        if line:
            click.echo(line)


def echo_term_sizes(calibration: CalibrationModel) -> None:
    """Print how large each kind of distortion is; nothing for a calibration without further terms."""
    from semcal_ros.core.camera.term_sizes import describe_term_sizes, has_terms, largest_term_sizes

    cameras = [calibration.at(g) for g in calibration.magnifications]
    if any(has_terms(camera) for camera in cameras):
        sizes = describe_term_sizes(largest_term_sizes(cameras))
        click.echo(f"distortion: {sizes} (largest, at any calibrated magnification)")


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


def echo_rejected(rejected: Sequence[RejectedView]) -> None:
    """Print each kind of reason once, with the views that have it."""
    from semcal_ros.workflows.find_grid import name_rejected

    for text in name_rejected(rejected):
        click.echo(f"rejected: {text}", err=True)


def list_rejections(rejected: Sequence[RejectedView]) -> list[dict[str, Any]]:
    """Plain data of rejected views, for JSON."""
    return [
        {"name": view.name, "magnification": view.magnification, "reason": view.reason}
        for view in rejected
    ]
