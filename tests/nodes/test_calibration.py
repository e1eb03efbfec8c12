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

"""Views are collected from a live stream, calibrated by service calls, and saved."""

from __future__ import annotations

import resource
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import Twist
from rclpy.event_handler import PublisherEventCallbacks
from sensor_msgs.msg import Image, JointState

from semcal_ros.calibration import Calibration
from tests.helpers.calibration_session import (
    MAGNIFICATIONS,
    PLAN,
    SERVER,
    SIZE,
    VIEWS,
    Session,
    calibration_session,
    text_value,
)
from tests.helpers.node_scenes import make_calibration
from tests.helpers.ros_process import LATCHED, RELIABLE, Peer, running

PARAMETERS = "/sem/parameter_server"
# The first magnifications of the plan, where the calibration itself is not looked at.
CALIBRATED = MAGNIFICATIONS[:2]


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    with calibration_session(tmp_path_factory.mktemp("allowed")) as made:
        yield made


@pytest.fixture
def calibrated(session: Session) -> Session:
    """The server with a calibration, also where the test that looks closely at it runs in another process."""
    if not session.texts:
        for index in range(len(CALIBRATED) * VIEWS):
            session.add_view(index)
        pending = session.begin("calibrate")
        session.peer.wait_for(pending.done, "a calibration", timeout_s=100.0)
        session.peer.wait_for(lambda: session.texts, "its text")
    return session


def test_there_is_nothing_to_add_calibrate_save_or_cancel_at_first(session: Session) -> None:
    for service, reason in (
        ("add_view", "no frame with a known magnification yet"),
        ("calibrate", "no usable view"),
        ("save", "no calibration to save"),
        ("cancel", "no calibration is running"),
        ("check", "no usable view"),
        ("update", "no usable view"),
    ):
        answer = session.call(service)
        assert not answer.success
        assert reason in answer.message


def test_the_server_introduces_itself_in_one_line(session: Session) -> None:
    (line,) = [text for text in session.node.output.splitlines() if "subscribes to" in text]
    for part in (
        "[INFO]",
        "Collects views of the grid from the live stream",
        "; subscribes to /sem/conditions, /sem/image_raw, /sem/magnification, ",
        "; publishes /sem/calibration, /sem/calibration_server/overlay, ",
    ):
        assert part in line


def test_an_image_without_a_grid_is_refused_with_a_reason_and_shown(session: Session) -> None:
    flat = np.random.default_rng(1).normal(120, 10, (SIZE, SIZE)).clip(0, 255).astype(np.uint8)
    session.show(flat, 1000.0)
    count = len(session.overlays)
    answer = session.call("add_view")
    assert not answer.success
    assert answer.message.startswith("no grid found at 1000x: ")
    session.peer.wait_for(lambda: len(session.overlays) > count, "the overlay")


def test_a_view_keeps_what_the_stage_said(session: Session) -> None:
    publisher = session.peer.node.create_publisher(JointState, "stage", LATCHED)
    session.peer.wait_for(lambda: publisher.get_subscription_count() == 1, "the subscription")
    publisher.publish(JointState(name=["tilt"], position=[0.3]))

    def known() -> bool:
        session.show(PLAN.render(0), PLAN.frames[0].magnification)
        return session.peer.state(SERVER).get("stage_tilt_rad") == "0.3"

    session.peer.wait_for(known, "the stage")
    answer = session.call("add_view")
    assert answer.success
    assert ", tilted by 17.2 degrees; ~/save will write " in answer.message
    assert answer.message.endswith(f" {session.folder}/calibration.yaml")
    # A wrong one makes it unknown again.
    publisher.publish(JointState(name=["tilt"], position=[17.2]))

    def rejected() -> bool:
        return "looks like degrees" in session.peer.state(SERVER).get("last_rejection", "")

    session.peer.wait_for(rejected, "the rejection")
    assert "tilt 17.2 rad on stage: degrees?" in session.peer.state(SERVER)["message"]
    session.show(PLAN.render(1), PLAN.frames[1].magnification)
    assert "tilted" not in session.call("add_view").message
    publisher.publish(JointState(name=["alpha"], position=[0.3]))
    session.peer.wait_for(
        lambda: "no joint tilt on stage" in session.peer.state(SERVER)["message"], "the joint"
    )
    session.peer.node.destroy_publisher(publisher)


def test_a_stage_of_another_type_is_named_and_views_are_taken_without_it(session: Session) -> None:
    silent = PublisherEventCallbacks(use_default_callbacks=False)
    publisher = session.peer.node.create_publisher(Twist, "stage", LATCHED, event_callbacks=silent)
    session.peer.wait_for(
        lambda: "geometry_msgs/msg/Twist on stage" in session.peer.state(SERVER)["message"],
        "the type",
    )
    session.show(PLAN.render(2), PLAN.frames[2].magnification)
    answer = session.call("add_view")
    assert answer.success
    assert "tilted" not in answer.message
    session.peer.node.destroy_publisher(publisher)


def test_nothing_is_done_with_two_streams_on_one_topic(session: Session) -> None:
    """A driver that was left on during a replay: its images would get the magnification of the other."""
    peer, rivals = session.peer, "2 publishers on /sem/image_raw: /sem/peer, /sem/replay"
    picture, replay = PLAN.render(3), Peer("replay")
    try:
        replay.node.create_publisher(Image, "image_raw", RELIABLE)

        def warned() -> bool:
            session.publish(picture, PLAN.frames[3].magnification)
            peer.spin(0.3)
            state = peer.state(SERVER)
            # A picture that may be of either is none.
            is_said = state["level"] == "1" and rivals in state["message"]
            return is_said and "picture_stamp" not in state

        peer.wait_for(warned, "the condition")
        for service in ("add_view", "calibrate", "calibrate_start", "check", "update", "acquire"):
            answer = session.call(service)
            assert not answer.success, service
            assert answer.message.startswith(rivals), service
    finally:
        replay.close()
    peer.wait_for(lambda: rivals not in peer.state(SERVER)["message"], "one publisher")
    session.show(picture, PLAN.frames[3].magnification)
    assert session.call("add_view").success


@pytest.mark.long
def test_views_are_calibrated_while_other_nodes_go_on(session: Session, tmp_path: Path) -> None:
    assert session.call("clear").success
    # Degrees that pass for radians, until one does not.
    stage = session.peer.node.create_publisher(JointState, "stage", LATCHED)
    stage.publish(JointState(name=["tilt"], position=[1.0]))

    def tilted() -> bool:
        session.show(PLAN.render(0), PLAN.frames[0].magnification)
        return session.peer.state(SERVER).get("stage_tilt_rad") == "1"

    session.peer.wait_for(tilted, "the stage")
    assert "degrees?" not in session.peer.state(SERVER)["message"]
    for index in range(len(PLAN.frames)):
        session.add_view(index)
    stage.publish(JointState(name=["tilt"], position=[30.0]))
    session.peer.wait_for(
        lambda: "tilt 30 rad on stage" in session.peer.state(SERVER)["message"], "the doubt"
    )
    session.peer.node.destroy_publisher(stage)
    assert not session.call("add_view").success  # the same frame again
    overlay = session.peer.wait_for(lambda: session.overlays[-1], "the overlay")
    assert (overlay.encoding, overlay.width, overlay.height) == ("bgr8", SIZE, SIZE)
    pixels = np.frombuffer(overlay.data, np.uint8).reshape(SIZE, SIZE, 3)
    assert np.any(np.ptp(pixels, axis=2) > 100)  # marks in colour

    old = make_calibration()
    old.save(tmp_path / "old.yaml")
    expected = {f"p@{g}": old.at(g).P.ravel() for g in (1250.0, 5250.0)}
    asked_during: set[str] = set()
    with running("parameter_server", {"calibration": tmp_path / "old.yaml"}):
        session.peer.wait_for(lambda: session.peer.state(PARAMETERS), "the parameter server")
        start = len(session.progress)
        calibrated = session.begin("calibrate")
        while not calibrated.done():
            stage = session.shown().get("stage", "")
            values = session.peer.get_parameters(PARAMETERS, *expected)
            if calibrated.done():
                break
            for value, matrix in zip(values, expected.values(), strict=True):
                np.testing.assert_array_equal(value.double_array_value, matrix)
            # The stream is taken in, too; fewer frames than may wait.
            if stage not in asked_during:
                session.publish(PLAN.render(0), MAGNIFICATIONS[0])
            asked_during.add(stage)
        session.wait_seen(MAGNIFICATIONS[0])
    assert calibrated.result().success, calibrated.result().message
    doubt = "stage: tilt 30 rad looks like degrees: the stage is not used"
    assert doubt in calibrated.result().message
    # Not only before it has begun in earnest.
    assert asked_during - {"", "start", "done"}
    # By the latched topic, it has reached even the server that answered from another one.
    text = session.peer.wait_for(lambda: session.texts, "the calibration")[-1].data
    calibration = Calibration.loads(text)
    assert calibration.magnifications == MAGNIFICATIONS
    assert calibration.method == "joint"
    assert not [w for w in calibration.statistics["warnings"] if "contradicts the tilt" in w]

    shown = [{v.key: v.value for v in status.values} for status in session.progress[start:]]
    fractions = [float(values["fraction"]) for values in shown if "fraction" in values]
    assert fractions == sorted(fractions)
    assert fractions[-1] == 1.0
    assert shown[-1]["stage"] == "done"
    assert shown[-1]["views"] == str(VIEWS * len(MAGNIFICATIONS))
    assert shown[-1]["views at 2000x"] == str(VIEWS)
    assert session.shown()["message"] == calibrated.result().message

    # No magnification was set twice, so that nothing tells how well it comes back.
    doubts = [w for w in calibration.statistics["warnings"] if w.startswith("scale: ")]
    assert doubts
    session.peer.wait_for(
        lambda: doubts[0][7:50] in session.peer.state(SERVER).get("calibration_warnings", ""),
        "the doubts about nm per pixel",
    )
    assert "scale of the calibration: " in session.peer.state(SERVER)["message"]

    for g in MAGNIFICATIONS:
        camera, truth = calibration.at(g), PLAN.microscope.camera_at(g)
        # 16 views of 384 px leave 0.2 % (1-sigma) of scale at worst, since tilt and scale trade off.
        assert camera.pixel_size_m == pytest.approx(truth.pixel_size_m, rel=0.006)
        sigma = np.sqrt(camera.covariance[0, 0]) / camera.m
        assert 0.0 < sigma < 0.004


def test_the_calibration_is_saved_where_the_parameter_says(calibrated: Session) -> None:
    file = calibrated.folder / "live.yaml"
    assert calibrated.set_output(file).successful
    answer = calibrated.call("save")
    assert (answer.success, answer.message) == (True, f"saved to {file}")
    assert file.read_text() == calibrated.texts[-1].data


# Tests may run as root, whom permission bits do not stop; these stop everybody.
def _folder_in_place_of_the_file(folder: Path) -> Path:
    (folder / "folder.yaml").mkdir()
    return folder / "folder.yaml"


def _file_in_place_of_the_folder(folder: Path) -> Path:
    (folder / "plain").write_text("old")
    return folder / "plain" / "live.yaml"


def _no_folder(folder: Path) -> Path:
    return folder / "missing" / "live.yaml"


@pytest.mark.parametrize(
    ("prepare", "reason"),
    [
        (_folder_in_place_of_the_file, "Is a directory"),
        (_file_in_place_of_the_folder, "Not a directory"),
        (_no_folder, "No such file"),
    ],
)
def test_a_file_that_cannot_be_written_is_one_plain_answer(
    calibrated: Session, prepare: Callable[[Path], Path], reason: str
) -> None:
    assert calibrated.set_output(prepare(calibrated.folder)).successful
    before = sorted(calibrated.folder.rglob("*"))
    answer = calibrated.call("save")
    assert not answer.success
    assert reason in answer.message
    assert sorted(calibrated.folder.rglob("*")) == before


def test_a_full_disk_leaves_the_old_file_and_nothing_else(calibrated: Session) -> None:
    """By a limit of the size of files, which stops a write half-way as a full disk does."""
    file = calibrated.folder / "full.yaml"
    file.write_text("old")
    assert calibrated.set_output(file).successful
    before = sorted(calibrated.folder.iterdir())
    pid, limit = calibrated.node.process.pid, resource.RLIMIT_FSIZE
    soft, hard = resource.prlimit(pid, limit)
    assert len(calibrated.texts[-1].data) > 8192
    resource.prlimit(pid, limit, (8192, hard))
    try:
        answer = calibrated.call("save")
    finally:
        resource.prlimit(pid, limit, (soft, hard))
    assert not answer.success
    assert "File too large" in answer.message
    assert file.read_text() == "old"
    assert sorted(calibrated.folder.iterdir()) == before
    assert calibrated.call("save").success
    assert file.read_text() == calibrated.texts[-1].data


def test_what_lies_outside_of_the_directory_is_refused(session: Session, tmp_path: Path) -> None:
    (session.folder / "door").symlink_to(tmp_path)
    for path in (
        tmp_path / "a.yaml",
        session.folder / ".." / "a.yaml",
        session.folder / "door" / "a.yaml",
        "/proc/self/cwd/a.yaml",
        "~/a.yaml",
        session.folder.parent / (session.folder.name + "2") / "a.yaml",
    ):
        result = session.set_output(path)
        assert not result.successful
        assert f"inside {session.folder}" in result.reason


def test_a_file_that_became_a_link_to_elsewhere_is_not_written(
    calibrated: Session, tmp_path: Path
) -> None:
    file, victim = calibrated.folder / "linked.yaml", tmp_path / "victim"
    file.write_text("old")
    victim.write_text("precious")
    assert calibrated.set_output(file).successful
    file.unlink()
    file.symlink_to(victim)
    answer = calibrated.call("save")
    assert not answer.success
    assert f"which is {victim}" in answer.message
    assert victim.read_text() == "precious"
    assert file.is_symlink()


def test_a_calibration_is_checked_and_renewed_by_new_views(calibrated: Session) -> None:
    calibrated.call("clear")
    publisher = calibrated.peer.node.create_publisher(DiagnosticStatus, "conditions", LATCHED)
    calibrated.peer.wait_for(lambda: publisher.get_subscription_count() == 1, "the subscription")
    pairs = {"accelerating_voltage_v": "5000", "working_distance_m": "near", "serial": "7"}
    values = [KeyValue(key=key, value=value) for key, value in pairs.items()]
    publisher.publish(DiagnosticStatus(values=values))
    for index in (0, 1, VIEWS, VIEWS + 1):
        calibrated.add_view(index)
    calibrated.peer.node.destroy_publisher(publisher)
    answer = calibrated.call("check")
    assert answer.success, answer.message
    assert answer.message.startswith("valid: nm per px off by ")
    assert answer.message.endswith("by 4 views")
    before = len(calibrated.texts)
    answer = calibrated.call("update")
    assert answer.success, answer.message
    calibrated.peer.wait_for(lambda: len(calibrated.texts) > before, "the renewed calibration")
    renewed = Calibration.loads(calibrated.texts[-1].data)
    assert [entry["views"] for entry in renewed.statistics["updates"]] == [4]
    # The one that was made here, before there was a message, has neither conditions nor a recording.
    made = [Calibration.loads(text.data).provenance for text in calibrated.texts]
    first, origin = next(told for told in made if told.views), renewed.provenance
    assert not first.conditions.keys() & {"acceleration_voltage_v", "serial_number"}
    assert first.configuration == origin.configuration == "virtual SEM"
    assert len(first.views) > len(origin.views) == 4
    assert (first.recording, origin.recording) == ("", "")
    assert origin.calibrated >= first.calibrated > "2026"
    assert origin.conditions["acceleration_voltage_v"] == (5000.0, 5000.0)
    assert origin.conditions["serial_number"] == ("7",)
    assert "working_distance_m" not in origin.conditions
    # Said to be at another magnification than they have, views contradict it.
    calibrated.call("clear")
    calibrated.show(PLAN.render(VIEWS), PLAN.frames[VIEWS].magnification / 1.3)
    assert calibrated.call("add_view").success
    answer = calibrated.call("check")
    assert not answer.success
    assert "invalid (scale" in answer.message
    assert "calibrate anew" in answer.message


def test_too_few_views_are_refused_and_the_calibration_stays(session: Session) -> None:
    before = len(session.texts)
    assert session.call("clear").success
    session.add_view(0)
    assert session.call("clear").message == "1 view removed"
    session.add_view(0)
    answer = session.call("calibrate")
    assert not answer.success
    assert "expected at least 3 views" in answer.message
    assert len(session.texts) == before


def test_magnifications_in_another_unit_are_refused_with_what_fits(session: Session) -> None:
    before = len(session.texts)
    session.call("clear")
    for index in range(3):
        g = PLAN.frames[index].magnification * 600.0
        session.show(PLAN.render(index), g)
        assert session.call("add_view").success
    answer = session.call("calibrate")
    assert not answer.success
    assert "times the scale" in answer.message
    assert "--display-width" in answer.message
    assert "display_width_m and squares_m in a configuration" in answer.message
    assert len(session.texts) == before


def test_an_unknown_method_is_refused(session: Session) -> None:
    result = session.peer.set_parameter(SERVER, "method", text_value("magic"))
    assert not result.successful
    assert "one of" in result.reason
