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
from semcal_ros.nodes.base import SemNode

for _module in pkgutil.iter_modules(semcal_ros.nodes.__path__, "semcal_ros.nodes."):
    importlib.import_module(_module.name)

# Meant to take the place of rclpy's.
OVERRIDDEN = {"destroy_node"}


def _kinds(base: type) -> set[type]:
    return {base}.union(*(_kinds(kind) for kind in base.__subclasses__()))


def _own(kind: type) -> set[str]:
    """What a class defines, and what its methods set on the instance."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    set_on_it = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.ctx, ast.Store)
        and isinstance(node.value, ast.Name)
        and node.value.id == "self"
    }
    return set_on_it | {name for name in vars(kind) if not name.startswith("__")}


NODES = sorted(_kinds(SemNode), key=lambda kind: kind.__name__)


@pytest.mark.parametrize("kind", NODES, ids=lambda kind: kind.__name__)
def test_a_node_overwrites_nothing_of_rclpy(kind: type) -> None:
    mangled = _own(Node) | set(dir(Node))
    # Names with two underscores are rclpy's alone.
    theirs = {name for name in mangled if not name.startswith("__")}
    assert "_services" in theirs
    assert _own(kind) & theirs <= OVERRIDDEN


def test_all_nodes_were_looked_at() -> None:
    names = {kind.__name__ for kind in NODES}
    assert {"StreamCorrector", "VisualServo", "BagPlayer", "CalibrationServer"} <= names
