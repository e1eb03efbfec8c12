"""Views are collected from a live stream and calibrated by service calls."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from node_scenes import image_message, magnification_message
from rcl_interfaces.msg import ParameterType, ParameterValue
from ros_process import LATCHED, RELIABLE, Peer, running
from sensor_msgs.msg import Image
from std_msgs.msg import Float64, String

from semcal_ros.calibration import Calibration
from semcal_ros.synthetic import Detector, calibration_plan, preset

SERVER = "/sem/calibration_server"
MAGNIFICATIONS = (500.0, 1000.0, 2000.0, 4000.0)
VIEWS = 4
SIZE = 384
PLAN = calibration_plan(
    preset("jsm820").with_image_size(SIZE, SIZE),
    magnifications=MAGNIFICATIONS,
    views=VIEWS,
    detector=Detector(),
    seed=5,
)


@dataclass
class Session:
    """A calibration server, and this side of its topics."""

    peer: Peer
    image: Any
    magnification: Any
    overlays: list[Any]
    progress: list[Any]
    texts: list[Any]
    published: int = 0

    def show(self, picture: np.ndarray, g: float) -> None:
        """Publish a frame and wait until the server has it."""
        self.published += 1
        self.magnification.publish(magnification_message(g))
        self.image.publish(image_message(picture, stamp_s=float(self.published)))

        def seen() -> bool:
            state = self.peer.state(SERVER)
            return (
                int(state.get("received", 0)) >= self.published
                and state.get("magnification") == f"{g:.6g}"
            )

        self.peer.wait_for(seen, f"frame {self.published}")

    def call(self, service: str) -> Any:
        return self.peer.trigger(f"{SERVER}/{service}", timeout_s=120.0)


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Session]:
    peer = Peer()
    made = Session(
        peer,
        peer.node.create_publisher(Image, "image_raw", RELIABLE),
        peer.node.create_publisher(Float64, "magnification", LATCHED),
        peer.collect(Image, f"{SERVER}/overlay"),
        peer.collect(DiagnosticStatus, f"{SERVER}/progress", LATCHED),
        peer.collect(String, "calibration", LATCHED),
    )
    with running("calibration_server", {"config": "virtual_sem"}):
        peer.wait_heard(SERVER, "~/overlay", "calibration")
        peer.wait_for(lambda: made.image.get_subscription_count() == 1, "the subscription")
        yield made
    peer.close()


def test_there_is_nothing_to_add_calibrate_or_save_at_first(session: Session) -> None:
    for service, reason in (
        ("add_view", "no frame with a known magnification yet"),
        ("calibrate", "no usable view"),
        ("save", "no calibration to save"),
    ):
        answer = session.call(service)
        assert not answer.success
        assert reason in answer.message


def test_an_image_without_a_grid_is_refused_with_a_reason_and_shown(session: Session) -> None:
    flat = np.random.default_rng(1).normal(120, 10, (SIZE, SIZE)).clip(0, 255).astype(np.uint8)
    session.show(flat, 1000.0)
    count = len(session.overlays)
    answer = session.call("add_view")
    assert not answer.success
    assert answer.message.startswith("no grid found at 1000x: ")
    session.peer.wait_for(lambda: len(session.overlays) > count, "the overlay")


def test_views_are_calibrated_on_demand(session: Session, tmp_path: Path) -> None:
    for index, frame in enumerate(PLAN.frames):
        session.show(PLAN.render(index), frame.magnification)
        answer = session.call("add_view")
        assert answer.success, answer.message
    assert not session.call("add_view").success  # the same frame again
    overlay = session.peer.wait_for(lambda: session.overlays[-1], "the overlay")
    assert (overlay.encoding, overlay.width, overlay.height) == ("bgr8", SIZE, SIZE)
    pixels = np.frombuffer(overlay.data, np.uint8).reshape(SIZE, SIZE, 3)
    assert np.any(np.ptp(pixels, axis=2) > 100)  # marks in colour

    answer = session.call("calibrate")
    assert answer.success, answer.message
    text = session.peer.wait_for(lambda: session.texts, "the calibration")[-1].data
    calibration = Calibration.loads(text)
    assert calibration.magnifications == MAGNIFICATIONS
    assert calibration.method == "joint"
    progress = {v.key: v.value for v in session.progress[-1].values}
    assert progress["views"] == str(VIEWS * len(MAGNIFICATIONS))
    assert progress["views at 2000x"] == str(VIEWS)

    for g in MAGNIFICATIONS:
        camera, truth = calibration.at(g), PLAN.microscope.camera_at(g)
        # 16 views of 384 px leave 0.2 % (1-sigma) of scale at worst, since tilt and scale trade off.
        assert camera.pixel_size_m == pytest.approx(truth.pixel_size_m, rel=0.006)
        sigma = np.sqrt(camera.covariance[0, 0]) / camera.m
        assert 0.0 < sigma < 0.004

    file = tmp_path / "live.yaml"
    value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=str(file))
    assert session.peer.set_parameter(SERVER, "output", value).successful
    answer = session.call("save")
    assert answer.success, answer.message
    assert Calibration.load(file).dumps() == calibration.dumps()


def test_too_few_views_are_refused_and_the_calibration_stays(session: Session) -> None:
    before = len(session.texts)
    assert session.call("clear").message == f"{VIEWS * len(MAGNIFICATIONS)} views removed"
    session.show(PLAN.render(0), MAGNIFICATIONS[0])
    assert session.call("add_view").success
    answer = session.call("calibrate")
    assert not answer.success
    assert "expected at least 3 views" in answer.message
    assert len(session.texts) == before


def test_an_unknown_method_is_refused(session: Session) -> None:
    value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value="magic")
    result = session.peer.set_parameter(SERVER, "method", value)
    assert not result.successful
    assert "one of" in result.reason
