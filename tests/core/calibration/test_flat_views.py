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

"""Pictures of a grid that lies flat, which is what most people have, or on a slanted stub."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.errors import CalibrationError
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.stage import GridFaults, SimulatedStage, stage_views

MICROSCOPE = preset("jsm820")
# The field is so small that the perspective does not tell a tilt.
G = 20000.0
NOISE_PX = 0.05


def views(
    tilts_deg: tuple[float, ...],
    magnification: float = G,
    seed: int = 0,
    largest_turn: float = np.pi,
    axis: float | None = None,
) -> list[GridView]:
    """Views of 34 squares across, turned at random, each tilted about an axis of its own, or about one of all."""
    rng = np.random.default_rng(seed)
    camera = MICROSCOPE.camera_at(magnification)
    i, j = (own.ravel() for own in np.meshgrid(np.arange(-40, 41), np.arange(-40, 41)))
    side = 4e-3 / magnification
    board = side * np.stack([i, j], axis=1)
    out = []
    for k, tilt in enumerate(np.radians(tilts_deg)):
        turn, own = rng.uniform(-1.0, 1.0, 2) * [largest_turn, np.pi]
        own = own if axis is None else axis
        points = np.column_stack([board, np.zeros(len(board))]) @ _turned(turn).T
        points = points @ (_turned(own) @ _tilted(tilt) @ _turned(-own)).T
        points[:, :2] += side * rng.uniform(-0.5, 0.5, 2)
        xy = camera.project(points)
        seen = np.all((xy > 4.0) & (xy < 507.0), axis=1)
        noisy = xy[seen] + rng.normal(0.0, NOISE_PX, (int(seen.sum()), 2))
        sigma = np.full(len(noisy), NOISE_PX)
        name = f"{magnification:g}/{k}"
        out.append(GridView(magnification, board[seen], noisy, sigma, name, square_m=side))
    return out


def _turned(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _tilted(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def calibrated(seen: list[GridView], untilted: str = "auto") -> CalibrationResult:
    return calibrate_views(
        seen,
        image_size=MICROSCOPE.image_size,
        display_width_m=MICROSCOPE.display_width_m,
        options=CalibrationOptions(untilted=untilted),
    )


def proposals(result: CalibrationResult) -> list[str]:
    return [text for text in result.warnings if "--untilted all" in text]


def relative_errors(
    result: CalibrationResult, magnification: float = G
) -> tuple[np.ndarray, np.ndarray]:
    """Of nm per pixel along x and y, and their stated sigmas."""
    camera, truth = result.model.at(magnification), MICROSCOPE.camera_at(magnification)
    found = np.array(camera.pixel_size_m) / np.array(truth.pixel_size_m) - 1.0
    return found, np.array(camera.pixel_size_sigma_m) / np.array(camera.pixel_size_m)


@pytest.mark.long
def test_flat_views_are_seen_to_be_flat_and_what_that_is_worth_is_said() -> None:
    # Hardly turned either: turned views tell the aspect ratio, and with it that nothing is tilted.
    seen = views((0.0,) * 5, largest_turn=0.05)
    free = calibrated(seen)
    (text,) = proposals(free)
    assert "none of the 5 views looks tilted" in text
    flat = calibrated(seen, "all")
    assert not proposals(flat)
    error, sigma = relative_errors(flat)
    _, before = relative_errors(free)
    assert np.max(sigma) < 0.5 * np.max(before)
    assert np.all(np.abs(error) < 3.0 * sigma)


@pytest.mark.long
@pytest.mark.parametrize("tilts", [(0.0, 20.0, 35.0, 20.0), (0.0, 6.0, 7.0, 6.0, 7.0)])
def test_tilted_views_are_not_proposed_as_flat(tilts: tuple[float, ...]) -> None:
    """Six degrees shorten a length by half a per cent, which corners tell well."""
    assert not proposals(calibrated(views(tilts)))


def test_one_flat_picture_is_enough_if_it_is_known_to_be_flat() -> None:
    seen = views((0.0,))
    error, sigma = relative_errors(calibrated(seen, "all"))
    assert np.all(np.abs(error) < 3.0 * sigma)
    with pytest.raises(CalibrationError, match=r"whose tilt is known.*--untilted all"):
        calibrated(seen)


def test_one_flat_picture_at_each_magnification() -> None:
    gs = (1000.0, 1700.0, 2800.0, 4600.0)
    seen = [replace(own, visit=k) for k, g in enumerate(gs) for own in views((0.0,), g, seed=k)]
    result = calibrated(seen, "all")
    for g in gs:
        error, sigma = relative_errors(result, g)
        assert np.all(np.abs(error) < 3.0 * sigma)
        assert np.all(sigma < 5e-3)


def slanted(tilt_deg: float, gs: tuple[float, ...], spread_deg: float = 0.0) -> list[GridView]:
    """Three views at each magnification that are turned, and tilted about one axis by (nearly) one angle."""
    tilts = tilt_deg + spread_deg * np.array([-1.0, 0.0, 1.0])
    return [v for k, g in enumerate(gs) for v in views(tuple(tilts), g, seed=k, axis=0.4)]


@pytest.mark.long
@pytest.mark.parametrize(
    ("tilt_deg", "gs"),
    [(17.0, (500.0, 900.0)), (17.0, (20000.0, 36000.0))],
)
def test_one_tilt_of_all_views_is_not_told_from_the_aspect_ratio(
    tilt_deg: float, gs: tuple[float, ...]
) -> None:
    """A specimen that is turned on a slanted stub is shortened alike in all views, as by a scan that is not square."""
    seen = slanted(tilt_deg, gs)
    result = calibrated(seen)
    error, sigma = relative_errors(result, gs[0])
    assert np.all(np.abs(error) < 2.5 * sigma)
    # The tangent at the tilt that was found would leave 0.7 % open, the prior of the aspect ratio alone 10 %.
    assert 1e-2 < np.max(sigma) < 0.15
    (text,) = [own for own in result.findings if "all tilts are about one axis" in own.text]
    assert text.cost_relative is not None
    assert text.cost_relative > 5e-3


@pytest.mark.long
def test_one_tilt_is_not_told_from_an_aspect_ratio_that_changes_with_magnification() -> None:
    """Over many magnifications the aspect ratio has coefficients that follow the camera with small tilts best."""
    microscope = preset("jsm820")
    gs = (100.0, 300.0, 700.0, 1500.0, 2500.0, 4000.0, 6000.0, 8000.0, 10000.0)
    stage, squares = SimulatedStage(tilts_rad=(0.3,) * 4), GridFaults(squares_sigma=3e-4)
    result = calibrate_views(
        stage_views(microscope.camera_at, gs, stage, squares, seed=4),
        image_size=microscope.image_size,
        display_width_m=microscope.display_width_m,
        options=CalibrationOptions(height_sigma_m=1e-5),
    )
    for g in (150.0, 1000.0, 7000.0):
        camera, truth = result.model.at(g), np.array(microscope.camera_at(g).pixel_size_m)
        error = np.array(camera.pixel_size_m) - truth
        # 3.6 sigmas (RMS) where what the views prefer chooses among the cameras of one rho.
        assert np.all(np.abs(error) < 2.0 * np.array(camera.pixel_size_sigma_m))
        assert np.all(np.array(camera.pixel_size_sigma_m) < 0.08 * truth)


@pytest.mark.long
def test_flat_views_stay_certain_where_the_perspective_shows_that_they_are_flat() -> None:
    _, sigma = relative_errors(calibrated(slanted(0.0, (500.0, 900.0))), 500.0)
    assert np.max(sigma) < 5e-3


@pytest.mark.long
def test_tilts_that_differ_tell_what_is_common_to_them() -> None:
    error, sigma = relative_errors(calibrated(slanted(17.0, (500.0, 900.0), spread_deg=8.0)), 500.0)
    assert np.all(np.abs(error) < 3.0 * sigma)
    assert np.max(sigma) < 1e-2
