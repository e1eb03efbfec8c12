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

"""The listings of a page, and notebooks: run as a reader would, and their output beside what is shown.

A listing is indented by four columns. A command begins with ``$ `` and may go on after a backslash; the lines up to the
next command are its output. ``...`` stands for any lines. A command that shows no output may print anything.
"""

from __future__ import annotations

import io
import os
import re
import shlex
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from semcal_ros.cli.main import main
from tests.helpers.project import ROOT, load_script

_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


@dataclass(frozen=True)
class Listed:
    """One command of a page, and the output that the page shows."""

    command: str
    output: tuple[str, ...]


def listings(page: Path) -> list[Listed]:
    """All commands of a page, in order."""
    found: list[tuple[str, list[str]]] = []
    continues = inside = False
    for line in page.read_text(encoding="utf-8").splitlines():
        if not line.startswith("    "):
            inside = inside and not line.strip()
            continue
        text = line[4:].rstrip()
        if continues:
            found[-1] = (f"{found[-1][0]} {text.strip()}", [])
        elif text.startswith("$ "):
            found.append((text[2:], []))
            inside = True
        elif inside:
            found[-1][1].append(text)
        continues = inside and found[-1][0].endswith("\\")
        if continues:
            found[-1] = (found[-1][0].removesuffix("\\").rstrip(), [])
    return [Listed(command, tuple(output)) for command, output in found]


def _same(shown: str, printed: str, tolerance: float) -> bool:
    """Whether two lines are the same but for their numbers, which agree within a relative tolerance."""
    if " ".join(_NUMBER.sub("#", shown).split()) != " ".join(_NUMBER.sub("#", printed).split()):
        return False
    pairs = zip(_NUMBER.findall(shown), _NUMBER.findall(printed), strict=True)
    # A last digit more or less is rounding.
    return all(
        abs(float(a) - float(b)) <= max(tolerance * abs(float(a)), 1.01 * _last_digit(a))
        for a, b in pairs
    )


def _last_digit(number: str) -> float:
    mantissa, _, exponent = number.partition("e")
    decimals = len(mantissa.partition(".")[2])
    return float(10.0 ** (int(exponent or 0) - decimals))


def differences(shown: tuple[str, ...], printed: list[str], tolerance: float) -> list[str]:
    """Lines that the page shows and the command did not print there."""
    missing, at, anywhere = [], 0, False
    for line in shown:
        if line.strip() == "...":
            anywhere = True
            continue
        places = range(at, len(printed)) if anywhere else range(at, min(at + 1, len(printed)))
        place = next((k for k in places if _same(line, printed[k], tolerance)), None)
        if place is None:
            missing.append(line)
        else:
            at, anywhere = place + 1, False
    return missing


def run_listing(listed: Listed, folder: Path, tolerance: float) -> None:
    """Run a command in a folder; its output must be that of the page, and its status 0, or 2 if that is an error.

    Raises
    ------
    AssertionError
        It fails, or prints something else.
    """
    words = shlex.split(listed.command)
    status, text = (_run_here if words[0] == "semcal" else _run_process)(words, folder)
    printed = [line.rstrip() for line in text.splitlines() if line.strip()]
    wanted = 2 if listed.output[:1] and listed.output[0].startswith("semcal: ") else 0
    assert status == wanted, (listed.command, printed)
    missing = differences(tuple(line for line in listed.output if line), printed, tolerance)
    assert not missing, (listed.command, missing, printed)


def _run_here(words: list[str], folder: Path) -> tuple[int, str]:
    """Status and output of ``semcal``, in this process: the imports of each command take a second of processor."""
    out, err, before = io.StringIO(), io.StringIO(), Path.cwd()
    os.chdir(folder)
    try:
        with redirect_stdout(out), redirect_stderr(err):
            status = main(words[1:])
    finally:
        os.chdir(before)
    return status, out.getvalue() + err.getvalue()


def _run_process(words: list[str], folder: Path) -> tuple[int, str]:
    done = subprocess.run(
        [sys.executable if words[0] == "python" else words[0], *words[1:]],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=170.0,
        check=False,
    )
    return done.returncode, done.stdout + done.stderr


def run_page(page: Path, folder: Path, tolerance: float, but: tuple[str, ...] = ()) -> int:
    """Run all commands of a page in order, but those that begin with one of ``but``; return how many ran."""
    count = 0
    for listed in listings(page):
        if not listed.command.startswith(but or ("\0",)):
            run_listing(listed, folder, tolerance)
            count += 1
    return count


def follow_notebook(path: Path, folder: Path, tolerance: float, but: str = "") -> int:
    """Run a notebook in a folder, but for cells that begin with ``but``; return how many lines and pictures agree.

    Raises
    ------
    AssertionError
        A cell fails, prints or draws something else.
    """
    # `colcon test` has no IPython.
    pytest.importorskip("IPython")
    module = load_script("run_notebooks")
    kept = module.read_notebook(path)
    done = module.run_notebook(path, folder, but)
    compared = 0
    for before, now in zip(kept["cells"], done["cells"], strict=True):
        if before["cell_type"] != "code":
            continue
        printed = _printed(now)
        assert differences(tuple(_printed(before)), printed, tolerance) == [], printed
        assert _kinds(before) == _kinds(now)
        compared += len(printed) + len(_kinds(now))
    return compared


def _printed(cell: dict[str, Any]) -> list[str]:
    texts = "".join("".join(o["text"]) for o in cell["outputs"] if o["output_type"] == "stream")
    return [line.rstrip() for line in texts.splitlines() if line.strip()]


def _kinds(cell: dict[str, Any]) -> list[list[str]]:
    """Of each picture or table of a cell, as what it can be shown."""
    return [sorted(output["data"]) for output in cell["outputs"] if "data" in output]
