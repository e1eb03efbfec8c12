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

"""The finder of the grid's corners beside OpenCV's, in rendered frames of known truth."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from benchmarks.calibration.cases import Array, lattice
from benchmarks.table import interleaved, show
from semcal_ros.core.corners import LatticeDetection, find_lattice
from semcal_ros.synthetic import calibration_plan, preset


def opencv_corners(image: NDArray[np.uint8]) -> Array:
    """Corners that OpenCV finds of a board of unknown extent."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER | cv2.CALIB_CB_ACCURACY
    found, corners, _ = cv2.findChessboardCornersSBWithMeta(image, (3, 3), flags)
    return corners.reshape(-1, 2).astype(np.float64) if found else np.zeros((0, 2))


def against(truth: Array, found: Array) -> tuple[int, int, float | None, NDArray[np.bool_]]:
    """Corners found to a pixel, false ones, RMS error of one coordinate, and which are right."""
    if not len(found):
        return 0, 0, None, np.zeros(0, dtype=bool)
    distance, nearest = cKDTree(truth).query(found)
    right = distance < 1.0
    if not right.any():
        return 0, len(found), None, right
    rms = float(np.sqrt(np.mean((found[right] - truth[nearest[right]]) ** 2)))
    return len(set(nearest[right])), int(np.sum(~right)), rms, right


def corners(quick: bool) -> None:
    magnifications = (100.0, 1000.0, 5000.0) if quick else (100.0, 500.0, 1000.0, 3000.0, 10000.0)
    microscope = preset("jsm820")
    size = np.array(microscope.image_size)
    plan = calibration_plan(microscope, magnifications=magnifications, views=2, seed=3)
    rows: list[list[object]] = []
    for index, frame in enumerate(plan.frames):
        image = plan.render(index)
        _board, truth = lattice(plan, index, -3.0)
        visible = int(np.sum(np.all((truth > 5.0) & (truth < size - 6.0), axis=1)))
        results: dict[str, list[object]] = {"ours": [], "cv2": []}

        def ours(image=image, results=results) -> None:
            results["ours"].append(find_lattice(image))

        def theirs(image=image, results=results) -> None:
            results["cv2"].append(opencv_corners(image))

        times = interleaved({"ours": ours, "cv2": theirs}, 2 if quick else 5)
        mine = results["ours"][0]
        assert isinstance(mine, LatticeDetection), mine
        found, false, rms, right = against(truth, mine.xy)
        score = None
        sigma = None
        if rms is not None:
            nearest = cKDTree(truth).query(mine.xy[right])[1]
            error = mine.xy[right] - truth[nearest]
            sigma = float(np.sqrt(np.mean(mine.sigma_px[right] ** 2)))
            score = float(np.sqrt(np.mean((error / mine.sigma_px[right][:, None]) ** 2)))
        other = against(truth, results["cv2"][0])
        tilt = np.degrees(frame.pose.tilt_rad)
        label = f"{frame.magnification:g}x, tilt {tilt:.0f} deg"
        row = [label, visible, found, false, rms, sigma, score, *other[:3]]
        rows.append([*row, times["ours"] / times["cv2"]])
    show(
        "Corner finding in rendered frames of 512 x 512: find_lattice, and findChessboardCornersSB",
        ["frame", "in view", "found", "false", "RMS px", "bound px", "err/sigma"]
        + ["SB found", "SB false", "SB RMS px", "time"],
        rows,
        "RMS is of one coordinate. bound: the 1-sigma that the detection itself states (RMS), which is",
        "the Cramer-Rao bound of its edge model; err/sigma: RMS of error over stated sigma, 1 if honest.",
        "In view: at least 5 px inside; nearer corners may be found as well. SB: 3 x 3 or larger.",
        "time: find_lattice as ratio to findChessboardCornersSB in the same frame, however few it finds.",
    )
