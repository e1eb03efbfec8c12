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

"""The calibration in force, the latest from a file or from the topic; and whether a magnification is in its range."""

from __future__ import annotations

import hashlib
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from std_msgs.msg import String

from semcal_ros.bridge.calibration import (
    ScaleWarnings,
    calibration_text_from_message,
    fill_calibration_text,
    pick_scale_warnings,
)
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import CalibrationFileError, SemcalError
from semcal_ros.files.calibration_file import read_calibration_text
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.latest_worker import LatestWorker
from semcal_ros.nodes.common.parameters import (
    CALIBRATION,
    REPLAYED_CALIBRATION,
    ParameterDeclaration,
)
from semcal_ros.nodes.common.qos import value_input
from semcal_ros.nodes.common.reporter import Reporter
from semcal_ros.nodes.common.subscription import MessageInfo, published_ns

_TOPIC = "topic"
# Largest accepted difference between the middleware's clock and that of this process.
_CLOCK_STEP_NS = 1_000_000
# More than can be in transit at once.
_KEPT_DIGESTS = 16
# Several nodes publish calibrations, perhaps including this one: with a depth of 1, its own message that comes back
# would displace another node's message that has not been taken yet.
_QUEUE = 10
# Names that the players of recordings have: that of this suite, and that of `ros2 bag play`.
_PLAYERS = ("bag_player", "rosbag2_player")

OUT_OF_RANGE = ParameterDeclaration(
    "out_of_range",
    "flag",
    "What is said of the camera at magnifications that the calibration does not cover, where images are rectified"
    " by its continuation. flag: camera_info and projection_stamped are zero, as without a calibration."
    " extrapolate: they are those of that continuation.",
    choices=("flag", "extrapolate"),
)


def calibration_digest(text: str) -> str:
    """Return the first 12 hexadecimal digits of the SHA-256 of a calibration's text in UTF-8."""
    return hashlib.sha256(text.encode()).hexdigest()[:12]


@dataclass(frozen=True)
class _Loaded:
    """A calibration with its text, its source, and when it came into force, ns; 0 for the file given at start.

    ``replayed``: it came while a recording was played on the topic.
    """

    calibration: Calibration
    text: str
    source: str
    since_ns: int
    replayed: bool = False


@dataclass(frozen=True, order=True)
class _Arrived:
    """A text from the topic, not yet parsed; ordered by publication time."""

    since_ns: int
    text: str


def _load(text: str, name: str, source: str, since_ns: int) -> _Loaded:
    return _Loaded(Calibration.loads(text, source=name), text, source, since_ns)


def _parse(arrived: _Arrived) -> _Loaded | SemcalError:
    try:
        return _load(arrived.text, "topic calibration", _TOPIC, arrived.since_ns)
    except SemcalError as error:
        return error
    except (MemoryError, RecursionError) as error:
        return CalibrationFileError(f"topic calibration: {type(error).__name__}")


def report_scale_warnings(reporter: Reporter, calibration: Calibration) -> ScaleWarnings:
    """Log the warnings about nm per pixel, show them among the values of the node, and return them."""
    warnings = pick_scale_warnings(calibration.warnings)
    if warnings.count:
        reporter.warn(warnings.summary)
        reporter.note("calibration_warnings", warnings.details)
    else:
        reporter.forget("calibration_warnings")
    return warnings


class CalibrationInput:
    """Holds the last good calibration; a bad one is refused, counted, and leaves the old one in force.

    The latest wins: a message counts from its publication, a file from when it was named or reloaded. The file
    given at start is older than anything on the topic, so that a restarted node returns to the calibration in force.

    While a recording is played on the topic, nobody can tell its old calibration, which is published now, from one
    that was made now. It then only fills in, unless :data:`~semcal_ros.nodes.common.parameters.REPLAYED_CALIBRATION`
    says otherwise.

    Texts are parsed beside the stream and take effect between two frames.

    Parameters
    ----------
    context
        Of the node; among its parameters are :data:`~semcal_ros.nodes.common.parameters.CALIBRATION` and
        :data:`~semcal_ros.nodes.common.parameters.REPLAYED_CALIBRATION`.
    on_change
        Called after each change; not for the file given at start.

    Raises
    ------
    CalibrationFileError
        The file given at start cannot be used.
    """

    def __init__(
        self, context: NodeContext, *, on_change: Callable[[], None] = lambda: None
    ) -> None:
        parameters, endpoints = context.parameters, context.endpoints
        self._parameters = parameters
        self._reporter = context.reporter
        self._on_change = on_change
        self._checked: tuple[str, _Loaded] | None = None
        self._loaded: _Loaded | None = None
        self._warnings = ScaleWarnings()
        self._node_config = self._config = context.config
        self._published_digests: deque[tuple[int, int, str]] = deque(maxlen=_KEPT_DIGESTS)
        self._parser = LatestWorker(endpoints.guard, _parse, self._on_parsed)
        path = parameters[CALIBRATION.name]
        if path:
            self._take_over(replace(self._read(path), since_ns=0))
        parameters.on_change(CALIBRATION.name, self._apply_file, self._check_file)
        self._refused = ""
        self._topic = endpoints.subscribe(
            String, "calibration", self._on_message, value_input(_QUEUE)
        )

    @property
    def current(self) -> Calibration | None:
        """The calibration in force, or None while there is none."""
        return None if self._loaded is None else self._loaded.calibration

    @property
    def config(self) -> MicroscopeConfig:
        """The node's configuration with the display width of the calibration in force."""
        return self._config

    @property
    def introduction(self) -> str:
        """What is known about the calibration, in a few words."""
        return (
            "no calibration yet" if self._loaded is None else f"calibration {self._loaded.source}"
        )

    def conditions(self) -> list[str]:
        """Return what the diagnostics should say about the calibration in force, a few words each."""
        if self._loaded is None:
            return ["uncalibrated"]
        doubts = [self._warnings.summary] if self._warnings.count else []
        return doubts + [self._refused] * bool(self._refused)

    @property
    def has_published(self) -> bool:
        """Whether :meth:`publish` has published anything."""
        return bool(self._published_digests)

    def camera(self, magnification: float, width: int, height: int) -> ScanCamera | None:
        """Return the camera for frames of this size, or None without a calibration; raises as ``Calibration.at``."""
        if self.current is None:
            return None
        return self.current.at(magnification).resized(width, height)

    def publish(self, publisher: Any) -> None:
        """Publish the text of the calibration in force on the topic that this object listens to."""
        if self._loaded is None:
            return
        message = String()
        fill_calibration_text(message, self._loaded.text)
        started_ns = time.time_ns() - _CLOCK_STEP_NS
        publisher.publish(message)
        ended_ns = time.time_ns() + _CLOCK_STEP_NS
        self._published_digests.append(
            (started_ns, ended_ns, calibration_digest(self._loaded.text))
        )

    # -- files -------------------------------------------------------------------------------------

    def load(self, path: str) -> None:
        """Take the calibration from a file; raises :class:`SemcalError` and keeps the old one if it is bad."""
        self._install(self._read(path))

    def _read(self, path: str) -> _Loaded:
        text = read_calibration_text(self._parameters.allowed_path(path))
        return _load(text, path, path, time.time_ns())

    def _check_file(self, path: str) -> None:
        self._checked = (path, self._read(path)) if path else None

    def _apply_file(self, path: str) -> None:
        if self._checked is not None and self._checked[0] == path:
            loaded = replace(self._checked[1], since_ns=time.time_ns())
            if self._loaded is not None and loaded.text == self._loaded.text:
                # Nothing changes for the images; a drift must go on.
                self._loaded = loaded
                self._reporter.note("calibration", loaded.source)
            else:
                self._install(loaded)
        self._checked = None

    # -- topic -------------------------------------------------------------------------------------

    def _is_older(self, since_ns: int) -> bool:
        # Two latched publishers may answer a late joiner in any order.
        return self._loaded is not None and since_ns < self._loaded.since_ns

    def _is_from_here(self, text: str, since_ns: int) -> bool:
        # A node that republishes what it takes over must not take over its own messages: with two calibrations
        # in transit it would publish them in turns for ever.
        return any(
            start <= since_ns <= end and calibration_digest(text) == digest
            for start, end, digest in self._published_digests
        )

    def _is_same(self, text: str, since_ns: int) -> bool:
        """Return whether the text is already in force; it then counts from now on and the drift is not reset."""
        if self._loaded is None or text != self._loaded.text:
            return False
        self._loaded = replace(self._loaded, since_ns=since_ns)
        return True

    def _on_message(self, message: Any, info: MessageInfo) -> None:
        since_ns = published_ns(info)
        try:
            text = calibration_text_from_message(message)
        except SemcalError as error:
            self._reporter.reject(error)
            return
        if self._is_older(since_ns) or self._is_from_here(text, since_ns):
            return
        if not self._is_same(text, since_ns):
            self._parser.submit(_Arrived(since_ns, text))

    def _on_parsed(self, result: _Loaded | SemcalError) -> None:
        if isinstance(result, SemcalError):
            self._reporter.reject(result)
        elif not (self._is_older(result.since_ns) or self._is_same(result.text, result.since_ns)):
            players = [p for p in self._topic.publishers() if p.rpartition("/")[2] in _PLAYERS]
            if players and self._refuses_replayed(result, players[0]):
                return
            self._install(replace(result, replayed=bool(players)))

    def _refuses_replayed(self, loaded: _Loaded, player: str) -> bool:
        """Refuse, with one warning, a calibration that is perhaps of a recording, where another one is in force."""
        current = self._loaded
        taken = self._parameters[REPLAYED_CALIBRATION.name] == "take"
        if taken or current is None or current.replayed:
            return False
        digest = calibration_digest(loaded.text)
        self._refused = f"calibration {digest} not used while {player} plays"
        self._reporter.warn(
            f"calibration {digest} on the topic is not used: {player} plays a recording there, and"
            f" {current.source} is in force; to use it, set {REPLAYED_CALIBRATION.name} to take and"
            " play again, or set the parameter calibration"
        )
        return True

    def _install(self, loaded: _Loaded) -> None:
        self._take_over(loaded)
        self._on_change()

    def _take_over(self, loaded: _Loaded) -> None:
        calibration, source = loaded.calibration, loaded.source
        displaced, self._loaded, self._refused = self._loaded, loaded, ""
        self._config = replace(self._node_config, display_width_m=calibration.display_width_m)
        low, high = calibration.magnification_range
        digest = calibration_digest(loaded.text)
        made = calibration.provenance.describe()
        text = f"calibration from {source}: {calibration.method}, {low:g}x to {high:g}x (made: {made}), {digest}"
        if displaced is not None and source == _TOPIC != displaced.source:
            self._reporter.warn(f"{text}; it displaces {displaced.source}")
        else:
            self._reporter.info(text)
        self._reporter.note("calibration", source)
        self._reporter.note("calibration_digest", digest)
        self._warnings = report_scale_warnings(self._reporter, calibration)


class RangeWatch:
    """Notes ``in_calibrated_range``, and logs when the range is left and entered again.

    Parameters
    ----------
    reporter
        Where to note and to log.
    """

    def __init__(self, reporter: Reporter) -> None:
        self._reporter = reporter
        self.is_outside = False

    def check(
        self, calibration: Calibration | None, camera: ScanCamera | None, magnification: float
    ) -> None:
        """Take the camera in use at a magnification; both are None without a calibration."""
        outside = camera is not None and not camera.in_range
        self._reporter.note("in_calibrated_range", camera is not None and not outside)
        if outside == self.is_outside or calibration is None:
            return
        self.is_outside = outside
        low, high = calibration.magnification_range
        covered = f"the calibrated range {low:g}x to {high:g}x"
        if outside:
            self._reporter.warn(f"{magnification:g}x is outside of {covered}")
        else:
            self._reporter.info(f"{magnification:g}x is inside of {covered} again")
