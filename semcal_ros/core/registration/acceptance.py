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

"""Whether an alignment of two images is believed: tests that a wrong shift does not pass."""

from __future__ import annotations

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.registration.inverse_compositional import Alignment
from semcal_ros.core.registration.normalised_correlation import CoarsePeak
from semcal_ros.core.registration.reference import RegistrationSettings
from semcal_ros.core.registration.thresholds import (
    HALVES_PX_MAX,
    HALVES_SIGMAS,
    STAGES_APART_PX_MAX,
)


def find_divergence(alignment: Alignment) -> Rejection[MatchFailure] | None:
    """Reject an alignment that did not converge."""
    if alignment.converged:
        return None
    return Rejection(
        MatchFailure.NOT_CONVERGED, f"refinement did not converge in {alignment.iterations} steps"
    )


def find_failure(
    limits: RegistrationSettings,
    peak: CoarsePeak,
    alignment: Alignment,
    correlation: float,
    max_shear_px: float,
    stretch_px: Array | None = None,
) -> Rejection[MatchFailure] | None:
    """Return why an alignment must not be used, or None.

    Parameters
    ----------
    limits
        The settings of the registration.
    peak
        The coarse shift at which the alignment started.
    alignment
        The fine shift.
    correlation
        That of the images over their overlap, after their noise has been accounted for.
    max_shear_px
        Largest difference between the upper and the lower end of the image that a drift during the
        scan explains, px.
    stretch_px
        (2,) by how much another scale may move the right half of the image against the left one, and the lower half
        against the upper one, px; None for not at all.
    """
    best, worst = np.sqrt(np.maximum(np.linalg.eigvalsh(alignment.covariance), 0.0)).tolist()
    if not worst <= limits.max_sigma_px and best <= limits.max_sigma_px:
        # The scatter of the blocks: a strained specimen, which has structure, has it too.
        return Rejection(
            MatchFailure.UNDETERMINED,
            f"one direction is not determined (sigma {worst:.2f} px): featureless there, or strained",
        )
    # What does not converge scatters in every direction, and that is no lack of structure.
    if rejection := find_divergence(alignment):
        return rejection
    if not worst <= limits.max_sigma_px:
        return Rejection(
            MatchFailure.UNDETERMINED, f"too little structure for its noise (sigma {worst:.2f} px)"
        )
    apart = float(np.max(np.abs(alignment.shift_px - peak.shift_px)))
    if apart > peak.step_px + STAGES_APART_PX_MAX:
        return Rejection(
            MatchFailure.STAGES_DISAGREE, f"coarse and fine shift differ by {apart:.1f} px"
        )
    if correlation < limits.min_correlation:
        return Rejection(
            MatchFailure.DISSIMILAR,
            f"images differ (noise-corrected correlation {correlation:.2f})",
        )
    allowed = HALVES_SIGMAS * np.sqrt(alignment.half_variance) + HALVES_PX_MAX
    shear = np.abs(alignment.joint_px[2:])
    if np.all(shear <= max_shear_px):
        # Between the upper and the lower half, only the departure from one line counts.
        allowed[1] += shear
    if stretch_px is not None:
        allowed += np.diag(stretch_px)
    if np.any(np.abs(alignment.half_difference_px) > allowed):
        apart = float(np.max(np.abs(alignment.half_difference_px)))
        return Rejection(
            MatchFailure.HALVES_DISAGREE, f"halves of the image disagree by {apart:.1f} px"
        )
    return None
