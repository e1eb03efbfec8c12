"""``semcal import``."""

from __future__ import annotations

from pathlib import Path

import click

from semcal_ros.cli.common import config_option, configured, overwrite_option, progress

__all__ = ["command"]


@click.command("import")
@click.argument("folder", type=click.Path(path_type=Path))
@click.argument("output", type=click.Path(path_type=Path))
@click.option(
    "--databar-rows",
    type=click.IntRange(0),
    help="Rows of text at the bottom, where the metadata do not tell (Zeiss).",
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
    from semcal_ros.files.tiff.to_bag import import_folder

    with progress(None, "importing") as bar:
        done = import_folder(
            folder,
            output,
            config=configured(config),
            databar_rows=databar_rows,
            overwrite=overwrite,
            on_progress=lambda n: bar.update(n) and None,
        )
    for line in done.lines():
        click.echo(line)
