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

"""The numbers of a calibration from corners to its model, each with its source; the rooms in it have their own."""

from __future__ import annotations

import math

from scipy.special import ndtr

from semcal_ros.core.calibration.judgement.thresholds import MISFIT_SIGMA
from semcal_ros.core.thresholds import Table

TABLE = Table()

# Of the measured rows: each says in how many cases it was tried, and what changed in them (doc/thresholds.md).
TRIED = "python -m benchmarks.thresholds calibration, 29 November 2026"

# A row takes three lines, and not one for each of its parts.
# fmt: off

# Automatic acquisition, in acquisition.py

PROBE_SQUARES = TABLE.stated(
    "PROBE_SQUARES", 0.3, "squares",
    "Length of the moves to learn from: more than any backlash that lets a stage be used at this magnification, and "
    "less than the half beyond which the next corner is nearer.",
)
OFF_CENTRE_MAX = TABLE.stated(
    "OFF_CENTRE_MAX", 0.08, "of the picture",
    "Middle of what is seen of the grid, off the middle of the picture.",
)
SHIFT_SCATTER_MAX = TABLE.stated(
    "SHIFT_SCATTER_MAX", 0.15, "squares",
    "Of the displacements of single corners, above which two pictures do not show the same ones.",
)
MOVED_MIN = TABLE.derived(
    "MOVED_MIN", 0.2, "ratio",
    "A move over that of the picture is 1, or the cosine of the tilt, 0.34 at 70 degrees; below this the stage has "
    "not moved, or the picture is older than the move.",
)
VIEWS_MAX = TABLE.measured(
    "VIEWS_MAX", 300, "views",
    "That an acquisition takes by default. For 0.1 % from 500x to 10 000x, a microscope with a one-axis stage needed "
    "111, 153 and 243 with three seeds on 23 November 2026, and 108 and 75 with the first two on the 26th; one whose "
    "further views would hardly help ends before.",
    command="python -m benchmarks.acquisition",
)
SURVEY_RATIO = TABLE.stated(
    "SURVEY_RATIO", 1.7, "ratio",
    "Of neighbouring magnifications of the survey: the functions of a calibration are smooth over a factor of two.",
)
VISITS_AT_ONCE = TABLE.cost(
    "VISITS_AT_ONCE", 4, "visits",
    "Between two calibrations: what they bring was predicted, so that there is little to learn from each alone.",
)
ROUND_WORTH = TABLE.stated(
    "ROUND_WORTH", 0.02, "of the largest sigma",
    "A round that is predicted to lower it by less is not worth the time.",
)
VIEW_ROTATION_RAD = TABLE.stated(
    "VIEW_ROTATION_RAD", 1.1, "rad",
    "Between the views of a visit, in the plane.",
)
VISIT_ROTATION_RAD = TABLE.derived(
    "VISIT_ROTATION_RAD", math.pi * (3.0 - math.sqrt(5.0)), "rad",
    "From visit to visit: the golden angle never repeats a direction (Vogel 1979, "
    "doi:10.1016/0025-5564(79)90080-4).",
)
TILT_MAX_RAD = TABLE.stated(
    "TILT_MAX_RAD", math.radians(60.0), "rad",
    "That may be asked for: squares are then half as high as they are wide.",
)
SATURATED_PART = TABLE.stated(
    "SATURATED_PART", 0.05, "of the pixels",
    "At one end of the detector's range, from which edges are cut off.",
)
BLURRED_PART = TABLE.derived(
    "BLURRED_PART", 0.25, "of the spacing",
    "Blur from which corners of neighbouring squares run into each other: the middle of a square, two sigmas from "
    "its edges, has 83 % of the contrast left, (1 - 4 Q(2))^2.",
)
MAGNIFICATION_OFF = TABLE.stated(
    "MAGNIFICATION_OFF", 0.02, "of the magnification",
    "Displays round what they show.",
)
TILT_OFF_RAD = TABLE.stated(
    "TILT_OFF_RAD", math.radians(2.0), "rad",
    "A tilt that is no longer the one that was asked for.",
)
SPANNED_PART = TABLE.stated(
    "SPANNED_PART", 0.6, "of the picture",
    "Along x and y, that the grid has to span.",
)

# Judgement, in judge.py

GRID_STRETCH_MAX = TABLE.derived(
    "GRID_STRETCH_MAX", 5e-3, "relative",
    "Of the cells of a grid, along one axis against the other: ten times what lithography makes. Half of it is in nm "
    "per pixel, 0.25 %, where those of a good calibration are known to 0.1 to 0.2 %.",
)
MISFIT_MAX = TABLE.derived(
    "MISFIT_MAX", 1.0 + 3.0 * MISFIT_SIGMA, "sigma of a corner",
    "RMS of the residuals beyond which they are due to the model or the grid: by chance once in 370 (normal, both "
    "sides), as stated sigmas are right to MISFIT_SIGMA.",
)

# Pipeline, in pipeline.py

VIEWS_MIN = TABLE.derived(
    "VIEWS_MIN", 3, "views",
    "A parallel view gives one equation beyond its pose; scale, aspect and skew are three unknowns.",
)
SCALE_FACTOR_TOLD = TABLE.stated(
    "SCALE_FACTOR_TOLD", 1.2, "factor",
    "Below it a scale that is off is not mentioned: display widths and squares are right to some per cent, and "
    "tilts shorten lengths by as much.",
)
IRREGULAR_RATIO = TABLE.measured(
    "IRREGULAR_RATIO", 4.0, "usual irregularities",
    "Of a grid that seems to be less regular than lithography makes it: perhaps one view is wrong. 1.5 times as large "
    "or as small, it changes nothing in 6 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
SUSPECTS_MAX = TABLE.cost(
    "SUSPECTS_MAX", 3, "views",
    "That are left out, one at a time, to see whether it was that one.",
)
UNTILTED_CONFIDENCE = TABLE.defined(
    "UNTILTED_CONFIDENCE", 0.95, "chance",
    "With which recordings that are untilted are said to look so.",
)
WORTHWHILE_PART = TABLE.stated(
    "WORTHWHILE_PART", 0.7, "of the sigma",
    "That knowing the tilts leaves, from which it is worth a sentence.",
)
REFUSED_PART = TABLE.measured(
    "REFUSED_PART", 0.5, "of the tilts",
    "That are refused, from which the axis may be wrong, and not the tilts; beyond it, the stage is not used: one "
    "wrong reading in two leaves it open which of them are the wrong ones. 1.5 times as large or as small, it changes "
    "nothing in 6 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
NEARER_PART = TABLE.stated(
    "NEARER_PART", 0.3, "of the angle",
    "To the stage's tilts, that an axis the other way round leaves where it is the right one.",
)
NARROWEST_PART = TABLE.derived(
    "NARROWEST_PART", 1e-6, "of the length",
    "Width below which the corners of a view lie on one line of the grid: the rounding of single precision. Those of "
    "two lines are apart by a thousandth and more of their length.",
)
OUTSIDE_PART = TABLE.stated(
    "OUTSIDE_PART", 0.1, "of the image",
    "By which no corner lies outside, not even a gross outlier: it was measured in images of another size.",
)
DETERMINED_PART = TABLE.stated(
    "DETERMINED_PART", 0.05, "of the largest singular value",
    "Below it, views of lines leave a linear distortion to its prior: where they run in two directions, within 3 "
    "degrees, it is 0.02 or less.",
)
APART_RAD = TABLE.stated(
    "APART_RAD", math.radians(30.0), "rad",
    "Angle below which lines count as of one direction; with 8 degrees, a pixel size was seen to be wrong by 8 %, 4 "
    "sigmas.",
)

# The last fit, in solve.py

SPREAD_UPDATES_MAX = TABLE.cost(
    "SPREAD_UPDATES_MAX", 40, "updates",
    "Of the variance components, until they change by less than SPREAD_CHANGE.",
)
SPREAD_CHANGE = TABLE.measured(
    "SPREAD_CHANGE", 1e-6, "of a spread",
    "A mirrored recording then gives the mirrored camera to two millionths of a sigma. 1.5 times as large or as "
    "small, 6 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
UPDATE_TOLERANCE = TABLE.measured(
    "UPDATE_TOLERANCE", 1e-9, "of the cost",
    "That a fit between two updates may leave: with more, the updates were seen to go to and fro. 1.5 times as large "
    "or as small, 6 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
UPDATE_PREDICTED = TABLE.measured(
    "UPDATE_PREDICTED", 1e-6, "half chi-square",
    "And what its last step may predict. 1.5 times as large or as small, 6 cases are decided alike, and errors change "
    "by less than 0.1 %.",
    command=TRIED,
)
EXACT_TOLERANCE = TABLE.measured(
    "EXACT_TOLERANCE", 1e-10, "of the cost, half chi-squares",
    "Of the last fit. It starts undamped: a damped first step along what is hardly determined is so short that it "
    "would pass for the last. 1.5 times as large or as small, it changes nothing in 6 cases; a thousand times or a "
    "thousandth of it does.",
    command=TRIED,
)
EXACT_STEPS_MAX = TABLE.cost(
    "EXACT_STEPS_MAX", 300, "steps",
    "Of the last fit; where they do not suffice, the fit says so.",
)

# Moves of the stage, in stage.py

FRAMES_MIN = TABLE.derived(
    "FRAMES_MIN", 5, "frames",
    "Two constants, two drifts and the four numbers of M have eight equations of four frames; one more shows the "
    "scatter.",
)
ONE_LINE_RATIO = TABLE.stated(
    "ONE_LINE_RATIO", 0.1, "ratio",
    "Of the smaller to the larger spread of the positions: moves along one line leave M open across it.",
)
ONE_SIGMA = TABLE.derived(
    "ONE_SIGMA", float(ndtr(1.0)), "chance",
    "Of a normal deviate below 1.",
)

# Views and their squares, in views.py

SQUARE_MISFIT = TABLE.stated(
    "SQUARE_MISFIT", 0.12, "log",
    "Of a square's size, that tilt, height, noise and the scale of the microscope do not explain.",
)
SQUARE_FAR = TABLE.stated(
    "SQUARE_FAR", 0.3, "log",
    "From which a size is wrong, as from a wrong magnification, however far off it is.",
)
SQUARE_SCATTER = TABLE.stated(
    "SQUARE_SCATTER", 0.05, "log",
    "Of spacings from tilt and height; below it, the nominal scale decides.",
)
SCALE_WEIGHT = TABLE.stated(
    "SCALE_WEIGHT", 0.02, "log per log",
    "Weight of a scale that is off, against the scatter of the sizes.",
)
LINES_TILT_MAX_RAD = TABLE.derived(
    "LINES_TILT_MAX_RAD", math.radians(1.0), "rad",
    "That the stage may say of a grating: it shortens the distance of the lines by 1.5e-4, 1 - cos 1 degree.",
)
VARIANCE_RATIO_KEPT = TABLE.stated(
    "VARIANCE_RATIO_KEPT", 1.5, "ratio",
    "Of observed to stated variances, up to which the stated uncertainties are kept.",
)

# Which terms the data ask for, in select.py

SIZE_MAX = TABLE.cost(
    "SIZE_MAX", 8, "coefficients",
    "Of one function. With few magnifications, their number is the smaller limit.",
)
COEFFICIENT_GAIN = TABLE.derived(
    "COEFFICIENT_GAIN", 1.0, "half chi-square",
    "That pays for one coefficient, as in Akaike's criterion (1974, doi:10.1109/TAC.1974.1100705).",
)
TERM_GAIN = TABLE.derived(
    "TERM_GAIN", 5.0, "half chi-square",
    "For a term that is not there yet: by chance one of 640 that are not needed, twice as much being a chi-square "
    "of one degree of freedom.",
)
LATE_TERM_GAIN = TABLE.derived(
    "LATE_TERM_GAIN", 10.0, "half chi-square",
    "For a product of both coordinates: that of a term, and five coefficients. A centre of the distortion that moves "
    "in both directions as a parabola in log g, with decentring along it, does the same with that many more. "
    "Microscopes with a displaced lens were seen to gain 25 to 2475, others 8 at most. The fifth order has the same.",
)
SCAN_SIZE_MAX = TABLE.measured(
    "SCAN_SIZE_MAX", 3, "coefficients",
    "Of a function of the scan: coils and settling hardly change with the magnification. With 4 or 2, nothing changes "
    "in 6 cases; with a thousand times or a thousandth of it something does.",
    command=TRIED,
)
CHOICE_GAIN = TABLE.measured(
    "CHOICE_GAIN", 2.0, "half chi-square",
    "By which a choice has to be better than the last. 1.5 times as large or as small, it changes nothing in 6 cases; "
    "a thousand times or a thousandth of it does.",
    command=TRIED,
)
CHOICE_ROUNDS = TABLE.cost(
    "CHOICE_ROUNDS", 5, "rounds",
    "Of choosing the numbers of coefficients. A choice that alternates never converges; the calibration then "
    "carries a warning.",
)
FREE_ROUNDS = TABLE.measured(
    "FREE_ROUNDS", 2, "rounds",
    "In which a choice has no right to stay once the corners count as stated, so that it does not depend on where the "
    "fit came from. Before, a choice that went to and fro would lead astray. With 3 or 1, 6 cases are decided alike, "
    "and errors change by less than 0.1 %.",
    command=TRIED,
)
BELIEF_STEPS = TABLE.cost(
    "BELIEF_STEPS", 3, "steps",
    "In which corners come to be believed.",
)
BELIEF_STEP_MIN = TABLE.cost(
    "BELIEF_STEP_MIN", 0.7, "of the excess noise",
    "Beyond which there is no further step.",
)
FIELD_ROUNDS = TABLE.cost(
    "FIELD_ROUNDS", 30, "rounds",
    "Of field and adjustment.",
)
CHOOSING_ROUNDS = TABLE.cost(
    "CHOOSING_ROUNDS", 2, "rounds",
    "In which strength and numbers of coefficients may change; with both fixed, the rounds converge.",
)
EXPLAINED_MIN = TABLE.measured(
    "EXPLAINED_MIN", 0.2, "of the misfit",
    "That a field has to explain. Distortion of the scan that no other parameter describes was seen to be explained "
    "to nine tenths, settling that is narrower than the knots to a quarter, and the waves of a grid to a sixth. 1.5 "
    "times as large or as small, it changes nothing in 6 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
FIELD_SETTLED_PX = TABLE.derived(
    "FIELD_SETTLED_PX", 1e-3, "px",
    "RMS change of the corrections of all corners: a fiftieth of the noise of good ones, 0.05 px.",
)

# The start, in start.py

SCALE_FACTOR_MAX = TABLE.measured(
    "SCALE_FACTOR_MAX", 3.0, "factor",
    "Between the scale that is seen and the predicted one. Display widths of real files are 114 to 519 mm, so that a "
    "guess from their middle is wrong by 2.1 at most; what is off by more is another unit, or no microscope. 1.5 "
    "times as large or as small, it changes nothing in 6 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
TWICE_OCTAVES = TABLE.stated(
    "TWICE_OCTAVES", 0.12, "octaves",
    "From a factor of two: with the right display width, the scale of a microscope is never so close to it.",
)
DISPLAY_WIDTH_LIMITS_M = TABLE.stated(
    "DISPLAY_WIDTH_LIMITS_M", (1e-3, 100.0), "m",
    "Widths of displays that are accepted, from a chip's to a projector's.",
)
UNTILTED_RAD = TABLE.derived(
    "UNTILTED_RAD", math.radians(8.0), "rad",
    "Apparent tilt below which a view may be untilted: an aspect ratio that is 1 % off looks like 8 degrees, cos 8 "
    "= 0.990.",
)
TILTED_RAD = TABLE.derived(
    "TILTED_RAD", 2.0 * UNTILTED_RAD, "rad",
    "Views up to twice as much could be either.",
)
FIRST_UPDATES = TABLE.cost(
    "FIRST_UPDATES", 4, "updates",
    "Of the variance components, before anything is selected: they have to be near only.",
)
START_RHO_MAX = TABLE.derived(
    "START_RHO_MAX", 1.0 / 5e-3, "1/m",
    "The depth gradient of weakly tilted views is noisy, and a pivot nearer than 5 mm would be noise.",
)
WINDOW_BIAS_PART = TABLE.measured(
    "WINDOW_BIAS_PART", 0.5, "ratio",
    "Sigma of the bias of a window that is taken out, over this bias. Of chess, crosses, dots and lines, settling by "
    "3 px, 0 to 0.42 of the bias is left 20 to 45 px apart over 6, 12 and 24 columns, and to 0.09 at 60 px but over 6, "
    "where it is 0.29 to 1.16 (RMS, less the noise; 30 November 2026).",
    command="python -m benchmarks.calibration.settling",
)
BEND_STEP_PX = TABLE.derived(
    "BEND_STEP_PX", 0.05, "px",
    "Of the central difference that gives the bend of the scan: 1e-4 of it is wrong where the beam settles over 3 "
    "columns, (step / decay)^2 / 6.",
)
BIAS_NEGLIGIBLE = TABLE.derived(
    "BIAS_NEGLIGIBLE", 0.01, "sigmas",
    "Decays of so little are none: where the beam has settled, a bias is that of the coils, and is taken out at once.",
)
WINDOW_BIAS_SETTLED = TABLE.derived(
    "WINDOW_BIAS_SETTLED", 0.3, "sigmas",
    "Bias that may be left in a corner without another fit: 0.1 more of its chi-square, which is 2.",
)
WINDOW_BIAS_LEFT = TABLE.defined(
    "WINDOW_BIAS_LEFT", 3.0, "sigmas",
    "More than what noise does to a corner is told.",
)
WINDOW_BIAS_ROUNDS = TABLE.cost(
    "WINDOW_BIAS_ROUNDS", 4, "fits",
    "Until no bias is left; the corners moved by up to 12, 9, 0.9 and 0.07 sigmas where the beam settles by 3 px.",
)
