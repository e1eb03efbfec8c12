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

"""The views that fit worst: their order, their arrows and what their residuals look like."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.report.calibration.numbers import collect_warnings
from semcal_ros.report.calibration.worst_views import choose_worst_views, describe_pattern
from semcal_ros.report.html.text import format_length
from tests.helpers.report_samples import SIZE, found_of


def spoil(result: CalibrationResult, view: int, factor: float) -> CalibrationResult:
    residuals = list(result.fit.residuals_px)
    residuals[view] = factor * residuals[view]
    return replace(result, fit=replace(result.fit, residuals_px=tuple(residuals)))


def test_worst_views_come_first_with_their_error_in_px_and_nm(result: CalibrationResult) -> None:
    spoilt = spoil(result, 6, 8.0)
    views = choose_worst_views(spoilt, (), len(result.views))
    assert views[0].name == result.views[6].name and views[0].ratio > 3.0
    assert [v.ratio for v in views] == sorted((v.ratio for v in views), reverse=True)
    assert any(f"corners of {views[0].name}" in f for f in collect_warnings(spoilt))
    px = float(np.sqrt(np.mean(np.sum(spoilt.fit.residuals_px[6] ** 2, axis=1))))
    pixel_m = np.mean(result.model.at(result.views[6].magnification).pixel_size_m)
    assert views[0].rms == f"{px:.3f} px, {format_length(px * float(pixel_m))}"
    assert "larger everywhere" in dict(views[0].facts)["Why suspicious"]
    # The true tilt of this view; the fit knows it to a fraction of a degree.
    tilt = re.search(r"tilted by ([\d.]+)", dict(views[0].facts)["Pose"])
    assert tilt is not None and abs(float(tilt[1]) - 32.0) < 1.0


def test_arrows_begin_at_the_corners_and_point_along_the_residuals(
    result: CalibrationResult,
) -> None:
    ((view),) = choose_worst_views(spoil(result, 6, 8.0), (), 1)
    drawn = [re.match(r"M([-\d.]+) ([-\d.]+)l([-\d.]+) ([-\d.]+)", m.path) for m in view.marks]
    numbers = np.array([[float(x) for x in m.groups()] for m in drawn if m is not None])
    factor = view.width / SIZE
    corners = (result.views[6].image_xy + 0.5) * factor
    nearest = np.argmin(np.linalg.norm(numbers[:, None, :2] - corners, axis=2), axis=1)
    # Paths have one decimal.
    assert np.abs(corners[nearest] - numbers[:, :2]).max() < 0.051
    long = float(re.findall(r"([\d.]+) times as long", view.caption)[0])
    residuals = 8.0 * result.fit.residuals_px[6][nearest]
    assert np.abs(numbers[:, 2:] - residuals * factor * long).max() < 0.051
    assert "picture was not kept" in view.caption and view.src == ""


def test_the_picture_of_the_view_is_shown_where_it_is_at_hand(result: CalibrationResult) -> None:
    ((view),) = choose_worst_views(spoil(result, 6, 8.0), [found_of(v) for v in result.views], 1)
    assert view.src.startswith("data:image/jpeg")
    # It is not enlarged.
    assert (view.width, view.height) == (SIZE, SIZE)


def test_what_residuals_look_like() -> None:
    rng = np.random.default_rng(2)
    xy = rng.uniform(0.0, 500.0, size=(200, 2))
    noise = 0.05 * rng.normal(size=(200, 2))
    assert "no larger than the noise" in describe_pattern(xy, noise, 1.02)[0]
    assert "larger everywhere" in describe_pattern(xy, 4.0 * noise, 4.0)[0]
    sheared = noise + 1e-3 * np.column_stack([xy[:, 1] - 250.0, np.zeros(200)])
    (drift,) = describe_pattern(xy, sheared, 3.0)
    share = re.search(r"shear of the whole view makes (\d+) %", drift)
    # The variances are 0.0208 (500^2 / 12 times 1e-6) and 2 times 0.0025 px2: 81 %, of 200 draws to a few.
    assert share is not None and abs(int(share[1]) - 81) < 6
    dirty = noise.copy()
    dirty[:8] += 1.0
    (dirt,) = describe_pattern(xy, dirty, 3.0)
    # Eight times 2 px2 against 200 times 0.005.
    assert dirt.startswith("10 of its corners make 9")
