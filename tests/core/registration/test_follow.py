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

"""A part of the picture that is known to show the specimen tells which of two motions is its own."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.drift.scenes import KINDS, draw
from semcal_ros.core.drift.settings import DriftSettings
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.registration.reference import RegistrationSettings
from semcal_ros.core.registration.register import prepare_reference, register


@pytest.mark.long
def test_a_tool_that_was_there_from_the_start_is_left_out_where_the_specimen_is_known() -> None:
    frames, drift, _ = draw(KINDS["tool over sparse from the start"], 116, 10)
    settings = DriftSettings(registration=RegistrationSettings(follow=(0.6, 0.0, 1.0, 1.0)))
    followed, plain = DriftTracker(settings), DriftTracker()
    accepted = []
    for k, frame in enumerate(frames):
        update = followed.update(frame, float(k))
        accepted.append(plain.update(frame, float(k)).accepted)
        assert update.accepted
        assert np.max(np.abs(update.drift_px - drift[k])) < 0.2
    assert update.moving is not None
    # The tip comes in from the left.
    columns = np.flatnonzero(update.moving.draw(frames[0].shape[::-1]).any(axis=0))
    assert columns.max() < 0.6 * frames[0].shape[1]
    assert sum(accepted) < 5


@pytest.mark.long
def test_a_part_without_structure_is_refused_rather_than_guessed() -> None:
    frames, _, _ = draw(KINDS["tool over gold from the start"], 101, 9)
    blank = frames[0].copy()
    moved = frames[8].copy()
    for picture in (blank, moved):
        picture[:40, -40:] = 60
    settings = DriftSettings(registration=RegistrationSettings(follow=(0.92, 0.0, 1.0, 0.08)))
    tracker = DriftTracker(settings)
    tracker.update(blank, 0.0)
    assert not tracker.update(moved, 1.0).accepted


@pytest.mark.parametrize("part", [(0.5, 0.0, 0.5, 1.0), (0.0, 0.0, 1.1, 1.0)])
def test_a_part_that_is_no_rectangle_of_the_picture_is_an_error(
    part: tuple[float, float, float, float],
) -> None:
    with pytest.raises(InvalidValueError, match="part to follow"):
        RegistrationSettings(follow=part)


def test_a_tool_does_not_choose_the_period_of_a_lattice() -> None:
    frames, drift, _ = draw(KINDS["tool over a lattice"], 100, 21)
    reference = prepare_reference(frames[0])
    accepted = 0
    for k in (3, 6, 10, 14, 20):
        found = register(reference, frames[k], guess_px=drift[k], guess_covariance=4.0 * np.eye(2))
        if found.accepted:
            assert np.max(np.abs(found.shift_px - drift[k])) < 0.1
        accepted += found.accepted
    # The tool comes in with the sixth frame, and leaves enough defects.
    assert accepted >= 4


def test_a_part_of_a_lattice_to_follow_is_refused() -> None:
    frames, drift, _ = draw(KINDS["lattice"], 100, 4)
    settings = RegistrationSettings(follow=(0.6, 0.0, 1.0, 1.0))
    found = register(
        prepare_reference(frames[0], settings=settings),
        frames[3],
        guess_px=drift[3],
        guess_covariance=4.0 * np.eye(2),
    )
    assert "by how many periods" in found.reason
