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

"""A match that is believed or not, and what the filters learn from it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.drift.filter import DriftFilter
from semcal_ros.core.drift.frame import ScanFrame
from semcal_ros.core.drift.gating import (
    OutlierTest,
    inflate_position,
    judge_shift,
    reach_of_drift_px,
)
from semcal_ros.core.drift.matching import Match, RejectedMatch
from semcal_ros.core.drift.measurement import add_zoom_uncertainty
from semcal_ros.core.drift.new_keyframes import change_scale
from semcal_ros.core.drift.operations import Measure
from semcal_ros.core.drift.own_motion import BodyFrame
from semcal_ros.core.drift.state import DriftState
from semcal_ros.core.drift.thresholds import (
    COMMON_SIGMAS,
    DISPUTED_SIGMAS,
    INNOVATION_CHI2_MAX,
    PULLED_SIGMAS,
    SAYS_NOTHING,
    SMALL_ZOOM,
)
from semcal_ros.core.drift.tracker_state import TrackerSetup, TrackerState
from semcal_ros.core.errors import Rejection


def use_match(
    setup: TrackerSetup, state: TrackerState, frame: ScanFrame, match: Match
) -> tuple[TrackerState, RejectedMatch | None]:
    """Update the filters by a match, unless it contradicts the prediction: why it is not used, or None."""
    measure, along = match.measure, match.registration.along
    process_noise, drift = state.filter.process_noise, state.filter.state
    # A keyframe of lines says nothing of the drift along them, whatever came into the picture since.
    sees_again = (
        along is None and state.lines.unseen is not None and measure.key not in state.lines.blind
    )
    anywhere = inflate_position(state.unseen_covariance(frame.px_from_unit))
    if sees_again:
        drift = anywhere(drift, process_noise)
    expected, _ = drift.predict_shift(measure.key)
    innovation = measure.shift[:2] - expected
    zoomed = measure
    if match.candidate.rescaled:
        zoomed = add_zoom_uncertainty(measure, state.keyframes[measure.key].frame, frame)
    outcome = zoomed(drift, process_noise)
    outliers, judged = judge_shift(
        state.outliers,
        drift,
        measure,
        outcome.nis,
        frame,
        share=match.registration.share,
        is_first=state.filter.measured == 0,
        last_s=state.previous_s,
        first_step_px=setup.settings.first_step_px,
        max_jump=setup.settings.max_jump,
    )
    state = replace(state, outliers=outliers)
    if isinstance(judged, Rejection):
        deviation = innovation / DISPUTED_SIGMAS
        disputed = np.outer(deviation, deviation)
        return state, RejectedMatch(judged, match.registration, disputed)
    if sees_again:
        state = state.apply(anywhere).see_again()
    if judged is not None:
        state = state.inflate(judged)
    # A picture before it showed another place, so that the prediction was widened: what came as expected may be a jump.
    far_px = float(np.linalg.norm(frame.px_from_unit @ innovation))
    is_back = np.any(state.doubt) and far_px > reach_of_drift_px(setup.settings.first_step_px)
    if judged is not None or is_back:
        state = replace(state, jump=np.outer(innovation, innovation))
    if along is not None:
        state = replace(state, lines=state.lines.begin_or_go_on(along, state.filter))
    since_s = drift.time_s - state.time_s
    state = replace(state, similarity=state.similarity.use(match.similarity, since_s))
    if outcome.shear_nis > INNOVATION_CHI2_MAX:
        measure = measure.without_shear()
    if match.candidate.ratio > SMALL_ZOOM:
        measure = replace(measure, zoom=zoomed.zoom)
        state, measure = change_scale(setup, state, frame, match, measure)
    elif match.candidate.rescaled:
        # A zoom in small steps would make a long chain of keyframes.
        measure = zoomed
    # Of two directions, one was the predicted one.
    nis = outcome.nis if along is None else 2.0 * outcome.nis
    pull_px = match.registration.alignment.pull_px
    pull = np.asarray(np.linalg.solve(frame.px_from_unit, pull_px), dtype=np.float64)
    known = widen_earlier(state.filter, measure, pull)
    updated = known.update(limit_by_pull(measure, known.state, pull))
    updated = updated.adapt_process_noise(nis, measure.covariance[:2, :2], since_s)
    state = replace(state, filter=updated)
    state = state if match.candidate.rescaled else _look_for_flicker(state, frame, match)
    return _expect(state, frame, match), None


def widen_earlier(before: DriftFilter, measure: Measure, pull: Array) -> DriftFilter:
    """The filter before a measurement; where its ``pull`` (2,) is large, earlier ones were pulled alike, by less than
    could be seen.
    """
    squared = float(pull @ pull)
    noise = float(np.trace(measure.covariance[:2, :2])) - squared
    return before.widen_pulled(measure, pull) if squared > PULLED_SIGMAS**2 * noise else before


def limit_by_pull(measure: Measure, drift: DriftState, pull: Array) -> Measure:
    """The measurement so that what is known after it is no better than its ``pull`` (2,), along that direction.

    What pulls the shift of one frame pulls that of the next one alike: no mean of such frames is better than each. Less
    than :data:`COMMON_SIGMAS` of the noise is of chance, and differs from frame to frame.
    """
    least = float(pull @ pull)
    if least == 0.0:
        return measure
    along = pull / np.sqrt(least)
    seen = along @ measure.jacobian(drift)[:2]
    before, noise = seen @ drift.covariance @ seen, along @ measure.covariance[:2, :2] @ along
    if least <= COMMON_SIGMAS**2 * (noise - least):
        return measure.with_noise_alone()
    if before * noise >= least * (before + noise):
        return measure
    widest = noise * SAYS_NOTHING
    wider = min(before * least / (before - least), widest) if before > least else widest
    covariance = measure.covariance.copy()
    covariance[:2, :2] += (wider - noise) * np.outer(along, along)
    return replace(measure, covariance=covariance)


def _look_for_flicker(state: TrackerState, frame: ScanFrame, match: Match) -> TrackerState:
    """Estimate again what drift faster than the frames does to them, at growing intervals."""
    averaged = float(state.keyframes.averaged(match.candidate.key))
    estimator, is_due = state.flicker.add(match.registration, averaged, frame.size)
    state = replace(state, flicker=estimator)
    if not is_due:
        return state
    variance_px2 = estimator.variance_px2()
    unit = 1.0 / np.sqrt(abs(np.linalg.det(frame.px_from_unit)))
    frame_s = 1.0 if frame.timing is None else frame.timing.frame_time_s
    flicker = variance_px2 * unit**2 / np.array([1.0, 1.0, frame_s**2, frame_s**2])
    if np.array_equal(flicker, state.filter.process_noise.flicker):
        return state
    return replace(state, filter=state.filter.set_flicker(flicker))


def _expect(state: TrackerState, frame: ScanFrame, match: Match) -> TrackerState:
    """The state after a frame that matched: nothing is doubted any more, and what moves by itself is known."""
    drift, moving = state.filter.state, match.registration.moving
    body = None
    if moving is not None and not state.similarity.is_active:
        body = BodyFrame(
            match.image, match.region, moving, drift.position, frame.px_from_unit, drift.time_s
        )
    return replace(
        state,
        rejected=0,
        doubt=np.zeros((2, 2)),
        outliers=OutlierTest.after(drift),
        moving=moving,
        body=state.body.update(body),
    )
