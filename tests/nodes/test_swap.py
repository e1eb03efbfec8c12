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

"""Another calibration comes into force while frames stream: between two frames, everywhere, and for good."""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rcl_interfaces.msg import ParameterType, ParameterValue
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float64, String

from semcal_ros.calibration import Calibration
from semcal_ros.core.camera.residual_field import zero_field
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.nodes.frames.calibration_input import calibration_digest
from tests.helpers.node_scenes import (
    RANGE,
    SIZE,
    image_message,
    magnification_message,
    make_calibration,
    stamp_of,
    texture,
)
from tests.helpers.ros_process import LATCHED, PATIENT, RELIABLE, NodeProcess, Peer, running

MAGNIFICATION = 2000.0
SERVER, RECTIFIER, CORRECTOR = "/sem/parameter_server", "/sem/rectifier", "/sem/stream_corrector"


def _scaled(calibration: Calibration, factor: float) -> Calibration:
    scale = calibration.functions["scale"]
    other = dataclasses.replace(scale, coefficients=factor * scale.coefficients)
    return dataclasses.replace(calibration, functions={**calibration.functions, "scale": other})


def _with_field(calibration: Calibration) -> Calibration:
    """As large as calibrations get in earnest: a residual field, and the joint covariance of everything."""
    field = zero_field((SIZE, SIZE), RANGE, 3)
    size = sum(f.size for f in calibration.functions.values()) + field.size
    return dataclasses.replace(calibration, residual=field, covariance=np.eye(size) * 1e-8)


def _undistorted(calibration: Calibration) -> Calibration:
    bent = calibration.functions["xi_r"]
    straight = dataclasses.replace(bent, coefficients=0.0 * bent.coefficients)
    return dataclasses.replace(calibration, functions={**calibration.functions, "xi_r": straight})


A = make_calibration()
B = _undistorted(_scaled(A, 1.25))
# Parsing this one takes long, for which nobody may wait.
SLOW = dataclasses.replace(B, statistics={"notes": [[float(i), i + 0.5] for i in range(12_000)]})


def _text(path: object) -> ParameterValue:
    return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=str(path))


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    paths = {"a": tmp_path / "a.yaml", "b": tmp_path / "b.yaml"}
    A.save(paths["a"])
    B.save(paths["b"])
    return paths


class Stream:
    """Frames from this side, and what a stream node makes of them."""

    def __init__(self, peer: Peer, node: str, pictures: int = 5) -> None:
        self.peer = peer
        self.node = node
        self._pictures = pictures
        self._image = peer.node.create_publisher(Image, "image_raw", RELIABLE)
        self._magnification = peer.node.create_publisher(Float64, "magnification", LATCHED)
        self.images = peer.collect(Image, "image_rect")
        self.infos = peer.collect(CameraInfo, "camera_info")
        self.sent: dict[tuple[int, int], NDArray[np.uint8]] = {}
        self._timer: Any = None

    def ready(self) -> None:
        """Wait until nothing can be lost."""
        self.peer.wait_heard(self.node, "image_rect", "camera_info")
        self.peer.wait_for(lambda: self._image.get_subscription_count() == 1, "a listener")
        self._magnification.publish(magnification_message(MAGNIFICATION))

    def send(self) -> None:
        number = len(self.sent) + 1
        picture = texture(1 + number % self._pictures)
        message = image_message(picture, stamp_s=0.1 * number)
        self.sent[stamp_of(message)] = picture
        self._image.publish(message)

    def start(self, rate_hz: float) -> None:
        """Send from now on, whenever this side waits."""
        self._timer = self.peer.node.create_timer(1.0 / rate_hz, self.send)

    def stop(self) -> None:
        """Send no more, and wait for what is on its way."""
        self._timer.cancel()
        self.peer.wait_for(
            lambda: min(len(self.images), len(self.infos)) >= len(self.sent),
            f"{len(self.sent)} frames",
        )

    def wait_more(self, count: int) -> None:
        goal = len(self.images) + count
        self.peer.wait_for(lambda: len(self.images) >= goal, f"{count} more frames")


def _of_image(stream: Stream, message: Any) -> str:
    """Which calibration rectified an image, exactly."""
    picture = stream.sent[stamp_of(message)]
    received = np.frombuffer(message.data, np.uint8).reshape(picture.shape)
    made = [
        name
        for name, calibration in {"A": A, "B": B}.items()
        if np.array_equal(received, Rectifier().rectify(picture, calibration.at(MAGNIFICATION)))
    ]
    assert len(made) == 1, "rectified by neither, or by both"
    return made[0]


def _of_info(message: Any) -> str:
    matrix = np.reshape(message.k, (3, 3))
    matches = [
        n
        for n, c in {"A": A, "B": B}.items()
        if np.allclose(matrix, c.at(MAGNIFICATION).rectified.K)
    ]
    assert len(matches) == 1
    return matches[0]


def _by_topic(peer: Peer, _files: dict[str, Path]) -> None:
    peer.node.create_publisher(String, "calibration", LATCHED).publish(String(data=B.dumps()))


def _by_parameter(peer: Peer, files: dict[str, Path]) -> None:
    assert peer.set_parameter(RECTIFIER, "calibration", _text(files["b"])).successful


@pytest.mark.parametrize("swap", [_by_topic, _by_parameter])
def test_each_image_and_its_camera_info_are_of_one_calibration(
    peer: Peer, files: dict[str, Path], swap: Callable[[Peer, dict[str, Path]], None]
) -> None:
    stream = Stream(peer, RECTIFIER)
    with running("rectifier", {"calibration": files["a"], **PATIENT}):
        stream.ready()
        stream.start(60.0)
        stream.wait_more(20)
        swap(peer, files)
        peer.wait_for(lambda: _of_info(stream.infos[-1]) == "B", "the other calibration")
        stream.wait_more(20)
        stream.stop()
    # Each of them has come, in the order in which they were sent.
    assert [stamp_of(m) for m in stream.images] == list(stream.sent)
    assert [stamp_of(m) for m in stream.infos] == list(stream.sent)
    by = [_of_image(stream, message) for message in stream.images]
    assert by == [_of_info(message) for message in stream.infos]
    assert by == sorted(by)
    assert set(by) == {"A", "B"}


def test_a_node_that_also_removes_drift_swaps_both_at_once(
    peer: Peer, files: dict[str, Path]
) -> None:
    """Nothing moves here, so that its images are those of the rectifier but for hundredths of a pixel."""
    stream = Stream(peer, CORRECTOR, pictures=1)
    with running("stream_corrector", {"calibration": files["a"], **PATIENT}):
        stream.ready()
        stream.start(20.0)
        stream.wait_more(10)
        _by_topic(peer, files)
        peer.wait_for(lambda: _of_info(stream.infos[-1]) == "B", "the other calibration")
        stream.wait_more(10)
        stream.stop()
    picture = texture(1)
    wanted = {
        name: Rectifier().rectify(picture, calibration.at(MAGNIFICATION)).astype(float)
        for name, calibration in {"A": A, "B": B}.items()
    }
    by = []
    for message in stream.images:
        received = np.frombuffer(message.data, np.uint8).reshape(picture.shape)
        errors = {name: np.median(np.abs(received - image)) for name, image in wanted.items()}
        by.append(min(errors, key=errors.get))
        assert errors[by[-1]] <= 2.0 < 0.5 * max(errors.values())
    assert by == [_of_info(message) for message in stream.infos]
    assert by == sorted(by)
    assert set(by) == {"A", "B"}


def test_no_frame_waits_until_a_large_calibration_is_read(
    peer: Peer, files: dict[str, Path]
) -> None:
    stream = Stream(peer, RECTIFIER)
    # How many frames were sent by the time that each came out; the clock of a busy machine would prove nothing.
    sent_by: list[int] = []
    peer.node.create_subscription(
        Image, "image_rect", lambda _message: sent_by.append(len(stream.sent)), RELIABLE
    )
    with running("rectifier", {"calibration": files["a"], **PATIENT}):
        stream.ready()
        # A quick machine reads it in a quarter of a second; that must be many frames.
        stream.start(60.0)
        stream.wait_more(5)
        publisher = peer.node.create_publisher(String, "calibration", LATCHED)
        publisher.publish(String(data=SLOW.dumps()))
        begin = len(stream.sent)
        peer.wait_for(lambda: _of_info(stream.infos[-1]) == "B", "the other calibration")
        reading = len(stream.sent) - begin
        stream.stop()
    # It took many frames to read, and none of them waited for half as long.
    assert reading >= 8
    late = [sent - number for number, sent in enumerate(sent_by, 1)]
    assert max(late[begin:]) < 0.5 * reading, (late, reading)


def test_a_bad_calibration_leaves_the_old_one_in_force(peer: Peer, files: dict[str, Path]) -> None:
    stream = Stream(peer, RECTIFIER)
    publisher = peer.node.create_publisher(String, "calibration", LATCHED)
    inner = "statistics: " + 10_000 * "[" + 10_000 * "]"
    bad = {
        "not valid YAML": A.dumps() + "[",
        "required property": A.dumps()[:500],
        "anchor": A.dumps().replace("statistics: {}", "statistics: &own {again: *own}"),
        "nested more than": A.dumps().replace("statistics: {}", inner),
        "calibration message with 0 bytes": "",
        "image_width_px": A.dumps().replace("image_width_px: 96", "image_width_px: -1"),
    }
    with running("rectifier", {"calibration": files["a"], **PATIENT}) as node:
        stream.ready()
        for reason, text in bad.items():
            publisher.publish(String(data=text))
            peer.wait_for(
                lambda r=reason: r in peer.state(RECTIFIER).get("last_rejection", ""), reason
            )
        files["b"].write_text(B.dumps()[:500])
        result = peer.set_parameter(RECTIFIER, "calibration", _text(files["b"]))
        assert not result.successful
        assert "b.yaml" in result.reason
        stream.send()
        peer.wait_for(lambda: stream.images, "the frame")
        assert _of_image(stream, stream.images[0]) == "A"
        assert peer.state(RECTIFIER)["calibration_digest"] == calibration_digest(A.dumps())
        assert node.process.poll() is None


def _digests(peer: Peer) -> set[str]:
    nodes = (SERVER, RECTIFIER, CORRECTOR)
    return {peer.state(node).get("calibration_digest", "none yet") for node in nodes}


def _wait_all(peer: Peer, calibration: Calibration) -> None:
    wanted = {calibration_digest(calibration.dumps())}
    peer.wait_for(lambda: _digests(peer) == wanted, f"all nodes at {wanted}; {_digests(peer)}")


class Suite:
    """The parameter server and the stream nodes, each of which can be killed and started again."""

    def __init__(self, stack: ExitStack, file: Path) -> None:
        self._stack = stack
        self._file = file
        self.processes: dict[str, NodeProcess] = {}
        for name in ("parameter_server", "rectifier", "stream_corrector"):
            self.start(name)

    def start(self, name: str) -> None:
        queue = {} if name == "parameter_server" else PATIENT
        self.processes[name] = self._stack.enter_context(
            running(name, {"calibration": self._file, **queue})
        )

    def restart(self, name: str) -> None:
        self.processes[name].stop(signal.SIGKILL)
        self.start(name)


def _taken(process: NodeProcess) -> list[str]:
    """Digests of the calibrations that a node took over one after the other, from its log."""
    lines = [line for line in process.output.splitlines() if ": calibration from " in line]
    return [line.partition("; it displaces ")[0].rpartition(", ")[2] for line in lines]


@pytest.mark.long
def test_all_nodes_agree_and_find_back_after_a_crash(peer: Peer, files: dict[str, Path]) -> None:
    """Their start parameter names A all the time."""
    of_a, of_b = calibration_digest(A.dumps()), calibration_digest(B.dumps())
    with ExitStack() as stack:
        suite = Suite(stack, files["a"])
        _wait_all(peer, A)
        # As after ~/calibrate of another node.
        holder = peer.node.create_publisher(String, "calibration", LATCHED)
        holder.publish(String(data=B.dumps()))
        _wait_all(peer, B)
        for name in ("rectifier", "parameter_server"):
            suite.restart(name)
            peer.wait_for(lambda n=name: of_b in _taken(suite.processes[n]), f"B in {name}")
        # The topic wins over the file of the start, and nobody went back to that in between.
        assert [_taken(process) for process in suite.processes.values()] == 3 * [[of_a, of_b]]
        _wait_all(peer, B)

        # The server's word counts, too, when nobody else holds the calibration.
        peer.node.destroy_publisher(holder)
        assert peer.trigger(f"{SERVER}/reload").success
        _wait_all(peer, A)
        assert peer.set_parameter(SERVER, "calibration", _text(files["b"])).successful
        _wait_all(peer, B)


def test_the_last_of_two_calibrations_at_once_comes_into_force(
    peer: Peer, files: dict[str, Path]
) -> None:
    """A server that publishes what it hears must not take its own words for news."""
    texts = peer.collect(String, "calibration", RELIABLE)
    with running("parameter_server", {"calibration": files["a"]}):
        peer.wait_heard(SERVER, "calibration")
        publisher = peer.node.create_publisher(String, "calibration", LATCHED)
        peer.wait_for(lambda: publisher.get_subscription_count() == 2, "the server")
        for factor in (1.1, 1.2, 1.3):
            # While the second one is being read, the server publishes the first one.
            quick, slow = (c.dumps() for c in (_scaled(A, factor), _with_field(_scaled(B, factor))))
            publisher.publish(String(data=quick))
            publisher.publish(String(data=slow))
            wanted = calibration_digest(slow)
            peer.wait_for(
                lambda w=wanted: peer.state(SERVER).get("calibration_digest") == w, "the second"
            )
        peer.wait_for(_at_rest(peer, texts), "the server to come to rest")
        assert peer.state(SERVER)["calibration_digest"] == wanted
        assert texts[-1].data == slow


def _at_rest(peer: Peer, texts: list[Any]) -> Callable[[], bool]:
    """Whether no text has come in between two reports, which come once a second."""
    seen: dict[int, int] = {}

    def unchanged() -> bool:
        reports = len(peer.diagnostics)
        seen.setdefault(reports, len(texts))
        return reports >= 3 and seen.get(reports - 2) == len(texts)

    return unchanged
