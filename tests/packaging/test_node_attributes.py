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

"""No node overwrites what rclpy keeps on itself: that fails silently, as when a list of services is replaced."""

from __future__ import annotations

import ast
import importlib
import inspect
import pkgutil
import textwrap

import pytest
from rclpy.node import Node

import semcal_ros.nodes
from semcal_ros.nodes.common.base import SemNode

for _module in pkgutil.walk_packages(semcal_ros.nodes.__path__, "semcal_ros.nodes."):
    importlib.import_module(_module.name)


def _kinds(base: type) -> set[type]:
    return {base}.union(*(_kinds(kind) for kind in base.__subclasses__()))


def _kept(kind: type) -> set[str]:
    """What the methods of a class set on the instance, and its private methods."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    set_on_it = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.ctx, ast.Store)
        and isinstance(node.value, ast.Name)
        and node.value.id == "self"
    }
    return set_on_it | {name for name in vars(kind) if name.startswith("_")}


NODES = sorted(_kinds(SemNode), key=lambda kind: kind.__name__)


@pytest.mark.parametrize("kind", NODES, ids=lambda kind: kind.__name__)
def test_a_node_overwrites_nothing_that_rclpy_keeps(kind: type) -> None:
    # Public methods may be overridden on purpose; names with two underscores are mangled or Python's.
    theirs = {name for name in _kept(Node) | set(dir(Node)) if not name.startswith("__")}
    assert "_services" in theirs
    assert not _kept(kind) & theirs


def test_all_nodes_were_looked_at() -> None:
    names = {kind.__name__ for kind in NODES}
    assert {"StreamCorrector", "VisualServo", "BagPlayer", "CalibrationServer"} <= names
