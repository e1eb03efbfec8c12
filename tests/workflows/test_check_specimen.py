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

"""Any specimen at several magnifications: a sound calibration agrees, one whose scales have changed does not."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from semcal_ros import Calibration
from semcal_ros.core.camera.calibration_model import ScaleSigma
from semcal_ros.core.errors import BagError
from semcal_ros.core.registration.affine import NotAlignedError, align_affine
from semcal_ros.files.bags.writer import write_simulated
from semcal_ros.synthetic import Detector, RecordingPlan, preset, truth_of
from semcal_ros.synthetic.drift import NO_DRIFT
from semcal_ros.synthetic.plans import PlannedFrame
from semcal_ros.synthetic.pose import Pose, rotation_about_beam
from semcal_ros.synthetic.stage import StagePosition
from semcal_ros.workflows.check_specimen import check_specimen
from semcal_ros.workflows.simulate import simulate
from tests.helpers.calibrations import DEFAULT, calibrated
from tests.helpers.semcal_runs import run

MAGNIFICATIONS = (1000.0, 2000.0, 4000.0)


def texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(800, 800)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 4.0)
    return smooth * (40.0 / smooth.std())


@pytest.mark.parametrize("noise", [2.0, 30.0])
def test_an_affine_map_is_found_within_its_sigma(noise: float) -> None:
    z = []
    for seed in range(12):
        rng, whole = np.random.default_rng(seed), texture(seed)
        matrix = np.eye(2) + 0.004 * rng.normal(size=(2, 2))
        shift = rng.uniform(40.0, 60.0, 2)
        warp = np.column_stack([matrix, shift + 100.0])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        seen = cv2.warpAffine(whole, warp, (256, 256), flags=flags)
        image = whole[100:612, 100:612]
        noisy = [part + noise * rng.normal(size=part.shape) for part in (seen, image)]
        found = align_affine(*(part.astype(np.float32) for part in noisy))
        assert found.shift_px == pytest.approx(shift, abs=0.5)
        z.append((found.matrix - matrix).ravel() / np.sqrt(np.diag(found.covariance)))
    # 48 numbers: their RMS scatters by 0.1, and four of a map are correlated.
    assert 0.6 < np.sqrt(np.mean(np.square(z))) < 1.4


def test_other_places_are_told_apart() -> None:
    with pytest.raises(NotAlignedError, match="correlate"):
        align_affine(texture(1)[:200, :200], texture(2))


@pytest.fixture(scope="module")
def steps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("specimen") / "steps"
    simulate(
        folder, "steps", magnifications=MAGNIFICATIONS, frames=1, specimen="gold", size=512,
        stage=None, grid=None,
    )  # fmt: skip
    return folder


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    model = calibrated("jsm820", DEFAULT).model
    return Calibration.from_model(replace(model, scale_sigma=ScaleSigma(repeatability=1e-3)))


def stretched(calibration: Calibration, by: float, name: str = "scale") -> Calibration:
    """A function that rises by so much over the whole range against what it was."""
    function = calibration.functions[name]
    coefficients = function.coefficients.copy()
    assert function.kind in ("chebyshev_log", "chebyshev")
    coefficients[1] += 0.5 * by
    functions = {**calibration.functions, name: replace(function, coefficients=coefficients)}
    return Calibration.from_model(replace(calibration, functions=functions))


@pytest.mark.slow
def test_a_sound_calibration_agrees(calibration: Calibration, steps: Path) -> None:
    done = check_specimen(calibration, steps, config="virtual_sem")
    assert done.holds
    assert [(r.low, r.high) for r in done.ratios] == [(1000.0, 2000.0), (2000.0, 4000.0)]
    # What makes it uncertain: 0.1 % of repeatability at each magnification, and drift.
    assert all(1e-3 < r.scale_sigma < 3e-3 for r in done.ratios)


@pytest.mark.slow
def test_scales_that_have_changed_do_not(calibration: Calibration, steps: Path) -> None:
    """The calibration states a scale that rises by 8 % over the calibrated range."""
    plain = check_specimen(calibration, steps, config="virtual_sem")
    changed = stretched(calibration, 0.08)
    done = check_specimen(changed, steps, config="virtual_sem")

    def change(g: float) -> float:
        return changed.functions["scale"](g) / calibration.functions["scale"](g)

    assert not done.holds
    for before, after in zip(plain.ratios, done.ratios, strict=True):
        # More px per m are stated at the higher magnification: too large a ratio of nm per px.
        expected = change(after.high) / change(after.low) - 1.0
        assert after.scale - before.scale == pytest.approx(expected, rel=0.1)
        assert after.aspect == pytest.approx(before.aspect, abs=2e-4)


@pytest.mark.slow
def test_an_aspect_that_has_changed_is_seen(calibration: Calibration, steps: Path) -> None:
    done = check_specimen(stretched(calibration, 0.08, "aspect"), steps, config="virtual_sem")
    assert not done.holds
    assert min(abs(r.aspect) / r.aspect_sigma for r in done.ratios) > 3.3
    assert max(abs(r.scale) / r.scale_sigma for r in done.ratios) < 3.3


def test_one_magnification_is_refused(calibration: Calibration) -> None:
    image = np.clip(128 + texture(3)[:512, :512], 0, 255).astype(np.uint8)
    with pytest.raises(BagError, match="images at one magnification"):
        check_specimen(calibration, [(image, 2000.0)])
    with pytest.raises(BagError, match="5 times apart"):
        check_specimen(calibration, [(image, 1000.0), (image, 5000.0)])


@pytest.fixture(scope="module")
def moves(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Gold on a stage that makes a small square at 2000x, and says where it is to 5 nm."""
    folder = tmp_path_factory.mktemp("specimen") / "moves"
    microscope, g = preset("jsm820").with_image_size(256, 256), 2000.0
    field = microscope.nominal_pixel_size_m(g) * 256
    rng = np.random.default_rng(1)
    frames = []
    for index, (x, y) in enumerate(
        ((0.0, 0.0), (0.2, 0.0), (0.2, 0.2), (0.0, 0.2), (-0.1, 0.1), (0.1, -0.1))
    ):
        true = StagePosition(x_m=x * field, y_m=y * field)
        said = StagePosition(x_m=true.x_m + 5e-9 * rng.normal(), y_m=true.y_m + 5e-9 * rng.normal())
        # Its axes are not those of the image.
        turned = rotation_about_beam(0.4)[:2, :2] @ [true.x_m, true.y_m]
        pose = Pose.flat((*turned, 0.0))
        frames.append(PlannedFrame(10.0 * index, g, pose, None, position=true, position_read=said))
    plan = RecordingPlan(microscope, "gold", tuple(frames), NO_DRIFT, Detector(), 5)
    images = (plan.render(index) for index in range(len(plan)))
    write_simulated(folder, plan.frames, images, truth_of(plan))
    return folder


@pytest.mark.slow
def test_moves_of_the_stage_tell_the_shape_of_the_pixels(
    calibration: Calibration, moves: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    done = check_specimen(calibration, moves, config="virtual_sem")
    (move,) = done.moves
    assert done.holds and done.ratios == () and move.found.frames == 6
    # What limits it is what is presumed of the stage.
    assert move.scale_sigma == pytest.approx((5e-3, 5e-3), rel=0.2)
    assert max(abs(move.found.scale_x), abs(move.found.scale_y), abs(move.found.skew)) < 2e-3
    assert move.found.scatter_m < 3e-8
    calibration.save(tmp_path / "cal.yaml")
    options = ("--specimen", "--config", "virtual_sem", "--stage-accuracy", "0.01%")
    assert run("check", tmp_path / "cal.yaml", moves, *options) == 0
    out = capsys.readouterr().out
    assert "pixels and stage agree" in out and "true to 0.01 % along each axis" in out
    (sigma,) = re.findall(r"^ +2000 +[-+.\d]+ \+- ([.\d]+)", out, re.MULTILINE)
    assert float(sigma) < 50.0 * move.scale_sigma[0]
    # nm per px that are stated too large by 3 % along x and y.
    scale = calibration.functions["scale"]
    functions = {
        **calibration.functions,
        "scale": replace(scale, coefficients=scale.coefficients / 1.03),
    }
    off = Calibration.from_model(replace(calibration, functions=functions))
    wrong = check_specimen(off, moves, config="virtual_sem")
    assert not wrong.holds
    for name in ("scale_x", "scale_y"):
        change = getattr(wrong.moves[0].found, name) - getattr(move.found, name)
        assert change == pytest.approx(0.03, abs=3e-4)
