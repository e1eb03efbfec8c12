"""Calibrated live streams from scanning electron microscopes."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from semcal_ros.calibration import Calibration
    from semcal_ros.core.camera.scan_camera import ScanCamera
    from semcal_ros.core.errors import SemcalError
    from semcal_ros.workflows.calibrate import calibrate

__all__ = ["Calibration", "ScanCamera", "SemcalError", "__version__", "calibrate"]

__version__ = "0.1.0"

_HOMES = {
    "Calibration": "semcal_ros.calibration",
    "ScanCamera": "semcal_ros.core.camera.scan_camera",
    "SemcalError": "semcal_ros.core.errors",
    "calibrate": "semcal_ros.workflows.calibrate",
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
