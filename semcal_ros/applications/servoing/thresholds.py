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

"""The numbers of visual servoing, each with its source."""

from __future__ import annotations

from semcal_ros.core.thresholds import Table

TABLE = Table()

# Of the measured rows: each says in how many cases it was tried, and what changed in them (doc/thresholds.md).
TRIED = "python -m benchmarks.thresholds servoing, 29 November 2026"

# A row takes three lines, and not one for each of its parts.
# fmt: off

# The target, in target.py

RATIO = TABLE.defined(
    "RATIO", 3, "ratio",
    "Of the cells of one level to those of the next: the middle cell of 3 x 3 holds the next board.",
)
MARKER_SIDE = TABLE.defined(
    "MARKER_SIDE", 0.7, "of a cell",
    "Of a marker: it is a part of what the target is. It leaves a white border of 0.15 of a cell, wider than one "
    "square of the marker, 0.7 / 6 = 0.12.",
)
MARKER_BITS = TABLE.defined(
    "MARKER_BITS", 6, "squares",
    "Along a side of a marker, as generated from the dictionary.",
)
LEVELS_MAX = TABLE.derived(
    "LEVELS_MAX", 6, "levels",
    "Eight markers in each: the fifty of the dictionary are enough for six.",
)

# Detection of markers, in target.py

SEARCHED_PX = TABLE.cost(
    "SEARCHED_PX", 1024, "px",
    "Larger pictures are averaged down by a whole factor to find the markers; their sides are then measured at full "
    "resolution.",
)
SIDE_MIN_PX = TABLE.stated(
    "SIDE_MIN_PX", 18.0, "px",
    "Of a marker: three pixels for each of the six squares along a side.",
)
SEARCH_BLUR_PX = TABLE.stated(
    "SEARCH_BLUR_PX", 1.0, "px",
    "Sigma of the smoothing for the search: a third of the smallest square that can be read.",
)
SIDE_ENDS = TABLE.measured(
    "SIDE_ENDS", 0.14, "of a side",
    "That is left out at each end, where the window would meet the next side. 1.5 times as large, errors are 12 % "
    "larger and errors over sigma 7.2 % larger; as small, errors are 0.88 % smaller.",
    command=TRIED,
)
WINDOW = TABLE.measured(
    "WINDOW", 0.11, "of a side",
    "Half width of the window across it; border and frame of a marker are wider. 1.5 times as large, errors are 46 % "
    "larger and errors over sigma 24 % smaller; as small, errors are 13 % larger and errors over sigma 28 % larger.",
    command=TRIED,
)
WINDOW_MIN_PX = TABLE.measured(
    "WINDOW_MIN_PX", 2.0, "px",
    "Of that half width: an edge has to lie in it with its blur. 1.5 times as large, errors are 7.3 % larger and "
    "those of one case 40 % larger; as small, errors change by less than 0.1 %.",
    command=TRIED,
)
WINDOW_MAX_PX = TABLE.cost(
    "WINDOW_MAX_PX", 6.0, "px",
    "Of that half width.",
)
WINDOW_ROUNDS = TABLE.cost(
    "WINDOW_ROUNDS", 4, "rounds",
    "In which the windows are laid over the corners found last.",
)
SETTLED_PX = TABLE.measured(
    "SETTLED_PX", 0.02, "px",
    "Movement of the corners after which that ends: what they are uncertain by at best. 1.5 times as large or as "
    "small, 7 cases are decided alike, and errors change by 0.28 % at most.",
    command=TRIED,
)
PLACES_MAX = TABLE.cost(
    "PLACES_MAX", 96, "places",
    "Along a side, at which its step is measured: neighbours that are closer than a pixel share their noise.",
)
STEP_SIGMAS = TABLE.derived(
    "STEP_SIGMAS", 3.5, "sigma",
    "From the line through the others, beyond which a step is dust: by chance one of 2100 (normal, both sides).",
)
RAGGED_PART = TABLE.measured(
    "RAGGED_PART", 0.5, "of the window",
    "Steps that scatter by more do not form a line. 1.5 times as large or as small, 7 cases are decided alike, and "
    "errors change by 2.1 % at most.",
    command=TRIED,
)
CONTRAST_MIN = TABLE.measured(
    "CONTRAST_MIN", 2.0, "sigma",
    "Of a side, in standard deviations of its pixels from the two levels. 1.5 times as large or as small, 7 cases are "
    "decided alike, and errors change by 2.2 % at most.",
    command=TRIED,
)
PLACES_MIN = TABLE.measured(
    "PLACES_MIN", 6, "places",
    "On a side, also after outliers were left out: three for each unknown. With 9 or 4, nothing changes in 7 cases; "
    "with a thousand times or a thousandth of it something does.",
    command=TRIED,
)

# The pose of the target, in pose.py

POSE_STEPS_MAX = TABLE.cost(
    "POSE_STEPS_MAX", 12, "steps",
    "From the similarity they converge quadratically, or not at all.",
)
POSE_SETTLED_PX = TABLE.derived(
    "POSE_SETTLED_PX", 1e-6, "px",
    "Movement of the corners in the last step: far below their errors, some hundredths of a pixel.",
)
MISREAD_PART = TABLE.measured(
    "MISREAD_PART", 0.25, "of a side",
    "From its expected position, from which a marker was misread. 1.5 times as large or as small, it changes nothing "
    "in 24 cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)

# The camera, in plane_camera.py

SAME_MATRIX = TABLE.derived(
    "SAME_MATRIX", 1e-9, "of an element",
    "Difference of two matrices from the same numbers, one divided and multiplied by rho again: rounding is some "
    "1e-15, and single precision would be 1e-7.",
)

# The axis of the zoom, in plane_camera.py

SAME_SCALE = TABLE.measured(
    "SAME_SCALE", 0.002, "of the scale",
    "Scales that differ by less are of one magnification: if the cameras still differ, another calibration has come "
    "into force. 1.5 times as large or as small, it changes nothing in 12 cases; a thousand times or a thousandth of "
    "it does.",
    command=TRIED,
)
SCALE_SIGMA = TABLE.stated(
    "SCALE_SIGMA", 0.003, "of the scale",
    "1-sigma of a camera's: it also moves points that are off the axis.",
)

# Commands and drift, in motion.py

COMMANDS_KEPT = TABLE.cost(
    "COMMANDS_KEPT", 1024, "commands",
    "Those of 30 s, LATENCY_MAX_S, at 34 a second.",
)
GATE_SIGMAS = TABLE.derived(
    "GATE_SIGMAS", 5.0, "sigma",
    "Of an innovation that is not drift: by chance one of 870 000 frames (normal, both sides, two axes).",
)
ODD_MAX = TABLE.measured(
    "ODD_MAX", 4, "frames",
    "In a row beyond the gate, that are drift after all. With 6 or 3, nothing changes in 15 cases; with a thousand "
    "times or a thousandth of it something does.",
    command=TRIED,
)
DRIFT_FACTOR = TABLE.stated(
    "DRIFT_FACTOR", 10.0, "ratio",
    "On the expected drift in that case.",
)
RESPONSE_SIGMA = TABLE.stated(
    "RESPONSE_SIGMA", 0.3, "of the command",
    "1-sigma of what a stage does beyond it, along each axis and across, before it has been seen to move: piezo stages "
    "without a sensor.",
)
RESPONSE_RATIO = TABLE.derived(
    "RESPONSE_RATIO", 10.0, "ratio",
    "Of a command's travel to the drift and the noise of the image, above which it tells the response. A command "
    "removes at most half of the noise of the frame before, and the response is off by 0.5 / 10^2 at most; one that "
    "holds a target against drift is nearly constant, and cannot be told from it.",
)
JUDGED_PX = TABLE.measured(
    "JUDGED_PX", 36.0, "px",
    "Commanded travel after which the stage is judged: well above drift and noise in that time. 1.5 times as large, 2 "
    "of 15 cases are decided otherwise; as small, 2 of 15 cases are decided otherwise.",
    command=TRIED,
)
TRAVEL_MIN = TABLE.measured(
    "TRAVEL_MIN", 0.3, "of the command",
    "That has to be seen of it. 1.5 times as large or as small, it changes nothing in 15 cases; a thousand times or a "
    "thousandth of it does.",
    command=TRIED,
)
TRAVEL_MAX = TABLE.measured(
    "TRAVEL_MAX", 3.0, "of the command",
    "And at most. 1.5 times as large or as small, it changes nothing in 15 cases; a thousand times or a thousandth of "
    "it does.",
    command=TRIED,
)

# The control law, in law.py

GAIN_MAX = TABLE.derived(
    "GAIN_MAX", 0.5, "of the error",
    "That is removed per frame. With the latency predicted, up to 2 is stable; without, 0.5 is still stable for a "
    "latency of two frames, whose limit is 0.618.",
)
GAIN_WITHOUT_TIMES_MAX = TABLE.derived(
    "GAIN_WITHOUT_TIMES_MAX", 0.25, "of the error",
    "Without times the latency cannot be predicted; a quarter does not overshoot with one frame of it, as 1 / 4 is "
    "where both roots of z^2 - z + k are real.",
)
LATENCY_MAX_S = TABLE.measured(
    "LATENCY_MAX_S", 30.0, "s",
    "Frames and commands of one clock are not farther apart. 1.5 times as large or as small, it changes nothing in 15 "
    "cases; a thousand times or a thousandth of it does.",
    command=TRIED,
)
COMMAND_DELAY = TABLE.stated(
    "COMMAND_DELAY", 0.5, "frames",
    "1-sigma of the delay with which a stage obeys a command.",
)
