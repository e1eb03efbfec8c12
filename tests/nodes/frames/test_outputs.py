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

"""What the diagnostics and the topics say of a measured drift, without the middleware."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import Image

from semcal_ros.bridge.images import image_from_message
from semcal_ros.core.drift.estimates import DriftStatus, DriftUpdate
from semcal_ros.core.drift.own_motion import OwnMotion
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.agreement import MovingTiles
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.nodes.frames.live_drift import FrameDrift
from semcal_ros.nodes.frames.outputs import DriftOutput
from semcal_ros.nodes.frames.stream import StreamFrame
from tests.helpers.drift_scenes import make_drift_update
from tests.helpers.node_fakes import fake_context, fake_reporter, notes
from tests.helpers.node_scenes import image_message, stamp_of

SIZE = 32


class Publishers:
    """Makes publishers that keep what is published, by topic."""

    def __init__(self) -> None:
        self.published: dict[str, list[Any]] = {}

    def stream_publisher(self, _type: Any, topic: str) -> Any:
        kept = self.published.setdefault(topic, [])
        return SimpleNamespace(is_awaited=True, publish=kept.append)


def publish(*updates: DriftUpdate) -> tuple[dict[str, str], dict[str, list[Any]]]:
    publishers, (reporter, _) = Publishers(), fake_reporter()
    output = DriftOutput(fake_context(publishers, reporter=reporter))
    pixels = np.zeros((SIZE, SIZE), dtype=np.uint8)
    header = image_message(pixels, 7.0).header
    for update in updates:
        output.publish(
            FrameDrift(update, update), StreamFrame(pixels, "mono8", header, 7_000_000_000, None)
        )
    return notes(reporter), publishers.published


def moving_update() -> DriftUpdate:
    """A tool over the left quarter of the field, which moves by 3 and -4 um/s along the axes of the drift."""
    tiles = np.zeros((4, 4), dtype=bool)
    tiles[:, 0] = True
    # 1-sigma of 3 and 1 um/s along axes that are turned by 45 degrees.
    covariance = 1e-12 * np.array([[5.0, 4.0], [4.0, 5.0]])
    return make_drift_update(
        moving=MovingTiles(tiles, np.zeros(2), np.full(2, SIZE / 4), 0.25),
        own_motion=OwnMotion(np.array([3e-6, -4e-6]), covariance, 0.0, 1.0),
    )


def test_diagnostics_say_how_what_moves_by_itself_moves() -> None:
    said, _ = publish(moving_update())
    assert float(said["drift_moving_share"]) == pytest.approx(0.25)
    assert float(said["drift_moving_velocity_x"]) == pytest.approx(3e-6, rel=1e-3)
    assert float(said["drift_moving_velocity_y"]) == pytest.approx(-4e-6, rel=1e-3)
    # That of the worse direction, which is no axis.
    assert float(said["drift_moving_velocity_sigma"]) == pytest.approx(3e-6, rel=1e-3)


def test_a_motion_that_is_no_longer_known_is_no_number() -> None:
    keys = [f"drift_moving_velocity_{name}" for name in ("x", "y", "sigma")]
    said, _ = publish(moving_update(), replace(moving_update(), own_motion=None))
    assert all(math.isnan(float(said[key])) for key in keys)
    assert float(said["drift_moving_share"]) == pytest.approx(0.25)
    said, _ = publish(moving_update(), make_drift_update())
    assert all(math.isnan(float(said[key])) for key in keys)
    assert float(said["drift_moving_share"]) == 0.0


def test_what_moves_by_itself_is_a_mask_of_the_same_stamp() -> None:
    _, published = publish(moving_update())
    (mask,) = published["~/moving"]
    assert isinstance(mask, Image)
    assert (mask.encoding, stamp_of(mask)) == ("mono8", (7, 0))
    pixels = image_from_message(mask)
    assert np.all(pixels[:, : SIZE // 4] == 255)
    assert not np.any(pixels[:, SIZE // 4 :])


def test_frames_that_were_not_matched_are_counted_with_their_reason() -> None:
    reason = Rejection(MatchFailure.NO_PEAK, "no shift stands out")
    lost = make_drift_update(status=DriftStatus.COASTING, rejection=reason)
    said, _ = publish(make_drift_update(), lost, lost)
    assert said["drift_frames_coasted"] == "2"
    assert said["drift_status"] == "coasting: no shift stands out"
