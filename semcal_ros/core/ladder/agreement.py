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

"""Does a ladder agree with the calibration that it extends, and with what is stated of its pictures?

In its own range the calibration says what the pictures show. Pictures that are mirrored or turned against it have the
distortion of another camera; a pixel size that is stated wrongly makes two jumps of the scale that cancel each other.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

from semcal_ros.core.arrays import equilibrate
from semcal_ros.core.ladder.adjustment import LadderFit, add_up, prior_information, share_noise
from semcal_ros.core.ladder.matching import Match
from semcal_ros.core.ladder.residuals import Link
from semcal_ros.core.ladder.thresholds import (
    BACK_PART,
    DEVIATION_MIN,
    DISAGREEMENT_FALSE_ALARMS,
    LINK_FACTOR,
    SETTING_RATIO,
    TOLD_PART,
    VISIT_SIGMAS,
)
from semcal_ros.core.ladder.unknowns import LadderSetup


@dataclass(frozen=True)
class Flip:
    """How pictures may lie that were flipped since the calibration.

    Attributes
    ----------
    name
        In words.
    signs
        Of x and y from the middle.
    """

    name: str
    signs: tuple[float, float]

    @property
    def is_mirror(self) -> bool:
        """Whether it is a mirror, and no turn."""
        return self.signs[0] * self.signs[1] < 0.0


#: All but the pictures as they are; a quarter turn changes the shape of most pictures.
FLIPS = (
    Flip("mirrored left to right", (-1.0, 1.0)),
    Flip("mirrored upside down", (1.0, -1.0)),
    Flip("turned by half a turn", (-1.0, -1.0)),
)


def flip_match(match: Match, flip: Flip) -> Match:
    """The match of the same pictures flipped."""
    found, signs = match.found, np.array(flip.signs)
    offset = np.where(signs < 0.0, np.array(found.map.size, dtype=np.float64) - 1.0, 0.0)
    flipped = replace(
        found,
        first_xy=offset + signs * found.first_xy,
        second_xy=offset + signs * found.second_xy,
        covariance=found.covariance * np.outer(signs, signs),
    )
    return replace(match, found=flipped)


@dataclass(frozen=True)
class Disagreement:
    """How far a ladder moves the calibration in its own range.

    Attributes
    ----------
    chi_square, freedom
        Of the change over what calibration and ladder together allow, and its degrees of freedom.
    """

    chi_square: float
    freedom: int

    @property
    def is_chance(self) -> bool:
        """Whether a calibration that still holds shows as much."""
        return self.chi_square <= float(chdtri(max(self.freedom, 1), DISAGREEMENT_FALSE_ALARMS))


def measure_disagreement(setup: LadderSetup, fit: LadderFit) -> Disagreement:
    """Compare the coefficients of the calibration with what the ladder makes of them.

    The components of the prior have the variance one; of their change, what the posterior covariance C leaves,
    1 - C, is expected.
    """
    own = setup.bounds[0]
    components, covariance = fit.state.values[own], fit.covariance[own, own]
    expected, directions = np.linalg.eigh(np.eye(len(components)) - covariance)
    told = expected > TOLD_PART
    change = directions.T @ components
    return Disagreement(
        float(np.sum(change[told] ** 2 / expected[told])), int(np.count_nonzero(told))
    )


def minus_log_evidence(setup: LadderSetup, fit: LadderFit, links: Sequence[Link]) -> float:
    """Minus twice the logarithm of the marginal likelihood of all pairs, but for a constant.

    That of :func:`.adjust`, with what pairs cost that were left out.
    """
    used = share_noise(setup, [links[k] for k in fit.kept])
    matrix, _, squares = add_up(fit.state, used)
    information = prior_information(setup, fit.drift, fit.jumps)
    scaled, scale = equilibrate(matrix + np.diag(information))
    factor = np.linalg.cholesky(scaled)
    total = 2.0 * float(np.sum(np.log(np.diag(factor))) - np.sum(np.log(scale)))
    total -= float(np.sum(np.log(information[information > 0.0])))
    total += float(fit.state.values**2 @ information)
    total += float(np.dot([link.share for link in used], squares))
    full = share_noise(setup, links)
    left_out = set(range(len(links))) - set(fit.kept)
    return total + sum(LINK_FACTOR * full[k].share * 2.0 * len(full[k]) for k in left_out)


@dataclass(frozen=True)
class Misstatement:
    """A pixel size or magnification that the other pictures contradict.

    Attributes
    ----------
    magnification
        As it is stated.
    deviation
        Relative deviation of the magnification that the others show from it.
    """

    magnification: float
    deviation: float


def find_misstatement(setup: LadderSetup, fit: LadderFit) -> Misstatement | None:
    """Find the magnification that is most likely stated wrongly, if one is.

    A wrong one makes the scale jump before it and back after it, where a relay leaves it as it is. In the range of the
    calibration the scale of its visit shows it; beside another one of the same setting, one jump.
    """
    counts = Counter(picture.magnification for picture in setup.pictures)
    levels = sorted(counts)
    # The scale is stored relative to the nominal one: a number near 1.
    state = fit.state
    steady = state.parameters[:, 0] / (1.0 + state.creep * setup.order)
    scales = dict.fromkeys(levels, 0.0)
    for picture, scale in zip(setup.pictures, steady.tolist(), strict=True):
        g = picture.magnification
        scales[g] += scale * setup.pixel_m(g) / counts[g]
    found: list[Misstatement] = []
    for number in fit.jumps:
        low, high = setup.intervals[number]
        step = scales[high] - scales[low]
        if abs(step) < DEVIATION_MIN:
            continue
        k = levels.index(low)
        if high < SETTING_RATIO * low:
            fewer = low if counts[low] < counts[high] else high
            found.append(Misstatement(fewer, step if fewer == high else -step))
        elif k + 2 < len(levels) and _is_back(scales[levels[k + 2]] - scales[high], step):
            found.append(Misstatement(high, step))
        elif k > 0 and _is_back(scales[low] - scales[levels[k - 1]], step):
            found.append(Misstatement(low, -step))
    found += _misstated_visits(setup, fit)
    return max(found, key=lambda one: abs(one.deviation), default=None)


def _misstated_visits(setup: LadderSetup, fit: LadderFit) -> list[Misstatement]:
    """Visits whose scale is not that of a magnification that was set again."""
    own = fit.state.values[setup.bounds[3]]
    magnifications = np.empty(len(own))
    magnifications[setup.visit_of] = [picture.magnification for picture in setup.pictures]
    limit = max(VISIT_SIGMAS * setup.visit_sigma, DEVIATION_MIN)
    found = []
    for number in np.flatnonzero(np.abs(own) > limit):
        g = float(magnifications[number])
        # Others of the same setting have taken a part of it.
        others = (np.abs(np.log(magnifications / g)) < np.log(SETTING_RATIO)) & (
            magnifications != g
        )
        deviation = own[number] - (float(np.mean(own[others])) if np.any(others) else 0.0)
        found.append(Misstatement(g, float(deviation)))
    return found


def _is_back(other: float, step: float) -> bool:
    """Whether the scale goes back by what it went before, or after."""
    return BACK_PART < -other / step < 1.0 / BACK_PART
