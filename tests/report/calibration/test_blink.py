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
from semcal_ros.report.calibration.blink import choose_blink
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
