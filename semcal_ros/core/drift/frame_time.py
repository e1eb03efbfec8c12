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

"""How long one pass over a frame takes, from how changing drift shears the frames.

A frame is scanned line after line, so that drift at velocity v shears it by T v between its first
and its last row, T being the time of one pass. Each frame that was tracked as an instant shows how
much more it is sheared than its keyframe:

    shear = T (v - v_key) + B (p - p_key) + c_key + noise

with the velocities v and positions p of the smoothed drift. B is the shear that a shift causes in
images whose distortion was not removed, (2, 2) with a prior; c_key is the noise of the keyframe's
own shear, which all frames that were compared with it share. T follows by weighted least squares where the
velocity changes; a steady drift shears all frames alike and tells nothing.

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

from semcal_ros.core.arrays import MEDIAN_CHI2_2, Array, Indices, invert_scaled
from semcal_ros.core.drift.estimates import DriftPath, DriftUpdate
from semcal_ros.core.drift.thresholds import (
    BEYOND_SIGMAS,
    COMMON_SHEAR_SCALE_FLOOR,
    CONVERGED_SIGMAS,
    FRAME_SHEAR_FLOOR_PX,
    HUBER_SIGMAS,
    INFORMATION_MIN,
    KEYFRAME_SHEAR_FLOOR_PX,
    MEAN_COUNTS,
    REWEIGHTED_MAX,
    SCORED_FRAMES,
    SHEAR_OF_SHIFT_DISTORTED,
    SHEAR_SCALE_FLOOR,
    TIME_SIGMAS_MIN,
    TIMED_CHI2_MAX,
    TIMED_FRAMES_MIN,
)
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.robust_losses import huber_weight
from semcal_ros.core.wording import counted


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
        Whether the iterated weights converged.
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
    path: DriftPath, *, shear_of_shift: float = SHEAR_OF_SHIFT_DISTORTED
) -> FrameTimeEstimate:
    """Time of one pass from frames that were tracked as instants (without a ``ScanTiming``).

    Parameters
    ----------
    path
        Smoothed drift of the frames.
    shear_of_shift
        Prior 1-sigma of each element of B: shear in px per px of shift.

    Raises
    ------
    InvalidValueError
        If the prior is not positive.
    """
    if not (np.isfinite(shear_of_shift) and shear_of_shift > 0.0):
        raise InvalidValueError(f"shear_of_shift = {shear_of_shift}", expected="a number > 0")
    observed = _collect_observations(path)
    count = len(observed.shear)
    if count < TIMED_FRAMES_MIN:
        few = f"{counted(count, 'frame')} with a shear against an earlier one"
        return FrameTimeEstimate(np.nan, np.inf, count, np.nan, False, False, few)
    steps = np.diff(path.time_s)
    forward = steps[steps > 0.0]
    interval_s = float(np.median(forward)) if forward.size else float("inf")
    fit = _fit_robustly(observed, shear_of_shift, interval_s)
    return _assess(fit, count, interval_s)


# -- observations ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Observations:
    """The shears of n frames against their keyframes.

    Attributes
    ----------
    shear
        (n, 2) px.
    velocity, position
        (n, 2) change against the keyframe, px/s and px.
    own, own_velocity
        (n, 2, 2) covariances of shear and velocity of the frame alone, px^2 and px^2/s^2.
    key, key_velocity
        (n, 2, 2) those of the keyframe alone.
    group
        (n,) number that frames with the same keyframe share.
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
class _KeyframeMean:
    """A keyframe while frames are added to its mean."""

    index: int
    group: int
    velocities: list[Array]

    def mean_velocity(self) -> tuple[int, Array]:
        """Number of frames in the reference, and their mean velocity."""
        count = max(n for n in (1, *MEAN_COUNTS) if n <= len(self.velocities))
        return count, np.asarray(np.mean(self.velocities[:count], axis=0))


def _collect_observations(path: DriftPath) -> _Observations:
    index_at: dict[float, int] = {}
    means: dict[int, _KeyframeMean] = {}
    rows = []
    for k, update in enumerate(path.updates):
        index = index_at.get(update.keyframe_time_s)
        index_at[update.time_s] = k
        if index is None or not _has_shear(update):
            continue
        if not (_knows_velocity(update) and _knows_velocity(path[index])):
            # A frame before which tracking began anew, and after which nothing was measured.
            continue
        mean = means.setdefault(index, _KeyframeMean(index, len(means), [path[index].velocity_m_s]))
        rows.append(_observe(path, update, mean))
        if update.merged:
            mean.velocities.append(update.velocity_m_s)
    columns = list(zip(*rows, strict=True)) if rows else [()] * 8
    observed = _Observations(*(np.array(column) for column in columns))
    return _flatten_noise(observed) if rows else observed


def _flatten_noise(observed: _Observations) -> _Observations:
    """Take out the part of the noise that is stated to grow with the shear.

    Where shear is left in the residuals that the noise is estimated from, frames that happen to
    show less of it would weigh more, and T would come out too small.
    """
    traces = np.trace(observed.own + observed.key, axis1=1, axis2=2)
    stated = np.maximum(traces, FRAME_SHEAR_FLOOR_PX**2)
    columns = np.stack([np.ones(len(stated)), np.sum(observed.shear**2, axis=1)], axis=1)
    (least, slope), _ = nnls(columns / stated[:, None], np.ones(len(stated)))
    share = np.ones(len(stated))
    if least > 0.0:
        share = least / (columns @ [least, slope])
    own = observed.own * share[:, None, None] + np.eye(2) * FRAME_SHEAR_FLOOR_PX**2
    key = observed.key * share[:, None, None] + np.eye(2) * KEYFRAME_SHEAR_FLOOR_PX**2
    return replace(observed, own=own, key=key)


def _has_shear(update: DriftUpdate) -> bool:
    finite = np.all(np.isfinite(update.shear_px)) and np.all(np.isfinite(update.shear_covariance))
    return bool(update.accepted and finite)


def _knows_velocity(update: DriftUpdate) -> bool:
    return bool(np.all(np.isfinite(update.covariance[2:, 2:])))


def _observe(path: DriftPath, update: DriftUpdate, mean: _KeyframeMean) -> tuple[Array | int, ...]:
    """One row of the columns of :class:`_Observations`."""
    unit = update.px_from_unit
    keyframe = path[mean.index]
    count, velocity = mean.mean_velocity()
    noise = update.shear_covariance
    spread, key_spread = (unit @ u.covariance[2:, 2:] @ unit.T for u in (update, keyframe))
    return (
        update.shear_px,
        unit @ (update.velocity_m_s - velocity),
        unit @ (update.drift_m - keyframe.drift_m),
        noise * (count / (count + 1.0)),
        spread,
        noise / (count + 1.0),
        key_spread / count,
        mean.group,
    )


# -- least squares --------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Fit:
    """T and its 1-sigma, s; the robust mean square of the residuals; whether the weights converged."""

    time_s: float
    sigma_s: float
    chi2: float
    converged: bool


def _fit_robustly(observed: _Observations, shear_of_shift: float, interval_s: float) -> _Fit:
    """T and B by iterated weights, which depend on T and on how well each frame fits."""
    design = np.zeros((len(observed.shear), 2, 5))
    design[:, :, 0] = observed.velocity
    design[:, 0, 1:3] = design[:, 1, 3:5] = observed.position
    groups = [np.flatnonzero(observed.group == g) for g in range(int(observed.group.max()) + 1)]
    time_s, trust, converged = 0.0, np.ones(len(observed.shear)), False
    for step in range(REWEIGHTED_MAX):
        # At most the interval: where the velocity does not change, T would grow without bound.
        limited_s = float(np.clip(time_s, 0.0, interval_s))
        solution = _solve(observed, design, groups, limited_s, trust, shear_of_shift)
        before, time_s = time_s, float(solution.mean[0])
        chi2 = float(np.median(solution.squares)) / MEDIAN_CHI2_2
        sigma = float(np.sqrt(solution.covariance[0, 0]))
        normal = np.sqrt(solution.squares / max(chi2, 1.0))
        trust = huber_weight(normal, HUBER_SIGMAS)
        if step > 1 and abs(time_s - before) < CONVERGED_SIGMAS * sigma:
            converged = True
            break
    sigma = max(sigma * float(np.sqrt(max(chi2, 1.0))), solution.block_sigma)
    sigma = float(np.hypot(sigma, COMMON_SHEAR_SCALE_FLOOR * time_s))
    return _Fit(time_s, sigma, chi2, converged)


@dataclass(frozen=True)
class _Solution:
    """``mean`` (5,) of T and B, row by row, and its ``covariance``; normalised ``squares`` (n,) of
    the residuals; 1-sigma of T from their scatter in blocks of frames.
    """

    mean: Array
    covariance: Array
    squares: Array
    block_sigma: float


def _solve(
    observed: _Observations,
    design: Array,
    groups: Sequence[Indices],
    time_s: float,
    trust: Array,
    shear_of_shift: float,
) -> _Solution:
    """One weighted fit, in which the noise that frames with the same keyframe share is eliminated."""
    expected = (SHEAR_SCALE_FLOOR * time_s) ** 2 * np.sum(observed.velocity**2, axis=1)
    own = observed.own + time_s**2 * observed.own_velocity + expected[:, None, None] * np.eye(2)
    weight = np.linalg.inv(own) * trust[:, None, None]
    normal = np.diag([INFORMATION_MIN] + [shear_of_shift**-2] * 4)
    right = np.zeros(5)
    parts = []
    for members in groups:
        a, w, y = design[members], weight[members], observed.shear[members]
        shared = np.mean(observed.key[members] + time_s**2 * observed.key_velocity[members], axis=0)
        inner = np.linalg.inv(w.sum(axis=0) + np.linalg.inv(shared))
        wa, wy = w @ a, np.einsum("nij,nj->ni", w, y)
        normal += np.einsum("nij,nik->jk", a, wa) - wa.sum(0).T @ inner @ wa.sum(0)
        right += np.einsum("nij,ni->j", a, wy) - wa.sum(0).T @ inner @ wy.sum(0)
        parts.append((members, inner, w, wa))
    covariance = invert_scaled(normal)
    mean = covariance @ right
    residual = observed.shear - design @ mean
    scores, squares = np.zeros((len(residual), 5)), np.zeros(len(residual))
    for members, inner, w, wa in parts:
        shared = inner @ np.einsum("nij,nj->i", w, residual[members])
        own_residual = residual[members] - shared
        squares[members] = np.einsum("ni,nij,nj->n", own_residual, w, own_residual) / trust[members]
        scores[members] = np.einsum("nij,ni->nj", wa, own_residual)
    # Errors that last for some frames show where neighbours agree.
    blocks = (
        np.add.reduceat(scores, np.arange(0, len(scores), SCORED_FRAMES), axis=0) @ covariance[0]
    )
    return _Solution(mean, covariance, squares, float(np.sqrt(np.sum(blocks**2))))


def _assess(fit: _Fit, frames: int, interval_s: float) -> FrameTimeEstimate:
    """Decide whether the estimate can be relied on."""
    time_s, sigma = fit.time_s, fit.sigma_s
    reason = ""
    if not fit.converged:
        reason = f"the weights did not converge in {REWEIGHTED_MAX} steps"
    elif not abs(time_s) > TIME_SIGMAS_MIN * sigma:
        reason = f"{time_s:.3g} +- {sigma:.2g} s: the velocity of the drift changes too little"
    elif time_s < 0.0:
        reason = f"{time_s:.3g} +- {sigma:.2g} s is negative: something else shears the frames"
    elif time_s - BEYOND_SIGMAS * sigma > interval_s:
        reason = (
            f"{time_s:.3g} +- {sigma:.2g} s is longer than the {interval_s:.3g} s between frames"
        )
    elif fit.chi2 > TIMED_CHI2_MAX:
        reason = f"the frames scatter {np.sqrt(fit.chi2):.1f} times as much as they should"
    if not reason:
        time_s = min(time_s, interval_s)
    return FrameTimeEstimate(time_s, sigma, frames, fit.chi2, fit.converged, not reason, reason)
