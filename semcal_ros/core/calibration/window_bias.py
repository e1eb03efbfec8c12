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

"""Where a scan that settles within the window of a corner is taken for a shift of the corner.

A corner is found from the pixels around it, by a model that follows the lattice of its neighbours to second order.
Where the beam settles over fewer columns than the points are apart, the picture is displaced within a window in another
way than the lattice tells, and the fit takes a part of that for a shift. To first order, this is what the fit makes
of a displacement along x by u and by u^2 / 2, u px from the corner
(:attr:`~semcal_ros.core.corners.LatticeDetection.scan_response`), times the slope and the second derivative by which
the settling departs from what the lattice follows of it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.thresholds import BEND_STEP_PX, WINDOW_BIAS_PART
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_distortion import (
    SETTLING,
    Raster,
    deflection_shift,
    deflection_stretch,
)
from semcal_ros.core.camera.thresholds import SETTLING_TIMES
from semcal_ros.core.corners.local_map import fit_local_maps


def find_window_bias(view: GridView, amplitudes: Array, raster: Raster) -> Array:
    """Return by how far each corner was found off, (n, 2) px: found less true position.

    Zero where the beam does not settle, or where the view does not say how its corners were fitted.

    Parameters
    ----------
    view
        n corners.
    amplitudes
        Of the distortion of the scan, in the order of :data:`~semcal_ros.core.camera.scan_distortion.SCAN_NAMES`.
    raster
        Where it lies in the picture.
    """
    bias = np.zeros_like(view.image_xy)
    response = view.scan_response
    if response is None or view.square_m == 0.0 or not np.any(amplitudes[SETTLING]):
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
    departs = np.stack([stretch(0.0) - 1.0 - slope, second - bend], axis=1)
    # The picture is displaced against the deflection.
    bias[known] = -np.einsum("nkc,nk->nc", response[known], departs)
    return bias


def undo_window_bias(view: GridView, bias: Array) -> GridView:
    """Return the view with corners where they were without a bias (n, 2) px, which becomes a part of their sigmas."""
    far = WINDOW_BIAS_PART * bias
    spread = view.covariance_px2
    if spread is not None:
        spread = spread + far[:, :, None] * far[:, None, :]
    return replace(
        view,
        image_xy=view.image_xy - bias,
        sigma_px=np.sqrt(view.sigma_px**2 + 0.5 * np.sum(far**2, axis=1)),
        covariance_px2=spread,
        scan_response=None,
    )


def approach_window_bias(
    view: GridView, removed: Array, amplitudes: Array, raster: Raster
) -> Array:
    """Return the bias (n, 2) of a view of which ``removed`` was taken out before the settling was fitted to it.

    What was fitted contains the rest of the bias. Where the beam settles by d and its bias is a times as large, it is
    fitted as (1 + a) d to corners as they were found, whose bias by that is a (1 + a) d: the step is 1 / (1 + a) of it.
    """
    bias = find_window_bias(view, amplitudes, raster)
    u = (view.image_xy[:, 0] - raster.middle_px[0]) / raster.norm_px
    decays = np.exp(-(1.0 + u)[:, None] / np.array(SETTLING_TIMES))
    decay = raster.norm_px * np.abs(decays @ amplitudes[SETTLING])
    size = np.linalg.norm(bias, axis=1)
    step = decay / np.maximum(decay + size, 1e-12)
    return removed + step[:, None] * (bias - removed)


def flatten_view(view: GridView, camera: ScanCamera) -> GridView:
    """Return a view without the residual field of a known camera, and without the bias of windows by its settling."""
    flat = replace(view, image_xy=camera.without_residual(view.image_xy))
    return undo_window_bias(flat, find_window_bias(flat, camera.scan_amplitudes, camera.raster))
