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

"""Under which conditions the microscope works, and whether a calibration was made under the same."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import CallbackGroup

from semcal_ros.bridge.conditions import read_conditions
from semcal_ros.calibration import Calibration
from semcal_ros.core.camera.conditions import compare_conditions
from semcal_ros.core.camera.records import NOT_RECORDED
from semcal_ros.core.errors import SemcalError
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.parameters import ParameterDeclaration
from semcal_ros.nodes.common.qos import value_input
from semcal_ros.nodes.common.subscription import MessageInfo

ON_MISMATCH = ParameterDeclaration(
    "on_mismatch",
    "warn",
    "What happens while the topic conditions tells of another microscope, voltage, working distance or scan rotation"
    " than the calibration was made with. warn: the log and the diagnostics say so. refuse: image_rect stays silent,"
    " too.",
    choices=("warn", "refuse"),
)


class ConditionsInput:
    """What the topic ``conditions`` said last; a message that cannot be used makes them unknown.

    Parameters
    ----------
    context
        Of the node.
    on_change
        Called after each change.
    group
        Callback group of the subscription.

    Attributes
    ----------
    current
        What is known, by the keys of the topic, SI units.
    """

    def __init__(
        self,
        context: NodeContext,
        on_change: Callable[[], None] = lambda: None,
        group: CallbackGroup | None = None,
    ) -> None:
        self._reporter = context.reporter
        self._on_change = on_change
        self.current: Mapping[str, float | str] = {}
        self._subscription = context.endpoints.subscribe(
            DiagnosticStatus, "conditions", self._on_message, value_input(), group
        )

    def _on_message(self, message: Any, _info: MessageInfo) -> None:
        known: Mapping[str, float | str] = {}
        try:
            known = read_conditions(message)
        except SemcalError as error:
            self._reporter.reject(error)
        if known != self.current:
            self.current = known
            self._on_change()

    def take_waiting(self) -> None:
        """Take what has arrived already."""
        self._subscription.take_waiting()


class ConditionsWatch:
    """Compares the conditions with those of the calibration in force; says each change once.

    Parameters
    ----------
    context
        Of the node.
    calibration
        Returns the calibration in force, or None.
    """

    def __init__(self, context: NodeContext, calibration: Callable[[], Calibration | None]) -> None:
        self._reporter = context.reporter
        self._calibration = calibration
        self._input = ConditionsInput(context, self.check)
        self._compared: tuple[object, object] = (None, None)
        self._decisive: tuple[str, ...] = ()
        self._others: tuple[str, ...] = ()

    @property
    def differs(self) -> bool:
        """Whether the calibration may not hold under the conditions of the last check."""
        return bool(self._decisive)

    def check(self) -> None:
        """Compare again if calibration or conditions have changed since the last time."""
        current, seen = self._calibration(), self._input.current
        if self._compared[0] is current and self._compared[1] is seen:
            return
        self._compared = current, seen
        if current is None:
            self._tell((), ())
            self._reporter.forget("conditions")
            return
        known = current.provenance.conditions
        found = compare_conditions(known, seen, height_sigma_m=current.scale_sigma.height_m)
        self._tell(
            tuple(d.text for d in found if d.decisive),
            tuple(d.text for d in found if not d.decisive),
        )
        if not seen:
            state = "unknown"
        elif not known:
            state = f"{NOT_RECORDED} in the calibration"
        else:
            state = "; ".join((*self._decisive, *self._others)) or "those of the calibration"
        self._reporter.note("conditions", state)

    def _tell(self, decisive: tuple[str, ...], others: tuple[str, ...]) -> None:
        before, self._decisive = self._decisive, decisive
        if decisive and decisive != before:
            self._reporter.warn(
                f"other conditions than those of the calibration: {', '.join(decisive)}; check it (semcal check), or"
                " use one that was made under these conditions"
            )
        elif before and not decisive:
            self._reporter.info("the conditions are those of the calibration again")
        if others and others != self._others:
            self._reporter.info(f"different from the calibration: {', '.join(others)}")
        self._others = others

    def conditions(self) -> list[str]:
        """Return what the diagnostics should say, in a few words."""
        self.check()
        return [f"other conditions: {', '.join(self._decisive)}"] if self._decisive else []
