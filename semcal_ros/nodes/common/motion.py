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

"""Topics by which a microscope is moved, with what is checked before; of ``microscope`` and ``virtual_sem``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Protocol

from diagnostic_msgs.msg import DiagnosticStatus
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64

from semcal_ros.bridge.diagnostics import DiagnosticLevel, DiagnosticSummary, fill_diagnostic_status
from semcal_ros.config.config import StageConfig
from semcal_ros.core.errors import MicroscopeError, SemcalError
from semcal_ros.drivers.limits import MotionLimits, describe_target, joint_unit
from semcal_ros.drivers.source import JOINTS
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.parameters import ParameterDeclaration
from semcal_ros.nodes.common.qos import stream_output

# Least, greatest and longest step of each joint. Stages of SEMs tilt from some degrees below 0 to 60 or more; a
# specimen that is higher than another touches the pole piece on its way up, so that z is locked unless someone says how
# far it may go. One command turns and tilts little enough to be watched and stopped.
_JOINT_LIMITS = {
    "tilt": (-0.09, 1.05, 0.35),
    "rotation": (-6.3, 6.3, 0.8),
    "x": (-5e-3, 5e-3, 1e-3),
    "y": (-5e-3, 5e-3, 1e-3),
    "z": (0.0, 0.0, 1e-4),
    "scan_rotation": (-6.3, 6.3, 6.3),
}
# What no stage reaches, to catch a wrong unit.
_FARTHEST = {"m": 0.5, "rad": 12.6}


def _limit(joint: str, name: str, text: str, default: float) -> ParameterDeclaration:
    unit = joint_unit(joint)
    far = _FARTHEST[unit]
    low = 0.0 if name == "step" else -far
    return ParameterDeclaration(f"{name}_{joint}", default, f"{text} {joint}.", unit, low, far)


MOTION = (
    ParameterDeclaration(
        "allow_motion",
        False,
        "Whether the stage may be moved and the magnification set from here.",
        fixed=True,
    ),
    ParameterDeclaration(
        "dry_run", False, "Check what is asked for and say what would be done; do nothing."
    ),
    ParameterDeclaration("min_magnification", 10.0, "Least magnification that is set.", "", 1, 1e8),
    ParameterDeclaration(
        "max_magnification", 1e6, "Greatest magnification that is set.", "", 1, 1e8
    ),
    *(_limit(j, "min", "Least position of the joint", v[0]) for j, v in _JOINT_LIMITS.items()),
    *(_limit(j, "max", "Greatest position of the joint", v[1]) for j, v in _JOINT_LIMITS.items()),
    *(_limit(j, "step", "Longest way in one command of", v[2]) for j, v in _JOINT_LIMITS.items()),
)
"""Parameters of a node that can move a microscope."""


class Performer(Protocol):
    """What does the moving; all but ``obstacle`` and ``run`` are called where ``run`` lets them."""

    def obstacle(self) -> str:
        """Return why nothing can be moved now, or an empty text."""

    def position(self) -> Mapping[str, float]:
        """Return where the stage is; raises :class:`MicroscopeError`."""

    def own_limits(self) -> Mapping[str, tuple[float, float]]:
        """Return limits of the microscope itself; raises :class:`MicroscopeError`."""

    def move(self, target: Mapping[str, float]) -> None:
        """Move, and return on arrival; raises :class:`MicroscopeError`."""

    def set_magnification(self, magnification: float) -> None:
        """Set it, and return once it is set; raises :class:`MicroscopeError`."""

    def run(self, work: Callable[[], str], done: Callable[[str, SemcalError | None], None]) -> None:
        """Do the work here or in another thread, then call ``done`` in the node's with its answer or its error."""


class MotionInterface:
    """Listens to ``~/set_magnification`` and ``~/move_stage``; says on ``~/motion`` what has become of each command.

    One command at a time: another one that comes meanwhile is refused. After a failure nothing is moved until
    :meth:`acknowledge`: whoever was moving it must first look what is the matter.

    Parameters
    ----------
    context
        Of the node, which declares :data:`MOTION`; its configuration says how the joints are called in messages.
    performer
        What does the moving.
    """

    def __init__(self, context: NodeContext, performer: Performer) -> None:
        self._name = context.node.get_fully_qualified_name()
        self._parameters = context.parameters
        self._reporter = context.reporter
        self._performer = performer
        source = context.config.stage or StageConfig()
        self._joints = {getattr(source, joint): joint for joint in JOINTS}
        self._number = 0
        self._command, self._asked = "", ""
        self._busy = False
        self.failure = ""
        self._status = context.endpoints.latched_publisher(DiagnosticStatus, "~/motion")
        self._subscriptions = [
            context.node.create_subscription(kind, topic, callback, stream_output(10))
            for kind, topic, callback in (
                (Float64, "~/set_magnification", self._on_magnification),
                (JointState, "~/move_stage", self._on_move),
            )
        ]
        self._say("idle", "nothing has been asked for", DiagnosticLevel.OK)

    def limits(self) -> MotionLimits:
        """Return the limits that the parameters state."""
        value = self._parameters
        return MotionLimits(
            {joint: (value[f"min_{joint}"], value[f"max_{joint}"]) for joint in JOINTS},
            {joint: value[f"step_{joint}"] for joint in JOINTS},
            (value["min_magnification"], value["max_magnification"]),
        )

    def acknowledge(self) -> None:
        """Allow to move again after a failure."""
        if self.failure:
            self.failure = ""
            self._say("idle", "moving is allowed again", DiagnosticLevel.OK)

    def conditions(self) -> list[str]:
        """Return what is wrong, a few words each."""
        return [f"not moving any more: {self.failure}"] if self.failure else []

    def _on_magnification(self, message: Any) -> None:
        magnification = float(message.data)

        def check() -> None:
            self.limits().check_magnification(magnification)

        self._begin(
            "set_magnification",
            f"magnification {magnification:g}",
            check,
            lambda: None,
            lambda: self._performer.set_magnification(magnification),
        )

    def _on_move(self, message: Any) -> None:
        names, positions = [str(name) for name in message.name], list(message.position)
        target = {self._joints.get(n, n): float(p) for n, p in zip(names, positions, strict=False)}
        limits = self.limits()

        def check() -> None:
            if len(names) != len(positions) or len(target) != len(names):
                raise MicroscopeError(
                    f"{len(positions)} positions of the joints {', '.join(names) or 'without names'}",
                    expected="one position for each joint, and each joint once",
                )
            limits.check_target(target)

        def look() -> None:
            limits.check_way(target, self._performer.position(), self._performer.own_limits())

        self._begin(
            "move_stage",
            describe_target(target),
            check,
            look,
            lambda: self._performer.move(target),
        )

    def _begin(
        self,
        command: str,
        asked: str,
        check: Callable[[], None],
        check_way: Callable[[], None],
        act: Callable[[], None],
    ) -> None:
        """Check a command and let it be done.

        ``check`` needs no microscope; ``look`` asks it where it is; only ``act`` changes anything.
        """
        if self._busy:
            self._reporter.reject(
                MicroscopeError(
                    f"{command} to {asked} while {self._command} is under way",
                    expected="one command at a time",
                    do="wait until ~/motion says that it has ended",
                )
            )
            return
        self._number += 1
        self._command, self._asked = command, asked
        dry = self._parameters["dry_run"]
        try:
            self._refuse_unless_allowed(dry)
            check()
        except SemcalError as error:
            self._refuse(error)
            return
        acting = False

        def work() -> str:
            nonlocal acting
            check_way()
            if dry:
                return f"would be done: {asked}"
            acting = True
            act()
            return f"done: {asked}"

        number = self._number

        def done(answer: str, error: SemcalError | None) -> None:
            if not self._busy or number != self._number:
                # It had been given up.
                self._reporter.warn(f"~/{command} has ended after all: {error or answer}")
                return
            self._busy = False
            if error is None:
                self._reporter.info(f"~/{command}: {answer}")
                self._say("dry_run" if dry else "done", answer, DiagnosticLevel.OK)
            elif acting:
                self._fail(error)
            else:
                self._refuse(error)

        self._busy = True
        self._say("moving", asked, DiagnosticLevel.OK)
        self._performer.run(work, done)

    def _refuse_unless_allowed(self, dry: bool) -> None:
        if not (self._parameters["allow_motion"] or dry):
            raise MicroscopeError(
                f"{self._command} to {self._asked}, which is not allowed",
                expected="a node that may move the microscope",
                do="start it with -p allow_motion:=true",
            )
        if self.failure:
            raise MicroscopeError(
                f"{self._command} to {self._asked} after a failure: {self.failure}",
                expected="somebody who has looked at the microscope",
                do="call ~/start",
            )
        if obstacle := self._performer.obstacle():
            raise MicroscopeError(
                f"{self._command} to {self._asked}: {obstacle}",
                expected="a microscope that answers",
            )

    def _refuse(self, error: SemcalError) -> None:
        self._reporter.reject(error)
        self._say("refused", str(error), DiagnosticLevel.WARN)

    def _fail(self, error: SemcalError) -> None:
        self.failure = str(error)
        self._reporter.reject(error)
        self._say("failed", self.failure, DiagnosticLevel.ERROR)

    def give_up(self, reason: str) -> None:
        """Take a command that is under way for failed; its end, should it come, is only told."""
        if self._busy:
            self._busy = False
            self._fail(MicroscopeError(reason))

    @property
    def busy(self) -> bool:
        """Whether a command is under way."""
        return self._busy

    def _say(self, state: str, text: str, level: DiagnosticLevel) -> None:
        values = {
            "command": self._command,
            "number": str(self._number),
            "asked": self._asked,
            "state": state,
        }
        message = DiagnosticStatus()
        summary = DiagnosticSummary(level, text, tuple(values.items()))
        fill_diagnostic_status(message, f"{self._name}: motion", "", summary)
        self._status.publish(message)


def motion_with(**defaults: bool | float) -> tuple[ParameterDeclaration, ...]:
    """Return :data:`MOTION` with other defaults, by name."""
    return tuple(
        replace(declared, default=defaults.get(declared.name, declared.default))
        for declared in MOTION
    )
