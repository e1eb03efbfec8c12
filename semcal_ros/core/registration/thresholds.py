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

"""The numbers of registration, each with its source."""

from __future__ import annotations

import numpy as np

from semcal_ros.core.thresholds import Table

TABLE = Table()

# Of the measured rows: each says in how many cases it was tried, and what changed in them (doc/thresholds.md).
TRIED = "python -m benchmarks.thresholds registration, 26 November 2026"
BODIES_TRIED = "python -m benchmarks.thresholds registration, 30 November 2026"

# A row takes three lines, and not one for each of its parts.
# fmt: off

# Defaults of RegistrationSettings, in reference.py

OVERLAP_MIN = TABLE.stated(
    "OVERLAP_MIN", 0.3, "of the smaller image",
    "For a shift to be searched for: the less two images have in common, the higher they correlate by chance.",
)
SIGMA_PX_MAX = TABLE.stated(
    "SIGMA_PX_MAX", 0.5, "px",
    "1-sigma of a shift in its worst direction, so that it is right to a pixel in 95 of 100 frames.",
)
CORRELATION_MIN = TABLE.stated(
    "CORRELATION_MIN", 0.6, "correlation",
    "Free of noise; below, two thirds of the variance of either image (1 - 0.6^2) are not in the other one.",
)
COMPETING_HEIGHT_MIN = TABLE.stated(
    "COMPETING_HEIGHT_MIN", 0.7, "of the highest peak",
    "Of peaks that are compared by how well they explain the image; lower ones are structure that resembles itself "
    "a little.",
)
DEVIATIONS_MIN = TABLE.derived(
    "DEVIATIONS_MIN", 5.0, "standard errors",
    "By which a peak must explain the image better than each other one: by chance, one in 3.5 million does.",
)

# Believed shifts, in acceptance.py and one_direction.py

STAGES_APART_PX_MAX = TABLE.measured(
    "STAGES_APART_PX_MAX", 1.0, "px",
    "By which the fine shift may be off the coarse one, beyond the sample of the surface that the vertex of a "
    "parabola is good to: for textures whose reduced images alias. 1.5 times as large or as small, it changes "
    "nothing in 20 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
HALVES_SIGMAS = TABLE.derived(
    "HALVES_SIGMAS", 5.0, "sigma",
    "By which two halves of an image may differ by chance: along one axis, more is one in 1.7 million.",
)
HALVES_PX_MAX = TABLE.measured(
    "HALVES_PX_MAX", 0.3, "px",
    "By which they may differ, too, for distortion that is left in the images: a change of scale of 1 part in "
    "1000 over the 300 px between the middles of halves of 600 px. 1.5 times as large or as small, 21 cases are "
    "decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
SAME_SHIFT_PX = TABLE.measured(
    "SAME_SHIFT_PX", 0.5, "px",
    "Shifts that were refined to within this distance of each other are one. 1.5 times as large or as small, it "
    "changes nothing in 23 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)

# Whether a reference and an image can be used, in register.py

SIDE_PX_MIN = TABLE.derived(
    "SIDE_PX_MIN", 48, "px",
    "Of what is compared: 36 px are left between the margins of the filters, 6 x 6 tiles of 6 px, from whose "
    "scatter the covariance of the shift can just be told.",
)
TEXTURE_PX_MIN = TABLE.stated(
    "TEXTURE_PX_MIN", 16, "px",
    "Side of the part in which noise and structure are measured: its spectrum has three coefficients to a ring.",
)
GREY_LEVEL_MAX = TABLE.derived(
    "GREY_LEVEL_MAX", 1e15, "grey levels",
    "Of an image of floats: the sum of the squares of 10^8 pixels is a float of 32 bits, which ends at 3.4e38.",
)
LEVEL_PX_MIN = TABLE.derived(
    "LEVEL_PX_MIN", 160, "px",
    "Of a reduced image: it leaves 24 tiles of the least side, 6 px, along each side between the margins of the "
    "filters. Coarser levels would have fewer.",
)
SIGNAL_MIN = TABLE.derived(
    "SIGNAL_MIN", 0.06, "of the variance of the noise",
    "Variance of the structure. Of images of noise, one in 50 of 96 px has more by chance, one in 200 of 128 px, and "
    "none of 10 000 of 192 px and more.",
)
WEAK_SIGNAL_MIN = TABLE.stated(
    "WEAK_SIGNAL_MIN", 2.0 * SIGNAL_MIN, "of the variance of the noise",
    "Below, a good part of it is chance; where the richest parts show more than noise, they tell the smoothing.",
)
PARTS_SIGNAL_MIN = TABLE.derived(
    "PARTS_SIGNAL_MIN", 0.3, "of the variance of the noise",
    "The same of the richest parts: those of 1550 images of noise, 192 to 768 px, had 0.21 at most.",
)
SIGNIFICANCE_MIN = TABLE.derived(
    "SIGNIFICANCE_MIN", 8.0, "standard errors",
    "By which the gradient of what is faint everywhere is more than that of white noise. Of 19 000 images of noise of "
    "48 to 256 px, two have more by chance, both of 64 px and less.",
)
SIGNAL_SHARE_MIN = TABLE.measured(
    "SIGNAL_SHARE_MIN", 0.02, "of the whole variance",
    "That the structure has, however large the noise is estimated: the correlation stays finite. 1.5 times as "
    "large or as small, it changes nothing in 20 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
NOISE_ERROR = TABLE.stated(
    "NOISE_ERROR", 0.1, "of the variance of the noise",
    "To which it is known: to 7 % of a single image (NOISE_SPECTRUM_PX), and to less of a mean of shifted ones.",
)
CONTRAST_CHANGE = TABLE.stated(
    "CONTRAST_CHANGE", 0.1, "of the contrast",
    "By which the contrast of an image is expected to differ from that of its reference, where noise hides it.",
)
FARTHER_PX = TABLE.stated(
    "FARTHER_PX", 8.0, "px",
    "Along lines, by which an image that shows more than lines fits worse: beyond the width of any detail.",
)
PULL_PX_MAX = TABLE.measured(
    "PULL_PX_MAX", 2.0, "px",
    "1-sigma of a shift with what a part may pull: one that may pull by more is another motion, and not one that "
    "was not found. 1.5 times as large or as small, it changes nothing in 17 cases; a thousand times or a "
    "thousandth of it does.",
    command=TRIED,
)

# Fixed pixels, in fixed_pixels.py and register.py

SMEARED_PX = TABLE.derived(
    "SMEARED_PX", 2, "px",
    "Around fixed pixels that the filters of gradients and of interpolation spoil, beyond the smoothing: farther "
    "out, those of smooth images have less than a twentieth of the squares of their weights.",
)
DROPPED_WITHIN_PX = TABLE.measured(
    "DROPPED_WITHIN_PX", 1, "px",
    "By which the shift at which fixed pixels are dropped may be off the one that is found; farther away they are "
    "dropped again, there. With 0 or 2, 25 cases are decided alike, and errors change by 0.13 % at most.",
    command=TRIED,
)
DROPPED_MAX = TABLE.cost(
    "DROPPED_MAX", 3, "shifts",
    "At which they are dropped: the predicted one, and those that were found.",
)

# The specimen where not all moves with it, in specimen.py and register.py

SPECIMEN_SHARE_MIN = TABLE.measured(
    "SPECIMEN_SHARE_MIN", 0.85, "of the structure",
    "That agrees with a shift which is the specimen's by itself. Where less does, images are of two motions, "
    "though no part was found to be one. With 0.775 or 0.9, it changes nothing in 25 cases; a thousand times or a "
    "thousandth of it does.",
    command=TRIED,
)
PREDICTED_SHARE_MIN = TABLE.measured(
    "PREDICTED_SHARE_MIN", 0.1, "of the structure",
    "That agrees with any shift that is tried; whether it is the specimen's, a prediction may say then. 1.5 times "
    "as large or as small, it changes nothing in 7 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
MAJORITY_SHARE = TABLE.derived(
    "MAJORITY_SHARE", 0.5, "of the structure",
    "Of which one shift at most can have more.",
)
WELL_PREDICTED_PX = TABLE.stated(
    "WELL_PREDICTED_PX", 1.0, "px",
    "1-sigma of a prediction that leaves no place for two motions.",
)
PREDICTED_PX_MAX = TABLE.measured(
    "PREDICTED_PX_MAX", 4.0, "px",
    "1-sigma up to which a prediction is a start of its own, and says which motion is the specimen's. 1.5 times "
    "as large or as small, it changes nothing in 7 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
HYPOTHESES_MAX = TABLE.cost(
    "HYPOTHESES_MAX", 3, "peaks",
    "Of the correlation from which a motion is looked for.",
)
NEAR_CHI2_MAX = TABLE.derived(
    "NEAR_CHI2_MAX", 18.4, "chi-square, 2 degrees of freedom",
    "Up to which a shift is the predicted one: beyond are one in 10^4, exp(-18.4 / 2).",
)
NOISE_PATCHES = TABLE.stated(
    "NOISE_PATCHES", 3, "patches",
    "Along each axis, in which the noise is measured.",
)

# Light that is not that of the reference, in illumination.py and register.py

LIGHT_EXCESS_MIN = TABLE.measured(
    "LIGHT_EXCESS_MIN", 0.2, "of what the light that neighbours foretell leaves",
    "That one gain and one plane leave more. 1.5 times as large, 26 cases are decided alike, and errors change by "
    "1.6 %; as small, it changes nothing in them.",
    command=BODIES_TRIED,
)
LIGHT_SIGMAS = TABLE.derived(
    "LIGHT_SIGMAS", 5.0, "sigma",
    "By which it is more than chance: the variance of smoothed noise over that of independent noise of n pixels is "
    "known to the square root of 2 / n; more is one in 3.5 million.",
)
LIGHT_NOISE_MIN = TABLE.stated(
    "LIGHT_NOISE_MIN", 0.2, "of the variance of the noise",
    "That planes over tiles leave; where smoothing leaves less, they leave nothing of the specimen.",
)
LIGHT_SHARE_MIN = TABLE.stated(
    "LIGHT_SHARE_MIN", 0.3, "of the tiles",
    "That agree but for their light; of fewer, the rest of an image would be drawn.",
)
LIGHT_GAIN_CHANGE = TABLE.measured(
    "LIGHT_GAIN_CHANGE", 0.3, "of the usual gain",
    "1-sigma to which the gain of a tile is known before it is measured. 1.5 times as large or as small, 21 cases are "
    "decided alike; as small, errors are 11 % larger.",
    command=BODIES_TRIED,
)
LIGHT_GAIN_RATIO_MAX = TABLE.measured(
    "LIGHT_GAIN_RATIO_MAX", 3.0, "of the usual gain",
    "To either side, of the gain of a tile: noise is made as much larger where it is dark. 1.5 times as large, errors "
    "change by 1.3 %; as small, 1 of 21 cases is decided otherwise and errors are 12 % larger.",
    command=BODIES_TRIED,
)
RICH_SIGMAS = TABLE.derived(
    "RICH_SIGMAS", 13.5, "sigma",
    "Of the noise by which a tile stands out that tells a gain: chosen by its own noise, it is 7 % off at most.",
)
STRUCTURE_MIN = TABLE.derived(
    "STRUCTURE_MIN", 2.0, "of the variance of the noise",
    "Of structure beside planes over tiles, to tell a gain: the noise is known to a tenth of it (NOISE_ERROR), or to a "
    "fifth where it is not white, and so the gain to 5 or 10 %.",
)
LIGHT_GROUPS = TABLE.stated(
    "LIGHT_GROUPS", 5, "groups",
    "Of tiles of one brightness, each of which tells whether the specimen is seen there. With 3, errors of 6 cases are "
    "15 % smaller, and a tool is more easily taken for light.",
)
COVERED_SIGMAS = TABLE.derived(
    "COVERED_SIGMAS", 2.5, "sigma",
    "By which tiles have less in common with the specimen than half of what the darkest shadow leaves, or surely "
    "more than nothing: by chance one in 160.",
)
LIGHT_KEPT_MIN = TABLE.measured(
    "LIGHT_KEPT_MIN", 0.3, "of the squares of the gradients",
    "That must tell a shift beside light that is free; of less, the shift is as uncertain as light moves it. 1.5 times "
    "as large or as small, 31 cases are decided alike, and errors change by 1.2 % at most.",
    command=BODIES_TRIED,
)
LIGHT_KEPT_LEAST = TABLE.cost(
    "LIGHT_KEPT_LEAST", 0.05, "of the squares of the gradients",
    "By which a step is divided that light took its part of; keeps it finite where there is nothing.",
)
LIGHT_GUESS_PX_MAX = TABLE.stated(
    "LIGHT_GUESS_PX_MAX", 2.0, "px",
    "1-sigma of a predicted shift at which the light of an image is measured that has none of its own.",
)

# Tiles that agree with a shift, in agreement.py

MISSING_MAX = TABLE.stated(
    "MISSING_MAX", 0.4, "of the structure",
    "Of a tile that may be missing: contrast changes with charging, focus and contamination by some tenths over a "
    "field.",
)
APART_MIN = TABLE.derived(
    "APART_MIN", 4.5, "standard deviations",
    "Between the means of two classes of brightness, of what each scatters by, for a body and its ground: the halves "
    "of a normal distribution are 2.65 apart, those of a uniform one, as of light that rises evenly, 3.46.",
)
BESIDES_MAX = TABLE.measured(
    "BESIDES_MAX", 0.6, "of the structure",
    "Of a tile that may be there besides, for the same reason. With 0.733, 2 of 19 cases are decided otherwise; "
    "with 0.4, 2 of 19 cases are decided otherwise and errors are 17 % larger.",
    command=TRIED,
)
AGREEMENT_SIGMAS = TABLE.derived(
    "AGREEMENT_SIGMAS", 4.5, "sigma",
    "Of the noise by which a tile must exceed that, or have a shift of its own: by chance once in 300 000 tiles "
    "on one side, in 150 000 on both.",
)
SHOWS_SMOOTHING_PX = TABLE.stated(
    "SHOWS_SMOOTHING_PX", 2.0, "px",
    "Beyond that of a sparse reference, for whether its tiles show structure: edges of bodies are as wide, and a tile "
    "of 16 px still has four gradients that chance does not share. Of 173 000 tiles of noise none shows any.",
)
TILE_SHIFT_PX_MAX = TABLE.measured(
    "TILE_SHIFT_PX_MAX", 0.15, "px",
    "Of a tile against the others, beyond the noise: distortion and interpolation leave some hundredths. 1.5 "
    "times as large, 1 of 19 cases is decided otherwise; as small, errors change by 1.2 %.",
    command=TRIED,
)
SUSPECT_SIGMAS = TABLE.derived(
    "SUSPECT_SIGMAS", 3.5, "sigma",
    "From which a tile is looked at together with its neighbours: by chance one in 2100.",
)
BEST_TILES = TABLE.measured(
    "BEST_TILES", 0.3, "of the tiles",
    "That fit best: what they leave is noise, of which interpolation hides some from where it is measured. 1.5 "
    "times as large, 1 of 19 cases is decided otherwise; as small, errors change by less than 0.1 %.",
    command=TRIED,
)
GAIN_MIN = TABLE.measured(
    "GAIN_MIN", 0.3, "ratio of contrasts",
    "Of a tile whose gain counts: less is that of another place, and what came in has nothing in common with what "
    "it covers. 1.5 times as large or as small, 19 cases are decided alike, and errors change by 0.69 % at most.",
    command=TRIED,
)
GAIN_RATIO_MAX = TABLE.measured(
    "GAIN_RATIO_MAX", 1.5, "of the median gain",
    "To either side, within which the gain of the image may be: what came in must not say how bright the specimen "
    "is. 1.5 times as large, 1 of 19 cases is decided otherwise; as small, 1 of 19 cases is decided otherwise.",
    command=TRIED,
)
TELLING_TILES_MIN = TABLE.measured(
    "TELLING_TILES_MIN", 12, "tiles",
    "That tell a gain, or how a shift changes over the field; half as many tell what the tiles of a row share. "
    "With 8 or 18, 19 cases are decided alike, and errors change by 0.74 % at most.",
    command=TRIED,
)
TELLING_SIGMA_PX_MAX = TABLE.measured(
    "TELLING_SIGMA_PX_MAX", 0.5, "px",
    "1-sigma of the shift of a tile; one that is less certain says nothing by it. 1.5 times as large or as small, "
    "19 cases are decided alike, and errors change by 1.8 % at most.",
    command=TRIED,
)
ODD_BODIES_LEFT_MIN = TABLE.measured(
    "ODD_BODIES_LEFT_MIN", 4, "bodies",
    "That lie apart from the one that moves otherwise and agree with each other: of two or three, as many may be "
    "tools. With 3 or 6, 25 cases are decided alike; with 99 times as many, errors of one double.",
    command=BODIES_TRIED,
)
ODD_BODIES_SPREAD_MIN = TABLE.measured(
    "ODD_BODIES_SPREAD_MIN", 0.5, "of the image in both directions",
    "Over which these lie: the parts of a tool lie together, and those of a specimen anywhere. 1.5 times as large or "
    "as small, it changes nothing in 5 cases; 99 times as large, errors of one double.",
    command=BODIES_TRIED,
)
ODD_BODY_CHI2_MIN = TABLE.derived(
    "ODD_BODY_CHI2_MIN", 16.0, "chi-square with 2 degrees of freedom",
    "From which a body moves otherwise than all others: by chance one in 3000, exp(8), so that of twenty that all move "
    "alike, one is left out in one of 150 images.",
)
WITNESSES_MIN = TABLE.measured(
    "WITNESSES_MIN", 2, "bodies",
    "That move alike, and otherwise than one that outweighs them, so that either may be the specimen. One alone may be "
    "a particle that is pushed over a plate. With 1 or 3, nothing changes in 4 cases; with 99 times as many it does.",
    command=BODIES_TRIED,
)
SHEAR_OF_BODIES_PX = TABLE.measured(
    "SHEAR_OF_BODIES_PX", 0.5, "px over the height of the image",
    "1-sigma by which a drift that has changed shears an image, so that bodies in different lines differ. 1.5 times as "
    "large or as small, it changes nothing in 4 cases; 99 times as large, fewer frames of one are tracked.",
    command=BODIES_TRIED,
)
ODD_BODY_STAYS = TABLE.stated(
    "ODD_BODY_STAYS", 0.5, "of ODD_BODY_CHI2_MIN",
    "From which one is that was so at the shift before: without it, such a shift may go to and fro between two, and is "
    "refused.",
)
CHANGE_PRECISION = TABLE.measured(
    "CHANGE_PRECISION", 1e-3, "1 / px^2",
    "Prior of the terms of a shift that changes over the field, 1-sigma of 32 px about none: those that tiles in "
    "a row leave open are none. 1.5 times as large or as small, it changes nothing in 19 cases; a thousand times "
    "or a thousandth of it does.",
    command=TRIED,
)
STRETCH_PX_MAX = TABLE.derived(
    "STRETCH_PX_MAX", HALVES_PX_MAX, "px",
    "By which a shift may change from the middle of the rows to their ends, as halves of an image may disagree.",
)
COMPLETE_SHARE_MIN = TABLE.measured(
    "COMPLETE_SHARE_MIN", 0.97, "of the structure",
    "That agrees with a shift where all of the image moves by it. With 0.955 or 0.98, it changes nothing in 17 "
    "cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
DISAGREEING_MAX = TABLE.measured(
    "DISAGREEING_MAX", 0.05, "of the tiles",
    "That may disagree before most of them must be in bodies. 1.5 times as large or as small, it changes nothing "
    "in 5 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
BODY_TILES_MIN = TABLE.measured(
    "BODY_TILES_MIN", 4, "tiles",
    "That make a body. With 6, 1 of 19 cases is decided otherwise; with 3, errors change by 1.6 %.",
    command=TRIED,
)
MOVING_TILES_MIN = TABLE.measured(
    "MOVING_TILES_MIN", 2, "tiles",
    "Of a body that is said to move: one alone is chance, or a particle that blinks. With 3, 1 of 5 cases is "
    "decided otherwise; with 1, 1 of 5 cases is decided otherwise.",
    command=TRIED,
)
STILL_SHIFT_PX_MIN = TABLE.measured(
    "STILL_SHIFT_PX_MIN", 0.05, "px",
    "Of a body where something moved in the image before: less of a shift is enough there. 1.5 times as large or "
    "as small, 5 cases are decided alike, and errors change by 1.1 % at most.",
    command=TRIED,
)
STILL_SIGMAS = TABLE.derived(
    "STILL_SIGMAS", 3.0, "sigma",
    "Of the mean of its tiles, beyond that: by chance one in 370 bodies along an axis.",
)
SHOWN_TILE_PX = TABLE.stated(
    "SHOWN_TILE_PX", 8, "px",
    "Side of the tiles into which pixels are gathered that are only to be shown.",
)

# Several peaks, in ambiguity.py

RESIDUAL_DIFFERENCE_MIN = TABLE.stated(
    "RESIDUAL_DIFFERENCE_MIN", 0.05, "of the residual",
    "By which two shifts must differ to be told apart: below it, the error of the interpolation, which depends on "
    "the fraction of the shift, decides instead of the specimen.",
)
CONTRADICTION_MIN = TABLE.stated(
    "CONTRADICTION_MIN", 0.3, "of the residual",
    "The same for an image to contradict a prediction: sharp lattices look a little different wherever their "
    "pixels fall.",
)
PREDICTED_CHI2_MAX = TABLE.derived(
    "PREDICTED_CHI2_MAX", 9.0, "chi-square, 2 degrees of freedom",
    "Up to which a prediction covers a peak, three sigmas: it misses the right one once in 90 times, exp(-9 / 2).",
)
COMMON_TILES_MIN = TABLE.derived(
    "COMMON_TILES_MIN", 16, "tiles",
    "Over which a mean is compared: its standard error is right to a fifth, 1 / sqrt(2 * 15) = 18 %; of fewer it "
    "is not.",
)

# Periodic specimens, in periodicity.py and defects.py

PERIODS_SIDE_PX_MAX = TABLE.cost(
    "PERIODS_SIDE_PX_MAX", 512, "px",
    "Side of the part of an image in which periods are looked for.",
)
SOFTENED_PX = TABLE.stated(
    "SOFTENED_PX", 24, "px",
    "Side of the squares in which contrast is measured before periods are looked for: fine lattices repeat in one.",
)
PERIOD_PX_MIN = TABLE.measured(
    "PERIOD_PX_MIN", 4.0, "px",
    "What repeats faster is beyond the Nyquist limit of a scan that is sampled well. 1.5 times as large or as "
    "small, it changes nothing in 8 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
REPEATED_MIN = TABLE.measured(
    "REPEATED_MIN", 0.6, "of the structure",
    "That repeats. With 0.733, nothing changes; with 0.4, 1 of 8 cases is decided otherwise.",
    command=TRIED,
)
PERIOD_SIGMAS = TABLE.derived(
    "PERIOD_SIGMAS", 5.5, "sigma",
    "Of white noise in the autocorrelation, which a period exceeds: by chance in one image of 1000, of 130 000 lags "
    "(normal, one side: 5.66) or 51 000 (5.50, of 320 px).",
)
DIP_MAX = TABLE.stated(
    "DIP_MAX", 0.7, "of what repeats",
    "To which the autocorrelation falls on the way to a period.",
)
PERIODS_SINE_MIN = TABLE.derived(
    "PERIODS_SINE_MIN", 0.3, "sine",
    "Of the angle between two periods: 17 degrees.",
)
PERIODS_COMPARED_MAX = TABLE.cost(
    "PERIODS_COMPARED_MAX", 16, "shifts",
    "That are compared: those nearest to the prediction.",
)
PERIODS_REACH_SIGMAS = TABLE.derived(
    "PERIODS_REACH_SIGMAS", 4.0, "sigma",
    "Within which a shift is predicted: beyond are one in 3000, exp(-4^2 / 2).",
)
REPEATING_PERIODS = TABLE.stated(
    "REPEATING_PERIODS", 1.5, "periods",
    "Least side of the squares in which an image repeats or does not.",
)
REPEATING_POWER = TABLE.stated(
    "REPEATING_POWER", 0.25, "of the typical power",
    "That a square has in common with those a period away where it shows the lattice: half of its contrast.",
)
REPEATING_SIGMAS = TABLE.stated(
    "REPEATING_SIGMAS", 1.5, "of the RMS contrast",
    "At which grey levels are cut off before: a wave reaches 1.4 of its own.",
)
REPEATING_TYPICAL = TABLE.stated(
    "REPEATING_TYPICAL", 0.75, "of the image",
    "With less power than the typical one: that of the lattice also where half of the field shows something else.",
)
REPEATING_SHARE_MIN = TABLE.stated(
    "REPEATING_SHARE_MIN", 0.47, "of the image",
    "In which it repeats, if it is of a lattice: the least of 95 lattices, with vacancies, or a tool over half of the "
    "field, is 0.50. Periods that a few particles have by chance, with a tool or without, leave 0.03 to 0.45, in three "
    "of 45 pictures 0.52 to 0.57, and in one, with a period of most of its width, all of it.",
)
DEFECT_SIGMAS = TABLE.derived(
    "DEFECT_SIGMAS", 5.0, "sigma",
    "By which one shift explains a tile better than another one where it is a defect: by chance one in 1.7 "
    "million tiles, on either side, since deviations are those of a normal distribution that are as rare.",
)
DEFECT_EVIDENCE_MAX = TABLE.measured(
    "DEFECT_EVIDENCE_MAX", 30.0, "squared sigmas",
    "Of a body of tiles that lie together. As much against a shift is a second motion. 1.5 times as large or as "
    "small, it changes nothing in 4 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
EVIDENCE_MIN = TABLE.derived(
    "EVIDENCE_MIN", 2.0 * DEFECT_EVIDENCE_MAX, "squared sigmas",
    "That tells two shifts apart: two defects.",
)
LONE_DEFECT_MOVED_PX_MIN = TABLE.stated(
    "LONE_DEFECT_MOVED_PX_MIN", 1.0, "px",
    "Of the specimen, so that one defect alone tells a predicted shift: one that is none of the specimen's stays.",
)
DISORDER_MIN = TABLE.stated(
    "DISORDER_MIN", 0.05, "of the structure",
    "That a wrong shift of a disordered lattice leaves of a tile: cells displaced by 0.6 of 16 px leave 0.14 to 0.17 "
    "(median), a perfect lattice up to 0.019, by the interpolation of sharp edges.",
)
DISORDERED_SHARE_MIN = TABLE.stated(
    "DISORDERED_SHARE_MIN", 0.5, "of the tiles",
    "In which it does: 0.88 of such a lattice, at most 0.22 of perfect ones with periods of 10 to 24 px.",
)
DISORDERED_TILES_MIN = TABLE.derived(
    "DISORDERED_TILES_MIN", 30, "tiles",
    "Of a perfect lattice, with 0.22 of them beyond the limit, half are so once in 1500 pairs of shifts (binomial).",
)
NOISE_DOUBT = TABLE.stated(
    "NOISE_DOUBT", 2.0, "of the noise",
    "That is taken off what a shift leaves before it is compared with the structure: noise is measured where it is "
    "least, and bright parts have more.",
)
ALONG_STARTS_PX = TABLE.cost(
    "ALONG_STARTS_PX", (-0.6, 0.6, -1.2, 1.2), "px",
    "Along lines, from which the shift is refined where the peak of the correlation is no start: lines make it long.",
)
COARSE_PERIOD_MIN = TABLE.measured(
    "COARSE_PERIOD_MIN", 1.0 / 16.0, "of the shorter side",
    "From which on a period is coarse. 1.5 times as large or as small, it changes nothing in 4 cases; a thousand "
    "times or a thousandth of it does.",
    command=TRIED,
)
HALF_PERIOD_SIGMAS = TABLE.derived(
    "HALF_PERIOD_SIGMAS", 5.0, "sigma",
    "Of a prediction in half a period that is predicted: along an axis it is off by more once in 1.7 million "
    "times.",
)

# Lines, in one_direction.py

LINES_POWER_MAX = TABLE.derived(
    "LINES_POWER_MAX", 0.03, "of the power across",
    "Of the gradient along lines, noise taken off: that of lines which run within 10 degrees (1-sigma) of each "
    "other, sin(10 degrees)^2.",
)
NOISE_POWER_SIGMA = TABLE.stated(
    "NOISE_POWER_SIGMA", 0.1, "of its power",
    "To which that of the noise is known.",
)
NOISE_POWER_MAX = TABLE.measured(
    "NOISE_POWER_MAX", 2.0, "of the power across",
    "Of the noise: more of it hides which way lines run. 1.5 times as large or as small, it changes nothing in 13 "
    "cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
LINES_MOVED = TABLE.measured(
    "LINES_MOVED", 0.25, "of the shorter side",
    "By which an image is moved along its lines to tell their direction. 1.5 times as large or as small, 13 cases "
    "are decided alike.",
    command=TRIED,
)
SAME_RIDGE_STEPS = TABLE.measured(
    "SAME_RIDGE_STEPS", 3.0, "samples of the coarse search",
    "Peaks that are nearer than this to each other across the lines are of one ridge. 1.5 times as large or as "
    "small, it changes nothing in 1 case; a thousand times or a thousandth of it does.",
    command=TRIED,
)
HELD_SIGMA_PX = TABLE.defined(
    "HELD_SIGMA_PX", 1.0, "px",
    "1-sigma along the lines, where the shift is the prediction. It is that of a measurement, so that what is not "
    "known stays apart from what is; whoever uses it adds how far the prediction may be off.",
)

# Search over all shifts, in normalised_correlation.py

SEARCHED_PX = TABLE.cost(
    "SEARCHED_PX", (128, 256, 512), "px",
    "Longest sides to which images are reduced, tried one after the other: each step costs four times as much, "
    "and textures with little structure left at one size may have it at the next.",
)
PEAK_SIGMAS = TABLE.derived(
    "PEAK_SIGMAS", 7.0, "robust sigma",
    "From which a peak is significant. A maximum over some 10^4 shifts of unrelated images stays below about 5, "
    "which as many normal deviates exceed in one of 350 images; 7, in one of 80 million.",
)
PEAK_CORRELATION_MIN = TABLE.measured(
    "PEAK_CORRELATION_MIN", 0.5, "correlation",
    "From which it is, too: on a lattice the whole surface oscillates, so that its spread says nothing; its "
    "height does. 1.5 times as large, 1 of 24 cases is decided otherwise; as small, nothing changes.",
    command=TRIED,
)
PEAK_HEIGHT_MIN = TABLE.measured(
    "PEAK_HEIGHT_MIN", 0.5, "of the highest",
    "Of peaks that are listed; competitors must reach 0.7 of it. 1.5 times as large or as small, it changes "
    "nothing in 24 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
PEAKS_MAX = TABLE.cost(
    "PEAKS_MAX", 8, "peaks",
    "The highest, and as many of those nearest to the prediction.",
)
SHADING_PARTS = TABLE.measured(
    "SHADING_PARTS", 16.0, "parts of the field",
    "The width of a blur that keeps shading, which is what is broader than an eighth of the field. 1.5 times as "
    "large or as small, 24 cases are decided alike, and errors change by 0.11 % at most.",
    command=TRIED,
)
OVERLAP_SAMPLES_MIN = TABLE.measured(
    "OVERLAP_SAMPLES_MIN", 4.0, "samples",
    "Along an axis; fewer do not make a correlation. 1.5 times as large or as small, it changes nothing in 24 "
    "cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
SURFACES_KEPT = TABLE.cost(
    "SURFACES_KEPT", 6, "parts of a surface",
    "Of the reference, one for each reduction and each size of an image: sizes differ with what the drift leaves "
    "of a frame.",
)

# Why images do not match, in mismatch.py

PARTS_SIDE_PX_MAX = TABLE.cost(
    "PARTS_SIDE_PX_MAX", 256, "px",
    "Longest side at which parts are compared: a part is then 64 px and more of most images.",
)
PARTS = TABLE.measured(
    "PARTS", 3, "parts",
    "Along each side. With 2 or 4, 3 cases are decided alike.",
    command=TRIED,
)
PARTS_FOUND_MIN = TABLE.derived(
    "PARTS_FOUND_MIN", PARTS * (PARTS - 1), "parts",
    "That must be found for a pattern: one row may be missing.",
)
PART_CORRELATION_MIN = TABLE.measured(
    "PART_CORRELATION_MIN", 0.4, "correlation",
    "Of a part that counts: that of 60 x 60 px of independent noise scatters by 1/60. 1.5 times as large or as "
    "small, 3 cases are decided alike.",
    command=TRIED,
)
PART_LEAD_MIN = TABLE.measured(
    "PART_LEAD_MIN", 0.1, "correlation",
    "Of such a part above that of any other place: six times the scatter of noise. 1.5 times as large or as "
    "small, it changes nothing in 3 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
PART_DEVIATION_PX_MAX = TABLE.measured(
    "PART_DEVIATION_PX_MAX", 1.5, "px of the reduced image",
    "RMS of the parts about one linear map. 1.5 times as large or as small, it changes nothing in 3 cases; a "
    "thousand times or a thousandth of it does.",
    command=TRIED,
)
DEFORMATION_MIN = TABLE.measured(
    "DEFORMATION_MIN", 0.01, "rad, or strain",
    "Rotation or strain that is none by chance, as a pixel over the 170 px between the outer parts may be. 1.5 "
    "times as large or as small, it changes nothing in 3 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)

# Noise and smoothing, in noise_spectrum.py

SPECTRUM_PX = TABLE.cost(
    "SPECTRUM_PX", 256, "px",
    "Side of the part of an image, from its middle, whose spectrum tells the smoothing.",
)
FAINT_SPECTRUM_PX = TABLE.cost(
    "FAINT_SPECTRUM_PX", 1024, "px",
    "The same of an image that shows hardly more than noise: of four times the side, a structure is told that has a "
    "quarter of the variance.",
)
NOISE_SPECTRUM_PX = TABLE.cost(
    "NOISE_SPECTRUM_PX", 64, "px",
    "Side of the part whose spectrum tells the noise, to 7 %.",
)
RICH_PART_PX = TABLE.measured(
    "RICH_PART_PX", 32, "px",
    "Side of the parts of a sparse image. With 21 or 48, it changes nothing in 1 case; a thousand times or a "
    "thousandth of it does.",
    command=TRIED,
)
RICH_PARTS = TABLE.stated(
    "RICH_PARTS", 4, "parts",
    "Of a sparse image that count: those that show most.",
)
RICH_VARIANCE_MAX = TABLE.stated(
    "RICH_VARIANCE_MAX", 1.1, "of the least variance",
    "Of a shift by the richest parts, for which a stronger smoothing is taken: it costs 5 % of the precision, and "
    "takes up to three quarters of the gradient of the noise away.",
)
SPECTRUM_RINGS = TABLE.measured(
    "SPECTRUM_RINGS", 48, "rings",
    "Of the spectrum, out to its corners. With 72, the error of one case is 33 % smaller; with 32, errors change "
    "by 1.4 % (25 cases).",
    command=TRIED,
)
SMOOTHINGS_PX = TABLE.measured(
    "SMOOTHINGS_PX", np.concatenate([[0.0], np.geomspace(0.4, 3.2, 19)]), "px",
    "Widths of the Gaussian to choose from: in steps of 12 %, over which the variance of a shift is flat. 1.5 "
    "times as large or as small, 25 cases are decided alike, and errors change by 1.5 % at most.",
    command=TRIED,
)
NOISE_BAND = TABLE.measured(
    "NOISE_BAND", 0.9, "of the Nyquist frequency",
    "Beyond which, in the corners of the spectrum, what is found is noise. With 0.933, errors are 6.4 % larger; "
    "with 0.85, errors change by 1.5 % (25 cases).",
    command=TRIED,
)
SMOOTHING_FREQUENCIES = TABLE.cost(
    "SMOOTHING_FREQUENCIES", 256, "frequencies",
    "Of the spectrum of a smoothing, more than it has taps.",
)
SMOOTHING_SIGMAS = TABLE.derived(
    "SMOOTHING_SIGMAS", 2.0, "standard errors",
    "By which the gradient that a smoothing leaves may be less than it looks: one in 44 is by chance. With 3, a few "
    "particles lose 7 % of their precision.",
)
SIGNAL_SIGMAS = TABLE.derived(
    "SIGNAL_SIGMAS", 2.0, "standard errors",
    "By which a ring exceeds the noise where it holds signal: one in 44 rings of noise does. As far below it, noise "
    "was taken away.",
)
GAUSSIAN_SIGMAS = TABLE.derived(
    "GAUSSIAN_SIGMAS", 3.5, "sigma",
    "At which the Gaussian is cut off: it has 0.2 % of its height there, exp(-3.5^2 / 2).",
)

# Filters, in fractional_delay.py

FILTER_FREQUENCIES = TABLE.derived(
    "FILTER_FREQUENCIES", 64, "frequencies",
    "At which a filter of up to 16 taps is fitted: four times as many.",
)
FILTER_RIDGE = TABLE.measured(
    "FILTER_RIDGE", 1e-9, "of the diagonal",
    "Of the normal matrix, added to it: what lies outside the band is left free, and this keeps the weights small "
    "there. 1.5 times as large or as small, 23 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
FLAT_BELOW = TABLE.measured(
    "FLAT_BELOW", 0.05, "(rad / px)^2",
    "Squared frequency below which the power of an image is taken as constant. 1.5 times as large or as small, 24 "
    "cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
BAND_EDGES = TABLE.measured(
    "BAND_EDGES", (0.72 * np.pi, 0.8 * np.pi), "rad / px",
    "Up to which filters are accurate: for images that are smooth, and for sharp ones with little noise. A shift "
    "is then wrong by 1.2 % of a wave at most. 1.5 times as large or as small, 26 cases are decided alike, and "
    "errors change by 1.1 % at most.",
    command=TRIED,
)
BAND_TAPS = TABLE.stated(
    "BAND_TAPS", (12, 16), "weights",
    "Of a fractional shift, of the same.",
)

# Tiles, in tiles.py

TILES_MIN = TABLE.measured(
    "TILES_MIN", 3, "tiles",
    "Along a side that leave something to compare after gain and offset follow ramps. With 2 or 4, it changes "
    "nothing in 24 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
SHARP_PX = TABLE.measured(
    "SHARP_PX", 0.3, "px",
    "Smoothing below which images have structure beyond the band of the shorter filters. 1.5 times as large or as "
    "small, 24 cases are decided alike, and errors change by 2.5 % at most.",
    command=TRIED,
)
HESSIAN_PIXELS = TABLE.cost(
    "HESSIAN_PIXELS", 12_000, "px",
    "From which the Gauss-Newton Hessian is taken: their gradients tell it to 1 %, and the gradients of the image "
    "cost more than all other sums.",
)
LOPSIDED_MAX = TABLE.derived(
    "LOPSIDED_MAX", 0.1, "of the larger eigenvalue",
    "Of the Hessian, below which the smaller one is told by all pixels: an error of 1 % of the larger one would be "
    "10 % of it, so that steps along the lines of a grating do not converge.",
)
ALL_PIXELS = TABLE.defined(
    "ALL_PIXELS", 2**62, "px",
    "More than an image has.",
)
HESSIAN_BANDS = TABLE.measured(
    "HESSIAN_BANDS", 3, "bands",
    "In which they lie: at the top, in the middle and at the bottom of the overlap. With 2 or 4, 23 cases are "
    "decided alike, and errors change by 0.62 % at most.",
    command=TRIED,
)
WINDOWS_KEPT = TABLE.cost(
    "WINDOWS_KEPT", 9, "windows",
    "For which what does not depend on the image is kept: an image that is shifted by little to either side along "
    "both axes loses a row or a column of tiles at either end, or none.",
)
CURVATURES_KEPT = TABLE.cost(
    "CURVATURES_KEPT", 3, "windows",
    "The same of second derivatives, which are those of all columns: three of them take 1.7 MB at 512 px, 6.4 at "
    "1536.",
)

# Least squares over tiles, in tile_least_squares.py

GRADIENT_ENERGY_MIN = TABLE.stated(
    "GRADIENT_ENERGY_MIN", 0.5, "of the energy",
    "Of the gradient that constants leave: ramps of gain and offset that explain away more than the rest are not "
    "used.",
)
USUAL_RAMP = TABLE.stated(
    "USUAL_RAMP", 0.05, "of the gain",
    "By which it may change from the middle to the edge of the field from frame to frame: ramps that are not told to "
    "that are not used, since they would make a shift uncertain and hardly wrong.",
)
GAIN_RCOND = TABLE.stated(
    "GAIN_RCOND", 1e-9, "of the largest eigenvalue",
    "Below which an eigenvalue of the normal equations of gain and offset is rounding: sums of single-precision "
    "pixels are good to 1e-7 and no better.",
)
DETERMINANT_MIN = TABLE.stated(
    "DETERMINANT_MIN", 1e-6, "1",
    "Scaled determinant of an information matrix, below which it is rounding, too.",
)
HELD_INFORMATION = TABLE.derived(
    "HELD_INFORMATION", 100.0, "of that of the gradients",
    "Along a direction that is held: a step there is a hundredth.",
)
RAMPS_KEPT = TABLE.cost(
    "RAMPS_KEPT", 32, "numbers of tiles",
    "For which the ramps are kept: those of a few windows at each resolution.",
)

# Fine alignment, in inverse_compositional.py

PASSES_MAX = TABLE.cost(
    "PASSES_MAX", 12, "passes",
    "A start that needs more is outside of the range of convergence.",
)
COARSE_PASSES_MAX = TABLE.cost(
    "COARSE_PASSES_MAX", 4, "passes",
    "The same at each coarse level.",
)
REWEIGHTED_PASSES_MAX = TABLE.cost(
    "REWEIGHTED_PASSES_MAX", 8, "passes",
    "In which the weights of tiles may change.",
)
STEP_PX_MAX = TABLE.measured(
    "STEP_PX_MAX", 1.5, "px",
    "The gradient extrapolates over a pixel or two of a sharp image; longer steps may overshoot. 1.5 times as "
    "large or as small, 23 cases are decided alike, and errors change by 0.93 % at most.",
    command=TRIED,
)
COARSE_STEP_PX = TABLE.stated(
    "COARSE_STEP_PX", 0.2, "px of the level",
    "At which a coarse level is left: less than half a pixel of the next one.",
)
CONTRACTION = TABLE.measured(
    "CONTRACTION", 0.06, "of a step",
    "What remains after it at most, beside CURVATURE. 1.5 times as large or as small, 23 cases are decided alike, "
    "and errors change by 1.4 % at most.",
    command=TRIED,
)
CURVATURE = TABLE.measured(
    "CURVATURE", 0.5, "1 / px",
    "What remains of the square of a step: one over the images' finest structure. 1.5 times as large or as small, "
    "23 cases are decided alike, and errors change by 1.5 % at most.",
    command=TRIED,
)
REMAINING_SIGMAS = TABLE.derived(
    "REMAINING_SIGMAS", 0.12, "sigma",
    "That may remain: it adds 0.7 % to the error of the shift, sqrt(1 + 0.12^2).",
)
REMAINING_PX = TABLE.measured(
    "REMAINING_PX", 5e-4, "px",
    "That may remain in any case: below, errors of interpolation rule. 1.5 times as large or as small, it changes "
    "nothing in 23 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
BLOCK_SIGMAS = TABLE.measured(
    "BLOCK_SIGMAS", 14.0, "widths of the smoothing",
    "Side of the blocks whose scores are independent: a Gaussian, applied to both images, correlates over some 4 "
    "sigma to either side; blocks are over three times as large, so that little of their sums is shared. 1.5 "
    "times as large, errors over sigma are 5 % smaller; as small, errors change by 2.2 % (23 cases).",
    command=TRIED,
)
BLOCKS_MIN = TABLE.derived(
    "BLOCKS_MIN", 36, "blocks",
    "Whose scatter tells a sigma to 12 %, 1 / sqrt(2 * 36).",
)
FREEDOM_MIN = TABLE.stated(
    "FREEDOM_MIN", 8.0, "degrees of freedom",
    "Of few scores: the number of those that count is itself uncertain where it is small.",
)
FEW_SCORES = TABLE.measured(
    "FEW_SCORES", 40.0, "scores",
    "Fewer make up most of the information only where it lies in lone particles. 1.5 times as large or as small, "
    "23 cases are decided alike, and errors change by 0.93 % at most.",
    command=TRIED,
)
EXPECTED_SCORES = TABLE.measured(
    "EXPECTED_SCORES", 6.0, "scores",
    "As which the covariance counts then that the residuals of the pixels lead to: what moves a particle as a "
    "whole, such as a change of its shape, is seen by the scatter of the scores alone. 1.5 times as large or as "
    "small, 23 cases are decided alike, and errors change by 1.3 % at most.",
    command=TRIED,
)
THREE_SIGMAS = TABLE.derived(
    "THREE_SIGMAS", 0.99865, "probability",
    "Of a normal deviate below three sigmas.",
)
SHEAR_ROWS_MIN = TABLE.measured(
    "SHEAR_ROWS_MIN", 6, "rows of tiles",
    "From which a change of the shift over the rows can be told apart from noise. With 4 or 9, it changes nothing "
    "in 23 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
ROWS_PER_MODE = TABLE.stated(
    "ROWS_PER_MODE", 1.5, "rows of tiles",
    "Per cosine mode down the frame: the higher modes are of rows that share smoothed noise.",
)
CONDITION_MAX = TABLE.stated(
    "CONDITION_MAX", 1e6, "condition number",
    "Of a scaled information matrix; with a larger one a shear is not determined.",
)
NOISE_ROWS_MIN = TABLE.stated(
    "NOISE_ROWS_MIN", 10, "rows of tiles",
    "From which on noise of lines is looked for.",
)
ROWS_RATIO_MIN = TABLE.derived(
    "ROWS_RATIO_MIN", 2.0, "ratio of variances",
    "From which it is found: that of 10 rows of white noise scatters by a factor of 1.6, exp(sqrt(2 / 9)), and is "
    "so large once in 28 times along an axis (chi-square with 9 degrees of freedom).",
)
INFORMATION_KEPT_MIN = TABLE.stated(
    "INFORMATION_KEPT_MIN", 0.5, "of the common information",
    "That the gradients of the tiles must keep without those of the noise. Where they do not, as along a direction in "
    "which a shift is held, the tiles count by their gradients as they are.",
)
CHANCE_SIGMAS = TABLE.derived(
    "CHANCE_SIGMAS", 5.0, "sigma",
    "By which the common information must exceed what chance gives: once in 3.5 million images of noise along an "
    "axis.",
)
PULL_SIDES = TABLE.measured(
    "PULL_SIDES", (2, 3, 4, 6, 8, 11), "tiles",
    "Sides of the squares that may move by themselves. 1.5 times as large, errors change by 3.5 %; as small, "
    "errors over sigma are 13 % larger (17 cases).",
    command=TRIED,
)
PULL_CHI2_MIN = TABLE.derived(
    "PULL_CHI2_MIN", 18.4, "chi-square, 2 degrees of freedom",
    "From which a square seems to move: of some 500 independent ones, one in 20 images, 500 exp(-18.4 / 2), in "
    "which it widens the covariance by little.",
)
PULL_BODY_MIN = TABLE.derived(
    "PULL_BODY_MIN", 0.15, "of the information",
    "That a square has if it stands out: in evenly structured pictures one of the largest squares, 11 x 11 of some "
    "39 x 39 tiles, has no more than 0.08.",
)
PULL_RATE = TABLE.derived(
    "PULL_RATE", 0.05, "of the images",
    "In which one square of a size that stands out seems to move by chance, at most: there are no more than one over "
    "its part of the information, and each may at this rate times the square of that part.",
)
MEDIAN_CHI2 = TABLE.derived(
    "MEDIAN_CHI2", 1.386, "chi-square, 2 degrees of freedom",
    "The median: 2 log(2).",
)
PULL_EXCESS_MAX = TABLE.measured(
    "PULL_EXCESS_MAX", 3.0, "of the expected variance",
    "By which squares scatter where the images differ all over, as by charging; more than that is that of "
    "motions. 1.5 times as large or as small, 17 cases are decided alike, and errors change by 2 % at most.",
    command=TRIED,
)
PULL_REST_MIN = TABLE.measured(
    "PULL_REST_MIN", 0.3, "of the information",
    "That must be elsewhere: the specimen is no smaller part. 1.5 times as large or as small, it changes nothing "
    "in 17 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
ROUNDING = TABLE.cost(
    "ROUNDING", 1e-6, "of the largest variance",
    "What of a sum is rounding; keeps chi-squares finite where there is nothing.",
)

# Affine alignment, in affine.py

AFFINE_STEPS_MAX = TABLE.cost(
    "AFFINE_STEPS_MAX", 200, "iterations",
    "Of the maximisation of the correlation.",
)
AFFINE_CONVERGED = TABLE.measured(
    "AFFINE_CONVERGED", 1e-8, "correlation",
    "Increase in an iteration below which the maximisation has converged. 1.5 times as large or as small, it "
    "changes nothing in 1 case; a thousand times or a thousandth of it does.",
    command=TRIED,
)
AFFINE_SMOOTHED_PX = TABLE.stated(
    "AFFINE_SMOOTHED_PX", 1.5, "px",
    "Sigma of the Gaussian that both images are smoothed with: shot noise has no scale.",
)
AFFINE_CORRELATION_MIN = TABLE.measured(
    "AFFINE_CORRELATION_MIN", 0.3, "correlation",
    "Below which images do not show the same, or noise hides it; at the shift that the alignment starts from, "
    "half of it. 1.5 times as large or as small, it changes nothing in 1 case; a thousand times or a thousandth "
    "of it does.",
    command=TRIED,
)
AFFINE_BORDER_PX = TABLE.stated(
    "AFFINE_BORDER_PX", 8, "px",
    "At the border, that are left out: interpolation and smoothing reach there.",
)
AFFINE_FLOOR_PX = TABLE.measured(
    "AFFINE_FLOOR_PX", 0.02, "px",
    "What interpolation leaves at the ends of the template, seen on noiseless textures. 1.5 times as large, "
    "errors over sigma are 25 % smaller; as small, errors over sigma are 24 % larger (1 case).",
    command=TRIED,
)
AFFINE_LAGS_PX = TABLE.measured(
    "AFFINE_LAGS_PX", 8, "px",
    "Up to which the correlation of the residuals is added up: that of white noise, smoothed so, is 0.1 % there. "
    "With 5 or 12, one case is decided alike, and its errors change by 0.47 %.",
    command=TRIED,
)
