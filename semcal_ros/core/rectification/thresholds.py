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


"""The numbers of the maps from raw to rectified pixels, each with its source.

"Seen" stands for what was observed when the number was chosen.
"""

from __future__ import annotations

import numpy as np

from semcal_ros.core.thresholds import Table

TABLE = Table()

# Of the measured rows: each says in how many cases it was tried, and what changed in them (doc/thresholds.md).
TRIED = "python -m benchmarks.thresholds rectification, 29 November 2026"

# A row takes three lines, and not one for each of its parts.
# fmt: off

# Exact raw positions, in raw_positions.py

POSITION_STEPS_MAX = TABLE.derived(
    "POSITION_STEPS_MAX", 50, "steps",
    "Each step shrinks the error by the drift per row time over a row: at half a row per row 20 steps leave "
    "2^-20, and what needs more than 50 is too fast for the raster.",
)
POSITION_CONVERGED_PX = TABLE.derived(
    "POSITION_CONVERGED_PX", 1e-5, "px",
    "A hundredth of MAP_ERROR_MAX_PX.",
)

# Maps from a few exact values, in chebyshev_map.py

TESTS_PER_AXIS = TABLE.measured(
    "TESTS_PER_AXIS", 9, "points",
    "At which a map is tested. With 14 or 6, nothing changes in 22 cases; with a thousand times or a thousandth of it "
    "something does.",
    command=TRIED,
)
TEST_OFFSET = TABLE.derived(
    "TEST_OFFSET", 0.37, "steps",
    "Of these points from a regular grid: of each of MAP_DEGREES, six of nine or more are a tenth of a step and "
    "farther from its nodes, where a map cannot be wrong.",
)
MAP_DEGREES = TABLE.cost(
    "MAP_DEGREES", (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96), "degree",
    "That are tried, the lowest first.",
)
MAP_ERROR_MAX_PX = TABLE.derived(
    "MAP_ERROR_MAX_PX", 0.001, "px",
    "At the test points: half of the 0.002 px that are promised, since between them a map may differ by more.",
)
MOVING_ERROR_MAX_PX = TABLE.derived(
    "MOVING_ERROR_MAX_PX", 0.003, "px",
    "With a residual field and a specimen that drifts while a departure of the field is scanned, which is known "
    "to first order: a tenth of the 1 / 32 px to which OpenCV 4 rounds positions.",
)
SLOW_RESPONSE_PX = TABLE.measured(
    "SLOW_RESPONSE_PX", 0.005, "px",
    "Drift during the scan of a departure up to which the specimen drifts slowly. 1.5 times as large or as small, it "
    "changes nothing in 8 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
FIELD_TESTS = TABLE.measured(
    "FIELD_TESTS", (17, 11), "columns, rows",
    "At which a map with a residual field is tested. With (26, 16) or (11, 7), 7 cases are decided alike, and errors "
    "change by less than 0.1 %.",
    command=TRIED,
)
TESTED_NEARBY = TABLE.derived(
    "TESTED_NEARBY", (0.05, 0.01), "of width, height",
    "By which a map may differ from a tested one without another test: half of the distance of the columns of a "
    "test, a tenth of the width at most; down, a twenty-fifth of the distance of the knots.",
)
TESTED_KEPT = TABLE.cost(
    "TESTED_KEPT", 16, "maps",
    "For a magnification that goes up and down, or a stage to and fro.",
)
COMPARED_ROWS = TABLE.stated(
    "COMPARED_ROWS", 49, "rows",
    "At which the interpolation of another field is compared with that of a tested one: some four per node.",
)
COMPARED_FACTOR = TABLE.stated(
    "COMPARED_FACTOR", 2.0, "ratio",
    "That comparison is in one column, of the field and not of its inverse; the inverse of a field whose slope is "
    "some hundredths differs by as much. Ample.",
)
FIELD_DEGREES = TABLE.cost(
    "FIELD_DEGREES", (12, 24, 48), "degree",
    "Down the image, of what the field adds; across it, every column has its values.",
)
SCAN_DEGREES = TABLE.cost(
    "SCAN_DEGREES", (6, 12, 24, 48, 96, 192), "degree",
    "The same of what the distortion of the scan adds.",
)
DEFLECTION_ERROR_MAX_PX = TABLE.derived(
    "DEFLECTION_ERROR_MAX_PX", 0.0005, "px",
    "Half of MAP_ERROR_MAX_PX: where the beam settles, an error of its deflection is one of twice as many "
    "columns.",
)
SCAN_STEP_PX = TABLE.derived(
    "SCAN_STEP_PX", 0.125, "px",
    "Of the table of deflections at a width of 512 px: its error is 0.125^2 / 8 of the curvature, of the fastest "
    "decay of 3 px 0.0002 px for each px of amplitude.",
)
SCAN_BEYOND = TABLE.measured(
    "SCAN_BEYOND", 10.0, "rasters",
    "To which that table goes on from the middle, in straight lines as the deflections do. 1.5 times as large or as "
    "small, it changes nothing in 11 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
SCAN_TESTS = TABLE.measured(
    "SCAN_TESTS", (65, 33, 33), "columns",
    "At which such a map is tested: where lines begin in some of the rows, over SETTLED_AFTER from there, and over "
    "the whole width. With (98, 50, 50) or (43, 22, 22), nothing changes in 11 cases; with a thousand times or a "
    "thousandth of it something does.",
    command=TRIED,
)
SETTLED_AFTER = TABLE.derived(
    "SETTLED_AFTER", 0.2, "of the width",
    "After it the slowest decay, of 48 of 512 columns, is exp(-102 / 48), an eighth.",
)
TESTS_BETWEEN_NODES = TABLE.stated(
    "TESTS_BETWEEN_NODES", np.array([0.25, 0.5, 0.75]), "of a step",
    "Rows at which such a map is tested.",
)
FIELD_BEYOND_STEP = TABLE.cost(
    "FIELD_BEYOND_STEP", 0.125, "of the height",
    "Steps in which the table of a field goes on above and below the image, as far as the drift.",
)
FIELD_TABLES_KEPT = TABLE.cost(
    "FIELD_TABLES_KEPT", 2, "tables",
    "Two magnifications may take turns.",
)
MATRICES_KEPT = TABLE.cost(
    "MATRICES_KEPT", 16, "matrices",
    "By size of image and degree; one stream needs one or two.",
)
OUTSIDE_PX = TABLE.defined(
    "OUTSIDE_PX", -1e4, "px",
    "A raw position outside every frame, for output pixels without one: they come out as 0.",
)

# The inverse of a residual field, in chebyshev_map.py

FIELD_COLUMN_PX = TABLE.measured(
    "FIELD_COLUMN_PX", 0.5, "px",
    "Step along the lines, where the beam settles. 1.5 times as large or as small, 8 cases are decided alike, and "
    "errors change by less than 0.1 %.",
    command=TRIED,
)
FIELD_ROWS_MAX = TABLE.cost(
    "FIELD_ROWS_MAX", 256, "rows",
    "Of a table.",
)
FIELD_ROW_STEP_AT_512 = TABLE.stated(
    "FIELD_ROW_STEP_AT_512", 2.0, "rows",
    "Knots are a quarter of the height apart down the image, so that a few rows do; the error is as the square of "
    "the step times the second derivative, which for one field falls with the height.",
)
FIELD_CONVERGED_PX = TABLE.derived(
    "FIELD_CONVERGED_PX", 0.0004, "px",
    "What further steps would add: less than half of MAP_ERROR_MAX_PX.",
)
FIELD_STEPS_MAX = TABLE.measured(
    "FIELD_STEPS_MAX", 12, "steps",
    "Of the inversion. With 18 or 8, nothing changes in 8 cases; with a thousand times or a thousandth of it "
    "something does.",
    command=TRIED,
)
FIELD_DISPLACEMENT_MAX_PX = TABLE.cost(
    "FIELD_DISPLACEMENT_MAX_PX", 256.0, "px",
    "A larger displacement is none of a microscope, and would make a table much larger than the image.",
)
FIELD_WHOLE_PART = TABLE.cost(
    "FIELD_WHOLE_PART", 0.7, "of the rows",
    "From which a table is made as a whole.",
)

# The phase of bidirectional scans, in line_phase.py

PHASE_MAX_PART = TABLE.measured(
    "PHASE_MAX_PART", 1.0 / 16.0, "of the width",
    "That is looked for: lags are some microseconds, and lines take a millisecond. 1.5 times as large, 1 of 12 cases "
    "is decided otherwise and errors are 5.7 % larger; as small, 1 of 12 cases is decided otherwise and errors are "
    "2.2 % larger.",
    command=TRIED,
)
LINES_COMPARED = TABLE.cost(
    "LINES_COMPARED", 128, "lines",
    "With their neighbours, up to twice as many; seen to tell the phase of gold at 30 electrons to 0.02 px.",
)
SMOOTHING_PX = TABLE.measured(
    "SMOOTHING_PX", 1.0, "px",
    "1-sigma along the lines: noise of single pixels tells nothing. 1.5 times as large, errors are 0.43 % smaller; as "
    "small, 1 of 12 cases is decided otherwise, there are 12 % fewer points or frames, errors are 6.9 % larger and "
    "those of one case 71 % larger.",
    command=TRIED,
)
PHASE_STEPS_MAX = TABLE.measured(
    "PHASE_STEPS_MAX", 6, "steps",
    "Gauss-Newton. With 9 or 4, nothing changes in 12 cases; with a thousand times or a thousandth of it something "
    "does.",
    command=TRIED,
)
PHASE_CONVERGED = TABLE.derived(
    "PHASE_CONVERGED", 0.1, "sigma",
    "That may be left: it adds half a per cent to the error.",
)
LINE_GROUPS = TABLE.derived(
    "LINE_GROUPS", 16, "groups",
    "From whose scatter the sigma is estimated to 1 / sqrt(30), a sixth.",
)
STRUCTURE_SIGMAS = TABLE.stated(
    "STRUCTURE_SIGMAS", 6.0, "sigma",
    "By which neighbours have something in common where there is structure along the lines. Seen: the best of all "
    "shifts of noise in 4 of 6000 images of 20 rows.",
)
REPEATED_PEAK = TABLE.measured(
    "REPEATED_PEAK", 0.8, "of the highest",
    "What repeats has another peak of the correlation at least so high. With 0.867 or 0.7, nothing changes in 12 "
    "cases; with a thousand times or a thousandth of it something does.",
    command=TRIED,
)
REPEATED_VALLEY = TABLE.measured(
    "REPEATED_VALLEY", 0.5, "of the highest",
    "and before it a valley at most so. 1.5 times as large or as small, it changes nothing in 12 cases; a thousand "
    "times or a thousandth of it does.",
    command=TRIED,
)
PHASE_OF_PERIOD = TABLE.measured(
    "PHASE_OF_PERIOD", 0.25, "of the period",
    "Below which the phase is then taken to be. 1.5 times as large or as small, it changes nothing in 12 cases; a "
    "thousand times or a thousandth of it does.",
    command=TRIED,
)
PHASE_SIGMAS = TABLE.derived(
    "PHASE_SIGMAS", 5.0, "sigma",
    "From which a phase is there: Student's t of 15 degrees exceeds it in 1.6 of 10^4 estimates.",
)
PHASE_MIN_PX = TABLE.measured(
    "PHASE_MIN_PX", 0.1, "px",
    "And from so many pixels. 1.5 times as large or as small, it changes nothing in 12 cases; a thousand times or a "
    "thousandth of it does.",
    command=TRIED,
)
LANCZOS_LOBES = TABLE.stated(
    "LANCZOS_LOBES", 4, "lobes",
    "To each side, of the filter that moves lines.",
)
PHASE_MEMORY = TABLE.derived(
    "PHASE_MEMORY", 7.0 / 8.0, "weight",
    "Of the estimates before, against that of the next one: 1 / (1 - 7 / 8) = 8 of them count.",
)
PHASE_FIRST_FRAMES = TABLE.cost(
    "PHASE_FIRST_FRAMES", 8, "frames",
    "In which the phase is estimated first,",
)
PHASE_EVERY = TABLE.cost(
    "PHASE_EVERY", 8, "frames",
    "and then in one of so many.",
)
UNDECLARED_FIRST_FRAMES = TABLE.cost(
    "UNDECLARED_FIRST_FRAMES", 3, "frames",
    "The same where nobody has declared a bidirectional scan,",
)
UNDECLARED_EVERY = TABLE.cost(
    "UNDECLARED_EVERY", 64, "frames",
    "and then.",
)

# Resampling, in rectifier.py

BAND_PIXELS = TABLE.cost(
    "BAND_PIXELS", 1 << 15, "px",
    "Both maps of a band fit a second-level cache; OpenCV resamples so few pixels in one thread.",
)
MAPS_KEPT = TABLE.cost(
    "MAPS_KEPT", 2, "maps",
    "Whole maps of 8 bytes per pixel: two magnifications may take turns.",
)
SIDE_MAX_PX = TABLE.derived(
    "SIDE_MAX_PX", 32766, "px",
    "cv2.remap counts rows and columns in 16 bits.",
)

# Stacks, in stack.py

EDGE_PX = TABLE.derived(
    "EDGE_PX", 1e-3, "px",
    "MAP_ERROR_MAX_PX: a pixel at the edge must not drop out by rounding.",
)

# Interpolations, in stack.py

REACH_PX = TABLE.defined(
    "REACH_PX", {"linear": 0, "cubic": 1, "lanczos4": 3}, "px",
    "Rows or columns that an interpolation takes beyond the two nearest ones.",
)
