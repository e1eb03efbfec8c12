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

"""Where the stage was when a frame was taken."""

from __future__ import annotations

import math
from typing import Any

from rclpy.callback_groups import CallbackGroup

from semcal_ros.bridge.fields import stamp_ns_from_msg
from semcal_ros.bridge.stage import (
    doubt_unit,
    missing_joints,
    read_stage,
    require_radians,
    tilt_jump_rad,
)
from semcal_ros.bridge.zero_order_hold import ZeroOrderHold
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.errors import SemcalError
from semcal_ros.middleware import message_class
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.qos import value_input
from semcal_ros.nodes.common.subscription import MessageInfo, published_ns

# More changes than can precede a late frame.
_KEPT = 4096
# Names of joints in a warning, enough to see what there is instead.
_NAMES = 8


class StageInput:
    """History of the topic of the stage; a reading is valid from its stamp to the next one.

    Messages without a stamp count when they arrive. An unusable message makes the stage unknown until
    the next usable one. A tilt that jumps is used, with a warning.

    Parameters
    ----------
    context
        Of the node; its configuration says what the topic carries, if there is one.
    group
        Callback group of the subscription.
    """

    def __init__(self, context: NodeContext, group: CallbackGroup | None = None) -> None:
        self._source = source = context.config.stage
        self._reporter = context.reporter
        self._history: ZeroOrderHold[StageReading | None] = ZeroOrderHold(_KEPT)
        self._stamped = True
        self._doubt = ""
        self._missing: list[str] = []
        self._last: tuple[int, StageReading] | None = None
        self._jumps = 0
        if source is not None:
            self._subscription = context.endpoints.subscribe(
                message_class(source.type), source.topic, self._on_message, value_input(), group
            )

    def _on_message(self, message: Any, info: MessageInfo) -> None:
        reading, stamp_ns = None, 0
        try:
            stamp_ns = stamp_ns_from_msg(message)
            reading = self._read(message)
        except SemcalError as error:
            self._reporter.reject(error)
        stamped = stamp_ns != 0
        if stamped != self._stamped:
            self._history.clear()
            self._last = None
            self._stamped = stamped
        time_ns = stamp_ns or published_ns(info)
        self._history.insert(time_ns, reading)
        if reading is not None:
            self._look_for_jump(time_ns, reading)

    def _read(self, message: Any) -> StageReading | None:
        if self._source is None:
            return None
        reading = read_stage(message, self._source)
        self._doubt = self._doubt or doubt_unit(reading, self._source)
        require_radians(reading, self._source)
        missing = missing_joints([reading], self._source)
        if missing and missing != self._missing:
            names = ", ".join(str(name) for name in message.name[:_NAMES]) or "none"
            self._reporter.warn(
                f"no joint {', '.join(missing)} on {self._source.topic}; its joints: {names}"
            )
        self._missing = missing
        return reading

    def _look_for_jump(self, time_ns: int, reading: StageReading) -> None:
        last, self._last = self._last, (time_ns, reading)
        if last is None or self._source is None:
            return
        seconds = (time_ns - last[0]) * 1e-9
        if change := tilt_jump_rad(last[1], reading, seconds):
            self._jumps += 1
            self._reporter.note("stage_jumps", self._jumps)
            self._reporter.warn_seldom(
                f"the tilt on {self._source.topic} jumps by {math.degrees(change):.1f} degrees within "
                f"{seconds:.3g} s: a wrong reading, or a wrong stamp"
            )

    @property
    def doubt(self) -> str:
        """The first angle that no stage has in rad, such as ``"tilt 30 rad"``; empty if there was none.

        The readings before it are doubtful too: small angles in degrees pass for radians.
        """
        return self._doubt

    def forget_doubt(self) -> None:
        """Trust the readings again, until the next doubtful one."""
        self._doubt = ""

    def conditions(self) -> list[str]:
        """Return what is wrong with the stage, a few words each."""
        if self._source is None:
            return []
        doubt = [f"{self._doubt} on {self._source.topic}: degrees?"] if self._doubt else []
        return doubt + [f"no joint {joint} on {self._source.topic}" for joint in self._missing]

    def at(self, stamp_ns: int) -> StageReading | None:
        """Return the reading of a frame with this stamp, or None while it is unknown; the newest one where the frame,
        or the stage, has no stamp (0).
        """
        if self._source is None:
            return None
        self._subscription.take_waiting()
        newest_ns = self._history.newest_ns
        reading = None
        if newest_ns is not None:
            reading = self._history.at(stamp_ns if self._stamped and stamp_ns else newest_ns)
        tilt = None if reading is None else reading.tilt_rad
        self._reporter.note("stage_tilt_rad", "unknown" if tilt is None else tilt)
        return reading
