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

"""Options that say what the grid is, and how it lies, as all commands that look at one have them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from semcal_ros.cli.options import given_options, make_option
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.workflows.find_grid import PATTERN, UNTILTED
from semcal_ros.workflows.options import SQUARES, OptionField

Command = TypeVar("Command", bound=Callable[..., Any])


def squares_and_pattern(command: Command) -> Command:
    """``--squares`` and ``--pattern``."""
    squares = make_option(OptionField("squares", Any, None, SQUARES))
    return squares(make_option(OptionField("pattern", str, "auto", PATTERN))(command))


def grid_options(command: Command) -> Command:
    """``--squares``, ``--pattern`` and ``--untilted``."""
    untilted = make_option(OptionField("untilted", Any, "auto", UNTILTED))
    return squares_and_pattern(untilted(command))


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
