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

"""The package of the page "Write your node", kept in tests/consumer: it is that of the page, and tracks a bead."""

from __future__ import annotations

import importlib.util
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from semcal_ros.core.arrays import Array
from tests.helpers.bead_sweep import magnifications, truth_nm, write_sweep
from tests.helpers.installed_package import CONSUMER, Installed, install
from tests.helpers.node_scenes import make_calibration
from tests.helpers.project import ROOT

PAGE = (ROOT / "doc" / "howto" / "write_a_node.md").read_text(encoding="utf-8")
FRAMES = 36
FILES = (
    "bead_tracker/bead.py",
    "launch/bead_launch.py",
    "package.xml",
    "setup.py",
    "setup.cfg",
)
MODES = ("combined", "one_process")
# In the chain of processes nothing tells that the tracker hears the corrector, but the corrector's own diagnostics.
HEARD = "image_rect:1 projection_stamped:1 projection_covariance_stamped:1 drift:1"
LAUNCH = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
service = LaunchService()
file = PythonLaunchDescriptionSource(sys.argv[1])
arguments = [tuple(text.split(":=", 1)) for text in sys.argv[2:]]
included = IncludeLaunchDescription(file, launch_arguments=arguments)
service.include_launch_description(LaunchDescription([included]))
sys.exit(service.run())
"""


@pytest.mark.parametrize("name", FILES)
def test_the_package_is_that_of_the_page(name: str) -> None:
    text = (CONSUMER / name).read_text(encoding="utf-8")
    shown = re.sub(r"\A(#.*\n)+\n", "", text)
    page = re.sub(r"^    ", "", PAGE, flags=re.MULTILINE)
    assert shown in page


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Installed:
    return install(CONSUMER, tmp_path_factory.mktemp("package"))


@pytest.fixture(scope="module")
def sweep(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sweep")
    write_sweep(folder / "sweep", make_calibration(), magnifications(FRAMES, 600.0, 6000.0))
    make_calibration().save(folder / "cal.yaml")
    return folder


def check_path(output: str) -> None:
    """The printed path is the bead's within 3 of the sigmas that are printed with it, frame by frame."""
    g = magnifications(FRAMES, 600.0, 6000.0)
    true: Array = truth_nm(make_calibration(), g)
    number = r"(-?\d+(?:\.\d+)?)"
    said = re.findall(rf"{number}x {number} \+- {number}, {number} \+- {number} nm", output)
    assert len(said) == FRAMES, output
    for line in said:
        magnification, x, sx, y, sy = map(float, line)
        k = int(np.argmin(np.abs(g - magnification)))
        assert magnification == pytest.approx(g[k], rel=1e-4)
        assert abs(x - true[k, 0]) < 3.0 * sx and abs(y - true[k, 1]) < 3.0 * sy, line
        # And the sigmas say something: half a pixel of a picture of 256, or 1 % of the length.
        assert max(sx, sy) < 0.5 * 1.2e8 / magnification / 256 + 0.01 * np.hypot(x, y) + 100.0


def test_it_installs_where_ros_looks_for_it(package: Installed) -> None:
    share = package.prefix / "share"
    assert (share / "ament_index/resource_index/packages/bead_tracker").is_file()
    assert (share / "bead_tracker/launch/bead_launch.py").is_file()
    assert (package.prefix / "lib/bead_tracker/bead").is_file()


def set_parameters(*parameters: str) -> list[str]:
    return ["--ros-args", *(word for text in parameters for word in ("-p", text))]


def node(name: str, *parameters: str) -> list[str]:
    return [sys.executable, "-m", f"semcal_ros.nodes.{name}", *set_parameters(*parameters)]


# No frame is corrected by a forecast, so that the path is the same however busy the computer is.
ALL_MEASURED = "drift_tracking:=every_frame"


def wait_in(topic: str, end: str = "subscription") -> str:
    """Let all frames of the sweep wait: with the usual ten, a busy computer skips late ones, as it should."""
    return f"qos_overrides./sem/{topic}.{end}.depth:=40"


@pytest.mark.long
def test_the_path_in_the_process_of_the_suite_by_python(package: Installed, sweep: Path) -> None:
    given = ("source:=bag", "viewer:=false", f"bag:={sweep / 'sweep'}", "consumer_depth:=40")
    command = node("suite", "config:=virtual_sem", f"calibration:={sweep / 'cal.yaml'}", *given)
    command += ["-p", wait_in("image_raw"), "-p", ALL_MEASURED]
    done = subprocess.run(
        command,
        env=package.environment(),
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    check_path(done.stdout)


@pytest.mark.long
def test_the_path_in_a_process_of_its_own_by_python(package: Installed, sweep: Path) -> None:
    environment = package.environment()
    waiting = (wait_in("image_raw"), wait_in("image_rect", "publisher"))
    given = ("config:=virtual_sem", f"calibration:={sweep}/cal.yaml", *waiting, ALL_MEASURED)
    corrector = node("stream_corrector", *given)
    player = node(
        "bag_player",
        f"bag:={sweep / 'sweep'}",
        "wait_for_subscribers:=2",
        f"wait_for:='{HEARD}'",
    )
    tracker = package.prefix / "lib/bead_tracker/bead"
    own = subprocess.Popen(
        [sys.executable, "-u", tracker, *set_parameters(wait_in("image_rect"))],
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    beside = subprocess.Popen(corrector, env=environment)
    try:
        subprocess.run(player, env=environment, check=True, timeout=120)
    finally:
        for process in (beside, own):
            process.send_signal(signal.SIGINT)
        output, _ = own.communicate(timeout=30)
        beside.wait(timeout=30)
    check_path(output)


@pytest.mark.long
@pytest.mark.skipif(
    importlib.util.find_spec("launch_ros") is None, reason="launch_ros is not on PyPI"
)
@pytest.mark.parametrize("mode", MODES)
def test_the_path_by_a_launch_file(package: Installed, sweep: Path, mode: str) -> None:
    arguments = [f"bag:={sweep / 'sweep'}", f"calibration:={sweep / 'cal.yaml'}", f"mode:={mode}"]
    arguments += ["config:=virtual_sem", "viewer:=false"]
    if mode == "combined":
        more = f"/sem/bag_player:\n  ros__parameters:\n    wait_for: '{HEARD}'\n"
        (sweep / "more.yaml").write_text(more, encoding="utf-8")
        arguments += ["wait_for_subscribers:=2", f"params_file:={sweep / 'more.yaml'}"]
    file = package.prefix / "share/bead_tracker/launch/bead_launch.py"
    done = subprocess.run(
        [sys.executable, "-c", LAUNCH, file, *arguments],
        env={**package.environment(), "PYTHONUNBUFFERED": "1"},
        capture_output=True,
        text=True,
        timeout=150,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    check_path(done.stdout)
