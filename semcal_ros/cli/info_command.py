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

"""``semcal info``."""

from __future__ import annotations

from pathlib import Path

import click

from semcal_ros.cli.options import config_option, recording_argument
from semcal_ros.cli.output import echo_notes, echo_table, show_progress
from semcal_ros.workflows.describe_recording import describe_recording

__all__ = ["command"]


@click.command("info")
@recording_argument
@config_option
def command(recording: Path, config: str) -> None:
    """What RECORDING contains: topics, frames, sizes, magnifications.

    \b
    Example:
      semcal info recordings/grid
    """
    with show_progress() as on_progress:
        found = describe_recording(recording, config=config, on_progress=on_progress)
    if found.topics:
        echo_table(
            ["topic", "type", "messages"], [[t.name, t.type, str(t.count)] for t in found.topics]
        )
    click.echo(f"{found.frame_count} frames over {found.duration_s:.3f} s")
    for kind, count in found.kinds.items():
        click.echo(f"  {count} x {kind}")
    low, high = found.magnifications[0], found.magnifications[-1]
    click.echo(f"{len(found.magnifications)} magnifications, {low:g} to {high:g}")
    echo_notes(found.notes)
