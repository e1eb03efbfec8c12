"""The virtual SEM as a running instrument: a stage that moves and a magnification that changes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic.detector import Detector
from semcal_ros.synthetic.drift import NO_DRIFT, DriftFunction
from semcal_ros.synthetic.microscope import VirtualMicroscope
from semcal_ros.synthetic.plans import specimen_for
from semcal_ros.synthetic.pose import Pose, rotation_about_beam
from semcal_ros.synthetic.render import render_frame

__all__ = ["LiveFrame", "LiveScene", "VirtualStage"]

Array = NDArray[np.float64]


@dataclass(frozen=True)
class VirtualStage:
    """Stage position under the last commanded velocity.

    Parameters
    ----------
    time_s
        When the command was given.
    position_m
        Position (x, y) in the sem frame at that time.
    rotation_rad
        Rotation about the beam at that time, from x towards y.
    velocity_m_s, turn_rad_s
        The command, valid from then on.
    """

    time_s: float = 0.0
    position_m: tuple[float, float] = (0.0, 0.0)
    rotation_rad: float = 0.0
    velocity_m_s: tuple[float, float] = (0.0, 0.0)
    turn_rad_s: float = 0.0

    def commanded(
        self, time_s: float, velocity_m_s: tuple[float, float], turn_rad_s: float = 0.0
    ) -> VirtualStage:
        """The stage after a new command; it keeps where it has got to.

        Raises
        ------
        InvalidValueError
            If the command is not finite or older than the one before.
        """
        if not np.all(np.isfinite([time_s, *velocity_m_s, turn_rad_s])):
            raise InvalidValueError(
                f"stage command {velocity_m_s} m/s, {turn_rad_s} rad/s", expected="finite numbers"
            )
        if time_s < self.time_s:
            raise InvalidValueError(
                f"stage command at {time_s} s",
                expected=f"not before the last one at {self.time_s} s",
            )
        x, y = self.position_at(time_s)[0]
        return VirtualStage(
            time_s, (float(x), float(y)), self.rotation_at(time_s), velocity_m_s, turn_rad_s
        )

    def position_at(self, time_s: ArrayLike) -> Array:
        """Positions (n, 2) in m at times (n,); before the last command, that command's position."""
        elapsed = np.maximum(np.atleast_1d(np.asarray(time_s, dtype=np.float64)) - self.time_s, 0.0)
        travel: Array = elapsed[:, None] * np.array(self.velocity_m_s)
        return np.array(self.position_m) + travel

    def rotation_at(self, time_s: float) -> float:
        """Rotation in rad at a time."""
        return self.rotation_rad + max(time_s - self.time_s, 0.0) * self.turn_rad_s


@dataclass(frozen=True, eq=False)
class LiveFrame:
    """A frame with its truth.

    Attributes
    ----------
    image
        (h, w) uint8 or uint16.
    start_time_s
        Stamp: start of the first pass.
    magnification
        Magnification during the whole frame.
    pose
        Specimen plane at the centre of the acquisition without drift, stage travel included.
    drift_m
        (2,) drift at the centre of the acquisition, without the travel of the stage.
    square_m
        Square size when the specimen is the chess grid, else None.
    """

    image: NDArray[np.uint8] | NDArray[np.uint16]
    start_time_s: float
    magnification: float
    pose: Pose
    drift_m: Array
    square_m: float | None


class LiveScene:
    """A specimen on a moving stage under a virtual microscope; it has no clock of its own.

    Parameters
    ----------
    microscope
        The microscope.
    kind
        "grid", "gold" or "flat". On the grid, the view is of the region whose squares suit the
        magnification.
    magnification
        Magnification to begin with.
    pose
        Specimen plane with the stage at home.
    drift
        Displacement (n, 2) in m at times (n,).
    detector
        Image formation.
    seed
        Seed of the specimen and of the noise; the noise of a frame depends on its number only.
    """

    def __init__(
        self,
        microscope: VirtualMicroscope,
        kind: str = "grid",
        *,
        magnification: float = 1000.0,
        pose: Pose | None = None,
        drift: DriftFunction = NO_DRIFT,
        detector: Detector | None = None,
        seed: int = 0,
    ) -> None:
        self.microscope = microscope
        self.kind = kind
        self.pose = Pose.flat() if pose is None else pose
        self.drift = drift
        self.detector = Detector() if detector is None else detector
        self.seed = seed
        self.stage = VirtualStage()
        self._taken = 0
        self._magnification = 1.0
        self.set_magnification(magnification)
        specimen_for(kind, microscope.nominal_pixel_size_m(magnification), microscope.width, seed)

    @property
    def magnification(self) -> float:
        """Magnification of the next frame."""
        return self._magnification

    def set_magnification(self, magnification: float) -> None:
        """Change the magnification from the next frame on.

        Raises
        ------
        InvalidValueError
            If it is not a positive finite number, or the microscope has no image there.
        """
        self.microscope.camera_at(magnification)
        self._magnification = float(magnification)

    def set_detector(self, **changes: object) -> None:
        """Change image settings by name, for instance ``bits=16``."""
        self.detector = replace(self.detector, **changes)  # type: ignore[arg-type]

    def set_twist(
        self, time_s: float, velocity_m_s: tuple[float, float], turn_rad_s: float = 0.0
    ) -> None:
        """Command a stage velocity from a time on; raises as :meth:`VirtualStage.commanded`."""
        self.stage = self.stage.commanded(time_s, velocity_m_s, turn_rad_s)

    def pose_at(self, time_s: float) -> Pose:
        """Specimen plane in the sem frame at a time, without drift."""
        turn = rotation_about_beam(self.stage.rotation_at(time_s))
        travel = np.append(self.stage.position_at(time_s)[0], 0.0)
        return Pose(turn @ self.pose.R, self.pose.t_m + travel)

    def frame(self, start_time_s: float) -> LiveFrame:
        """Take the frame whose first pixel is at ``start_time_s``.

        The travel of the stage distorts the frame as drift does; a rotation is taken at the centre
        of the acquisition.
        """
        centre_s = start_time_s + self.microscope.timing.centre_offset_s
        pose = self.pose_at(centre_s)
        stage, drift = self.stage, self.drift
        at_centre = stage.position_at(centre_s)

        def displacement(time_s: Array) -> Array:
            return drift(time_s) + stage.position_at(time_s) - at_centre

        g = self._magnification
        pixel_m = self.microscope.nominal_pixel_size_m(g)
        specimen, square_m = specimen_for(self.kind, pixel_m, self.microscope.width, self.seed)
        image = render_frame(
            self.microscope,
            specimen,
            pose,
            g,
            start_time_s=start_time_s,
            drift=displacement,
            seed=(self.seed, self._taken),
            detector=self.detector,
        )
        self._taken += 1
        drift_m = drift(np.array([centre_s]))[0]
        return LiveFrame(image, start_time_s, g, pose, drift_m, square_m)
