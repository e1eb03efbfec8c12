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

"""Gating: which measured shifts to believe, and when to trust the prediction less."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, solve_scaled
from semcal_ros.core.drift.frame import ScanFrame
from semcal_ros.core.drift.operations import Inflate, Measure
from semcal_ros.core.drift.state import DriftState
from semcal_ros.core.drift.thresholds import (
    DAMPING,
    INNOVATION_CHI2_MAX,
    INTERVAL_S_MIN,
    REACH_SIGMAS,
    WHOLE_SHARE_MIN,
)
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.failures import MatchFailure


@dataclass(frozen=True)
class OutlierTest:
    """Test of shifts that the filter did not expect, one after the other. Each makes another test.

    One is used if drift can get that far between two frames, if the unexpected shift before agrees
    with it, or if the positions measured before, the last expected one included, show that the
    drift goes on like this.

    Attributes
    ----------
    expected
        Time and position of the last frame that came as expected.
    unexpected
        Those of the frames since, two at most.
    """

    expected: tuple[float, Array] | None = None
    unexpected: tuple[tuple[float, Array], ...] = ()

    @classmethod
    def after(cls, state: DriftState) -> OutlierTest:
        """The test after a frame that came as expected, with that state."""
        return cls((state.time_s, state.position))

    def see(self, time_s: float, position: Array) -> OutlierTest:
        """The test after a frame that was seen at an unexpected ``position`` (2,)."""
        # The same frame may be compared with several keyframes.
        earlier = tuple(e for e in self.unexpected if e[0] < time_s)
        return replace(self, unexpected=(*earlier, (time_s, position))[-2:])

    def explain(
        self, state: DriftState, position: Array, reach: Array, last_s: float
    ) -> tuple[OutlierTest, Inflate | None]:
        """Covariance inflation by which the filter can use an unexpected position.

        Parameters
        ----------
        state
            Prediction.
        position
            (2,) drift that was measured.
        reach
            (2, 2) how far drift gets between two frames: the farthest vector is ``reach`` times a
            unit vector.
        last_s
            Time of the frame before.

        Returns
        -------
        The test from then on, and the inflation; None where the position is an outlier.
        """
        earlier = tuple(e for e in self.unexpected if e[0] < state.time_s)
        test = self.see(state.time_s, position)

        def is_near(expected: Array) -> bool:
            return bool(np.linalg.norm(np.linalg.solve(reach, position - expected)) <= 1.0)

        since_s = max(state.time_s - (earlier[-1][0] if earlier else last_s), INTERVAL_S_MIN)
        innovation = float(np.sum((position - state.position) ** 2))
        spread = np.eye(2) * innovation
        if is_near(state.position):
            return test, _inflate(spread, spread / since_s**2)
        if not earlier:
            return test, None
        velocities = [state.velocity]
        points = earlier if self.expected is None else (self.expected, *earlier)
        if len(points) >= 2:
            (before_s, before), (latest_s, latest) = points[-2:]
            velocities.append((latest - before) / max(latest_s - before_s, INTERVAL_S_MIN))
        for velocity in velocities:
            if is_near(earlier[-1][1] + velocity * since_s):
                change = float(np.sum((velocity - state.velocity) ** 2))
                return test, _inflate(spread, reach @ reach.T / since_s**2 + np.eye(2) * change)
        return test, None


def _inflate(position: Array, velocity: Array) -> Inflate:
    """Inflation by a (2, 2) covariance of the drift and one of its velocity."""
    covariance = np.zeros((6, 6))
    covariance[:2, :2], covariance[2:4, 2:4] = position, velocity
    return Inflate(covariance)


def judge_shift(
    tests: OutlierTest,
    state: DriftState,
    measure: Measure,
    nis: float,
    frame: ScanFrame,
    *,
    share: float = 1.0,
    is_first: bool,
    last_s: float,
    first_step_px: float,
    max_jump: float,
) -> tuple[OutlierTest, Rejection[MatchFailure] | Inflate | None]:
    """Decide whether a measured shift is believed.

    Parameters
    ----------
    tests
        The test of unexpected shifts of this stream.
    state
        Prediction.
    measure
        The measured shift.
    nis
        Its innovation's normalised square.
    frame
        The frame that was measured.
    share
        Part of its structure that shows the shift. What a part of the image does that was not expected, a tool does
        as well as a stage.
    is_first
        Whether nothing was measured before: the first step has only a guessed prior, which must not
        refuse what was registered well.
    last_s
        Time of the frame before.
    first_step_px
        1-sigma of the drift between the first two frames, px.
    max_jump
        Largest unexpected shift of a drift, in image sizes.

    Returns
    -------
    The test from then on, and why the shift is not used, or the covariance inflation with which it is, or None
    where it is used as it is.
    """
    expected, _ = state.predict_shift(measure.key)
    x_px, y_px = np.abs(frame.px_from_unit @ (measure.shift[:2] - expected))
    width, height = frame.size
    is_outlier = nis > INNOVATION_CHI2_MAX
    if (is_first or is_outlier) and (x_px > max_jump * width or y_px > max_jump * height):
        reason = f"jump of ({x_px:.0f}, {y_px:.0f}) px: a move of the stage"
        return tests, Rejection(MatchFailure.STAGE_MOVE, reason)
    is_far = max(x_px, y_px) > reach_of_drift_px(first_step_px)
    if share < WHOLE_SHARE_MIN and is_far and (is_first or is_outlier):
        reason = f"shift of {100.0 * share:.0f} % of the structure is {np.sqrt(nis):.0f} deviations from the prediction"
        return tests, Rejection(MatchFailure.OUTLIER, reason)
    if is_first or not is_outlier:
        return tests, None
    position = measure.shift[:2] + state.keyframe_state(measure.key)[:2]
    # What moves fast may also turn fast.
    step_px = float(np.hypot(*(frame.px_from_unit @ state.velocity))) * (state.time_s - last_s)
    reach_px = max(reach_of_drift_px(first_step_px), step_px)
    reach = np.asarray(reach_px * np.linalg.inv(frame.px_from_unit))
    tests, inflation = tests.explain(state, position, reach, last_s)
    if inflation is None:
        reason = f"shift is {np.sqrt(nis):.0f} deviations from the prediction"
        return tests, Rejection(MatchFailure.OUTLIER, reason)
    return tests, inflation


def reach_of_drift_px(first_step_px: float) -> float:
    """How far drift gets between two frames, px, where its first step has the 1-sigma ``first_step_px``."""
    return REACH_SIGMAS * first_step_px


def inflate_after_pause(speed: float, pause_s: float) -> Inflate:
    """After a long time without a frame: the drift may have stopped, or doubled its speed."""
    spread = np.eye(2) * (speed * pause_s) ** 2
    return _inflate(spread, spread / pause_s**2)


def inflate_position(covariance: Array) -> Inflate:
    """Where the drift was only predicted in a direction that was not seen: ``covariance`` (2, 2) of that."""
    return _inflate(covariance, np.zeros((2, 2)))


def inflate_when_lost(px_from_unit: Array, reach_px: float, speed_px_s: float) -> Inflate:
    """After many frames that did not match: the frame may show another place.

    ``reach_px`` is how far away that may be, ``speed_px_s`` how fast the drift may be there.
    """
    unit = np.linalg.inv(px_from_unit)
    square = unit @ unit.T
    return _inflate(square * reach_px**2, square * speed_px_s**2)


def inflate_if_contradicted(
    state: DriftState, key: int | None, nearest: Array, since_s: float
) -> Inflate | None:
    """Where all shifts that an image allows are far from the prediction; None where one is near.

    Parameters
    ----------
    state
        Prediction.
    key
        Number of the keyframe.
    nearest
        (2,) the nearest shift against it; NaN where there is none.
    since_s
        Time since the frame before.
    """
    if key not in state.keys or not np.all(np.isfinite(nearest)):
        return None
    expected, covariance = state.predict_shift(key)
    innovation = nearest - expected
    if float(innovation @ solve_scaled(covariance, innovation, DAMPING)) <= INNOVATION_CHI2_MAX:
        return None
    spread = np.eye(2) * float(innovation @ innovation)
    return _inflate(spread, spread / since_s**2)
