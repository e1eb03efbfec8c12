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

"""Rendered boards lie where the camera model says, and every pixel is taken at its own time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic import (
    PRESETS,
    ChessGrid,
    Pose,
    VirtualMicroscope,
    preset,
    render_reflectivity,
    square_for,
)
from semcal_ros.synthetic.render import trace_ray_lattice

REACH_PX = 4.0
STEPS = np.linspace(-REACH_PX, REACH_PX, 81)


def edge_offsets(image: NDArray[np.float32], points: Array, normals: Array, rises: Array) -> Array:
    """Signed distance of an edge from ``points`` along ``normals``, from its profile's area."""
    where = points[:, None, :] + STEPS[None, :, None] * normals[:, None, :]
    profile = map_coordinates(image, [where[..., 1], where[..., 0]], order=3)
    profile = np.where(rises[:, None], profile, 1.0 - profile)
    area = (profile.sum(axis=1) - 0.5 * (profile[:, 0] + profile[:, -1])) * (STEPS[1] - STEPS[0])
    return REACH_PX - area


def corner_errors(
    image: NDArray[np.float32],
    microscope: VirtualMicroscope,
    g: float,
    pose: Pose,
    square_m: float,
    shift_m: object = None,
) -> Array:
    """(n, 2) measured minus predicted corner positions in px.

    ``shift_m`` maps raw pixels (n, 2) to the specimen's displacement (n, 2) at their time.
    """

    def raw(board: Array) -> Array:
        sem = pose.sem_from_specimen(board * square_m)
        xy = microscope.project(g, sem)
        if shift_m is not None:
            for _ in range(4):
                sem_moved = sem.copy()
                sem_moved[:, :2] += shift_m(xy)  # type: ignore[operator]
                xy = microscope.project(g, sem_moved)
        return xy

    reach = math.ceil(2.0 * microscope.width * microscope.nominal_pixel_size_m(g) / square_m)
    axis = np.arange(-reach, reach + 1, dtype=np.float64)
    corners = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    xy = raw(corners)
    size = np.array([microscope.width, microscope.height])
    span = np.abs(raw(corners + 0.3) - xy).max()
    seen = np.all((xy > span + 5) & (xy < size - span - 5), axis=1)
    corners, xy = corners[seen], xy[seen]
    if len(corners) > 60:
        keep = np.random.default_rng(0).choice(len(corners), 60, replace=False)
        corners = corners[keep]

    # A band-limited image can be interpolated: without the blur, this scatters by 0.015 px.
    smooth = gaussian_filter(image, 1.0)
    rows, sides = [], []
    for along in (0, 1):
        across = 1 - along
        offsets, normal = [], np.zeros((len(corners), 2))
        for arm in (-0.3, 0.3):
            on_edge = corners.copy()
            on_edge[:, along] += arm
            ahead = on_edge.copy()
            ahead[:, along] += 1e-3
            tangent = raw(ahead) - raw(on_edge)
            normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            beyond = on_edge.copy()
            beyond[:, across] += 1e-3
            sign = np.sign(np.sum((raw(beyond) - raw(on_edge)) * normal, axis=1))
            normal *= sign[:, None]
            square = np.floor(on_edge)
            square[:, across] = corners[:, across]  # the square on the positive side of the edge
            bright = np.mod(square.sum(axis=1), 2) == 0
            offsets.append(edge_offsets(smooth, raw(on_edge), normal, bright))
        rows.append(normal)
        sides.append(np.mean(offsets, axis=0))
    matrix = np.stack(rows, axis=1)
    return np.linalg.solve(matrix, np.stack(sides, axis=1)[..., None])[..., 0]


@pytest.mark.parametrize("name", sorted(PRESETS))
@pytest.mark.parametrize("g", [500.0, 7000.0])
def test_corners_appear_where_the_camera_projects_them(name: str, g: float) -> None:
    microscope = preset(name)
    square_m = square_for(microscope.nominal_pixel_size_m(g))
    pose = Pose.tilted(math.radians(28.0), 0.7, 0.4, (3e-7, -2e-7, 35e-6))
    image = render_reflectivity(microscope, ChessGrid(square_m), pose, g)
    errors = corner_errors(image, microscope, g, pose, square_m)
    assert len(errors) >= 12
    # Four samples per pixel and the measurement leave 0.002 px RMS on single corners.
    assert np.abs(errors).max() < 0.012
    assert np.abs(errors.mean(axis=0)).max() < 0.0015


def test_preset_without_residual_projects_as_its_scan_camera() -> None:
    microscope = preset("jsm820")
    points = np.random.default_rng(1).uniform(-4e-6, 4e-6, (50, 3))
    assert np.array_equal(
        microscope.project(6000.0, points), microscope.camera_at(6000.0).project(points)
    )


def test_other_image_sizes_show_the_same_field() -> None:
    g, square_m = 2000.0, 5e-6
    microscope = preset("jsm820").with_image_size(320, 200)
    pose = Pose.tilted(math.radians(15.0), 0.2, 0.3)
    image = render_reflectivity(microscope, ChessGrid(square_m), pose, g)
    assert image.shape == (200, 320)
    errors = corner_errors(image, microscope, g, pose, square_m)
    assert len(errors) >= 12
    assert np.abs(errors).max() < 0.012  # as above


def test_a_displaced_specimen_is_seen_displaced() -> None:
    microscope, g, square_m = preset("jsm820"), 5000.0, 2e-6
    pose, shift = Pose.flat(rotation_rad=0.2), np.array([0.31e-6, -0.17e-6])
    image = render_reflectivity(
        microscope,
        ChessGrid(square_m),
        pose,
        g,
        drift=lambda t: np.broadcast_to(shift, (len(t), 2)),
    )
    moved = Pose(pose.R, pose.t_m + np.append(shift, 0.0))
    assert np.abs(corner_errors(image, microscope, g, moved, square_m)).max() < 0.012
    # The displacement is (6.7, -3.7) px: with the wrong sign the edges would not be found at all.
    resting = render_reflectivity(microscope, ChessGrid(square_m), pose, g)
    assert np.abs(image - resting).mean() > 0.1


@pytest.mark.parametrize("averages", [1, 5])
def test_drift_inside_a_frame_shears_it_by_velocity_times_time(averages: int) -> None:
    timing = ScanTiming(2.0, averages, 0.2)
    microscope, g, square_m = preset("jsm820").with_timing(timing), 5000.0, 2e-6
    # 6 px over the rows of one pass; several passes must not smear the edges away.
    velocity = np.array([140e-9, -90e-9]) / averages
    pose, start_s = Pose.tilted(0.2, 1.0, 0.3), 7.0
    image = render_reflectivity(
        microscope,
        ChessGrid(square_m),
        pose,
        g,
        start_time_s=start_s,
        drift=lambda t: t[:, None] * velocity,
    )

    def shift(xy: Array) -> Array:
        line_s = 2.0 / 512
        in_pass = xy[:, 1] * line_s + xy[:, 0] / 512 * line_s * 0.8
        time_s = start_s + in_pass + 2.0 * (averages - 1) / 2
        return time_s[:, None] * velocity

    errors = corner_errors(image, microscope, g, pose, square_m, shift)
    # A row is at one time while the prediction runs on within it: half a row of shear, 0.006 px.
    assert np.abs(errors).max() < 0.02
    assert np.abs(errors.mean(axis=0)).max() < 0.002


def test_averaging_is_the_mean_of_the_single_passes() -> None:
    single = preset("jsm820").with_timing(ScanTiming(0.5, 1, 0.1))
    averaged = preset("jsm820").with_timing(ScanTiming(0.5, 4, 0.1))
    board, pose, g = ChessGrid(2e-6), Pose.flat(rotation_rad=0.1), 5000.0
    for speed, tolerance in ((2e-6, 1e-5), (4e-9, 0.02)):
        # Fast: every pass is drawn. Slow (0.17 px in all): drawn once, and the smear is left out.
        path = np.array([speed, 0.5 * speed])

        def drift(time_s: Array, path: Array = path) -> Array:
            return time_s[:, None] * path

        passes = [
            render_reflectivity(single, board, pose, g, start_time_s=0.5 * k, drift=drift)
            for k in range(4)
        ]
        image = render_reflectivity(averaged, board, pose, g, drift=drift)
        assert np.abs(image - np.mean(passes, axis=0)).max() < tolerance


def test_a_vibration_in_step_with_the_passes_is_drawn() -> None:
    microscope = preset("ideal").with_timing(ScanTiming(0.1, 1, 0.0))
    # 50 Hz are 5 periods in 512 rows: the column of an edge swings by +-3 px.
    amplitude = 3.0 * microscope.nominal_pixel_size_m(5000.0)

    def drift(time_s: Array) -> Array:
        wave = amplitude * np.sin(2.0 * np.pi * 50.0 * time_s)
        return np.stack([wave, np.zeros_like(wave)], axis=1)

    image = render_reflectivity(microscope, ChessGrid(8e-6), Pose.flat(), 5000.0, drift=drift)
    # Bright columns between the edge at x = 0 and half a square to its right.
    rows = np.arange(260, 420)  # within one square
    width = image[rows, 226:286].sum(axis=1)
    expected = 3.0 * np.sin(2.0 * np.pi * 50.0 * (rows + 255.5 / 512) * 0.1 / 512)
    swing = -(width - width.mean())
    assert np.corrcoef(swing, expected)[0, 1] > 0.999
    assert np.std(swing) == pytest.approx(np.std(expected), rel=0.02)  # 2 %: part of a period


@pytest.mark.parametrize("name", sorted(PRESETS))
@pytest.mark.parametrize("g", [100.0, 20000.0])
def test_interpolated_rays_agree_with_the_exact_inverse(name: str, g: float) -> None:
    microscope = preset(name)
    lattice = trace_ray_lattice(microscope, g, 2, 4)
    camera = lattice.camera
    rng = np.random.default_rng(3)
    line, col = (
        rng.integers(0, len(lattice.lines), 300),
        rng.integers(0, lattice.basis.shape[1], 300),
    )
    x = np.einsum("ij,ij->i", lattice.x_m[line], lattice.basis[:, col].T)
    y = np.einsum("ij,ij->i", lattice.y_m[line], lattice.basis[:, col].T)
    interpolated = camera.project_ideal(np.stack([x, y, np.zeros(300)], axis=1))
    raw = np.stack([(col + 0.5) / 2 - 4.5, lattice.lines[line]], axis=1)
    # The settling of the beam at the left border, over 20 px, is the hardest spot.
    tolerance = 0.004 if name == "scan_nonlinear" else 1e-8
    assert np.abs(interpolated - microscope.undistort(g, raw)).max() < tolerance


@pytest.mark.parametrize("name", ["jsm820", "spiral", "scan_nonlinear"])
def test_undistort_inverts_distort(name: str) -> None:
    microscope = preset(name)
    raw = np.random.default_rng(5).uniform(-5, 517, (400, 2))
    back = microscope.distort(900.0, microscope.undistort(900.0, raw))
    assert np.abs(back - raw).max() < 1e-8


def test_a_plane_seen_edge_on_is_refused() -> None:
    with pytest.raises(InvalidValueError, match="tilt it less"):
        render_reflectivity(
            preset("jsm820"), ChessGrid(1e-6), Pose.tilted(math.pi / 2, 0.0, 0.0), 1000.0
        )


@pytest.mark.parametrize("g", [0.0, -100.0, math.nan, math.inf])
def test_magnifications_without_meaning_are_refused(g: float) -> None:
    with pytest.raises(InvalidValueError, match="finite number greater than 0"):
        preset("jsm820").camera_at(g)


def test_unknown_preset_is_refused_by_name() -> None:
    with pytest.raises(InvalidValueError, match=r"'jsm'.*jsm820"):
        preset("jsm")
