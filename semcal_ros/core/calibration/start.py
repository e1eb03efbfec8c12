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

"""From views and nominal values to a first state, coarse to fine.

Corners start as uncertain as a plane under a perspective leaves them: what they show besides is the distortion, which
the model does not have yet. Before that come the scale that the views show against the predicted one, the views that
show the specimen untilted, where no stage says so, and the axes of the lattices: a chess grid looks the same after a
quarter turn, so that the lattice of a view has one of four directions by chance. Where the stage says how far it
turned, all views are given the same axes, which what belongs to the grid (its stretch and shear) needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import MEDIAN_CHI2, Array, Mask
from semcal_ros.core.calibration.estimator.blocks import GRID_NAMES, MISS_NAMES, Problem, State
from semcal_ros.core.calibration.estimator.bundle_adjustment import (
    DECENTRING,
    SMOOTH,
    BundleResult,
    refit_functions,
)
from semcal_ros.core.calibration.estimator.poses import (
    adjust,
    initial_values,
    refine_coarsely,
    resolve_mirrored_tilts,
    right_way_up,
    thin_view,
)
from semcal_ros.core.calibration.estimator.problem import (
    Functions,
    Setup,
    VarianceComponents,
    build_problem,
    constant_functions,
    initial_components,
    stack_theta,
)
from semcal_ros.core.calibration.estimator.thresholds import COARSE_TOLERANCE
from semcal_ros.core.calibration.estimator.variance_components import update_components
from semcal_ros.core.calibration.stage import OFFSET_NAMES, Attitudes, attitudes, stage_rotations
from semcal_ros.core.calibration.thresholds import (
    DISPLAY_WIDTH_LIMITS_M,
    FIRST_UPDATES,
    SCALE_FACTOR_MAX,
    START_RHO_MAX,
    TILTED_RAD,
    TWICE_OCTAVES,
    UNTILTED_RAD,
)
from semcal_ros.core.calibration.views import GridView, add_excess_noise
from semcal_ros.core.camera.calibration_model import (
    FUNCTION_NAMES,
    stack_coefficients,
    with_coefficients,
)
from semcal_ros.core.camera.plane_geometry import fit_homography, view_affine
from semcal_ros.core.errors import CalibrationError, InvalidValueError, UnusableCalibrationError
from semcal_ros.core.wording import format_length


def observed_scale_factor(views: Sequence[GridView], nominal_px_per_m: Array) -> float:
    """Return the median ratio of observed to nominal scale, from the homographies of the views.

    Parameters
    ----------
    views
        V views.
    nominal_px_per_m
        (V,) scale that the nominal values predict for each.
    """
    affines = [view_affine(v.board_xy_m, v.image_xy, v.image_xy.mean(axis=0)) for v in views]
    return float(np.median(np.array([a.scale for a in affines]) / nominal_px_per_m))


def is_scale_far(factor: Array) -> Mask:
    """Return whether ratios of observed to nominal scale are too far from 1 for a calibration."""
    return (factor < 1.0 / SCALE_FACTOR_MAX) | (factor > SCALE_FACTOR_MAX)


def advise_scale(
    factor: float,
    *,
    display_width_m: float,
    squares_m: Sequence[float],
    pixel_size_m: float | None = None,
) -> str:
    """Return the options that make the nominal scale the observed one; see :func:`check_nominal_scale`."""
    width_m = display_width_m / factor
    ways = []
    if DISPLAY_WIDTH_LIMITS_M[0] <= width_m <= DISPLAY_WIDTH_LIMITS_M[1]:
        ways.append(f"--display-width {format_length(width_m)}")
    if pixel_size_m is not None:
        size = format_length(pixel_size_m / factor)
        ways.append(f"--pixel-size {size} in place of a magnification or another pixel size")
    fitting = ", or ".join(ways) or f"magnifications {factor:.4g} times as large"
    if not squares_m:
        return f"give {fitting} (display_width_m in a configuration)"
    sides = ",".join(format_length(factor * side) for side in sorted(set(squares_m), reverse=True))
    return (
        f"if the squares are right, give {fitting}; if the magnification is, give --squares {sides} "
        "(display_width_m and squares_m in a configuration)"
    )


def check_nominal_scale(
    factor: float,
    *,
    display_width_m: float,
    squares_m: Sequence[float],
    pixel_size_m: float | None = None,
) -> None:
    """Refuse views whose scale is far from that of their units.

    Parameters
    ----------
    factor
        Ratio of the observed to the nominal scale.
    display_width_m
        Display width to which the magnifications refer, m.
    squares_m
        Sides of the squares in view, m; empty where they are not known.
    pixel_size_m
        Nominal pixel size, where all views have the same, m.

    Raises
    ------
    UnusableCalibrationError
        If it is off by more than a factor of 3; the error says what would fit.
    """
    if not is_scale_far(np.array(factor)):
        return
    sides = " and ".join(format_length(side) for side in sorted(set(squares_m), reverse=True))
    raise UnusableCalibrationError(
        f"images that show {factor:.3g} times the scale that a display width of "
        f"{format_length(display_width_m)}"
        + (f" and squares of {sides}" if sides else "")
        + " predict",
        expected=f"a scale within a factor of {SCALE_FACTOR_MAX:g} of the predicted one",
        do=advise_scale(
            factor,
            display_width_m=display_width_m,
            squares_m=squares_m,
            pixel_size_m=pixel_size_m,
        ),
    )


def check_square_sides(factor: float, display_width_m: float) -> None:
    """Refuse a scale that results from confusing the side of a square with the period of the grid.

    Raises
    ------
    CalibrationError
        If the ratio of the observed to the nominal scale is about 2 or a half.
    """
    if abs(abs(np.log2(factor)) - 1.0) >= TWICE_OCTAVES:
        return
    width_m = display_width_m / factor
    raise CalibrationError(
        f"images that show {factor:.3g} times the scale that squares_m and the display width of "
        f"{display_width_m:g} m predict",
        expected="squares_m to hold the sides of single squares, not the period of the grid",
        do=f"correct squares_m (--squares), or if that is right, set display_width_m to {width_m:.4g} m "
        f"(--display-width {format_length(width_m)})",
    )


def align_lattices(setup: Setup) -> Setup:
    """Return the setup with lattices of the same axes, and with the start of the stage's rotation.

    Views of which the stage does not say the rotation stay as they are.
    """
    known = attitudes(
        [v.stage for v in setup.views],
        [False] * len(setup.views),
        setup.axis,
        setup.priors.untilted_sigma_rad,
    )
    turn = _turns(setup, known)
    told = np.isfinite(known.sigma_rad[:, 2])
    if not np.any(told):
        return setup
    # The mean of angles that are known up to quarter turns.
    offset = float(np.angle(np.mean(np.exp(4j * turn[told])))) / 4.0
    quarters = np.where(told, np.round((turn - offset) / (0.5 * np.pi)), 0.0).astype(int)
    views = tuple(_turned(v, int(k)) for v, k in zip(setup.views, quarters, strict=True))
    return replace(setup, views=views, stage_rotation_rad=offset)


def _turns(setup: Setup, known: Attitudes) -> Array:
    """Return the (V,) angles about the normal by which the views differ from the stage's."""
    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in setup.views]))
    start = initial_values(setup.views, nominal, setup.centre_px, setup.priors.rho_mean)
    expected, _ = stage_rotations(known, np.zeros(5))
    # The sign of the tilt is not known yet. What it changes about the turn is small.
    left = np.swapaxes(expected, 1, 2) @ start.rotations
    return np.arctan2(left[:, 1, 0] - left[:, 0, 1], left[:, 0, 0] + left[:, 1, 1])


def _turned(view: GridView, quarters: int) -> GridView:
    """Return the view with a grid that is turned by so many quarters, and its pose turned back."""
    c, s = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarters % 4]
    x, y = view.board_xy_m.T
    return replace(view, board_xy_m=np.stack([c * x - s * y, s * x + c * y], axis=1))


UNTILTED_MODES = ("auto", "all", "none")


def mark_untilted(setup: Setup, untilted: str | Sequence[str]) -> Setup:
    """Return the setup with views that are known not to be tilted.

    Parameters
    ----------
    untilted
        Names of such views, ``"all"``, ``"none"``, or ``"auto"``: the view with the least apparent tilt of
        each visit, if it looks untilted and every other view of the visit is clearly tilted.

    Raises
    ------
    InvalidValueError
        If there is no view of that name, or a mode is not known.
    """
    if isinstance(untilted, str):
        if untilted not in UNTILTED_MODES:
            raise InvalidValueError(
                f"untilted {untilted!r}",
                expected=f"{', '.join(UNTILTED_MODES)}, or a list of names of views",
            )
        if untilted == "none" or (
            untilted == "auto" and any(v.has_stage_tilt for v in setup.views)
        ):
            return setup
        chosen = set(range(len(setup.views))) if untilted == "all" else _apparently_untilted(setup)
    else:
        names = {view.name for view in setup.views}
        unknown = [name for name in untilted if name not in names]
        if unknown:
            raise InvalidValueError(
                f"untilted {', '.join(map(repr, unknown[:3]))}",
                expected="names of views that were used, such as " + ", ".join(sorted(names)[:3]),
            )
        chosen = {i for i, view in enumerate(setup.views) if view.name in set(untilted)}
    views = tuple(
        replace(view, untilted=True) if i in chosen else view for i, view in enumerate(setup.views)
    )
    return replace(setup, views=views)


def look_untilted(setup: Setup) -> bool:
    """Whether every view looks tilted by no more than an aspect ratio that is not 1 makes it look."""
    return bool(np.all(_apparent_tilts(setup) < TILTED_RAD))


def _apparent_tilts(setup: Setup) -> Array:
    """Return the (V,) tilts, rad, under a camera with square pixels and no distortion."""
    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in setup.views]))
    start = initial_values(setup.views, nominal, setup.centre_px, setup.priors.rho_mean)
    return np.arccos(np.clip(start.rotations[:, 2, 2], -1.0, 1.0))


def _apparently_untilted(setup: Setup) -> set[int]:
    tilt = _apparent_tilts(setup)
    visit, groups = setup.visits
    chosen = set()
    for own in (np.flatnonzero(visit == j) for j in range(len(groups))):
        least = own[np.argmin(tilt[own])]
        others = own[own != least]
        if len(others) and tilt[least] < UNTILTED_RAD and np.all(tilt[others] > TILTED_RAD):
            chosen.add(int(least))
    return chosen


def adapt_priors(setup: Setup) -> Setup:
    """Return the setup with priors of a strong perspective where the views have one.

    At one magnification it is a photograph: its priors are those of a lens of whose distance the order is known. With
    several it is a microscope with a field as wide as its pivot is far, whose grid, stage and scan are those of any.
    """
    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in setup.views]))
    start = initial_values(setup.views, nominal, setup.centre_px, setup.priors.rho_mean)
    if not start.wide:
        return setup
    if len(setup.magnifications) == 1:
        return replace(setup, priors=setup.priors.of_photographs(start.rho))
    return replace(setup, priors=replace(setup.priors, rho_mean=start.rho, rho_sigma=start.rho))


def add_shared_unknowns(setup: Setup) -> Setup:
    """Return the setup with the unknowns of the grid, of the tilt axis and of the stage.

    A photograph has none of them: its priors (see :func:`adapt_priors`) are those of a lens.
    """
    if setup.priors.is_wide:
        return setup
    squares = tuple(f"square_{k}" for k in range(1, len(setup.squares_m)))
    stage = OFFSET_NAMES if any(v.has_stage_tilt for v in setup.views) else ()
    return replace(setup, shared=(*GRID_NAMES, *squares, *MISS_NAMES, *stage))


def measure_misfit_px(setup: Setup) -> float:
    """Return by how much the worst view departs from a plane under a perspective, 1-sigma per axis in px, beyond the
    sigmas of its corners.

    Where every corner is believed to its own noise while lens and scan are not known yet, poses, pivot and grid take
    their place, and no prior counts. An adjustment therefore starts from corners that are as uncertain as that.
    """
    worst = 0.0
    for view in setup.views:
        ones = np.ones((len(view.board_xy_m), 1))
        seen = np.hstack([view.board_xy_m, ones]) @ fit_homography(view.board_xy_m, view.image_xy).T
        left = view.known_residuals(view.image_xy - seen[:, :2] / seen[:, 2:])
        median = float(np.median(np.sum(left**2, axis=1)))
        variance = median / MEDIAN_CHI2[view.dimensions] - float(np.median(view.sigma_px)) ** 2
        worst = max(worst, variance)
    return float(np.sqrt(worst))


def with_excess(setup: Setup, sigma_px: float) -> Setup:
    """Return the setup with corners that are more uncertain by ``sigma_px`` per axis."""
    if sigma_px == 0.0:
        return setup
    return replace(setup, views=add_excess_noise(setup.views, sigma_px))


def tempered(setup: Setup, sigma_px: float) -> Setup:
    """Return the setup with observations, of corners and of the stage, that are believed less by the same factor."""
    noisy = with_excess(setup, sigma_px)
    own = np.concatenate([view.own_variance_share for view in noisy.views])
    # Of corners that state next to no noise, rounding leaves no share at all.
    share = max(float(np.median(own)), float(np.finfo(np.float64).eps))
    return replace(noisy, tempering=share**-0.5)


def _fit_start(setup: Setup) -> tuple[Functions, State, VarianceComponents]:
    """Fit moderately flexible functions, poses and variance components from nominal values."""
    nominal = setup.nominal_px_per_m(np.array([v.magnification for v in setup.views]))
    start = initial_values(setup.views, nominal, setup.centre_px, setup.priors.rho_mean)
    rho = start.rho if start.wide else min(max(start.rho, 0.0), START_RHO_MAX)
    names = [name for name in FUNCTION_NAMES if name not in DECENTRING]
    values = {"scale": start.scale_factor, "rho": rho}
    constants = constant_functions(setup, values, names)
    spread = initial_components(setup)
    problem = build_problem(setup, constants, setup.views, spread)
    theta = np.concatenate([stack_coefficients(constants), setup.shared_start()])
    state = State(theta, start.rotations, start.translations_m)
    state, _ = resolve_mirrored_tilts(problem, state)

    fits = [_fit_decentred(setup, constants, state, spread, name) for name in DECENTRING]
    functions, problem, result = min(fits, key=lambda fit: fit[2].cost)
    for _ in range(FIRST_UPDATES):
        # Before anything is selected: too wide a prior of the heights would let them imitate the
        # scale.
        spread = update_components(setup, problem, result)
        problem = build_problem(setup, functions, setup.views, spread)
        result = refine_coarsely(problem, result.state)
    return with_coefficients(functions, result.state.theta), result.state, spread


def _fit_decentred(
    setup: Setup, constants: Functions, state: State, spread: VarianceComponents, decentring: str
) -> tuple[Functions, Problem, BundleResult]:
    """Fit functions that may change moderately, with decentring along one diagonal."""
    size = min(3, max(1, len(setup.magnifications) - 1))
    sizes = dict.fromkeys((*SMOOTH, decentring), ("chebyshev_log", size))
    functions = refit_functions(constants, sizes)
    problem = build_problem(setup, functions, setup.views, spread)
    state = replace(state, theta=stack_theta(setup, functions, state))
    result = adjust(problem, state, tolerance=COARSE_TOLERANCE)
    return functions, problem, right_way_up(setup, functions, problem, result)


@dataclass(frozen=True)
class Start:
    """Where a fit starts.

    Attributes
    ----------
    setup
        The views as they were observed.
    tempered
        The same with corners that are as uncertain as the model.
    functions, state, spread
        Moderately flexible functions, poses and variance components.
    """

    setup: Setup
    tempered: Setup
    functions: Functions
    state: State
    spread: VarianceComponents


def start(setup: Setup) -> Start:
    """Fit poses and a camera that hardly depends on the magnification, to a part of the corners."""
    start_px = measure_misfit_px(setup)
    noisy = tempered(setup, start_px)
    if start_px > 0.0:
        # What a stage says wrongly must not lead poses astray that are so uncertain.
        noisy = replace(noisy, tempering=np.inf)
    thin = replace(noisy, views=tuple(thin_view(v) for v in noisy.views))
    return Start(setup, noisy, *_fit_start(thin))
