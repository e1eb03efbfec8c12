"""The keyframes that were seen so far, and which of them to look at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semcal_ros.core.drift.frame import ScanFrame
from semcal_ros.core.drift.keyframe import Keyframe, carried, scale_ratio
from semcal_ros.core.drift.state import DriftState
from semcal_ros.core.registration.reference import Reference, RegistrationSettings

__all__ = ["MEANS_PREPARED", "SAME_SCALE", "Candidate", "KeyframeStore"]


#: Ratio of two scales below which pictures need no resampling: 0.05 px at the edge of 1024 px.
SAME_SCALE = 1.0001
# How much more an old keyframe must overlap than what is asked of the one in use.
_WORTH_A_CHANGE = 0.05
# Frames are added to a mean where most of it is seen and the mean's noise still matters.
_OVERLAP_TO_ADD = 0.75
#: Numbers of frames in a mean at which it is used anew.
MEANS_PREPARED = (2, 4, 8, 16, 32)


@dataclass(frozen=True)
class Candidate:
    """A keyframe to register a frame against.

    Attributes
    ----------
    key
        Its number.
    ratio
        By which factor its scale differs from the frame's, at least 1.
    overlap
        Expected part of the frame that it shows.
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
        Of the registrations.
    at_most_bytes, at_most
        Memory and number of the pictures that are kept; the first one is never forgotten.
    """

    def __init__(self, settings: RegistrationSettings, at_most_bytes: int, at_most: int) -> None:
        self._settings = settings
        self._limits = at_most_bytes, at_most
        self._frames: dict[int, Keyframe] = {}
        self._prepared: tuple[int, Keyframe, Reference] | None = None
        self._carried: tuple[Keyframe, ScanFrame, Reference] | None = None
        self._first: int | None = None
        self._next = 0
        self.current: int | None = None

    def __getitem__(self, key: int) -> Keyframe:
        return self._frames[key]

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, keyframe: Keyframe, reference: Reference | None = None) -> tuple[int, list[int]]:
        """Its number, by which it is the one in use, and those that were forgotten for it.

        ``reference`` is its prepared reference, where that is known already.
        """
        number = self._next
        self._next += 1
        self._first = number if self._first is None else self._first
        self._frames[number] = keyframe
        self.current = number
        if reference is not None:
            self._prepared = number, keyframe, reference
        return number, self._forgotten()

    def _forgotten(self) -> list[int]:
        gone = []
        while len(self._frames) > 2 and (
            len(self._frames) > self._limits[1]
            or sum(k.nbytes for k in self._frames.values()) > self._limits[0]
        ):
            # The order is that of the last use.
            oldest = next(k for k in self._frames if k not in (self._first, self.current))
            del self._frames[oldest]
            gone.append(oldest)
        return gone

    def forget(self, key: int) -> None:
        """Drop a keyframe."""
        del self._frames[key]
        if self._first == key:
            self._first = next(iter(self._frames), None)

    def use(self, key: int) -> None:
        """Make it the one in use."""
        self.current = key
        self._frames[key] = self._frames.pop(key)

    def replace(self, key: int, keyframe: Keyframe) -> None:
        """Another picture under the same number."""
        self._frames[key] = keyframe

    def reference(self, key: int) -> Reference:
        """The prepared reference; it is kept until another one is asked for, or until the mean has
        become much better.
        """
        keyframe = self._frames[key]
        known = self._prepared
        if known is None or known[0] != key or self._improved(known[1], keyframe):
            known = key, keyframe, keyframe.reference(self._settings)
            self._prepared = known
        return known[2]

    def _improved(self, before: Keyframe, now: Keyframe) -> bool:
        if before.shot is not now.shot or not np.array_equal(before.removed, now.removed):
            return True
        return now.averaged in MEANS_PREPARED and now.averaged > before.averaged

    def averaged(self, key: int) -> int:
        """Number of frames in the prepared reference."""
        if self._prepared is not None and self._prepared[0] == key:
            return self._prepared[1].averaged
        return self._frames[key].averaged

    def wants(self, key: int, overlap: float) -> bool:
        """Whether a frame would make the keyframe's mean better."""
        return self._frames[key].averaged < MEANS_PREPARED[-1] and overlap >= _OVERLAP_TO_ADD

    def carried(self, key: int, shot: ScanFrame) -> Reference:
        """The reference as the camera of a frame would show it; the latest one is kept, because a
        frame may be looked at several times.
        """
        keyframe, known = self._frames[key], self._carried
        if known is None or known[0] is not keyframe or known[1] is not shot:
            known = keyframe, shot, carried(keyframe, shot).reference(self._settings)
            self._carried = known
        return known[2]

    def least_ratio(self, shot: ScanFrame) -> float:
        """By which factor the scale of a frame differs from that of the most similar keyframe."""
        return min(scale_ratio(k.shot, shot) for k in self._frames.values())

    def candidates(
        self, state: DriftState, shot: ScanFrame, enough: float, max_ratio: float
    ) -> list[Candidate]:
        """What a frame can be registered against, the best first.

        The one in use comes first as long as its overlap is ``enough``; then one that overlaps
        more; then one of another scale.
        """
        found = []
        for key, keyframe in self._frames.items():
            ratio = scale_ratio(keyframe.shot, shot)
            if ratio <= max_ratio and key in state.keys:
                shift = shot.px_from_unit @ (state.position - state.where(key)[:2])
                left = np.clip(1.0 - np.abs(shift) / np.array(shot.size), 0.0, 1.0)
                found.append(Candidate(key, ratio, float(left[0] * left[1])))

        def rank(candidate: Candidate) -> tuple[bool, bool, float]:
            here = candidate.key == self.current
            good = candidate.overlap >= enough + (0.0 if here else _WORTH_A_CHANGE)
            return candidate.rescaled, not (here and good), -candidate.overlap

        return sorted(found, key=rank)
