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

"""The motion of what moves by itself is right within its sigma, or not stated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.own_motion import BodyFrame, OwnMotion, OwnMotionEstimator
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.registration.agreement import MovingTiles
from tests.helpers.drift_scenes import Texture

SIZE = 224
GROUND, GRAIN = Texture(5), Texture(9)
Y, X = np.mgrid[:SIZE, :SIZE].astype(np.float64)
DRIFT = np.array([0.4, -0.3])


def inside(distance: Array) -> Array:
    """1 where a distance from an edge is negative, 0 where it is positive, softly as the beam sees it."""
    return np.asarray(1.0 / (1.0 + np.exp(np.clip(distance / 0.7, -50.0, 50.0))))


def picture(kind: str, velocity: Array, frame: int, seed: int) -> Array:
    """A drifting texture under a body that moves by ``velocity`` px per frame."""
    clean = 90.0 + 20.0 * GROUND.view(tuple(DRIFT * frame), SIZE)
    x, y = np.array([110.0, 110.0]) + velocity * (frame - 8)
    part = np.zeros_like(clean)
    own = np.full_like(clean, 185.0)
    if kind == "rough tool":
        own = 120.0 + 25.0 * GRAIN.view(tuple(velocity * frame), SIZE)
        part = inside(X - x + 20.0) * inside(np.abs(Y - y) - 60.0)
    elif kind == "smooth disc":
        part = inside(np.hypot(X - x, Y - y) - 26.0)
    elif kind == "particle":
        part = inside(np.hypot(X - x, Y - y) - 11.0)
    elif kind == "bar that turns":
        along, across = (
            (X - x) * np.cos(0.02 * frame) + (Y - y) * np.sin(0.02 * frame),
            (Y - y) * np.cos(0.02 * frame) - (X - x) * np.sin(0.02 * frame),
        )
        part = inside(np.abs(along) - 45.0) * inside(np.abs(across) - 14.0)
    elif kind == "shadow":
        clean = clean * (1.0 - 0.5 / (1.0 + np.exp((X - x) / 12.0)))
    drawn = clean * (1.0 - part) + own * part
    noisy = np.random.default_rng(1000 * seed + frame).normal(drawn, 7.0)
    return np.rint(noisy.clip(0, 255)).astype(np.uint8)


def track(kind: str, velocity: Array, seed: int, frames: int = 16) -> list[OwnMotion]:
    """All measurements of one scene, 0.5 s between the frames."""
    tracker = DriftTracker()
    found: list[OwnMotion] = []
    refused: list[str] = []
    for k in range(frames):
        update = tracker.update(picture(kind, velocity, k, seed), 0.5 * k)
        refused += [] if update.accepted else [update.reason]
        own = update.own_motion
        if own is not None and (not found or own.end_s > found[-1].end_s):
            assert update.moving is not None
            found.append(own)
    assert len(refused) <= 1, refused
    return found


@pytest.mark.parametrize(
    ("kind", "least"),
    [("rough tool", 4), ("smooth disc", 3), ("particle", 1), ("bar that turns", 1)],
)
@pytest.mark.long
def test_the_motion_of_a_body_is_right_within_its_sigma(kind: str, least: int) -> None:
    scores = []
    for seed, velocity in enumerate([(2.0, -1.2), (-1.4, 2.4), (1.1, 2.0)]):
        for own in track(kind, np.array(velocity), seed, 20):
            # In px per s, along the axes of the drift; not relative to the specimen.
            error = own.velocity_m_s - 2.0 * np.array(velocity)
            scores.append(error / np.sqrt(np.diag(own.covariance)))
            assert np.max(np.sqrt(np.diag(own.covariance))) < 0.6 / (own.end_s - own.begin_s)
    assert len(scores) >= least
    assert np.max(np.abs(scores)) < 4.0
    # The ring about a body says at most how much ground is in it: sigmas are rather too large.
    assert 0.2 < float(np.sqrt(np.mean(np.square(scores)))) < 1.5


def test_a_rough_tool_is_followed() -> None:
    (first, *_) = track("rough tool", np.array([2.0, -1.2]), 0, frames=8)
    error = first.velocity_m_s - [4.0, -2.4]
    sigma = np.sqrt(np.diag(first.covariance))
    assert np.all(np.abs(error) < 3.5 * sigma)
    assert np.max(sigma) < 0.4


def test_a_shadow_has_no_motion_that_is_stated() -> None:
    assert not track("shadow", np.array([3.0, 0.0]), 0, frames=10)


def body_frame(shift: Array, seed: int, time_s: float) -> BodyFrame:
    tiles = np.zeros((14, 14), dtype=bool)
    tiles[3:12, :9] = True
    frame = picture("rough tool", shift, 8 if seed == 0 else 9, seed)
    return BodyFrame(
        frame,
        (0, 0, SIZE, SIZE),
        MovingTiles(tiles, np.zeros(2), np.full(2, 16.0), 0.4),
        DRIFT * (8 + seed),
        np.eye(2),
        time_s,
    )


def test_nothing_is_said_across_a_change_of_scale_or_of_what_moves() -> None:
    velocity = np.array([2.5, 1.0])
    first, second = body_frame(velocity, 0, 0.0), body_frame(velocity, 1, 1.0)
    estimator = OwnMotionEstimator()
    frames = [first, second, replace(first, time_s=2.0), replace(second, time_s=3.0)]
    known = []
    for frame in frames:
        estimator = estimator.update(frame)
        known.append(estimator.latest is not None)
    # The first time tells where to look, the second one confirms it.
    assert known == [False, False, False, True]
    assert estimator.update(None) == OwnMotionEstimator()
    time_s = 4.0
    while estimator.base is None:
        estimator = estimator.update(replace(first, time_s=time_s))
        time_s += 1.0
    assert estimator.latest is not None
    rescaled = replace(second, time_s=time_s, px_from_unit=2.0 * np.eye(2))
    assert estimator.update(rescaled).latest is None


def test_what_moves_as_the_specimen_does_is_not_told_from_it() -> None:
    estimator = OwnMotionEstimator()
    for k in range(6):
        estimator = estimator.update(body_frame(DRIFT, k % 2, float(k)))
        assert estimator.latest is None
