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

"""A calibration that records itself: goes to each picture, takes it, calibrates, and chooses the next ones."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from semcal_ros.calibration import Calibration
from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.acquisition import (
    AcquisitionGoal,
    ViewRequest,
    find_picture_fault,
    find_stage_move,
    grid_is_centred,
    image_from_stage,
    is_magnification_of,
    lattice_shift,
    plan_survey,
    propose_visits,
    request_of_picture,
)
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.calibration.thresholds import PROBE_SQUARES, VIEWS_MAX
from semcal_ros.core.corners import LatticeDetection
from semcal_ros.core.errors import CalibrationError, InvalidValueError, MicroscopeError
from semcal_ros.core.ladder.acquisition import PictureRequest
from semcal_ros.core.wording import counted
from semcal_ros.nodes.acquisition.commands import MicroscopeCommands
from semcal_ros.nodes.common.parameters import ParameterDeclaration, Parameters

ACQUISITION = (
    ParameterDeclaration(
        "microscope",
        "",
        "Node that ~/acquire moves: microscope or virtual_sem. Empty: a person moves it, told by ~/progress, and calls"
        " ~/add_view.",
        fixed=True,
    ),
    ParameterDeclaration(
        "lowest_magnification", 0.0, "Where ~/acquire begins; 0: not known.", "", 0.0, 1e8
    ),
    ParameterDeclaration(
        "highest_magnification", 0.0, "Where ~/acquire ends; 0: not known.", "", 0.0, 1e8
    ),
    ParameterDeclaration(
        "target",
        1e-3,
        "Relative 1-sigma of nm per pixel that ~/acquire goes on to, repeatability aside.",
        "",
        1e-5,
        0.1,
    ),
    ParameterDeclaration(
        "extend_to", 0.0, "Magnification that ~/extend reaches; 0: not known.", "", 0.0, 1e8
    ),
    ParameterDeclaration("tilts_deg", "0, 20, 40", "Tilts of the views of each visit, degrees."),
    ParameterDeclaration(
        "turn_by",
        "scan_rotation",
        "What turns the grid in the image between views.",
        choices=("scan_rotation", "rotation", "nothing"),
    ),
    ParameterDeclaration(
        "most_views", VIEWS_MAX, "Views that ~/acquire takes at most.", "", 6, 1000
    ),
    ParameterDeclaration(
        "record",
        "",
        "Recording of all pictures that ~/acquire judges, a new folder; empty: none.",
        confined=True,
    ),
    ParameterDeclaration(
        "resume",
        "",
        "Recording of an interrupted acquisition whose views the first ~/acquire takes over; empty: none.",
        confined=True,
    ),
)
"""Parameters of an acquisition."""

# Pictures of one view before it is left out: noise or a vibration passes, a grid that is not there does not.
_ATTEMPTS = 3
# The picture that is being scanned on arrival, and the first that is scanned after it.
_PICTURES = 2
#: Ratio to a magnification that is only set to come back from, as a visit must.
AWAY = 1.25

# Moves to bring a grid to the middle: what is seen of it at first may be a corner only.
_MOST_MOVES = 6
# A move after which it is off by more than this part of what it was has gone the wrong way.
_BETTER = 0.7
# Smallest part of the way from one posture to the next after which the grid must still be seen.
_SMALLEST_STEP = 1.0 / 32.0

Posture = Mapping[str, float]
"""Angles of the joints, rad."""


def goal_of(
    parameters: Parameters, squares_m: tuple[float, ...], display_width_m: float
) -> AcquisitionGoal:
    """Read the goal from the parameters :data:`ACQUISITION`; raises :class:`InvalidValueError`."""
    low, high = parameters["lowest_magnification"], parameters["highest_magnification"]
    if not (low > 0.0 and high > 0.0):
        raise InvalidValueError(
            "no range of magnifications",
            expected="the parameters lowest_magnification and highest_magnification",
            do="set them",
        )
    text = parameters["tilts_deg"]
    try:
        tilts = tuple(math.radians(float(part)) for part in text.split(","))
    except ValueError as error:
        raise InvalidValueError(
            f"parameter tilts_deg = {text!r}", expected="degrees with commas, such as 0, 20, 40"
        ) from error
    return AcquisitionGoal(
        (low, high),
        squares_m,
        display_width_m,
        parameters["target"],
        tilts,
        parameters["most_views"],
    )


def describe_request(request: ViewRequest, turn_by: str) -> str:
    """Return what a person has to do for a view."""
    turn = ""
    if turn_by != "nothing":
        what = "the scan" if turn_by == "scan_rotation" else "the specimen"
        turn = f", turn {what} to {math.degrees(request.turn_rad):.0f} degrees"
    return (
        f"set {request.magnification:.0f}x anew, tilt to {math.degrees(request.tilt_rad):.0f} degrees{turn}; "
        f"the {1e6 * request.square_m:g} um squares fill the image, in focus"
    )


@dataclass(frozen=True)
class Progress:
    """How far an acquisition is.

    Attributes
    ----------
    state
        ``running``, ``waiting`` for a person, ``stopped``, ``failed`` or ``done``.
    text
        What happens, or is to be done, in words.
    views, planned
        Views taken, and all that are planned so far.
    left_out
        Views of which no usable picture came.
    largest
        Largest relative 1-sigma of nm per pixel after the last calibration; NaN before the first.
    """

    state: str
    text: str
    views: int = 0
    planned: int = 0
    left_out: int = 0
    largest: float = math.nan


class Taker(Protocol):
    """What looks at the pictures; all calls may last, and end by ``still_wanted`` of the run."""

    def wait_for_pictures(self, count: int) -> None:
        """Return after so many more pictures; raises :class:`MicroscopeError` if they stay away."""

    def take(self, request: Any) -> str:
        """Make use of the newest picture, and say which; raises :class:`CalibrationError` with what is wrong."""

    def wait_for_view(self, request: Any) -> str:
        """Return what a person has taken for a request."""

    def stage(self) -> StageReading | None:
        """Return where the stage is now."""

    def show(self, progress: Progress) -> None:
        """Tell how far the run is."""


class GridFinder(Protocol):
    """What finds the grid in the newest picture."""

    def find_grid(self) -> LatticeDetection | None:
        """Return the corners of the newest picture, or None without a grid."""

    def wait_for_pictures(self, count: int) -> None:
        """Return after so many more pictures; raises :class:`MicroscopeError` if they stay away."""


class GridFollower:
    """Finds the grid again, and brings it to the middle of the image.

    Parameters
    ----------
    finder
        Finds the grid in the newest picture.
    commands
        Moves.
    show
        Called with what is done.
    """

    def __init__(
        self, finder: GridFinder, commands: MicroscopeCommands, show: Callable[[str], None]
    ) -> None:
        self._finder = finder
        self._commands = commands
        self._show = show
        self._last: Posture | None = None
        # Without the scan rotation, at magnification 1.
        self._px_per_m: Array | None = None

    def remember(self, posture: Posture) -> None:
        """Note that the grid was seen in a posture."""
        self._last = dict(posture)

    def bring_back(self, request: ViewRequest, posture: Posture) -> bool:
        """Bring the grid to the middle of the image in a posture; return whether anything was done.

        Parameters
        ----------
        request
            The view that is wanted; the magnification is set already.
        posture
            The posture that it asks for, in which the stage stands.

        Raises
        ------
        CalibrationError
            The image does not follow the stage, or the grid is lost on the way.
        MicroscopeError
            The microscope refuses or fails.
        """
        if self._commands.place() is None:
            return False
        seen = self._finder.find_grid()
        if seen is not None:
            if grid_is_centred(seen):
                return False
            self._centre(request, seen, posture)
            return True
        if self._last is None:
            return False
        self._approach(request, self._last, posture)
        return True

    def _approach(self, request: ViewRequest, start: Posture, goal: Posture) -> None:
        """Go back to where the grid was seen, and from there in steps after each of which it still is."""
        self._show("the grid has left the image: going back to where it was seen")
        at, step = 0.0, 0.5
        self._stand(start, goal)
        if self._finder.find_grid() is None:
            raise CalibrationError(
                "the grid is not where it was seen last",
                do="look at the microscope, then call ~/acquire to go on",
            )
        here = dict(start)
        while at < 1.0:
            part = min(1.0, at + step)
            there = {j: start[j] + part * (goal[j] - start[j]) for j in goal}
            self._stand(there, here)
            seen = self._finder.find_grid()
            if seen is None:
                self._stand(here, there)
                step *= 0.5
                if step < _SMALLEST_STEP:
                    tilt = math.degrees(here.get("tilt", 0.0))
                    raise CalibrationError(
                        f"the grid leaves the image with the smallest step beyond a tilt of {tilt:.1f} degrees",
                        expected="a specimen near the eucentric height",
                        do="set that, or choose smaller tilts",
                    )
                continue
            if not grid_is_centred(seen):
                self._centre(request, seen, there)
            at, here = part, there
            step = min(2.0 * step, 1.0 - at) or step

    def _stand(self, posture: Posture, before: Posture) -> None:
        self._commands.move(posture, before)
        self._finder.wait_for_pictures(_PICTURES)

    def _centre(self, request: ViewRequest, seen: LatticeDetection, posture: Posture) -> None:
        # The tilt shortens one direction, which the next look corrects.
        scale = request.magnification * _turn(posture.get("scan_rotation", 0.0))
        for _ in range(_MOST_MOVES):
            learned = self._px_per_m
            if learned is None:
                learned = np.asarray(np.linalg.solve(scale, self._learn(request, seen)))
                self._px_per_m = learned
                seen = self._seen()
            px_per_m: Array = scale @ learned
            way = find_stage_move(seen, px_per_m)
            # Never farther than the image: what is seen cannot be off by more.
            longest = float(max(seen.image_size)) / float(np.linalg.norm(px_per_m, 2))
            way *= min(1.0, longest / max(float(np.hypot(*way)), 1e-12))
            self._show(f"moving the grid to the middle: {1e6 * way[0]:.1f}, {1e6 * way[1]:.1f} um")
            self._shift(way)
            after = self._seen()
            if grid_is_centred(after):
                return
            before_m, after_m = (find_stage_move(s, px_per_m) for s in (seen, after))
            if np.hypot(*after_m) > _BETTER * np.hypot(*before_m):
                self._px_per_m = None
            seen = after

    def _learn(self, request: ViewRequest, seen: LatticeDetection) -> Array:
        """Learn which way the image goes with x and y."""
        way_m = PROBE_SQUARES * request.square_m
        ways, shifts = way_m * np.eye(2), np.zeros((2, 2))
        for axis in range(2):
            self._shift(ways[axis])
            after = self._seen()
            shifts[axis] = lattice_shift(seen, after)
            seen = after
        return image_from_stage(ways, shifts, seen.spacing_px / request.square_m)

    def _shift(self, way_m: Array) -> None:
        place = self._commands.place()
        if place is None:
            raise CalibrationError("the stage does not tell x and y any more")
        target = {"x": place[0] + float(way_m[0]), "y": place[1] + float(way_m[1])}
        self._commands.move(target, {})
        self._finder.wait_for_pictures(_PICTURES)

    def _seen(self) -> LatticeDetection:
        seen = self._finder.find_grid()
        if seen is None:
            raise CalibrationError("the grid was lost while it was moved to the middle")
        return seen


def _turn(angle_rad: float) -> Array:
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s], [s, c]])


class ViewTaker(GridFinder, Taker, Protocol):
    """What makes views, and calibrates from them."""

    def calibrate(self) -> Calibration:
        """Calibrate from all views; raises :class:`CalibrationError`."""


Request = TypeVar("Request", ViewRequest, PictureRequest)


class Run(ABC, Generic[Request]):
    """Requests that are answered by pictures, one after the other; it can be stopped and gone on with.

    Parameters
    ----------
    requests
        What is to be taken first.
    taker
        Looks at the pictures.
    commands
        Moves; None where a person does.
    still_wanted
        If it returns False, the run ends as soon as nothing moves.

    Attributes
    ----------
    service
        What is called to go on with it.
    unit
        What a picture that was taken is called.
    progress
        How far it is.
    discarded
        Whether it cannot be gone on with.
    """

    service, unit = "", ""
    #: Requests left out in a row before somebody must look.
    most_left_out = 3

    def __init__(
        self,
        requests: Iterable[Request],
        taker: Taker,
        commands: MicroscopeCommands | None,
        still_wanted: Callable[[], bool],
    ) -> None:
        self.discarded = False
        self._taker = taker
        self._commands = commands
        self._still_wanted = still_wanted
        self._waiting: list[Request] = list(requests)
        self._requested: list[Request] = []
        self._left_out = 0
        self._in_a_row = 0
        self._visit = -1
        self._magnification = math.nan
        self.progress = Progress("stopped", "not begun", planned=len(self._waiting))

    @property
    @abstractmethod
    def reached(self) -> bool:
        """Whether what was asked for is met."""

    def run(self) -> str:
        """Go on until the end, and say in words why and with what it ended.

        Raises
        ------
        SemcalError
            The microscope refuses or is silent, what is looked at is lost, a calibration fails, or it is not wanted
            any more. Another call goes on where this one ended.
        """
        # Somebody may have moved it meanwhile.
        self._visit = -1
        self._in_a_row = 0
        while True:
            while self._waiting:
                self._take(self._waiting[0])
                self._requested.append(self._waiting.pop(0))
            if ended := self._conclude():
                return ended

    @abstractmethod
    def _conclude(self) -> str:
        """Calibrate from what was taken; return why it ends, or nothing after asking for more."""

    @abstractmethod
    def _describe(self, request: Request) -> str:
        """Return what has to be done for a request."""

    @abstractmethod
    def _go(self, request: Request, commands: MicroscopeCommands) -> None:
        """Bring the microscope to where a request wants it."""

    def _remember(self, request: Request) -> None:
        """Note that a request was answered from where the microscope is."""

    def _is_needed(self, request: Request) -> bool:
        """Return whether it cannot go on without an answer to a request."""
        return False

    def _recover(self, request: Request) -> None:
        """Do what helps after a picture that was not usable; raises :class:`CalibrationError`."""

    def report(self, text: str) -> None:
        """Tell how far it is, with what has just been done."""
        self._show("running", text)

    def _show(self, state: str, text: str) -> None:
        taken = len(self._requested) - self._left_out
        planned = len(self._requested) + len(self._waiting)
        self.progress = replace(
            self.progress,
            state=state,
            text=text,
            views=taken,
            planned=planned,
            left_out=self._left_out,
        )
        self._taker.show(self.progress)

    def _refuse_unwanted(self) -> None:
        if not self._still_wanted():
            raise CalibrationError("stopped", do=f"call {self.service} to go on")

    def _take(self, request: Request) -> None:
        described = self._describe(request)
        if self._commands is None:
            self._show("waiting", described)
            self._show("running", self._taker.wait_for_view(request))
            return
        fault = ""
        for attempt in range(_ATTEMPTS):
            self._refuse_unwanted()
            again = f" (again: {fault})" if fault else ""
            self._show("running", f"{described}{again}")
            self._go(request, self._commands)
            self._taker.wait_for_pictures(_PICTURES + attempt)
            try:
                self._show("running", self._taker.take(request))
            except CalibrationError as error:
                fault = str(error)
            else:
                self._in_a_row = 0
                self._remember(request)
                return
            if attempt + 1 < _ATTEMPTS:
                try:
                    self._recover(request)
                except CalibrationError as error:
                    fault = str(error)
        if self._is_needed(request):
            raise CalibrationError(
                f"no usable picture: {fault}",
                do=f"look at the microscope, then call {self.service} to go on",
            )
        self._left_out += 1
        self._in_a_row += 1
        if self._in_a_row >= self.most_left_out:
            raise CalibrationError(
                f"{counted(self._in_a_row, self.unit)} in a row without a usable picture, the last: {fault}",
                do=f"look at the microscope, then call {self.service} to go on",
            )
        self._show("running", f"left out: {fault}")

    def _set_anew(self, visit: int, g: float, away: float, commands: MicroscopeCommands) -> None:
        """Set the magnification of a visit, from another one; once for all of its requests."""
        if visit == self._visit:
            return
        if g == self._magnification:
            commands.set_magnification(away)
            self._taker.wait_for_pictures(1)
        commands.set_magnification(g)
        self._visit, self._magnification = visit, g

    def _move(
        self,
        target: Mapping[str, float],
        current: Mapping[str, float | None],
        commands: MicroscopeCommands,
    ) -> None:
        try:
            commands.move(target, current)
        except MicroscopeError:
            # Where it stands is not known.
            self._visit = -1
            raise


class AcquisitionRun(Run[ViewRequest]):
    """One acquisition of views of a grid.

    Parameters
    ----------
    goal
        What is asked for.
    taker
        Looks and calibrates.
    commands, still_wanted
        As of :class:`Run`.
    turn_by
        Which joint turns the grid in the image.

    Attributes
    ----------
    goal
        What is asked for.
    """

    service, unit = "~/acquire", "view"

    def __init__(
        self,
        goal: AcquisitionGoal,
        taker: ViewTaker,
        commands: MicroscopeCommands | None,
        turn_by: str,
        still_wanted: Callable[[], bool],
    ) -> None:
        super().__init__(plan_survey(goal), taker, commands, still_wanted)
        self.goal = goal
        self._calibrate = taker.calibrate
        self._turn_by = turn_by
        self._posture: Posture = {}
        self._follower = None
        if commands is not None:
            self._follower = GridFollower(taker, commands, lambda text: self._show("running", text))

    @property
    def reached(self) -> bool:
        """Whether nm per pixel is as certain as was asked for."""
        return self.progress.largest <= self.goal.target

    def adopt(
        self,
        magnification: float,
        grey: NDArray[Any],
        detection: LatticeDetection,
        stage: StageReading | None,
    ) -> bool:
        """Take a picture that was recorded before as the answer to a request; return whether it is one.

        It answers the first open request that it fits. One that fits none was chosen after a calibration.
        """
        for number, request in enumerate(self._waiting):
            if is_magnification_of(request, magnification) and not find_picture_fault(
                grey, detection, request, stage
            ):
                self._requested.append(self._waiting.pop(number))
                return True
        visit = 1 + max(request.visit for request in (*self._waiting, *self._requested))
        own = request_of_picture(self.goal, visit, magnification, stage)
        if own is None or find_picture_fault(grey, detection, own, stage):
            return False
        self._requested.append(own)
        return True

    def _conclude(self) -> str:
        self._show("running", "calibrating")
        model = self._calibrate()
        proposal = propose_visits(self.goal, model, self._requested)
        self.progress = replace(self.progress, largest=proposal.largest)
        self._waiting.extend(proposal.requests)
        if not proposal.reason:
            return ""
        return (
            f"{proposal.reason}: nm per px known to {100.0 * proposal.largest:.3f} % at {proposal.at:.0f}x, the "
            "worst, repeatability aside; ~/save writes the calibration"
        )

    def _describe(self, request: ViewRequest) -> str:
        return describe_request(request, self._turn_by)

    def _remember(self, request: ViewRequest) -> None:
        if self._follower is not None:
            self._follower.remember(self._posture)

    def _recover(self, request: ViewRequest) -> None:
        if self._follower is not None:
            self._follower.bring_back(request, self._posture)

    def _go(self, request: ViewRequest, commands: MicroscopeCommands) -> None:
        g = request.magnification
        up = g * AWAY
        inside = up <= self.goal.magnification_range[1]
        self._set_anew(request.visit, g, up if inside else g / AWAY, commands)
        now = self._taker.stage() or StageReading()
        target = {"tilt": request.tilt_rad}
        current: dict[str, float | None] = {"tilt": now.tilt_rad}
        if self._turn_by == "scan_rotation":
            target["scan_rotation"] = request.turn_rad
            current["scan_rotation"] = now.scan_rotation_rad
        elif self._turn_by == "rotation":
            target["rotation"] = request.turn_rad
            current["rotation"] = now.rotation_rad
        self._move(target, current, commands)
        self._posture = target
