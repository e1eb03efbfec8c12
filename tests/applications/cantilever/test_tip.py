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

"""The end of beams with tips of any outline, against the truth of simulated frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.applications.cantilever.edges import EdgeModel
from semcal_ros.applications.cantilever.finding import find_strip
from semcal_ros.applications.cantilever.series import SeriesSettings, measure_series
from semcal_ros.applications.cantilever.tip import find_apex, fit_tip
from semcal_ros.synthetic import Detector, preset
from semcal_ros.synthetic.specimens.cantilever import (
    TIPS,
    BeamTip,
    CantileverScene,
    cantilever_plan,
    make_tip,
    random_cantilever,
)
from semcal_ros.synthetic.specimens.substrate import Substrate

PIXEL_M = 40e-9
LENGTH_M, WIDTH_M = 35e-6, 3e-6
END_PX = 170


def pixels(tip, seed, ground="islands", rim=0.12):
    """Pixels around the end of a beam, in coordinates along and across its axis, and the end itself."""
    rng = np.random.default_rng([seed, 5])
    end_m = rng.uniform(-0.5, 0.5) * PIXEL_M
    detector = Detector()
    pad = detector.pad_px
    columns, rows = np.arange(-pad, 240 + pad), np.arange(-70 - pad, 71 + pad)
    x, y = np.meshgrid(PIXEL_M * (columns - END_PX), PIXEL_M * rows)
    scene = CantileverScene(
        length_m=LENGTH_M,
        width_m=WIDTH_M,
        tip=tip,
        rim=rim,
        substrate=Substrate(ground, 0.2, 0.08, 1.5e-6, seed),
    )
    light = scene.reflectivity(x + LENGTH_M - end_m, y.copy(), PIXEL_M * np.eye(2))
    grey = detector.expose(light.astype(np.float32), rng).astype(float)
    inner = slice(pad, -pad)
    return (x[inner, inner].ravel(), y[inner, inner].ravel(), grey.ravel()), end_m


def fitted(tip, seed, ground="islands", rim=0.12):
    """The fit and the error of its apex; the search starts where the edges of the strip would end."""
    samples, end_m = pixels(tip, seed, ground, rim)
    apex_m = find_apex(samples, -tip.length_m, 0.5 * WIDTH_M, PIXEL_M)
    model = EdgeModel(1.1 * PIXEL_M, 6.0 * PIXEL_M, -6e-6, 12.0 * PIXEL_M, 9, 0.5 * WIDTH_M)
    fit = fit_tip(samples, apex_m, model, PIXEL_M)
    return fit, fit.apex_m - end_m


@pytest.mark.parametrize("name", TIPS)
def test_the_apex_is_where_it_is_and_as_good_as_it_says(name):
    errors, deviations = [], []
    for seed in range(3):
        tip = make_tip(name, WIDTH_M, np.random.default_rng(seed))
        fit, error = fitted(tip, seed, ("islands", "grains", "fibres")[seed])
        errors.append(error)
        deviations.append(error / fit.sigma_m)
        # A straight step through the middle of a round end is 0.7 um short.
        assert fit.sigma_m < PIXEL_M
        # What narrows is left to the tip: with facets of some pixels less would do, too.
        assert fit.flank_m > tip.length_m - 5.0 * PIXEL_M
    assert np.max(np.abs(errors)) < 0.5 * PIXEL_M
    assert np.max(np.abs(deviations)) < 3.0


@pytest.mark.long
@pytest.mark.slow
def test_a_bright_rim_is_in_the_uncertainty():
    """The model of an edge has none: it pulls the apex outwards, and the farther the fit reaches, the more."""
    made = [make_tip(name, WIDTH_M, np.random.default_rng(0)) for name in TIPS]
    bright, none = ([fitted(tip, 0, rim=rim) for tip in made] for rim in (0.3, 0.0))
    # One alike over all tips: 0.2 px, where noise would have moved it by less than a tenth.
    assert np.mean([error for _, error in bright]) > 0.1 * PIXEL_M
    assert abs(np.mean([error for _, error in none])) < 0.1 * PIXEL_M
    deviations = np.array([error / fit.sigma_m for fit, error in bright])
    assert np.sqrt(np.mean(deviations**2)) < 2.0
    sigmas_m = [np.mean([fit.sigma_m for fit, _ in fits]) for fits in (bright, none)]
    assert sigmas_m[0] > 1.3 * sigmas_m[1]


def test_a_pointed_tip_ends_at_its_point():
    fit, error = fitted(BeamTip(WIDTH_M, 0.0), 4)
    # Over its last two pixels the point is narrower than the beam spot.
    assert abs(error) < 3.0 * fit.sigma_m
    assert abs(error) < 2.0 * PIXEL_M


def test_an_end_that_does_not_show_is_not_made_up():
    (along, across, grey), _ = pixels(BeamTip(), 0)
    noise = np.random.default_rng(1).normal(100.0, 9.0, grey.size)
    assert find_apex((along, across, noise), 0.0, 0.5 * WIDTH_M, PIXEL_M) == pytest.approx(
        0.0, abs=4.0 * WIDTH_M
    )
    model = EdgeModel(1.1 * PIXEL_M, 6.0 * PIXEL_M, -6e-6, 12.0 * PIXEL_M, 9, 0.5 * WIDTH_M)
    fit = fit_tip((along, across, noise), 0.0, model, PIXEL_M)
    # In noise, chance finds some edges; they may not claim a place to a pixel.
    assert fit is None or fit.sigma_m > PIXEL_M


@pytest.mark.parametrize(("name", "seed"), [("semicircular", 8), ("tapered", 9)])
def test_a_beam_with_such_a_tip_bends_by_what_it_bends(name, seed):
    """A round end once made 236.6 +- 5.9 nm of 250 nm, a tapered one was taken for the base."""
    tip = make_tip(name, 3.5e-6, np.random.default_rng(seed))
    scene = CantileverScene(tip=tip, pusher_m=(35e-6 - tip.length_m - 0.8e-6, 38e-6))
    scope = replace(preset("jsm820"), display_width_m=0.12).with_image_size(256, 256)
    plan = cantilever_plan(
        scope, scene=scene, pushes=(0.0, 1.0), magnifications=(7760.0,), view="end", seed=seed
    )
    images = [plan.render(k) for k in range(2)]
    strip = find_strip(images[0])
    assert strip.tip_seen and not strip.base_seen
    times = [f.start_time_s for f in plan.frames]
    camera = scope.camera_at(7760.0)
    found = measure_series(images, times, camera, scope.timing, SeriesSettings(35e-6))
    last = found.frames[-1]
    assert abs(last.deflection_m - 250e-9) < 3.0 * last.sigma_m
    assert last.sigma_m < 8e-9
    end = np.array(plan.truth()["frames"][0]["end_px"])
    axis = found.undeformed.axis
    apex = axis.point(np.array([axis.visible_m[1]]), np.zeros(1))
    seen = camera.project(np.column_stack([apex, [[0.0]]]))[0]
    # Where it counts from is the apex, to half a pixel.
    assert np.hypot(*(seen - end)) < 0.5


def test_the_gap_between_a_dark_beam_and_a_dark_pusher_is_no_beam():
    """It is a bright strip with edges as sharp as the beam's; this scene was refused."""
    one = random_cantilever(14)
    scope = replace(preset("jsm820"), display_width_m=0.12).with_image_size(256, 256)
    plan = cantilever_plan(
        scope,
        scene=one.scene,
        pushes=(0.0,),
        magnifications=(8890.0,),
        rotation_rad=one.rotation_rad,
        view="end",
        seed=14,
    )
    strip = find_strip(plan.render(0))
    assert strip.is_dark and strip.tip_seen and not strip.base_seen
    pixel_m = scope.nominal_pixel_size_m(8890.0)
    assert strip.half_width_px == pytest.approx(0.5 * one.scene.width_m / pixel_m, abs=2.5)
