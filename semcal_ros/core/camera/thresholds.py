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


"""The numbers of the camera model, each with its source.

"Seen" stands for what was observed when the number was chosen.
"""

from __future__ import annotations

import numpy as np

from semcal_ros.core.thresholds import Table

TABLE = Table()

# Of the measured rows: each says in how many cases it was tried, and what changed in them (doc/thresholds.md).
TRIED = "python -m benchmarks.thresholds camera, 29 November 2026"

# A row takes three lines, and not one for each of its parts.
# fmt: off

# Conditions that differ, in conditions.py

VOLTAGE_TOLERANCE = TABLE.stated(
    "VOLTAGE_TOLERANCE", 0.01, "of the voltage",
    "High-voltage supplies are stable and read back to far less, and lens fields that are focused again follow "
    "the voltage: a magnification changes by no more.",
)
DISTANCE_TOLERANCE = TABLE.stated(
    "DISTANCE_TOLERANCE", 0.01, "of the distance",
    "A working distance follows each focusing: 0.1 mm at 10 mm, less than the focus of a flat specimen scatters.",
)
ROTATION_TOLERANCE_RAD = TABLE.stated(
    "ROTATION_TOLERANCE_RAD", 0.0087, "rad",
    "Half a degree, the 1-sigma that the configuration assumes of a stage's rotation. An aspect ratio of 1 % that "
    "is turned by so much becomes a skew of 2e-4.",
)
CONDITION_TOLERANCE = TABLE.stated(
    "CONDITION_TOLERANCE", 0.01, "of the value",
    "Makers' programs round what they show.",
)

# Beyond the calibrated range, in calibration_model.py

USUAL_CHANGES = TABLE.stated(
    "USUAL_CHANGES",
    {"scale": 0.02, "aspect": 0.01, "skew": 0.002, "ex": 0.04, "ey": 0.04, "xi_r": 0.02, "xi_t": 0.005},
    "of each function, of a half width for the centre",
    "By how much one changes over a factor of e of the magnification where a calibration has seen no such factor: the "
    "1-sigma of the fit's priors, over a decade and more. All other terms of lens and scan change as `xi_t` does.",
)

# Distortion by the lens, in distortion.py

LENS_STEPS_MAX = TABLE.stated(
    "LENS_STEPS_MAX", 50, "steps",
    "Newton's method converges quadratically from the closed inverse of the radial part; a point that needs more "
    "lies at a fold of the map.",
)
LENS_TOLERANCE = TABLE.derived(
    "LENS_TOLERANCE", 1e-14, "half image widths",
    "Of the last step: some ninety roundings of a coordinate of order one, 2^-53.",
)

# Nominal calibrations, in calibration_model.py

CONTRADICTION_SIGMAS = TABLE.derived(
    "CONTRADICTION_SIGMAS", 3.0, "sigma",
    "From which two sizes for one magnification contradict: by chance one of 370 pairs (normal, both sides).",
)

# Cameras of other programs, in pinhole_model.py

COEFFICIENT_POWERS = TABLE.defined(
    "COEFFICIENT_POWERS", (2, 4, 1, 1, 6, 2, 4, 6), "power of r",
    "That each of COEFFICIENTS multiplies.",
)
FOCAL_LENGTH_MAX_PX = TABLE.derived(
    "FOCAL_LENGTH_MAX_PX", 1e7, "px",
    "Stands for a parallel projection: over a tenth of a field of 512 px in height, the scale changes by 5e-6, a "
    "thousandth of a pixel at the edge.",
)
COMPARED_ACROSS = TABLE.stated(
    "COMPARED_ACROSS", 17, "places",
    "Across the field, at which both models are compared,",
)
COMPARED_HEIGHTS = TABLE.stated(
    "COMPARED_HEIGHTS", (-0.1, 0.0, 0.1), "field widths",
    "and the heights at which they are.",
)

# The raw picture as a pinhole's, in pinhole_model.py

PLUMB_BOB_POINTS = TABLE.derived(
    "PLUMB_BOB_POINTS", 10, "points",
    "Along each side of the grid: eleven for each of the nine unknowns.",
)

# The residual field, in residual_field.py

FIELD_DEGREE = TABLE.derived(
    "FIELD_DEGREE", 3, "degree",
    "Cubic splines have two continuous derivatives.",
)
FIELD_BREAKS_X = TABLE.stated(
    "FIELD_BREAKS_X",
    (-1.04, -1.0, -0.97, -0.935, -0.9, -0.8, -0.65, -0.45, -0.22, 0.0, 0.25, 0.5, 0.75, 1.04), "half widths",
    "Knots: densest at the start of the lines, where the beam settles; the outermost lie outside the image, so "
    "that its border is inside the domain.",
)
FIELD_BREAKS_Y = TABLE.stated(
    "FIELD_BREAKS_Y", (-1.04, -0.5, 0.0, 0.5, 1.04), "half heights",
    "Knots.",
)
FIELD_STEPS_MAX = TABLE.measured(
    "FIELD_STEPS_MAX", 20, "steps",
    "Newton's method needs a few; a point that needs more has no raw position. With 30 or 13, nothing changes in 8 "
    "cases; with a thousand times or a thousandth of it something does.",
    command=TRIED,
)
FIELD_TOLERANCE = TABLE.derived(
    "FIELD_TOLERANCE", 1e-9, "half widths",
    "Of the last step, whose square is below the rounding, 2^-53.",
)

# Distortion by the scan, in scan_distortion.py

SETTLING_TIMES = TABLE.stated(
    "SETTLING_TIMES", (0.0117, 0.0234, 0.0469, 0.0938, 0.1875), "half lines",
    "Time constants of the settling, 3, 6, 12, 24 and 48 columns of 512: a factor of two apart, they stand for any "
    "decay in between.",
)
SCAN_END = TABLE.defined(
    "SCAN_END", 1.0, "half lines",
    "Beyond the picture the functions go on as straight lines.",
)
SCAN_STEPS_MAX = TABLE.measured(
    "SCAN_STEPS_MAX", 30, "steps",
    "Newton's method converges quadratically; a function as steep as it may be was seen to take five. With 45 or 20, "
    "nothing changes in 1 case; with a thousand times or a thousandth of it something does.",
    command=TRIED,
)
SCAN_LAST_STEP = TABLE.stated(
    "SCAN_LAST_STEP", 1e-7, "half lines",
    "Seen to leave 1e-9 px where the settling is the quickest and as steep as it may be, and much less elsewhere.",
)
SCAN_SLOPE_MAX = TABLE.measured(
    "SCAN_SLOPE_MAX", 0.9, "1",
    "Beyond it the beam would hardly go forwards: no answer. 1.5 times as large or as small, it changes nothing in 1 "
    "case; a thousand times or a thousandth of it does.",
    command=TRIED,
)
LEGENDRE_POWERS = TABLE.derived(
    "LEGENDRE_POWERS", np.array([
        [-0.5, 0.0, 1.5, 0.0, 0.0, 0.0, 0.0, 0.0],
        [0.0, -1.5, 0.0, 2.5, 0.0, 0.0, 0.0, 0.0],
        [0.375, 0.0, -3.75, 0.0, 4.375, 0.0, 0.0, 0.0],
        [0.0, 1.875, 0.0, -8.75, 0.0, 7.875, 0.0, 0.0],
        [-0.3125, 0.0, 6.5625, 0.0, -19.6875, 0.0, 14.4375, 0.0],
        [0.0, -2.1875, 0.0, 19.6875, 0.0, -43.3125, 0.0, 26.8125],
    ]), "1",
    "Coefficients of the powers of u in the Legendre polynomials P2 to P7.",
)

# Raster timing, in scan_timing.py

FRAME_TIME_MAX_S = TABLE.stated(
    "FRAME_TIME_MAX_S", 1e6, "s",
    "Eleven days: what is longer has lost its unit.",
)

# Sizes of terms, in term_sizes.py

TERM_SIZES_ACROSS = TABLE.stated(
    "TERM_SIZES_ACROSS", 33, "points",
    "Of the lattice along each side of the picture, its outermost pixels among them.",
)

# The budget, in uncertainty.py

SPECIMEN_TILT_SIGMA_RAD = TABLE.stated(
    "SPECIMEN_TILT_SIGMA_RAD", 0.0087, "rad",
    "Half a degree, 1-sigma, of a specimen that is mounted flat, as in the priors of a calibration.",
)
COVERAGE_FACTOR = TABLE.derived(
    "COVERAGE_FACTOR", 2.0, "sigma",
    "Of the expanded uncertainty: 95.4 % of a normal distribution (JCGM 100:2008, 6.3.3).",
)
JUDGED_MAGNIFICATIONS = TABLE.derived(
    "JUDGED_MAGNIFICATIONS", 25, "magnifications",
    "At which the range is judged: nearly four per factor of two over two decades.",
)
LENGTH_PLACES = TABLE.stated(
    "LENGTH_PLACES", (0.25, 0.5, 0.75), "of width and height",
    "Where a length may lie in the image: the worst of these places counts.",
)
