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

"""The entry points of the ROS executables, which a signal also ends in order while they are still importing."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from importlib import import_module


def _starter(name: str) -> Callable[[], int]:
    def start() -> int:
        # The imports take a second or two. An exception in the middle of them would be printed with its traceback, and
        # there is nothing yet that would have to be closed. `run_node` takes over as soon as it begins.
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda _number, _frame: os._exit(0))
        status: int = import_module(f"semcal_ros.nodes.{name}").main()
        return status

    return start


bag_player = _starter("bag_player")
calibration_server = _starter("calibration_server")
drift_compensator = _starter("drift_compensator")
microscope = _starter("microscope")
parameter_server = _starter("parameter_server")
rectifier = _starter("rectifier")
stream_corrector = _starter("stream_corrector")
suite = _starter("suite")
virtual_sem = _starter("virtual_sem")
visual_servo = _starter("visual_servo")
