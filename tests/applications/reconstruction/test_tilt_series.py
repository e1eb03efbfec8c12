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

"""Heights from tilted pictures, against a height field that is ray-cast pixel by pixel."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.thresholds.fleets.reconstruction import AXIS_RAD, RoughSurface, expose
from semcal_ros.applications.reconstruction import tilt_series
from semcal_ros.applications.reconstruction.tilt_series import (
    HeightMap,
    find_tilt_geometry,
    measure_heights,
)
from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError, StructureError

_SIDE = 240
_PIXEL_M = 50e-9
_TILTS_RAD = tuple(np.radians((-7.0, 0.0, 7.0)))
_TILT_SIGMA_RAD = 1e-6


def _surface(seed: int, rms_px: float = 6.0) -> RoughSurface:
    return RoughSurface(np.random.default_rng(seed), _SIDE, rms_px)


def _expose(grey: Array, seed: int) -> Array:
    return expose(grey, np.random.default_rng(seed))


def _see(
    surface: RoughSurface, tilt_rad: float, *, seed: int, shift: tuple[float, float] = (0, 0)
) -> tuple[Array, Array]:
    """Return a picture with noise, and the height seen by each pixel."""
    grey, height = surface.look(tilt_rad, shift)
    return _expose(grey, seed), height


@pytest.fixture(scope="module")
def scene() -> tuple[list[Array], Array]:
    specimen = _surface(1)
    shifts = ((3.3, -5.1), (0.0, 0.0), (-2.2, 4.7))
    seen = [
        _see(specimen, t, seed=i, shift=s)
        for i, (t, s) in enumerate(zip(_TILTS_RAD, shifts, strict=True))
    ]
    return [image for image, _ in seen], seen[1][1]


def _scores(found: HeightMap, truth_px: Array) -> Array:
    error = found.height_m - _PIXEL_M * truth_px
    known = np.isfinite(error)
    return (error - np.median(error[known]))[known] / found.sigma_m[known]


@pytest.mark.parametrize("chosen", [(0, 1, 2), (1, 2)])
def test_heights_are_within_their_uncertainty(
    scene: tuple[list[Array], Array], chosen: tuple[int, ...]
) -> None:
    images, truth = scene
    found = measure_heights(
        [images[k] for k in chosen],
        [_TILTS_RAD[k] for k in chosen],
        _PIXEL_M,
        tilt_sigma_rad=_TILT_SIGMA_RAD,
    )
    scores = _scores(found, truth)
    assert found.coverage > 0.5
    assert 0.7 < np.sqrt(np.mean(scores**2)) < 1.4
    # A relief of the wrong sign or scale is far from this.
    known = np.isfinite(found.height_m)
    assert np.polyfit(_PIXEL_M * truth[known], found.height_m[known], 1)[0] == pytest.approx(
        1.0, abs=0.03
    )


def test_the_tilts_are_part_of_the_uncertainty(scene: tuple[list[Array], Array]) -> None:
    images, _ = scene
    # Larger than a stage has, so that it outweighs the noise of this small picture.
    sigma = np.radians(0.5)
    found = measure_heights(images[1:], _TILTS_RAD[1:], _PIXEL_M, tilt_sigma_rad=sigma)
    wrong = measure_heights(
        images[1:], (0.0, _TILTS_RAD[2] + sigma), _PIXEL_M, tilt_sigma_rad=sigma
    )
    both = np.isfinite(found.height_m) & np.isfinite(wrong.height_m)
    change = (wrong.height_m - found.height_m)[both]
    # One of two tilts was off by its sigma: less than the 1-sigma of the heights, but not by much.
    ratio = np.sqrt(np.mean((change - change.mean()) ** 2) / np.mean(found.sigma_m[both] ** 2))
    assert 0.4 < ratio < 1.0, ratio


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ("order", "mirror image"),
        ("axis", "--tilt-axis"),
        ("other specimen", "agree with a tilt|only .* match"),
        ("contrast", "agree with a tilt|only .* match"),
        ("flat", "no parallax"),
        ("same", "no parallax: .* within 0.00 px"),
    ],
)
def test_pictures_that_allow_no_heights_are_refused(
    scene: tuple[list[Array], Array], change: str, reason: str
) -> None:
    images, tilts, axis = list(scene[0]), list(_TILTS_RAD), 0.0
    if change == "order":
        # The middle one stays the reference, and both others are on one side of it.
        images = [images[0], images[1], images[0]]
    if change == "axis":
        axis = np.pi / 2.0
    if change == "other specimen":
        images = [images[1], _see(_surface(9), 0.1, seed=0)[0]]
        tilts = [0.0, 0.1]
    if change == "contrast":
        images, tilts = [images[1], 255 - images[2]], [0.0, 0.1]
    if change == "same":
        images, tilts = [images[1], images[1]], [0.0, 0.12]
    if change == "flat":
        flat = _surface(3, rms_px=0.0)
        images, tilts = [_see(flat, t, seed=7)[0] for t in (0.0, 0.12)], [0.0, 0.12]
    with pytest.raises(StructureError, match=reason):
        measure_heights(images, tilts, _PIXEL_M, tilt_sigma_rad=1e-3, axis_rad=axis)


@pytest.mark.parametrize("tilts", [(0.0, 0.0), (0.0, 2.0), (0.0, np.nan), (0.0,)])
def test_tilts_that_say_nothing_are_refused(
    scene: tuple[list[Array], Array], tilts: tuple[float, ...]
) -> None:
    with pytest.raises(InvalidValueError, match="--tilts"):
        measure_heights(scene[0][:2], tilts, _PIXEL_M, tilt_sigma_rad=1e-3)


@pytest.mark.slow
@pytest.mark.long
def test_the_axis_is_within_its_uncertainty() -> None:
    """30 pairs of five specimens, each with other noise. In such a set, one false match on its line made the RMS 6."""
    scores = []
    for specimen in range(5):
        surface = _surface(specimen)
        greys = [surface.look(t, s)[0] for t, s in ((0.0, (0, 0)), (0.12, (3.3 * specimen, -4.7)))]
        for seed in range(6):
            one, two = (_expose(grey, 10 * seed + k) for k, grey in enumerate(greys))
            found = find_tilt_geometry(one, two, near_axis_rad=0.0)
            scores.append((found.axis_rad - AXIS_RAD) / np.sqrt(found.covariance[0, 0]))
    # The RMS of 30 independent scores scatters by 0.13; those of one specimen share an error of a fraction of it.
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.45, scores


def test_a_false_match_on_its_epipolar_line_does_not_turn_the_axis(
    scene: tuple[list[Array], Array], monkeypatch: pytest.MonkeyPatch
) -> None:
    images, match = scene[0], tilt_series._match_features

    def with_a_false_one(first: Array, second: Array, shown: object) -> tuple[Array, Array]:
        one, two = match(first, second, shown)
        across = np.array([-np.sin(AXIS_RAD), np.cos(AXIS_RAD)])
        # 70 px along the line, and 1 px off it, which is within the tolerance.
        wrong = two[:1] + 70.0 * across + np.array([np.cos(AXIS_RAD), np.sin(AXIS_RAD)])
        return np.vstack([one, one[:1]]), np.vstack([two, wrong])

    plain = find_tilt_geometry(images[1], images[2], near_axis_rad=0.0)
    monkeypatch.setattr(tilt_series, "_match_features", with_a_false_one)
    found = find_tilt_geometry(images[1], images[2], near_axis_rad=0.0)
    assert len(found.first) < found.matches
    shifts = np.linalg.norm(found.second - found.first, axis=1)
    assert np.max(np.abs(shifts - np.median(shifts))) < 20.0
    # Other samples of RANSAC leave a match more or less at the limit. The false one turned the axis by 1/70 rad.
    assert found.axis_rad == pytest.approx(plain.axis_rad, abs=np.sqrt(plain.covariance[0, 0]))


def test_what_is_masked_has_no_heights_and_spoils_none(scene: tuple[list[Array], Array]) -> None:
    images, truth = scene
    mask = np.ones(truth.shape, dtype=np.bool_)
    mask[60:130, 70:150] = False
    # As of a bright tip that does not move with the specimen, with an edge that would be matched.
    covered = [np.where(mask, image, 2.0 * np.max(image)) for image in images]
    found = measure_heights(
        covered, _TILTS_RAD, _PIXEL_M, tilt_sigma_rad=_TILT_SIGMA_RAD, masks=[mask] * 3
    )
    assert not np.any(np.isfinite(found.height_m[~mask]))
    scores = _scores(found, truth)
    assert 0.7 < np.sqrt(np.mean(scores**2)) < 1.4
    assert found.coverage > 0.4
    untold = measure_heights(covered, _TILTS_RAD, _PIXEL_M, tilt_sigma_rad=_TILT_SIGMA_RAD)
    assert np.any(np.isfinite(untold.height_m[~mask]))


@pytest.mark.parametrize(("shift", "share"), [((212.0, 0.0), "12"), ((0.0, -222.0), "[78]")])
def test_too_little_overlap_is_refused_with_its_numbers(
    scene: tuple[list[Array], Array], shift: tuple[float, float], share: str
) -> None:
    second, _ = _see(_surface(1), _TILTS_RAD[2], seed=5, shift=shift)
    with pytest.raises(StructureError, match=rf"share {share}% of their field: .* shifted by "):
        measure_heights([scene[0][1], second], (0.0, _TILTS_RAD[2]), _PIXEL_M, tilt_sigma_rad=1e-3)
