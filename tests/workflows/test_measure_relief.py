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

"""Heights of pictures by a microscope with distortion, with its calibration and without."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from benchmarks.thresholds.fleets.reconstruction import AXIS_RAD, RoughSurface, expose
from semcal_ros.calibration import Calibration
from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.workflows.measure_relief import Relief, measure_relief
from tests.helpers.calibrations import calibrated

SIDE, G = 240, 100.0
TILTS_RAD = (0.0, float(np.radians(8.0)))


def test_a_calibration_takes_the_distortion_out_of_the_heights() -> None:
    model = Calibration.from_model(calibrated("jsm820").model)
    camera = model.at(G).resized(SIDE, SIDE)
    surface = RoughSurface(np.random.default_rng(3), SIDE, 6.0)
    rows, columns = np.indices((SIDE, SIDE), dtype=np.float64)
    raw = np.stack([columns.ravel(), rows.ravel()], axis=1)
    at = camera.rect_from_raw(raw)

    def distort(picture: Array) -> Array:
        values = map_coordinates(picture, at[:, ::-1].T, order=3, mode="nearest")
        return values.reshape(SIDE, SIDE)

    looks = [surface.look(tilt, (0.0, 40.0 * k)) for k, tilt in enumerate(TILTS_RAD)]
    rng = np.random.default_rng(4)
    images = [(expose(distort(grey), rng), G) for grey, _ in looks]
    truth_m = camera.rectified.pixel_size_m[0] * looks[0][1]

    def measure(calibration: Calibration | None) -> tuple[Relief, float, float]:
        relief = measure_relief(
            images,
            tilts_rad=TILTS_RAD,
            axis_rad=AXIS_RAD,
            tilt_sigma_rad=1e-4,
            calibration=calibration,
        )
        error = relief.heights.height_m - truth_m
        error -= np.nanmedian(error)
        over_sigma = np.sqrt(np.nanmean((error / relief.heights.sigma_m) ** 2))
        return relief, float(over_sigma), float(np.sqrt(np.nanmean(error**2)))

    flat, over_sigma, error_m = measure(model)
    _, _, untold_m = measure(None)
    assert over_sigma < 1.5
    # Up to 3 px of distortion, by which the pictures are moved against each other by 9 px.
    assert error_m < 0.5 * untold_m
    assert any("rectified by the calibration" in note for note in flat.notes)
    assert any("do not tell a slope" in note for note in flat.notes)


@pytest.mark.parametrize("tilts_rad", [(0.0,), (0.1, 0.1), (0.0, math.nan)])
def test_tilts_that_cannot_be_are_refused(tilts_rad: tuple[float, ...]) -> None:
    images = [(np.zeros((64, 64), np.uint8), G)] * 2
    with pytest.raises(InvalidValueError, match="tilts"):
        measure_relief(images, tilts_rad=tilts_rad)
