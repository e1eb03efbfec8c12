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

"""Whether pixels are as large along x as along y, from moves of the stage that carry any specimen through the image.

A specimen that is moved by d (m) is seen to move by ``s = M d`` in rectified pixels. Where stage and image axes lie to
each other is not known, so M is a rotation or reflection over the pixel size; ``M M'`` is the unit matrix over the
square of the pixel size, whatever that rotation is. A drift at constant velocity is estimated beside M.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError

__all__ = ["StageIsotropy", "fit_stage_moves"]

# Two constants, two drifts and the four of M have eight equations of four frames: one more frame shows the scatter.
_LEAST_FRAMES = 5
# Ratio of the smaller to the larger spread of the positions: moves along one line leave M open across it.
_ONE_LINE = 0.1
# Probability (two-sided) of a normal deviate beyond 1, for the factor of Student's t on a 1-sigma.
_ONE_SIGMA = 0.8413


@dataclass(frozen=True)
class StageIsotropy:
    """Size and shape of the pixels against the moves of a stage.

    Attributes
    ----------
    scale_x, scale_y
        nm per px of the calibration over the one that the stage says, less one, along x and y of the rectified image.
    skew
        Cosine of the angle between the axes of the image, on the specimen.
    scale_x_sigma, scale_y_sigma, skew_sigma
        Their 1-sigma from the scatter of the positions about the fit; the stage's own errors are not in them.
    scatter_m
        1-sigma of a position of the stage per axis: its repeatability, and the errors of the registration.
    frames
        Number of frames that were used.
    """

    scale_x: float
    scale_y: float
    skew: float
    scale_x_sigma: float
    scale_y_sigma: float
    skew_sigma: float
    scatter_m: float
    frames: int


def fit_stage_moves(
    position_m: Array, shift_px: Array, time_s: Array, pixel_size_m: float
) -> StageIsotropy:
    """Compare shifts of rectified images with the positions of the stage.

    Parameters
    ----------
    position_m
        (n, 2) x and y of the stage, without tilt.
    shift_px
        (n, 2) where in the rectified image the specimen lies, against any one frame.
    time_s
        (n,) when.
    pixel_size_m
        Size of a rectified pixel by the calibration.

    Raises
    ------
    InvalidValueError
        If there are fewer than five frames, or their positions lie on one line.
    """
    count = len(position_m)
    if count < _LEAST_FRAMES:
        raise InvalidValueError(f"{count} positions of the stage", expected=f"{_LEAST_FRAMES}")
    centred = position_m - position_m.mean(axis=0)
    spread = np.linalg.svd(centred, compute_uv=False)
    if not spread[1] > _ONE_LINE * spread[0]:
        raise InvalidValueError(
            "positions of the stage on one line", expected="moves along x and along y"
        )
    span = np.ptp(time_s)
    late = (time_s - time_s.mean()) / (span if span > 0.0 else 1.0)
    design = np.column_stack([centred / spread[0], np.ones(count), late])
    # Of frames at one time, the drift is open, and zero.
    inverse = np.linalg.pinv(design)
    fitted = inverse @ shift_px
    rest = shift_px - design @ fitted
    freedom = count - int(np.linalg.matrix_rank(design))
    variance = np.sum(rest**2, axis=0) / max(freedom, 1)
    # Both axes of the image share the scatter of the stage.
    common = float(np.mean(variance))
    matrix = fitted[:2].T * (pixel_size_m / spread[0])
    covariance = common * (inverse @ inverse.T)[:2, :2] * (pixel_size_m / spread[0]) ** 2
    length = np.linalg.norm(matrix, axis=1)
    unit = matrix / length[:, None]
    skew = float(unit[0] @ unit[1])
    # A few residuals do not tell their own sigma well.
    wide = float(stdtrit(2 * max(freedom, 1), _ONE_SIGMA))
    sigma = [float(np.sqrt(u @ covariance @ u)) for u in unit]
    across = [
        (unit[1] - skew * unit[0]) / length[0],
        (unit[0] - skew * unit[1]) / length[1],
    ]
    skew_sigma = float(np.sqrt(sum(a @ covariance @ a for a in across)))
    return StageIsotropy(
        float(length[0] - 1.0),
        float(length[1] - 1.0),
        skew,
        wide * sigma[0],
        wide * sigma[1],
        wide * skew_sigma,
        float(np.sqrt(common)) * pixel_size_m,
        count,
    )
