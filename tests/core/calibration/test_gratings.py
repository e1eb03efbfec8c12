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

"""A grating of parallel lines, turned and not tilted, calibrates both axes; what it leaves open is refused or said."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from benchmarks.calibration.gratings import DISPLAY_WIDTH_M, Array, Microscope, draw_picture
from semcal_ros.core.calibration.judgement.check import Verdict
from semcal_ros.core.calibration.judgement.plan import judge_calibration
from semcal_ros.core.calibration.judgement.thresholds import PLANNED_DIRECTIONS_RAD
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.calibration.views import FoundView
from semcal_ros.core.camera.uncertainty import worst_pixel_size
from semcal_ros.core.corners import LatticeDetection, find_lattice
from semcal_ros.core.errors import CalibrationError
from semcal_ros.workflows.calibrate import RecordingCalibration, calibrate_found
from semcal_ros.workflows.check_and_update import check, update
from semcal_ros.workflows.evaluate import evaluate

PITCH_M = 1e-6
SCOPE = Microscope(384, 320, (1.01, 0.995), 3e-3, 0.01, 0.0)
THREE = (0.1, 1.2, 2.2)


def pixel_m(magnification: float) -> float:
    return DISPLAY_WIDTH_M / (magnification * SCOPE.width)


@cache
def view(magnification: float, turn: float) -> FoundView:
    rng = np.random.default_rng(int(100.0 * turn))
    picture = draw_picture(SCOPE, pixel_m(magnification), PITCH_M, turn, rng)
    found = find_lattice(picture, pattern="grating")
    assert isinstance(found, LatticeDetection), found.reason
    return FoundView(f"{magnification:g}x {turn:g}", magnification, None, found)


def calibrated(
    views: Sequence[FoundView], options: CalibrationOptions | None = None
) -> RecordingCalibration:
    return calibrate_found(
        views, [], display_width_m=DISPLAY_WIDTH_M, squares_m=[PITCH_M], options=options
    )


def misfit_px(done: RecordingCalibration, magnification: float) -> float:
    """RMS distance after the best shift and turn, px: the scale counts."""
    camera = done.calibration.at(magnification)
    x, y = (values.ravel() for values in SCOPE.raster(16))
    raw: Array = np.stack([x, y], axis=1) + 0.5 * np.array([SCOPE.width - 1, SCOPE.height - 1])
    ours = camera.undistort(raw) @ np.linalg.inv(camera.ideal_from_sem_jacobian).T
    truth = np.stack(SCOPE.metres(x, y, pixel_m(magnification)), axis=1)
    ours, truth = ours - ours.mean(axis=0), truth - truth.mean(axis=0)
    u, _, vt = np.linalg.svd(ours.T @ truth)
    left = (ours @ (u @ vt) - truth) / pixel_m(magnification)
    return float(np.sqrt(np.mean(np.sum(left**2, axis=1))))


def test_three_directions_tell_both_axes_the_skew_and_the_distortion() -> None:
    done = calibrated([view(3000.0, turn) for turn in THREE])
    camera = done.calibration.at(3000.0)
    expected = pixel_m(3000.0) * np.array(SCOPE.sizes)
    # The three views have one height, so that what remains is noise: 0.05 px at 500 places of a view.
    assert np.allclose(camera.pixel_size_m, expected, rtol=5e-4)
    assert misfit_px(done, 3000.0) < 0.1
    # Stated are also heights of 10 um under an unknown pivot.
    sigma = np.array(camera.pixel_size_sigma_m) / expected
    assert np.all((sigma > 5e-4) & (sigma < 5e-3))
    assert not any("tilted" in finding.text for finding in done.result.findings)


@pytest.mark.long
def test_two_directions_leave_the_skew_to_its_prior_and_say_so() -> None:
    done = calibrated([view(3000.0, turn) for turn in (0.1, 0.1 + 0.5 * np.pi, 0.12)])
    said = [finding.text for finding in done.result.findings]
    assert any("two directions" in text for text in said)
    # What helps with a board, a tilt or a turned scan, does not with lines, or is not what is at hand.
    assert not any("tilt" in text or "scan rotated" in text for text in said)
    expected = pixel_m(3000.0) * np.array(SCOPE.sizes)
    assert np.allclose(done.calibration.at(3000.0).pixel_size_m, expected, rtol=2e-3)


@pytest.mark.long
def test_the_advice_is_to_turn_and_its_views_bring_what_it_says() -> None:
    first = [view(3000.0, turn) for turn in (0.1, 0.7, 0.12)]
    done = calibrated(first)
    verdict = judge_calibration(done.calibration)
    assert "untilted, turned to 0, 60 and 120 degrees" in verdict.advise()
    assert verdict.next_visit is not None
    with_more = calibrated([*first, *(view(3000.0, 0.3 + turn) for turn in PLANNED_DIRECTIONS_RAD)])
    reached = worst_pixel_size(with_more.calibration)[0]
    # 1.5 % before, from what two directions leave open. Planned are sharp pictures, with points of 0.05 px.
    assert reached < 0.2 * verdict.largest
    assert reached == pytest.approx(verdict.next_visit.largest, rel=0.5)


@pytest.mark.long
def test_what_was_a_grating_is_looked_for_as_one() -> None:
    done = calibrated([view(3000.0, turn) for turn in THREE])
    pictures = [
        draw_picture(SCOPE, pixel_m(3000.0), PITCH_M, turn, np.random.default_rng(k))
        for k, turn in enumerate((0.4, 1.5, 2.6))
    ]
    # Neither pattern nor pitch is told: the calibration knows both.
    source = [(picture, 3000.0, float(k)) for k, picture in enumerate(pictures)]
    assert check(done.calibration, source).result.verdict is Verdict.VALID
    assert evaluate(done.calibration, source).views == 3
    renewed = update(done.calibration, source, ageing=1e-4)
    assert renewed.calibration.record is not None
    assert renewed.calibration.record.is_grating


def test_one_direction_is_refused() -> None:
    with pytest.raises(CalibrationError, match="one direction"):
        calibrated([view(3000.0, turn) for turn in (0.1, 0.12, 0.15)])


def test_a_tilted_grating_and_other_methods_are_refused() -> None:
    views = [view(3000.0, turn) for turn in THREE]
    tilted = [*views[:2], replace(views[2], stage=StageReading(tilt_rad=0.3))]
    with pytest.raises(CalibrationError, match=r"tilted by 17\.2 degrees"):
        calibrated(tilted)
    with pytest.raises(CalibrationError, match="method discrete"):
        calibrated(views, CalibrationOptions(method="discrete"))
