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

"""The looks of a cantilever: outlines of its tip, substrates, charging, and what is drawn at random."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic.specimens.cantilever import (
    TIPS,
    BeamTip,
    CantileverScene,
    Charging,
    make_tip,
    random_cantilever,
)
from semcal_ros.synthetic.specimens.substrate import SUBSTRATES, Substrate

PLAIN = CantileverScene(background=0.0, rim=0.0, beam=1.0, holder=1.0, pusher=0.5)
PIXEL_M = 25e-9


def drawn(specimen, left_m=28e-6, size=320):
    """Reflectivity of a square field that ends 1 um behind a beam of 35 um."""
    x, y = np.meshgrid(left_m + PIXEL_M * np.arange(size), PIXEL_M * (np.arange(size) - size / 2))
    return x, y, np.array(specimen.reflectivity(x, y, PIXEL_M * np.eye(2)), dtype=float)


@pytest.mark.parametrize("name", TIPS)
def test_the_tip_has_its_outline_and_ends_where_the_beam_does(name):
    tip = make_tip(name, PLAIN.width_m, np.random.default_rng(2))
    x, y, seen = drawn(replace(PLAIN, tip=tip))
    missing = (1.0 - tip.facet) * PLAIN.width_m * tip.length_m
    missing *= 1.0 - np.pi / 4.0 if tip.flank == "elliptic" else 0.5
    area = (35e-6 - x[0, 0] + 0.5 * PIXEL_M) * PLAIN.width_m - missing
    # A facet of zero width is as blunt as a pixel.
    assert seen.sum() * PIXEL_M**2 == pytest.approx(area, abs=0.3 * PLAIN.width_m * PIXEL_M)
    middle = seen[np.argmin(np.abs(y[:, 0]))]
    assert x[0, 0] + PIXEL_M * (middle.sum() - 0.5) == pytest.approx(35e-6, abs=0.3 * PIXEL_M)


def test_impossible_looks_are_refused():
    with pytest.raises(InvalidValueError, match="facet of 2"):
        BeamTip(1e-6, 2.0)
    with pytest.raises(InvalidValueError, match="one of grains, islands"):
        Substrate("moss")
    with pytest.raises(InvalidValueError, match="contrast of 0 to"):
        Substrate(contrast=2.0)
    with pytest.raises(InvalidValueError, match="positive halo_m"):
        Charging(halo_m=0.0)
    with pytest.raises(InvalidValueError, match="towards 0"):
        CantileverScene(push_direction=0)


def correlation(texture, lag):
    """Correlation with itself a number of pixels away, in the mean over both directions."""
    return np.mean(
        [np.corrcoef(a.ravel(), b.ravel())[0, 1] for a, b in (
            (texture[lag:], texture[:-lag]), (texture[:, lag:], texture[:, :-lag]))]
    )  # fmt: skip


@pytest.mark.long
def test_substrates_differ_in_their_statistics_and_not_in_brightness():
    shapes = {}
    for kind in SUBSTRATES:
        _, _, seen = drawn(Substrate(kind, 0.4, 0.08, 0.5e-6, seed=1))
        # Every fourth point of a field of 64 structures along each side: scratches are few. Most
        # grains are much smaller than the largest; those below a pixel have no contrast.
        x, y = (4.0 * v for v in np.meshgrid(*[PIXEL_M * np.arange(320)] * 2))
        size_m = 2e-6 if kind == "grains" else 0.5e-6
        wide = Substrate(kind, 0.4, 0.08, size_m, seed=1).reflectivity(x, y, PIXEL_M * np.eye(2))
        assert wide.mean() == pytest.approx(0.4, abs=0.02)
        assert wide.std() == pytest.approx(0.08, rel=0.2)
        skew = np.mean((seen - seen.mean()) ** 3) / seen.std() ** 3
        shapes[kind] = correlation(seen, 8), skew
        repeated = drawn(Substrate(kind, 0.4, 0.08, 0.5e-6, seed=1), size=32)[2]
        assert not np.array_equal(repeated, drawn(Substrate(kind, 0.4, 0.08, 0.5e-6, seed=2), size=32)[2])  # fmt: skip
    values = list(shapes.values())
    apart = [np.hypot(*np.subtract(a, b)) for i, a in enumerate(values) for b in values[:i]]
    assert min(apart) > 0.1, shapes


def test_charge_brightens_one_side_and_the_neighbourhood():
    ground = Substrate("smooth", 0.3, 0.0)
    x, y, seen = drawn(
        replace(PLAIN, substrate=ground, beam=0.3, charging=Charging((2e4, 0.0), 0.1, 0.5e-6))
    )
    beside = np.abs(y[:, 0] - 0.5 * PLAIN.width_m - 0.5e-6).argmin()
    # One reach away the halo has fallen to 1 / e; a gradient of 0.02 per um levels off at a half.
    factor = 1.0 + 0.5 * np.tanh(2.0 * 2e4 * x[0, 40])
    distance = y[beside, 0] - 0.5 * PLAIN.width_m
    expected = factor * (0.3 + 0.1 * np.exp(-distance / 0.5e-6))
    assert seen[beside, 40] == pytest.approx(expected, rel=1e-3)


def test_a_push_from_the_other_side_is_the_mirror_image():
    scene = replace(PLAIN, deflection_m=250e-9, gap_m=0.0)
    other = replace(scene, deflection_m=-250e-9, push_direction=-1)
    footprint = PIXEL_M * np.eye(2)
    x, y = np.meshgrid(np.linspace(30e-6, 36e-6, 8), np.linspace(-4e-6, 4e-6, 9))
    np.testing.assert_allclose(
        scene.reflectivity(x.copy(), y.copy(), footprint),
        other.reflectivity(x.copy(), -y, footprint),
        atol=1e-12,
    )


def test_random_cantilevers_show_everything_and_come_back():
    drawn_ones = [random_cantilever(seed, base_in_view=True) for seed in range(10)]
    assert {one.tip for one in drawn_ones} == set(TIPS)
    assert {one.substrate for one in drawn_ones} == set(SUBSTRATES)
    assert {one.is_dark for one in drawn_ones} == {False, True}
    assert {one.scene.push_direction for one in drawn_ones} == {1, -1}
    assert len({(one.tip, one.substrate, one.is_dark) for one in drawn_ones}) >= 9
    assert random_cantilever(3) == random_cantilever(3)
    # Where only the end is in view, something must show the drift.
    assert "smooth" not in {random_cantilever(seed).substrate for seed in range(10)}
    for one in drawn_ones:
        # The pusher touches a straight side.
        assert one.scene.pusher_m[0] < one.scene.length_m - one.scene.tip.length_m
