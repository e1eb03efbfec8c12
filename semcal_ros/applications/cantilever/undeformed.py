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

"""The beam at rest: its axis, its edges, and the positions of its base and its free end."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.applications.cantilever.edges import (
    EdgeFit,
    EdgeModel,
    StepFit,
    choose_width,
    fit_edges,
    fit_step,
)
from semcal_ros.applications.cantilever.plane import Axis
from semcal_ros.applications.cantilever.thresholds import (
    BLOCK_PX,
    BLOCKS_MIN,
    BLOCKS_PART_MIN,
    EDGE_FIRST_PX,
    END_SEARCH_PX,
    HOLDER_FROM_PX,
    HOLDER_STEPS,
    HOLDER_TO_PX,
    REACH_MAX,
    REACH_PX,
    ROUGH_APEX_PX,
)
from semcal_ros.applications.cantilever.tip import fit_tip
from semcal_ros.core.arrays import Array, mad_sigma
from semcal_ros.core.errors import InvalidValueError

#: Coordinates along and across the axis, m, and grey levels, (n,) each.
PixelSamples = tuple[Array, Array, Array]


@dataclass(frozen=True)
class UndeformedBeam:
    """The beam at rest.

    Attributes
    ----------
    axis
        Axis of the beam, with arc lengths measured from the base.
    model
        Blocks along the axis and the width of the edges.
    across_m, sigma_m, step
        (blocks, 2) edges: position across the axis, 1-sigma, and grey levels by which the beam is
        brighter.
    length_m, length_sigma_m
        Length in calibrated metres and its 1-sigma; NaN if base and end are not both in view.
    zero_sigma_m
        1-sigma of the place from which arc lengths are counted.
    notes
        Remarks for the user.
    """

    axis: Axis
    model: EdgeModel
    across_m: Array
    sigma_m: Array
    step: Array
    length_m: float
    length_sigma_m: float
    zero_sigma_m: float
    notes: tuple[str, ...]


def measure_undeformed_beam(
    rough: Axis, views: list[PixelSamples], length_m: float, px_m: float
) -> UndeformedBeam:
    """Measure the beam in the reference frames.

    Parameters
    ----------
    rough
        Axis of the beam, good to a few px.
    views
        Pixels of the reference frames in the coordinates of the rough axis.
    length_m
        Length of the beam.
    px_m
        Size of a pixel.

    Raises
    ------
    InvalidValueError
        If neither end of the beam is in view, or too little of its edges.
    """
    axis, width_m = _align_axis(rough, views, px_m)
    moved = [_change_axis(view, rough, axis) for view in views]
    ends, notes = _locate_ends(axis, moved, width_m, length_m, px_m)
    counted = ends.axis
    final = [_change_axis(view, axis, counted) for view in moved]
    model = _place_blocks(counted, width_m, px_m, ends.flank_m)
    fits = [fit_edges(*view, model, _predict_straight_edges(model)) for view in final]
    across, sigma, step = average_edges(fits)
    found = np.isfinite(sigma).all(axis=1)
    if int(found.sum()) < max(BLOCKS_MIN, BLOCKS_PART_MIN * found.size):
        raise InvalidValueError(
            f"no beam where one was looked for: both edges are seen in {int(found.sum())} of {found.size} places",
            expected="a strip with two parallel edges from base to tip",
            do="check --base and --tip, the first frame, focus and contrast",
        )
    return UndeformedBeam(
        counted,
        model,
        across,
        sigma,
        step,
        ends.length_m,
        ends.length_sigma_m,
        ends.zero_sigma_m,
        tuple(notes),
    )


def average_edges(fits: list[EdgeFit]) -> tuple[Array, Array, Array]:
    """Average the edges of several frames: positions, 1-sigma and steps, (blocks, 2) each."""
    weight = np.stack([1.0 / fit.sigma_m**2 for fit in fits])
    total = weight.sum(axis=0)
    known = total > 0.0
    share = np.where(known, weight / np.where(known, total, 1.0), 1.0 / len(fits))
    across = np.sum(share * np.stack([fit.across_m for fit in fits]), axis=0)
    step = np.sum(share * np.stack([fit.step for fit in fits]), axis=0)
    sigma = np.where(known, 1.0 / np.sqrt(np.where(known, total, 1.0)), np.inf)
    return across, sigma, step


def _predict_straight_edges(model: EdgeModel) -> Array:
    """Return the (blocks, 2) edges of a straight beam."""
    return np.asarray(np.ones((model.blocks, 1)) * np.array([-1.0, 1.0]) * model.half_width_m)


def _place_blocks(axis: Axis, width_m: float, px_m: float, flank_m: float = 0.0) -> EdgeModel:
    # Where the beam narrows towards its tip, its edges are not parallel to the axis.
    first, last = axis.visible_m[0], axis.visible_m[1] - flank_m
    # Blocks keep clear of the ends of the beam, which are edges themselves.
    inset = REACH_PX * px_m
    count = max(int((last - first - 2.0 * inset) / (BLOCK_PX * px_m)), 1)
    size = (last - first - 2.0 * inset) / count
    reach = min(REACH_PX * px_m, REACH_MAX * axis.half_width_m)
    return EdgeModel(width_m, reach, first + inset, size, count, axis.half_width_m)


def _change_axis(view: PixelSamples, before: Axis, now: Axis) -> PixelSamples:
    """Convert a view to the coordinates of another axis."""
    points = before.point(view[0], view[1])
    return (*now.coordinates(points[:, 0], points[:, 1]), view[2])


def _align_axis(rough: Axis, views: list[PixelSamples], px_m: float) -> tuple[Axis, float]:
    """Fit the axis midway between both edges, and the width of the edges."""
    axis, width_m = rough, EDGE_FIRST_PX * px_m
    for iteration in range(4):
        model = _place_blocks(axis, width_m, px_m)
        moved = [_change_axis(view, rough, axis) for view in views]
        if iteration == 2:
            width_m = choose_width(*moved[0], model, _predict_straight_edges(model), px_m)
            model = replace(model, width_m=width_m)
        across, sigma, _ = average_edges(
            [fit_edges(*v, model, _predict_straight_edges(model)) for v in moved]
        )
        axis = _refine_axis(axis, model, across, sigma)
    return axis, width_m


def _refine_axis(axis: Axis, model: EdgeModel, across: Array, sigma: Array) -> Axis:
    good = np.isfinite(sigma).all(axis=1)
    if int(good.sum()) < 3:
        return axis
    middle, half = across.mean(axis=1)[good], 0.5 * (across[:, 1] - across[:, 0])[good]
    # A body that lies on an edge must not turn the axis.
    deviation = half - np.median(half)
    usual = np.abs(deviation) < 4.0 * max(mad_sigma(deviation), 1e-12)
    along = model.centres_m[good][usual]
    if len(along) < 3:
        return axis
    slope, offset = np.polyfit(along, middle[usual], 1)
    turned = axis.direction + slope * axis.normal
    return replace(
        axis,
        origin_m=axis.origin_m + offset * axis.normal,
        direction=turned / float(np.hypot(*turned)),
        half_width_m=float(np.median(half)),
    )


# -- the ends -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Ends:
    """Both ends: the axis with arc lengths from the base, lengths with 1-sigma, and where the tip begins."""

    axis: Axis
    length_m: float
    length_sigma_m: float
    zero_sigma_m: float
    flank_m: float


def _locate_ends(
    axis: Axis, views: list[PixelSamples], width_m: float, length_m: float, px_m: float
) -> tuple[_Ends, list[str]]:
    """Locate both ends; also notes."""
    notes: list[str] = []
    model = _place_blocks(axis, width_m, px_m)
    first, last = axis.visible_m
    start_m, start_sigma_m, stop_m, stop_sigma_m, flank_m = first, np.inf, last, np.inf, 0.0
    if axis.base_seen:
        base = _average_steps([fit_base_edge(v, first, model, px_m) for v in views])
        start_m, start_sigma_m = first - base.place_m, base.sigma_m
        if not np.isfinite(start_m):
            notes.append("the edge of the holder is not seen: the base is where the beam fades")
            start_m, start_sigma_m = first, model.half_width_m
    if axis.end_seen:
        joined = tuple(np.concatenate([v[k] for v in views]) for k in range(3))
        tip = fit_tip((joined[0], joined[1], joined[2]), last, model, px_m)
        if tip is None:
            notes.append(
                "the outline of the free end is not seen: it is where the middle of the beam fades"
            )
            stop_sigma_m = ROUGH_APEX_PX * px_m
        else:
            stop_m, stop_sigma_m, flank_m = tip.apex_m, tip.sigma_m, tip.flank_m
    both = axis.base_seen and axis.end_seen
    seen_m = stop_m - start_m if both else float("nan")
    sigma_m = float(np.hypot(start_sigma_m, stop_sigma_m)) if both else float("nan")
    if axis.base_seen:
        zero, zero_sigma_m = start_m, start_sigma_m
    elif axis.end_seen:
        zero, zero_sigma_m = stop_m - length_m, stop_sigma_m
        notes.append("the base is out of view: arc lengths are counted back from the free end")
    else:
        raise InvalidValueError(
            "a cantilever without an end in view", expected="its base or its free end in view"
        )
    if not axis.end_seen:
        notes.append("the free end is out of view: its deflection is extrapolated")
    low, high = start_m if axis.base_seen else first, stop_m if axis.end_seen else last
    origin = axis.origin_m + zero * axis.direction
    counted = replace(axis, origin_m=origin, visible_m=(low - zero, high - zero))
    return _Ends(counted, seen_m, sigma_m, float(zero_sigma_m), flank_m), notes


def _average_steps(steps: list[StepFit]) -> StepFit:
    known = [s for s in steps if np.isfinite(s.sigma_m) and s.sigma_m > 0.0]
    if not known:
        return StepFit(float("nan"), float("inf"), 0.0)
    weight = np.array([1.0 / s.sigma_m**2 for s in known])
    place = float(np.sum(weight * np.array([s.place_m for s in known])) / weight.sum())
    return StepFit(place, float(1.0 / np.sqrt(weight.sum())), known[0].step)


def fit_base_edge(view: PixelSamples, at_m: float, model: EdgeModel, px_m: float) -> StepFit:
    """Fit the edge of the holder on both sides of the beam, at its centre line.

    The edge may be turned against the beam's normal: its two sides show by how much.

    Parameters
    ----------
    view
        Pixels in the coordinates of the axis.
    at_m
        Where the edge is expected, m.
    model
        Edges of the beam.
    px_m
        Size of a pixel, m.

    Returns
    -------
    The edge; its distance grows into the holder, from the expected place.
    """
    along, across, grey = view
    away = np.abs(across) - model.half_width_m
    of_holder = (away > HOLDER_FROM_PX * px_m) & (away < HOLDER_TO_PX * px_m)
    along, across, grey = along[of_holder], across[of_holder], grey[of_holder]
    rough_m = END_SEARCH_PX * px_m
    # From the middle of one side to that of the other.
    apart_m = 2.0 * model.half_width_m + (HOLDER_FROM_PX + HOLDER_TO_PX) * px_m
    slope, place_m, found = 0.0, 0.0, fit_step(at_m - along, grey, model, rough_m=rough_m)
    for iteration in range(HOLDER_STEPS):
        distance = at_m - along - slope * across - place_m
        # After the first iteration it is known where to look.
        left, right = (
            fit_step(distance[side], grey[side], model, rough_m=None if iteration else rough_m)
            for side in (across < 0.0, across > 0.0)
        )
        if not (np.isfinite(left.place_m) and np.isfinite(right.place_m)):
            return found
        slope += (right.place_m - left.place_m) / apart_m
        place_m += 0.5 * (left.place_m + right.place_m)
        step = fit_step(at_m - along - slope * across - place_m, grey, model)
        if not np.isfinite(step.place_m):
            return found
        found = replace(step, place_m=place_m + step.place_m)
    return found
