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

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.camera.calibration_model import CalibrationModel, ScaleSigma
from semcal_ros.core.camera.uncertainty import budget_of_length, budget_of_pixel_size
from semcal_ros.core.errors import InvalidValueError
from tests.helpers.calibrations import calibrated

SCALE = ScaleSigma(repeatability=1e-3, grid=4e-4, height_m=2e-5)


@pytest.fixture(scope="module")
def model() -> CalibrationModel:
    return replace(calibrated("jsm820").model, scale_sigma=SCALE)


def by_source(budget: object) -> dict[str, float]:
    return {part.source: part.relative for part in budget.parts}  # type: ignore[attr-defined]


def test_the_parts_add_up_to_what_the_camera_states(model: CalibrationModel) -> None:
    low, high = model.magnification_range
    for g in (low, np.sqrt(low * high), 2.0 * high):
        camera, budget = model.at(g).rectified, budget_of_pixel_size(model, g)
        parts = by_source(budget)
        assert budget.value_m == pytest.approx(camera.pixel_size_m[0])
        tilt = parts["tilt of the specimen"]
        stated = max(camera.pixel_size_sigma_m) / camera.pixel_size_m[0]
        assert budget.relative == pytest.approx(np.hypot(stated, tilt), rel=1e-9)
        assert sum(budget.share(part) for part in budget.parts) == pytest.approx(1.0)
        assert parts["repeatability of the magnification"] == 1e-3
        assert parts["squares of the grid"] == 4e-4
        assert parts["height of the specimen"] == pytest.approx(model.at(g).rho * 2e-5)
        assert ("magnification outside the calibrated range" in parts) == (g > high)
    assert budget.expanded_m == 2.0 * budget.sigma_m


def test_what_the_calibration_adds_is_split_and_the_parts_add_up(model: CalibrationModel) -> None:
    assert model.record is not None
    shares = model.record.scale_shares
    assert shares is not None
    older = replace(model, record=replace(model.record, scale_shares=None))
    names = (
        "corners of the calibration",
        "visits, poses and heights of the calibration",
        "form of the functions of the calibration",
    )
    for index in (1, 2):
        g = model.magnifications[index]
        parts = by_source(budget_of_pixel_size(model, g))
        before = by_source(budget_of_pixel_size(older, g))
        whole = before["views of the calibration"]
        assert sum(parts[name] ** 2 for name in names) == pytest.approx(whole**2, rel=1e-9)
        assert parts[names[0]] ** 2 == pytest.approx(shares.corners[index] * whole**2)
        others = {source: own for source, own in parts.items() if source not in names}
        assert others | {"views of the calibration": whole} == pytest.approx(before)


def test_a_higher_specimen_has_the_pixel_size_of_the_projection(model: CalibrationModel) -> None:
    g, height_m = model.magnification_range[0], 3e-4
    camera = model.at(g).rectified
    ends = np.array([[-1e-6, 0.0, height_m], [1e-6, 0.0, height_m]])
    length_px = np.ptp(camera.project(ends)[:, 0])
    budget = budget_of_pixel_size(model, g, height_m=height_m)
    assert budget.value_m == pytest.approx(2e-6 / length_px, rel=1e-9)
    assert "distance of the scan pivot" in by_source(budget)
    with pytest.raises(InvalidValueError, match="where the pivot of the scan lies"):
        budget_of_pixel_size(model, g, height_m=-2.0 / camera.rho)


def test_a_length_scatters_as_stated(model: CalibrationModel) -> None:
    """Cameras are drawn from the covariance, and a length is measured with the one that is estimated."""
    g, edge_px = model.magnification_range[0], 0.3
    camera = model.at(g).rectified
    length_m = 0.4 * camera.width * camera.pixel_size_m[0]
    budget = budget_of_length(model, g, length_m, edge_sigma_px=edge_px)
    rng = np.random.default_rng(0)
    middle = 0.5 * np.array([camera.width - 1.0, camera.height - 1.0])
    half = np.array([0.5 * length_m / camera.pixel_size_m[0], 0.0])
    ends = camera.sem_from_ideal(np.stack([middle - half, middle + half]))
    jacobian = camera.project_jacobian(ends)[:, 0]
    draws = rng.multivariate_normal(
        np.zeros(len(camera.joint_covariance)), camera.joint_covariance, 4000
    )
    moved = draws @ (jacobian[1] - jacobian[0]) + rng.normal(0.0, edge_px, (4000, 2)) @ [1.0, -1.0]
    scatter = float(np.std(moved)) / (2.0 * half[0])
    # The budget takes the worst place and direction, and the tilt, too.
    assert scatter < 1.05 * budget.relative
    assert scatter > 0.7 * budget.relative
    edges = by_source(budget)["position of both edges"]
    assert edges == pytest.approx(np.sqrt(2.0) * edge_px / (2.0 * half[0]))
    with pytest.raises(InvalidValueError, match="a length in the image"):
        budget_of_length(model, g, 3.0 * length_m, edge_sigma_px=edge_px)
