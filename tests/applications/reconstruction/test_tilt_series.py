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

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates, spline_filter

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
_AXIS_RAD = np.radians(12.0)
_TILTS_RAD = tuple(np.radians((-7.0, 0.0, 7.0)))
_TILT_SIGMA_RAD = 1e-6


def _smooth(rng: np.random.Generator, sigma: float, side: int) -> Array:
    field = cv2.GaussianBlur(rng.standard_normal((side, side)), (0, 0), sigma)
    return np.asarray(field / field.std())


class _Specimen:
    """Rough surface z(x, y) on a grid of pixels, with a texture that is painted on it."""

    def __init__(self, seed: int, rms_px: float = 6.0) -> None:
        rng = np.random.default_rng(seed)
        side = _SIDE + 120
        # Coefficients of splines. OpenCV's cubic kernel shifts what it shows by up to 0.05 px, which follows the relief
        # as parallax does: the axis was off by three of its sigmas for that alone.
        self.height = spline_filter(rms_px * _smooth(rng, 22.0, side))
        self.texture = spline_filter(sum(_smooth(rng, s, side) for s in (1.2, 2.5, 6.0)))
        self._middle = 0.5 * (side - 1)

    def _look_up(self, field: Array, x: Array, y: Array) -> Array:
        at = [y + self._middle, x + self._middle]
        return np.asarray(map_coordinates(field, at, order=3, prefilter=False, mode="nearest"))

    def see(
        self, tilt_rad: float, *, seed: int, noise: float = 3.0, shift: tuple[float, float] = (0, 0)
    ) -> tuple[Array, Array]:
        """Return grey levels and the height seen by each pixel."""
        grey, height = self.look(tilt_rad, shift)
        return _expose(grey, seed, noise), height

    def look(self, tilt_rad: float, shift: tuple[float, float] = (0, 0)) -> tuple[Array, Array]:
        """Without noise: each ray is followed to where it hits."""
        rows, columns = np.indices((_SIDE, _SIDE), dtype=np.float64)
        x, y = (
            part - 0.5 * (_SIDE - 1) - s for part, s in zip((columns, rows), shift, strict=True)
        )
        c, s = np.cos(_AXIS_RAD), np.sin(_AXIS_RAD)
        u, v = c * x + s * y, c * y - s * x
        height = np.zeros_like(u)
        # Slopes of a quarter times the tilt: each step leaves a thirtieth of the error.
        for _ in range(8):
            across = (v - height * np.sin(tilt_rad)) / np.cos(tilt_rad)
            height = self._look_up(self.height, c * u - s * across, s * u + c * across)
        grey = 120.0 + 25.0 * self._look_up(self.texture, c * u - s * across, s * u + c * across)
        return grey, height


def _expose(grey: Array, seed: int, noise: float = 3.0) -> Array:
    noisy = grey + np.random.default_rng(seed).normal(0.0, noise, grey.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def scene() -> tuple[list[Array], Array]:
    specimen = _Specimen(1)
    shifts = ((3.3, -5.1), (0.0, 0.0), (-2.2, 4.7))
    seen = [
        specimen.see(t, seed=i, shift=s)
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
        images = [images[1], _Specimen(9).see(0.1, seed=0)[0]]
        tilts = [0.0, 0.1]
    if change == "contrast":
        images, tilts = [images[1], 255 - images[2]], [0.0, 0.1]
    if change == "same":
        images, tilts = [images[1], images[1]], [0.0, 0.12]
    if change == "flat":
        flat = _Specimen(3, rms_px=0.0)
        images, tilts = [flat.see(t, seed=7)[0] for t in (0.0, 0.12)], [0.0, 0.12]
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
        surface = _Specimen(specimen)
        greys = [surface.look(t, s)[0] for t, s in ((0.0, (0, 0)), (0.12, (3.3 * specimen, -4.7)))]
        for seed in range(6):
            one, two = (_expose(grey, 10 * seed + k) for k, grey in enumerate(greys))
            found = find_tilt_geometry(one, two, near_axis_rad=0.0)
            scores.append((found.axis_rad - _AXIS_RAD) / np.sqrt(found.covariance[0, 0]))
    # The RMS of 30 independent scores scatters by 0.13; those of one specimen share an error of a fraction of it.
    assert 0.7 < np.sqrt(np.mean(np.square(scores))) < 1.45, scores


def test_a_false_match_on_its_epipolar_line_does_not_turn_the_axis(
    scene: tuple[list[Array], Array], monkeypatch: pytest.MonkeyPatch
) -> None:
    images, match = scene[0], tilt_series._match_features

    def with_a_false_one(first: Array, second: Array) -> tuple[Array, Array]:
        one, two = match(first, second)
        across = np.array([-np.sin(_AXIS_RAD), np.cos(_AXIS_RAD)])
        # 70 px along the line, and 1 px off it, which is within the tolerance.
        wrong = two[:1] + 70.0 * across + np.array([np.cos(_AXIS_RAD), np.sin(_AXIS_RAD)])
        return np.vstack([one, one[:1]]), np.vstack([two, wrong])

    plain = find_tilt_geometry(images[1], images[2], near_axis_rad=0.0)
    monkeypatch.setattr(tilt_series, "_match_features", with_a_false_one)
    found = find_tilt_geometry(images[1], images[2], near_axis_rad=0.0)
    assert len(found.first) < found.matches
    shifts = np.linalg.norm(found.second - found.first, axis=1)
    assert np.max(np.abs(shifts - np.median(shifts))) < 20.0
    # Other samples of RANSAC leave a match more or less at the limit. The false one turned the axis by 1/70 rad.
    assert found.axis_rad == pytest.approx(plain.axis_rad, abs=np.sqrt(plain.covariance[0, 0]))


@pytest.mark.parametrize(("shift", "share"), [((212.0, 0.0), "12"), ((0.0, -222.0), "[78]")])
def test_too_little_overlap_is_refused_with_its_numbers(
    scene: tuple[list[Array], Array], shift: tuple[float, float], share: str
) -> None:
    second, _ = _Specimen(1).see(_TILTS_RAD[2], seed=5, shift=shift)
    with pytest.raises(StructureError, match=rf"share {share}% of their field: .* shifted by "):
        measure_heights([scene[0][1], second], (0.0, _TILTS_RAD[2]), _PIXEL_M, tilt_sigma_rad=1e-3)
