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

"""The numbers of a calibration that a specimen extends beyond its grid, each with its source."""

from __future__ import annotations

import math

from semcal_ros.core.calibration.estimator.problem import Priors
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.thresholds import Table

TABLE = Table()

# Of the measured rows: each says in how many cases it was tried, and what changed in them (doc/thresholds.md).
TRIED = "python -m benchmarks.thresholds ladder, 29 November 2026"

# A row takes three lines, and not one for each of its parts.
# fmt: off

# Plans, in acquisition.py

LADDER_MOVES = TABLE.stated(
    "LADDER_MOVES", ((0.0, 0.0), (0.25, 0.08), (-0.07, 0.26)), "fields of view",
    "Of the specimen at each magnification; the picture with the turned scan is in the middle.",
)
STEP = TABLE.derived(
    "STEP", 1.5, "ratio",
    "Of neighbouring magnifications that are planned: the upper picture covers 44 % of the lower one, 1 / 1.5^2.",
)
ANCHORS = TABLE.stated(
    "ANCHORS", 3, "steps",
    "That lie inside the calibrated range, so that the scale does not rest on one visit.",
)
MAGNIFICATION_MAX = TABLE.measured(
    "MAGNIFICATION_MAX", 1e7, "magnification",
    "Beyond it no scanning electron microscope magnifies. 1.5 times as large or as small, it changes nothing in 1 "
    "case; a thousand times or a thousandth of it does.",
    command=TRIED,
)

# Acquisition, in acquisition.py

OFF_CENTRE_MAX = TABLE.stated(
    "OFF_CENTRE_MAX", 0.15, "of the field",
    "Place of the specimen off the middle, up to which the next magnification shows all of it.",
)
MOVE_MIN = TABLE.measured(
    "MOVE_MIN", 0.1, "of the field",
    "A shorter move tells little of the distortion; a fifth to a third is asked for. 1.5 times as large or as small, "
    "it changes nothing in 5 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
MOVE_MAX = TABLE.measured(
    "MOVE_MAX", 0.5, "of the field",
    "A longer one leaves too little in common. 1.5 times as large or as small, it changes nothing in 5 cases; a "
    "thousand times or a thousandth of it does.",
    command=TRIED,
)
SCAN_ROTATION_OFF_RAD = TABLE.stated(
    "SCAN_ROTATION_OFF_RAD", math.radians(5.0), "rad",
    "From the scan rotation that was asked for, beyond what is an error of reading.",
)
SHIFT_STEPS = TABLE.cost(
    "SHIFT_STEPS", 3, "steps",
    "To where the map between both pictures takes a pixel to the middle: it is smooth.",
)

# What may be compared, in matching.py

STEP_MAX = TABLE.derived(
    "STEP_MAX", 1.6, "ratio",
    "Of neighbouring magnifications of a ladder: the upper picture then covers 39 % of the lower one, 1 / 1.6^2.",
)
SETTING_RATIO = TABLE.stated(
    "SETTING_RATIO", 1.06, "ratio",
    "Magnifications that are closer are one setting, stated twice: no microscope switches its range between them.",
)
ROUNDING_RATIO = TABLE.stated(
    "ROUNDING_RATIO", 1.02, "ratio",
    "That the rounding of a magnification adds to a step.",
)
QUARTER_TURNS_RAD = TABLE.defined(
    "QUARTER_TURNS_RAD", (0.0, 0.5 * math.pi, -0.5 * math.pi, math.pi), "rad",
    "Scans of unknown rotation are tried at these.",
)
CORRELATION_SURE = TABLE.stated(
    "CORRELATION_SURE", 0.5, "correlation",
    "Median over the blocks, of which no other quarter turn has more.",
)
SAME_ANGLE_RAD = TABLE.cost(
    "SAME_ANGLE_RAD", 0.1, "rad",
    "Rotations that differ by less are tried once.",
)
TURNED_RAD = TABLE.measured(
    "TURNED_RAD", 0.5, "rad",
    "Scans whose rotations differ by less count as equally turned: a turned scan is planned at a quarter turn, and "
    "nobody turns one by less than this on purpose to calibrate. 1.5 times as large or as small, it changes nothing "
    "in 6 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)

# Places of pictures in others, in correspondences.py

OVERLAP_MIN = TABLE.stated(
    "OVERLAP_MIN", 0.12, "of the smaller picture",
    "That has to overlap where the place is searched.",
)
SECOND_PEAK_MAX = TABLE.stated(
    "SECOND_PEAK_MAX", 0.9, "of the highest",
    "A second peak, farther off than its width, from which the specimen may repeat itself.",
)
COARSE_FACTORS = TABLE.derived(
    "COARSE_FACTORS", (4, 2), "px per px",
    "Reductions at which displacements are measured first, with a linear map: a third of a degree displaces the "
    "corner of 384 px by 1.6 px, which a reduced picture sees as less than one.",
)
COARSE_DEGREE = TABLE.measured(
    "COARSE_DEGREE", 1, "degree",
    "Of the map between reduced pictures. With 2 or 0, 6 cases are decided alike, and errors change by 4.6 % at most.",
    command=TRIED,
)
FINE_DEGREE = TABLE.stated(
    "FINE_DEGREE", 4, "degree",
    "Of the map between whole ones.",
)
COARSE_PASSES = TABLE.cost(
    "COARSE_PASSES", 3, "passes",
    "At each reduction.",
)
FINE_PASSES = TABLE.cost(
    "FINE_PASSES", 4, "passes",
    "At full resolution.",
)
LAST_STEP_PX = TABLE.measured(
    "LAST_STEP_PX", 0.004, "px",
    "RMS of the last step of the map: about what interpolation leaves. 1.5 times as large or as small, it changes "
    "nothing in 6 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
INTERPOLATION_PX = TABLE.measured(
    "INTERPOLATION_PX", 0.003, "px",
    "What interpolation leaves of a displacement, as seen on noiseless textures. 1.5 times as large or as small, 6 "
    "cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
TILES = TABLE.stated(
    "TILES", 2, "tiles",
    "Of a block along each side.",
)
SIGNAL_MIN = TABLE.stated(
    "SIGNAL_MIN", 0.25, "of the energy",
    "Of a block's gradients, that has to be more than noise.",
)
GAIN_MIN = TABLE.measured(
    "GAIN_MIN", 0.2, "ratio",
    "Of the contrasts of two pictures of one specimen; a smaller one shows something else. 1.5 times as large or as "
    "small, it changes nothing in 6 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
GAIN_MAX = TABLE.derived(
    "GAIN_MAX", 1.0 / GAIN_MIN, "ratio",
    "The inverse of GAIN_MIN, as either picture may be the first.",
)
BLOCK_SIGMA_MAX_PX = TABLE.stated(
    "BLOCK_SIGMA_MAX_PX", 0.5, "px",
    "A block whose place is not known better says nothing.",
)
BLOCK_SIGMAS = TABLE.derived(
    "BLOCK_SIGMAS", 5.0, "robust sigmas",
    "Of a block about the smooth map, beyond which it shows something else: by chance one of 870 000 blocks "
    "(normal, both sides, two coordinates).",
)
BLOCKS_AGREEING_MIN = TABLE.measured(
    "BLOCKS_AGREEING_MIN", 0.7, "of the blocks",
    "That have to agree with one smooth map: dust may move, but where a third does, nothing says which. With 0.8 or "
    "0.55, nothing changes in 6 cases; with a thousand times or a thousandth of it something does.",
    command=TRIED,
)
BLOCK_STEP_MAX_PX = TABLE.measured(
    "BLOCK_STEP_MAX_PX", 1.5, "px",
    "A longer displacement at the finest resolution is none that least squares has found. 1.5 times as large or as "
    "small, 6 cases are decided alike, and errors change by 0.45 % at most.",
    command=TRIED,
)
BLOCKS_MIN = TABLE.derived(
    "BLOCKS_MIN", 24, "blocks",
    "A map of the fourth degree has 15 coefficients for each coordinate; these leave nine residuals.",
)
CORRELATION_MIN = TABLE.stated(
    "CORRELATION_MIN", 0.3, "correlation",
    "Below it, two pictures do not show the same.",
)
PIXEL_SIGMA = TABLE.stated(
    "PIXEL_SIGMA", 0.5, "px",
    "Of beam and pixel together, in either picture: half a pixel, to which a microscope is focused.",
)

# Unknowns and their priors, in unknowns.py

POSE_SIZE = TABLE.defined(
    "POSE_SIZE", 5, "unknowns",
    "Rotation, shift (x, y) and change of the drift (x, y) of a picture.",
)
BEND_FACTOR = TABLE.measured(
    "BEND_FACTOR", 2.0, "ratio",
    "The functions may bend by so much more than where they are known. 1.5 times as large or as small, 6 cases are "
    "decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
JUMP_SIGMA = TABLE.measured(
    "JUMP_SIGMA", Priors().scale_jump, "of the scale",
    "1-sigma of a jump that was found, as among the priors of a calibration by a grid. 1.5 times as large or as "
    "small, 6 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
SINGULAR_PART = TABLE.derived(
    "SINGULAR_PART", 1e-13, "of the largest eigenvalue",
    "Of a matrix of correlations; what is below is rounding, some hundred of 2^-53.",
)
SLOPE_SIGMA_RAD = TABLE.measured(
    "SLOPE_SIGMA_RAD", 0.1, "rad",
    "Prior 1-sigma of the slope of the specimen: six degrees, so that pictures at low magnification, where it shows, "
    "decide whether it lies flat. 1.5 times as large or as small, 6 cases are decided alike, and errors change by "
    "0.17 % at most.",
    command=TRIED,
)
VISIT_SIGMA_MIN = TABLE.measured(
    "VISIT_SIGMA_MIN", 2e-5, "of the scale",
    "Of a magnification that is set again: the last digit of a scan generator of 16 bits, 1.5e-5. 1.5 times as large "
    "or as small, it changes nothing in 6 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)

# Residuals, in residuals.py

TIME_STEPS = TABLE.derived(
    "TIME_STEPS", 3, "steps",
    "To the time of a pixel, by Newton's method with pixels of the nominal size: where a drift is a tenth of the "
    "picture in a frame, which is the most, and these are off by a tenth, each leaves a hundredth of the way, and the "
    "two before the last 1e-4 of the few pixels by which a correspondence is off at the start.",
)

# Adjustment, in adjustment.py

FIT_STEPS = TABLE.cost(
    "FIT_STEPS", 200, "steps",
    "From the poses of the correspondences five are enough as a rule; of 18 ladders of another generator four took 27 "
    "to 54 on 30 November 2026.",
)
COMPARING_STEPS = TABLE.cost(
    "COMPARING_STEPS", 6, "steps",
    "After which mirrored and turned pictures are compared with those as they are. In four ladders the cost of a "
    "wrong way to lie was 57 and more above that of the right one after three, six and twelve steps.",
)
FIT_TOLERANCE = TABLE.cost(
    "FIT_TOLERANCE", 1e-9, "of the cost",
    "At which the steps end.",
)
DRIFT_FIRST_PX = TABLE.cost(
    "DRIFT_FIRST_PX", 0.5, "px",
    "Spread of the drift in a frame of the finest magnification, at the start.",
)
DRIFT_MIN_PX = TABLE.measured(
    "DRIFT_MIN_PX", 0.02, "px",
    "The least that is tried: a stage that has settled does a tenth of a pixel. 1.5 times as large or as small, 6 "
    "cases are decided alike, and errors change by 0.43 % at most.",
    command=TRIED,
)
DRIFT_MAX = TABLE.measured(
    "DRIFT_MAX", 0.03, "of the picture",
    "More than a thirtieth is no drift. 1.5 times as large or as small, 6 cases are decided alike, and errors change "
    "by less than 0.1 %.",
    command=TRIED,
)
DRIFTS_TRIED = TABLE.cost(
    "DRIFTS_TRIED", 12, "spreads",
    "Of the drift, in even steps of their logarithm.",
)
DRIFT_ROUNDS = TABLE.cost(
    "DRIFT_ROUNDS", 3, "rounds",
    "Of fit and choice.",
)
SETTLED_DRIFT_PX = TABLE.measured(
    "SETTLED_DRIFT_PX", 1.0, "px",
    "Spread of the drift that a settled specimen may have. 1.5 times as large or as small, 6 cases are decided alike, "
    "and errors change by less than 0.1 %.",
    command=TRIED,
)
UNEXPLAINED_RATIO = TABLE.measured(
    "UNEXPLAINED_RATIO", 1.1, "ratio",
    "By which a larger drift has to lower the variance of the residuals to be believed: what else is not in the model "
    "lowers it by some per cent. 1.5 times as large or as small, 6 cases are decided alike, and errors change by less "
    "than 0.1 %.",
    command=TRIED,
)
VIBRATION_PX = TABLE.measured(
    "VIBRATION_PX", 0.01, "px",
    "By which vibration stretches a frame at any magnification. 1.5 times as large or as small, 6 cases are decided "
    "alike, and errors change by 0.82 % at most.",
    command=TRIED,
)
JUMP_GAIN = TABLE.derived(
    "JUMP_GAIN", 20.0, "twice the cost",
    "That a jump has to gain: by chance, one of 12 places does so in 1 of 11 000 ladders, chi-square of one degree "
    "of freedom.",
)
JUMPS_MAX = TABLE.measured(
    "JUMPS_MAX", 4, "jumps",
    "A ladder with more is not one of a microscope. With 6 or 3, nothing changes in 6 cases; with a thousand times or "
    "a thousandth of it something does.",
    command=TRIED,
)
GAUGE = TABLE.derived(
    "GAUGE", (1e-9, 1e-7), "rad, px",
    "1-sigma of rotation and shift of the first picture, which has its place: a millionth of what a picture tells, "
    "so that they are held without loss of digits.",
)
CREEP_SIGMA = TABLE.stated(
    "CREEP_SIGMA", 1e-3, "of the scale",
    "1-sigma of its change from one picture to the next: 3 % over 28 pictures.",
)
LINK_FACTOR = TABLE.measured(
    "LINK_FACTOR", 9.0, "ratio of squares",
    "A pair of pictures whose mean square residual exceeds the median pair's by it is left out; chance makes 2. 1.5 "
    "times as large or as small, 6 cases are decided alike, and errors change by 0.95 % at most.",
    command=TRIED,
)

# Agreement with the calibration, in agreement.py

TOLD_PART = TABLE.stated(
    "TOLD_PART", 0.05, "of the variance",
    "Directions of the prior of which the pictures tell less are not asked.",
)
DISAGREEMENT_FALSE_ALARMS = TABLE.defined(
    "DISAGREEMENT_FALSE_ALARMS", 1e-4, "chance",
    "With which a calibration that still holds is said to disagree.",
)
EVIDENCE_SURE = TABLE.derived(
    "EVIDENCE_SURE", 30.0, "minus twice the log",
    "Difference of evidence, of which one in 3.3 million is chance, exp(-30 / 2).",
)
BACK_PART = TABLE.measured(
    "BACK_PART", 0.65, "of a step",
    "By which the scale has to go back, or by the inverse, to be back: its functions bend by less. With 0.767 or "
    "0.475, nothing changes in 2 cases; with a thousand times or a thousandth of it something does.",
    command=TRIED,
)
VISIT_SIGMAS = TABLE.derived(
    "VISIT_SIGMAS", 6.0, "sigma",
    "Of a visit, in repeatabilities, that is not the repeatability's: by chance one of 500 million (normal, both "
    "sides).",
)
DEVIATION_MIN = TABLE.stated(
    "DEVIATION_MIN", 3e-3, "of the scale",
    "A smaller one is not worth a refusal.",
)

# Extension, in extend.py

STEEPEST_RAD = TABLE.stated(
    "STEEPEST_RAD", 0.0873, "rad",
    "Slope of a specimen that is not flat any more: 5 degrees, ten times that of one that is mounted flat.",
)
VARIANCE_FACTOR_MAX = TABLE.derived(
    "VARIANCE_FACTOR_MAX", 4.0, "variances",
    "Residuals of twice their sigma are a model that does not fit, or pictures that do not show one plane; by "
    "chance, 24 residuals do so once in 7 billion, chi-square.",
)
VARIANCE_FACTOR_NOTED = TABLE.measured(
    "VARIANCE_FACTOR_NOTED", 1.25, "variances",
    "A thousand residuals or more have a mean square within 0.15 of 1; interpolation and the jitter of lines add "
    "some. 1.5 times as large, nothing changes; as small, 5 of 5 cases are decided otherwise.",
    command=TRIED,
)
LINKS_USED_MIN = TABLE.stated(
    "LINKS_USED_MIN", 0.5, "of the pairs",
    "That have to remain.",
)
CREEP_SIGMAS = TABLE.derived(
    "CREEP_SIGMAS", 4.0, "sigma",
    "Of a creep that is one: by chance one of 16 000 (normal, both sides).",
)
CREEP_MAX = TABLE.stated(
    "CREEP_MAX", 5e-3, "of the scale",
    "Over all pictures: what adds up to more need not be as steady as it is taken to be.",
)
NAMED_MAX = TABLE.defined(
    "NAMED_MAX", 3, "names",
    "Of pictures in a sentence; the others are counted.",
)

# From a specimen alone, in from_specimen.py

MAGNIFICATIONS_MIN = TABLE.derived(
    "MAGNIFICATIONS_MIN", 3, "magnifications",
    "The functions begin at the lowest two, with constants and slopes; bends show beyond.",
)
SCALE_HELD = TABLE.measured(
    "SCALE_HELD", 1e-6, "of the scale",
    "1-sigma to which it is held while the pictures are adjusted; the known pixel size multiplies it afterwards. 1.5 "
    "times as large or as small, 2 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
PRINCIPAL_POINT = TABLE.measured(
    "PRINCIPAL_POINT", Priors().centre_fraction, "image widths",
    "1-sigma, which flat pictures do not show: as in a calibration by a grid. 1.5 times as large or as small, 2 cases "
    "are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
PIVOT = TABLE.measured(
    "PIVOT", Priors().rho_mean, "1/m",
    "Which flat pictures do not show either. 1.5 times as large or as small, 2 cases are decided alike, and errors "
    "change by less than 0.1 %.",
    command=TRIED,
)
PIVOT_SIGMA = TABLE.measured(
    "PIVOT_SIGMA", Priors().rho_sigma, "1/m",
    "And its 1-sigma. 1.5 times as large or as small, 2 cases are decided alike, and errors change by less than 0.1 "
    "%.",
    command=TRIED,
)
STAGE_SIGMA_MAX = TABLE.measured(
    "STAGE_SIGMA_MAX", 0.05, "of the length",
    "Moves that tell it worse tell nothing that a pixel size by the display width does not. 1.5 times as large or as "
    "small, it changes nothing in 1 case; a thousand times or a thousandth of it does.",
    command=TRIED,
)
ONE_ROTATION_COS = TABLE.derived(
    "ONE_ROTATION_COS", 0.99985, "cosine",
    "Of the angle up to which scans are equally turned, for the place of their centre: one degree.",
)
POINTED_SIGMA_PX = TABLE.measured(
    "POINTED_SIGMA_PX", 0.5, "px",
    "To which a place is pointed at by hand. 1.5 times as large, errors over sigma are 20 % smaller; as small, 15 % "
    "larger.",
    command=TRIED,
)
LENGTH_MIN_PX = TABLE.derived(
    "LENGTH_MIN_PX", 20.0, "px",
    "A shorter one says too little: half a pixel at either end is 3.5 % of it, sqrt(2) x 0.5 / 20.",
)
REPEATABILITY = TABLE.measured(
    "REPEATABILITY", Priors().visit_scale_sigma, "of the scale",
    "Of a magnification where nothing tells it, as in a calibration by a grid. 1.5 times as large or as small, 2 "
    "cases are decided alike, and errors change by 0.5 % at most.",
    command=TRIED,
)
HEIGHT_SIGMA_M = TABLE.measured(
    "HEIGHT_SIGMA_M", CalibrationOptions().height_sigma_m, "m",
    "Of what is measured, as in a calibration by a grid. 1.5 times as large or as small, 2 cases are decided alike, "
    "and errors change by less than 0.1 %.",
    command=TRIED,
)

# And the priors of its functions, in from_specimen.py

CONSTANT_SIGMAS = TABLE.stated(
    "CONSTANT_SIGMAS", {"aspect": 0.01, "skew": 0.01, "xi_r": 0.03, "xi_t": 0.01, "ex": 0.08, "ey": 0.08}, "by name",
    "Prior 1-sigma of the constants: those of an instrument that nobody knows; relative, in normalised coordinates, "
    "or, of centres, in image widths.",
)
SLOPE_SIGMAS = TABLE.stated(
    "SLOPE_SIGMAS",
    {"scale": 0.01, "aspect": 3e-3, "skew": 3e-3, "xi_r": 5e-3, "xi_t": 2e-3, "ex": 0.02, "ey": 0.02},
    "by name",
    "And of their change over the first step.",
)

# And the bends of the functions, in unknowns.py

BENDS_MIN = TABLE.stated(
    "BENDS_MIN", {"ex": 0.02, "ey": 0.02, "others": 4e-3}, "by name",
    "Least 1-sigma of the second derivatives by log g: relative, or, of centres, in image widths. Over a step of "
    "1.5 each bends the edge of 1024 px by 0.15 px, and the functions of the virtual JSM-820 bend by less.",
)
