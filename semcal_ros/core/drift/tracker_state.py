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

"""All that a tracker knows after a frame, and what it says of that frame.

The state never changes: a step makes another one, which shares what has stayed the same. So anything may be tried on a
state; what did not hold is undone by going on from the one before.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.camera_uncertainty import scale_covariance
from semcal_ros.core.drift.estimates import DriftPredictor, DriftStatus, DriftUpdate, forget_prior
from semcal_ros.core.drift.filter import DriftFilter
from semcal_ros.core.drift.flicker import FlickerEstimator
from semcal_ros.core.drift.frame import MotionCorrector, ScanFrame
from semcal_ros.core.drift.gating import OutlierTest
from semcal_ros.core.drift.keyframe_store import KeyframeStore
from semcal_ros.core.drift.lines import LinesOnly
from semcal_ros.core.drift.operations import Inflate, Marginalise, Operation
from semcal_ros.core.drift.own_motion import OwnMotionEstimator
from semcal_ros.core.drift.settings import DriftSettings
from semcal_ros.core.drift.similarity import SimilarityState, turn_drift
from semcal_ros.core.drift.static_parts import StaticParts
from semcal_ros.core.drift.torn_frames import TearTest
from semcal_ros.core.errors import Rejection
from semcal_ros.core.registration.agreement import MovingTiles
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.registration.register import Registration


@dataclass(frozen=True)
class TrackerSetup:
    """What a tracker is told once, apart from its state.

    Attributes
    ----------
    settings
        How to track.
    corrector
        What undoes a motion in a frame; it remembers maps, which change no result.
    keeps_history
        Whether the filters keep all of their events, for a smoother.
    """

    settings: DriftSettings
    corrector: MotionCorrector
    keeps_history: bool


@dataclass(frozen=True)
class TrackerState:
    """Everything that is known since the drift was zero.

    Attributes
    ----------
    filter
        The drift.
    similarity
        Rotation and scale.
    keyframes
        The images that frames are compared with.
    camera, time_s
        Those of the latest frame.
    sample
        Some of its pixels, by which an image that comes again is recognised.
    zoomed_s
        Time of the first frame since the magnification was changed last. Keyframes before are of other visits.
    late_s
        By how much later than its time it may have been taken: an interval where the frame before has the same time.
    outliers
        The test of shifts that were not expected.
    rejected
        Number of frames in a row that did not match.
    sought
        Number of frames that matched since it is not known how far an earlier keyframe is.
    doubt
        (2, 2) what the last frames that contradict the prediction add to the covariance of the drift, until one
        matches.
    jump
        (2, 2) square of the part of the drift at the latest frame that was not expected, and is believed: the frame
        before was there already, or it is no further than drift gets. Zero where it was expected.
    moving, body
        What did not move with the specimen in the last frame that matched, and what measures its motion.
    static
        What never moves.
    tears
        The test for frames of which a part is that of the frame before.
    lines
        What is known where lines alone are seen.
    flicker
        Drift that is faster than the frames.
    """

    filter: DriftFilter
    similarity: SimilarityState
    keyframes: KeyframeStore
    camera: ScanCamera | None
    time_s: float
    sample: bytes
    zoomed_s: float = float("-inf")
    late_s: float = 0.0
    outliers: OutlierTest = field(default_factory=OutlierTest)
    rejected: int = 0
    sought: int = 0
    doubt: Array = field(default_factory=lambda: np.zeros((2, 2)))
    jump: Array = field(default_factory=lambda: np.zeros((2, 2)))
    moving: MovingTiles | None = None
    body: OwnMotionEstimator = field(default_factory=OwnMotionEstimator)
    static: StaticParts = field(default_factory=StaticParts)
    tears: TearTest = field(default_factory=TearTest)
    lines: LinesOnly = field(default_factory=LinesOnly)
    flicker: FlickerEstimator = field(default_factory=FlickerEstimator)

    def goes_on_with(self, frame: ScanFrame, time_s: float) -> bool:
        """Whether a frame continues the stream: it is not earlier, its drift has the same unit, and there is an image
        to compare it with.
        """
        has_same_unit = (self.camera is None) == (frame.camera is None)
        return time_s >= self.time_s and has_same_unit and len(self.keyframes) > 0

    @property
    def previous_s(self) -> float:
        """Time of the frame before, seen from the one that is being followed: where both have the same, a typical
        interval earlier.
        """
        now_s = self.filter.state.time_s
        return self.time_s if now_s > self.time_s else now_s - self.filter.interval_s

    def unseen_covariance(self, px_from_unit: Array) -> Array:
        """(2, 2) covariance of the drift along lines, which has only been predicted since they alone are seen."""
        return self.lines.covariance(self.filter, px_from_unit)

    def apply(self, operation: Operation) -> TrackerState:
        """The state after an operation on the drift."""
        return replace(self, filter=self.filter.apply(operation))

    def inflate(self, inflation: Inflate) -> TrackerState:
        """Let the covariance grow, also that of what is only predicted since lines alone are seen."""
        lines = self.lines.inflate(inflation, self.filter)
        return replace(self.apply(inflation), lines=lines)

    def forget(self, key: int) -> TrackerState:
        """Remove a keyframe, and what is estimated of it."""
        return replace(
            self.apply(Marginalise(key)),
            keyframes=self.keyframes.forget(key),
            similarity=self.similarity.forget(key),
        )

    def see_again(self) -> TrackerState:
        """Both directions are known again; keyframes that were made in between are not."""
        state = self
        for key in sorted(self.lines.blind & set(self.keyframes.keys)):
            state = state.forget(key)
        return replace(state, lines=replace(self.lines, along=None, unseen=None, blind=frozenset()))

    def predictor(self) -> DriftPredictor:
        """What is known now of later times."""
        return DriftPredictor(
            self.filter.state.without_keyframes(),
            self.filter.process_noise,
            self.camera,
            self.similarity.predictor(),
            doubt=self.doubt + self.lines.of_unseen,
            measured=self.filter.measured > 0,
        )


def make_update(
    state: TrackerState,
    frame: ScanFrame,
    status: DriftStatus,
    rejection: Rejection[MatchFailure] | None = None,
    *,
    registration: Registration | None = None,
    overlap: float = float("nan"),
    restarted: bool = False,
) -> DriftUpdate:
    """The drift at a frame; ``overlap`` is for a frame without a registration."""
    drift = state.filter.state
    motion = drift.position, drift.velocity, drift.acceleration
    covariance = drift.drift_covariance
    is_first = registration is None and rejection is None
    similarity = state.similarity.estimate(registration, frame, is_first=is_first)
    if state.similarity.is_active:
        turned = turn_drift(*motion, covariance, similarity)
        motion = turned.position, turned.velocity, turned.acceleration
        covariance = turned.covariance
    of_scale = scale_covariance(frame.camera, motion[0], motion[1])
    covariance = covariance + of_scale
    if not is_first:
        covariance[:2, :2] += state.filter.process_noise.flicker_covariance
    unseen = state.unseen_covariance(frame.px_from_unit)
    covariance[:2, :2] += state.doubt + unseen
    if state.filter.measured == 0:
        covariance = forget_prior(covariance, is_first=is_first)
    alignment = None if registration is None else registration.alignment
    return DriftUpdate(
        time_s=drift.time_s,
        drift_m=motion[0].copy(),
        velocity_m_s=motion[1].copy(),
        acceleration_m_s2=motion[2].copy(),
        covariance=covariance,
        status=status,
        rejection=rejection,
        residual=float("nan") if alignment is None else alignment.residual_rms,
        px_from_unit=frame.px_from_unit,
        overlap=overlap if alignment is None else alignment.overlap,
        calibrated=frame.camera is not None,
        restarted=restarted,
        shear_px=np.full(2, np.nan) if alignment is None else alignment.joint_px[2:],
        shear_covariance=(
            np.full((2, 2), np.inf) if alignment is None else alignment.joint_covariance[2:, 2:]
        ),
        keyframe_time_s=float("nan"),
        merged=False,
        similarity=similarity.mean,
        similarity_covariance=similarity.covariance,
        doubt=state.doubt,
        jump=state.jump,
        unseen=unseen,
        along=state.lines.along,
        moving=None if registration is None else registration.moving,
        own_motion=state.body.latest,
        fixed=None if frame.fixed is None else MovingTiles.of_pixels(frame.fixed),
        stripes=state.static.stripes,
        of_scale=of_scale[:2, :2],
    )
