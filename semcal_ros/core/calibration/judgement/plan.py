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

"""What a calibration is good for, and which views to record next so that nm per pixel becomes more certain.

Each candidate is a visit of a magnification with three views of the grid, of which two are tilted; of a grating, with
three directions of its lines. What it would tell about the camera is its Fisher information, with poses, repeatability,
height and drift eliminated. The visits are chosen one after the other, each the one that lowers the largest 1-sigma of
nm per pixel over the range the most: greedy experimental design (Fedorov, Theory of Optimal Experiments, 1972, for the
G-criterion).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, check_positive
from semcal_ros.core.calibration.estimator.blocks import Effects, State, make_problem
from semcal_ros.core.calibration.estimator.bundle_adjustment import refine
from semcal_ros.core.calibration.estimator.problem import Priors
from semcal_ros.core.calibration.estimator.thresholds import HELD_SIGMA, REFERENCE_WIDTH_PX
from semcal_ros.core.calibration.judgement.revision import record_of
from semcal_ros.core.calibration.judgement.thresholds import (
    CANDIDATES,
    JUDGED,
    PLANNED_ACROSS_MAX,
    PLANNED_DIRECTIONS_RAD,
    PLANNED_ROTATIONS_RAD,
    PLANNED_SIGMA_PX,
    PLANNED_TILTS_RAD,
    PLANNED_VISITS_MAX,
    SQUARES_ACROSS_MIN,
    VISIT_WORTH,
)
from semcal_ros.core.calibration.judgement.update import ageing_sigmas, change_directions
from semcal_ros.core.calibration.stage import StageAxis, attitudes
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import (
    CalibrationModel,
    design_matrix,
    pixel_size_gradient,
)
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.uncertainty import worst_pixel_size
from semcal_ros.core.errors import InvalidValueError, SemcalError
from semcal_ros.core.wording import format_length, rounded_magnification


@dataclass(frozen=True)
class PlannedVisit:
    """A visit to make.

    Attributes
    ----------
    magnification
        The magnification to set.
    square_m
        Side of the squares to look at, or pitch of the grating.
    largest, at
        Largest relative 1-sigma of nm per pixel in the range after it, and the magnification where that is.
    """

    magnification: float
    square_m: float
    largest: float
    at: float


@dataclass(frozen=True)
class ViewPlan:
    """Visits that make nm per pixel more certain.

    Attributes
    ----------
    visits
        The visits, in the order of their use; empty if the target is met.
    largest, at
        Largest relative 1-sigma of nm per pixel in the range now, and the magnification where that is.
    floor
        What no number of views goes below at any magnification: repeatability, squares, height.
    reached
        Whether the target is met at the end.
    is_grating
        Whether the visits are those of a grating, untilted, its lines in :data:`PLANNED_DIRECTIONS_RAD`; else of a
        grid, tilted by :data:`PLANNED_TILTS_RAD`.
    """

    visits: tuple[PlannedVisit, ...]
    largest: float
    at: float
    floor: float
    reached: bool
    is_grating: bool = False


def plan_views(
    model: CalibrationModel,
    target: float,
    *,
    squares_m: Sequence[float],
    most_visits: int = 10,
    single_setting: bool = True,
    ageing: float = 0.0,
) -> ViewPlan:
    """Choose visits until the relative 1-sigma of nm per pixel is below a target in the whole calibrated range.

    Parameters
    ----------
    model
        The calibration.
    target
        Relative 1-sigma to reach.
    squares_m
        Sides of the squares that the grid has.
    most_visits
        End after so many, with the target met or not.
    single_setting
        Whether the sigmas are those of a user who sets the magnification once, with the part that no view lowers
        (:attr:`ViewPlan.floor`); otherwise those of the calibration itself, which views can make as small as wanted.
    ageing
        1-sigma of a relative change of the scale until the views are recorded, as that of
        :func:`~semcal_ros.core.calibration.judgement.update.update_calibration`; 0 for views of the same session.

    Raises
    ------
    InvalidValueError
        If a number is out of range, or there are no squares.
    """
    check_positive(target, "target =")
    if not 1 <= most_visits <= PLANNED_VISITS_MAX:
        raise InvalidValueError(f"{most_visits} visits", expected=f"1 to {PLANNED_VISITS_MAX}")
    if not squares_m or min(squares_m) <= 0.0:
        raise InvalidValueError(f"squares of {list(squares_m)} m", expected="positive sizes")
    low, high = model.magnification_range
    judged = np.geomspace(low, high, JUDGED) if high > low else np.array([low])
    if model.ladder is not None:
        # Beyond, the grid shows nothing.
        low, high = model.ladder.anchored
    candidates = np.geomspace(low, high, CANDIDATES) if high > low else np.array([low])
    root = np.concatenate([model.principal_components, _aged(model, ageing)], axis=1)
    rows = np.stack([pixel_size_gradient(model, float(g)) @ root for g in judged])  # (G, 2, K)
    floor = np.array(
        [
            np.hypot(
                model.scale_sigma.relative(model.at(float(g)).rho), model.ladder_sigma(float(g))
            )
            for g in judged
        ]
    )
    fixed = floor if single_setting else np.zeros_like(floor)
    designs = [_design(model, float(g)) @ root for g in candidates]
    seen = [_square_for(model.at(float(g)), squares_m) for g in candidates]
    information = [
        _visit_information(model, float(g), square)
        for g, square in zip(candidates, seen, strict=True)
    ]
    if all(i is None for i in information):
        raise InvalidValueError(
            f"squares of {', '.join(format_length(s) for s in squares_m)}, of which no magnification shows corners",
            expected="squares of which several fit into the field of view",
            do="name the squares that the grid has",
        )
    gains = [
        np.zeros((root.shape[1],) * 2) if i is None else d.T @ i @ d
        for d, i in zip(designs, information, strict=True)
    ]
    precision = np.eye(root.shape[1])

    def judge(matrix: Array) -> tuple[float, int]:
        inverse = np.linalg.inv(matrix)
        own = np.max(np.einsum("gak,kl,gal->ga", rows, inverse, rows), axis=1)
        total = np.sqrt(own + fixed**2)
        worst = int(np.argmax(total))
        return float(total[worst]), worst

    present = precision.copy()
    # Until views are used, the calibration is taken as it was when it was made.
    size = len(root)
    present[size:, size:] *= 1e12
    largest, worst = judge(present)
    start = worst_pixel_size(model) if single_setting else (largest, float(judged[worst]))
    visits: list[PlannedVisit] = []
    while largest > target and len(visits) < most_visits:
        scores = [_mean_variance(precision + gain, rows, fixed) for gain in gains]
        best = int(np.argmin(scores))
        precision = precision + gains[best]
        largest, worst = judge(precision)
        visits.append(
            PlannedVisit(float(candidates[best]), seen[best], largest, float(judged[worst]))
        )
    return ViewPlan(
        tuple(visits), *start, float(floor.max()), largest <= target, _is_of_grating(model)
    )


def _is_of_grating(model: CalibrationModel) -> bool:
    return model.record is not None and model.record.is_grating


def _mean_variance(precision: Array, rows: Array, fixed: Array) -> float:
    """A smooth form of the largest variance: its eighth-power mean, so that ties have an order."""
    own = np.max(np.einsum("gak,kl,gal->ga", rows, np.linalg.inv(precision), rows), axis=1)
    return float(np.mean((own + fixed**2) ** 8) ** 0.125)


def _aged(model: CalibrationModel, ageing: float) -> Array:
    """(K, P) what may have changed since the calibration, one sigma of each; nothing without ageing."""
    changes = change_directions(model, model.image_width)
    if ageing == 0.0:
        return changes[:, :0]
    return changes * list(ageing_sigmas(model, ageing, model.image_width).values())


def _design(model: CalibrationModel, g: float) -> Array:
    return design_matrix(model.functions, g, model.nominal_px_per_m(g))


def _square_for(camera: ScanCamera, squares_m: Sequence[float]) -> float:
    """The largest squares of which enough fit the image, else the smallest."""
    field = camera.width * camera.pixel_size_m[0]
    fitting = [size for size in squares_m if field / size >= SQUARES_ACROSS_MIN]
    return max(fitting) if fitting else min(squares_m)


def _visit_information(model: CalibrationModel, g: float, square_m: float) -> Array | None:
    """(P, P) information of a visit on the camera, all that is not the camera eliminated; None where no view shows
    enough corners.
    """
    camera = replace(model.at(g), residual=None)
    usual = Priors()
    heights = record_of(model, usual)
    views, rotations = [], []
    field = camera.width * camera.pixel_size_m[0]
    count = min(int(1.5 * field / square_m) + 2, 2 * PLANNED_ACROSS_MAX)
    # More corners than these tell no more than a finer spacing of as many would.
    step = square_m * max(1, math.ceil(1.5 * field / square_m / (2 * PLANNED_ACROSS_MAX)))
    index = (np.arange(count) - 0.5 * (count - 1)) * step
    board = np.stack(np.meshgrid(index, index), axis=-1).reshape(-1, 2)
    of_lines = _is_of_grating(model)
    tilts = (0.0,) * len(PLANNED_DIRECTIONS_RAD) if of_lines else PLANNED_TILTS_RAD
    turns = PLANNED_DIRECTIONS_RAD if of_lines else PLANNED_ROTATIONS_RAD
    for tilt, turn in zip(tilts, turns, strict=True):
        rotation = _tilt(tilt) @ _turn(turn)
        points = np.column_stack([board, np.zeros(len(board))]) @ rotation.T
        xy = camera.project(points)
        inside = np.all((xy >= 0.0) & (xy <= (camera.width - 1.0, camera.height - 1.0)), axis=1)
        sigmas = np.full(int(inside.sum()), PLANNED_SIGMA_PX)
        if np.sum(inside) < 4:
            # Fewer tell no pose.
            continue
        view = GridView(g, board[inside], xy[inside], sigmas, square_m=square_m)
        if of_lines:
            along = camera.project(points + step * rotation[:, 1]) - xy
            view = _as_lines(view, along[inside], unknown_px=camera.width)
        views.append(view)
        rotations.append(rotation)
    if not views:
        return None
    problem = make_problem(
        views,
        np.array([g]),
        camera.parameters[None, :, None],
        parameters=camera.names,
        raster=camera.raster,
        nominal_px_per_m=np.array([camera.m]),
        prior_mean=np.ones(1),
        prior_sigma=np.full(1, HELD_SIGMA),
        height_sigma_m=heights.height_sigma_m,
    )
    y = np.concatenate([v.image_xy[:, 1] for v in views])
    effects = Effects(
        np.zeros(len(views), dtype=np.intp),
        np.zeros(1, dtype=np.intp),
        max(model.scale_sigma.repeatability, 1e-6),
        heights.visit_height_sigma_m or usual.visit_height_sigma_m,
        np.full(len(views), usual.drift_sigma_px * camera.width / REFERENCE_WIDTH_PX),
        y / camera.height - 0.5,
    )
    state = State(np.ones(1), np.stack(rotations), np.zeros((len(views), 3)))
    problem = replace(problem, effects=effects)
    if of_lines:
        flat = [True] * len(views)
        known = attitudes([None] * len(views), flat, StageAxis(), usual.untilted_sigma_rad)
        problem = replace(problem, attitudes=known)
    return refine(problem, state, max_iterations=0).information[0]


def _as_lines(view: GridView, along: Array, unknown_px: float) -> GridView:
    """The view of points of which only the position across lines is known, which run along ``along`` (n, 2), px."""
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    across = np.stack([along[:, 1], -along[:, 0]], axis=1)
    own = view.sigma_px[:, None, None] ** 2 * across[:, :, None] * across[:, None, :]
    spread = own + unknown_px**2 * along[:, :, None] * along[:, None, :]
    return replace(view, covariance_px2=spread, untilted=True, across=across)


def _tilt(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _turn(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Judgement:
    """How well a calibration knows nm per pixel.

    Attributes
    ----------
    low, high
        The calibrated range of magnifications.
    largest, at
        Largest relative 1-sigma of nm per pixel in the range, and the magnification where that is.
    pixel_size_m
        Pixel size there, the mean of both axes, m.
    floor
        The part of ``largest`` that no number of views removes: repeatability, squares, height; NaN if unknown.
    next_visit
        The visit that lowers it most; None where none is worth it, or the grid is not known.
    conditions
        What it holds for: voltage, working distance and date.
    is_grating
        Whether the views are those of a grating.
    """

    low: float
    high: float
    largest: float
    at: float
    pixel_size_m: float
    floor: float
    next_visit: PlannedVisit | None
    conditions: str = ""
    is_grating: bool = False

    @property
    def pixel_sigma_m(self) -> float:
        """1-sigma of the pixel size there, m."""
        return self.largest * self.pixel_size_m

    def describe(self) -> str:
        """Return how well nm per pixel is known, over which range, and under which conditions."""
        # Pixels of photographs of a board are some tenths of a mm.
        factor, unit = (1e9, "nm") if self.pixel_size_m < 1e-4 else (1e6, "um")
        sigma, size = factor * self.pixel_sigma_m, factor * self.pixel_size_m
        digits = 2
        if 0.0 < sigma < math.inf:
            digits = min(max(1 - math.floor(math.log10(sigma)), 0), 6)
        span = (
            f"from {self.low:g}x to {self.high:g}x" if self.high > self.low else f"at {self.low:g}x"
        )
        best = f"{100.0 * self.largest:.2g} % (1-sigma)" + (
            " or better" if self.high > self.low else ""
        )
        where = f", least well at {rounded_magnification(self.at)}" if self.high > self.low else ""
        known = f"{size:.{digits}f} +- {sigma:.{digits}f} {unit}"
        under = f" ({self.conditions})" if self.conditions else ""
        return f"nm per px is known to {best} {span}{where}: {known}{under}"

    def advise(self) -> str:
        """Return what to record next; empty if that is not known."""
        visit = self.next_visit
        if visit is not None:
            angles = PLANNED_DIRECTIONS_RAD if self.is_grating else PLANNED_TILTS_RAD[1:]
            *first, last = [f"{math.degrees(angle):.0f}" for angle in angles]
            degrees = f"{', '.join(first)} and {last} degrees"
            size, where = 1e6 * visit.square_m, rounded_magnification(visit.magnification)
            percent = 100.0 * visit.largest
            if self.is_grating:
                return (
                    f"to improve it most: views of the {size:g} um lines at {where}, untilted, turned to {degrees}, "
                    f"bring it to {percent:.2g} % (see semcal plan)"
                )
            return (
                f"to improve it most: views of the {size:g} um squares at {where}, flat and tilted by {degrees}, "
                f"bring it to {percent:.2g} % (see semcal plan)"
            )
        if not math.isfinite(self.floor):
            return ""
        return (
            "more views would hardly improve it: the repeatability of the magnification, the squares and the height "
            f"alone make {100.0 * self.floor:.2g} % (semcal at --budget lists them)"
        )


def judge_calibration(model: CalibrationModel) -> Judgement:
    """Judge how well a calibration knows nm per pixel, and what would improve that most."""
    largest, at = worst_pixel_size(model)
    low, high = model.magnification_range
    size_m = float(np.mean(model.at(at).pixel_size_m))
    squares = () if model.record is None else model.record.squares_m
    floor, visit = math.nan, None
    if squares and math.isfinite(largest) and largest > 0.0:
        try:
            plan = plan_views(model, 1e-9, squares_m=squares, most_visits=1)
        except (SemcalError, ArithmeticError, np.linalg.LinAlgError):
            pass  # a calibration that was edited can be anything; the sentence is then left out
        else:
            floor = plan.floor
            first = plan.visits[0] if plan.visits else None
            if first is not None and first.largest < (1.0 - VISIT_WORTH) * largest:
                visit = first
    conditions = model.provenance.describe_essentials()
    return Judgement(
        float(low),
        float(high),
        largest,
        at,
        size_m,
        floor,
        visit,
        conditions,
        _is_of_grating(model),
    )
