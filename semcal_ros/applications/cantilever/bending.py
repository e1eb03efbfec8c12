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

"""From displacements along the beam to the deflection of its end.

The displacement across the axis of a clamped beam at the arc length ``s = u L`` is

    D(u) = r0 + r1 u + bending,    bending = d (u^2 + c (u^3 - u^2))

r0 and r1 are the remaining drift and rotation, with priors from what is known about both. d is the
deflection: the bending at u = 1, at the arc length L from the base. c is the shape: 0 is the
second-order polynomial of Malti et al. (2012), -1/2 a beam that is loaded at its end (Euler and
Bernoulli). A free shape is still common to all frames, since the beam is pushed at one place, so
that fitting it adds little to the uncertainty of a single frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.applications.cantilever.thresholds import (
    BENT_FRAMES_MIN,
    BENT_SPREAD_MIN,
    EDGES_MIN,
    FREE_TERMS,
    HIDDEN_PART,
    LOAD_PLACE_MIN,
    LOADED_PART,
    POINT_LOAD_PROBABILITY,
    POINT_LOAD_SIGMA,
    PUSHED_PART,
    ROBUST_ROUNDS,
    ROTATION_SIGMA_RAD,
    SHAPE_PRIOR,
    TINY,
    WEIGHT_MIN,
)
from semcal_ros.core.arrays import Array, Mask, mad_sigma
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.robust_losses import tukey_weight
from semcal_ros.core.wording import did_you_mean

SHAPES = ("free", "beam", "parabola")


@dataclass(frozen=True)
class Bending:
    """Fit of one frame against the reference.

    Attributes
    ----------
    deflection_m, sigma_m
        Bending at the end of the beam, and its 1-sigma without the uncertainty of the scale.
    coefficients
        (4,) r0, r1, and the factors of u^2 and u^3 of the bending, in m.
    covariance
        (2, 2) of the deflection and of the factor of u^3, m^2; the second is zero if the shape was
        given.
    rms_m
        RMS residual of the edges that were used.
    residuals
        (blocks, 2) residuals over their 1-sigma; NaN where the edge was not used.
    used
        (blocks, 2) bool: the edges that were used.
    """

    deflection_m: float
    sigma_m: float
    coefficients: Array
    covariance: Array
    rms_m: float
    residuals: Array
    used: Mask

    def curve(self, u: Array) -> Array:
        """Evaluate the bending alone at fractions of the length; straight beyond the ends."""
        return evaluate_bending(self.coefficients[2:], u)


@dataclass(frozen=True)
class Shape:
    """The shape of the bent beam.

    Attributes
    ----------
    value, sigma
        c and its 1-sigma.
    relative
        1-sigma of an error in proportion to the deflection, common to all frames, that the ground
        beside the edges causes.
    """

    value: float
    sigma: float
    relative: float = 0.0


def parse_shape(name: str) -> Shape | None:
    """Return the shape for a name in :data:`SHAPES`; None for a free shape.

    Raises
    ------
    InvalidValueError
        If there is no such name.
    """
    if name not in SHAPES:
        raise InvalidValueError(
            f"shape {name!r}", expected="one of " + ", ".join(SHAPES), do=did_you_mean(name, SHAPES)
        )
    return {"beam": Shape(-0.5, 0.0), "parabola": Shape(0.0, 0.0)}.get(name)


def fit_common_shape(
    frames: Sequence[Bending], reference_sigma_m: float, reference_count: int
) -> Shape:
    """Fit the shape that several frames have in common.

    The factor of u^3 is c d plus a constant that the noise of the reference causes.

    Parameters
    ----------
    frames
        Fits with a free shape.
    reference_sigma_m
        1-sigma of the factor of u^3 that the noise of the reference causes.
    reference_count
        Number of frames in the reference.

    Returns
    -------
    What is known before anything is seen, where no frame shows the beam.
    """
    good = [f for f in frames if np.isfinite(f.sigma_m)]
    if not good:
        return Shape(*SHAPE_PRIOR)
    d = np.array([f.deflection_m for f in good])
    b = np.array([f.coefficients[3] for f in good])
    spread = np.array([f.covariance for f in good]).reshape(-1, 2, 2)
    c, normal = SHAPE_PRIOR[0], np.eye(2)
    for _ in range(3):
        direction = np.array([-c, 1.0])
        variance = np.maximum(np.einsum("i,nij,j->n", direction, spread, direction), TINY)
        rows = np.column_stack([d, np.ones(len(d))])
        prior = np.array([1.0 / SHAPE_PRIOR[1] ** 2, 1.0 / max(reference_sigma_m**2, TINY)])
        normal = (rows / variance[:, None]).T @ rows + np.diag(prior)
        right = (rows / variance[:, None]).T @ b + np.array([prior[0] * SHAPE_PRIOR[0], 0.0])
        c = float(np.linalg.solve(normal, right)[0])
    along = float(np.sum((d - d.mean()) ** 2))
    single = float(np.median(np.sqrt(spread[:, 0, 0])))
    apart = along > (BENT_SPREAD_MIN * single) ** 2
    excess = _estimate_shared_excess(good, d, reference_count) if apart else 1.0
    if not apart:
        # Where the errors may be the same in all frames, these know no more than one.
        normal = (rows / (len(good) * variance)[:, None]).T @ rows + np.diag(prior)
    sigma = float(np.sqrt(np.linalg.inv(normal)[0, 0] * excess))
    relative = float(np.sqrt((excess - 1.0) / max(along, TINY))) * single
    return Shape(c, min(sigma, SHAPE_PRIOR[1]), min(relative, 1.0))


def locate_load(u: Array, frames: Sequence[Bending]) -> tuple[float, float]:
    """Locate where the beam is pushed: the first and last place, as fractions of the length.

    What pushes a beam hides its edge there. Where nothing is hidden, it is pushed somewhere in its outer fifth.

    Parameters
    ----------
    u
        (blocks,) arc length of the blocks over the length.
    frames
        Fits of the frames that are not references.
    """
    seen = [f for f in frames if np.isfinite(f.deflection_m)]
    size = np.array([abs(f.deflection_m) for f in seen])
    pushed = [f for f, d in zip(seen, size, strict=True) if d >= PUSHED_PART * size.max()]
    if len(pushed) < 2 or len(u) < 2:
        return LOADED_PART
    hidden = np.mean([~f.used.any(axis=1) for f in pushed], axis=0) >= HIDDEN_PART
    block = float(u[1] - u[0])
    places = np.flatnonzero(hidden)
    # One block alone may be dirt; beside what is hidden, a neighbour is left out, too (see :mod:`.edges`).
    if len(places) < 2:
        return LOADED_PART
    last = float(u[places[-1]]) - 0.5 * block if places[-1] < len(u) - 1 else 1.0
    return min(float(u[places[0]]) + 0.5 * block, last), last


def expect_point_load(fitted: Shape, load: tuple[float, float] = LOADED_PART) -> Shape:
    """Combine a fitted shape with what is known of beams that are pushed.

    Before anything is seen, the beam is as likely as not loaded at one place; if it is
    not, its shape is as unknown as :func:`fit_common_shape` assumes. The result has the mean and the 1-sigma of both
    posteriors together. So a shape that contradicts a point load, such as a parabola, stays as it was fitted.

    Parameters
    ----------
    fitted
        Shape from :func:`fit_common_shape`.
    load
        First and last place of the load, as fractions of the length, all places between them alike.
    """
    seen = max(fitted.sigma, 1e-6) ** 2
    first, last = (max(place, LOAD_PLACE_MIN) for place in load)
    places = np.linspace(first, last, 101)
    shapes = -1.0 / (3.0 * places - 1.0)
    mean, sigma = float(shapes.mean()), float(np.hypot(shapes.std(), POINT_LOAD_SIGMA))
    share = seen / (seen + sigma**2)
    loaded, loaded_variance = fitted.value + share * (mean - fitted.value), share * sigma**2
    # The fitted shape holds the broad prior already. Its evidence is that of the frames alone under that prior.
    evidence = [
        float(np.exp(-0.5 * (fitted.value - m) ** 2 / (seen + s**2)) / np.sqrt(seen + s**2))
        for m, s in ((mean, sigma), SHAPE_PRIOR)
    ]
    weight = POINT_LOAD_PROBABILITY * evidence[0]
    weight /= max(weight + (1.0 - POINT_LOAD_PROBABILITY) * evidence[1], TINY)
    value = weight * loaded + (1.0 - weight) * fitted.value
    variance = weight * (loaded_variance + (loaded - value) ** 2)
    variance += (1.0 - weight) * (seen + (fitted.value - value) ** 2)
    return Shape(value, float(np.sqrt(variance)), fitted.relative)


def _estimate_shared_excess(frames: Sequence[Bending], d: Array, reference_count: int) -> float:
    """Estimate how much more the residuals of an edge grow with the deflection than noise explains.

    A bright grain beside an edge pulls the fitted edge in all frames alike; the effect of the
    reference does not depend on the deflection.
    """
    if len(frames) < BENT_FRAMES_MIN:
        return 1.0
    left = np.stack([f.residuals.ravel() for f in frames])
    seen = np.isfinite(left)
    whole = seen.sum(axis=0) >= BENT_FRAMES_MIN
    left, seen = left[:, whole], seen[:, whole].astype(np.float64)
    count = np.maximum(seen.sum(axis=0), 1.0)
    away = (d[:, None] - (seen * d[:, None]).sum(axis=0) / count) * seen
    power = np.sum(away**2, axis=0)
    grown = np.sum(away * np.nan_to_num(left), axis=0)
    usable = power > TINY
    if int(usable.sum()) < EDGES_MIN:
        return 1.0
    expected = reference_count / (reference_count + 1.0)
    ratio = float(np.mean(grown[usable] ** 2 / power[usable])) / expected
    # The fits with a free shape have taken what their four terms explain out of the residuals. With
    # narrow priors on r0 and r1 it is less, so the excess may come out a little too large.
    number = float(usable.sum())
    return float(max(ratio * number / max(number - FREE_TERMS, 1.0), 1.0))


def evaluate_bending(terms: Array, u: Array) -> Array:
    """Evaluate factors (2,) times u^2 and u^3 within the beam, and the tangent beyond its end."""
    a, b = terms
    inside = np.clip(u, 0.0, 1.0)
    slope = 2.0 * a + 3.0 * b
    return np.asarray(a * inside**2 + b * inside**3 + slope * np.maximum(u - 1.0, 0.0))


def fit_bending(
    u: Array,
    displacement_m: Array,
    sigma_m: Array,
    length_m: float,
    offset_sigma_m: float,
    shape: Shape | None = None,
) -> Bending:
    """Fit displacements of both edges.

    Parameters
    ----------
    u
        (blocks,) arc length over the length.
    displacement_m, sigma_m
        (blocks, 2) of both edges against the reference, and 1-sigma; infinite where unknown.
    length_m
        Length of the beam.
    offset_sigma_m
        1-sigma of the remaining drift.
    shape
        Shape of the bending; None to fit it.

    Returns
    -------
    Bending
        With an infinite sigma if too little of the beam was seen.
    """
    usable = np.isfinite(sigma_m) & np.isfinite(displacement_m)
    cubic = u**3 - u**2
    terms = [u**2, cubic] if shape is None else [u**2 + shape.value * cubic]
    design = np.column_stack([np.ones(len(u)), u, *terms])
    rows = np.repeat(design, 2, axis=0)[usable.ravel()]
    seen, sigma = displacement_m.ravel()[usable.ravel()], sigma_m.ravel()[usable.ravel()]
    if len(seen) < EDGES_MIN:
        return _nothing_seen(usable.shape)
    prior = np.zeros(design.shape[1])
    prior[0] = 1.0 / max(offset_sigma_m, 1e-13) ** 2
    prior[1] = 1.0 / (ROTATION_SIGMA_RAD * length_m) ** 2
    fitted = _fit_robustly(rows, seen, sigma, prior)
    if fitted is None:
        return _nothing_seen(usable.shape)
    solution, weight, scale, covariance = fitted
    kept = weight > WEIGHT_MIN
    used = np.zeros(usable.size, dtype=bool)
    used[np.flatnonzero(usable.ravel())[kept]] = True
    left = seen - rows @ solution
    rms = float(np.sqrt(np.mean(left[kept] ** 2))) if kept.any() else float("nan")
    residuals = np.full(usable.size, np.nan)
    residuals[used] = (left / (scale * sigma))[kept]
    d = float(solution[2])
    whole = np.zeros((2, 2))
    whole[: len(terms), : len(terms)] = covariance[2:, 2:]
    b = float(solution[3]) if shape is None else shape.value * d
    if shape is not None and shape.sigma > 0.0:
        # A wrong shape biases the deflection by what the fit makes of the difference.
        plain = rows * (weight / sigma**2)[:, None]
        wrong = np.repeat(cubic, 2)[usable.ravel()]
        taken = np.linalg.solve(plain.T @ rows + np.diag(prior), plain.T @ wrong)[2]
        whole[0, 0] += (taken * d * shape.sigma) ** 2 + (d * shape.relative) ** 2
    return Bending(
        d,
        float(np.sqrt(whole[0, 0])),
        np.array([solution[0], solution[1], d - b, b]),
        whole,
        rms,
        residuals.reshape(usable.shape),
        used.reshape(usable.shape),
    )


def _nothing_seen(shape: tuple[int, ...]) -> Bending:
    nan = float("nan")
    return Bending(
        nan,
        float("inf"),
        np.full(4, nan),
        np.full((2, 2), np.inf),
        nan,
        np.full(shape, nan),
        np.zeros(shape, dtype=bool),
    )


def _fit_robustly(
    rows: Array, seen: Array, sigma: Array, prior: Array
) -> tuple[Array, Array, float, Array] | None:
    """Fit by reweighted least squares (Tukey's biweight), scaled by the scatter of the residuals.

    Returns None where too few agree with each other.

    The model is linear, so each round is one small solve. scipy.optimize.least_squares has no loss
    that gives outliers no weight at all: with its Cauchy loss, a fit of 60 blocks takes 65 to 80 ms
    instead of 8 to 10 ms, and the error is the same with up to a tenth of an edge covered by
    another body, and 5 % larger with a fifth.
    """
    plain = 1.0 / sigma**2
    weight = np.ones(len(seen))
    scale = 1.0
    solution: Array = np.zeros(rows.shape[1])
    for iteration in range(ROBUST_ROUNDS):
        total = weight * plain / scale**2
        normal = (rows * total[:, None]).T @ rows + np.diag(prior)
        solution = np.asarray(np.linalg.solve(normal, (rows * total[:, None]).T @ seen))
        residual = (seen - rows @ solution) / sigma
        scale = max(mad_sigma(residual), 0.8)
        # The first rounds do not yet know what is an outlier.
        weight = tukey_weight(residual, scale * (2.0 if iteration < 3 else 1.0))
        if int(np.count_nonzero(weight > WEIGHT_MIN)) < EDGES_MIN:
            return None
    # The sandwich formula: the weights cost a little more than the plain inverse says.
    total = weight * plain / scale**2
    meat = (rows * (weight**2 * plain / scale**2)[:, None]).T @ rows + np.diag(prior)
    inverse = np.linalg.inv((rows * total[:, None]).T @ rows + np.diag(prior))
    slope = float(np.mean(np.where(weight > 0.0, 1.0, 0.0)))
    covariance = inverse @ meat @ inverse / max(slope, 0.5)
    return solution, weight, scale, np.asarray(covariance)


def locate_end(terms: Array, length_m: float) -> float:
    """Locate the end of the bent beam along the axis, m, from its conserved arc length.

    Parameters
    ----------
    terms
        (2,) a and b of the bending in m.
    length_m
        Length of the beam.
    """
    u = np.linspace(0.0, 1.0, 129)
    slope = (2.0 * terms[0] * u + 3.0 * terms[1] * u**2) / length_m
    # ds = dx sqrt(1 + y'^2), so that dx/ds = 1 / sqrt(1 + y'^2).
    shrink = 1.0 / np.sqrt(1.0 + slope**2)
    middle = 0.5 * (shrink[1:] + shrink[:-1])
    return float(length_m * np.sum(middle * np.diff(u)))
