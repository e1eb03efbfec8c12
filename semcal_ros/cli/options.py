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

"""Options that several commands share, each described once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.tiff.values import plain_number, quantity

__all__ = [
    "FIGURE_SUFFIXES",
    "calibration_option",
    "check_outputs",
    "config_option",
    "frame_time_option",
    "interpolation_option",
    "json_option",
    "magnification_option",
    "no_drift_option",
    "output_option",
    "overwrite_option",
    "parse_length",
    "parse_ratio",
    "recording_argument",
    "recording_options",
    "require_folder",
]

Command = TypeVar("Command", bound=Callable[..., Any])
Output = tuple[str, Path | None, Sequence[str]]


PATH = click.Path(path_type=Path)
#: Formats of matplotlib by the suffix of a file name.
FIGURE_SUFFIXES = (".png", ".svg", ".pdf")

recording_argument = click.argument("recording", type=PATH)
config_option = click.option(
    "--config",
    default="generic",
    show_default=True,
    metavar="NAME_OR_FILE",
    help="msg_configs of the microscope: topics, units, display width, scan timing.",
)
frame_time_option = click.option(
    "--frame-time",
    type=click.FloatRange(0.0, min_open=True),
    metavar="S",
    help="Seconds of one pass over a frame, instead of what the configuration says.",
)
magnification_option = click.option(
    "--magnification",
    type=float,
    help="Magnification of all images: only for a folder of ordinary ones (png, jpg), which do not contain it.",
)
overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace an existing output, once the new one is complete."
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON, in SI units.")


def recording_options(command: Command) -> Command:
    """Options for reading a recording: ``--config`` and ``--frame-time``."""
    return config_option(frame_time_option(command))


def output_option(text: str) -> Callable[[Command], Command]:
    """The required ``-o`` with its help text."""
    return click.option("-o", "--output", required=True, type=PATH, help=text)


def calibration_option(
    text: str | None = None, *, required: bool = False
) -> Callable[[Command], Command]:
    """``--calibration`` with its help text."""
    return click.option("--calibration", type=PATH, required=required, help=text)


def no_drift_option(text: str) -> Callable[[Command], Command]:
    """``--no-drift`` with its help text."""
    return click.option("--no-drift", is_flag=True, help=text)


def interpolation_option(default: str) -> Callable[[Command], Command]:
    """``--interpolation`` with its default."""
    return click.option(
        "--interpolation",
        type=click.Choice(["linear", "cubic", "lanczos4"]),
        default=default,
        show_default=True,
    )


def parse_length(
    _context: click.Context, _parameter: click.Parameter, text: str | None
) -> float | None:
    """Callback of an option for a length with its unit, such as ``10um``; a bare number is in m."""
    if text is None:
        return None
    length_m = quantity(text, "m", default_unit="m")
    if length_m is None or length_m < 0.0:
        raise click.BadParameter(f"{text!r} is not a length such as 10um or 1e-5 (m)")
    # Without the rounding error of the unit.
    return float(f"{length_m:.12g}")


def parse_ratio(
    _context: click.Context, _parameter: click.Parameter, text: str | None
) -> float | None:
    """Callback of an option for a ratio, such as ``0.1%`` or 0.001."""
    if text is None:
        return None
    ratio = plain_number(text.strip().removesuffix("%"))
    if ratio is None:
        raise click.BadParameter(f"{text!r} is not a ratio such as 0.1% or 0.001")
    return float(f"{0.01 * ratio:.12g}") if text.strip().endswith("%") else ratio


def check_outputs(outputs: Sequence[Output], *, recording: Path | None = None) -> None:
    """Refuse outputs that cannot be written, before any work is done for them.

    Parameters
    ----------
    outputs
        (option, path or None, suffixes that its kind of file may have; none for any).
    recording
        Recording that must not be written to.

    Raises
    ------
    InvalidValueError
        A suffix is not accepted, a folder does not exist, two outputs are one file, or an output
        belongs to the recording.
    """
    taken: set[Path] = set()
    source = None if recording is None else recording.resolve()
    for option, path, suffixes in outputs:
        if path is None:
            continue
        if suffixes and path.suffix.lower() not in suffixes:
            raise InvalidValueError(
                f"{option} {path}",
                expected="a name that ends in " + ", ".join(suffixes),
                do="choose one of these suffixes",
            )
        require_folder(path)
        target = path.resolve()
        if target in taken:
            raise InvalidValueError(
                f"{option} {path} is also another output", expected="a file of its own"
            )
        if source is not None and (target == source or source in target.parents):
            raise InvalidValueError(
                f"{option} {path} belongs to the recording", expected="a file outside it"
            )
        taken.add(target)


def require_folder(path: Path) -> None:
    """Refuse an output whose folder does not exist, before any work is done for it."""
    if not path.absolute().parent.is_dir():
        raise InvalidValueError(
            f"{path}: there is no folder {path.absolute().parent}",
            expected="an existing folder",
            do="create it first",
        )
    if path.is_dir():
        raise InvalidValueError(f"{path} is a folder", expected="the name of a file")
