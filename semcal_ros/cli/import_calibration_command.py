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

import re
from pathlib import Path

import click

from semcal_ros.cli.options import LENGTH, PATH, parse_ratio, require_folder
from semcal_ros.cli.output import echo_verdict
from semcal_ros.core.wording import counted
from semcal_ros.workflows.import_calibration import import_calibration


def _parse_size(_context: click.Context, _parameter: click.Parameter, text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)\s*[x×,]\s*(\d+)", text.strip())
    if found is None or not all(1 <= int(side) <= 65_536 for side in found.groups()):
        raise click.BadParameter(f"{text!r} is not an image size such as 1024x768")
    return int(found[1]), int(found[2])


@click.command("import-calibration")
@click.argument("table", type=PATH)
@click.option("-o", "--output", type=PATH, required=True, help="Calibration to write, .yaml.")
@click.option(
    "--image-size",
    required=True,
    callback=_parse_size,
    metavar="WxH",
    help="Size of the images whose pixels these are, without databar, such as 1024x768.",
)
@click.option(
    "--sigma",
    callback=parse_ratio,
    default="3%",
    show_default=True,
    metavar="RATIO",
    help="Relative 1-sigma of pixel sizes for which the table has none.",
)
@click.option(
    "--display-width",
    type=LENGTH,
    metavar="LENGTH",
    help="Width of the display that the magnification refers to (default: the one that fits).",
)
def command(
    table: Path,
    output: Path,
    image_size: tuple[int, int],
    sigma: float,
    display_width: float | None,
) -> None:
    """A nominal calibration from TABLE: magnifications and nm per px, as .csv, .parquet or .xlsx.

    It has no distortion; rectify, measure and reconstruct use its pixel sizes and carry their uncertainty.

    \b
    Example:
      semcal import-calibration sizes.csv --image-size 1024x768 --sigma 1% -o nominal.yaml
    """
    require_folder(output)
    made = import_calibration(
        table, image_size=image_size, sigma=sigma, display_width_m=display_width
    )
    made.save(output)
    echo_verdict(made)
    click.echo(
        f"{counted(len(made.magnifications), 'magnification')}, display width {made.display_width_m:.6g} m"
    )
    click.echo(f"calibration: {output}")
    for warning in made.statistics["warnings"]:
        click.echo(f"warning: {warning}", err=True)
