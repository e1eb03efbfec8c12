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

"""Starting up is quick: a command imports only what it uses."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.node_scenes import make_calibration

SLOW = ("scipy", "cv2", "matplotlib", "pydantic", "tqdm", "rosbags", "rclpy", "joblib")
CODE = """
import sys
from semcal_ros.cli import main
status = main(sys.argv[1:])
print("loaded", *sorted({name.partition(".")[0] for name in sys.modules}))
sys.exit(status)
"""


@pytest.mark.parametrize(
    ("arguments", "never"),
    [(("--help",), (*SLOW, "numpy", "yaml", "jsonschema")), (("at", "cal.yaml", "1000"), SLOW)],
)
def test_a_command_imports_only_what_it_uses(
    tmp_path: Path, arguments: tuple[str, ...], never: tuple[str, ...]
) -> None:
    make_calibration().save(tmp_path / "cal.yaml")
    done = subprocess.run(
        [sys.executable, "-c", CODE, *arguments],
        cwd=tmp_path,
        env={"PYTHONPATH": str(Path(__file__).resolve().parents[2])},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    loaded = done.stdout.rpartition("loaded ")[2].split()
    assert "semcal_ros" in loaded
    assert set(loaded) & set(never) == set()
