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

"""The drift-corrected average against images whose shift and noise are known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.rectification.raw_positions import RasterDrift
from semcal_ros.core.rectification.stack import Stack, find_scanned
from tests.helpers.drift_scenes import DriftingSpecimen, Texture, noisy, small_camera

SIZE = 128
TEXTURE = Texture(seed=5)


def at(x: float, y: float) -> RasterDrift:
    return RasterDrift(np.array([x, y]), np.zeros(2))


def stacked(pictures: list[np.ndarray], drifts: list[RasterDrift | None], **options: str) -> Stack:
    height, width = pictures[0].shape
    stack = Stack((width, height), **options)
    for picture, drift in zip(pictures, drifts, strict=True):
        stack.add(*stack.rectify(picture.astype(np.float32), None, drift))
    return stack


@pytest.mark.parametrize("count", [4, 25])
def test_noise_falls_with_the_root_of_the_number_and_the_standard_error_says_so(count):
    sigma, rng = 6.0, np.random.default_rng(count)
    # Whole pixels: no interpolation comes between the noise and the average.
    shifts = rng.integers(-9, 10, (count, 2))
    pictures = [noisy(TEXTURE.view(tuple(s), SIZE), sigma, k) for k, s in enumerate(shifts)]
    image = stacked(pictures, [at(*s) for s in shifts]).result()
    seen = image.count == count
    errors = (image.mean - noisy(TEXTURE.view((0, 0), SIZE), 0.0, 0))[seen]
    expected = sigma / np.sqrt(count)
    # An RMS of n normal numbers scatters by 1 / sqrt(2 n) of itself; three times that.
    assert seen.sum() > 0.6 * SIZE**2
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(expected, rel=3 / np.sqrt(2 * errors.size))
    stated = np.sqrt(np.mean(image.standard_error[seen].astype(float) ** 2))
    degrees = errors.size * (count - 1)
    assert stated == pytest.approx(expected, rel=3 / np.sqrt(2 * degrees))
    # Per pixel, too: errors in units of the stated ones have Student's t distribution.
    t = errors / image.standard_error[seen]
    inside = np.mean(np.abs(t) < {4: 3.182, 25: 2.064}[count])
    assert inside == pytest.approx(0.95, abs=3 * np.sqrt(0.95 * 0.05 / errors.size))


def test_a_drifting_texture_stays_sharp():
    drifts = [(0.7 * k, -0.45 * k) for k in range(9)]
    truth = noisy(TEXTURE.view((0, 0), SIZE), 0.0, 0)
    pictures = [noisy(TEXTURE.view(d, SIZE), 0.0, 0) for d in drifts]
    corrected = stacked(pictures, [at(*d) for d in drifts]).result()
    plain = stacked(pictures, [None] * len(drifts)).result()
    seen = corrected.count == len(drifts)
    errors = [np.sqrt(np.mean((s.mean - truth)[seen] ** 2)) for s in (corrected, plain)]
    # Cubic interpolation of a texture that is blurred by 1.5 px is good to a percent of its
    # contrast (40 grey levels); the drift of 6.7 px blurs most of it away.
    assert errors[0] < 0.4
    assert errors[1] > 20 * errors[0]


def test_the_shear_within_a_frame_is_undone():
    """Each pixel at its own time, with a distorting camera."""
    camera, timing = small_camera(2000.0), ScanTiming(0.9, 1, 0.1)
    specimen = DriftingSpecimen(pitch_m=0.1e-6, seed=3)
    velocity = np.array([0.6e-6, -0.4e-6])
    stack, frozen = Stack((192, 192)), Stack((192, 192))
    for k in range(6):
        drift = RasterDrift(k * velocity, velocity)
        frame = specimen.frame(camera, timing, drift.position, velocity, k, noise=0.0)
        stack.add(*stack.rectify(frame, camera, drift, timing))
        frozen.add(*frozen.rectify(frame, camera, at(*drift.position), timing))
    image, sheared = stack.result(), frozen.result()
    seen = image.count == 6
    still = specimen.frame(camera, timing, np.zeros(2), np.zeros(2), 0, noise=0.0)
    truth, valid = stack.rectify(still, camera, None, timing)
    seen &= valid
    errors = [np.sqrt(np.mean((s.mean - truth)[seen] ** 2)) for s in (image, sheared)]
    # Rounding to whole grey levels and two interpolations of a contrast of 40; unsheared by 4.3 px
    # within a frame it is another image.
    assert errors[0] < 0.5
    assert errors[1] > 5 * errors[0]


def test_pixels_that_were_not_scanned_do_not_count():
    bright = np.full((40, 60), 100.0)
    stack = stacked([bright, bright, bright], [None, at(10, 0), at(0, -5)], interpolation="linear")
    image = stack.result()
    expected = np.full((40, 60), 3)
    expected[:, 50:] -= 1
    expected[:5] -= 1
    np.testing.assert_array_equal(image.count, expected)
    np.testing.assert_allclose(image.mean, 100.0, rtol=1e-6)
    np.testing.assert_allclose(image.standard_error[expected > 1], 0.0, atol=1e-4)


def test_black_is_a_grey_level_like_others():
    dark = np.zeros((40, 60))
    image = stacked([dark, dark + 8.0], [at(0, 0), at(0, 0)], interpolation="linear").result()
    np.testing.assert_array_equal(image.count, 2)
    np.testing.assert_allclose(image.mean, 4.0)
    # Half of the difference of two values is the standard error of their mean.
    np.testing.assert_allclose(image.standard_error, 4.0)


def test_what_is_not_known_is_nan():
    empty = Stack((5, 4)).result()
    assert np.isnan(empty.mean).all() and np.isnan(empty.standard_error).all()
    assert empty.frames == 0
    picture = np.full((4, 5), 7.0, dtype=np.float32)
    picture[1, 2] = np.nan
    stack = Stack((5, 4))
    stack.add(picture, np.ones((4, 5), dtype=bool))
    once = stack.result()
    assert np.isnan(once.standard_error).all()
    assert np.isnan(once.mean[1, 2]) and once.count[1, 2] == 0
    assert np.nanmax(np.abs(once.mean - 7.0)) == 0.0


def test_small_noise_on_large_grey_levels():
    """Sums of squares must not lose what is small against the mean."""
    rng = np.random.default_rng(1)
    stack, valid = Stack((64, 64)), np.ones((64, 64), dtype=bool)
    for _ in range(200):
        stack.add((60000.0 + rng.standard_normal((64, 64))).astype(np.float32), valid)
    stated = np.sqrt(np.mean(stack.result().standard_error.astype(float) ** 2))
    assert stated == pytest.approx(1 / np.sqrt(200), rel=3 / np.sqrt(2 * 64**2 * 199))


def test_the_reach_of_the_interpolation_is_respected():
    x, y = np.meshgrid(np.arange(8, dtype=np.float32), np.arange(6, dtype=np.float32))
    assert find_scanned(x, y, (8, 6)).all()
    assert not find_scanned(x + 0.01, y, (8, 6))[:, -1].any()
    inner = find_scanned(x, y, (8, 6), reach=1)
    assert inner[1:-1, 1:-1].all() and inner.sum() == 6 * 4
    # Every counted pixel of a constant image keeps its value: nothing from beyond the edge.
    for interpolation in ("linear", "cubic", "lanczos4"):
        image = stacked([np.full((48, 48), 90.0)], [at(0.4, -2.3)], interpolation=interpolation)
        np.testing.assert_allclose(image.result().mean[image.result().count == 1], 90.0, rtol=1e-5)


def test_what_does_not_fit_is_refused():
    stack = Stack((8, 6))
    valid = np.ones((6, 8), dtype=bool)
    with pytest.raises(InvalidValueError, match="expected"):
        stack.rectify(np.zeros((8, 6), np.uint8), None)
    with pytest.raises(InvalidValueError, match="expected"):
        stack.rectify(np.zeros((6, 8, 3), np.uint8), None)
    with pytest.raises(InvalidValueError, match="expected"):
        stack.add(np.zeros((6, 8), np.float32), valid[:, :4])
    with pytest.raises(InvalidValueError, match="nearest"):
        Stack((8, 6), "nearest")
    with pytest.raises(InvalidValueError, match="0 x 6"):
        Stack((0, 6))
