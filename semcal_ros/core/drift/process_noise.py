"""How a drift changes by itself.

Between frames the acceleration is random and fades with a time constant (Singer 1970,
doi:10.1109/TAES.1970.310128); with none it is white, and the drift has a constant velocity but for
that (Bar-Shalom, Li and Kirubarajan 2001, section 6.2.2, doi:10.1002/0471221279).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array

__all__ = ["ProcessNoise"]


# Gauss-Legendre quadrature, and up to how many memories it is used.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)
_MEMORIES = 4.0
# Of a time: where the quadrature looks, and all of it.
_PARTS = np.append(0.5 * (_NODES + 1.0), 1.0)


@dataclass(frozen=True)
class ProcessNoise:
    """How the drift changes by itself.

    Attributes
    ----------
    psd
        Power spectral density of the acceleration at low frequencies, length^2 / s^3.
    memory_s
        Time in which an acceleration fades; 0 for a white one.
    """

    psd: float
    memory_s: float = 0.0

    @property
    def acceleration_variance(self) -> float:
        """Of each component in the long run; 0 for a white one, whose variance says nothing."""
        return 0.5 * self.psd / self.memory_s if self.memory_s > 0.0 else 0.0

    def within(self, scan_s: float) -> Array:
        """(4, 4) covariance of the mean drift and the mean velocity over an acquisition, given drift,
        velocity and acceleration at its middle.

        A white acceleration of density q gives ``q A^3 / 320`` and ``q A / 12`` over A seconds; of
        one that lasts longer, the state knows a part.
        """
        unknown = self.psd
        if self.memory_s > 0.0:
            unknown *= min(1.0, 0.5 * scan_s / self.memory_s)
        return np.diag(np.repeat([unknown * scan_s**3 / 320.0, unknown * scan_s / 12.0], 2))

    def over(self, dt_s: float) -> tuple[Array, Array]:
        """(3, 3) transition of ``[x, v, a]`` of one axis over an interval, and its noise."""
        if not self.memory_s > 0.0:
            move = np.array([[1.0, dt_s, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
            noise = np.zeros((3, 3))
            noise[0, :2] = dt_s**3 / 3.0, dt_s**2 / 2.0
            noise[1, :2] = dt_s**2 / 2.0, dt_s
            return move, noise * self.psd
        rate = 1.0 / self.memory_s
        # Over many memories by doubling: the quadrature is exact to rounding for few.
        doublings = max(0, int(np.ceil(np.log2(max(dt_s * rate, 1e-300) / _MEMORIES))))
        part_s = dt_s / 2.0**doublings
        # What is left of an acceleration, and what it has done to velocity and drift, after a time.
        effects = _of_acceleration(part_s * _PARTS, rate)
        move = np.eye(3)
        move[:, 2] = effects[:, -1]
        move[0, 1] = part_s
        # The noise that enters with some time left acts for that time.
        acted = effects[:, :-1]
        noise = (acted * (0.5 * part_s * _WEIGHTS)) @ acted.T
        for _ in range(doublings):
            noise = move @ noise @ move.T + noise
            move = move @ move
        return move, (noise + noise.T) * (0.5 * self.psd * rate**2)


def _of_acceleration(time_s: Array, rate: float) -> Array:
    """(3, n) drift, velocity and acceleration that an acceleration of 1 has become, which fades at
    a rate.
    """
    decay = np.expm1(-rate * time_s)
    drift = np.where(
        rate * time_s > 1e-3,
        (time_s + decay / rate) / rate,
        0.5 * time_s**2 * (1.0 - rate * time_s / 3.0 + (rate * time_s) ** 2 / 12.0),
    )
    return np.asarray(np.stack([drift, -decay / rate, 1.0 + decay]))
