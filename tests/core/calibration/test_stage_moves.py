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

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.calibration.stage import StageIsotropy, fit_stage_moves
from semcal_ros.core.errors import InvalidValueError

PIXEL_M = 2e-8
SCATTER_M = 1e-8


def measured(seed: int, stretch: float = 0.0, shear: float = 0.0, frames: int = 8) -> StageIsotropy:
    """A specimen that drifts, under a stage that lies mirrored and turned to the image and repeats to 10 nm."""
    rng = np.random.default_rng(seed)
    position = rng.uniform(-2e-6, 2e-6, (frames, 2))
    time = np.arange(float(frames))
    turn = rng.uniform(-np.pi, np.pi)
    c, s = np.cos(turn), np.sin(turn)
    to_image = np.array([[1.0 + stretch, shear], [0.0, 1.0]]) @ np.array([[c, s], [s, -c]])
    seen = (position + SCATTER_M * rng.normal(size=position.shape)) @ to_image.T / PIXEL_M
    return fit_stage_moves(position, seen + np.outer(time, [0.7, -0.4]), time, PIXEL_M)


def test_scale_and_skew_are_found_within_their_sigma() -> None:
    z = []
    for seed in range(400):
        found = measured(seed, stretch=0.02, shear=0.01)
        # The shear turns x towards y: its cosine, and a second-order change of the length along x.
        z.append(
            (
                (found.scale_x - (np.hypot(1.02, 0.01) - 1.0)) / found.scale_x_sigma,
                found.scale_y / found.scale_y_sigma,
                (found.skew - 0.01 / np.hypot(1.02, 0.01)) / found.skew_sigma,
            )
        )
    # Of 400 each, the part within one sigma scatters by 0.023.
    assert np.mean(np.abs(z) < 1.0, axis=0) == pytest.approx([0.683] * 3, abs=0.07)
    scatter = [measured(seed).scatter_m for seed in range(50)]
    assert np.sqrt(np.mean(np.square(scatter))) == pytest.approx(SCATTER_M, rel=0.15)


def test_what_leaves_the_shape_open_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="4 positions"):
        measured(0, frames=4)
    line = np.outer(np.arange(6.0), [1e-6, 2e-6])
    with pytest.raises(InvalidValueError, match="on one line"):
        fit_stage_moves(line, line / PIXEL_M, np.arange(6.0), PIXEL_M)
