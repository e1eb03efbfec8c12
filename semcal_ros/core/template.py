"""The reference side of an alignment: all that can be computed before the image is seen."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.subpixel import MARGIN

__all__ = ["Patch", "Template", "Window", "overlap_window"]

Array = NDArray[np.float64]
Image = NDArray[np.float32]

_EDGE = MARGIN + 1
_MIN_OVERLAP_PX = 24


@dataclass(frozen=True)
class Window:
    """The overlap: its position in the reference, and the whole-pixel shift to the image."""

    left: int
    top: int
    width: int
    height: int
    whole: tuple[int, int]

    def of(self, picture: Image) -> Image:
        """This part of the reference, or of a picture of its size."""
        return picture[self.top : self.top + self.height, self.left : self.left + self.width]


@dataclass(frozen=True)
class Patch:
    """The reference over one overlap of n pixels.

    ``columns`` (8, n): gradient by x and y, made orthogonal to the rest; the centred patch, ramps
    along x and y, and the patch times those; ones. ``looks`` (2, 2, 8, 8) are the Gram matrices of
    the left, right, top and bottom half, or None for a lone particle, of which no half tells
    anything without the other.
    """

    mean: float
    columns: Image
    solve_nuisance: Array
    information: Array
    looks: Array | None

    @property
    def gradient(self) -> Image:
        """(2, n) gradient that only a shift explains."""
        return self.columns[:2]

    @property
    def nuisance(self) -> Image:
        """(5, n) changes of gain and offset."""
        return self.columns[2:7]


@dataclass(frozen=True)
class Template:
    """Reference of an alignment.

    Attributes
    ----------
    smooth, dx, dy
        Smoothed picture and its derivatives per px.
    sigma_px
        Width of the smoothing.
    noise, gradient_noise
        Mean square per pixel that noise adds to ``smooth``, and to each of ``dx`` and ``dy``.
    """

    smooth: Image
    dx: Image
    dy: Image
    sigma_px: float
    noise: float
    gradient_noise: float
    # Drift is slow: consecutive frames overlap in the same whole pixels.
    _latest: dict[Window, Patch] = field(default_factory=dict, repr=False, compare=False)

    def patch(self, window: Window) -> Patch:
        """Everything about the overlap that does not depend on the image."""
        found = self._latest.get(window)
        if found is None:
            found = _patch(self, window)
            self._latest.clear()
            self._latest[window] = found
        return found


def _patch(template: Template, window: Window) -> Patch:
    picture = window.of(template.smooth)
    height, width = picture.shape
    mean = float(picture.mean(dtype=np.float64))
    ramp_x = np.linspace(-1.0, 1.0, width, dtype=np.float32)[None, :]
    ramp_y = np.linspace(-1.0, 1.0, height, dtype=np.float32)[:, None]
    planes = np.empty((8, height, width), dtype=np.float32)
    planes[0], planes[1] = window.of(template.dx), window.of(template.dy)
    np.subtract(picture, np.float32(mean), out=planes[2])
    planes[3], planes[4] = ramp_x, ramp_y
    np.multiply(planes[2], ramp_x, out=planes[5])
    np.multiply(planes[2], ramp_y, out=planes[6])
    for k in (0, 1, 5, 6):
        planes[k] -= planes[k].mean(dtype=np.float64)
    planes[7] = 1.0
    columns = planes.reshape(8, -1)

    noise = height * width * template.noise * np.array([1.0, 0.0, 0.0, 1.0 / 3.0, 1.0 / 3.0])
    nuisance = columns[2:7]
    of_gradient = np.full(2, height * width * template.gradient_noise)
    gram = _noise_free((nuisance @ nuisance.T).astype(np.float64), noise)
    cross = (columns[:2] @ nuisance.T).astype(np.float64)
    steepness = np.sum(columns[:2] ** 2, axis=1, dtype=np.float64)
    energy = np.asarray(steepness - of_gradient, dtype=np.float64)
    alone = _mimicked(energy, cross, gram)
    if alone:
        nuisance[1:], cross[:, 1:], gram[1:, :], gram[:, 1:] = 0.0, 0.0, 0.0, 0.0
        gram[np.diag_indices(5)] += 1e-30
    inverse = np.asarray(np.linalg.inv(gram), dtype=np.float64)
    columns[:2] -= (cross @ inverse).astype(np.float32) @ nuisance

    looks = _half_grams(columns, height, width)
    information = _noise_free((looks[0, 0] + looks[0, 1])[:2, :2], of_gradient)
    half_noise = 0.5 * np.concatenate([of_gradient, noise, [0.0]])
    for pair in looks:
        pair[:] = [_noise_free(half, half_noise) for half in pair]
    return Patch(mean, columns, inverse, information, None if alone else looks)


def _mimicked(energy: Array, cross: Array, gram: Array) -> bool:
    """Whether ramps of gain and offset would explain away most of the gradient, as they do for a
    lone particle.
    """
    plain = energy - cross[:, 0] ** 2 / gram[0, 0]
    left = energy - np.sum(cross @ np.linalg.inv(gram) * cross, axis=1)
    return bool(np.any(left < 0.5 * plain))


def _half_grams(columns: Image, height: int, width: int) -> Array:
    whole = columns @ columns.T
    upper = columns[:, : height // 2 * width]
    left = columns.reshape(8, height, width)[:, :, : width // 2].reshape(8, -1)
    parts = [np.asarray(part @ part.T, dtype=np.float64) for part in (left, upper)]
    pairs = np.stack([np.stack([part, whole - part]) for part in parts])
    return np.asarray(pairs, dtype=np.float64)


def _noise_free(gram: Array, noise: Array) -> Array:
    """Gram matrix without the noise of the reference, which makes its columns look larger than
    they are.
    """
    clean = gram.copy()
    seen = np.diag(gram)
    clean[np.diag_indices_from(clean)] = (
        np.maximum(seen - noise, 0.05 * seen) * (1.0 + 1e-6) + 1e-30
    )
    return clean


def overlap_window(reference: Image, image: Image, shift: Array) -> Window | None:
    """The overlap at a shift without the margins of the filters, or None where it is too small."""
    whole = (int(np.rint(shift[0])), int(np.rint(shift[1])))
    spans = []
    for axis in (0, 1):
        n_reference, n_image = reference.shape[1 - axis], image.shape[1 - axis]
        first = max(_EDGE, _EDGE - whole[axis])
        last = min(n_reference - _EDGE, n_image - _EDGE - whole[axis])
        if last - first < _MIN_OVERLAP_PX:
            return None
        spans.append((first, last - first))
    return Window(spans[0][0], spans[1][0], spans[0][1], spans[1][1], whole)
