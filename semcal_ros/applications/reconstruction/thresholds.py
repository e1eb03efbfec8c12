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

"""The numbers of the reconstruction of balls and reliefs, each with its source."""

from __future__ import annotations

import math

import numpy as np

from semcal_ros.core.thresholds import Table

TABLE = Table()

# Of the measured rows: each says in how many cases it was tried, and what changed in them (doc/thresholds.md).
TRIED = "python -m benchmarks.thresholds reconstruction, 29 November 2026"

# A row takes three lines, and not one for each of its parts.
# fmt: off

# Tracks, in feature_tracks.py

FEATURES_MIN = TABLE.measured(
    "FEATURES_MIN", 30, "features",
    "With fewer left, the whole frame is processed: the others may be anywhere. With 45 or 20, nothing changes in 5 "
    "cases; with a thousand times or a thousandth of it something does.",
    command=TRIED,
)

# Pairs of views, in epipolar.py

PAIRS_MIN = TABLE.derived(
    "PAIRS_MIN", 5, "pairs",
    "Four define the geometry, a fifth tests it.",
)

# Factorization, in factorization.py

WINDOWS = TABLE.cost(
    "WINDOWS", (3, 4, 6, 8, 12, 16, 24, 32, 48), "views",
    "Successive ones that are tried as the first block: short blocks share more points, long ones turn farther.",
)
COMMON_MIN = TABLE.measured(
    "COMMON_MIN", 12, "points",
    "That all views of a block share: four times the rank, so that the other singular values show the noise. With 18 "
    "or 8, nothing changes in 4 cases; with a thousand times or a thousandth of it something does.",
    command=TRIED,
)
VIEW_POINTS_MIN = TABLE.measured(
    "VIEW_POINTS_MIN", 8, "points",
    "In a view: twice the four unknowns of each row of its camera. With 12 or 5, nothing changes in 4 cases; with a "
    "thousand times or a thousandth of it something does.",
    command=TRIED,
)
BLOCK_VIEWS_MIN = TABLE.derived(
    "BLOCK_VIEWS_MIN", 3, "views",
    "Two affine views leave the relief open.",
)
HUBER_SIGMAS = TABLE.measured(
    "HUBER_SIGMAS", 1.5, "sigma",
    "On the norm of a residual: near the 1.345 that is 95 % efficient with one normal deviate. Of normal points, a "
    "third is beyond and loses weight, exp(-1.5^2 / 2). 1.5 times as large, errors are 4.1 % smaller; as small, "
    "errors are 6.9 % larger.",
    command=TRIED,
)
DEPTH_LEVER_MIN = TABLE.stated(
    "DEPTH_LEVER_MIN", 1e-3, "of that across the view",
    "Squared lever arm of the depth of a new point, until which it waits.",
)

# Bundle adjustment, in adjustment.py

CAUCHY_SIGMAS = TABLE.stated(
    "CAUCHY_SIGMAS", 2.5, "sigma",
    "On the norm of a residual, from which the loss grows slower, Cauchy's constant; 2.385 is 95 % efficient with "
    "one normal deviate.",
)
SCALE_MIN = TABLE.defined(
    "SCALE_MIN", 1e-6, "sigma",
    "Least scale of the residuals, for observations without errors.",
)
DEPTH_PRIOR = TABLE.stated(
    "DEPTH_PRIOR", 3.0, "spreads",
    "Prior 1-sigma of the heights of the points, in their spread: no limit in practice.",
)

# Shading, in appearance.py

SECOND_DIFFERENCE = TABLE.defined(
    "SECOND_DIFFERENCE", np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0]) / 6.0, "grey levels",
    "Along both axes. Its squares sum to 1, so that it keeps the sigma of the noise.",
)
SHADING_DEGREE = TABLE.stated(
    "SHADING_DEGREE", 4, "degree",
    "Of the polynomial in X and Y of the normal: a cosine and its square, seen from any side, and shadows as wide "
    "as a quarter of the ball.",
)
LIMB_TERMS = TABLE.stated(
    "LIMB_TERMS", 4, "terms",
    "With the logarithm of the cosine and its inverse, all powers between them were seen to be reached within a per "
    "cent up to 70 degrees.",
)
COSINE2_MIN = TABLE.measured(
    "COSINE2_MIN", 0.01, "squared cosine",
    "At 84 degrees: the limb is not steeper than the beam spot lets it be. 1.5 times as large, errors change by less "
    "than 0.1 %; as small, errors are 5 % larger.",
    command=TRIED,
)
SHADING_OUTLIER = TABLE.stated(
    "SHADING_OUTLIER", 2.5, "median error",
    "From which a patch shows something else, an edge or the tip.",
)
SHADING_NODES = TABLE.measured(
    "SHADING_NODES", 257, "nodes",
    "Along X and Y: linear interpolation was seen to be right to 1e-4 of the range of the cosine. With 386 or 171, 4 "
    "cases are decided alike, and errors change by 2.1 % at most.",
    command=TRIED,
)
SHADING_CONDITION = TABLE.measured(
    "SHADING_CONDITION", 1e-4, "of the largest singular value",
    "Directions of the coefficients that the views determine less stay zero. 1.5 times as large or as small, it "
    "changes nothing in 4 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)

# Patches, in patches.py

WINDOW = TABLE.stated(
    "WINDOW", 0.6, "half patches",
    "Sigma of the window in which patches are compared.",
)
PATCH_GAIN_MIN = TABLE.cost(
    "PATCH_GAIN_MIN", 0.3, "of the template",
    "Contrast of a patch, that keeps a division bounded for those that are hardly like the template; their "
    "correlation rejects them afterwards.",
)
SHADING_POINTS = TABLE.cost(
    "SHADING_POINTS", 100, "points",
    "From which the shading is learnt: some 60 000 samples for 18 coefficients.",
)
POINTS_AT_ONCE = TABLE.cost(
    "POINTS_AT_ONCE", 64, "points",
    "Whose patches are compared together: of 150 views some 9 MB.",
)

# Passes, in reconstruct.py

POINT_MISFIT_MAX = TABLE.stated(
    "POINT_MISFIT_MAX", 2.0, "of the median point's",
    "Mean square of the residuals of a point. Of points that turn with a ball, 99 of 100 were seen to be below; of "
    "those on the outline of its tip, most above.",
)

# Spheres, in ball.py

SPHERE_TRIALS = TABLE.derived(
    "SPHERE_TRIALS", 500, "samples",
    "Random ones of four points. If only a third of the points is on the sphere, one sample in 81 is good, and all "
    "are bad with a chance of 0.2 %.",
)
SPHERE_POINTS_MIN = TABLE.derived(
    "SPHERE_POINTS_MIN", 8, "points",
    "Twice the four unknowns of a sphere.",
)

# Local surfaces, in surface.py

SURFACE_NEIGHBOURS = TABLE.cost(
    "SURFACE_NEIGHBOURS", 48, "points",
    "In a fit, at most: eight for each coefficient of a quadric.",
)
SURFACE_POINTS_MIN = TABLE.derived(
    "SURFACE_POINTS_MIN", 8, "points",
    "A quadric has six coefficients; two more show the scatter.",
)

# A ball or not, in ball.py

OFF_SPHERE = TABLE.measured(
    "OFF_SPHERE", 0.2, "of the radius",
    "Points farther off belong to what holds the ball. 1.5 times as large or as small, it changes nothing in 3 cases; "
    "a thousand times or a thousandth of it does.",
    command=TRIED,
)
NECK_RAD = TABLE.measured(
    "NECK_RAD", 0.35, "rad",
    "About such points, within which others are left out: the neck of the tip. 1.5 times as large or as small, it "
    "changes nothing in 3 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
BUMP_RAD = TABLE.measured(
    "BUMP_RAD", 0.2, "rad",
    "1-sigma of a window. A bump as wide as it shows most clearly; narrower ones, or with a few points in them, show "
    "noise. 1.5 times as large or as small, it changes nothing in 3 cases; a thousand times or a thousandth of it "
    "does.",
    command=TRIED,
)
BUMP_POINTS_MIN = TABLE.stated(
    "BUMP_POINTS_MIN", 5.0, "points",
    "In a window, by weight.",
)
ROUNDNESS_FALSE_ALARMS = TABLE.defined(
    "ROUNDNESS_FALSE_ALARMS", 0.005, "chance",
    "With which a true ball is said to be none, over both searches.",
)
HEIGHT_SIGMAS = TABLE.derived(
    "HEIGHT_SIGMAS", 2.5, "robust sigmas",
    "Heights beyond count as so many: of normal ones, one of 80 (both sides).",
)
ROBUST_ROUNDS = TABLE.cost(
    "ROBUST_ROUNDS", 10, "rounds",
    "Of either loss.",
)
FREEDOM_MIN = TABLE.defined(
    "FREEDOM_MIN", 1e-3, "residuals",
    "Keeps a division from zero where a point alone decides a fit.",
)

# The diameter, in ball.py

JACKKNIFE_FALSE_ALARMS = TABLE.defined(
    "JACKKNIFE_FALSE_ALARMS", 0.05, "chance",
    "With which the jackknife, of few degrees of freedom, counts instead of the noise that is predicted.",
)
PATCH_GROUPS = TABLE.measured(
    "PATCH_GROUPS", 16, "groups",
    "Of neighbouring patches, that are left out in turn: each holds many patches, and fifteen degrees of freedom tell "
    "a sigma to 18 %. With 24 or 11, 3 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)

# Pairs of tilted pictures, in tilt_series.py

DESCRIPTOR_RATIO = TABLE.derived(
    "DESCRIPTOR_RATIO", 0.8, "ratio",
    "Of the distances of the best and the second best descriptor (Lowe 2004, section 7.1, "
    "doi:10.1023/B:VISI.0000029664.99615.94).",
)
MATCH_TOLERANCE_PX = TABLE.measured(
    "MATCH_TOLERANCE_PX", 2.0, "px",
    "Three times the 0.7 px that a SIFT feature of a coarser octave is uncertain by. 1.5 times as large or as small, "
    "10 cases are decided alike, and errors change by 0.74 % at most.",
    command=TRIED,
)
MATCH_NEIGHBOURS = TABLE.measured(
    "MATCH_NEIGHBOURS", 8, "matches",
    "That a match is compared with: enough for a median that one wrong match among them does not move. With 12 or 5, "
    "nothing changes in 9 cases; with a thousand times or a thousandth of it something does.",
    command=TRIED,
)
NEIGHBOUR_SIGMAS = TABLE.measured(
    "NEIGHBOUR_SIGMAS", 6.0, "robust sigmas",
    "By which it may be shifted against them: relief is steeper in places than its spread tells, so that no rate is "
    "known. 1.5 times as large or as small, it changes nothing in 9 cases; a thousand times or a thousandth of it "
    "does.",
    command=TRIED,
)
MATCHES_MIN = TABLE.measured(
    "MATCHES_MIN", 20, "matches",
    "Fewer leave the axis to a handful of places of the specimen. With 30 or 13, 10 cases are decided alike, and "
    "errors change by less than 0.1 %.",
    command=TRIED,
)
OVERLAP_MIN = TABLE.measured(
    "OVERLAP_MIN", 0.2, "of the picture",
    "That the other has to show. With less, the axis comes from a strip along one edge: at a tenth it was seen to be "
    "off by three of its sigmas, at a quarter not. 1.5 times as large, 1 of 10 cases is decided otherwise and there "
    "are 4.9 % fewer points or frames; as small, errors change by less than 0.1 %.",
    command=TRIED,
)
OVERLAP_MATCHES = TABLE.derived(
    "OVERLAP_MATCHES", 5, "matches",
    "From which an overlap is computed: an affine map needs three, and two more test it.",
)
PARALLAX_MAX = TABLE.measured(
    "PARALLAX_MAX", 0.05, "of the width",
    "RMS, beyond which matches are wrong: relief of a tenth of the field at 30 degrees makes a twentieth. 1.5 times "
    "as large or as small, it changes nothing in 10 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
MATCHES_PART_MIN = TABLE.measured(
    "MATCHES_PART_MIN", 0.25, "of the matches",
    "A pair of pictures of which fewer agree is not described by one parallel projection. 1.5 times as large or as "
    "small, it changes nothing in 10 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
PARALLAX_MIN = TABLE.measured(
    "PARALLAX_MIN", 2.0, "noise",
    "Of the matches, that the parallax has to exceed, or the axis is a fit of noise. 1.5 times as large, 1 of 10 "
    "cases is decided otherwise and there are 18 % fewer points or frames; as small, 1 of 10 cases is decided "
    "otherwise.",
    command=TRIED,
)
GREY_WINDOW_PX = TABLE.stated(
    "GREY_WINDOW_PX", 2.5, "px",
    "1-sigma of the window in which grey levels are compared.",
)
WINDOW_REACH = TABLE.derived(
    "WINDOW_REACH", 3.0, "sigmas",
    "Of this window, within which a pixel that does not show the specimen spoils a height: 0.3 % of it lies beyond "
    "along either axis.",
)
MATCH_STEPS = TABLE.derived(
    "MATCH_STEPS", 3, "steps",
    "Of the refinement, each of which gives back what the window smoothed away; NOISE_GAIN is that of three.",
)
NOISE_GAIN = TABLE.derived(
    "NOISE_GAIN", 2.0 * (9 / 2 - 18 / 3 + 15 / 4 - 6 / 5 + 1 / 6), "ratio",
    "Of the variance after three steps to that of one: the integral of |1 - (1 - B)^3|^2 over that of B^2, for the "
    "transfer function B of a Gaussian in the plane.",
)
KEPT_NOISE = TABLE.derived(
    "KEPT_NOISE", 0.5 * ((6 / 7) ** 2 + (6 / 7) ** 3), "of the variance",
    "Of white noise that interpolation keeps. OpenCV's cubic kernel keeps 6/7 per direction; the first picture is "
    "resampled along both, the second once more along rows.",
)
GREY_CORRELATION_MIN = TABLE.derived(
    "GREY_CORRELATION_MIN", 0.7, "correlation",
    "Of grey levels that are compared: half of their variance is common.",
)
DISPARITY_AGREEMENT_PX = TABLE.measured(
    "DISPARITY_AGREEMENT_PX", 1.0, "px",
    "Between the disparities from either side: the step of the search. 1.5 times as large or as small, 6 cases are "
    "decided alike, and errors change by 2.2 % at most.",
    command=TRIED,
)

# Series of tilts, in tilt_series.py

TILT_STEP_MIN_RAD = TABLE.measured(
    "TILT_STEP_MIN_RAD", math.radians(0.5), "rad",
    "Between two pictures: at 0.5 degrees an error of 0.1 px is one of 11 px in height. 1.5 times as large or as "
    "small, 11 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
TILT_STEP_MAX_RAD = TABLE.measured(
    "TILT_STEP_MAX_RAD", math.radians(45.0), "rad",
    "Beyond it, pictures of rough surfaces hide too much of each other. 1.5 times as large or as small, 11 cases are "
    "decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
AXIS_DOUBT_RAD = TABLE.derived(
    "AXIS_DOUBT_RAD", math.radians(45.0), "rad",
    "From the expected axis: farther off, it could be the expected one in either sense.",
)
COVERAGE_MIN = TABLE.measured(
    "COVERAGE_MIN", 0.02, "of the picture",
    "That has to have a height, or the map says nothing about the specimen. 1.5 times as large or as small, it "
    "changes nothing in 6 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
CONTRADICTION_SIGMAS = TABLE.derived(
    "CONTRADICTION_SIGMAS", 4.0, "sigma",
    "Of the difference of two heights, beyond which matches are wrong: by chance one of 16 000 (normal, both "
    "sides).",
)
