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

"""A replay in which every frame has another magnification, through the nodes over real DDS."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterType, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameterTypes
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import SetBool

from semcal_ros.calibration import Calibration
from semcal_ros.core.rectification.rectifier import Rectifier
from tests.helpers.node_scenes import make_calibration, stamp_of, write_recording
from tests.helpers.ros_process import LATCHED, PATIENT, RELIABLE, NodeProcess, Peer, running

MAGNIFICATIONS = [float(g) for g in np.geomspace(600.0, 6000.0, 15).round(1)]
CALIBRATION = make_calibration()


@dataclass
class Replay:
    """What came out of one replay, and the nodes that are still up."""

    peer: Peer
    images: list[NDArray[np.uint8]]
    server: NodeProcess
    rectified: list[Any] = field(default_factory=list)
    infos: list[Any] = field(default_factory=list)
    projections: list[Any] = field(default_factory=list)
    texts: list[Any] = field(default_factory=list)
    clock: list[Any] = field(default_factory=list)
    player_status: int = -1


@pytest.fixture(scope="module")
def replay(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Replay]:
    """bag_player, parameter_server and rectifier; only the server is given the calibration file."""
    folder = tmp_path_factory.mktemp("replay")
    images = write_recording(folder / "bag", MAGNIFICATIONS)
    CALIBRATION.save(folder / "cal.yaml")
    peer = Peer()
    playing = {"bag": folder / "bag", "rate": 2.0, "start_paused": True, "clock": True}
    with (
        running("bag_player", playing) as player,
        running("parameter_server", {"calibration": folder / "cal.yaml"}) as server,
        running("rectifier", PATIENT) as rectifier,
    ):
        run = Replay(peer, images, server)
        run.rectified = peer.collect(Image, "image_rect")
        run.infos = peer.collect(CameraInfo, "camera_info")
        run.projections = peer.collect(Float64MultiArray, "projection")
        run.texts = peer.collect(String, "calibration", LATCHED)
        run.clock = peer.collect(Clock, "/clock")
        peer.wait_for(lambda: peer.node.count_subscribers("magnification") == 2, "the listeners")
        peer.wait_for(lambda: "calibration from topic" in rectifier.output, "the calibration")
        # The paths from the nodes to this test must stand before the first frame.
        peer.wait_heard("/sem/rectifier", "image_rect", "camera_info")
        peer.wait_heard("/sem/parameter_server", "projection")
        peer.call(SetBool, "bag_player/pause", SetBool.Request(data=False))
        count = len(MAGNIFICATIONS)
        peer.wait_for(
            lambda: min(len(run.rectified), len(run.infos), len(run.projections)) >= count,
            f"{count} of everything",
        )
        run.player_status = player.wait()
        yield run
    peer.close()


def test_images_and_camera_infos_pair_one_to_one(replay: Replay) -> None:
    stamps = [stamp_of(m) for m in replay.rectified]
    assert stamps == [stamp_of(m) for m in replay.infos]
    assert stamps == sorted(set(stamps))
    assert len(stamps) == len(MAGNIFICATIONS)
    assert {m.header.frame_id for m in [*replay.rectified, *replay.infos]} == {"camera"}


def test_camera_info_is_that_of_the_frames_own_magnification(replay: Replay) -> None:
    for info, g in zip(replay.infos, MAGNIFICATIONS, strict=True):
        camera = CALIBRATION.at(g)
        np.testing.assert_allclose(np.reshape(info.k, (3, 3)), camera.rectified.K, rtol=1e-12)
        np.testing.assert_allclose(
            np.reshape(info.p, (3, 4)),
            np.hstack([camera.rectified.K, np.zeros((3, 1))]),
            rtol=1e-12,
        )
        assert (info.distortion_model, list(info.d)) == ("plumb_bob", [0.0] * 5)
        assert list(info.r) == list(np.eye(3).ravel())


def test_each_image_is_rectified_at_its_own_magnification(replay: Replay) -> None:
    rectifier = Rectifier()
    for message, image, g in zip(replay.rectified, replay.images, MAGNIFICATIONS, strict=True):
        expected = rectifier.rectify(image, CALIBRATION.at(g))
        received = np.frombuffer(message.data, np.uint8).reshape(image.shape)
        np.testing.assert_array_equal(received, expected)
    # The test would not notice a node that rectifies nothing if the distortion were none.
    assert np.abs(expected.astype(int) - replay.images[-1]).max() > 20


def test_every_change_of_magnification_gives_a_projection(replay: Replay) -> None:
    assert len(replay.projections) == len(MAGNIFICATIONS)
    for message, g in zip(replay.projections, MAGNIFICATIONS, strict=True):
        np.testing.assert_allclose(
            np.reshape(message.data, (3, 4)), CALIBRATION.at(g).rectified.P_affine, rtol=1e-12
        )
        assert [(d.label, d.size) for d in message.layout.dim] == [("rows", 3), ("columns", 4)]


def test_the_server_publishes_the_text_of_the_file(replay: Replay) -> None:
    assert Calibration.loads(replay.texts[-1].data).dumps() == CALIBRATION.dumps()


def test_projection_is_kept_for_those_who_come_later(replay: Replay) -> None:
    late = replay.peer.collect(Float64MultiArray, "projection", LATCHED)
    replay.peer.wait_for(lambda: late, "the latched projection")
    expected = CALIBRATION.at(MAGNIFICATIONS[-1]).rectified.P_affine
    np.testing.assert_allclose(np.reshape(late[0].data, (3, 4)), expected, rtol=1e-12)


def test_the_player_ends_by_itself_and_its_clock_goes_on(replay: Replay) -> None:
    assert replay.player_status == 0
    times = [m.clock.sec + 1e-9 * m.clock.nanosec for m in replay.clock]
    assert times == sorted(times)
    # The recording lasts 2.8 s; the clock is published about every 20 ms of wall time as well.
    assert times[-1] - times[0] == pytest.approx(2.8, abs=0.5)
    assert len(times) > 2 * len(MAGNIFICATIONS)


# -- continuous parameters -------------------------------------------------------------------------

SERVER = "parameter_server"


def test_a_parameter_is_answered_at_any_magnification(replay: Replay) -> None:
    camera = CALIBRATION.at(2345.6)
    names = ("p@2345.6", "k@2345.6", "d@2345.6", "e@2345.6", "p_affine@2345.6", "pixel_size@2345.6")
    expected = (
        camera.P,
        camera.K,
        [camera.xi_r, camera.xi_t],
        [camera.ex, camera.ey],
        camera.P_affine,
        camera.pixel_size_m,
    )
    values = replay.peer.get_parameters(SERVER, *names, "sigma@2345.6")
    for value, truth in zip(values, expected, strict=False):
        assert value.type == ParameterType.PARAMETER_DOUBLE_ARRAY
        np.testing.assert_allclose(value.double_array_value, np.ravel(truth), rtol=1e-12)
    sigma = values[-1].double_array_value
    assert len(sigma) == 5
    assert all(0.0 < s < 1.0 for s in sigma)


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("p@9000", "within the calibrated range, 500 to 8000"),
        ("p@499", "within the calibrated range"),
        ("p@-5250", "a finite number above 0"),
        ("p@nan", "a finite number above 0"),
        ("p@", "a finite number above 0"),
        ("q@5250", "p@<magnification>"),
    ],
)
def test_a_parameter_without_an_answer_is_not_set_and_the_log_says_why(
    replay: Replay, name: str, reason: str
) -> None:
    # Others in the same request are answered all the same.
    bad, good = replay.peer.get_parameters(SERVER, name, "d@1000")
    assert bad.type == ParameterType.PARAMETER_NOT_SET
    assert good.type == ParameterType.PARAMETER_DOUBLE_ARRAY
    replay.peer.wait_for(lambda: reason in replay.server.output, f"the warning on {name}")


def test_ordinary_clients_can_describe_but_not_set_them(replay: Replay) -> None:
    request = DescribeParameters.Request(names=["p@5250", "config"])
    described = replay.peer.call(DescribeParameters, f"{SERVER}/describe_parameters", request)
    assert [d.name for d in described.descriptors] == ["p@5250", "config"]
    assert described.descriptors[0].read_only
    asked = GetParameterTypes.Request(names=["p@5250", "p@1"])
    types = replay.peer.call(GetParameterTypes, f"{SERVER}/get_parameter_types", asked).types
    assert list(types) == [ParameterType.PARAMETER_DOUBLE_ARRAY, ParameterType.PARAMETER_NOT_SET]
    value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=1.0)
    result = replay.peer.set_parameter(SERVER, "p@5250", value)
    assert not result.successful
    assert "computed from the calibration" in result.reason


def test_ordinary_parameters_are_served_as_ever(replay: Replay) -> None:
    (config,) = replay.peer.get_parameters(SERVER, "config")
    assert config.string_value == "generic"
    assert replay.peer.get_parameters(SERVER, "no_such_parameter") == []


def test_a_bad_calibration_is_refused_and_the_old_one_stays(replay: Replay, tmp_path: Path) -> None:
    (path,) = replay.peer.get_parameters(SERVER, "calibration")
    # Beside the file of the start; elsewhere, its place alone would be reason enough.
    broken = Path(path.string_value).with_name("broken.yaml")
    broken.write_text(CALIBRATION.dumps()[:500])
    value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=str(broken))
    result = replay.peer.set_parameter(SERVER, "calibration", value)
    assert not result.successful
    assert "broken.yaml" in result.reason
    assert "a calibration" in result.reason
    (d,) = replay.peer.get_parameters(SERVER, "d@1000")
    assert d.double_array_value[0] == CALIBRATION.at(1000.0).xi_r


def test_reload_reads_the_file_again(replay: Replay) -> None:
    (path,) = replay.peer.get_parameters(SERVER, "calibration")
    count = len(replay.texts)
    answer = replay.peer.trigger(f"{SERVER}/reload")
    assert answer.success, answer.message
    replay.peer.wait_for(lambda: len(replay.texts) > count, "the calibration again")
    file = Path(path.string_value)
    good = file.read_text()
    try:
        file.write_text("nonsense: [")
        answer = replay.peer.trigger(f"{SERVER}/reload")
    finally:
        file.write_text(good)
    assert not answer.success
    assert "not valid YAML" in answer.message
    (d,) = replay.peer.get_parameters(SERVER, "d@1000")
    assert math.isclose(d.double_array_value[0], CALIBRATION.at(1000.0).xi_r)


def test_a_calibration_from_another_node_is_taken_over(replay: Replay) -> None:
    """As after ~/calibrate of calibration_server; reload returns to the file."""
    scale = CALIBRATION.functions["scale"]
    functions = {
        **CALIBRATION.functions,
        "scale": dataclasses.replace(scale, coefficients=scale.coefficients * 1.1),
    }
    other = dataclasses.replace(CALIBRATION, functions=functions)
    publisher = replay.peer.node.create_publisher(String, "calibration", LATCHED)
    publisher.publish(String(data=other.dumps()))

    def scale_is(calibration: Calibration) -> bool:
        (k,) = replay.peer.get_parameters(SERVER, "k@1000")
        return math.isclose(k.double_array_value[0], calibration.at(1000.0).K[0, 0])

    replay.peer.wait_for(lambda: scale_is(other), "the other calibration")
    assert replay.peer.trigger(f"{SERVER}/reload").success
    replay.peer.wait_for(lambda: scale_is(CALIBRATION), "the file's calibration")
    replay.peer.node.destroy_publisher(publisher)


# -- both jobs in one node ----------------------------------------------------------------------


def test_stream_corrector_corrects_every_frame(replay: Replay, tmp_path: Path) -> None:
    """In a namespace of its own; it hears of the calibration from the server that is still up."""
    magnifications = [1500.0] * 4
    write_recording(tmp_path / "bag", magnifications)
    peer = Peer("other_peer", "other")
    remap = ("-r", "__ns:=/other", "-r", "calibration:=/sem/calibration")
    topics = [(f"/sem/{name}", f"/other/{name}") for name in ("image_raw", "magnification")]
    topics = [text for old, new in topics for text in ("-r", f"{old}:={new}")]
    images = peer.collect(Image, "image_rect")
    infos = peer.collect(CameraInfo, "camera_info")
    drifts = peer.collect(PoseWithCovarianceStamped, "drift")
    velocities = peer.collect(TwistWithCovarianceStamped, "drift_velocity", RELIABLE)
    masks = peer.collect(Image, "stream_corrector/moving", RELIABLE)
    settings = {
        "config": "virtual_sem",
        "qos_overrides./other/image_raw.subscription.depth": 50,
    }
    with running("stream_corrector", settings, *remap) as corrector:
        peer.wait_for(lambda: "calibration from topic" in corrector.output, "the calibration")
        outputs = ("image_rect", "camera_info", "drift", "drift_velocity", "~/moving")
        peer.wait_heard("/other/stream_corrector", *outputs)
        player = {"bag": tmp_path / "bag", "start_paused": True, "wait_for_subscribers": 1}
        with running("bag_player", player, *topics, *remap[:2]):
            peer.call(SetBool, "/other/bag_player/pause", SetBool.Request(data=False))
            results = (images, infos, drifts, velocities, masks)
            peer.wait_for(lambda: min(map(len, results)) >= 4, "4 frames")
        answer = peer.trigger("stream_corrector/reset")
        assert answer.success
    peer.close()
    assert [stamp_of(m) for m in images] == [stamp_of(m) for m in infos]
    assert [stamp_of(m) for m in images] == [stamp_of(m) for m in drifts]
    assert [stamp_of(m) for m in images] == [stamp_of(m) for m in masks]
    assert (masks[0].width, masks[0].height, masks[0].encoding) == (
        images[0].width,
        images[0].height,
        "mono8",
    )
    assert infos[0].k[0] == pytest.approx(CALIBRATION.at(1500.0).rectified.K[0, 0])
    # A new keyframe is where drift is zero by definition, exactly.
    first = drifts[0].pose.pose.position
    assert (first.x, first.y) == (0.0, 0.0)
