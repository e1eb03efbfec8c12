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

"""What tracking says of the drift: its status, its value at a frame, at other times, and along a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.camera_uncertainty import scale_covariance
from semcal_ros.core.drift.own_motion import OwnMotion
from semcal_ros.core.drift.process_noise import ProcessNoise
from semcal_ros.core.drift.similarity import SimilarityPredictor, turn_drift
from semcal_ros.core.drift.state import MOTION_SIZE, DriftState
from semcal_ros.core.drift.stripes import Stripes
from semcal_ros.core.errors import InvalidValueError, Rejection
from semcal_ros.core.rectification.raw_positions import RasterDrift
from semcal_ros.core.registration.agreement import MovingTiles
from semcal_ros.core.registration.failures import MatchFailure
from semcal_ros.core.wording import omit_numbers


class DriftStatus(Enum):
    """What the drift at a frame rests on."""

    #: The frame itself, which became a keyframe.
    KEYFRAME = "keyframe"
    #: The frame, registered against a keyframe.
    TRACKED = "tracked"
    #: The prediction: the frame was not used.
    COASTING = "coasting"


@dataclass(frozen=True)
class DriftEstimate:
    """Drift at one time.

    Attributes
    ----------
    time_s
        The time, s.
    drift_m, velocity_m_s, acceleration_m_s2
        (2,) drift since the first frame in the sem frame, its rate, and the rate of that. In px,
        px/s and px/s^2 of the raw image where there is no camera.
    covariance
        (4, 4) of ``[x, y, vx, vy]`` in those units: from the noise of all images on the way and
        from the covariance of the camera's scale. Infinite where nothing was measured yet, except for
        the position of the first frame, where the drift is zero by definition.
    similarity, similarity_covariance
        (4,) rotation of the image (rad, from x towards y) and logarithm of its scale since the first frame,
        about the origin of the sem frame (the middle of the image without a camera), and their rates
        per s; (4, 4). The drift is the displacement of what lay at that origin. Zero, with the sigma
        that the frame itself does not exclude, where no rotation was found
        (:mod:`semcal_ros.core.drift.similarity`).
    """

    time_s: float
    drift_m: Array
    velocity_m_s: Array
    acceleration_m_s2: Array
    covariance: Array
    similarity: Array = field(default_factory=lambda: np.zeros(4), kw_only=True)
    similarity_covariance: Array = field(
        default_factory=lambda: np.diag(np.full(4, np.inf)), kw_only=True
    )

    @property
    def rotation_rad(self) -> float:
        """Rotation of the image since the first frame, from x towards y."""
        return float(self.similarity[0])

    @property
    def log_scale(self) -> float:
        """Logarithm of the scale of the image since the first frame."""
        return float(self.similarity[1])

    @property
    def raster(self) -> RasterDrift:
        """The drift during a frame whose centre is at that time, for a
        :class:`~semcal_ros.core.rectification.rectifier.Rectifier`.
        """
        turn = self.similarity[:2], self.similarity[2:]
        return RasterDrift(self.drift_m, self.velocity_m_s, self.acceleration_m_s2, *turn)


@dataclass(frozen=True)
class DriftUpdate(DriftEstimate):
    """Drift at the centre of a frame's acquisition.

    Attributes
    ----------
    status
        What the drift rests on.
    rejection
        Why the frame's own image was not used; None where it was.
    residual
        RMS grey levels that the shift does not explain; NaN where nothing was registered.
    px_from_unit
        (2, 2) rectified pixels of this frame per unit of the drift.
    overlap
        Fraction of the image that was compared with the keyframe.
    calibrated
        False where no camera was given.
    restarted
        Whether the drift from here on is not tied to that before: tracking went on at a drift that was only
        predicted, and the frames from here on may show another place; or it began anew at zero, since the time goes
        back or the unit changes. The frames from here on are consistent with each other.
    shear_px, shear_covariance
        (2,) by how much more the last row is shifted against the keyframe than the first, after the
        known motion was removed, and its (2, 2) covariance; NaN and infinite where it was not
        measured.
    keyframe_time_s
        Time of the keyframe that the frame was compared with; NaN where there was none.
    merged
        Whether the frame became part of that keyframe's mean.
    doubt
        (2, 2) the part of the covariance that is due to images that contradict the prediction, this one or
        those before; zero where the drift rests on the frame's own image.
    jump
        (2, 2) square of the part of the drift that was not expected at this frame, and is believed: when it came about
        since the last frame that was used is not known. Zero where it was expected.
    along
        (2,) direction of the lines that frames show, px: the drift along them is only predicted; None where both
        directions are measured.
    unseen
        (2, 2) the part of the covariance that is due to that prediction; zero where both directions are measured.
    moving
        What does not move with the specimen, in px of the rectified frame before its drift is removed; None where
        nothing was found.
    own_motion
        How the largest body of it moves, as it was measured last; None where nothing moves by itself, or its motion is
        not determined (:mod:`semcal_ros.core.drift.own_motion`).
    fixed
        What stays in place while the specimen drifts, such as a data bar or a burnt spot of the detector, and was left
        out; in the same px. None where nothing was found.
    stripes
        In which directions the frame has brightness of its own lines or columns, which was taken out.
    of_scale
        (2, 2) the part of the covariance of the drift that is due to the scale of the camera, which changes metres and
        not pixels.
    """

    status: DriftStatus
    rejection: Rejection[MatchFailure] | None
    residual: float
    px_from_unit: Array
    overlap: float
    calibrated: bool
    restarted: bool
    shear_px: Array
    shear_covariance: Array
    keyframe_time_s: float
    merged: bool
    doubt: Array = field(default_factory=lambda: np.zeros((2, 2)), kw_only=True)
    jump: Array = field(default_factory=lambda: np.zeros((2, 2)), kw_only=True)
    along: Array | None = field(default=None, kw_only=True)
    unseen: Array = field(default_factory=lambda: np.zeros((2, 2)), kw_only=True)
    moving: MovingTiles | None = field(default=None, kw_only=True)
    own_motion: OwnMotion | None = field(default=None, kw_only=True)
    fixed: MovingTiles | None = field(default=None, kw_only=True)
    stripes: Stripes = field(default_factory=Stripes, kw_only=True)
    of_scale: Array = field(default_factory=lambda: np.zeros((2, 2)), kw_only=True)

    @property
    def accepted(self) -> bool:
        """Whether the drift rests on this frame's own image."""
        return self.rejection is None

    @property
    def fixed_share(self) -> float:
        """Part of the frame that stays in place."""
        return 0.0 if self.fixed is None else self.fixed.share

    def draw_apart(
        self, size: tuple[int, int], *, scale: float = 1.0, zoom: float = 1.0
    ) -> NDArray[np.uint8]:
        """(height, width) 255 where the corrected frame of (width, height) shows what does not move with the specimen:
        what moves otherwise, and what stays in place. ``scale`` is by how many times more pixels the frame has than
        what was measured, and ``zoom`` by how many times as large it shows the specimen, where it is another frame.
        """
        width, height = size
        drawn = np.zeros((height, width), dtype=np.uint8)
        drift_px = self.px_from_unit @ self.drift_m
        # What stays in place does so at any magnification.
        for part, seen in ((self.moving, zoom), (self.fixed, 1.0)):
            if part is not None:
                drawn |= part.draw(size, moved_px=-drift_px, scale=scale, zoom=seen)
        return drawn

    @property
    def reason(self) -> str:
        """Why it does not; empty where it does."""
        return "" if self.rejection is None else self.rejection.reason

    @property
    def status_text(self) -> str:
        """``"keyframe"``, ``"tracked"``, the same with what was not seen, or ``"coasting: <reason>"``."""
        if self.along is not None and not self.reason:
            return f"{self.status.value} across lines; predicted along them"
        return f"{self.status.value}: {self.reason}" if self.reason else self.status.value

    @property
    def kind(self) -> str:
        """The status without the numbers of the single frame."""
        return omit_numbers(self.status_text)

    @property
    def units(self) -> str:
        """``"m"`` or ``"px"``: unit of drift, velocity (per s) and covariance."""
        return "m" if self.calibrated else "px"

    @property
    def drift_px(self) -> Array:
        """(2,) drift in rectified pixels of this frame."""
        return self.px_from_unit @ self.drift_m

    @property
    def covariance_px2(self) -> Array:
        """(2, 2) covariance of :attr:`drift_px`, without that of the scale; infinite where nothing was measured."""
        own = self.covariance[:2, :2] - self.of_scale
        if not np.all(np.isfinite(own)):
            return np.diag([np.inf, np.inf])
        return np.asarray(self.px_from_unit @ own @ self.px_from_unit.T)

    @property
    def sigma_px(self) -> Array:
        """(2,) 1-sigma of :attr:`drift_px`, without that of the scale; infinite where nothing was measured."""
        return np.sqrt(np.maximum(np.diag(self.covariance_px2), 0.0))


@dataclass(frozen=True)
class DriftPredictor:
    """All that a prediction needs. It never changes, so that another thread may hold it.

    Attributes
    ----------
    state
        The drift at the last frame.
    process_noise
        Process noise of the drift.
    camera
        Camera of the last frame, or None for drift in px.
    similarity
        Predictor of rotation and scale, or None where there are none.
    doubt
        (2, 2) by how much the drift may be off because the last frames contradict it, or do not show a direction.
    measured
        Whether any drift was measured; if not, a prediction has an infinite covariance.
    """

    state: DriftState
    process_noise: ProcessNoise
    camera: ScanCamera | None
    similarity: SimilarityPredictor | None = None
    doubt: Array = field(default_factory=lambda: np.zeros((2, 2)), kw_only=True)
    measured: bool = field(default=True, kw_only=True)

    @property
    def time_s(self) -> float:
        """Centre of the acquisition of the last frame."""
        return self.state.time_s

    def at(self, time_s: float) -> DriftEstimate:
        """Drift at a time.

        Raises
        ------
        InvalidValueError
            If it is before that of the last frame, or not finite.
        """
        if not self.time_s <= time_s < np.inf:
            raise InvalidValueError(
                f"a forecast for {time_s} s", expected=f"a time after {self.time_s} s"
            )
        transition, noise = self.process_noise.discretise(time_s - self.time_s)
        # As Predict does it, without the keyframes: this is computed for every frame.
        motion = transition @ self.state.mean[:MOTION_SIZE].reshape(3, 2)
        both = np.zeros((4, MOTION_SIZE))
        both[0::2, 0::2] = both[1::2, 1::2] = transition[:2]
        covariance = both @ self.state.covariance[:MOTION_SIZE, :MOTION_SIZE] @ both.T
        covariance[0::2, 0::2] += noise[:2, :2]
        covariance[1::2, 1::2] += noise[:2, :2]
        covariance[:2, :2] += self.process_noise.flicker_covariance + self.doubt
        if not self.measured:
            return DriftEstimate(
                time_s, motion[0], motion[1], motion[2], forget_prior(covariance, is_first=False)
            )
        if self.similarity is None:
            covariance += scale_covariance(self.camera, motion[0], motion[1])
            return DriftEstimate(time_s, motion[0], motion[1], motion[2], covariance)
        similarity = self.similarity.at(time_s)
        turned = turn_drift(motion[0], motion[1], motion[2], covariance, similarity)
        scale = scale_covariance(self.camera, turned.position, turned.velocity)
        return DriftEstimate(
            time_s,
            turned.position,
            turned.velocity,
            turned.acceleration,
            turned.covariance + scale,
            similarity=similarity.mean,
            similarity_covariance=similarity.covariance,
        )


def forget_prior(covariance: Array, *, is_first: bool) -> Array:
    """Covariance (4, 4) of a drift of which nothing was measured: the filter's is that of a typical drift only.

    ``is_first`` keeps the (2, 2) block of the position of the first frame, which is zero by definition.
    """
    unknown = np.diag(np.full(4, np.inf))
    if is_first:
        unknown[:2, :2] = covariance[:2, :2]
    return unknown


@dataclass(frozen=True)
class DriftPath:
    """Drift at n frames.

    Attributes
    ----------
    updates
        The n frames, live or with hindsight. The properties are their columns.
    """

    updates: Sequence[DriftUpdate]

    def __len__(self) -> int:
        return len(self.updates)

    def __getitem__(self, index: int) -> DriftUpdate:
        return self.updates[index]

    @cached_property
    def time_s(self) -> Array:
        """(n,) centres of the acquisitions."""
        return np.array([u.time_s for u in self.updates])

    @cached_property
    def drift_m(self) -> Array:
        """(n, 2) drift since the first frame; px where not ``calibrated``."""
        return np.array([u.drift_m for u in self.updates]).reshape(-1, 2)

    @cached_property
    def velocity_m_s(self) -> Array:
        """(n, 2) its rate."""
        return np.array([u.velocity_m_s for u in self.updates]).reshape(-1, 2)

    @cached_property
    def covariance(self) -> Array:
        """(n, 4, 4) of ``[x, y, vx, vy]``."""
        return np.array([u.covariance for u in self.updates]).reshape(-1, 4, 4)

    @cached_property
    def drift_px(self) -> Array:
        """(n, 2) drift in rectified pixels of each frame."""
        return np.array([u.drift_px for u in self.updates]).reshape(-1, 2)

    @cached_property
    def similarity(self) -> Array:
        """(n, 4) rotation, rad, and logarithm of the scale since the first frame, and their rates."""
        return np.array([u.similarity for u in self.updates]).reshape(-1, 4)

    @property
    def turns(self) -> bool:
        """Whether rotation or a change of scale was found."""
        return bool(np.any(self.similarity))

    @property
    def similarity_sigma(self) -> Array:
        """(n, 2) 1-sigma of rotation and logarithm of the scale."""
        return np.array(
            [np.sqrt(np.diag(u.similarity_covariance)[:2]) for u in self.updates]
        ).reshape(-1, 2)

    @cached_property
    def residual(self) -> Array:
        """(n,) RMS grey levels that the shift does not explain; NaN where nothing was registered."""
        return np.array([u.residual for u in self.updates])

    @cached_property
    def accepted(self) -> Mask:
        """(n,) bool: whether the drift rests on the frame's own image."""
        return np.array([u.accepted for u in self.updates], dtype=bool)

    @cached_property
    def restarted(self) -> Mask:
        """(n,) bool: whether the drift from the frame on is not tied to that before it."""
        return np.array([u.restarted for u in self.updates], dtype=bool)

    @property
    def calibrated(self) -> bool:
        """False where no camera was given."""
        return all(u.calibrated for u in self.updates)

    @property
    def trusted(self) -> Mask:
        """(n,) bool: accepted, and tracked all the way back to the first frame.

        After a restart nothing is, until a frame is found with one from before it: nothing else makes its place known
        to half of the 1-sigma that it had there. Where the drift begins anew at zero, nothing is from then on.
        """
        limit, tied = np.inf, np.ones(len(self.updates), dtype=bool)
        for k, update in enumerate(self.updates):
            if update.restarted:
                sigma_px = update.sigma_px.max()
                limit = min(limit, 0.5 * sigma_px if np.isfinite(sigma_px) else 0.0)
                tied[k] = False
            elif limit < np.inf:
                tied[k] = update.sigma_px.max() < limit
        return self.accepted & tied

    @property
    def followed(self) -> bool:
        """Whether any frame was matched with another one; if not, no drift was measured."""
        return int((self.accepted & ~self.restarted).sum()) > 1

    @property
    def sigma_m(self) -> Array:
        """(n, 2) 1-sigma of ``drift_m``."""
        return np.sqrt(self.covariance[:, [0, 1], [0, 1]])

    @property
    def velocity_sigma_m_s(self) -> Array:
        """(n, 2) 1-sigma of ``velocity_m_s``."""
        return np.sqrt(self.covariance[:, [2, 3], [2, 3]])
