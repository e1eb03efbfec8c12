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

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, TypeVar

import click

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.files.tiff.values import angle_in_degrees, plain_number, quantity

Command = TypeVar("Command", bound=Callable[..., Any])


PATH = click.Path(path_type=Path)
#: Formats of matplotlib by the suffix of a file name.
FIGURE_SUFFIXES = (".png", ".svg", ".pdf")


class Quantity(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # generic only in newer versions
    """A positive number with a unit, such as ``35um``; a bare number is in SI.

    Parameters
    ----------
    what
        Name of the quantity, for errors.
    unit
        SI unit: ``m`` or ``s``.
    example
        Text that is accepted.
    zero
        Whether 0 is accepted, too.
    negative
        Whether all numbers are accepted.
    within
        Least and largest value in SI, both accepted; None for any.
    """

    def __init__(
        self,
        what: str,
        unit: str,
        example: str,
        *,
        zero: bool = False,
        negative: bool = False,
        within: tuple[float, float] | None = None,
    ) -> None:
        self.name = what
        self._within = within
        self._negative = negative
        self._zero = zero
        self._unit = unit
        self._example = example

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Return the value in SI."""
        if isinstance(value, float):
            return value
        found = quantity(value, self._unit, default_unit=self._unit)
        if found is None and self._is_too_large(value):
            self.fail(f"{value!r} is too large", param, ctx)
        if found is None:
            self.fail(f"{value!r} is not a {self.name} such as {self._example}", param, ctx)
        if not self._negative and (found < 0.0 or (found == 0.0 and not self._zero)):
            self.fail(f"{value!r} is not {'0 or above' if self._zero else 'above 0'}", param, ctx)
        # Without the rounding error of the unit.
        value_si = float(f"{found:.12g}")
        if self._within is not None and not self._within[0] <= value_si <= self._within[1]:
            low, high = self._within
            self.fail(f"{value!r} is not within {low:g} to {high:g} {self._unit}", param, ctx)
        return value_si

    def _is_too_large(self, text: str) -> bool:
        """Whether the number overflows, of a text that is not a quantity."""
        without = re.sub(r"e\+?\d{3,}", "", text.strip(), flags=re.IGNORECASE)
        return quantity(without, self._unit, default_unit=self._unit) is not None


LENGTH = Quantity("length", "m", "35um or 3.5e-5 (m)")
LENGTH_OR_ZERO = Quantity("length", "m", "10um or 1e-5 (m)", zero=True)
HEIGHT = Quantity("height", "m", "50um or 5e-5 (m)", negative=True)
DURATION = Quantity("time", "s", "533ms or 0.533 (s)")


config_option = click.option(
    "--config",
    default="generic",
    show_default=True,
    metavar="NAME_OR_FILE",
    help="msg_configs of the microscope: topics, units, display width, scan timing.",
)


def squares_option(text: str) -> Callable[[Command], Command]:
    """``--squares`` with its help text."""
    return click.option("--squares", callback=parse_lengths, metavar="LENGTH,...", help=text)


def parse_lengths(
    _context: click.Context, parameter: click.Parameter, text: str | None
) -> tuple[float, ...] | None:
    """Callback of an option for lengths with their units, such as ``25um,10um``."""
    if text is None:
        return None
    return tuple(LENGTH.convert(part.strip(), parameter, _context) for part in text.split(","))


def parse_angle(
    _context: click.Context, _parameter: click.Parameter, text: str | None
) -> float | None:
    """Callback of an option for an angle with its unit, such as ``7deg``; in rad."""
    if text is None:
        return None
    found = angle_in_degrees(text.strip())
    if found is None:
        raise click.BadParameter(f"{text!r} is not an angle such as 7deg")
    return found


def parse_tilts(
    context: click.Context, parameter: click.Parameter, text: str | None
) -> tuple[float, ...] | None:
    """Callback of an option for angles such as ``0,20deg``, whose bare numbers are degrees; in rad."""
    if text is None:
        return None
    parts = [part.strip() for part in text.split(",")]
    stated = (part if plain_number(part) is None else f"{part}deg" for part in parts)
    found = (parse_angle(context, parameter, part) for part in stated)
    return tuple(angle for angle in found if angle is not None)


overwrite_option = click.option(
    "--overwrite", is_flag=True, help="Replace an existing output, once the new one is complete."
)
dask_option = click.option(
    "--dask",
    metavar="ADDRESS",
    help="Dask scheduler, such as tcp://host:8786, whose workers share the work.",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON, in SI units.")


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


def parse_magnification(
    _context: click.Context, _parameter: click.Parameter, text: str | None
) -> float | None:
    """Callback of an option: a magnification such as ``100000x``."""
    if text is None:
        return None
    try:
        return float(text.strip().removesuffix("x"))
    except ValueError as error:
        raise click.BadParameter(f"{text!r} is not a magnification such as 100000x") from error


def refuse_with(option: str, why: str, names: Iterable[str]) -> None:
    """Refuse parameters of a command that were given on the command line beside an option.

    Parameters
    ----------
    option, why
        The option, and why it goes with none of them.
    names
        Of the parameters.

    Raises
    ------
    InvalidValueError
        If one of them was given.
    """
    context = click.get_current_context()
    for name in names:
        if context.get_parameter_source(name) not in (None, click.core.ParameterSource.DEFAULT):
            given = "--" + name.replace("_", "-")
            raise InvalidValueError(
                f"{given} with {option}, {why}", expected="one of the two", do=f"leave out {given}"
            )
