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

"""``semcal import``."""

from __future__ import annotations

from pathlib import Path

import click

from semcal_ros.cli.options import PATH, overwrite_option
from semcal_ros.cli.output import show_progress
from semcal_ros.cli.recording_input import recording_input, refuse_mask
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.files.images.to_bag import import_images
from semcal_ros.files.recordings import RecordedFiles


@click.command("import")
@recording_input
@click.argument("output", type=PATH)
@overwrite_option
def command(
    recording: RecordedFiles, config: MicroscopeConfig, output: Path, overwrite: bool
) -> None:
    """Make the bag OUTPUT from image files.

    They may be those of an SEM (Zeiss, Thermo Fisher, TESCAN, JEOL, Hitachi, Phenom) or any others. Pixel size,
    databar, working distance and scan rotation come from the metadata of each file, or from the options.
    Magnifications refer to the display width of the configuration, so that every pixel size is kept exactly.

    \b
    Example:
      semcal import tiffs/ recordings/from_tiff
    """
    refuse_mask(recording, "--mask for the commands that read the bag")
    with show_progress() as on_progress:
        done = import_images(
            recording,
            output,
            config=config,
            overwrite=overwrite,
            on_progress=lambda done, total: on_progress("importing", done, total),
        )
    for line in done.lines():
        click.echo(line)
