"""Bending of a cantilever, in nanometres, with its uncertainty (Malti et al. 2012, section 4.3)."""

from __future__ import annotations

from semcal_ros.applications.cantilever.bending import SHAPES, Bending
from semcal_ros.applications.cantilever.finding import Strip, find_strip
from semcal_ros.applications.cantilever.repeatability import (
    Repeatability,
    compare_series,
    group_frames,
)
from semcal_ros.applications.cantilever.series import (
    Deflection,
    Series,
    SeriesSettings,
    measure_series,
)

__all__ = [
    "SHAPES",
    "Bending",
    "Deflection",
    "Repeatability",
    "Series",
    "SeriesSettings",
    "Strip",
    "compare_series",
    "find_strip",
    "group_frames",
    "measure_series",
]
