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

"""The residual field from a table, against Newton's method at every pixel."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.thresholds.fleets.rectification import make_settling_field
from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.residual_field import ResidualField, zero_field
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.rectification.chebyshev_map import RawMap, SmoothMaps, tabulate_field
from semcal_ros.core.rectification.raw_positions import RasterDrift, raw_from_output
from semcal_ros.synthetic import preset

SIZE = (256, 192)
TIMING = ScanTiming(2.0, averages=2, flyback_fraction=0.1)
G = 2000.0


def settling_field(strength_px: float) -> ResidualField:
    return make_settling_field(SIZE, strength_px)


def camera_with(field: ResidualField, g: float = G) -> ScanCamera:
    plain = preset("pincushion").camera_at(g).resized(*SIZE)
    return replace(plain, residual=field.at(g))


def pixels() -> NDArray[np.intp]:
    """Every third one, which is a sixth of the beam's settling, and the edges."""
    x, y = np.meshgrid(*(np.union1d(np.arange(0, n, 3), n - 1) for n in SIZE))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def largest_error(made: RawMap, camera: ScanCamera, drift: RasterDrift | None = None) -> float:
    """The largest error of a pixel that comes out; what lies outside of the raw frame is black."""
    exact = raw_from_output(pixels().astype(np.float64), SIZE, camera, drift, TIMING)
    scanned = np.all((exact > -1.0) & (exact < np.array(SIZE)), axis=1)
    return float(np.max(np.abs(whole(made) - exact)[scanned]))


def whole(made: RawMap) -> Array:
    band = np.empty((SIZE[1], 2 * SIZE[0]), np.float32)
    made.band(0, SIZE[1], band)
    x, y = pixels().T
    return np.stack([band[y, x], band[y, SIZE[0] + x]], axis=1)


def drift_px(position: tuple[float, float], velocity: tuple[float, float], acceleration=(0.0, 0.0)):
    """A drift in px and seconds of the camera at G."""
    per_px = 1.0 / camera_with(settling_field(0.0)).m
    return RasterDrift(*(per_px * np.array(v) for v in (position, velocity, acceleration)))


@pytest.mark.parametrize(
    "drift",
    [
        None,
        drift_px((0.0, 0.0), (0.0, 0.0)),
        drift_px((-7.3, 4.1), (0.4, -0.3)),
        # A row is scanned while the specimen drifts by a twentieth of it: what lies elsewhere was seen at another time.
        drift_px((31.0, -20.0), (-3.0, 5.0)),
        drift_px((1.0, 2.0), (3.0, -2.0), (2.0, 4.0)),
    ],
    ids=["no drift", "zero", "slow", "fast", "accelerated"],
)
def test_a_map_from_the_table_is_the_exact_one(drift: RasterDrift | None) -> None:
    camera = camera_with(settling_field(2.0))
    made = SmoothMaps().make_map(SIZE, camera, drift, TIMING)
    assert made.is_interpolated
    # What a fast drift may add at the test points, and a little between them; the field moves pixels by 3 px.
    assert largest_error(made, camera, drift) < 0.004


def test_a_stage_that_starts_to_move_is_tested_anew() -> None:
    camera, maps = camera_with(settling_field(2.0)), SmoothMaps()
    for drift in (
        drift_px((0.0, 0.0), (0.1, 0.0)),
        drift_px((1.0, 0.5), (0.1, 0.0)),
        # Far from what was tested, and so fast that rows of the field that did before do not now.
        drift_px((31.0, -20.0), (-3.0, 5.0)),
        drift_px((0.0, -60.0), (0.1, 0.0)),
    ):
        made = maps.make_map(SIZE, camera, drift, TIMING)
        assert largest_error(made, camera, drift) < 0.004


def test_every_magnification_of_a_zoom_has_its_own_field() -> None:
    maps, field = SmoothMaps(), settling_field(2.0)
    for g in (150.0, 151.0, 9000.0, 150.0, 20000.0):
        camera = camera_with(field, g)
        made = maps.make_map(SIZE, camera, None, None)
        assert made.is_interpolated
        assert largest_error(made, camera) < 0.004


def test_a_field_that_changes_with_the_magnification_is_tested_anew() -> None:
    zero = zero_field(SIZE, (100.0, 10000.0), 2)
    coefficients = zero.coefficients.copy()
    # Along the lines only, so that rows stay where they are; from line to line more than twelve degrees follow.
    coefficients[1, ..., 0] = 6.0 / (0.5 * SIZE[0]) * np.cos(3.0 * np.arange(7))[:, None]
    maps, field = SmoothMaps(), replace(zero, coefficients=coefficients)
    plain = preset("pincushion").camera_at(G).resized(*SIZE)
    for g in (100.0, 10000.0, 100.0):
        camera = replace(plain, residual=field.at(g))
        assert largest_error(maps.make_map(SIZE, camera, None, None), camera) < 0.004


def test_the_slope_of_a_field_is_bounded() -> None:
    field = settling_field(2.0)
    at = np.random.default_rng(0).uniform(-1.0, 1.0, (20000, 2)) * [1.0, SIZE[1] / SIZE[0]]
    slices = [field.at(g) for g in (100.0, 1000.0, 10000.0)]
    largest = max(float(np.abs(one.gradient(at)).sum(axis=2).max()) for one in slices)
    assert all(largest <= one.largest_slope < 2.0 * largest for one in slices)


def test_a_field_that_is_too_steep_for_the_table_is_computed_exactly() -> None:
    camera = camera_with(settling_field(12.0))
    made = SmoothMaps().make_map(SIZE, camera, None, None)
    assert largest_error(made, camera) < 0.004


def test_look_ups_invert_the_field() -> None:
    camera = camera_with(settling_field(2.0))
    assert camera.residual is not None
    table = tabulate_field(camera, SIZE)
    assert table is not None
    rng = np.random.default_rng(0)
    at = rng.uniform([-1.0, -1.0], SIZE, (2000, 2))
    found = table.invert(*(np.ascontiguousarray(v[None], dtype=np.float32) for v in at.T))
    assert found is not None
    q = (at - 0.5 * (np.array(SIZE) - 1.0)) / camera.norm_px
    exact = camera.norm_px * (camera.residual.inverse(q) - q)
    # A slope of 0.2 at most, over 64.
    assert np.max(np.abs(found[0] - exact)) < 0.2 / 64


def test_the_table_of_a_large_image_is_as_accurate_as_its_map_must_be() -> None:
    size = 2048, 4096
    zero = zero_field(size, (100.0, 10000.0), 1)
    coefficients = zero.coefficients.copy()
    # 2 px that change their sign from knot to knot down the image.
    coefficients[..., 0] = 2.0 / (0.5 * size[0]) * np.cos(2.5 * np.arange(7))[:, None]
    field = replace(zero, coefficients=coefficients).at(G)
    camera = replace(preset("pincushion").camera_at(G).resized(*size), residual=field)
    table = tabulate_field(camera, size)
    assert table is not None
    at = np.random.default_rng(0).uniform([0.0, 0.0], np.array(size) - 1.0, (2000, 2))
    found = table.invert(*(np.ascontiguousarray(v[None], dtype=np.float32) for v in at.T))
    assert found is not None
    q = (at - 0.5 * (np.array(size) - 1.0)) / camera.norm_px
    exact = camera.norm_px * (field.inverse(q) - q)
    # Maps are tested to 0.001 px; OpenCV 4 rounds positions, and adds 1/64 of the change from row to row, 0.015 px.
    assert np.max(np.abs(found[0] - exact)) < 0.00125


@pytest.mark.parametrize("beyond", [0.0, 24.0])
def test_a_table_for_some_rows_says_the_same_there(beyond: float) -> None:
    camera = camera_with(settling_field(2.0))
    # Lines of an image that is bent and has drifted out of the frame.
    x = np.linspace(0.0, SIZE[0] - 1.0, 60, dtype=np.float32)
    places = np.array([[-3.0], [40.0], [101.5], [189.0 + beyond]], dtype=np.float32)
    column, row = np.broadcast_arrays(x, places + 4.0 * (x / 128.0 - 1.0) ** 2)
    whole = tabulate_field(camera, SIZE, beyond)
    strips = tabulate_field(camera, SIZE, beyond, np.asarray(row, dtype=np.float32))
    assert whole is not None
    assert strips is not None
    assert len(strips.back_px) < 0.7 * len(whole.back_px)
    found, expected = (table.invert(column, row) for table in (strips, whole))
    # Single precision of rows of some hundred, times the slope; OpenCV 4 rounds both alike but at an edge.
    np.testing.assert_allclose(found, expected, atol=3e-4)


def test_a_field_without_end_has_no_table() -> None:
    assert tabulate_field(camera_with(settling_field(400.0)), SIZE) is None
