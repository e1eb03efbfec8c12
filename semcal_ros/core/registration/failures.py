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

"""Kinds of reasons for not using an image, for registration and drift alike."""

from __future__ import annotations

from enum import Enum


class MatchFailure(Enum):
    """Why an image was not matched with a reference."""

    #: The reference is blank, too small, without structure, or not finite.
    UNUSABLE_REFERENCE = "unusable reference"
    #: The image is.
    UNUSABLE_IMAGE = "unusable image"
    #: The image, or a part of it, is the one before once more, down to its noise.
    REPEATED_IMAGE = "repeated image"
    #: It has the time of the one before.
    REPEATED_TIME = "repeated time"
    #: No shift correlates clearly better than chance.
    NO_PEAK = "no peak"
    #: Several shifts explain the image equally well, or another one than was predicted does.
    AMBIGUOUS = "ambiguous"
    #: The images share fewer rows or columns than a comparison needs.
    TOO_LITTLE_OVERLAP = "too little overlap"
    #: The gradient of the images leaves a direction of the shift open.
    UNDETERMINED = "undetermined"
    #: The refinement did not converge.
    NOT_CONVERGED = "not converged"
    #: The refinement ended far from the coarse peak that it started at.
    STAGES_DISAGREE = "stages disagree"
    #: The halves of the overlap are shifted differently.
    HALVES_DISAGREE = "halves disagree"
    #: The images have too little of their structure in common.
    DISSIMILAR = "dissimilar"
    #: Of a specimen that repeats itself, defects are elsewhere at each of the shifts that were compared.
    DEFECTS_ELSEWHERE = "defects elsewhere"
    #: The shift is so large that the stage must have moved.
    STAGE_MOVE = "stage move"
    #: The shift is far from what the drift so far predicts.
    OUTLIER = "outlier"
    #: No keyframe has a scale near that of the image.
    SCALE_CHANGE = "scale change"


#: Failures of the image alone, which say nothing about the reference.
IMAGE_FAILURES = frozenset(
    {MatchFailure.UNUSABLE_IMAGE, MatchFailure.REPEATED_IMAGE, MatchFailure.REPEATED_TIME}
)

#: The image matches, at an unexpected place: the next one tells whether that holds.
SEEN_AWAY = frozenset({MatchFailure.OUTLIER, MatchFailure.STAGE_MOVE})

#: Failures that stripes in the images may be the cause of.
STRIPE_FAILURES = frozenset(
    {
        MatchFailure.NO_PEAK,
        MatchFailure.UNDETERMINED,
        MatchFailure.NOT_CONVERGED,
        MatchFailure.STAGES_DISAGREE,
        MatchFailure.HALVES_DISAGREE,
        MatchFailure.DISSIMILAR,
    }
)
