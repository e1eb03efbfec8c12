"""Reports with pictures, each one self-contained HTML file."""

from __future__ import annotations

from semcal_ros.report.calibration_page import calibration_report
from semcal_ros.report.correction_page import DemoRow, correction_report
from semcal_ros.report.examples import ExampleView, UnusedView

__all__ = ["DemoRow", "ExampleView", "UnusedView", "calibration_report", "correction_report"]
