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

"""A view whose magnification is wrong is left out and named; a microscope that jumps is not taken for that."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from semcal_ros.core.calibration import pipeline
from semcal_ros.core.calibration.estimator.blocks import Problem, State
from semcal_ros.core.calibration.estimator.bundle_adjustment import Adjustment, BundleResult
from semcal_ros.core.calibration.estimator.problem import Priors, Setup
from semcal_ros.core.calibration.estimator.trust_region import DescentStatus
from semcal_ros.core.calibration.judgement.outliers import (
    find_change_point,
    find_outliers,
    find_wrong_tilts,
    measure_deviations,
)
from semcal_ros.core.calibration.judgement.thresholds import OUTLIER_FALSE_ALARMS
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.stage import StageAxis, attitudes
from semcal_ros.core.calibration.views import ViewStatus
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.plane_geometry import rotations_from_vectors
from semcal_ros.core.camera.scan_distortion import Raster
from semcal_ros.core.errors import CalibrationError
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import SimulatedStage, stage_views
from tests.helpers.calibrations import CALIBRATED, calibrated, seen_views

OFF = CalibrationOptions(residual="off")
OPTIONS = {"image_size": (512, 512), "display_width_m": 0.12, "options": OFF}


def _misnamed(views, index, factor):
    """The view as it would be if its magnification had been recorded wrongly: the board's size follows from it."""
    out = list(views)
    # What is seen stays; the assignment of squares keeps their sides.
    out[index] = replace(views[index], board_xy_m=views[index].board_xy_m / factor)
    return out


# Under a parallel projection, tilts of a stretched grid imitate the wrong scale; of the last view best of all.
# These planes are tilted about the middle of the grid, so that they cross the beam up to 0.1 mm higher or lower: of the
# 8 mm to the pivot, 6 % stand out just as much as is allowed beside that.
@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "factor", "wrong"),
    [
        ("strong_perspective", 1.07, 10),
        ("parallel", 1.06, 11),
    ],
)
def test_a_view_at_the_wrong_magnification_is_left_out(name, factor, wrong):
    # One of 16 views, which is still no more than few of them.
    views = seen_views(name, CALIBRATED[::2])
    result = calibrate_views(_misnamed(views, wrong, factor), **OPTIONS)
    assert [o.name for o in result.outliers] == [views[wrong].name]
    assert result.outliers[0].rejection.status is ViewStatus.OUTLIER
    assert "wrong magnification" in result.outliers[0].reason
    assert len(result.views) == len(views) - 1
    if name == "strong_perspective":
        # As good as if that view had never been recorded.
        clean = calibrate_views([v for i, v in enumerate(views) if i != wrong], **OPTIONS)
        for g in (500.0, 2600.0, 8000.0):
            np.testing.assert_allclose(result.model.at(g).m, clean.model.at(g).m, rtol=1e-6)


@pytest.mark.long
def test_a_view_whose_own_grid_is_not_known_to_be_stretched_is_not_left_out_for_it(monkeypatch):
    """The spread of the grids may be large by chance, and fall without any one of the views."""
    views = seen_views("parallel", (1000.0, 2000.0, 4000.0))
    given = {key: OPTIONS[key] for key in ("image_size", "display_width_m")}
    setup = pipeline.prepare(views, **given)
    fit = pipeline.fit_joint(setup, "off")
    adjustment = fit.adjustment
    collapsed = replace(adjustment.spread, lattice_sigma=1e-3 * adjustment.spread.lattice_sigma)
    without = replace(fit, adjustment=replace(adjustment, spread=collapsed))
    monkeypatch.setattr(pipeline, "_is_irregular", lambda _setup, _fit: True)
    monkeypatch.setattr(pipeline, "fit_joint", lambda _setup, _residual: without)
    assert pipeline._find_masked_outlier(setup, fit) == {}
    # One that is, is.
    lattices = np.zeros_like(adjustment.result.state.lattices)
    lattices[4] = 0.03
    state = replace(adjustment.result.state, lattices=lattices)
    stretched = replace(adjustment, result=replace(adjustment.result, state=state))
    assert list(pipeline._find_masked_outlier(setup, replace(fit, adjustment=stretched))) == [4]


@pytest.mark.long
def test_of_four_views_the_one_of_other_squares_is_left_out():
    views = seen_views("jsm820", (800.0,))
    result = calibrate_views(_misnamed(views, 1, 2.0**0.5), **OPTIONS)
    assert [o.name for o in result.outliers] == [views[1].name]
    truth = preset("jsm820").camera_at(800.0).pixel_size_m[0]
    camera = result.model.at(800.0)
    # It was 7 % off, with as large a sigma.
    assert camera.pixel_size_sigma_m[0] < 0.01 * truth
    assert abs(camera.pixel_size_m[0] - truth) < 3.0 * camera.pixel_size_sigma_m[0]


@pytest.mark.long
@pytest.mark.parametrize("views", [2, 3, 4])
def test_one_wrong_magnification_among_few_views_is_left_out(views):
    """Of two magnifications with that many views each, one view at 300x states 700x."""
    seen = seen_views("jsm820", (300.0, 800.0), views=views)
    wrong = [replace(v, magnification=700.0) if i == 1 else v for i, v in enumerate(seen)]
    result = calibrate_views(wrong, **OPTIONS)
    assert [o.name for o in result.outliers] == [seen[1].name]
    for g in (300.0, 800.0):
        camera, truth = result.model.at(g), preset("jsm820").camera_at(g).pixel_size_m
        assert np.all(np.array(camera.pixel_size_sigma_m) < 0.01 * np.array(truth))
        error = np.array(camera.pixel_size_m) - truth
        assert np.all(np.abs(error) < 3.0 * np.array(camera.pixel_size_sigma_m))


def _of_stage(count):
    """Views at 800x that know their tilts, of which the second shows squares that are larger by sqrt(2)."""
    stage = SimulatedStage(tilts_rad=(0.0, 0.35, 0.6)[:count])
    views = stage_views(
        preset("jsm820").camera_at, (800.0,), stage, readings=True, most_corners=130
    )
    return _misnamed(views, 1, 2.0**0.5)


@pytest.mark.long
def test_of_three_views_the_one_of_other_squares_is_left_out():
    """Few views do not widen the spread of heights: tilts and grids would take the place of the scale."""
    views = _of_stage(3)
    result = calibrate_views(views, **OPTIONS)
    assert [o.name for o in result.outliers] == [views[1].name]
    camera, truth = result.model.at(800.0), preset("jsm820").camera_at(800.0).pixel_size_m
    error = np.array(camera.pixel_size_m) - truth
    assert np.all(np.abs(error) < 3.0 * np.array(camera.pixel_size_sigma_m))


@pytest.mark.long
def test_of_two_views_that_do_not_agree_none_is_believed():
    views = _of_stage(2)
    names = f"{views[0].name} .*{views[1].name} .*"
    with pytest.raises(CalibrationError, match=f"{names}do not agree.*record a third view"):
        calibrate_views(views, **OPTIONS)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["jsm820", pytest.param("pincushion", marks=pytest.mark.long)])
def test_ordinary_views_stay(name):
    """As they do with those of the other microscopes (test_calibrate, test_residual_field_fit)."""
    # With a residual field if there is one, as many other tests have it.
    result = calibrated(name)
    assert result.outliers == () and len(result.views) == 28


@pytest.mark.slow
@pytest.mark.long
def test_a_jump_of_the_scale_is_not_a_matter_of_single_views():
    views = [
        replace(v, board_xy_m=v.board_xy_m / 1.03) if v.magnification > 3000.0 else v
        for v in seen_views("jsm820")
    ]
    result = calibrate_views(views, **OPTIONS)
    assert result.outliers == ()
    assert any("jump" in w for w in result.warnings)


MAGNIFICATIONS = np.array([100.0, 300.0, 1000.0, 3000.0])
SETUP = Setup((), MAGNIFICATIONS, (512, 512), 0.12, Priors())


def _adjusted(group, residual_sigmas, *, heights_m=0.0, pull=0.0, weight=1.0):
    """An adjustment of a constant scale only, written down and not computed.

    Views of 10 corners, each off by that many sigmas; every magnification says with the weight
    ``weight`` that the scale differs from the common one by ``pull``.
    """
    count, corners = len(group), 10
    nominal = SETUP.nominal_px_per_m(MAGNIFICATIONS)
    designs = np.zeros((4, 10, 1))
    designs[:, 0, 0] = nominal
    information, gradient = np.zeros((4, 10, 10)), np.zeros((4, 10))
    information[:, 0, 0] = weight / nominal**2
    gradient[:, 0] = weight * pull / nominal
    miss = np.zeros((count * corners, 2))
    miss[:, 0] = np.repeat(np.broadcast_to(residual_sigmas, count), corners)
    translations = np.zeros((count, 3))
    translations[:, 2] = heights_m
    problem = Problem(
        board_m=np.zeros((len(miss), 3)),
        observed_px=np.zeros((len(miss), 2)),
        whitening=np.tile([1.0, 0.0, 1.0], (len(miss), 1)),
        starts=corners * np.arange(count + 1),
        group=np.asarray(group),
        designs=designs,
        unit_m=np.ones(count),
        raster=Raster.of(512, 512),
        prior_mean=np.zeros(1),
        prior_sigma=np.full(1, np.inf),
        height_sigma_m=np.ones(count),
    )
    result = BundleResult(
        State(np.ones(1), np.tile(np.eye(3), (count, 1, 1)), translations),
        miss,
        np.ones(len(miss)),
        0.0,
        information,
        gradient,
        np.eye(1),
        np.zeros((count, 1)),
        np.ones((count, 1)),
        np.zeros((0, 2)),
        1,
        DescentStatus.SMALL_DECREASE,
    )
    return problem, result


GROUP = np.repeat(np.arange(4), 6)
# Degrees of freedom of the 24 views: 480 numbers, 6 for each pose and the scale.
FREEDOM = 480 - 6 * 24 - 1


@pytest.mark.parametrize(("residual", "factor"), [(0.1, 1.0), (1.0, 1.0), (3.0, 3.0)])
def test_a_jump_counts_in_what_scales_scatter_by(residual, factor):
    """Two magnifications say -a and two +a, each to 0.001, and nothing is left besides the jump 2 a.

    The scatter is that of one usual observation, of three: a mean of four scales leaves three, of which one is the
    jump. Corners that fit better than they should make none of it smaller.
    """
    off = residual * np.sqrt(FREEDOM / 240.0)
    sigma = 1e-3 * factor / np.sqrt(3.0)
    # In either direction, at three places between and two between the ends, once in a hundred recordings.
    limit = stats.t.isf(0.01 / 10.0, 3)
    constant = {"scale": ContinuousFunction("chebyshev_log", np.ones(1), (100.0, 3000.0))}
    for sigmas, found in (
        (-0.99 * limit, False),
        (0.99 * limit, False),
        (1.01 * limit, True),
        (-1.01 * limit, True),
    ):
        half = 0.5 * sigmas * sigma
        pull = np.array([-half, -half, half, half])
        problem, result = _adjusted(GROUP, off, pull=pull, weight=1e6)
        jump = find_change_point(SETUP, Adjustment(constant, problem, result, None, 1, True))
        assert (jump is not None) == found
        if jump is not None:
            assert (jump.below, jump.above) == (300.0, 1000.0)
            assert jump.relative == pytest.approx(2.0 * half)
            assert jump.sigma == pytest.approx(sigma)


def test_a_magnification_whose_scale_nothing_tells_is_no_jump():
    problem, result = _adjusted(GROUP, 1.0, pull=np.array([0.0, 0.0, 1.0, 1.0]), weight=1e6)
    blind = result.information.copy()
    blind[1] = 0.0
    constant = {"scale": ContinuousFunction("chebyshev_log", np.ones(1), (100.0, 3000.0))}
    adjustment = Adjustment(constant, problem, replace(result, information=blind), None, 1, True)
    assert find_change_point(SETUP, adjustment) is None


@pytest.mark.parametrize(("height_m", "odd"), [(35e-6, False), (45e-6, True)])
def test_heights_that_differ_by_micrometres_are_alike_however_small_the_spread(height_m, odd):
    heights = np.zeros(24)
    heights[9] = height_m
    found = find_outliers(*_adjusted(GROUP, 1.0, heights_m=heights))
    assert list(found) == ([9] if odd else [])


def test_heights_that_only_some_magnifications_tell_do_not_make_one_of_them_odd():
    """Where the projection is parallel, the prior holds them: their spread is not that of the others."""
    group = np.repeat(np.arange(4), [14, 6, 6, 6])
    heights = np.where(np.arange(32) % 2, -1.0, 1.0) * np.where(group == 0, 22e-6, 1e-6)
    heights[1] = -128e-6
    assert not find_outliers(*_adjusted(group, 1.0, heights_m=heights))
    # A millimetre is odd all the same.
    heights[1] = -1e-3
    assert list(find_outliers(*_adjusted(group, 1.0, heights_m=heights))) == [1]


@pytest.mark.parametrize(("times", "odd"), [(5.0, False), (7.0, True)])
def test_a_view_that_fits_much_worse_than_the_others_is_an_outlier(times, odd):
    residual = np.ones(24)
    residual[17] = times
    assert list(find_outliers(*_adjusted(GROUP, residual))) == ([17] if odd else [])


@pytest.mark.parametrize(("corners", "odd"), [(2, False), (5, True)])
def test_some_corners_that_are_far_off_are_no_wrong_view(corners, odd):
    """Of ten; two would make the residuals of the view 18 times as large."""
    problem, result = _adjusted(GROUP, 1.0)
    first = problem.starts[17]
    result.residuals_px[first : first + corners, 0] = 40.0
    found = find_outliers(problem, result)
    assert list(found) == ([17] if odd else [])
    for rejection in found.values():
        assert "residuals that are" in rejection.reason
        # Nothing is said of heights and grids that are as those of the others.
        assert "um of height" not in rejection.reason


def test_where_half_of_a_magnification_disagrees_no_single_view_is_at_fault():
    residual = np.ones(24)
    residual[:2] = 10.0
    group = np.array([0] * 4 + [1] * 6 + [2] * 7 + [3] * 7)
    assert not find_outliers(*_adjusted(group, residual))
    group[3] = 1
    residual[1] = 1.0
    assert list(find_outliers(*_adjusted(group, residual))) == [0]
    # Nor where many disagree in all.
    residual[[5, 12, 20]] = 10.0
    assert not find_outliers(*_adjusted(group, residual))


@pytest.mark.parametrize("count", [3, 4, 6, 8, 16])
def test_a_view_has_no_part_in_the_spread_by_which_it_is_judged(count):
    """Of up to eight views, one that is off would else never be far off in spreads."""
    heights = 2e-6 * np.cos(np.arange(count))
    heights[1] += 2.5e-3
    group = np.zeros(count, dtype=int)
    assert list(find_outliers(*_adjusted(group, 1.0, heights_m=heights))) == [1]


def test_of_two_views_that_disagree_neither_is_chosen():
    heights = np.array([0.0, 5e-3])
    adjusted = _adjusted([0, 0], 1.0, heights_m=heights)
    assert np.all(measure_deviations(*adjusted).of_limit > 1.0)
    assert not find_outliers(*adjusted)
    # Nor of two pairs.
    assert not find_outliers(*_adjusted([0] * 4, 1.0, heights_m=np.repeat(heights, 2)))


@pytest.mark.parametrize(("height_m", "odd"), [(0.5e-3, False), (1.2e-3, True)])
def test_a_tilted_view_is_not_judged_by_still_ones(height_m, odd):
    """A stage moves where it tilts: views from above that agree to a micrometre do not say by how much."""
    heights = np.array([0.0, 1e-6, -1e-6, 0.5e-6, 0.0, height_m])
    problem, result = _adjusted([0] * 6, 1.0, heights_m=heights)
    rotations = result.state.rotations.copy()
    rotations[-1] = rotations_from_vectors(np.array([[0.6, 0.0, 0.0]]))[0]
    tilted = replace(result, state=replace(result.state, rotations=rotations))
    assert list(find_outliers(problem, tilted)) == ([5] if odd else [])
    # Among other views from above it would be an outlier.
    assert list(find_outliers(problem, result)) == [5]


@pytest.mark.parametrize(
    ("count", "sigma_m"),
    [
        (3, 1e-5),
        (3, 1e-4),
        (4, 1e-5),
        (4, 1.35e-4),
        (6, 1.35e-4),
        (16, 1e-5),
        (16, 1e-4),
        (16, 1e-3),
    ],
)
def test_sound_views_are_left_out_in_one_recording_of_a_hundred_at_most(count, sigma_m):
    """Normal heights, of few views up to what is usual with what it is uncertain by, of many of any spread."""
    rng = np.random.default_rng((7, count))
    recordings, lost = 100, 0
    for _ in range(recordings):
        heights = rng.normal(0.0, sigma_m, count)
        lost += bool(find_outliers(*_adjusted([0] * count, 1.0, heights_m=heights)))
    assert lost <= recordings * OUTLIER_FALSE_ALARMS


def test_the_worst_of_the_tilts_that_contradict_the_stage_comes_first():
    """One wrong reading moves the others with it, and is named in the message."""
    problem, result = _adjusted([0] * 4, 1.0)
    stage = attitudes([None] * 4, [True] * 4, StageAxis(), 0.01)
    left = np.zeros((4, 3))
    left[:, 0] = [9.4, 29.0, -32.0, -9.8]
    told = {"prior_residuals": {"attitude": left}, "prior_variance": {"attitude": 0.0 * left}}
    found = find_wrong_tilts(replace(problem, attitudes=stage), replace(result, **told))
    assert list(found) == [2, 1]
    assert not find_wrong_tilts(problem, result)


@pytest.mark.long
def test_a_magnification_of_which_no_view_is_left_is_not_calibrated() -> None:
    """The only view of a magnification was recorded at one that is 6 % off."""
    others = seen_views("jsm820", (300.0, 800.0, 1800.0, 3500.0))
    (alone,) = _misnamed(seen_views("jsm820", (2500.0,), views=1, seed=2), 0, 1.06)
    result = calibrate_views([*others, replace(alone, name="alone")], **OPTIONS)
    assert [view.name for view in result.outliers] == ["alone"]
    rows = result.model.statistics["by_magnification"]
    assert [row["magnification"] for row in rows] == [300.0, 800.0, 1800.0, 3500.0]
