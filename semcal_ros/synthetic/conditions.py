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

"""What the virtual SEM tells of how it takes its images."""

from __future__ import annotations

from semcal_ros.synthetic.microscope import VirtualMicroscope

__all__ = ["SIMULATED_VOLTAGE_V", "SIMULATED_WORKING_DISTANCE_M", "conditions_of"]

#: Ordinary values, which are told only: no image depends on them.
SIMULATED_VOLTAGE_V, SIMULATED_WORKING_DISTANCE_M = 10e3, 10e-3


def conditions_of(
    microscope: VirtualMicroscope,
    *,
    voltage_v: float = SIMULATED_VOLTAGE_V,
    working_distance_m: float = SIMULATED_WORKING_DISTANCE_M,
    scan_rotation_rad: float = 0.0,
) -> dict[str, float | str]:
    """Return the conditions as the topic ``conditions`` names them, in SI units.

    Parameters
    ----------
    microscope
        With its image size and timing.
    voltage_v, working_distance_m, scan_rotation_rad
        What it is set to.
    """
    timing = microscope.timing
    line_share = (1.0 - timing.flyback_fraction) / timing.line_averages
    return {
        "accelerating_voltage_v": voltage_v,
        "working_distance_m": working_distance_m,
        "scan_rotation_rad": scan_rotation_rad,
        "frame_time_s": timing.frame_time_s,
        "dwell_s": timing.frame_time_s * line_share / (microscope.width * microscope.height),
        "detector": "simulated",
        "maker": "semcal_ros",
        "model": microscope.name,
    }
