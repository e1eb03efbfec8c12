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

"""Follows a grid that a tilt or a turn carries out of the field of view, by x and y of the stage."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.acquisition import (
    ViewRequest,
    find_stage_move,
    grid_is_centred,
    image_from_stage,
    lattice_shift,
)
from semcal_ros.core.calibration.thresholds import PROBE_SQUARES
from semcal_ros.core.corners import LatticeDetection
from semcal_ros.core.errors import CalibrationError
from semcal_ros.nodes.acquisition.commands import MicroscopeCommands

# Moves to bring a grid to the middle: what is seen of it at first may be a corner only.
_MOST_MOVES = 6
# A move after which it is off by more than this part of what it was has gone the wrong way.
_BETTER = 0.7
# Smallest part of the way from one posture to the next after which the grid must still be seen.
_SMALLEST_STEP = 1.0 / 32.0
_PICTURES = 2

Posture = Mapping[str, float]
"""Angles of the joints, rad."""


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
