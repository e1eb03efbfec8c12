"""How the stage is servoed."""

from __future__ import annotations

from dataclasses import dataclass

from semcal_ros.core.errors import InvalidValueError

__all__ = ["ServoSettings"]


@dataclass(frozen=True)
class ServoSettings:
    """Settings of :class:`~semcal_ros.applications.servoing.law.Servo`.

    Attributes
    ----------
    gain_hz
        Part of the error that is taken away per second, 1/s.
    speed_limit_m_s, turn_limit_rad_s
        Largest commanded speeds.
    travel_limit_px
        How far a feature may move within a frame: what moves during its acquisition is blurred by that.
    tolerance_px
        Converged is what is nearer to the goal than this, RMS over the features, and known to half of it (1-sigma).
    settle_frames
        For so many frames in a row.
    scale_tolerance
        The target must have the size that the camera of the frame says, to this fraction: else the frame is of
        another magnification than its camera.
    max_sigma_px
        A pose that is less certain (1-sigma) is not used.
    feed_forward
        Whether what moves beside the commands (drift) is estimated and commanded away.
    drift_sigma_m_s, drift_change_m_s
        Drift to be expected (1-sigma), and by how much it changes in a second.
    axis_sigma_px, axis_change_px
        By how much the cameras may be wrong about where the optical axis is seen (1-sigma), and by how much more
        that differs from one magnification to the next: what the changes of the magnification tell of it corrects
        them. 0: they are not corrected.
    slip
        Part of a commanded travel by which the stage may miss it (1-sigma): no drift is read from that.
    """

    gain_hz: float = 1.0
    speed_limit_m_s: float = 50e-6
    turn_limit_rad_s: float = 0.1
    travel_limit_px: float = 12.0
    tolerance_px: float = 0.5
    settle_frames: int = 3
    scale_tolerance: float = 0.05
    max_sigma_px: float = 1.0
    feed_forward: bool = True
    drift_sigma_m_s: float = 50e-9
    drift_change_m_s: float = 5e-9
    axis_sigma_px: float = 15.0
    axis_change_px: float = 0.3
    slip: float = 0.03

    def __post_init__(self) -> None:
        for name in (
            "gain_hz",
            "speed_limit_m_s",
            "turn_limit_rad_s",
            "travel_limit_px",
            "tolerance_px",
            "settle_frames",
            "scale_tolerance",
            "max_sigma_px",
        ):
            if not getattr(self, name) > 0:
                raise InvalidValueError(
                    f"{name} = {getattr(self, name)}", expected="a positive number"
                )
        for name in (
            "drift_sigma_m_s",
            "drift_change_m_s",
            "axis_sigma_px",
            "axis_change_px",
            "slip",
        ):
            if not getattr(self, name) >= 0:
                raise InvalidValueError(f"{name} = {getattr(self, name)}", expected="a number >= 0")
