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

"""The defects of a lattice tell its shift, also beside a tool, which has no say in it."""

from __future__ import annotations

from typing import cast

import cv2
import numpy as np
import pytest
from scipy import integrate, optimize, special, stats

from semcal_ros.core.arrays import Array
from semcal_ros.core.registration.defects import (
    _Candidate,
    _count_left_defects,
    _find_least_evidence,
    _weigh,
)
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.registration.inverse_compositional import Alignment, align
from semcal_ros.core.registration.noise_spectrum import normal_deviations
from semcal_ros.core.registration.register import Registration, prepare_reference, register_pair
from semcal_ros.core.registration.specimen import noise_beside_tools
from semcal_ros.core.registration.thresholds import DEFECT_EVIDENCE_MAX, EVIDENCE_MIN
from semcal_ros.core.registration.tiles import Pyramid
from tests.helpers.drift_scenes import lattice, noisy

SIZE = 192
#: A tip from the left, that moves by itself: where its apex is, px.
TIP_AT = np.array([80.0, 90.0])


def draw_lattice(
    period: float, angle: float, shift: Array, defects: Array, *, contrast: float = 1.0
) -> Array:
    """A lattice of squares of ``period`` px, and particles (n, 2) on it."""
    whole = contrast * lattice(SIZE, period, (float(shift[0]), float(shift[1])), angle)
    y, x = np.mgrid[:SIZE, :SIZE]
    for defect in defects + shift:
        whole = whole + 2.0 * np.exp(-((x - defect[0]) ** 2 + (y - defect[1]) ** 2) / 18.0)
    return np.asarray(whole)


def cover(picture: Array, apex: Array, level: float = 4.0, grain: Array | None = None) -> Array:
    """A picture with a tip over it."""
    corners = np.array([[-400.0, -70.0], [-30.0, -55.0], [0.0, 0.0], [-30.0, 55.0], [-400.0, 70.0]])
    part = np.zeros((SIZE, SIZE), np.uint8)
    cv2.fillPoly(
        part, [np.rint(16.0 * (corners + apex)).astype(np.int32)], 255, cv2.LINE_AA, shift=4
    )
    share = cv2.GaussianBlur(part.astype(np.float64) / 255.0, (0, 0), 0.8)
    return np.asarray((1.0 - share) * picture + share * (level if grain is None else level + grain))


def compare(first: Array, second: Array, guess: Array, sigma_px: float) -> Registration:
    """The second picture against the first one, both with noise."""
    pair = noisy(first, 4.0, 1), noisy(second, 4.0, 2)
    return register_pair(*pair, guess_px=guess, guess_covariance=np.eye(2) * sigma_px**2)


@pytest.mark.parametrize("seed", range(4))
def test_defects_tell_the_shift_beside_a_tool_that_came_in(seed: int) -> None:
    rng = np.random.default_rng(seed)
    period, angle = rng.uniform(4.0, 5.5), rng.uniform(0.0, 0.7)
    shift = rng.uniform(-4.0, 4.0, 2)
    defects = np.column_stack([rng.uniform(120.0, 175.0, 6), np.linspace(20.0, 170.0, 6)])
    first = draw_lattice(period, angle, np.zeros(2), defects)
    second = cover(draw_lattice(period, angle, shift, defects), TIP_AT)
    found = compare(first, second, shift + 0.2, 0.5)
    assert found.accepted, found.reason
    np.testing.assert_allclose(found.shift_px, shift, atol=0.06)
    assert found.moving is not None
    columns = np.flatnonzero(found.moving.draw((SIZE, SIZE)).any(axis=0))
    assert columns.max() < TIP_AT[0] + 25.0
    # A jump by a period is seen, whatever was predicted: the tool does not hide it.
    side = 2.0 * period * np.array([np.cos(angle), np.sin(angle)])
    jumped = cover(draw_lattice(period, angle, shift + side, defects), TIP_AT)
    after = compare(first, jumped, shift, 0.5)
    assert not after.accepted or np.max(np.abs(after.shift_px - shift - side)) < 0.06


@pytest.mark.parametrize("rough", [False, True])
@pytest.mark.parametrize("of_lattice", [False, True])
def test_a_tool_over_a_perfect_lattice_tells_no_period(of_lattice: bool, rough: bool) -> None:
    """It may have moved against the lattice by a period, as one that rests does where the lattice drifts by one."""
    angle, period = 0.3, 5.0
    side = 2.0 * period * np.array([np.cos(angle), np.sin(angle)])
    none = np.zeros((0, 2))
    grain = np.random.default_rng(3).normal(size=(SIZE, SIZE))
    grain = 4.0 * cv2.GaussianBlur(grain, (0, 0), 2.0)
    pair = []
    for k in (0, 1):
        moved = k * side
        picture = draw_lattice(period, angle, moved if of_lattice else np.zeros(2), none)
        apex = TIP_AT if of_lattice else TIP_AT + moved
        grown = cv2.warpAffine(
            grain,
            np.array([[1.0, 0.0, apex[0]], [0.0, 1.0, apex[1]]]),
            (SIZE, SIZE),
            flags=cv2.INTER_CUBIC,
            borderMode=cv2.BORDER_WRAP,
        )
        pair.append(cover(picture, apex, grain=grown if rough else None))
    for sigma_px in (0.3, 8.0):
        assert "ambiguous" in compare(*pair, np.zeros(2), sigma_px).reason


def test_a_tool_that_outshines_a_lattice_does_not_choose_its_period() -> None:
    """The highest peak of the correlation is that of the tool, which has moved by a period against the specimen."""
    angle, period, shift = 0.3, 5.0, np.array([0.6, -0.4])
    side = 2.0 * period * np.array([np.cos(angle), np.sin(angle)])
    defects = np.array([[150.0, 30.0], [130.0, 165.0], [170.0, 100.0], [165.0, 150.0]])
    first, second = (
        draw_lattice(period, angle, at, defects, contrast=0.5) for at in (np.zeros(2), shift)
    )
    pair = cover(first, TIP_AT), cover(second, TIP_AT + shift + side)
    for guess, sigma_px in ((shift, 0.5), (shift + side, 0.5), (shift, 10.0)):
        found = compare(*pair, guess, sigma_px)
        assert not found.accepted or np.max(np.abs(found.shift_px - shift)) < 0.1


def test_defects_that_are_left_unexplained_ask_for_more_evidence() -> None:
    """At a shift far from the prediction: that by a period explains half of the defects, by others of the reference."""
    period, shift, guess = 5.0, np.array([80.0, 0.0]), np.array([10.0, 0.0])
    heights = np.array([25.0, 60.0, 100.0, 145.0])
    farther = np.column_stack([np.full(4, 150.0), heights])
    defects = np.concatenate([farther, farther + guess - shift])
    pair = [draw_lattice(period, 0.0, at, defects) for at in (np.zeros(2), shift)]
    assert "ambiguous" in compare(*pair, guess, 0.5).reason
    near = compare(*pair, shift, 0.5)
    assert near.accepted, near.reason
    np.testing.assert_allclose(near.shift_px, shift, atol=0.06)
    reference = prepare_reference(noisy(pair[0], 4.0, 1))
    pyramid = Pyramid(np.asarray(noisy(pair[1], 4.0, 2), dtype=np.float32))
    noise = noise_beside_tools(reference, pyramid)
    level = reference.levels[-1]
    everywhere = np.ones(level.normal_matrices.shape[:2], dtype=bool)
    least = []
    for start in (shift, guess):
        found = align([level], pyramid, start)
        assert isinstance(found, Alignment)
        zeros, ones = np.zeros(everywhere.shape), np.ones(everywhere.shape)
        candidate = _Candidate(found, zeros, ones, zeros, everywhere, 10.0)
        least.append(_find_least_evidence(candidate, _count_left_defects(candidate, noise), False))
    # Two defects, and one more than the four that the second shift does not explain.
    assert least[0] == EVIDENCE_MIN
    assert least[1] == 5.0 * DEFECT_EVIDENCE_MAX


def draw_beside_tool(shift: Array, defects: Array, edge_px: int, rng: np.random.Generator) -> Array:
    """A lattice in electrons, 120 for a brightness of one, and on the left a bright tool with bands across."""
    picture = 0.3 + 0.15 * draw_lattice(8.0, 0.3, shift, defects, contrast=0.8)
    picture[:, :edge_px] = 0.75 + 0.1 * np.sin(np.arange(SIZE) / 7.0)[:, None]
    return np.asarray(rng.poisson(120.0 * picture) / 0.6)


@pytest.mark.parametrize("seed", range(4))
def test_a_tool_without_structure_does_not_pull_the_shift(seed: int) -> None:
    """Its inside agrees with any shift, and its bands would tell one of their own."""
    rng = np.random.default_rng(seed)
    shift = rng.uniform(-4.0, 4.0, 2)
    defects = np.array([[135.0, 45.0], [115.0, 95.0], [140.0, 145.0]])
    first = draw_beside_tool(np.zeros(2), defects, 60, rng)
    second = draw_beside_tool(shift, defects, 63, rng)
    found = register_pair(first, second, guess_px=shift, guess_covariance=0.09 * np.eye(2))
    assert found.accepted, found.reason
    error = found.shift_px - shift
    assert np.max(np.abs(error)) < 0.1
    assert error @ np.linalg.solve(found.covariance, error) < stats.chi2.isf(1e-4, 2)


@pytest.mark.parametrize("seed", range(4))
def test_one_defect_tells_the_shift_that_was_predicted(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shift = rng.uniform(1.5, 4.0, 2) * rng.choice([-1, 1], 2)
    defects = rng.uniform(50.0, 140.0, (1, 2))
    first, second = (draw_lattice(8.0, 0.3, at, defects) for at in (np.zeros(2), shift))
    found = compare(first, second, shift + rng.normal(0.0, 0.2, 2), 0.3)
    assert found.accepted, found.reason
    np.testing.assert_allclose(found.shift_px, shift, atol=0.03)
    # Nothing predicts that far, and one defect alone may be none.
    assert "ambiguous" in compare(first, second, shift, 10.0).reason


@pytest.mark.parametrize("jump", [(1, 1), (1, -1), (0, -2), (3, -1)])
@pytest.mark.parametrize("defects", [0, 1, 2])
def test_a_prediction_hides_no_jump_by_a_period(jump: tuple[int, int], defects: int) -> None:
    rng = np.random.default_rng(defects)
    turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    shift = np.array([2.1, -1.4])
    at = shift + 8.0 * turn @ np.array(jump)
    places = rng.uniform(60.0, 130.0, (defects, 2))
    first, second = draw_lattice(8.0, 0.3, np.zeros(2), places), draw_lattice(8.0, 0.3, at, places)
    found = compare(first, second, shift, 0.3)
    if found.accepted:
        np.testing.assert_allclose(found.shift_px, at, atol=0.1)
    elif found.rejection is not None and found.rejection.status is MatchFailure.DEFECTS_ELSEWHERE:
        assert defects, found.reason
    elif defects:
        # It is not believed, but that the specimen is elsewhere is said.
        assert 3.0 * np.hypot(*(found.suggested_px - shift)) > np.hypot(*(at - shift))
    else:
        assert np.all(np.isnan(found.suggested_px))


@pytest.mark.parametrize("jump", [(1, 1), (0, 2)])
def test_a_spot_that_stays_is_no_defect_that_tells_a_prediction(jump: tuple[int, int]) -> None:
    """Dirt of a detector over a perfect lattice: the stage moves by a period, and the spot does not."""
    turn = np.array([[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]])
    spot = np.array([[90.0, 100.0]])
    for shift in (np.array([0.3, 0.2]), np.array([0.9, -0.3]), np.array([1.5, 1.0])):
        at = shift + 8.0 * turn @ np.array(jump)
        pair = [draw_lattice(8.0, 0.3, where, spot - where) for where in (np.zeros(2), at)]
        found = compare(pair[0], pair[1], shift, 0.3)
        assert not found.accepted, (shift, found.shift_px)


@pytest.mark.parametrize("products", [8, 15, 40])
def test_long_tails_of_mean_squares_are_known(products: int) -> None:
    """A difference of two sums of squares is one of two gamma variables; its tails by integration."""
    half = stats.gamma(products / 2.0)

    def beyond(deviation: float) -> float:
        whole = integrate.quad(lambda x: half.pdf(x) * half.sf(x + deviation), 0.0, np.inf)
        return float(whole[0])

    median = optimize.brentq(lambda deviation: beyond(deviation) - 0.25, 0.01, 10.0)
    deviations = np.array([2.0, 3.0, 4.0, 5.0, 6.0])
    robust = deviations * median / stats.norm.isf(0.25)
    expected = [stats.norm.isf(beyond(deviation)) for deviation in robust]
    found = normal_deviations(np.concatenate([deviations, -deviations]), products)
    # What the saddlepoint approximation is good for.
    np.testing.assert_allclose(found[:5], expected, atol=0.04)
    np.testing.assert_array_equal(found[5:], -found[:5])
    # A normal one of 5 sigmas is far rarer.
    assert expected[3] < 4.6


@pytest.mark.parametrize("brightest", [1.0, 6.0])
def test_chance_is_no_defect(brightest: float) -> None:
    """Mean squares of 15 values in 784 tiles: some fifteen of all stand out by 5 robust sigmas, though of normal ones
    hardly any would. Bright tiles have more noise: half of them up to six times as much as the darkest.
    """
    tiles, everywhere = (500, 28, 28), np.ones((28, 28), dtype=bool)
    rng = np.random.default_rng(1)
    squares = rng.chisquare(15.0, (2, *tiles)) / 15.0
    noise = np.where(rng.random((28, 28)) < 0.6, 1.0, rng.uniform(1.0, brightest, (28, 28)))
    brightness = 40.0 * noise + 7.0
    alignment = cast("Alignment", None)
    evidence = 0.0
    for pair in zip(*(noise * squares), strict=True):
        shifts = [_Candidate(alignment, own, own, brightness, everywhere, 15.0) for own in pair]
        evidence += sum(_weigh(*shifts))
    # A quarter of a tile is expected; more than three are seen once in ten thousand times.
    assert evidence <= 3.0 * DEFECT_EVIDENCE_MAX


def draw_pores(
    pitch: float, disorder: float, shift: Array, seed: int = 5, soft_px: float = 0.8
) -> Array:
    """Dark pores on a lattice of squares, each displaced by ``disorder`` of the pitch (normal, 1-sigma)."""
    rng = np.random.default_rng(seed)
    picture = np.ones((SIZE, SIZE))
    near = np.arange(-int(pitch), int(pitch) + 1)
    for place in np.ndindex(2 * int(SIZE / pitch), 2 * int(SIZE / pitch)):
        at = pitch * (np.array(place) + disorder * rng.normal(size=2)) - 0.5 * SIZE + shift
        x, y = (
            values[(values >= 0) & (values < SIZE)]
            for values in np.rint(at).astype(int)[:, None] + near
        )
        distance = np.hypot(x[None, :] - at[0], y[:, None] - at[1])
        picture[np.ix_(y, x)] -= 1.0 / (1.0 + np.exp((distance - 0.3 * pitch) / soft_px))
    return picture


@pytest.mark.parametrize("jump", [(0, 0), (1, 0), (1, -1), (0, 2)])
@pytest.mark.parametrize("pitch", [7.3, 10.0])
def test_the_disorder_of_a_lattice_tells_a_jump_by_periods(
    pitch: float, jump: tuple[int, int]
) -> None:
    drift = np.array([0.4, -0.3])
    shift = drift + pitch * np.array(jump)
    pair = draw_pores(pitch, 0.05, np.zeros(2)), draw_pores(pitch, 0.05, shift)
    found = compare(*pair, drift, 0.5)
    assert found.accepted, found.reason
    np.testing.assert_allclose(found.shift_px, shift, atol=0.06)


@pytest.mark.parametrize("soft_px", [0.2, 0.8])
@pytest.mark.parametrize("sigma", [0.3, 4.0])
@pytest.mark.parametrize("pitch", [7.3, 10.0])
def test_edges_that_are_interpolated_are_no_disorder(
    pitch: float, sigma: float, soft_px: float
) -> None:
    """Shifts by a period that is no whole number of pixels differ in what interpolation does to sharp edges."""
    shift = np.array([0.4, -0.3])
    pair = [
        noisy(draw_pores(pitch, 0.0, at, soft_px=soft_px), sigma, k)
        for k, at in enumerate((np.zeros(2), shift + [pitch, 0.0]))
    ]
    found = register_pair(*pair, guess_px=shift, guess_covariance=np.eye(2) * 0.25)
    assert not found.accepted


def test_a_jump_farther_than_what_is_compared_is_refused() -> None:
    pitch, drift = 7.3, np.array([0.4, -0.3])
    pair = draw_pores(pitch, 0.05, np.zeros(2)), draw_pores(pitch, 0.05, drift + 6.0 * pitch)
    found = compare(*pair, drift, 0.5)
    assert not found.accepted or np.max(np.abs(found.shift_px - drift - 6.0 * pitch)) < 0.06


def draw_grating(period: float, angle: float, shift: Array, particles: Array) -> Array:
    """Lines, and particles (n, 2) on them."""
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float64)
    u = np.cos(angle) * (x - shift[0]) + np.sin(angle) * (y - shift[1])
    whole = np.cos(2.0 * np.pi * u / period)
    for at in particles + shift:
        whole += 2.0 / (1.0 + np.exp(np.clip(np.hypot(x - at[0], y - at[1]) - 4.0, -50.0, 50.0)))
    return np.asarray(whole)


@pytest.mark.parametrize("jump", [0, 1, -2])
@pytest.mark.parametrize("period", [8.0, 13.0])
def test_particles_on_a_grating_tell_the_period_and_the_place_along_it(
    period: float, jump: int
) -> None:
    angle, drift = 0.3, np.array([0.4, -0.3])
    shift = drift + jump * period * np.array([np.cos(angle), np.sin(angle)])
    particles = np.random.default_rng(2).uniform(20.0, SIZE - 20.0, (30, 2))
    pair = [draw_grating(period, angle, at, particles) for at in (np.zeros(2), shift)]
    found = compare(*pair, drift, 0.5)
    # A jump may be refused.
    assert found.accepted or jump, found.reason
    if found.accepted:
        assert found.along is None
        np.testing.assert_allclose(found.shift_px, shift, atol=0.06)


@pytest.mark.parametrize("period", [8.0, 13.0])
def test_a_plain_grating_tells_no_place_along_it(period: float) -> None:
    pair = [
        draw_grating(period, 0.3, at, np.zeros((0, 2)))
        for at in (np.zeros(2), np.array([0.4, -0.3]))
    ]
    found = compare(*pair, np.array([0.4, -0.3]), 0.5)
    assert not found.accepted or found.along is not None


@pytest.mark.parametrize("periods", [1, 2, 3])
def test_a_prediction_does_not_hide_a_jump_of_a_disordered_coarse_lattice(periods: int) -> None:
    """Of periods that are a good part of the field, a prediction decides, but not against the picture."""
    pitch, drift = 16.0, np.array([0.4, -0.3])
    shift = drift + [periods * pitch, 0.0]
    pair = draw_pores(pitch, 0.05, np.zeros(2)), draw_pores(pitch, 0.05, shift)
    found = compare(*pair, drift, 0.5)
    # What is farther than all that is compared may be refused.
    assert found.accepted or periods == 3, found.reason
    if found.accepted:
        np.testing.assert_allclose(found.shift_px, shift, atol=0.06)


def test_a_lattice_in_another_focus_still_tells_its_shift() -> None:
    drift = np.array([0.4, -0.3])
    first, second = (lattice(SIZE, 16.0, (float(x), float(y))) for x, y in (np.zeros(2), drift))
    blurred = cv2.GaussianBlur(second, (0, 0), 3.0)
    found = compare(first, blurred, drift, 0.5)
    assert found.accepted, found.reason
    np.testing.assert_allclose(found.shift_px, drift, atol=0.06)


def draw_circuit(period: float, shift: Array, seed: int) -> Array:
    """Lines of an integrated circuit, some of which end or are missing, with vias on them; in electrons for 20."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:SIZE, :SIZE].astype(np.float64)
    angle = rng.uniform(-0.05, 0.05)
    across = (x - shift[0]) * np.cos(angle) + (y - shift[1]) * np.sin(angle)
    along = y - shift[1]

    def inside(distance: Array) -> Array:
        return np.asarray(special.expit(-2.0 * distance))

    picture = np.full((SIZE, SIZE), 0.25)
    for k in range(-3, 16):
        end = rng.choice([400.0, 400.0, 400.0, rng.uniform(20.0, 170.0), -400.0])
        off = np.abs(across - period * k)
        picture += 0.4 * inside(np.maximum(off - 0.22 * period, along - end))
        for at in rng.uniform(-40.0, 230.0, 2):
            via = inside(np.hypot(across - period * k, along - at) - 0.33 * period)
            picture = np.maximum(picture, 0.25 + 0.65 * via)
    return picture


@pytest.mark.long
def test_vias_and_ends_tell_the_shift_of_lines_beside_bare_ground() -> None:
    refused = []
    for seed in range(8):
        rng = np.random.default_rng(100 + seed)
        shift, period = rng.uniform(-2.0, 2.0, 2), rng.uniform(14.0, 18.0)
        jump = np.array([period, 30.0])
        first, second, third = (
            np.clip(8.0 * rng.poisson(20.0 * draw_circuit(period, at, seed)), 0.0, 255.0)
            for at in (np.zeros(2), shift, shift + jump)
        )
        found = register_pair(first, second)
        if not found.accepted:
            refused.append(found.reason)
            continue
        sigma = np.sqrt(np.diag(found.covariance))
        assert np.all(np.abs(found.shift_px - shift) < 4.0 * sigma)
        assert np.max(sigma) < 0.15
        # A prediction hides no jump by a period.
        after = register_pair(first, third, guess_px=shift, guess_covariance=0.25 * np.eye(2))
        assert not after.accepted or np.max(np.abs(after.shift_px - shift - jump)) < 0.6
    # Where only a few vias are in sight, it may be: four of 24 such pairs.
    assert len(refused) <= 2, refused
