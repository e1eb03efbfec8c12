"""Undo distortion and drift of a frame in one interpolation.

The specimen drifts before it is projected and distorted, so an output pixel u, which is an ideal
pixel of the camera with the specimen at zero drift, is found in the raw frame at

    raw = distort(u + J d(t(raw))),    d(t) = d_centre + v (t - t_centre) + a (t - t_centre)^2 / 2

with ``J`` the derivative of ideal pixels by sem-frame coordinates and ``t(raw)`` the time at which
that raw pixel was scanned. The map is smooth, so it is evaluated exactly at a few Chebyshev nodes
only and interpolated by polynomials in x and y (Trefethen 2019, doi:10.1137/1.9781611975949): a
small matrix product per band of rows, of which none depends on what changes from frame to frame but
the node values.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import TypeVar, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.core.camera import ScanCamera
from semcal_ros.core.errors import InvalidValueError
from semcal_ros.core.raster import ScanTiming

__all__ = ["RasterDrift", "Rectifier", "camera_key", "raw_from_output"]

Array = NDArray[np.float64]
Map = NDArray[np.float32]
_Key = TypeVar("_Key")
_Value = TypeVar("_Value")

_INTERPOLATIONS = {
    "linear": cv2.INTER_LINEAR,
    "cubic": cv2.INTER_CUBIC,
    "lanczos4": cv2.INTER_LANCZOS4,
}
_DTYPES = ("uint8", "uint16", "float32")
_BAND_ROWS = 64
_TESTS = 11
# The last ones are for residual fields, whose splines are less smooth than the distortion.
_DEGREES = (4, 6, 8, 12, 16, 24, 32, 48, 64, 96)
# The promise is 0.002 px; between the points where the maps are compared they may differ more.
_MAX_MAP_ERROR_PX = 0.001
_KEPT = 16
_KEPT_MAPS = 2
_MAX_STEPS = 50


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
    """

    position: Array
    velocity: Array
    acceleration: Array = field(default_factory=lambda: np.zeros(2))


def raw_from_output(
    xy: Array,
    size: tuple[int, int],
    camera: ScanCamera | None,
    drift: RasterDrift | None,
    timing: ScanTiming | None,
) -> Array:
    """Raw pixels (n, 2) of output pixels (n, 2), exactly; NaN where the distortion has no answer.

    Parameters
    ----------
    xy
        Output pixels.
    size
        (width, height) of the raw frame.
    camera
        Camera of that size, or None for no distortion; drift is then in px.
    drift
        Drift to remove, or None.
    timing
        Raster timing; None takes the frame as an instant, so that the velocity has no effect.
    """
    jacobian = np.eye(2) if camera is None else camera.ideal_from_sem_jacobian
    if drift is None:
        return xy.copy() if camera is None else camera.distort(xy)
    at_centre = xy + jacobian @ np.asarray(drift.position, dtype=np.float64)
    raw = at_centre if camera is None else camera.distort(at_centre)
    velocity = jacobian @ np.asarray(drift.velocity, dtype=np.float64)
    acceleration = jacobian @ np.asarray(drift.acceleration, dtype=np.float64)
    if timing is None or not (np.any(velocity) or np.any(acceleration)):
        return raw
    width, height = size
    for _ in range(_MAX_STEPS):
        # A contraction as long as the drift moves by much less than a row while a row is scanned.
        offset_s = timing.pixel_offset_s(raw[:, 1], raw[:, 0], height, width)
        since_s = (offset_s - timing.centre_offset_s)[:, None]
        # The mean over the passes of the square of the time.
        square = since_s**2 + timing.pass_variance_s2
        moved = at_centre + since_s * velocity + 0.5 * square * acceleration
        new = moved if camera is None else camera.distort(moved)
        change = np.abs(new - raw)
        raw = new
        if not np.any(change > 1e-7):
            return raw
    raise InvalidValueError(
        f"drift of {np.hypot(*velocity):.3g} px/s with {timing.frame_time_s} s per pass",
        expected="a drift that is slow against the scan of a row",
        do="check the frame time and the unit of the velocity",
    )


@dataclass(frozen=True)
class _Interpolant:
    """Polynomial interpolation from a lattice of nodes to the pixels of an image and to a few test
    points.
    """

    points_xy: Array
    nodes: int
    rows: Map
    cols: Map
    test_rows: Array
    test_cols: Array


def _basis(n_pixels: int, degree: int, at: Array) -> tuple[Array, Array]:
    """Node positions in px, and the (n_at, degree + 1) matrix that interpolates node values
    (barycentric formula).
    """
    k = np.arange(degree + 1)
    half = 0.5 * max(n_pixels - 1, 1)
    nodes = half * (1.0 - np.cos(np.pi * k / degree))
    weights = np.where(k % 2 == 0, 1.0, -1.0)
    weights[[0, -1]] *= 0.5
    difference = at[:, None] - nodes[None, :]
    hit = np.abs(difference) < 1e-9
    terms = weights / np.where(hit, 1.0, difference)
    matrix = terms / terms.sum(axis=1, keepdims=True)
    exact = hit.any(axis=1)
    matrix[exact] = hit[exact]
    return nodes, matrix


def _interpolant(size: tuple[int, int], degree: int) -> _Interpolant:
    """Nodes of one polynomial degree; the test points lie where none of the degrees has a node."""
    tests, bases = [], []
    for n_pixels in size:
        # Denser at the edges, as the nodes are and as the beam settles at the start of a line.
        angles = np.pi * (np.arange(_TESTS) + 0.37) / _TESTS
        test = 0.5 * (n_pixels - 1) * (1.0 - np.cos(angles))
        tests.append(test)
        nodes, at_pixels = _basis(n_pixels, degree, np.arange(n_pixels, dtype=np.float64))
        bases.append((nodes, at_pixels, _basis(n_pixels, degree, test)[1]))
    lattices = [np.meshgrid(bases[0][0], bases[1][0]), np.meshgrid(*tests)]
    points = [np.stack([x.ravel(), y.ravel()], axis=1) for x, y in lattices]
    return _Interpolant(
        points_xy=np.vstack(points),
        nodes=degree + 1,
        rows=bases[1][1].astype(np.float32),
        cols=np.ascontiguousarray(bases[0][1].T, dtype=np.float32),
        test_rows=bases[1][2],
        test_cols=bases[0][2],
    )


class Rectifier:
    """Rectifies frames, keeping the parts of the maps that do not change.

    Parameters
    ----------
    interpolation
        ``"linear"`` (the default), ``"cubic"`` or ``"lanczos4"``. OpenCV 4 rounds positions of the
        map to 1/32 px.

    Notes
    -----
    The image keeps its size and type. Pixels that were not scanned come out as 0. An instance is
    not meant to be shared between threads.
    """

    def __init__(self, interpolation: str = "linear") -> None:
        if interpolation not in _INTERPOLATIONS:
            raise InvalidValueError(
                f"interpolation {interpolation!r}", expected=" or ".join(_INTERPOLATIONS)
            )
        self._flag = _INTERPOLATIONS[interpolation]
        self._degrees: OrderedDict[tuple[object, ...], int] = OrderedDict()
        self._interpolants: OrderedDict[tuple[int, int, int], _Interpolant] = OrderedDict()
        self._static: OrderedDict[tuple[object, ...], tuple[Map, Map]] = OrderedDict()

    def rectify(
        self,
        image: NDArray[np.generic],
        camera: ScanCamera | None,
        drift: RasterDrift | None = None,
        timing: ScanTiming | None = None,
    ) -> NDArray[np.generic]:
        """The frame as an ideal camera would see the specimen at zero drift.

        Parameters
        ----------
        image
            (h, w) or (h, w, 3) of uint8, uint16 or float32.
        camera
            Camera of this frame's magnification; scaled to the image's size if it has another.
            None: no distortion.
        drift
            Drift during this frame: in m with a camera, in px without; None for none.
        timing
            Raster timing, by which the drift's velocity shears the frame; None takes the frame as
            an instant.

        Raises
        ------
        InvalidValueError
            If the image has another type or shape, or the drift is not finite or too fast for the
            raster.
        """
        _check_image(image)
        _check_drift(drift)
        height, width = image.shape[:2]
        if camera is None and drift is None:
            return image.copy()
        if drift is None:
            return self.remapped(image, *self.maps((width, height), camera))
        output = np.empty_like(image)
        fitted = None if camera is None else camera.resized(width, height)
        for top, map_x, map_y in self._bands((width, height), fitted, drift, timing):
            output[top : top + len(map_x)] = self.remapped(image, map_x, map_y)
        return output

    def maps(
        self,
        size: tuple[int, int],
        camera: ScanCamera | None,
        drift: RasterDrift | None = None,
        timing: ScanTiming | None = None,
    ) -> tuple[Map, Map]:
        """Raw x and y, (h, w) float32 each, of every output pixel of an image of ``size`` (width,
        height).
        """
        _check_drift(drift)
        fitted = None if camera is None else camera.resized(*size)
        key = camera_key(size, fitted)
        if drift is None and key in self._static:
            self._static.move_to_end(key)
            return self._static[key]
        bands = list(self._bands(size, fitted, drift, timing))
        both = np.vstack([x for _, x, _ in bands]), np.vstack([y for _, _, y in bands])
        if drift is None:
            # Full maps are large: only the latest few are worth their memory.
            _keep(self._static, key, both, _KEPT_MAPS)
        return both

    def remapped(self, image: NDArray[np.generic], map_x: Map, map_y: Map) -> NDArray[np.generic]:
        """The image at raw positions as :meth:`maps` gives them; 0 outside of it."""
        picture = cast("NDArray[np.float32]", image)
        warped = cv2.remap(
            picture, map_x, map_y, self._flag, borderMode=cv2.BORDER_CONSTANT, borderValue=0
        )
        return np.asarray(warped)

    def _bands(
        self,
        size: tuple[int, int],
        camera: ScanCamera | None,
        drift: RasterDrift | None,
        timing: ScanTiming | None,
    ) -> Iterator[tuple[int, Map, Map]]:
        """First row and maps of one band of rows after the other, small enough to stay in the
        processor's cache.
        """
        found = self._departure(size, camera, drift, timing)
        if found is None:
            yield from _exact_bands(size, camera, drift, timing)
            return
        interpolant, departure = found
        width, height = size
        right_x = departure[:, :, 0].astype(np.float32) @ interpolant.cols
        right_y = departure[:, :, 1].astype(np.float32) @ interpolant.cols
        columns = np.arange(width, dtype=np.float32)
        for top in range(0, height, _BAND_ROWS):
            rows = interpolant.rows[top : top + _BAND_ROWS]
            map_x, map_y = rows @ right_x, rows @ right_y
            map_x += columns
            map_y += np.arange(top, top + len(rows), dtype=np.float32)[:, None]
            yield top, map_x, map_y

    def _departure(
        self,
        size: tuple[int, int],
        camera: ScanCamera | None,
        drift: RasterDrift | None,
        timing: ScanTiming | None,
    ) -> tuple[_Interpolant, Array] | None:
        """The map minus the identity at the nodes of the lowest degree that is accurate, or None
        where none is.

        What single precision has to carry later is this small departure, not the position itself.
        """
        key = camera_key(size, camera)
        for degree in [d for d in _DEGREES if d >= self._degrees.get(key, 0)]:
            interpolant = self._interpolants.get((*size, degree))
            if interpolant is None:
                interpolant = _interpolant(size, degree)
            _keep(self._interpolants, (*size, degree), interpolant, _KEPT)
            points, nodes = interpolant.points_xy, interpolant.nodes
            departure = raw_from_output(points, size, camera, drift, timing) - points
            if not np.all(np.isfinite(departure)):
                return None
            at_nodes = departure[: nodes * nodes].reshape(nodes, nodes, 2)
            truth = departure[nodes * nodes :].reshape(len(interpolant.test_rows), -1, 2)
            tested = np.einsum(
                "ri,ijk,cj->rck", interpolant.test_rows, at_nodes, interpolant.test_cols
            )
            if float(np.max(np.abs(tested - truth))) <= _MAX_MAP_ERROR_PX:
                _keep(self._degrees, key, degree, _KEPT)
                return interpolant, at_nodes
        return None


def _keep(store: OrderedDict[_Key, _Value], key: _Key, value: _Value, at_most: int) -> None:
    """Store as the latest and forget the oldest beyond ``at_most``."""
    store[key] = value
    store.move_to_end(key)
    while len(store) > at_most:
        store.popitem(last=False)


def camera_key(size: tuple[int, int], camera: ScanCamera | None) -> tuple[object, ...]:
    """What maps of (width, height) depend on, for looking them up."""
    if camera is None:
        return size
    field = b"" if camera.residual is None else camera.residual.coefficients.tobytes()
    return (*size, camera.norm_px, *camera.parameters.tolist(), field)


def _exact_bands(
    size: tuple[int, int],
    camera: ScanCamera | None,
    drift: RasterDrift | None,
    timing: ScanTiming | None,
) -> Iterator[tuple[int, Map, Map]]:
    """Every pixel on its own: for a map that polynomials do not follow, or that has holes."""
    width, height = size
    for top in range(0, height, _BAND_ROWS):
        x, y = np.meshgrid(np.arange(width), np.arange(top, min(top + _BAND_ROWS, height)))
        xy = np.stack([x.ravel(), y.ravel()], axis=1).astype(np.float64)
        raw = raw_from_output(xy, size, camera, drift, timing)
        # Outside of the frame: such pixels come out as 0.
        raw[~np.all(np.isfinite(raw), axis=1)] = -1e4
        maps = raw.astype(np.float32).reshape(*x.shape, 2)
        yield top, np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])


def _check_image(image: NDArray[np.generic]) -> None:
    if image.dtype.name not in _DTYPES or not (
        image.ndim == 2 or (image.ndim == 3 and image.shape[2] == 3)
    ):
        raise InvalidValueError(
            f"an image of shape {image.shape} and type {image.dtype}",
            expected="(h, w) or (h, w, 3) of " + ", ".join(_DTYPES),
        )


def _check_drift(drift: RasterDrift | None) -> None:
    if drift is None:
        return
    parts = (drift.position, drift.velocity, drift.acceleration)
    values = np.concatenate([np.ravel(part) for part in parts])
    if values.shape != (6,) or not np.all(np.isfinite(values)):
        raise InvalidValueError(
            f"drift {values.tolist()}",
            expected="two finite positions, velocities and accelerations each",
        )
