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

"""A calibration that records itself: unattended by ``semcal acquire``, step by step, and when something goes wrong."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Float64

from semcal_ros import extend
from semcal_ros.calibration import Calibration
from semcal_ros.core.wording import group_by_kind
from semcal_ros.synthetic import preset
from semcal_ros.workflows.calibrate import CalibrateOptions, calibrate_recording
from tests.helpers.calibrations import calibrated
from tests.helpers.project import ROOT
from tests.helpers.ros_process import LATCHED, RELIABLE, Peer, running

pytestmark = pytest.mark.slow

SERVER = "/sem/calibration_server"
SIZE = 320
SEM: dict[str, Any] = {
    "specimen": "grid",
    "width": SIZE,
    "height": SIZE,
    "magnification": 2000.0,
    "rate": 10.0,
}
GOAL: dict[str, Any] = {
    "config": "virtual_sem",
    "lowest_magnification": 1500.0,
    "highest_magnification": 3000.0,
    "target": 0.05,
    "allow_writing": False,
}


class Progress:
    """What ``~/progress`` says."""

    def __init__(self, peer: Peer) -> None:
        self.messages = peer.collect(DiagnosticStatus, f"{SERVER}/progress", LATCHED)

    def __getitem__(self, key: str) -> str:
        values = self.messages[-1].values if self.messages else []
        return {value.key: value.value for value in values}.get(key, "")

    @property
    def text(self) -> str:
        return str(self.messages[-1].message)


# Of a command whose output is followed while it runs.
OPTIONS: dict[str, Any] = {
    "env": {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONUNBUFFERED": "1"},
    "text": True,
}


def interrupted(command: list[str], until: str) -> str:
    """Run a command until it says something that matches, then end it by Ctrl-C; return all that it said."""
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **OPTIONS
    ) as process:
        assert process.stdout is not None
        said = ""
        while not re.search(until, said, re.MULTILINE):
            line = process.stdout.readline()
            assert line, said
            said += line
        process.send_signal(signal.SIGINT)
        said += process.stdout.read()
    assert process.returncode == 130, said
    return without_waiting(said)


def without_waiting(said: str) -> str:
    """What was said but for that it waits for the first picture, as it does on a busy machine."""
    return re.sub(r"\Awaiting for pictures .*\n", "", said)


def resumed(command: list[str], views: Path, timeout_s: float) -> subprocess.CompletedProcess[str]:
    """Go on with an acquisition that was interrupted."""
    return subprocess.run(
        [*command, "--resume", str(views)],
        capture_output=True,
        timeout=timeout_s,
        check=False,
        **OPTIONS,
    )


def test_a_microscope_that_no_node_can_be_is_refused(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "semcal_ros", "acquire", "-o", str(tmp_path / "cal.yaml")]
    command += ["--range", "1500,3000", "--microscope", "my microscope"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        "microscope 'my microscope'; expected the name of a node, such as virtual_sem"
    ]


@pytest.mark.long
def test_semcal_acquire_calibrates_the_virtual_microscope_and_goes_on_after_ctrl_c(
    tmp_path: Path,
) -> None:
    """From nothing to a calibration that is right within what it states, and a recording of it, in two parts."""
    output = tmp_path / "cal.yaml"
    command = [sys.executable, "-m", "semcal_ros", "acquire", "-o", str(output)]
    command += ["--config", "virtual_sem", "--microscope", "virtual_sem"]
    command += ["--range", "1500,3000", "--target", "5%", "--tilts", "0,30deg"]
    with running("virtual_sem", SEM):
        # The first visit, and a part of the second one.
        said = interrupted(command, r"^3/8: set")
        views = tmp_path / "cal_views"
        assert f"recorded to {views}" in said.splitlines()[0]
        assert said.splitlines()[-1].endswith(f"--resume {views} goes on")
        assert not output.exists()
        done = resumed(command, views, timeout_s=150.0)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = without_waiting(done.stdout).splitlines()
    assert lines[0].startswith(
        f"acquisition begun with the views of {views}, recorded to {views}_2"
    )
    kept = re.fullmatch(rf"(\d)/8: (\d) views taken over from {views}", lines[1])
    # One more may have been taken before the signal came.
    assert kept is not None and kept[1] == kept[2] and kept[1] in "34"
    assert f"{kept[1]}/8: view {int(kept[1]) + 1} at" in done.stdout
    assert "the target is met" in lines[-3]
    assert lines[-2] == f"all pictures: {views}_2"
    assert lines[-1].startswith(f"saved to {output}")
    calibration = Calibration.load(output)
    # What is suspicious is said, and nothing else.
    assert calibration.warnings
    assert done.stderr.splitlines() == [
        f"warning: {w}" for w in group_by_kind(calibration.warnings)
    ]
    assert calibration.magnification_range == (1500.0, 3000.0)
    truth = preset("jsm820").with_image_size(SIZE, SIZE)
    for g in (1500.0, 2200.0, 3000.0):
        camera = calibration.at(g)
        error = np.divide(camera.pixel_size_m, truth.camera_at(g).pixel_size_m) - 1.0
        stated = np.divide(camera.pixel_size_sigma_m, camera.pixel_size_m)
        assert np.all(np.abs(error) < 3.5 * stated)
        assert np.all(stated < 0.05)
    # Four visits with two tilts; the recording has each of them, and gives as many views.
    assert calibration.provenance is not None and len(calibration.provenance.views) == 8
    again = calibrate_recording(tmp_path / "cal_views_2", CalibrateOptions(config="virtual_sem"))
    assert len(again.collected.views) >= 8
    readings = [view.stage for view in again.collected.views]
    tilts = {round(np.degrees(r.tilt_rad) / 30.0) for r in readings if r is not None and r.tilt_rad}
    assert tilts == {0, 1}


@pytest.mark.long
def test_semcal_acquire_extends_a_calibration_and_goes_on_after_ctrl_c(tmp_path: Path) -> None:
    """The same with a ladder over gold: right within what it states beyond the grid, and a recording of it."""
    grid, output, views = tmp_path / "cal.yaml", tmp_path / "new.yaml", tmp_path / "new_views"
    Calibration.from_model(calibrated("jsm820").model).save(grid)
    command = [sys.executable, "-m", "semcal_ros", "acquire", "-o", str(output)]
    command += ["--config", "virtual_sem", "--microscope", "virtual_sem"]
    command += ["--extend", str(grid), "--to", "14000x"]
    with running("virtual_sem", {**SEM, "specimen": "gold", "drift": "slow"}):
        # The first magnification, and a part of the second one.
        said = interrupted(command, r"^5/16: ")
        assert said.splitlines()[0].startswith(f"ladder begun, recorded to {views}")
        assert re.search(rf"ended with [56] pictures; .* --resume {views} goes on$", said.rstrip())
        assert not output.exists()
        done = resumed(command, views, timeout_s=200.0)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = without_waiting(done.stdout).splitlines()
    assert re.fullmatch(rf"[56]/16: [56] pictures taken over from {views}", lines[1])
    assert "extended to 100x to 14000x by 16 pictures" in lines[-3]
    assert lines[-1].startswith(f"saved to {output}")
    found, truth = Calibration.load(output), preset("jsm820")
    for g in (11000.0, 14000.0):
        camera = found.at(g)
        wanted = truth.with_image_size(*found.image_size).camera_at(g)
        errors = np.subtract(camera.pixel_size_m, wanted.pixel_size_m)
        assert np.all(np.abs(errors) < 3.5 * np.array(camera.pixel_size_sigma_m))
        assert max(camera.pixel_size_sigma_m) < 4e-3 * camera.pixel_size_m[0]
    # The recording has all pictures, and gives the same as a command.
    again = extend(grid, tmp_path / "new_views_2", config="virtual_sem")
    assert sum(step.pictures for step in again.result.steps) >= 16
    np.testing.assert_allclose(
        again.calibration.at(14000.0).pixel_size_m, found.at(14000.0).pixel_size_m, rtol=2e-3
    )


@pytest.mark.long
def test_a_grid_that_a_tilt_carries_away_is_followed(peer: Peer) -> None:
    """A grid of 100 um on a stage whose axis is 0.5 mm off: 40 degrees carry it by 117 um, out of the field."""
    scene = {
        **SEM,
        "tilt_carries_away": True,
        "eucentric_error_m": 5e-4,
        "grid_extent": 20,
        "magnification": 1500.0,
    }
    goal = {**GOAL, "microscope": "virtual_sem", "highest_magnification": 1500.0}
    progress = Progress(peer)
    images = peer.collect(Image, "image_raw")
    stage = peer.collect(JointState, "stage", LATCHED)
    with running("virtual_sem", scene), running("calibration_server", goal) as server:
        peer.wait_for(lambda: len(images) > 2 and progress.messages, "frames")
        assert peer.trigger(f"{SERVER}/acquire").success
        ended = ("done", "failed", "stopped")
        peer.wait_for(lambda: progress["acquisition"] in ended, "the end", timeout_s=300.0)
        assert progress["acquisition"] == "done", server.output
        assert (progress["taken"], progress["left_out"]) == ("12", "0")
        way = np.array(
            [[dict(zip(m.name, m.position, strict=True))[j] for j in "xy"] for m in stage]
        )
        # The axis lies along x.
        assert np.ptp(way[:, 1]) > 5e-5


def test_a_person_is_told_what_to_set_and_goes_on_after_a_stop(peer: Peer) -> None:
    progress = Progress(peer)
    images = peer.collect(Image, "image_raw")
    knob = peer.node.create_publisher(Float64, "virtual_sem/set_magnification", RELIABLE)
    with running("virtual_sem", SEM), running("calibration_server", GOAL):
        peer.wait_for(lambda: len(images) > 2 and progress.messages, "frames")
        begun = peer.trigger(f"{SERVER}/acquire")
        assert begun.success and begun.message.startswith("acquisition begun")
        peer.wait_for(lambda: progress["acquisition"] == "waiting", "the first request")
        assert progress["request"].startswith("set 1500x anew, tilt to 0 degrees, turn the scan to")
        assert "um squares fill the image" in progress["request"]
        again = peer.trigger(f"{SERVER}/acquire")
        assert not again.success and "an acquisition is running" in again.message
        # Nobody has turned the knob.
        peer.wait_for(
            lambda: peer.state(SERVER).get("magnification") == "2000", "the magnification"
        )

        def refused() -> bool:
            answer = peer.trigger(f"{SERVER}/add_view")
            assert not answer.success
            return "a picture at 2000x; expected 1500x" in answer.message

        peer.wait_for(refused, "the refusal of a picture at another magnification")
        peer.wait_for(lambda: knob.get_subscription_count() == 1, "the knob")
        knob.publish(Float64(data=1500.0))

        def taken() -> bool:
            return bool(peer.trigger(f"{SERVER}/add_view").success)

        peer.wait_for(taken, "the first view")
        peer.wait_for(lambda: progress["taken"] == "1", "the next request")
        assert "tilt to 20 degrees" in progress["request"]
        ended = peer.trigger(f"{SERVER}/cancel")
        assert ended.success and "~/acquire goes on with it" in ended.message
        peer.wait_for(lambda: progress["acquisition"] == "stopped", "the end")
        on = peer.trigger(f"{SERVER}/acquire")
        assert on.success and on.message.startswith("acquisition going on")
        peer.wait_for(lambda: progress["acquisition"] == "waiting", "the same request")
        assert progress["taken"] == "1" and "tilt to 20 degrees" in progress["request"]


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        ({"allow_motion": False}, "which is not allowed"),
        ({"max_magnification": 1000.0}, "1000"),
        pytest.param(
            {"specimen": "gold"},
            "3 views in a row without a usable picture, the last: no grid found",
            marks=pytest.mark.long,
        ),
    ],
    ids=["not allowed", "limits", "no grid"],
)
def test_what_goes_wrong_ends_it_with_the_reason_and_nothing_moves_any_more(
    peer: Peer, scene: dict[str, Any], said: str
) -> None:
    progress = Progress(peer)
    stage = peer.collect(JointState, "stage", LATCHED)
    images = peer.collect(Image, "image_raw")
    goal = {**GOAL, "microscope": "virtual_sem"}
    with running("virtual_sem", {**SEM, **scene}), running("calibration_server", goal):
        peer.wait_for(lambda: len(images) > 2 and progress.messages, "frames")
        peer.wait_for(lambda: peer.trigger(f"{SERVER}/acquire").success, "the begin")
        # Of each view without a grid, every kind of pattern is looked for first.
        peer.wait_for(lambda: progress["acquisition"] == "failed", "the end", timeout_s=300.0)
        assert said in progress["request"]
        assert said in progress.text
        moved = len(stage)
        peer.spin(0.5)
        assert len(stage) == moved
        assert "acquisition" not in peer.state(SERVER).get("message", "")


def test_what_is_to_be_reached_must_be_said(peer: Peer) -> None:
    with running("virtual_sem", SEM), running("calibration_server", {"config": "virtual_sem"}):
        for service, said in (
            ("acquire", "no range of magnifications"),
            ("extend", "no calibration to begin with"),
        ):
            answer = peer.trigger(f"{SERVER}/{service}")
            assert not answer.success
            assert said in answer.message
