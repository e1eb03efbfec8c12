"""Reports with figures, each one self-contained HTML file."""

from __future__ import annotations

from semcal_ros.report.calibration.page import write_calibration_report

__all__ = ["write_calibration_report"]
