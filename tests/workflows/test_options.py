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

"""Options that are declared once: the keywords of a function and the options of a command."""

from __future__ import annotations

import inspect
import math
from dataclasses import dataclass, fields
from typing import Annotated, Any

import click
import pytest
from click.testing import CliRunner

from semcal_ros import calibrate, stack
from semcal_ros.cli.options import KINDS, given_options, options_of
from semcal_ros.workflows.calibrate import PAPER_OPTIONS, CalibrateOptions
from semcal_ros.workflows.calibrate_specimen import SpecimenOptions
from semcal_ros.workflows.check_and_update import CheckOptions, UpdateOptions
from semcal_ros.workflows.evaluate import EvaluateOptions
from semcal_ros.workflows.measure_cantilever import CantileverOptions
from semcal_ros.workflows.measure_relief import ReliefOptions
from semcal_ros.workflows.options import Keyword, KeywordsOf, Option, option_fields
from semcal_ros.workflows.reconstruct import ReconstructOptions
from semcal_ros.workflows.rectify import RectifyOptions
from semcal_ros.workflows.simulate import FaultOptions, SimulationOptions
from semcal_ros.workflows.stack import StackOptions
from semcal_ros.workflows.track_drift import DriftOptions


@dataclass(frozen=True)
class Sample:
    """One field of each kind."""

    count: Annotated[int, Option("How many.", between=(1, 9), python="At most nine.")] = 3
    width_m: Annotated[float | None, Option("How wide.", kind="length")] = None
    share: Annotated[float, Option("Which part.", kind="ratio")] = 0.0015
    radius_m: Annotated[float, Option("Of the bow.", kind="length or 0")] = 1e-5
    tilts: Annotated[tuple[float, ...], Option("Tilts.", kind="tilts")] = (0.0, math.pi / 9.0)
    bits: Annotated[int, Option("Depth.", choices=(8, 16))] = 8
    places: Annotated[tuple[float, ...], Option("Places.", names=("--place",), repeated=True)] = ()
    fast: Annotated[bool, Option("Hurry.")] = False
    drift: Annotated[bool, Option("Leave it in.", names=("--no-drift",))] = True
    memory: Annotated[object, Keyword("For Python alone.")] = None
    unsaid: int = 0


@KeywordsOf(Sample)
def measure(source: str, options: Sample) -> tuple[str, Sample]:
    """Measure something.

    Raises
    ------
    ValueError
        Never.
    """
    return source, options


def told(*arguments: str) -> tuple[Sample, list[str], Any]:
    """What a command is called with, and the options that count as given."""
    called: list[Any] = []

    @click.command()
    @options_of(Sample)
    def command(options: Sample) -> None:
        called.extend([options, given_options()])

    result = CliRunner().invoke(command, arguments)
    return (*called, result) if called else (Sample(), [], result)


def test_without_options_a_command_has_the_defaults_of_the_dataclass() -> None:
    options, given, _ = told()
    assert options.tilts == pytest.approx(Sample().tilts)
    assert options == Sample(tilts=options.tilts)
    assert given == []


def test_texts_become_values_in_si_units() -> None:
    options, given, _ = told(
        *("--count", "9", "--width", "35um", "--share", "0.4%", "--radius", "0", "--tilts", "0,90"),
        *("--bits", "16", "--place", "1", "--place", "2.5", "--fast", "--no-drift"),
    )
    assert options.tilts == pytest.approx((0.0, math.pi / 2.0))
    assert options == Sample(
        9, 35e-6, 0.004, 0.0, options.tilts, 16, (1.0, 2.5), fast=True, drift=False
    )
    assert "--width" in given
    assert "--no-drift" in given


def test_the_default_stands_in_the_help_as_a_user_would_write_it() -> None:
    text = told("--help")[2].output
    for shown in ("[default: 0.15%]", "[default: 10um]", "[default: 0deg,20deg]", "[default: 8]"):
        assert shown in text
    assert "1<=x<=9" in text
    assert "memory" not in text


@pytest.mark.parametrize(
    "arguments", [("--count", "10"), ("--bits", "12"), ("--share", "much"), ("--width", "wide")]
)
def test_what_is_not_accepted_is_refused(arguments: tuple[str, str]) -> None:
    assert told(*arguments)[2].exit_code == 2


def test_a_function_takes_the_fields_as_keywords() -> None:
    source, options = measure("bag", bits=16, width_m=1.0)
    assert source == "bag"
    assert options == Sample(bits=16, width_m=1.0)
    with pytest.raises(TypeError, match="unexpected keyword argument 'widht_m'"):
        measure("bag", widht_m=1.0)  # type: ignore[call-arg]
    assert list(inspect.signature(measure).parameters)[:3] == ["source", "count", "width_m"]
    assert inspect.signature(measure).parameters["bits"].annotation is int


def test_two_things_may_come_first() -> None:
    @KeywordsOf(Sample)
    def compare(first: str, second: str, options: Sample) -> tuple[str, str, int]:
        return first, second, options.bits

    assert compare("a", "b", bits=16) == ("a", "b", 16)
    assert list(inspect.signature(compare).parameters)[:3] == ["first", "second", "count"]


def test_its_docstring_says_what_they_mean_before_the_other_sections() -> None:
    text = measure.__doc__ or ""
    assert "count\n    How many. At most nine.\n" in text
    assert "memory\n    For Python alone." in text
    assert text.index("Keyword arguments") < text.index("Raises")


@pytest.mark.parametrize(
    "kind",
    [
        *(CalibrateOptions, CantileverOptions, CheckOptions, DriftOptions, EvaluateOptions),
        *(FaultOptions, ReconstructOptions, UpdateOptions),
        *(RectifyOptions, ReliefOptions, SimulationOptions, SpecimenOptions, StackOptions),
    ],
)
def test_every_field_of_the_package_has_a_meaning_and_a_known_kind(kind: type) -> None:
    described = option_fields(kind)
    assert [one.name for one in described] == [field.name for field in fields(kind)]
    for one in described:
        assert one.meaning.text.strip()
        if isinstance(one.meaning, Option):
            assert one.meaning.kind in KINDS


def test_the_options_of_the_paper_are_fields_of_core() -> None:
    from semcal_ros.core.calibration.options import MethodOptions

    assert [one.name for one in option_fields(MethodOptions, PAPER_OPTIONS)] == list(
        MethodOptions.__dataclass_fields__
    )


def test_the_public_functions_have_their_keywords() -> None:
    assert {"drift", "at", "video", "dask"} <= set(inspect.signature(stack).parameters)
    assert {"squares_m", "method", "untilted", "options"} <= set(
        inspect.signature(calibrate).parameters
    )
