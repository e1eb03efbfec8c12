"""How long one pass over a frame takes, from how changing drift shears the frames.

A frame is scanned line after line, so that drift at velocity v shears it by T v between its first
and its last row, T being the time of one pass. Of frames that were tracked as instants, each tells
how much more it is sheared than its keyframe:

    shear = T (v - v_key) + B (p - p_key) + c_key + noise

with the velocities v and positions p of the smoothed drift. B is what distortion that is left in
the pictures does to a shift, (2, 2) with a prior; c_key is the noise of the keyframe's own shear,
which all frames that were compared with it share. T follows by weighted least squares where the
velocity changes; a steady drift shears all frames alike, and tells nothing.

- The smoothed velocities are expectations given all positions: their errors do not depend on them,
  and enlarge the noise without attenuating T (Berkson 1950, doi:10.1080/01621459.1950.10483349). So
  their variance enters the weights, which are iterated, but not the slope.
- Frames with little shear become part of their keyframe, whose v_key becomes that of their mean.
- Frames are taken as instants at their start, though they show their middle. That shifts the time
  of positions and velocities alike, and makes no difference.
- An exponential settling has p - p_key in proportion to v - v_key: there the prior of B limits what
  can be known of T.

How many passes are averaged, and how long the beam takes to return, shears no frame by itself and
cannot be seen: T is the time of one pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls

from semcal_ros.core.arrays import Array, Indices, invert_scaled
from semcal_ros.core.drift.estimates import DriftPath, DriftUpdate
from semcal_ros.core.drift.keyframe_store import MEANS_PREPARED
from semcal_ros.core.errors import InvalidValueError

__all__ = ["LEFT_IN", "REMOVED", "FrameTimeEstimate", "estimate_frame_time"]


#: Shear per shift, 1-sigma, where distortion is left in the pictures, and where a calibration
#: removed it.
LEFT_IN, REMOVED = 0.01, 0.001

_FEWEST_FRAMES = 6
_LEAST_RATIO = 5.0
_LARGEST_CHI2 = 6.0
_BEYOND = 3.0
# What a registration's model does not know of a shear, and what is not known of which frames are in
# a keyframe's mean, px. A registration goes to the shear in one linear step, which is wrong by some
# percent, depending on what is seen: in one frame, and in all frames of the same place.
_FLOOR_PX = 0.005
_KEYFRAME_FLOOR_PX = 0.01
_SCALE_FLOOR = 0.03
_COMMON_SCALE_FLOOR = 0.04
# Normalised residuals of two components beyond this weigh less (1 in 20 good ones).
_HUBER = 2.45
_MEDIAN_CHI2 = 2.0 * float(np.log(2.0))
_ITERATIONS = 50
_SETTLED = 1e-3
_BLOCK = 5
# Of T, 1 / s^2.
_LEAST_INFORMATION = 1e-12


@dataclass(frozen=True)
class FrameTimeEstimate:
    """Time of one pass.

    Attributes
    ----------
    frame_time_s
        The estimate, s; NaN where there were too few frames. Never above the median interval of the
        frames where it is ``observable``.
    sigma_s
        Its 1-sigma, enlarged where the frames scatter more than they should.
    frames
        Number of frames that it rests on.
    chi2_per_dof
        Robust mean square of the normalised residuals; near 1 where all is as stated.
    converged
        Whether the iterated weights settled.
    observable
        Whether the estimate can be relied on.
    reason
        Why not; empty where it can.
    """

    frame_time_s: float
    sigma_s: float
    frames: int
    chi2_per_dof: float
    converged: bool
    observable: bool
    reason: str


def estimate_frame_time(
    path: DriftPath, updates: Sequence[DriftUpdate], *, shear_of_shift: float = LEFT_IN
) -> FrameTimeEstimate:
    """Time of one pass from frames that were tracked as instants (without a ``ScanTiming``).

    Parameters
    ----------
    path
        Smoothed drift of n frames.
    updates
        The n updates of the tracker, in the same order.
    shear_of_shift
        Prior 1-sigma of each element of B: shear in px per px of shift.

    Raises
    ------
    InvalidValueError
        If path and updates are not of the same number of frames, or the prior is not positive.
    """
    if len(path) != len(updates):
        raise InvalidValueError(
            f"a path of {len(path)} frames and {len(updates)} updates", expected="as many of both"
        )
    if not (np.isfinite(shear_of_shift) and shear_of_shift > 0.0):
        raise InvalidValueError(f"shear_of_shift = {shear_of_shift}", expected="a number > 0")
    seen = _seen(path, updates)
    if len(seen.shear) < _FEWEST_FRAMES:
        few = f"{len(seen.shear)} frames with a shear against an earlier one"
        return FrameTimeEstimate(np.nan, np.inf, len(seen.shear), np.nan, False, False, few)
    steps = np.diff(path.time_s)
    forward = steps[steps > 0.0]
    interval_s = float(np.median(forward)) if forward.size else float("inf")
    fit = _fitted(seen, shear_of_shift, interval_s)
    return _judged(fit, len(seen.shear), interval_s)


# -- what was seen --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Seen:
    """n frames: their ``shear`` (n, 2) px, the change of ``velocity`` (n, 2) px/s and ``position``
    (n, 2) px against the keyframe, covariances (n, 2, 2) of the frame alone and of the keyframe
    alone (of the shear in px^2, of the velocity in px^2/s^2), and the number of the ``group``
    (n,) that shares a keyframe.
    """

    shear: Array
    velocity: Array
    position: Array
    own: Array
    own_velocity: Array
    key: Array
    key_velocity: Array
    group: Indices


@dataclass
class _Mean:
    """A keyframe while frames are added to it."""

    index: int
    number: int
    velocities: list[Array]

    def used(self) -> tuple[int, Array]:
        """How many frames are in the reference, and their mean velocity."""
        count = max(n for n in (1, *MEANS_PREPARED) if n <= len(self.velocities))
        return count, np.asarray(np.mean(self.velocities[:count], axis=0))


def _seen(path: DriftPath, updates: Sequence[DriftUpdate]) -> _Seen:
    at: dict[float, int] = {}
    means: dict[int, _Mean] = {}
    rows = []
    for k, update in enumerate(updates):
        index = at.get(update.keyframe_time_s)
        at[float(path.time_s[k])] = k
        if index is None or not _usable(update):
            continue
        mean = means.setdefault(index, _Mean(index, len(means), [path.velocity_m_s[index]]))
        rows.append(_row(path, k, update, mean))
        if update.joined:
            mean.velocities.append(path.velocity_m_s[k])
    columns = list(zip(*rows, strict=True)) if rows else [()] * 8
    seen = _Seen(*(np.array(column) for column in columns))
    return _evened(seen) if rows else seen


def _evened(seen: _Seen) -> _Seen:
    """Without the part of the noise that is stated to grow with the shear.

    Where shear is left in the residuals that the noise is estimated from, frames that happen to
    show less of it would weigh more, and T would come out too small.
    """
    stated = np.maximum(np.trace(seen.own + seen.key, axis1=1, axis2=2), _FLOOR_PX**2)
    columns = np.stack([np.ones(len(stated)), np.sum(seen.shear**2, axis=1)], axis=1)
    (least, slope), _ = nnls(columns / stated[:, None], np.ones(len(stated)))
    share = np.ones(len(stated))
    if least > 0.0:
        share = least / (columns @ [least, slope])
    own = seen.own * share[:, None, None] + np.eye(2) * _FLOOR_PX**2
    key = seen.key * share[:, None, None] + np.eye(2) * _KEYFRAME_FLOOR_PX**2
    return replace(seen, own=own, key=key)


def _usable(update: DriftUpdate) -> bool:
    finite = np.all(np.isfinite(update.shear_px)) and np.all(np.isfinite(update.shear_covariance))
    return bool(update.accepted and finite)


def _row(path: DriftPath, k: int, update: DriftUpdate, mean: _Mean) -> tuple[Array | int, ...]:
    unit = update.px_from_unit
    count, velocity = mean.used()
    noise = update.shear_covariance
    spread = [unit @ path.covariance[i][2:, 2:] @ unit.T for i in (k, mean.index)]
    return (
        update.shear_px,
        unit @ (path.velocity_m_s[k] - velocity),
        unit @ (path.drift_m[k] - path.drift_m[mean.index]),
        noise * (count / (count + 1.0)),
        spread[0],
        noise / (count + 1.0),
        spread[1] / count,
        mean.number,
    )


# -- least squares --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Fit:
    """T and its 1-sigma, s; the robust mean square of the residuals; whether the weights settled."""

    time_s: float
    sigma_s: float
    chi2: float
    converged: bool


def _fitted(seen: _Seen, shear_of_shift: float, interval_s: float) -> _Fit:
    """T and B with weights that know T and which frames to believe less."""
    design = np.zeros((len(seen.shear), 2, 5))
    design[:, :, 0] = seen.velocity
    design[:, 0, 1:3] = design[:, 1, 3:5] = seen.position
    groups = [np.flatnonzero(seen.group == g) for g in range(int(seen.group.max()) + 1)]
    time_s, belief, converged = 0.0, np.ones(len(seen.shear)), False
    for step in range(_ITERATIONS):
        # No longer than it can be: a velocity that does not change would let T run away.
        known_s = float(np.clip(time_s, 0.0, interval_s))
        solved = _solved(seen, design, groups, known_s, belief, shear_of_shift)
        before, time_s = time_s, float(solved.mean[0])
        chi2 = float(np.median(solved.squares)) / _MEDIAN_CHI2
        sigma = float(np.sqrt(solved.covariance[0, 0]))
        normal = np.sqrt(solved.squares / max(chi2, 1.0))
        belief = np.minimum(1.0, _HUBER / np.maximum(normal, 1e-9))
        if step > 1 and abs(time_s - before) < _SETTLED * sigma:
            converged = True
            break
    sigma = max(sigma * float(np.sqrt(max(chi2, 1.0))), solved.block_sigma)
    sigma = float(np.hypot(sigma, _COMMON_SCALE_FLOOR * time_s))
    return _Fit(time_s, sigma, chi2, converged)


@dataclass(frozen=True)
class _Solved:
    """``mean`` (5,) of T and B, row by row, and its ``covariance``; normalised ``squares`` (n,) of
    the residuals; 1-sigma of T from their scatter in blocks of frames.
    """

    mean: Array
    covariance: Array
    squares: Array
    block_sigma: float


def _solved(
    seen: _Seen,
    design: Array,
    groups: Sequence[Indices],
    time_s: float,
    belief: Array,
    shear_of_shift: float,
) -> _Solved:
    """One weighted fit; what the frames of a keyframe share is eliminated group by group."""
    expected = (_SCALE_FLOOR * time_s) ** 2 * np.sum(seen.velocity**2, axis=1)
    own = seen.own + time_s**2 * seen.own_velocity + expected[:, None, None] * np.eye(2)
    weight = np.linalg.inv(own) * belief[:, None, None]
    # Where the velocity does not change at all, T stays open.
    normal = np.diag([_LEAST_INFORMATION] + [shear_of_shift**-2] * 4)
    right = np.zeros(5)
    parts = []
    for members in groups:
        a, w, y = design[members], weight[members], seen.shear[members]
        shared = np.mean(seen.key[members] + time_s**2 * seen.key_velocity[members], axis=0)
        inner = np.linalg.inv(w.sum(axis=0) + np.linalg.inv(shared))
        wa, wy = w @ a, np.einsum("nij,nj->ni", w, y)
        normal += np.einsum("nij,nik->jk", a, wa) - wa.sum(0).T @ inner @ wa.sum(0)
        right += np.einsum("nij,ni->j", a, wy) - wa.sum(0).T @ inner @ wy.sum(0)
        parts.append((members, inner, w, wa))
    covariance = invert_scaled(normal)
    mean = covariance @ right
    left = seen.shear - design @ mean
    scores, squares = np.zeros((len(left), 5)), np.zeros(len(left))
    for members, inner, w, wa in parts:
        rest = left[members] - inner @ np.einsum("nij,nj->i", w, left[members])
        squares[members] = np.einsum("ni,nij,nj->n", rest, w, rest) / belief[members]
        scores[members] = np.einsum("nij,ni->nj", wa, rest)
    # Errors of smoothed velocities last for some frames; they show where neighbours agree.
    blocks = np.add.reduceat(scores, np.arange(0, len(scores), _BLOCK), axis=0) @ covariance[0]
    return _Solved(mean, covariance, squares, float(np.sqrt(np.sum(blocks**2))))


def _judged(fit: _Fit, frames: int, interval_s: float) -> FrameTimeEstimate:
    """Whether the estimate can be relied on."""
    found, sigma = fit.time_s, fit.sigma_s
    reason = ""
    if not fit.converged:
        reason = f"the weights did not settle in {_ITERATIONS} steps"
    elif not abs(found) > _LEAST_RATIO * sigma:
        reason = f"{found:.3g} +- {sigma:.2g} s: the velocity of the drift changes too little"
    elif found < 0.0:
        reason = f"{found:.3g} +- {sigma:.2g} s is negative: something else shears the frames"
    elif found - _BEYOND * sigma > interval_s:
        reason = (
            f"{found:.3g} +- {sigma:.2g} s is longer than the {interval_s:.3g} s between frames"
        )
    elif fit.chi2 > _LARGEST_CHI2:
        reason = f"the frames scatter {np.sqrt(fit.chi2):.1f} times as much as they should"
    if not reason:
        found = min(found, interval_s)
    return FrameTimeEstimate(found, sigma, frames, fit.chi2, fit.converged, not reason, reason)
