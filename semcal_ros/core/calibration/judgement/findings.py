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

"""What a reader should know before trusting a calibration: what its views cover, and what their residuals show."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array, Indices, mad_sigma, quantile
from semcal_ros.core.calibration.estimator.thresholds import FLAT_RAD, HUBER_SIGMAS, NAMED_MAX
from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.judgement.evaluate import rms_by_magnification
from semcal_ros.core.calibration.judgement.thresholds import (
    CELL_CORNERS_MIN,
    COVERAGE_CELLS,
    EMPTY_PART,
    FILLED_PART,
    HELD_OUT_RATIO,
    NEXT_SIGMA,
    PATTERN_PX,
    PATTERN_RATIO,
    REJECTED_PART,
    VIEW_PART,
    VIEW_PART_SIGMAS,
    VIEW_RATIO,
)
from semcal_ros.core.calibration.method_fit import Finding, rank_findings
from semcal_ros.core.calibration.views import FoundView, RejectedView, show_lines
from semcal_ros.core.camera.uncertainty import make_field_lattice, predict_shape_sigma_px
from semcal_ros.core.corners import LatticeDetection
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.robust_losses import huber_weight
from semcal_ros.core.wording import counted


@dataclass(frozen=True)
class ViewCoverage:
    """What views cover.

    Attributes
    ----------
    field_share
        Share of the cells of the field that have a corner in at least one view; 0 without views.
    tilts_deg
        Tilt of the grid in each view: what the stage says, else as :func:`estimate_tilt_deg`.
    views
        Number of views at each magnification, in ascending order.
    """

    field_share: float
    tilts_deg: tuple[float, ...]
    views: dict[float, int]


def estimate_tilt_deg(detection: LatticeDetection) -> float:
    """Estimate the tilt of a square grid from how much shorter it is in one direction, degrees.

    An aspect of the pixels of 1 % looks like 8 degrees, so this tells large tilts from small ones only.
    """
    ij = detection.ij - detection.ij.mean(axis=0)
    map_from_lattice = np.linalg.lstsq(
        ij.astype(np.float64), detection.xy - detection.xy.mean(axis=0), rcond=None
    )[0]
    longer, shorter = np.linalg.svd(map_from_lattice, compute_uv=False)
    return math.degrees(math.acos(min(float(shorter / longer), 1.0)))


def _filled(detection: LatticeDetection, rows: int) -> Array:
    width, height = detection.image_size
    cells = np.floor((detection.xy + 0.5) / np.array([width / COVERAGE_CELLS, height / rows]))
    column, row = np.clip(cells.astype(np.intp), 0, [COVERAGE_CELLS - 1, rows - 1]).T
    filled = np.zeros((rows, COVERAGE_CELLS), dtype=np.float64)
    filled[row, column] = 1.0
    return filled


def measure_view_coverage(views: Sequence[FoundView]) -> ViewCoverage:
    """Measure what views of one microscope cover.

    Parameters
    ----------
    views
        Of any magnifications. Their images should have one shape; where they have not, the shape of the first counts.
    """
    if not views:
        return ViewCoverage(0.0, (), {})
    width, height = views[0].detection.image_size
    rows = max(1, round(COVERAGE_CELLS * height / width))
    filled = np.max([_filled(view.detection, rows) for view in views], axis=0)
    tilts = []
    for view in views:
        told = None if view.stage is None else view.stage.tilt_rad
        tilts.append(estimate_tilt_deg(view.detection) if told is None else math.degrees(told))
    counts = Counter(float(view.magnification) for view in views)
    return ViewCoverage(float(np.mean(filled)), tuple(tilts), dict(sorted(counts.items())))


@dataclass(frozen=True)
class Cells:
    """A lattice of nearly square cells over the field, and the cell of every corner."""

    columns: int
    rows: int
    index: Indices
    centres: Array

    @property
    def counts(self) -> Indices:
        """(columns * rows,) number of corners in each cell."""
        return np.bincount(self.index, minlength=self.columns * self.rows)


def compute_empty_share(result: CalibrationResult, across: int = 12) -> float:
    """Compute the share of cells without a corner, with ``across`` cells across the field."""
    counts = assign_cells(result, np.concatenate([v.image_xy for v in result.views]), across).counts
    return float(np.mean(counts == 0))


def assign_cells(result: CalibrationResult, xy: Array, across: int) -> Cells:
    """Divide the field, ``across`` cells wide, and assign each pixel ``xy`` to a cell."""
    width, height = result.model.image_size
    rows = max(1, round(across * height / width))
    size = np.array([width / across, height / rows])
    ij = np.floor((xy + 0.5) / size).astype(np.intp)
    ij = np.clip(ij, 0, [across - 1, rows - 1])
    j, i = np.mgrid[0:rows, 0:across]
    centres = (np.stack([i.ravel(), j.ravel()], axis=1) + 0.5) * size - 0.5
    return Cells(across, rows, ij[:, 1] * across + ij[:, 0], centres)


def compute_reached_shares(result: CalibrationResult, across: int = 6) -> dict[float, float]:
    """Compute, for each magnification, the share of cells, ``across`` in a row, with a corner."""
    xy: dict[float, list[Array]] = {}
    for view in result.views:
        xy.setdefault(float(view.magnification), []).append(view.image_xy)
    return {
        g: float(np.mean(assign_cells(result, np.concatenate(own), across).counts > 0))
        for g, own in sorted(xy.items())
    }


def concatenate_corners(result: CalibrationResult) -> tuple[Array, Array]:
    """Concatenate all corners (n, 2) and their residuals (n, 2), px."""
    return (
        np.concatenate([v.image_xy for v in result.views]),
        np.concatenate(result.fit.residuals_px),
    )


def compute_tilts_deg(result: CalibrationResult) -> tuple[Array, Array]:
    """Compute the tilt of the grid in each view, and the direction of its normal, degrees."""
    normals = result.fit.rotations[:, :, 2]
    upright = normals * np.where(normals[:, 2:] < 0.0, -1.0, 1.0)
    tilt = np.degrees(np.arccos(np.clip(upright[:, 2], -1.0, 1.0)))
    return tilt, np.degrees(np.arctan2(upright[:, 1], upright[:, 0]))


def normalise_residuals(result: CalibrationResult) -> Array:
    """Divide residuals (n, 2), or (n, 1) across the lines of a grating, by the 1-sigma of their corners."""
    own = zip(result.views, result.fit.residuals_px, strict=True)
    return np.concatenate([v.known_residuals(r) / v.sigma_px[:, None] for v, r in own])


def estimate_pattern_px(result: CalibrationResult) -> tuple[float, float]:
    """Estimate the size in px of a pattern in the residuals, and its ratio to chance.

    The ratio compares the squares of the cells' weighted mean residuals with what independent
    corners of the same spread would give; 1 is pure chance. Single corners that are far off count as
    little as in the adjustment (Huber).
    """
    xy, residuals = concatenate_corners(result)
    weights = np.concatenate([v.sigma_px for v in result.views]) ** -2.0
    normalised = normalise_residuals(result)
    spread = mad_sigma(normalised)
    norm = np.linalg.norm(normalised, axis=1) / max(spread, 1e-30)
    weights = weights * huber_weight(norm, HUBER_SIGMAS)
    cells = assign_cells(result, xy, COVERAGE_CELLS)
    size = cells.columns * cells.rows
    enough = cells.counts >= CELL_CORNERS_MIN
    if not np.any(enough):
        return 0.0, 1.0
    total = np.bincount(cells.index, weights, size)[enough]
    sums = np.stack(
        [np.bincount(cells.index, weights * residuals[:, k], size)[enough] for k in (0, 1)], axis=1
    )
    chance = spread**2 / total
    squares = np.sum((sums / total[:, None]) ** 2, axis=1)
    expected = result.views[0].dimensions * chance
    excess = float(np.mean(squares - expected))
    if not np.all(chance > 0.0):
        return 0.0, 1.0
    return float(np.sqrt(max(excess, 0.0))), float(np.mean(squares / expected))


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
    more = len(items) - NAMED_MAX
    return ", ".join(items[:NAMED_MAX]) + (f" and {more} more" if more > 0 else "")


def _check_views(result: CalibrationResult, rejected: Sequence[RejectedView]) -> list[Finding]:
    found = []
    total = len(rejected) + len(result.views)
    if len(rejected) > REJECTED_PART * total:
        reason, count = Counter(r.reason for r in rejected).most_common(1)[0]
        found.append(
            Finding(
                f"{len(rejected)} of {counted(total, 'view')} were rejected, {count} of them for this reason: "
                f"{reason}"
            )
        )
    bad = []
    for view, residuals in zip(result.views, result.fit.residuals_px, strict=True):
        own = np.abs(view.known_residuals(residuals) / view.sigma_px[:, None])
        # Single corners that are far off do no harm.
        ratio = quantile(own, VIEW_PART) / VIEW_PART_SIGMAS
        if ratio > VIEW_RATIO:
            bad.append((ratio, ratio * view.expected_rms_px, view))
    if bad:
        bad.sort(key=lambda item: -item[0])
        _, worst_px, worst = max(bad, key=lambda item: item[1])
        names = _join_names([f"{view.name} ({view.magnification:g}x)" for _, _, view in bad])
        found.append(
            Finding(
                f"the corners of {names} fit more than {VIEW_RATIO:g} times worse than their own uncertainty: "
                "look at these images, and leave them out if something is wrong",
                worst_px,
                magnification=float(worst.magnification),
            )
        )
    return found


def _check_field(result: CalibrationResult) -> list[Finding]:
    found = []
    empty = compute_empty_share(result)
    if empty > EMPTY_PART:
        found.append(
            Finding(
                f"{100.0 * empty:.0f} % of the image field has no corner in any view: "
                "the distortion there is extrapolated; let the grid fill the image"
            )
        )
    shares = compute_reached_shares(result)
    poor = [f"{g:g}x" for g, share in shares.items() if share < FILLED_PART]
    # If all of them are poor, the sentence above says so, or the grid is very coarse.
    if 0 < len(poor) < len(shares):
        found.append(
            Finding(
                f"at {_join_names(poor)} the corners reach less than half of the image field: the "
                "distortion there comes from other magnifications; let the grid fill the image"
            )
        )
    largest = float(np.max(compute_tilts_deg(result)[0]))
    if largest < math.degrees(FLAT_RAD) and not show_lines(result.views):
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
    worse = [g for g in inner if values[g] > HELD_OUT_RATIO * fitted[g]]
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
    if ratio > PATTERN_RATIO and size > PATTERN_PX:
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
    if worst[g] > NEXT_SIGMA * model.image_size[0]:
        return [
            Finding(
                f"around {float(f'{g:.2g}'):.10g}x positions at the edge of the image are uncertain "
                f"by {worst[g]:.1f} px relative to its centre: take more images there, "
                f"{'turned' if show_lines(result.views) else 'tilted'} in different directions",
                worst[g],
                magnification=g,
            )
        ]
    return []
