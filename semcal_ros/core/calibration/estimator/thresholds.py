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

"""The numbers of the estimator, each with its source."""

from __future__ import annotations

import math

from semcal_ros.core.thresholds import Table

TABLE = Table()

# Of the measured rows: each says in how many cases it was tried, and what changed in them (doc/thresholds.md).
TRIED = "python -m benchmarks.thresholds estimator, 28 November 2026"

# A row takes three lines, and not one for each of its parts.
# fmt: off

# Descent, in trust_region.py

FIRST_DAMPING = TABLE.cost(
    "FIRST_DAMPING", 1e-5, "of the diagonal",
    "Damping of the first step: nearly a Gauss-Newton step, which is right wherever the start is near.",
)
DAMPING_MIN = TABLE.cost(
    "DAMPING_MIN", 1e-12, "of the diagonal",
    "The step is a Gauss-Newton step then.",
)
DAMPING_MAX = TABLE.derived(
    "DAMPING_MAX", 1e10, "of the diagonal",
    "A step has no length left: it moves the start of an unknown by 1e-10 of what the equations ask for, some "
    "roundings of its value.",
)
DAMPING_LOWERED_MIN = TABLE.cost(
    "DAMPING_LOWERED_MIN", 0.1, "of the damping before",
    "After a step that did all that was predicted. Nielsen (IMM-REP-1999-05) has a third; steps are few where the "
    "problem is nearly linear.",
)
PREDICTED_MAX = TABLE.stated(
    "PREDICTED_MAX", 1e3, "tolerances",
    "That the quadratic model may still predict at the end: where it fails, its prediction says little.",
)

# Unknowns and their priors, in problem.py

HELD_SIGMA = TABLE.derived(
    "HELD_SIGMA", 1e-9, "of the unknown",
    "Prior 1-sigma that holds an unknown of order one at its mean: its square is 1e-18 of that of a free one, below "
    "a rounding.",
)
REFERENCE_WIDTH_PX = TABLE.defined(
    "REFERENCE_WIDTH_PX", 512, "px",
    "Width of an image for which lengths in px among the priors are meant; they grow with the image.",
)

# Loss, in residuals.py

HUBER_SIGMAS = TABLE.derived(
    "HUBER_SIGMAS", 3.0, "sigma",
    "On the norm of a whitened residual of a corner: of normal corners one in 90 is beyond, exp(-3^2 / 2), and "
    "loses weight.",
)
LOSS_LOST = TABLE.stated(
    "LOSS_LOST", 1e6, "half chi-square",
    "Of a corner that the camera does not show at all: that of one far outside the image. A fit may start in such a "
    "state, and is refused if it ends there.",
)

# Poses, in poses.py

WIDE_RATIO = TABLE.measured(
    "WIDE_RATIO", 0.7, "of the distance",
    "Field width over the distance of the pivot, from which a view counts as a wide one. Noise and distortion imitate "
    "a few hundredths; a microscope has 0.06 to 0.15 at 100x and 0.5 at 60x with a pivot of 4 mm, a photographic lens "
    "about 1. 1.5 times as large or as small, it changes nothing in 9 cases; a thousand times or a thousandth of it "
    "does.",
    command=TRIED,
)
MIRROR_ROUNDS = TABLE.cost(
    "MIRROR_ROUNDS", 5, "rounds",
    "Of mirroring views. Each follows a fit to the last one, and they end when no view changes.",
)
DECREASE_MIN = TABLE.measured(
    "DECREASE_MIN", 0.1, "half chi-square",
    "That makes another pose of a view the better one: what a fit of few steps leaves is less. 1.5 times as large or "
    "as small, 9 cases are decided alike, and errors change by 0.3 % at most.",
    command=TRIED,
)
POSE_STEPS = TABLE.cost(
    "POSE_STEPS", 12, "steps",
    "From either sign of a tilt, enough to see which fits better; the fit that follows does the rest.",
)
COARSE_TOLERANCE = TABLE.cost(
    "COARSE_TOLERANCE", 1e-6, "of the cost",
    "Tolerance of the intermediate fits; only the last has to be exact.",
)
POSE_CORNERS = TABLE.cost(
    "POSE_CORNERS", 60, "corners",
    "Per view, for what has to be near only: signs of tilts, poses, functions at the start.",
)

# Residual field, in residual_field_fit.py

STRENGTHS_PX = TABLE.measured(
    "STRENGTHS_PX", (0.05, 0.3, 2.0, 12.0), "px",
    "Standard deviations of a coefficient that are tried, in a picture of REFERENCE_WIDTH_PX: from less than the "
    "noise of corners to a camera lens, in steps of six. 1.5 times as large or as small, 6 cases are decided alike, "
    "and errors change by 0.4 % at most.",
    command=TRIED,
)
NO_STRENGTH_PX = TABLE.derived(
    "NO_STRENGTH_PX", 1e-7, "px",
    "A prior this narrow holds the field at zero: 1e-5 of the noise of the best corners, 0.01 px.",
)
SMOOTHNESS = TABLE.measured(
    "SMOOTHNESS", 4.0, "ratio",
    "Of the coefficients to their second differences in the image: fields are smooth. 1.5 times as large or as small, "
    "6 cases are decided alike, and errors change by 0.3 % at most.",
    command=TRIED,
)
STEADINESS = TABLE.measured(
    "STEADINESS", 3.0, "ratio",
    "Of the coefficients to their differences between neighbours in log g. 1.5 times as large or as small, 6 cases "
    "are decided alike, and errors change by 0.2 % at most.",
    command=TRIED,
)
OVERLAP_PX = TABLE.derived(
    "OVERLAP_PX", 1e-4, "px",
    "Prior 1-sigma of the part of a field that the rest of the model describes: a hundredth of the noise of the "
    "best corners, so that this part is left to the model.",
)
COEFFICIENTS_IN_G_MAX = TABLE.measured(
    "COEFFICIENTS_IN_G_MAX", 5, "coefficients",
    "A field changes slowly with the magnification. 1.5 times as large or as small, it changes nothing in 6 cases; a "
    "thousand times or a thousandth of it does.",
    command=TRIED,
)
MAGNIFICATIONS_MIN = TABLE.derived(
    "MAGNIFICATIONS_MIN", 4, "magnifications",
    "Fewer do not predict one that is left out: a parabola through the others needs three.",
)
FOLDS_MAX = TABLE.cost(
    "FOLDS_MAX", 6, "folds",
    "Of the cross-validation; each is solved once for every strength.",
)
RIDGES = TABLE.derived(
    "RIDGES", (0.0, 1e-12, 1e-10, 1e-8), "of the diagonal",
    "Tried in turn, from none: elimination by subtraction loses some thousand roundings, 2^-53 each, and more where "
    "the equations are nearly singular.",
)
FIELD_GAIN_SIGMAS = TABLE.derived(
    "FIELD_GAIN_SIGMAS", 2.5, "sigma",
    "And in standard errors of the gain: by chance one in 160 (normal, one side).",
)
FIELD_SIZE_MIN = TABLE.measured(
    "FIELD_SIZE_MIN", 0.15, "sigma of a corner",
    "Least RMS size of a field at the corners: a smaller one costs more certainty, where there are no corners, than "
    "it is worth. 1.5 times as large or as small, it changes nothing in 6 cases; a thousand times or a thousandth of "
    "it does.",
    command=TRIED,
)
GAINING_PART = TABLE.measured(
    "GAINING_PART", 2.0 / 3.0, "of the magnifications",
    "That must gain: what is in a few of them only is no distortion of the microscope. 1.5 times as large or as "
    "small, it changes nothing in 6 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)

# Variance components, in variance_components.py

FLAT_RAD = TABLE.measured(
    "FLAT_RAD", math.radians(5.0), "rad",
    "Tilt up to which a view counts as one from above, 5 degrees: more than that of a specimen on its mount, less "
    "than tilts that are set on purpose. It shortens the grid by 0.4 %, which shows little of the perspective. 1.5 "
    "times as large or as small, 9 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
SPREAD_COUNT_MIN = TABLE.derived(
    "SPREAD_COUNT_MIN", 4, "effects",
    "Fewer do not tell their spread: of four, its 1-sigma is 1 / sqrt(2 x 4) = 35 % of it.",
)
USUAL_WEIGHT = TABLE.measured(
    "USUAL_WEIGHT", 0.05, "effects",
    "Weight of the usual spread against one observed effect: enough to decide where nothing is observed. 1.5 times as "
    "large or as small, 9 cases are decided alike, and errors change by 1.0 % at most.",
    command=TRIED,
)
USUAL_LATTICES = TABLE.defined(
    "USUAL_LATTICES", 1.0, "effects",
    "Of a stretch or shear of lattices for which the usual spread counts against a larger one: one lattice.",
)
CHOICE_LATTICES_MAX = TABLE.stated(
    "CHOICE_LATTICES_MAX", 8.0, "of the usual spread",
    "Of the lattices while coefficients are chosen: more than that of a bad grid, 0.1 %, and less than what takes the "
    "place of a missing term, 1 %.",
)
SPREAD_MIN = TABLE.measured(
    "SPREAD_MIN", 0.01, "of the usual spread",
    "Below it, no view shows a spread. 1.5 times as large or as small, 9 cases are decided alike, and errors change "
    "by less than 0.1 %.",
    command=TRIED,
)
SPREAD_MAX = TABLE.measured(
    "SPREAD_MAX", 20.0, "of the usual spread",
    "A larger one is a mistake, and no spread. 1.5 times as large or as small, it changes nothing in 9 cases; a "
    "thousand times or a thousandth of it does.",
    command=TRIED,
)

# The bundle adjustment, in bundle_adjustment.py

FIT_STEPS_MAX = TABLE.cost(
    "FIT_STEPS_MAX", 60, "steps",
    "A guard against endless iteration; the result says where it was reached.",
)
POOR_GAIN = TABLE.measured(
    "POOR_GAIN", 0.25, "of the predicted decrease",
    "Of a view, below which its quadratic model has failed. 1.5 times as large or as small, 9 cases are decided "
    "alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
FOLLOWING_STEPS = TABLE.cost(
    "FOLLOWING_STEPS", 6, "steps",
    "By which the pose of such a view follows a new camera; it has to be near only, and the next step continues "
    "from there.",
)
NEGLIGIBLE_CHANGE = TABLE.measured(
    "NEGLIGIBLE_CHANGE", 1e-2, "half chi-square",
    "Of a view, that does not count as a failure. 1.5 times as large or as small, 9 cases are decided alike, and "
    "errors change by less than 0.1 %.",
    command=TRIED,
)
ROTATION_STEP_MAX_RAD = TABLE.measured(
    "ROTATION_STEP_MAX_RAD", 0.5, "rad",
    "Of a rotation vector: farther away, the equations say nothing. 1.5 times as large or as small, it changes "
    "nothing in 9 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
ROUNDING_DAMPING = TABLE.stated(
    "ROUNDING_DAMPING", 1e-10, "of the diagonal",
    "That makes up for what rounding takes from the equations; it changes no sigma in the first five digits.",
)
NOTHING_DECREASE = TABLE.derived(
    "NOTHING_DECREASE", 1e-5, "half chi-square",
    "Of a step that changes nothing: it moves an unknown by 0.0045 of its sigma, sqrt(2 x 1e-5).",
)
COST_TOLERANCE = TABLE.measured(
    "COST_TOLERANCE", 1e-7, "of the cost",
    "Decrease below which another step does not matter to the result. 1.5 times as large or as small, 10 cases are "
    "decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)

# The posterior, in posterior.py

REMAINING_MAX = TABLE.stated(
    "REMAINING_MAX", 1.0, "sigma",
    "Of an unknown that is still on its way: far beyond what the last step of a converged fit leaves, some "
    "hundredths.",
)
HELD_PART = TABLE.measured(
    "HELD_PART", 0.8, "of the prior sigma",
    "Of a constant, or of a change, beyond which the prior holds it: the data have told less than the prior. 1.5 "
    "times as large or as small, it changes nothing in 6 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
NAMED_MAX = TABLE.defined(
    "NAMED_MAX", 5, "names",
    "Of views, magnifications or unknowns in a sentence; the others are counted.",
)
ALONG_LINE_MIN = TABLE.derived(
    "ALONG_LINE_MIN", 0.5, "squared cosine",
    "Between a line of the raster and the direction in which a point is known: at 45 degrees, half; below it, a "
    "shift along the line hardly shows.",
)
JITTER_LENGTHS = TABLE.measured(
    "JITTER_LENGTHS", (0.4, 1.5, 6.0, 24.0), "lines",
    "Of correlation, that are tried: hardly more than one line, that of one corner's window, and multiples of it up "
    "to a quarter of a small picture. Longer ones look like a drift. 1.5 times as large or as small, 9 cases are "
    "decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
LAG_MAX = TABLE.cost(
    "LAG_MAX", 64, "lines",
    "Up to which products of residuals are compared.",
)
JITTER_GAIN = TABLE.derived(
    "JITTER_GAIN", 9.0, "chi-square",
    "Below which there is no jitter: by chance in one of 370 recordings for each length, one degree of freedom.",
)
LAG_PAIRS_MIN = TABLE.measured(
    "LAG_PAIRS_MIN", 20.0, "weight",
    "Sum of the weights with which a lag is compared. 1.5 times as large or as small, it changes nothing in 9 cases; "
    "a thousand times or a thousandth of it does.",
    command=TRIED,
)
SHARED_DEGREE = TABLE.stated(
    "SHARED_DEGREE", 4, "degree",
    "Of the polynomials in which images are compared: what disturbs poses and camera most, in twelve coefficients that "
    "the pose hardly takes.",
)
SHARED_CORNERS = TABLE.derived(
    "SHARED_CORNERS", 2, "corners",
    "For each coefficient: half of what they say is noise then.",
)
OUTLIER_SIGMAS = TABLE.derived(
    "OUTLIER_SIGMAS", 5.0, "sigma",
    "Of what a view scatters, beyond which a corner is somewhere else: by chance one in 1.7 million.",
)
SHARED_CONDITION = TABLE.stated(
    "SHARED_CONDITION", 1e-6, "of the largest eigenvalue",
    "Below which corners in a part of the image do not tell the polynomials apart.",
)
SHARED_PAIRS_MIN = TABLE.derived(
    "SHARED_PAIRS_MIN", 5, "pairs of views",
    "Whose median is that of right ones where one view is wrong, which is in two of them.",
)
SHARED_FALSE_ALARMS = TABLE.defined(
    "SHARED_FALSE_ALARMS", 1e-3, "chance",
    "With which corners that are independent are made more uncertain.",
)
MEDIAN_FREEDOM = TABLE.derived(
    "MEDIAN_FREEDOM", 0.42, "of the degrees of freedom",
    "That count for a median over pairs of neighbouring views: 2 / pi, since it is a median, and 2 / 3, since each "
    "view is in two pairs, whose squared differences have a correlation of a quarter.",
)
RESERVE_SIZE = TABLE.measured(
    "RESERVE_SIZE", 2, "coefficients",
    "Zero ones that are added to those that were chosen: what the views leave open of them enters the covariance. 1.5 "
    "times as large or as small, 6 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
RESERVE_SIZE_MIN = TABLE.measured(
    "RESERVE_SIZE_MIN", 5, "coefficients",
    "In all, at least. 1.5 times as large or as small, 6 cases are decided alike, and errors change by less than 0.1 "
    "%.",
    command=TRIED,
)
USUAL_CHANGES = TABLE.measured(
    "USUAL_CHANGES", 0.5, "coefficients",
    "Weight of the usual size of the changes of a function, against one that the views determine: two of them make it "
    "half as large at the least, so that few magnifications which happen to agree do not promise too much. 1.5 times "
    "as large or as small, 6 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
CHANGE_FALLS = TABLE.defined(
    "CHANGE_FALLS", (1.0, 0.84, 0.71, 0.59, 0.5, 0.42, 0.35, 0.3, 0.25), "per order",
    "By how much coefficients of the lens fall besides the square of their order, that are tried: from those of a "
    "function with a kink to those of one that is nearly a straight line, in steps of a sixth.",
)
FALL_DOUBT = TABLE.derived(
    "FALL_DOUBT", 2.0, "half chi-square",
    "Two standard deviations of what the evidence tells: the slowest fall within them is taken.",
)
CHANGE_LIMITS = TABLE.measured(
    "CHANGE_LIMITS", (0.1, 3.0), "of the usual size",
    "Of the changes. 1.5 times as large or as small, it changes nothing in 6 cases; a thousand times or a thousandth "
    "of it does.",
    command=TRIED,
)
CHANGE_UPDATES = TABLE.cost(
    "CHANGE_UPDATES", 5, "updates",
    "Until it changes by some per cent.",
)
CERTAINTY_STEP = TABLE.derived(
    "CERTAINTY_STEP", 0.02, "of a sigma",
    "Of a central difference, whose error is the square of it: 4e-4, far below what a share is worth.",
)

# The extrapolation of their updates, in variance_components.py

SPREAD_MEMORY = TABLE.cost(
    "SPREAD_MEMORY", 4, "updates",
    "From which the next one is extrapolated.",
)
SPREAD_STEP_MAX = TABLE.cost(
    "SPREAD_STEP_MAX", 0.5, "log",
    "Of an extrapolation: from farther away, the updates are not linear.",
)

# A tilt that all views share, in common_tilt.py

ALIKE_FORESHORTENING = TABLE.measured(
    "ALIKE_FORESHORTENING", 0.02, "relative",
    "Spread of what tilts shorten views by, below which they may not tell the tilt that is common to them. Where they "
    "do, next to nothing is added: it costs time only to be too large. 1.5 times as large or as small, it changes "
    "nothing in 5 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
COMMON_TILT_CONFIDENCE = TABLE.derived(
    "COMMON_TILT_CONFIDENCE", 0.99, "chance",
    "That views of one tilt cost no more under it than under any other: two angles and a height of each then follow "
    "from few numbers, each of which could save half a chi-square.",
)
COMMON_TILT_SLACK = TABLE.stated(
    "COMMON_TILT_SLACK", 2.0, "times",
    "As much, up to which views allow a tilt: the coefficients were chosen for the camera that was found, and follow "
    "another one less well.",
)
RISE_GIVEN_UP = TABLE.cost(
    "RISE_GIVEN_UP", 2.0, "times",
    "What views allow, beyond which the walk ends.",
)
PIVOT_HELD_PART = TABLE.cost(
    "PIVOT_HELD_PART", 0.02, "of rho",
    "To which it is held.",
)
PIVOT_RATIO = TABLE.derived(
    "PIVOT_RATIO", 1.4, "of rho",
    "Between the values that are tried: a tilt goes with its inverse, and what it shortens with the square of that.",
)
PIVOT_SIGMAS = TABLE.derived(
    "PIVOT_SIGMAS", 3.0, "prior sigma",
    "By which a camera is less likely beforehand than the most likely one, beyond which none is tried: 0.3 % of a "
    "normal distribution.",
)
PIVOT_STEPS_MAX = TABLE.cost(
    "PIVOT_STEPS_MAX", 12, "steps",
    "To either side.",
)
PIVOT_ITERATIONS = TABLE.cost(
    "PIVOT_ITERATIONS", 25, "steps",
    "Of the adjustment with one rho.",
)
PIVOT_TOLERANCE = TABLE.stated(
    "PIVOT_TOLERANCE", 0.05, "half chi-square",
    "Decrease in one step that ends the adjustment with one rho: a tenth of what chance does to one number.",
)
