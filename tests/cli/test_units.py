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

"""Quantities on the command line: with their unit, or bare as documented."""

from __future__ import annotations

import math
from typing import Any

import click
import pytest

from semcal_ros.cli.acquire_command import command as acquire
from semcal_ros.cli.doctor_command import command as doctor
from semcal_ros.cli.drift_command import command as drift
from semcal_ros.cli.options import parse_tilts
from semcal_ros.cli.reconstruct_command import command as reconstruct
from tests.helpers.semcal_runs import refused


def parsed(command: click.Command, option: str, text: str) -> Any:
    (parameter,) = (p for p in command.params if option in p.opts)
    return parameter.type_cast_value(click.Context(command), text)


@pytest.mark.parametrize(
    ("command", "option", "text", "value"),
    [
        (reconstruct, "--height-sigma", "5um", 5e-6),
        (reconstruct, "--height-sigma", "2e-6", 2e-6),
        (reconstruct, "--height-sigma", "0", 0.0),
        (drift, "--forecast", "500ms", 0.5),
        (drift, "--forecast", "10", 10.0),
        (doctor, "--seconds", "500ms", 0.5),
        (doctor, "--seconds", "3", 3.0),
    ],
)
def test_quantities_have_units(
    command: click.Command, option: str, text: str, value: float
) -> None:
    assert parsed(command, option, text) == value


@pytest.mark.parametrize("command", [reconstruct, doctor])
def test_defaults_are_what_they_were(command: click.Command) -> None:
    option, value = {"reconstruct": ("--height-sigma", 10e-6), "doctor": ("--seconds", 3.0)}[
        str(command.name)
    ]
    (parameter,) = (p for p in command.params if option in p.opts)
    assert parsed(command, option, str(parameter.default)) == value


@pytest.mark.parametrize("text", ["0,20,40", "0deg,20deg,40deg", "0, 20 deg, 40"])
@pytest.mark.parametrize("command", [acquire, reconstruct])
def test_bare_tilts_are_degrees(command: click.Command, text: str) -> None:
    (parameter,) = (p for p in command.params if "--tilts" in p.opts)
    assert parameter.callback is parse_tilts
    found = parse_tilts(click.Context(command), parameter, text)
    assert found == pytest.approx([0.0, math.radians(20.0), math.radians(40.0)])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("doctor", "--seconds", "5000s"), "not within 0.1 to 3600 s"),
        (("doctor", "--seconds", "1m"), "'1m' is not a time such as 3s or 500ms"),
        (("drift", "x", "-o", "x.csv", "--forecast", "0"), "'0' is not above 0"),
        (("drift", "x", "-o", "x.csv", "--forecast", "2e6"), "not within 0 to 1e+06 s"),
        (
            ("acquire", "-o", "c.yaml", "--range", "1,2", "--tilts", "0,2um"),
            "'2um' is not an angle",
        ),
        (("acquire", "-o", "c.yaml", "--range", "1,2", "--tilts", ""), "is not an angle"),
        # Before anybody waits for a microscope.
        (("acquire", "-o", "c.yaml", "--range", "2000,500"), "expected the lower one first"),
        (
            ("acquire", "-o", "c.yaml", "--range", "500,2000", "--tilts", "0,95"),
            "a tilt of 95 degrees",
        ),
        (
            ("acquire", "-o", "c.yaml", "--range", "500,9000", "--most-views", "6"),
            "6 views; expected at least",
        ),
        (("acquire", "-o", "c.yaml", "--range", "1,2", "--resume", "gone"), "does not exist"),
        (("acquire", "-o", "c.yaml"), "neither --range nor --extend"),
        (("acquire", "-o", "c.yaml", "--range", "1,2", "--microscope", ""), "without a name"),
        (("acquire", "-o", "c.yaml", "--range", "1,2", "--extend", "c"), "--range and --extend"),
        (("acquire", "-o", "c.yaml", "--extend", "c.yaml"), "--extend without --to"),
        (("acquire", "-o", "c.yaml", "--range", "1,2", "--to", "9x"), "--to without --extend"),
        (("acquire", "-o", "c.yaml", "--extend", "c", "--to", "much"), "not a magnification"),
        (
            ("acquire", "-o", "c.yaml", "--extend", "c", "--to", "9x", "--tilts", "0,9"),
            "--tilts with --extend",
        ),
        (("acquire", "-o", "c.yaml", "--extend", "gone", "--to", "9x"), "No such file"),
        (
            ("acquire", "-o", "c.yaml", "--range", "1,2", "--no-record", "--record", "r"),
            "--record and --no-record",
        ),
    ],
)
def test_other_texts_are_refused(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], words: str
) -> None:
    assert words in refused(capsys, *arguments)
