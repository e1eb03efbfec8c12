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

"""A notebook of the tutorials, run as a reader would, and its outputs beside those that it keeps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.helpers.listings import differences
from tests.helpers.project import load_script


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
