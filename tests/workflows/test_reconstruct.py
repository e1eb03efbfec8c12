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

"""``reconstruct`` of recordings that do not show the specimen all the time."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros import reconstruct
from tests.helpers.turning_ball import turning_ball


@pytest.mark.long
def test_frames_without_the_specimen_do_not_take_the_place_of_others():
    """A ball that leaves the field: each frame after that is a keyframe without points."""
    images, calibration = turning_ball()
    alone = reconstruct(images, calibration=calibration, spacing_px=10.0, keyframes=16)
    rng = np.random.default_rng(0)
    _, magnification, last_s = images[-1]
    for k in range(60):
        empty = np.clip(rng.normal(40.0, 8.0, (192, 512)), 0, 255).astype(images[0][0].dtype)
        images.append((empty, magnification, last_s + 5.0 * (k + 1)))
    found = reconstruct(images, calibration=calibration, spacing_px=10.0, keyframes=16)
    assert found.ball.diameter_m == pytest.approx(alone.ball.diameter_m, rel=1e-3)
    (note,) = (note for note in found.notes if "left out" in note)
    assert "with fewer than 12 points left out, the first of them frame 1" in note
    assert note.endswith("was the specimen in view?")
