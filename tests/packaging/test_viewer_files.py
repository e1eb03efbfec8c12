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

"""The files for Foxglove, RViz and rqt name topics and fields that there are."""

from __future__ import annotations

import ast
import json
import re
from typing import Any

import pytest
import yaml
from rosbags.typesys import Stores, get_typestore

from semcal_ros.nodes.common.command_line import EXECUTABLES
from tests.helpers.project import ROOT

FOLDER = ROOT / "viewers"
TYPES = {
    "drift": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "magnification": "std_msgs/msg/Float64",
}


def outputs() -> set[str]:
    """Full names of all topics that an executable publishes."""
    names = {name.strip() for about in EXECUTABLES.values() for name in about.outputs.split(",")}
    return {f"/sem/{name}" for name in names} | {"/diagnostics"}


def texts(value: Any) -> list[str]:
    """All strings in a document."""
    if isinstance(value, dict):
        return [text for part in value.values() for text in texts(part)]
    if isinstance(value, list):
        return [text for part in value for text in texts(part)]
    return [value] if isinstance(value, str) else []


def strings(name: str) -> list[str]:
    """All strings in one of the files."""
    text = (FOLDER / name).read_text(encoding="utf-8")
    if name.endswith(".rviz"):
        return texts(yaml.safe_load(text))
    found = texts(json.loads(text))
    if name.endswith(".perspective"):
        # rqt keeps values as Python literals.
        return texts([ast.literal_eval(part) for part in found if part != "repr"])
    return found


def has_field(typename: str, path: list[str]) -> bool:
    """Whether a message has a field, of a field, and so on."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name in path:
        fields = dict(store.fielddefs[typename][1])
        if name not in fields:
            return False
        _kind, detail = fields[name]
        typename = str(detail if isinstance(detail, str) else detail[0])
    return typename == "float64"


@pytest.mark.parametrize("name", ["foxglove.json", "semcal.rviz", "semcal.perspective"])
def test_every_topic_is_published(name: str) -> None:
    topics = set()
    for text in strings(name):
        if text == "/diagnostics":
            topics.add(text)
        elif text.startswith("/sem/"):
            topic, *path = re.split(r"[./]", text.removeprefix("/sem/"))
            topics.add(f"/sem/{topic}")
            assert not path or has_field(TYPES[topic], path), text
    assert {"/sem/image_raw", "/sem/image_rect", "/sem/drift"} <= topics
    assert topics <= outputs()


def test_a_field_that_does_not_exist_is_found() -> None:
    assert not has_field(TYPES["drift"], ["pose", "pose", "position", "w"])
    assert has_field(TYPES["drift"], ["pose", "pose", "position", "x"])


def test_every_panel_of_foxglove_is_placed() -> None:
    layout = json.loads((FOLDER / "foxglove.json").read_text(encoding="utf-8"))

    def placed(node: Any) -> list[str]:
        if isinstance(node, str):
            return [node]
        return [*placed(node["first"]), *placed(node["second"])]

    assert sorted(placed(layout["layout"])) == sorted(layout["configById"])
