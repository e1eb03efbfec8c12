"""Least squares for shift, gain and offset on the sums over tiles.

Gain and offset are constant over a tile and follow a ramp over the field. They are eliminated: the
gradient is made orthogonal to them, and what is left of it only a shift explains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import Array, invert_scaled
from semcal_ros.core.registration.tiles import PyramidLevel, TileSums, TileWindow

__all__ = ["TileFit", "TileGeometry", "fitted", "geometry_of", "residuals", "well_posed"]


@dataclass(frozen=True)
class TileGeometry:
    """What the fit over a window of n tiles needs and the image does not change.

    Attributes
    ----------
    gram
        (n, 4, 4) of the tiles.
    ramps
        (n, p) factors of the p terms of gain and offset: one and two ramps, or one alone where the
        ramps would explain away most of the gradient, as they do for a lone particle.
    inverse
        (2 p, 2 p) inverse of the normal equations of gain and offset.
    explained
        (2, 2 p) what of the gradient they explain.
    kept
        (2,) fraction of the gradient's RMS that is left.
    """

    gram: Array
    ramps: Array
    inverse: Array
    explained: Array
    kept: Array

    @property
    def alone(self) -> bool:
        """Whether gain and offset are constants."""
        return int(self.ramps.shape[1]) == 1


@dataclass(frozen=True)
class TileFit:
    """One look at the pixels.

    Attributes
    ----------
    scores
        (n, 2) the tiles' products of the orthogonal gradient with what gain and offset leave.
    information
        (2, 2) the part of the common information that only a shift explains.
    gain, offset
        (p,) terms of the gain and of the offset.
    step
        (2,) change of the shift.
    """

    scores: Array
    information: Array
    gain: Array
    offset: Array
    step: Array


def geometry_of(level: PyramidLevel, window: TileWindow) -> TileGeometry:
    """Everything about a window; that of the latest one is kept, because drift is slow."""
    known = level.kept.get(window.key)
    if isinstance(known, TileGeometry):
        return known
    rows = np.linspace(-1.0, 1.0, window.rows.stop - window.rows.start)
    cols = np.linspace(-1.0, 1.0, window.cols.stop - window.cols.start)
    y, x = np.meshgrid(rows, cols, indexing="ij")
    ramps = np.stack([np.ones(x.size), x.ravel(), y.ravel()], axis=1)
    gram = level.gram[window.rows, window.cols].reshape(-1, 4, 4)
    plain = np.diag(gram[:, :2, :2].sum(axis=0))
    found = _eliminated(gram, ramps)
    constant = _eliminated(gram, ramps[:, :1])
    if np.any(found.kept**2 * plain < 0.5 * constant.kept**2 * plain):
        found = constant
    level.kept.clear()
    level.kept[window.key] = found
    return found


def _eliminated(gram: Array, ramps: Array) -> TileGeometry:
    count = ramps.shape[1]
    pairs = (ramps[:, :, None] * ramps[:, None, :]).reshape(len(ramps), -1)
    whole = (gram.reshape(-1, 16).T @ pairs).reshape(4, 4, count, count).transpose(0, 2, 1, 3)
    normal = whole[2:, :, 2:, :].reshape(2 * count, 2 * count)
    mixed = whole[:2, 0, 2:, :].reshape(2, 2 * count)
    plain = np.diag(whole[:2, 0, :2, 0])
    inverse = invert_scaled(normal, rcond=1e-9)
    explained = mixed @ inverse
    left = plain - np.sum(explained * mixed, axis=1)
    kept = np.asarray(np.sqrt(np.maximum(left, 0.0) / np.maximum(plain, 1e-30)))
    return TileGeometry(gram, ramps, inverse, explained, kept)


def well_posed(matrix: Array) -> bool:
    """Whether a (2, 2) information matrix determines both directions."""
    a, b, c = float(matrix[0, 0]), float(matrix[0, 1]), float(matrix[1, 1])
    return a > 0.0 and c > 0.0 and a * c - b * b > 1e-6 * a * c


def fitted(geometry: TileGeometry, sums: TileSums) -> TileFit | None:
    """Gain, offset and step, or None where the gradient leaves a direction undetermined.

    Noise makes the reference's gradient look steeper than it is; the common information does not
    contain it.
    """
    information = sums.slopes * np.outer(geometry.kept, geometry.kept)
    if not well_posed(information):
        return None
    gram, ramps, count = geometry.gram, geometry.ramps, geometry.ramps.shape[1]
    cross = sums.cross.reshape(-1, 4)
    seen = (cross[:, 2:].T @ ramps).ravel()
    terms = geometry.inverse @ seen
    gain, offset = ramps @ terms[:count], ramps @ terms[count:]
    left = cross - gram[:, :, 2] * gain[:, None] - gram[:, :, 3] * offset[:, None]
    scores = left[:, :2] - (left[:, 2:3] * ramps) @ geometry.explained[:, :count].T
    scores = scores - (left[:, 3:4] * ramps) @ geometry.explained[:, count:].T
    step = -np.linalg.solve(information, scores.sum(axis=0))
    return TileFit(scores, information, terms[:count], terms[count:], step)


def residuals(geometry: TileGeometry, sums: TileSums, fit: TileFit) -> Array:
    """(n,) squares of what gain and offset leave, summed over each tile."""
    gram, cross = geometry.gram, sums.cross.reshape(-1, 4)
    gain, offset = geometry.ramps @ fit.gain, geometry.ramps @ fit.offset
    model = gain**2 * gram[:, 2, 2] + offset**2 * gram[:, 3, 3]
    model += 2.0 * gain * offset * gram[:, 2, 3]
    seen = gain * cross[:, 2] + offset * cross[:, 3]
    return np.asarray(sums.energy.ravel() - 2.0 * seen + model)
