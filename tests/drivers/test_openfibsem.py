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

"""Faults of a microscope behind OpenFIBSEM, with its DemoMicroscope in a process of its own."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

from semcal_ros.core.errors import ConfigError
from semcal_ros.drivers.openfibsem import require_fibsem

REPOSITORY = Path(__file__).resolve().parents[2]
FAULTS = """
import time
import pytest
from semcal_ros.core.errors import MicroscopeError
from semcal_ros.drivers.openfibsem import OpenFibsemSource

def read(source):
    until_s = time.monotonic() + 20.0
    while time.monotonic() < until_s:
        if (frame := source.read(0.2)) is not None:
            return frame
    raise AssertionError("no frame")

source = OpenFibsemSource("Demo", "localhost")
shifted = []
assert "DemoMicroscope" in source.open()
microscope = source._microscope
frame = read(source)
assert frame.image.shape == (1024, 1536)
assert frame.field_width_m == pytest.approx(150e-6)
assert frame.start_ns <= time.time_ns()

# The stage says that it has moved, and has not.
microscope.move_stage_absolute = lambda position: position
with pytest.raises(MicroscopeError, match="tilt at 0 rad after a move to 0.1"):
    source.move_stage({"tilt": 0.1})
# The magnification stays where it is.
microscope.set_field_of_view = lambda width_m, beam: 150e-6
with pytest.raises(MicroscopeError, match="a field width of 0.00015 m"):
    source.set_field_width(50e-6)
# A whole turn is no distance.
microscope.get_scan_rotation = lambda beam: 6.283185307179586
source.move_stage({"scan_rotation": 0.0})

# The thread of fibsem logs an error and ends.
def fail(*args, **kwargs):
    raise OSError("the server is gone")
microscope.acquire_image = fail
with pytest.raises(MicroscopeError, match="has stopped to scan"):
    for _ in range(100):
        source.read(0.2)
source.close()
source.close()
with pytest.raises(MicroscopeError, match="no connection"):
    source.stage_position()

# It comes back.
source.open()
read(source)
source.close()

# Connecting leaves the beam where it is.
from fibsem.microscopes.simulator import DemoMicroscope
DemoMicroscope.reset_beam_shifts = lambda self: shifted.append(self)
source.open()
source.close()
assert shifted == []

with pytest.raises(MicroscopeError, match="expected one of Demo"):
    OpenFibsemSource("Abacus").open()
print("passed")
"""


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("fibsem") is None, reason="needs fibsem (requirements/microscope.txt)"
)
@pytest.mark.long
def test_faults_of_a_microscope() -> None:
    paths = [str(REPOSITORY), os.environ.get("PYTHONPATH", "")]
    done = subprocess.run(
        [sys.executable, "-c", FAULTS],
        # The simulator need not pretend to take time.
        env={
            **os.environ,
            "FIBSEM_SIM_NO_DELAY": "1",
            "PYTHONPATH": os.pathsep.join(filter(None, paths)),
        },
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip().endswith("passed")


def test_without_fibsem_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match="pip install fibsem"):
        require_fibsem()
