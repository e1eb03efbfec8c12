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

"""Priors of the nuisance parameters of each corner, learnt from the image as a whole.

A single small or blurred corner hardly separates a gradient of the contrast or a bend of an edge
from a shift of its own. The variation of such parameters over the image, however, is well
determined by all corners together, so their spread is learnt and used as a prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array, Indices
from semcal_ros.core.corners.edge_model import (
    ANGLES,
    GRADIENTS,
    GROWTH,
    LINEAR,
    LOG_BLUR,
    NONLINEAR,
    SAGITTAS,
    EdgeGeometry,
)
from semcal_ros.core.corners.local_map import LocalMaps, fit_local_maps
from semcal_ros.core.corners.thresholds import (
    ANGLE_PRIOR,
    GRADIENT_LEAST,
    GRADIENT_PRIOR,
    GROWTH_PRIOR_PX,
    LARGE_SQUARE_PX,
    LIKELIHOOD_LOSS,
    LOG_BLUR_PRIOR,
    OUTLIER_SCORE,
    PRIOR_SPREADS,
    SAGITTA_PRIOR_PX,
)

PARAMETERS = NONLINEAR + LINEAR
# Parameters that share one spread.
GROUPS = (ANGLES, slice(LOG_BLUR, LOG_BLUR + 1), SAGITTAS, *GRADIENTS, GROWTH)
# Parameters with a value that is common to all corners of an image.
COMMON = (LOG_BLUR, GROWTH.start, GROWTH.start + 1)


@dataclass(frozen=True)
class Prior:
    """Independent normal priors of the parameters of n corners.

    Attributes
    ----------
    mean, deviation
        (n, 15); a deviation is infinite where nothing is known.
    """

    mean: Array
    deviation: Array

    def near(self, parameters: Array) -> Prior:
        """Return the same prior with directions within half a turn of (n, 15) ``parameters``."""
        mean = self.mean.copy()
        turns = (parameters[:, ANGLES] - mean[:, ANGLES]) / (2.0 * np.pi)
        mean[:, ANGLES] += 2.0 * np.pi * np.round(turns)
        return Prior(mean, self.deviation)


@dataclass(frozen=True)
class Learnt:
    """Common values and spreads of nuisance parameters.

    Attributes
    ----------
    common
        (15,) means; zero where a parameter has no common value.
    spread
        (15,) factors on the deviations of the loose prior.
    """

    common: Array
    spread: Array

    def prior(self, maps: LocalMaps, geometry: EdgeGeometry) -> Prior:
        """Return the prior of corners whose local maps are given."""
        loose = loose_prior(maps, geometry, 1.0)
        mean = loose.mean + self.common
        mean[:, LOG_BLUR] = self.common[LOG_BLUR]
        return Prior(mean, loose.deviation * self.spread)


def loose_prior(maps: LocalMaps, geometry: EdgeGeometry, blur_px: float) -> Prior:
    """Return the prior before any fit: what is plausible for any image of a board."""
    deviation = np.full((len(maps.xy), PARAMETERS), np.inf)
    deviation[:, ANGLES] = ANGLE_PRIOR
    deviation[:, LOG_BLUR] = LOG_BLUR_PRIOR
    sagitta = SAGITTA_PRIOR_PX * (2.0 * geometry.length / LARGE_SQUARE_PX) ** 3 + 0.002
    deviation[:, SAGITTAS] = sagitta[:, None]
    for gradient in GRADIENTS:
        deviation[:, gradient] = GRADIENT_PRIOR
    deviation[:, GROWTH] = GROWTH_PRIOR_PX
    mean = np.zeros_like(deviation)
    mean[:, ANGLES] = np.arctan2(maps.axes[:, :, 1], maps.axes[:, :, 0])
    mean[:, LOG_BLUR] = np.log(blur_px)
    return Prior(mean, deviation)


def learn(parameters: Array, normal: Array, used: Prior, unit: float, noise: float) -> Learnt:
    """Learn common values and spreads from the fits of some corners.

    Parameters
    ----------
    parameters
        (n, 15) fitted values.
    normal
        (n, 15, 15) normal matrices, including the prior.
    used
        Prior of those fits.
    unit
        Variance of a pixel that the weight of the prior assumed.
    noise
        Variance of the residuals in the same measure.
    """
    information = 1.0 / np.einsum("nii->ni", np.linalg.inv(normal))
    common, spread = np.zeros(PARAMETERS), np.ones(PARAMETERS)
    for group in GROUPS:
        deviation = used.deviation[:, group]
        # The information of the pixels alone, without the prior.
        share = np.maximum(information[:, group] - unit / deviation**2, 1e-9)
        likeliest = used.mean[:, group] + (parameters[:, group] - used.mean[:, group]) * (
            information[:, group] / share
        )
        variance = noise / (share * deviation**2)
        if group.start in COMMON:
            common[group] = _weighted_median(likeliest, 1.0 / (1.0 + variance))
            centre = common[group]
        else:
            centre = used.mean[:, group]
        spread[group] = _largest_spread(
            ((likeliest - centre) / deviation).ravel(), variance.ravel()
        )
    return Learnt(common, spread)


def _weighted_median(values: Array, weights: Array) -> Array:
    """Return the (m,) weighted medians of the columns of (n, m)."""
    order = np.argsort(values, axis=0)
    total = np.cumsum(np.take_along_axis(weights, order, axis=0), axis=0)
    middle = (total < 0.5 * total[-1]).sum(axis=0)
    picked = np.take_along_axis(order, middle[None], axis=0)
    return np.asarray(np.take_along_axis(values, picked, axis=0)[0], dtype=np.float64)


def _largest_spread(score: Array, variance: Array) -> float:
    """Return the largest spread that scores with these variances do not contradict."""
    total = PRIOR_SPREADS[:, None] ** 2 + variance
    # Corners under debris count no more than others at three standard deviations.
    cost = 0.5 * (np.log(total) + np.minimum(score**2 / total, OUTLIER_SCORE)).sum(axis=1)
    plausible = cost <= cost.min() + LIKELIHOOD_LOSS
    if PRIOR_SPREADS[np.argmin(cost)] <= 1.0:
        plausible &= PRIOR_SPREADS <= 1.0
    return float(PRIOR_SPREADS[np.nonzero(plausible)[0][-1]])


def smooth_levels(prior: Prior, cells: Indices, linear: Array, maps: LocalMaps) -> Prior:
    """Return the prior with gradients of brightness and contrast from the neighbours' levels.

    Parameters
    ----------
    prior
        Prior to start from.
    cells
        (n, 2) lattice indices.
    linear
        (n, 8) fitted levels.
    maps
        Local maps of the same corners.
    """
    parity = np.where(cells.sum(axis=1) % 2 == 0, 1.0, -1.0)
    levels = np.stack([linear[:, 0], linear[:, 3] * parity], axis=1)
    smooth = fit_local_maps(cells, cells, levels, leave_out_self=False)
    others = fit_local_maps(cells, cells, levels)
    usable = (others.support >= 6) & (others.leverage < 1.0)
    if usable.sum() < 6:
        return prior
    # Rows: x and y; columns: brightness, contrast.
    slope = np.asarray(np.linalg.solve(maps.axes, smooth.axes))
    slope[:, :, 1] *= parity[:, None]
    slope *= 0.25 * np.linalg.norm(maps.axes, axis=2).sum(axis=1)[:, None, None]
    residual = np.abs(levels - others.xy) / np.sqrt(1.0 + others.leverage)[:, None]
    typical = np.median(residual[usable], axis=0) / 0.675
    mean, deviation = prior.mean.copy(), prior.deviation.copy()
    for level, gradient in enumerate(GRADIENTS):
        limit = max(float(typical[level]), GRADIENT_LEAST)
        # Where the levels are noisy, no gradient at all may be the better guess.
        if limit < float(np.max(prior.deviation[:, gradient])):
            mean[usable, gradient] = slope[usable, :, level]
            deviation[usable, gradient] = limit
    return Prior(mean, deviation)
