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

"""The servoing target: what is drawn is where it says, and is found again at every magnification."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.applications.servoing import (
    NestedTarget,
    PlaneCamera,
    PlanePose,
    find_target,
    fit_pose,
)
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.synthetic import NOISE_FREE, Detector, LiveScene, Pose, preset, render_frame
from semcal_ros.synthetic.specimens.target import TargetSpecimen, random_target

TARGET = NestedTarget()
SCOPE = replace(preset("jsm820"), timing=ScanTiming(0.1))


def found_pose(g: float, pose: PlanePose, detector: Detector, size: int = 512):
    """Pose in a rendered frame that is rectified with the true camera, and that camera."""
    scope = SCOPE.with_image_size(size, size)
    flat = Pose.flat((pose.x_m, pose.y_m, 0.0), pose.angle_rad)
    image = render_frame(scope, TargetSpecimen(), flat, g, detector=detector, seed=3)
    camera = scope.camera_at(g)
    view = find_target(Rectifier("cubic").rectify(image, camera), TARGET)
    return fit_pose(view, PlaneCamera.from_camera(camera)), camera


def test_a_box_of_any_size_sees_its_mean() -> None:
    """Samples of a seventh of a texel, averaged, are the samples of a large one: no edge is lost or moved."""
    specimen = TargetSpecimen()
    cell = TARGET.cell_m(2)
    fine = cell / 840.0
    x, y = np.meshgrid((np.arange(840) + 0.5) * fine, (np.arange(840) + 0.5) * fine)
    seen = specimen.reflectivity(x + 0.5 * cell, y - 0.5 * cell, fine * np.eye(2))
    for factor in (2, 14):
        step = factor * fine
        u, v = np.meshgrid(*[(np.arange(840 // factor) + 0.5) * step] * 2)
        coarse = specimen.reflectivity(u + 0.5 * cell, v - 0.5 * cell, step * np.eye(2))
        n = 840 // factor
        mean = seen.reshape(n, factor, n, factor).mean(axis=(1, 3))
        # Single precision of coordinates up to 180 texels.
        np.testing.assert_allclose(coarse, mean, atol=2e-3 if factor < 14 else 2e-2)


def test_the_origin_is_the_middle_of_every_board() -> None:
    corners = TARGET.corners_m(np.arange(TARGET.size)).reshape(TARGET.levels, -1, 2)
    np.testing.assert_allclose(corners.mean(axis=1), 0.0, atol=1e-18)
    sizes = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    np.testing.assert_allclose(sizes[:-1] / sizes[1:], 3.0)
    codes = {TARGET.bits(i).tobytes() for i in range(TARGET.size)}
    assert len(codes) == TARGET.size


@pytest.mark.parametrize("g", [200.0, 500.0, 1200.0, 2800.0, 5000.0, 10000.0])
def test_the_target_is_found_where_it_is_at_every_magnification(g: float) -> None:
    field_m = 0.12 / g
    pose = PlanePose(0.06 * field_m, -0.04 * field_m, 0.3)
    fit, camera = found_pose(g, pose, Detector())
    assert fit.accepted, fit.reason
    error = fit.pose.minus(pose)
    error_px = np.hypot(*(camera.ideal_from_sem_jacobian @ error[:2]))
    assert error_px < 0.05
    assert abs(error[2]) < 1e-3
    assert fit.scale == pytest.approx(1.0, abs=2e-3)
    sigma_px = camera.m * math.sqrt(fit.covariance[0, 0])
    assert 0.001 < sigma_px < 0.05


@pytest.mark.slow
def test_the_error_is_what_the_uncertainty_says() -> None:
    """Over places and angles; of 24 numbers the RMS has a sigma of 14 %."""
    rng = np.random.default_rng(4)
    scores = []
    for _ in range(8):
        x, y = rng.uniform(-4e-6, 4e-6, 2)
        pose = PlanePose(x, y, rng.uniform(-math.pi, math.pi))
        fit, _ = found_pose(2000.0, pose, Detector(electrons=120.0), size=384)
        scores.append(fit.pose.minus(pose) / np.sqrt(np.diag(fit.covariance)))
    assert 0.5 < np.sqrt(np.mean(np.square(scores))) < 1.8


def test_without_noise_blur_moves_nothing() -> None:
    """What is left is the interpolation of a single target: some hundredths of a px, either way."""
    errors = {0.0: [], 1.5: []}
    for pose in (PlanePose(1.3e-6, 0.7e-6, 0.2), PlanePose(-2.3e-6, 1.9e-6, 1.1)):
        for blur, found in errors.items():
            fit, camera = found_pose(2000.0, pose, replace(NOISE_FREE, blur_px=blur))
            found.append(camera.m * fit.pose.minus(pose)[:2])
    sharp, blurred = (np.array(e) for e in errors.values())
    assert np.max(np.hypot(*sharp.T)) < 0.04
    assert np.max(np.hypot(*(blurred - sharp).T)) < 0.03


def test_what_is_no_target_is_refused() -> None:
    for kind in ("flat", "grid", "gold"):
        image = LiveScene(SCOPE, kind, magnification=2000.0).frame(0.0).image
        view = find_target(image, TARGET)
        assert not view.accepted
        assert view.reason
    assert find_target(np.zeros((64, 64), np.uint8), TARGET).reason == "image: blank"
    assert "not finite" in find_target(np.full((64, 64), np.nan), TARGET).reason


def test_the_live_scene_shows_it() -> None:
    scene = LiveScene(SCOPE, "target", magnification=1000.0, pose=Pose.flat((5e-6, 0.0, 0.0)))
    assert find_target(scene.frame(0.0).image, TARGET).accepted


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_a_rough_target_on_any_ground_is_found_where_it_is(seed: int) -> None:
    scope, g = SCOPE.with_image_size(256, 256), 1000.0
    pose = PlanePose(7e-6, -5e-6, 0.3)
    flat = Pose.flat((pose.x_m, pose.y_m, 0.0), pose.angle_rad)
    camera = scope.camera_at(g)
    images = [
        render_frame(scope, specimen, flat, g, detector=Detector(), seed=3)
        for specimen in (random_target(seed), TargetSpecimen())
    ]
    assert np.std(images[0].astype(float) - images[1]) > 5.0
    view = find_target(Rectifier("cubic").rectify(images[0], camera), TARGET)
    error = fit_pose(view, PlaneCamera.from_camera(camera)).pose.minus(pose)
    # A fifth of a pixel: the texture of the ground pulls the sides of the markers.
    assert np.hypot(*(camera.ideal_from_sem_jacobian @ error[:2])) < 0.2
