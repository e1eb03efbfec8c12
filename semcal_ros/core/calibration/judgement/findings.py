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

"""What a reader should know before trusting a calibration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.judgement.coverage import (
    compute_empty_share,
    compute_reached_shares,
    compute_tilts_deg,
)
from semcal_ros.core.calibration.judgement.evaluate import rms_by_magnification
from semcal_ros.core.calibration.judgement.finding import Finding, rank_findings
from semcal_ros.core.calibration.residual_pattern import estimate_pattern_px
from semcal_ros.core.calibration.views import RejectedView
from semcal_ros.core.camera.predicted_error import make_field_lattice, predict_shape_sigma_px
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.wording import counted

__all__ = ["find_all", "find_weaknesses"]

# Part of the field without a corner that is worth a warning: about 5 of 108 cells of a 4:3 image.
_EMPTY_SHARE = 0.05
# This tilt shortens the grid by 0.4 % only, which shows little of the perspective.
_SMALL_TILT_DEG = 5.0
# Predicting a magnification from the others is a little worse than fitting it; this much worse
# means that the functions between the magnifications miss something.
_HELD_OUT_RATIO = 1.5
# Part of the field that the corners of one magnification should reach.
_FILLED_SHARE = 0.5
# More rejected views than this are no accident: something is wrong with the recording.
_REJECTED_SHARE = 1.0 / 3.0
# RMS error of a view over its prediction from the corners' 1-sigma, above which it is named.
_VIEW_RATIO = 3.0
# Mean square of the cells' mean residuals over that expected by chance, above which they form a
# pattern.
_PATTERN_RATIO = 3.0
# RMS of a pattern, px: a smaller one may be significant but does not matter.
_PATTERN_PX = 0.02
# Beyond this predicted error, between two calibrated magnifications or at one, more images help.
_SIGMA_PX = 2.0
# Views or magnifications that a sentence names; the others are counted.
_NAMED = 5


def find_all(
    result: CalibrationResult, rejected: Sequence[RejectedView] = ()
) -> tuple[Finding, ...]:
    """All that a user is told: what the adjustment found, and what an expert sees in the figures, ranked by cost."""
    return rank_findings((*result.findings, *find_weaknesses(result, rejected)), result.model)


def find_weaknesses(
    result: CalibrationResult, rejected: Sequence[RejectedView] = ()
) -> list[Finding]:
    """Find what an expert would see in the figures of a calibration.

    What the adjustment itself found is in ``result.findings``.
    """
    found = [
        *_check_views(result, rejected),
        *_check_field(result),
        *_check_held_out(result),
        *_check_pattern(result),
        *_check_predicted_error(result),
    ]
    if not result.fit.converged:
        found.append(
            Finding("the poses of some views did not converge; their residuals may be too large")
        )
    return found


def _join_names(items: Sequence[str]) -> str:
    more = len(items) - _NAMED
    return ", ".join(items[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def _check_views(result: CalibrationResult, rejected: Sequence[RejectedView]) -> list[Finding]:
    found = []
    total = len(rejected) + len(result.views)
    if len(rejected) > _REJECTED_SHARE * total:
        reason, count = Counter(r.reason for r in rejected).most_common(1)[0]
        found.append(
            Finding(
                f"{len(rejected)} of {counted(total, 'view')} were rejected, {count} of them for this reason: "
                f"{reason}"
            )
        )
    bad = []
    for view, residuals in zip(result.views, result.fit.residuals_px, strict=True):
        rms = float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))
        ratio = rms / float(np.sqrt(2.0 * np.mean(view.sigma_px**2)))
        if ratio > _VIEW_RATIO:
            bad.append((ratio, rms, view))
    if bad:
        bad.sort(key=lambda item: -item[0])
        _, worst_px, worst = max(bad, key=lambda item: item[1])
        names = _join_names([f"{view.name} ({view.magnification:g}x)" for _, _, view in bad])
        found.append(
            Finding(
                f"the corners of {names} fit more than {_VIEW_RATIO:g} times worse than their own uncertainty: "
                "look at these images, and leave them out if something is wrong",
                worst_px,
                magnification=float(worst.magnification),
            )
        )
    return found


def _check_field(result: CalibrationResult) -> list[Finding]:
    found = []
    empty = compute_empty_share(result)
    if empty > _EMPTY_SHARE:
        found.append(
            Finding(
                f"{100.0 * empty:.0f} % of the image field has no corner in any view: "
                "the distortion there is extrapolated; let the grid fill the image"
            )
        )
    shares = compute_reached_shares(result)
    poor = [f"{g:g}x" for g, share in shares.items() if share < _FILLED_SHARE]
    # If all of them are poor, the sentence above says so, or the grid is very coarse.
    if 0 < len(poor) < len(shares):
        found.append(
            Finding(
                f"at {_join_names(poor)} the corners reach less than half of the image field: the "
                "distortion there comes from other magnifications; let the grid fill the image"
            )
        )
    largest = float(np.max(compute_tilts_deg(result)[0]))
    if largest < _SMALL_TILT_DEG:
        found.append(
            Finding(
                f"no view is tilted by more than {largest:.1f} degrees: scale and height are hardly "
                "separated; tilt the grid by 20 to 40 degrees in different directions"
            )
        )
    return found


def _check_held_out(result: CalibrationResult) -> list[Finding]:
    values = result.held_out_rms_px
    without = [f"{g:g}x" for g, value in values.items() if np.isinf(value)]
    if without:
        return [
            Finding(f"without the images at {', '.join(without)} the method has no answer there")
        ]
    fitted = rms_by_magnification(result.fit)
    # The two outermost magnifications are extrapolated in this test, unlike in any proper use.
    inner = [g for g in result.model.magnifications[1:-1] if g in values]
    worse = [g for g in inner if values[g] > _HELD_OUT_RATIO * fitted[g]]
    if not worse:
        return []
    worst = max(worse, key=lambda g: values[g])
    return [
        Finding(
            f"the images at {', '.join(f'{g:g}x' for g in worse)} are predicted badly from the other magnifications: "
            "take images at more magnifications around there",
            float(np.sqrt(max(values[worst] ** 2 - fitted[worst] ** 2, 0.0))),
            magnification=float(worst),
        )
    ]


def _check_pattern(result: CalibrationResult) -> list[Finding]:
    size, ratio = estimate_pattern_px(result)
    if ratio > _PATTERN_RATIO and size > _PATTERN_PX:
        low, high = result.model.magnification_range
        return [
            Finding(
                f"the residuals have a pattern over the field of {size:.2f} px RMS, more than chance "
                "explains: the scan has a distortion that the model does not describe",
                size,
                magnification=float(np.sqrt(low * high)),
            )
        ]
    return []


def _check_predicted_error(result: CalibrationResult) -> list[Finding]:
    """Check the magnification at which positions are least certain."""
    model = result.model
    low, high = model.magnification_range
    lattice = make_field_lattice(*model.image_size, 5)
    try:
        worst = {
            float(g): float(np.nanmax(predict_shape_sigma_px(model.at(float(g)), lattice)))
            for g in np.clip(np.geomspace(low, high, 41 if high > low else 1), low, high)
        }
    except (InvalidValueError, ValueError):
        return []
    g = max(worst, key=lambda x: worst[x])
    if worst[g] > _SIGMA_PX:
        return [
            Finding(
                f"around {float(f'{g:.2g}'):.10g}x positions at the edge of the image are uncertain "
                f"by {worst[g]:.1f} px relative to its centre: take more images there, tilted in different directions",
                worst[g],
                magnification=g,
            )
        ]
    return []
