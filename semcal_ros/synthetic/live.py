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

"""The virtual SEM as a running instrument: a stage that moves and a magnification that changes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcal_ros.core.arrays import Array
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.synthetic.detector import Detector
from semcal_ros.synthetic.drift import NO_DRIFT, DriftFunction
from semcal_ros.synthetic.microscope import VirtualMicroscope
from semcal_ros.synthetic.plans import specimen_for
from semcal_ros.synthetic.pose import Pose, rotation_about_beam
from semcal_ros.synthetic.render import render_frame
from semcal_ros.synthetic.specimens.grid import GridFaults, Specimen
from semcal_ros.synthetic.stage import SimulatedStage, visit_scales
from semcal_ros.synthetic.thresholds import COMMANDS_KEPT, SETTINGS_KEPT


@dataclass(frozen=True)
class VirtualStage:
    """Stage position under the commanded velocities.

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
    before
        The stage before that command, for the rows of a frame that were scanned earlier; the oldest of
        ``COMMANDS_KEPT`` rests before its command.
    """

    time_s: float = 0.0
    position_m: tuple[float, float] = (0.0, 0.0)
    rotation_rad: float = 0.0
    velocity_m_s: tuple[float, float] = (0.0, 0.0)
    turn_rad_s: float = 0.0
    before: VirtualStage | None = None

    def commanded(
        self, time_s: float, velocity_m_s: tuple[float, float], turn_rad_s: float = 0.0
    ) -> VirtualStage:
        """Return the stage after a new command; it continues from its present position.

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
            time_s,
            (float(x), float(y)),
            self.rotation_at(time_s),
            velocity_m_s,
            turn_rad_s,
            self._recent(COMMANDS_KEPT - 1),
        )

    def placed(self, time_s: float, position_m: tuple[float, float]) -> VirtualStage:
        """Return the stage after it has been put to a position at once; it goes on with its velocity.

        Raises
        ------
        InvalidValueError
            As :meth:`commanded`.
        """
        if not np.all(np.isfinite(position_m)):
            raise InvalidValueError(f"stage position {position_m} m", expected="finite numbers")
        there = self.commanded(time_s, self.velocity_m_s, self.turn_rad_s)
        return replace(there, position_m=position_m)

    def _recent(self, commands: int) -> VirtualStage:
        before = None if commands <= 1 or self.before is None else self.before._recent(commands - 1)
        return replace(self, before=before)

    def position_at(self, time_s: ArrayLike) -> Array:
        """Return positions (n, 2) in m at times (n,)."""
        times = np.atleast_1d(np.asarray(time_s, dtype=np.float64))
        elapsed = np.maximum(times - self.time_s, 0.0)
        positions: Array = np.array(self.position_m) + elapsed[:, None] * np.array(
            self.velocity_m_s
        )
        earlier = times < self.time_s
        if self.before is not None and earlier.any():
            positions[earlier] = self.before.position_at(times[earlier])
        return positions

    def rotation_at(self, time_s: float) -> float:
        """Return the rotation in rad at a time."""
        if time_s < self.time_s and self.before is not None:
            return self.before.rotation_at(time_s)
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
        Magnification at the end of the frame.
    mixed
        Whether the magnification changed during the frame's scan.
    pose
        Specimen plane at the centre of the acquisition without drift, stage travel included.
    drift_m
        (2,) drift at the centre of the acquisition, without the travel of the stage.
    square_m
        Square size when the specimen is the checkerboard, else None.
    visit_scale
        Factor with which this magnification came back.
    """

    image: NDArray[np.uint8] | NDArray[np.uint16]
    start_time_s: float
    magnification: float
    mixed: bool
    pose: Pose
    drift_m: Array
    square_m: float | None
    visit_scale: float = 1.0


class _Setting(NamedTuple):
    """A change of the magnification, and the factor with which it came back."""

    time_s: float
    magnification: float
    scale: float


class LiveScene:
    """A specimen on a moving stage under a virtual microscope; it has no clock of its own.

    Parameters
    ----------
    microscope
        The microscope.
    kind
        One of :data:`~semcal_ros.synthetic.plans.SPECIMEN_KINDS`. On the grid, the view is of the
        region whose squares suit the magnification.
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
    faults, grid
        Faults of the stage and of the grid, or None for perfect ones. Of the stage's, the scene has the
        scale of each visit and the jitter of the lines; that its axis misses is a matter of the pose.
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
        faults: SimulatedStage | None = None,
        grid: GridFaults | None = None,
    ) -> None:
        self.microscope = microscope
        self.kind = kind
        self.drift = drift
        self.detector = Detector() if detector is None else detector
        if faults is not None:
            self.set_detector(line_jitter_px=faults.line_jitter_px)
        self.seed = seed
        self.stage = VirtualStage()
        self._grid = grid
        self._taken = 0
        self._poses = [(-math.inf, Pose.flat() if pose is None else pose)]
        self._scales = visit_scales(faults, seed)
        self._settings: list[_Setting] = []
        self.set_magnification(magnification)
        self._specimen(magnification)

    @property
    def magnification(self) -> float:
        """Magnification that was set last."""
        return self._settings[-1].magnification

    @property
    def pose(self) -> Pose:
        """Specimen plane with the stage at home, as it was set last."""
        return self._poses[-1][1]

    def set_pose(self, pose: Pose, time_s: float = -math.inf) -> None:
        """Turn or lift the specimen; a frame that is being scanned shows it as it was.

        Poses that were set for later times are forgotten.
        """
        earlier = [set_before for set_before in self._poses if set_before[0] < time_s]
        self._poses = [*earlier[-COMMANDS_KEPT:], (time_s, pose)]

    def set_magnification(self, magnification: float, time_s: float = -math.inf) -> None:
        """Change the magnification from a time on; a frame that is being scanned then shows both.

        Setting the present magnification changes nothing.

        Raises
        ------
        InvalidValueError
            If it is not a positive finite number, the microscope has no image there, or the time is
            before that of the last change.
        """
        self.microscope.camera_at(magnification)
        g = float(magnification)
        if self._settings and not self._settings[-1].time_s <= time_s:
            raise InvalidValueError(
                f"a magnification set at {time_s} s",
                expected=f"not before the last one at {self._settings[-1].time_s} s",
            )
        if self._settings and self._settings[-1].magnification == g:
            return
        self._settings = [setting for setting in self._settings if setting.time_s < time_s][
            -SETTINGS_KEPT:
        ]
        self._settings.append(_Setting(time_s, g, next(self._scales)))

    def set_detector(self, **changes: object) -> None:
        """Change image settings by name, for instance ``bits=16``."""
        self.detector = replace(self.detector, **changes)  # type: ignore[arg-type]

    def set_twist(
        self, time_s: float, velocity_m_s: tuple[float, float], turn_rad_s: float = 0.0
    ) -> None:
        """Command a stage velocity from a time on; raises as :meth:`VirtualStage.commanded`."""
        self.stage = self.stage.commanded(time_s, velocity_m_s, turn_rad_s)

    def place_stage(self, time_s: float, position_m: tuple[float, float]) -> None:
        """Put the stage to a position (x, y) from a time on; raises as :meth:`VirtualStage.placed`."""
        self.stage = self.stage.placed(time_s, position_m)

    def pose_at(self, time_s: float) -> Pose:
        """Return the specimen plane in the sem frame at a time, without drift."""
        return self._moved(self._set_pose_at(time_s), time_s)

    def _set_pose_at(self, time_s: float) -> Pose:
        set_before = [pose for at_s, pose in self._poses if at_s <= time_s]
        return set_before[-1] if set_before else self._poses[0][1]

    def _moved(self, pose: Pose, time_s: float) -> Pose:
        turn = rotation_about_beam(self.stage.rotation_at(time_s))
        travel = np.append(self.stage.position_at(time_s)[0], 0.0)
        return Pose(turn @ pose.R, pose.t_m + travel)

    def frame(self, start_time_s: float) -> LiveFrame:
        """Take the frame whose first pixel is at ``start_time_s``.

        The travel of the stage distorts the frame as drift does; a rotation is taken at the centre
        of the acquisition.
        """
        centre_s = start_time_s + self.microscope.timing.centre_offset_s
        pose = self._moved(self._set_pose_at(start_time_s), centre_s)
        stage, drift = self.stage, self.drift
        at_centre = stage.position_at(centre_s)

        def displacement(time_s: Array) -> Array:
            return drift(time_s) + stage.position_at(time_s) - at_centre

        parts = self._parts(start_time_s)
        images = [self._image(turn, start_time_s, pose, displacement) for turn, _ in parts]
        g = parts[-1][0].magnification
        image = images[-1]
        if len(parts) > 1:
            rows = self.microscope.height
            mean = sum(part[:rows] * share for part, (_, share) in zip(images, parts, strict=True))
            image[:rows] = np.rint(mean)
        self._taken += 1
        drift_m = drift(np.array([centre_s]))[0]
        square_m = self._specimen(g)[1]
        return LiveFrame(
            image,
            start_time_s,
            g,
            len(parts) > 1,
            pose,
            drift_m,
            square_m,
            parts[-1][0].scale,
        )

    def _parts(self, start_time_s: float) -> list[tuple[_Setting, Array]]:
        """Return the magnifications during a frame, each with the fraction (h, w) of every pixel's passes
        scanned at it.
        """
        timing = self.microscope.timing
        height, width = self.microscope.height, self.microscope.width
        end_s = start_time_s + timing.acquisition_time_s
        before = sum(setting.time_s <= start_time_s for setting in self._settings)
        settings = [
            setting for setting in self._settings[max(before - 1, 0) :] if setting.time_s < end_s
        ]
        if len(settings) < 2:
            return [((settings or self._settings)[0], np.ones((height, width)))]
        row, col = np.mgrid[:height, :width]
        pass_s = replace(timing, averages=1).pixel_offset_s(row, col, height, width)
        times_s = start_time_s + pass_s + timing.frame_time_s * _column(timing.averages)
        # The fraction scanned since each change, minus the fraction scanned since the next one.
        begun = [np.mean(times_s >= setting.time_s, axis=0) for setting in settings[1:]]
        shares = [np.ones((height, width)), *begun]
        left = [share - after for share, after in zip(shares, [*begun, 0.0], strict=True)]
        return list(zip(settings, left, strict=True))

    def _specimen(self, magnification: float) -> tuple[Specimen, float | None]:
        pixel_m = self.microscope.nominal_pixel_size_m(magnification)
        return specimen_for(self.kind, pixel_m, self.microscope.width, self.seed, self._grid)

    def _image(
        self, setting: _Setting, start_time_s: float, pose: Pose, drift: DriftFunction
    ) -> NDArray[np.uint8] | NDArray[np.uint16]:
        return render_frame(
            self.microscope.during_visit(setting.scale),
            self._specimen(setting.magnification)[0],
            pose,
            setting.magnification,
            start_time_s=start_time_s,
            drift=drift,
            seed=(self.seed, self._taken),
            detector=self.detector,
        )


def _column(count: int) -> Array:
    """(count, 1, 1) of 0, 1, 2..."""
    return np.arange(count, dtype=np.float64)[:, None, None]
