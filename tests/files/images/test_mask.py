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

"""Masks: what burnt-in text does to drift and grids without one, and that outputs keep their pixels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from semcal_ros import rectify, track_drift
from semcal_ros.core.errors import BagError
from semcal_ros.files.images.mask import fill_masked
from semcal_ros.files.recordings import RecordedFiles
from tests.helpers.node_scenes import make_calibration

SIZE = 128
# The specimen moves by so much from frame to frame, px.
STEP = np.array([1.5, -0.75])


def texture(seed: int, blur_px: float) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(2 * SIZE, 2 * SIZE)).astype(np.float32)
    return cv2.GaussianBlur(noise, (0, 0), blur_px)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A weak moving texture under a strong pattern that stays: half of the field is dirt on the detector."""
    moving, still = texture(1, 2.0), texture(2, 1.5)[:SIZE, :SIZE]
    out = tmp_path / "frames"
    out.mkdir()
    for k in range(5):
        x, y = 60.0 - k * STEP
        seen = cv2.getRectSubPix(moving, (SIZE, SIZE), (x + SIZE / 2, y + SIZE / 2))
        grey = 128.0 + 60.0 * seen / seen.std() * 0.3
        grey[:, : SIZE // 2] = 128.0 + 60.0 * still[:, : SIZE // 2] / still.std()
        cv2.imwrite(str(out / f"f{k}.png"), np.clip(np.rint(grey), 0, 255).astype(np.uint8))
    mask = np.full((SIZE, SIZE), 255, dtype=np.uint8)
    mask[:, : SIZE // 2] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    return out


def recording(folder: Path, **given: object) -> RecordedFiles:
    return RecordedFiles(folder, magnification=2000.0, frame_interval_s=1.0, **given)


def test_drift_is_that_of_the_specimen_and_not_of_what_lies_on_the_image(folder: Path) -> None:
    plain = track_drift(recording(folder))
    masked = track_drift(recording(folder, mask=folder.parent / "mask.png"))
    pixel_m = 0.12 / 2000.0 / SIZE
    moved = [track.path.drift_m[-1] / pixel_m for track in (plain, masked)]
    # The specimen moves with the window's step; the dirt wins without the mask.
    assert np.linalg.norm(moved[0] - 4 * STEP) > 1.0
    # Half of the field, signal to noise of an 8-bit image: some hundredths of a pixel.
    assert moved[1] == pytest.approx(4 * STEP, abs=0.1)


def test_written_images_keep_the_masked_pixels(folder: Path) -> None:
    path, calibration = folder.parent / "mask.png", make_calibration()
    kept = rectify(recording(folder, mask=path), calibration=calibration, drift=False)
    plain = rectify(recording(folder), calibration=calibration, drift=False)
    np.testing.assert_array_equal(kept.images[0], plain.images[0])


def test_what_is_filled_in_is_smooth_and_the_rest_untouched() -> None:
    rng = np.random.default_rng(0)
    y, x = np.mgrid[0:64, 0:96]
    image = (2.0 * x + y + 200.0 + rng.normal(0.0, 2.0, x.shape)).astype(np.uint16)
    used = np.ones(image.shape, dtype=bool)
    used[20:40, 30:60] = False
    damaged = image.copy()
    damaged[~used] = 60000
    filled = fill_masked(damaged, used)
    np.testing.assert_array_equal(filled[used], image[used])
    # The slope across the hole is continued; its noise is not.
    error = filled.astype(float) - (2.0 * x + y + 200.0)
    assert np.abs(error[~used]).max() < 8.0
    assert np.abs(np.diff(error, axis=1)[22:38, 32:57]).max() < 2.0
    assert fill_masked(image, np.ones_like(used)) is image


@pytest.mark.parametrize(
    ("mask", "what"),
    [
        (np.zeros((SIZE, SIZE), np.uint8), "black all over"),
        (np.full((SIZE, SIZE // 2), 255, np.uint8), "64 x 128 px for images of 128 x 128 px"),
        (None, "not an image"),
    ],
)
def test_a_mask_that_does_not_fit_is_refused(folder: Path, mask: object, what: str) -> None:
    path = folder.parent / "other.png"
    if mask is None:
        path.write_bytes(b"no picture")
    else:
        cv2.imwrite(str(path), mask)
    with pytest.raises(BagError, match=what):
        track_drift(recording(folder, mask=path))


def test_the_mask_is_cut_with_the_region(folder: Path) -> None:
    """The mask belongs to the whole image, and so do its coordinates."""
    path = folder.parent / "mask.png"
    masked = track_drift(recording(folder, mask=path, roi=(32, 0, 96, 128)))
    pixel_m = 0.12 / 2000.0 / SIZE
    # The border of the mask stays where it is, in a narrower field, and holds the drift back by 2 %.
    assert masked.path.drift_m[-1] / pixel_m == pytest.approx(4 * STEP, abs=0.2)
