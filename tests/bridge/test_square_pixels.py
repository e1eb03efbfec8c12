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

"""camera_info as those read it who know no skew, against the projection of the same image."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semcal_ros.bridge.projection import (
    fill_camera_info,
    fill_projection,
    fill_projection_covariance,
    fill_stamped_projection,
    fill_stamped_projection_covariance,
    projection_covariance_from_message,
    projection_from_message,
    stamped_projection_covariance_from_message,
    stamped_projection_from_message,
)
from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import MessageError
from semcal_ros.files.bags.messages import blank_message, jazzy_types, serialize_message
from semcal_ros.synthetic import preset

New = Callable[[str], Any]
INFO = "sensor_msgs/msg/CameraInfo"
ARRAY = "std_msgs/msg/Float64MultiArray"
IMAGE = "sensor_msgs/msg/Image"
MAGNIFICATIONS = np.geomspace(100.0, 10_000.0, 9)


@dataclass(frozen=True)
class Pinhole:
    """What CameraInfo means to a reader that follows its definition: P has no skew."""

    fx: float
    fy: float
    cx: float
    cy: float
    tx: float
    ty: float

    @classmethod
    def from_message(cls, message: Any) -> Pinhole:
        p = np.reshape(message.p, (3, 4))
        return cls(p[0, 0], p[1, 1], p[0, 2], p[1, 2], p[0, 3], p[1, 3])

    def pixels(self, xyz: Array) -> Array:
        x, y, z = xyz.T
        u = (self.fx * x + self.tx) / z + self.cx
        v = (self.fy * y + self.ty) / z + self.cy
        return np.stack([u, v], axis=1)


def field_points(camera: ScanCamera) -> Array:
    """(n, 3) points all over the field, at heights up to a tenth of its width."""
    x, y = np.meshgrid(np.linspace(0.0, 511.0, 9), np.linspace(0.0, 511.0, 9))
    field_m = camera.width / camera.m
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    return np.concatenate([camera.sem_from_ideal(pixels, z * field_m) for z in (-0.1, 0.0, 0.1)])


def assert_readers_agree(new: New, header: Any, camera: ScanCamera, seen_skew_px: float) -> None:
    info, matrix = new(INFO), new(ARRAY)
    fill_camera_info(info, camera, header, 512, 512)
    fill_projection(matrix, camera)
    k = np.reshape(info.k, (3, 3))
    assert k[0, 0] == k[1, 1] > 0.0
    assert (k[0, 1], k[1, 0]) == (0.0, 0.0)
    xyz = field_points(camera)
    u = np.column_stack([xyz, np.ones(len(xyz))]) @ projection_from_message(matrix).T
    expected = u[:, :2] / u[:, 2:]
    optical = xyz + [0.0, 0.0, 1.0 / camera.rho]
    np.testing.assert_allclose(Pinhole.from_message(info).pixels(optical), expected, atol=0.01)
    # The same reader, had the camera of the undistorted picture been published.
    ideal = camera.K
    wrong = Pinhole(ideal[0, 0], ideal[1, 1], ideal[0, 2], ideal[1, 2], 0.0, 0.0).pixels(optical)
    away = wrong - camera.project_ideal(xyz)
    assert np.sqrt(np.mean(np.sum(away**2, axis=1))) > seen_skew_px


@pytest.mark.parametrize("g", MAGNIFICATIONS)
def test_a_reader_without_skew_agrees_with_the_projection(new: New, header: Any, g: float) -> None:
    assert_readers_agree(new, header, preset("jsm820").camera_at(g), 0.05)


def test_so_it_does_on_the_reference_recording(new: New, header: Any, reference_data: Path) -> None:
    truth = json.loads((reference_data / "grid_calibration" / "truth.json").read_text())
    for g, p in truth["params"].items():
        camera = ScanCamera(
            float(g), p["m"] * 1e6, p["a"], p["s"] / p["m"], p["px"], p["py"], p["rho"] * 1e6,
            p["xr"], p["xt"], p["ex"], p["ey"], truth["norm_px"], 512, 512,
        )  # fmt: skip
        assert_readers_agree(new, header, camera, 0.05)


# -- projection_stamped ---------------------------------------------------------------------------


def through_the_wire(message: Any) -> Any:
    """The message as a receiver sees it; rclpy messages are compared as they are."""
    name = getattr(message, "__msgtype__", None)
    if name is None:
        return message
    return jazzy_types().deserialize_cdr(serialize_message(message), name)


@pytest.mark.parametrize("rho", [50.0, 0.0])
def test_a_stamped_projection_round_trip(
    new: New, header: Any, camera: ScanCamera, rho: float
) -> None:
    message = new(IMAGE)
    fill_stamped_projection(message, replace(camera, rho=rho), header, 512, 512)
    message = through_the_wire(message)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (1_700_000_001, 999_999_999)
    assert message.header.frame_id == "sem_optical"
    assert (message.encoding, message.height, message.width, message.step) == ("64FC1", 3, 4, 32)
    assert message.is_bigendian == (sys.byteorder == "big")
    expected = replace(camera, rho=rho).rectified.P_affine
    np.testing.assert_array_equal(stamped_projection_from_message(message), expected)
    # As any reader of images takes it.
    plain = np.frombuffer(message.data, np.float64).reshape(3, 4)
    np.testing.assert_array_equal(plain, expected)


def test_a_stamped_projection_is_of_the_size_of_its_image(
    new: New, header: Any, camera: ScanCamera
) -> None:
    message = new(IMAGE)
    fill_stamped_projection(message, camera, header, 1024, 768)
    expected = camera.resized(1024, 768).rectified.P_affine
    np.testing.assert_array_equal(stamped_projection_from_message(message), expected)


def test_an_image_without_a_camera_has_a_projection_of_zeros(new: New, header: Any) -> None:
    message = new(IMAGE)
    fill_stamped_projection(message, None, header, 512, 512)
    assert not stamped_projection_from_message(message).any()
    assert message.header.frame_id == "sem_optical"


def test_padding_and_byte_order_are_honoured(new: New, header: Any, camera: ScanCamera) -> None:
    message = new(IMAGE)
    fill_stamped_projection(message, camera, header, 512, 512)
    expected = camera.rectified.P_affine
    padded = np.zeros((3, 40), np.uint8)
    padded[:, :32] = np.ascontiguousarray(expected, dtype=">f8").view(np.uint8)
    message.data = padded.ravel() if isinstance(message.data, np.ndarray) else padded.tobytes()
    message.step, message.is_bigendian = 40, 1
    np.testing.assert_array_equal(stamped_projection_from_message(message), expected)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"encoding": "32FC1"}, "64FC1"),
        ({"height": 4, "width": 3, "step": 24}, "4 x 3 numbers; expected 3 rows of 4"),
        ({"width": 3}, "3 x 3 numbers"),
        ({"step": 24}, "step"),
        ({"step": 40}, "truncated"),
    ],
)
def test_another_image_is_no_projection(
    new: New, header: Any, camera: ScanCamera, change: dict[str, Any], reason: str
) -> None:
    message = new(IMAGE)
    fill_stamped_projection(message, camera, header, 512, 512)
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(MessageError, match=reason):
        stamped_projection_from_message(message)


def test_a_stamped_projection_must_be_finite(header: Any, camera: ScanCamera) -> None:
    message = blank_message(IMAGE)
    fill_stamped_projection(message, camera, header, 512, 512)
    message.data[:8] = np.array([np.nan]).view(np.uint8)
    with pytest.raises(MessageError, match="finite"):
        stamped_projection_from_message(message)


# -- the covariance of the projection ---------------------------------------------------------------


def test_a_covariance_round_trip(new: New, header: Any, camera: ScanCamera) -> None:
    known = replace(camera, covariance=np.diag(np.arange(1.0, 11.0)))
    message = new(ARRAY)
    fill_projection_covariance(message, known)
    message = through_the_wire(message)
    assert [(d.label, d.size, d.stride) for d in message.layout.dim] == [
        ("rows", 12, 144),
        ("columns", 12, 12),
    ]
    expected = known.rectified.P_affine_covariance
    np.testing.assert_array_equal(projection_covariance_from_message(message), expected)
    with pytest.raises(MessageError, match="12 finite numbers"):
        projection_from_message(message)
    image = new(IMAGE)
    fill_stamped_projection_covariance(image, known, header, 1024, 768)
    image = through_the_wire(image)
    assert (image.encoding, image.height, image.width, image.step) == ("64FC1", 12, 12, 96)
    np.testing.assert_array_equal(
        stamped_projection_covariance_from_message(image),
        known.resized(1024, 768).rectified.P_affine_covariance,
    )
    empty, matrix = new(IMAGE), new(IMAGE)
    fill_stamped_projection_covariance(empty, None, header, 512, 512)
    assert not stamped_projection_covariance_from_message(through_the_wire(empty)).any()
    fill_stamped_projection(matrix, known, header, 512, 512)
    with pytest.raises(MessageError, match="12 rows of 12"):
        stamped_projection_covariance_from_message(through_the_wire(matrix))
