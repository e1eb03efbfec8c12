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

"""``semcal simulate``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import click

from semcal_ros.cli.options import PATH, options_of
from semcal_ros.cli.output import show_progress
from semcal_ros.core.wording import counted
from semcal_ros.workflows.simulate import FaultOptions, SimulationOptions, record_simulation


@click.command("simulate")
@click.argument("output", type=PATH)
@options_of(SimulationOptions)
@options_of(FaultOptions, "faults")
def command(output: Path, options: SimulationOptions, faults: FaultOptions) -> None:
    """Record the virtual SEM to the bag OUTPUT, with truth.json (SI units) beside it.

    \b
    Example:
      semcal simulate grid --plan grid --preset jsm820
      semcal simulate worn --eucentric-error 300um --repeatability 0.4% --grid-stretch 0.1%
      semcal simulate ladder --plan ladder
      semcal simulate zoom --plan zoom --magnification 600 --magnification 6000
    """
    chosen = replace(options, stage=faults.make_stage(), grid=faults.make_grid())
    with show_progress() as on_progress:
        count = record_simulation(output, replace(chosen, on_progress=on_progress))
    click.echo(f"{counted(count, 'frame')}: {output}")
