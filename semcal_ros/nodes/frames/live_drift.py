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

"""Drift tracking in the nodes: inline or beside the stream, reset by service and by a new calibration."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NoAnswer
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.drift.estimates import DriftEstimate, DriftUpdate
from semcal_ros.core.drift.settings import DriftSettings
from semcal_ros.core.drift.tracker import DriftTracker
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.rectification.binning import bin_image
from semcal_ros.core.rectification.raw_positions import RasterDrift
from semcal_ros.core.registration.reference import RegistrationSettings
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.parameters import ParameterDeclaration
from semcal_ros.nodes.common.reporter import NODE_ERRORS
from semcal_ros.nodes.frames.outputs import DriftOutput, ImageOutput, RectifiedOutput
from semcal_ros.nodes.frames.stream import StreamFrame
from semcal_ros.nodes.workers.child_process import ChildProcessEnded
from semcal_ros.nodes.workers.drift_worker import DriftProcess, Measurement, measure_frame

_RESTARTING = (
    ParameterDeclaration(
        "keyframe_overlap",
        DriftSettings.rekey_overlap,
        "A new keyframe is taken when less than this fraction of the image overlaps with the last one."
        " A change restarts the tracking.",
        low=0.1,
        high=0.95,
    ),
    ParameterDeclaration(
        "max_jump",
        DriftSettings.max_jump,
        "A shift between frames beyond this fraction of the field counts as a move of the stage."
        " A change restarts the tracking.",
        low=0.01,
        high=1.0,
    ),
)
_DETAIL = ParameterDeclaration(
    "drift_detail",
    1536,
    "Images with a longer side than this are averaged down by a whole factor before their drift is"
    " measured: 4096 x 4096 takes ten times as long, and its finest detail is mostly noise. What is"
    " published keeps all pixels. A change restarts the tracking.",
    unit="px",
    low=64,
    high=32766,
)
_MODE = ParameterDeclaration(
    "drift_tracking",
    "auto",
    "Which frames wait until their own drift is measured. every_frame: all, however late they get."
    " forecast: none; each is corrected by a forecast from earlier frames, and as many as possible"
    " are measured beside the stream. auto: every frame as long as the stream leaves the time.",
    choices=("auto", "every_frame", "forecast"),
)
DRIFT_PARAMETERS = (*_RESTARTING, _DETAIL, _MODE)

# Turns (see LoadMonitor.turn_s) that a forecast may span: a few are normal, since measurements beside the stream
# pause for twice as long as they take; many more mean a clock jump or a pause.
_FAR = 20.0
# That the stream waits for a measurement, which takes some 0.1 s: the process was stopped, or hangs.
_PATIENCE_S = 10.0
# Pause between measurements beside the stream, relative to the duration of one: they take at most a third of a CPU.
_REST = 2.0

# Weight of the newest value in a running mean: the mean follows a change within about ten frames
# and hides a single slow one.
_WEIGHT = 0.1
# Number of intervals after which their mean counts; the first interval may include the publisher's start.
_LEAST_INTERVALS = 2
# Fractions of the interval: rectifying and publishing need the rest. Above the first, not every frame is measured any
# more; below the second, every frame is again. The gap keeps a stream at the limit from switching with every frame.
_TOO_MUCH, _LITTLE_ENOUGH = 0.6, 0.4


@dataclass(frozen=True)
class FrameDrift:
    """Drift at one frame, in m.

    Attributes
    ----------
    estimate
        The drift at the centre of the frame.
    measured
        The latest frame whose drift was measured: this frame or an earlier one.
    binned
        Pixels of the frame per pixel of what was measured.
    zoom
        How many times as large the frame shows the specimen as the one that was measured.
    """

    estimate: DriftEstimate
    measured: DriftUpdate
    binned: int = 1
    zoom: float = 1.0

    @property
    def is_forecast(self) -> bool:
        """Whether the drift of this frame itself was not measured."""
        return self.estimate is not self.measured

    @property
    def raster(self) -> RasterDrift:
        """Return the drift during the frame, for a rectifier."""
        return self.estimate.raster

    def draw_moving(self, size: tuple[int, int]) -> NDArray[np.uint8]:
        """Return an image (height, width), 255 where the corrected frame shows what does not move with the specimen."""
        return self.measured.draw_apart(size, scale=float(self.binned), zoom=self.zoom)


class LiveDrift:
    """The tracker of one node, with the service ``~/reset``.

    Parameters
    ----------
    context
        Of the node; among its parameters are :data:`DRIFT_PARAMETERS`.

    Notes
    -----
    :meth:`close` must be called before the node is destroyed.
    """

    def __init__(self, context: NodeContext) -> None:
        self._config = context.config
        self._parameters = context.parameters
        self._reporter = context.reporter
        self._load = LoadMonitor()
        self._failed = 0
        self._process = DriftProcess()
        for setting in (*_RESTARTING, _DETAIL):
            self._parameters.on_change(setting.name, lambda _value: self.reset())
        self.reset()
        self._service = context.endpoints.trigger_service("~/reset", self._on_reset)

    def _on_reset(self) -> str:
        self.reset()
        return "the next frame has zero drift"

    def reset(self) -> None:
        """Reset the drift: the next frame has zero drift."""
        values = self._parameters
        # A new tracker: the old one may be in use beside the stream.
        self._tracker = DriftTracker(
            DriftSettings(
                registration=RegistrationSettings(follow=self._config.follow),
                rekey_overlap=values["keyframe_overlap"],
                max_jump=values["max_jump"],
            )
        )
        self._is_in_process = False
        self._binned = 1
        self._origin_ns: int | None = None
        self._latest: Measurement | None = None
        self._at_work: Future[Measurement] | None = None
        self._rest_until_s = 0.0

    def close(self) -> None:
        """Stop what runs beside the stream."""
        self._process.close()

    def estimate(self, frame: StreamFrame, camera: ScanCamera) -> FrameDrift:
        """Estimate the drift at a frame; raises as :meth:`DriftTracker.update`."""
        if frame.interval_s is not None:
            self._load.add_interval(frame.interval_s)
        time_s, centre_s = self._times(frame)
        if self._latest is not None and centre_s < self._latest.predictor.time_s:
            self._reporter.info(
                "the stamps of the images went back: the drift begins at zero again"
            )
            self.reset()
            time_s, centre_s = self._times(frame)
        waits = self._waits or self._is_far(centre_s)
        self._collect(wait=waits)
        scan = self._config.scan
        if self._latest is None or waits:
            self._fetch()
            time_s, centre_s = self._times(frame)
            self._keep(measure_frame(self._tracker, *self._bin(frame, camera), time_s, scan))
        elif self._process_is_free():
            tracker = None if self._is_in_process else self._tracker
            self._is_in_process = True
            small = self._bin(frame, camera)
            self._at_work = self._process.measure(tracker, *small, time_s, scan)
        assert self._latest is not None
        return _estimate_at(self._latest, centre_s, self._binned, camera)

    def _bin(
        self, frame: StreamFrame, camera: ScanCamera
    ) -> tuple[NDArray[np.generic], ScanCamera]:
        small, fitted = bin_image(frame.image, camera, self._parameters[_DETAIL.name])
        self._binned = frame.image.shape[1] // small.shape[1]
        return small, fitted

    def _process_is_free(self) -> bool:
        rested = self._at_work is None and time.monotonic() >= self._rest_until_s
        return rested and self._process.is_ready()

    def _is_far(self, centre_s: float) -> bool:
        """Return whether a forecast would span a clock jump or a pause, which the filter does not model."""
        latest = self._latest
        return latest is not None and centre_s - latest.predictor.time_s > _FAR * self._load.turn_s

    def _times(self, frame: StreamFrame) -> tuple[float, float]:
        """Return the start and the centre of a frame's acquisition, in s since the first frame."""
        if self._origin_ns is None:
            # Seconds since 1970 as a float resolve only 0.2 us.
            self._origin_ns = frame.stamp_ns
            self._reporter.note("drift_since", f"{frame.stamp_ns * 1e-9:.9f}")
        scan = self._config.scan
        time_s = (frame.stamp_ns - self._origin_ns) * 1e-9 + self._config.start_offset_s
        return time_s, time_s + (0.0 if scan is None else scan.centre_offset_s)

    @property
    def _waits(self) -> bool:
        mode = self._parameters["drift_tracking"]
        return mode == "every_frame" or (mode == "auto" and self._load.keeps_up)

    def _collect(self, *, wait: bool) -> None:
        """Take over the result of a measurement beside the stream once it is ready."""
        if self._at_work is None or not (wait or self._at_work.done()):
            return
        done, self._at_work = self._at_work, None
        try:
            self._keep(done.result(_PATIENCE_S))
            # The pause leaves the processor to other nodes.
            self._rest_until_s = time.monotonic() + _REST * self._load.cost_s
        except NODE_ERRORS as error:
            self._complain(str(error))
        except ChildProcessEnded as error:
            self._complain(f"the process that measures it {error}")
            self.reset()
        except NoAnswer:
            self._give_up()

    def _give_up(self) -> None:
        self._complain("the process that measures it does not answer and is replaced")
        self._process.abandon()
        self.reset()

    def _fetch(self) -> None:
        """Get the tracker back into this process."""
        if not self._is_in_process:
            return
        try:
            self._tracker = self._process.fetch().result(_PATIENCE_S)
            self._is_in_process = False
        except ChildProcessEnded as error:
            self._complain(f"the process that measures it {error}")
            self.reset()
        except NoAnswer:
            self._give_up()

    def _complain(self, reason: str) -> None:
        # The frame was already published: it does not count as rejected.
        self._failed += 1
        self._reporter.note("drift_frames_failed", self._failed)
        self._reporter.warn_seldom(f"drift: {reason}")

    def _keep(self, latest: Measurement) -> None:
        self._latest = latest
        self._load.add_cost(latest.cost_s)
        self._reporter.note("drift_ms", 1e3 * self._load.cost_s)


class DriftCorrection:
    """Takes the drift out of frames, together with what their camera says of distortion, and publishes it.

    Parameters
    ----------
    context
        Of the node; among its parameters are :data:`DRIFT_PARAMETERS`.
    closing
        Gets what is to be closed before the node is destroyed.
    """

    def __init__(self, context: NodeContext, closing: ExitStack) -> None:
        self.tracking = LiveDrift(context)
        closing.callback(self.tracking.close)
        self._output = DriftOutput(context)

    def correct(
        self,
        frame: StreamFrame,
        camera: ScanCamera,
        image: ImageOutput | RectifiedOutput,
        publish: Callable[[FrameDrift | None], None],
    ) -> None:
        """Measure the drift of a frame, render the image without it, and publish both.

        A frame that was scanned while the magnification changed has no drift.

        Parameters
        ----------
        frame
            The frame.
        camera
            Its scale, and the distortion that is taken out.
        image
            Where the image is rendered.
        publish
            Publishes it; called with the drift, before that is published.
        """
        drift = None if frame.mixed else self.tracking.estimate(frame, camera)
        image.render(frame, camera, None if drift is None else drift.raster)
        publish(drift)
        if drift is not None:
            self._output.publish(drift, frame)

    def conditions(self) -> list[str]:
        """Return, in a few words, whether the drift is only predicted."""
        return [self._output.trouble] * bool(self._output.trouble)


def _estimate_at(
    latest: Measurement, centre_s: float, binned: int, camera: ScanCamera
) -> FrameDrift:
    update = latest.update
    if centre_s == update.time_s:
        return FrameDrift(update, update, binned)
    # The camera is that of the frame, of all of its pixels.
    measured_px_per_m = np.sqrt(abs(np.linalg.det(update.px_from_unit)))
    zoom = float(camera.m / binned / measured_px_per_m)
    return FrameDrift(latest.predictor.at(centre_s), update, binned, zoom)


class LoadMonitor:
    """Compares the time that a measurement takes with the interval between frames.

    Both are running means. Until there are enough frames to decide, every frame is measured.

    Examples
    --------
    >>> load = LoadMonitor()
    >>> for _ in range(20):
    ...     load.add_interval(0.005)
    ...     load.add_cost(0.010)
    >>> load.keeps_up
    False
    """

    def __init__(self) -> None:
        self._interval_s: float | None = None
        self._cost_s: float | None = None
        self._frames = 0
        self._keeps_up = True

    @property
    def keeps_up(self) -> bool:
        """Whether a measurement fits between two frames, with room for the rest of the work."""
        return self._keeps_up

    @property
    def turn_s(self) -> float:
        """Mean time from one frame that can be measured to the next, s; infinite before it is known."""
        if self._interval_s is None or self._cost_s is None:
            return math.inf
        return self._interval_s + self._cost_s

    @property
    def cost_s(self) -> float:
        """Mean time of a measurement, s; NaN before the first."""
        return math.nan if self._cost_s is None else self._cost_s

    def add_interval(self, interval_s: float) -> None:
        """Add the interval between the publications of two successive frames, s.

        Raises
        ------
        InvalidValueError
            If it is negative or not finite.
        """
        self._interval_s = _mean(self._interval_s, _check(interval_s))
        self._frames += 1
        self._decide()

    def add_cost(self, cost_s: float) -> None:
        """Add the duration of a measurement, s; raises as :meth:`add_interval`."""
        self._cost_s = _mean(self._cost_s, _check(cost_s))
        self._decide()

    def _decide(self) -> None:
        if self._interval_s is None or self._cost_s is None or self._frames < _LEAST_INTERVALS:
            return
        share = _LITTLE_ENOUGH if not self._keeps_up else _TOO_MUCH
        self._keeps_up = self._cost_s <= share * self._interval_s


def _check(seconds: float) -> float:
    if not 0.0 <= seconds < math.inf:
        raise InvalidValueError(f"a time of {seconds} s", expected="a finite number >= 0")
    return seconds


def _mean(before: float | None, now: float) -> float:
    return now if before is None else before + _WEIGHT * (now - before)
