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


"""The numbers of the search for corners, each with its source.

In the order of the modules that use them first. "Seen" stands for what was observed when the number was chosen.
"""

from __future__ import annotations

import numpy as np

from semcal_ros.core.thresholds import Table

TABLE = Table()

# Of the measured rows: each says in how many pictures it was tried, and what changed in them (doc/thresholds.md).
TRIED = "python -m benchmarks.thresholds corners, 26 November 2026"

# A row takes three lines, and not one for each of its parts.
# fmt: off

# Saddle points, in lattice.py

SADDLE_THRESHOLD = TABLE.derived(
    "SADDLE_THRESHOLD", 0.1, "of the strong response",
    "A weaker maximum counts as noise. The response is quadratic in the contrast, so a third of it leaves 1/9.",
)
STRONG_RANK = TABLE.measured(
    "STRONG_RANK", 12, "rank",
    "The response at this rank stands for the strong saddles: a usable image has as many corners, and a few "
    "specks brighter than the board do not set the threshold. With 8 or 18, 9 pictures are decided alike, and "
    "errors change by 0.92 % at most.",
    command=TRIED,
)
SADDLES_MIN = TABLE.cost(
    "SADDLES_MIN", 6000, "points",
    "Saddle points kept at most, of a small image.",
)
SADDLE_AREA = TABLE.cost(
    "SADDLE_AREA", 5.0, "scale^2",
    "And of a large one, one for each such area: saddle points are four scales apart, 16 scale^2, and there may "
    "be three times as many.",
)
SATURATED_MAX = TABLE.derived(
    "SATURATED_MAX", 0.5, "of the image",
    "The squares of one colour cover half: where more is at a limit of the grey values, neither colour is free of "
    "it.",
)
IMAGE_SIDE_MIN_PX = TABLE.stated(
    "IMAGE_SIDE_MIN_PX", 32, "px",
    "Smaller images are refused: hardly a dozen corners of squares of 6 px fit in.",
)

# Growing a lattice, in lattice.py

SEED_NEIGHBOURS = TABLE.derived(
    "SEED_NEIGHBOURS", 20, "points",
    "Where the four neighbours of a seed are looked for: the first four shells of a square lattice, 4 + 4 + 4 + "
    "8.",
)
SEED_ASYMMETRY_MAX = TABLE.derived(
    "SEED_ASYMMETRY_MAX", 0.25, "of the length",
    "Sum of two opposite arms over their length: half of 0.5, which arms of one and of three squares give.",
)
SEARCH_RADIUS = TABLE.derived(
    "SEARCH_RADIUS", 0.3, "squares",
    "About a prediction; below 0.5, so that a point cannot be nearer to the prediction of the next cell.",
)
SEEDS_TRIED = TABLE.cost(
    "SEEDS_TRIED", 8, "seeds",
    "For images without a board.",
)
SEED_POINTS = TABLE.cost(
    "SEED_POINTS", 1200, "points",
    "The strongest, among which seeds are looked for: one seed in the middle of a board is enough.",
)
CELLS_TO_RIM_MAX = TABLE.cost(
    "CELLS_TO_RIM_MAX", 1400, "cells",
    "From the seed to the rim: with more than 1000 in a row, a tenth of a gigabyte.",
)

SADDLE_DIRECTION_MAX_DEG = TABLE.stated(
    "SADDLE_DIRECTION_MAX_DEG", 28.0, "deg",
    "Between an arm and the direction of its saddle: in skewed cells directions are off by a few degrees, and "
    "noise adds to that.",
)

# Local maps, in local_map.py

CUBIC_BELOW = TABLE.stated(
    "CUBIC_BELOW", 300, "corners",
    "With more, squares are small and a quadratic over 5 x 5 corners follows any lens; with fewer the third order "
    "matters.",
)
SECOND_ORDER_RIDGE = TABLE.derived(
    "SECOND_ORDER_RIDGE", 1e-2, "weight of a neighbour",
    "Holds terms at zero that the neighbours do not determine; among all neighbours of a 5 x 5 block it takes 0.9 "
    "thousandths off a bend.",
)
THIRD_ORDER_RIDGE = TABLE.stated(
    "THIRD_ORDER_RIDGE", 3e-2, "weight of a neighbour",
    "Larger, since few neighbours determine the third order worse.",
)
SUPPORT_MIN = TABLE.derived(
    "SUPPORT_MIN", 3, "neighbours",
    "Three points determine an affine map.",
)

# Windows of corners, in edge_model.py

WINDOW_HALF_WIDTH = TABLE.derived(
    "WINDOW_HALF_WIDTH", 0.5, "squares",
    "Windows of neighbours just touch: no pixel is used twice, and the errors are independent.",
)
WINDOW_BLOCK_PIXELS = TABLE.cost(
    "WINDOW_BLOCK_PIXELS", 60000.0, "px",
    "In the boxes that are searched at a time, to stay in the cache.",
)

# The model of a corner, in edge_model.py

NEIGHBOUR_BLURS = TABLE.derived(
    "NEIGHBOUR_BLURS", 8.0, "blur widths",
    "Parallel edges at this distance are half of it beyond the end of the window: four widths, where 3e-5 of the "
    "step is left.",
)

ERF_P = TABLE.derived(
    "ERF_P", 0.3275911, "1",
    "erf(z) = sign(z) (1 - t (c1 + t (c2 + ...)) exp(-z^2)), t = 1 / (1 + p |z|): Abramowitz and Stegun 7.1.26, "
    "error below 1.5e-7, as of single precision.",
)
ERF_C = TABLE.derived(
    "ERF_C", (0.254829592, -0.284496736, 1.421413741, -1.453152027, 1.061405429), "1",
    "c1 to c5 of the same.",
)

# Priors of the fit of corners, in corner_fit.py

ANGLE_PRIOR = TABLE.derived(
    "ANGLE_PRIOR", 0.03, "rad",
    "Edge about that of the local map: saddle points good to 0.3 px, over a square of 10 px.",
)
LOG_BLUR_PRIOR = TABLE.measured(
    "LOG_BLUR_PRIOR", 0.5, "log",
    "A factor of 1.65 about the first guess. 1.5 times as large or as small, 3 pictures are decided alike, and "
    "errors change by 0.9 % at most.",
    command=TRIED,
)
SAGITTA_PRIOR_PX = TABLE.measured(
    "SAGITTA_PRIOR_PX", 0.5, "px",
    "Error of a map through few, one-sided neighbours under a strong distortion, for squares of LARGE_SQUARE_PX; "
    "it grows as the third power of the square. 1.5 times as large, errors change by 0.8 %; as small, errors over "
    "sigma are 5.1 % smaller (3 pictures).",
    command=TRIED,
)
LARGE_SQUARE_PX = TABLE.derived(
    "LARGE_SQUARE_PX", 130.0, "px",
    "About a quarter of a 512 px image.",
)
GRADIENT_PRIOR = TABLE.measured(
    "GRADIENT_PRIOR", 0.15, "contrast of the image",
    "Shading over half a square. 1.5 times as large or as small, 3 pictures are decided alike, and errors change "
    "by 4.3 % at most.",
    command=TRIED,
)
GRADIENT_LEAST = TABLE.derived(
    "GRADIENT_LEAST", 0.003, "grey range",
    "Least deviation of a gradient that the neighbours predict: just below the step of an 8-bit image, 1 / 255.",
)
GROWTH_PRIOR_PX = TABLE.measured(
    "GROWTH_PRIOR_PX", 0.3, "px x contrast",
    "Growth of the bright squares. 1.5 times as large or as small, 3 pictures are decided alike, and errors "
    "change by 1 % at most.",
    command=TRIED,
)
LIKELIHOOD_LOSS = TABLE.derived(
    "LIKELIHOOD_LOSS", 0.5, "log-likelihood",
    "Against the best spread, up to which a larger one is taken: one standard deviation, 1^2 / 2.",
)
OUTLIER_SCORE = TABLE.derived(
    "OUTLIER_SCORE", 9.0, "score^2",
    "Where an outlier's weight ends: three standard deviations, squared.",
)

PRIOR_SPREADS = TABLE.measured(
    "PRIOR_SPREADS", np.concatenate([np.geomspace(0.02, 1.0, 14), np.geomspace(1.35, 11.0, 8)]), "of the priors",
    "That are tried; those above 1 only where the corners show more than the priors allow. 1.5 times as large or "
    "as small, 3 pictures are decided alike, and errors change by 2.6 % at most.",
    command=TRIED,
)

# The fit of corners, in corner_fit.py

BLUR_MIN_PX = TABLE.derived(
    "BLUR_MIN_PX", 0.28, "px",
    "A pixel averages over its width, a blur of 1 / sqrt(12) = 0.289 px: no edge is sharper.",
)
BAND_MIN_PX = TABLE.measured(
    "BAND_MIN_PX", 3.0, "px",
    "Least half-width of the band along an edge, which leaves room for an error of the prediction. 1.5 times as "
    "large or as small, 3 pictures are decided alike, and errors change by 2.5 % at most.",
    command=TRIED,
)
BAND_BLURS = TABLE.derived(
    "BAND_BLURS", 3.0, "blur widths",
    "Half-width of the band: the slope of an edge is then exp(-3^2 / 2) = 1.1 % of its peak.",
)
NOISE_FLOOR_PART = TABLE.stated(
    "NOISE_FLOOR_PART", 0.25, "of the floor",
    "A safeguard: the line of the noise model falls below zero for dark pixels; their weights stay within a "
    "factor of four of those at their mean.",
)
FIT_BLOCK_PIXELS = TABLE.cost(
    "FIT_BLOCK_PIXELS", 24000, "px",
    "Large enough to hide the cost of a call, small enough to keep the arrays in the cache.",
)
PULL_LEAST = TABLE.measured(
    "PULL_LEAST", 0.02, "of the prior's variance",
    "Where pixels carry almost no information, rounding must not decide whether a pull is large. 1.5 times as "
    "large or as small, it changes nothing in 3 pictures; a thousand times or a thousandth of it does.",
    command=TRIED,
)
ASSUMED_VARIANCE = TABLE.measured(
    "ASSUMED_VARIANCE", 0.02, "contrast^2",
    "Of a pixel in the first pass, before the noise is known. 1.5 times as large or as small, 3 pictures are "
    "decided alike, and errors change by 0.98 % at most.",
    command=TRIED,
)

# Refining a lattice, in lattice_refinement.py

FIRST_BLUR_PX = TABLE.measured(
    "FIRST_BLUR_PX", 1.0, "px",
    "Where the first fits start; LOG_BLUR_PRIOR covers 0.37 to 2.7 px within two sigma. 1.5 times as large or as "
    "small, 3 pictures are decided alike, and errors change by 2.4 % at most.",
    command=TRIED,
)
GROW_ROUNDS = TABLE.measured(
    "GROW_ROUNDS", 4, "rounds",
    "Of filling in; each adds a ring of cells, and growing has found most of them before. With 3 or 6, it changes "
    "nothing in 3 pictures; a thousand times or a thousandth of it does.",
    command=TRIED,
)
CORNER_SAMPLE = TABLE.cost(
    "CORNER_SAMPLE", 40, "corners",
    "From which noise, blur and spreads are learnt first.",
)
HOPELESS_PART = TABLE.derived(
    "HOPELESS_PART", 0.25, "of the sample",
    "The finder asks for half of all corners in the end; a sample of 40 falls so far below a half by 3.2 standard "
    "deviations.",
)
CORNER_SECOND_SAMPLE = TABLE.cost(
    "CORNER_SECOND_SAMPLE", 160, "corners",
    "From which the spreads are learnt again, when noise and blur are known.",
)
RIM_PART = TABLE.measured(
    "RIM_PART", 0.1, "squares",
    "Corners nearer to the frame than MARGIN_PX and this may fail. 1.5 times as large or as small, it changes "
    "nothing in 3 pictures; a thousand times or a thousandth of it does.",
    command=TRIED,
)

# Checks of fitted corners, in checks.py

CONTINUED_MAX = TABLE.stated(
    "CONTINUED_MAX", 0.05, "squares",
    "Parts of one lattice continue each other so well: local maps predict the next corners across a gap to a few "
    "hundredths, and parts of another board are off by up to SEARCH_RADIUS.",
)
LEVERAGE_MAX = TABLE.stated(
    "LEVERAGE_MAX", 25.0, "variances of a corner",
    "Predictions with a larger variance reach too far across the gap.",
)
PART_MIN = TABLE.stated(
    "PART_MIN", 4, "corners",
    "Smaller parts were predicted from the corners across the gap already, and agree with them.",
)
MARGIN_PX = TABLE.measured(
    "MARGIN_PX", 2.0, "px",
    "Corners nearer to the frame are not fitted: up to half of their window is outside the image. 1.5 times as "
    "large, errors over sigma are 7.1 % smaller; as small, errors over sigma are 5.7 % smaller (3 pictures).",
    command=TRIED,
)
CONTRAST_MIN = TABLE.derived(
    "CONTRAST_MIN", 0.3, "of the median",
    "Saddle points are kept down to the root of SADDLE_THRESHOLD, 0.32.",
)
COVERAGE_MIN = TABLE.derived(
    "COVERAGE_MIN", 0.3, "of the window",
    "A corner on one side of the frame keeps half of its window and is fitted; one in a corner of it keeps a "
    "quarter and is not.",
)
ANGLE_MAX = TABLE.derived(
    "ANGLE_MAX", 0.2, "rad",
    "Between a fitted edge and the local map: 6.7 standard deviations of ANGLE_PRIOR.",
)
CHI2_MAX = TABLE.measured(
    "CHI2_MAX", 4.0, "median chi-square",
    "Residuals of more than twice the usual size do not belong to a corner. 1.5 times as large or as small, it "
    "changes nothing in 3 pictures; a thousand times or a thousandth of it does.",
    command=TRIED,
)
CHI2_EXCESS = TABLE.stated(
    "CHI2_EXCESS", 0.5, "of the median",
    "By this part a chi-square exceeds the median before a corner is disturbed; allows for differences between "
    "good corners. By trial.",
)
CHI2_SIGMAS = TABLE.derived(
    "CHI2_SIGMAS", 6.0, "sqrt(2 / freedom)",
    "And by this number of standard deviations: by chance once in 10^9 corners (normal, one side).",
)
MISFIT_VISIBLE = TABLE.stated(
    "MISFIT_VISIBLE", 0.12, "half the contrast",
    "RMS residual below which a misfit is not visible, and a corner is kept whatever its chi-square. By trial.",
)
IMBALANCE_MAX = TABLE.derived(
    "IMBALANCE_MAX", 15.0, "chi-square, 2 degrees",
    "By chance once in 1800 undisturbed corners: exp(-15 / 2).",
)
UNLIKE_MAX = TABLE.measured(
    "UNLIKE_MAX", 0.05, "half the contrast",
    "Stains of the board and shortcomings of the model. 1.5 times as large or as small, it changes nothing in 3 "
    "pictures; a thousand times or a thousandth of it does.",
    command=TRIED,
)
BORDER_UNLIKE = TABLE.derived(
    "BORDER_UNLIKE", 0.5, "CornerFit.unlike",
    "Midway: beyond the border all squares are alike, 0; at a corner of the board the fourth differs by 1.",
)
BLUR_SIGMAS = TABLE.derived(
    "BLUR_SIGMAS", 4.0, "sigma",
    "By chance once in 16 000 corners (normal, both sides), more often in the tails: the spread is that of all "
    "corners.",
)
CORNERS_COMPARED_MIN = TABLE.derived(
    "CORNERS_COMPARED_MIN", 6, "corners",
    "A quadratic map has six coefficients per coordinate: fewer corners cannot be compared with each other.",
)

# Corners against their neighbours, in checks.py

RESIDUAL_SIGMAS = TABLE.derived(
    "RESIDUAL_SIGMAS", (5.0, 4.3, 3.7), "sigma",
    "In turn. By chance the last is exceeded once in 940 corners: exp(-3.7^2 / 2); debris shifts far more of "
    "them.",
)
MAP_ERROR_PX = TABLE.stated(
    "MAP_ERROR_PX", 2.0, "px",
    "Error of local maps through squares of LARGE_SQUARE_PX under the strongest distortion, per standard "
    "deviation of a prediction; it grows as the third power of the square.",
)
MAP_ERROR_RATIO = TABLE.stated(
    "MAP_ERROR_RATIO", 4.0, "medians",
    "That error is concentrated in parts of the image.",
)
SCATTER_SIGMAS = TABLE.derived(
    "SCATTER_SIGMAS", 2.8, "sigma",
    "Scatter beyond that of chance: once in 390 images of a regular grid with independent errors (normal, one "
    "side).",
)
TREND_DEGREE = TABLE.stated(
    "TREND_DEGREE", 5, "degree",
    "Follows smooth distortions and perspectives to a few hundredths of a pixel; twice as many corners as terms "
    "keep single ones from bending it.",
)

MEDIAN_SIGMA_1 = TABLE.derived(
    "MEDIAN_SIGMA_1", 2.333, "of the median",
    "1-sigma of the median of n chi-squares of one degree, times sqrt(n): 1 / (2 x density x median) there.",
)
MEDIAN_SIGMA_2 = TABLE.derived(
    "MEDIAN_SIGMA_2", float(1.0 / np.log(2.0)), "of the median",
    "The same of two degrees of freedom: 1 / log 2.",
)

# What the motif of a cell is, in pattern.py

HARMONIC_ORDERS = TABLE.measured(
    "HARMONIC_ORDERS", 4, "order",
    "With more harmonics, small spacings would be judged by noise. With 3 or 6, it changes nothing in 9 pictures; "
    "a thousand times or a thousandth of it does.",
    command=TRIED,
)
AMBIGUOUS_RATIO = TABLE.derived(
    "AMBIGUOUS_RATIO", 2.0, "ratio of misfits",
    "Up to it both of two patterns are possible: with 28 harmonics noise exceeds it once in 28 images, F(28, 28).",
)
COMPARABLE_RATIO = TABLE.derived(
    "COMPARABLE_RATIO", 1.24, "ratio of misfits",
    "Up to it a checkerboard is presumed: odds of 20 to one with 28 harmonics, 20^(2 / 28).",
)
SHAPE_MISFIT_LEAST = TABLE.measured(
    "SHAPE_MISFIT_LEAST", 2e-4, "of the power",
    "Misfit that the steps of sizes and blurs cause. 1.5 times as large or as small, it changes nothing in 9 "
    "pictures; a thousand times or a thousandth of it does.",
    command=TRIED,
)
LINES_OPENING_MIN = TABLE.derived(
    "LINES_OPENING_MIN", 0.55, "cells",
    "Bars 0.45 of their distance wide leave as much open; square dots that wide could as well be that.",
)
MOTIF_STEP = TABLE.measured(
    "MOTIF_STEP", 1.0 / 12.0, "cells",
    "The middle of a motif is looked for in such steps, within the reach of the centre of symmetry. 1.5 times as "
    "large or as small, it changes nothing in 1 picture; a thousand times or a thousandth of it does.",
    command=TRIED,
)
SHAPES_FOR_CENTRE = TABLE.measured(
    "SHAPES_FOR_CENTRE", 7, "shapes",
    "One of so many is enough to find the centre under a relief. With 5 or 10, it changes nothing in 9 pictures; "
    "a thousand times or a thousandth of it does.",
    command=TRIED,
)
RELIEF_GAIN_MIN = TABLE.derived(
    "RELIEF_GAIN_MIN", 1.6, "ratio of powers",
    "By which a relief has to lower what is left: noise does so once in 19 000 cells, by its four numbers among "
    "56, F(4, 52).",
)
RELIEF_MISFIT_MAX = TABLE.stated(
    "RELIEF_MISFIT_MAX", 0.25, "of the power",
    "Between replicas with bright edges, seen to leave up to 0.23, and pads half as wide as their distance about "
    "the middle between two of them, 0.34.",
)
RELIEF_ASIDE_MIN = TABLE.stated(
    "RELIEF_ASIDE_MIN", 0.03, "of the power",
    "At no multiples of one frequency: between parallel lines, seen with 0.005, and crossed ones of which one "
    "direction is hardly seen, 0.05.",
)
ODDS_MAX = TABLE.defined(
    "ODDS_MAX", 1e6, "odds",
    "Odds beyond a million say nothing more.",
)

MOTIF_SIZES = TABLE.measured(
    "MOTIF_SIZES", np.linspace(0.08, 0.98, 46), "cells",
    "Diameters of discs and sides of squares that are tried. 1.5 times as large, nothing changes; as small, 1 of "
    "9 pictures is decided otherwise and 1 wrong answer more.",
    command=TRIED,
)
CHESS_SIZES = TABLE.measured(
    "CHESS_SIZES", np.linspace(0.82, 1.0, 10), "cells",
    "The same of the squares of a checkerboard. 1.5 times as large, 3 of 9 pictures are decided otherwise and 3 "
    "wrong answers more; as small, 3 of 9 pictures are decided otherwise and 3 wrong answers more.",
    command=TRIED,
)
MOTIF_BLURS = TABLE.measured(
    "MOTIF_BLURS", np.linspace(0.0, 0.24, 13), "cells",
    "Blurs that are tried. 1.5 times as large or as small, it changes nothing in 9 pictures; a thousand times or "
    "a thousandth of it does.",
    command=TRIED,
)
ARM_LENGTHS = TABLE.measured(
    "ARM_LENGTHS", np.linspace(0.2, 0.44, 7), "cells",
    "Half lengths of the arms of crosses, from their centre; longer ones meet, and are lines. 1.5 times as large, "
    "nothing changes; as small, 1 of 9 pictures is decided otherwise and 1 wrong answer more.",
    command=TRIED,
)
ARM_WIDTHS = TABLE.stated(
    "ARM_WIDTHS", np.linspace(0.06, 0.42, 13), "cells",
    "Widths of these arms.",
)
RIM_WIDTHS = TABLE.stated(
    "RIM_WIDTHS", np.array([0.05, 0.1]), "cells",
    "Edges are brighter than faces.",
)
RIM_DIMNESS = TABLE.stated(
    "RIM_DIMNESS", np.array([0.25, 0.5, 0.75]), "of the rim",
    "The part of its brightness that the face lacks.",
)
RELIEF_SHIFTS = TABLE.stated(
    "RELIEF_SHIFTS", np.linspace(-0.2, 0.2, 9), "cells",
    "To which a relief may have shifted the centre of symmetry.",
)

# The unit cell, in unit_cell.py

KNOTS_MIN = TABLE.stated(
    "KNOTS_MIN", 8, "knots",
    "Per cell and axis, of the smallest spacings.",
)
KNOTS_MAX = TABLE.cost(
    "KNOTS_MAX", 128, "knots",
    "One per pixel of the largest spacing holds whatever pixels let through.",
)
SAMPLES_PER_KNOT = TABLE.derived(
    "SAMPLES_PER_KNOT", 4, "samples",
    "Linear interpolation between them: an edge with a blur of one pixel then loses 0.242 / (8 x 4^2) = 0.2 % of "
    "its height.",
)
MEAN_STEPS = TABLE.stated(
    "MEAN_STEPS", 12, "steps",
    "Conjugate gradients towards the mean; more would only follow the noise between pixels.",
)
NOISE_POWERS = TABLE.derived(
    "NOISE_POWERS", 9.0, "variances",
    "Power of a Fourier coefficient from which it is kept: noise exceeds it once in 8100, exp(-9).",
)
CELL_PARAMETERS = TABLE.defined(
    "CELL_PARAMETERS", 7, "parameters",
    "x, y, gain, offset, gradient along x and y, change of blur.",
)
CELL_STEP_MAX = TABLE.stated(
    "CELL_STEP_MAX", 0.1, "spacings",
    "A longer step of a position may end in another part of the motif.",
)
CELL_BLOCK_PIXELS = TABLE.cost(
    "CELL_BLOCK_PIXELS", 200_000, "px",
    "Cells are fitted in blocks of so many pixels, for memory.",
)
LOOKUP_ROW_PIXELS = TABLE.cost(
    "LOOKUP_ROW_PIXELS", 1024, "px",
    "In a row of those that are looked up together.",
)
COARSE_BINS = TABLE.derived(
    "COARSE_BINS", 16, "bins",
    "Along a side of a coarse mean: twice the 8 that HARMONIC_ORDERS need (Nyquist).",
)
CENTRE_ORDERS = TABLE.stated(
    "CENTRE_ORDERS", (2, 3, 6), "order",
    "For the centre of symmetry, one after the other: at the first guess the phases of high orders may wrap, and "
    "they determine it best.",
)

# Dots, lines and crosses, in dots_and_lines.py

FULL_RESOLUTION_PX = TABLE.cost(
    "FULL_RESOLUTION_PX", 64.0, "px",
    "Distance between cells up to which they are classified at full resolution: 4 px for each of the COARSE_BINS.",
)
CELL_SINE_MIN = TABLE.derived(
    "CELL_SINE_MIN", 0.25, "sine",
    "Between the axes of a cell: a tilt of 75 degrees makes it so acute, cos 75 = 0.26.",
)
MIXTURE_MIN = TABLE.stated(
    "MIXTURE_MIN", 0.5, "variances of the mean",
    "Mean square difference from which two kinds of cells are not alike; dots and gaps were seen to differ by "
    "several, noise by a hundredth at a signal to noise ratio of 1.",
)
MIXTURE_ROUNDS = TABLE.stated(
    "MIXTURE_ROUNDS", 2, "rounds",
    "Of telling two kinds apart.",
)
CELL_SAMPLE = TABLE.cost(
    "CELL_SAMPLE", 60, "cells",
    "That are averaged: an eighth of the noise remains.",
)
CELL_SAMPLE_PIXELS = TABLE.cost(
    "CELL_SAMPLE_PIXELS", 400_000, "px",
    "In these cells, at most.",
)
CELL_SAMPLE_MIN = TABLE.stated(
    "CELL_SAMPLE_MIN", 12, "cells",
    "Whatever their size.",
)
COARSE_SAMPLE = TABLE.cost(
    "COARSE_SAMPLE", 40, "cells",
    "For the classification, which needs less.",
)
COARSE_SAMPLE_PIXELS = TABLE.cost(
    "COARSE_SAMPLE_PIXELS", 100_000, "px",
    "But as many pixels of small cells as of large ones.",
)
MEAN_ROUNDS = TABLE.stated(
    "MEAN_ROUNDS", 3, "rounds",
    "Of mean and fit: positions from saddle points smear the first mean, and the second was seen to have "
    "converged.",
)
LAST_ROUNDS = TABLE.stated(
    "LAST_ROUNDS", 3, "rounds",
    "Of maps through the fitted cells and fits along these: on the rim, an error of its axes shifts a cell, and "
    "the maps are one-sided.",
)
OUTLINE_SHOWN_MIN = TABLE.stated(
    "OUTLINE_SHOWN_MIN", 0.9, "of the squared gradient",
    "Of the outline in the image; with less, an error of the local map is not told from a shift: crossings half "
    "in view were seen to be off by two sigmas.",
)
LAST_STEP_MAX_PX = TABLE.stated(
    "LAST_STEP_MAX_PX", 0.05, "px",
    "Of a fit that has converged, besides a hundredth of the spacing.",
)

# Local phases, in spectrum.py

DEMODULATION_PERIODS = TABLE.derived(
    "DEMODULATION_PERIODS", 0.75, "periods",
    "Standard deviation of the low pass behind the demodulation: harmonics are down to exp(-2 pi^2 0.75^2) = "
    "1.5e-5.",
)
PATTERN_DEMODULATION_PERIODS = TABLE.derived(
    "PATTERN_DEMODULATION_PERIODS", 0.45, "periods",
    "Of a pattern, whose other frequencies are as far as its first from a multiple: down to exp(-2 pi^2 0.45^2) = "
    "1.8 %.",
)
PHASE_DEGREE = TABLE.stated(
    "PHASE_DEGREE", 5, "degree",
    "Of the smooth part of the phase; the rest is added to it.",
)
PHASE_PLACES_MAX = TABLE.cost(
    "PHASE_PLACES_MAX", 128, "places",
    "Across a picture, at which the phase is compared with the next.",
)
LINES_AMPLITUDE_MIN = TABLE.measured(
    "LINES_AMPLITUDE_MIN", 0.3, "of the median",
    "Below it there are no lines, such as under debris or beyond the end of the grating. 1.5 times as large or as "
    "small, 3 pictures are decided alike, and errors change by 1.1 % at most.",
    command=TRIED,
)
LOST_PHASE_RAD = TABLE.measured(
    "LOST_PHASE_RAD", 2.0, "rad",
    "Residual phase beyond which lines were not followed; half a period is pi. 1.5 times as large or as small, it "
    "changes nothing in 3 pictures; a thousand times or a thousandth of it does.",
    command=TRIED,
)

# Spectra, in spectrum.py

SPECTRUM_PX = TABLE.cost(
    "SPECTRUM_PX", 1024, "px",
    "Side of the part, at each scale, in which the frequency is looked for.",
)
PERIODS_MIN = TABLE.measured(
    "PERIODS_MIN", 3.5, "periods",
    "In the part, that are looked for. 1.5 times as large or as small, it changes nothing in 4 pictures; a "
    "thousand times or a thousandth of it does.",
    command=TRIED,
)
PERIOD_MIN_PX = TABLE.measured(
    "PERIOD_MIN_PX", 5.0, "px",
    "The shortest period that is looked for. 1.5 times as large or as small, 4 pictures are decided alike, and "
    "errors change by 0.52 % at most.",
    command=TRIED,
)
SUBMULTIPLE_POWER = TABLE.derived(
    "SUBMULTIPLE_POWER", 50.0, "usual power",
    "At a part of the frequency, that makes it the frequency: noise exceeds fifty lower quartiles once in 1.8 "
    "million values, 0.75^50.",
)
SIDE_LOBE_POWER = TABLE.derived(
    "SIDE_LOBE_POWER", 1e-3, "power of the frequency",
    "Side lobes of the Hann window are below: 7e-4, doi:10.1109/PROC.1978.10837.",
)
WINDOW_LOBE_BINS = TABLE.derived(
    "WINDOW_LOBE_BINS", 3.0, "bins",
    "Beside the direction of the lines that belong to them: half of the main lobe of the Hann window is two.",
)
BENT_LINES_PART = TABLE.measured(
    "BENT_LINES_PART", 0.1, "of the frequency",
    "A distortion may bend lines by so much; it has as many bins. 1.5 times as large or as small, it changes "
    "nothing in 3 pictures; a thousand times or a thousandth of it does.",
    command=TRIED,
)
MULTIPLES_COMPARED = TABLE.measured(
    "MULTIPLES_COMPARED", 2.2, "multiples",
    "Frequencies of the lines are compared up to it. 1.5 times as large or as small, it changes nothing in 3 "
    "pictures; a thousand times or a thousandth of it does.",
    command=TRIED,
)
FREQUENCY_OFF_BINS = TABLE.stated(
    "FREQUENCY_OFF_BINS", 1.0, "bins",
    "To which frequencies are known.",
)
FREQUENCY_UNSURE_PART = TABLE.stated(
    "FREQUENCY_UNSURE_PART", 0.02, "of the frequency",
    "And where a distortion bends lines.",
)
PEAKS_MAX = TABLE.cost(
    "PEAKS_MAX", 12, "peaks",
    "Of a spectrum, the clearest.",
)
FAINT_PEAK = TABLE.stated(
    "FAINT_PEAK", 5e-3, "of the clearest",
    "From which a maximum counts: those of a hole's edge are mostly below.",
)
MULTIPLE_POWER_RATIO = TABLE.measured(
    "MULTIPLE_POWER_RATIO", 10.0, "ratio of powers",
    "From which the lines are followed by a multiple. 1.5 times as large or as small, 3 pictures are decided "
    "alike, and errors change by 0.52 % at most.",
    command=TRIED,
)
HIGHEST_HARMONIC = TABLE.measured(
    "HIGHEST_HARMONIC", 9, "order",
    "Of narrow lines many harmonics are as strong as the fundamental, and a hole has the less power the higher "
    "they are. With 6 or 14, it changes nothing in 3 pictures; a thousand times or a thousandth of it does.",
    command=TRIED,
)
EVERYWHERE_RATIO = TABLE.derived(
    "EVERYWHERE_RATIO", 2.5, "medians of others",
    "From which a frequency is everywhere: of noise alone, medians over twenty independent places scatter by 15 "
    "%, so that it is ten of their deviations above.",
)
PLACES_ACROSS = TABLE.measured(
    "PLACES_ACROSS", 16, "places",
    "The low pass as a part of the picture: a hole of a third of the side then reaches a quarter of the places. "
    "With 11 or 24, it changes nothing in 3 pictures; a thousand times or a thousandth of it does.",
    command=TRIED,
)
OTHER_DIRECTIONS_DEG = TABLE.measured(
    "OTHER_DIRECTIONS_DEG", (25.0, 50.0, 75.0, 105.0, 130.0, 155.0), "deg",
    "With which a frequency is compared; of a square lattice, 90 degrees would be another of its frequencies. 1.5 "
    "times as large or as small, it changes nothing in 3 pictures; a thousand times or a thousandth of it does.",
    command=TRIED,
)
CLIPPED_PART = TABLE.measured(
    "CLIPPED_PART", 0.2, "of the pixels",
    "Whose grey levels are clipped at either end: holes and debris in a fifth of the picture have no more "
    "contrast than lines that take more than that of their period. 1.5 times as large or as small, 4 pictures are "
    "decided alike, and errors change by 0.36 % at most.",
    command=TRIED,
)
USUAL_QUANTILE = TABLE.measured(
    "USUAL_QUANTILE", 0.25, "quantile",
    "Of the power in a ring, that stands for what is usual there; of noise it is -log(0.75) = 0.288 of the mean. "
    "1.5 times as large or as small, it changes nothing in 4 pictures; a thousand times or a thousandth of it "
    "does.",
    command=TRIED,
)
RING_OCTAVES = TABLE.measured(
    "RING_OCTAVES", 0.25, "octaves",
    "Width of a ring: at PERIODS_MIN a lobe of the window takes half of one. 1.5 times as large or as small, it "
    "changes nothing in 4 pictures; a thousand times or a thousandth of it does.",
    command=TRIED,
)

# Crossed waves, in crossed_waves.py

CLEAR_POWER = TABLE.derived(
    "CLEAR_POWER", 100.0, "usual power",
    "From which a frequency counts: noise exceeds a hundred lower quartiles once in 3 x 10^12 values, 0.75^100.",
)
FREQUENCIES_MAX = TABLE.cost(
    "FREQUENCIES_MAX", 24, "frequencies",
    "That are looked at, the clearest.",
)
BASES_TRIED = TABLE.cost(
    "BASES_TRIED", 48, "frequencies",
    "Of their parts, sums and differences, the lowest, of which two are tried as a basis.",
)
BASIS_PARTS = TABLE.stated(
    "BASIS_PARTS", 3, "parts",
    "Down to a third of a frequency: of thin lines any harmonics may be the strong ones.",
)
BASIS_SINE_MIN = TABLE.derived(
    "BASIS_SINE_MIN", 0.7, "sine",
    "Between the frequencies of a basis: a square tilted about its diagonal by 66 degrees.",
)
BASIS_RATIO_MAX = TABLE.derived(
    "BASIS_RATIO_MAX", 1.9, "ratio",
    "Of their lengths: a square tilted about a side by 58 degrees, 1 / cos 58.",
)
EXPLAINED_MIN = TABLE.stated(
    "EXPLAINED_MIN", 0.95, "of the root powers",
    "That the basis has to explain: a foreign frequency is debris.",
)
FOLLOWED_AMONG = TABLE.stated(
    "FOLLOWED_AMONG", 8, "frequencies",
    "Of so many of the clearest, the lowest are followed: distortions and waves change their phases least.",
)
NEWTON_STEPS = TABLE.measured(
    "NEWTON_STEPS", 6, "steps",
    "From an even lattice to the places by the phases; what has not arrived is left out. With 4 or 9, 3 pictures "
    "are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)

# Gratings, in grating.py

LINES_POWER = TABLE.derived(
    "LINES_POWER", 200.0, "median power",
    "Of the lines, over others of their size: noise has a chance of 3e-55 in half a million values, 2^-200 each.",
)
ACROSS_POWER_MAX = TABLE.measured(
    "ACROSS_POWER_MAX", 0.1, "power of the lines",
    "At a frequency that is no multiple; from there on the pattern repeats across them as well. Equal crossed "
    "lines, dots and squares have 1. 1.5 times as large or as small, it changes nothing in 3 pictures; a thousand "
    "times or a thousandth of it does.",
    command=TRIED,
)
LINES_RING_OCTAVES = TABLE.stated(
    "LINES_RING_OCTAVES", 1.0, "octaves",
    "Frequencies of the same size, either way: at PERIODS_MIN some 70 are no multiples.",
)
LINES_DEGREE = TABLE.measured(
    "LINES_DEGREE", 5, "degree",
    "Of the polynomial through all places. With 3 or 8, 2 pictures are decided alike.",
    command=TRIED,
)

# The whole search, in detection.py

SCALES_PX = TABLE.stated(
    "SCALES_PX", (2.5, 1.5, 4.2, 7.0, 12.0, 20.0, 34.0, 58.0, 99.0, 168.0, 286.0, 486.0), "px",
    "Of the search for saddle points, in steps of 1.7; a quarter of their distance is best. The first suits the "
    "small squares of low magnifications.",
)
SCALE_MAX_PART = TABLE.stated(
    "SCALE_MAX_PART", 0.075, "of the picture",
    "The largest scale.",
)
MINIMUM_CORNERS = TABLE.derived(
    "MINIMUM_CORNERS", 8, "corners",
    "A view with fewer is refused: twice as many as determine a homography, so that there are residuals to judge "
    "it by.",
)
GROWN_MIN = TABLE.derived(
    "GROWN_MIN", 6, "points",
    "Of a lattice that is considered closely: a seed and its four neighbours are five.",
)
COVERED_RATIO = TABLE.stated(
    "COVERED_RATIO", 1.5, "ratio of areas",
    "How much more of the picture a less likely pattern has to cover than a likelier one of the same lattice.",
)
FILLED_PART = TABLE.stated(
    "FILLED_PART", 0.6, "of the image",
    "A lattice whose regular squares cover so much will not be surpassed at another scale.",
)
QUALITY_MIN = TABLE.stated(
    "QUALITY_MIN", 0.5, "of the expected points",
    "That must pass: what is a grid in less than half of its points is something else, or damaged beyond use.",
)
CONVINCING_PART = TABLE.stated(
    "CONVINCING_PART", 0.8, "of the expected points",
    "That pass, beyond which no coarser picture shows more of them.",
)
FOREIGN_MAX = TABLE.stated(
    "FOREIGN_MAX", 0.15, "of the corners",
    "That do not continue the lattice: a larger part is a second board rather than cut off by debris.",
)
CELL_MISFIT_MAX = TABLE.stated(
    "CELL_MISFIT_MAX", 0.4, "of the power",
    "That no shape explains. Seen: photographs 0.006, bright rims an eighth of the pitch wide up to 0.2, a "
    "textured cross grating 0.23, cells of a lattice through noise 0.6 and more.",
)
CHESS_MISFIT_MAX = TABLE.stated(
    "CHESS_MISFIT_MAX", 0.08, "of the power",
    "Of a checkerboard nothing but growth and blur changes the cell; photographs were seen to leave up to 0.004.",
)
CELL_ASYMMETRY_MAX = TABLE.measured(
    "CELL_ASYMMETRY_MAX", 0.02, "of the power",
    "Seen: a hexagonal lattice of dots 0.05 or more, a square one with a blur of a sixth of the pitch, at 45 "
    "degrees, 0.001. 1.5 times as large or as small, it changes nothing in 8 pictures; a thousand times or a "
    "thousandth of it does.",
    command=TRIED,
)
CLEAR_MISFIT = TABLE.stated(
    "CLEAR_MISFIT", 0.02, "of the power",
    "Below it a grown lattice shows its pattern; with blurred or wrongly grown cells the fitted corners decide.",
)
SMALL_PART = TABLE.stated(
    "SMALL_PART", 0.15, "of the image",
    "A lattice that covers less must show its pattern clearly: texture repeats itself by chance.",
)
COMMON_POWER_MIN = TABLE.stated(
    "COMMON_POWER_MIN", 0.8, "of the power",
    "Common to the cells. Seen: lattices of dots and gaps two thirds or less; lattices of different scales "
    "through the same dots differ by a tenth.",
)
LATTICES_TRIED = TABLE.cost(
    "LATTICES_TRIED", 4, "lattices",
    "Of different scales, that are considered closely.",
)
CELL_FULL_PX = TABLE.cost(
    "CELL_FULL_PX", 80.0, "px",
    "Largest distance between dots that is fitted at full resolution: the time grows with its square, and sharp "
    "edges lose a tenth of their certainty at most.",
)
SPACING_MIN_PX = TABLE.stated(
    "SPACING_MIN_PX", 10.0, "px",
    "Of points in a reduced picture.",
)
SAME_AREA_LOG = TABLE.derived(
    "SAME_AREA_LOG", 0.3, "log",
    "Of the ratio of areas that are the same: below half of log 2 = 0.69, by which a lattice with every other "
    "point of another differs.",
)
ALONG_SIGMA = TABLE.derived(
    "ALONG_SIGMA", 30.0, "sides of the picture",
    "1-sigma along the lines of a grating: a million places tell lengths along them to 30 sqrt(12 / 10^6) = 10 %.",
)
UNEVEN_MAX = TABLE.measured(
    "UNEVEN_MAX", 0.04, "periods",
    "Departure of the lines of a grating from even distances. Seen: rough edges and noise as large as the "
    "contrast 0.013, three lines of a circuit 0.06. 1.5 times as large or as small, it changes nothing in 2 "
    "pictures; a thousand times or a thousandth of it does.",
    command=TRIED,
)

# Likely patterns, in pattern.py

COMMONEST = TABLE.stated(
    "COMMONEST", {"chess": 0, "dots": 1, "lines": 1, "crosses": 2}, "order",
    "What is taken for likely where nothing else decides, first to last.",
)
