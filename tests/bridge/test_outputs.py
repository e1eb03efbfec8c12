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

"""camera_info, projection, drift, stamps and calibration text, in both families of messages."""

from __future__ import annotations

import array
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semcal_ros.bridge.calibration import (
    MAX_TEXT_BYTES,
    calibration_text_from_message,
    fill_calibration_text,
)
from semcal_ros.bridge.drift import (
    UNKNOWN_VARIANCE,
    fill_drift,
    fill_drift_velocity,
    rotation_of,
    rotation_rate_of,
)
from semcal_ros.bridge.fields import (
    fill_header,
    fill_stamp,
    new_nested,
    optional_stamp_ns,
    stamp_ns_from_msg,
)
from semcal_ros.bridge.projection import fill_camera_info, fill_projection, projection_from_message
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError, MessageError
from semcal_ros.files.bags.messages import blank_message, jazzy_types, serialize_message
from tests.helpers.drift_scenes import make_drift_update

New = Callable[[str], Any]
INFO = "sensor_msgs/msg/CameraInfo"
ARRAY = "std_msgs/msg/Float64MultiArray"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TWIST = "geometry_msgs/msg/TwistWithCovarianceStamped"
COVARIANCE = np.diag([1e-18, 4e-18, 9e-20, 16e-20])
COVARIANCE[0, 1] = COVARIANCE[1, 0] = 5e-19
COVARIANCE[2, 3] = COVARIANCE[3, 2] = 7e-21


def through_the_wire(message: Any) -> Any:
    """The message as a receiver sees it; rclpy messages are compared as they are."""
    name = getattr(message, "__msgtype__", None)
    return (
        message if name is None else jazzy_types().deserialize_cdr(serialize_message(message), name)
    )


def assert_header(message: Any) -> None:
    assert message.header.stamp.sec == 1_700_000_001
    assert message.header.stamp.nanosec == 999_999_999
    assert message.header.frame_id == "sem_optical"


def test_camera_info_projects_as_the_camera(new: New, header: Any, camera: ScanCamera) -> None:
    message = new(INFO)
    fill_camera_info(message, camera, header, 512, 512)
    message = through_the_wire(message)
    assert_header(message)
    assert (message.width, message.height) == (512, 512)
    assert message.distortion_model == "plumb_bob"
    assert list(message.d) == [0.0] * 5
    np.testing.assert_array_equal(np.reshape(message.r, (3, 3)), np.eye(3))
    p = np.reshape(message.p, (3, 4))
    assert p[2].tolist() == [0.0, 0.0, 1.0, 0.0]
    np.testing.assert_array_equal(p[:, :3], np.reshape(message.k, (3, 3)))
    # Points of the optical frame lie at Z = 1/rho + z.
    xyz = np.array([[1e-6, -2e-6, 0.0], [-9e-6, 4e-6, 3e-6]])
    pixels = np.c_[xyz[:, :2], xyz[:, 2] + 1.0 / camera.rho] @ p[:, :3].T
    # 420 000 px m of focal length times the rounding of 0.02 m + 3 um, far below 1e-6 px.
    seen = camera.rectified.project(xyz)
    np.testing.assert_allclose(pixels[:, :2] / pixels[:, 2:], seen, atol=1e-6)


def test_camera_info_of_another_image_size(new: New, header: Any, camera: ScanCamera) -> None:
    message = new(INFO)
    fill_camera_info(message, camera, header, 1024, 1024)
    np.testing.assert_allclose(
        np.reshape(message.k, (3, 3)), camera.resized(1024, 1024).rectified.K
    )
    assert (message.width, message.height) == (1024, 1024)


@pytest.mark.parametrize("parallel", [True, False])
def test_camera_info_without_a_pinhole_is_marked_uncalibrated(
    new: New, header: Any, camera: ScanCamera, parallel: bool
) -> None:
    message = new(INFO)
    fill_camera_info(message, camera, header, 512, 512)
    fill_camera_info(message, replace(camera, rho=0.0) if parallel else None, header, 512, 480)
    message = through_the_wire(message)
    assert_header(message)
    assert not np.any(message.k)
    assert not np.any(message.p)
    assert list(message.d) == [0.0] * 5
    assert (message.width, message.height) == (512, 480)


@pytest.mark.parametrize("rho", [50.0, 0.0])
def test_projection_round_trip(new: New, camera: ScanCamera, rho: float) -> None:
    message = new(ARRAY)
    seen = replace(camera, rho=rho)
    fill_projection(message, seen)
    message = through_the_wire(message)
    sizes = [(dim.label, dim.size, dim.stride) for dim in message.layout.dim]
    assert sizes == [("rows", 3, 12), ("columns", 4, 4)]
    np.testing.assert_array_equal(projection_from_message(message), seen.rectified.P_affine)


@pytest.mark.parametrize("values", [[1.0] * 11, [1.0] * 13, [float("nan")] * 12, []])
def test_a_projection_of_another_size_is_refused(new: New, values: list[float]) -> None:
    message = new(ARRAY)
    message.data = np.array(values) if isinstance(message.data, np.ndarray) else values
    with pytest.raises(MessageError, match="12"):
        projection_from_message(message)


def test_drift(new: New, header: Any) -> None:
    message = new(POSE)
    fill_drift(message, np.array([1e-9, -2e-9]), COVARIANCE, header)
    message = through_the_wire(message)
    assert_header(message)
    pose = message.pose.pose
    assert (pose.position.x, pose.position.y, pose.position.z) == (1e-9, -2e-9, 0.0)
    assert (pose.orientation.x, pose.orientation.w) == (0.0, 1.0)
    matrix = np.reshape(message.pose.covariance, (6, 6))
    np.testing.assert_array_equal(matrix[:2, :2], COVARIANCE[:2, :2])
    assert np.diag(matrix)[2:].tolist() == [UNKNOWN_VARIANCE] * 4
    assert np.count_nonzero(matrix) == 8


def test_drift_velocity(new: New, header: Any) -> None:
    message = new(TWIST)
    fill_drift_velocity(message, [3e-10, 4e-10], COVARIANCE, header)
    message = through_the_wire(message)
    assert_header(message)
    twist = message.twist.twist
    assert (twist.linear.x, twist.linear.y, twist.linear.z) == (3e-10, 4e-10, 0.0)
    assert twist.angular.z == 0.0
    matrix = np.reshape(message.twist.covariance, (6, 6))
    np.testing.assert_array_equal(matrix[:2, :2], COVARIANCE[2:, 2:])
    fill_drift_velocity(message, [3e-10, 4e-10], COVARIANCE[2:, 2:], header)
    np.testing.assert_array_equal(np.reshape(message.twist.covariance, (6, 6)), matrix)


def test_a_drift_that_was_never_measured_has_the_variance_of_the_unknown(
    new: New, header: Any
) -> None:
    message, twist = new(POSE), new(TWIST)
    covariance = np.diag([4e-18, np.inf, np.inf, np.inf])
    fill_drift(message, [0.0, 0.0], covariance, header)
    fill_drift_velocity(twist, [0.0, 0.0], covariance, header)
    sent = np.reshape(through_the_wire(message).pose.covariance, (6, 6))
    assert np.array_equal(sent, np.diag([4e-18, *[UNKNOWN_VARIANCE] * 5]))
    sent = np.reshape(through_the_wire(twist).twist.covariance, (6, 6))
    assert np.array_equal(sent, UNKNOWN_VARIANCE * np.eye(6))


def test_a_specimen_that_turns_does_so_about_z(new: New, header: Any) -> None:
    update = make_drift_update(
        similarity=np.array([0.02, 1e-3, 3e-4, 1e-5]),
        similarity_covariance=np.diag([4e-8, 1e-8, 9e-10, 1e-10]),
    )
    message = new(POSE)
    fill_drift(message, update.drift_m, COVARIANCE, header, rotation_of(update))
    message = through_the_wire(message)
    orientation = message.pose.pose.orientation
    assert (orientation.x, orientation.y) == (0.0, 0.0)
    assert (orientation.z, orientation.w) == pytest.approx((np.sin(0.01), np.cos(0.01)))
    assert np.diag(np.reshape(message.pose.covariance, (6, 6)))[2:] == pytest.approx(
        [UNKNOWN_VARIANCE] * 3 + [4e-8]
    )
    message = new(TWIST)
    fill_drift_velocity(message, [0.0, 0.0], COVARIANCE, header, rotation_rate_of(update))
    message = through_the_wire(message)
    assert message.twist.twist.angular.z == pytest.approx(3e-4)
    assert message.twist.covariance[35] == pytest.approx(9e-10)


def test_a_rotation_that_was_not_found_is_none() -> None:
    update = make_drift_update(similarity_covariance=np.diag([1e-8, 1e-8, np.inf, np.inf]))
    assert rotation_of(update) is None and rotation_rate_of(update) is None


@pytest.mark.parametrize(
    ("drift", "covariance"),
    [
        ([0.0, float("nan")], COVARIANCE),
        ([0.0, 0.0, 0.0], COVARIANCE),
        ([0.0, 0.0], np.eye(3)),
        ([0.0, 0.0], np.full((2, 2), np.inf)),
        ([0.0, 0.0], np.diag([1.0, -1.0])),
        ([0.0, 0.0], [[1.0, 0.5], [0.0, 1.0]]),
    ],
)
def test_drift_refuses_nonsense(header: Any, drift: Any, covariance: Any) -> None:
    message = blank_message(POSE)
    with pytest.raises(InvalidValueError):
        fill_drift(message, drift, covariance, header)
    assert message.header.frame_id == ""


@given(stamp_ns=st.integers(-(2**31) * 10**9, (2**31) * 10**9 - 1))
def test_stamps_round_trip(new: New, stamp_ns: int) -> None:
    image = new("sensor_msgs/msg/Image")
    fill_header(image.header, stamp_ns, "sem")
    assert stamp_ns_from_msg(image) == stamp_ns
    assert stamp_ns_from_msg(image.header) == stamp_ns
    assert stamp_ns_from_msg(image.header.stamp) == stamp_ns
    assert 0 <= image.header.stamp.nanosec < 10**9
    assert image.header.frame_id == "sem"


def test_stamps_that_are_none() -> None:
    message = blank_message("std_msgs/msg/Float64")
    assert optional_stamp_ns(message) is None
    with pytest.raises(MessageError, match="without a stamp"):
        stamp_ns_from_msg(message)
    broken = blank_message("std_msgs/msg/Header")
    broken.stamp.nanosec = 10**9
    with pytest.raises(MessageError, match="1000000000"):
        stamp_ns_from_msg(broken)
    with pytest.raises(InvalidValueError):
        fill_stamp(broken.stamp, 2**31 * 10**9)


def test_calibration_text(new: New) -> None:
    message = new("std_msgs/msg/String")
    for text in ("", "  \n", "x" * (MAX_TEXT_BYTES + 1)):
        message.data = text
        with pytest.raises(MessageError, match="calibration"):
            calibration_text_from_message(message)
        with pytest.raises(InvalidValueError):
            fill_calibration_text(message, text)
    fill_calibration_text(message, "format: µ\n")
    assert calibration_text_from_message(through_the_wire(message)) == "format: µ\n"
    with pytest.raises(MessageError, match="std_msgs/msg/String"):
        calibration_text_from_message(new(INFO))


def test_nested_messages_need_a_known_family() -> None:
    with pytest.raises(MessageError, match="rclpy or rosbags"):
        new_nested(array.array("B"), "std_msgs/msg/MultiArrayDimension")
