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

"""The microscope as a camera at one magnification."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.distortion import (
    LENS_NAMES,
    Undistortion,
    distort_jacobians,
    distort_normalised,
    undistort_normalised,
)
from semcal_ros.core.camera.projection import (
    ALL_NAMES,
    PARAMETER_NAMES,
    project_ideal_points,
    project_points_with_jacobians,
)
from semcal_ros.core.camera.residual_field import FieldSlice
from semcal_ros.core.camera.scan_distortion import (
    SCAN_NAMES,
    Raster,
    deflection_shift,
    deflection_stretch,
    raw_from_deflection,
)
from semcal_ros.core.errors import InvalidValueError

# Parameters that grow with the number of pixels of an image.
_IN_PX = ("m", "px", "py", "ex", "ey")


def as_points(values: ArrayLike, dimensions: int) -> Array:
    """Return ``values`` as an (n, dimensions) float64 array.

    Raises
    ------
    InvalidValueError
        If they have another shape.
    """
    points = np.asarray(values, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != dimensions:
        raise InvalidValueError(
            f"points of shape {points.shape}",
            expected=f"an array of shape (n, {dimensions})",
            do="reshape a single point with [None]",
        )
    return points


@dataclass(frozen=True)
class ScanCamera:
    """Projection and distortion of the SEM at one magnification: ``doc/model.md``.

    It knows three kinds of pixels of one image: *raw* ones, as scanned; *ideal* ones, without
    distortion; *rectified* ones, which are ideal, square and at right angles, as in ``image_rect``.
    The camera of those is :attr:`rectified`.

    Parameters
    ----------
    magnification
        The magnification g that this camera is for, with respect to the calibration's display
        width.
    m
        Scale at the reference plane, px per m.
    aspect, skew
        Aspect ratio ``a`` and skew ratio ``sigma``, dimensionless.
    px, py
        Principal point, px.
    rho
        Inverse distance of the scan pivot from the reference plane, 1/m; 0 is a parallel
        projection.
    xi_r, xi_t
        Radial and tangential distortion in normalised coordinates.
    ex, ey
        Centre of the distortion, px.
    xi_s, xi_u, xi_v, xi_w, xi_r4
        Spiral distortion, the tangential one along the other diagonal, the products of both coordinates that belong to
        a displaced lens, and the radial distortion of the fifth order, in normalised coordinates (see
        :mod:`semcal_ros.core.camera.distortion`).
    coil_x2 to coil_x7, settling_1 to settling_5, coil_y2 to coil_y7
        Distortion of the scan along the lines and across them (see
        :mod:`semcal_ros.core.camera.scan_distortion`), in half image widths.
    raster_ratio
        Height over width of the pictures to which the distortion of the scan refers; None for this one's.
    norm_px
        Normalisation length of the distortion, px (half the image width).
    width, height
        Image size, px.
    covariance
        (P, P) covariance of :attr:`parameters`, or None where it is not known.
    in_range
        False when ``magnification`` lies outside the calibrated range.
    residual
        Distortion that the parameters do not describe (see
        :mod:`semcal_ros.core.camera.residual_field`), or None.

    Examples
    --------
    >>> import numpy as np
    >>> camera = ScanCamera(5000.0, 2.1e7, 1.0, 0.0, 255.5, 255.5, 50.0, 0.002, 0.001, 256.0, 256.0, 256.0, 512, 512)
    >>> raw = camera.project(np.array([[1e-6, 2e-6, 0.0]]))
    >>> np.allclose(camera.distort(camera.undistort(raw)), raw)
    True
    """

    magnification: float
    m: float
    aspect: float
    skew: float
    px: float
    py: float
    rho: float
    xi_r: float
    xi_t: float
    ex: float
    ey: float
    norm_px: float
    width: int
    height: int
    covariance: Array | None = None
    in_range: bool = True
    residual: FieldSlice | None = None
    xi_s: float = 0.0
    xi_u: float = 0.0
    xi_v: float = 0.0
    xi_w: float = 0.0
    xi_r4: float = 0.0
    coil_x2: float = 0.0
    coil_x3: float = 0.0
    coil_x4: float = 0.0
    coil_x5: float = 0.0
    coil_x6: float = 0.0
    coil_x7: float = 0.0
    settling_1: float = 0.0
    settling_2: float = 0.0
    settling_3: float = 0.0
    settling_4: float = 0.0
    settling_5: float = 0.0
    coil_y2: float = 0.0
    coil_y3: float = 0.0
    coil_y4: float = 0.0
    coil_y5: float = 0.0
    coil_y6: float = 0.0
    coil_y7: float = 0.0
    raster_ratio: float | None = None

    def __post_init__(self) -> None:
        values = [*self.all_parameters.tolist(), self.magnification, self.norm_px]
        if not all(map(math.isfinite, values)):
            raise InvalidValueError(
                f"camera parameters {[float(value) for value in values]}", expected="finite numbers"
            )
        for name in ("magnification", "m", "aspect", "norm_px", "width", "height"):
            if not getattr(self, name) > 0:
                raise InvalidValueError(
                    f"camera with {name} = {getattr(self, name)}", expected="a positive number"
                )

    @classmethod
    def nominal(
        cls, magnification: float, width: int, height: int, display_width_m: float
    ) -> ScanCamera:
        """Return the camera that the display width alone predicts: parallel, without distortion.

        Its covariance is that of an uncalibrated instrument: a scale accurate to 3 %, an axis within
        3 % of the width from the middle, and an unknown distortion of a few tenths of a per cent
        (1-sigma).
        """
        cx, cy = 0.5 * (width - 1), 0.5 * (height - 1)
        m = magnification * width / display_width_m
        sigmas = np.array([0.03 * m, 0.01, 0.01, *[0.03 * width] * 2, 50.0, 5e-3, 2e-3])
        covariance = np.diag(np.append(sigmas, [0.05 * width] * 2) ** 2)
        return cls(
            magnification=magnification,
            m=m,
            aspect=1.0,
            skew=0.0,
            px=cx,
            py=cy,
            rho=0.0,
            xi_r=0.0,
            xi_t=0.0,
            ex=cx,
            ey=cy,
            norm_px=0.5 * width,
            width=width,
            height=height,
            covariance=covariance,
            in_range=False,
        )

    @property
    def all_parameters(self) -> Array:
        """(k,) parameters, with all zeros, in the order of :data:`~semcal_ros.core.camera.projection.ALL_NAMES`."""
        return np.array([getattr(self, name) for name in ALL_NAMES], dtype=np.float64)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of :attr:`parameters`: all, or those that every camera has where it has no other."""
        plain = len(PARAMETER_NAMES)
        known = plain if self.covariance is None else len(self.covariance)
        return (
            ALL_NAMES if known > plain or np.any(self.all_parameters[plain:]) else PARAMETER_NAMES
        )

    @property
    def parameters(self) -> Array:
        """(P,) parameter vector in the order of :attr:`names`."""
        return self.all_parameters[: len(self.names)]

    @cached_property
    def raster(self) -> Raster:
        """Where the raster lies in the picture."""
        whole = Raster.of(self.width, self.height)
        ratio = whole.ratio if self.raster_ratio is None else self.raster_ratio
        return Raster(whole.middle_px, self.norm_px, ratio)

    @property
    def _lens(self) -> tuple[float, ...]:
        return tuple(getattr(self, name) for name in LENS_NAMES)

    @property
    def scan_amplitudes(self) -> Array:
        """(k,) amplitudes of the distortion of the scan, in the order of :data:`SCAN_NAMES`."""
        return np.array([getattr(self, name) for name in SCAN_NAMES])

    # -- projection -------------------------------------------------------------------------------

    def project(self, xyz_m: ArrayLike) -> Array:
        """Project sem-frame points (n, 3) in m to raw pixels (n, 2); NaN where there is none."""
        return self.distort(self.project_ideal(xyz_m))

    def project_ideal(self, xyz_m: ArrayLike) -> Array:
        """Project sem-frame points (n, 3) in m to undistorted pixels (n, 2)."""
        return project_ideal_points(self.parameters, as_points(xyz_m, 3))

    def project_sigma(self, xyz_m: ArrayLike) -> Array:
        """Return 1-sigma (n, 2) in px of :meth:`project`, from the covariance of the calibration.

        Raises
        ------
        InvalidValueError
            If the camera carries no covariance.
        """
        covariance = self.joint_covariance
        if covariance is None:
            raise InvalidValueError(
                "a camera without covariance",
                expected="a camera from Calibration.at(g)",
                do="take the camera from a calibration",
            )
        jacobian = self.project_jacobian(xyz_m)
        variance = np.einsum("nip,pq,niq->ni", jacobian, covariance, jacobian, optimize=True)
        return np.sqrt(np.maximum(variance, 0.0))

    def project_jacobian(self, xyz_m: ArrayLike) -> Array:
        """Return the derivative (n, 2, P + F) of :meth:`project`.

        It is by the P parameters, followed by the F coefficients of the residual field.
        """
        points = as_points(xyz_m, 3)
        known, xy, jacobian = self._parametric_jacobian(points)
        if self.residual is not None:
            gradient = self.residual.gradient(self._normalised(xy))
            jacobian = np.asarray(np.linalg.solve(np.eye(2) + gradient, jacobian))
        return _scatter_rows(jacobian, known, len(points))

    def _parametric_jacobian(self, points: Array) -> tuple[NDArray[np.intp], Array, Array]:
        """Linearise the projection before the residual field.

        Returns
        -------
        Indices (k,) of the sem-frame points that have a raw pixel, these pixels (k, 2), and the
        derivative (k, 2, P + F) of the pixels under the parametric distortion alone: by the P
        parameters, and, where the raw pixels stay, minus that by the F coefficients of the field.
        """
        jacobians = project_points_with_jacobians(self.parameters, points, self.raster)
        known = np.flatnonzero(np.all(np.isfinite(jacobians.xy), axis=1))
        xy = self._with_residual(jacobians.xy[known])
        found = np.all(np.isfinite(xy), axis=1)
        known, xy = known[found], xy[found]
        by = jacobians.d_parameters[known]
        if self.residual is not None:
            fields = np.zeros((len(known), 2, self.residual.coefficients.size))
            basis = self.residual.basis(self._normalised(xy))
            fields[:, 0, 0::2] = fields[:, 1, 1::2] = -self.norm_px * basis
            by = np.concatenate([by, fields], axis=2)
        return known, xy, by

    @property
    def joint_covariance(self) -> Array | None:
        """(P + F, P + F) covariance of the parameters and the coefficients of the field."""
        field = self.residual
        if self.covariance is None or field is None:
            return self.covariance
        if field.covariance is None or field.cross_covariance is None:
            return None
        return np.block(
            [
                [self.covariance, field.cross_covariance],
                [field.cross_covariance.T, field.covariance],
            ]
        )

    def sem_from_ideal(self, xy: ArrayLike, z_m: float = 0.0) -> Array:
        """Return sem-frame points (n, 3) in m, at height ``z_m``, of undistorted pixels (n, 2)."""
        points = as_points(xy, 2)
        w = 1.0 + self.rho * z_m
        if w <= 0.0:
            raise InvalidValueError(
                f"height {z_m} m", expected=f"a point below the scan pivot at {-1.0 / self.rho} m"
            )
        y = (points[:, 1] - self.py) * w / self.m * self.aspect
        x = ((points[:, 0] - self.px) * w / self.m - self.skew * y) / self.aspect
        return np.stack([x, y, np.full(len(points), float(z_m))], axis=1)

    # -- distortion -------------------------------------------------------------------------------

    @property
    def _centre(self) -> Array:
        return np.array([self.ex, self.ey])

    def _normalised(self, xy: Array) -> Array:
        """Return pixels in half image widths from the image centre, as for the residual field."""
        return (xy - self._middle) / self.norm_px

    @cached_property
    def parametric(self) -> ScanCamera:
        """The camera without its residual field."""
        return self if self.residual is None else replace(self, residual=None)

    @property
    def distorts_scan(self) -> bool:
        """Whether coils or settling distort the scan."""
        return bool(np.any(self.scan_amplitudes))

    def without_residual(self, xy: ArrayLike) -> Array:
        """Return where raw pixels (n, 2) would lie under the parametric distortion alone."""
        points = as_points(xy, 2)
        if self.residual is None:
            return points
        return points + self.norm_px * self.residual.displacement(self._normalised(points))

    @property
    def scan_key(self) -> tuple[object, ...]:
        """What the distortion of the scan depends on, for looking it up."""
        return (self.raster, *self.scan_amplitudes.tolist())

    def deflect(self, xy: ArrayLike) -> Array:
        """Return where the beam should be, px, at raw pixels (n, 2): without residual field and distortion of the scan.

        What is left is the distortion of the lens.
        """
        straight, amplitudes = self.without_residual(xy), self.scan_amplitudes
        if not np.any(amplitudes):
            return straight
        return straight + deflection_shift(straight, amplitudes, self.raster)

    def _stretch(self, xy: Array) -> Array:
        """(n, 2) derivative of the deflection along each axis by the raw pixel (n, 2) without the residual field."""
        return deflection_stretch(self.without_residual(xy), self.scan_amplitudes, self.raster)

    def _with_residual(self, xy: Array) -> Array:
        """Invert :meth:`without_residual`."""
        if self.residual is None:
            return xy
        q = self._normalised(xy)
        return xy + self.norm_px * (self.residual.inverse(q) - q)

    def distort(self, xy: ArrayLike) -> Array:
        """Distort undistorted pixels (n, 2) to raw pixels (n, 2); NaN where ``4 xi_r r2 >= 1``."""
        seen, amplitudes = self._distort_by_lens(xy), self.scan_amplitudes
        if np.any(amplitudes):
            seen = raw_from_deflection(seen, amplitudes, self.raster)
        return self._with_residual(seen)

    def _distort_by_lens(self, xy: ArrayLike) -> Array:
        q = (as_points(xy, 2) - self._centre) / self.norm_px
        return self._centre + self.norm_px * distort_normalised(q, *self._lens)

    def undistort(self, xy: ArrayLike) -> Array:
        """Undistort raw pixels (n, 2) to undistorted pixels (n, 2).

        Rows are NaN where the model has no answer; :meth:`undistort_report` says why.
        """
        return self._centre + self.norm_px * self.undistort_report(xy).q

    def undistort_report(self, xy: ArrayLike) -> Undistortion:
        """Undistort to normalised coordinates, with convergence flags and residuals."""
        q_d = (self.deflect(xy) - self._centre) / self.norm_px
        return undistort_normalised(q_d, *self._lens)

    # -- rectified pixels -------------------------------------------------------------------------

    @property
    def _middle(self) -> Array:
        """(2,) middle of the image, px, which keeps its place when the image is rectified."""
        return 0.5 * np.array([self.width - 1.0, self.height - 1.0])

    @property
    def _rect_from_ideal(self) -> Array:
        """(2, 2) matrix that takes aspect and skew out of ideal pixels and keeps their area."""
        return np.array([[1.0 / self.aspect, -self.skew], [0.0, self.aspect]])

    @property
    def _ideal_from_rect(self) -> Array:
        """(2, 2) inverse of :attr:`_rect_from_ideal`."""
        return np.array([[self.aspect, self.skew], [0.0, 1.0 / self.aspect]])

    def rect_from_ideal(self, xy: ArrayLike) -> Array:
        """Map ideal pixels (n, 2) to rectified pixels (n, 2), px.

        ``x_rect = c + [[1/a, -sigma], [0, a]] (x_u - c)`` with the middle ``c`` of the image: what
        is left of ``m [[a, sigma], [0, 1/a]]`` is m times the identity.
        """
        return self._middle + (as_points(xy, 2) - self._middle) @ self._rect_from_ideal.T

    def ideal_from_rect(self, xy: ArrayLike) -> Array:
        """Map rectified pixels (n, 2) to ideal pixels (n, 2), px: invert :meth:`rect_from_ideal`."""
        return self._middle + (as_points(xy, 2) - self._middle) @ self._ideal_from_rect.T

    def rect_from_raw(self, xy: ArrayLike) -> Array:
        """Map raw pixels (n, 2) to rectified pixels (n, 2), px; NaN where there is none."""
        return self.rect_from_ideal(self.undistort(xy))

    def raw_from_rect(self, xy: ArrayLike) -> Array:
        """Map rectified pixels (n, 2) to raw pixels (n, 2), px; NaN where there is none.

        Every rectification of an image samples it here.
        """
        return self.distort(self.ideal_from_rect(xy))

    def deflection_from_rect(self, xy: ArrayLike) -> Array:
        """Map rectified pixels (n, 2) to where the beam should be, px, as :meth:`deflect` does raw ones."""
        return self._distort_by_lens(self.ideal_from_rect(xy))

    @cached_property
    def rectified(self) -> RectifiedCamera:
        """The camera of the rectified image: square pixels, no skew, no distortion.

        Its pixel has the area of this camera's: 1/m along both axes. What is seen in the middle of
        the undistorted image is seen in the middle of the rectified one.
        """
        px, py = self.rect_from_ideal([[self.px, self.py]])[0].tolist()
        ex, ey = self.rect_from_ideal([[self.ex, self.ey]])[0].tolist()
        covariance = self.covariance
        if covariance is not None:
            covariance = _congruent(self._rectified_from_parameters, covariance)
        return RectifiedCamera(
            magnification=self.magnification,
            m=self.m,
            aspect=1.0,
            skew=0.0,
            px=px,
            py=py,
            rho=self.rho,
            xi_r=0.0,
            xi_t=0.0,
            ex=ex,
            ey=ey,
            norm_px=self.norm_px,
            width=self.width,
            height=self.height,
            covariance=covariance,
            in_range=self.in_range,
            source=self,
        )

    @property
    def _rectified_from_parameters(self) -> Array:
        """(P, P) from errors of the parameters to those of the parameters of :attr:`rectified`.

        The rectification is done with the parameters as they are estimated, so an error dM of the
        matrix ``M = m [[a, sigma], [0, 1/a]]`` is left over in the image: m (I + M^-1 dM).
        """
        matrix = np.eye(len(self.names))
        matrix[1:3, 1:3] = [
            [1.0 / self.aspect, 0.0],
            [self.skew / self.aspect**2, 1.0 / self.aspect],
        ]
        matrix[3:5, 3:5] = self._rect_from_ideal
        return matrix

    # -- matrices ---------------------------------------------------------------------------------

    @property
    def P_affine(self) -> Array:
        """(3, 4) projection of homogeneous sem-frame points (m), finite for every rho."""
        m, a = self.m, self.aspect
        return np.array(
            [
                [a * m, self.skew * m, self.rho * self.px, self.px],
                [0.0, m / a, self.rho * self.py, self.py],
                [0.0, 0.0, self.rho, 1.0],
            ]
        )

    @property
    def P_affine_covariance(self) -> Array:
        """(12, 12) covariance of :attr:`P_affine`, row by row; its units are the products of those of the elements.

        Five elements are constant, so rows and columns of zeros belong to them, and the rank is six at most. Distortion
        and residual field are no part of it.

        Raises
        ------
        InvalidValueError
            If the camera carries no covariance.
        """
        if self.covariance is None:
            raise InvalidValueError(
                "a camera without covariance", expected="a camera from Calibration.at(g)"
            )
        m, a = self.m, self.aspect
        by = np.zeros((12, 6))
        # The derivatives of the elements by m, aspect, skew, px, py and rho.
        by[0, :2] = a, m
        by[1, 0], by[1, 2] = self.skew, m
        by[2, 3], by[2, 5] = self.rho, self.px
        by[3, 3] = 1.0
        by[5, :2] = 1.0 / a, -m / a**2
        by[6, 4], by[6, 5] = self.rho, self.py
        by[7, 4] = 1.0
        by[10, 5] = 1.0
        covariance = _congruent(by, self.covariance[:6, :6])
        # Symmetric to the last bit, as readers may check.
        return np.asarray(0.5 * (covariance + covariance.T))

    @property
    def P(self) -> Array:
        """(3, 4) projection ``K [I | (0, 0, 1/rho)]`` of sem-frame points.

        Raises
        ------
        InvalidValueError
            For a parallel projection (rho <= 0), whose focal length is not finite; use
            :attr:`P_affine`.
        """
        self._require_perspective()
        return self.P_affine / self.rho

    @property
    def K(self) -> Array:
        """(3, 3) intrinsic matrix with ``f = m / rho``; raises as :attr:`P`."""
        self._require_perspective()
        return self.P[:, :3].copy()

    def _require_perspective(self) -> None:
        if not self.rho > 0.0:
            raise InvalidValueError(
                f"inverse pivot distance {self.rho} 1/m",
                expected="a positive one for K and P",
                do="use P_affine, which also holds for a parallel projection",
            )

    @property
    def ideal_from_sem_jacobian(self) -> Array:
        """(2, 2) derivative of undistorted pixels by (X, Y) on the reference plane, px per m."""
        return self.m * np.array([[self.aspect, self.skew], [0.0, 1.0 / self.aspect]])

    @property
    def pixel_size_m(self) -> tuple[float, float]:
        """Size (x, y) in m of an undistorted pixel at the reference plane.

        These are the steps in X and Y of the sem frame that move the image by one pixel along its
        columns and rows.
        """
        return 1.0 / (self.m * self.aspect), self.aspect / self.m

    @property
    def pixel_size_sigma_m(self) -> tuple[float, float]:
        """1-sigma of :attr:`pixel_size_m`, m; raises as :meth:`project_sigma`."""
        if self.covariance is None:
            raise InvalidValueError(
                "a camera without covariance", expected="a camera from Calibration.at(g)"
            )
        x, y = self.pixel_size_m
        gradient_x = np.array([-1.0 / self.m, -1.0 / self.aspect])
        gradient_y = np.array([-1.0 / self.m, 1.0 / self.aspect])
        block = self.covariance[:2, :2]
        return (
            x * float(np.sqrt(max(gradient_x @ block @ gradient_x, 0.0))),
            y * float(np.sqrt(max(gradient_y @ block @ gradient_y, 0.0))),
        )

    # -- other image sizes ------------------------------------------------------------------------

    def resized(self, width: int, height: int) -> ScanCamera:
        """Return the camera of the same field of view sampled with another number of pixels.

        The field width and the shape of the pixels are kept, so a change of the height-to-width
        ratio crops or extends the field symmetrically about the image centre.
        """
        if (width, height) == (self.width, self.height):
            return self
        if width < 1 or height < 1:
            raise InvalidValueError(f"image size {width} x {height}", expected="positive numbers")
        s = width / self.width
        shift_y = 0.5 * (height - s * self.height)

        def x_resized(x: float) -> float:
            return (x + 0.5) * s - 0.5

        def y_resized(y: float) -> float:
            return (y + 0.5) * s - 0.5 + shift_y

        factors = np.array([s if name in _IN_PX else 1.0 for name in self.names])
        covariance, residual = self.covariance, self.residual
        if covariance is not None:
            covariance = covariance * np.outer(factors, factors)
        if residual is not None and residual.cross_covariance is not None:
            residual = replace(
                residual, cross_covariance=residual.cross_covariance * factors[:, None]
            )
        return replace(
            self,
            m=self.m * s,
            px=x_resized(self.px),
            py=y_resized(self.py),
            ex=x_resized(self.ex),
            ey=y_resized(self.ey),
            norm_px=self.norm_px * s,
            raster_ratio=self.raster.ratio,
            width=int(width),
            height=int(height),
            covariance=covariance,
            residual=residual,
        )


@dataclass(frozen=True)
class RectifiedCamera(ScanCamera):
    """The camera of a rectified image, as :attr:`ScanCamera.rectified` makes it.

    Its raw, ideal and rectified pixels are the same: those of the rectified image. So ``project``
    says where a point of the sem frame is seen in ``image_rect``.

    The image is rectified with the parameters as they are estimated, and their errors stay in it.
    ``covariance`` is that of the rectified image's own m, aspect, skew, px, py and rho, followed by
    the parameters of the distortion that was taken out; in :attr:`joint_covariance` and
    :meth:`project_jacobian` the coefficients of the residual field that was taken out come last.

    Parameters
    ----------
    source
        The camera of the raw image.
    """

    source: ScanCamera = field(kw_only=True, repr=False, compare=False)

    @property
    def rectified(self) -> RectifiedCamera:
        """The camera itself."""
        return self

    def resized(self, width: int, height: int) -> RectifiedCamera:
        """Return the rectified camera of the resized :attr:`source`."""
        return self.source.resized(width, height).rectified

    @property
    def joint_covariance(self) -> Array | None:
        """As :attr:`ScanCamera.joint_covariance`, after the rectification."""
        covariance = self.source.joint_covariance
        if covariance is None:
            return None
        return _congruent(
            _extend(self.source._rectified_from_parameters, len(covariance)), covariance
        )

    def project_jacobian(self, xyz_m: ArrayLike) -> Array:
        """Return the derivative (n, 2, P + F) of the rectified pixel of a point.

        The point is seen at a raw pixel that depends on the true parameters, which is then mapped
        with the estimated ones.
        """
        source, points = self.source, as_points(xyz_m, 3)
        known, xy, by = source._parametric_jacobian(points)
        q = (source.project_ideal(points[known]) - source._centre) / source.norm_px
        # The residual field displaces a pixel and is inverted at the same place: it cancels.
        by = by * source._stretch(xy)[:, :, None]
        lens = distort_jacobians(q, *source._lens, points_only=True)[1]
        by = source._rect_from_ideal @ np.linalg.solve(lens, by)
        by_rectified = by @ np.linalg.inv(_extend(source._rectified_from_parameters, by.shape[2]))
        return _scatter_rows(by_rectified, known, len(points))


def _congruent(matrix: Array, covariance: Array) -> Array:
    """Covariance after a linear map."""
    return np.asarray(matrix @ covariance @ matrix.T)


def _extend(matrix: Array, size: int) -> Array:
    """The matrix as the first block of one that is the identity elsewhere."""
    extended = np.eye(size)
    extended[: len(matrix), : len(matrix)] = matrix
    return extended


def _scatter_rows(values: Array, rows: NDArray[np.intp], size: int) -> Array:
    """Array of ``size`` rows with values in some of them, NaN in the others."""
    scattered = np.full((size, *values.shape[1:]), np.nan)
    scattered[rows] = values
    return scattered
