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

"""One declaration for each option: a field of a frozen dataclass, with its type, its default and what it means.

The function of the package takes the fields as keywords (:class:`KeywordsOf`), with their meaning in its docstring; the
command takes them as options (:func:`semcal_ros.cli.options.options_of`); the page on the command line has its tables
from those.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import wraps
from typing import (
    Annotated,
    Any,
    Concatenate,
    Generic,
    ParamSpec,
    TypeVar,
    cast,
    get_args,
    get_origin,
    get_type_hints,
    overload,
)

Given = ParamSpec("Given")
Options = TypeVar("Options")
First = TypeVar("First")
Second = TypeVar("Second")
Source = TypeVar("Source")
Result = TypeVar("Result")


@dataclass(frozen=True)
class Keyword:
    """What a field of a dataclass of options means; alone, of one that the command line does not have.

    Attributes
    ----------
    text
        One or two sentences.
    """

    text: str

    @property
    def in_python(self) -> str:
        """What the keyword means."""
        return self.text


@dataclass(frozen=True)
class Option(Keyword):
    """What a field means, and how it is written on the command line.

    Attributes
    ----------
    kind
        What a text there stands for, where it is not that of the field's type: a key of
        :data:`semcal_ros.cli.options.KINDS`, such as ``length``.
    names
        How it is called there; by default as the field, without its unit.
    choices
        What is accepted.
    between
        Least and greatest number.
    metavar
        What stands for the value in the help, where it is not that of the kind.
    required
        Whether the command needs it.
    repeated
        Whether it may be given several times; the field is a tuple.
    python
        What is true of the keyword only, such as its unit.
    """

    kind: str = ""
    names: tuple[str, ...] = ()
    choices: Sequence[object] = ()
    between: tuple[float, float | None] | None = None
    metavar: str | None = None
    required: bool = False
    repeated: bool = False
    python: str = ""

    @property
    def in_python(self) -> str:
        """Extend the base class: with what is true of the keyword only."""
        return f"{self.text} {self.python}".rstrip()


# Shared by several workflows and commands.
INTERPOLATION = Option("Interpolation between raw pixels.", choices=("linear", "cubic", "lanczos4"))
DASK = Option(
    "Dask scheduler, such as tcp://host:8786, whose workers share the work.", metavar="ADDRESS"
)
SQUARES = Option(
    "Sizes of the squares of the grid, such as 25um,10um, instead of those of the configuration.",
    kind="lengths",
    python="In m.",
)
OVERWRITE = Option("Replace an existing output, once the new one is complete.")
CONFIG = Keyword("A ``msg_configs`` name or file; the default is ``generic``.")
FRAME_TIME = Keyword("Seconds of one pass over a frame, in place of what the configuration says.")
MAGNIFICATION = Keyword("Magnification of a folder of ordinary images, which do not contain it.")
PROGRESS = Keyword("Called with the stage, the number of frames done, and that of all frames.")


@dataclass(frozen=True)
class OptionField:
    """One field of a dataclass of options.

    Attributes
    ----------
    name, default
        As declared; the default is ``dataclasses.MISSING`` where there is none.
    type
        Its type, without what it means.
    meaning
        What it means.
    """

    name: str
    type: Any
    default: Any
    meaning: Keyword


def option_fields(kind: type, meanings: Mapping[str, Keyword] | None = None) -> list[OptionField]:
    """Return the fields of a dataclass of options that have a meaning.

    Parameters
    ----------
    kind
        The dataclass, whose types are ``Annotated`` with a :class:`Keyword`.
    meanings
        Of fields that do not have it in their types, since the dataclass is of a room that knows no command line.
    """
    hints = get_type_hints(kind, include_extras=True)
    found = []
    for field in fields(kind):
        hint, meaning = hints[field.name], (meanings or {}).get(field.name)
        if get_origin(hint) is Annotated:
            hint, *extras = get_args(hint)
            meaning = next((e for e in extras if isinstance(e, Keyword)), meaning)
        if meaning is not None:
            found.append(OptionField(field.name, hint, field.default, meaning))
    return found


class KeywordsOf(Generic[Given, Options]):
    """Lets a function of up to three things and a dataclass of options take the fields of the dataclass as keywords.

    The docstring of the function gets a list of the keywords and what they mean; the dataclass is its attribute
    ``options``.

    Parameters
    ----------
    options
        The dataclass.

    Examples
    --------
    >>> @dataclass(frozen=True)
    ... class HowOften:
    ...     times: Annotated[int, Keyword("How often.")] = 1
    >>> @KeywordsOf(HowOften)
    ... def say(text: str, options: HowOften) -> str:
    ...     return options.times * text
    >>> say("ho", times=3)
    'hohoho'
    """

    def __init__(self, options: Callable[Given, Options]) -> None:
        self._options = options

    @overload
    def __call__(
        self, function: Callable[[Source, Options], Result]
    ) -> Callable[Concatenate[Source, Given], Result]: ...

    @overload
    def __call__(
        self, function: Callable[[First, Source, Options], Result]
    ) -> Callable[Concatenate[First, Source, Given], Result]: ...

    @overload
    def __call__(
        self, function: Callable[[First, Second, Source, Options], Result]
    ) -> Callable[Concatenate[First, Second, Source, Given], Result]: ...

    def __call__(self, function: Callable[..., Result]) -> Callable[..., Result]:
        """Return the function with these keywords."""
        described = option_fields(cast(type, self._options))
        types = {one.name: one.type for one in described}
        own = inspect.signature(function)
        *things, _ = own.parameters.values()
        given = [
            parameter.replace(annotation=types.get(name, parameter.annotation))
            for name, parameter in inspect.signature(self._options).parameters.items()
        ]
        signature = own.replace(parameters=[*things, *given])
        make = cast("Callable[..., Options]", self._options)

        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Result:
            # Here, so that a misspelt keyword is one of this function.
            bound = signature.bind(*args, **kwargs).arguments
            leading = [bound.pop(thing.name) for thing in things]
            return function(*leading, make(**bound))

        call.__doc__ = _with_keywords(inspect.getdoc(function) or "", described)
        vars(call).update(__signature__=signature, options=self._options)
        return call


def _with_keywords(text: str, described: list[OptionField]) -> str:
    """A docstring with what the keywords mean, before its other sections."""
    lines = ["Keyword arguments", "-----------------"]
    for one in described:
        lines += [one.name, f"    {one.meaning.in_python}"]
    summary, section, rest = text.partition("\n\nRaises\n")
    return "\n".join([summary, "", *lines]) + section + rest
