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

"""Which cases of a fleet can depend on a row of a table at all.

A row is a global name of the modules that import it. What a case executes is recorded by a profile of its calls: a case
that enters no function with the name in its code cannot depend on the row. A row that a module uses while it is
imported may act anywhere.
"""

from __future__ import annotations

import ast
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "semcal_ros"


def names_read(action: Callable[[], object]) -> set[str]:
    """Global and attribute names in all functions of the package that an action enters."""
    names: set[str] = set()
    seen: set[Any] = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code not in seen:
            seen.add(frame.f_code)
            if str(frame.f_globals.get("__name__", "")).startswith(PACKAGE):
                names.update(frame.f_code.co_names)

    threading.setprofile(note)
    sys.setprofile(note)
    try:
        action()
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    return names


def find_users(table: str) -> dict[str, set[str] | None]:
    """For each row of a table, the names that stand for it in functions; None if it acts while modules are imported."""
    starts: dict[str, set[str]] = {}
    anywhere: set[str] = set()
    for path in sorted((ROOT / PACKAGE).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        if module == table:
            tree = ast.parse(text)
            for node in tree.body:
                if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
                    starts[node.targets[0].id] = _loaded(node.value)
        elif table in text:
            tree = ast.parse(text)
            imported = {
                alias.asname or alias.name: alias.name
                for node in ast.walk(tree)
                if isinstance(node, ast.ImportFrom) and node.module == table
                for alias in node.names
            }
            anywhere |= {imported[n] for n in _loaded_outside_functions(tree) if n in imported}
            renamed = {name: own for own, name in imported.items() if own != name}
            if renamed:
                raise ValueError(f"{module} renames {', '.join(renamed)}")
    users: dict[str, set[str] | None] = {}
    for row in starts:
        following = {row}
        while more := {r for r, names in starts.items() if names & following} - following:
            following |= more
        users[row] = None if following & anywhere else following
    return users


def _loaded(node: ast.AST) -> set[str]:
    return {n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Load)}


def _loaded_outside_functions(node: ast.AST) -> set[str]:
    """Names that are read when a module is imported: also defaults and decorators of functions."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        parts: list[ast.AST] = [*node.args.defaults, *node.decorator_list]
        parts += [value for value in node.args.kw_defaults if value is not None]
    elif isinstance(node, ast.Lambda):
        return set()
    elif isinstance(node, ast.Name):
        return {node.id}
    else:
        parts = list(ast.iter_child_nodes(node))
    return set().union(*map(_loaded_outside_functions, parts))
