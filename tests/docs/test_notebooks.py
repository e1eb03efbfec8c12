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

"""The notebooks of the tutorials run, and print and draw what they keep."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers.listings import follow_notebook
from tests.helpers.project import ROOT

FOLDER = ROOT / "doc" / "tutorials"
# As for the listings of the pages.
TOLERANCE = 0.05


@pytest.mark.slow
@pytest.mark.long
def test_the_calibration_notebook_prints_and_draws_what_it_keeps(tmp_path: Path) -> None:
    assert follow_notebook(FOLDER / "calibration_notebook.ipynb", tmp_path, TOLERANCE) == 16
    # The other one is followed where its recording is made: test_cantilever of tests/examples.
    assert {path.stem for path in FOLDER.glob("*.ipynb")} == {
        "calibration_notebook",
        "cantilever_notebook",
    }
