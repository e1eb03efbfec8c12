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

from dataclasses import dataclass

import numpy as np

from semcal_ros.core.drift.frame import ScanFrame
from semcal_ros.core.drift.keyframe import Keyframe, resample_keyframe, scale_ratio
from semcal_ros.core.drift.state import DriftState
from semcal_ros.core.registration.reference import Reference, RegistrationSettings

#: Ratio of two scales below which images need no resampling: 0.05 px at the edge of 1024 px.
SAME_SCALE = 1.0001
# An old keyframe must overlap by this much more than is asked of the one in use, or two of them
# would take turns.
_CHANGE_MARGIN = 0.05
# Frames are added to a mean where they show most of it.
_MIN_MERGE_OVERLAP = 0.75
#: Numbers of frames in a mean at which it replaces the prepared reference: each time its noise
#: variance has halved. From 32 frames on, it adds 1.5 % to the sigma of a shift.
MEAN_COUNTS = (2, 4, 8, 16, 32)


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


class KeyframeStore:
    """Keyframes by number, with the prepared reference of the one in use.

    Parameters
    ----------
    settings
        Settings of the registrations.
    max_bytes, max_count
        Memory and number of the keyframes that are kept; the first one is never forgotten.
    """

    def __init__(self, settings: RegistrationSettings, max_bytes: int, max_count: int) -> None:
        self._settings = settings
        self._max_bytes, self._max_count = max_bytes, max_count
        self._keyframes: dict[int, Keyframe] = {}
        self._prepared: tuple[int, Keyframe, Reference] | None = None
        self._resampled: tuple[Keyframe, ScanFrame, Reference] | None = None
        self._first: int | None = None
        self._next = 0
        self.current: int | None = None

    def __getitem__(self, key: int) -> Keyframe:
        return self._keyframes[key]

    @property
    def keys(self) -> tuple[int, ...]:
        """Numbers of the keyframes."""
        return tuple(self._keyframes)

    def __len__(self) -> int:
        return len(self._keyframes)

    def add(self, keyframe: Keyframe, reference: Reference | None = None) -> tuple[int, list[int]]:
        """Add a keyframe and make it the one in use.

        Parameters
        ----------
        keyframe
            The keyframe.
        reference
            Its prepared reference, where that exists already.

        Returns
        -------
        Its number, and those of the keyframes that were forgotten for it.
        """
        number = self._next
        self._next += 1
        self._first = number if self._first is None else self._first
        self._keyframes[number] = keyframe
        self.current = number
        if reference is not None:
            self._prepared = number, keyframe, reference
        return number, self._forget_oldest()

    def _forget_oldest(self) -> list[int]:
        gone = []
        while len(self._keyframes) > 2 and (
            len(self._keyframes) > self._max_count
            or sum(k.nbytes for k in self._keyframes.values()) > self._max_bytes
        ):
            # The order is that of the last use.
            oldest = next(k for k in self._keyframes if k not in (self._first, self.current))
            del self._keyframes[oldest]
            gone.append(oldest)
        return gone

    def forget(self, key: int) -> None:
        """Remove a keyframe."""
        del self._keyframes[key]
        if self._first == key:
            self._first = next(iter(self._keyframes), None)

    def use(self, key: int) -> None:
        """Make it the one in use."""
        self.current = key
        self._keyframes[key] = self._keyframes.pop(key)

    def replace(self, key: int, keyframe: Keyframe) -> None:
        """Replace a keyframe under the same number."""
        self._keyframes[key] = keyframe

    def reference(self, key: int) -> Reference:
        """The prepared reference; it is kept until another one is asked for, or until the mean has
        become much better.
        """
        keyframe = self._keyframes[key]
        latest = self._prepared
        if latest is None or latest[0] != key or self._is_outdated(latest[1], keyframe):
            latest = key, keyframe, keyframe.prepare_reference(self._settings)
            self._prepared = latest
        return latest[2]

    def _is_outdated(self, before: Keyframe, now: Keyframe) -> bool:
        """Whether a keyframe has become much better than the one that was prepared, or another one."""
        if now.averaged < before.averaged:
            return True
        if before.frame is not now.frame or not np.array_equal(before.removed, now.removed):
            return True
        return now.averaged in MEAN_COUNTS and now.averaged > before.averaged

    def averaged(self, key: int) -> int:
        """Number of frames in the prepared reference."""
        if self._prepared is not None and self._prepared[0] == key:
            return self._prepared[1].averaged
        return self._keyframes[key].averaged

    def has_room(self, key: int, overlap: float) -> bool:
        """Whether a frame with that overlap would make the mean of a keyframe better."""
        return self._keyframes[key].averaged < MEAN_COUNTS[-1] and overlap >= _MIN_MERGE_OVERLAP

    def resampled_reference(self, key: int, frame: ScanFrame) -> Reference:
        """The reference as the camera of a frame would show it; the latest one is kept, because a
        frame may be registered several times.
        """
        keyframe, latest = self._keyframes[key], self._resampled
        if latest is None or latest[0] is not keyframe or latest[1] is not frame:
            latest = (
                keyframe,
                frame,
                resample_keyframe(keyframe, frame).prepare_reference(self._settings),
            )
            self._resampled = latest
        return latest[2]

    def smallest_scale_ratio(self, frame: ScanFrame) -> float:
        """Factor by which the scale of a frame differs from that of the most similar keyframe."""
        return min(scale_ratio(k.frame, frame) for k in self._keyframes.values())

    def candidates(
        self, state: DriftState, frame: ScanFrame, enough: float, max_ratio: float
    ) -> list[Candidate]:
        """The keyframes that a frame can be registered against, the best first.

        The one in use comes first as long as its overlap is ``enough``; then those that overlap
        more; then those of another scale, up to a factor of ``max_ratio``.
        """
        candidates = []
        for key, keyframe in self._keyframes.items():
            ratio = scale_ratio(keyframe.frame, frame)
            if ratio <= max_ratio and key in state.keys:
                shift = frame.px_from_unit @ (state.position - state.keyframe_state(key)[:2])
                common = np.clip(1.0 - np.abs(shift) / np.array(frame.size), 0.0, 1.0)
                candidates.append(Candidate(key, ratio, float(common[0] * common[1])))

        def rank(candidate: Candidate) -> tuple[bool, bool, float]:
            in_use = candidate.key == self.current
            good = candidate.overlap >= enough + (0.0 if in_use else _CHANGE_MARGIN)
            return candidate.rescaled, not (in_use and good), -candidate.overlap

        return sorted(candidates, key=rank)
