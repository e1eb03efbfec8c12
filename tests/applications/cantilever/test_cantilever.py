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

"""Bending of a cantilever against the truth of simulated frames."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.special import ndtr

from benchmarks.thresholds.fleets.cantilever import (
    PAINTED_LENGTH_PX,
    PAINTED_PX_M,
    paint_two_beams,
)
from semcal_ros.applications.cantilever import (
    SeriesSettings,
    compare_series,
    describe_disagreement,
    find_strip,
    group_frames,
    measure_series,
)
from semcal_ros.applications.cantilever.bending import (
    Shape,
    expect_point_load,
    fit_bending,
    fit_common_shape,
    locate_end,
    locate_load,
    parse_shape,
)
from semcal_ros.applications.cantilever.edges import EdgeModel, fit_edges
from semcal_ros.applications.cantilever.undeformed import fit_base_edge
from semcal_ros.core.camera.projection import PARAMETER_NAMES
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic import Detector, Drift, preset
from semcal_ros.synthetic.specimens.cantilever import (
    CantileverScene,
    cantilever_plan,
    random_cantilever,
)

LENGTH = 35e-6
DRIFT = Drift(velocity_m_s=(6e-9, -4e-9), settling_m=(60e-9, 90e-9), wander_m=10e-9, seed=4)


def scope(size=256, width=0.12, name="jsm820"):
    return replace(preset(name), display_width_m=width).with_image_size(size, size)


def measured(plan, *, shape="free", magnification=None, reference=(0,), images=None, **options):
    """The frames of one magnification, with the true camera, and their true deflections."""
    g = magnification or plan.frames[0].magnification
    chosen = [k for k, f in enumerate(plan.frames) if f.magnification == g]
    images = images or [plan.render(k) for k in chosen]
    times = [plan.frames[k].start_time_s for k in chosen]
    truth = np.array([plan.frames[k].scene.deflection_m for k in chosen])
    camera = plan.microscope.camera_at(g)
    settings = SeriesSettings(LENGTH, shape, **options)
    timing = plan.microscope.timing
    found = measure_series(images, times, camera, timing, settings, reference=reference)
    return found, truth


# -- edges ----------------------------------------------------------------------------------------


def edge_pixels(rng, rows, shift, noise, width=1.0):
    """Pixels around both edges of a straight beam, in px."""
    along, across = np.meshgrid(np.arange(120.0), np.arange(-rows, rows + 1.0))
    line = 0.02 * along + shift
    beam = ndtr((across - line + 10.0) / width) - ndtr((across - line - 10.0) / width)
    grey = 40.0 + 90.0 * beam + rng.normal(0.0, noise, along.shape)
    return along.ravel(), across.ravel(), grey.ravel()


def test_edges_are_where_they_are_and_as_good_as_they_say():
    rng = np.random.default_rng(1)
    model = EdgeModel(1.0, 6.0, 6.0, 12.0, 9, 10.0)
    base = np.array([-10.0, 10.0]) + 0.02 * model.centres_m[:, None]
    deviations, errors = [], []
    for _ in range(30):
        shift = rng.uniform(-2.0, 2.0)
        fit = fit_edges(*edge_pixels(rng, 20, shift, 9.0), model, base)
        errors.append(fit.across_m - base - shift)
        deviations.append(errors[-1] / fit.sigma_m)
    deviations = np.array(deviations)
    # 540 edges: the RMS of unit deviates is good to 3 %.
    assert np.sqrt(np.mean(deviations**2)) == pytest.approx(1.0, abs=0.12)
    assert abs(deviations.mean()) < 4.0 / np.sqrt(deviations.size)
    # Cramer-Rao: noise / step / sqrt(rows * sum of squared derivative) = 0.1 / sqrt(12 * 0.28).
    assert np.std(errors) < 1.35 * 0.1 / np.sqrt(12 * 0.28)


def test_edges_that_do_not_agree_say_nothing():
    """The fit of such a bending once ended in a singular matrix, or in a sigma below zero."""
    u = np.linspace(0.1, 1.0, 4)
    # Every edge elsewhere by many sigmas: fewer than six agree with each other.
    moved = 1e-6 * np.random.default_rng(13).standard_cauchy((4, 2))
    for sigma_m in (1e-9, np.inf):
        found = fit_bending(u, moved, np.full((4, 2), sigma_m), LENGTH, 1e-9)
        assert np.isnan(found.deflection_m)
        assert found.sigma_m == np.inf
        assert not found.used.any()


def test_an_edge_that_is_not_there_has_no_sigma():
    rng = np.random.default_rng(2)
    along, across, grey = edge_pixels(rng, 20, 0.0, 5.0)
    model = EdgeModel(1.0, 6.0, 6.0, 12.0, 9, 10.0)
    base = np.array([-10.0, 10.0]) + 0.02 * model.centres_m[:, None]
    hidden = (along > 60) & (across < 0)
    fit = fit_edges(along[~hidden], across[~hidden], grey[~hidden], model, base)
    assert np.all(np.isinf(fit.sigma_m[6:, 0]))
    assert np.all(np.isfinite(fit.sigma_m[:, 1]))


# -- bending --------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["free", "beam", "parabola"])
def test_each_shape_finds_its_own(shape):
    u = np.linspace(0.05, 0.98, 30)
    curve = {"beam": 0.5 * (3 * u**2 - u**3), "parabola": u**2}.get(shape, 1.3 * u**2 - 0.3 * u**3)
    moved = 2e-7 * np.stack([curve, curve], axis=1)
    found = fit_bending(u, moved, np.full(moved.shape, 1e-9), LENGTH, 1e-9, parse_shape(shape))
    # The prior of no rotation costs nothing where there is none.
    assert found.deflection_m == pytest.approx(2e-7, abs=1e-13)
    assert found.used.all()


def test_sigma_of_the_deflection_is_honest():
    rng = np.random.default_rng(3)
    u = np.linspace(0.45, 0.98, 30)
    curve = np.stack([0.5 * (3 * u**2 - u**3)] * 2, axis=1)
    deviations = []
    for _ in range(300):
        offset = rng.normal(0.0, 0.8e-9)
        moved = 2e-7 * curve + offset + rng.normal(0.0, 3e-9, curve.shape)
        moved[-3:, 0] += 40e-9  # something lies on the last blocks of one edge
        found = fit_bending(u, moved, np.full(curve.shape, 3e-9), LENGTH, 0.8e-9)
        deviations.append((found.deflection_m - 2e-7) / found.sigma_m)
    # 300 deviates: the RMS is good to 4 %.
    assert np.sqrt(np.mean(np.square(deviations))) == pytest.approx(1.0, abs=0.15)


def test_the_second_order_differs_from_a_beam_by_what_theory_says():
    """A clamped parabola fitted to a beam that is loaded at its end is 1 / 12 too high there."""
    u = (np.arange(2000) + 0.5) / 2000
    moved = np.stack([0.5 * (3 * u**2 - u**3)] * 2, axis=1) * 1e-7
    # So little is known of each block that the base does not turn, as it may by 10 microradian.
    found = fit_bending(
        u, moved, np.full(moved.shape, 1e-6), LENGTH, 1e-13, parse_shape("parabola")
    )
    assert found.deflection_m == pytest.approx(1e-7 * 13 / 12, rel=2e-3)


def test_an_uncertain_shape_makes_the_deflection_uncertain_by_what_it_would_change():
    u = np.linspace(0.3, 0.8, 30)
    moved = np.stack([0.5 * (3 * u**2 - u**3)] * 2, axis=1) * 2e-7
    sigma = np.full(moved.shape, 0.3e-9)
    known, vague, other = (
        fit_bending(u, moved, sigma, LENGTH, 1e-9, Shape(value, spread))
        for value, spread in ((-0.5, 0.0), (-0.5, 0.02), (-0.48, 0.0))
    )
    change = other.deflection_m - known.deflection_m
    assert abs(change) > known.sigma_m
    # The deflection is nearly linear in so small a change of the shape.
    added = np.sqrt(vague.sigma_m**2 - known.sigma_m**2)
    assert added == pytest.approx(abs(change), rel=0.1, abs=0.0)


@pytest.mark.parametrize("load", [0.85, 0.9, 1.0])
def test_the_shape_of_a_point_load_is_pulled_towards_those_of_point_loads(load):
    """A beam that is pushed at a has the third order -1 / (3 a - 1)."""
    u = np.linspace(0.0, load, 50)
    bent = 3.0 * load * u**2 - u**3
    fitted = np.linalg.lstsq(np.stack([u**2, u**3 - u**2], axis=1), bent, rcond=None)[0]
    true = fitted[1] / fitted[0]
    assert true == pytest.approx(-1.0 / (3.0 * load - 1.0), rel=1e-9)
    for error in (-0.06, 0.06):
        expected = expect_point_load(Shape(true + error, 0.06))
        assert abs(expected.value - true) < 2.0 * expected.sigma
        # More than that of the fit only where it may as well be no point load.
        assert expected.sigma < 0.066
        # The mean of loads anywhere in the outer fifth: the integral of c over it.
        mean = -np.log(2.0 / 1.4) / 3.0 / 0.2
        assert abs(expected.value - mean) < abs(true + error - mean)
        # A place that is known tells more.
        known = expect_point_load(Shape(true + error, 0.06), (load, load))
        assert abs(known.value - true) < 0.5 * 0.06
        assert known.sigma < expected.sigma


def test_a_shape_that_is_no_point_load_stays():
    for value in (0.0, -1.0):
        expected = expect_point_load(Shape(value, 0.05, 0.01))
        assert expected.value == pytest.approx(value, abs=1e-3)
        assert expected.sigma == pytest.approx(0.05, rel=0.02)
        assert expected.relative == 0.01
    # Nothing seen: as likely as not a point load, so still vague.
    vague = expect_point_load(Shape(-0.25, 0.35))
    assert vague.sigma > 0.25


def test_the_sigma_of_an_expected_shape_is_honest():
    """Half of the beams have a point load, the others any shape; frames tell it to 0.03 to 0.2."""
    rng = np.random.default_rng(8)
    deviations = []
    for number in range(4000):
        loaded = number % 2 == 0
        true = -1.0 / (3.0 * rng.uniform(0.8, 1.0) - 1.0) if loaded else rng.normal(-0.25, 0.35)
        noise = rng.uniform(0.03, 0.2)
        # As the fit to the frames does: their noise, and a broad prior.
        share = noise**2 / (noise**2 + 0.35**2)
        seen = true + rng.normal(0.0, noise)
        fitted = Shape(seen + share * (-0.25 - seen), noise * np.sqrt(1.0 - share))
        expected = expect_point_load(fitted)
        deviations.append((expected.value - true) / expected.sigma)
    # 4000 deviates: their RMS is good to 1 to 2 %. The load's distribution is uniform, and taken for a normal one.
    assert np.sqrt(np.mean(np.square(deviations))) == pytest.approx(1.0, abs=0.07)


def hidden_frames(deflections_m, hidden):
    """Fits in which both edges of some of 40 blocks are hidden while the beam is pushed."""
    frames = []
    for d in deflections_m:
        used = np.ones((40, 2), dtype=bool)
        used[hidden if d > 50e-9 else []] = False
        # Ground beside one edge, in every frame.
        used[11, 0] = False
        frames.append(SimpleNamespace(deflection_m=d, used=used))
    return frames


def test_the_load_is_where_something_hides_the_edges():
    u = (np.arange(40) + 0.5) / 42.0
    pushes = [20e-9, 100e-9, 250e-9, 180e-9, 0.0]
    # From a place to the last block: as far as the free end. The neighbour of what is hidden is left out, too.
    first, last = locate_load(u, hidden_frames(pushes, [36, 37, 38, 39]))
    assert first == pytest.approx(37.0 / 42.0, abs=1e-12)
    assert last == 1.0
    # A needle.
    first, last = locate_load(u, hidden_frames(pushes, [29, 30, 31]))
    assert first == pytest.approx(30.0 / 42.0, abs=1e-12)
    assert last == pytest.approx(31.0 / 42.0, abs=1e-12)
    # One block is dirt; nothing hidden, nothing known; nor is it in a single frame.
    for frames in (hidden_frames(pushes, [30]), hidden_frames(pushes, []), []):
        assert locate_load(u, frames) == (0.8, 1.0)
    assert locate_load(u, hidden_frames([250e-9], [36, 37, 38])) == (0.8, 1.0)


@pytest.mark.parametrize("seed", range(4))
def test_frames_that_are_bent_alike_know_no_more_of_the_shape_than_one(seed):
    """Noise of frames without a spread once seemed to grow with the deflection, and made a sigma of a third of it."""
    rng = np.random.default_rng(seed)
    u = np.linspace(0.05, 0.98, 30)
    curve = np.stack([0.5 * (3 * u**2 - u**3)] * 2, axis=1)
    sigma = np.full(curve.shape, 3e-9)

    def frames(pushes_m):
        seen = [d * curve + rng.normal(0.0, 3e-9, curve.shape) for d in pushes_m]
        return [fit_bending(u, moved, sigma, LENGTH, 1e-9) for moved in seen]

    alike = frames([2e-7] * 6)
    shape = fit_common_shape(alike, 1e-8, 1)
    assert shape.relative == 0.0
    one = fit_common_shape(alike[:1], 1e-8, 1)
    assert shape.sigma == pytest.approx(one.sigma, rel=0.25)
    apart = fit_common_shape(frames(np.linspace(5e-8, 3e-7, 6)), 1e-8, 1)
    # The noise of the reference stays.
    assert apart.sigma < 0.95 * one.sigma


def test_frames_that_show_no_beam_leave_the_shape_to_what_is_known_before():
    """With a reference that shows none either, this once ended in a singular matrix."""
    u = np.linspace(0.1, 1.0, 4)
    unseen = fit_bending(u, np.zeros((4, 2)), np.full((4, 2), np.inf), LENGTH, 1e-9)
    assert unseen.sigma_m == np.inf
    for frames in ([unseen, unseen], []):
        assert fit_common_shape(frames, np.inf, 1) == Shape(-0.25, 0.35)


def test_a_mean_over_frames_keeps_what_they_share():
    """Four frames of a pose, each with noise of 1 nm and an error of the scale of 1 nm."""
    frame = SimpleNamespace(
        deflection_m=5e-9,
        sigma_m=np.sqrt(2.0) * 1e-9,
        noise_m=1e-9,
        by_length_m=5e-9,
        by_length_sigma_m=1e-9,
    )
    series = SimpleNamespace(magnification=5000.0, frames=(frame,) * 8)
    table = compare_series([series], poses=2)
    # The scale as a whole; of the noise a fifth is that of the reference, also a mean of four, and
    # the rest averages out.
    np.testing.assert_allclose(table.sigma_m, 1e-9 * np.sqrt(1.0 + 0.2 + 0.8 / 4.0))
    np.testing.assert_allclose(table.by_length_sigma_m, 1e-9 * np.sqrt(0.2 + 0.8 / 4.0))


def test_the_end_recedes_as_the_beam_bends():
    # Euler and Bernoulli: 3/5 of the deflection squared over the length.
    receded = LENGTH - locate_end(np.array([1.5e-6, -0.5e-6]), LENGTH)
    assert receded == pytest.approx(0.6 * (1e-6) ** 2 / LENGTH, rel=3e-3)


def test_settings_are_checked():
    with pytest.raises(InvalidValueError, match="finite number greater than 0"):
        SeriesSettings(0.0)
    with pytest.raises(InvalidValueError, match="one of free, beam, parabola"):
        SeriesSettings(LENGTH, "cubic")


# -- finding --------------------------------------------------------------------------------------


@pytest.mark.parametrize("rotation", [-9.0, 35.0, 100.0, 171.0, -60.0])
def test_the_cantilever_is_found_at_any_rotation(rotation):
    plan = cantilever_plan(
        scope(256, 0.45),
        pushes=(0.0,),
        magnifications=(6450.0,),
        rotation_rad=np.deg2rad(rotation),
    )
    strip = find_strip(plan.render(0))
    truth = plan.truth()["frames"][0]
    assert strip.base_seen and strip.tip_seen
    # To be refined later, over 14 px.
    assert np.hypot(*(strip.base_px - truth["base_px"])) < 7.0
    assert np.hypot(*(strip.tip_px - truth["end_px"])) < 7.0
    assert strip.half_width_px == pytest.approx(0.5 * 3.5e-6 / (0.45 / 6450 / 256), abs=2.5)


def test_a_view_of_the_end_only():
    plan = cantilever_plan(scope(), pushes=(0.0,), magnifications=(7760.0,), view="end")
    strip = find_strip(plan.render(0))
    assert strip.tip_seen and not strip.base_seen
    assert np.hypot(*(strip.tip_px - plan.truth()["frames"][0]["end_px"])) < 7.0


def test_clicks_say_where_it_is():
    plan = cantilever_plan(scope(), pushes=(0.0,), magnifications=(7760.0,), view="end")
    truth = plan.truth()["frames"][0]
    base, tip = (np.array(truth[k]) + 4.0 for k in ("base_px", "end_px"))
    strip = find_strip(plan.render(0), base_px=base, tip_px=tip)
    assert strip.tip_seen and not strip.base_seen
    dx, dy = np.subtract(truth["end_px"], truth["base_px"])
    x, y = strip.tip_px - truth["end_px"]
    assert (
        abs(dx * y - dy * x) / np.hypot(dx, dy) < 2.5
    )  # across the beam it is found, not taken from the click


def random_plan(seed, magnification, pushes):
    """A random scene with both ends and a pusher in view."""
    drawn = random_cantilever(seed, base_in_view=True)
    plan = cantilever_plan(
        scope(1024, 0.4),
        scene=drawn.scene,
        largest_deflection_m=drawn.largest_deflection_m,
        rotation_rad=drawn.rotation_rad,
        magnifications=(magnification,),
        pushes=pushes,
        seed=seed,
    )
    return drawn.scene, plan


def random_series(seed, magnification, pushes):
    """The first picture of a random scene, and its measurement, with base and tip where they are given."""
    scene, plan = random_plan(seed, magnification, pushes)
    images = [plan.render(k) for k in range(len(plan))]
    times = [frame.start_time_s for frame in plan.frames]
    camera, timing = plan.microscope.camera_at(magnification), plan.microscope.timing

    def measure(**ends):
        settings = SeriesSettings(scene.length_m, **ends)
        return measure_series(images, times, camera, timing, settings)

    return images[0], measure


@pytest.mark.parametrize(
    ("seed", "magnification"),
    [
        (14, 6450.0),
        pytest.param(82, 8890.0, marks=pytest.mark.long),
        pytest.param(43, 6450.0, marks=pytest.mark.long),
        pytest.param(63, 6450.0, marks=pytest.mark.long),
    ],
)
def test_a_body_of_more_contrast_is_not_taken_for_the_cantilever(seed, magnification):
    """A pusher, or the edge of the holder and another one, may be a stronger strip: the length tells."""
    scene, plan = random_plan(seed, magnification, (0.0,))
    truth, image = plan.truth()["frames"][0], plan.render(0)
    length_px = float(np.hypot(*np.subtract(truth["end_px"], truth["base_px"])))
    # The maker's 3 %, either way.
    for stated_px in (0.97 * length_px, 1.03 * length_px):
        strip = find_strip(image, length_px=stated_px)
        assert strip.base_seen and strip.tip_seen
        # To be refined later, over 14 px.
        assert np.hypot(*(strip.base_px - truth["base_px"])) < 9.0
        width_px = scene.width_m / scene.length_m * length_px
        assert 2.0 * strip.half_width_px == pytest.approx(width_px, rel=0.1)
    # Without the length it is the other body, or this test shows nothing.
    other = find_strip(image)
    assert not (other.base_seen and other.tip_seen)


@pytest.mark.long
def test_the_shape_of_a_pushed_beam_knows_the_pusher(monkeypatch):
    """The inner corner of the pusher touches the beam at 0.916 of its length."""
    scene, _ = random_plan(1, 7760.0, (0.0,))
    _, measure = random_series(1, 7760.0, (0.0, 0.3, 0.6, 1.0))
    located = []

    def remember(u, frames):
        located.append(locate_load(u, frames))
        return located[-1]

    monkeypatch.setattr("semcal_ros.applications.cantilever.series.locate_load", remember)
    found = measure()
    assert scene.load == pytest.approx(0.917, abs=1e-3)
    # Two thirds of a block.
    assert located[0][0] == pytest.approx(scene.load, abs=0.012)
    assert located[0][1] == 1.0
    assert found.shape.value == pytest.approx(
        -1.0 / (3.0 * scene.load - 1.0), abs=3.0 * found.shape.sigma
    )


@pytest.mark.long
def test_what_moves_along_itself_is_no_clamped_beam():
    image, measure = random_series(14, 6450.0, (0.0, 0.4, 1.0))
    other = find_strip(image)
    taken = {"the beam": {}, "the pusher": {"base_px": other.base_px, "tip_px": other.tip_px}}
    told = {
        name: [note for note in measure(**ends).notes if "moves along it" in note]
        for name, ends in taken.items()
    }
    assert told["the beam"] == []
    # It comes closer by its gap of 600 nm, and by the deflection.
    assert len(told["the pusher"]) == 1
    assert "is it the pusher?" in told["the pusher"][0]


@pytest.mark.long
def test_of_two_parallel_beams_the_one_that_bends_is_measured():
    """Both are alike, at 100 nm per pixel; the lower one bends as a beam that is pushed at its end."""
    pixel_m, length = PAINTED_PX_M, PAINTED_LENGTH_PX
    camera = replace(scope(256, name="ideal").camera_at(6450.0), m=1.0 / pixel_m)
    truth_px = np.array([0.0, 1.0, 2.5, 4.0])
    images = paint_two_beams(truth_px)
    settings = SeriesSettings(length * pixel_m)
    found = measure_series(images, [0.0, 5.0, 10.0, 15.0], camera, None, settings)
    assert any("the one that bends was measured" in note for note in found.notes)
    for frame, push in zip(found.frames[1:], truth_px[1:], strict=True):
        assert abs(frame.deflection_m) == pytest.approx(push * pixel_m, abs=4.0 * frame.sigma_m)
        assert frame.sigma_m < 0.1 * pixel_m
    clicks = {"base_px": (40.0, 80.0), "tip_px": (189.0, 80.0)}
    # Where the lower one is at rest and where it is bent most.
    other = measure_series(
        [images[0], images[-1]],
        [0.0, 15.0],
        camera,
        None,
        SeriesSettings(length * pixel_m, **clicks),
    )
    assert max(abs(f.deflection_m) for f in other.frames) < 0.1 * pixel_m


@pytest.mark.long
def test_a_base_that_moves_is_that_of_no_cantilever():
    """The tip of a pusher whose other end is out of view may be taken for a base."""
    image, measure = random_series(14, 6450.0, (0.0, 0.4, 1.0))
    other = find_strip(image)
    outwards = other.base_px - other.tip_px
    taken = {"base_px": other.tip_px, "tip_px": other.base_px + 0.2 * outwards}
    wrong, right = measure(**taken), measure()
    assert wrong.undeformed.axis.base_seen and right.undeformed.axis.base_seen
    assert any("the base of what was measured moves" in note for note in wrong.notes)
    assert not any("moves" in note for note in right.notes)


@pytest.mark.parametrize("turn_deg", [-8.0, 0.0, 3.0, 12.0])
def test_the_edge_of_a_holder_may_be_turned(turn_deg):
    """What counts is where it crosses the centre line of the beam."""
    along, across = np.meshgrid(np.arange(0.0, 60.0), np.arange(-50.0, 51.0))
    edge = 21.3 + np.tan(np.radians(turn_deg)) * across
    noise = np.random.default_rng(6).normal(0.0, 5.0, along.shape)
    grey = 50.0 + 90.0 * ndtr(edge - along) + noise
    view = along.ravel(), across.ravel(), grey.ravel()
    found = fit_base_edge(view, 19.0, EdgeModel(1.0, 6.0, 30.0, 12.0, 9, 10.0), 1.0)
    assert 19.0 - found.place_m == pytest.approx(21.3, abs=4.0 * found.sigma_m)
    assert found.sigma_m < 0.03


def painted(beams, *, holder=True):
    """A picture of 256 px with a holder on its left; beams are (row, half width, length, grey level)."""
    image = np.full((256, 256), 60.0)
    if holder:
        image[:, :40] = 150.0
    for row, half, length, grey in beams:
        image[row - half : row + half + 1, 30 : 40 + length] = grey
    noise = np.random.default_rng(5).normal(0.0, 6.0, image.shape)
    return np.clip(gaussian_filter(image, 1.0) + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("brighter", [150.0, 200.0])
def test_one_of_two_parallel_beams_is_found_and_the_other_told(brighter):
    """The left edge of one and the right edge of the other are as strong a pair as those of a beam."""
    image = painted([(100, 8, 150, 150.0), (140, 8, 150, brighter)])
    strip = find_strip(image, length_px=150.0)
    assert strip.half_width_px == pytest.approx(8.5, abs=1.5)
    assert min(abs(strip.base_px[1] - row) for row in (100.0, 140.0)) < 1.5
    (rival,) = strip.rivals
    assert abs(rival.base_px[1] - strip.base_px[1]) == pytest.approx(40.0, abs=2.0)
    # A neighbour of another length is none.
    strip = find_strip(painted([(100, 8, 150, 150.0), (140, 8, 110, brighter)]), length_px=150.0)
    assert strip.base_px[1] == pytest.approx(100.0, abs=1.5)
    assert strip.rivals == ()


@pytest.mark.parametrize(("row", "other"), [(100, 140), (140, 100)])
def test_two_clicks_choose_among_parallel_beams(row, other):
    """The other one is brighter."""
    image = painted([(row, 8, 150, 130.0), (other, 8, 150, 210.0)])
    strip = find_strip(image, base_px=(42.0, row + 3.0), tip_px=(188.0, row - 3.0))
    assert strip.base_px[1] == pytest.approx(row, abs=1.5)
    assert strip.tip_px[1] == pytest.approx(row, abs=1.5)
    assert strip.half_width_px == pytest.approx(8.5, abs=1.5)


def test_pictures_without_a_cantilever_are_refused():
    with pytest.raises(InvalidValueError, match="no strip"):
        find_strip(np.full((128, 128), 80, dtype=np.uint8))
    with pytest.raises(InvalidValueError, match="both or none"):
        find_strip(np.zeros((64, 64), np.uint8), base_px=(1.0, 2.0))


# -- the whole ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def end_plan():
    """The end of the beam at rest, half and fully bent."""
    return cantilever_plan(
        scope(256), pushes=(0.0, 0.5, 1.0), magnifications=(7760.0,), view="end", seed=6
    )


@pytest.fixture(scope="module")
def end_images(end_plan):
    return [end_plan.render(k) for k in range(len(end_plan))]


@pytest.fixture(scope="module")
def end_found(end_plan, end_images):
    """What is found at the end of the beam."""
    return measured(end_plan, images=end_images)[0]


@pytest.mark.parametrize(
    ("base", "tip"), [((50, 50), (200, 200)), ((30, 210), (225, 190)), ((150, 50), (155, 200))]
)
def test_points_that_are_not_on_the_beam_are_refused(end_plan, end_images, base, tip):
    camera, settings = (
        scope(256).camera_at(7760.0),
        SeriesSettings(LENGTH, base_px=base, tip_px=tip),
    )
    with pytest.raises(InvalidValueError, match="no beam where one was looked for"):
        measure_series(end_images[:1], [0.0], camera, end_plan.microscope.timing, settings)


@pytest.mark.long
def test_a_dark_beam_is_measured_as_its_negative(end_plan, end_images, end_found):
    negatives = [255 - image for image in end_images]
    bright, dark = end_found, measured(end_plan, images=negatives)[0]
    assert not find_strip(end_images[0]).is_dark
    assert find_strip(negatives[0]).is_dark
    for one, other, truth in zip(bright.frames, dark.frames, (0.0, 125e-9, 250e-9), strict=True):
        assert other.deflection_m == pytest.approx(one.deflection_m, abs=0.1 * one.sigma_m + 1e-12)
        assert abs(other.deflection_m - truth) < 4.0 * other.sigma_m + 1e-12


@pytest.mark.parametrize(
    ("length_m", "told"),
    [
        (3e-6, "a length of 3 um for a cantilever that is at least"),
        # 13.8 um of it are in view.
        (12e-6, "a length of 12 um for a cantilever that is at least 13"),
        (35.0, "a cantilever of 35 m where"),
    ],
)
def test_a_length_of_less_than_what_is_in_view_is_refused(length_m, told):
    plan = cantilever_plan(scope(256), pushes=(0.0,), magnifications=(6450.0,), view="end", seed=6)
    with pytest.raises(InvalidValueError, match=told) as refused:
        measure_series(
            [plan.render(0)],
            [0.0],
            plan.microscope.camera_at(6450.0),
            None,
            SeriesSettings(length_m),
        )
    assert "check --length" in str(refused.value)


@pytest.mark.long
def test_a_whole_beam_of_another_length_is_refused_and_a_small_difference_told():
    plan = cantilever_plan(scope(256, 0.4), pushes=(0.0,), magnifications=(8890.0,), seed=2)
    camera, image = plan.microscope.camera_at(8890.0), plan.render(0)

    def with_length(length_m, camera=camera):
        return measure_series([image], [0.0], camera, None, SeriesSettings(length_m))

    # 33 um are 6 % away: the maker's 3 % are no more than 5.2 % in three sigmas of a uniform distribution.
    for length_m in (12e-6, 33e-6, 37.1e-6):
        told = rf"{1e6 * length_m:g} um for a cantilever that is 34\.99 um long.*check --length"
        with pytest.raises(InvalidValueError, match=told):
            with_length(length_m)
    found = with_length(33.8e-6)
    assert any("not 33.8 um: check the length" in note for note in found.notes)
    # A scale that is known to 4 % contradicts nothing by 6 %.
    covariance = np.zeros((len(PARAMETER_NAMES), len(PARAMETER_NAMES)))
    covariance[0, 0] = (0.04 * camera.m) ** 2
    found = with_length(33e-6, replace(camera, covariance=covariance))
    assert any("not 33 um: check the length" in note for note in found.notes)


@pytest.mark.long
def test_a_shape_that_the_beam_does_not_have_is_told_and_in_the_sigma(end_plan, end_images):
    """A loaded beam bends by a third order that a parabola does not have."""
    found, truth = measured(end_plan, shape="parabola", images=end_images)
    assert any("does not bend as --shape says" in note for note in found.notes)
    last = found.frames[-1]
    assert last.deflection_m - truth[-1] > 10e-9
    assert abs(last.deflection_m - truth[-1]) < 2.0 * last.sigma_m
    fitting, _ = measured(end_plan, shape="beam", images=end_images)
    assert not any("--shape" in note for note in fitting.notes)


@pytest.mark.long
@pytest.mark.slow
def test_the_end_in_view():
    plan = cantilever_plan(
        scope(256),
        pushes=(0.0, 0.3, 1.0, 0.5),
        magnifications=(7760.0,),
        view="end",
        drift=DRIFT,
        seed=1,
    )
    found, truth = measured(plan)
    errors = np.array([f.deflection_m for f in found.frames]) - truth
    sigma = np.array([f.sigma_m for f in found.frames])
    assert found.drift.accepted.all()
    # A twelfth of a pixel of 60 nm.
    assert np.all(sigma[1:] < 5e-9)
    assert np.all(np.abs(errors[1:]) < 4.0 * sigma[1:])
    assert abs(errors[0]) < 0.5e-9
    assert np.isnan(found.frames[2].by_length_m)
    # The drift is that of the specimen, not of what moves in it.
    true = np.array([plan.drift_at_centre_m(k) for k in range(len(plan))])
    away = found.drift.drift_m - (true - true[0])
    assert np.all(np.abs(away) < 3e-9)
    tip = np.array(plan.truth()["frames"][2]["end_px"])
    moved = plan.microscope.camera_at(7760.0).m * (plan.drift_at_centre_m(2) + [0.0, 250e-9])
    assert np.hypot(*(found.frames[2].tip_px - tip - moved)) < 2.0


@pytest.mark.long
@pytest.mark.slow
def test_both_ends_in_view_give_two_scales():
    plan = cantilever_plan(
        scope(384, 0.4),
        pushes=(0.0, 1.0),
        magnifications=(8890.0,),
        frames_per_pose=2,
        drift=DRIFT,
        seed=2,
    )
    found, truth = measured(plan, reference=(0, 1))
    # The true camera: both scales are the same but for where the ends are, a pixel being 117 nm.
    assert abs(found.undeformed.length_m - LENGTH) < 4.0 * found.undeformed.length_sigma_m + 10e-9
    assert found.undeformed.length_sigma_m < 20e-9
    for frame, true in zip(found.frames[2:], truth[2:], strict=True):
        for value, sigma in (
            (frame.deflection_m, frame.sigma_m),
            (frame.by_length_m, frame.by_length_sigma_m),
        ):
            assert abs(value - true) < 4.0 * sigma
            assert sigma < 12e-9


def test_a_beam_seen_edge_on():
    """300 nm thick: the beam is 4 px wide."""
    scene = CantileverScene(width_m=300e-9)
    plan = cantilever_plan(
        scope(256), scene=scene, pushes=(0.0, 1.0), magnifications=(6450.0,), view="end", seed=3
    )
    found, truth = measured(plan)
    frame = found.frames[1]
    assert abs(frame.deflection_m - truth[1]) < 4.0 * frame.sigma_m
    assert frame.sigma_m < 8e-9


@pytest.mark.long
@pytest.mark.slow
def test_a_blurred_and_noisy_recording_knows_less():
    plan = cantilever_plan(
        scope(256), pushes=(0.0, 1.0), magnifications=(7760.0,), view="end", seed=4
    )
    noisy = replace(plan, detector=Detector(electrons=40.0, blur_px=1.6))
    good, truth = measured(plan)
    bad, _ = measured(noisy)
    assert bad.frames[1].sigma_m > 1.5 * good.frames[1].sigma_m
    assert abs(bad.frames[1].deflection_m - truth[1]) < 4.0 * bad.frames[1].sigma_m


def test_frames_of_other_sizes_and_references_are_refused():
    camera = preset("jsm820").camera_at(7760.0)
    images = [np.zeros((64, 64), np.uint8), np.zeros((64, 96), np.uint8)]
    with pytest.raises(InvalidValueError, match="one size"):
        measure_series(images, [0.0, 1.0], camera, None, SeriesSettings(LENGTH))
    with pytest.raises(InvalidValueError, match="reference frames"):
        measure_series(images[:1], [0.0], camera, None, SeriesSettings(LENGTH), reference=(1,))


# -- repeatability --------------------------------------------------------------------------------


def test_frames_closer_than_a_scan_takes_are_instants(end_plan, end_images, end_found):
    """The drift between two of them, over a time that is none, is no velocity within a frame."""
    images = end_images
    truth = np.array([f.scene.deflection_m for f in end_plan.frames])
    camera, timing = scope(256).camera_at(7760.0), end_plan.microscope.timing
    found = measure_series(images, [0.0, 1e-3, 2e-3], camera, timing, SeriesSettings(LENGTH))
    assert any("each frame is treated as an instant" in note for note in found.notes)
    for frame, true in zip(found.frames, truth, strict=True):
        assert abs(frame.deflection_m - true) < 4.0 * frame.sigma_m + 1e-12
    assert not any("instant" in note for note in end_found.notes)
    with pytest.raises(InvalidValueError, match=r"times do not grow.*--frame-interval"):
        measure_series(images, [0.0, 0.0, 1.0], camera, timing, SeriesSettings(LENGTH))


def test_frames_are_cut_into_poses():
    assert group_frames(6, 3) == [[0, 1], [2, 3], [4, 5]]
    assert group_frames(2, None) == [[0], [1]]
    with pytest.raises(InvalidValueError, match="7 frames for 3 poses"):
        group_frames(7, 3)


@pytest.mark.slow
def test_the_spread_is_that_of_the_poses():
    plan = cantilever_plan(
        scope(256),
        pushes=(0.0, 1.0),
        magnifications=(6450.0, 8890.0),
        view="end",
        drift=DRIFT,
        seed=5,
    )
    series = [measured(plan, magnification=g)[0] for g in (6450.0, 8890.0)]
    table = compare_series(series)
    values = [s.frames[1].deflection_m for s in series]
    assert table.spread_m[1] == pytest.approx(np.std(values, ddof=1))
    assert table.rms_spread_m == pytest.approx(table.spread_m[1])
    assert table.spread_m[0] < 0.5e-9
    assert table.expected_spread_m == pytest.approx(np.sqrt(np.mean(table.sigma_m[:, 1] ** 2)))
    with pytest.raises(InvalidValueError, match="different numbers of frames"):
        compare_series([series[0], replace(series[1], frames=series[1].frames[:1])])


def test_magnifications_that_measured_different_things_are_told():
    """One of three follows another body, which does not bend."""

    def series(magnification, width_m, deflections_m):
        frames = tuple(
            SimpleNamespace(
                deflection_m=value,
                sigma_m=1.5e-9,
                noise_m=1.2e-9,
                by_length_m=value,
                by_length_sigma_m=1.5e-9,
            )
            for value in deflections_m
        )
        axis = SimpleNamespace(half_width_m=0.5 * width_m)
        return SimpleNamespace(
            magnification=magnification, frames=frames, undeformed=SimpleNamespace(axis=axis)
        )

    alike = [
        series(6450.0, 2.5e-6, [0.0, 51e-9, 101e-9]),
        series(7760.0, 2.52e-6, [0.0, 50e-9, 98e-9]),
        series(8890.0, 2.6e-6, [0.0, 52e-9, 100e-9]),
    ]
    assert describe_disagreement(alike, compare_series(alike)) == []
    other = [series(6450.0, 5.3e-6, [0.0, 1e-9, 0.0]), *alike[1:]]
    width, spread = describe_disagreement(other, compare_series(other))
    assert width.startswith("the beam is 5.3 um at 6450x, 2.52 um at 7760x, 2.6 um at 8890x wide")
    # Standard deviations of (1, 50, 52) and (0, 98, 100): 28.9 and 57.2 nm, RMS 45.3 nm.
    assert "differ by 45 nm RMS where their sigmas predict 1.5 nm" in spread
    assert "most at 6450x in pose 3, by -98 nm" in spread
    # A pose that is nowhere known, and one that one of them lacks.
    gaps = [
        series(6450.0, 2.5e-6, [0.0, np.nan, np.nan, 1e-9]),
        series(7760.0, 2.5e-6, [0.0, np.nan, 98e-9, 98e-9]),
        series(8890.0, 2.5e-6, [0.0, np.nan, 100e-9, 100e-9]),
    ]
    for one in gaps:
        for frame in one.frames:
            if np.isnan(frame.deflection_m):
                frame.noise_m = np.inf
    (spread,) = describe_disagreement(gaps, compare_series(gaps))
    assert "most at 6450x in pose 4, by -97 nm" in spread
    # One magnification has nothing to differ from.
    assert describe_disagreement(alike[:1], compare_series(alike[:1])) == []
