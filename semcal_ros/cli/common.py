"""What several commands share: options, progress, tables."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from tqdm import tqdm

from semcal_ros.calibration import Calibration
from semcal_ros.core.errors import InvalidValueError

if TYPE_CHECKING:
    from semcal_ros.config.config import MicroscopeConfig

__all__ = [
    "config_option",
    "configured",
    "echo_json",
    "echo_table",
    "magnification_option",
    "overwrite_option",
    "progress",
    "require_folder",
    "require_suffix",
]

config_option = click.option(
    "--config",
    default="generic",
    show_default=True,
    metavar="NAME_OR_FILE",
    help="msg_configs of the microscope: topics, units, display width, scan timing.",
)
magnification_option = click.option(
    "--magnification",
    type=float,
    help="Of all images: only for a folder of ordinary ones (png, jpg), which do not tell it.",
)
overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace an existing output, once the new one is complete."
)


def configured(name: str, model: Calibration | None = None) -> MicroscopeConfig:
    """The configuration that the ``--config`` option names, with the display width of a calibration."""
    # Imported on demand: a command without recordings starts without pydantic.
    from semcal_ros.config.config import load_config

    config = load_config(name)
    return config if model is None else replace(config, display_width_m=model.display_width_m)


def progress(total: int | None, label: str) -> tqdm[Any]:
    """A progress bar on stderr, shown on terminals for work that lasts over a second."""
    return tqdm(total=total, desc=label, unit="frame", disable=None, delay=1, leave=False)


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


def require_suffix(path: Path, suffixes: Sequence[str], what: str) -> None:
    """Refuse an output whose name does not end as its kind of file does, before any work is done
    for it.
    """
    if path.suffix.lower() not in suffixes:
        raise InvalidValueError(
            f"{what} {path}",
            expected="a name that ends in " + ", ".join(suffixes),
            do="choose one of these suffixes",
        )


def require_folder(path: Path) -> None:
    """Refuse an output whose folder does not exist, before any work is done for it."""
    if not path.absolute().parent.is_dir():
        raise InvalidValueError(
            f"{path}: there is no folder {path.absolute().parent}",
            expected="an existing folder",
            do="make it first",
        )
    if path.is_dir():
        raise InvalidValueError(f"{path} is a folder", expected="the name of a file")
