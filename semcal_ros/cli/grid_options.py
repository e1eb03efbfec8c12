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

import click

from semcal_ros.cli.options import squares_option
from semcal_ros.core.calibration.start import UNTILTED_MODES
from semcal_ros.core.corners import PATTERNS
from semcal_ros.core.errors import InvalidValueError

Command = TypeVar("Command", bound=Callable[..., Any])


def _parse_untilted(
    _context: click.Context, _parameter: click.Parameter, text: str
) -> str | tuple[str, ...]:
    if text in UNTILTED_MODES:
        return text
    return tuple(part.strip() for part in text.split(",") if part.strip())


def squares_and_pattern(command: Command) -> Command:
    """``--squares`` and ``--pattern``."""
    pattern = click.option(
        "--pattern",
        type=click.Choice(PATTERNS),
        default="auto",
        show_default=True,
        help="What the grid consists of: chess squares, dots or holes, crosses, crossed lines, or a grating of "
        "parallel lines, which is turned and not tilted.",
    )
    squares = squares_option(
        "Sizes of the squares of the grid, such as 25um,10um, instead of those of the configuration."
    )
    return squares(pattern(command))


def grid_options(command: Command) -> Command:
    """``--squares``, ``--pattern`` and ``--untilted``."""
    untilted = click.option(
        "--untilted",
        callback=_parse_untilted,
        default="auto",
        show_default=True,
        metavar="auto|all|none|N,N,...",
        help="Frames without tilt, by number or by file name, if no stage says the tilts.",
    )
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
    context = click.get_current_context()
    for name in ("squares", "pattern", "untilted"):
        # Its value may be None, or equal to the default, although it was given.
        if context.get_parameter_source(name) not in (None, click.core.ParameterSource.DEFAULT):
            raise InvalidValueError(
                f"--{name}, which is about a grid; {why}",
                expected="one of the two",
                do=f"leave out --{name}",
            )
