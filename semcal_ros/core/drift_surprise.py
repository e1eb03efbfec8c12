"""Which unexpected shifts to believe."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.drift_map import DriftMap
from semcal_ros.core.drift_operations import Widen

__all__ = ["Surprises"]

Array = NDArray[np.float64]


class Surprises:
    """Shifts that the filter did not expect, one after the other.

    One is believed if drift can get so far between two frames, if the unexpected shift before says
    the same, or if the two before say that the drift goes on like this.
    """

    def __init__(self) -> None:
        self._earlier: tuple[tuple[float, Array], ...] = ()

    def forget(self) -> None:
        """A frame came as expected."""
        self._earlier = ()

    def believed(self, state: DriftMap, seen: Array, reach: Array, last_s: float) -> Widen | None:
        """What makes the filter accept an unexpected drift, or None if it is not to be believed.

        Parameters
        ----------
        state
            Prediction.
        seen
            (2,) drift that was measured.
        reach
            (2, 2) how far drift gets between two frames: the largest vector is ``reach`` times a
            unit vector.
        last_s
            Time of the frame before.
        """
        earlier = self._earlier
        self._earlier = (*earlier, (state.time_s, seen))[-2:]

        def near(expected: Array) -> bool:
            return bool(np.linalg.norm(np.linalg.solve(reach, seen - expected)) <= 1.0)

        since_s = max(state.time_s - (earlier[-1][0] if earlier else last_s), 1e-9)
        covariance = np.zeros((6, 6))
        covariance[:2, :2] = np.eye(2) * float(np.sum((seen - state.position) ** 2))
        if near(state.position):
            covariance[2:4, 2:4] = covariance[:2, :2] / since_s**2
            return Widen(covariance)
        paces = [state.velocity] if earlier else []
        if len(earlier) == 2:
            paces.append((earlier[1][1] - earlier[0][1]) / (earlier[1][0] - earlier[0][0]))
        for pace in paces:
            if near(earlier[-1][1] + pace * since_s):
                turn = float(np.sum((pace - state.velocity) ** 2))
                covariance[2:4, 2:4] = reach @ reach.T / since_s**2 + np.eye(2) * turn
                return Widen(covariance)
        return None
