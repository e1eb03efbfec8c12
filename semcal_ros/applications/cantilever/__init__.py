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

"""Bending of a cantilever, in nanometres, with its uncertainty (Malti et al. 2012, section 4.3)."""

from __future__ import annotations

from semcal_ros.applications.cantilever.bending import SHAPES, Bending
from semcal_ros.applications.cantilever.finding import Strip, find_strip
from semcal_ros.applications.cantilever.repeatability import (
    Repeatability,
    compare_series,
    describe_disagreement,
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
    "describe_disagreement",
    "find_strip",
    "group_frames",
    "measure_series",
]
