"""Reports with pictures, each one self-contained HTML file."""

from __future__ import annotations

from semcal_ros.report.calibration.examples import ExampleView, UnusedView
from semcal_ros.report.calibration.page import calibration_report
from semcal_ros.report.correction_page import DemoRow, correction_report

__all__ = ["DemoRow", "ExampleView", "UnusedView", "calibration_report", "correction_report"]
