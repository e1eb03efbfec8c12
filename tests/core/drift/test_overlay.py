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

"""What is drawn into pictures does not hold the drift."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.drift.overlay import find_overlay, remove_overlay
from semcal_ros.core.drift.tracker import DriftTracker
from tests.helpers.drift_scenes import Texture

SIZE = 224
GROUND = Texture(5)
SCALE = 30.0 / float(GROUND.view((0.0, 0.0), SIZE).std())


def picture(shift: tuple[float, float], seed: int, *, drawn: bool) -> np.ndarray:
    """A texture with noise, and over it a cross-hair, a scale bar and a line of text without."""
    clean = 110.0 + SCALE * GROUND.view(shift, SIZE)
    out = np.random.default_rng(seed).normal(clean, 6.0).clip(0, 255).astype(np.uint8)
    if drawn:
        out[SIZE // 2 - 1 : SIZE // 2 + 1, 20:-20] = 250
        out[20:-20, SIZE // 2 - 1 : SIZE // 2 + 1] = 250
        out[-14:-10, 30:110] = 250
        text = np.random.default_rng(99).random((6, 40)) > 0.5
        out[12:24, 20:100] = np.where(np.kron(text, np.ones((2, 2))) > 0, 200, 40)
    return out


def test_what_is_drawn_is_found_and_what_is_not_is_not() -> None:
    found = find_overlay(*(picture((0.3 * k, 0.0), k, drawn=True) for k in (0, 1)))
    assert found is not None
    truth = picture((0.0, 0.0), 0, drawn=True) != picture((0.0, 0.0), 0, drawn=False)
    assert found[truth].mean() > 0.9
    assert found.mean() < 3.0 * truth.mean()
    for seed in range(10):
        plain = [picture((0.3 * k, 0.0), 2 * seed + k, drawn=False) for k in (0, 1)]
        assert find_overlay(*plain) is None


def test_floats_noiseless_and_repeated_pictures_tell_nothing() -> None:
    first, second = (picture((0.3 * k, 0.0), k, drawn=True) for k in (0, 1))
    assert find_overlay(first, first) is None
    assert find_overlay(first.astype(np.float32), second.astype(np.float32)) is None
    smooth = [
        np.rint(110.0 + SCALE * GROUND.view((0.1 * k, 0.0), SIZE)).astype(np.uint8) for k in (0, 1)
    ]
    assert find_overlay(*smooth) is None
    assert find_overlay(first, second[:-2]) is None


@pytest.mark.parametrize("channels", [1, 3])
def test_its_place_is_filled_from_around(channels: int) -> None:
    image = picture((0.0, 0.0), 0, drawn=True)
    overlay = image == 250
    stacked = image if channels == 1 else np.stack([image] * 3, axis=2)
    out = remove_overlay(stacked, overlay)
    assert out.shape == stacked.shape
    assert out.dtype == stacked.dtype
    assert out[overlay].max() < 220
    np.testing.assert_array_equal(out[~overlay], stacked[~overlay])


def test_a_drift_under_a_cross_hair_is_that_of_the_specimen() -> None:
    tracker = DriftTracker()
    for k in range(12):
        shift = (0.45 * k, -0.3 * k)
        update = tracker.update(picture(shift, k, drawn=True), float(k))
        assert update.accepted, update.reason
        # The first pictures have but two to tell what is drawn, and a tenth of the letters is not found.
        np.testing.assert_allclose(update.drift_px, shift, atol=0.3 if k < 3 else 0.15)
