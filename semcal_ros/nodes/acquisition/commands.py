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

"""Asks a microscope to move, over the topics of ``microscope`` or ``virtual_sem``, and waits for its answers."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.exceptions import NameValidationException
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from semcal_ros.config.config import StageConfig
from semcal_ros.core.errors import InvalidValueError, MicroscopeError
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.qos import latched

# Stages turn by some degrees per second; nothing that is asked for here is farther than a full turn.
_ANSWER_S = 120.0
# The middleware finds a node that runs within a second or two.
_FIND_S = 10.0
_POLL_S = 0.05
# A little less than the longest way that `microscope` does in one command by default.
_STEPS_RAD = {"tilt": 0.3, "rotation": 0.75, "scan_rotation": math.inf}


class MicroscopeCommands:
    """One command at a time; each returns once the microscope has done it.

    Parameters
    ----------
    context
        Of the node that asks; its configuration says how the joints are called in messages.
    name
        Name of the node that is asked.
    still_wanted
        Asked while waiting; if it returns False, the wait ends with an error.

    Raises
    ------
    InvalidValueError
        If no node can have that name.
    """

    def __init__(self, context: NodeContext, name: str, still_wanted: Callable[[], bool]) -> None:
        endpoints = context.endpoints
        self._name = name
        self._stage = context.config.stage or StageConfig()
        self._still_wanted = still_wanted
        self._changed = threading.Condition()
        self._answer: dict[str, str] = {}
        self._text = ""
        try:
            self._magnification = endpoints.stream_publisher(Float64, f"{name}/set_magnification")
        except NameValidationException as error:
            raise InvalidValueError(
                f"microscope {name!r}", expected="the name of a node, such as virtual_sem"
            ) from error
        self._move = endpoints.stream_publisher(JointState, f"{name}/move_stage")
        group = MutuallyExclusiveCallbackGroup()
        self._motion = endpoints.subscribe(
            DiagnosticStatus, f"{name}/motion", self._on_motion, latched(), group
        )
        self._place: tuple[float, float] | None = None
        self._joints = endpoints.subscribe(
            JointState, self._stage.topic, self._on_stage, latched(), group
        )

    def place(self) -> tuple[float, float] | None:
        """Return x and y of the stage, m; None for a stage that does not tell them."""
        return self._place

    def set_magnification(self, magnification: float) -> None:
        """Set the magnification; raises :class:`MicroscopeError` if that is refused or fails."""
        self._ask(
            self._magnification,
            Float64(data=magnification),
            "set_magnification",
            f"magnification {magnification:g}",
        )

    def move(self, target: Mapping[str, float], current: Mapping[str, float | None]) -> None:
        """Move joints, far ways in steps.

        Parameters
        ----------
        target
            Position of each joint, rad or m.
        current
            Where they are, as far as that is known.

        Raises
        ------
        MicroscopeError
            It is refused or fails, or the microscope does not answer.
        """
        ways = {}
        for joint, position in target.items():
            before = current.get(joint)
            ways[joint] = (position if before is None else before, position)
        steps = max(
            (
                math.ceil(abs(to - start) / _STEPS_RAD[joint])
                for joint, (start, to) in ways.items()
                if joint in _STEPS_RAD
            ),
            default=1,
        )
        for step in range(1, max(steps, 1) + 1):
            part = step / max(steps, 1)
            place = {joint: start + part * (to - start) for joint, (start, to) in ways.items()}
            names = [getattr(self._stage, joint) for joint in place]
            told = ", ".join(
                f"{joint} {math.degrees(at):.1f} deg"
                if joint in _STEPS_RAD
                else f"{joint} {1e6 * at:.1f} um"
                for joint, at in place.items()
            )
            message = JointState(name=names, position=list(place.values()))
            self._ask(self._move, message, "move_stage", told)

    def _on_stage(self, message: Any, _info: Any) -> None:
        try:
            joints = dict(zip(message.name, message.position, strict=True))
            x, y = float(joints[self._stage.x]), float(joints[self._stage.y])
        except (KeyError, TypeError, ValueError):
            # What is wrong with it is said where the angles are read.
            self._place = None
        else:
            self._place = (x, y) if math.isfinite(x) and math.isfinite(y) else None

    def _on_motion(self, message: Any, _info: Any) -> None:
        with self._changed:
            self._answer = {value.key: value.value for value in message.values}
            self._text = str(message.message)
            self._changed.notify_all()

    def _ask(self, publisher: Any, message: Any, command: str, told: str) -> None:
        self._wait(
            lambda: bool(self._answer) and publisher.get_subscription_count() > 0,
            _FIND_S,
            MicroscopeError(
                f"no node {self._name} that takes ~/{command}",
                expected="the node `microscope` or `virtual_sem` in this namespace",
                do="start it, or set the parameter microscope",
            ),
        )
        before = int(self._answer.get("number", 0))
        publisher.publish(message)

        def answered() -> bool:
            number = int(self._answer.get("number", 0))
            return number > before and self._answer.get("state") != "moving"

        self._wait(
            answered,
            _ANSWER_S,
            MicroscopeError(
                f"no answer of {self._name} to {command}: {told}", do="look at the microscope"
            ),
        )
        if self._answer.get("state") != "done":
            raise MicroscopeError(
                f"{self._name} has not done {told} ({self._answer.get('state')}): {self._text}"
            )

    def _wait(self, condition: Callable[[], bool], limit_s: float, late: MicroscopeError) -> None:
        end_s = time.monotonic() + limit_s
        with self._changed:
            while not condition():
                if not self._still_wanted():
                    raise MicroscopeError("stopped")
                if time.monotonic() > end_s:
                    raise late
                self._changed.wait(_POLL_S)
