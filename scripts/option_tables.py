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

"""Write the tables of options in doc/cli.md from the commands: ``python scripts/option_tables.py [--check]``.

A table stands between ``<!-- options of semcal NAME -->`` and ``<!-- end of options -->``. With ``--check`` nothing is
written, and the exit status is 1 if one is not that of its command.
"""

from __future__ import annotations

import argparse
import re
import sys
from importlib import import_module
from pathlib import Path

import click

PAGE = Path(__file__).resolve().parents[1] / "doc" / "cli.md"
TABLE = re.compile(
    r"(<!-- options of semcal ([\w-]+) -->\n)(.*?)(<!-- end of options -->)", re.DOTALL
)
# Described once for all commands, in the section on recordings.
OF_RECORDINGS = {
    "--config",
    "--pixel-size",
    "--magnification",
    "--display-width",
    "--frame-interval",
    "--frame-time",
    "--databar-rows",
    "--roi",
    "--mask",
}


def make_table(name: str) -> str:
    """Return the table of a command, in Markdown."""
    module = import_module(f"semcal_ros.cli.{name.replace('-', '_')}_command")
    command: click.Command = module.command
    reads = any(isinstance(one, click.Argument) and one.name == "paths" for one in command.params)
    left_out = OF_RECORDINGS if reads else set()
    rows = ["| option | default | |", "|---|---|---|"]
    options = [one for one in command.params if isinstance(one, click.Option)]
    rows += [_row(one) for one in options if not left_out.intersection(one.opts)]
    return "\n".join(rows) + "\n"


def _row(option: click.Option) -> str:
    if isinstance(option.type, click.Choice):
        value = "|".join(str(choice) for choice in option.type.choices)
    else:
        value = option.metavar or option.type.name.upper().removesuffix(" RANGE")
    name = " ".join([min(option.opts, key=len), *([] if option.is_flag else [value])])
    text, _, stated = (option.help or "").partition("[default: ")
    default = option.default if option.show_default else stated.removesuffix("]")
    text = text.strip().removesuffix(".")
    return f"| {_code(name)} | {_code(str(default)) if default != '' else ''} | {_escape(text)} |"


def _code(text: str) -> str:
    return f"`{_escape(text)}`"


def _escape(text: str) -> str:
    return text.replace("|", "\\|")


def write_tables(page: str) -> str:
    """Return a page with its tables made anew."""
    return TABLE.sub(lambda found: f"{found[1]}{make_table(found[2])}{found[4]}", page)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--check", action="store_true", help="write nothing; say what differs")
    options = parser.parse_args(arguments)
    before = PAGE.read_text(encoding="utf-8")
    after = write_tables(before)
    if options.check and after != before:
        print(f"{PAGE}: tables of options are not those of the commands", file=sys.stderr)
        return 1
    if not options.check:
        PAGE.write_text(after, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
