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

"""What a calibration server knows, event by event: no ROS, no threads, no process."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from semcal_ros.bridge.conditions import Conditions
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import load_config
from semcal_ros.core.calibration.acquisition import ViewRequest
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.corners import LatticeDetection
from semcal_ros.core.errors import CalibrationError, InvalidValueError, Rejection
from semcal_ros.nodes.acquisition.recorded import RecordedView
from semcal_ros.nodes.calibration_state import CalibrationState, LadderSource
from semcal_ros.nodes.workers.calibration_worker import CalibrationJob, ExtensionJob, Stage

ROOT = Path(__file__).resolve().parents[2]
CONFIG = load_config("virtual_sem")
TILTED = StageReading(tilt_rad=0.35)
S = 1_000_000_000


@dataclass(frozen=True)
class FakeFrame:
    """A frame of a few pixels."""

    stamp_ns: int = 0
    magnification: float | None = 1000.0
    image: Any = field(default_factory=lambda: np.arange(256, dtype=np.uint8).reshape(16, 16))
    encoding: str = "mono8"
    header: object = None

    @property
    def size(self) -> tuple[int, int]:
        return self.image.shape[1], self.image.shape[0]


@dataclass
class FakeRun:
    """An acquisition that stands still."""

    goal: object
    state: str = "running"
    discarded: bool = False
    service: str = "~/acquire"

    @property
    def progress(self) -> Any:
        return SimpleNamespace(
            state=self.state, text="tilt it", views=3, planned=9, left_out=1, largest=0.002
        )


class FakeJob:
    """A calibration that never ends."""

    elapsed_s = 2.0

    def __init__(self, job: CalibrationJob | ExtensionJob) -> None:
        self.job = job

    def cancel(self) -> None:
        raise AssertionError("the state stops nothing by itself")


def detection(count: int = 4) -> LatticeDetection:
    ij = np.array([(i, j) for i in range(count) for j in range(count)])
    return LatticeDetection(ij, 4.0 * ij, np.full(len(ij), 0.05), 4.0, (16, 16))


def seen(
    *magnifications: float, state: CalibrationState | None = None, stage: StageReading | None = None
) -> CalibrationState:
    """The state after frames with these magnifications."""
    state = state or CalibrationState()
    for g in magnifications:
        stamp_ns = state.pictures * S
        state = state.with_frame(FakeFrame(stamp_ns, g), g, stage, Conditions())
    return state


def collected(
    *magnifications: float, state: CalibrationState | None = None, stage: StageReading | None = None
) -> CalibrationState:
    """The state after a view of each of these frames."""
    state = state or CalibrationState()
    for g in magnifications:
        state = seen(g, state=state, stage=stage)
        picture = state.picture_to_take()
        state, _ = state.with_view(picture.to_view(detection(), None), picture)
    return state


def job_of(state: CalibrationState, doubt: str = "") -> CalibrationJob:
    return state.calibration_job(CONFIG, CalibrationOptions(), doubt)


def test_it_needs_no_ros() -> None:
    code = (
        "import sys\n"
        "blocked = ('rclpy', 'sensor_msgs', 'std_msgs', 'diagnostic_msgs', 'rcl_interfaces')\n"
        "sys.modules.update(dict.fromkeys(blocked))\n"
        "import semcal_ros.nodes.calibration_state"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_another_magnification_begins_a_visit() -> None:
    visits = []
    state = CalibrationState()
    for g in (500.0, 500.0, 1000.0, 500.0):
        state = seen(g, state=state)
        visits.append(state.picture_to_take().visit)
    assert visits == [0, 0, 1, 2]
    assert state.pictures == 4


def test_a_frame_is_taken_once_and_not_where_two_streams_are() -> None:
    with pytest.raises(InvalidValueError, match="no frame with a known magnification yet"):
        CalibrationState().picture_to_take()
    state = collected(500.0)
    with pytest.raises(InvalidValueError, match="the same frame as before"):
        state.picture_to_take()
    with pytest.raises(InvalidValueError, match="no frame"):
        state.without_picture().picture_to_take()
    # The views go, and the frame may be taken again.
    state, text = state.cleared()
    assert text == "1 view removed"
    assert state.picture_to_take().magnification == 500.0


def test_a_view_is_described_and_keeps_no_pixels() -> None:
    state = seen(1000.0, stage=TILTED)
    picture = state.picture_to_take()
    after, text = state.with_view(picture.to_view(detection(), None), picture)
    assert text == "view 1 at 1000x with 16 corners, tilted by 20.1 degrees"
    view = after.views[0].view
    assert (view.name, view.stage, view.visit) == ("view 1", TILTED, 0)
    assert view.image is not None
    assert view.image.size == 1
    # A state is never changed.
    assert state.views == ()


def test_what_is_not_as_asked_for_is_refused_with_the_reason() -> None:
    picture = seen(1000.0, stage=TILTED).picture_to_take()
    with pytest.raises(CalibrationError, match="no grid found at 1000x: too dark"):
        picture.to_view(Rejection(cast(Any, None), "too dark"), None)
    level = ViewRequest(0, 1000.0, 0.0, 0.0, 10e-6)
    picture.require_magnification_of(level)
    with pytest.raises(CalibrationError, match=r"tilted by 20\.1 degrees instead of 0\.0"):
        picture.to_view(detection(), level)
    with pytest.raises(CalibrationError, match=r"a picture at 1000x.*2000x"):
        picture.require_magnification_of(ViewRequest(0, 2000.0, 0.35, 0.0, 10e-6))


def test_a_job_has_all_views_and_one_runs_at_a_time() -> None:
    with pytest.raises(CalibrationError, match="no usable view yet"):
        job_of(CalibrationState())
    state = collected(500.0, 1000.0, 1000.0, stage=TILTED)
    job = job_of(state)
    assert [view.name for view in job.views] == ["view 1", "view 2", "view 3"]
    assert [view.visit for view in job.views] == [0, 1, 1]
    assert job.views[0].stage == TILTED
    assert job.notes == ()
    running = FakeJob(job)
    busy = state.with_job(running)
    with pytest.raises(CalibrationError, match="a calibration is running"):
        job_of(busy)
    # Views can be added meanwhile, for the next one.
    busy = collected(4000.0, state=busy)
    after, wanted = busy.with_end_of(running, done=True)
    assert wanted
    assert after.stage == Stage("done", 1.0)
    kept = after.with_calibration(cast(Calibration, object()), len(job.views))
    assert kept.unused_views == 1
    assert len(job_of(kept).views) == 4


def test_a_stage_in_degrees_is_not_used_and_that_is_noted() -> None:
    job = job_of(collected(500.0, stage=TILTED), "tilt 30 rad")
    assert job.views[0].stage is None
    assert job.notes == ("stage: tilt 30 rad looks like degrees: the stage is not used",)
    # Without a stage in the views there is nothing to note.
    assert job_of(collected(500.0), "tilt 30 rad").notes == ()


def test_what_was_cancelled_is_not_wanted_when_it_ends() -> None:
    with pytest.raises(CalibrationError, match="no calibration is running"):
        CalibrationState().cancelled()
    state = collected(500.0)
    first, second = FakeJob(job_of(state)), FakeJob(job_of(state))
    state = state.with_job(first).with_stage(first, Stage("corners", 0.5))
    assert state.stage == Stage("corners", 0.5)
    state, stopped, text = state.cancelled()
    assert stopped is first
    assert text == "cancelled the joint calibration from 1 view after 2.0 s"
    assert state.stage is None
    # What it still says does not count for the one that has begun since.
    state = state.with_job(second).with_stage(first, Stage("late", 0.9))
    assert state.stage is None
    after, wanted = state.with_end_of(first, done=True)
    assert not wanted
    assert after.running is second


def begin(state: CalibrationState, goal: object) -> tuple[CalibrationState, Any]:
    return state.with_acquisition(goal, lambda: cast(Any, FakeRun(goal)), Path("record"))


def test_an_acquisition_goes_on_until_it_is_done_or_another_is_asked_for() -> None:
    state, run = begin(CalibrationState(), "goal")
    assert (state.acquisition_wanted, state.recording) == (True, Path("record"))
    state = state.with_ladder_source("picture 0", LadderSource(0, Conditions(), None))
    stopped, job, text = state.cancelled()
    assert job is None
    assert text == "the acquisition ends as soon as nothing moves; ~/acquire goes on with it"
    assert not stopped.acquisition_wanted
    again, same = begin(stopped, "goal")
    assert same is run
    assert set(again.ladder) == {"picture 0"}
    for change in ({"state": "done"}, {"discarded": True}):
        before, ended = begin(CalibrationState(), "goal")
        vars(ended).update(change)
        after, new = begin(before, "goal")
        assert new is not ended
        assert after.ladder == {}
    other, new = begin(again, "another goal")
    assert new is not run
    assert other.ladder == {}


def test_a_cancelled_acquisition_ends_its_calibration_too() -> None:
    state, _ = begin(collected(500.0), "goal")
    running = FakeJob(job_of(state))
    after, stopped, _ = state.with_job(running).cancelled()
    assert stopped is running
    assert after.running is None
    assert not state.with_end_of_acquisition().acquisition_wanted
    assert not state.closed().acquisition_wanted


def test_what_comes_after_a_recording_is_of_other_visits() -> None:
    recorded = collected(500.0, 1000.0).views
    state = seen(1000.0).with_recorded_views(recorded)
    state = state.with_resumed(Path("before"), [one.view.visit for one in recorded])
    assert [one.view.visit for one in state.views] == [0, 1]
    assert state.newest is not None
    assert state.newest.visit == 2
    assert state.resumed == Path("before")
    # Also where no picture has come yet.
    first = seen(500.0, state=CalibrationState().with_resumed(Path("before"), [0])).newest
    assert first is not None
    assert first.visit == 1


def test_a_new_picture_is_one_that_was_scanned_after_the_question() -> None:
    state = seen(500.0, 500.0)
    assert state.newest is not None
    stamp_ns = state.newest.frame.stamp_ns
    assert state.has_new_picture(2, stamp_ns)
    assert not state.has_new_picture(3, stamp_ns)
    # A scan that had begun before; a stamp that is so far behind is of another clock.
    assert not state.has_new_picture(2, stamp_ns + S)
    assert state.has_new_picture(2, stamp_ns + 31 * S)
    assert not CalibrationState().has_new_picture(0, 0)


def test_a_person_is_asked_and_answers() -> None:
    request = ViewRequest(0, 1000.0, 0.0, 0.0, 10e-6)
    state = CalibrationState(taken_by_hand="an older one").with_request(request)
    assert (state.request, state.taken_by_hand) == (request, "")
    assert state.with_answer("view 1").taken_by_hand == "view 1"
    assert state.without_request().request is None


def test_progress_has_views_coverage_and_the_acquisition() -> None:
    state, _ = begin(collected(500.0, 1000.0, 1000.0, stage=TILTED), "goal")
    state = state.with_job(FakeJob(job_of(state)))
    assert state.running is not None
    state = state.with_stage(state.running, Stage("fit", 0.25))
    values = dict(state.progress({"target": "0.001", "microscope": "sem"}))
    assert values["views"] == "3"
    assert values["corners"] == "48"
    assert (values["views at 500x"], values["views at 1000x"]) == ("1", "2")
    assert (values["stage"], values["fraction"]) == ("fit", "0.250")
    assert (values["target"], values["microscope"]) == ("0.001", "sem")
    assert (values["acquisition"], values["request"]) == ("running", "tilt it")
    assert (values["taken"], values["planned"], values["left_out"]) == ("3", "9", "1")
    assert values["largest_sigma"] == "0.002"
    assert dict(CalibrationState().progress({}))["views"] == "0"


def test_views_say_whether_a_calibration_holds_and_there_must_be_one_to_save() -> None:
    with pytest.raises(CalibrationError, match="no usable view yet"):
        CalibrationState().compared(CONFIG, "")
    views, _ = collected(500.0, stage=TILTED).compared(CONFIG, "")
    assert views[0].stage == TILTED
    assert collected(500.0, stage=TILTED).compared(CONFIG, "tilt 30 rad")[0][0].stage is None
    with pytest.raises(InvalidValueError, match="no calibration to save"):
        CalibrationState().calibration_to_save()
    made = cast(Calibration, object())
    assert CalibrationState().with_calibration(made).calibration_to_save() is made


def test_a_recorded_view_loses_its_pixels() -> None:
    whole = replace(collected(500.0).views[0].view, image=np.zeros((16, 16), dtype=np.uint8))
    state = CalibrationState().with_recorded_views([RecordedView(whole, 7, Conditions())])
    assert state.views[0].stamp_ns == 7
    kept = state.views[0].view.image
    assert kept is not None
    assert kept.size == 1
