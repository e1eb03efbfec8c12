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

"""The step of the differential equations: which magnifications it selects, and which step is chosen."""

from __future__ import annotations

import numpy as np
import pytest

from semcal_ros.core.calibration.judgement.evaluate import rms_by_magnification
from semcal_ros.core.calibration.options import CalibrationOptions, MethodOptions
from semcal_ros.core.calibration.paper.discrete import DiscreteFit
from semcal_ros.core.calibration.paper.pda import (
    StepTrial,
    choose_step,
    equation_error,
    select_magnifications,
    try_steps,
)
from semcal_ros.core.camera.calibration_model import FUNCTION_NAMES
from semcal_ros.core.errors import CalibrationError, InvalidValueError
from semcal_ros.synthetic import CALIBRATION_MAGNIFICATIONS
from tests.helpers.calibrations import CALIBRATED, CALIBRATED_EVENLY, calibrated

PAPER = np.array(CALIBRATION_MAGNIFICATIONS)
EVEN = np.arange(100.0, 4101.0, 100.0)


def _fit_of(magnifications: np.ndarray, values: np.ndarray) -> DiscreteFit:
    """Separate calibrations in which every parameter has these values, all equally certain."""
    count = len(magnifications)
    parameters = np.tile(values[:, None], (1, len(FUNCTION_NAMES)))
    covariances = np.tile(1e-4 * np.eye(len(FUNCTION_NAMES)), (count, 1, 1))
    return DiscreteFit(magnifications, parameters, covariances, (None,) * count, (None,) * count)


def test_a_step_selects_its_multiples_and_both_ends():
    def selected(step):
        return PAPER[select_magnifications(PAPER, step)].tolist()

    assert selected(500.0) == PAPER.tolist()
    # 100, 1100, 2100, ... 9100: the recorded ones beside them; and the last.
    assert selected(1000.0) == [100.0, *np.arange(1000.0, 9001.0, 1000.0), 10000.0]
    assert selected(4000.0) == [100.0, 4000.0, 8000.0, 10000.0]
    assert selected(1e6) == [100.0, 10000.0]
    assert selected(1e-3) == PAPER.tolist()


def test_the_steps_that_are_tried_are_multiples_of_the_usual_spacing():
    def tried(magnifications):
        fit = _fit_of(magnifications, np.exp(-magnifications / 5000.0))
        return [(t.step, t.magnifications) for t in try_steps(fit, lambda *_: 1.0)]

    # The first spacing of the paper's magnifications is 400, all others are 500.
    assert tried(PAPER)[:3] == [(500.0, 21), (1000.0, 11), (1500.0, 8)]
    # Spacings 100, 200, 400, ... 3200: the usual one, 600, passes over some; the finest over none.
    assert tried(100.0 * 2.0 ** np.arange(7))[0] == (100.0, 7)


def test_the_step_that_avoids_bad_magnifications_is_chosen():
    """Every second separate calibration is wrong by far more than it says; a step of 200 misses these."""
    u = (EVEN - EVEN[0]) / np.ptp(EVEN)
    true = np.exp(-3.0 * u) + 0.2 * np.exp(2.0 * u)
    values = true.copy()
    values[1::2] += 0.3 * np.where(np.arange(len(values[1::2])) % 2, 1.0, -1.0)

    def error(functions, _covariance):
        found = np.array([functions["aspect"](g) for g in EVEN])
        return float(np.sqrt(np.mean((found - true) ** 2)))

    trials = try_steps(_fit_of(EVEN, values), error)
    by_step = {trial.step: trial for trial in trials}
    assert by_step[100.0].magnifications == 41 and by_step[200.0].magnifications == 21
    assert choose_step(trials) == 200.0
    # Five magnifications are the fewest: an order of 2, two for the fit, one that can be left out.
    assert min(trial.magnifications for trial in trials) >= 5
    # The equation holds at the step of 200 but for what differences of first order cost, and is nonsense at 100.
    assert by_step[200.0].equation_error < 0.3
    assert by_step[100.0].equation_error > 0.5


def test_the_error_of_an_equation_is_the_part_that_it_does_not_explain():
    rng = np.random.default_rng(0)
    u = np.linspace(0.0, 1.0, len(EVEN))
    # What obeys x' = -2 x but for the differences, whose error is about half a step of 1/40 times 2.
    assert equation_error(_fit_of(EVEN, np.exp(-2.0 * u)), 1) < 0.03
    # The second derivative of noise alone is not explained by the noise and its slope. Neighbouring differences share
    # values, though: of D^2 x = (x_(i+2) - 2 x_i + x_(i-2)) / 4h^2, the middle term is the value itself, so that of
    # its square, 6 units, 4 are explained.
    many = np.arange(100.0, 4100.0)
    noise = equation_error(_fit_of(many, rng.normal(size=len(many))), 2)
    # The error of a variance from 4000 values, and of the four larger ones at the ends.
    assert noise == pytest.approx(np.sqrt(1.0 / 3.0), rel=0.05)
    assert equation_error(_fit_of(EVEN, np.zeros(len(EVEN))), 2) == 0.0


def test_the_views_choose_and_not_the_equations():
    """An equation fits its own few samples well, however far it is from what lies between them."""
    assert choose_step([StepTrial(500.0, 21, 0.9, 0.2), StepTrial(2500.0, 5, 0.1, 0.5)]) == 500.0


def test_too_few_magnifications_and_hopeless_steps_are_refused():
    fit = _fit_of(EVEN[:4], EVEN[:4])
    with pytest.raises(CalibrationError, match="at least 5 to choose a step"):
        try_steps(fit, lambda *_: 0.0)
    with pytest.raises(CalibrationError, match="no finite error with any of 2 steps"):
        choose_step([StepTrial(1.0, 9, 0.1, np.inf), StepTrial(2.0, 5, 0.1, np.inf)])
    for step in (0.0, -1.0, np.nan, np.inf, "best"):
        with pytest.raises(InvalidValueError, match="pda_step"):
            MethodOptions(pda_step=step)


@pytest.mark.long
@pytest.mark.slow
def test_a_chosen_step_is_that_of_the_calibration():
    options = CalibrationOptions("pda", MethodOptions(pda_step="auto"))
    result = calibrated("jsm820", options, CALIBRATED_EVENLY, 3)
    statistics = result.model.statistics
    steps, step = statistics["fit"]["steps"], statistics["fit"]["step"]
    (chosen,) = (row for row in steps if row["step"] == step)
    assert chosen["rms_px"] == min(row["rms_px"] for row in steps)
    # The error that chose it is the calibration's own.
    assert chosen["rms_px"] == pytest.approx(statistics["rms_px"], rel=1e-6)


@pytest.mark.long
@pytest.mark.slow
def test_what_lies_between_the_steps_takes_no_part():
    """Multiples of 3000 above 100 select 100, 3500, 6000 and 10 000: leaving out another one changes nothing."""
    options = CalibrationOptions("pda", MethodOptions(pda_order=1, pda_step=3000.0))
    result = calibrated("jsm820", options)
    used = select_magnifications(np.array(CALIBRATED), 3000.0)
    between = [g for g, u in zip(CALIBRATED, used, strict=True) if not u]
    assert between == [300.0, 800.0, 1800.0]
    rms = rms_by_magnification(result.fit)
    for g in CALIBRATED:
        # The noise of the corners is estimated from other views, which moves the poses a little; a magnification that
        # takes part changes the error by 6 % and more.
        same = result.held_out_rms_px[g] == pytest.approx(rms[g], rel=1e-2)
        assert same == (g in between)
