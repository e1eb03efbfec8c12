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

"""Count what a reader of the package has to take in: ``python scripts/house.py [--against COMMIT] [--list]``.

With ``--against``, the figures of another commit stand in the first column. ``--list`` names the modules with one
importer and the constants without a source.
"""

from __future__ import annotations

import argparse
import ast
import io
import re
import subprocess
import sys
import tarfile
import tempfile
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "semcal_ros"
# Their thresholds and types are counted: the method, and its uses.
WITH_THRESHOLDS = ("core/", "applications/")
WITH_TYPES = ("core/calibration", "core/drift")
LONGEST = 5
MANY = 10
# Methods of a table of thresholds (semcal_ros/core/thresholds.py), by the kind of source.
KINDS = ("derived", "measured", "defined", "cost", "stated")
# The same beside a number, in a room with too few of them for a table: ``# Derived: half of the main lobe.``
KIND_OF_COMMENT = re.compile(rf"#:? ({'|'.join(kind.capitalize() for kind in KINDS)}): \S")
# Functions whose value is a number as their arguments are.
NUMERIC = re.compile(r"(np|math)\.\w+|float|int|tuple|frozenset")
CONSTANT = re.compile(r"_?[A-Z][A-Z0-9_]*")


@dataclass(frozen=True)
class Module:
    """One file of the package."""

    name: str
    """Its dotted name; that of a package ends with ``.__init__``."""
    path: str
    """Relative to the package, with slashes."""
    tree: ast.Module
    lines: list[str]


@dataclass(frozen=True)
class Report:
    """The figures of a tree."""

    figures: dict[str, int]
    one_importer: list[str]
    """Names of the modules that one other module imports."""
    without_source: list[str]
    """``path:line name`` of the constants without a comment or a row in a table."""
    longest: list[str]
    """``count path:line name`` of the functions with the most parameters."""


def read_modules(root: Path, room: str = "") -> list[Module]:
    """Read all files of the package below a root, or of one room, such as ``core/corners``."""
    found = []
    for path in sorted((root / PACKAGE / room).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        name = ".".join(path.relative_to(root).with_suffix("").parts)
        relative = path.relative_to(root / PACKAGE).as_posix()
        found.append(Module(name, relative, ast.parse(text), text.splitlines()))
    return found


def count_all(modules: list[Module]) -> Report:
    """Count everything in the modules of a tree."""
    lines = Counter[str]()
    sources = Counter[str]()
    bare = []
    for module in modules:
        lines += count_lines(module)
        if module.path.startswith(WITH_THRESHOLDS):
            for name, line, source in find_constants(module):
                sources[source] += 1
                if source == "none":
                    bare.append(f"{module.path}:{line} {name}")
    importers = find_importers(modules)
    alone = sorted(name for name, others in importers.items() if len(others) == 1)
    functions = find_parameter_counts(modules)
    figures = {
        "files": len(modules),
        "lines of code": lines["code"],
        "lines of imports": lines["imports"],
        "lines of __all__": lines["all"],
        "modules with one importer": len(alone),
        **{f"constants, {kind}": count for kind, count in sorted(sources.items())},
        **{
            f"dataclasses in {room}": sum(
                _is_dataclass(node)
                for module in modules
                if module.path.startswith(f"{room}/")
                for node in ast.walk(module.tree)
            )
            for room in WITH_TYPES
        },
        f"functions with over {MANY} parameters": sum(count > MANY for count, _ in functions),
        "parameters of the longest list": functions[0][0] if functions else 0,
    }
    longest = [f"{count} {place}" for count, place in functions[:LONGEST]]
    return Report(figures, alone, bare, longest)


def count_lines(module: Module) -> Counter[str]:
    """Count lines of code (no docstrings, comments, blanks), and those of imports and ``__all__`` among them."""
    strings = {
        line
        for node in ast.walk(module.tree)
        for body in [getattr(node, "body", None)]
        if isinstance(body, list)
        for part in body
        if isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant)
        if isinstance(part.value.value, str)
        for line in _span(part)
    }
    code = {
        number
        for number, line in enumerate(module.lines, 1)
        if line.strip() and not line.lstrip().startswith("#")
    } - strings
    imports, offered = set[int](), set[int]()
    for node in ast.walk(module.tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            imports |= _span(node)
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            offered |= _span(node)
    return Counter(code=len(code), imports=len(imports & code), all=len(offered & code))


def _span(node: ast.stmt) -> set[int]:
    return set(range(node.lineno, (node.end_lineno or node.lineno) + 1))


def find_constants(module: Module) -> list[tuple[str, int, str]]:
    """Find the numbers with a name at the level of a module: name, line, kind of source.

    The kind is that of its row in a table of thresholds, or the first word of the comment above or beside it; else
    ``comment`` where there is any, else ``none``. Constants in adjacent lines share the comment above the first.
    """
    found = []
    before: ast.stmt | None = None
    source = "none"
    for node in module.tree.body:
        if not isinstance(node, ast.Assign | ast.AnnAssign):
            continue
        follows = before is not None and before.end_lineno == node.lineno - 1
        said = _kind_of_comment(module.lines, node)
        source = said if said != "none" or not follows else source
        before = node
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        names = [name.id for t in targets for name in ast.walk(t) if isinstance(name, ast.Name)]
        kind = _kind_of_row(node.value)
        if kind is None and not _is_number(node.value):
            continue
        found += [(name, node.lineno, kind or source) for name in names if CONSTANT.fullmatch(name)]
    return found


def _kind_of_comment(lines: list[str], node: ast.stmt) -> str:
    """The kind of source that the comment above a statement or beside it begins with."""
    first = node.lineno
    while first > 1 and lines[first - 2].lstrip().startswith("#"):
        first -= 1
    above = " ".join(line.strip() for line in lines[first - 1 : node.lineno - 1])
    beside = " ".join(
        line[line.index("#") :]
        for line in (lines[number - 1] for number in sorted(_span(node)))
        if "#" in line
    )
    texts = [text for text in (above, beside) if text]
    kinds = [found[1].lower() for text in texts if (found := KIND_OF_COMMENT.match(text))]
    return kinds[0] if kinds else "comment" if texts else "none"


def _kind_of_row(value: ast.expr | None) -> str | None:
    """``stated`` of ``TABLE.stated("NAME", 3.0, "px", "why")``; None for any other expression."""
    if not (isinstance(value, ast.Call) and isinstance(value.func, ast.Attribute)):
        return None
    table, kind = ast.unparse(value.func.value), value.func.attr
    return kind if table == "TABLE" and kind in KINDS else None


def _is_number(value: ast.expr | None) -> bool:
    """Whether an expression is of numbers: ``-2.0``, ``(0.5, 1 / 3)``, ``np.linspace(0.0, 1.0, 5)``, ``{"x": 1}``."""
    if isinstance(value, ast.Constant):
        return type(value.value) in (int, float)
    if isinstance(value, ast.Tuple | ast.List):
        return bool(value.elts) and all(map(_is_number, value.elts))
    if isinstance(value, ast.Dict):
        return bool(value.values) and all(map(_is_number, value.values))
    if isinstance(value, ast.BinOp):
        return _is_number(value.left) and _is_number(value.right)
    if isinstance(value, ast.UnaryOp):
        return _is_number(value.operand)
    if isinstance(value, ast.Attribute):
        return ast.unparse(value) in ("np.pi", "math.pi")
    return (
        isinstance(value, ast.Call)
        and NUMERIC.fullmatch(ast.unparse(value.func)) is not None
        and bool(value.args)
        and all(map(_is_number, value.args))
    )


def find_importers(modules: list[Module]) -> dict[str, set[str]]:
    """Find which modules import each module; a package itself is left out."""
    names = {module.name for module in modules}
    found = defaultdict[str, set[str]](set)
    for module in modules:
        for node in ast.walk(module.tree):
            if isinstance(node, ast.Import):
                wanted = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                wanted = [str(node.module), *(f"{node.module}.{a.name}" for a in node.names)]
            else:
                continue
            for name in wanted:
                if name in names and name != module.name:
                    found[name].add(module.name)
    return found


def find_parameter_counts(modules: list[Module]) -> list[tuple[int, str]]:
    """Count the parameters of every function, ``self`` and ``cls`` aside; the longest list first."""
    found = []
    for module in modules:
        for node in ast.walk(module.tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                given = node.args
                names = [a.arg for a in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
                count = len([name for name in names if name not in ("self", "cls")])
                found.append((count, f"{module.path}:{node.lineno} {node.name}"))
    return sorted(found, key=lambda item: (-item[0], item[1]))


def _is_dataclass(node: ast.AST) -> bool:
    return isinstance(node, ast.ClassDef) and any(
        ast.unparse(decorator).partition("(")[0].endswith("dataclass")
        for decorator in node.decorator_list
    )


def read_commit(commit: str, room: str = "") -> list[Module]:
    """Read the modules of a commit, or of one room.

    Raises
    ------
    subprocess.CalledProcessError
        Git does not know the commit; it says so on standard error.
    """
    done = subprocess.run(
        ["git", "archive", commit, PACKAGE], cwd=ROOT, check=True, stdout=subprocess.PIPE
    )
    with tempfile.TemporaryDirectory() as folder:
        with tarfile.open(fileobj=io.BytesIO(done.stdout)) as archive:
            archive.extractall(folder, filter="data")
        return read_modules(Path(folder), room)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--against", metavar="COMMIT", help="the commit of the first column")
    parser.add_argument("--list", action="store_true", help="name what is counted")
    options = parser.parse_args(arguments)
    columns = {}
    if options.against:
        columns[options.against[:9]] = count_all(read_commit(options.against))
    now = columns["now"] = count_all(read_modules(ROOT))
    rows = dict.fromkeys(row for report in columns.values() for row in report.figures)
    width = max(map(len, rows))
    print(" " * width, *(f"{name:>9}" for name in columns))
    for row in rows:
        print(f"{row:{width}}", *(f"{r.figures.get(row, 0):9}" for r in columns.values()))
    print("\nLongest lists of parameters:", *now.longest, sep="\n  ")
    if options.list:
        print("\nModules with one importer:", *now.one_importer, sep="\n  ")
        print("\nConstants without a source:", *now.without_source, sep="\n  ")
    return 0


if __name__ == "__main__":
    sys.exit(main())
