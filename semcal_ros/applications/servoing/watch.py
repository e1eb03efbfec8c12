"""Does the picture follow the stage?"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["FollowWatch"]

Array = NDArray[np.float64]

# Commanded way after which it is judged: well above what drift and noise move meanwhile.
_JUDGED_PX = 36.0
# Part of the commanded way that must be seen, at least and at most.
_LEAST, _MOST = 0.3, 3.0


class FollowWatch:
    """Adds up commanded and seen ways, and says when they have nothing to do with each other.

    A stage that does not move, one whose axes are others than assumed, or a picture that is held still while the
    stage moves would be driven on for ever, and with a wrong sign ever faster.
    """

    def __init__(self) -> None:
        self._path = self._along = self._squared = 0.0

    def update(self, commanded_px: Array, seen_px: Array) -> str:
        """What is wrong, or an empty text.

        Parameters
        ----------
        commanded_px, seen_px
            (2,) way of the target between two frames as commanded and as seen, px.
        """
        self._path += float(np.hypot(commanded_px[0], commanded_px[1]))
        self._along += float(commanded_px @ seen_px)
        self._squared += float(commanded_px @ commanded_px)
        if self._path < _JUDGED_PX:
            return ""
        share = self._along / self._squared
        self._path = self._along = self._squared = 0.0
        if _LEAST <= share <= _MOST:
            return ""
        return (
            f"the picture does not follow the stage: it moved by {share:.2f} of the commanded way; check axes, topic"
            " and that the drift of each frame is added again"
        )
