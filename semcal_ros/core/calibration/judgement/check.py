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

"""Whether a calibration still describes the microscope, from a few views of the grid.

The calibration is adjusted to the views (:mod:`~semcal_ros.core.calibration.judgement.revision`), with changes that all
magnifications share, and the changes are tested: with all others zero, a group of changes
lowers chi-square by ``b' L^-1 b``, where ``L`` is their information and ``b`` the score. The most significant
group is taken, and then the next one given that, as long as one is significant (forward selection; Lehmann and
Romano, Testing Statistical Hypotheses, chapter 7, has the test of linear hypotheses).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from scipy.special import chdtrc, ndtri

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.estimator.blocks import Problem
from semcal_ros.core.calibration.estimator.bundle_adjustment import BundleResult
from semcal_ros.core.calibration.estimator.problem import Setup
from semcal_ros.core.calibration.estimator.thresholds import HELD_SIGMA
from semcal_ros.core.calibration.judgement.revision import (
    WATCHED,
    Revision,
    changing,
    free_sigmas,
    gaining,
    make_setup,
    revise,
)
from semcal_ros.core.calibration.judgement.thresholds import (
    CELL_VIEWS_MIN,
    CHANGE_ROUNDS,
    CHECK_CELLS,
    CHECK_FALSE_ALARMS,
    GAIN_MAX,
    MISFIT_SIGMA,
    OTHER_SCALE,
    SIGN_FLIPS,
)
from semcal_ros.core.calibration.stage import StageAxis
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.distortion import LATE_TERMS
from semcal_ros.core.camera.scan_distortion import SCAN_NAMES, SETTLING
from semcal_ros.core.wording import counted

_GROUPS = {
    "scale": ("scale",),
    "aspect": ("aspect",),
    "skew": ("skew",),
    "distortion": ("xi_r", "xi_t", "xi_u"),
    "centre of distortion": ("ex", "ey"),
    "spiral": ("xi_s",),
    "products and fifth order": LATE_TERMS,
    "coils": ("coil_x2", "coil_x3", "coil_y2", "coil_y3"),
    "settling": SCAN_NAMES[SETTLING],
}
#: The names under which changes are reported.
CHANGES = tuple(_GROUPS)
_NOT_RENEWABLE = tuple(name for name, group in _GROUPS.items() if set(group) <= set(WATCHED))
_UNDESCRIBED = "distortion that no parameter describes"
_TESTS = len(CHANGES) + 1


def groups_of_changes(model: CalibrationModel) -> dict[str, tuple[str, ...]]:
    """Return the parameters of a calibration that are tested together, by each of :data:`CHANGES`."""
    own = (*changing(model), *WATCHED)
    return {name: tuple(p for p in group if p in own) for name, group in _GROUPS.items()}


class Verdict(Enum):
    """What a check says."""

    VALID = "valid"
    DEGRADED = "degraded"
    INVALID = "invalid"


@dataclass(frozen=True)
class Change:
    """A change of the camera since the calibration.

    Attributes
    ----------
    name
        One of :data:`CHANGES`.
    values, sigmas
        Changes of its parameters (:func:`groups_of_changes`) with their 1-sigma, in the mean over the views: relative
        for the scale, px for the centre, half image widths for coils and settling.
    chi2, p_value
        By how much it lowers chi-square, and how probable as much is without a change.
    largest_px, largest_m
        Largest displacement in the image that it makes, without a shift of the whole: in px, and on the specimen. The
        latter is at another magnification.
    """

    name: str
    values: tuple[float, ...]
    sigmas: tuple[float, ...]
    chi2: float
    p_value: float
    largest_px: float = 0.0
    largest_m: float = 0.0

    @property
    def z_scores(self) -> tuple[float, ...]:
        """Its values over their 1-sigma."""
        return tuple(v / s for v, s in zip(self.values, self.sigmas, strict=True))


@dataclass(frozen=True)
class ShapeTest:
    """Whether residuals form a pattern that all views share.

    Attributes
    ----------
    rms_px
        RMS of the mean residual per axis over the cells of the image, less its noise.
    p_value
        How probable a pattern as strong is without one; NaN where too few views were seen.
    stated_px
        1-sigma per axis with which the calibration knows what no pose imitates, RMS over the image.
    """

    rms_px: float
    p_value: float
    stated_px: float

    @property
    def z_score(self) -> float:
        """The normal deviate that is as improbable (two-sided); NaN where too few views were seen."""
        return abs(float(ndtri(0.5 * self.p_value)))

    @property
    def significant(self) -> bool:
        """Whether there is a pattern, and a stronger one than the calibration allows for."""
        return self.p_value < CHECK_FALSE_ALARMS / _TESTS and self.rms_px > self.stated_px


@dataclass(frozen=True)
class CalibrationCheck:
    """Result of :func:`check_calibration`.

    Attributes
    ----------
    verdict
        Valid, degraded, or invalid: of another microscope, display width or grid.
    changes
        What has changed, the most significant first; empty if nothing has.
    tested
        All tested changes, in the order of :data:`CHANGES`: each given those of ``changes``.
    shape
        Test for distortion that no parameter describes.
    scale_change, scale_sigma
        By how much the scale (px per m) of the images is larger than the calibration's, relative, given what has
        changed, and its 1-sigma:
        of the images, their height, the calibration and the repeatability of its visits.
    rms_px, misfit
        RMS of the residuals with the changes adjusted, and how many times what the uncertainty of the corners explains
        that is.
    views, out_of_range
        Numbers of views that were used, and that lie outside the calibrated range.
    """

    verdict: Verdict
    changes: tuple[Change, ...]
    tested: tuple[Change, ...]
    shape: ShapeTest
    scale_change: float
    scale_sigma: float
    rms_px: float
    misfit: float
    views: int
    out_of_range: int

    @property
    def misfit_z(self) -> float:
        """z-score of the misfit.

        A large one is no change of the camera but noise, blur or an uneven grid, and takes no part in the verdict.
        """
        return (self.misfit - 1.0) / MISFIT_SIGMA

    @property
    def not_renewable(self) -> tuple[str, ...]:
        """What has changed that a few views do not tell at all magnifications, so that only a new calibration does."""
        named = [change.name for change in self.changes if change.name in _NOT_RENEWABLE]
        return (*named, *[_UNDESCRIBED] * self.shape.significant)

    @property
    def summary(self) -> str:
        """The verdict, what has changed, and how far nm per pixel is off, in one sentence."""
        named = [change.name for change in self.changes]
        named += [_UNDESCRIBED] * self.shape.significant
        changed = f" ({', '.join(named)})" if named else ""
        return (
            f"{self.verdict.value}{changed}: nm per px off by {-100.0 * self.scale_change:+.3f} "
            f"+- {100.0 * self.scale_sigma:.3f} %, by {counted(self.views, 'view')}"
        )


def check_calibration(
    model: CalibrationModel,
    views: Sequence[GridView],
    *,
    image_size: tuple[int, int],
    untilted: str | Sequence[str] = "auto",
    axis: StageAxis | None = None,
) -> CalibrationCheck:
    """Test whether views of the grid agree with a calibration within both uncertainties.

    The grid is taken to be the one of the calibration, and to lie within ``model.scale_sigma.height_m`` of its
    height: neither the size of the squares nor a height can be told from the scale.

    Parameters
    ----------
    model
        The calibration.
    views
        One or more views. Of one view without a known tilt, aspect and skew cannot be told from a tilt, and are
        uncertain by as much.
    image_size
        (width, height) of the images.
    untilted, axis
        As in :class:`~semcal_ros.core.calibration.options.CalibrationOptions`.

    Raises
    ------
    CalibrationError
        If no view lies in the calibrated range, or the calibration cannot project the views at all.
    InvalidValueError
        If an untilted view is named that is not there.
    """
    setup = make_setup(model, views, image_size, untilted, axis or StageAxis())
    revision, estimate, found = _find_changes(model, setup)
    setup, problem, result = revision.setup, revision.problem, revision.result
    proven = {change.name: change for change in found}
    # What has changed takes part of the rest with it: the rest is tested beside it, and not as if nothing had.
    beside = [proven.get(name) or _test(estimate, list(proven), name) for name in CHANGES]
    tested = tuple(_with_effect(model, setup, change) for change in beside)
    by_name = {change.name: change for change in tested}
    changes, scale = tuple(by_name[name] for name in proven), by_name["scale"]
    shape = _test_shape(setup, problem, result, _stated_px(model, setup))
    verdict = Verdict.DEGRADED if changes or shape.significant else Verdict.VALID
    if changes and abs(scale.values[0]) > OTHER_SCALE:
        verdict = Verdict.INVALID
    return CalibrationCheck(
        verdict,
        changes,
        tested,
        shape,
        scale.values[0],
        scale.sigmas[0],
        float(np.sqrt(np.mean(np.sum(result.residuals_px**2, axis=1)))),
        revision.misfit,
        len(setup.views),
        len(views) - len(setup.views),
    )


def _stated_px(model: CalibrationModel, setup: Setup) -> float:
    """The calibration's own 1-sigma per axis of what no pose imitates, RMS over the image, px."""
    camera = model.at(float(np.median(setup.magnifications))).resized(*setup.image_size)
    covariance = camera.joint_covariance
    if covariance is None:
        return 0.0
    x, y = np.meshgrid(*(np.linspace(0.0, n - 1.0, 7) for n in setup.image_size))
    lattice: Array = np.stack([x.ravel(), y.ravel()], axis=1)
    jacobian = camera.project_jacobian(camera.sem_from_ideal(lattice))
    # Raw per ideal px, by central differences: what a pose does comes before the distortion.
    raw_from_ideal = np.stack(
        [
            camera.distort(lattice + step) - camera.distort(lattice - step)
            for step in 0.5 * np.eye(2)
        ],
        axis=2,
    )
    known = np.isfinite(jacobian).all(axis=(1, 2)) & np.isfinite(raw_from_ideal).all(axis=(1, 2))
    # A pose moves the ideal image by a homography; here its derivative, for x and y in turn.
    x, y = (lattice[known] / camera.width - 0.5).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    moves = np.stack(
        [
            np.stack([one, x, y, zero, zero, zero, x * x, x * y], axis=1),
            np.stack([zero, zero, zero, one, x, y, x * y, y * y], axis=1),
        ],
        axis=1,
    )
    moves = (raw_from_ideal[known] @ moves).reshape(2 * len(x), 8)
    basis, _ = np.linalg.qr(moves)
    rows = jacobian[known].reshape(2 * len(x), -1)
    left = rows - basis @ (basis.T @ rows)
    return float(np.sqrt(np.mean(np.einsum("ni,ij,nj->n", left, covariance, left))))


@dataclass(frozen=True)
class _Group:
    """The unknowns of a group of changes: (C,) their columns, and the prior 1-sigma of those after the first, of
    relative changes; (P, C) what they make of its parameters, in the mean over the views.
    """

    columns: Array
    relative_sigmas: Array
    parameters: Array


@dataclass(frozen=True)
class _Estimate:
    """Estimate of all changes as a Gaussian: its information and score, and the unknowns of each group."""

    information: Array
    score: Array
    groups: Mapping[str, _Group]

    def solve(self, groups: Sequence[str]) -> tuple[Array, Array, float]:
        """Values and covariance of some changes where all others are zero, and the chi-square they explain."""
        index = [column for name in groups for column in self.groups[name].columns]
        if not index:
            return np.zeros(0), np.zeros((0, 0)), 0.0
        covariance = np.asarray(
            np.linalg.inv(self.information[np.ix_(index, index)]), dtype=np.float64
        )
        values = covariance @ self.score[index]
        return values, covariance, float(values @ self.score[index])


def _find_changes(
    model: CalibrationModel, setup: Setup
) -> tuple[Revision, _Estimate, list[Change]]:
    """Adjust to the views, and find what has changed.

    Each change is tested where nothing has changed. If one has, all together tell what it is. But where all are free,
    poses may go far along what views of a few tilts do not tell apart, and the equations that lead back to no change
    are no longer linear. What is found there is therefore adjusted alone, and all else tested at that place, until it
    is the same.

    A distortion that has changed may have done so in proportion to itself. As long as it has to be by the same amount
    at all magnifications, the rest is taken for a change of its centre.
    """
    free, groups = free_sigmas(model, setup), groups_of_changes(model)
    revision = revise(model, setup, free, held=free)
    estimate = _estimate_changes(revision)
    found = _select(estimate)
    if not found:
        return revision, estimate, found
    found = _select(_estimate_changes(revise(model, setup, free)))
    for _ in range(CHANGE_ROUNDS):
        names = {change.name for change in found}
        held = free.keys() - {p for name in names for p in groups[name]}
        revision = revise(model, setup, free, gain_sigmas(model, setup, found), held)
        estimate = _estimate_changes(revision)
        found = _select(estimate)
        if {change.name for change in found} == names:
            break
    return revision, estimate, found


def gain_sigmas(
    model: CalibrationModel, setup: Setup, changes: Sequence[Change]
) -> dict[str, float]:
    """Return the prior 1-sigma of the relative changes of
    :func:`~semcal_ros.core.calibration.judgement.revision.gaining`: so large that they could be the whole change that
    was proven, where the views are.

    Whether the distortion has changed by the same amount at all magnifications or in proportion, views at one of them
    do not tell.
    """
    sigmas, groups = {}, groups_of_changes(model)
    for change in changes:
        for name, value in zip(groups[change.name], change.values, strict=True):
            if name in gaining(model):
                usual = float(np.sqrt(np.mean(_at_views(model, setup, name) ** 2)))
                sigmas[name] = min(abs(value) / max(usual, np.finfo(np.float64).tiny), GAIN_MAX)
    return sigmas


def _at_views(model: CalibrationModel, setup: Setup, name: str) -> Array:
    """(M,) a parameter as calibrated, at the magnifications of the views."""
    return np.array([model.functions[name](float(g)) for g in setup.magnifications])


def _estimate_changes(revision: Revision) -> _Estimate:
    model, setup = revision.model, revision.setup
    names, index = revision.names, np.r_[revision.gains]
    is_free = revision.problem.prior_sigma[index] > HELD_SIGMA
    gains = [p for p, free in zip(gaining(model), is_free, strict=True) if free]
    own = np.r_[revision.changes, index[is_free]]
    sigmas = revision.problem.prior_sigma[own]
    information = np.asarray(np.linalg.inv(revision.covariance[np.ix_(own, own)]), dtype=np.float64)
    groups = {}
    for name, parameters in groups_of_changes(model).items():
        relative = [p for p in parameters if p in gains]
        columns = [names.index(p) for p in parameters]
        columns += [len(names) + gains.index(p) for p in relative]
        values = np.eye(len(parameters), len(columns))
        for column, p in enumerate(relative, start=len(parameters)):
            values[parameters.index(p), column] = np.mean(_at_views(model, setup, p))
        groups[name] = _Group(np.array(columns), sigmas[columns[len(parameters) :]], values)
    return _Estimate(information, information @ revision.proposed[own], groups)


def _test(estimate: _Estimate, given: Sequence[str], name: str) -> Change:
    """Test one group of changes where those of other groups are free and the rest is zero."""
    group = estimate.groups[name]
    values, covariance, explained = estimate.solve([*given, name])
    _, _, before = estimate.solve(given)
    gain = max(explained - before, 0.0)
    own = slice(len(values) - len(group.columns), None)
    values, covariance = values[own], covariance[own, own]
    # Of a relative change as much is a degree of freedom as the views tell of it.
    left = np.diag(covariance)[len(group.parameters) :] / group.relative_sigmas**2
    freedom = len(group.parameters) + float(np.sum(np.maximum(1.0 - left, 0.0)))
    sigmas = np.sqrt(np.diag(group.parameters @ covariance @ group.parameters.T))
    return Change(
        name,
        tuple((group.parameters @ values).tolist()),
        tuple(sigmas.tolist()),
        gain,
        float(chdtrc(freedom, gain)),
    )


def _select(estimate: _Estimate) -> list[Change]:
    """The changes that the views prove, the most significant first, each given all of them."""
    chosen: list[str] = []
    while len(chosen) < len(CHANGES):
        rest = [_test(estimate, chosen, name) for name in CHANGES if name not in chosen]
        best = min(rest, key=lambda change: (change.p_value, -change.chi2))
        if best.p_value >= CHECK_FALSE_ALARMS / _TESTS:
            break
        chosen.append(best.name)
    # What a later choice explains better is taken back.
    while True:
        found = [
            _test(estimate, [other for other in chosen if other != name], name) for name in chosen
        ]
        needless = [change for change in found if change.p_value >= CHECK_FALSE_ALARMS / _TESTS]
        if not needless:
            return sorted(found, key=lambda change: change.p_value)
        chosen.remove(max(needless, key=lambda change: change.p_value).name)


def _test_shape(
    setup: Setup, problem: Problem, result: BundleResult, stated_px: float
) -> ShapeTest:
    """Test the mean residuals of cells by turning the signs of whole views.

    Without a common pattern, the residuals of a view are as probable as their negatives, whatever the corners of
    one view have in common.
    """
    width, height = setup.image_size
    cell = np.minimum(
        (problem.observed_px / (width, height) * CHECK_CELLS).astype(int), CHECK_CELLS - 1
    )
    index = cell[:, 1] * CHECK_CELLS + cell[:, 0]
    views, cells = len(setup.views), CHECK_CELLS**2
    inlier = result.huber_weight >= 1.0
    place = problem.view_of_point * cells + index
    count = np.bincount(place[inlier], minlength=views * cells).reshape(views, cells)
    means = np.zeros((views, cells, 2))
    for axis in range(2):
        sums = np.bincount(
            place[inlier], weights=result.residuals_px[inlier, axis], minlength=views * cells
        )
        means[:, :, axis] = sums.reshape(views, cells) / np.maximum(count, 1)
    seen = count > 0
    enough = seen.sum(axis=0) >= CELL_VIEWS_MIN
    if not np.any(enough):
        return ShapeTest(0.0, np.nan, stated_px)
    means, seen = means[:, enough], seen[:, enough]
    number = seen.sum(axis=0)[:, None]
    square = np.sum(means**2, axis=0) / number

    def statistic(signs: Array) -> Array:
        mean = np.einsum("nv,vcx->ncx", signs, means) / number
        return np.sum(mean**2 / np.maximum(square, 1e-12) * number, axis=(1, 2))

    rng = np.random.default_rng(0)
    flips = rng.choice([-1.0, 1.0], size=(SIGN_FLIPS, views))
    observed = float(statistic(np.ones((1, views)))[0])
    beyond = int(np.sum(statistic(flips) >= observed))
    noise = (square - np.mean(means, axis=0) ** 2) / np.maximum(number - 1, 1)
    pattern = (np.sum(means, axis=0) / number) ** 2 - np.maximum(noise, 0.0)
    rms = float(np.sqrt(max(np.mean(pattern), 0.0)))
    return ShapeTest(rms, (beyond + 1) / (SIGN_FLIPS + 1), stated_px)


def _with_effect(model: CalibrationModel, setup: Setup, change: Change) -> Change:
    """The change with the largest displacements that it makes, without a shift of the whole."""
    largest_px = largest_m = 0.0
    for g in setup.magnifications:
        camera = model.at(float(g)).resized(*setup.image_size)
        x, y = np.meshgrid(
            np.linspace(0.0, camera.width - 1.0, 9), np.linspace(0.0, camera.height - 1.0, 9)
        )
        # Points of the reference plane that are seen all over the image.
        inverse = np.linalg.inv(camera.ideal_from_sem_jacobian)
        plane = (np.stack([x.ravel(), y.ravel()], axis=1) - (camera.px, camera.py)) @ inverse.T
        points = np.column_stack([plane, np.zeros(len(plane))])
        changed: dict[str, Any] = {}
        for name, value in zip(groups_of_changes(model)[change.name], change.values, strict=True):
            if name == "scale":
                changed["m"] = camera.m * (1.0 + value)
            else:
                changed[name] = getattr(camera, name) + value
        moved = replace(camera, **changed).project(points) - camera.project(points)
        moved -= np.nanmean(moved, axis=0)
        px = float(np.nanmax(np.hypot(*moved.T)))
        largest_px = max(largest_px, px)
        largest_m = max(largest_m, px * float(np.mean(camera.pixel_size_m)))
    return replace(change, largest_px=largest_px, largest_m=largest_m)
