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

"""A calibration as continuous functions of the magnification, with its covariance; and a nominal one from pixel sizes.

A nominal calibration is what a microscopist has who knows nm per pixel at some magnifications, from the maker or from a
scale bar: no distortion, a parallel projection, and the uncertainty of both.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from semcal_ros.core.arrays import Array, check_positive
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.projection import ALL_NAMES, PARAMETER_NAMES
from semcal_ros.core.camera.records import FitRecord, LadderRecord, Provenance
from semcal_ros.core.camera.residual_field import ResidualField
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.thresholds import CONTRADICTION_SIGMAS, USUAL_CHANGES
from semcal_ros.core.errors import InvalidValueError

#: What tells a camera: a grid, a specimen, or neither.
Origin = Literal["grid", "specimen", "extrapolated"]

# The scale is kept relative to the nominal one, width g / display width, so that it is a number
# near 1 at every g.
ALL_FUNCTIONS: tuple[str, ...] = ("scale", *ALL_NAMES[1:])
"""The functions of a calibration, in the order of the parameters of the camera."""
FUNCTION_NAMES: tuple[str, ...] = ALL_FUNCTIONS[: len(PARAMETER_NAMES)]
"""Those that every calibration has."""
TERM_NAMES: tuple[str, ...] = ALL_NAMES[len(PARAMETER_NAMES) :]
"""Those that a calibration need not have; the parameter is zero then."""


def names_of(functions: Mapping[str, ContinuousFunction]) -> tuple[str, ...]:
    """Return the names of the functions that are there, in the order of ``ALL_FUNCTIONS``."""
    return tuple(name for name in ALL_FUNCTIONS if name in functions)


def _parameters_of(names: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the parameters of a camera whose functions have these names."""
    return FUNCTION_NAMES if set(names) == set(FUNCTION_NAMES) else ALL_FUNCTIONS


def columns_of(functions: Mapping[str, ContinuousFunction]) -> dict[str, slice]:
    """Return where the coefficients of each function stand among those of all, in the order of ``ALL_FUNCTIONS``."""
    names = names_of(functions)
    stops = np.cumsum([functions[name].size for name in names])
    return {
        name: slice(int(stop) - functions[name].size, int(stop))
        for name, stop in zip(names, stops, strict=True)
    }


def stack_coefficients(functions: Mapping[str, ContinuousFunction]) -> Array:
    """Return (K,) the coefficients of all functions, as in :func:`columns_of`."""
    return np.concatenate([functions[name].coefficients for name in names_of(functions)])


def with_coefficients(
    functions: Mapping[str, ContinuousFunction], values: Array
) -> dict[str, ContinuousFunction]:
    """Return the functions with coefficients from a vector as of :func:`stack_coefficients`, or a longer one."""
    return {
        name: replace(functions[name], coefficients=values[own].copy())
        for name, own in columns_of(functions).items()
    }


def checked_magnification(magnification: float) -> float:
    """Return the magnification as a float.

    Raises
    ------
    InvalidValueError
        If it is not finite and positive.
    """
    return check_positive(magnification, "magnification")


def design_matrix(
    functions: Mapping[str, ContinuousFunction],
    g: float,
    nominal_px_per_m: float,
    rows: Sequence[str] | None = None,
) -> Array:
    """Return the (P, K) matrix from all coefficients to the camera parameters at ``g``.

    The coefficients are in the order of ``ALL_FUNCTIONS``. The parameters are those of ``rows``, which are names of
    functions that need not be there; without ``rows`` they are those of the camera at ``g``.
    """
    known: dict[object, Array] = {}
    columns = columns_of(functions)
    if rows is None:
        rows = _parameters_of(columns)
    place = {name: row for row, name in enumerate(rows)}
    matrix = np.zeros((len(rows), sum(functions[name].size for name in columns)))
    for name, own in columns.items():
        function = functions[name]
        # Most functions share their basis.
        key = function.basis_key
        if key not in known:
            known[key] = function.basis(g)
        row = known[key] * nominal_px_per_m if name == "scale" else known[key]
        matrix[place[name], own] = row
    return matrix


@dataclass(frozen=True)
class ScaleSigma:
    """What adds to the uncertainty of the scale, beyond the covariance of the calibration.

    Each is common to a whole picture, so no number of calibration images makes it smaller.

    Attributes
    ----------
    repeatability
        Relative 1-sigma with which the scale comes back when a magnification is set again.
    grid
        Relative 1-sigma of the size of the squares, from the grid's certificate.
    height_m
        1-sigma of the height of what is measured, about the plane of the untilted grid, m.
    """

    repeatability: float = 0.0
    grid: float = 0.0
    height_m: float = 0.0

    def __post_init__(self) -> None:
        for name in ("repeatability", "grid", "height_m"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value >= 0.0):
                raise InvalidValueError(f"{name} {value}", expected="a number of at least 0")

    def relative(self, rho: float) -> float:
        """Return the relative 1-sigma of the scale of a camera with the inverse pivot distance."""
        return float(np.hypot(np.hypot(self.repeatability, self.grid), rho * self.height_m))


@dataclass(frozen=True)
class CalibrationModel:
    """Camera of the microscope at every magnification.

    Attributes
    ----------
    functions
        One :class:`ContinuousFunction` per name in ``ALL_FUNCTIONS``; those of ``TERM_NAMES`` may be missing.
    covariance
        (K, K) covariance of all coefficients, in the order of ``ALL_FUNCTIONS``, then of the
        residual field.
    image_width, image_height
        Size in px of the calibration images (without databar).
    display_width_m
        Width of the display to which "magnification" refers, m.
    magnifications
        The calibrated magnifications, ascending.
    method
        "joint", "discrete" or "pda".
    statistics
        Description of the calibration for its reader: views, corners, residuals, held-out errors,
        priors and gauge, convergence, warnings. Plain numbers, strings, lists and dicts.
    residual
        Distortion that the parameters do not describe, or None.
    scale_sigma
        Uncertainty of the scale beyond the covariance.
    record
        What the fit leaves for checks, updates and plans; None for a calibration that was not fitted to views, and for
        old files that do not say it.
    provenance
        Where it comes from.
    ladder
        How it was extended beyond the grid, or None where it was not.
    """

    functions: Mapping[str, ContinuousFunction]
    covariance: Array
    image_width: int
    image_height: int
    display_width_m: float
    magnifications: tuple[float, ...]
    method: str
    statistics: Mapping[str, Any] = field(default_factory=dict)
    residual: ResidualField | None = None
    scale_sigma: ScaleSigma = ScaleSigma()
    record: FitRecord | None = None
    provenance: Provenance = field(default_factory=Provenance)
    ladder: LadderRecord | None = None

    def __post_init__(self) -> None:
        missing = [name for name in FUNCTION_NAMES if name not in self.functions]
        if missing:
            raise InvalidValueError(
                f"a calibration without {', '.join(missing)}", expected=", ".join(FUNCTION_NAMES)
            )
        size = len(self.coefficients)
        size += 0 if self.residual is None else self.residual.size
        if self.covariance.shape != (size, size):
            raise InvalidValueError(
                f"covariance of shape {self.covariance.shape}", expected=f"({size}, {size})"
            )
        if not self.magnifications or list(self.magnifications) != sorted(self.magnifications):
            raise InvalidValueError(
                f"magnifications {self.magnifications}", expected="an ascending, non-empty list"
            )

    @property
    def magnification_range(self) -> tuple[float, float]:
        """Lowest and highest calibrated magnification."""
        return self.magnifications[0], self.magnifications[-1]

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) in px."""
        return self.image_width, self.image_height

    @cached_property
    def coefficients(self) -> Array:
        """(K,) all coefficients of the functions, as in :func:`columns_of`."""
        return stack_coefficients(self.functions)

    @property
    def coefficient_covariance(self) -> Array:
        """(K, K) their covariance, without that of the residual field."""
        size = len(self.coefficients)
        return self.covariance[:size, :size]

    @cached_property
    def principal_components(self) -> Array:
        """(K, K) one sigma of each principal component of the coefficients: their covariance is this times its
        transpose.
        """
        variances, directions = np.linalg.eigh(self.coefficient_covariance)
        return np.asarray(directions * np.sqrt(np.maximum(variances, 0.0)), dtype=np.float64)

    @property
    def norm_px(self) -> float:
        """Normalisation of the distortion: half the image width, px."""
        return 0.5 * self.image_width

    def nominal_px_per_m(self, g: float) -> float:
        """Return the scale in px per m that the display width alone predicts."""
        return g * self.image_width / self.display_width_m

    def at(self, magnification: float) -> ScanCamera:
        """Return the camera at a magnification.

        Outside :attr:`magnification_range` the functions continue along their tangents in log g,
        ``in_range`` is False, and the covariance grows with the distance from the range. The
        covariance is that of the next time that this magnification is set: it contains
        :attr:`scale_sigma`, and what the :attr:`ladder` adds beyond the grid.

        Raises
        ------
        InvalidValueError
            If the magnification is not finite and positive, or so far out of range that no camera
            results.
        """
        g = checked_magnification(magnification)
        low, high = self.magnification_range
        in_range = bool(low * (1 - 1e-9) <= g <= high * (1 + 1e-9))
        design = design_matrix(self.functions, g, self.nominal_px_per_m(g))
        theta = self.coefficients
        size = len(theta)
        covariance = design @ self.covariance[:size, :size] @ design.T
        residual = None
        if self.residual is not None:
            spread, cross = self.covariance[size:, size:], design @ self.covariance[:size, size:]
            residual = self.residual.at(g, spread, cross)
        if not in_range:
            with np.errstate(over="ignore"):  # the camera refuses what is not finite
                covariance = covariance + self._extrapolation_covariance(g)
        parameters = design @ theta
        with np.errstate(over="ignore"):
            covariance[0, 0] += (parameters[0] * self.scale_sigma.relative(parameters[5])) ** 2
            covariance[0, 0] += (parameters[0] * self.ladder_sigma(g)) ** 2
        values = dict(zip(ALL_NAMES, parameters.tolist(), strict=False))
        try:
            return ScanCamera(
                magnification=g,
                **values,
                norm_px=self.norm_px,
                width=self.image_width,
                height=self.image_height,
                covariance=covariance,
                in_range=in_range,
                residual=residual,
            )
        except InvalidValueError as error:
            raise InvalidValueError(
                f"magnification {g:g}, where the calibration has no meaningful camera",
                expected=f"a magnification near the calibrated range {low:g} to {high:g}",
                do="calibrate there",
            ) from error

    def origin_of(self, magnification: float) -> Origin:
        """What tells the camera at a magnification: a grid, a specimen, or nothing but the course of the functions."""
        g = checked_magnification(magnification)
        low, high = self.magnification_range
        if not low * (1 - 1e-9) <= g <= high * (1 + 1e-9):
            return "extrapolated"
        if self.method == "specimen" or (self.ladder is not None and self.ladder.beyond(g) > 1e-9):
            return "specimen"
        return "grid"

    def ladder_sigma(self, magnification: float) -> float:
        """Relative 1-sigma of the scale that a ladder adds beyond the grid; 0 without one."""
        if self.ladder is None:
            return 0.0
        g = checked_magnification(magnification)
        return float(np.hypot(self.ladder.growth_sigma(g), self.ladder.relay_sigma(g)))

    def extrapolation_sigma(self, magnification: float) -> float:
        """Relative 1-sigma of the scale that a magnification outside the calibrated range adds; 0 inside."""
        g = checked_magnification(magnification)
        low, high = self.magnification_range
        if low * (1 - 1e-9) <= g <= high * (1 + 1e-9):
            return 0.0
        return float(np.sqrt(self._extrapolation_covariance(g)[0, 0]) / self.at(g).m)

    def _extrapolation_covariance(self, g: float) -> Array:
        """Return a diagonal (P, P) allowance for the unknown course of the functions.

        The 1-sigma of a parameter is twice its variation over the calibrated range (highest minus
        lowest value), times the distance from the range in log g over the length of the range in
        log g. A range shorter than a factor of e counts as one of a factor of e, and tells the less of the variation,
        the shorter it is: the rest is what is usual, :data:`USUAL_CHANGES`. So the sigma grows
        linearly from zero at the edge, and the variance with the square of the distance.
        """
        low, high = self.magnification_range
        edge = low if g < low else high
        span = max(float(np.log(high / low)), 1.0)
        distance = abs(float(np.log(g / edge))) / span
        grid = np.geomspace(low, high, 33)
        names = names_of(self.functions)
        sigma = np.zeros(len(_parameters_of(names)))
        for name in names:
            values = [self.functions[name](x) for x in grid]
            seen = 2.0 * (max(values) - min(values))
            unseen = (1.0 - float(np.log(high / low)) / span) * self._usual_change(name)
            sigma[ALL_FUNCTIONS.index(name)] = np.hypot(seen, unseen) * distance
        sigma[0] *= self.nominal_px_per_m(g)
        return np.diag(sigma**2)

    def _usual_change(self, name: str) -> float:
        """By how much a function changes over a factor of e; those that are the same at all magnifications do not."""
        if name in ("px", "py", "rho"):
            return 0.0
        change = USUAL_CHANGES.get(name, USUAL_CHANGES["xi_t"])
        return 0.5 * self.image_width * change if name in ("ex", "ey") else change


def pixel_size_gradient(model: CalibrationModel, magnification: float) -> Array:
    """(2, K) relative change of the pixel size along x and y per unit of the coefficients of the functions."""
    camera = model.at(magnification)
    design = design_matrix(model.functions, magnification, model.nominal_px_per_m(magnification))
    scale, aspect = design[0] / camera.m, design[1] / camera.aspect
    return np.stack([-scale - aspect, -scale + aspect])


@dataclass(frozen=True)
class KnownPixelSize:
    """The pixel size at a magnification.

    Attributes
    ----------
    magnification
        The magnification.
    pixel_size_m
        Size of a pixel, m.
    relative_sigma
        Its relative 1-sigma, along each axis.
    where
        Where it stands, for errors.
    """

    magnification: float
    pixel_size_m: float
    relative_sigma: float
    where: str = ""


def make_nominal_calibration(
    sizes: Sequence[KnownPixelSize],
    image_size: tuple[int, int],
    display_width_m: float | None = None,
) -> CalibrationModel:
    """Make a calibration that knows nm per pixel only.

    Between two magnifications, the ratio to the nominal scale is linear in log g. The errors of all sizes count as
    common: they come from one maker or one standard. The distortion is zero with the 1-sigma of an
    uncalibrated microscope (:meth:`.ScanCamera.nominal`).

    Parameters
    ----------
    sizes
        At least one, in any order; the calibration covers their magnifications.
    image_size
        (width, height) of the images whose pixels they are, px.
    display_width_m
        Width of the display that the magnification refers to, m; by default, the one that fits the sizes.

    Raises
    ------
    InvalidValueError
        For no sizes, numbers that are not positive, sizes that do not fall with the magnification, or two for one
        magnification that contradict.
    """
    if not sizes:
        raise InvalidValueError("no pixel sizes", expected="at least one")
    for size in sizes:
        for value, name in (
            (size.magnification, "magnification"),
            (size.pixel_size_m, "pixel size"),
            (size.relative_sigma, "1-sigma of the pixel size"),
        ):
            if not (math.isfinite(value) and value > 0.0):
                raise InvalidValueError(
                    f"{size.where}{name} {value:g}", expected="a number above 0"
                )
    known = _merge(sizes)
    width, height = image_size
    products = [one.magnification * one.pixel_size_m * width for one in known]
    display = display_width_m or float(np.median(products))
    g = np.array([one.magnification for one in known])
    ratio = np.array([display / product for product in products])
    sigma = np.array([one.relative_sigma for one in known])
    span = (float(g[0]), float(g[-1]))
    plain = ScanCamera.nominal(1.0, width, height, display)
    functions = {
        name: ContinuousFunction("linear_log", np.array([value]), span, np.array([g[0]]))
        for name, value in zip(FUNCTION_NAMES, plain.parameters.tolist(), strict=True)
    }
    functions["scale"] = ContinuousFunction("linear_log", ratio, span, g)
    assert plain.covariance is not None
    variance = np.diag(plain.covariance).copy()
    # Half of the variance of a pixel size along one axis is that of the scale, half that of the aspect ratio.
    scale_sigma = ratio * sigma / math.sqrt(2.0)
    variance[1] = float(np.max(sigma)) ** 2 / 2.0
    count = len(g)
    covariance = np.zeros((count + len(variance) - 1,) * 2)
    covariance[:count, :count] = np.outer(scale_sigma, scale_sigma)
    covariance[count:, count:] = np.diag(variance[1:])
    return CalibrationModel(
        functions=functions,
        covariance=covariance,
        image_width=width,
        image_height=height,
        display_width_m=display,
        magnifications=tuple(g.tolist()),
        method="table",
        statistics={
            "warnings": [
                "scale: from a table of pixel sizes, not calibrated: distortion and perspective are not known"
            ]
        },
    )


def _merge(sizes: Sequence[KnownPixelSize]) -> list[KnownPixelSize]:
    """Return the sizes in order of the magnification, those of equal magnification averaged."""
    known: list[KnownPixelSize] = []
    for size in sorted(sizes, key=lambda one: one.magnification):
        if known and known[-1].magnification == size.magnification:
            known[-1] = _average(known[-1], size)
            continue
        if known and size.pixel_size_m >= known[-1].pixel_size_m:
            raise InvalidValueError(
                f"{size.where}{1e9 * size.pixel_size_m:g} nm per px at {size.magnification:g}x and "
                f"{1e9 * known[-1].pixel_size_m:g} at {known[-1].magnification:g}x",
                expected="a pixel size that falls with the magnification",
            )
        known.append(size)
    return known


def _average(first: KnownPixelSize, second: KnownPixelSize) -> KnownPixelSize:
    joint = math.hypot(first.relative_sigma, second.relative_sigma)
    if abs(math.log(second.pixel_size_m / first.pixel_size_m)) > CONTRADICTION_SIGMAS * joint:
        raise InvalidValueError(
            f"{second.where}{1e9 * second.pixel_size_m:g} and {1e9 * first.pixel_size_m:g} nm per px at "
            f"{first.magnification:g}x",
            expected="one pixel size for a magnification, or sizes that agree within their sigma",
        )
    mean = math.sqrt(first.pixel_size_m * second.pixel_size_m)
    sigma = max(first.relative_sigma, second.relative_sigma)
    return KnownPixelSize(first.magnification, mean, sigma, first.where)
