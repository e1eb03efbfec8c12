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

"""The numbers by which a calibration is judged, checked, brought up to date and planned, each with its source."""

from __future__ import annotations

import math

from semcal_ros.core.thresholds import Table, sigmas_of_chance

TABLE = Table()

# Of the measured rows: each says in how many cases it was tried, and what changed in them (doc/thresholds.md).
TRIED = "python -m benchmarks.thresholds judgement, 28 November 2026"

# A row takes three lines, and not one for each of its parts.
# fmt: off

# Checks against new views, in check.py

CHECK_FALSE_ALARMS = TABLE.defined(
    "CHECK_FALSE_ALARMS", 0.01, "chance",
    "With which a valid calibration is called degraded; each of the tests has its share.",
)
CHANGE_ROUNDS = TABLE.cost(
    "CHANGE_ROUNDS", 4, "rounds",
    "Of adjusting what has changed and testing the rest.",
)
SIGN_FLIPS = TABLE.derived(
    "SIGN_FLIPS", 33_000, "draws",
    "Of the signs of the views: a chance at the limit of one test, 0.01 / 10, is then known to 1 / sqrt(33) = 17 %.",
)
CHECK_CELLS = TABLE.measured(
    "CHECK_CELLS", 6, "cells",
    "Across the picture, in which the mean residual is tested: as fine as the knots of a residual field. 1.5 times as "
    "large or as small, it changes nothing in 3 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
CELL_VIEWS_MIN = TABLE.stated(
    "CELL_VIEWS_MIN", 6, "views",
    "In which a cell is seen; fewer do not tell a pattern from the scatter of the views.",
)
MISFIT_SIGMA = TABLE.measured(
    "MISFIT_SIGMA", 0.1, "of the sigma",
    "1-sigma of the stated uncertainty of corners: the error over it was 0.87 to 1.07 in six frames, tilted or not, "
    "from 100x to 5000x, on 26 November 2026.",
    command="python -m benchmarks.calibration --quick",
)
UPDATE_MISFIT = TABLE.derived(
    "UPDATE_MISFIT", 2.0, "of the sigma",
    "That the residuals of an update may be without a warning: ten MISFIT_SIGMA above one. Lines that jitter by a "
    "twentieth of a pixel leave up to 1.5.",
)
OTHER_SCALE = TABLE.measured(
    "OTHER_SCALE", 0.1, "of the scale",
    "Change of the scale beyond which this is another microscope, display width or grid: an SEM repeats to below 1 %, "
    "and makers promise 10 % at the most (ISO 16700). 1.5 times as large or as small, it changes nothing in 3 cases; "
    "a thousand times or a thousandth of it does.",
    command=TRIED,
)

# Comparisons, in compare.py

COMPARED_COUNT = TABLE.stated(
    "COMPARED_COUNT", 7, "magnifications",
    "That are compared where none are given: three per factor of ten over two decades.",
)
COMPARED_ACROSS = TABLE.cost(
    "COMPARED_ACROSS", 13, "places",
    "Across the field; more would find the same maximum of smooth functions.",
)
DIFFERENT_SIGMAS = TABLE.derived(
    "DIFFERENT_SIGMAS", sigmas_of_chance(0.01 / 10), "sigma",
    "From which two calibrations differ: by chance in one of a hundred comparisons, of some ten independent numbers "
    "each (normal, both sides).",
)

# Evaluation on held-out views, in evaluate.py

POSE_STEPS_MAX = TABLE.cost(
    "POSE_STEPS_MAX", 300, "steps",
    "Of a pose alone: the tilt of a nearly flat view acts through its square, so that its last degrees take many "
    "small steps.",
)

# Findings, in findings.py

COVERAGE_CELLS = TABLE.stated(
    "COVERAGE_CELLS", 8, "cells",
    "Across the field. At the lowest magnifications a square of the grid is smaller than one of them; at the "
    "highest a view has some tens of corners, and a few views fill them.",
)
CELL_CORNERS_MIN = TABLE.stated(
    "CELL_CORNERS_MIN", 5, "corners",
    "With fewer, a cell is left out of the test for a pattern.",
)
EMPTY_PART = TABLE.stated(
    "EMPTY_PART", 0.05, "of the field",
    "Without a corner, that is worth a warning: some 5 of the 108 cells of a 4:3 picture.",
)
HELD_OUT_RATIO = TABLE.stated(
    "HELD_OUT_RATIO", 1.5, "ratio of RMS",
    "Of a magnification that is predicted from the others to one that is fitted, from which the functions between "
    "the magnifications miss something.",
)
FILLED_PART = TABLE.stated(
    "FILLED_PART", 0.5, "of the field",
    "That the corners of one magnification should reach.",
)
REJECTED_PART = TABLE.stated(
    "REJECTED_PART", 1.0 / 3.0, "of the views",
    "More rejected ones are no accident: something is wrong with the recording.",
)
VIEW_RATIO = TABLE.stated(
    "VIEW_RATIO", 3.0, "ratio of spreads",
    "Of a view's residuals to what the 1-sigma of its corners predicts, above which it is named. Corners do not "
    "scatter as much by chance; what they have in common does.",
)
VIEW_PART = TABLE.stated(
    "VIEW_PART", 0.75, "of the residuals",
    "Whose largest is a view's spread. A quarter may be far off: the adjustment bears them.",
)
VIEW_PART_SIGMAS = TABLE.derived(
    "VIEW_PART_SIGMAS", 1.15035, "sigma",
    "Of which as many normal residuals are smaller: the quantile of the normal distribution at (1 + VIEW_PART) / 2.",
)
PATTERN_RATIO = TABLE.stated(
    "PATTERN_RATIO", 3.0, "ratio of squares",
    "Of the cells' mean residuals to those by chance, above which they form a pattern.",
)
PATTERN_PX = TABLE.stated(
    "PATTERN_PX", 0.02, "px",
    "RMS of a pattern: a smaller one may be significant, but does not matter.",
)
NEXT_SIGMA = TABLE.stated(
    "NEXT_SIGMA", 0.004, "of the width of the image",
    "Predicted error, between two calibrated magnifications or at one, beyond which more images help: 2 px of 512.",
)

# Outliers, in outliers.py

JUMP_FALSE_ALARMS = TABLE.defined(
    "JUMP_FALSE_ALARMS", 0.01, "chance",
    "With which a recording without a jump of the scale is said to have one, at any of its places and in either "
    "direction: once in 100 recordings.",
)
SMOOTHER_ORDERS = TABLE.stated(
    "SMOOTHER_ORDERS", 2, "coefficients",
    "By which a smooth scale may bend more than the chosen one, instead of a jump: a wave has no more extremes "
    "than one between two magnifications each, and of a step two orders explain a part only.",
)
STEP_LEFT_MIN = TABLE.stated(
    "STEP_LEFT_MIN", 1e-3, "of the information",
    "On a step of the scale, that the chosen function has to leave: where it can follow the step, there is nothing to "
    "find.",
)
TILT_SIGMAS = TABLE.derived(
    "TILT_SIGMAS", 5.0, "sigma",
    "Deviation of a tilt from what the stage says, beyond which one of the two is wrong: by chance one of 1.7 "
    "million tilts (normal, both sides).",
)
DETERMINED_MIN = TABLE.measured(
    "DETERMINED_MIN", 0.02, "of the variance",
    "A residual that the view itself determines less says nothing. 1.5 times as large or as small, it changes nothing "
    "in 6 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
HEIGHT_SIGMAS = TABLE.measured(
    "HEIGHT_SIGMAS", 8.0, "sigma",
    "Of height and stretch, at the least: heights are a mixture of views with a still and with a moved stage, with "
    "long tails, for which no rate is known. 1.5 times as large or as small, it changes nothing in 6 cases; a "
    "thousand times or a thousandth of it does.",
    command=TRIED,
)
OUTLIER_FALSE_ALARMS = TABLE.defined(
    "OUTLIER_FALSE_ALARMS", 0.01, "chance",
    "With which a recording of sound views, with normal heights, loses one: once in 100 recordings, and less often "
    "where HEIGHT_SIGMAS is the larger limit.",
)
USUAL_VIEWS = TABLE.stated(
    "USUAL_VIEWS", 4, "views",
    "That the usual spread of heights and shapes counts as, where few views show one: it is right to 1 / sqrt(2 x 4) "
    "= 35 %.",
)
HEIGHT_SPREAD_MIN_M = TABLE.measured(
    "HEIGHT_SPREAD_MIN_M", 5e-6, "m",
    "Smaller differences of height are not significant. 1.5 times as large or as small, it changes nothing in 6 "
    "cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
SHAPE_SPREAD_MIN = TABLE.stated(
    "SHAPE_SPREAD_MIN", 5e-4, "of a length",
    "Smaller stretches and shears are those of ordinary grids.",
)
MISFIT_RATIO = TABLE.measured(
    "MISFIT_RATIO", 6.0, "ratio of RMS",
    "Of a view's residuals to the median view's, found by trial: good views differ by less, and a wrong magnification "
    "that a height cannot imitate by more. 1.5 times as large or as small, it changes nothing in 6 cases; a thousand "
    "times or a thousandth of it does.",
    command=TRIED,
)
TRIMMED_PART = TABLE.derived(
    "TRIMMED_PART", 0.75, "of the corners",
    "That count in a view's residuals, those with the smallest ones: a quarter may be wrong, which is the usual choice "
    "(Rousseeuw and Van Driessen 2006, doi:10.1007/s10618-005-0024-4).",
)
VIEWS_MIN = TABLE.stated(
    "VIEWS_MIN", 3, "views",
    "Where a magnification has fewer, they are compared with those at all.",
)
SWAMPED_PART = TABLE.derived(
    "SWAMPED_PART", 0.75, "of the oddest",
    "What is less odd waits for a fit without the oddest: a median of two views of which one is wrong is wrong by half "
    "as much, and so is what is compared with it; this is half-way from there to the oddest itself.",
)
WRONG_PART_MAX = TABLE.measured(
    "WRONG_PART_MAX", 0.1, "of the views",
    "Single views are wrong, not many. 1.5 times as large or as small, it changes nothing in 6 cases; a thousand "
    "times or a thousandth of it does.",
    command=TRIED,
)
WRONG_QUANTILE_SIGMAS = TABLE.derived(
    "WRONG_QUANTILE_SIGMAS", sigmas_of_chance(WRONG_PART_MAX), "sigma",
    "Of normal deviates, WRONG_PART_MAX are larger.",
)

# Plans, in plan.py

PLANNED_TILTS_RAD = TABLE.measured(
    "PLANNED_TILTS_RAD", (0.0, math.radians(20.0), math.radians(40.0)), "rad",
    "Of the views of a planned visit: without tilt, and two that a stage of any SEM reaches. 1.5 times as large or as "
    "small, 10 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
PLANNED_ROTATIONS_RAD = TABLE.measured(
    "PLANNED_ROTATIONS_RAD", (0.2, 1.3, 2.4), "rad",
    "In the plane, of these views: different ones, so that aspect and skew are seen. 1.5 times as large or as small, "
    "the errors of one case change by less than 0.1 %.",
    command=TRIED,
)
PLANNED_DIRECTIONS_RAD = TABLE.derived(
    "PLANNED_DIRECTIONS_RAD", (0.0, math.radians(60.0), math.radians(120.0)), "rad",
    "Of the lines of a grating in the views of a planned visit: the most different three.",
)
CANDIDATES = TABLE.cost(
    "CANDIDATES", 15, "magnifications",
    "That a visit is tried at.",
)
JUDGED = TABLE.cost(
    "JUDGED", 25, "magnifications",
    "At which the sigma is predicted.",
)
PLANNED_VISITS_MAX = TABLE.measured(
    "PLANNED_VISITS_MAX", 30, "visits",
    "A plan of more is a new calibration. 1.5 times as large or as small, it changes nothing in 1 case; a thousand "
    "times or a thousandth of it does.",
    command=TRIED,
)
PLANNED_SIGMA_PX = TABLE.measured(
    "PLANNED_SIGMA_PX", 0.05, "px",
    "Of a corner, per axis, in a sharp image; the visits limit a calibration, and not the corners. 1.5 times as large "
    "or as small, the errors of one case change by 0.8 % at most.",
    command=TRIED,
)
SQUARES_ACROSS_MIN = TABLE.measured(
    "SQUARES_ACROSS_MIN", 8.0, "squares",
    "Across the picture, that a view should show. 1.5 times as large or as small, the errors of one case change by "
    "1.3 % at most.",
    command=TRIED,
)
PLANNED_ACROSS_MAX = TABLE.cost(
    "PLANNED_ACROSS_MAX", 30, "corners",
    "Across the picture.",
)
VISIT_WORTH = TABLE.stated(
    "VISIT_WORTH", 0.05, "of the largest sigma",
    "A visit that lowers it by less is not worth the way to the microscope.",
)

# Revisions, in revision.py

FREE_CHANGE = TABLE.measured(
    "FREE_CHANGE", 0.3, "of the scale",
    "Prior 1-sigma of one that is to be found, or may have changed by anything: no limit in practice. 1.5 times as "
    "large or as small, 3 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
DRIFT_UPDATES = TABLE.cost(
    "DRIFT_UPDATES", 3, "updates",
    "Of the spread of the drift within the images, which is the recording's.",
)

# Checks of the scale, in scale_checks.py

ONE_DIRECTION = TABLE.derived(
    "ONE_DIRECTION", 0.01, "of the larger variance",
    "Of the tilts, that of the smaller direction where they are about one axis: 3 degrees beside 30.",
)
SURPRISING_SIGMAS = TABLE.derived(
    "SURPRISING_SIGMAS", 4.0, "sigma",
    "Of the prior of a constant of the stage or of the pivot, that says that the configuration is wrong: by chance "
    "one of 16 000 (normal, both sides).",
)
UNUSUAL_SIGMAS = TABLE.derived(
    "UNUSUAL_SIGMAS", 2.58, "prior sigma",
    "Of aspect ratio and skew, beyond which they are unusual: one microscope of a hundred each, if these were as "
    "different as the wide priors allow.",
)
HYSTERESIS_FALSE_ALARMS = TABLE.defined(
    "HYSTERESIS_FALSE_ALARMS", 3e-4, "chance",
    "With which a calibration without one is said to have a hysteresis, once in 3000.",
)

# Updates, in update.py

DEFAULT_AGEING = TABLE.measured(
    "DEFAULT_AGEING", 5e-3, "of the scale",
    "1-sigma of its change since the calibration that the views need not prove: half of the 1 % that makers promise "
    "of the stability of a magnification. 1.5 times as large or as small, 10 cases are decided alike, and errors "
    "change by 0.1 % at most.",
    command=TRIED,
)
GAIN_MAX = TABLE.stated(
    "GAIN_MAX", 1.0, "of the distortion",
    "Prior 1-sigma, at most, of a change in proportion to it: it may have doubled, or gone.",
)
SHAPE_PART = TABLE.measured(
    "SHAPE_PART", 0.2, "of the ageing",
    "By which the shape changes: it is made by ratios of what makes the scale. 1.5 times as large or as small, the "
    "errors of one case change by 1.1 % at most.",
    command=TRIED,
)
AGEING_MAX = TABLE.measured(
    "AGEING_MAX", 0.1, "of the scale",
    "More is another microscope. 1.5 times as large or as small, it changes nothing in 1 case; a thousand times or a "
    "thousandth of it does.",
    command=TRIED,
)
