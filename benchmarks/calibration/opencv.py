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

"""cv2.calibrateCamera at every magnification, as a method of the benchmark of the calibrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from benchmarks.calibration.cases import Array, Case, PixelSize
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.errors import CalibrationError

# What OpenCV's camera consists of, in the order of the rows below; the last two columns are the pixel size.
_DISTORTION = slice(4, 9)
_PIXEL_SIZE = slice(9, 11)


@dataclass(frozen=True)
class OpenCv:
    """Separate calibrations; their parameters are interpolated linearly in log g.

    Focal lengths are divided by g before, and pixel sizes multiplied, as they are nearly proportional to it. Lengths
    are measured in units of 256 nominal px, so that numbers stay near 1.

    Attributes
    ----------
    magnifications, parameters
        (M,) and (M, 11): focal lengths over g, principal point, five coefficients of distortion, pixel sizes in m
        times g at the mean distance of the views, which is OpenCV's nearest to a reference plane.
    refused
        Magnifications at which OpenCV raised an error.
    """

    case: Case
    magnifications: Array
    parameters: Array
    refused: tuple[float, ...]

    @classmethod
    def calibrated(cls, case: Case, guess: bool) -> OpenCv:
        """With ``guess`` the focal length starts from the working distance, and the principal point is fixed."""
        magnifications, rows, refused = [], [], []
        for g in sorted({v.magnification for v in case.seen}):
            own = [v for v in case.seen if v.magnification == g]
            try:
                rows.append(_calibrated_at(case, g, own, guess))
                magnifications.append(g)
            except cv2.error:
                refused.append(g)
        if not rows:
            raise CalibrationError("views that OpenCV refuses", expected="a calibration")
        return cls(case, np.array(magnifications), np.array(rows), tuple(refused))

    def _at(self, g: float) -> Array:
        logs = np.log(self.magnifications)
        return np.array([np.interp(np.log(g), logs, column) for column in self.parameters.T])

    def pixel_size_m(self, g: float) -> PixelSize:
        """Pixel size (x, y) at the mean distance."""
        x, y = self._at(g)[_PIXEL_SIZE] / g
        return float(x), float(y)

    def residuals(self, views: Sequence[GridView]) -> list[Array]:
        """Observed minus projected px of views, each under the better of the two poses that a plane allows."""
        return [self._residual(view) for view in views]

    def _residual(self, view: GridView) -> Array:
        p = self._at(view.magnification)
        f = p[:2] * view.magnification
        k = np.array([[f[0], 0.0, p[2]], [0.0, f[1], p[3]], [0.0, 0.0, 1.0]])
        d, board = p[_DISTORTION], _board(self.case, view)
        pixels = view.image_xy.reshape(-1, 1, 2)
        try:
            _, turns, moves, _ = cv2.solvePnPGeneric(board, pixels, k, d, flags=cv2.SOLVEPNP_IPPE)
            found = []
            for turn, move in zip(turns, moves, strict=True):
                turn, move = cv2.solvePnPRefineLM(board, pixels, k, d, turn, move)
                seen = cv2.projectPoints(board, turn, move, k, d)[0].reshape(-1, 2)
                found.append(view.image_xy - seen)
        except cv2.error as error:
            raise CalibrationError(
                f"no pose at magnification {view.magnification:g}: {error.err}",
                expected="a pose from solvePnP",
            ) from error
        return min(found, key=lambda r: float(np.sum(r * r)))


def _unit_m(case: Case, g: float) -> float:
    return 256.0 / case.nominal_px_per_m(g)


def _board(case: Case, view: GridView) -> Array:
    flat = view.board_xy_m / _unit_m(case, view.magnification)
    return np.column_stack([flat, np.zeros(len(flat))]).reshape(-1, 1, 3)


def _calibrated_at(case: Case, g: float, views: Sequence[GridView], guess: bool) -> list[float]:
    """One row of :attr:`OpenCv.parameters`."""
    boards = [_board(case, v).astype(np.float32) for v in views]
    pixels = [v.image_xy.astype(np.float32).reshape(-1, 1, 2) for v in views]
    start, flags = np.eye(3), 0
    if guess:
        start = np.diag([case.nominal_px_per_m(g) * case.working_distance_m] * 2 + [1.0])
        start[:2, 2] = (np.array(case.image_size) - 1.0) / 2.0
        flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_K3
    _, k, d, _, moves = cv2.calibrateCamera(
        boards, pixels, case.image_size, start, None, flags=flags
    )
    distance_m = float(np.mean([move.ravel()[2] for move in moves])) * _unit_m(case, g)
    f = np.array([k[0, 0], k[1, 1]])
    return [*(f / g), k[0, 2], k[1, 2], *d.ravel()[:5], *(distance_m / f * g)]
