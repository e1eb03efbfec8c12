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

"""Photographs of a chess board, calibrated here and by OpenCV on the same corners, judged on pictures left out.

    python -m benchmarks.calibration.photographs FOLDER --board 8x6

A lens of a photograph is no electron beam: this shows how far the model and its residual field carry. The
pictures are divided into parts; every part is predicted by calibrations from the others. Its poses are fitted under
each camera in the same way, by least squares of all corners alike, from the pose that each camera's own tool finds.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.calibration.cases import Array
from benchmarks.table import show
from semcal_ros.core.calibration.judgement.evaluate import fit_poses
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.plane_geometry import view_affine
from semcal_ros.core.corners import LatticeDetection, find_lattice
from semcal_ros.core.errors import SemcalError

# Lengths in squares; the display width is chosen so that the nominal scale is that of the photographs.
SQUARE_M = 0.03
Views = Sequence[GridView]
Projection = Callable[[Array, Array], Array]


def found_here(image: NDArray[np.uint8]) -> tuple[Array, Array, Array, Array] | None:
    """Board indices, pixels, their sigmas and covariances by the finder of this package."""
    found = find_lattice(image, pattern="chess")
    if not isinstance(found, LatticeDetection) or len(found.xy) < 8:
        return None
    return found.ij - found.ij.min(axis=0), found.xy, found.sigma_px, found.covariance_px2


def found_by_opencv(
    image: NDArray[np.uint8], board: tuple[int, int]
) -> tuple[Array, Array, Array, None] | None:
    """The same by OpenCV's sector-based finder, which knows the board; it tells no sigmas."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    ok, corners = cv2.findChessboardCornersSB(image, board, flags)
    if not ok:
        return None
    ij = np.stack(np.meshgrid(*map(np.arange, board), indexing="xy"), axis=-1).reshape(-1, 2)
    return ij, corners.reshape(-1, 2).astype(np.float64), np.full(len(ij), 0.1), None


def read_views(
    folder: Path, board: tuple[int, int] | None
) -> tuple[list[GridView], tuple[int, int]]:
    """The views of a folder of pictures of one size."""
    views, size = [], (0, 0)
    for path in sorted(p for p in folder.iterdir() if p.suffix.lower() in (".jpg", ".png")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        size = (image.shape[1], image.shape[0])
        found = found_here(image) if board is None else found_by_opencv(image, board)
        if found is None:
            continue
        ij, xy, sigma, covariance = found
        middle = np.argmin(np.sum((xy - xy.mean(axis=0)) ** 2, axis=1))
        flat = np.asarray(ij - ij[middle], dtype=np.float64) * SQUARE_M
        views.append(GridView(1.0, flat, xy, sigma, path.stem, covariance, square_m=SQUARE_M))
    return views, size


def _squared_errors(view: GridView, project: Projection, turn: Array, move: Array) -> Array:
    """Squared distances of the corners under the pose that fits them best."""
    flat = np.column_stack([view.board_xy_m, np.zeros(len(view.board_xy_m))])

    def miss(pose: Array) -> Array:
        seen = project(Rotation.from_rotvec(pose[:3]).apply(flat), pose[3:])
        return np.nan_to_num((seen - view.image_xy).ravel(), nan=1e3)

    start = np.concatenate([turn, move])
    scale = np.array([1.0, 1.0, 1.0, *[max(float(np.linalg.norm(move)), SQUARE_M)] * 3])
    best = least_squares(miss, start, x_scale=scale, xtol=1e-12, ftol=1e-12)
    return np.sum(best.fun.reshape(-1, 2) ** 2, axis=1)


def by_opencv(seen: Views, judged: Views, size: tuple[int, int], flags: int) -> list[Array]:
    """Squared errors of the judged views under OpenCV's camera from the seen ones."""

    def board(view: GridView) -> NDArray[np.float32]:
        flat = np.column_stack([view.board_xy_m, np.zeros(len(view.board_xy_m))]) / SQUARE_M
        return flat.astype(np.float32)

    pixels = [v.image_xy.astype(np.float32).reshape(-1, 1, 2) for v in seen]
    _, k, d, _, _ = cv2.calibrateCamera(
        [board(v) for v in seen], pixels, size, None, None, flags=flags
    )
    out = []
    for view in judged:

        def project(turned: Array, move: Array) -> Array:
            at = (turned + move) / SQUARE_M
            return cv2.projectPoints(at, np.zeros(3), np.zeros(3), k, d)[0].reshape(-1, 2)

        _, turn, move = cv2.solvePnP(board(view), view.image_xy.reshape(-1, 1, 2), k, d)
        out.append(_squared_errors(view, project, turn.ravel(), move.ravel() * SQUARE_M))
    return out


def by_joint(seen: Views, judged: Views, size: tuple[int, int], residual: str) -> list[Array]:
    """The same under the camera of this package."""
    affines = [view_affine(v.board_xy_m, v.image_xy, v.image_xy.mean(axis=0)) for v in seen]
    width = size[0] / float(np.median([a.scale for a in affines]))
    options = CalibrationOptions(residual=residual)
    camera = calibrate_views(
        seen, image_size=size, display_width_m=width, options=options
    ).model.at(1.0)
    poses = fit_poses(judged, lambda _g: camera, height_sigma_m=1e3 * SQUARE_M)
    out = []
    for view, rotation, move in zip(judged, poses.rotations, poses.translations_m, strict=True):
        turn = Rotation.from_matrix(rotation).as_rotvec()
        out.append(_squared_errors(view, lambda x, t: camera.project(x + t), turn, move))
    return out


METHODS: dict[str, Callable[[Views, Views, tuple[int, int]], list[Array]]] = {
    "OpenCV, 5": lambda a, b, size: by_opencv(a, b, size, 0),
    "OpenCV, 8 (rational)": lambda a, b, size: by_opencv(a, b, size, cv2.CALIB_RATIONAL_MODEL),
    "joint": lambda a, b, size: by_joint(a, b, size, "off"),
    "joint, field auto": lambda a, b, size: by_joint(a, b, size, "auto"),
    "joint, field on": lambda a, b, size: by_joint(a, b, size, "on"),
}


def compare(views: Views, size: tuple[int, int], folds: int, title: str) -> None:
    """Print the table of all methods: all pictures fitted, and left out in turn."""
    order = np.random.default_rng(0).permutation(len(views))
    rows: list[list[object]] = []
    for name, method in METHODS.items():
        try:
            fitted = method(views, views, size)
            held_out = []
            for part in np.array_split(order, folds):
                rest = [v for i, v in enumerate(views) if i not in part]
                held_out += method(rest, [views[i] for i in part], size)
        except SemcalError as error:
            print(f"{name}: {error}")
            rows.append([name, None, None, None])
            continue
        per_view = [float(np.sqrt(np.mean(own))) for own in held_out]
        rms = [float(np.sqrt(np.mean(np.concatenate(e)))) for e in (fitted, held_out)]
        rows.append([name, *rms, float(np.median(per_view)), max(per_view)])
    corners = sum(len(v.image_xy) for v in views)
    show(
        f"{title}: {len(views)} pictures, {corners} corners, {folds} parts",
        ["", "fitted px", "held out px", "median picture", "worst picture"],
        rows,
        "RMS of the corners' distances. Held out: each part under the camera from the others, poses fitted.",
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--board", default="8x6", help="inner corners, for OpenCV's finder")
    parser.add_argument("--parts", type=int, default=6)
    given = parser.parse_args()
    columns, rows = (int(n) for n in given.board.split("x"))
    for title, board in (
        ("corners found here", None),
        ("corners found by OpenCV", (columns, rows)),
    ):
        views, size = read_views(given.folder, board)
        compare(views, size, given.parts, title)


if __name__ == "__main__":
    main()
