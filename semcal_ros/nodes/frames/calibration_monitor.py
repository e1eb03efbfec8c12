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

"""Looks at a frame from time to time, and says whether the calibration still holds where it shows the grid."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.bridge.compressed import decoded_image
from semcal_ros.bridge.fields import stamp_ns_from_msg
from semcal_ros.bridge.images import to_gray
from semcal_ros.calibration import Calibration
from semcal_ros.config.config import MicroscopeConfig
from semcal_ros.core.calibration.judgement.check import CalibrationCheck, Verdict
from semcal_ros.core.calibration.views import FoundView
from semcal_ros.core.corners import find_lattice
from semcal_ros.core.errors import Rejection, SemcalError
from semcal_ros.files.images.databar import DatabarCutter
from semcal_ros.middleware import message_class
from semcal_ros.nodes.common.context import NodeContext
from semcal_ros.nodes.common.endpoints import unpack
from semcal_ros.nodes.common.latest_worker import LatestWorker
from semcal_ros.nodes.common.qos import glimpse_input
from semcal_ros.nodes.common.reporter import NODE_ERRORS
from semcal_ros.nodes.common.subscription import MessageInfo, published_ns
from semcal_ros.nodes.frames.held_values import MagnificationInput
from semcal_ros.workflows.check_and_update import check_found

# One check of a hundred calls a valid calibration degraded, and there are thousands of them: so many in a row have to.
_IN_A_ROW = 2
# What numerics raise where a view cannot be solved for.
_NUMERIC = (cv2.error, ArithmeticError, ValueError, np.linalg.LinAlgError)


@dataclass(frozen=True, order=True)
class _Glimpse:
    """A frame with what it is compared with; the later one is the greater."""

    number: int
    image: NDArray[Any] = field(compare=False)
    magnification: float = field(compare=False)
    calibration: Calibration = field(compare=False)
    config: MicroscopeConfig = field(compare=False)


@dataclass(frozen=True)
class _Examined:
    """A check, or the reason why there is none."""

    calibration: Calibration
    result: CalibrationCheck | None
    reason: str = ""


def _examine(glimpse: _Glimpse) -> _Examined:
    try:
        detection = find_lattice(glimpse.image)
        if isinstance(detection, Rejection):
            return _Examined(glimpse.calibration, None, f"no grid: {detection.reason}")
        view = FoundView("view 0", glimpse.magnification, None, detection)
        return _Examined(
            glimpse.calibration, check_found(glimpse.calibration, [view], glimpse.config)
        )
    except (SemcalError, *_NUMERIC) as error:
        return _Examined(glimpse.calibration, None, " ".join(str(error).split()))


class CalibrationMonitor:
    """Checks the calibration in force with a frame every ``period_s``, in a thread of its own.

    The frames in between are not decoded.

    Parameters
    ----------
    context
        Of the node.
    magnification
        Tells at which magnification a frame was taken.
    calibration
        Returns the calibration in force, or None, and the configuration with its display width.
    period_s
        Time between two frames, s.
    """

    def __init__(
        self,
        context: NodeContext,
        magnification: MagnificationInput,
        calibration: Callable[[], tuple[Calibration | None, MicroscopeConfig]],
        period_s: float,
    ) -> None:
        image = context.config.image
        self._databar = DatabarCutter(image.databar_rows)
        self._reporter = context.reporter
        self._magnification = magnification
        self._calibration = calibration
        self._period_s = period_s
        self._next_s = time.monotonic()
        self._number = 0
        self._bad: list[str] = []
        self._reported: tuple[Calibration | None, bool] = (None, False)
        self._worker = LatestWorker(context.endpoints.guard, _examine, self._on_seen)
        self._type = message_class(image.type)
        self._subscription = context.endpoints.subscribe(
            self._type, image.topic, self._on_bytes, glimpse_input(), raw=True
        )

    def _on_bytes(self, data: bytes, info: MessageInfo) -> None:
        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        current, config = self._calibration()
        if current is None:
            return
        self._next_s = now_s + self._period_s
        try:
            message = unpack(data, self._type)
            pixels, encoding = decoded_image(message)
            image = self._databar.cut(pixels)
            if image is None:
                return
            times = stamp_ns_from_msg(message), published_ns(info)
            g = self._magnification.at(*times, image.shape[1], config)
            if g is None or self._magnification.changed_during(*times):
                return
            grey = np.array(to_gray(image, encoding))
        except NODE_ERRORS as error:
            self._reporter.reject(error)
            return
        self._number += 1
        self._worker.submit(_Glimpse(self._number, grey, g, current, config))

    def _on_seen(self, seen: _Examined) -> None:
        current, _ = self._calibration()
        if seen.calibration is not current:
            return
        if self._reported[0] is not current:
            self._reported, self._bad = (current, False), []
        if seen.result is None:
            # What was found before still holds: the specimen is another one now.
            self._reporter.note("monitor", seen.reason)
            return
        summary = seen.result.summary
        self._reporter.note("monitor", summary)
        if seen.result.verdict is Verdict.VALID:
            self._bad = []
        else:
            self._bad.append(summary)
        doubtful = len(self._bad) >= _IN_A_ROW
        if doubtful and not self._reported[1]:
            self._reporter.warn(f"the calibration may not hold any more: {summary}")
        elif self._reported[1] and not doubtful:
            self._reporter.info(f"the calibration holds: {summary}")
        self._reported = current, doubtful

    def conditions(self) -> list[str]:
        """Return what the diagnostics should say: a calibration that does not hold any more."""
        current, _ = self._calibration()
        doubtful = self._reported[0] is current and self._reported[1]
        return [f"calibration {self._bad[-1]}"] if doubtful else []
