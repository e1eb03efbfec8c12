"""Calibrated live streams from scanning electron microscopes."""

from __future__ import annotations

from semcal_ros.calibration import Calibration
from semcal_ros.core.camera import ScanCamera
from semcal_ros.core.errors import SemcalError

__all__ = ["Calibration", "ScanCamera", "SemcalError", "__version__"]

__version__ = "0.1.0"
