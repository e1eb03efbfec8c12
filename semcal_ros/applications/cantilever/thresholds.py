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

"""The numbers of the bending of cantilevers, each with its source."""

from __future__ import annotations

import math

import numpy as np

from semcal_ros.core.robust_losses import TUKEY_CONSTANT
from semcal_ros.core.thresholds import Table

TABLE = Table()

# Of the measured rows: each says in how many cases it was tried, and what changed in them (doc/thresholds.md).
TRIED = "python -m benchmarks.thresholds cantilever, 29 November 2026"

# A row takes three lines, and not one for each of its parts.
# fmt: off

# Finding the beam, in finding.py

SEARCHED_PX = TABLE.cost(
    "SEARCHED_PX", 640, "px",
    "Larger pictures are reduced to it before they are searched.",
)
COARSE_PX = TABLE.cost(
    "COARSE_PX", 256, "px",
    "Of a picture in which all directions are searched.",
)
BLUR_PX = TABLE.measured(
    "BLUR_PX", 1.5, "px",
    "Sigma of the smoothing before gradients are taken. 1.5 times as large, 1 of 16 cases is decided otherwise and "
    "errors are 0.22 % larger; as small, errors are 1.6 % smaller.",
    command=TRIED,
)
STEP_RAD = TABLE.derived(
    "STEP_RAD", math.radians(1.0), "rad",
    "Between directions: half of it turns the ends of a line across COARSE_PX by 1.1 px, within the 3 px that are "
    "summed.",
)
FINE_RAD = TABLE.derived(
    "FINE_RAD", np.deg2rad(np.arange(-2.0, 2.01, 0.2)), "rad",
    "Twice the coarse step to either side; half a fine step turns the ends across SEARCHED_PX by 0.6 px.",
)
WIDTH_MIN_PX = TABLE.derived(
    "WIDTH_MIN_PX", 4, "px",
    "The two edges of a narrower strip merge under the smoothing: it is less than three of its sigmas wide.",
)
WIDTH_MAX = TABLE.measured(
    "WIDTH_MAX", 0.35, "of the shorter side",
    "A wider bright area is not taken for a cantilever. 1.5 times as large or as small, it changes nothing in 16 "
    "cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
DARK_PART = TABLE.measured(
    "DARK_PART", 0.7, "of the strength",
    "Of a dark strip, when it is compared with a bright one: between a bright beam and another body lies a dark "
    "strip, of which one edge is the beam's. With 0.8 or 0.55, nothing changes in 16 cases; with a thousand times or "
    "a thousandth of it something does.",
    command=TRIED,
)
STRIPS_MAX = TABLE.cost(
    "STRIPS_MAX", 3, "strips",
    "Of each kind, that are looked at: a pusher may show more contrast than the beam, and lies across it.",
)
APART_RAD = TABLE.measured(
    "APART_RAD", math.radians(10.0), "rad",
    "Between two strips that are not one. 1.5 times as large or as small, it changes nothing in 15 cases; a thousand "
    "times or a thousandth of it does.",
    command=TRIED,
)
ALIKE_PART = TABLE.measured(
    "ALIKE_PART", 0.8, "of the strength",
    "Of its edges, from which one between them counts: of two beams side by side, all edges alike, the outer two are "
    "not one beam. A bright rim leaves less inside. With 0.867 or 0.7, 16 cases are decided alike, and errors change "
    "by less than 0.1 %.",
    command=TRIED,
)
STRENGTH_MIN = TABLE.measured(
    "STRENGTH_MIN", 0.3, "of the strongest",
    "Of a strip other than the strongest bright and the strongest dark one, if it has the length that is known. 1.5 "
    "times as large or as small, it changes nothing in 15 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
LENGTH_TOLERANCE = TABLE.measured(
    "LENGTH_TOLERANCE", 0.06, "of the length",
    "The maker's 3 %, and as much for a calibration that is not good; a tapered tip makes the strip shorter by up to "
    "its width. 1.5 times as large or as small, it changes nothing in 15 cases; a thousand times or a thousandth of "
    "it does.",
    command=TRIED,
)
EDGE_PART = TABLE.stated(
    "EDGE_PART", 0.35, "of the 90 % quantile",
    "A strip extends as far as its edges are so strong.",
)
GAP_MAX = TABLE.measured(
    "GAP_MAX", 0.06, "of the shorter side",
    "Shorter gaps in the edges are dirt or texture, and not an end. 1.5 times as large, 1 of 15 cases is decided "
    "otherwise; as small, 1 of 15 cases is decided otherwise.",
    command=TRIED,
)
LENGTH_MIN = TABLE.measured(
    "LENGTH_MIN", 0.2, "of the shorter side",
    "Of a strip. 1.5 times as large, 1 of 15 cases is decided otherwise; as small, nothing changes.",
    command=TRIED,
)
BORDER_PX = TABLE.derived(
    "BORDER_PX", 7.0, "px",
    "An end closer to the border is out of view: the mean along the strip reaches 4 px beyond its end, and the "
    "outer 3 px are not searched.",
)
NOWHERE = TABLE.defined(
    "NOWHERE", 1 << 30, "index",
    "Beyond any line.",
)

# Edges, in edges.py

EDGE_STEPS = TABLE.derived(
    "EDGE_STEPS", 5, "steps",
    "The first finds the grey levels only; each later one moves the edge by half the reach at most, so that two "
    "bring it anywhere within reach, and two more settle it.",
)
EDGE_PIXELS_MIN = TABLE.measured(
    "EDGE_PIXELS_MIN", 12, "px",
    "Of an edge, weighted by the taper: four for each of its three unknowns. With 18, 1 of 16 cases is decided "
    "otherwise and errors are 0.62 % larger; with 8, errors change by less than 0.1 %.",
    command=TRIED,
)
EDGE_WIDTHS_PX = TABLE.measured(
    "EDGE_WIDTHS_PX", tuple(0.55 * 1.16**k for k in range(16)), "px",
    "1-sigma of edges, that are tried: from one as sharp as the pixels to 5.1 px, nearly the reach, 16 % apart, as a "
    "parabola interpolates between them. 1.5 times as large or as small, 16 cases are decided alike, and errors "
    "change by 1.8 % at most.",
    command=TRIED,
)
TINY = TABLE.defined(
    "TINY", 1e-30, "any",
    "Keeps divisions from zero: below any variance, which is at least 1e-26 m^2.",
)
WIDTH_SIGMAS = TABLE.derived(
    "WIDTH_SIGMAS", 4.5, "sigma",
    "By which the displacements of the two edges may differ; beyond, one belongs to another body. By chance one of "
    "150 000 (normal, both sides).",
)

# The beam at rest, in undeformed.py

REACH_PX = TABLE.stated(
    "REACH_PX", 6.0, "px",
    "From an edge, up to which pixels are used: five times the width that a focused one has.",
)
EDGE_FIRST_PX = TABLE.cost(
    "EDGE_FIRST_PX", 1.1, "px",
    "Width (1-sigma) of an edge, until it is fitted.",
)
BLOCK_PX = TABLE.derived(
    "BLOCK_PX", 2.0 * REACH_PX, "px",
    "Length of a block along the beam: as long as the pixels that count reach across an edge, to either side.",
)
BLOCKS_MIN = TABLE.measured(
    "BLOCKS_MIN", 6, "blocks",
    "With both edges: a fit with four unknowns needs some more. With 9 or 4, nothing changes in 16 cases; with a "
    "thousand times or a thousandth of it something does.",
    command=TRIED,
)
BLOCKS_PART_MIN = TABLE.measured(
    "BLOCKS_PART_MIN", 0.6, "of the blocks",
    "With both edges. A beam at rest shows all of them, but for dirt; on the texture of the ground, chance was seen "
    "to find a quarter to two fifths. With 0.733 or 0.4, nothing changes in 16 cases; with a thousand times or a "
    "thousandth of it something does.",
    command=TRIED,
)
REACH_MAX = TABLE.measured(
    "REACH_MAX", 1.5, "half widths",
    "The fit of one edge of a narrow beam must not include the other. 1.5 times as large, errors are 1 % smaller; as "
    "small, 1 of 16 cases is decided otherwise, errors are 9.6 % larger and those of one case 200 % larger.",
    command=TRIED,
)
END_SEARCH_PX = TABLE.measured(
    "END_SEARCH_PX", 14.0, "px",
    "From the ends of the strip, in which those of the beam are searched. 1.5 times as large or as small, 9 cases are "
    "decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
HOLDER_FROM_PX = TABLE.measured(
    "HOLDER_FROM_PX", 3.0, "px",
    "From the beam, where the fit of the holder's edge begins: beyond the blur of the beam's edge. 1.5 times as large "
    "or as small, 9 cases are decided alike, and errors change by 0.28 % at most.",
    command=TRIED,
)
HOLDER_TO_PX = TABLE.measured(
    "HOLDER_TO_PX", 24.0, "px",
    "And where it ends: the holder may be taken for straight so far. 1.5 times as large or as small, 9 cases are "
    "decided alike, and errors change by 2.6 % at most.",
    command=TRIED,
)
HOLDER_STEPS = TABLE.cost(
    "HOLDER_STEPS", 3, "steps",
    "Of the fit of its slope; each leaves less than a tenth of the error.",
)

# The free end, in tip.py

TIP_SEARCH = TABLE.measured(
    "TIP_SEARCH", 3.0, "half widths",
    "Before and beyond the expected end, in which it is searched: a taper is rarely longer than one and a half times "
    "as wide. 1.5 times as large or as small, 15 cases are decided alike, and errors change by 0.22 % at most.",
    command=TRIED,
)
APEX_BIN_PX = TABLE.measured(
    "APEX_BIN_PX", 1.5, "px",
    "Of a bin along the beam: more than a pixel, so that none is empty. 1.5 times as large, errors are 0.17 % "
    "smaller; as small, 1 of 15 cases is decided otherwise and errors are 0.54 % larger.",
    command=TRIED,
)
MIDDLE_PART = TABLE.measured(
    "MIDDLE_PART", 0.2, "half widths",
    "The middle of the beam, whose brightness shows the end. 1.5 times as large or as small, 15 cases are decided "
    "alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
FLANK_MAX = TABLE.measured(
    "FLANK_MAX", 4.0, "half widths",
    "The longest flank. 1.5 times as large, errors change by less than 0.1 %; as small, 1 of 15 cases is decided "
    "otherwise.",
    command=TRIED,
)
STRAIGHT_PART = TABLE.measured(
    "STRAIGHT_PART", 0.5, "half widths",
    "Of the straight sides, that the outline includes, so that it shows where they begin. 1.5 times as large or as "
    "small, 15 cases are decided alike, and errors change by 0.1 % at most.",
    command=TRIED,
)
STRAIGHT_MIN_PX = TABLE.derived(
    "STRAIGHT_MIN_PX", BLOCK_PX, "px",
    "At least one block.",
)
TIP_BLOCK_MIN_PX = TABLE.stated(
    "TIP_BLOCK_MIN_PX", 4.0, "px",
    "A block of the outline is a quarter of the half width long, up to BLOCK_PX, so that a narrow beam has enough "
    "of them, and no shorter than an edge is wide.",
)
CORNER_WIDTHS = TABLE.measured(
    "CORNER_WIDTHS", 2.0, "edge widths",
    "From a corner of the outline, in which edges are not fitted: the beam spot rounds them. 1.5 times as large or as "
    "small, 15 cases are decided alike, and errors change by 0.66 % at most.",
    command=TRIED,
)
CORNER_RAD = TABLE.measured(
    "CORNER_RAD", 0.3, "rad/px",
    "Of the outline, above which it has a corner; a semicircle of 5 px has 0.2. 1.5 times as large or as small, 15 "
    "cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
TIP_STEPS = TABLE.cost(
    "TIP_STEPS", 8, "steps",
    "Each with a robust linear fit of three unknowns: some bring the outline to edges that are off by the reach of "
    "a block.",
)
SETTLED_PX = TABLE.cost(
    "SETTLED_PX", 0.02, "px",
    "Smaller steps end the fit.",
)
SHORT_REACH = TABLE.measured(
    "SHORT_REACH", 2.0 / 3.0, "of the reach",
    "With which the free end is fitted once more, to see what a rim or a halo moves it by: four pixels still hold an "
    "edge with its blur. With 0.778 or 0.5, 14 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
ROUGH_APEX_PX = TABLE.measured(
    "ROUGH_APEX_PX", 2.0, "px",
    "1-sigma of the apex as the brightness of the middle of the beam alone shows it. 1.5 times as large or as small, "
    "16 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
LOSS_MAX = TABLE.derived(
    "LOSS_MAX", TUKEY_CONSTANT**2 / 3.0, "chi-square",
    "Of a rejected block: Tukey's loss beyond his constant c, c^2 / 3.",
)
BLOCKS_SPARE = TABLE.measured(
    "BLOCKS_SPARE", 3, "blocks",
    "Beyond the unknowns, that show the scatter. With 4, 1 of 15 cases is decided otherwise; with 2, nothing changes.",
    command=TRIED,
)
WEIGHT_MIN = TABLE.measured(
    "WEIGHT_MIN", 0.05, "of a full weight",
    "An edge of a smaller weight does not count as used. 1.5 times as large or as small, it changes nothing in 16 "
    "cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)

# Undistorted coordinates, in plane.py

NODE_SPACING_PX = TABLE.cost(
    "NODE_SPACING_PX", 10.0, "px",
    "Of the nodes at which the distortion is undone, a hundredth of the pixels: it is smooth, and a spline through "
    "the nodes gives the others.",
)
NODE_DEGREE = TABLE.derived(
    "NODE_DEGREE", 5, "degree",
    "Of that spline, the highest that FITPACK has.",
)

# The drift of the ground, in background_drift.py

ROUGH_SIDE_PX = TABLE.cost(
    "ROUGH_SIDE_PX", 256, "px",
    "The rough drift is measured in a picture whose shorter side is reduced to between this and twice as much.",
)
TILES = TABLE.measured(
    "TILES", 4, "tiles",
    "Along the shorter side. With 6 or 3, 16 cases are decided alike, and errors change by 1 % at most.",
    command=TRIED,
)
INDEPENDENT_PX = TABLE.stated(
    "INDEPENDENT_PX", 1.0, "px",
    "Of the reduced picture, from the median, beyond which a region moves by itself: ten times the error of the "
    "median.",
)
TILE_MIN_PX = TABLE.measured(
    "TILE_MIN_PX", 64, "px",
    "A smaller tile holds too little texture for a peak that stands out. With 96 or 43, 16 cases are decided alike, "
    "and errors change by 0.28 % at most.",
    command=TRIED,
)
TILES_MIN = TABLE.derived(
    "TILES_MIN", 3, "tiles",
    "The median of three is right even if one of them is wrong.",
)
BEAM_PART_MAX = TABLE.measured(
    "BEAM_PART_MAX", 0.5, "of a tile",
    "That the beam may cover. 1.5 times as large or as small, 16 cases are decided alike, and errors change by 0.62 % "
    "at most.",
    command=TRIED,
)
CELL_PX = TABLE.measured(
    "CELL_PX", 8, "px",
    "Side of the cells in which changes are detected. With 12, errors are 3.5 % smaller and those of one case 39 % "
    "larger; with 5, 1 of 16 cases is decided otherwise and errors are 1.4 % smaller.",
    command=TRIED,
)
CELL_LIMIT = TABLE.measured(
    "CELL_LIMIT", 4.0, "of 1 / sqrt(n)",
    "By which a cell may exceed the usual range of n frames: noise was seen to do so in 1 of 10^4 cells. 1.5 times as "
    "large, errors are 4.2 % larger and those of one case 62 % larger; as small, errors are 5.3 % larger and those of "
    "one case 41 % larger.",
    command=TRIED,
)
ROUGH_ERROR_PX = TABLE.derived(
    "ROUGH_ERROR_PX", 0.4, "px",
    "Error of the rough drift to either side: 0.1 px of a picture that is reduced four times. It changes a static "
    "edge by twice as much times its slope.",
)
DRIFT_PASSES = TABLE.measured(
    "DRIFT_PASSES", 3, "passes",
    "Of the tracker. Covered areas that do not move with the drift were seen to pull it towards their shift, by 3 nm "
    "where that is 2 px wrong; so it is tracked again with the drift that was found. With 4 or 2, nothing changes in "
    "16 cases; with a thousand times or a thousandth of it something does.",
    command=TRIED,
)
SAME_DRIFT_PX = TABLE.measured(
    "SAME_DRIFT_PX", 0.15, "px",
    "Unless it differs by less from the one that was used: a tenth of an error that does harm. 1.5 times as large or "
    "as small, 16 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
MOVING_CELLS_MIN = TABLE.measured(
    "MOVING_CELLS_MIN", 4, "cells",
    "Of a body that change, from which it moves. With 6 or 3, 16 cases are decided alike, and errors change by 0.44 % "
    "at most.",
    command=TRIED,
)
MOVING_PART_MIN = TABLE.measured(
    "MOVING_PART_MIN", 0.03, "of its cells",
    "And this part of them: in a large body a few exceed the limit by chance. 1.5 times as large or as small, 16 "
    "cases are decided alike, and errors change by 0.44 % at most.",
    command=TRIED,
)
STILL_WEIGHT = TABLE.measured(
    "STILL_WEIGHT", 0.99, "of a full weight",
    "Of pixels that show nothing of the cover. With 0.993 or 0.985, 16 cases are decided alike, and errors change by "
    "1.6 % at most.",
    command=TRIED,
)
TEXTURE_SIDE_PX = TABLE.derived(
    "TEXTURE_SIDE_PX", 32, "px",
    "Of a square of such pixels, in which the noise is measured: the corners of its spectrum have some 70 "
    "coefficients, half of them independent, which tell the power to 1 / sqrt(35) = 17 %.",
)
STRIP_SIDE_PX = TABLE.derived(
    "STRIP_SIDE_PX", TEXTURE_SIDE_PX // 2, "px",
    "A strip of the same area may be half as wide.",
)
TEXTURE_ASPECTS = TABLE.cost(
    "TEXTURE_ASPECTS", (0.125, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0), "ratio",
    "Width over height of the rectangles that are tried.",
)
SOFT_PX = TABLE.measured(
    "SOFT_PX", 3.0, "px",
    "Sigma of the soft rim of a covered area: a sharp rim would be an edge for the tracker. 1.5 times as large or as "
    "small, 16 cases are decided alike, and errors change by 0.65 % at most.",
    command=TRIED,
)
FILL_PX = TABLE.measured(
    "FILL_PX", 14.0, "px",
    "Sigma over which the ground fills a covered area: several widths of its rim. 1.5 times as large or as small, 16 "
    "cases are decided alike, and errors change by 2.4 % at most.",
    command=TRIED,
)

# Bending, in bending.py

ROTATION_SIGMA_RAD = TABLE.measured(
    "ROTATION_SIGMA_RAD", 1e-5, "rad",
    "1-sigma of the rotation between frames: raster and clamp are that stable. 1.5 times as large or as small, 12 "
    "cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
SHAPE_PRIOR = TABLE.measured(
    "SHAPE_PRIOR", (-0.25, 0.35), "shape factor",
    "Mean and 1-sigma of an unknown shape c: both the parabola, 0, and a beam that is loaded at its end, -1/2, are "
    "likely; the mean is between them. 1.5 times as large, errors are 1.6 % larger and those of one case 60 % larger; "
    "as small, errors are 4.9 % larger and errors over sigma 10 % larger.",
    command=TRIED,
)
LOADED_PART = TABLE.measured(
    "LOADED_PART", (0.8, 1.0), "of the length",
    "Where a beam is loaded if nothing shows the place. 1.5 times as large or as small, 16 cases are decided alike, "
    "and errors change by 2.2 % at most.",
    command=TRIED,
)
POINT_LOAD_SIGMA = TABLE.measured(
    "POINT_LOAD_SIGMA", 0.03, "shape factor",
    "1-sigma of c of a beam that is pushed at a known place: its section is not the same everywhere, and what pushes "
    "it is no point. A load that is 3 % of the length elsewhere changes c by as much. 1.5 times as large or as small, "
    "11 cases are decided alike, and errors change by 0.56 % at most.",
    command=TRIED,
)
POINT_LOAD_PROBABILITY = TABLE.measured(
    "POINT_LOAD_PROBABILITY", 0.5, "chance",
    "That a beam is loaded at one place, before anything is seen: as likely as not. 1.5 times as large or as small, "
    "11 cases are decided alike, and errors change by 3 % at most.",
    command=TRIED,
)
LOAD_PLACE_MIN = TABLE.measured(
    "LOAD_PLACE_MIN", 0.4, "of the length",
    "From the base, that can be told from a load at it: there, c grows beyond all limits. 1.5 times as large or as "
    "small, it changes nothing in 11 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
PUSHED_PART = TABLE.measured(
    "PUSHED_PART", 0.3, "of the largest deflection",
    "Frames in which the beam is bent by so much show what it is pushed by. 1.5 times as large or as small, 11 cases "
    "are decided alike, and errors change by 0.72 % at most.",
    command=TRIED,
)
HIDDEN_PART = TABLE.measured(
    "HIDDEN_PART", 0.5, "of these frames",
    "In which both edges are unusable, where it is pushed. 1.5 times as large or as small, it changes nothing in 11 "
    "cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
ROBUST_ROUNDS = TABLE.cost(
    "ROBUST_ROUNDS", 12, "rounds",
    "Of reweighting, which converges long before.",
)
FREE_TERMS = TABLE.defined(
    "FREE_TERMS", 4, "unknowns",
    "Of a fit with a free shape: rotation, shift, and the factors of u^2 and u^3.",
)
EDGES_MIN = TABLE.derived(
    "EDGES_MIN", FREE_TERMS + 2, "edges",
    "In a fit: two more than unknowns show the scatter.",
)
BENT_FRAMES_MIN = TABLE.measured(
    "BENT_FRAMES_MIN", 4, "frames",
    "In which an edge is seen, that show whether its residual grows with the deflection. With 6, errors over sigma "
    "are 18 % larger; with 3, errors are 0.38 % larger.",
    command=TRIED,
)
BENT_SPREAD_MIN = TABLE.measured(
    "BENT_SPREAD_MIN", 5.0, "sigma",
    "Of one frame, by which their deflections have to spread: of frames that are bent alike, noise would seem to grow "
    "with it. 1.5 times as large or as small, 12 cases are decided alike, and errors change by 0.76 % at most.",
    command=TRIED,
)

# Magnifications beside each other, in repeatability.py

SPREAD_RATIO = TABLE.derived(
    "SPREAD_RATIO", 2.5, "ratio",
    "Spread over what the sigmas predict, from which a note says so: of three magnifications by chance one in 520, "
    "exp(-2.5^2), even if the errors of all poses are the same.",
)
OTHER_WIDTH = TABLE.stated(
    "OTHER_WIDTH", 1.15, "ratio",
    "Of the widths at two magnifications, from which they are those of two bodies: focus widens a beam of some 50 "
    "px by a few per cent.",
)

# Series, in series.py

SAME_STEP = TABLE.measured(
    "SAME_STEP", (0.5, 1.6), "ratio",
    "Of an edge's step to that in the reference, within which it is the same edge. 1.5 times as large, errors are "
    "0.37 % larger; as small, 1 of 12 cases is decided otherwise, there are 8.3 % fewer points or frames, errors are "
    "16 % larger and errors over sigma 33 % larger.",
    command=TRIED,
)
MAKER_TOLERANCE = TABLE.stated(
    "MAKER_TOLERANCE", 0.03, "of the length",
    "What makers of cantilevers state; a larger difference is told. Uniform between limits, it has a 1-sigma of 1.7 "
    "%.",
)
LENGTH_SIGMAS = TABLE.derived(
    "LENGTH_SIGMAS", 3.0, "sigma",
    "Of the difference of measured and given length, beyond which one is wrong: by chance one of 370 (normal, both "
    "sides) if all of it were noise.",
)
LENGTH_MAX = TABLE.measured(
    "LENGTH_MAX", 50.0, "fields of view",
    "A longer beam has the wrong unit: no bending would be seen. 1.5 times as large or as small, it changes nothing "
    "in 16 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
SHAPE_SIGMAS = TABLE.derived(
    "SHAPE_SIGMAS", 3.0, "sigma",
    "Of the shape of the bending from a given one, that is told: by chance one of 370 (normal, both sides).",
)
DEFLECTION_MAX = TABLE.measured(
    "DEFLECTION_MAX", 0.04, "of the length",
    "In the search, if none is given. It covers the area beside the beam, and a wider one may find other bodies. 1.5 "
    "times as large or as small, 16 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
DEFLECTION_ABSURD = TABLE.measured(
    "DEFLECTION_ABSURD", 1.5, "largest deflections",
    "A fit beyond has found something other than the beam. 1.5 times as large or as small, it changes nothing in 12 "
    "cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
SLIP_PX = TABLE.measured(
    "SLIP_PX", 5.0, "px",
    "Along the strip, median, by which its end lies elsewhere than in the reference, from which it is not the end of "
    "a clamped beam: bent by a 25th of its length, that one comes back by a thousandth of it. The brightness of the "
    "middle shows the end to 2 px. 1.5 times as large or as small, it changes nothing in 12 cases; a thousand times "
    "or a thousandth of it does.",
    command=TRIED,
)
BASE_SLIP_PX = TABLE.stated(
    "BASE_SLIP_PX", 1.0, "px",
    "The same of the base, whose edge is found to a fraction of a pixel.",
)
BASE_SLIP_SIGMAS = TABLE.derived(
    "BASE_SLIP_SIGMAS", 3.0, "sigma",
    "And in sigmas of it: by chance one of 370 (normal, both sides).",
)
INTERVAL_MIN = TABLE.measured(
    "INTERVAL_MIN", 0.9, "of the frame time",
    "Between two frames: less is no time at which a scan can have begun. With 0.933 or 0.85, nothing changes in 16 "
    "cases; with a thousand times or a thousandth of it something does.",
    command=TRIED,
)
NAMED_MAX = TABLE.defined(
    "NAMED_MAX", 3, "names",
    "Of regions of the ground in a note.",
)
LINE_POINTS = TABLE.defined(
    "LINE_POINTS", 65, "points",
    "Of the centre line in the results, for drawing.",
)
UNTRACKED_M = TABLE.measured(
    "UNTRACKED_M", 1e-7, "m",
    "1-sigma of the offset where the background was not tracked: so large that the base alone determines it. 1.5 "
    "times as large or as small, 12 cases are decided alike, and errors change by 0.12 % at most.",
    command=TRIED,
)
