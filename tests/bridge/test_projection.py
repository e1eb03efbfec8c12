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

"""The frames for tf2 are those in which the camera and the stage are described."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from semcal_ros.bridge.projection import fill_static_frames, static_frames
from semcal_ros.config.config import load_config
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.files.bags.messages import blank_message
from semcal_ros.nodes import parameter_server as output
from tests.helpers.node_fakes import fake_context
from tests.helpers.node_scenes import make_calibration

CONFIG = load_config("virtual_sem")
assert CONFIG.stage is not None
TURNED = replace(CONFIG, stage=replace(CONFIG.stage, tilt_axis_deg=30.0))


def filled(camera: ScanCamera | None) -> dict[str, Any]:
    message = blank_message("tf2_msgs/msg/TFMessage")
    fill_static_frames(
        message,
        static_frames(TURNED, camera),
        1_500_000_000,
        lambda: blank_message("geometry_msgs/msg/TransformStamped"),
    )
    assert {t.header.frame_id for t in message.transforms} == {"sem"}
    assert all(
        (t.header.stamp.sec, t.header.stamp.nanosec) == (1, 500_000_000) for t in message.transforms
    )
    return {t.child_frame_id: t.transform for t in message.transforms}


def in_frame(transform: Any, point: tuple[float, float, float]) -> np.ndarray:
    """A point of the sem frame in the frame of a transform, as tf2 has it: p_sem = R p + t."""
    q, t = transform.rotation, transform.translation
    assert q.x == q.y == 0.0
    yaw = 2.0 * math.atan2(q.z, q.w)
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    xy = turn.T @ (np.array(point[:2]) - [t.x, t.y])
    return np.array([*xy, point[2] - t.z])


def test_the_camera_of_camera_info_is_in_the_optical_frame() -> None:
    camera = make_calibration().at(2000.0).rectified
    point = (3e-6, -2e-6, 5e-6)
    seen = camera.K @ in_frame(filled(camera)[TURNED.frame_id], point)
    assert seen[:2] / seen[2] == pytest.approx(camera.project(np.array([point]))[0], abs=1e-6)


def test_the_stage_has_its_x_along_the_tilt_axis() -> None:
    axis = (math.cos(math.radians(30.0)), math.sin(math.radians(30.0)), 0.0)
    assert in_frame(filled(None)["stage"], axis) == pytest.approx([1.0, 0.0, 0.0])
    assert in_frame(filled(None)["specimen"], axis) == pytest.approx(axis)


def test_a_parallel_projection_has_no_optical_frame() -> None:
    camera = make_calibration().at(2000.0)
    assert set(filled(replace(camera, rho=0.0))) == {"specimen", "stage"}


def test_they_are_published_once_and_again_when_they_change(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sent: list[Any] = []
    endpoints: Any = SimpleNamespace(
        latched_publisher=lambda _kind, topic: SimpleNamespace(publish=sent.append, topic=topic)
    )
    monkeypatch.setattr(output, "message_class", lambda name: lambda: blank_message(name))
    frames = output.StaticFramesOutput(fake_context(endpoints, TURNED))
    calibration = make_calibration()
    for g in (1000.0, 1000.0, 2000.0):
        frames.publish(calibration.at(g))
    # rho is the same at all magnifications of this calibration.
    assert [len(message.transforms) for message in sent] == [2, 3]
