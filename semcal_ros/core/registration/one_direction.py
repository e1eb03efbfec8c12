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

"""Shift across a specimen of scratches or wires in one direction, along which nothing tells it.

The gradients of such an image all point across (the structure tensor, Foerstner and Guelch 1987): along its other
direction the correlation is a ridge. The shift along it stays the predicted one, and
that across is refined as any other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.registration.inverse_compositional import Alignment, align
from semcal_ros.core.registration.noise_spectrum import passed_gradient
from semcal_ros.core.registration.normalised_correlation import (
    CoarsePeak,
    CoarseReference,
    find_coarse_peaks,
)
from semcal_ros.core.registration.thresholds import (
    HALVES_PX_MAX,
    HALVES_SIGMAS,
    HELD_SIGMA_PX,
    LINES_MOVED,
    LINES_POWER_MAX,
    NOISE_POWER_MAX,
    NOISE_POWER_SIGMA,
    SAME_RIDGE_STEPS,
)
from semcal_ros.core.registration.tiles import Pyramid, PyramidLevel


@dataclass(frozen=True)
class OneDirection:
    """The directions of a reference that shows parallel lines.

    Attributes
    ----------
    across, along
        (2,) unit vectors: the shift along the first shows, and that along the second does not.
    sigma_rad
        1-sigma of their angle.
    """

    across: Array
    along: Array
    sigma_rad: float


def find_direction(
    levels: Sequence[PyramidLevel], image: Pyramid, noise_variance: float
) -> OneDirection | None:
    """Return the directions of a specimen of parallel lines; None of any other.

    The gradients tell them to some thousandths: filters take more from steep ones. The image moved along its own lines
    tells the rest.

    Parameters
    ----------
    levels, image
        The reference, and the image that it was made of.
    noise_variance
        That of its white noise, per pixel before smoothing.
    """
    level = levels[-1]
    whole = level.normal_matrices.reshape(-1, 4, 4).sum(axis=0)
    noise = noise_variance * passed_gradient(level.sigma_px) * float(whole[3, 3])
    values, vectors = np.linalg.eigh(whole[:2, :2] - noise * np.eye(2))
    if (
        noise > NOISE_POWER_MAX * values[1]
        or values[0] > LINES_POWER_MAX * values[1] + NOISE_POWER_SIGMA * noise
    ):
        return None
    across, along = vectors[:, 1], vectors[:, 0]
    length = LINES_MOVED * min(level.size)
    angles, variances = [], []
    for moved in (length, -length):
        found = align(levels, image, moved * along, held=along)
        if isinstance(found, Rejection):
            return None
        angles.append(float(found.shift_px @ across) / moved)
        variances.append(float(across @ found.covariance @ across) / length**2)
    angle = 0.5 * (angles[0] + angles[1])
    sigma_rad = float(np.hypot(0.5 * (angles[0] - angles[1]), np.sqrt(0.5 * np.mean(variances))))
    return OneDirection(across - angle * along, along + angle * across, sigma_rad)


def align_across(
    coarse: CoarseReference,
    levels: Sequence[PyramidLevel],
    pyramid: Pyramid,
    lines: OneDirection,
    guess: Array,
    guess_covariance: Array,
    min_competing_height: float,
) -> tuple[CoarsePeak, Alignment] | Rejection[MatchFailure]:
    """Refine the shift across lines, at the predicted place along them.

    Parameters
    ----------
    coarse, levels
        The reference.
    pyramid
        The image.
    lines
        Their directions.
    guess, guess_covariance
        (2,) predicted shift, and its covariance (2, 2).
    min_competing_height
        As in :class:`~semcal_ros.core.registration.reference.RegistrationSettings`.

    Returns
    -------
    The peak and the alignment, whose covariance along the lines means nothing; or a rejection where
    several shifts across explain the images, or their halves disagree.
    """
    peaks = find_coarse_peaks(coarse, pyramid, guess, finest=True)
    if not peaks:
        return Rejection(MatchFailure.NO_PEAK, "no shift stands out across the lines")
    offsets = [float((np.array(p.shift_px) - guess) @ lines.across) for p in peaks]
    least = min_competing_height * peaks[0].correlation
    for peak, offset in zip(peaks[1:], offsets[1:], strict=True):
        if abs(offset - offsets[0]) > SAME_RIDGE_STEPS * peak.step_px and peak.correlation >= least:
            return Rejection(
                MatchFailure.AMBIGUOUS,
                f"ambiguous: shifts of {offsets[0]:.1f} and {offset:.1f} px across the lines explain the image "
                "equally well",
            )
    start = guess + offsets[0] * lines.across
    x, y = start.tolist()
    found = align(levels, pyramid, start, held=lines.along)
    if not isinstance(found, Rejection):
        found = known_across(found, lines, guess_covariance)
    return found if isinstance(found, Rejection) else (replace(peaks[0], shift_px=(x, y)), found)


def known_across(
    found: Alignment, lines: OneDirection, guess_covariance: Array, counts: Mask | None = None
) -> Alignment | Rejection[MatchFailure]:
    """The alignment with its place along lines marked as not measured; a rejection where the halves of the image
    disagree across them.

    ``counts`` (rows, cols) are the tiles that show the specimen; None where all do.
    """
    if failure := _compare_halves(found, lines, counts):
        return failure
    # Where the place along the lines is wrong, an angle that is wrong shifts what lies across.
    aside = float(lines.along @ guess_covariance @ lines.along)
    variance = float(lines.across @ found.covariance @ lines.across) + aside * lines.sigma_rad**2
    covariance = variance * np.outer(lines.across, lines.across)
    covariance += HELD_SIGMA_PX**2 * np.outer(lines.along, lines.along)
    # A shear is one of rows, of which a part shows.
    unknown = np.full(4, np.nan), np.full((4, 4), np.inf)
    return replace(
        found,
        covariance=covariance,
        joint_px=unknown[0],
        joint_covariance=unknown[1],
        half_difference_px=np.zeros((2, 2)),
        half_variance=np.full((2, 2), np.inf),
    )


def _compare_halves(
    found: Alignment, lines: OneDirection, counts: Mask | None
) -> Rejection[MatchFailure] | None:
    """Reject an alignment whose halves are shifted differently across the lines."""
    tiles = found.tile_statistics()
    if tiles is None:
        return None
    scores = tiles.scores @ lines.across
    weights = np.einsum("i,rcij,j->rc", lines.across, tiles.gradient, lines.across)
    if counts is not None:
        scores, weights = scores * counts, weights * counts
    noise = float(np.sum(scores**2) / max(np.sum(weights), 1e-30))
    rows, cols = (n // 2 for n in scores.shape)
    halves = (
        ((slice(None), slice(None, cols)), (slice(None), slice(cols, None))),
        ((slice(None, rows), slice(None)), (slice(rows, None), slice(None))),
    )
    for pair in halves:
        sums = [(float(scores[half].sum()), float(weights[half].sum())) for half in pair]
        if min(weight for _, weight in sums) <= 0.0:
            continue
        apart = abs(sums[0][0] / sums[0][1] - sums[1][0] / sums[1][1])
        sigma = np.sqrt(noise * sum(1.0 / weight for _, weight in sums))
        if apart > HALVES_SIGMAS * sigma + HALVES_PX_MAX:
            return Rejection(
                MatchFailure.HALVES_DISAGREE,
                f"halves of the image disagree by {apart:.1f} px across the lines",
            )
    return None
