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

"""Drift of a background that little is left of."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from semcal_ros.applications.cantilever.background_drift import (
    _find_texture,
    follow_background,
)
from semcal_ros.applications.cantilever.plane import Axis, PlaneMap
from semcal_ros.applications.cantilever.series import _is_tied
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.estimates import DriftPath

SIZE = 384


@pytest.mark.parametrize("turned", [False, True])
def test_the_texture_is_sought_in_what_stays_in_view_and_uncovered(turned: bool) -> None:
    weight = np.ones((SIZE, SIZE), np.float32)
    weight[60:, :] = 0.0
    weight[:30, 190:200] = 0.0
    if turned:
        weight = np.ascontiguousarray(weight.T)
    left, top, right, bottom = _find_texture(weight, 3.0)
    assert weight[top - 3 : bottom + 3, left - 3 : right + 3].min() == 1.0
    assert min(left, top) >= 3
    assert max(right, bottom) <= SIZE - 3
    # 30 px are free along the whole side, and 60 px along half of it; 4 px are left out at each border.
    assert (right - left) * (bottom - top) > 0.6 * 52 * 180
    assert _find_texture(np.zeros((SIZE, SIZE), np.float32), 0.0) is None


def test_drift_beside_a_wide_beam() -> None:
    """A smooth cover over the middle loses no frame."""
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((SIZE + 40, SIZE + 40)).astype(np.float32)
    texture = cv2.GaussianBlur(noise, (0, 0), 2.5)
    texture *= 8.0 / texture.std()
    y, x = np.mgrid[:SIZE, :SIZE]
    frames, drift_px = [], np.array([[0.0, 0.0], [2.3, -1.2], [3.9, -2.6], [5.2, -3.1]])
    for k, (dx, dy) in enumerate(drift_px):
        matrix = np.array([[1.0, 0.0, 20.0 - dx], [0.0, 1.0, 20.0 - dy]])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        frame = 70.0 + cv2.warpAffine(texture, matrix, (SIZE, SIZE), flags=flags)
        frame[(np.abs(y - 192 - dy - 3 * k) < 120) & (x < 360 + dx)] = 170.0
        frame += rng.normal(0.0, 8.0, frame.shape)
        frames.append(np.clip(np.rint(frame), 0, 255).astype(np.uint8))
    plane = PlaneMap(ScanCamera.nominal(8890.0, SIZE, SIZE, 0.12), None)
    ends = plane.sem_of(np.array([[0.0, 192.0], [360.0, 192.0]]))
    length_m = float(np.hypot(*(ends[1] - ends[0])))
    direction = (ends[1] - ends[0]) / length_m
    half_m = 120.0 * plane.pixel_m
    axis = Axis(ends[0], direction, half_m, (0.0, length_m), False, True)
    times_s = [20.0 * k for k in range(len(frames))]
    path = follow_background(frames, times_s, plane, axis, 12.0 * plane.pixel_m).path
    assert path.trusted.all(), [u.reason for u in path.updates]
    # The contrast is as large as the noise, and a third of the image counts.
    np.testing.assert_allclose(path.drift_px, drift_px, atol=0.12)


@pytest.mark.parametrize(
    ("accepted", "reference", "tied"),
    [
        ([1, 1, 0], (0,), [1, 1, 0]),
        # Tracking began with the second frame: nothing is known of the first.
        ([0, 1, 1], (0,), [0, 0, 0]),
        ([0, 1, 1], (1,), [0, 1, 1]),
        ([1, 0, 1], (0, 1), [0, 0, 0]),
    ],
)
def test_a_frame_is_tied_to_reference_frames_that_have_a_drift(
    accepted: list[int], reference: tuple[int, ...], tied: list[int]
) -> None:
    updates = [SimpleNamespace(accepted=bool(a), restarted=False) for a in accepted]
    path = DriftPath(updates)  # type: ignore[arg-type]
    assert [_is_tied(path, k, reference) for k in range(3)] == [bool(t) for t in tied]
