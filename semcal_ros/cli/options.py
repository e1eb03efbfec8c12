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

"""Options of commands: made from dataclasses, and those that several commands share."""

from __future__ import annotations

import math
import os
import re
import types
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, dataclass
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin

import click

from semcal_ros.core.errors import InvalidValueError, SemcalError
from semcal_ros.files.images.metadata import angle_in_degrees, plain_number, quantity
from semcal_ros.workflows.options import (
    OVERWRITE,
    Keyword,
    Option,
    OptionField,
    option_fields,
)

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


json_option = click.option("--json", "as_json", is_flag=True, help="Print JSON, in SI units.")


def output_option(text: str) -> Callable[[Command], Command]:
    """The required ``-o`` with its help text."""
    return click.option("-o", "--output", required=True, type=PATH, help=text)


# Options that name files to be written, by their parameters; and the input that its command may replace.
_WRITTEN = frozenset(
    [
        "output",
        "table",
        "figure",
        "plot",
        "video",
        "report",
        "strip",
        "record",
        "cloud",
        "sigma",
        "extended",
    ]
)
_REPLACED = frozenset({("update", "calibration"), ("extend", "calibration")})


def spare_inputs(context: click.Context) -> None:
    """Refuse an output of a command that is one of the files it reads, by whatever name; the calibration that
    ``update`` and ``extend`` renew may be replaced.

    Raises
    ------
    InvalidValueError
        An output is an input.
    """
    written, read = [], []
    for parameter in context.command.params:
        value = context.params.get(parameter.name or "")
        for one in value if isinstance(value, (tuple, list)) else (value,):
            if not isinstance(one, (str, Path)) or not os.path.isfile(one):
                continue
            if isinstance(parameter, click.Option) and parameter.name in _WRITTEN:
                written.append((parameter.opts[0], one))
            elif (context.info_name, parameter.name) not in _REPLACED:
                read.append((parameter.human_readable_name, one))
    for option, path in written:
        for name, source in read:
            if os.path.samefile(path, source):
                raise InvalidValueError(
                    f"{option} {path} is also an input of this command ({name})",
                    expected="an output of its own",
                    do="choose another name",
                )


class FiniteRange(click.FloatRange):
    """A number within limits, and no infinity or NaN."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """Extend the base class: refuse what is not finite, which no comparison does."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


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


@contextmanager
def needs_ros(expected: str = "rclpy") -> Iterator[None]:
    """Refuse, where ROS 2 cannot be imported, what imports it inside.

    Parameters
    ----------
    expected
        What the command needs.

    Raises
    ------
    SemcalError
        If an import inside fails.
    """
    try:
        yield
    except ImportError as error:
        raise SemcalError(
            f"ROS 2 cannot be imported ({error})",
            expected=expected,
            do="source a ROS 2 workspace or run `make setup`",
        ) from error


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
    """Refuse options that were given on the command line beside another one, even with the value of their default.

    Parameters
    ----------
    option, why
        The other option, and why it goes with none of them.
    names
        Of the options, such as ``--tilts``; what the command does not have is passed over.

    Raises
    ------
    InvalidValueError
        If one of them was given.
    """
    given = set(given_options())
    for name in names:
        if name in given:
            raise InvalidValueError(
                f"{name} with {option}, {why}", expected="one of the two", do=f"leave out {name}"
            )


def given_options() -> list[str]:
    """Return the options that the user gave to the command that runs, such as ``--tilts``."""
    context = click.get_current_context()
    # A value may be None, or equal to the default, although it was given.
    nothing = (None, click.core.ParameterSource.DEFAULT)
    return [
        max(parameter.opts, key=len)
        for parameter in context.command.params
        if parameter.name and context.get_parameter_source(parameter.name) not in nothing
    ]


def refuse_grid_options(why: str) -> None:
    """Refuse the first of these options that the user gave, for work that looks at no grid.

    Parameters
    ----------
    why
        What the work looks at instead, with the option that asked for it.

    Raises
    ------
    InvalidValueError
        If one was given, even with the value of its default.
    """
    given = given_options()
    for name in ("--squares", "--pattern", "--untilted"):
        if name in given:
            raise InvalidValueError(
                f"{name}, which is about a grid; {why}",
                expected="one of the two",
                do=f"leave out {name}",
            )


# -- options from dataclasses -------------------------------------------------------------------------


@dataclass(frozen=True)
class Kind:
    """How a value is written on the command line.

    Attributes
    ----------
    metavar
        What stands for it in the help.
    type
        Reads one.
    parse
        Callback of click that reads it; None for the type alone.
    write
        The default as a user would write it.
    """

    metavar: str | None = None
    type: Any = None
    parse: Callable[[click.Context, click.Parameter, Any], Any] | None = None
    write: Callable[[Any], str] = str


class _PixelType(click.ParamType):  # type: ignore[type-arg,unused-ignore]  # likewise
    """Two numbers: column and row."""

    name = "X,Y"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float]:
        if isinstance(value, tuple):
            return value
        try:
            x, y = (float(part) for part in str(value).split(","))
        except ValueError:
            self.fail(f"{value!r} is not a pair of pixel coordinates such as 120.5,300", param, ctx)
        if not (math.isfinite(x) and math.isfinite(y)):
            self.fail(f"{value!r} is not finite", param, ctx)
        return x, y


def _parse_quarter_turn(
    context: click.Context, parameter: click.Parameter, text: str | None
) -> float | None:
    """One angle; in degrees."""
    angles = parse_tilts(context, parameter, text)
    if angles is None:
        return None
    if len(angles) != 1:
        raise click.BadParameter(f"{text!r} is not one angle such as 90")
    return math.degrees(angles[0])


def _parse_numbers(
    _context: click.Context, _parameter: click.Parameter, text: str | None
) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(",")) if text else ()
    except ValueError:
        raise click.BadParameter(f"{text!r} is not a list such as 1000,5000") from None


def _parse_step(
    _context: click.Context, _parameter: click.Parameter, text: str | None
) -> float | str | None:
    if text is None or text == "auto":
        return text
    try:
        return float(text)
    except ValueError:
        raise click.BadParameter(f"{text!r} is neither auto nor a number such as 500") from None


def _parse_range(
    _context: click.Context, _parameter: click.Parameter, text: str | None
) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        low, high = (float(part) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r} is not a range such as 500,10000") from None
    return low, high


def _parse_untilted(
    _context: click.Context, _parameter: click.Parameter, text: str
) -> str | tuple[str, ...]:
    # Heavy for commands that look at no grid.
    from semcal_ros.core.calibration.start import UNTILTED_MODES

    if text in UNTILTED_MODES:
        return text
    return tuple(part.strip() for part in text.split(",") if part.strip())


def _parse_length_in_picture(
    context: click.Context, parameter: click.Parameter, text: str | None
) -> tuple[float, ...] | None:
    """Length in m, number of the picture, and the four coordinates."""
    if text is None:
        return None
    length, _, rest = text.partition("@")
    try:
        picture, *ends = (float(part) for part in rest.split(","))
        if len(ends) != 4 or picture != int(picture):
            raise ValueError
    except ValueError:
        raise click.BadParameter(
            f"{text!r} is not a length such as 4.2um@0,110,80,300,82"
        ) from None
    return (float(LENGTH.convert(length, parameter, context)), picture, *ends)


def _parse_size(_context: click.Context, _parameter: click.Parameter, text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)\s*[x×,]\s*(\d+)", text.strip())
    if found is None or not all(1 <= int(side) <= 65_536 for side in found.groups()):
        raise click.BadParameter(f"{text!r} is not an image size such as 1024x768")
    return int(found[1]), int(found[2])


def _write_ratio(ratio: float) -> str:
    return f"{100.0 * ratio:.12g}%"


def _write_length(length_m: float) -> str:
    for size, unit in ((1.0, "m"), (1e-3, "mm"), (1e-6, "um")):
        if abs(length_m) >= size:
            return f"{length_m / size:.12g}{unit}"
    return f"{length_m / 1e-9:.12g}nm"


def _write_tilts(tilts_rad: Iterable[float]) -> str:
    return ",".join(f"{math.degrees(tilt):.12g}deg" for tilt in tilts_rad)


#: By the names of :class:`~semcal_ros.workflows.options.Option`.
KINDS: dict[str, Kind] = {
    "": Kind(),
    "path": Kind(type=PATH),
    "path of a file": Kind("FILE", PATH),
    "length": Kind("LENGTH", LENGTH, write=_write_length),
    "length or 0": Kind("LENGTH", LENGTH_OR_ZERO, write=_write_length),
    "height": Kind("LENGTH", HEIGHT),
    "time": Kind("TIME", DURATION),
    "time to listen": Kind(
        "TIME",
        Quantity("time", "s", "3s or 500ms", within=(0.1, 3600.0)),
        write=lambda s: f"{s:g}s",
    ),
    "factor": Kind(type=FiniteRange(min=0.0, min_open=True)),
    "image size": Kind("WxH", parse=_parse_size),
    "time ahead": Kind("TIME", Quantity("time", "s", "5s or 500ms", within=(0.0, 1e6))),
    "lengths": Kind("LENGTH,...", parse=parse_lengths),
    "ratio": Kind("RATIO", parse=parse_ratio, write=_write_ratio),
    "magnification": Kind("G", parse=parse_magnification),
    "pixel": Kind(type=_PixelType()),
    "angle": Kind("ANGLE", parse=parse_angle),
    "tilts": Kind("ANGLE,...", parse=parse_tilts, write=_write_tilts),
    "quarter turn": Kind("ANGLE", parse=_parse_quarter_turn),
    "numbers": Kind("G,G,...", parse=_parse_numbers),
    "step": Kind("auto|G", parse=_parse_step),
    "range": Kind("LOW,HIGH", parse=_parse_range),
    "untilted": Kind("auto|all|none|N,N,...", parse=_parse_untilted),
    "length in picture": Kind("LENGTH@N,X,Y,X,Y", parse=_parse_length_in_picture),
}

# Units at the end of a field's name, which the command line does not have: there, a quantity is given with its unit.
_UNITS = re.compile(r"_(m|px|rad|deg|s)$")


def _plain_type(hint: Any) -> Any:
    """The type of a field without None."""
    if get_origin(hint) in (Union, types.UnionType):
        return next(part for part in get_args(hint) if part is not type(None))
    return hint


def _is_flag(field: OptionField) -> bool:
    return field.type is bool


def make_option(field: OptionField) -> Callable[[Command], Command]:
    """Return the option of click for a field whose meaning is an :class:`Option`."""
    option = field.meaning
    assert isinstance(option, Option)
    names = option.names or ("--" + _UNITS.sub("", field.name).replace("_", "-"),)
    kind = KINDS[option.kind]
    settings: dict[str, Any] = {"help": option.text or None}
    if _is_flag(field):
        return click.option(*names, field.name, is_flag=True, **settings)
    plain = _plain_type(field.type)
    settings["metavar"] = option.metavar or kind.metavar
    settings["type"], settings["callback"] = kind.type, kind.parse
    if option.choices:
        settings["type"] = click.Choice([str(choice) for choice in option.choices])
        if plain is int:
            settings["callback"] = lambda _context, _parameter, text: text and int(text)
    elif not option.kind and option.repeated:
        settings["type"] = get_args(plain)[0]
    elif not option.kind and option.between:
        limits: Any = click.IntRange if plain is int else FiniteRange
        settings["type"] = limits(*option.between)
    elif not option.kind:
        settings["type"] = plain
    if option.repeated:
        settings["multiple"] = True
    if option.required:
        settings["required"] = True
    elif field.default is not MISSING and field.default not in (None, ()):
        settings |= {"default": kind.write(field.default), "show_default": True}
    return click.option(*names, field.name, **settings)


def options_of(
    kind: type, name: str = "options", meanings: Mapping[str, Keyword] | None = None
) -> Callable[[Command], Command]:
    """Give a command the options that the fields of a dataclass mean, and call it with such an object.

    Parameters
    ----------
    kind
        The dataclass; a field that is a flag is true by default where the option takes something away.
    name
        Of the parameter of the command.
    meanings
        As of :func:`~semcal_ros.workflows.options.option_fields`.
    """
    found = [one for one in option_fields(kind, meanings) if isinstance(one.meaning, Option)]

    def decorate(command: Command) -> Command:
        @wraps(command)
        def call(**given: Any) -> Any:
            values = {field.name: given.pop(field.name) for field in found}
            for field in found:
                if _is_flag(field) and field.default is True:
                    values[field.name] = not values[field.name]
            return command(**{name: kind(**values)}, **given)

        decorated: Any = call
        for field in reversed(found):
            decorated = make_option(field)(decorated)
        result: Command = decorated
        return result

    return decorate


overwrite_option = make_option(OptionField("overwrite", bool, False, OVERWRITE))
