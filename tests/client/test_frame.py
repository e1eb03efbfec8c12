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

"""Pixels to metres and back: round trips, covariances against random cameras, refusals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.client import CalibratedFrame
from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError
from tests.helpers.node_scenes import make_calibration

UV = np.array([[0.0, 0.0], [200.0, 40.0], [63.5, 120.0]])


def projection_of(m: float, px: float, py: float, rho: float) -> Array:
    return np.array(
        [[m, 0.0, rho * px, px], [0.0, m, rho * py, py], [0.0, 0.0, rho, 1.0]], dtype=np.float64
    )


MEAN = np.array([4e6, 60.0, 70.0, 100.0])
SPREAD = np.diag([8e3, 5.0, 4.0, 10.0]) ** 2


def by_parameters() -> Array:
    """(12, 4) derivatives of the projection by m, px, py and rho."""
    steps = [1.0, 1e-3, 1e-3, 1e-2]
    columns = []
    for k, step in enumerate(steps):
        two = [projection_of(*(MEAN + sign * step * np.eye(4)[k])) for sign in (1.0, -1.0)]
        columns.append((two[0] - two[1]).ravel() / (2.0 * step))
    return np.stack(columns, axis=1)


def made(projection: Array | None = None, **other: object) -> CalibratedFrame:
    covariance = by_parameters() @ SPREAD @ by_parameters().T
    frame = CalibratedFrame(
        np.zeros((128, 256), np.uint8),
        17,
        1000.0,
        projection_of(*MEAN) if projection is None else projection,
        covariance,
        np.array([1e-7, 2e-7]),
        np.diag([1e-9, 2e-9]) ** 2,
    )
    return replace(frame, **other)  # type: ignore[arg-type]


@pytest.mark.parametrize("height_m", [0.0, 2e-4])
def test_pixels_become_metres_and_come_back(height_m: float) -> None:
    frame = made()
    points = frame.metres_from_pixels(UV, height_m=height_m)
    xyz = np.column_stack([points.values, np.full(len(UV), height_m)])
    assert np.allclose(frame.pixels_from_metres(xyz).values, UV, atol=1e-9)
    assert frame.pixel_size_m == pytest.approx(2.5e-7)
    assert frame.pixel_size_sigma_m == pytest.approx(2.5e-7 * 8e3 / 4e6)
    # One pixel to the right is one pixel size farther along x.
    assert frame.displacement(UV, UV + [1.0, 0.0]).values == pytest.approx(
        np.tile([2.5e-7, 0.0], (3, 1))
    )


@pytest.mark.long
def test_covariances_are_those_of_random_cameras() -> None:
    """Between 4000 of them, a variance scatters by 2 %."""
    rng = np.random.default_rng(0)
    height_m, sigma_px = 2e-4, 0.3
    frame = made()
    there, back, moved = [], [], []
    xyz = np.column_stack([frame.metres_from_pixels(UV, height_m=height_m).values, [height_m] * 3])
    for parameters in rng.multivariate_normal(MEAN, SPREAD, 4000):
        other = made(projection_of(*parameters))
        seen = UV + rng.normal(0.0, sigma_px, UV.shape)
        drift = rng.normal(0.0, [1e-9, 2e-9])
        there.append(other.metres_from_pixels(seen, height_m=height_m).values + drift)
        back.append(other.pixels_from_metres(xyz + np.append(drift, 0.0)).values)
        ends = UV[:1] + rng.normal(0.0, sigma_px, (2, 1, 2)) + [[[0.0, 0.0]], [[90.0, 20.0]]]
        moved.append(other.displacement(*ends, height_m=height_m).values)
    stated = (
        frame.metres_from_pixels(UV, sigma_px=sigma_px, height_m=height_m),
        frame.pixels_from_metres(xyz),
        frame.displacement(UV[:1], UV[:1] + [90.0, 20.0], sigma_px=sigma_px, height_m=height_m),
    )
    for sample, known in zip((there, back, moved), stated, strict=True):
        for k, covariance in enumerate(known.covariance):
            seen = np.cov(np.array(sample)[:, k].T)
            ratios = np.linalg.eigvals(np.linalg.solve(covariance, seen)).real
            assert np.all((ratios > 0.9) & (ratios < 1.1))


def test_a_length_within_a_frame_does_not_know_of_axis_and_drift() -> None:
    frame = made(drift_covariance=np.eye(2))
    length = frame.displacement(UV[0], UV[1], sigma_px=0.0)
    # Scale alone: 0.2 % of 200 and of 40 pixels.
    assert length.sigma[0] == pytest.approx([200 * 2.5e-7 * 0.002, 40 * 2.5e-7 * 0.002], rel=1e-6)
    assert np.all(frame.metres_from_pixels(UV).sigma > 1.0)


def test_frames_without_a_camera_say_why_they_are_not_valid() -> None:
    frame = made(np.zeros((3, 4)), reason="no calibration")
    assert not frame.valid
    assert np.isnan(frame.pixel_size_m)
    for ask in (frame.metres_from_pixels, frame.pixels_from_metres):
        with pytest.raises(InvalidValueError, match="no calibration"):
            ask(UV)


@pytest.mark.parametrize("points", [[1.0, 2.0, 3.0], [[np.nan, 0.0]], np.zeros((2, 2, 2))])
def test_points_of_another_shape_are_refused(points: object) -> None:
    with pytest.raises(InvalidValueError, match="points of shape"):
        made().metres_from_pixels(points)  # type: ignore[arg-type]


def test_points_that_are_no_numbers_or_not_as_many_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="no numbers"):
        made().metres_from_pixels("abc")  # type: ignore[arg-type]
    with pytest.raises(InvalidValueError, match="3 starts and 2 ends"):
        made().displacement(UV, UV[:2])
    assert made().displacement(UV[0], UV).values.shape == (3, 2)


def test_points_behind_the_pivot_are_refused() -> None:
    with pytest.raises(InvalidValueError, match="behind the pivot"):
        made().pixels_from_metres([0.0, 0.0, -0.011])
    for height_m in (-0.011, np.nan):
        with pytest.raises(InvalidValueError, match="a height of"):
            made().metres_from_pixels(UV, height_m=height_m)


def test_a_drift_that_was_never_measured_leaves_no_place_known() -> None:
    frame = made(drift_covariance=np.full((2, 2), np.inf))
    assert np.all(np.isinf(frame.pixels_from_metres([[1e-6, 2e-6]]).sigma))
    assert np.all(np.isinf(frame.metres_from_pixels(UV).sigma))
    assert np.all(np.isfinite(frame.displacement(UV[0], UV[1]).sigma))


def test_it_agrees_with_the_camera_of_a_calibration() -> None:
    camera = make_calibration().at(2000.0).rectified
    frame = made(camera.P_affine, P_covariance=camera.P_affine_covariance)
    assert frame.pixel_size_m == pytest.approx(camera.pixel_size_m[0])
    assert frame.pixel_size_sigma_m == pytest.approx(camera.pixel_size_sigma_m[0], rel=1e-6)
