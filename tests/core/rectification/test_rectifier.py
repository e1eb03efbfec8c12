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

"""Rectification against the exact map and against images with known contents."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.rectification.raw_positions import PixelDrift, RasterDrift, raw_from_output
from semcal_ros.core.rectification.rectifier import Rectifier
from tests.helpers.drift_scenes import small_camera

SIZE = 192
CAMERA = small_camera(1000.0, SIZE)
TIMING = ScanTiming(1.5, averages=1, flyback_fraction=0.1)
STILL = np.zeros(2)


def _grid(width: int, height: int) -> np.ndarray:
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)


def _spot(at: tuple[float, float], size: int = SIZE) -> np.ndarray:
    y, x = np.mgrid[:size, :size]
    return (200.0 * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / 18.0)).astype(np.float32)


def _centroid(picture: np.ndarray) -> np.ndarray:
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]]
    weight = picture.astype(np.float64)
    return np.array([np.sum(x * weight), np.sum(y * weight)]) / weight.sum()


def test_puts_a_spot_at_its_rectified_pixel() -> None:
    point = CAMERA.rectified.sem_from_ideal([[30.0, 160.0]])
    raw = CAMERA.project(point)[0]
    rectified = Rectifier().rectify(_spot((raw[0], raw[1])), CAMERA)
    # A spot of 3 px is resampled linearly: its centroid keeps to about 0.02 px.
    np.testing.assert_allclose(_centroid(rectified), [30.0, 160.0], atol=0.03)
    assert np.hypot(*(raw - [30.0, 160.0])) > 0.3


def test_sign_of_the_drift() -> None:
    # A point that drifted by (+5, -3) um is seen away from its place and is put back.
    drift = np.array([5e-6, -3e-6])
    point = CAMERA.rectified.sem_from_ideal([[100.0, 80.0]])
    raw = CAMERA.project(point + np.append(drift, 0.0))[0]
    assert raw[0] > 115.0
    assert raw[1] < 72.0
    rectified = Rectifier().rectify(_spot((raw[0], raw[1])), CAMERA, RasterDrift(drift, STILL))
    np.testing.assert_allclose(_centroid(rectified), [100.0, 80.0], atol=0.03)


def test_drift_in_px_without_a_camera() -> None:
    picture = _spot((60.0, 70.0))
    moved = Rectifier().rectify(picture, None, RasterDrift(np.array([10.0, -4.0]), STILL))
    np.testing.assert_allclose(_centroid(moved), [50.0, 74.0], atol=1e-3)
    np.testing.assert_array_equal(Rectifier().rectify(picture, None), picture)


def test_each_pixel_is_put_back_by_the_drift_at_its_own_time() -> None:
    # 8 px/s along x: what is scanned late has drifted further than the centre, what is scanned
    # early less.
    velocity = np.array([8.0, 0.0])
    for row in (20.0, 170.0):
        expected = 90.0
        raw_x = expected
        for _ in range(20):
            t = TIMING.pixel_offset_s(row, raw_x, SIZE, SIZE) - TIMING.centre_offset_s
            raw_x = expected + velocity[0] * float(t)
        assert (raw_x > 93.0) if row > SIZE / 2 else (raw_x < 86.0)
        picture = _spot((raw_x, row))
        out = Rectifier("cubic").rectify(picture, None, RasterDrift(STILL, velocity), TIMING)
        # The spot itself is sheared by 8 px per 128 rows, which leaves its centre in place.
        np.testing.assert_allclose(_centroid(out), [expected, row], atol=0.06)


def test_averaged_scans_shear_by_one_pass_only() -> None:
    drift = RasterDrift(STILL, np.array([4.0, 0.0]))
    eight = ScanTiming(0.25, averages=8)
    xy = np.array([[50.0, 0.0], [50.0, SIZE - 1.0]])
    raw = raw_from_output(xy, (SIZE, SIZE), None, drift, eight)
    assert raw[1, 0] - raw[0, 0] == pytest.approx(4.0 * 0.25 * (SIZE - 1) / SIZE, rel=0.01)
    # The middle of the frame is its centre in time.
    middle = raw_from_output(np.array([[SIZE / 2, SIZE / 2]]), (SIZE, SIZE), None, drift, eight)
    assert middle[0, 0] == pytest.approx(SIZE / 2, abs=0.01)


@pytest.mark.parametrize("bidirectional", [False, True])
@pytest.mark.parametrize("rows_per_row", [0.001, 0.03, 0.4])
def test_raw_positions_fulfil_their_equation_however_fast_the_drift_is(
    rows_per_row: float, bidirectional: bool
) -> None:
    # Steps are left out where those before tell that they would change nothing.
    timing = replace(TIMING, bidirectional=bidirectional)
    speed_m_s = rows_per_row * SIZE / timing.frame_time_s / CAMERA.m
    drift = RasterDrift(
        np.array([4e-6, -7e-6]), speed_m_s * np.array([0.6, -0.8]), speed_m_s * np.array([0.2, 0.1])
    )
    xy = _grid(9, 9) * 20.0 + 10.0
    raw = raw_from_output(xy, (SIZE, SIZE), CAMERA, drift, timing)
    moved = PixelDrift((SIZE, SIZE), CAMERA, drift, timing).moved(xy, raw)
    # A hundredth of what is promised for maps, and what the last step leaves.
    np.testing.assert_allclose(CAMERA.raw_from_rect(moved), raw, atol=2e-5)


def test_averaged_scans_bend_by_the_mean_over_their_passes() -> None:
    acceleration = np.array([6.0, -4.0])
    timing = ScanTiming(0.4, averages=5, flyback_fraction=0.1)
    xy = _grid(7, 5) * 20.0
    size = (140, 100)
    raw = raw_from_output(xy, size, None, RasterDrift(STILL, STILL, acceleration), timing)
    # Each pass by itself, as a scan of its own.
    single = ScanTiming(0.4, flyback_fraction=0.1).pixel_offset_s(raw[:, 1], raw[:, 0], 100, 140)
    since_s = single[:, None] + 0.4 * np.arange(5) - 1.0
    expected = xy + 0.5 * acceleration * np.mean(since_s**2, axis=1)[:, None]
    np.testing.assert_allclose(raw, expected, atol=1e-4)


@settings(max_examples=25, deadline=None)
@given(
    st.floats(-0.05, 0.05),
    st.floats(-0.02, 0.02),
    st.floats(-20e-6, 20e-6),
    st.floats(-10e-6, 10e-6),
    st.floats(-4e-6, 4e-6),
)
def test_maps_are_exact_to_a_hundredth_of_a_pixel(
    xi_r: float, xi_t: float, dx: float, dy: float, v: float
) -> None:
    width, height = 160, 120
    base = small_camera(1000.0, width)
    camera = ScanCamera(
        1000.0, base.m, 1.005, 0.02, 75.0, 66.0, 50.0, xi_r, xi_t, 70.0, 62.0, 80.0, width, height
    )
    drift = RasterDrift(np.array([dx, dy]), np.array([v, -v]))
    for use in (None, drift):
        maps = Rectifier().maps((width, height), camera, use, TIMING)
        exact = raw_from_output(_grid(width, height), (width, height), camera, use, TIMING)
        error = np.stack([m.ravel() for m in maps], axis=1) - exact
        assert float(np.max(np.abs(error))) < 0.01


def test_map_of_a_field_with_a_hole_in_the_distortion() -> None:
    camera = ScanCamera(
        100.0, 1e5, 1.0, 0.0, 95.5, 95.5, 0.0, 0.2, 0.0, 95.5, 95.5, 96.0, SIZE, SIZE
    )
    # 4 xi_r r2 reaches 1 inside the corners: no raw pixel there, black in the output.
    out = Rectifier().rectify(np.full((SIZE, SIZE), 200, np.uint8), camera)
    assert out[0, 0] == 0
    assert out[96, 96] == 200


def test_changing_drift_and_magnification_use_their_own_maps() -> None:
    rectifier = Rectifier()
    grid = _grid(SIZE, SIZE)
    for magnification in (500.0, 1000.0, 500.0, 2000.0, 500.0):
        camera = small_camera(magnification, SIZE)
        for drift in (None, RasterDrift(np.array([1e-6, 2e-6]), STILL), None):
            maps = rectifier.maps((SIZE, SIZE), camera, drift)
            exact = raw_from_output(grid, (SIZE, SIZE), camera, drift, None)
            assert float(np.max(np.abs(maps[0].ravel() - exact[:, 0]))) < 0.01


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
@pytest.mark.parametrize("channels", [(), (3,)])
@pytest.mark.parametrize("interpolation", ["linear", "cubic", "lanczos4"])
def test_type_and_shape_are_kept(
    dtype: type, channels: tuple[int, ...], interpolation: str
) -> None:
    picture = np.full((100, SIZE, *channels), 77, dtype)
    drift = RasterDrift(np.array([1e-6, 0.0]), np.array([1e-7, 0.0]))
    out = Rectifier(interpolation).rectify(picture, CAMERA, drift, TIMING)
    assert out.dtype == picture.dtype
    assert out.shape == picture.shape
    assert np.all(np.abs(out[40:60, 60:120].astype(float) - 77) < 1e-3)


def test_what_was_not_scanned_is_black() -> None:
    picture = np.full((64, 64), 200, np.uint8)
    out = Rectifier().rectify(picture, None, RasterDrift(np.array([10.0, 0.0]), STILL))
    assert np.all(out[:, 55:] == 0)
    assert np.all(out[:, :53] == 200)


def test_another_image_size_uses_the_same_field_of_view() -> None:
    raw = CAMERA.project(CAMERA.rectified.sem_from_ideal([[30.0, 160.0]]))[0]
    double = CAMERA.resized(2 * SIZE, 2 * SIZE)
    ideal = 2.0 * (np.array([30.0, 160.0]) + 0.5) - 0.5
    at = 2.0 * (raw + 0.5) - 0.5
    picture = _spot((at[0], at[1]), 2 * SIZE)
    np.testing.assert_allclose(_centroid(Rectifier().rectify(picture, CAMERA)), ideal, atol=0.05)
    np.testing.assert_allclose(_centroid(Rectifier().rectify(picture, double)), ideal, atol=0.05)


def test_bad_input_is_refused() -> None:
    good = np.zeros((64, 64), np.uint8)
    with pytest.raises(InvalidValueError, match="linear or cubic or lanczos4"):
        Rectifier("nearest")
    with pytest.raises(InvalidValueError, match="uint8, uint16, float32"):
        Rectifier().rectify(good.astype(np.int32), CAMERA)
    with pytest.raises(InvalidValueError, match="32766"):
        Rectifier().rectify(np.zeros((2, 40_000), np.uint8), CAMERA)
    with pytest.raises(InvalidValueError, match="finite"):
        Rectifier().rectify(good, None, RasterDrift(np.array([np.nan, 0.0]), STILL))
    with pytest.raises(InvalidValueError, match="slow against"):
        fast = RasterDrift(STILL, np.array([0.0, 200.0]))
        Rectifier().rectify(good, None, fast, TIMING)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_writing_to_given_memory_gives_the_same_picture(dtype: type) -> None:
    rng = np.random.default_rng(1)
    picture = (200.0 * rng.random((100, SIZE))).astype(dtype)
    drift = RasterDrift(np.array([1e-6, 2e-6]), np.array([1e-7, 0.0]))
    memory = np.full(picture.nbytes + 1, 255, np.uint8)
    # An odd address, as that of data inside a message may be.
    out = memory[1:].view(dtype).reshape(picture.shape) if dtype is np.uint8 else None
    out = np.empty_like(picture) if out is None else out
    rectifier = Rectifier()
    for camera, moved in ((None, None), (CAMERA, None), (CAMERA, drift)):
        for _ in range(3):
            # The first time in bands, later from maps that were kept.
            result = rectifier.rectify(picture, camera, moved, TIMING, out=out)
            assert result is out
            expected = Rectifier().rectify(picture, camera, moved, TIMING)
            np.testing.assert_array_equal(out, expected)
    assert memory[0] == 255


def test_a_map_that_comes_again_gives_the_same_picture() -> None:
    picture = np.random.default_rng(2).integers(0, 255, (300, 200), dtype=np.uint8)
    drift = RasterDrift(np.array([1e-6, 2e-6]), np.array([1e-6, 3e-6]))
    rectifier = Rectifier()
    first, second, third = (rectifier.rectify(picture, CAMERA, drift, TIMING) for _ in range(3))
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(first, third)


@pytest.mark.parametrize(
    "out",
    [
        np.empty((100, 101), np.uint8),
        np.empty((100, 100), np.uint16),
        np.empty((200, 200), np.uint8)[::2, ::2],
        np.frombuffer(bytes(10_000), np.uint8).reshape(100, 100),
    ],
    ids=["shape", "type", "stride", "read-only"],
)
def test_an_output_that_does_not_fit_is_refused(out: np.ndarray) -> None:
    with pytest.raises(InvalidValueError, match="output"):
        Rectifier().rectify(np.zeros((100, 100), np.uint8), CAMERA, out=out)


def test_frames_of_every_size_are_covered_by_bands() -> None:
    # A gradient: a row that no band wrote, or that another one wrote, shows at once.
    for width, height in ((1, 1), (7, 501), (501, 7), (20_000, 2), (333, 257)):
        y, x = np.mgrid[:height, :width].astype(np.float32)
        drift = RasterDrift(np.array([0.25, 0.5]), STILL)
        out = Rectifier().rectify(x + y, None, drift)
        inside = (slice(0, height - 1), slice(0, width - 1))
        np.testing.assert_allclose(out[inside], (x + y + 0.75)[inside], rtol=1e-6, atol=1e-3)
