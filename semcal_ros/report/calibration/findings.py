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

"""Warnings that a reader should know before trusting a calibration, in plain sentences."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from semcal_ros.core.calibration.calibrate import CalibrationResult
from semcal_ros.core.calibration.evaluate import rms_by_magnification
from semcal_ros.core.calibration.views import RejectedView
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.report.calibration.cells import (
    assign_cells,
    compute_empty_share,
    compute_reached_shares,
    concatenate_corners,
)
from semcal_ros.report.calibration.coverage_figures import compute_tilts_deg
from semcal_ros.report.calibration.geometry import make_field_lattice, predict_shape_sigma_px
from semcal_ros.report.calibration.numbers import tabulate_views
from semcal_ros.report.calibration.rms_figures import normalise_residuals
from semcal_ros.report.html.text import format_magnification, remove_control_characters

__all__ = ["collect_warnings", "estimate_pattern_px"]

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
# Cells across the field for the test: larger than in the figure, so that their means are less
# noisy.
_PATTERN_CELLS = 8
# With fewer corners a cell is left out.
_MIN_IN_CELL = 5
# Views or magnifications that a sentence names; the others are counted.
_NAMED = 5


def _format_sentence(text: str) -> str:
    clean = remove_control_characters(text).strip()
    return clean[:1].upper() + clean[1:].rstrip(".") + "."


def _join_names(items: Sequence[str]) -> str:
    more = len(items) - _NAMED
    return ", ".join(items[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def collect_warnings(result: CalibrationResult, rejected: Sequence[RejectedView] = ()) -> list[str]:
    """Collect the calibration's warnings, then what an expert would see in the figures."""
    found = [
        *result.warnings,
        *_check_views(result, rejected),
        *_check_field(result),
        *_check_held_out(result),
        *_check_pattern(result),
        *_check_predicted_error(result),
    ]
    if not result.fit.converged:
        found.append("the poses of some views did not converge; their residuals may be too large")
    return [_format_sentence(text) for text in dict.fromkeys(found)]


def _check_views(result: CalibrationResult, rejected: Sequence[RejectedView]) -> list[str]:
    found = []
    total = len(rejected) + len(result.views)
    if len(rejected) > _REJECTED_SHARE * total:
        reason, count = Counter(r.reason for r in rejected).most_common(1)[0]
        found.append(
            f"{len(rejected)} of {total} views were rejected, {count} of them for this reason: "
            f"{reason}"
        )
    bad = [f"{r.name} ({r.magnification})" for r in tabulate_views(result) if r.ratio > _VIEW_RATIO]
    if bad:
        found.append(
            f"the corners of {_join_names(bad)} fit more than {_VIEW_RATIO:g} times worse than their "
            "own uncertainty: look at these images, and leave them out if something is wrong"
        )
    return found


def _check_field(result: CalibrationResult) -> list[str]:
    found = []
    empty = compute_empty_share(result)
    if empty > _EMPTY_SHARE:
        found.append(
            f"{100.0 * empty:.0f} % of the image field has no corner in any view: "
            "the distortion there is extrapolated; let the grid fill the image"
        )
    shares = compute_reached_shares(result)
    poor = [f"{g:g}×" for g, share in shares.items() if share < _FILLED_SHARE]
    # If all of them are poor, the sentence above says so, or the grid is very coarse.
    if 0 < len(poor) < len(shares):
        found.append(
            f"at {_join_names(poor)} the corners reach less than half of the image field: the "
            "distortion there comes from other magnifications; let the grid fill the image"
        )
    largest = float(np.max(compute_tilts_deg(result)[0]))
    if largest < _SMALL_TILT_DEG:
        found.append(
            f"no view is tilted by more than {largest:.1f} degrees: scale and height are hardly "
            "separated; tilt the grid by 20 to 40 degrees in different directions"
        )
    return found


def _check_held_out(result: CalibrationResult) -> list[str]:
    values = result.held_out_rms_px
    without = [f"{g:g}×" for g, value in values.items() if np.isinf(value)]
    if without:
        return [f"without the images at {', '.join(without)} the method has no answer there"]
    fitted = rms_by_magnification(result.fit)
    # The two outermost magnifications are extrapolated in this test, unlike in any proper use.
    inner = [g for g in result.model.magnifications[1:-1] if g in values]
    worse = [f"{g:g}×" for g in inner if values[g] > _HELD_OUT_RATIO * fitted[g]]
    if worse:
        return [
            f"the images at {', '.join(worse)} are predicted badly from the other magnifications: "
            "take images at more magnifications around there"
        ]
    return []


def estimate_pattern_px(result: CalibrationResult) -> tuple[float, float]:
    """Estimate the size in px of a pattern in the residuals, and its ratio to chance.

    The ratio compares the squares of the cells' weighted mean residuals with what independent
    corners of the same spread would give; 1 is pure chance.
    """
    xy, residuals = concatenate_corners(result)
    weights = np.concatenate([v.sigma_px for v in result.views]) ** -2.0
    cells = assign_cells(result, xy, _PATTERN_CELLS)
    size = cells.columns * cells.rows
    enough = cells.counts >= _MIN_IN_CELL
    if not np.any(enough):
        return 0.0, 1.0
    total = np.bincount(cells.index, weights, size)[enough]
    sums = np.stack(
        [np.bincount(cells.index, weights * residuals[:, k], size)[enough] for k in (0, 1)], axis=1
    )
    # The median is robust; 0.6745 is the median absolute value of a standard normal variable.
    spread = float(np.median(np.abs(normalise_residuals(result)))) / 0.6745
    chance = spread**2 / total
    squares = np.sum((sums / total[:, None]) ** 2, axis=1)
    excess = float(np.mean(squares - 2.0 * chance))
    if not np.all(chance > 0.0):
        return 0.0, 1.0
    return float(np.sqrt(max(excess, 0.0))), float(np.mean(squares / (2.0 * chance)))


def _check_pattern(result: CalibrationResult) -> list[str]:
    size, ratio = estimate_pattern_px(result)
    if ratio > _PATTERN_RATIO and size > _PATTERN_PX:
        return [
            f"the residuals have a pattern over the field of {size:.2f} px RMS, more than chance "
            "explains: the scan has a distortion that the model does not describe"
        ]
    return []


def _check_predicted_error(result: CalibrationResult) -> list[str]:
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
            f"around {format_magnification(g, 2)} positions at the edge of the image are uncertain "
            f"by {worst[g]:.1f} px relative to its centre: take more images there, tilted in different directions"
        ]
    return []
