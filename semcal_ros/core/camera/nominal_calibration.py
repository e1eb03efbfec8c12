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

"""A calibration from pixel sizes alone: no distortion, a parallel projection, and the uncertainty of both.

It is what a microscopist has who knows nm per pixel at some magnifications, from the maker or from a scale bar.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.camera.calibration_model import FUNCTION_NAMES, CalibrationModel
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.camera.thresholds import CONTRADICTION_SIGMAS
from semcal_ros.core.errors import InvalidValueError


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
