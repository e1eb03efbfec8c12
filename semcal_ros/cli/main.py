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

"""Entry point of the ``semcal`` command: its subcommands, and how errors reach the user."""

from __future__ import annotations

import contextlib
import os
import re
import sys
from copy import copy
from functools import wraps
from importlib import import_module
from typing import Any

import click

import semcal_ros
from semcal_ros.cli.options import spare_inputs
from semcal_ros.core.errors import SemcalError, UnusableCalibrationError
from semcal_ros.core.wording import did_you_mean
from semcal_ros.middleware import add_environment_prefix

# Modules are imported when their command is used, so that `semcal --help` does not wait for plotting or bags.
_COMMANDS = {
    "acquire": "calibrate a live microscope unattended, or step by step",
    "at": "camera at a magnification: K, P, distortion, nm per pixel",
    "calibrate": "calibrate from a recording of the grid",
    "check": "whether a calibration still holds, by a few views of the grid",
    "compare": "by how much two calibrations differ",
    "demo": "a virtual microscope in the browser, raw and corrected",
    "doctor": "what keeps a live stream from working",
    "drift": "specimen drift of a recording, as a table",
    "evaluate": "reprojection error of a calibration on a recording",
    "export": "a calibration as a file of OpenCV, ROS, mrcal, COLMAP, Fiji, or a table",
    "extend": "a calibration beyond its grid, by pictures of a specimen",
    "import": "make a bag from images, such as those of an SEM's own software",
    "import-calibration": "a calibration from a table of pixel sizes",
    "info": "what a recording contains",
    "measure": "measurements in nanometres: bending of a cantilever",
    "plan": "which views to record next for a more certain calibration",
    "play": "replay a recording as ROS topics",
    "reconstruct": "heights from tilted images, or the shape of a ball that turns",
    "rectify": "drift-free, undistorted copy of a recording",
    "simulate": "record the virtual SEM to a bag, with its truth",
    "stack": "drift-corrected average of a recording, and a stabilised video",
    "update": "renew a calibration with a few views of the grid",
    "view": "the live stream in the browser",
}


class _Group(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        try:
            module = import_module(f"semcal_ros.cli.{cmd_name.replace('-', '_')}_command")
        except ImportError as error:
            raise SemcalError(
                f"semcal {cmd_name} cannot be loaded ({error})",
                expected="the packages of requirements/base.txt, in versions that fit each other",
                do="run `make setup`, or reinstall them",
            ) from error
        return _guard(module.command)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        if args and args[0] not in _COMMANDS and not args[0].startswith("-"):
            raise SemcalError(
                f"no such command {args[0]!r}",
                expected="one of " + ", ".join(sorted(_COMMANDS)),
                do=did_you_mean(args[0], _COMMANDS),
            )
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(sorted(_COMMANDS.items()))


def _guard(command: click.Command) -> click.Command:
    """The command, or all of a group, that writes over no file that it reads, and ends when nobody reads its output."""
    guarded = copy(command)
    if isinstance(guarded, click.Group):
        guarded.commands = {name: _guard(one) for name, one in guarded.commands.items()}
        return guarded
    callback = command.callback
    assert callback is not None

    @wraps(callback)
    def call(*given: Any, **named: Any) -> Any:
        spare_inputs(click.get_current_context())
        try:
            return callback(*given, **named)
        except BrokenPipeError:
            # The reader of the output has seen enough; click would exit as if the command had failed.
            with contextlib.suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 0

    guarded.callback = call
    return guarded


@click.group(cls=_Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(semcal_ros.__version__, prog_name="semcal")
def _semcal() -> None:
    """Calibrate scanning electron microscopes, and correct what they record.

    \b
    Example:
      semcal simulate grid --plan grid
      semcal calibrate grid -o cal.yaml --report report.html
      semcal at cal.yaml 5250
    """


def main(args: list[str] | None = None) -> int:
    """Run the command; returns its exit status: 0, 2 for bad input, or 1 for input that gave no result to rely on."""
    add_environment_prefix()
    given = sys.argv[1:] if args is None else args
    try:
        # Without standalone mode, click returns the status of an Exit that a command raises.
        status = _semcal(args=given or ["--help"], prog_name="semcal", standalone_mode=False)
        return status if isinstance(status, int) else 0
    except click.exceptions.Exit as stop:
        return stop.exit_code
    except click.UsageError as error:
        command = error.ctx.command_path if error.ctx is not None else "semcal"
        return _refuse(f"{_one_line(error)}; {_name_choice(error)}see {command} --help")
    except click.ClickException as error:
        return _refuse(_one_line(error))
    except UnusableCalibrationError as error:
        return _refuse(str(error), status=1)
    except SemcalError as error:
        return _refuse(str(error))
    except OSError as error:
        name = f"{error.filename}: " if error.filename else ""
        return _refuse(f"{name}{error.strerror or error}")
    except (KeyboardInterrupt, click.Abort):
        return 130


def _one_line(error: click.ClickException) -> str:
    return " ".join(error.format_message().split()).rstrip(".")


def _name_choice(error: click.UsageError) -> str:
    """Which of the choices of an option a misspelt one stands for; click only names those of options."""
    param = error.param if isinstance(error, click.BadParameter) else None
    if param is None or not isinstance(param.type, click.Choice):
        return ""
    given = re.match(r"'([^']*)'", error.message)
    question = did_you_mean(given.group(1), map(str, param.type.choices)) if given else ""
    return f"{question} " if question else ""


def _refuse(reason: str, *, status: int = 2) -> int:
    click.echo(f"semcal: {reason}", err=True)
    return status
