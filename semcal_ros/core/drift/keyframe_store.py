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

"""The keyframes so far, and which of them to register a frame against."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from semcal_ros.core.drift.frame import ScanFrame
from semcal_ros.core.drift.keyframe import Keyframe, resample_keyframe, scale_ratio
from semcal_ros.core.drift.state import DriftState
from semcal_ros.core.drift.thresholds import (
    CHANGE_MARGIN,
    MASKED_MAX,
    MEAN_COUNTS,
    MERGED_OVERLAP_MIN,
    SAME_SCALE,
)
from semcal_ros.core.registration.reference import Reference, RegistrationSettings


@dataclass(frozen=True)
class Candidate:
    """A keyframe to register a frame against.

    Attributes
    ----------
    key
        Its number.
    ratio
        Factor by which its scale differs from that of the frame, at least 1.
    overlap
        Predicted part of the frame that it shows.
    """

    key: int
    ratio: float
    overlap: float

    @property
    def rescaled(self) -> bool:
        """Whether it has to be resampled."""
        return self.ratio > SAME_SCALE


@dataclass(frozen=True)
class PreparedReference:
    """A reference, and the keyframe ``key`` as it was when it was prepared."""

    key: int
    keyframe: Keyframe
    reference: Reference

    def serves(self, key: int, keyframe: Keyframe) -> bool:
        """Whether it still is good enough for a keyframe, which has neither been replaced nor improved much since."""
        mine = self.keyframe
        return (
            self.is_of(key, keyframe)
            and keyframe.averaged >= mine.averaged
            and not (keyframe.averaged in MEAN_COUNTS and keyframe.averaged > mine.averaged)
        )

    def is_of(self, key: int, keyframe: Keyframe) -> bool:
        """Whether it was made of the first frame of a keyframe, and of others at most."""
        mine = self.keyframe
        return (
            key == self.key
            and keyframe.frame is mine.frame
            and np.array_equal(keyframe.removed, mine.removed)
        )

    def masked(self, keyframe: Keyframe) -> PreparedReference:
        """The same without the pixels that a keyframe of the same picture leaves out; they still show in the search
        over all shifts.
        """
        left, top, right, bottom = self.reference.region
        fixed = None if keyframe.fixed is None else keyframe.fixed[top:bottom, left:right]
        return PreparedReference(self.key, keyframe, replace(self.reference, fixed=fixed))


@dataclass(frozen=True)
class KeyframeStore:
    """Keyframes by number, with the prepared reference of the one in use. What happens to it makes another one, which
    shares the images.

    Attributes
    ----------
    keyframes
        The keyframes by number, in the order of their last use.
    current
        Number of the one in use.
    first
        Number of the one that is never forgotten.
    following
        Number of the next one.
    prepared
        The latest reference.
    resampled
        The latest reference of another scale, and the frame whose camera would show it so.
    single
        The latest reference of the first frame of a keyframe alone.
    """

    keyframes: dict[int, Keyframe] = field(default_factory=dict)
    current: int | None = None
    first: int | None = None
    following: int = 0
    prepared: PreparedReference | None = None
    resampled: tuple[PreparedReference, ScanFrame] | None = None
    single: PreparedReference | None = None

    def __getitem__(self, key: int) -> Keyframe:
        return self.keyframes[key]

    @property
    def keys(self) -> tuple[int, ...]:
        """Numbers of the keyframes."""
        return tuple(self.keyframes)

    def __len__(self) -> int:
        return len(self.keyframes)

    @property
    def latest(self) -> int:
        """Number of the keyframe that was added last."""
        return self.following - 1

    def add(self, keyframe: Keyframe, reference: Reference | None = None) -> KeyframeStore:
        """Add a keyframe and make it the one in use.

        Parameters
        ----------
        keyframe
            The keyframe.
        reference
            Its prepared reference, where that exists already.
        """
        number = self.following
        prepared = self.prepared
        if reference is not None:
            prepared = PreparedReference(number, keyframe, reference)
        return replace(
            self,
            keyframes={**self.keyframes, number: keyframe},
            current=number,
            first=number if self.first is None else self.first,
            following=number + 1,
            prepared=prepared,
        )

    def superfluous(self, max_bytes: int, max_count: int) -> list[int]:
        """Numbers of the keyframes to forget, so that memory and number of the others stay within their limits: those
        that were not used for the longest time, and never the first one.
        """
        left, gone = dict(self.keyframes), []
        while len(left) > 2 and (
            len(left) > max_count or sum(k.nbytes for k in left.values()) > max_bytes
        ):
            oldest = next(k for k in left if k not in (self.first, self.current))
            del left[oldest]
            gone.append(oldest)
        return gone

    def forget(self, key: int) -> KeyframeStore:
        """Remove a keyframe."""
        rest = {k: keyframe for k, keyframe in self.keyframes.items() if k != key}
        first = next(iter(rest), None) if self.first == key else self.first
        return replace(self, keyframes=rest, first=first)

    def use(self, key: int) -> KeyframeStore:
        """Make it the one in use."""
        others = {k: keyframe for k, keyframe in self.keyframes.items() if k != key}
        return replace(self, keyframes={**others, key: self.keyframes[key]}, current=key)

    def replace(self, key: int, keyframe: Keyframe) -> KeyframeStore:
        """Replace a keyframe under the same number."""
        return replace(self, keyframes={**self.keyframes, key: keyframe})

    def clean(self, key: int, single: Keyframe) -> KeyframeStore:
        """Replace a keyframe by its first frame alone, of which more is left out than before. A reference of that frame
        is kept, without these pixels, if they are few.
        """
        store, old, latest = self.replace(key, single), self.keyframes[key], self.single
        if latest is None or old.fixed is None or single.fixed is None:
            return store
        newly = single.fixed & ~old.fixed
        if not latest.is_of(key, old) or float(np.mean(newly)) > MASKED_MAX:
            return store
        latest = latest.masked(single)
        return replace(store, prepared=latest, single=latest)

    def reference(
        self, key: int, settings: RegistrationSettings
    ) -> tuple[KeyframeStore, Reference]:
        """The prepared reference of a keyframe, and the store that keeps it until another one is asked for, or until
        the mean has become much better.
        """
        keyframe, latest, single = self.keyframes[key], self.prepared, self.single
        if latest is None or not latest.serves(key, keyframe):
            latest = PreparedReference(key, keyframe, keyframe.prepare_reference(settings))
            if keyframe.averaged == 1 and keyframe.fixed is not None:
                # What else stays in place moves against the specimen, until it is found.
                single = latest
        return replace(self, prepared=latest, single=single), latest.reference

    def single_reference(
        self, key: int, make: Callable[[], Keyframe], settings: RegistrationSettings
    ) -> tuple[KeyframeStore, Reference]:
        """The prepared reference of the first frame of a keyframe, which ``make`` makes a keyframe of, and the store
        that keeps it: frames are compared with it again whenever the mean has become much better.
        """
        keyframe, latest = self.keyframes[key], self.single
        if latest is None or not latest.is_of(key, keyframe):
            single = make()
            latest = PreparedReference(key, single, single.prepare_reference(settings))
        return replace(self, single=latest), latest.reference

    def averaged(self, key: int) -> int:
        """Number of frames in the prepared reference."""
        if self.prepared is not None and self.prepared.key == key:
            return self.prepared.keyframe.averaged
        return self.keyframes[key].averaged

    def has_room(self, key: int, overlap: float) -> bool:
        """Whether a frame with that overlap would make the mean of a keyframe better."""
        return self.keyframes[key].averaged < MEAN_COUNTS[-1] and overlap >= MERGED_OVERLAP_MIN

    def resampled_reference(
        self, key: int, frame: ScanFrame, settings: RegistrationSettings
    ) -> tuple[KeyframeStore, Reference]:
        """The reference as the camera of a frame would show the keyframe, and the store that keeps it, because a frame
        may be registered several times.
        """
        keyframe, latest = self.keyframes[key], self.resampled
        if latest is None or latest[0].keyframe is not keyframe or latest[1] is not frame:
            reference = resample_keyframe(keyframe, frame).prepare_reference(settings)
            latest = PreparedReference(key, keyframe, reference), frame
        return replace(self, resampled=latest), latest[0].reference

    def smallest_scale_ratio(self, frame: ScanFrame) -> float:
        """Factor by which the scale of a frame differs from that of the most similar keyframe."""
        return min(scale_ratio(k.frame, frame) for k in self.keyframes.values())

    def candidates(
        self, state: DriftState, frame: ScanFrame, enough: float, max_ratio: float
    ) -> list[Candidate]:
        """The keyframes that a frame can be registered against, the best first.

        The one in use comes first as long as its overlap is ``enough``; then those that overlap
        more; then those from which the specimen has changed; then those of another scale, up to a factor of
        ``max_ratio``.
        """
        candidates = []
        for key, keyframe in self.keyframes.items():
            ratio = scale_ratio(keyframe.frame, frame)
            if ratio <= max_ratio and key in state.keys:
                shift = frame.px_from_unit @ (state.position - state.keyframe_state(key)[:2])
                common = np.clip(1.0 - np.abs(shift) / np.array(frame.size), 0.0, 1.0)
                candidates.append(Candidate(key, ratio, float(common[0] * common[1])))

        def rank(candidate: Candidate) -> tuple[bool, bool, bool, float]:
            in_use = candidate.key == self.current
            good = candidate.overlap >= enough + (0.0 if in_use else CHANGE_MARGIN)
            is_worn = not in_use and self.keyframes[candidate.key].is_worn
            return candidate.rescaled, is_worn, not (in_use and good), -candidate.overlap

        return sorted(candidates, key=rank)
