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

from semcal_ros.cli.options import PATH, config_option, overwrite_option
from semcal_ros.cli.output import show_progress
from semcal_ros.files.tiff.to_bag import import_folder
from semcal_ros.workflows.inputs import count_frames, resolve_config

__all__ = ["command"]


@click.command("import")
@click.argument("folder", type=PATH)
@click.argument("output", type=PATH)
@click.option(
    "--databar-rows",
    type=click.IntRange(0),
    help="Rows of text at the bottom, if the metadata do not say (Zeiss).",
)
@config_option
@overwrite_option
def command(
    folder: Path, output: Path, databar_rows: int | None, config: str, overwrite: bool
) -> None:
    """Make the bag OUTPUT from the SEM TIFF files in FOLDER (Zeiss, Thermo Fisher, TESCAN, JEOL).

    Pixel size, databar, working distance and scan rotation come from each file's metadata. Magnifications refer to the
    display width of the configuration, so that every pixel size is kept exactly.

    \b
    Example:
      semcal import tiffs/ recordings/from_tiff
    """
    with show_progress() as on_progress:
        done = import_folder(
            folder,
            output,
            config=resolve_config(config),
            databar_rows=databar_rows,
            overwrite=overwrite,
            on_progress=count_frames(on_progress, "importing", None),
        )
    for line in done.lines():
        click.echo(line)
