"""Settings and results of the live drift tracker."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from semcal_ros.core.arrays import Array, Mask
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.camera_uncertainty import scale_covariance
from semcal_ros.core.drift.process_noise import ProcessNoise
from semcal_ros.core.drift.state import MOVING, DriftState
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.rectification.raw_positions import RasterDrift
from semcal_ros.core.registration.reference import RegistrationSettings

__all__ = [
    "DriftForecast",
    "DriftPath",
    "DriftPredictor",
    "DriftSettings",
    "DriftUpdate",
    "kind_of",
    "path_of_updates",
]


_NUMBER = re.compile(r"-?\d[\d.]*")


def kind_of(status: str) -> str:
    """A status without the numbers of the single frame, so that frames can be counted by kind."""
    return _NUMBER.sub("\u2026", status)


@dataclass(frozen=True)
class DriftSettings:
    """How drift is tracked.

    Attributes
    ----------
    registration
        Limits of a single registration.
    rekey_overlap
        The keyframe is replaced when less than this fraction of the picture still overlaps with it.
    max_jump
        A shift between frames beyond this fraction of the field is taken for a move of the stage,
        not for drift.
    first_step_px
        Expected drift (1-sigma) between the first two frames, px.
    max_ratio
        Largest change of magnification across which the keyframe is carried by resampling.
    lost_after
        Number of consecutive frames that cannot be matched after which tracking starts anew at the
        predicted drift.
    acceleration_psd
        Process noise, m^2/s^3 (px^2/s^3 without a camera); None adapts it to the stream.
    average
        Whether frames are added to their keyframe, so that its noise does not limit what follows.
    max_keyframes, max_keyframe_bytes
        How many pictures are kept to come back to, and their memory.
    interpolation
        Of the rectification before registration.
    """

    registration: RegistrationSettings = field(default_factory=RegistrationSettings)
    rekey_overlap: float = 0.6
    max_jump: float = 0.25
    first_step_px: float = 3.0
    max_ratio: float = 2.5
    lost_after: int = 8
    acceleration_psd: float | None = None
    average: bool = True
    max_keyframes: int = 48
    max_keyframe_bytes: int = 1 << 28
    interpolation: str = "cubic"

    def __post_init__(self) -> None:
        checks = (
            ("rekey_overlap", 0.0 < self.rekey_overlap < 1.0, "a fraction between 0 and 1"),
            ("max_jump", 0.0 < self.max_jump <= 1.0, "a fraction between 0 and 1"),
            ("first_step_px", self.first_step_px > 0.0, "a positive number of px"),
            ("max_ratio", self.max_ratio >= 1.0, "at least 1"),
            ("lost_after", self.lost_after >= 2, "at least 2 frames"),
            ("max_keyframes", self.max_keyframes >= 2, "at least 2"),
            ("acceleration_psd", (self.acceleration_psd or 0.0) >= 0.0, "a number >= 0 or None"),
        )
        for name, good, expected in checks:
            if not good:
                raise InvalidValueError(f"{name} = {getattr(self, name)}", expected=expected)


@dataclass(frozen=True)
class DriftUpdate:
    """Drift at one frame.

    Attributes
    ----------
    time_s
        Centre of the frame's acquisition.
    drift_m, velocity_m_s, acceleration_m_s2
        (2,) drift since the first frame in the sem frame, its rate, and the rate of that. In px,
        px/s and px/s^2 of the raw image where ``calibrated`` is false.
    covariance
        (4, 4) of ``[x, y, vx, vy]`` in those units: from the noise of all pictures on the way and
        from what the camera's own covariance leaves open of the scale.
    status
        ``"keyframe"``, ``"tracked"`` or ``"coasting: <reason>"``.
    accepted, reason
        Whether the drift rests on this frame's own picture; why not.
    residual
        RMS grey levels that the shift does not explain; NaN where nothing was registered.
    px_from_unit
        (2, 2) ideal pixels of this frame per unit of the drift.
    overlap
        Fraction of the picture that was compared with the keyframe.
    calibrated
        False where no camera was given.
    restarted
        Whether tracking went on from here at a drift that was only predicted: the frames from here
        on are consistent with each other, but may show another place than those before.
    shear_px, shear_covariance
        (2,) by how much more the last row is shifted against the keyframe than the first, what
        was known of it taken out before, and its (2, 2) covariance; NaN and infinite where it was
        not measured.
    keyframe_time_s
        Time of the keyframe that the frame was compared with; NaN where there was none.
    joined
        Whether the frame became part of that keyframe's mean.
    """

    time_s: float
    drift_m: Array
    velocity_m_s: Array
    acceleration_m_s2: Array
    covariance: Array
    status: str
    accepted: bool
    reason: str
    residual: float
    px_from_unit: Array
    overlap: float
    calibrated: bool
    restarted: bool
    shear_px: Array
    shear_covariance: Array
    keyframe_time_s: float
    joined: bool

    @property
    def kind(self) -> str:
        """The status without its numbers."""
        return kind_of(self.status)

    @property
    def units(self) -> str:
        """``"m"`` or ``"px"``: unit of drift, velocity (per s) and covariance."""
        return "m" if self.calibrated else "px"

    @property
    def drift_px(self) -> Array:
        """(2,) drift in ideal pixels of this frame."""
        return np.asarray(self.px_from_unit @ self.drift_m)

    @property
    def raster(self) -> RasterDrift:
        """The drift during this frame, as :class:`~semcal_ros.core.rectification.rectifier.Rectifier` wants it."""
        return RasterDrift(self.drift_m, self.velocity_m_s, self.acceleration_m_s2)


@dataclass(frozen=True)
class DriftForecast:
    """Drift at another time, from what is known now.

    Attributes
    ----------
    time_s
        Time of the forecast.
    drift_m, velocity_m_s, acceleration_m_s2
        (2,) as in :class:`~semcal_ros.core.drift.estimates.DriftUpdate`.
    covariance
        (4, 4) of ``[x, y, vx, vy]``.
    """

    time_s: float
    drift_m: Array
    velocity_m_s: Array
    acceleration_m_s2: Array
    covariance: Array

    @property
    def raster(self) -> RasterDrift:
        """The drift during a frame at that time, for a rectifier."""
        return RasterDrift(self.drift_m, self.velocity_m_s, self.acceleration_m_s2)


@dataclass(frozen=True)
class DriftPredictor:
    """All that a forecast needs; it never changes, so that another thread may hold it.

    Attributes
    ----------
    state
        The drift at the last frame.
    restlessness
        How much it is expected to change.
    camera
        Camera of the last frame, or None for drift in px.
    """

    state: DriftState
    restlessness: ProcessNoise
    camera: ScanCamera | None

    @property
    def time_s(self) -> float:
        """Centre of the acquisition of the last frame."""
        return self.state.time_s

    def at(self, time_s: float) -> DriftForecast:
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
        move, noise = self.restlessness.over(time_s - self.time_s)
        # As Move does it, without what only a tracker needs: this is worked out for every frame.
        motion = move @ self.state.mean[:MOVING].reshape(3, 2)
        both = np.zeros((4, MOVING))
        both[0::2, 0::2] = both[1::2, 1::2] = move[:2]
        covariance = both @ self.state.covariance[:MOVING, :MOVING] @ both.T
        covariance[0::2, 0::2] += noise[:2, :2]
        covariance[1::2, 1::2] += noise[:2, :2]
        covariance += scale_covariance(self.camera, motion[0], motion[1])
        return DriftForecast(time_s, motion[0], motion[1], motion[2], covariance)


@dataclass(frozen=True)
class DriftPath:
    """Drift at n frames.

    Attributes
    ----------
    time_s
        (n,) centres of the acquisitions.
    drift_m, velocity_m_s, acceleration_m_s2
        (n, 2) drift since the first frame in the sem frame, its rate, and the rate of that; px,
        px/s and px/s^2 where ``calibrated`` is false.
    covariance
        (n, 4, 4) of ``[x, y, vx, vy]``.
    drift_px
        (n, 2) drift in ideal pixels of each frame.
    sigma_px
        (n, 2) 1-sigma of ``drift_px``.
    residual
        (n,) RMS grey levels that the shift does not explain; NaN where nothing was registered.
    status
        n texts as in :class:`~semcal_ros.core.drift.estimates.DriftUpdate`.
    accepted
        (n,) bool: whether the drift rests on the frame's own picture.
    restarted
        (n,) bool: whether tracking went on from the frame at a drift that was only predicted.
    calibrated
        False where no camera was given.
    """

    time_s: Array
    drift_m: Array
    velocity_m_s: Array
    acceleration_m_s2: Array
    covariance: Array
    drift_px: Array
    sigma_px: Array
    residual: Array
    status: tuple[str, ...]
    accepted: Mask
    restarted: Mask
    calibrated: bool

    def __len__(self) -> int:
        return len(self.status)

    @property
    def trusted(self) -> Mask:
        """(n,) bool: accepted, and tracked all the way back to the first frame."""
        return np.asarray(self.accepted & ~np.logical_or.accumulate(self.restarted))

    @property
    def sigma_m(self) -> Array:
        """(n, 2) 1-sigma of ``drift_m``."""
        return np.asarray(np.sqrt(self.covariance[:, [0, 1], [0, 1]]))

    @property
    def velocity_sigma_m_s(self) -> Array:
        """(n, 2) 1-sigma of ``velocity_m_s``."""
        return np.asarray(np.sqrt(self.covariance[:, [2, 3], [2, 3]]))

    def raster(self, index: int) -> RasterDrift:
        """The drift during one frame, as :class:`~semcal_ros.core.rectification.rectifier.Rectifier` wants it."""
        found = (self.drift_m, self.velocity_m_s, self.acceleration_m_s2)
        return RasterDrift(*(values[index] for values in found))


def path_of_updates(updates: Sequence[DriftUpdate]) -> DriftPath:
    """What was known live, frame by frame."""
    covariance = np.array([u.covariance for u in updates]).reshape(-1, 4, 4)
    px_covariance = [u.px_from_unit @ u.covariance[:2, :2] @ u.px_from_unit.T for u in updates]
    return DriftPath(
        time_s=np.array([u.time_s for u in updates]),
        drift_m=np.array([u.drift_m for u in updates]).reshape(-1, 2),
        velocity_m_s=np.array([u.velocity_m_s for u in updates]).reshape(-1, 2),
        acceleration_m_s2=np.array([u.acceleration_m_s2 for u in updates]).reshape(-1, 2),
        covariance=covariance,
        drift_px=np.array([u.drift_px for u in updates]).reshape(-1, 2),
        sigma_px=np.sqrt([np.diag(c) for c in px_covariance]).reshape(-1, 2),
        residual=np.array([u.residual for u in updates]),
        status=tuple(u.status for u in updates),
        accepted=np.array([u.accepted for u in updates], dtype=bool),
        restarted=np.array([u.restarted for u in updates], dtype=bool),
        calibrated=all(u.calibrated for u in updates),
    )
