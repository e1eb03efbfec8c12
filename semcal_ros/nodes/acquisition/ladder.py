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

"""A ladder that records itself: sets each magnification, moves the specimen, turns the scan, and keeps the place."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from semcal_ros.calibration import Calibration
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.errors import CalibrationError, InvalidValueError, MicroscopeError, Rejection
from semcal_ros.core.ladder.acquisition import (
    PictureRequest,
    TakenPicture,
    find_offset,
    learn_motion,
    plan_pictures,
    take_picture,
)
from semcal_ros.core.ladder.matching import LadderPicture
from semcal_ros.core.ladder.thresholds import OFF_CENTRE_MAX
from semcal_ros.nodes.acquisition.commands import MicroscopeCommands
from semcal_ros.nodes.acquisition.run import AWAY, Run, Taker
from semcal_ros.nodes.common.parameters import Parameters

# Moves to bring the place to the middle: the first one is right to the distortion, the second to the backlash.
_MOST_MOVES = 4
# The picture that is being scanned on arrival, and the first that is scanned after it.
_PICTURES = 2
# Off the middle, as a part of the field, from which it is brought back: well within what a picture may be off.
_NEAR = 0.5 * OFF_CENTRE_MAX
# A stage that is tilted by more is not the untilted one that a ladder needs: it looks 0.1 % shorter.
_TILTED_RAD = math.radians(2.5)


@dataclass(frozen=True)
class LadderGoal:
    """What a ladder is for.

    Attributes
    ----------
    calibration
        What is extended.
    magnification
        How far.
    turned
        Whether scans are turned.
    """

    calibration: Calibration
    magnification: float
    turned: bool = True


def ladder_goal_of(parameters: Parameters, calibration: Calibration) -> LadderGoal:
    """Read the goal from the parameters; raises :class:`InvalidValueError`."""
    last, turn_by = parameters["extend_to"], parameters["turn_by"]
    if not last > 0.0:
        raise InvalidValueError(
            "no magnification to extend to", expected="the parameter extend_to", do="set it"
        )
    if turn_by == "rotation":
        raise InvalidValueError(
            "parameter turn_by = 'rotation'",
            expected="scan_rotation for a ladder: the stage would carry the place away",
            do="set it to scan_rotation, or to nothing",
        )
    return LadderGoal(calibration, last, turn_by == "scan_rotation")


def place_of(stage: StageReading | None) -> tuple[float, float] | None:
    """Return x and y of a stage, m; None where it does not tell them."""
    if stage is None or stage.x_m is None or stage.y_m is None:
        return None
    return stage.x_m, stage.y_m


def describe_picture(request: PictureRequest) -> str:
    """Return what a person has to do for a picture."""
    turn = "the scan not turned"
    if request.turn_rad != 0.0:
        turn = f"the scan turned to {math.degrees(request.turn_rad):+.0f} degrees"
    where = "the place in the middle"
    if request.move != (0.0, 0.0):
        x, y = (100.0 * part for part in request.move)
        where = f"the place moved by {x:+.0f} and {y:+.0f} % of the field along x and y"
    setting = (
        f"set {request.magnification:g}x" if request.is_middle else f"{request.magnification:g}x"
    )
    return f"{setting}; {where}, {turn}, in focus"


class LadderTaker(Taker, Protocol):
    """What makes pictures of a ladder, and extends by them."""

    def newest_picture(self) -> LadderPicture | None:
        """Return the newest picture."""

    def extend_calibration(self, run: LadderRun) -> str:
        """Extend by all pictures that were taken, and say with what result; raises :class:`CalibrationError`."""


class LadderRun(Run[PictureRequest]):
    """One ladder over one place of a specimen.

    Parameters
    ----------
    goal
        What is asked for.
    taker
        Looks and extends.
    commands, still_wanted
        As of :class:`Run`.

    Attributes
    ----------
    goal
        What is asked for.
    taken
        The pictures so far.
    """

    service, unit = "~/extend", "picture"
    #: Both of the moves: the picture does not follow the stage.
    most_left_out = 2

    def __init__(
        self,
        goal: LadderGoal,
        taker: LadderTaker,
        commands: MicroscopeCommands | None,
        still_wanted: Callable[[], bool],
    ) -> None:
        requests = plan_pictures(goal.calibration, goal.magnification, turned=goal.turned)
        super().__init__(requests, taker, commands, still_wanted)
        self.goal = goal
        self.taken: list[TakenPicture] = []
        self._reached = False
        self._looker = taker
        # Where the stage has the place in the middle, where it was sent last, and how unturned scans are turned.
        self._place_m: tuple[float, float] | None = None
        self._sent_m: tuple[float, float] | None = None
        self._rotation_rad = 0.0
        self._centred = False

    @property
    def reached(self) -> bool:
        """Whether the calibration is extended."""
        return self._reached

    def take(
        self,
        request: PictureRequest,
        picture: LadderPicture,
        place_m: tuple[float, float] | None,
    ) -> None:
        """Take a picture for a request; raises :class:`CalibrationError` with what is wrong."""
        self.taken.append(
            take_picture(self.goal.calibration, self.taken, request, picture, place_m)
        )

    def adopt(self, picture: LadderPicture, place_m: tuple[float, float] | None) -> bool:
        """Take a picture that was recorded before for the first open request that it fits; return whether it is one."""
        for number, request in enumerate(self._waiting):
            try:
                self.take(request, picture, place_m)
            except CalibrationError:
                continue
            self._requested.append(self._waiting.pop(number))
            return True
        return False

    def number_visits(self, visits: list[int]) -> None:
        """Say in which visits the pictures were taken, one number for each."""
        self.taken = [
            replace(one, picture=replace(one.picture, visit=visit))
            for one, visit in zip(self.taken, visits, strict=True)
        ]

    def _conclude(self) -> str:
        if self._commands is not None:
            self._return(self._commands)
        self._show("running", f"extending to {self.goal.magnification:g}x")
        summary = self._looker.extend_calibration(self)
        self._reached = True
        return f"{summary}; ~/save writes the calibration"

    def _describe(self, request: PictureRequest) -> str:
        return describe_picture(request)

    def _is_needed(self, request: PictureRequest) -> bool:
        # What follows is found by the picture in the middle.
        return request.is_middle

    # -- moving ------------------------------------------------------------------------------------

    def run(self) -> str:
        """Extend the base class: the microscope may have been moved meanwhile."""
        self._place_m = self._sent_m = None
        return super().run()

    def _recover(self, request: PictureRequest) -> None:
        self._centred = False

    def _go(self, request: PictureRequest, commands: MicroscopeCommands) -> None:
        middle = next((one for one in reversed(self.taken) if one.request.is_middle), None)
        if self._place_m is None:
            self._begin(middle, commands)
        if request.visit != self._visit:
            self._centred = False
        g = request.magnification
        away = g / AWAY if self.goal.magnification > g else g * AWAY
        self._set_anew(request.visit, g, away, commands)
        if middle is not None and not self._centred:
            self._stand((0.0, 0.0), 0.0, g, commands)
            self._centre(middle, g, commands)
            self._centred = True
        self._stand(request.move, request.turn_rad, g, commands)

    def _begin(self, middle: TakenPicture | None, commands: MicroscopeCommands) -> None:
        """Look where the stage is, or where it was when the place was seen last."""
        now, place_m = self._looker.stage() or StageReading(), commands.place()
        if place_m is None:
            raise MicroscopeError(
                "a stage that does not tell x and y",
                expected="one that can be moved by them",
                do="move it by hand: leave the parameter microscope empty",
            )
        if now.tilt_rad is not None and abs(now.tilt_rad) > _TILTED_RAD:
            raise CalibrationError(
                f"a stage that is tilted by {math.degrees(now.tilt_rad):.1f} degrees",
                expected="an untilted one",
                do="untilt it, and find the place again",
            )
        rotation = now.scan_rotation_rad
        if middle is not None:
            place_m = middle.place_m or place_m
            rotation = middle.picture.scan_rotation_rad
        self._place_m, self._rotation_rad = place_m, rotation or 0.0

    def _stand(
        self, move: tuple[float, float], turn_rad: float, g: float, commands: MicroscopeCommands
    ) -> None:
        """Move the stage by parts of the field from the middle, and turn the scan."""
        assert self._place_m is not None
        field_m = self.goal.calibration.display_width_m / g
        place_m = (
            self._place_m[0] + move[0] * field_m,
            self._place_m[1] + move[1] * field_m,
        )
        target: dict[str, float] = {}
        current: dict[str, float | None] = {}
        if place_m != self._sent_m:
            target |= {"x": place_m[0], "y": place_m[1]}
        if self.goal.turned:
            now = self._looker.stage() or StageReading()
            target["scan_rotation"] = self._rotation_rad + turn_rad
            current["scan_rotation"] = now.scan_rotation_rad
        if target:
            self._sent_m = None
            self._move(target, current, commands)
            self._sent_m = place_m

    def _centre(self, middle: TakenPicture, g: float, commands: MicroscopeCommands) -> None:
        """Bring the place to the middle by what the pictures show of it."""
        model = self.goal.calibration
        for _ in range(_MOST_MOVES):
            self._refuse_unwanted()
            self._looker.wait_for_pictures(_PICTURES)
            seen = self._looker.newest_picture()
            if seen is None:
                raise MicroscopeError("no picture comes any more")
            offset = find_offset(model, middle.picture, seen)
            if isinstance(offset, Rejection):
                raise CalibrationError(
                    f"the place is lost at {g:g}x: {offset.reason}",
                    expected=f"what was in the middle at {middle.picture.magnification:g}x",
                    do="look at the microscope, bring it back, then call ~/extend to go on",
                )
            size = np.array(seen.image.shape[::-1], dtype=np.float64)
            if np.max(np.abs(offset / size)) <= _NEAR:
                return
            motion = learn_motion(model, self.taken)
            if motion is None:
                # The picture is refused if it is too far off.
                return
            way = np.asarray(-np.linalg.solve(g * motion, offset))
            self._show(
                "running",
                f"moving the place to the middle at {g:g}x: {1e6 * way[0]:+.3g}, {1e6 * way[1]:+.3g} um",
            )
            assert self._place_m is not None
            self._place_m = self._place_m[0] + float(way[0]), self._place_m[1] + float(way[1])
            self._stand((0.0, 0.0), 0.0, g, commands)

    def _return(self, commands: MicroscopeCommands) -> None:
        """Leave stage and scan as they were found."""
        if self._place_m is not None:
            self._stand((0.0, 0.0), 0.0, self.goal.magnification, commands)
