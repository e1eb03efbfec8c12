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

"""Builds the documentation site: the pages of doc/ and the reference that is generated from the code.

``make docs`` runs it. The site needs no network, neither to be read nor, once MkDocs is installed, to be built. A
warning, such as a link or an anchor that leads nowhere, is an error. MkDocs lives in an environment of its own
(.venv-docs), so that its dependencies are nobody else's.

Exit status: 0; 1 if the build fails; 3 if MkDocs cannot be installed.
"""

from __future__ import annotations

import ast
import base64
import dataclasses
import fcntl
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import click

from semcal_ros import _HOMES  # the public names, with the modules that define them
from semcal_ros.cli.main import _COMMANDS  # no public name lists them with their summaries
from semcal_ros.nodes.common.base import node_class
from semcal_ros.nodes.common.command_line import EXECUTABLES, HelpWanted, starting_with
from semcal_ros.nodes.common.parameters import DIRECTORY, ParameterDeclaration
from semcal_ros.workflows.options import OptionField, option_fields

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "semcal_ros"
REQUIREMENTS = ROOT / "requirements" / "docs.txt"
ENVIRONMENT = ROOT / ".venv-docs"
PAGES = ROOT / "build" / "docs"
SITE = ROOT / "site"
CANNOT_INSTALL = 3
_WORD = re.compile(r"[a-z]{3}")
# Three words at least, and nothing that only code has.
_SENTENCE = re.compile(r"(?=(?:.*?\b[a-z]{2,}\b){2})[^<>{}\\=_$|]*\s[^<>{}\\=_$|]*\s[^<>{}\\=_$|]*")
_FINDINGS = ("ok", "note", "problem")
# Their texts are in the other generated pages, or are none.
_NOT_SHOWN = (
    *(
        "option",
        "argument",
        "command",
        "group",
        "Option",
        "Keyword",
        "Argument",
        "ParameterDeclaration",
    ),
    *("add_argument", "compile", "Executable", "Field", "deprecated", "warn_deprecated"),
)
# Who says what is not an error, by the rooms of the package.
SAID_BY = {
    "What nodes say: log, diagnostics, answers of services": ("nodes", "middleware", "drivers"),
    "What the page in the browser says": ("viewer",),
    "Notes and warnings of commands and calibrations; why something was not used": (
        *("applications", "bridge", "calibration.py", "cli", "config", "core", "files"),
        *("synthetic", "workflows"),
    ),
}
_TYPES = {bool: "bool", int: "integer", float: "double", str: "string"}
# Files beside doc/ that its pages link to.
BESIDE = ("README.md", "CONTRIBUTING.md", "SECURITY.md")


def commands_page() -> str:
    """Every command with its help, as `--help` prints it."""
    parts = ["# Commands", "", "Generated from the code: what `semcal COMMAND --help` prints.", ""]
    for name in sorted(_COMMANDS):
        module = import_module(f"semcal_ros.cli.{name.replace('-', '_')}_command")
        parts += _help(module.command, f"semcal {name}", 2)
    return "\n".join(parts)


def _help(command: click.Command, name: str, level: int) -> list[str]:
    context = click.Context(command, info_name=name, max_content_width=100, terminal_width=100)
    parts = [f"{'#' * level} {name}", "", "```text", command.get_help(context), "```", ""]
    if isinstance(command, click.Group):
        for own in command.list_commands(context):
            found = command.get_command(context, own)
            assert found is not None
            parts += _help(found, f"{name} {own}", level + 1)
    return parts


def parameters_page() -> str:
    """The parameters of every node, as they are declared."""
    parts = [
        "# Parameters",
        "",
        "Generated from the code. What they mean together: [Nodes](../nodes.md).",
        "",
    ]
    for name in sorted(EXECUTABLES):
        parts += [f"## {name}", "", EXECUTABLES[name].purpose, ""]
        parts += ["| parameter | type | default | accepted | read | |", "|---|---|---|---|---|---|"]
        for declared in sorted(_declarations(name), key=lambda d: d.name):
            default = declared.default
            if isinstance(default, bool):
                shown = str(default).lower()
            else:
                shown = f"{default:g}" if isinstance(default, float) else str(default)
            cells = (
                f"`{declared.name}`",
                _TYPES[type(default)],
                f"`{shown}`" if shown else "empty",
                _cell(declared.expected),
                "at start" if declared.fixed else "any time",
                _cell(declared.description),
            )
            parts.append(f"| {' | '.join(cells)} |")
        parts.append("")
    return "\n".join(parts)


def _declarations(name: str) -> list[ParameterDeclaration]:
    """As `--help` of the executable shows them: the last declaration of a name counts."""
    try:
        with starting_with(["--help"]):
            node_class(name)()
    except HelpWanted as wanted:
        found = {declared.name: declared for declared in wanted.declarations}
        if any(declared.confined for declared in found.values()):
            found.setdefault(DIRECTORY.name, DIRECTORY)
        return list(found.values())
    raise AssertionError(f"{name} does not ask for help")


def _cell(text: str) -> str:
    """A text for a cell of a table, where nothing but code is formatted."""
    parts = re.split(r"(`[^`]*`)", text.replace("|", "\\|"))
    parts[::2] = [re.sub(r"([*_\[\]<>])", r"\\\1", part) for part in parts[::2]]
    return " ".join("".join(parts).split())


def api_page() -> str:
    """The public names of the package; mkdocstrings puts their docstrings there."""
    parts = ["# Python functions", ""]
    parts += ["Generated from the docstrings. With examples: [From Python](../python.md).", ""]
    for name, home in _HOMES.items():
        parts += [f"::: {home}.{name}", ""]
        # Which the source of the function does not show.
        options = getattr(getattr(import_module(home), name), "options", None)
        if options is not None:
            parts += ["| keyword | default | |", "|---|---|---|"]
            parts += [_keyword_row(field) for field in option_fields(options)]
            parts.append("")
    return "\n".join(parts)


def _keyword_row(field: OptionField) -> str:
    default = "" if field.default is dataclasses.MISSING else f"`{field.default!r}`"
    if callable(field.default):
        default = ""
    return f"| `{field.name}` | {_cell(default)} | {_cell(field.meaning.in_python.replace('``', '`'))} |"


def without_sphinx(html: str) -> str:
    """Take marks that docstrings have for Sphinx out of a page that is made of them."""
    html = re.sub(r"<p>::</p>\s*", "", html).replace("::</p>", ":</p>")
    return re.sub(r":(?:attr|class|data|func|meth|mod):(<code>)~?", r"\1", html)


def messages_page() -> str:
    """Every message that the source can show, so that a search finds it."""
    errors: dict[str, tuple[str, str]] = {}
    findings: dict[str, tuple[str, str]] = {}
    others: dict[str, set[str]] = {title: set() for title in SAID_BY}
    for path in sorted(PACKAGE.rglob("*.py")):
        room = path.relative_to(PACKAGE).parts[0]
        titles = (title for title, rooms in SAID_BY.items() if room in rooms)
        said = others.get(next(titles, ""), set())
        for node in _shown_nodes(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call):
                said.add(_text_of(node).replace("(.*)", "…"))
                continue
            words = {k.arg: _text_of(k.value) for k in node.keywords}
            finds = room == "doctor" and _name_of(node.func) in _FINDINGS
            text = _text_of(node.args[1 if finds else 0])
            if _WORD.search(text):
                table = findings if finds else errors
                table.setdefault(text, (words.get("expected", ""), words.get("do", "")))
    parts = ["# Messages", ""]
    parts += [
        "Generated from the source. An ellipsis is a value.",
        "By symptom: [Troubleshooting](../howto/troubleshooting.md).",
        "",
        "## Errors",
        "",
        "What went wrong, what was expected, and what to do.",
        "",
    ]
    parts += _message_table(errors)
    parts += ["## What `semcal doctor` finds", "", *_message_table(findings)]
    for title, texts in others.items():
        parts += [f"## {title}", "", "| message |", "|---|"]
        parts += [f"| {_cell(text)} |" for text in sorted(texts - errors.keys(), key=_order)]
        parts.append("")
    return "\n".join(parts)


def _message_table(found: dict[str, tuple[str, str]]) -> list[str]:
    rows = [
        f"| {' | '.join(map(_cell, (text, *found[text])))} |" for text in sorted(found, key=_order)
    ]
    return ["| message | expected | what to do |", "|---|---|---|", *rows, ""]


def _shown_nodes(tree: ast.AST) -> Iterator[ast.Call | ast.expr]:
    """Calls that make errors or findings, and other texts of several words that somebody may be shown."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Call):
            name = _name_of(node.func)
            if name in _NOT_SHOWN:
                continue
            if node.args and (name.endswith("Error") or (name in _FINDINGS and len(node.args) > 1)):
                yield node
                continue
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            continue  # a docstring
        if isinstance(node, ast.keyword) and node.arg in ("help", "short_help", "description"):
            continue
        if isinstance(node, ast.Constant | ast.JoinedStr | ast.BinOp):
            text = _text_of(node)
            if _SENTENCE.fullmatch(text) and "'self'" not in text:
                yield node
            if text != "…":
                continue
        yield from _shown_nodes(node)


def _order(text: str) -> str:
    return text.lstrip("… ").lower()


def _name_of(node: ast.expr) -> str:
    return node.id if isinstance(node, ast.Name) else getattr(node, "attr", "")


def _text_of(node: ast.expr) -> str:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return " ".join(node.value.split())
    if isinstance(node, ast.JoinedStr):
        parts = [p.value if isinstance(p, ast.Constant) else "…" for p in node.values]
        return " ".join("".join(str(part) for part in parts).split())
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.Add):
        return f"{_text_of(node.left)}{_text_of(node.right)}"
    if isinstance(node, ast.IfExp):
        return f"{_text_of(node.body)} / {_text_of(node.orelse)}"
    return "…"


GENERATED = {
    "reference/commands.md": commands_page,
    "reference/parameters.md": parameters_page,
    "reference/api.md": api_page,
    "reference/messages.md": messages_page,
}


def collect(target: Path) -> None:
    """Lay out everything that the site is made of."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(ROOT / "doc", target)
    convert_notebooks(sorted(target.rglob("*.ipynb")))
    for name in BESIDE:
        text = (ROOT / name).read_text(encoding="utf-8")
        # Links of the root lead into doc/; what is not on the site is named only.
        text = re.sub(r"\]\(doc/", "](../", text)
        text = re.sub(r"!?\[([^\]]*)\]\((?!\.\./|https?:|#)[^)]*\)", r"\1", text)
        (target / "project").mkdir(exist_ok=True)
        (target / "project" / name.lower()).write_text(text, encoding="utf-8")
    for path in target.rglob("*.md"):
        if path.parent.name == "project":
            continue
        text = path.read_text(encoding="utf-8")
        up = "../" * len(path.relative_to(target).parents[:-1])
        for name in BESIDE:
            text = re.sub(rf"\]\((?:\.\./)+{name}", f"]({up}project/{name.lower()}", text)
        text = re.sub(r"(\]\([^)\s]*)\.ipynb\)", r"\1.md)", text)
        path.write_text(text, encoding="utf-8")
    for name, make in GENERATED.items():
        (target / name).parent.mkdir(exist_ok=True)
        (target / name).write_text(make(), encoding="utf-8")


def convert_notebooks(paths: list[Path]) -> None:
    """Put a page with the outputs that a notebook keeps in place of each notebook.

    nbconvert makes the same pages, with 24 more packages.
    """
    for path in paths:
        parts: list[str] = []
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            source = "".join(cell["source"])
            if cell["cell_type"] == "markdown":
                parts.append(source)
                continue
            parts.append(f"```python\n{source}\n```")
            for output in cell["outputs"]:
                picture = path.with_name(f"{path.stem}_{len(parts)}.png")
                parts.append(_shown(output, picture))
        path.with_suffix(".md").write_text("\n\n".join([*parts, ""]), encoding="utf-8")
        path.unlink()


def _shown(output: dict[str, Any], picture: Path) -> str:
    """What a cell printed or drew; a picture goes into a file."""
    data = output.get("data", {})
    if "image/png" in data:
        picture.write_bytes(base64.b64decode("".join(data["image/png"])))
        return f"![]({picture.name})"
    if "text/html" in data:
        return "".join(data["text/html"])
    text = "".join(output.get("text", data.get("text/plain", "")))
    return f"```text\n{text.rstrip()}\n```"


def install() -> bool:
    """Make the environment of MkDocs, unless it is there; return whether it is."""
    with open(ROOT / ".venv.lock", "w", encoding="ascii") as lock:
        # Tests in several processes want it at once; it is the lock of make setup.
        fcntl.flock(lock, fcntl.LOCK_EX)
        return _install()


def _install() -> bool:
    digest = hashlib.sha256(REQUIREMENTS.read_bytes()).hexdigest()
    mark = ENVIRONMENT / "requirements.sha256"
    if mark.is_file() and mark.read_text() == digest:
        return True
    shutil.rmtree(ENVIRONMENT, ignore_errors=True)
    commands = (
        [sys.executable, "-m", "venv", str(ENVIRONMENT)],
        [
            *(str(ENVIRONMENT / "bin" / "pip"), "install", "--quiet", "--no-input"),
            *("--disable-pip-version-check", "--no-deps", "-r", str(REQUIREMENTS)),
        ],
    )
    for command in commands:
        if subprocess.run(command, check=False).returncode:
            return False
    mark.write_text(digest)
    return True


def build(configuration: Path) -> bool:
    """Build the site that a configuration describes; print its warnings, and return whether there were none."""
    done = subprocess.run(
        # Not --quiet: MkDocs then drops the warnings before --strict counts them.
        [str(ENVIRONMENT / "bin" / "mkdocs"), "build", "--strict", "-f", str(configuration)],
        cwd=configuration.parent,
        # A notice about the next version of MkDocs is no warning about these pages.
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    for line in done.stderr.splitlines():
        if line.strip() and not line.startswith("INFO"):
            print(line, file=sys.stderr)
    return done.returncode == 0


def main() -> int:
    """Build the site into site/."""
    if not install():
        print("docs: MkDocs could not be installed", file=sys.stderr)
        return CANNOT_INSTALL
    collect(PAGES)
    if not build(ROOT / "mkdocs.yml"):
        return 1
    api = SITE / "reference" / "api.html"
    api.write_text(without_sphinx(api.read_text(encoding="utf-8")), encoding="utf-8")
    print(f"{SITE / 'index.html'}")
    print("The search needs a server: python3 -m http.server -d site")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
