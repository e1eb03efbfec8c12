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

"""A ladder that records itself, step by step, on a microscope of grains whose stage and zoom are as real ones are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Any, cast

import numpy as np
import pytest

from semcal_ros.calibration import Calibration
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.errors import CalibrationError, InvalidValueError, MicroscopeError
from semcal_ros.core.ladder.acquisition import PictureRequest
from semcal_ros.core.ladder.matching import LadderPicture
from semcal_ros.nodes.acquisition.ladder import (
    LadderGoal,
    LadderRun,
    describe_picture,
    ladder_goal_of,
)
from semcal_ros.nodes.acquisition.run import Progress
from tests.helpers.ladders import calibration_of, make_scope, take

# The first magnification, in the range of the grid, and the last one.
FIRST, LAST = 3556.0, 12000.0


class Microscope:
    """Moves, scans, and takes pictures for a run; a picture is a hundred milliseconds of drawing."""

    def __init__(self) -> None:
        self.scope = make_scope()
        self.magnification = 2000.0
        self.joints = {"x": 1e-3, "y": -2e-3, "scan_rotation": 0.3, "tilt": 0.0}
        self.log: list[str] = []
        self.shown: list[Progress] = []
        self.zoom_shift = (0.0, 0.0)
        # Stages are mounted as they are: mirrored, and turned by half a radian.
        self.specimen_from_stage = np.array([[0.88, 0.48], [0.48, -0.88]])
        self.run: LadderRun | None = None
        self.wanted = True
        self.fault = ""
        self.extended: list[LadderPicture] = []

    # -- what it is told -------------------------------------------------------------------------

    def place(self) -> tuple[float, float] | None:
        return self.joints["x"], self.joints["y"]

    def set_magnification(self, magnification: float) -> None:
        self.log.append(f"{magnification:g}x")
        self.magnification = magnification

    def move(self, target: Mapping[str, float], _current: Mapping[str, float | None]) -> None:
        if self.fault:
            raise MicroscopeError(self.fault)
        self.log.append(" ".join(sorted(target)))
        self.joints |= target

    # -- what it shows ---------------------------------------------------------------------------

    def picture(self, name: str = "") -> LadderPicture:
        g = self.magnification
        way = np.array([self.joints["x"] - 1e-3, self.joints["y"] + 2e-3])
        # What a zoom does beside zooming: the place moves in the picture.
        off = np.array(self.zoom_shift) * self.scope.display_m / FIRST * math.log(g / FIRST)
        at = (self.specimen_from_stage @ way + off) / (self.scope.display_m / g)
        turn = self.joints["scan_rotation"]
        image = take(self.scope, g, (float(at[0]), float(at[1])), turn - 0.3, seed=len(self.log))
        return LadderPicture(np.rint(image).astype(np.uint8), g, name, turn)

    def newest_picture(self) -> LadderPicture | None:
        return self.picture()

    def stage(self) -> StageReading | None:
        joints = self.joints
        return StageReading(
            tilt_rad=joints["tilt"],
            x_m=joints["x"],
            y_m=joints["y"],
            scan_rotation_rad=joints["scan_rotation"],
        )

    def wait_for_pictures(self, _count: int) -> None:
        if not self.wanted:
            raise CalibrationError("stopped")

    def take(self, request: PictureRequest) -> str:
        assert self.run is not None
        self.run.take(request, self.picture(f"picture {len(self.run.taken)}"), self.place())
        return f"picture {len(self.run.taken)}"

    def wait_for_view(self, request: PictureRequest) -> str:
        return self.take(request)

    def show(self, progress: Progress) -> None:
        self.shown.append(progress)

    def extend_calibration(self, run: LadderRun) -> str:
        self.extended = [one.picture for one in run.taken]
        return f"extended by {len(run.taken)} pictures"


@pytest.fixture
def scope() -> Microscope:
    return Microscope()


def begin(scope: Microscope, *, visits: int = 2, by_hand: bool = False) -> LadderRun:
    """A ladder to 12 000x, or the first magnifications of it."""
    calibration = Calibration.from_model(calibration_of(scope.scope))
    commands = None if by_hand else cast("Any", scope)
    run = LadderRun(LadderGoal(calibration, LAST), scope, commands, lambda: scope.wanted)
    run._waiting = [request for request in run._waiting if request.visit < visits]
    scope.run = run
    return run


@pytest.mark.parametrize("visits", [2, pytest.param(4, marks=pytest.mark.long)])
def test_the_place_stays_in_the_middle_although_each_zoom_moves_it(
    scope: Microscope, visits: int
) -> None:
    # By 18 % of the field of 3556x, a quarter to a third of that of the next magnification.
    scope.zoom_shift = (0.4, -0.25)
    run = begin(scope, visits=visits)
    assert run.run() == f"extended by {4 * visits} pictures; ~/save writes the calibration"
    assert run.reached and run.progress.views == run.progress.planned == 4 * visits
    assert len(scope.extended) == 4 * visits
    seen = sorted({picture.magnification for picture in scope.extended})
    assert seen[0] == FIRST and (seen[-1] == LAST) == (visits == 4)
    assert max(b / a for a, b in pairwise(seen)) < 1.52
    for one in run.taken[1:]:
        assert one.offset_px is not None
        off = np.abs(one.offset_px) / 256.0
        # Middle and turned pictures lie within the comparison's limit, moved ones a quarter away.
        limit = (0.18, 0.42) if one.request.move != (0.0, 0.0) else (0.0, 0.15)
        assert limit[0] < np.hypot(*off) or limit[0] == 0.0
        assert np.max(off) < limit[1]
    assert any("moving the place to the middle" in progress.text for progress in scope.shown)
    turns = [one.picture.scan_rotation_rad - 0.3 for one in run.taken]
    assert [round(math.degrees(turn)) for turn in turns] == [0, 0, 0, 90, 0, 0, 0, -90] * (
        visits // 2
    )
    # The scan is left as it was found, and the stage where the place is in the middle.
    assert scope.joints["scan_rotation"] == 0.3 and scope.joints["tilt"] == 0.0


def test_a_stop_is_gone_on_with_and_a_recording_taken_over(scope: Microscope) -> None:
    run = begin(scope)
    taken = run.take

    def take_six(*arguments: Any) -> None:
        taken(*arguments)
        scope.wanted = len(run.taken) < 6

    run.take = take_six  # type: ignore[method-assign]
    with pytest.raises(CalibrationError, match="stopped"):
        run.run()
    assert len(run.taken) == 6
    # Another process, the stage having been moved by somebody: it knows what was recorded.
    recorded = [(one.picture, one.place_m) for one in run.taken]
    scope.wanted = True
    scope.joints |= {"x": 1.1e-3, "scan_rotation": 0.0}
    again = begin(scope)
    assert [again.adopt(*one) for one in recorded] == [True] * 6
    assert not again.adopt(*recorded[-1]), "a second picture of one request"
    again.number_visits([0, 0, 0, 0, 1, 1])
    again.report("taken over")
    scope.log.clear()
    again.run()
    assert len(again.taken) == 8
    assert [one.picture.visit for one in again.taken[:6]] == [0, 0, 0, 0, 1, 1]
    # The magnification that was interrupted is set anew, then the stage goes to where the place was.
    assert scope.log[0] == f"{again.taken[4].picture.magnification:g}x"
    assert scope.joints["scan_rotation"] == 0.3
    # The same run in the same process sets it anew from another one.
    scope.log.clear()
    run.take = taken  # type: ignore[method-assign]
    run.run()
    first, second = (float(text[:-1]) for text in scope.log[:2])
    assert second == run.taken[4].picture.magnification and first == pytest.approx(second / 1.25)


def test_a_place_that_is_lost_ends_it_with_what_to_do(scope: Microscope) -> None:
    scope.zoom_shift = (9.0, 4.0)
    run = begin(scope)
    with pytest.raises(
        CalibrationError, match=r"no usable picture|the place is lost at .*~/extend"
    ):
        run.run()
    assert len(run.taken) == 4
    assert not run.reached


def test_a_stage_that_hardly_moves_ends_it(
    scope: Microscope,
) -> None:
    scope.specimen_from_stage = 0.1 * scope.specimen_from_stage
    run = begin(scope)
    with pytest.raises(
        CalibrationError, match=r"2 pictures in a row .* moved by [0-9] % of the field"
    ):
        run.run()


@pytest.mark.parametrize(
    ("joints", "said"),
    [({"tilt": 0.2}, "tilted by 11.5 degrees; expected an untilted one"), ({}, "refused")],
)
def test_what_the_stage_cannot_do_is_refused_before_anything_moves(
    scope: Microscope, joints: dict[str, float], said: str
) -> None:
    scope.joints |= joints
    scope.fault = "" if joints else "refused"
    with pytest.raises((CalibrationError, MicroscopeError), match=said):
        begin(scope).run()
    assert not any("x" in text.split() for text in scope.log)


def test_a_stage_that_tells_no_place_is_left_to_a_person(
    scope: Microscope, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scope, "place", lambda: None)
    with pytest.raises(MicroscopeError, match=r"does not tell x and y.*by hand"):
        begin(scope).run()
    # By hand nothing needs to be known.
    scope.magnification = FIRST
    run = begin(scope, by_hand=True)
    run._waiting = run._waiting[:1]
    run.run()
    assert [one.place_m for one in run.taken] == [None]
    assert [progress.state for progress in scope.shown[:2]] == ["running", "waiting"]


def test_requests_in_words() -> None:
    middle = describe_picture(PictureRequest(0, 4444.0, (0.0, 0.0), 0.0))
    assert middle == "set 4444x; the place in the middle, the scan not turned, in focus"
    moved = describe_picture(PictureRequest(0, 4444.0, (0.25, 0.08), 0.0))
    assert "the place moved by +25 and +8 % of the field" in moved
    turned = describe_picture(PictureRequest(0, 4444.0, (0.0, 0.0), -0.5 * math.pi))
    assert "turned to -90 degrees" in turned


def test_a_goal_needs_a_magnification_and_a_scan() -> None:
    calibration = Calibration.from_model(calibration_of(make_scope()))

    def read(**values: Any) -> LadderGoal:
        return ladder_goal_of(cast("Any", values), calibration)

    with pytest.raises(InvalidValueError, match="extend_to"):
        read(extend_to=0.0, turn_by="nothing")
    with pytest.raises(InvalidValueError, match="carry the place away"):
        read(extend_to=2e4, turn_by="rotation")
    assert read(extend_to=2e4, turn_by="nothing") == LadderGoal(calibration, 2e4, False)
