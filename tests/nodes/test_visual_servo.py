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

"""visual_servo over real DDS: what stops the stage, and the closed loop with the virtual SEM and the corrector."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, Twist
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float64, Float64MultiArray

from semcal_ros.bridge.drift import fill_drift
from semcal_ros.bridge.projection import (
    fill_camera_info,
    fill_projection,
    fill_stamped_projection,
    fill_stamped_projection_covariance,
)
from semcal_ros.calibration import Calibration
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.synthetic import NOISE_FREE, Pose, preset, render_frame
from semcal_ros.synthetic.specimens.target import TargetSpecimen
from tests.helpers.node_scenes import image_message
from tests.helpers.ros_process import LATCHED, RELIABLE, NodeProcess, Peer, running

SERVO = "/sem/visual_servo"
SIZE = 256
SCOPE = replace(preset("ideal"), timing=ScanTiming(0.1)).with_image_size(SIZE, SIZE)
G = 2000.0
NEVER_FAST = {"speed_limit_um_s": 0.2, "config": "virtual_sem", "start": True}


def _picture(x_m: float) -> np.ndarray:
    detector = replace(NOISE_FREE, bits=8)
    pose = Pose.flat((x_m, 0.0, 0.0))
    return render_frame(SCOPE, TargetSpecimen(), pose, G, detector=detector)


class Microscope:
    """A peer in the place of the corrector: frames whose stage never moves."""

    def __init__(self, peer: Peer) -> None:
        make = peer.node.create_publisher
        self.peer = peer
        self.images = make(Image, "image_rect", RELIABLE)
        self.infos = make(CameraInfo, "camera_info", RELIABLE)
        self.drifts = make(PoseWithCovarianceStamped, "drift", RELIABLE)
        self.projections = make(Float64MultiArray, "projection", LATCHED)
        self.matrices = make(Image, "projection_stamped", RELIABLE)
        self.spreads = make(Image, "projection_covariance_stamped", RELIABLE)
        self.with_stamped = False
        self.scale_sigma: float | None = None
        self.late_s = 0.0
        self._stamp_s = 0.0
        self.knob = make(Float64, "magnification", LATCHED)
        self.twists = peer.collect(Twist, "virtual_sem/stage")
        self.errors = peer.collect(PoseWithCovarianceStamped, "visual_servo/error")
        self.picture = _picture(6e-6)
        self.camera: Any = SCOPE.camera_at(G)
        self.drift_m = (0.0, 0.0)

    def tell_camera(self, g: float) -> None:
        message = Float64MultiArray()
        fill_projection(message, SCOPE.camera_at(g))
        self.projections.publish(message)
        self.knob.publish(Float64(data=g))

    def frame(self, ago_s: float = 0.0) -> None:
        """One frame that was scanned until now, or until some time ago."""
        # A stream that falls behind keeps its order.
        self._stamp_s = max(time.time() - 0.6 - ago_s, self._stamp_s + 0.01)
        image = image_message(self.picture, self._stamp_s)
        info, drift = CameraInfo(), PoseWithCovarianceStamped()
        fill_camera_info(info, self.camera, image.header, SIZE, SIZE)
        fill_drift(drift, self.drift_m, np.eye(2) * 1e-18, image.header)
        if self.scale_sigma is not None:
            spread = Image()
            sigmas = [self.scale_sigma * self.camera.m, *[0.0] * 9]
            known = replace(self.camera, covariance=np.diag(sigmas) ** 2)
            fill_stamped_projection_covariance(spread, known, image.header, SIZE, SIZE)
            self.spreads.publish(spread)
        if self.with_stamped:
            matrix = Image()
            fill_stamped_projection(matrix, self.camera, image.header, SIZE, SIZE)
            self.matrices.publish(matrix)
        # The order of arrival is not that of the pairs.
        self.drifts.publish(drift)
        self.images.publish(image)
        self.infos.publish(info)

    def frames_until(self, condition: Any, what: str) -> Any:
        """Send frames until something holds."""
        due = [0.0]

        def sent() -> Any:
            if time.monotonic() >= due[0]:
                self.frame(self.late_s)
                due[0] = time.monotonic() + 0.15
            return condition()

        return self.peer.wait_for(sent, what)

    @property
    def speed(self) -> float:
        """Last commanded speed along x; nan before the first."""
        return self.twists[-1].linear.x if self.twists else float("nan")


@contextmanager
def servoed(peer: Peer, **changes: Any) -> Iterator[tuple[Microscope, NodeProcess]]:
    """The node on a target 6 um off its goal, with the stage on its way."""
    microscope = Microscope(peer)
    with running("visual_servo", {**NEVER_FAST, **changes}) as node:
        peer.wait_heard(SERVO, "virtual_sem/stage", "~/error")
        inputs = (microscope.images, microscope.infos, microscope.drifts, microscope.projections)
        peer.wait_for(
            lambda: all(p.get_subscription_count() for p in (*inputs, microscope.knob)), "the node"
        )
        microscope.tell_camera(G)
        yield microscope, node


def _moves(microscope: Microscope) -> bool:
    return microscope.speed < 0.0


def _stands(microscope: Microscope) -> bool:
    return microscope.speed == 0.0


def test_it_waits_for_the_start_and_stops_without_frames_and_when_asked(peer: Peer) -> None:
    with servoed(peer, start=False) as (microscope, _):
        microscope.frames_until(lambda: len(microscope.errors) >= 3, "measurements")
        # The target is seen and nothing moves.
        assert microscope.errors[-1].pose.pose.position.x == pytest.approx(6e-6, abs=20e-9)
        assert all(t.linear.x == 0.0 for t in microscope.twists)
        assert peer.trigger(f"{SERVO}/start").success
        microscope.frames_until(lambda: _moves(microscope), "a command")
        # Towards the goal, not faster than allowed.
        assert all(abs(t.linear.x) <= 0.2e-6 * (1 + 1e-9) for t in microscope.twists)
        peer.wait_for(lambda: _stands(microscope), "the stop without frames")
        assert peer.wait_for(
            lambda: "no frames" in peer.state(SERVO).get("servo_state", ""), "the reason"
        )
        microscope.frames_until(lambda: _moves(microscope), "a command again")
        assert peer.trigger(f"{SERVO}/stop").success
        peer.wait_for(lambda: _stands(microscope), "the stop")
        count = len(microscope.errors)
        microscope.frames_until(lambda: len(microscope.errors) > count + 1, "measurements")
        assert _stands(microscope)


@pytest.mark.long
def test_frames_that_came_seldom_do_not_let_it_move_unseen_for_longer(peer: Peer) -> None:
    """A processor that is too slow takes one frame of many; what counts is the time that the microscope needs."""
    with servoed(peer) as (microscope, _):

        def received(count: int) -> bool:
            return int(peer.state(SERVO).get("published", 0)) >= count

        microscope.frame(ago_s=20.0)
        peer.wait_for(lambda: received(1), "the first frame")
        microscope.frame()
        peer.wait_for(lambda: _moves(microscope), "a moving stage")
        # 2.5 of the 0.5 s of a frame, and not of the 20 s between the two that came.
        peer.wait_for(lambda: microscope.speed == 0.0, "a stop", timeout_s=8.0)
        peer.wait_for(lambda: "no frames" in peer.state(SERVO).get("servo_state", ""), "the reason")
        assert microscope.speed == 0.0


@pytest.mark.parametrize("ahead_s", [0.0, 3600.0], ids=["own clock", "another clock"])
@pytest.mark.long
def test_frames_that_come_too_late_do_not_move_it(peer: Peer, ahead_s: float) -> None:
    with servoed(peer) as (microscope, _):
        microscope.late_s = -ahead_s
        microscope.frames_until(lambda: _moves(microscope), "motion")
        microscope.late_s = 4.0 - ahead_s
        microscope.frames_until(lambda: microscope.speed == 0.0, "the stop")
        first = len(microscope.twists)
        state = microscope.frames_until(
            lambda: "s old" in peer.state(SERVO)["servo_state"] and peer.state(SERVO), "the reason"
        )
        microscope.frames_until(lambda: len(microscope.twists) > first + 5, "some more")
        assert not any(twist.linear.x for twist in microscope.twists[first:])
        assert "frames are" in state["message"]
        microscope.late_s = -ahead_s
        microscope.frames_until(lambda: _moves(microscope), "motion again")


@pytest.mark.long
def test_a_simulated_clock_that_begins_after_the_frames_does_not_make_them_old(peer: Peer) -> None:
    clock = peer.node.create_publisher(ClockMessage, "/clock", RELIABLE)
    with servoed(peer, use_sim_time=True, start=False) as (microscope, _):
        # Without a clock it is the year 1970.
        microscope.frames_until(lambda: len(microscope.errors) > 3, "measurements without a clock")
        peer.wait_for(clock.get_subscription_count, "the node at the clock")
        count = len(microscope.errors)

        def measured() -> bool:
            message = ClockMessage()
            message.clock.sec, message.clock.nanosec = divmod(time.time_ns(), 10**9)
            clock.publish(message)
            return len(microscope.errors) > count + 10

        microscope.frames_until(measured, "measurements by the clock")
        assert microscope.errors[-1].pose.pose.position.x == pytest.approx(6e-6, abs=20e-9)


def test_a_start_without_a_stream_says_what_it_waits_for(peer: Peer) -> None:
    with running("visual_servo", {"config": "virtual_sem"}):
        answer = peer.trigger(f"{SERVO}/start")
    assert answer.success
    for topic in ("image_rect", "camera_info", "drift"):
        assert topic in answer.message


def test_the_stamped_projection_of_a_frame_is_enough(peer: Peer) -> None:
    """No parameter_server, and a parallel camera besides, which has no K to search by."""
    microscope = Microscope(peer)
    microscope.with_stamped = True
    with running("visual_servo", NEVER_FAST):
        peer.wait_heard(SERVO, "virtual_sem/stage", "~/error")
        inputs = (microscope.images, microscope.infos, microscope.drifts, microscope.matrices)
        peer.wait_for(lambda: all(p.get_subscription_count() for p in inputs), "the node")
        microscope.frames_until(lambda: _moves(microscope), "a command")
        microscope.camera = None
        microscope.frames_until(lambda: _stands(microscope), "the stop without a camera")
        microscope.camera = replace(SCOPE.camera_at(G), rho=0.0)
        microscope.frames_until(lambda: _moves(microscope), "a command by a parallel camera")
        assert microscope.errors[-1].pose.pose.position.x < 7e-6


def test_the_stated_uncertainty_has_that_of_the_calibrations_scale(peer: Peer) -> None:
    microscope = Microscope(peer)
    microscope.with_stamped, microscope.scale_sigma = True, 0.0
    with running("visual_servo", {**NEVER_FAST, "start": False}):
        peer.wait_heard(SERVO, "~/error")
        inputs = (microscope.matrices, microscope.spreads, microscope.images, microscope.infos)
        peer.wait_for(lambda: all(p.get_subscription_count() for p in inputs), "the node")

        def stated_m() -> float:
            return float(peer.state(SERVO).get("servo_sigma_m", "inf"))

        microscope.frames_until(lambda: stated_m() < 5e-9, "the uncertainty of the image")
        # 1 % of the 6 um by which the target is off the axis.
        microscope.scale_sigma = 0.01
        microscope.frames_until(lambda: 58e-9 < stated_m() < 65e-9, "that of the scale")
        microscope.frames_until(
            lambda: microscope.errors[-1].pose.covariance[0] > (55e-9) ** 2, "its covariance"
        )
        # Without it, as from bags of earlier versions, it is that of the image again.
        microscope.scale_sigma = None
        microscope.frames_until(lambda: stated_m() < 5e-9, "the uncertainty of the image alone")
        assert microscope.errors[-1].pose.covariance[0] < (10e-9) ** 2


def test_a_lost_target_a_missing_camera_and_a_turned_knob_stop_it(peer: Peer) -> None:
    with servoed(peer) as (microscope, _):

        def stopped(reason: str) -> None:
            microscope.frames_until(lambda: _stands(microscope), f"the stop: {reason}")
            microscope.frames_until(
                lambda: reason in peer.state(SERVO).get("servo_state", ""), reason
            )
            assert _stands(microscope)

        def goes() -> None:
            microscope.frames_until(lambda: _moves(microscope), "a command")

        goes()
        kept, microscope.picture = microscope.picture, np.full((SIZE, SIZE), 128, np.uint8)
        stopped("blank")
        microscope.picture = kept
        goes()
        microscope.camera = None
        stopped("without a camera")
        microscope.camera = SCOPE.camera_at(G)
        goes()
        # A camera that is consistent in itself, and of another magnification than the image.
        microscope.camera = SCOPE.camera_at(1.3 * G)
        microscope.tell_camera(1.3 * G)
        # No further frame is needed for that.
        peer.wait_for(lambda: _stands(microscope), "the stop by the knob")
        stopped("times as large")


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGTERM], ids=["sigint", "sigterm"])
def test_the_last_word_is_zero(peer: Peer, ending: int) -> None:
    with servoed(peer) as (microscope, node):
        microscope.frames_until(lambda: _moves(microscope), "a command")
        assert node.stop(ending) == 0
        peer.wait_for(lambda: _stands(microscope), "the last command")
        assert "Traceback" not in node.output


def test_a_picture_that_does_not_follow_stops_it_until_it_is_started_again(peer: Peer) -> None:
    with servoed(peer, speed_limit_um_s=50.0, travel_limit_px=8.0) as (microscope, _):
        microscope.frames_until(
            lambda: "does not follow" in peer.state(SERVO).get("servo_state", ""), "the refusal"
        )
        assert _stands(microscope)
        assert peer.trigger(f"{SERVO}/start").success
        microscope.frames_until(lambda: _moves(microscope), "a command")


def test_the_drift_of_the_frame_is_added_again(peer: Peer) -> None:
    with servoed(peer) as (microscope, _):
        microscope.drift_m = (-6e-6, 1e-6)
        microscope.frames_until(lambda: len(microscope.errors) >= 2, "measurements")
        place = microscope.errors[-1].pose.pose.position
        assert (place.x, place.y) == pytest.approx((0.0, 1e-6), abs=20e-9)


def _calibration() -> Calibration:
    """The truth of the preset `ideal` as a calibration: what is tested is the loop, not the calibration."""
    values = {"scale": 1.0, "aspect": 1.0, "skew": 0.0, "px": 127.5, "py": 127.5, "rho": 50.0}
    values |= {"xi_r": 0.0, "xi_t": 0.0, "ex": 127.5, "ey": 127.5}
    return Calibration(
        functions={
            name: ContinuousFunction("chebyshev_log", np.array([value]), (400.0, 6000.0))
            for name, value in values.items()
        },
        covariance=np.eye(10) * 1e-12,
        image_width=SIZE,
        image_height=SIZE,
        display_width_m=0.12,
        magnifications=(400.0, 6000.0),
        method="joint",
    )


@pytest.mark.long
def test_the_nodes_together_converge_across_magnifications(peer: Peer, tmp_path: Path) -> None:
    """virtual_sem, parameter_server, stream_corrector and visual_servo; the goal is kept from 1000x to 4000x."""
    _calibration().save(tmp_path / "cal.yaml")
    calibrated = {"config": "virtual_sem", "calibration": tmp_path / "cal.yaml"}
    scene = {
        "preset": "ideal",
        "specimen": "target",
        "width": SIZE,
        "height": SIZE,
        "magnification": 1000.0,
        "rotation_deg": 4.0,
        # Slow enough for a busy machine to finish each frame before it is too old to move the stage.
        "rate": 2.0,
    }
    goal = {
        "config": "virtual_sem",
        "goal_x_m": 5e-6,
        "goal_y_m": -3e-6,
        "tolerance_px": 1.0,
        "start": True,
    }
    errors = peer.collect(PoseWithCovarianceStamped, "visual_servo/error")
    knob = peer.node.create_publisher(Float64, "virtual_sem/set_magnification", RELIABLE)
    with (
        running("parameter_server", calibrated),
        running("stream_corrector", calibrated),
        running("visual_servo", goal),
        running("virtual_sem", scene),
    ):
        for g in (1000.0, 2000.0, 4000.0):
            peer.wait_for(lambda: knob.get_subscription_count() == 1, "the knob")
            knob.publish(Float64(data=g))
            try:
                peer.wait_for(
                    lambda value=g: (
                        peer.state(SERVO).get("servo_state") == "converged"
                        and float(peer.state("/sem/stream_corrector").get("magnification", "nan"))
                        == value
                        and float(peer.state(SERVO).get("servo_error_px", "nan")) < 1.0
                    ),
                    f"convergence at {g:g}x",
                    # Four processes; the stage stands still while they are late.
                    timeout_s=55.0,
                )
            except AssertionError as error:
                nodes = ("virtual_sem", "stream_corrector", "visual_servo")
                raise AssertionError(
                    [str(error), *(peer.state(f"/sem/{n}") for n in nodes)]
                ) from None
    place = errors[-1].pose.pose.position
    # Two px at 4000x.
    assert np.hypot(place.x, place.y) < 2.0 * 0.12 / 4000.0 / SIZE
