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

"""What the calibration server knows: views, a calibration that runs, an acquisition; no ROS and no files.

Each event is a method of the frozen :class:`CalibrationState`: it returns the next state, with what is to be done, or
refuses by an error and changes nothing. :mod:`semcal_ros.nodes.calibration_server` reads messages, calls these
methods one at a time, does what they say, and publishes.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from semcal_ros.bridge.conditions import Conditions
from semcal_ros.bridge.images import to_gray
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.calibration.acquisition import (
    ViewRequest,
    find_picture_fault,
    is_same_magnification,
)
from semcal_ros.core.calibration.judgement.findings import measure_view_coverage
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.calibration.views import FoundView
from semcal_ros.core.camera.records import Provenance
from semcal_ros.core.corners import LatticeDetection
from semcal_ros.core.errors import CalibrationError, InvalidValueError, Rejection
from semcal_ros.core.ladder.acquisition import PictureRequest
from semcal_ros.core.ladder.matching import LadderPicture
from semcal_ros.core.wording import counted
from semcal_ros.nodes.acquisition.recorded import RecordedView, view_name
from semcal_ros.nodes.workers.calibration_worker import (
    CalibrationJob,
    ExtensionJob,
    Stage,
    without_images,
)
from semcal_ros.workflows.calibrate import options_for
from semcal_ros.workflows.extend import make_picture
from semcal_ros.workflows.provenance import ConditionsComparison, describe_views

if TYPE_CHECKING:  # what they move the microscope with needs ROS
    from semcal_ros.nodes.acquisition.ladder import LadderRun
    from semcal_ros.nodes.acquisition.run import AcquisitionRun

Answer = TypeVar("Answer")

# Stamps that are behind by more are of another clock, or of so slow a scan that one follows the other.
_OTHER_CLOCK_NS = 30 * 10**9
# Why the stage is not used, as from a recording: small angles in degrees have passed for radians.
_DEGREES = "stage: {} looks like degrees: the stage is not used"


class Frame(Protocol):
    """A frame of the stream."""

    @property
    def image(self) -> NDArray[Any]:
        """(h, w) or (h, w, 3) pixels, whose memory may be used again."""

    @property
    def encoding(self) -> str:
        """How the pixels are to be read."""

    @property
    def header(self) -> Any:
        """Its header, for what is published about it."""

    @property
    def stamp_ns(self) -> int:
        """Its stamp."""

    @property
    def magnification(self) -> float | None:
        """The magnification; None where it is not known."""

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in px."""


class RunningJob(Protocol):
    """A calibration, or an extension, in a process of its own."""

    @property
    def job(self) -> CalibrationJob | ExtensionJob:
        """What is computed."""

    @property
    def elapsed_s(self) -> float:
        """Seconds since it began."""

    def cancel(self) -> None:
        """Stop it at once."""


@dataclass(frozen=True)
class StreamPicture:
    """A frame with a known magnification, and what was known when it arrived."""

    frame: Frame
    magnification: float
    visit: int
    stage: StageReading | None
    conditions: Conditions

    @property
    def grey(self) -> NDArray[Any]:
        """(h, w) grey levels; perhaps in the memory of the frame."""
        return to_gray(self.frame.image, self.frame.encoding)

    def require_magnification_of(self, request: ViewRequest | PictureRequest) -> None:
        """Refuse a picture at another magnification than was asked for; raises :class:`CalibrationError`."""
        if not is_same_magnification(request.magnification, self.magnification):
            raise CalibrationError(
                f"a picture at {self.magnification:g}x", expected=f"{request.magnification:.0f}x"
            )

    def to_view(
        self, detection: LatticeDetection | Rejection[Any], request: ViewRequest | None
    ) -> FoundView:
        """Make a view without pixels; raises :class:`CalibrationError` without a grid, or with one not as asked for."""
        g = self.magnification
        if isinstance(detection, Rejection):
            raise CalibrationError(
                f"no grid found at {g:g}x: {detection.reason}",
                expected="an image filled by the chess grid",
            )
        grey = self.grey
        if request is not None:
            fault = find_picture_fault(grey, detection, request, self.stage)
            if fault:
                raise CalibrationError(f"not usable at {g:g}x: {fault}")
        return without_images([FoundView("", g, grey, detection, self.stage, self.visit)])[0]

    def to_ladder_picture(self, name: str) -> LadderPicture:
        """Make a picture of a ladder, with pixels of its own."""
        made = make_picture(
            np.array(self.grey), self.magnification, name, self.stage, self.conditions
        )
        return replace(made, visit=self.visit)


@dataclass(frozen=True)
class LadderSource:
    """Of one picture of a ladder: its stamp, ns, and how it was taken."""

    stamp_ns: int
    conditions: Conditions
    stage: StageReading | None


@dataclass(frozen=True)
class CalibrationState:
    """What a calibration server knows at one moment.

    Attributes
    ----------
    newest, pictures
        The newest picture; how many have come.
    used
        The frame of the last view or picture that was taken.
    first_visit
        Visit of the first picture that comes.
    views, calibrated_views
        The views; how many of them, the first ones, a calibration was made from.
    calibration
        The last one that was made.
    running, stage
        The calibration that is running, and how far it is; the stage stays after one has ended.
    acquisition, acquisition_wanted
        The acquisition, also one that has ended; whether it is to go on.
    request, taken_by_hand
        What a person is asked for, and what was taken for it, in words.
    ladder
        Of the pictures of a ladder, by their names.
    recording, resumed
        What the acquisition is recorded to, and the recording that it went on with.
    """

    newest: StreamPicture | None = None
    pictures: int = 0
    used: Frame | None = None
    first_visit: int = 0
    views: tuple[RecordedView, ...] = ()
    calibrated_views: int = 0
    calibration: Calibration | None = None
    running: RunningJob | None = None
    stage: Stage | None = None
    acquisition: AcquisitionRun | LadderRun | None = None
    acquisition_wanted: bool = False
    request: ViewRequest | PictureRequest | None = None
    taken_by_hand: str = ""
    ladder: Mapping[str, LadderSource] = field(default_factory=dict)
    recording: Path | None = None
    resumed: Path | None = None

    # -- pictures and views ------------------------------------------------------------------------

    def with_frame(
        self,
        frame: Frame,
        magnification: float,
        stage: StageReading | None,
        conditions: Conditions,
    ) -> CalibrationState:
        """Take note of a frame: another magnification than before begins a visit."""
        before = self.newest
        visit = self.first_visit if before is None else before.visit
        visit += before is not None and before.magnification != magnification
        newest = StreamPicture(frame, magnification, visit, stage, conditions)
        return replace(self, newest=newest, pictures=self.pictures + 1)

    def without_picture(self) -> CalibrationState:
        """Forget the newest picture: nobody knows which microscope it is of."""
        return replace(self, newest=None)

    def picture_to_take(self) -> StreamPicture:
        """Return the newest picture; raises :class:`InvalidValueError` if there is none, or none that is new."""
        if self.newest is None:
            raise InvalidValueError(
                "no frame with a known magnification yet", do="check that the microscope publishes"
            )
        if self.newest.frame is self.used:
            raise InvalidValueError("the same frame as before", do="wait for the next one")
        return self.newest

    def with_view(self, view: FoundView, picture: StreamPicture) -> tuple[CalibrationState, str]:
        """Add a view; also return what it is, in words."""
        view = replace(view, name=view_name(len(self.views)))
        taken = RecordedView(view, picture.frame.stamp_ns, picture.conditions)
        views = (*self.views, taken)
        text = f"{view.name} at {view.magnification:g}x"
        text += f" with {counted(len(view.detection.xy), 'corner')}"
        tilt = None if view.stage is None else view.stage.tilt_rad
        text += "" if tilt is None else f", tilted by {np.degrees(tilt):.1f} degrees"
        return replace(self, views=views, used=picture.frame), text

    def with_ladder_picture(self, name: str, picture: StreamPicture) -> CalibrationState:
        """Take note of a picture that a ladder has taken."""
        source = LadderSource(picture.frame.stamp_ns, picture.conditions, picture.stage)
        return replace(self.with_ladder_source(name, source), used=picture.frame)

    def with_ladder_source(self, name: str, source: LadderSource) -> CalibrationState:
        """Take note of where a picture of a ladder comes from."""
        return replace(self, ladder={**self.ladder, name: source})

    def cleared(self) -> tuple[CalibrationState, str]:
        """Remove all views; also return how many there were, in words."""
        text = f"{counted(len(self.views), 'view')} removed"
        return replace(self, views=(), calibrated_views=0, used=None), text

    @property
    def unused_views(self) -> int:
        """How many views no calibration was made from."""
        return len(self.views) - self.calibrated_views

    def _named_views(self, stage_doubt: str) -> tuple[FoundView, ...]:
        views = tuple(replace(one.view, name=view_name(i)) for i, one in enumerate(self.views))
        return tuple(replace(v, stage=None) for v in views) if stage_doubt else views

    def _describe(self, config: MicroscopeConfig, views: Iterable[FoundView]) -> Provenance:
        """Where a calibration from these views, all that there are, comes from."""
        seen = {
            view.name: (one.conditions, view.stage)
            for view, one in zip(views, self.views, strict=True)
        }
        return describe_views(config, seen, [one.stamp_ns for one in self.views])

    # -- calibrations ------------------------------------------------------------------------------

    def refuse_another_job(self) -> None:
        """Refuse a second calibration beside one that is running; raises :class:`CalibrationError`."""
        if self.running is not None:
            raise CalibrationError(
                "a calibration is running", do="wait for its end, or call ~/cancel"
            )

    def calibration_job(
        self, config: MicroscopeConfig, options: CalibrationOptions, stage_doubt: str
    ) -> CalibrationJob:
        """Return what is to be computed from the views.

        Parameters
        ----------
        config
            Of the microscope.
        options
            Method and residual field.
        stage_doubt
            What looks like degrees in the messages of the stage; empty where nothing does.

        Raises
        ------
        CalibrationError
            One is running, or there are no views.
        """
        self.refuse_another_job()
        self._require_views()
        had_stage = any(one.view.stage is not None for one in self.views)
        notes = (_DEGREES.format(stage_doubt),) if stage_doubt and had_stage else ()
        views = self._named_views(stage_doubt)
        return CalibrationJob(
            views,
            config.display_width_m,
            config.squares_m,
            options_for(config, options),
            config.grid_certificate,
            notes,
            self._describe(config, views),
            {v.name: one.conditions for v, one in zip(views, self.views, strict=True)},
        )

    def _require_views(self) -> None:
        if not self.views:
            raise CalibrationError("no usable view yet", do="call ~/add_view first")

    def extension_job(
        self,
        config: MicroscopeConfig,
        calibration: Calibration,
        pictures: tuple[LadderPicture, ...],
        stage_doubt: str,
    ) -> ExtensionJob:
        """Return the extension of a calibration by pictures; further parameters as of :meth:`calibration_job`."""
        compared = ConditionsComparison(calibration, scans_may_turn=True)
        sources = {picture.name: self.ladder[picture.name] for picture in pictures}
        for source in sources.values():
            compared.add(source.conditions)
        notes = compared.notes
        if stage_doubt:
            pictures = tuple(replace(picture, scan_rotation_rad=None) for picture in pictures)
            notes = (*notes, _DEGREES.format(stage_doubt))
        seen = {name: (source.conditions, source.stage) for name, source in sources.items()}
        origin = describe_views(config, seen, [source.stamp_ns for source in sources.values()])
        return ExtensionJob(calibration, pictures, config, origin, notes)

    def with_job(self, running: RunningJob) -> CalibrationState:
        """Begin a calibration, in place of one that may be running."""
        return replace(self, running=running)

    def with_stage(self, running: RunningJob, stage: Stage) -> CalibrationState:
        """Take note of how far a calibration is, unless another one has taken its place."""
        return replace(self, stage=stage) if self.running is running else self

    def with_end_of(self, running: RunningJob, *, done: bool) -> tuple[CalibrationState, bool]:
        """Allow the next calibration; also return whether this one is still wanted."""
        if self.running is not running:
            return self, False
        return replace(self, running=None, stage=Stage("done", 1.0) if done else None), True

    def with_calibration(
        self, calibration: Calibration, views: int | None = None
    ) -> CalibrationState:
        """Keep a calibration, made from so many of the first views; None where it is from none."""
        count = self.calibrated_views if views is None else views
        return replace(self, calibration=calibration, calibrated_views=count)

    def compared(
        self, config: MicroscopeConfig, stage_doubt: str
    ) -> tuple[tuple[FoundView, ...], Provenance]:
        """Return the views that say if a calibration holds, and their origin; raises :class:`CalibrationError`."""
        views = self._named_views(stage_doubt)
        self._require_views()
        return views, self._describe(config, views)

    def calibration_to_save(self) -> Calibration:
        """Return the calibration; raises :class:`InvalidValueError` if there is none."""
        if self.calibration is None:
            raise InvalidValueError("no calibration to save", do="call ~/calibrate first")
        return self.calibration

    def cancelled(self) -> tuple[CalibrationState, RunningJob | None, str]:
        """End an acquisition, or a calibration.

        Returns
        -------
        The next state, what is to be stopped, and what was done, in words.

        Raises
        ------
        CalibrationError
            Nothing is running.
        """
        running = self.running
        after = replace(self, acquisition_wanted=False, running=None, stage=None)
        if self.acquisition_wanted:
            return (
                after,
                running,
                f"the acquisition ends as soon as nothing moves; {self.service} goes on with it",
            )
        if running is None:
            raise CalibrationError("no calibration is running")
        return after, running, f"cancelled the {running.job.title} after {running.elapsed_s:.1f} s"

    def closed(self) -> CalibrationState:
        """End an acquisition, as the node ends."""
        return replace(self, acquisition_wanted=False)

    # -- a calibration that records itself -----------------------------------------------------------

    @property
    def service(self) -> str:
        """What goes on with the acquisition."""
        return "~/acquire" if self.acquisition is None else self.acquisition.service

    def can_go_on(self, goal: object) -> bool:
        """Whether the last acquisition is one for this goal, and can be gone on with."""
        run = self.acquisition
        ended = run is None or run.discarded or run.progress.state == "done"
        return run is not None and not ended and run.goal == goal

    def with_acquisition(
        self,
        goal: object,
        make_run: Callable[[], AcquisitionRun | LadderRun],
        recording: Path | None,
    ) -> tuple[CalibrationState, AcquisitionRun | LadderRun]:
        """Begin an acquisition, or go on with the one that has the same goal; also return it."""
        run, ladder = self.acquisition, self.ladder
        if run is None or not self.can_go_on(goal):
            run, ladder = make_run(), {}
        after = replace(
            self, acquisition=run, acquisition_wanted=True, recording=recording, ladder=ladder
        )
        return after, run

    def with_recorded_views(self, taken: Iterable[RecordedView]) -> CalibrationState:
        """Take over views of a recording."""
        views = [replace(one, view=without_images([one.view])[0]) for one in taken]
        return replace(self, views=(*self.views, *views))

    def with_resumed(self, path: Path, visits: Iterable[int]) -> CalibrationState:
        """Go on after the visits of a recording: what comes now was set anew."""
        first = 1 + max(visits, default=-1)
        newest = self.newest
        if newest is not None:
            newest = replace(newest, visit=newest.visit + first)
        return replace(self, resumed=path, first_visit=first, newest=newest)

    def with_request(self, request: ViewRequest | PictureRequest) -> CalibrationState:
        """Ask a person for a picture."""
        return replace(self, request=request, taken_by_hand="")

    def without_request(self) -> CalibrationState:
        """Ask nobody for a picture."""
        return replace(self, request=None)

    def with_answer(self, text: str) -> CalibrationState:
        """Take note of what a person has taken."""
        return replace(self, taken_by_hand=text)

    def with_end_of_acquisition(self) -> CalibrationState:
        """Take note that an acquisition has ended, for whatever reason."""
        return replace(self, request=None, acquisition_wanted=False)

    def has_new_picture(self, count: int, asked_ns: int) -> bool:
        """Whether so many pictures have come in all, and the newest was scanned after a moment, ns."""
        if self.pictures < count or self.newest is None:
            return False
        # Pictures of a scan that began before may still come, more than one where they overlap.
        late_ns = asked_ns - self.newest.frame.stamp_ns
        return late_ns <= 0 or late_ns > _OTHER_CLOCK_NS

    # -- what it tells -----------------------------------------------------------------------------

    def progress(self, settings: Mapping[str, str]) -> tuple[tuple[str, str], ...]:
        """Return what ~/progress shows: views and their coverage, the stage of a calibration, an acquisition.

        Parameters
        ----------
        settings
            What ~/acquire would do, and with what: a viewer shows it before it begins.
        """
        views = [one.view for one in self.views]
        values = [("views", str(len(views)))]
        values.append(("corners", str(sum(len(view.detection.xy) for view in views))))
        counts = Counter(view.magnification for view in views)
        values += [(f"views at {g:g}x", str(counts[g])) for g in sorted(counts)]
        coverage = measure_view_coverage(views)
        values.append(("field_share", f"{coverage.field_share:.3f}"))
        if coverage.tilts_deg:
            values.append(("least_tilt_deg", f"{min(coverage.tilts_deg):.1f}"))
            values.append(("largest_tilt_deg", f"{max(coverage.tilts_deg):.1f}"))
        if self.stage is not None:
            values += [("stage", self.stage.name), ("fraction", f"{self.stage.fraction:.3f}")]
        values += settings.items()
        if self.acquisition is not None:
            progress = self.acquisition.progress
            values += [("acquisition", progress.state), ("request", progress.text)]
            values += [("taken", str(progress.views)), ("planned", str(progress.planned))]
            values += [("left_out", str(progress.left_out))]
            values += [("largest_sigma", f"{progress.largest:.3g}")]
        return tuple(values)


class CurrentState:
    """The state of now, for several threads: one event at a time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._now = CalibrationState()

    @property
    def now(self) -> CalibrationState:
        """The state; it is frozen, and may be an old one at once."""
        return self._now

    def change(self, event: Callable[[CalibrationState], CalibrationState]) -> CalibrationState:
        """Go on to the state that an event leads to, and return it; a refusal leaves it as it is."""
        with self._lock:
            self._now = event(self._now)
            return self._now

    def answer(
        self, event: Callable[[CalibrationState], tuple[CalibrationState, Answer]]
    ) -> Answer:
        """As :meth:`change`, for an event that also answers; return the answer."""
        with self._lock:
            self._now, answer = event(self._now)
            return answer
