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

"""The corner finder on the reference recordings (skipped where they are not at hand)."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from tests.helpers.grids import detected

pytestmark = pytest.mark.slow


def true_corners(frame: dict[str, Any], truth: dict[str, Any]) -> Array:
    """(n, 2) pixels of all grid corners in and around one frame."""
    p = truth["params"][str(frame["magnification"])]
    camera = ScanCamera(
        frame["magnification"], p["m"] * 1e6, p["a"], p["s"] / p["m"], p["px"], p["py"],
        p["rho"] * 1e6, p["xr"], p["xt"], p["ex"], p["ey"], truth["norm_px"], 512, 512,
    )  # fmt: skip
    square = frame["square_um"]
    reach = int(900.0 / (p["m"] * square)) + 3
    i, j = np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1))
    board = np.stack([i.ravel() * square, j.ravel() * square, 0.0 * i.ravel()], axis=1)
    xyz_um = board @ np.array(frame["R"]).T + np.array(frame["t_um"])
    xy = camera.project(1e-6 * xyz_um)
    return xy[np.all((xy > -10) & (xy < 522), axis=1)]


@pytest.mark.long
def test_every_magnification_of_the_grid_recording(reference_data: Path) -> None:
    from rosbags.highlevel import AnyReader

    folder = reference_data / "grid_calibration"
    truth = json.loads((folder / "truth.json").read_text())
    scores = []
    with AnyReader([folder]) as reader:
        topics = [c for c in reader.connections if c.topic.endswith("image_raw")]
        for k, (connection, _, raw) in enumerate(reader.messages(topics)):
            # One view of each magnification, a different tilt each time.
            if k % 5 != (k // 5) % 5:
                continue
            message: Any = reader.deserialize(raw, connection.msgtype)
            picture = np.asarray(message.data).reshape(message.height, message.step)
            detection = detected(picture[:, : message.width])
            xy = true_corners(truth["frames"][k], truth)
            visible = xy[np.all((xy > 5) & (xy < 506), axis=1)]
            assert np.mean(cKDTree(detection.xy).query(visible)[0] < 1.0) > 0.97, k
            error = detection.xy - xy[cKDTree(xy).query(detection.xy)[1]]
            assert np.linalg.norm(error, axis=1).max() < 0.5, k
            scores.append((error / detection.sigma_px[:, None]).ravel())
    # The edges of this recording are brighter than the model's: the sigmas are some 15 % on the
    # safe side.
    assert 0.8 < np.concatenate(scores).std() < 1.1


@pytest.mark.parametrize("name", ["left01", "left05", "right02", "right09"])
def test_photographs_of_a_board_with_a_border(reference_data: Path, name: str) -> None:
    picture = cv2.imread(
        str(reference_data / "opencv_boards" / "images" / f"{name}.jpg"), cv2.IMREAD_GRAYSCALE
    )
    found, corners = cv2.findChessboardCorners(picture, (9, 6))
    assert found
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    corners = cv2.cornerSubPix(picture, corners, (5, 5), (-1, -1), stop)
    detection = detected(picture)
    reference = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    distance = cKDTree(reference).query(detection.xy)[0]
    # The finder drops corners that are touched by something else, and adds none.
    assert 48 <= len(detection.xy) <= 54
    assert distance.max() < 1.0
