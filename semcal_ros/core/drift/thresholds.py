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

"""The numbers of drift tracking, each with its source."""

from __future__ import annotations

from semcal_ros.core.thresholds import Table

TABLE = Table()

# Of the measured rows: each says in how many cases it was tried, and what changed in them (doc/thresholds.md).
TRIED = "python -m benchmarks.thresholds drift, 28 November 2026"

# A row takes three lines, and not one for each of its parts.
# fmt: off

# Defaults of DriftSettings, in settings.py

REKEY_OVERLAP = TABLE.measured(
    "REKEY_OVERLAP", 0.6, "of the image",
    "That a keyframe must share with a frame to stay the one in use: twice the least with which a shift is searched "
    "for, so that the next keyframe is measured against it while both still see much of the same. 1.5 times as large "
    "or as small, it changes nothing in 26 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
JUMP_MAX = TABLE.measured(
    "JUMP_MAX", 0.25, "of the image",
    "Between frames; more that was not expected is a move of the stage: drift is slower by far. 1.5 times as large, 3 "
    "of 26 cases are decided otherwise; as small, errors change by less than 0.1 %.",
    command=TRIED,
)
FIRST_STEP_PX = TABLE.measured(
    "FIRST_STEP_PX", 3.0, "px",
    "1-sigma of the drift between the first two frames, of which nothing is known; innovations take its place. 1.5 "
    "times as large or as small, 26 cases are decided alike, and the time of a pass changes by 0.003 s at most, where "
    "its sigma is 0.036 s.",
    command=TRIED,
)
RATIO_MAX = TABLE.measured(
    "RATIO_MAX", 2.5, "ratio of scales",
    "Across which a keyframe is resampled: at this one, a sixth of the coarser picture is in the finer one. 1.5 times "
    "as large or as small, it changes nothing in 26 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
LOST_AFTER = TABLE.measured(
    "LOST_AFTER", 8, "frames",
    "In a row that match nothing, after which the place that was seen is given up: what disturbs a few frames, as a "
    "touch of the table does, is over by then. 1.5 times as large, it changes nothing; as small, 4 of 26 cases are "
    "decided otherwise: the drift is counted anew after a stage move.",
    command=TRIED,
)
KEYFRAMES_MAX = TABLE.cost(
    "KEYFRAMES_MAX", 48, "keyframes",
    "That are kept: each adds four numbers to the state of the filter, whose covariance is updated at each frame.",
)
KEYFRAME_BYTES_MAX = TABLE.cost(
    "KEYFRAME_BYTES_MAX", 1 << 28, "bytes",
    "Of their images: 32 of 1024 x 1024 pixels, each as a mean of 4 bytes and a first frame of up to 4.",
)

# Steps, in tracker.py

VELOCITY_CHANGE = TABLE.measured(
    "VELOCITY_CHANGE", 0.1, "of the first step",
    "By how much the velocity is expected to change per frame, to begin with; the innovations correct it within some "
    "frames. 1.5 times as large or as small, 25 cases are decided alike, and the time of a pass changes by 0.003 s at "
    "most, where its sigma is 0.036 s.",
    command=TRIED,
)
PAUSE_MIN = TABLE.measured(
    "PAUSE_MIN", 10.0, "time constants",
    "Time without a frame after which nothing says that the drift went on as it was: of its acceleration, nothing is "
    "left by then. 1.5 times as large or as small, it changes nothing in 25 cases; a thousand times or a thousandth "
    "of it does.",
    command=TRIED,
)
CANDIDATES = TABLE.cost(
    "CANDIDATES", 2, "keyframes",
    "That a frame is compared with; twice as many where nothing matched before, since it may be of any of them.",
)

# Matches, in matching.py

REGISTRATIONS_MAX = TABLE.cost(
    "REGISTRATIONS_MAX", 4, "registrations",
    "Of one frame; each removes the shear that the one before it measured, to some per cent, so that the second "
    "is nearly always the last.",
)
TURN_LEFT_PX = TABLE.stated(
    "TURN_LEFT_PX", 0.1, "px",
    "Rotation and scale that are left at the edge of a frame are worth another registration from here on: linear "
    "terms describe less of it well.",
)
PULLED_PX = TABLE.stated(
    "PULLED_PX", 0.3, "px",
    "1-sigma of how far a mean may have been pulled: what moves by less than this against the specimen may not "
    "have been found, and has pulled by a part of it.",
)
PULLED_CHI2_MIN = TABLE.derived(
    "PULLED_CHI2_MIN", 9.2, "chi-square, 2 degrees of freedom",
    "From which a mean is of frames that were pulled: of others one in a hundred, exp(-9.2 / 2), which costs a "
    "few frames until there is a mean again.",
)

# Belief, in filter_update.py and gating.py

PULLED_SIGMAS = TABLE.stated(
    "PULLED_SIGMAS", 5.0, "sigma of the rest",
    "From which earlier frames are taken to be pulled, too. The rest is what a measurement has beside the pull; "
    "against a keyframe of n frames it has n / (n + 1) of the variance of noise and pull, so that against a single "
    "one 1.4 sigmas of the noise are enough.",
)
COMMON_SIGMAS = TABLE.stated(
    "COMMON_SIGMAS", 2.0, "sigma of the rest",
    "From which a pull counts as one of all frames: as above, 0.8 sigmas of the noise against a single frame.",
)
SAYS_NOTHING = TABLE.derived(
    "SAYS_NOTHING", 1e6, "of the variance",
    "Of a measurement that says nothing beyond what is known: it moves the drift by a millionth of its deviation, and "
    "the covariance stays far from rounding.",
)
LEAST_EIGENVALUE = TABLE.derived(
    "LEAST_EIGENVALUE", 1e-9, "of a scaled covariance",
    "Below which it may be one by rounding alone, a million times that of a double.",
)
DISPUTED_SIGMAS = TABLE.measured(
    "DISPUTED_SIGMAS", 2.0, "sigma",
    "At which a disputed position counts: if it is the right one, the stated sigma covers it twice. 1.5 times as "
    "large or as small, 25 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
INNOVATION_CHI2_MAX = TABLE.derived(
    "INNOVATION_CHI2_MAX", 27.6, "chi-square, 2 degrees of freedom",
    "Normalised square of an innovation that a correct filter exceeds once in a million frames: exp(-27.6 / 2).",
)
WHOLE_SHARE_MIN = TABLE.stated(
    "WHOLE_SHARE_MIN", 0.95, "of the structure",
    "That must show a jump for it to be one of the stage: tools covered a tenth and more.",
)
REACH_SIGMAS = TABLE.derived(
    "REACH_SIGMAS", 2.0, "sigma of the first step",
    "Within which a shift agrees with what was expected: 95 % of a normal deviate.",
)
INTERVAL_S_MIN = TABLE.cost(
    "INTERVAL_S_MIN", 1e-9, "s",
    "Keeps divisions by intervals finite; no stream has frames that are nearer to each other.",
)
DAMPING = TABLE.cost(
    "DAMPING", 1e-9, "of the diagonal",
    "Keeps a scaled covariance invertible where a shift is predicted exactly.",
)

# New keyframes, in new_keyframes.py

ZOOM_MIN = TABLE.stated(
    "ZOOM_MIN", 1.001, "ratio of scales",
    "From which a frame is of another visit of a magnification. What makers write differs by less from rounding.",
)
VISIT_SCALE = TABLE.stated(
    "VISIT_SCALE", 1e-3, "of the scale",
    "Least 1-sigma by which two visits differ, of one magnification or two: a calibration that was made of one visit "
    "of each does not know how well the microscope comes back.",
)
VISIT_SIGMAS = TABLE.derived(
    "VISIT_SIGMAS", 3.0, "sigma",
    "Of the scale of a visit, up to which an image that is larger is no other one: one in 370 is beyond by chance.",
)
SMALL_ZOOM = TABLE.stated(
    "SMALL_ZOOM", 1.15, "ratio of scales",
    "Up to which the keyframe stays in use, resampled for each frame; beyond, interpolation loses structure, and "
    "the frame becomes the keyframe of its magnification.",
)
KEPT_CORRELATION_MIN = TABLE.stated(
    "KEPT_CORRELATION_MIN", 0.75, "correlation",
    "A frame that agrees less with its keyframe takes its place: the specimen changes.",
)
USUAL_RATIO = TABLE.stated(
    "USUAL_RATIO", 1.15, "ratio",
    "Of what a frame leaves unexplained to the least that one has left: up to it, noise and another part of the "
    "specimen.",
)
FRAMES_AVERAGED = TABLE.stated(
    "FRAMES_AVERAGED", 4.0, "frames",
    "Over which the filter averages at least: an error that all of them share counts as often.",
)
WORN_RATIO = TABLE.stated(
    "WORN_RATIO", 1.5, "ratio",
    "Of what a frame leaves unexplained to the least that one has left: beyond it, half of its square is of a specimen "
    "that has changed since.",
)
WORN_FRAMES = TABLE.measured(
    "WORN_FRAMES", 3, "frames",
    "In a row beyond it, after which the keyframe is replaced: a flash or a bad frame passes. With 4 or 2, 27 cases "
    "are decided alike, and errors change by 0.6 % at most.",
    command=TRIED,
)
MERGED_CORRELATION_MIN = TABLE.measured(
    "MERGED_CORRELATION_MIN", 0.85, "correlation",
    "Of a frame that becomes part of a mean: a specimen that changes spoils none before its keyframe is replaced. 1.5 "
    "times as large or as small, it changes nothing in 24 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
MERGED_GAINS = TABLE.measured(
    "MERGED_GAINS", (0.5, 2.0), "ratio of contrasts",
    "Between which a frame becomes part of a mean: beyond, its noise counts four times as much, or its grey levels "
    "are clipped. 1.5 times as large or as small, it changes nothing in 24 cases; a thousand times or a thousandth of "
    "it does.",
    command=TRIED,
)
MERGED_SHEAR_PX_MAX = TABLE.measured(
    "MERGED_SHEAR_PX_MAX", 0.1, "px",
    "Shear of a frame that does not blur a mean: half of it at the upper and the lower edge. 1.5 times as large or as "
    "small, 24 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
OPEN_SIGMAS = TABLE.derived(
    "OPEN_SIGMAS", 2.0, "sigma",
    "Of a measured shear within which it may be none: 95 % of a normal deviate. A few particles tell a shear "
    "badly.",
)
BLUR_PX_MAX = TABLE.derived(
    "BLUR_PX_MAX", 0.5, "px",
    "Shear that a mean bears: a quarter of a pixel to either side at the edges blurs structure at a third of a "
    "cycle per pixel by 4.5 % there, 1 - sinc(1/6).",
)
PLACE_SIGMA_PX_MAX = TABLE.derived(
    "PLACE_SIGMA_PX_MAX", 0.2, "px",
    "1-sigma of a shift that a mean bears: structure at a third of a cycle per pixel is blurred by 8 %, 1 - "
    "exp(-2 (0.2 pi / 3)^2).",
)
COPY_NOISE = TABLE.measured(
    "COPY_NOISE", 0.15, "of the variance",
    "Of a shift by which the position of a frame as a keyframe differs from the measured one: as a reference its "
    "noise weighs otherwise than as an image. Seen in the closure of triples of frames. 1.5 times as large or as "
    "small, 25 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
COPY_NOISE_BESIDE = TABLE.stated(
    "COPY_NOISE_BESIDE", 5.0, "of the variance",
    "The same for the fraction that did not overlap, of which other parts are compared. Seen in the closure of "
    "triples of frames.",
)

# Keyframes, in keyframe_store.py and keyframe.py

SAME_SCALE = TABLE.derived(
    "SAME_SCALE", 1.0001, "ratio of scales",
    "Below which images need no resampling: 0.05 px at the edge of 1024 px.",
)
CHANGE_MARGIN = TABLE.stated(
    "CHANGE_MARGIN", 0.05, "of the image",
    "By which an old keyframe must overlap more than is asked of the one in use, or two of them would take turns.",
)
MERGED_OVERLAP_MIN = TABLE.measured(
    "MERGED_OVERLAP_MIN", 0.75, "of the image",
    "That a frame must show of a mean that it becomes part of, so that the noise of the mean is nearly even. 1.5 "
    "times as large or as small, it changes nothing in 24 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
MEAN_COUNTS = TABLE.derived(
    "MEAN_COUNTS", (2, 4, 8, 16, 32), "frames",
    "In a mean at which it replaces the prepared reference: each time its noise variance has halved. From 32 "
    "frames on, it adds 1.5 % to the sigma of a shift, sqrt(1 + 1/32).",
)
MASKED_MAX = TABLE.measured(
    "MASKED_MAX", 0.01, "of the image",
    "That is newly left out of a reference which is kept otherwise: so few pixels decide on no peak of the search "
    "over all shifts, in which they show. 1.5 times as large or as small, it changes nothing in 7 cases; a thousand "
    "times or a thousandth of it does.",
    command=TRIED,
)
COMMON_PX_MIN = TABLE.cost(
    "COMMON_PX_MIN", 8, "px",
    "Rows or columns in common; fewer are not added to a mean, which they hardly improve.",
)
BLUR_BELOW = TABLE.stated(
    "BLUR_BELOW", 0.95, "ratio of scales",
    "An image that shrinks by more must be blurred first, or it would alias; by 5 % it hardly does.",
)
PIXEL_SIGMA_PX = TABLE.measured(
    "PIXEL_SIGMA_PX", 0.45, "px",
    "Width of a pixel as a Gaussian: to that of a pixel of the new image an image that shrinks is blurred. 1.5 times "
    "as large or as small, the errors of one case change by 0.2 % at most.",
    command=TRIED,
)

# What never moves, in static_parts.py

OVERLAY_FIRST_FRAMES = TABLE.measured(
    "OVERLAY_FIRST_FRAMES", 3, "frames",
    "In which an overlay is looked for: one is there from the start, and a second and a third look confirm it. 1.5 "
    "times as large or as small, 25 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
OVERLAY_EVERY_FRAMES = TABLE.cost(
    "OVERLAY_EVERY_FRAMES", 8, "frames",
    "After which an overlay is looked for again.",
)
OVERLAY_LOOKS_KEPT = TABLE.cost(
    "OVERLAY_LOOKS_KEPT", 3, "looks",
    "For which what was found is taken for drawn: of a counter, some looks do not find all digits. What is there no "
    "more is left out for some thirty frames.",
)
FIXED_FIRST = TABLE.measured(
    "FIXED_FIRST", 4, "comparisons",
    "After which what stays is looked for more seldom, by one frame more each time; a spot does not show where the "
    "specimen is as dark, so that one look is not enough. 1.5 times as large or as small, it changes nothing in 25 "
    "cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
FIXED_EVERY_FRAMES_MAX = TABLE.cost(
    "FIXED_EVERY_FRAMES_MAX", 32, "frames",
    "After which what stays is looked for again at the latest.",
)
NEWLY_FIXED = TABLE.measured(
    "NEWLY_FIXED", 1e-4, "of the image",
    "That must newly be found to stay for keyframes to be freed of it, which makes their means start again: 25 of 512 "
    "x 512 px. 1.5 times as large or as small, 25 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
FIXED_PULL_MIN = TABLE.derived(
    "FIXED_PULL_MIN", 0.3, "sigma",
    "By which what newly stays has pulled the drift, for the frame to be measured again: less adds less than 5 % to "
    "the error of a frame.",
)

# What stays in place, in fixed_parts.py

FIXED_MOVE_PX_MIN = TABLE.measured(
    "FIXED_MOVE_PX_MIN", 0.8, "px",
    "Drift from which on two images are compared: less of it hardly changes a picture with details of some pixels. "
    "1.5 times as large, 1 of 25 cases is decided otherwise; as small, errors change by 0.8 %.",
    command=TRIED,
)
FIXED_SQUARE_PX = TABLE.measured(
    "FIXED_SQUARE_PX", 5, "px",
    "Side of the squares over which squared differences are summed: about the least detail that is worth leaving out. "
    "1.5 times as large or as small, 25 cases are decided alike, and errors change by 0.3 % at most.",
    command=TRIED,
)
FIXED_RATIO_MIN = TABLE.derived(
    "FIXED_RATIO_MIN", 8.0, "ratio of sums",
    "By which one of the two sums must exceed the other: of 25 independent differences each, once in 10^6 by "
    "chance (F distribution). Differences that are smoothed by interpolation are fewer, and there are many "
    "squares, so that single ones do not count.",
)
FIXED_PIXELS_MIN = TABLE.measured(
    "FIXED_PIXELS_MIN", 9, "px",
    "Of a body that stays; fewer are chance among the squares of 512 x 512 px. 1.5 times as large or as small, 25 "
    "cases are decided alike, and errors change by 0.3 % at most.",
    command=TRIED,
)
ROUNDING_VARIANCE = TABLE.derived(
    "ROUNDING_VARIANCE", 1.0 / 6.0, "squared grey levels",
    "Of the difference of two rounded numbers: twice 1/12.",
)
FIXED_SHARE_MAX = TABLE.measured(
    "FIXED_SHARE_MAX", 0.3, "of the image",
    "That may stay: where more does, the shift is not that of the specimen. 1.5 times as large or as small, it "
    "changes nothing in 25 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
FIXED_ENLARGED_PX = TABLE.measured(
    "FIXED_ENLARGED_PX", 2, "px",
    "By which what stays is enlarged: its soft edge is told by less than its inside. 1.5 times as large or as small, "
    "25 cases are decided alike, and errors change by 0.2 % at most.",
    command=TRIED,
)
GRADIENTS_SMOOTHED_PX = TABLE.measured(
    "GRADIENTS_SMOOTHED_PX", 1.5, "px",
    "Smoothing before gradients are summed, which noise would dominate. 1.5 times as large or as small, 25 cases are "
    "decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
GRADIENTS_ALLOWED = TABLE.measured(
    "GRADIENTS_ALLOWED", 2.0, "factor",
    "Allowed for the noise that is left in the sum of all gradients, which makes the part of what stays look smaller. "
    "1.5 times as large or as small, 2 cases are decided alike, and errors change by 0.1 % at most.",
    command=TRIED,
)

# Torn frames, in torn_frames.py

TORN_LINE_PARTS = TABLE.measured(
    "TORN_LINE_PARTS", 4, "parts",
    "Of a line that are compared each by itself: the digits of a clock change in one or two of them, noise in all. "
    "1.5 times as large or as small, it changes nothing in 25 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
TORN_CHANGES_MIN = TABLE.measured(
    "TORN_CHANGES_MIN", 0.75, "of the parts with noise",
    "That must have changed before, where a line is old: three of four. 1.5 times as large or as small, it changes "
    "nothing in 25 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
TORN_REVERSALS_MIN = TABLE.derived(
    "TORN_REVERSALS_MIN", 0.25, "of the pixels",
    "At which grey levels with noise turn from rising to falling, or back: two thirds where noise is white, 0.39 after "
    "a Gaussian blur by 1 px (Rice 1945).",
)
TORN_STEPS_MIN = TABLE.derived(
    "TORN_STEPS_MIN", 0.6, "of the pixels",
    "That differ from the one before: noise of 0.7 grey levels and more does it. Of a drawn text, where strokes are a "
    "pixel wide, half do.",
)
TORN_LINES_MIN = TABLE.measured(
    "TORN_LINES_MIN", 4, "lines",
    "That must be old: fields and pairs of lines that are refreshed by turns have one or two at an edge. 1.5 times as "
    "large or as small, it changes nothing in 25 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
TORN_SHARE_MIN = TABLE.derived(
    "TORN_SHARE_MIN", 0.02, "of the lines",
    "That must be old: fewer pull a frame by no more than 0.02 of the drift between two frames.",
)
TORN_CHECKED_LINES = TABLE.cost(
    "TORN_CHECKED_LINES", 16, "lines",
    "Of the old ones that are looked at for noise.",
)

# Overlays, in overlay.py

OVERLAY_TEXT_PX = TABLE.measured(
    "OVERLAY_TEXT_PX", 9, "px",
    "Side of the window for text, in which pixels are counted that are the same in two pictures: about a letter. 1.5 "
    "times as large or as small, 26 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
OVERLAY_LINE_PX = TABLE.measured(
    "OVERLAY_LINE_PX", 21, "px",
    "Length of the windows for lines: longer than chance makes them, shorter than cross-hairs. 1.5 times as large, 1 "
    "of 26 cases is decided otherwise; as small, 1 of 26 cases is decided otherwise and the error of one case is 127 "
    "% larger.",
    command=TRIED,
)
OVERLAY_SIGMAS = TABLE.derived(
    "OVERLAY_SIGMAS", 6.0, "sigma of a binomial law",
    "By which there must be more of them than elsewhere: by chance, once in 10^9 on one side of a normal law.",
)
OVERLAY_NEAR_MIN = TABLE.measured(
    "OVERLAY_NEAR_MIN", 12, "px",
    "That must be the same in a window, where a normal law describes few numbers badly. 1.5 times as large, 1 of 25 "
    "cases is decided otherwise; as small, errors change by less than 0.1 %.",
    command=TRIED,
)
OVERLAY_PIXELS_MIN = TABLE.measured(
    "OVERLAY_PIXELS_MIN", 60, "px",
    "That must be the same in a picture: less than the shortest scale bar. 1.5 times as large or as small, it changes "
    "nothing in 25 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
OVERLAY_CLIPPED_MIN = TABLE.measured(
    "OVERLAY_CLIPPED_MIN", 19, "px",
    "Of OVERLAY_LINE_PX that must be the same where they may be clipped: parts of a specimen are, too, and seldom in "
    "straight lines. 1.5 times as large, the error of one case is 127 % larger; as small, it changes nothing, in 25 "
    "cases.",
    command=TRIED,
)
OVERLAY_STEADY_MAX = TABLE.stated(
    "OVERLAY_STEADY_MAX", 0.25, "of what noise changes",
    "Pixels of the border of a shape in an extreme grey level that change from picture to picture. Of particles of up "
    "to eight times the range as many change as are expected.",
)
OVERLAY_EXPECTED_MIN = TABLE.derived(
    "OVERLAY_EXPECTED_MIN", 1.0, "px",
    "That noise should change of the border of a shape where that none does says something: by chance, none does in "
    "exp(-1) = 37 of 100.",
)
OVERLAY_UNCHANGED_SIGMAS = TABLE.derived(
    "OVERLAY_UNCHANGED_SIGMAS", 3.0, "sigma",
    "By which shapes without any change have more of the border than chance leaves: once in 740, and what lies beside "
    "them must be quiet as well, or sharp.",
)
OVERLAY_QUIET_MAX = TABLE.stated(
    "OVERLAY_QUIET_MAX", 0.75, "of the noise",
    "That is left beside a shape whose edge is mixed with the picture, half of it on average. Beside a clipped part of "
    "a specimen there is more of it; but what noise clips does not count, so that up to a tenth seems to be missing.",
)
OVERLAY_QUIET_SIGMAS = TABLE.derived(
    "OVERLAY_QUIET_SIGMAS", 5.0, "sigma",
    "By which it is less: by chance, once in 3 x 10^6.",
)
OVERLAY_SHARP_MAX = TABLE.derived(
    "OVERLAY_SHARP_MAX", 0.02, "of the step",
    "That is left one pixel beside a shape. A Gaussian edge of 0.7 px leaves as much where it is clipped at a "
    "twentieth of its height, and one of 0.5 px at a third.",
)
OVERLAY_STEP_SIGMAS = TABLE.derived(
    "OVERLAY_STEP_SIGMAS", 4.0, "sigma of the noise",
    "That a shape differs from what lies around it: noise that is clipped makes shapes, too, of a pixel in 30 000.",
)
OVERLAY_NOISE_MIN = TABLE.derived(
    "OVERLAY_NOISE_MIN", 1.5, "grey levels",
    "Below which pixels are the same by chance: at 1.5, the difference of two is rounded to zero in one of five, "
    "0.5 / (1.5 sqrt(2)) = 0.24 sigma to either side.",
)
OVERLAY_SAME_MAX = TABLE.measured(
    "OVERLAY_SAME_MAX", 0.6, "of the image",
    "That may be the same: more is a picture that came again. 1.5 times as large or as small, it changes nothing in "
    "25 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
OVERLAY_LETTERS_MAX = TABLE.stated(
    "OVERLAY_LETTERS_MAX", 0.01, "of the image",
    "That has the grey level of letters besides them: of a specimen with more of it, noise makes shapes as large as "
    "letters.",
)
OVERLAY_LETTER_PX_MAX = TABLE.stated(
    "OVERLAY_LETTER_PX_MAX", 36, "px",
    "Of a letter along its longer side, four times OVERLAY_TEXT_PX: its box is left out as a whole, so that a circle "
    "or a frame is none.",
)
OVERLAY_LETTER_PIXELS_MIN = TABLE.stated(
    "OVERLAY_LETTER_PIXELS_MIN", 6, "px",
    "Of a letter: the least that is legible, five of height and one more. Fewer that touch may be noise.",
)
OVERLAY_ENLARGED_PX = TABLE.measured(
    "OVERLAY_ENLARGED_PX", 2, "px",
    "By which an overlay is enlarged: letters have soft edges. 1.5 times as large or as small, 25 cases are decided "
    "alike, and errors change by 0.1 % at most.",
    command=TRIED,
)
OVERLAY_FILLED_PX = TABLE.measured(
    "OVERLAY_FILLED_PX", 21, "px",
    "Side of the square from which its place is filled, wider than the strokes of letters. 1.5 times as large or as "
    "small, 2 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)

# What moves by itself, in own_motion.py

APART_PX_MIN = TABLE.measured(
    "APART_PX_MIN", 1.5, "px",
    "By which a body must have moved against the specimen before its pixels are told from those of the ground: about "
    "a detail of the images. 1.5 times as large, 1 of 25 cases is decided otherwise and the error of one case is 34 % "
    "smaller; as small, it changes nothing.",
    command=TRIED,
)
BODY_FRAMES_MAX = TABLE.stated(
    "BODY_FRAMES_MAX", 12, "frames",
    "After which a slower one is compared all the same.",
)
BODY_REST_FRAMES = TABLE.cost(
    "BODY_REST_FRAMES", 3, "frames",
    "Without a measurement after each, which takes as long as the drift of a frame without a tool.",
)
BODY_SEARCHES = TABLE.measured(
    "BODY_SEARCHES", (1, 3, 6), "frames",
    "After which a body whose motion is unknown is searched for: a fast one is near only at first, a slow one has not "
    "moved yet. 1.5 times as large, 1 of 25 cases is decided otherwise; as small, 1 of 25 cases is decided otherwise.",
    command=TRIED,
)
BODY_REST_FRAMES_MAX = TABLE.cost(
    "BODY_REST_FRAMES_MAX", 24, "frames",
    "Without a search after it was not found again and again.",
)
BODY_REACH_PX = TABLE.cost(
    "BODY_REACH_PX", 16, "px",
    "That a body whose motion is not known yet may have moved between two frames.",
)
BODY_BEYOND_PX = TABLE.measured(
    "BODY_BEYOND_PX", 3.0, "px",
    "That one may have moved beyond the expected. 1.5 times as large or as small, it changes nothing in 6 cases; a "
    "thousand times or a thousandth of it does.",
    command=TRIED,
)
BODY_MARGIN_PX = TABLE.measured(
    "BODY_MARGIN_PX", 10, "px",
    "Around a body that are compared, too: smoothing and interpolation reach some of them. 1.5 times as large, errors "
    "change by 1.0 %; as small, 1 of 6 cases is decided otherwise.",
    command=TRIED,
)
BODY_SMOOTHED_PX = TABLE.stated(
    "BODY_SMOOTHED_PX", 1.0, "px",
    "Smoothing of both images, which halves their noise and leaves the edges.",
)
BODY_DISAGREES = TABLE.derived(
    "BODY_DISAGREES", 6.0, "of the noise",
    "Mean squared difference over BODY_SQUARE_PX from which a square disagrees: of some two independent "
    "differences, one in 400, exp(-6).",
)
BODY_SQUARE_PX = TABLE.stated(
    "BODY_SQUARE_PX", 3, "px",
    "Side of the squares that agree or not.",
)
BODY_PIXELS_MIN = TABLE.measured(
    "BODY_PIXELS_MIN", 40, "px",
    "That must disagree: single squares are no body. 1.5 times as large or as small, it changes nothing in 6 cases; a "
    "thousand times or a thousandth of it does.",
    command=TRIED,
)
CONFIRMED_SIGMAS = TABLE.derived(
    "CONFIRMED_SIGMAS", 3.0, "sigma",
    "A measurement that differs by less from the one before confirms it: 99 % of two numbers, exp(-3^2 / 2).",
)
CONFIRMED_PX = TABLE.stated(
    "CONFIRMED_PX", 0.3, "px",
    "The same, of the displacement between two frames: a body may become that much faster.",
)
BODY_GAP_PX = TABLE.stated(
    "BODY_GAP_PX", 7, "px",
    "Gaps in the outline of a body up to which it is one.",
)
TILE_PIXELS_MIN = TABLE.measured(
    "TILE_PIXELS_MIN", 8, "px",
    "Of a tile that make it count: two for each of its four unknowns, shift, gain and offset. 1.5 times as large or "
    "as small, 4 cases are decided alike, and errors change by 2.6 % at most.",
    command=TRIED,
)
RING_PX = TABLE.measured(
    "RING_PX", 3, "px",
    "Width of the ring of the second look: the pixels that were taken for a body reach some 2 px beyond its edge. 1.5 "
    "times as large or as small, 6 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
PART_OF_RING = TABLE.measured(
    "PART_OF_RING", 0.6, "of the change",
    "By which the ground may have pulled the first look, of what the ring changes. Found by drawn bodies: errors over "
    "sigma are then 0.6 for rough tools, 0.7 for smooth discs and 1.1 for particles (20 measurements of each). The "
    "images do not tell it: what a smaller mask changes goes with the error of tools and discs (correlations of -0.8 "
    "and -0.9), less so with that of particles (-0.5), and leaves two discs of three without a shift; what the ring "
    "changes beyond its own noise makes the same of all three. 1.5 times as large or as small, 6 cases are decided "
    "alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
BODY_FLOOR_PX = TABLE.measured(
    "BODY_FLOOR_PX", 0.02, "px",
    "Errors of interpolation at an edge. 1.5 times as large or as small, 6 cases are decided alike, and errors change "
    "by less than 0.1 %.",
    command=TRIED,
)
BODY_GAINS = TABLE.measured(
    "BODY_GAINS", (0.9, 1.1), "ratio of contrasts",
    "Between which a body shows itself again as bright. 1.5 times as large, the one case is decided otherwise and "
    "errors are 11 % larger and errors over sigma are 72 % larger; as small, the one case is decided otherwise and "
    "errors are 11 % larger and errors over sigma are 72 % larger.",
    command=TRIED,
)
BODY_LEFT_MAX = TABLE.measured(
    "BODY_LEFT_MAX", 5.0, "of the noise",
    "Variance that may be left: more is another body, or one that changes. 1.5 times as large or as small, it changes "
    "nothing in 1 case; a thousand times or a thousandth of it does.",
    command=TRIED,
)
BODY_HALVES_SIGMAS = TABLE.derived(
    "BODY_HALVES_SIGMAS", 4.0, "sigma",
    "By which its halves may move otherwise: more is a body that turns, by chance one in 16 000.",
)
APART_SIGMAS = TABLE.derived(
    "APART_SIGMAS", 3.0, "sigma",
    "By which it must move otherwise than the ground: by chance one in 90, exp(-3^2 / 2).",
)
BODY_SIGMA_PX_MAX = TABLE.measured(
    "BODY_SIGMA_PX_MAX", 0.3, "px",
    "A larger one is that of something else: a body that turns, two bodies, or a shadow. 1.5 times as large or as "
    "small, it changes nothing in 1 case; a thousand times or a thousandth of it does.",
    command=TRIED,
)

# Drift that is faster than the frames, in flicker.py

FLICKER_MODES = TABLE.measured(
    "FLICKER_MODES", (2, 10), "modes",
    "The first that is used and the one after the last: the lowest after the line; 15 rows of tiles resolve them. 1.5 "
    "times as large or as small, 26 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
DENSITY_GAIN_MIN = TABLE.derived(
    "DENSITY_GAIN_MIN", 12.0, "twice the log likelihood",
    "By which a density must explain rows that do not clearly move better than nothing does: chance reaches it "
    "once in 4000 times (chi-square with 1 degree of freedom, one side).",
)
JITTER_GAIN_MIN = TABLE.derived(
    "JITTER_GAIN_MIN", 4.0, "twice the log likelihood",
    "By which lines that jitter one by one must explain rows that move better than a density does: two sigmas, "
    "2^2. Too large an uncertainty is the lesser evil.",
)
MIXED_GAIN_MIN = TABLE.derived(
    "MIXED_GAIN_MIN", 1.0, "twice the log likelihood",
    "That a density must gain beside jitter: one sigma.",
)
MOVING_RATIO_MIN = TABLE.measured(
    "MOVING_RATIO_MIN", 2.0, "of the noise",
    "From which rows clearly move, beside MOVING_SIGMAS. 1.5 times as large or as small, 25 cases are decided alike, "
    "and errors change by less than 0.1 %.",
    command=TRIED,
)
MOVING_SIGMAS = TABLE.derived(
    "MOVING_SIGMAS", 2.0, "sigma",
    "By which the power of rows that move exceeds that of the noise: 1 in 40 by chance.",
)
POWER_MIN = TABLE.cost(
    "POWER_MIN", 1e-30, "squared px",
    "Keeps ratios of powers finite.",
)
FLICKER_FRAMES = TABLE.cost(
    "FLICKER_FRAMES", 64, "frames",
    "That are remembered.",
)
FLICKER_OUTLIER = TABLE.measured(
    "FLICKER_OUTLIER", 20.0, "of the median power",
    "From which a frame is left out: chance makes less of sixteen numbers, an image that is wrong in places makes "
    "much more. 1.5 times as large or as small, it changes nothing in 25 cases; a thousand times or a thousandth of "
    "it does.",
    command=TRIED,
)
FLICKER_GROWTH = TABLE.derived(
    "FLICKER_GROWTH", 1.5, "of the frames",
    "After which an estimate is made again: it has become more certain by a fifth, sqrt(1.5).",
)
FLICKER_ITERATIONS = TABLE.cost(
    "FLICKER_ITERATIONS", 60, "iterations",
    "Of the fit: amounts are then right to some per cent.",
)
FLICKER_SHIFT_MAX = TABLE.measured(
    "FLICKER_SHIFT_MAX", 0.1, "of the field",
    "By which a frame may be shifted: beyond, distortion bends it, too. 1.5 times as large or as small, it changes "
    "nothing in 25 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
POWER_OF_MODE = TABLE.measured(
    "POWER_OF_MODE", 0.9, "of the density",
    "Power of a mode of 1/f noise about its line, times its number: 1 but for the line and the ends. Seen in 4000 "
    "simulated frames. 1.5 times as large or as small, 25 cases are decided alike, and errors change by less than 0.1 "
    "%.",
    command=TRIED,
)
VARIANCE_OF_MEAN = TABLE.derived(
    "VARIANCE_OF_MEAN", 3.0, "of the density",
    "Integral of (1 - sinc f)^2 / f up to 12 cycles per frame, which 24 rows of tiles resolve.",
)
VARIANCE_OF_SHEAR = TABLE.derived(
    "VARIANCE_OF_SHEAR", 7.8, "of the density",
    "The same of the square of the response of a fitted line, from a quarter of a cycle per frame on: what is "
    "slower is drift.",
)

# Frames, in frame.py

NEGLIGIBLE_PX = TABLE.stated(
    "NEGLIGIBLE_PX", 1e-3, "px",
    "Displacement by a motion that is left in a frame: a tenth of what registration resolves.",
)
REGIONS = TABLE.cost(
    "REGIONS", 16, "cameras",
    "Whose scanned region is remembered; a zoom passes through more, and comes back to few.",
)
SAMPLES = TABLE.cost(
    "SAMPLES", 96, "px",
    "Along a side, by whose noise a repeated image is recognised.",
)
EDGE_POINTS = TABLE.cost(
    "EDGE_POINTS", 17, "points",
    "Along each edge of a region at which it is checked; distortion is smooth between them.",
)
SHRINKS_MAX = TABLE.cost(
    "SHRINKS_MAX", 4, "steps",
    "In which a region shrinks until all of its edges were scanned; distortion takes 2.",
)
FIXED_PART_MAX = TABLE.stated(
    "FIXED_PART_MAX", 0.05, "of a pixel",
    "That may be fixed: a pixel with more does not show the specimen.",
)
CUBIC_REACH_PX = TABLE.derived(
    "CUBIC_REACH_PX", 2.0, "px",
    "That a cubic interpolation reaches beyond a position.",
)

# Measurements, in measurement.py

SHIFT_FLOOR_PX = TABLE.measured(
    "SHIFT_FLOOR_PX", 1e-3, "px",
    "Error of a shift that the scatter of the tiles does not show, 1-sigma: interpolation. 1.5 times as large or as "
    "small, 25 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
SHEAR_FLOOR_PX = TABLE.stated(
    "SHEAR_FLOOR_PX", 0.02, "px",
    "The same of a shear: one linear step leads to it.",
)
SHEAR_OF_SHIFT = TABLE.stated(
    "SHEAR_OF_SHIFT", 1e-3, "of the shift",
    "The same of a shear: distortion that a good calibration leaves.",
)
DISTORTION_OF_SCALE = TABLE.stated(
    "DISTORTION_OF_SCALE", 1.0 / 3.0, "of the error of the scale",
    "Relative error of a distortion: a calibration whose scale is less certain leaves more of it.",
)
SHEAR_LEFT_PX = TABLE.stated(
    "SHEAR_LEFT_PX", 0.1, "px",
    "That a wrong velocity leaves in a frame, from which another registration is worth its time.",
)
KNOWN_SHEAR_PX = TABLE.stated(
    "KNOWN_SHEAR_PX", 1.0, "px",
    "1-sigma of the shear by a velocity up to which it is taken out of a frame anyway: at the edge of the image, half "
    "of it is left.",
)
SHEAR_MAX = TABLE.stated(
    "SHEAR_MAX", 0.1, "of the height of the image",
    "By which drift may shear it; more is a stage that moves.",
)
SHEAR_COPY_NOISE = TABLE.stated(
    "SHEAR_COPY_NOISE", 0.01, "of the variance",
    "Of a measured shear by which that of the keyframe differs from it.",
)

# Rotation and scale, in similarity.py

SCREEN_SIGMAS = TABLE.derived(
    "SCREEN_SIGMAS", 2.5, "sigma",
    "By which the left and the right half must differ before more than the shift is fitted: a screen that costs "
    "nothing, and lets one frame in forty through by chance (two components).",
)
UNPREDICTED_MAX = TABLE.stated(
    "UNPREDICTED_MAX", 0.01, "rad, or logarithm of the scale",
    "Largest unpredicted rotation and change of scale: beyond, a registration by shift alone fails.",
)
TURN_FLOOR_PX = TABLE.stated(
    "TURN_FLOOR_PX", 0.02, "px over the image",
    "Error that the scatter of the tiles does not show, 1-sigma: what one linear step leaves, as of a shear.",
)
TURN_OF_SHIFT = TABLE.stated(
    "TURN_OF_SHIFT", 1e-3, "of the shift",
    "The same: what any distortion leaves.",
)
RAW_DISTORTION = TABLE.stated(
    "RAW_DISTORTION", 5e-3, "1",
    "Radial distortion where there is no camera: the 1-sigma of an uncalibrated one (ScanCamera.nominal).",
)
RAW_OFF_CENTRE = TABLE.stated(
    "RAW_OFF_CENTRE", 0.1, "half widths",
    "Distance of its centre from the middle where there is no camera: the 1-sigma of an uncalibrated one.",
)
UNMEASURED_TURN = TABLE.derived(
    "UNMEASURED_TURN", 5e-3, "rad, or logarithm of the scale",
    "Between a frame and a keyframe of which nothing was measured, 1-sigma: what fits into the half of a pixel "
    "over 100 px that registration tolerates.",
)

# Process noise, in process_noise.py and filter.py

QUADRATURE_SPAN_MAX = TABLE.derived(
    "QUADRATURE_SPAN_MAX", 4.0, "time constants",
    "Up to which the quadrature of order 24 is exact to rounding; longer steps are made by doubling.",
)
MEAN_POSITION_VARIANCE = TABLE.derived(
    "MEAN_POSITION_VARIANCE", 1.0 / 320.0, "of q A^3",
    "Variance of the mean position over an acquisition of A seconds, given the motion at its middle, for a white "
    "acceleration of density q: integral over the impulse responses of both halves.",
)
MEAN_VELOCITY_VARIANCE = TABLE.derived(
    "MEAN_VELOCITY_VARIANCE", 1.0 / 12.0, "of q A",
    "The same of the mean velocity.",
)
MEAN_WALK_VARIANCE = TABLE.derived(
    "MEAN_WALK_VARIANCE", 1.0 / 12.0, "of w A",
    "Variance of the mean position over an acquisition of A seconds about that at its middle, for a random walk of "
    "density w: 2 w / A^2 times the integral of s^2 from 0 to A / 2.",
)
SERIES_BELOW = TABLE.derived(
    "SERIES_BELOW", 1e-3, "time constants",
    "Below which the difference of exponentials is a series of three terms, whose first neglected one is 1e-11 of "
    "it then.",
)
ADAPTATION = TABLE.measured(
    "ADAPTATION", 0.2, "of the logarithm",
    "By which the process noise changes with an innovation of one unit of excess: some five frames are averaged. 1.5 "
    "times as large or as small, 25 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
INNOVATION_RATIO_MAX = TABLE.measured(
    "INNOVATION_RATIO_MAX", 6.0, "of what it should be",
    "As which a normalised innovation squared counts at most, so that a single outlier raises the process noise by no "
    "more than exp(0.2 x 5) = 2.7. 1.5 times as large or as small, 25 cases are decided alike, and errors change by "
    "less than 0.1 %.",
    command=TRIED,
)
MOTION_MIN = TABLE.measured(
    "MOTION_MIN", 0.02, "sigma of a measurement",
    "By which process noise moves the drift between two frames at least: less of it has no effect. 1.5 times as large "
    "or as small, it changes nothing in 25 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
TIME_CONSTANT_FRAMES = TABLE.measured(
    "TIME_CONSTANT_FRAMES", 1.0, "frame intervals",
    "In which an acceleration decays: with a longer time constant the filter follows a smooth drift more closely, and "
    "overshoots when a rough one turns. 1.5 times as large or as small, 25 cases are decided alike, and the time of a "
    "pass changes by 0.0007 s at most, where its sigma is 0.036 s.",
    command=TRIED,
)
ESTIMATED_AFTER = TABLE.cost(
    "ESTIMATED_AFTER", (4, 8, 16), "measurements",
    "After which the process noise is estimated again from all of them.",
)
LARGER_SIGMAS = TABLE.measured(
    "LARGER_SIGMAS", 1.0, "sigma",
    "By which it is taken larger than the likeliest then: of so few measurements, too large an uncertainty is the "
    "lesser evil. 1.5 times as large or as small, 25 cases are decided alike, and errors change by 0.4 % at most.",
    command=TRIED,
)

# Hindsight, in smoother.py

MEASUREMENT_COST_MAX = TABLE.measured(
    "MEASUREMENT_COST_MAX", 50.0, "chi-square",
    "As which a measurement counts at most, about twice that of an outlier for shift and shear: a few outliers do not "
    "decide on the process noise. 1.5 times as large or as small, it changes nothing in 25 cases; a thousand times or "
    "a thousandth of it does.",
    command=TRIED,
)
MEASUREMENTS_UNCOUNTED = TABLE.derived(
    "MEASUREMENTS_UNCOUNTED", 2, "measurements",
    "That the prior of the velocity explains: the first two.",
)
LIKELIHOOD_MEASUREMENTS_MAX = TABLE.cost(
    "LIKELIHOOD_MEASUREMENTS_MAX", 600, "measurements",
    "For a likelihood: both components of 600 shifts tell a variance to 4 %, sqrt(2 / 1200).",
)
LIKELIHOOD_MEASUREMENTS_MIN = TABLE.derived(
    "LIKELIHOOD_MEASUREMENTS_MIN", 4, "measurements",
    "For a likelihood: two beyond those that do not count.",
)
WALK_FRAMES = TABLE.stated(
    "WALK_FRAMES", 30.0, "frame intervals, squared",
    "Density of a random walk over that of the acceleration beside it, where the drift is taken for one: its mean "
    "velocity changes within 30 frames by as much as a step is long. With 10 and 100, sixteen streams with a zoom have "
    "15 and 20 wrong frames of 528 instead of 16 (51 without a random walk), and none in hindsight (10 without).",
)
WALK_EVIDENCE_MIN = TABLE.derived(
    "WALK_EVIDENCE_MIN", 6.0, "twice the log likelihood ratio",
    "By which a smooth drift or a random walk is the likelier one, to be taken as true; with less, live, both are "
    "allowed for: strong evidence (Kass and Raftery 1995, doi:10.1080/01621459.1995.10476572).",
)
WALK_LOG_RANGE = TABLE.cost(
    "WALK_LOG_RANGE", (-4.0, 3.0), "logarithm",
    "Of the density, within which that of a random walk is looked for: about that of the likeliest smooth drift over "
    "WALK_FRAMES, with which both predict steps of about the same length.",
)
DENSITY_LOG_RANGE = TABLE.measured(
    "DENSITY_LOG_RANGE", (-14.0, 5.0), "logarithm",
    "Of the density relative to the guess: a likelihood is flat beyond. 1.5 times as large or as small, 25 cases are "
    "decided alike, and errors change by 0.1 % at most.",
    command=TRIED,
)
DENSITY_GRID = TABLE.cost(
    "DENSITY_GRID", 9, "densities",
    "At which the highest maximum is looked for; Brent's method refines it.",
)
DENSITY_LOG_TOLERANCE = TABLE.measured(
    "DENSITY_LOG_TOLERANCE", 0.1, "logarithm",
    "Of the density: far less than what the data can tell. 1.5 times as large or as small, 25 cases are decided "
    "alike, and errors change by 0.1 % at most.",
    command=TRIED,
)
SMOOTHER_BLOCK = TABLE.cost(
    "SMOOTHER_BLOCK", 512, "events",
    "Between two states to which the backward pass returns. A step takes up to 320 kB (48 keyframes, of four "
    "numbers each), so that a block stays below 170 MB, and so do the states between the blocks of 20 000 frames.",
)
SEQUENCE_BLOCK = TABLE.cost(
    "SEQUENCE_BLOCK", 128, "items",
    "Of a shared sequence that are copied when one is appended: some 0.3 us on average.",
)

# The frame time, in frame_time.py

SHEAR_OF_SHIFT_DISTORTED = TABLE.measured(
    "SHEAR_OF_SHIFT_DISTORTED", 0.01, "of the shift",
    "Shear that distortion imitates in images as they come: one of 1 % at the edge of the field. 1.5 times as large "
    "or as small, 26 cases are decided alike, and the time of a pass changes by 0.0005 s at most, where its sigma is "
    "0.036 s.",
    command=TRIED,
)
SHEAR_OF_SHIFT_RECTIFIED = TABLE.stated(
    "SHEAR_OF_SHIFT_RECTIFIED", 0.001, "of the shift",
    "What is left of it in rectified images.",
)
TIMED_FRAMES_MIN = TABLE.derived(
    "TIMED_FRAMES_MIN", 6, "frames",
    "From two components of each of which five unknowns, T and B, are estimated.",
)
TIME_SIGMAS_MIN = TABLE.measured(
    "TIME_SIGMAS_MIN", 5.0, "sigma",
    "The estimate is used when it is known to 20 %. 1.5 times as large or as small, it changes nothing in 1 case; a "
    "thousand times or a thousandth of it does.",
    command=TRIED,
)
TIMED_CHI2_MAX = TABLE.measured(
    "TIMED_CHI2_MAX", 6.0, "chi-square over its degrees of freedom",
    "Residuals that are 2.4 times as large as stated come from something else than noise. 1.5 times as large or as "
    "small, it changes nothing in 1 case; a thousand times or a thousandth of it does.",
    command=TRIED,
)
BEYOND_SIGMAS = TABLE.derived(
    "BEYOND_SIGMAS", 3.0, "sigma",
    "By which an estimate must be longer than the frame interval to be called so: by chance one in 700.",
)
FRAME_SHEAR_FLOOR_PX = TABLE.measured(
    "FRAME_SHEAR_FLOOR_PX", 0.005, "px",
    "Error of the shear of a frame that a registration does not state. 1.5 times as large or as small, the errors of "
    "one case change by 2.8 % at most.",
    command=TRIED,
)
KEYFRAME_SHEAR_FLOOR_PX = TABLE.measured(
    "KEYFRAME_SHEAR_FLOOR_PX", 0.01, "px",
    "Error that a registration does not state of which frames are in the mean of a keyframe. 1.5 times as large or as "
    "small, the errors of one case change by 1.5 % at most.",
    command=TRIED,
)
SHEAR_SCALE_FLOOR = TABLE.stated(
    "SHEAR_SCALE_FLOOR", 0.03, "of the shear",
    "A registration goes to the shear in one linear step, which is wrong by some per cent, depending on the "
    "specimen: in one frame.",
)
COMMON_SHEAR_SCALE_FLOOR = TABLE.measured(
    "COMMON_SHEAR_SCALE_FLOOR", 0.04, "of the shear",
    "The same in all frames of the same place. 1.5 times as large, errors over sigma are 29 % smaller; as small, "
    "errors over sigma are 34 % larger, in 1 case.",
    command=TRIED,
)
HUBER_SIGMAS = TABLE.derived(
    "HUBER_SIGMAS", 2.45, "sigma",
    "Normalised residuals of two components beyond this weigh less: 1 in 20 good ones, exp(-2.45^2 / 2).",
)
REWEIGHTED_MAX = TABLE.cost(
    "REWEIGHTED_MAX", 50, "iterations",
    "Until the weights have converged; they take fewer than ten.",
)
CONVERGED_SIGMAS = TABLE.measured(
    "CONVERGED_SIGMAS", 1e-3, "sigma",
    "The weights have converged when T changes by less than this part of its sigma. 1.5 times as large or as small, "
    "it changes nothing in 1 case; a thousand times or a thousandth of it does.",
    command=TRIED,
)
SCORED_FRAMES = TABLE.measured(
    "SCORED_FRAMES", 5, "frames",
    "Over which scores are summed: errors of smoothed velocities last for some frames. 1.5 times as large or as "
    "small, the errors of one case change by less than 0.1 %.",
    command=TRIED,
)
INFORMATION_MIN = TABLE.cost(
    "INFORMATION_MIN", 1e-12, "1 / s^2",
    "On T, where the velocity does not change at all: keeps T at 0 and finite.",
)

# Pairs of scans, in scan_pairs.py

SEARCHED_TILE_PX = TABLE.measured(
    "SEARCHED_TILE_PX", 64, "px",
    "Side of the tiles by which scans are searched: large enough for a peak that stands out. 1.5 times as large or as "
    "small, 26 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
COMPARED_TILE_PX = TABLE.measured(
    "COMPARED_TILE_PX", 32, "px",
    "Side of the tiles that are compared pixel by pixel, which are the smaller the less the drift changes within. 1.5 "
    "times as large, errors are 20 % larger and errors over sigma are 157 % larger and 27 % fewer points are found; "
    "as small, errors are 21 % larger and errors over sigma are 77 % larger and 141 % more points are found, in 1 "
    "case.",
    command=TRIED,
)
KNOT_PX = TABLE.measured(
    "KNOT_PX", 48, "px",
    "Lines from knot to knot, which a row of the smaller tiles tells with ease. 1.5 times as large, the one case is "
    "decided otherwise and errors over sigma are 70 % larger; as small, the one case is decided otherwise and errors "
    "are 110 % larger and errors over sigma are 62 % smaller.",
    command=TRIED,
)
KNOTS_MAX = TABLE.cost(
    "KNOTS_MAX", 32, "knots",
    "What a minute of solving allows.",
)
TILES_SMOOTHED_PX = TABLE.measured(
    "TILES_SMOOTHED_PX", 1.0, "px",
    "Smoothing before gradients are taken. 1.5 times as large, errors are 19 % larger and errors over sigma are 21 % "
    "larger and 6.8 % more points are found; as small, errors are 12 % larger and 11 % fewer points are found, in 1 "
    "case.",
    command=TRIED,
)
TILE_RIM_PX = TABLE.derived(
    "TILE_RIM_PX", 3, "px",
    "At the edge of a tile that the smoothing spoils: three of its sigmas.",
)
COMMON_SLOPE_MIN = TABLE.measured(
    "COMMON_SLOPE_MIN", 0.3, "of the gradients",
    "That two tiles must have in common, of all that they have: noise alone has 0.1 by chance in a tile of 26 x 26 px "
    "after that smoothing. In one direction alone, a quarter of it. 1.5 times as large, errors are 6.1 % larger and "
    "11 % fewer points are found; as small, errors change by 0.9 % and 2.3 % more points are found, in 1 case.",
    command=TRIED,
)
TILE_VARIANCE_MIN = TABLE.stated(
    "TILE_VARIANCE_MIN", 1e-6, "of the variance",
    "Least mean square of the difference of two tiles: that of the rounding to 8 bits.",
)
ROUNDS_MAX = TABLE.cost(
    "ROUNDS_MAX", 12, "rounds",
    "In which the displacement is taken out and what is left is measured again.",
)
ROUNDS_FREE = TABLE.stated(
    "ROUNDS_FREE", 2, "rounds",
    "After which it must begin to stay where it is.",
)
STILL_PX = TABLE.measured(
    "STILL_PX", 0.003, "px",
    "Change of the displacement below which it stays where it is. 1.5 times as large or as small, the errors of one "
    "case change by less than 0.1 %.",
    command=TRIED,
)
SETTLED_SIGMAS = TABLE.stated(
    "SETTLED_SIGMAS", 0.5, "sigma",
    "Within which it may wander where little is known.",
)
DISPLACED_LINES_MAX = TABLE.measured(
    "DISPLACED_LINES_MAX", 0.25, "px per line",
    "Beyond which scans are not compared: a twentieth of the width in a fifth of a scan. 1.5 times as large or as "
    "small, it changes nothing in 1 case; a thousand times or a thousandth of it does.",
    command=TRIED,
)
LINE_STEPS = TABLE.cost(
    "LINE_STEPS", 4, "steps",
    "Of the fixed point by which the line of a displaced pixel is found; each gains the slope of the "
    "displacement, which is well below a tenth.",
)
SPARSE_PX = TABLE.cost(
    "SPARSE_PX", 8, "px",
    "Between those of a tile over which its place on the slow axis is averaged.",
)
COARSE_SIGMA_PX = TABLE.measured(
    "COARSE_SIGMA_PX", 1.0, "px",
    "1-sigma of a shift that is only searched for. 1.5 times as large or as small, the errors of one case change by "
    "less than 0.1 %.",
    command=TRIED,
)
FAR_MEDIANS = TABLE.stated(
    "FAR_MEDIANS", 4.0, "of the median",
    "By which tiles may be off.",
)
PERIODIC_PEAK_MIN = TABLE.measured(
    "PERIODIC_PEAK_MIN", 0.8, "of the highest peak",
    "Of peaks that may be periods of a lattice. 1.5 times as large or as small, it changes nothing in 1 case; a "
    "thousand times or a thousandth of it does.",
    command=TRIED,
)
BEND_PX = TABLE.measured(
    "BEND_PX", 2.0, "px",
    "That the drift is taken to bend at a knot: far more than tiles tell it to, so that it decides only where no tile "
    "was measured, and the drift goes on there in a straight line with such an uncertainty. 1.5 times as large or as "
    "small, the errors of one case change by less than 0.1 %.",
    command=TRIED,
)
FREEDOM_MIN = TABLE.measured(
    "FREEDOM_MIN", 0.02, "of the residual",
    "Of a tile that the fit leaves it at least: what a knot is told by one tile alone has no residual. 1.5 times as "
    "large or as small, 26 cases are decided alike, and errors change by less than 0.1 %.",
    command=TRIED,
)
ZERO_SIGMA_PX = TABLE.cost(
    "ZERO_SIGMA_PX", 1e-4, "px",
    "1-sigma of the mean over the first scan, which is zero by definition.",
)
SAME_PLACE_PX = TABLE.measured(
    "SAME_PLACE_PX", 0.5, "px",
    "Corrected scans whose whole images are farther apart are not of the same place. 1.5 times as large or as small, "
    "it changes nothing in 1 case; a thousand times or a thousandth of it does.",
    command=TRIED,
)
INTERPOLATED_PX = TABLE.derived(
    "INTERPOLATED_PX", 1, "px",
    "That a cubic interpolation takes beyond the two nearest ones.",
)

# Stripes, in stripes.py

STRIPE_STRIPS = TABLE.measured(
    "STRIPE_STRIPS", 6, "strips",
    "Of an image beside each other, of whose lines the noise differs and stripes do not. 1.5 times as large or as "
    "small, it changes nothing in 25 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
STRIPE_CELLS_MIN = TABLE.measured(
    "STRIPE_CELLS_MIN", 0.9, "of the cells",
    "In which a strip agrees with the others in sign, of images that have stripes. 1.5 times as large or as small, 26 "
    "cases are decided alike, and errors change by 0.9 % at most.",
    command=TRIED,
)
STRIPE_CELLS_TRIED = TABLE.cost(
    "STRIPE_CELLS_TRIED", 0.65, "of the cells",
    "From which a frame is followed once more without them: one picture of noise in ten. The shift decides.",
)
STRIPE_PARTS = TABLE.measured(
    "STRIPE_PARTS", 8, "parts",
    "Of the length of a strip, which are compared for themselves. 1.5 times as large or as small, 25 cases are "
    "decided alike, and errors change by 0.9 % at most.",
    command=TRIED,
)
STRIPE_SMOOTHED_PX = TABLE.measured(
    "STRIPE_SMOOTHED_PX", 1.0, "px",
    "Smoothing of what is compared, so that little is left of sharp edges that are interpolated. 1.5 times as large "
    "or as small, 25 cases are decided alike, and errors change by 0.9 % at most.",
    command=TRIED,
)
STRIPE_MOVE_PX_MAX = TABLE.measured(
    "STRIPE_MOVE_PX_MAX", 16.0, "px",
    "By which the specimen has moved since the frame that is compared with, before a later one takes its place: half "
    "of the period of the widest stripes that pull much. 1.5 times as large or as small, it changes nothing in 25 "
    "cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
STRIPE_SHADING = TABLE.measured(
    "STRIPE_SHADING", 0.25, "of the image",
    "Over which brightness changes slowly: shading, which pulls little. 1.5 times as large or as small, it changes "
    "nothing in 25 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
STRIPE_CLIP = TABLE.stated(
    "STRIPE_CLIP", 4.0, "sigma",
    "At which the means of lines are clipped, so that a few lines of something else do not look like stripes.",
)
STRIPE_PROFILE_MIN = TABLE.measured(
    "STRIPE_PROFILE_MIN", 32, "lines",
    "Below, their variances are hardly known. 1.5 times as large or as small, it changes nothing in 25 cases; a "
    "thousand times or a thousandth of it does.",
    command=TRIED,
)
STRIPE_SHARE_MAX = TABLE.measured(
    "STRIPE_SHARE_MAX", 0.3, "of the squared gradients",
    "That the means of lines have: of a specimen that shows more, it is what the shift across them is told by. 1.5 "
    "times as large or as small, it changes nothing in 25 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
STRIPE_TRIES = TABLE.cost(
    "STRIPE_TRIES", 3, "frames",
    "That were refused, after which frames are no longer tried without stripes.",
)
STRIPE_CHI2_MIN = TABLE.derived(
    "STRIPE_CHI2_MIN", 25.0, "squared deviations",
    "Along one axis, between the shifts with and without stripes: by chance one in 1.7 million (normal, both sides).",
)
LONE_LINE_AROUND = TABLE.stated(
    "LONE_LINE_AROUND", 9, "lines",
    "With which one is compared: several times as many as a cross-hair is wide, in which a specimen hardly changes.",
)
LONE_LINE_CHI2_MIN = TABLE.derived(
    "LONE_LINE_CHI2_MIN", 9.0, "squared deviations",
    "The same where one line lies through all of the image, which is seldom a specimen: by chance one in 370 (normal, "
    "both sides), and what its lines have in common is left out then.",
)
