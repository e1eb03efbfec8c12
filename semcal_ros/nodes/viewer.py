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

"""The node behind ``semcal view``: hears the stream while a page is open, and calls the services for its buttons."""

from __future__ import annotations

import math
import os
import threading
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from numpy.typing import NDArray
from rcl_interfaces.srv import SetParameters
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import EventHandler
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from sensor_msgs.msg import Image
from std_srvs.srv import SetBool, Trigger

from semcal_ros.bridge.compressed import decoded_image
from semcal_ros.bridge.drift import UNKNOWN_VARIANCE
from semcal_ros.bridge.fields import stamp_ns_from_msg
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.corners import find_lattice
from semcal_ros.core.errors import InvalidValueError, MessageError, Rejection
from semcal_ros.core.wording import counted
from semcal_ros.files.images.databar import DatabarCutter
from semcal_ros.middleware import message_class
from semcal_ros.nodes.common.base import SemNode
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.endpoints import Endpoints, read_stamp_ns, unpack
from semcal_ros.nodes.common.latest_worker import LatestWorker
from semcal_ros.nodes.common.parameters import (
    CALIBRATION,
    REPLAYED_CALIBRATION,
    ParameterDeclaration,
)
from semcal_ros.nodes.common.qos import latched, stream_output
from semcal_ros.nodes.common.reporter import NODE_ERRORS
from semcal_ros.nodes.common.run import run_node
from semcal_ros.nodes.common.subscription import AdaptiveSubscription, published_ns
from semcal_ros.nodes.frames.calibration_input import CalibrationInput
from semcal_ros.nodes.frames.held_values import ConditionsInput, MagnificationInput
from semcal_ros.nodes.frames.overlay import corner_overlay
from semcal_ros.viewer.pictures import Outlines, outline
from semcal_ros.viewer.plain_words import NodeReport, describe_rates, explain
from semcal_ros.viewer.server import PageServer
from semcal_ros.viewer.source import CalibrationPanel, DriftPanel, Status, View
from semcal_ros.viewer.state import (
    DriftTrace,
    describe_acquisition,
    describe_coverage,
    describe_magnification,
    describe_run,
    drift_in_pixels,
)

_PARAMETERS = (
    CALIBRATION,
    REPLAYED_CALIBRATION,
    ParameterDeclaration("host", "localhost", "Address to listen on.", fixed=True),
    ParameterDeclaration("port", 8060, "Port; 0 takes a free one.", "", 0, 65535, fixed=True),
    ParameterDeclaration(
        "token", "", "What must be brought to another host than localhost.", fixed=True
    ),
)
# As often as the server sends pictures where there is time; see there. Each waking of the executor costs more than the
# pictures do: it builds its wait set of a hundred parts anew.
_POLL_S = 0.2
# How often the names of nodes and services are asked for, which takes milliseconds.
_GRAPH_S = 2.0
_STATUS_S = 0.4
# A service answers at once, but for those that compute.
_ANSWER_S = 20.0
# Until a client and a service have found each other both ways.
_MEETING_S = 1.5
_COMPUTE_S = 600.0
_CALIBRATION_ACTIONS = {
    "add_view": "add_view",
    "calibrate": "calibrate_start",
    "acquire": "acquire",
    "cancel": "cancel",
    "check": "check",
    "save": "save",
    "clear": "clear",
}
_SLOW = ("add_view", "check")
# Parameters of the calibration server that the values of `acquire` are, in their order.
_GOAL = ("lowest_magnification", "highest_magnification", "target")
# Corners are looked for once a second, and never for more than a fourth of the time of one processor; in pictures that
# are no wider than this, which is more than the page shows.
_CORNERS_S, _CORNERS_SHARE, _CORNERS_PX = 1.0, 0.25, 1024
_SERVER = "calibration_server"
# A tenth of the processor against a node that wants it too.
_NICE = 10

# Raw images that wait for their corrected ones: registration takes some frames in a fast stream.
_RAW_DEPTH = 4
_KEPT_RAW = 6
# And no more memory than this, which is four images of 4096 x 4096.
_KEPT_BYTES = 64 << 20
# A corrected image that is older than the newest raw one by more belongs to a corrector that has stopped.
_STALE_S = 3.0
# For so long events are waited for; the executor needs some milliseconds to begin.
_EVENTS_S = 0.02


@dataclass(frozen=True, order=True)
class _Sought:
    """A picture in which corners are looked for; the order is that of the frames."""

    number: int
    image: NDArray[Any] = field(compare=False)


@dataclass(frozen=True)
class _Corners:
    """A picture with the corners that were found, what is to be said of it, and how long that took."""

    number: int
    picture: NDArray[Any]
    text: str
    seconds: float


def _find_corners(sought: _Sought) -> _Corners:
    started_s = time.monotonic()
    image = sought.image
    grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    height, width = grey.shape
    if width > _CORNERS_PX:
        size = _CORNERS_PX, max(1, round(height * _CORNERS_PX / width))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    refused, xy = "", np.empty((0, 2))
    try:
        found = find_lattice(grey)
        if isinstance(found, Rejection):
            refused = found.reason
        else:
            xy = found.xy
    except NODE_ERRORS as error:
        refused = " ".join(str(error).split())
    text = f"no grid: {refused}" if refused else counted(len(xy), "corner")
    picture = corner_overlay(grey, xy)
    return _Corners(sought.number, picture, text, time.monotonic() - started_s)


class PolledGroup(MutuallyExclusiveCallbackGroup):
    """Subscriptions whose messages wait until they are taken; the executor leaves them alone.

    An executor that woke for every image would cost a part of a core in a fast stream, for pictures that nobody sees.
    Events of the subscriptions, such as of their quality of service, are handled just after :meth:`open_events`. At
    other times they must not be waited for either: Fast DDS signals a message and an event by one condition, so that
    with messages waiting the executor would not sleep at all.
    """

    def __init__(self) -> None:
        super().__init__()
        self._open_until_s = -math.inf

    def open_events(self) -> None:
        """Let events be handled now; call it when the messages have been taken."""
        self._open_until_s = time.monotonic() + _EVENTS_S

    def can_execute(self, entity: Any) -> bool:
        """Extend the base class: never for a subscription, seldom for an event."""
        if isinstance(entity, Subscription):
            return False
        if isinstance(entity, EventHandler) and time.monotonic() > self._open_until_s:
            return False
        return super().can_execute(entity)


@dataclass(frozen=True)
class ViewedFrame:
    """The newest pictures of one frame.

    Attributes
    ----------
    stamp_ns, sent_ns
        Its stamp, and when the raw image was published (the corrected one, where that is all there is).
    pictures
        ``raw``, ``corrected`` or both; without data bar.
    moving
        Outlines of what does not move with the specimen, in the corrected picture.
    """

    stamp_ns: int
    sent_ns: int
    pictures: dict[str, NDArray[Any]]
    moving: Outlines = ()


@dataclass(frozen=True)
class _Waiting:
    """A serialized image that has arrived."""

    stamp_ns: int
    sent_ns: int
    data: bytes


class ViewedImages:
    """Takes the newest raw and corrected image when asked, and only then unpacks them.

    Parameters
    ----------
    context
        Of the node.
    group
        Of the subscriptions.
    """

    def __init__(self, context: NodeContext, group: PolledGroup) -> None:
        config, endpoints = context.config, context.endpoints
        self._databar = DatabarCutter(config.image.databar_rows)
        self._raw_type = message_class(config.image.type)
        self._raw = self._subscribe(
            endpoints, self._raw_type, config.image.topic, stream_output(_RAW_DEPTH), group
        )
        self._corrected = {
            topic: self._subscribe(endpoints, Image, topic, stream_output(1), group)
            for topic in ("image_rect", "image_stabilized")
        }
        self._moving = {
            node: self._subscribe(endpoints, Image, f"{node}/moving", stream_output(1), group)
            for node in ("stream_corrector", "drift_compensator")
        }
        self._mask: _Waiting | None = None
        self._masked_s = 0.0
        self._kept: deque[_Waiting] = deque()
        self._newest: _Waiting | None = None
        self._seen_s = 0.0
        self._shown: tuple[int, int] | None = None

    @staticmethod
    def _subscribe(
        endpoints: Endpoints, kind: Any, topic: str, profile: QoSProfile, group: PolledGroup
    ) -> AdaptiveSubscription:
        return endpoints.subscribe(kind, topic, lambda *_: None, profile, group, raw=True)

    @property
    def subscriptions(self) -> list[AdaptiveSubscription]:
        """What is to be paused while nobody looks."""
        return [self._raw, *self._corrected.values(), *self._moving.values()]

    def publishers(self, picture: str) -> list[str]:
        """Return the full names of the nodes that publish the raw or the corrected images."""
        chosen = [self._raw] if picture == "raw" else list(self._corrected.values())
        return [name for one in chosen for name in one.publishers() if name]

    def forget(self) -> None:
        """Forget all images."""
        self._kept.clear()
        self._newest = self._shown = self._mask = None

    def take(self) -> ViewedFrame | None:
        """Return the newest frame, or None if it is the same as before.

        Raises
        ------
        SemcalError
            An image cannot be unpacked.
        """
        self._take_raw()
        now_s = time.monotonic()
        for subscription in self._corrected.values():
            while (taken := subscription.take()) is not None:
                self._newest, self._seen_s = _waiting(taken), now_s
                break
        for subscription in self._moving.values():
            while (taken := subscription.take()) is not None:
                self._mask, self._masked_s = _waiting(taken), now_s
        corrected = self._newest if now_s - self._seen_s < _STALE_S else None
        raw = self._raw_of(corrected)
        if raw is None and corrected is None:
            return None
        numbers = (
            0 if raw is None else raw.stamp_ns,
            0 if corrected is None else corrected.stamp_ns,
        )
        if numbers == self._shown:
            return None
        self._shown = numbers
        pictures = {}
        if raw is not None:
            image = self._unpack(raw, self._raw_type)
            cut = self._databar.cut(image)
            pictures["raw"] = image if cut is None else cut
        if corrected is not None:
            pictures["corrected"] = self._unpack(corrected, Image)
        first = raw or corrected
        assert first is not None
        moving: Outlines = ()
        if corrected and self._mask and now_s - self._masked_s < _STALE_S:
            # The mask follows its picture; that of the frame before is as good for the eye.
            moving = outline(self._unpack(self._mask, Image))
        return ViewedFrame((corrected or first).stamp_ns, first.sent_ns, pictures, moving)

    def _take_raw(self) -> None:
        while (taken := self._raw.take()) is not None:
            self._kept.append(_waiting(taken))
        while len(self._kept) > _KEPT_RAW or (
            len(self._kept) > 1 and sum(len(one.data) for one in self._kept) > _KEPT_BYTES
        ):
            self._kept.popleft()

    def _raw_of(self, corrected: _Waiting | None) -> _Waiting | None:
        """The raw image of a corrected one if it is still there, else the newest."""
        if not self._kept:
            return None
        if corrected is not None:
            for one in self._kept:
                if one.stamp_ns == corrected.stamp_ns:
                    return one
        return self._kept[-1]

    @staticmethod
    def _unpack(waiting: _Waiting, kind: Any) -> NDArray[Any]:
        image, encoding = decoded_image(unpack(waiting.data, kind))
        # The page draws in OpenCV's order of the channels.
        return image[..., ::-1] if encoding.startswith("rgb") else image


def _waiting(taken: tuple[Any, Any]) -> _Waiting:
    data, info = taken
    return _Waiting(read_stamp_ns(data), published_ns(info), data)


class Viewer(SemNode):
    """A page in the browser; see :mod:`semcal_ros.viewer`. Nothing is subscribed while no page is open, but for
    the magnification, the calibration and the conditions, which come seldom.
    """

    def __init__(self) -> None:
        super().__init__("viewer", _PARAMETERS)
        self._lock = threading.Lock()
        self._pages = 0
        self._open = False
        self._view: View | None = None
        self._number = 0
        self._camera: tuple[object, ScanCamera] | None = None
        self._trace = DriftTrace()
        self._speed: tuple[float, float] | None = None
        self._reports: dict[str, tuple[float, NodeReport]] = {}
        self._progress: tuple[str, str, dict[str, str]] | None = None
        self._corners: _Corners | None = None
        self._corners_s = 0.0
        self._finder = LatestWorker(self.endpoints.guard, _find_corners, self._on_corners)
        self._offered: dict[str, tuple[str, Any]] = {}
        # Clients, and when they were made.
        self._callers: dict[str, tuple[Any, float]] = {}
        self._wanted: list[tuple[str, Any, Any, Future[Any]]] = []
        self._graph_s = self._status_s = 0.0
        self._magnification: float | None = None
        self.calibration = CalibrationInput(self.node_context)
        self._magnifications = MagnificationInput(self.node_context)
        self._conditions = ConditionsInput(self.node_context)
        self._polled = group = PolledGroup()
        self._images = ViewedImages(self.node_context, group)
        listen = [
            (PoseWithCovarianceStamped, "drift", stream_output(100), self._on_drift),
            (TwistWithCovarianceStamped, "drift_velocity", stream_output(1), self._on_velocity),
            (DiagnosticArray, "/diagnostics", stream_output(100), self._on_diagnostics),
            (DiagnosticStatus, f"{_SERVER}/progress", latched(), self._on_progress),
        ]
        self._values = [
            self.endpoints.subscribe(kind, topic, handler, profile, group)
            for kind, topic, profile, handler in listen
        ]
        for subscription in self._streams:
            subscription.pause()
        self._changed = self.endpoints.guard(self._on_change)
        # Ticks only while a page is open.
        self._timer = self.create_timer(
            _POLL_S, self._poll, clock=Clock(clock_type=ClockType.STEADY_TIME), autostart=False
        )
        self._described = self._make_status(())
        self.server = PageServer(
            self, self.parameters["host"], self.parameters["port"], self.parameters["token"]
        )
        self.closing.callback(self.server.stop)
        self.server.start()

    def introduction(self) -> list[str]:
        """Extend the base class: also where the page is."""
        return ["shows the stream in the browser", f"open {self.server.address}"]

    def idle(self) -> bool:
        """Override the base class: nothing is late while nobody looks."""
        return True

    @property
    def _streams(self) -> list[Any]:
        return [*self._images.subscriptions, *self._values]

    # -- called by the server, in its thread -----------------------------------------------------------

    def watch(self, pages: int) -> None:
        """Subscribe with the first page, and unsubscribe with the last."""
        self._pages = pages
        self._changed.trigger()

    def newest(self) -> View | None:
        """Return the newest frame."""
        return self._view

    def overlay(self) -> NDArray[Any] | None:
        """Return the newest picture with corners."""
        corners = self._corners
        return None if corners is None else corners.picture

    def describe(self) -> Status:
        """Return the state at the last tick."""
        return self._described

    def act(self, action: str, value: float | tuple[float, ...] | None) -> str:
        """Call the service of an action, and return its answer."""
        found = self._offered.get(action)
        if found is None:
            raise InvalidValueError(
                f"nobody offers {action!r}",
                expected="a node of the suite that does",
                do="start it, or look at the namespace",
            )
        service, kind = found
        if action == "acquire" and isinstance(value, tuple):
            self._set_goal(service.rpartition("/")[0], value)
        request = SetBool.Request(data=True) if kind is SetBool else Trigger.Request()
        response = self._ask(service, kind, request, _COMPUTE_S if action in _SLOW else _ANSWER_S)
        if not response.success:
            raise InvalidValueError(response.message or f"{service} refused")
        return response.message or f"{service}: done"

    def _set_goal(self, node: str, values: tuple[float, ...]) -> None:
        """Tell the calibration server what to acquire."""
        if len(values) != len(_GOAL):
            raise InvalidValueError(
                counted(len(values), "value"), expected="two magnifications and a target"
            )
        numbers = zip(_GOAL, values, strict=True)
        parameters = [Parameter(name, value=float(v)).to_parameter_msg() for name, v in numbers]
        request = SetParameters.Request(parameters=parameters)
        answer = self._ask(f"{node}/set_parameters", SetParameters, request, _ANSWER_S)
        for result in answer.results:
            if not result.successful:
                raise InvalidValueError(result.reason)

    def _ask(self, service: str, kind: Any, request: Any, limit_s: float) -> Any:
        answer: Future[Any] = Future()
        with self._lock:
            self._wanted.append((service, kind, request, answer))
        self._changed.trigger()
        try:
            return answer.result(limit_s)
        except TimeoutError as error:
            raise InvalidValueError(
                f"no answer from {service}", do="look whether its node still runs"
            ) from error

    # -- callbacks -----------------------------------------------------------------------------------

    def _on_change(self) -> None:
        """Follow the number of pages, and call the services that are wanted."""
        wanted_open = self._pages > 0
        if wanted_open != self._open:
            self._open = wanted_open
            for subscription in self._streams:
                if wanted_open:
                    subscription.resume()
                else:
                    subscription.pause()
            if wanted_open:
                self._images.forget()
                self._graph_s = 0.0
                self._reports.clear()
                self._timer.reset()
            else:
                self._timer.cancel()
        with self._lock:
            wanted, self._wanted = self._wanted, []
        for service, kind, request, answer in wanted:
            self._call(service, kind, request, answer)

    def _call(self, service: str, kind: Any, request: Any, answer: Future[Any]) -> None:
        client, made_s = self._caller(service, kind)
        threading.Thread(
            target=self._call_when_found, args=(client, made_s, request, answer), daemon=True
        ).start()

    def _caller(self, service: str, kind: Any) -> tuple[Any, float]:
        if service not in self._callers:
            self._callers[service] = self.create_client(kind, service), time.monotonic()
        return self._callers[service]

    @staticmethod
    def _call_when_found(client: Any, made_s: float, request: Any, answer: Future[Any]) -> None:
        # A service that has not found this client yet answers to nobody, and there is no asking whether it has.
        time.sleep(max(0.0, made_s + _MEETING_S - time.monotonic()))
        if client.wait_for_service(timeout_sec=5.0):
            client.call_async(request).add_done_callback(
                lambda done: answer.set_result(done.result())
            )

    def _poll(self) -> None:
        try:
            for subscription in self._values:
                subscription.take_waiting()
            frame = self._images.take()
            if frame is not None:
                self._show(frame)
        except NODE_ERRORS as error:
            self.reporter.reject(error)
        self._polled.open_events()
        now_s = time.monotonic()
        self._timer.timer_period_ns = round(1e9 * max(_POLL_S, self.server.picture_interval_s))
        self._look_for_corners(now_s)
        if now_s - self._graph_s > _GRAPH_S:
            self._graph_s = now_s
            self._look_for_services()
        if now_s - self._status_s > _STATUS_S:
            self._status_s = now_s
            self._described = self._make_status(
                tuple(replace(r, age_s=now_s - at) for at, r in self._reports.values())
            )

    def _show(self, frame: ViewedFrame) -> None:
        image = frame.pictures.get("corrected", frame.pictures.get("raw"))
        assert image is not None
        height, width = image.shape[:2]
        config = self.calibration.config
        g = self._magnifications.at(frame.stamp_ns, frame.sent_ns, width, config)
        self._magnification = g
        camera = None if g is None else self._camera_at(g, width, height)
        drift = self._trace.last
        drift_px = None
        if camera is not None and drift is not None:
            drift_px = drift_in_pixels(camera, drift[1:3])
        self._number += 1
        notes: dict[str, object] = dict(self._conditions.current)
        if drift is not None:
            notes.update(drift_x_m=drift[1], drift_y_m=drift[2], drift_sigma_m=drift[3])
        notes["config"] = self.config.name
        self._view = View(
            self._number,
            frame.stamp_ns,
            frame.pictures,
            camera,
            self.calibration.current is not None,
            drift_px,
            notes=notes,
            moving=frame.moving,
        )

    def _camera_at(self, g: float, width: int, height: int) -> ScanCamera | None:
        key = (self.calibration.current, g, width, height)
        if self._camera is None or self._camera[0] != key:
            camera = self.calibration.camera(g, width, height)
            if camera is None:
                camera = ScanCamera.nominal(g, width, height, self.config.display_width_m)
            self._camera = key, camera
        return self._camera[1]

    def _on_drift(self, message: Any, _info: Any) -> None:
        position, covariance = message.pose.pose.position, message.pose.covariance
        if not np.all(np.isfinite([position.x, position.y, covariance[0], covariance[7]])):
            raise MessageError("a drift that is not finite", expected="metres and their variances")
        sigma_m = math.sqrt(max(covariance[0], covariance[7], 0.0))
        self._trace.add(stamp_ns_from_msg(message), position.x, position.y, sigma_m, self._speed)

    def _on_velocity(self, message: Any, _info: Any) -> None:
        linear, covariance = message.twist.twist.linear, message.twist.covariance
        variance = max(covariance[0], covariance[7], 0.0)
        speed = math.hypot(linear.x, linear.y)
        known = variance < UNKNOWN_VARIANCE and math.isfinite(speed)
        self._speed = (speed, math.sqrt(variance)) if known else None

    def _on_diagnostics(self, message: Any, _info: Any) -> None:
        own = self.get_namespace().rstrip("/") + "/"
        for status in message.status:
            name, _, kind = status.name.partition(": ")
            if not name.startswith(own) or kind != "stream" or name == own + self.get_name():
                continue
            values = {pair.key: pair.value for pair in status.values}
            level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
            report = NodeReport(name.removeprefix(own), level, status.message, values)
            self._reports[name] = time.monotonic(), report

    def _on_progress(self, message: Any, _info: Any) -> None:
        level = message.level[0] if isinstance(message.level, bytes) else int(message.level)
        values = {pair.key: pair.value for pair in message.values}
        self._progress = message.message, "ok" if level == 0 else "warn", values

    def _look_for_corners(self, now_s: float) -> None:
        """Look for the grid in the newest raw picture, in a thread beside, while a calibration is being made."""
        view = self._view
        if view is None or now_s < self._corners_s or not self._makes_calibration():
            return
        before = self._corners
        if "raw" not in view.pictures or (before is not None and before.number == view.number):
            return
        # Until the result is there.
        self._corners_s = math.inf
        self._finder.submit(_Sought(view.number, view.pictures["raw"]))

    def _on_corners(self, corners: _Corners) -> None:
        self._corners = corners
        wait_s = max(_CORNERS_S - corners.seconds, corners.seconds * (1.0 / _CORNERS_SHARE - 1.0))
        self._corners_s = time.monotonic() + wait_s

    def _makes_calibration(self) -> bool:
        return self._progress is not None and "add_view" in self._offered

    def _look_for_services(self) -> None:
        """Find out who offers what the buttons do: the nodes behind the images, and the calibration server."""
        offered = {
            name: kinds[0] for name, kinds in self.get_service_names_and_types() if len(kinds) == 1
        }
        kinds = {"std_srvs/srv/Trigger": Trigger, "std_srvs/srv/SetBool": SetBool}
        found: dict[str, tuple[str, Any]] = {}

        def offer(action: str, names: Sequence[str]) -> None:
            for name in names:
                if offered.get(name) in kinds and action not in found:
                    found[action] = name, kinds[offered[name]]
                    self._caller(*found[action])

        sources = self._images.publishers("raw")
        offer("start", [f"{node}/{verb}" for node in sources for verb in ("start", "resume")])
        offer("stop", [f"{node}/{verb}" for node in sources for verb in ("stop", "pause")])
        offer("reset", [f"{node}/reset" for node in self._images.publishers("corrected")])
        namespace = self.get_namespace().rstrip("/")
        for action, service in _CALIBRATION_ACTIONS.items():
            offer(action, [f"{namespace}/{_SERVER}/{service}"])
        self._offered = found

    # -- what the page shows -----------------------------------------------------------------------------

    def _make_status(self, reports: tuple[NodeReport, ...]) -> Status:
        current = self.calibration.current
        return Status(
            title=f"{self.config.name}, {self.get_namespace()}",
            kind="live",
            magnification=describe_magnification(self._magnification, current),
            rates=describe_rates(reports),
            notes=explain(reports),
            drift=self._describe_drift(),
            actions=tuple(self._offered),
            calibration=self._describe_calibration(),
        )

    def _describe_drift(self) -> DriftPanel:
        return self._trace.panel("no drift is published; start stream_corrector")

    def _describe_calibration(self) -> CalibrationPanel | None:
        if self._progress is None or not self._makes_calibration():
            return None
        answer, level, values = self._progress
        corners = self._corners
        return CalibrationPanel(
            answer,
            level,
            describe_coverage(values),
            describe_run(values),
            0 if corners is None else corners.number,
            "" if corners is None else corners.text,
            describe_acquisition(values),
        )


def give_way() -> None:
    """Lower the priority of this process: pictures for a person wait for the stream, and not the other way round."""
    os.nice(_NICE)


def run_viewer(args: Sequence[str] | None = None) -> int:
    """Run the node, which is no executable of its own: ``semcal view`` is its command."""
    give_way()
    return run_node(Viewer, args)
