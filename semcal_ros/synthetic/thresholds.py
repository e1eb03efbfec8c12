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

"""The numbers of the virtual microscope and of its specimens, each with its source."""

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


# Grids, in grid.py

SQUARES_M = TABLE.defined(
    "SQUARES_M", (25e-6, 10e-6, 5e-6, 2e-6, 1e-6), "m",
    "Sides of the squares of the grids on one chip.",
)

SQUARE_MAX = TABLE.derived(
    "SQUARE_MAX", 0.155, "image widths",
    "At least six squares are in view, 1 / 6.45.",
)

FAULT_MAX = TABLE.stated(
    "FAULT_MAX", 0.05, "of a length",
    "A grid that is off by more would be another grid.",
)

CURVATURE_MAX = TABLE.derived(
    "CURVATURE_MAX", 200.0, "1/m",
    "At 100x the field reaches 0.85 mm from its middle: on a tighter curve its border would be steeper than 10 "
    "degrees, 200 x 0.85e-3 = 0.17, and no chip is.",
)

SURFACE_STEPS = TABLE.derived(
    "SURFACE_STEPS", 60, "steps",
    "The height changes by the slope of the surface, 0.17 at most, times the tangent of the tilt, 1.7 at 60 "
    "degrees, in each; the tolerance takes 15.",
)

SURFACE_TOLERANCE = TABLE.derived(
    "SURFACE_TOLERANCE", 1e-8, "squares",
    "Of at least 11 px: 1e-7 px.",
)


# Rays, in render.py

NODE_SPACING_PX = TABLE.stated(
    "NODE_SPACING_PX", 12.0, "px",
    "The errors that the module states are those of this spacing and of quintic splines.",
)

INTERVALS_MAX = TABLE.cost(
    "INTERVALS_MAX", 96, "intervals",
    "Above 96 x 12 px the spacing grows with the frame.",
)

NODE_DEGREE = TABLE.defined(
    "NODE_DEGREE", 5, "degree",
    "Of the splines, quintic.",
)


# Gold on carbon, in gold.py

GOLD_TILE = TABLE.cost(
    "GOLD_TILE", 1024, "texels",
    "Along each side of a tile: 17 diameters of its largest particle.",
)

GOLD_RADII_TEXELS = TABLE.derived(
    "GOLD_RADII_TEXELS", (6.0, 30.0), "texels",
    "Smallest and largest radius. Their ratio of 5 exceeds the ratio of 4 between octaves, so that the sizes have "
    "no gap.",
)

GOLD_MARGIN = TABLE.derived(
    "GOLD_MARGIN", 32, "texels",
    "About the centre of a particle: beyond the largest radius, 30, and its soft edge.",
)

GOLD_COVERAGE = TABLE.defined(
    "GOLD_COVERAGE", 0.17, "of the tile",
    "Summed area of the particles of an octave: six leave exp(-6 x 0.17) = 36 % of the film bare.",
)

OCTAVE_ROTATION_RAD = TABLE.derived(
    "OCTAVE_ROTATION_RAD", math.pi * (3.0 - math.sqrt(5.0)), "rad",
    "From octave to octave: no small number of golden angles is a whole turn, so that octaves do not align.",
)


# Substrates, in substrate.py

GROUND_TILE = TABLE.cost(
    "GROUND_TILE", 2048, "texels",
    "Along each side of a tile: 85 of its structures until it repeats.",
)

GROUND_SIZE_TEXELS = TABLE.defined(
    "GROUND_SIZE_TEXELS", 24.0, "texels",
    "Of these structures.",
)

FINER_SIZE = TABLE.defined(
    "FINER_SIZE", 1.0 / 5.3, "of the size",
    "Of a second layer of the same tile, so that there is structure at all magnifications; turned, it does not "
    "repeat with the first.",
)

FINER_RMS = TABLE.defined(
    "FINER_RMS", 0.35, "of the first",
    "RMS of this layer.",
)

GOLD_MEAN = TABLE.stated(
    "GOLD_MEAN", 0.276, "reflectivity",
    "Of GoldOnCarbon, over fields of 29 um: 0.276 +- 0.009 for six seeds.",
)

GOLD_RMS = TABLE.stated(
    "GOLD_RMS", 0.205, "reflectivity",
    "The same: 0.205 +- 0.008.",
)

FIBRE_ELONGATION = TABLE.defined(
    "FIBRE_ELONGATION", 20.0, "ratio",
    "Of the length of fibres to their width.",
)

FIBRE_LAYERS = TABLE.defined(
    "FIBRE_LAYERS", 5, "layers",
    "Of fibres, each in its direction; one lies over the others where it is brighter.",
)

SCRATCH_LEVELS = TABLE.defined(
    "SCRATCH_LEVELS", (-0.6, -0.35, 0.3, 0.45, 0.65, 0.8, 1.0), "reflectivity",
    "Of scratches, of which more are bright than dark: burrs shine, grooves are in the shade.",
)

SCRATCHES = TABLE.defined(
    "SCRATCHES", 260, "scratches",
    "On a tile.",
)

SCRATCH_SPREAD_RAD = TABLE.defined(
    "SCRATCH_SPREAD_RAD", 0.25, "rad",
    "1-sigma about the direction of polishing.",
)

REFLECTIVITY_RANGE = TABLE.defined(
    "REFLECTIVITY_RANGE", (0.01, 1.1), "reflectivity",
    "That a texture may reach: a real surface neither absorbs all nor shines.",
)


# Balls, in ball.py

BALL_SAMPLES = TABLE.cost(
    "BALL_SAMPLES", 2, "samples",
    "Per pixel and direction: the outline has steps of a quarter of the contrast at most.",
)

BALL_MARGIN_M = TABLE.derived(
    "BALL_MARGIN_M", 20e-9, "m",
    "More than perspective moves the outline by at the end of the tip.",
)


# Bodies, in ball.py

BODY_TILE = TABLE.cost(
    "BODY_TILE", 128, "voxels",
    "Along each side of the periodic noise: the two grain sizes take 17 MB.",
)

GRAIN_VOXELS = TABLE.stated(
    "GRAIN_VOXELS", 10.0, "voxels",
    "Per grain, where the tile does not have to be coarser to hold the whole ball.",
)

BODY_ROOM = TABLE.stated(
    "BODY_ROOM", 1.1, "diameters",
    "Side of the tile: the texture does not repeat on the ball.",
)

BODY_STEPS = TABLE.derived(
    "BODY_STEPS", 12, "steps",
    "To a surface that departs from a sphere by some per cent: Newton's, whose error falls below 1e-6 of it.",
)


# Cantilevers, in cantilever.py

CANTILEVER_MAGNIFICATIONS = TABLE.defined(
    "CANTILEVER_MAGNIFICATIONS", (6450.0, 7760.0, 8890.0), "magnification",
    "Of the experiment of Malti et al. (2012).",
)

CANTILEVER_PUSHES = TABLE.defined(
    "CANTILEVER_PUSHES", ( 0.0, 0.08, 0.24, 0.44, 0.64, 0.84, 1.0, 0.72, 0.4, 0.12, 0.0, ), "of the largest",
    "No push on the way back repeats one of the way up.",
)

FREE_GAP_M = TABLE.stated(
    "FREE_GAP_M", 600e-9, "m",
    "Between beam and pusher at rest: it never shades what it does not touch.",
)


# Targets of visual servoing, in target.py

BIT_TEXELS = TABLE.derived(
    "BIT_TEXELS", 7, "texels",
    "Seven for each square of a marker, and nine for the white on either side of it.",
)
