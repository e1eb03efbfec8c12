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

"""One view raw and corrected: which, where its crosses lie, and how long its scale bar is."""

from __future__ import annotations

import base64
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest

from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.report.calibration.numbers import collect_warnings
from semcal_ros.report.calibration.view_pictures import (
    choose_blink,
    choose_worst_views,
    describe_pattern,
)
from semcal_ros.report.html.page import format_length
from tests.helpers.report_samples import SIZE, found_of


def test_crosses_lie_on_the_corrected_corners_of_the_view(result: CalibrationResult) -> None:
    blink = choose_blink(result, [found_of(v) for v in result.views])
    assert blink is not None and (blink.width, blink.height) == (SIZE, SIZE)
    (index,) = (k for k, v in enumerate(result.views) if f"The view {v.name} " in blink.alt)
    camera = result.model.at(result.views[index].magnification)
    drawn = re.findall(r"M([-\d.]+) ([\d.]+)h([\d.]+)", blink.marks)
    at = np.array([[float(x) + 0.5 * float(h), float(y)] for x, y, h in drawn]) - 0.5
    assert 20 <= len(at) <= 40
    corners = camera.rect_from_raw(result.views[index].image_xy)
    off = np.linalg.norm(at[:, None] - corners, axis=2).min(axis=1)
    # Noise of the corners 0.05 px per axis, and a tenth of a pixel of the path.
    assert off.max() < 0.35
    # Uncorrected they are off by the distortion, which is pixels here.
    raw = np.linalg.norm(at[:, None] - result.views[index].image_xy, axis=2).min(axis=1)
    assert raw.max() > 1.0


def test_the_corrected_picture_is_corrected_and_the_bar_has_its_length(
    result: CalibrationResult,
) -> None:
    rng = np.random.default_rng(0)
    noise = cv2.GaussianBlur(rng.normal(size=(SIZE, SIZE)), (0, 0), 2.0)
    image = np.clip(128.0 + 40.0 * noise / noise.std(), 0, 255).astype(np.uint8)
    view = result.views[0]
    blink = choose_blink(result, [replace(found_of(view), image=image)])
    assert blink is not None
    camera = result.model.at(view.magnification)
    expected = Rectifier("cubic").rectify(image, camera)
    shown = decode(blink.corrected)
    inner = (slice(20, -20), slice(20, -20))
    # JPEG leaves a few grey levels.
    left_over = np.abs(shown.astype(float) - expected)[inner].mean()
    assert left_over < 3.0
    assert left_over < 0.5 * np.abs(shown.astype(float) - image)[inner].mean()
    left, _, right = (float(x) for x in re.findall(r"[\d.]+", blink.bar.path))
    length = re.match(r"([\d.]+) µm ±", blink.bar.label)
    assert length is not None
    pixel_m = camera.rectified.pixel_size_m[0]
    # The path has one decimal at either end.
    assert (right - left) * pixel_m == pytest.approx(1e-6 * float(length[1]), abs=0.11 * pixel_m)


def decode(uri: str) -> np.ndarray:
    data = np.frombuffer(base64.b64decode(uri.partition("base64,")[2]), np.uint8)
    decoded = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
    assert decoded is not None
    return np.asarray(decoded)


def test_without_a_picture_there_is_nothing_to_blink(result: CalibrationResult) -> None:
    assert choose_blink(result, ()) is None
    small = replace(found_of(result.views[0]), image=np.zeros((8, 8), np.uint8))
    assert choose_blink(result, [small]) is None


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
