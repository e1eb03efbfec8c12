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

"""Parameters: what is accepted at start, what while the node runs, and what follows from a change."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.nodes.common.parameters import (
    CALIBRATION,
    AllowedPaths,
    ParameterDeclaration,
    Parameters,
)

RATE = ParameterDeclaration("rate", 1.0, "Rate.", "Hz", 0.5, 10.0)
COUNT = ParameterDeclaration("count", 3, "Count.", low=0, high=5)
MODE = ParameterDeclaration("mode", "a", "Mode.", choices=("a", "b"))
ON = ParameterDeclaration("on", False, "On.")


class FakeNode:
    """As much of a ROS node as parameters need."""

    def __init__(self, **given: Any) -> None:
        self._given = given
        self.check: Callable[[Any], Any] = lambda _: None
        self.apply: Callable[[Any], None] = lambda _: None

    def declare_parameter(self, name: str, default: Any, _descriptor: Any) -> Any:
        return SimpleNamespace(value=self._given.get(name, default))

    def add_on_set_parameters_callback(self, callback: Any) -> None:
        self.check = callback

    def add_post_set_parameters_callback(self, callback: Any) -> None:
        self.apply = callback

    def set(self, name: str, value: Any) -> Any:
        """Result of setting a parameter, as ROS does it."""
        changes = [SimpleNamespace(name=name, value=value)]
        result = self.check(changes)
        if result.successful:
            self.apply(changes)
        return result


def declared(*declarations: ParameterDeclaration, **given: Any) -> tuple[Any, Parameters]:
    node: Any = FakeNode(**given)
    return node, Parameters(node, declarations)


@pytest.mark.parametrize(
    ("declaration", "good", "kept"),
    [(RATE, 2, 2.0), (RATE, 0.5, 0.5), (RATE, 10.0, 10.0), (COUNT, 5, 5), (MODE, "b", "b")],
)
def test_good_values_are_kept_in_the_type_of_the_parameter(
    declaration: ParameterDeclaration, good: Any, kept: Any
) -> None:
    node, parameters = declared(declaration)
    assert node.set(declaration.name, good).successful
    assert parameters[declaration.name] == kept
    assert type(parameters[declaration.name]) is type(declaration.default)


@pytest.mark.parametrize(
    ("declaration", "bad"),
    [
        (RATE, 0.4),
        (RATE, 10.1),
        (RATE, float("nan")),
        (RATE, "2"),
        (RATE, True),
        (COUNT, 6),
        (COUNT, -1),
        (COUNT, 2.0),
        (COUNT, True),
        (MODE, "c"),
        (ON, 1),
    ],
)
def test_bad_values_are_refused_with_what_is_accepted(
    declaration: ParameterDeclaration, bad: Any
) -> None:
    node, parameters = declared(declaration)
    result = node.set(declaration.name, bad)
    assert not result.successful
    assert f"parameter {declaration.name} = {bad!r}" in result.reason
    assert declaration.expected in result.reason
    assert parameters[declaration.name] == declaration.default
    with pytest.raises(InvalidValueError, match=declaration.name):
        declared(declaration, **{declaration.name: bad})


def test_a_change_is_checked_before_and_applied_after() -> None:
    node, parameters = declared(RATE)
    seen: list[tuple[float, float]] = []

    def check(value: float) -> None:
        if value == 3.0:
            raise InvalidValueError("not three")

    parameters.on_change("rate", lambda value: seen.append((value, parameters["rate"])), check)
    assert node.set("rate", 2.0).successful
    assert node.set("rate", 3.0).reason == "not three"
    assert seen == [(2.0, 2.0)]


def test_the_value_that_it_has_is_no_change_unless_it_names_a_file(tmp_path: Path) -> None:
    file = str(tmp_path / "cal.yaml")
    node, parameters = declared(RATE, CALIBRATION, calibration=file)
    seen: list[Any] = []
    for name in ("rate", "calibration"):
        parameters.on_change(name, seen.append)
    for name, value in (("rate", 1.0), ("rate", 1), ("calibration", file), ("rate", 2.0)):
        assert node.set(name, value).successful
    assert seen == [file, 2.0]


def test_parameters_of_ros_itself_pass() -> None:
    node, _ = declared(RATE)
    assert node.set("use_sim_time", True).successful


def test_files_that_callers_name_must_lie_in_the_folder(tmp_path: Path) -> None:
    inside, outside = tmp_path / "in", tmp_path / "out"
    inside.mkdir()
    outside.mkdir()
    (inside / "link.yaml").symlink_to(outside / "cal.yaml")
    node, parameters = declared(CALIBRATION, directory=str(inside))
    for name in (outside / "cal.yaml", inside / ".." / "out" / "cal.yaml", inside / "link.yaml"):
        result = node.set("calibration", str(name))
        assert not result.successful
        assert str(outside) in result.reason
        with pytest.raises(InvalidValueError):
            parameters.allowed_path(str(name))
    assert node.set("calibration", str(inside / "cal.yaml")).successful
    assert node.set("calibration", "").successful


def test_a_file_given_at_start_is_allowed_and_its_folder_too(tmp_path: Path) -> None:
    node, _ = declared(CALIBRATION, calibration=str(tmp_path / "cal.yaml"))
    assert node.set("calibration", str(tmp_path / "other.yaml")).successful
    assert not node.set("calibration", "/etc/passwd").successful


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_that_are_not_finite_are_refused_without_limits_too(value: float) -> None:
    with pytest.raises(InvalidValueError, match="a number"):
        ParameterDeclaration("offset", 0.0, "Offset.").convert(value)


def test_only_what_really_lies_inside_is_allowed(tmp_path: Path) -> None:
    inside = tmp_path / "inside"
    (inside / "deep").mkdir(parents=True)
    (tmp_path / "inside2").mkdir()
    (inside / "door").symlink_to(tmp_path)
    (tmp_path / "way_in").symlink_to(inside)
    allowed = AllowedPaths(str(inside))
    good_ones = (inside / "a", inside / "deep" / ".." / "a", tmp_path / "way_in" / "a", "a")
    for good in good_ones:
        assert allowed.resolve(str(good)) == inside / "a"
    for bad in (
        inside / ".." / "a",
        inside / "door" / "a",
        inside / "deep" / ".." / ".." / "inside2" / "a",
        tmp_path / "inside2" / "a",
        "../a",
        "door/a",
        "nul\0byte",
    ):
        with pytest.raises(InvalidValueError):
            allowed.resolve(str(bad))


def test_the_start_is_trusted_with_its_file_and_its_folder(tmp_path: Path) -> None:
    (tmp_path / "other").mkdir()
    start = tmp_path / "start.yaml"
    by_folder = AllowedPaths("", [str(start)])
    assert by_folder.resolve(str(tmp_path / "other" / "a")) == tmp_path / "other" / "a"
    # A directory of its own takes the place of that folder, not of the file.
    by_directory = AllowedPaths(str(tmp_path / "other"), [str(start)])
    assert by_directory.resolve(str(start)) == start
    with pytest.raises(InvalidValueError, match="inside"):
        by_directory.resolve(str(tmp_path / "b.yaml"))
    with pytest.raises(InvalidValueError, match="directory"):
        AllowedPaths().resolve(str(start))
