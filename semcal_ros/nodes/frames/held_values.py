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

"""What the microscope said when a frame was taken: the magnification and the conditions."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.callback_groups import CallbackGroup

from semcal_ros.bridge.conditions import read_conditions
from semcal_ros.bridge.fields import optional_stamp_ns
from semcal_ros.bridge.magnification import MagnificationReading, read_magnification
from semcal_ros.bridge.zero_order_hold import ZeroOrderHold, find_values
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.camera.conditions import compare_conditions
from semcal_ros.core.camera.records import NOT_RECORDED
from semcal_ros.core.drift.thresholds import SAME_SCALE
from semcal_ros.core.errors import SemcalError
from semcal_ros.middleware import message_class
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.parameters import ParameterDeclaration
from semcal_ros.nodes.common.qos import value_input
from semcal_ros.nodes.common.subscription import MessageInfo, published_ns

# More changes than can precede a late frame.
_KEPT = 4096

ON_MISMATCH = ParameterDeclaration(
    "on_mismatch",
    "warn",
    "What happens while the topic conditions tells of another microscope, voltage, working distance or scan rotation"
    " than the calibration was made with. warn: the log and the diagnostics say so. refuse: image_rect stays silent,"
    " too.",
    choices=("warn", "refuse"),
)
# Smaller steps back are late frames; a replay that restarts steps back by more.
_CLOCK_STEP_NS = 1_000_000_000
# Fast DDS offers a latched value once more every 3 s, should the first offer have come before the match.
_PATIENCE_S = 4.0


class MagnificationInput:
    """History of the magnification topic.

    A value is valid from its stamp on. Messages without a header count from their publication, and
    so do the frames then: the order in which the microscope publishes decides, whatever the order of
    arrival and the rate of a replay. An unusable message makes the magnification unknown until the
    next usable one; meanwhile, and when one of several publishers leaves, those that are there are asked for
    their last value again.

    Parameters
    ----------
    context
        Of the node.
    on_reading
        Called with each good reading.
    group
        Callback group of the subscription.
    """

    def __init__(
        self,
        context: NodeContext,
        on_reading: Callable[[MagnificationReading], None] | None = None,
        group: CallbackGroup | None = None,
    ) -> None:
        source = context.config.magnification
        self._config = context.config
        self._reporter = context.reporter
        self._on_reading = on_reading
        self._history: ZeroOrderHold[MagnificationReading | None] = ZeroOrderHold(_KEPT)
        message_type = message_class(source.type)
        self._has_stamp = optional_stamp_ns(message_type()) is not None
        self._subscription = context.endpoints.subscribe(
            message_type,
            source.topic,
            self._on_message,
            value_input(),
            group,
            source="magnification",
        )
        self.received = 0
        self._renewals = 0
        self._last_ns = 0
        self._latest_sent_ns = 0
        # The history up to a stamp, after which the clock went back.
        self._aside: tuple[int, ZeroOrderHold[MagnificationReading | None]] | None = None
        # Until when, on a steady clock, to wait for a message that was published after the other time.
        self._doubted: tuple[float, int] | None = None

    def _on_message(self, message: Any, info: MessageInfo) -> None:
        self.received += 1
        key_ns = sent_ns = published_ns(info)
        repeated = sent_ns <= self._latest_sent_ns and self._subscription.renewals > 0
        if repeated and self._renewals != self._subscription.renewals:
            # Sent once more by a publisher that is still there: what came after it is over.
            self._history.clear()
        self._renewals = self._subscription.renewals
        self._latest_sent_ns = max(sent_ns, self._latest_sent_ns)
        reading: MagnificationReading | None = None
        try:
            if self._has_stamp:
                key_ns = optional_stamp_ns(message) or 0
            reading = read_magnification(message, self._config)
        except SemcalError as error:
            if not repeated:
                self._reporter.reject(error)
                self._reporter.warn_seldom(
                    "the magnification is unknown until the next usable message: images are not used meanwhile"
                )
                self._subscription.ask_again()
        self._history.insert(key_ns, reading)
        if reading is not None and self._on_reading is not None:
            self._on_reading(reading)

    def at(
        self, stamp_ns: int, sent_ns: int, image_width_px: int, config: MicroscopeConfig
    ) -> float | None:
        """Return the magnification of a frame, or None while it is unknown.

        Parameters
        ----------
        stamp_ns, sent_ns
            Header stamp of the frame, and its publication time at the microscope.
        image_width_px
            Width of the frame.
        config
            The configuration in force, whose display width is that of the calibration.

        Raises
        ------
        MessageError
            The magnification is absurd for frames of this width.
        """
        self._subscription.take_waiting()
        if self._has_stamp:
            self._forget_if_back(stamp_ns)
        reading, _ = self._find(stamp_ns, sent_ns)
        if reading is None or self._is_doubted():
            return None
        return replace(reading, config=config).magnification(image_width_px)

    def find_rivals(self) -> str:
        """As :meth:`AdaptiveSubscription.find_rivals`."""
        return self._subscription.find_rivals()

    @property
    def rivals(self) -> str:
        """As :attr:`AdaptiveSubscription.rivals`."""
        return self._subscription.rivals

    def doubt(self, since_ns: int) -> None:
        """Doubt the magnification: the microscope was restarted after ``since_ns`` and may soon publish another one.
        Otherwise the old one stays valid.
        """
        self._doubted = time.monotonic() + _PATIENCE_S, since_ns

    def _is_doubted(self) -> bool:
        if self._doubted is None:
            return False
        until_s, since_ns = self._doubted
        if self._latest_sent_ns > since_ns or time.monotonic() > until_s:
            self._doubted = None
        return self._doubted is not None

    def _forget_if_back(self, stamp_ns: int) -> None:
        """Set the history aside if the clock went back and no magnification has arrived since.

        It is taken up again where the next stamps go on as if nothing had been: a single frame may have a bad stamp.
        """
        newest_ns = self._history.newest_ns
        went_back = stamp_ns < self._last_ns - _CLOCK_STEP_NS
        if went_back and newest_ns is not None and newest_ns > stamp_ns + _CLOCK_STEP_NS:
            self._aside = self._last_ns, self._history
            self._history = ZeroOrderHold(_KEPT)
            self._subscription.ask_again()
        elif self._aside is not None:
            last_ns, history = self._aside
            if len(self._history):
                self._aside = None
            elif stamp_ns >= last_ns - _CLOCK_STEP_NS:
                self._aside, self._history = None, history
        self._last_ns = stamp_ns

    def _find(
        self, stamp_ns: int, sent_ns: int
    ) -> tuple[MagnificationReading | None, list[MagnificationReading | None]]:
        return find_values(
            self._history, stamp_ns, None if self._has_stamp else sent_ns, self._config
        )

    def changed_during(self, stamp_ns: int, sent_ns: int) -> bool:
        """Return whether the magnification changed during a frame's scan, as far as that is known.

        Call it after :meth:`at`, with the same arguments.
        """
        _, during = self._find(stamp_ns, sent_ns)
        values = [reading.value for reading in during if reading is not None]
        if len(values) < len(during):
            # Known for a part of the scan only.
            return bool(values)
        return max(values) > SAME_SCALE * min(values)


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
