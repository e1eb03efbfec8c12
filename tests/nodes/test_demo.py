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

"""``semcal demo`` as a user starts it: a corrected picture comes, and Ctrl-C ends all of it."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import uuid
from pathlib import Path

import pytest

from tests.helpers.live_page import corrected_view
from tests.helpers.project import ROOT

pytestmark = pytest.mark.slow


def _nodes(mark: str) -> set[str]:
    """Processes that have the calibration of a demo, all but the microscope, and ``mark`` in their environment."""
    found = set()
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            command = (entry / "cmdline").read_bytes().decode().split("\0")
            is_own = mark.encode() in (entry / "environ").read_bytes()
        except (OSError, UnicodeDecodeError):
            continue
        if is_own and any(
            part.startswith("config:=virtual_sem") or "semcal-demo-" in part for part in command
        ):
            found.add(entry.name)
    return found


@pytest.mark.long
def test_one_command_shows_the_corrected_stream_and_ends_with_ctrl_c() -> None:
    # Another test may show a demo at the same time.
    mark = str(uuid.uuid4())
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1", "OF_TEST": mark}
    with subprocess.Popen(
        [sys.executable, "-m", "semcal_ros", "demo", "--port", "0", "--size", "128"],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
        env=environment,
    ) as demo:
        assert demo.stdout is not None
        found = None
        while found is None:
            line = demo.stdout.readline()
            assert line
            found = re.search(r"open (http://\S+/)", line)
        try:
            corrected_view(found[1])
            assert len(_nodes(mark)) == 2
        finally:
            demo.send_signal(signal.SIGINT)
            demo.wait(60)
    assert demo.returncode == 0
    assert not _nodes(mark)


def test_a_port_that_is_taken_is_refused_in_one_line() -> None:
    with socket.create_server(("localhost", 0)) as taken:
        port = taken.getsockname()[1]
        done = subprocess.run(
            [sys.executable, "-m", "semcal_ros", "demo", "--port", str(port), "--size", "64"],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            timeout=120,
            check=False,
        )
    assert done.returncode == 2
    assert str(port) in done.stderr.splitlines()[-1]
