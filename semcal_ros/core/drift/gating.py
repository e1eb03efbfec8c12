"""Which unexpected shifts to believe, and when not to believe the prediction."""

from __future__ import annotations

import numpy as np

from semcal_ros.core.arrays import Array, solve_scaled
from semcal_ros.core.drift.operations import Inflate
from semcal_ros.core.drift.state import DriftState

__all__ = ["GATE", "OutlierTest", "of_a_contradiction", "of_a_pause", "of_another_place"]


#: Innovations beyond this normalised square happen to a correct filter once in a million frames.
GATE = 27.6


class OutlierTest:
    """Shifts that the filter did not expect, one after the other.

    One is believed if drift can get so far between two frames, if the unexpected shift before says
    the same, or if what was seen before, the last expected drift included, says that the drift goes
    on like this.
    """

    def __init__(self) -> None:
        self._expected: tuple[float, Array] | None = None
        self._earlier: tuple[tuple[float, Array], ...] = ()

    def forget(self, state: DriftState | None = None) -> None:
        """A frame came as expected, with that state; None where nothing is known any more."""
        self._earlier = ()
        self._expected = None if state is None else (state.time_s, state.position)

    @property
    def latest(self) -> Array | None:
        """(2,) the drift that was seen last and not believed."""
        return self._earlier[-1][1] if self._earlier else None

    def believed(
        self, state: DriftState, seen: Array, reach: Array, last_s: float
    ) -> Inflate | None:
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
        # The same frame may be compared with several keyframes.
        earlier = tuple(e for e in self._earlier if e[0] < state.time_s)
        self._earlier = (*earlier, (state.time_s, seen))[-2:]

        def near(expected: Array) -> bool:
            return bool(np.linalg.norm(np.linalg.solve(reach, seen - expected)) <= 1.0)

        since_s = max(state.time_s - (earlier[-1][0] if earlier else last_s), 1e-9)
        covariance = np.zeros((6, 6))
        covariance[:2, :2] = np.eye(2) * float(np.sum((seen - state.position) ** 2))
        if near(state.position):
            covariance[2:4, 2:4] = covariance[:2, :2] / since_s**2
            return Inflate(covariance)
        paces = [state.velocity] if earlier else []
        known = [self._expected, *earlier] if self._expected is not None else list(earlier)
        if len(known) >= 2 and earlier:
            before, latest = known[-2], known[-1]
            paces.append((latest[1] - before[1]) / max(latest[0] - before[0], 1e-9))
        for pace in paces:
            if near(earlier[-1][1] + pace * since_s):
                turn = float(np.sum((pace - state.velocity) ** 2))
                covariance[2:4, 2:4] = reach @ reach.T / since_s**2 + np.eye(2) * turn
                return Inflate(covariance)
        return None


def _spread(position: Array, velocity: Array) -> Inflate:
    """Widened by a (2, 2) covariance of the drift and one of its velocity."""
    covariance = np.zeros((6, 6))
    covariance[:2, :2], covariance[2:4, 2:4] = position, velocity
    return Inflate(covariance)


def of_a_pause(speed: float, pause_s: float) -> Inflate:
    """After a long time without a frame: the drift may have stopped, or doubled."""
    way = np.eye(2) * (speed * pause_s) ** 2
    return _spread(way, way / pause_s**2)


def of_another_place(px_from_unit: Array, reach_px: float, pace_px: float) -> Inflate:
    """After many frames that did not match: it may be another place.

    ``reach_px`` is how far away it may be, ``pace_px`` how fast it may drift (px per s).
    """
    unit = np.linalg.inv(px_from_unit)
    square = np.asarray(unit @ unit.T, dtype=np.float64)
    return _spread(square * reach_px**2, square * pace_px**2)


def of_a_contradiction(
    state: DriftState, key: int | None, nearest: Array, since_s: float
) -> Inflate | None:
    """Where all shifts that a picture allows are far from the prediction; None where one is not.

    ``nearest`` (2,) is the nearest one against keyframe ``key``, NaN where nothing is known;
    ``since_s`` the time since the frame before.
    """
    if key not in state.keys or not np.all(np.isfinite(nearest)):
        return None
    expected, covariance = state.shift_from(key)
    away = nearest - expected
    if float(away @ solve_scaled(covariance, away, damping=1e-9)) <= GATE:
        return None
    spread = np.eye(2) * float(away @ away)
    return _spread(spread, spread / since_s**2)
