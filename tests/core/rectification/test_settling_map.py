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

"""Live maps of a camera whose beam settles at the start of the lines, against the exact positions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.residual_field import zero_field
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_distortion import SCAN_NAMES
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.rectification.chebyshev_map import RawMap, SmoothMaps
from semcal_ros.core.rectification.raw_positions import RasterDrift, raw_from_output
from semcal_ros.core.rectification.rectifier import Rectifier
from tests.helpers.long_tests import long_but

SIZE = (512, 384)
TIMING = ScanTiming(2.0, averages=2, flyback_fraction=0.1)
M = 4e6
CAMERA = ScanCamera(
    1000.0, M, 1.01, 0.004, 250.0, 200.0, 50.0, 0.02, -0.005, 240.0, 185.0, 256.0, *SIZE
)
# Up to 3 px in the first column, with fast decays and a slow one; spiral and coils of some px.
SETTLING = replace(
    CAMERA,
    xi_s=-0.008,
    xi_u=0.003,
    xi_v=-0.002,
    xi_w=0.002,
    coil_x3=-0.006,
    coil_y2=0.004,
    settling_1=-0.005,
    settling_2=0.012,
    settling_4=0.006,
)


def drift_px(position: tuple[float, float], velocity: tuple[float, float], acceleration=(0.0, 0.0)):
    return RasterDrift(*(np.array(v) / M for v in (position, velocity, acceleration)))


DRIFTS = {
    "no drift": None,
    "still": drift_px((-7.3, 4.1), (0.0, 0.0)),
    "slow": drift_px((-7.3, 4.1), (0.4, -0.3)),
    # A row is scanned while the specimen drifts by a twentieth of it.
    "fast": drift_px((31.0, -20.0), (-3.0, 5.0)),
    "accelerated": drift_px((1.0, 2.0), (3.0, -2.0), (2.0, 4.0)),
}


def errors(made: RawMap, camera: ScanCamera, drift: RasterDrift | None) -> Array:
    """Errors (n, 2) in px of every column, in some rows and the outermost ones; outside the raw frame is black."""
    width, height = size = (camera.width, camera.height)
    rows = np.union1d(np.arange(0, height, 7), height - 1)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(width), rows))
    exact = raw_from_output(
        np.stack([x, y], axis=1).astype(np.float64), size, camera, drift, TIMING
    )
    band = np.empty((height, 2 * width), np.float32)
    made.band(0, height, band)
    scanned = np.all((exact > -1.0) & (exact < np.array(size)), axis=1)
    assert scanned.mean() > 0.8
    return (np.stack([band[y, x], band[y, width + x]], axis=1) - exact)[scanned]


@pytest.mark.parametrize("size", [SIZE, (256, 192), (1280, 960), (512, 300)])
@pytest.mark.parametrize("drift", DRIFTS.values(), ids=DRIFTS)
def test_a_map_with_settling_is_the_exact_one(drift: RasterDrift | None, size) -> None:
    camera = SETTLING.resized(*size)
    made = SmoothMaps().make_map(size, camera, drift, TIMING)
    assert made.is_interpolated
    # The promise is 0.002 px; a table that did not follow the raster beyond a part of it took 0.0019 px of that.
    assert np.abs(errors(made, camera, drift)).max() < 0.0015


def test_the_settling_is_seen_in_the_first_columns() -> None:
    """The camera without it misses by px there, and by its straight line elsewhere."""
    still = replace(SETTLING, settling_1=0.0, settling_2=0.0, settling_4=0.0)
    made = SmoothMaps().make_map(SIZE, still, None, TIMING)
    missed = np.abs(errors(made, SETTLING, None))
    assert 2.0 < missed.max() < 4.0
    assert missed[:, 1].max() < 0.002


@pytest.mark.parametrize("name", long_but(lambda name: name != "accelerated", DRIFTS))
def test_a_residual_field_comes_on_top(name: str) -> None:
    zero = zero_field(SIZE, (100.0, 10000.0), 1)
    values = zero.coefficients.copy()
    # Near enough to where each basis function has its maximum.
    x, y = (
        np.array([np.mean(knots[k + 1 : k + 4]) for k in range(len(knots) - 4)])
        for knots in (zero.knots_x, zero.knots_y)
    )
    values[..., 0] = np.sin(3.0 * x) * np.cos(2.0 * y)[:, None] / 256.0
    values[..., 1] = np.cos(2.0 * x) * np.sin(3.0 * y)[:, None] / 256.0
    camera = replace(SETTLING, residual=replace(zero, coefficients=values).at(1000.0))
    made = SmoothMaps().make_map(SIZE, camera, DRIFTS[name], TIMING)
    # A specimen that accelerates that much is followed exactly, which is slow.
    assert made.is_interpolated or name == "accelerated"
    # What a fast drift may add at the test points, and a little between them, as without settling.
    assert np.abs(errors(made, camera, DRIFTS[name])).max() < 0.004


def test_frames_of_a_stream_keep_to_their_own_camera_and_drift() -> None:
    maps = SmoothMaps()
    for factor, name in ((1.0, "no drift"), (0.3, "slow"), (-1.0, "fast"), (0.0, "slow")):
        own = {n: factor * getattr(SETTLING, n) for n in ("settling_1", "settling_2", "settling_4")}
        camera = replace(SETTLING, **own)
        made = maps.make_map(SIZE, camera, DRIFTS[name], TIMING)
        assert made.is_interpolated
        assert np.abs(errors(made, camera, DRIFTS[name])).max() < 0.002


def test_a_beam_that_stands_still_is_computed_exactly() -> None:
    """Some output pixels were never scanned."""
    camera = replace(CAMERA, settling_1=0.05)
    made = SmoothMaps().make_map(SIZE, camera, None, None)
    assert not made.is_interpolated
    exact = camera.raw_from_rect(np.array([[3.0, 100.0], [300.0, 100.0]]))
    band = np.empty((1, 2 * SIZE[0]), np.float32)
    made.band(100, 101, band)
    assert np.isnan(exact[0]).any()
    assert band[0, 3] < -1000.0
    np.testing.assert_allclose(band[0, [300, 812]], exact[1], atol=1e-3)


@pytest.mark.parametrize("seed", range(12))
def test_any_scan_is_followed_by_the_map_or_computed_exactly(seed: int) -> None:
    """Amplitudes of a px each, and a drift of some rows: where the map is interpolated, it is to 0.002 px."""
    rng = np.random.default_rng(seed)
    own = {n: rng.normal(0.0, 0.004 if "coil" in n else 0.003) for n in SCAN_NAMES}
    size = tuple(rng.integers((200, 150), (700, 500)).tolist())
    camera = replace(CAMERA.resized(*size), raster_ratio=None, **own)
    drift = drift_px(*rng.normal(0.0, [[10.0], [2.0], [0.5]], (3, 2)))
    made = SmoothMaps().make_map(size, camera, drift, TIMING)
    assert np.abs(errors(made, camera, drift)).max() < 0.002


def test_the_rectifier_tells_rasters_of_another_height_apart() -> None:
    """The functions across the lines refer to the picture that was calibrated, of which this one is a part."""
    rectifier = Rectifier()
    xy = np.array([[100.0, 3.0], [400.0, 380.0]])
    for ratio in (0.75, 1.0):
        camera = replace(CAMERA, coil_y3=0.01, raster_ratio=ratio)
        map_x, map_y = rectifier.maps(SIZE, camera)
        at_y, at_x = xy[:, 1].astype(int), xy[:, 0].astype(int)
        got = np.stack([map_x[at_y, at_x], map_y[at_y, at_x]], axis=1)
        np.testing.assert_allclose(got, camera.raw_from_rect(xy), atol=0.002)
