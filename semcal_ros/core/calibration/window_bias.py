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

"""Where the distortion of the scan within the window of a corner is taken for a shift of the corner.

A corner is found from the pixels around it, by a model that follows the lattice of its neighbours to second order.
Where the beam settles over fewer columns than the points are apart, the picture is displaced within a window in another
way than the lattice tells, and the fit takes a part of that for a shift. To first order, this is what the fit makes
of a displacement along x by u and by u^2 / 2, u px from the corner
(:attr:`~semcal_ros.core.corners.LatticeDetection.scan_response`), times the slope and the second derivative by which
the settling departs from what the lattice follows of it. Coils that are not linear do the same, by less.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.thresholds import (
    BEND_STEP_PX,
    BIAS_NEGLIGIBLE,
    WINDOW_BIAS_PART,
)
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_distortion import (
    ALONG_COUNT,
    SETTLING,
    Raster,
    deflection_shift,
    deflection_stretch,
    settling_decay,
)
from semcal_ros.core.corners.local_map import fit_local_maps


def find_window_bias(view: GridView, amplitudes: Array, raster: Raster) -> Array:
    """Return by how far each corner was found off, (n, 2) px: found less true position.

    Zero where the scan is not distorted along the lines, or where the view does not say how its corners were fitted.

    Parameters
    ----------
    view
        n corners on whole squares: all that were found, since the fit followed the lattice of all.
    amplitudes
        Of the distortion of the scan, in the order of :data:`~semcal_ros.core.camera.scan_distortion.SCAN_NAMES`.
    raster
        Where it lies in the picture.
    """
    bias = np.zeros_like(view.image_xy)
    response, along_lines = view.scan_response, amplitudes[:ALONG_COUNT]
    if response is None or view.square_m == 0.0 or not len(bias) or not np.any(along_lines):
        return bias
    xy = view.image_xy
    ij = np.rint(view.board_xy_m / view.square_m).astype(np.int64)
    ij -= ij.min(axis=0)
    shift = deflection_shift(xy, amplitudes, raster)
    shift[:, 1] = 0.0
    maps = fit_local_maps(ij, ij, xy, leave_out_self=False)
    of_shift = fit_local_maps(ij, ij, shift, leave_out_self=False)
    known = maps.usable
    # Squares per px along x.
    along = np.linalg.inv(maps.axes[known])[:, 0]
    slope = np.sum(of_shift.axes[known, :, 0] * along, axis=1)
    bend = np.sum(of_shift.bend[known, :, 0] * along**2, axis=1)
    bend += 2.0 * of_shift.twist[known, 0] * along[:, 0] * along[:, 1]

    def stretch(by_px: float) -> Array:
        return deflection_stretch(xy[known] + [by_px, 0.0], amplitudes, raster)[:, 0]

    second = (stretch(BEND_STEP_PX) - stretch(-BEND_STEP_PX)) / (2.0 * BEND_STEP_PX)
    not_followed = np.stack([stretch(0.0) - 1.0 - slope, second - bend], axis=1)
    # The picture is displaced against the deflection.
    bias[known] = -np.einsum("nkc,nk->nc", response[known], not_followed)
    return bias


def undo_window_bias(view: GridView, bias: Array) -> GridView:
    """Return the view with corners where they were without a bias (n, 2) px, of which a part is added to their sigmas.

    That part is added to each corner on its own. What the bias is wrong by is alike along a column, so that many
    corners of a column together are less certain than is stated.
    """
    sigma = WINDOW_BIAS_PART * bias
    spread = view.covariance_px2
    if spread is not None:
        spread = spread + sigma[:, :, None] * sigma[:, None, :]
    square = 0.5 * np.sum(sigma**2, axis=1)
    if view.across is not None:
        square = np.sum(sigma * view.across, axis=1) ** 2
    return replace(
        view,
        image_xy=view.image_xy - bias,
        sigma_px=np.sqrt(view.sigma_px**2 + square),
        covariance_px2=spread,
        scan_response=None,
    )


def approach_window_bias(
    view: GridView, removed: Array, amplitudes: Array, raster: Raster
) -> tuple[Array, Array]:
    """Return the bias (n, 2) of a view to take out next, and what is left (n, 2) of it now.

    What was fitted to the corners after ``removed`` was taken out of them contains the rest of the bias. Where the beam
    settles by d and a corner is off by a d, the settling is fitted as (1 + a) d to corners as they were found, and
    their bias by that is b = a (1 + a) d. So the next one is r' = r + (b - r) / (1 + a), with r = ``removed``. What the
    coils do to a corner is little of what they do to the picture, and needs no such care.
    """
    bias = find_window_bias(view, amplitudes, raster)
    settling = np.zeros_like(amplitudes)
    settling[SETTLING] = amplitudes[SETTLING]
    size = np.linalg.norm(find_window_bias(view, settling, raster), axis=1)
    decay = raster.norm_px * np.abs(settling_decay(view.image_xy[:, 0], amplitudes, raster))
    # Far from the left border both are nothing.
    little = BIAS_NEGLIGIBLE * view.sigma_px
    step = (decay + little) / (decay + size + little)
    return removed + step[:, None] * (bias - removed), bias - removed


def flatten_view(view: GridView, camera: ScanCamera) -> GridView:
    """Return a view without the residual field of a known camera, and without the bias of windows by its scan.

    The camera is one for the size of the view's picture.
    """
    flat = replace(view, image_xy=camera.without_residual(view.image_xy))
    return undo_window_bias(flat, find_window_bias(flat, camera.scan_amplitudes, camera.raster))
