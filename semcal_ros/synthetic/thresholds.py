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

"""The numbers of the virtual microscope, each with its source."""

from __future__ import annotations

import math

import numpy as np

from semcal_ros.core.thresholds import Table

TABLE = Table()

# A row takes three lines, and not one for each of its parts.
# fmt: off

# Detector, in detector.py

JITTER_MAX_PX = TABLE.stated(
    "JITTER_MAX_PX", 4.0, "px",
    "A tenth of a per cent of a field of 4096 px: lines that jump farther make no image.",
)
SHIFT_REACH = TABLE.derived(
    "SHIFT_REACH", 4, "px",
    "Samples on either side of a shifted one. A beam spot of 0.8 px leaves 13 % of the amplitude at 0.4 cycles per "
    "px, exp(-2 (0.8 x 0.4 pi)^2); below, interpolation over eight samples is right to a few per cent.",
)
POISSON_MAX = TABLE.derived(
    "POISSON_MAX", 200.0, "electrons",
    "From there a normal distribution serves: it has the same first two moments, and the skewness of the other is "
    "below 0.07, 1 / sqrt(200).",
)
TOOL_CORNERS = TABLE.defined(
    "TOOL_CORNERS", np.array([(-1.0, 0.15), (1.0, 0.46), (1.0, 0.54), (-1.0, 0.9)]), "of its reach, of the height",
    "Corners of a tool that comes in from the left.",
)
TOOL_LEVEL = TABLE.defined(
    "TOOL_LEVEL", 0.85, "reflectivity",
    "Of the tool.",
)
TOOL_RIDGES = TABLE.defined(
    "TOOL_RIDGES", 0.1, "reflectivity",
    "Of the ridges along it.",
)
RIDGE_PX = TABLE.defined(
    "RIDGE_PX", 9.0, "px per rad",
    "Of these ridges.",
)

# Drift, in drift.py

WANDER_TERMS = TABLE.derived(
    "WANDER_TERMS", 14, "sines",
    "Of the wander: with periods from 120 s to 4 s each is 30^(1 / 13) = 1.3 times the next, 2.6 to an octave.",
)

# A running microscope, in live.py

SETTINGS_KEPT = TABLE.cost(
    "SETTINGS_KEPT", 16, "changes",
    "Of the magnification, for frames that have begun before them.",
)
COMMANDS_KEPT = TABLE.cost(
    "COMMANDS_KEPT", 32, "commands",
    "Of the stage, for the same reason.",
)

# Projection, in microscope.py

FIXED_POINT_STEPS = TABLE.derived(
    "FIXED_POINT_STEPS", 60, "steps",
    "Each multiplies the error by the derivative of the residual: from 10 px, 60 reach the tolerance for "
    "derivatives up to 0.65, (1e-10 / 10)^(1 / 60).",
)
FIXED_POINT_TOLERANCE_PX = TABLE.derived(
    "FIXED_POINT_TOLERANCE_PX", 1e-10, "px",
    "A hundred times below the 1e-8 px of the splines that render with it, and above the rounding of a coordinate "
    "of 4096 px, 9e-13.",
)
SIMULATED_VOLTAGE_V = TABLE.defined(
    "SIMULATED_VOLTAGE_V", 10e3, "V",
    "An ordinary value, which is told only.",
)
SIMULATED_WORKING_DISTANCE_M = TABLE.defined(
    "SIMULATED_WORKING_DISTANCE_M", 10e-3, "m",
    "The same.",
)

# Plans, in plans.py

LADDER_STEP = TABLE.defined(
    "LADDER_STEP", 1.5, "ratio",
    "Of neighbouring magnifications of a ladder.",
)
LADDER_MOVES = TABLE.defined(
    "LADDER_MOVES", ((0.0, 0.0), (0.25, 0.08), (-0.07, 0.26), (-0.2, -0.16)), "fields of view",
    "At each of them.",
)
RESTING_RAD = TABLE.defined(
    "RESTING_RAD", (math.radians(8.0), 0.1), "rad",
    "Tilt and rotation of what is not recorded at many poses.",
)

# Rendering, in render.py

BLOCK_ROWS = TABLE.cost(
    "BLOCK_ROWS", 32, "rows",
    "That are drawn at once, so that their arrays stay in the CPU's cache: 1 MiB for each coordinate at 4096 "
    "columns.",
)
PASS_SPACING_PX = TABLE.derived(
    "PASS_SPACING_PX", 0.2, "px",
    "Passes that are closer are drawn once: the blur that is left out has a variance of 0.2^2 / 12 px^2.",
)
PASS_SAMPLES = TABLE.cost(
    "PASS_SAMPLES", 7, "samples",
    "Of the drift, for the length of its path: only a vibration at a multiple of seven times the pass rate escapes "
    "them.",
)

# Stage, in stage.py

AXIS_OFFSET_MAX_M = TABLE.stated(
    "AXIS_OFFSET_MAX_M", 5e-3, "m",
    "Of the tilt axis from the specimen: beyond, it is no stage of a microscope, or the unit is wrong.",
)
SCALE_SIGMA_MAX = TABLE.stated(
    "SCALE_SIGMA_MAX", 0.05, "of the scale",
    "Of a visit, for the same reason.",
)
TILT_MAX_RAD = TABLE.stated(
    "TILT_MAX_RAD", math.radians(70.0), "rad",
    "Of a stage.",
)
