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

"""Where in the raw frame each pixel of a rectified one was seen, exactly.

The specimen drifts before it is projected and distorted, so an output pixel x, which is a rectified
pixel of the camera with the specimen at zero drift, is seen in the raw frame at

    raw = raw_from_rect(x + m d(t(raw))),    d(t) = d_centre + v (t - t_centre) + a (t - t_centre)^2 / 2

with the scale ``m`` of the rectified camera, in px per m, and ``t(raw)`` the time at which that raw
pixel was scanned. A specimen that also turns, or whose magnification creeps, has ``c + M(t) (x - c)``
in the place of x, with the principal point c and a matrix ``M = exp(s) R(theta)``. Aspect, skew and
distortion of the camera are all in ``raw_from_rect``
(:class:`~semcal_ros.core.camera.scan_camera.ScanCamera`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.rectification.thresholds import POSITION_CONVERGED_PX, POSITION_STEPS_MAX


@dataclass(frozen=True)
class RasterDrift:
    """Drift over one frame.

    Attributes
    ----------
    position
        (2,) drift at the centre of the acquisition: m in the sem frame, or px of the image where
        there is no camera.
    velocity
        (2,) drift velocity at that moment, the same unit per s.
    acceleration
        (2,) its rate of change, the same unit per s^2.
    similarity
        (2,) rotation (rad, from x towards y) and logarithm of the scale of the image of the specimen,
        about :func:`rotation_centre`; the position is the displacement of what lay there.
    similarity_rate
        (2,) their rates, per s.
    """

    position: Array
    velocity: Array
    acceleration: Array = field(default_factory=lambda: np.zeros(2))
    similarity: Array = field(default_factory=lambda: np.zeros(2))
    similarity_rate: Array = field(default_factory=lambda: np.zeros(2))


def similarity_matrix(similarity: Array) -> Array:
    """(2, 2) matrix ``exp(s) R(theta)`` of ``[theta, s]``; those of two of them multiply as they add."""
    angle, log_scale = similarity.tolist()
    cos, sin = np.exp(log_scale) * np.cos(angle), np.exp(log_scale) * np.sin(angle)
    return np.array([[cos, -sin], [sin, cos]])


def rotation_centre(size: tuple[int, int], camera: ScanCamera | None) -> Array:
    """(2,) rectified pixel about which a specimen turns: the origin of the sem frame, or the middle of
    the image where there is no camera.
    """
    if camera is None:
        return 0.5 * (np.array(size, dtype=np.float64) - 1.0)
    rectified = camera.rectified
    return np.array([rectified.px, rectified.py])


def raw_from_output(
    xy: Array,
    size: tuple[int, int],
    camera: ScanCamera | None,
    drift: RasterDrift | None,
    timing: ScanTiming | None,
) -> Array:
    """Raw pixels (n, 2) of rectified pixels (n, 2), exactly; NaN where the distortion has no answer.

    Parameters
    ----------
    xy
        Output pixels.
    size
        (width, height) of the raw frame.
    camera
        Camera of that size, or None for a raw frame that counts as rectified; drift is then in px.
    drift
        Drift to remove, or None.
    timing
        Raster timing; None takes the frame as an instant, so that the velocity has no effect.
    """
    if camera is None:
        return xy.copy() if drift is None else _reach(xy, size, None, drift, timing, _same, _same)
    return _reach(xy, size, camera, drift, timing, camera.raw_from_rect, _same)


def deflection_from_output(
    xy: Array,
    size: tuple[int, int],
    camera: ScanCamera,
    drift: RasterDrift | None,
    timing: ScanTiming | None,
    raw_from_deflection: Callable[[Array], Array],
) -> Array:
    """Where the beam should be for rectified pixels (n, 2), px; as :func:`raw_from_output`.

    ``raw_from_deflection`` gives the raw pixels there, at whose times the drift counts. They need not be exact.
    """
    reach = camera.deflection_from_rect
    return _reach(xy, size, camera, drift, timing, reach, raw_from_deflection)


def _same(xy: Array) -> Array:
    return xy


def _reach(
    xy: Array,
    size: tuple[int, int],
    camera: ScanCamera | None,
    drift: RasterDrift | None,
    timing: ScanTiming | None,
    reach: Callable[[Array], Array],
    raw_from_reached: Callable[[Array], Array],
) -> Array:
    """What ``reach`` makes of rectified pixels that the drift has moved until their raw pixel is scanned."""
    if drift is None:
        return reach(xy)
    shift = PixelDrift(size, camera, drift, timing)
    if shift.is_still:
        return reach(shift.moved(xy))
    # What is displaced by little is scanned at nearly the time of its output pixel.
    raw, contraction = xy, shift.contraction
    for _ in range(POSITION_STEPS_MAX):
        # A contraction as long as the drift moves by much less than a row while a row is scanned.
        reached = reach(shift.moved(xy, raw))
        new = raw_from_reached(reached)
        change_px = np.abs(new - raw)
        raw = new
        # The error that remains is smaller than the step by the same factor again.
        if not (contraction * change_px > POSITION_CONVERGED_PX).any():
            return reached
    assert timing is not None
    raise InvalidValueError(
        f"drift of {np.hypot(*shift.velocity_px_s):.3g} px/s with {timing.frame_time_s} s per pass",
        expected="a drift that is slow against the scan of a row",
        do="check the frame time and the unit of the velocity",
    )


class PixelDrift:
    """A drift in rectified pixels.

    Parameters
    ----------
    size, camera, drift, timing
        As in :func:`raw_from_output`.
    """

    def __init__(
        self,
        size: tuple[int, int],
        camera: ScanCamera | None,
        drift: RasterDrift,
        timing: ScanTiming | None,
    ) -> None:
        jacobian = np.eye(2) if camera is None else camera.rectified.ideal_from_sem_jacobian
        self._size, self._timing = size, timing
        self._position_px = jacobian @ np.asarray(drift.position, dtype=np.float64)
        self._half_acceleration_px = 0.5 * (
            jacobian @ np.asarray(drift.acceleration, dtype=np.float64)
        )
        self.velocity_px_s = jacobian @ np.asarray(drift.velocity, dtype=np.float64)
        self._is_accelerated = bool(self._half_acceleration_px.any())
        self._turns = bool(np.any(drift.similarity) or np.any(drift.similarity_rate))
        if self._turns:
            self._centre = rotation_centre(size, camera)
            self._matrix = similarity_matrix(np.asarray(drift.similarity, dtype=np.float64))
            turn, growth = np.asarray(drift.similarity_rate, dtype=np.float64).tolist()
            self._rate = np.array([[growth, -turn], [turn, growth]]) @ self._matrix

    @property
    def is_still(self) -> bool:
        """Whether the drift is the same for all pixels of a frame."""
        moves = self._is_accelerated or bool(self.velocity_px_s.any())
        turns = self._turns and bool(self._rate.any())
        return self._timing is None or not (moves or turns)

    @property
    def contraction(self) -> float:
        """By how much a step of the time towards that of the raw pixel makes its error smaller, at least; at most 1.

        Rows by which the drift at its fastest moves while a row is scanned, twice, because the distortion stretches
        what moves.
        """
        if self._timing is None:
            return 0.0
        width, height = self._size
        time_s = self._timing.acquisition_time_s
        speed = float(np.hypot(*self.velocity_px_s))
        speed += 2.0 * float(np.hypot(*self._half_acceleration_px)) * time_s
        if self._turns:
            speed += float(np.hypot(*self._rate[:, 0])) * (width + height)
        return min(2.0 * speed * self._timing.frame_time_s / height, 1.0)

    def displacement(self, raw: Array) -> Array:
        """(n, 2) by how much the drift displaces what is scanned at raw pixels (n, 2)."""
        start = raw if self._turns else np.zeros_like(raw)
        return self.moved(start, raw) - start

    def moved(self, xy: Array, raw: Array | None = None) -> Array:
        """Return rectified pixels (n, 2) moved by the drift at the times at which raw ones are scanned.

        Without raw pixels, the time is the centre of the acquisition.
        """
        at_centre = xy + self._position_px
        if self._turns:
            from_centre = xy - self._centre
            at_centre = from_centre @ self._matrix.T + (self._centre + self._position_px)
        if raw is None or self._timing is None:
            return at_centre
        width, height = self._size
        offset_s = self._timing.pixel_offset_s(raw[:, 1], raw[:, 0], height, width)
        since_s = offset_s - self._timing.centre_offset_s
        moved = at_centre + np.multiply.outer(self.velocity_px_s, since_s).T
        if self._is_accelerated:
            # The mean over the passes of the square of the time.
            square_s2 = since_s**2 + self._timing.pass_variance_s2
            moved += np.multiply.outer(self._half_acceleration_px, square_s2).T
        if self._turns:
            moved += since_s[:, None] * (from_centre @ self._rate.T)
        return moved


def camera_key(size: tuple[int, int], camera: ScanCamera | None) -> tuple[object, ...]:
    """What maps of (width, height) depend on, for looking them up."""
    if camera is None:
        return size
    field = b"" if camera.residual is None else camera.residual.coefficients.tobytes()
    raster = camera.norm_px, camera.raster.ratio
    return (*size, *raster, *camera.parameters.tolist(), field)


def drift_key(drift: RasterDrift | None, timing: ScanTiming | None) -> tuple[object, ...]:
    """What the drift adds to :func:`camera_key`."""
    if drift is None:
        return ()
    return (timing, *(float(value) for part in _parts(drift) for value in part))


def _parts(drift: RasterDrift) -> tuple[Array, ...]:
    turn = drift.similarity, drift.similarity_rate
    return drift.position, drift.velocity, drift.acceleration, *turn


def check_drift(drift: RasterDrift | None) -> None:
    """Raise :class:`InvalidValueError` where a drift is not made of finite pairs."""
    if drift is None:
        return
    values = np.concatenate([np.ravel(part) for part in _parts(drift)])
    if values.shape != (10,) or not np.all(np.isfinite(values)):
        raise InvalidValueError(
            f"drift {values.tolist()}",
            expected="two finite positions, velocities, accelerations, and numbers of a rotation each",
        )
