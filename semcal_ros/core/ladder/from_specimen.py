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

"""Calibrate without a grid: pictures of one flat, textured specimen, and one known pixel size.

Moved pictures tell the distortion, turned scans aspect and skew, and zooms the ratios of the scales, as in a ladder
beyond a grid (:mod:`semcal_ros.core.ladder.extend`). Nothing of that knows a metre: all places on the specimen, and all
pixel sizes, may be multiplied by one number. So the adjustment is made with a scale that is held, and the pixel size
that is known at one magnification multiplies it afterwards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from semcal_ros.core.arrays import Array, check_positive, check_range
from semcal_ros.core.camera.calibration_model import CalibrationModel, ScaleSigma, names_of
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.ladder_record import LadderRecord
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import CalibrationError, InvalidValueError
from semcal_ros.core.ladder.extend import (
    LARGEST_STEP,
    LadderPicture,
    LadderStep,
    RejectedPair,
    describe_ladder,
    describe_steps,
    make_model,
    measure_ladder,
)

__all__ = [
    "METHOD",
    "KnownLength",
    "ScaleAnchor",
    "SpecimenCalibration",
    "calibrate_from_specimen",
]

#: The method of the calibration, as its file says it.
METHOD = "specimen"
# The lowest two magnifications are where the functions begin: constants and slopes there, bends beyond.
_LEAST_MAGNIFICATIONS = 3
_ROUNDING = 1.02
# Prior 1-sigma of the constants: those of an instrument that nobody knows; relative, in normalised coordinates, or, of
# centres, in image widths.
_CONSTANTS = {"aspect": 0.01, "skew": 0.01, "xi_r": 0.03, "xi_t": 0.01, "ex": 0.08, "ey": 0.08}
# And of their change over the first step.
_SLOPES = {
    "scale": 0.01,
    "aspect": 3e-3,
    "skew": 3e-3,
    "xi_r": 5e-3,
    "xi_t": 2e-3,
    "ex": 0.02,
    "ey": 0.02,
}
# The scale is held to this while the pictures are adjusted; then the known pixel size multiplies it.
_HELD = 1e-6
# Principal point, in image widths, and pivot (1/m), which flat pictures do not show: as in a calibration by a grid.
_PRINCIPAL_POINT, _PIVOT, _PIVOT_SIGMA = 0.08, 50.0, 60.0
# A place that is pointed at by hand is known to half a pixel; a length of fewer pixels than these says too little.
_EDGE_SIGMA_PX, _LEAST_LENGTH_PX = 0.5, 20.0
# How well a magnification comes back where nothing tells it, and the height of what is measured, m: as there.
_REPEATABILITY, _HEIGHT_M = 1e-3, 1e-5


@dataclass(frozen=True)
class ScaleAnchor:
    """A known pixel size.

    Attributes
    ----------
    pixel_size_m
        Side of a pixel of the pictures, of an area of one pixel.
    magnification
        Where it is known.
    sigma
        Its relative 1-sigma.
    """

    pixel_size_m: float
    magnification: float
    sigma: float

    def __post_init__(self) -> None:
        check_positive(self.pixel_size_m, "pixel size", "m")
        check_positive(self.magnification, "magnification")
        if self.sigma != 0.0:
            check_range(self.sigma, "relative 1-sigma of a pixel size", 1e-6, 0.2)


@dataclass(frozen=True)
class KnownLength:
    """A known length between two pixels of a picture.

    Attributes
    ----------
    length_m
        The length.
    picture
        Number of the picture.
    start_xy, end_xy
        The raw pixels.
    sigma
        Relative 1-sigma of the length itself.
    """

    length_m: float
    picture: int
    start_xy: tuple[float, float]
    end_xy: tuple[float, float]
    sigma: float

    def __post_init__(self) -> None:
        check_positive(self.length_m, "length", "m")
        if self.pixels < _LEAST_LENGTH_PX:
            raise InvalidValueError(
                f"a length of {self.pixels:.3g} px",
                expected=f"{_LEAST_LENGTH_PX:g} px or more",
                do="choose two places farther apart",
            )

    @property
    def pixels(self) -> float:
        """Distance of both, px."""
        return float(np.hypot(*np.subtract(self.end_xy, self.start_xy)))

    def as_anchor(self, model: CalibrationModel, magnification: float) -> ScaleAnchor:
        """The pixel size that the length means, by the distortion of a calibration of another scale."""
        camera = model.at(magnification)
        ends = camera.sem_from_ideal(camera.undistort([self.start_xy, self.end_xy]))[:, :2]
        seen_m = float(np.hypot(*(ends[1] - ends[0])))
        if not np.isfinite(seen_m):
            raise InvalidValueError(
                f"a length from pixel {self.start_xy} to {self.end_xy}",
                expected="pixels of the picture",
            )
        edges = np.sqrt(2.0) * _EDGE_SIGMA_PX / self.pixels
        return ScaleAnchor(
            self.length_m / seen_m / camera.m, magnification, float(np.hypot(self.sigma, edges))
        )


@dataclass(frozen=True, eq=False)
class SpecimenCalibration:
    """A calibration without a grid.

    Attributes
    ----------
    model
        The calibration over all magnifications of the pictures.
    steps, rejected, unused
        As of :class:`.LadderResult`.
    weaknesses
        What the recording lacks, and what the known pixel size limits.
    """

    model: CalibrationModel
    steps: tuple[LadderStep, ...]
    rejected: tuple[RejectedPair, ...]
    unused: tuple[str, ...]
    weaknesses: tuple[str, ...]


def calibrate_from_specimen(
    pictures: Sequence[LadderPicture],
    known: ScaleAnchor | KnownLength,
    *,
    display_width_m: float,
    timing: ScanTiming | None = None,
    on_progress: Callable[[str, int, int | None], object] = lambda _stage, _done, _total: None,
) -> SpecimenCalibration:
    """Calibrate from pictures of a specimen alone.

    Parameters
    ----------
    pictures
        As for :func:`.extend_calibration`, at three magnifications or more.
    known
        One known pixel size, at a magnification within the range of the pictures, or a known length in one of them.
    display_width_m
        Display width that magnifications refer to.
    timing, on_progress
        As there.

    Raises
    ------
    CalibrationError
        As there, or if there are fewer than three magnifications.
    InvalidValueError
        If the pictures differ in size, or the anchor is not one of their range.
    """
    seen = sorted({check_positive(p.magnification, "magnification") for p in pictures})
    if len(seen) < _LEAST_MAGNIFICATIONS:
        raise CalibrationError(
            f"pictures at {len(seen)} magnifications",
            expected=f"{_LEAST_MAGNIFICATIONS} or more, in steps of at most {LARGEST_STEP:g}",
            do="record more, or take a grid",
        )
    for below, above in pairwise(seen):
        if above > LARGEST_STEP * _ROUNDING * below:
            raise CalibrationError(
                f"a gap from {below:g}x to {above:g}x, a factor of {above / below:.2f}",
                expected=f"steps of at most {LARGEST_STEP:g}",
                do=f"record pictures at {np.sqrt(below * above):.0f}x, too",
            )
    if isinstance(known, ScaleAnchor):
        anchor = known
    else:
        if not 0 <= known.picture < len(pictures):
            raise InvalidValueError(
                f"a length in picture {known.picture} of {len(pictures)}",
                expected=f"0 to {len(pictures) - 1}",
            )
        at = pictures[known.picture].magnification
        # Any scale: the length corrects it when the distortion is known.
        anchor = ScaleAnchor(display_width_m / at / pictures[0].image.shape[1], at, known.sigma)
    if not seen[0] * (1 - 1e-6) <= anchor.magnification <= seen[-1] * (1 + 1e-6):
        raise InvalidValueError(
            f"a pixel size at {anchor.magnification:g}x for pictures from {seen[0]:g}x to {seen[-1]:g}x",
            expected="one at a magnification of that range",
        )
    start = _unknown_microscope(pictures[0].image.shape, seen, anchor, display_width_m)
    measured = measure_ladder(start, pictures, timing=timing, on_progress=on_progress)
    model = make_model(measured)
    if isinstance(known, KnownLength):
        anchor = known.as_anchor(model, anchor.magnification)
    model = _anchored(model, anchor)
    steps = describe_steps(measured)
    weaknesses = _find_weaknesses(steps, anchor, model)
    notes = describe_ladder(measured) | {"warnings": list(weaknesses)}
    statistics = {
        "ladder": notes,
        "warnings": list(weaknesses),
        "anchor": {
            "pixel_size_m": anchor.pixel_size_m,
            "magnification": anchor.magnification,
            "sigma": anchor.sigma,
        },
    }
    model = replace(model, statistics=statistics)
    return SpecimenCalibration(model, steps, measured.rejected, measured.unused, weaknesses)


def _unknown_microscope(
    shape: tuple[int, ...], seen: Sequence[float], anchor: ScaleAnchor, display_width_m: float
) -> CalibrationModel:
    """The prior: a microscope without distortion over the first step, and how far it may be from that."""
    height, width = shape[:2]
    # Between the lowest two magnifications the functions are straight lines in log g.
    g_range = (seen[0], seen[1])
    nominal = anchor.magnification * width / display_width_m
    means = {
        "scale": 1.0 / (anchor.pixel_size_m * nominal),
        "aspect": 1.0,
        "px": 0.5 * (width - 1),
        "py": 0.5 * (height - 1),
        "rho": _PIVOT,
        "ex": 0.5 * (width - 1),
        "ey": 0.5 * (height - 1),
    }
    unseen = {"px": _PRINCIPAL_POINT * width, "py": _PRINCIPAL_POINT * width, "rho": _PIVOT_SIGMA}
    functions, sigmas = {}, []
    for name in ("scale", "aspect", "skew", "px", "py", "rho", "xi_r", "xi_t", "ex", "ey"):
        unit = width if name in ("ex", "ey") else 1.0
        if name in unseen:
            own, spread = [means[name]], [unseen[name]]
        else:
            own = [means.get(name, 0.0), 0.0]
            constant = _HELD if name == "scale" else _CONSTANTS[name]
            spread = [constant * unit, 0.5 * _SLOPES[name] * unit]
        functions[name] = ContinuousFunction("chebyshev_log", np.array(own), g_range)
        sigmas += spread
    return CalibrationModel(
        functions=functions,
        covariance=np.diag(np.square(sigmas)),
        image_width=width,
        image_height=height,
        display_width_m=display_width_m,
        magnifications=g_range,
        method=METHOD,
        scale_sigma=ScaleSigma(repeatability=_REPEATABILITY, height_m=_HEIGHT_M),
    )


def _anchored(model: CalibrationModel, anchor: ScaleAnchor) -> CalibrationModel:
    """Multiply all scales so that the pixel size at the anchor is the known one."""
    g = anchor.magnification
    start = 0
    for name in names_of(model.functions):
        if name == "scale":
            break
        start += model.functions[name].size
    scale = model.functions["scale"]
    own = slice(start, start + scale.size)
    row, values = scale.basis(g), scale.coefficients
    wanted = 1.0 / (anchor.pixel_size_m * model.nominal_px_per_m(g))
    now = float(row @ values)
    anchored = values * (wanted / now)
    # What the pictures leave open at the anchor itself is taken out, and the error of the known size put in.
    jacobian: Array = np.eye(len(model.covariance))
    jacobian[own, own] = wanted / now * (np.eye(scale.size) - np.outer(values, row) / now)
    covariance = jacobian @ model.covariance @ jacobian.T
    covariance[own, own] += anchor.sigma**2 * np.outer(anchored, anchored)
    before = model.ladder
    assert before is not None
    ladder = LadderRecord((g, g), before.growth, before.relays)
    functions = {**model.functions, "scale": replace(scale, coefficients=anchored)}
    return replace(
        model, functions=functions, covariance=0.5 * (covariance + covariance.T), ladder=ladder
    )


def _find_weaknesses(
    steps: Sequence[LadderStep], anchor: ScaleAnchor, model: CalibrationModel
) -> tuple[str, ...]:
    found = [
        f"scale: all pixel sizes rest on the one that was stated at {anchor.magnification:g}x, whose 1-sigma of "
        f"{100.0 * anchor.sigma:.2g} % they all have; distortion, aspect and skew do not depend on it"
    ]
    turned = [step.magnification for step in steps if step.turned]
    if len(turned) < 2:
        found.append(
            "hardly any scan is turned, so that aspect and skew are held by what is usual: turn the scan by 90 degrees "
            "for a picture at every magnification"
        )
    single = [step.magnification for step in steps if step.pictures < 2]
    if single:
        listed = ", ".join(f"{g:g}x" for g in single[:4])
        found.append(f"one picture only at {listed}: nothing tells the distortion there")
    if model.ladder is not None:
        found += [
            f"the scale jumps by {100.0 * relay.jump:+.2f} % between {relay.low:g}x and {relay.high:g}x"
            for relay in model.ladder.relays
        ]
    return tuple(found)
