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

"""Photographs of a real board calibrate through the same path, as well as with OpenCV's five parameters."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from semcal_ros.core.calibration.judgement.evaluate import fit_poses
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.views import views_from_detections
from tests.helpers.grids import seen_photograph

pytestmark = [pytest.mark.slow, pytest.mark.long]

SIZE = (640, 480)


@pytest.fixture(scope="module")
def photographs(reference_data):
    """Detections of both cameras."""
    folder = reference_data / "opencv_boards" / "images"
    found = {}
    for camera in ("left", "right"):
        paths = sorted(folder.glob(f"{camera}*.jpg"))
        found[camera] = [seen_photograph(p) for p in paths]
    return found


def _views(detections, square_m):
    # 0.48 m of display at 1x is 0.75 mm per px: about what a board at half a metre shows.
    views, _ = views_from_detections(
        detections,
        [1.0] * len(detections),
        display_width_m=0.48 * square_m / 25e-3,
        squares_m=[square_m],
    )
    return list(views)


def _opencv(seen, judged):
    """Calibrate with five distortion parameters; RMS of other views with their poses fitted."""
    boards = [np.column_stack([v.board_xy_m, np.zeros(len(v.board_xy_m))]) for v in seen + judged]
    boards = [(b * 40.0).astype(np.float32) for b in boards]
    pixels = [v.image_xy.astype(np.float32).reshape(-1, 1, 2) for v in seen + judged]
    n = len(seen)
    _, k, d, _, _ = cv2.calibrateCamera(boards[:n], pixels[:n], SIZE, None, None)
    square = []
    for board, xy in zip(boards[n:], pixels[n:], strict=True):
        _, turn, move = cv2.solvePnP(board, xy, k, d)
        turn, move = cv2.solvePnPRefineLM(board, xy, k, d, turn, move)
        seen_at = cv2.projectPoints(board, turn, move, k, d)[0]
        square.append(np.sum((seen_at - xy) ** 2, axis=2).ravel())
    return float(np.sqrt(np.mean(np.concatenate(square))))


def test_every_board_is_found(photographs):
    for detections in photographs.values():
        assert len(detections) == 13
        for detection in detections:
            # 9 x 6 corners; a few at the rim may be refused, none may be added.
            assert 45 <= len(detection.xy) <= 54


@pytest.mark.parametrize("camera", ["left", "right"])
@pytest.mark.parametrize("residual", ["auto", "on"])
def test_held_out_error_is_that_of_five_parameters(photographs, camera, residual):
    views = _views(photographs[camera], 25e-3)
    for first in (0, 1):
        seen, judged = views[first::2], views[1 - first :: 2]
        result = calibrate_views(
            seen,
            image_size=SIZE,
            display_width_m=0.48,
            options=CalibrationOptions(residual=residual),
        )
        assert len(result.views) == len(seen)
        # Nothing is known of the heights of a photographed board.
        own = fit_poses(judged, result.model.at, height_sigma_m=1.0).rms_px()
        # Six or seven boards of 54 corners: the promise is 5 %, on either half.
        assert own < 1.05 * _opencv(seen, judged)


@pytest.mark.parametrize("square_m", [25e-6, 1e-3])
def test_the_unit_of_length_does_not_matter(photographs, square_m):
    def focal_px(square):
        views = _views(photographs["left"], square)
        scale = square / 25e-3
        model = calibrate_views(
            views,
            image_size=SIZE,
            display_width_m=0.48 * scale,
            options=CalibrationOptions(residual="off"),
        ).model
        camera = model.at(1.0)
        return camera.m / camera.rho

    # The starting values scale along; only rounding is left, magnified by the adjustment.
    assert focal_px(square_m) == pytest.approx(focal_px(25e-3), rel=1e-5)
