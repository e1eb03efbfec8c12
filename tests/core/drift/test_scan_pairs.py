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

"""The drift within scans of one place whose rasters are turned by 90 degrees."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.scan_pairs import TurnedScan, average_scans, measure_scan_pairs
from semcal_ros.core.errors import InvalidValueError
from tests.helpers.turned_scans import Drift, scan, still, surface

# Cubic splines follow these exactly.
SMOOTH: list[Drift] = [
    lambda u: np.stack([6.0 * u - 3.0 * u**2, 4.0 * u**3], axis=-1),
    lambda u: np.stack([9.0 + 2.0 * u, -7.0 - 5.0 * u**2], axis=-1),
]


def wandering(rng: np.random.Generator) -> Drift:
    """A drift by some pixels that goes on, turns and swings."""
    offset, way, swing = rng.normal(0.0, [[5.0], [4.0], [1.0]], (3, 2))
    rate, phase = rng.uniform(3.0, 8.0, 2), rng.uniform(0.0, 6.0, 2)

    def drift(progress: Array) -> Array:
        u = progress[..., None]
        return np.asarray(offset + way * u + swing * np.sin(rate * u + phase))

    return drift


def truth_at(drifts: list[Drift], progress: Array) -> Array:
    values = np.array([drift(progress) for drift in drifts])
    return np.asarray(values - values[0].mean(axis=0))


@pytest.mark.long
def test_the_drift_is_found_within_its_uncertainty():
    """Both senses, square and wide frames, coarse and fine structure; 12 pairs of 12 to 32 displacements."""
    ratios = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        shown, turn = surface(seed, rng.uniform(3.0, 7.0)), int(rng.choice([-1, 1]))
        size = (384, 384) if seed % 2 else (448, 320)
        drifts = [wandering(rng), wandering(rng)]
        scans = [
            TurnedScan(scan(shown, drift, size, 90.0 * turn * k, seed=10 * seed + k), turn * k)
            for k, drift in enumerate(drifts)
        ]
        found = measure_scan_pairs(scans)
        error = found.displacement_px - truth_at(drifts, found.progress)
        # The outer knots are told by few tiles.
        assert np.sqrt(np.mean(error[:, 1:-1] ** 2)) < 0.06
        # Its mean over the first scan is zero by definition.
        ratios.append(error[1] / found.sigma_px[1])
    spread = float(np.sqrt(np.mean(np.square(np.concatenate(ratios)))))
    # Some 150 displacements, which are correlated: 20 % either way is by chance.
    assert 0.75 < spread < 1.3


def test_without_noise_it_is_exact():
    """What is left is the rounding to grey levels. A wrong sign, axis or line would leave pixels."""
    shown, drifts = surface(3), SMOOTH
    images = [scan(shown, drift, (384, 384), 90.0 * k, 0.01) for k, drift in enumerate(drifts)]
    scans = [TurnedScan(image, k) for k, image in enumerate(images)]
    found = measure_scan_pairs(scans)
    assert np.abs(found.displacement_px - truth_at(drifts, found.progress)).max() < 0.01
    average = average_scans(scans, found)
    # Where the specimen was on the average over the first scan.
    mean = drifts[0](found.progress).mean(axis=0)
    rows, cols = np.indices((384, 384), dtype=float)
    expected = 128.0 + 40.0 * shown(cols - 191.5 - mean[0], rows - 191.5 - mean[1])
    both = average.count == 2
    assert both.mean() > 0.9
    residual = (average.mean - np.clip(expected, 0.0, 255.0))[both]
    assert np.sqrt(np.mean(residual**2)) < 1.0
    distorted = images[0].astype(float) - np.clip(expected, 0.0, 255.0)
    assert np.sqrt(np.mean(distorted**2)) > 10.0


@pytest.mark.long
def test_distortion_turns_with_the_raster():
    """The lines of a turned scan are those of the beam, so that each scan is undistorted before it is turned."""
    camera = ScanCamera(
        magnification=5000.0,
        m=1e7,
        aspect=1.01,
        skew=0.004,
        px=200.0,
        py=180.0,
        rho=0.0,
        xi_r=0.01,
        xi_t=0.006,
        ex=190.0,
        ey=195.0,
        norm_px=192.0,
        width=384,
        height=384,
    )
    shown, drifts = surface(4), SMOOTH

    def measure(known: ScanCamera | None) -> tuple[Array, Array]:
        scans = [
            TurnedScan(scan(shown, drift, (384, 384), -90.0 * k, 1.0, camera), -k, known)
            for k, drift in enumerate(drifts)
        ]
        found = measure_scan_pairs(scans)
        return np.abs(found.displacement_px - truth_at(drifts, found.progress)), found.sigma_px

    error, sigma = measure(camera)
    assert (error < 0.01 + 4.0 * sigma).all()
    # The lines at either end are hardly in the picture; of the others the drift is known well.
    assert error[:, 1:-1].max() < 0.02
    assert measure(None)[0].max() > 0.5


@pytest.mark.long
def test_several_pairs_are_solved_together():
    shown, drifts = surface(6), [wandering(np.random.default_rng(k)) for k in range(4)]
    scans = [
        TurnedScan(scan(shown, drift, (320, 320), 90.0 * (k % 2), seed=k), k % 2)
        for k, drift in enumerate(drifts)
    ]
    four, two = measure_scan_pairs(scans), measure_scan_pairs(scans[:2])
    error = four.displacement_px - truth_at(drifts, four.progress)
    assert np.sqrt(np.mean((error / np.maximum(four.sigma_px, 1e-3)) ** 2)) < 1.4
    assert np.median(four.sigma_px[1]) < 0.9 * np.median(two.sigma_px[1])
    assert average_scans(scans, four).frames == 4


def test_a_wrong_angle_looks_like_drift():
    """The limit that the description names, in its numbers: half a degree is 0.87 % of the width in each scan."""
    shown = surface(7)
    scans = [TurnedScan(scan(shown, still, (320, 320), 90.5 * k, 1.0), k) for k in (0, 1)]
    found = measure_scan_pairs(scans)
    span = found.progress[-1] - found.progress[0]
    slopes = np.ptp(found.displacement_px, axis=1) / span / 320.0
    turned = np.radians(0.5)
    # Against the first scan, the specimen of the second is turned from +x to +y.
    assert slopes[0] == pytest.approx([turned, 0.0], abs=0.05 * turned)
    assert slopes[1] == pytest.approx([0.0, turned], abs=0.05 * turned)


@pytest.mark.long
def test_where_there_is_no_structure_the_sigma_is_large():
    """Two fifths of the rows are empty: what their columns and the other rows do not tell, nobody knows."""
    whole, drifts = surface(5), [wandering(np.random.default_rng(k)) for k in (1, 2)]

    def shown(x: Array, y: Array) -> Array:
        return np.asarray(whole(x, y) * (y > -40.0))

    scans = [
        TurnedScan(scan(shown, drift, (384, 384), 90.0 * k), k) for k, drift in enumerate(drifts)
    ]
    found = measure_scan_pairs(scans)
    error = found.displacement_px - truth_at(drifts, found.progress)
    # The mean over the first scan, and with it all displacements, depends on the unknown part.
    assert found.sigma_px.max() > 0.5
    assert np.sqrt(np.mean((error / np.maximum(found.sigma_px, 1e-3)) ** 2)) < 2.0
    lines = np.diff(found.displacement_px[0, 4:], axis=0) - np.diff(
        drifts[0](found.progress[4:]), axis=0
    )
    assert np.abs(lines).max() < 0.2


def test_masked_pixels_and_those_that_are_no_number_do_not_count():
    shown = surface(5)
    images = [
        scan(shown, drift, (320, 320), 90.0 * k, 1.0).astype(np.float32)
        for k, drift in enumerate(SMOOTH)
    ]
    mask = np.ones((320, 320), dtype=bool)
    mask[100:160, 200:260] = False
    images[0][~mask] = 3e4
    images[1][20, 30] = np.nan
    scans = [TurnedScan(images[0], 0, None, mask), TurnedScan(images[1], 1)]
    found = measure_scan_pairs(scans)
    assert np.abs(found.displacement_px - truth_at(SMOOTH, found.progress)).max() < 0.05
    average = average_scans(scans, found)
    # What was masked is 30 000.
    assert np.nanmax(average.mean) < 300.0
    assert (average.count == 1).sum() > 60 * 60


def test_odd_sides_turn_about_the_middle_of_the_frame():
    """Otherwise a scan that stands still would be half a pixel off."""
    shown = surface(6)
    scans = [TurnedScan(scan(shown, still, (321, 256), 90.0 * k, 1.0), k) for k in (0, 1)]
    found = measure_scan_pairs(scans)
    assert np.abs(found.displacement_px).max() < 0.03


def test_what_does_not_match_is_refused():
    shown, size = surface(8), (256, 256)
    first = TurnedScan(scan(shown, still, size, 0.0), 0)
    turned = scan(shown, still, size, 90.0, seed=1)
    with pytest.raises(InvalidValueError, match="other sense of rotation"):
        measure_scan_pairs([first, TurnedScan(turned, -1)])
    with pytest.raises(InvalidValueError, match="other sense of rotation"):
        measure_scan_pairs([first, TurnedScan(scan(surface(9), still, size, 90.0), 1)])
    with pytest.raises(InvalidValueError, match="structure"):
        measure_scan_pairs([first, TurnedScan(np.full((256, 256), 7, np.uint8), 1)])
    with pytest.raises(InvalidValueError, match="turned by 0, 180 degrees"):
        measure_scan_pairs([first, TurnedScan(turned, 2)])
    with pytest.raises(InvalidValueError, match="two or more"):
        measure_scan_pairs([first])
    with pytest.raises(InvalidValueError, match="at least 192 px"):
        measure_scan_pairs(
            [TurnedScan(image[:128, :128], k) for k, image in enumerate((first.image, turned))]
        )
    with pytest.raises(InvalidValueError, match=r"scan 2 of shape \(128, 128\)"):
        measure_scan_pairs([first, TurnedScan(turned[:128, :128], 1)])
