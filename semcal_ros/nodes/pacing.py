"""Where a replay is in its recording."""

from __future__ import annotations

__all__ = ["Pacer"]


class Pacer:
    """Position in a recording that advances with a wall clock, which is an argument.

    Parameters
    ----------
    rate
        Seconds of recording per second.
    paused
        Whether it stands still at first.
    """

    def __init__(self, rate: float = 1.0, *, paused: bool = False) -> None:
        self.rate = rate
        self.paused = paused
        self.position_ns = 0
        self._wall_s: float | None = None

    def seek(self, position_ns: int) -> None:
        """Go to a position, ns."""
        self.position_ns = position_ns
        self._wall_s = None

    def advance(self, wall_s: float) -> int:
        """Position at a wall time that does not go back, ns."""
        if self._wall_s is not None and not self.paused:
            self.position_ns += round((wall_s - self._wall_s) * self.rate * 1e9)
        self._wall_s = wall_s
        return self.position_ns

    def wait_s(self, target_ns: int, at_most_s: float) -> float:
        """Seconds of wall time until a position is reached, limited; the limit itself while paused."""
        if self.paused:
            return at_most_s
        return min(max(target_ns - self.position_ns, 0) * 1e-9 / self.rate, at_most_s)
