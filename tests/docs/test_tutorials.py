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

"""The tutorials: their commands print what they show; their sentences are short; the site builds without a warning."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.listings import differences, listings, run_page
from tests.helpers.project import NODES, ROOT, load_script

DOC = ROOT / "doc"
TUTORIALS = sorted((DOC / "tutorials").glob("*.md"))
NOTEBOOKS = sorted((DOC / "tutorials").glob("*.ipynb"))
HOWTO = sorted((DOC / "howto").glob("*.md"))
# Another processor rounds differently, and a fit amplifies that; what a reader sees is the same.
TOLERANCE = 0.05


@pytest.mark.slow
@pytest.mark.long
def test_the_first_calibration_prints_what_the_page_shows(tmp_path: Path) -> None:
    assert run_page(DOC / "tutorials" / "first_calibration.md", tmp_path, TOLERANCE) == 11
    # Goes on in the same folder.
    assert run_page(DOC / "howto" / "views.md", tmp_path, TOLERANCE) == 7


# What of doc/cli.md is not run here, and why.
NOT_RUN = {
    "semcal drift 'scan_": "pictures of the reader's own",
    "semcal calibrate grid -o pda.yaml": "the last digits of unstable equations depend on the processor",
    "semcal import-calibration": "a table of the reader's own; tests/cli/test_compare_export_import.py",
    "ros2 run": "does not end",
    "semcal acquire": "a live microscope; tests/nodes/test_acquisition.py",
    "semcal reconstruct": "recordings of the example nano_ball, and pictures of the reader's own",
    "semcal rectify tiffs": "pictures of the reader's own; the first tutorial has its own",
    "semcal play": "lasts as long as the recording; tests/nodes/test_bag_player.py",
    "semcal demo": "does not end; tests/nodes/test_demo.py",
    "semcal view": "does not end; tests/nodes/test_viewer.py",
    "semcal measure cantilever": "the recording of the example cantilever; the tutorial has its own",
    "semcal doctor": "a live system; tests/nodes/test_doctor.py",
    "semcal import tiffs": "pictures of the reader's own",
}


@pytest.mark.slow
@pytest.mark.long
def test_the_page_of_all_commands_prints_what_it_shows(tmp_path: Path) -> None:
    page = DOC / "cli.md"
    commands = [listed.command for listed in listings(page)]
    unused = [start for start in NOT_RUN if not any(c.startswith(start) for c in commands)]
    assert unused == []
    assert run_page(page, tmp_path, TOLERANCE, but=tuple(NOT_RUN)) == 24


def test_a_listing_is_read_and_compared_line_by_line(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "Text.\n\n    $ one --a \\\n        --b\n    size 10.0 nm\n    ...\n    end\n    $ two\n\nText.\n"
    )
    first, second = listings(page)
    assert (first.command, first.output) == ("one --a --b", ("size 10.0 nm", "...", "end"))
    assert (second.command, second.output) == ("two", ())
    assert differences(first.output, ["size 10.2 nm", "x", "end"], 0.05) == []
    assert differences(first.output, ["size 11.2 nm", "x", "end"], 0.05) == ["size 10.0 nm"]
    assert differences(first.output, ["size 10.0 um", "end"], 0.05) == ["size 10.0 nm"]
    assert differences(first.output, ["size 10.0 nm", "x"], 0.05) == ["end"]
    # Without an ellipsis nothing may come between.
    assert differences(("a", "b"), ["a", "x", "b"], 0.05) == ["b"]


def _prose(page: Path) -> str:
    """The text of a page or a notebook, without listings, tables, headings, pictures and targets of links."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        text = "\n\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
    text = re.sub(r"^(    .*|\|.*|#.*|!\[.*)$", "", text, flags=re.MULTILINE)
    return re.sub(r"\]\([^)]*\)", "]", text)


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", *TUTORIALS, *NOTEBOOKS, *HOWTO], ids=lambda path: path.stem
)
def test_no_sentence_is_longer_than_thirty_words(page: Path) -> None:
    sentences = re.split(r"(?<=[.!?:;])\s+|\n\n|\n- ", _prose(page))
    assert [s for s in sentences if len(s.split()) > 30] == []


@pytest.mark.slow
@pytest.mark.long
def test_the_site_builds_without_a_warning() -> None:
    """Links, anchors and the navigation are checked by MkDocs, the generated pages among them."""
    script = ROOT / "scripts" / "build_docs.py"
    done = subprocess.run(
        [sys.executable, str(script)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=170,
    )
    if done.returncode == 3:
        pytest.skip("MkDocs cannot be installed here")
    assert done.returncode == 0, done.stdout + done.stderr
    messages = (ROOT / "site" / "reference" / "messages.html").read_text(encoding="utf-8")
    for text in (
        "no range of magnifications",  # an error
        "uses the configuration …, this command …",  # a finding of the doctor
        "check beam blank, shutter and detector",  # a condition of a node
        "has said nothing for … s",  # of the page in the browser
        "to improve it most: views of the … um squares",  # of a command
        "the views do not determine the",  # a warning of a calibration
        "too little overlap",  # a rejection
    ):
        assert text in messages, text
    commands = (ROOT / "site" / "reference" / "commands.html").read_text(encoding="utf-8")
    assert "semcal acquire" in commands and "--by-hand" in commands
    parameters = (ROOT / "site" / "reference" / "parameters.html").read_text(encoding="utf-8")
    for node in NODES:
        section = parameters.partition(f'id="{node}"')[2].partition("<h2")[0]
        assert "a number from 0.05 to 60 (s)" in section, f"diagnostics_period of {node}"
    api = (ROOT / "site" / "reference" / "api.html").read_text(encoding="utf-8")
    for name in ("Calibration", "ScanCamera", "calibrate", "track_drift"):
        assert f">{name}</span>" in api
    assert ":class:" not in api and "<p>::</p>" not in api
    # Nothing is fetched from elsewhere when it is read.
    fetched = re.compile(
        r"""<(?:script|img|iframe|link rel="(?:stylesheet|preconnect|icon)")[^>]*["']https?://"""
    )
    pages = sorted((ROOT / "site").rglob("*.html"))
    assert len(pages) > 30
    assert [p.name for p in pages if fetched.search(p.read_text(encoding="utf-8"))] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("link", "good"),
    [
        ("index.md#a-heading", True),
        ("index.md#no-heading", False),
        ("no_page.md", False),
        ("/index.md", False),
    ],
)
@pytest.mark.long
def test_a_link_that_leads_nowhere_fails_the_build(tmp_path: Path, link: str, good: bool) -> None:
    """By the settings of mkdocs.yml, on one page."""
    script = load_script("build_docs")
    if not script.install():
        pytest.skip("MkDocs cannot be installed here")
    (tmp_path / "pages").mkdir()
    (tmp_path / "pages" / "index.md").write_text(f"# A page\n\n## A heading\n\n[x]({link})\n")
    configuration = tmp_path / "mkdocs.yml"
    configuration.write_text(
        f"INHERIT: {ROOT / 'mkdocs.yml'}\ndocs_dir: pages\nnav: [index.md]\nplugins: []\n"
    )
    assert script.build(configuration) == good
