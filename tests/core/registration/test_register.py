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

"""Registration against known shifts, against the Cramer-Rao bound, and its refusals."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.registration import inverse_compositional
from semcal_ros.core.registration import register as register_module
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.registration.fractional_delay import (
    FINE,
    SHARP,
    Band,
    gradients,
    gradients_transposed,
    sample_shifted,
    sample_tiles,
)
from semcal_ros.core.registration.normalised_correlation import CoarsePeak
from semcal_ros.core.registration.reference import RegistrationSettings
from semcal_ros.core.registration.register import (
    Registration,
    prepare_reference,
    register,
    register_pair,
)
from tests.helpers.drift_scenes import Texture, cramer_rao_px, lattice, noisy

SIZE = 192
TEXTURE = Texture(1)


def _pair(shift: tuple[float, float], sigma: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    reference = noisy(TEXTURE.view((0.0, 0.0), SIZE), sigma, 2 * seed)
    return reference, noisy(TEXTURE.view(shift, SIZE), sigma, 2 * seed + 1)


def _refused(result: Registration, *words: str) -> None:
    assert not result.accepted
    assert any(word in result.reason for word in words), result.reason


def test_sign_and_axes_of_the_shift() -> None:
    # A single bright spot moves by 7 px to the right and 3 px up.
    y, x = np.mgrid[:128, :128]
    before = 100.0 * np.exp(-((x - 60.0) ** 2 + (y - 70.0) ** 2) / 50.0)
    after = 100.0 * np.exp(-((x - 67.0) ** 2 + (y - 67.0) ** 2) / 50.0)
    rng = np.random.default_rng(0)
    result = register_pair(
        before + rng.standard_normal(before.shape), after + rng.standard_normal(after.shape)
    )
    assert result.accepted, result.reason
    # 1 % noise on a spot of 5 px: the bound is about 0.01 px.
    np.testing.assert_allclose(result.shift_px, [7.0, -3.0], atol=0.06)


@pytest.mark.parametrize(
    "shift", [(0.0, 0.0), (0.5, -0.5), (3.3, -7.8), (-60.2, 41.7), (64.0, 0.4)]
)
def test_shift_up_to_a_third_of_the_field(shift: tuple[float, float]) -> None:
    result = register_pair(*_pair(shift, 4.0))
    assert result.accepted, result.reason
    # Five of the stated deviations, and these must be small.
    sigma = np.sqrt(np.diag(result.covariance))
    assert np.all(sigma < 0.02)
    assert np.all(np.abs(result.shift_px - shift) < 5.0 * sigma)


@settings(max_examples=15, deadline=None)
@given(st.floats(-30.0, 30.0), st.floats(-30.0, 30.0), st.integers(0, 1000))
def test_any_shift(dx: float, dy: float, seed: int) -> None:
    result = register_pair(*_pair((dx, dy), 6.0, seed))
    assert result.accepted, result.reason
    np.testing.assert_allclose(result.shift_px, [dx, dy], atol=0.08)


@pytest.mark.slow
@pytest.mark.parametrize(("sigma", "shift"), [(4.0, (0.37, -1.21)), (22.5, (5.6, 9.3))])
def test_reaches_the_cramer_rao_bound_with_honest_covariance(
    sigma: float, shift: tuple[float, float]
) -> None:
    trials = 60
    results = [register_pair(*_pair(shift, sigma, seed)) for seed in range(trials)]
    assert all(r.accepted for r in results)
    error = np.array([r.shift_px for r in results]) - shift
    bound = cramer_rao_px(TEXTURE, shift, SIZE, sigma)
    rms = float(np.sqrt(np.mean((error / bound) ** 2)))
    # 120 values: the RMS scatters by 6.5 %. At 5 dB (22.5 grey levels) noise in the gradient adds
    # some.
    assert rms < 1.3
    assert np.all(np.abs(error.mean(axis=0)) < 4.0 * bound / np.sqrt(trials) + 0.002)
    stated = np.array([np.sqrt(np.diag(r.covariance)) for r in results])
    inside = np.abs(error) / stated
    # 68 and 95 % within four binomial deviations of 120 values.
    assert 0.51 < np.mean(inside < 1.0) < 0.85
    assert np.mean(inside < 1.96) > 0.87


@pytest.mark.parametrize("factor", [1e-3, 1.0 / 257.0, 0.1, 257.0])
def test_grey_levels_of_another_depth_are_the_same_image(factor: float) -> None:
    """Of 16 bits after 8, of parts of one, or of a detector with another gain: the shift does not know."""
    first, second = _pair((2.3, -1.4), 3.0)
    usual, scaled = register_pair(first, second), register_pair(first, factor * second)
    assert usual.accepted and scaled.accepted
    np.testing.assert_allclose(scaled.shift_px, usual.shift_px, atol=1e-3)
    np.testing.assert_allclose(scaled.covariance, usual.covariance, rtol=1e-2)
    assert scaled.contrast == pytest.approx(factor * usual.contrast, rel=1e-3)


def test_gain_offset_and_residual_are_measured() -> None:
    reference = noisy(TEXTURE.view((0.0, 0.0), SIZE), 3.0, 0)
    image = 0.5 * noisy(TEXTURE.view((2.2, 1.1), SIZE), 3.0, 1) + 20.0
    result = register_pair(reference, image)
    assert result.accepted
    assert result.alignment.gain == pytest.approx(0.5, abs=0.005)
    assert result.alignment.offset == pytest.approx(20.0, abs=1.0)
    # White noise of 1.5 in each image after the gain; smoothing can only lower it.
    assert 0.2 < result.alignment.residual_rms < 1.1 * 1.5 * np.sqrt(2.0)


def test_a_change_of_shading_does_not_pull_the_shift() -> None:
    x = np.linspace(0.5, 1.5, SIZE)
    image = TEXTURE.view((4.3, -2.2), SIZE) * x + 0.5 * x[:, None]
    result = register_pair(_pair((0.0, 0.0), 3.0)[0], noisy(image, 3.0, 5))
    assert result.accepted, result.reason
    # The gain ramp of +-50 % would pull x by more than 0.03 px if it were not part of the model.
    np.testing.assert_allclose(result.shift_px, [4.3, -2.2], atol=0.02)


@pytest.mark.parametrize("place", [(128.0, 200.0), (60.0, 190.0), (200.0, 60.0)])
def test_noise_where_nothing_is_does_not_pull_a_cluster_towards_the_middle(
    place: tuple[float, float],
) -> None:
    """It would lower the gain there, and so tilt it across the cluster: by 0.14 px at a stated 0.07, and at rest."""
    rng = np.random.default_rng(3)
    y, x = np.mgrid[0.0:256.0, 0.0:256.0]
    picture = np.full((256, 256), 55.0)
    for _ in range(14):
        left, top = place + rng.uniform(-22.0, 22.0, 2)
        distance = np.hypot(x - left, y - top)
        picture += rng.uniform(40.0, 90.0) * stats.norm.cdf(
            (rng.uniform(3.0, 7.0) - distance) / 1.2
        )
    found = []
    for seed in range(24):
        pair = (noisy(picture, 16.0, 2 * seed + k, 0.0, 1.0) for k in range(2))
        result = register_pair(*pair)
        if result.accepted:
            found.append([*result.shift_px, *np.sqrt(np.diag(result.covariance))])
    assert len(found) > 18
    shifts, sigmas = np.split(np.array(found), 2, axis=1)
    # The mean of 20 is known to a quarter of their sigma.
    assert np.all(np.abs(shifts.mean(axis=0)) < 0.75 * np.median(sigmas, axis=0))
    assert np.all(np.std(shifts, axis=0) < 1.6 * np.median(sigmas, axis=0))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_pixel_types(dtype: type) -> None:
    scale = 200.0 if dtype is np.uint16 else 1.0
    pair = [np.clip(p * scale, 0, 60000).astype(dtype) for p in _pair((1.7, 2.4), 4.0)]
    np.testing.assert_allclose(register_pair(*pair).shift_px, [1.7, 2.4], atol=0.03)


def test_colour_pictures_are_registered_by_their_mean() -> None:
    pair = [np.repeat(p[:, :, None], 3, axis=2) for p in _pair((1.7, 2.4), 4.0)]
    np.testing.assert_allclose(register_pair(*pair).shift_px, [1.7, 2.4], atol=0.03)


def test_regions_keep_the_coordinates_of_the_whole_picture() -> None:
    reference, image = _pair((6.4, -3.3), 3.0)
    reference[:, :20], image[-15:, :] = 0.0, 255.0
    result = register_pair(
        reference, image, reference_region=(20, 0, SIZE, SIZE), image_region=(0, 0, SIZE, SIZE - 15)
    )
    assert result.accepted, result.reason
    np.testing.assert_allclose(result.shift_px, [6.4, -3.3], atol=0.03)


def test_prepared_reference_gives_the_same() -> None:
    reference, image = _pair((1.2, 3.4), 5.0)
    direct, prepared = (
        register_pair(reference, image),
        register(prepare_reference(reference), image),
    )
    np.testing.assert_array_equal(direct.shift_px, prepared.shift_px)


def test_a_coarse_lattice_is_refused_without_and_resolved_with_a_prediction() -> None:
    """A jump by a period would be a move of the stage."""
    period, shift = 30.0, (2.3, -1.2)
    pair = [noisy(lattice(SIZE, period, s), 4.0, k) for k, s in enumerate([(0.0, 0.0), shift])]
    _refused(register_pair(*pair), "ambiguous")
    vague = np.eye(2) * (2.0 * period) ** 2
    _refused(register_pair(*pair, guess_px=shift, guess_covariance=vague), "ambiguous")
    result = register_pair(*pair, guess_px=(2.0, -1.0), guess_covariance=np.eye(2) * 0.5)
    assert result.accepted, result.reason
    np.testing.assert_allclose(result.shift_px, shift, atol=0.05)


@pytest.mark.parametrize("period", [5.0, 8.0])
def test_a_fine_lattice_without_defects_is_refused_whatever_the_prediction(period: float) -> None:
    """Nothing in the image would tell a jump by a period."""
    shift = (2.3, -1.2)
    pair = [noisy(lattice(SIZE, period, s), 4.0, k) for k, s in enumerate([(0.0, 0.0), shift])]
    _refused(register_pair(*pair), "ambiguous")
    for sigma in (2.0 * period, 0.7):
        covariance = np.eye(2) * sigma**2
        result = register_pair(*pair, guess_px=(2.0, -1.0), guess_covariance=covariance)
        _refused(result, "ambiguous")


@pytest.mark.parametrize("seed", range(6))
def test_the_defects_of_a_lattice_tell_its_shift_also_after_a_jump(seed: int) -> None:
    """Random periods, defects and shifts; some of the predictions are wrong by a period or two."""
    rng = np.random.default_rng(seed)
    period, angle = rng.uniform(8.0, 20.0), rng.uniform(0.0, 0.7)
    shift = rng.uniform(-6.0, 6.0, 2)
    defects = rng.uniform(0.25 * SIZE, 0.75 * SIZE, (4, 2))

    def picture(at: np.ndarray, seed: int) -> np.ndarray:
        whole = lattice(SIZE, period, (float(at[0]), float(at[1])), angle)
        y, x = np.mgrid[:SIZE, :SIZE]
        for defect in defects + at:
            whole = whole + 2.0 * np.exp(-((x - defect[0]) ** 2 + (y - defect[1]) ** 2) / 18.0)
        return noisy(whole, 4.0, seed)

    pair = picture(np.zeros(2), 2 * seed), picture(shift, 2 * seed + 1)
    along = 2.0 * period * np.array([np.cos(angle), np.sin(angle)])
    for guess in (shift + 0.3, shift + along):
        result = register_pair(*pair, guess_px=guess, guess_covariance=np.eye(2) * 0.5)
        # Never by a period, whatever was predicted.
        if result.accepted:
            np.testing.assert_allclose(result.shift_px, shift, atol=0.06)
        else:
            assert "ambiguous" in result.reason
    near = register_pair(*pair, guess_px=shift + 0.3, guess_covariance=np.eye(2) * 0.5)
    assert near.accepted, near.reason


def test_prediction_does_not_override_an_unambiguous_picture() -> None:
    result = register_pair(
        *_pair((20.3, 5.5), 4.0), guess_px=(0.0, 0.0), guess_covariance=np.eye(2)
    )
    np.testing.assert_allclose(result.shift_px, [20.3, 5.5], atol=0.03)


def _noise(seed: int) -> np.ndarray:
    return 100.0 + 10.0 * np.random.default_rng(seed).standard_normal((SIZE, SIZE))


def test_refuses_blank_and_featureless() -> None:
    reference, image = _pair((0.0, 0.0), 4.0)
    _refused(register_pair(reference, np.zeros((SIZE, SIZE), np.uint8)), "image: blank")
    _refused(register_pair(np.full((SIZE, SIZE), 7, np.uint8), image), "reference: blank")
    _refused(register_pair(reference, np.full((SIZE, SIZE), np.nan, np.float32)), "not finite")
    _refused(register_pair(_noise(0), _noise(1)), "reference: featureless (noise only)")
    _refused(register_pair(reference, _noise(2)), "stands out")


@pytest.mark.parametrize(
    ("offset", "share_black", "share_white"), [(60.0, 0.06, 0.83), (130.0, 0.54, 0.24)]
)
def test_what_is_not_saturated_tells_the_shift(
    offset: float, share_black: float, share_white: float
) -> None:
    """Pixels at an end of the grey scale show nothing, and their noise is hidden; the edges between them show it."""
    shift = np.array([2.3, -1.4])
    pair = [np.clip((p - offset) * 10.0, 0, 255).astype(np.uint8) for p in _pair(tuple(shift), 4.0)]
    assert np.mean(pair[0] == 0) == pytest.approx(share_black, abs=0.02)
    assert np.mean(pair[0] == 255) == pytest.approx(share_white, abs=0.02)
    result = register_pair(*pair)
    assert result.accepted, result.reason
    # 3 sigmas of the two directions.
    z = np.linalg.solve(np.linalg.cholesky(result.covariance), result.shift_px - shift)
    assert float(z @ z) < stats.chi2.isf(0.0027, 2)
    assert np.max(np.abs(result.shift_px - shift)) < 0.05


def test_a_few_bright_pixels_on_black_are_not_blank() -> None:
    """They are found in large images, too, wherever they lie."""
    image = np.zeros((1024, 1024), np.uint8)
    image[611, 333] = 200
    assert not prepare_reference(image).defect.startswith("blank")


def test_refuses_what_leaves_a_direction_open() -> None:
    ramp = 100.0 * np.tanh((np.arange(SIZE) - 90.0) / 3.0)[None, :] * np.ones((SIZE, 1))
    rng = np.random.default_rng(3)
    edge = [ramp + 5.0 * rng.standard_normal(ramp.shape) for _ in range(2)]
    _refused(register_pair(*edge), "one direction", "ambiguous")


def test_refuses_unrelated_textures() -> None:
    for seed in range(12):
        blur = 1.0 + 0.5 * seed
        pair = [Texture(k + seed, 256, blur, 3.0 * blur).view((0.0, 0.0), SIZE) for k in (100, 200)]
        assert not register_pair(*(noisy(p, 4.0, k + seed) for k, p in enumerate(pair))).accepted


def test_refuses_when_halves_move_differently() -> None:
    reference, image = _pair((0.0, 0.0), 4.0)
    image[:, SIZE // 2 :] = noisy(TEXTURE.view((3.0, 0.0), SIZE), 4.0, 9)[:, SIZE // 2 :]
    _refused(register_pair(reference, image), "disagree")


def _partly_moved(by_px: float, seed: int) -> Registration:
    """A picture whose left quarter moves by so much, less than is found to be a motion of its own."""
    reference, image = _pair((0.3, -0.2), 6.0, seed)
    part = noisy(TEXTURE.view((0.3 + by_px, -0.2), SIZE), 6.0, 2 * seed + 1)
    image[:, : SIZE // 4] = part[:, : SIZE // 4]
    return register_pair(reference, image)


def test_what_moves_by_itself_and_is_not_found_is_in_the_sigma() -> None:
    # The pull is up to a quarter of the motion, six times the sigma of the noise. A square shows a third of the strip.
    pulled = [_partly_moved(0.14, seed) for seed in range(12)]
    assert all(found.accepted and found.moving is None for found in pulled)
    errors = np.array([found.shift_px[0] - 0.3 for found in pulled])
    sigmas = np.array([np.sqrt(found.covariance[0, 0]) for found in pulled])
    plain = np.mean([np.sqrt(_partly_moved(0.0, seed).covariance[0, 0]) for seed in range(12)])
    assert abs(errors.mean()) > 5.0 * plain
    assert np.sqrt(np.mean((errors / sigmas) ** 2)) < 2.5
    # Across, where nothing pulls, the sigma is that of the noise.
    across = np.mean([np.sqrt(found.covariance[1, 1]) for found in pulled])
    assert across < 1.5 * plain


def test_where_all_moves_alike_chance_is_seldom_taken_for_a_pull() -> None:
    found = [register_pair(*_pair((0.3, -0.2), 6.0, seed)).alignment for seed in range(40)]
    # What is found once is found, and added, again.
    widened = [
        alignment.with_pull().covariance[0, 0] > alignment.covariance[0, 0] for alignment in found
    ]
    # Stated: one image in 20; more than six of 40 come by chance once in 100.
    assert np.count_nonzero(widened) <= 6


def test_refuses_a_moving_picture_under_a_fixed_pattern() -> None:
    # Such as contamination on the detector: two shifts are equally true.
    fixed = 40.0 * Texture(9).view((0.0, 0.0), SIZE)
    reference, image = _pair((25.3, 2.2), 4.0)
    _refused(register_pair(reference + fixed, image + fixed), "ambiguous", "differ", "disagree")


@pytest.mark.parametrize(
    "arguments",
    [
        {"image": np.zeros(5)},
        {"image": np.zeros((64, 64, 2))},
        {"image": np.zeros((64, 64), bool)},
        {"image": np.zeros((64, 64)), "image_region": (0, 0, 65, 64)},
    ],
)
def test_bad_arguments_are_refused_with_a_reason(arguments: dict) -> None:
    with pytest.raises(InvalidValueError, match="expected"):
        register_pair(np.zeros((64, 64)), **arguments)


@pytest.mark.parametrize("band", [FINE, SHARP])
def test_subpixel_filters_are_exact_for_band_limited_pictures(band: Band) -> None:
    picture = TEXTURE.view((0.0, 0.0), 128).astype(np.float32)
    dx, dy = gradients(picture, band)
    exact_x, exact_y = TEXTURE.gradient((0.0, 0.0), 128)
    inner = np.s_[8:-8, 8:-8]
    # Gradients of 0.21 RMS to 0.4 %, an image of unit RMS to 0.2 %.
    assert float(np.sqrt(np.mean((dx - exact_x)[inner] ** 2))) < 8e-4
    assert float(np.sqrt(np.mean((dy - exact_y)[inner] ** 2))) < 8e-4
    for fraction in ((0.3, -0.4), (0.5, 0.5), (-0.9, 0.0)):
        plain = np.array([1.0])
        patch = sample_shifted(picture, (10, 12), (100, 90), np.array(fraction), plain, band, 0.0)
        moved = TEXTURE.view((-fraction[0], -fraction[1]), 128)[12:102, 10:110]
        assert float(np.sqrt(np.mean((patch - moved) ** 2))) < 2e-3


@pytest.mark.parametrize("corner", [(10, 12), (2, 1), (13, 14)])
def test_tiles_are_what_the_filters_give(corner: tuple[int, int]) -> None:
    picture = TEXTURE.view((0.0, 0.0), 64).astype(np.float32)
    fraction, smoothing = np.array([0.3, -0.4]), np.array([0.1, 0.2, 0.4, 0.2, 0.1])
    # The second and the third reach beyond the edges.
    whole = sample_shifted(picture, corner, (49, 48), fraction, smoothing, FINE, 0.0)
    tiles = sample_tiles(picture, corner, (7, 6), (7, 8), fraction, smoothing, FINE)
    joined = tiles.reshape(7, 6, 8, 7).transpose(1, 2, 0, 3).reshape(48, 49)
    # Single precision, of an image of unit RMS.
    np.testing.assert_allclose(joined, whole, atol=3e-6)


@pytest.mark.parametrize("band", [FINE, SHARP])
def test_transposed_gradients_are_those_of_the_other_factor(band: Band) -> None:
    one, other = np.random.default_rng(0).standard_normal((2, 40, 33), dtype=np.float32)
    slopes, transposed = gradients(one, band), gradients_transposed(other, band)
    for slope, back in zip(slopes, transposed, strict=True):
        # Sums of some 1300 products of unit size in single precision.
        assert float(np.vdot(slope, other)) == pytest.approx(float(np.vdot(one, back)), abs=1e-3)


def test_jitter_of_the_scan_lines_is_in_the_covariance() -> None:
    rng = np.random.default_rng(5)
    inside = []
    for trial in range(24):
        reference = noisy(TEXTURE.view((0.0, 0.0), SIZE), 3.0, 2 * trial)
        # Each line by itself, as vibration and stray fields move it.
        exact = TEXTURE.view((2.3, -1.6), SIZE + 2)[1:-1]
        columns = np.arange(SIZE) + 1.0
        lines = [
            np.interp(columns - dx, np.arange(SIZE + 2), line)
            for dx, line in zip(rng.normal(0.0, 0.4, SIZE), exact, strict=True)
        ]
        result = register_pair(reference, noisy(np.array(lines), 3.0, 2 * trial + 1))
        assert result.accepted, result.reason
        inside.append(np.abs(result.shift_px - (2.3, -1.6)) / np.sqrt(np.diag(result.covariance)))
    # 48 values: 68 and 95 % within three binomial deviations. Noise taken for white would put a
    # third of the shifts along the lines beyond two sigma.
    assert np.mean(np.array(inside) < 1.0) > 0.48
    assert np.mean(np.array(inside) < 1.96) > 0.85


def test_featureless_in_one_direction_however_noisy_is_refused() -> None:
    rng = np.random.default_rng(0)
    x = np.arange(SIZE) / 9.0
    for angle in (0.0, 0.5, 1.2):
        y, col = np.meshgrid(x, x, indexing="ij")
        stripes = 60.0 * np.sin(np.cos(angle) * col + np.sin(angle) * y)
        pair = [128.0 + stripes + rng.normal(0.0, 12.0, stripes.shape) for _ in range(2)]
        for guess in ({}, {"guess_covariance": np.eye(2)}):
            result = register_pair(*pair, **guess)
            assert not result.accepted
            assert result.reason


def test_too_small_an_overlap_is_not_searched() -> None:
    # Half of the width and half of the height: a quarter of the area, though each is more than 30 %.
    pair = _pair((96.4, -95.7), 4.0)
    _refused(
        register_pair(*pair),
        "stands out",
        "too little overlap",
        "featureless",
        "differ",
        "ambiguous",
    )
    less = register_pair(*pair, settings=RegistrationSettings(min_overlap=0.2))
    assert less.accepted, less.reason
    assert less.alignment.overlap == pytest.approx(0.25, abs=0.01)


def test_every_rejection_has_its_kind() -> None:
    reference, image = _pair((0.0, 0.0), 4.0)
    blank = np.zeros((SIZE, SIZE), np.uint8)
    torn = image.copy()
    torn[:, SIZE // 2 :] = noisy(TEXTURE.view((3.0, 0.0), SIZE), 4.0, 9)[:, SIZE // 2 :]
    grid = [noisy(lattice(SIZE, 12.0, (2.0 * k, 0.0)), 4.0, k) for k in range(2)]
    for pair, failure in (
        ((blank, image), MatchFailure.UNUSABLE_REFERENCE),
        ((reference, blank), MatchFailure.UNUSABLE_IMAGE),
        ((reference, _noise(2)), MatchFailure.NO_PEAK),
        (grid, MatchFailure.AMBIGUOUS),
        ((reference, torn), MatchFailure.HALVES_DISAGREE),
    ):
        rejection = register_pair(*pair).rejection
        assert rejection is not None
        assert rejection.status is failure


@pytest.mark.parametrize(("off_px", "accepted"), [(1.7, True), (2.3, False)])
def test_a_coarse_shift_that_the_fine_one_contradicts_is_refused(
    off_px: float, accepted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where coarse and fine structure of an image move apart: a sample and 1 px are allowed."""
    reference, image = _pair((3.3, -2.1), 4.0)
    # Samples of 1 px.
    peak = CoarsePeak((3.3, -2.1 + off_px), 0.9, 50.0, 1.0)
    monkeypatch.setattr(
        register_module, "find_coarse_peaks", lambda *_arguments, **_options: [peak]
    )
    result = register_pair(reference, image)
    np.testing.assert_allclose(result.shift_px, [3.3, -2.1], atol=0.1)
    assert result.accepted == accepted
    if result.rejection is not None:
        assert result.rejection.status is MatchFailure.STAGES_DISAGREE


def test_pictures_with_less_than_the_least_correlation_are_refused() -> None:
    # Each image adds a texture of its own that is as strong as the common one: they correlate by half.
    own = [40.0 * Texture(k).view((0.0, 0.0), SIZE) for k in (31, 32)]
    reference, image = (
        picture + extra for picture, extra in zip(_pair((3.3, -2.1), 4.0), own, strict=True)
    )
    rejection = register_pair(reference, image).rejection
    assert rejection is not None
    assert rejection.status is MatchFailure.DISSIMILAR
    lenient = register_pair(reference, image, settings=RegistrationSettings(min_correlation=0.3))
    assert lenient.rejection is None or lenient.rejection.status is not MatchFailure.DISSIMILAR
    assert lenient.correlation == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("count", [1, 2])
def test_shifts_that_cannot_be_refined_say_why(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """One peak and competing ones alike once had a single reason for all causes."""
    reference, other = _pair((0.0, 0.0), 4.0)[0], noisy(Texture(7).view((0.0, 0.0), SIZE), 4.0, 5)
    y, x = np.mgrid[:SIZE, :SIZE] / 9.0
    rng = np.random.default_rng(0)
    stripes = [
        128.0 + 60.0 * np.sin(0.9 * x + 0.4 * y) + rng.normal(0.0, 4.0, x.shape) for _ in "ab"
    ]
    apart = (0.0, 0.0), (0.0, 3.0)
    for pair, shifts, status, told in (
        ((reference, other), apart, MatchFailure.DISSIMILAR, "images differ"),
        (stripes, apart, MatchFailure.UNDETERMINED, "one direction is not determined"),
        (
            (reference, reference),
            ((180.0, 0.0), (-180.0, 0.0)),
            MatchFailure.TOO_LITTLE_OVERLAP,
            "too little overlap (6 % of the image)",
        ),
    ):
        peaks = [CoarsePeak(shift, 0.9, 20.0, 1.0) for shift in shifts[:count]]
        monkeypatch.setattr(register_module, "find_coarse_peaks", lambda *_, p=peaks, **__: p)
        rejection = register_pair(*pair).rejection
        assert rejection is not None
        assert rejection.status is status
        assert rejection.reason.startswith(told)


def test_what_does_not_converge_is_not_called_featureless(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inverse_compositional, "PASSES_MAX", 1)
    for count in (1, 2):
        peaks = [CoarsePeak((5.0 + k, -2.0), 0.9, 20.0, 4.0) for k in range(count)]
        monkeypatch.setattr(register_module, "find_coarse_peaks", lambda *_, p=peaks, **__: p)
        rejection = register_pair(*_pair((2.3, -1.6), 4.0)).rejection
        assert rejection is not None
        assert rejection.status is MatchFailure.NOT_CONVERGED


def test_noise_is_measured_where_the_texture_is() -> None:
    # The middle of the image is covered by something smooth, as a moving body is before tracking.
    image = _pair((0.0, 0.0), 8.0)[0].astype(np.float32)
    truth = prepare_reference(image)
    image[40:152, 40:] = image.mean()
    settings = RegistrationSettings(texture_region=(0, 153, 192, 192))
    told = prepare_reference(image, settings=settings)
    # 39 x 64 px have some 200 coefficients in the corners of their spectrum: 3 sigma are 20 %.
    assert told.noise_variance == pytest.approx(64.0, rel=0.25)
    assert told.levels[-1].sigma_px == pytest.approx(truth.levels[-1].sigma_px, rel=0.3)
    assert prepare_reference(image).noise_variance < 16.0


def _faint_pair(noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A pair that is resampled by half a pixel, which takes noise away at high frequencies, and the first before."""
    rng = np.random.default_rng(2)
    big = cv2.GaussianBlur(rng.standard_normal((440, 440)).astype(np.float32), (0, 0), 4.0)
    big *= 8.0 / big.std()
    raw = [big[20:404, 20 + k : 404 + k] + rng.normal(0.0, noise, (384, 384)) for k in (0, 3)]
    matrix = np.array([[1.0, 0.0, -0.5], [0.0, 1.0, -0.5]])
    moved = [cv2.warpAffine(im.astype(np.float32), matrix, (384, 384)) for im in raw]
    return moved[0], moved[1], raw[0].astype(np.float32)


def test_noise_that_resampling_has_coloured_is_smoothed_as_white_noise_is() -> None:
    first, _, raw = _faint_pair(12.0)
    white = prepare_reference(raw).levels[-1].sigma_px
    told = prepare_reference(first, raw=raw).levels[-1].sigma_px
    # Without what it was before, it seems to have next to no noise, and structure at all frequencies.
    assert prepare_reference(first).levels[-1].sigma_px < 0.6 * white
    # The variance of a shift is flat about its least: a width that is 30 % larger costs 3 % of its sigma here.
    assert told == pytest.approx(white, rel=0.3)


def _at_low_dose(electrons: float, seed: int, *, moved: bool = True) -> list[np.ndarray]:
    """Two pictures of a rough ground with a contrast of 12 %, at so many electrons per px, 1.5 and -1 px apart; of two
    grounds if they are not ``moved``.
    """
    rng = np.random.default_rng(seed)
    pictures = []
    for k in (0, 1):
        if not (k and moved):
            ground = sum(
                cv2.GaussianBlur(rng.standard_normal((1024, 1024)), (0, 0), s) * s for s in (2, 6)
            )
            ground *= 0.12 / ground.std()
        # Half pixels by the mean of two neighbours of a picture of twice the size.
        top, left = (26, 23) if k and moved else (24, 26)
        seen = cv2.resize(
            ground[top : top + 976, left : left + 976], None, fx=0.5, fy=0.5, interpolation=3
        )
        pictures.append(rng.poisson(electrons * (1.0 + seen)) * (60.0 / electrons))
    return pictures


@pytest.mark.parametrize("electrons", [4.0, 12.0, 40.0])
def test_a_faint_texture_is_told_by_many_pixels(electrons: float) -> None:
    """Its variance is 6 % of that of the noise at 4 electrons, and it is not featureless."""
    z = []
    for seed in range(4):
        first, second = _at_low_dose(electrons, seed)
        found = register_pair(first, second, guess_px=(0.0, 0.0), guess_covariance=4.0 * np.eye(2))
        assert found.accepted, found.reason
        z.append((found.shift_px - [1.5, -1.0]) / np.sqrt(np.diag(found.covariance)))
    # Eight normal deviates have a mean square beyond 2.5 once in 100 times.
    assert np.mean(np.square(z)) < 2.5


@pytest.mark.long
def test_two_faint_textures_have_nothing_in_common() -> None:
    for seed in range(4):
        for electrons in (4.0, 12.0):
            assert not register_pair(*_at_low_dose(electrons, seed, moved=False)).accepted


def test_the_contrast_of_faint_images_is_not_that_of_their_noise() -> None:
    """A mean into which frames went with a contrast that chance made has more noise than it is thought to have."""
    contrasts = [register_pair(*_at_low_dose(4.0, seed)).contrast for seed in range(6)]
    assert np.std(np.log(contrasts)) < 0.06
    first, second = _at_low_dose(400.0, 0)
    # Where they are clear, it is what it is.
    assert register_pair(first, 0.6 * second).contrast == pytest.approx(0.6, abs=0.02)


def test_faint_images_are_compared_with_all_their_pixels() -> None:
    first, second, raw = _faint_pair(40.0)
    found = register(prepare_reference(first, raw=raw), second)
    assert found.accepted, found.rejection
    error_px = np.abs(found.shift_px - [-3.0, 0.0])
    assert np.all(error_px < 4.0 * np.sqrt(np.diag(found.covariance)))


def _edge(shift: tuple[float, float], scale: float, seed: int) -> np.ndarray:
    """A soft edge with a bright rim that bends once through the image, at 150 electrons per px, and nothing else."""
    y, x = (np.indices((256, 256)) - 127.5) / scale
    x, y = x - shift[0], y - shift[1]
    beyond = (x - 40.0 * np.tanh(y / 40.0) - 10.0) / np.hypot(1.0, np.cosh(y / 40.0) ** -2)
    level = 0.35 + 0.3 / (1.0 + np.exp(-beyond / 4.0)) + 0.25 * np.exp(-((beyond / 5.0) ** 2))
    counted = np.random.default_rng(seed).poisson(150.0 * level) / 150.0
    return np.clip(np.rint(200.0 * counted), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("scale", [1.0, 1.01])
def test_one_edge_does_not_tell_a_scale(scale: float) -> None:
    """A change of it moves the edge nearly as a shift and a shear do; what its gradients leave is noise, which would
    answer with a scale of its own.
    """
    for seed in range(6):
        found = register_pair(_edge((0.0, 0.0), 1.0, seed), _edge((1.3, -0.8), scale, 100 + seed))
        assert found.fit_similarity() is None
        if scale == 1.0:
            error = found.shift_px - [1.3, -0.8]
            assert found.accepted, found.reason
            assert error @ np.linalg.solve(found.covariance, error) < 25.0
