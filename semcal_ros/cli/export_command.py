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

"""``semcal export``."""

from __future__ import annotations

import math
from pathlib import Path

import click

from semcal_ros.calibration import Calibration
from semcal_ros.cli.options import PATH, options_of, output_option
from semcal_ros.cli.output import echo_notes
from semcal_ros.workflows.export_camera import EXPORT_FORMATS, ExportOptions, export_calibration

# Above this, the difference is told as a note: a tenth of a pixel is what users of such files see.
_TOLD_PX = 0.1


@click.command("export")
@click.argument("calibration", type=PATH)
@click.option(
    "--format",
    "kind",
    type=click.Choice(tuple(EXPORT_FORMATS)),
    required=True,
    help="Which program.",
)
@output_option("File to write.")
@options_of(ExportOptions)
def command(calibration: Path, kind: str, output: Path, options: ExportOptions) -> None:
    """CALIBRATION as a file of another program: OpenCV, ROS, mrcal, COLMAP, Fiji, or a table.

    \b
    Example:
      semcal export cal.yaml --format ros --magnification 5000 -o sem.yaml
      semcal export cal.yaml --format csv -o parameters.csv
    """
    model = Calibration.load(calibration)
    done = export_calibration(model, kind, output, **vars(options))
    for path in done.paths:
        click.echo(f"{kind}: {path}")
    if done.worst_px > 0.0:
        rms = f", RMS {done.rms_px:.2g} px" if math.isfinite(done.rms_px) else ""
        click.echo(f"differs from the calibration by up to {done.worst_px:.2g} px{rms}")
    if done.worst_px > _TOLD_PX:
        echo_notes(
            [
                "that is what the format cannot hold of raw images (skew, residual field, part of the distortion); "
                "--rectified is exact"
            ]
        )
