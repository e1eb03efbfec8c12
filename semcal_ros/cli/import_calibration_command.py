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

"""``semcal import-calibration``."""

from __future__ import annotations

from pathlib import Path

import click

from semcal_ros.cli.options import PATH, options_of, output_option, require_folder
from semcal_ros.cli.output import echo_verdict
from semcal_ros.core.wording import counted
from semcal_ros.workflows.import_calibration import ImportOptions, import_calibration


@click.command("import-calibration")
@click.argument("table", type=PATH)
@output_option("Calibration to write, .yaml.")
@options_of(ImportOptions)
def command(table: Path, output: Path, options: ImportOptions) -> None:
    """A nominal calibration from TABLE: magnifications and nm per px, as .csv, .parquet or .xlsx.

    It has no distortion; rectify, measure and reconstruct use its pixel sizes and carry their uncertainty.

    \b
    Example:
      semcal import-calibration sizes.csv --image-size 1024x768 --sigma 1% -o nominal.yaml
    """
    require_folder(output)
    made = import_calibration(table, **vars(options))
    made.save(output)
    echo_verdict(made)
    click.echo(
        f"{counted(len(made.magnifications), 'magnification')}, display width {made.display_width_m:.6g} m"
    )
    click.echo(f"calibration: {output}")
    for warning in made.warnings:
        click.echo(f"warning: {warning}", err=True)
