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

"""Calibrated live streams from scanning electron microscopes."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from semcal_ros.calibration import Calibration
    from semcal_ros.core.camera.scan_camera import ScanCamera
    from semcal_ros.core.errors import SemcalError
    from semcal_ros.files.recordings import RecordedFiles
    from semcal_ros.workflows.calibrate import calibrate
    from semcal_ros.workflows.check_and_update import check, update
    from semcal_ros.workflows.describe_recording import describe_recording
    from semcal_ros.workflows.extend import extend
    from semcal_ros.workflows.measure_cantilever import measure_cantilever
    from semcal_ros.workflows.reconstruct import reconstruct
    from semcal_ros.workflows.rectify import rectify
    from semcal_ros.workflows.stack import stack
    from semcal_ros.workflows.track_drift import track_drift

__all__ = [
    "Calibration",
    "RecordedFiles",
    "ScanCamera",
    "SemcalError",
    "__version__",
    "calibrate",
    "check",
    "describe_recording",
    "extend",
    "measure_cantilever",
    "reconstruct",
    "rectify",
    "stack",
    "track_drift",
    "update",
]

__version__ = "0.1.0"

_HOMES = {
    "Calibration": "semcal_ros.calibration",
    "RecordedFiles": "semcal_ros.files.recordings",
    "ScanCamera": "semcal_ros.core.camera.scan_camera",
    "SemcalError": "semcal_ros.core.errors",
    "calibrate": "semcal_ros.workflows.calibrate",
    "check": "semcal_ros.workflows.check_and_update",
    "describe_recording": "semcal_ros.workflows.describe_recording",
    "extend": "semcal_ros.workflows.extend",
    "measure_cantilever": "semcal_ros.workflows.measure_cantilever",
    "reconstruct": "semcal_ros.workflows.reconstruct",
    "rectify": "semcal_ros.workflows.rectify",
    "stack": "semcal_ros.workflows.stack",
    "track_drift": "semcal_ros.workflows.track_drift",
    "update": "semcal_ros.workflows.check_and_update",
}


def __getattr__(name: str) -> Any:
    # On demand: whoever imports semcal_ros.core must not need what files and schemas need.
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOMES[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
