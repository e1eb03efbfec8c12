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
that is known at one magnification multiplies it afterwards. It may come from a length, or from the moves of a stage.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from semcal_ros.core.arrays import Array, check_positive, check_range
from semcal_ros.core.calibration.stage import fit_stage_moves
from semcal_ros.core.calibration.thresholds import DISPLAY_WIDTH_LIMITS_M
from semcal_ros.core.camera.calibration_model import CalibrationModel, ScaleSigma, columns_of
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.records import LadderRecord
from semcal_ros.core.camera.scan_timing import ScanTiming
from semcal_ros.core.errors import CalibrationError, InvalidValueError
from semcal_ros.core.ladder.extend import (
    LadderMeasurement,
    LadderStep,
    describe_ladder,
    describe_steps,
    find_unrest,
    make_model,
    measure_ladder,
)
from semcal_ros.core.ladder.matching import LadderPicture, RejectedPair, check_steps
from semcal_ros.core.ladder.thresholds import (
    CONSTANT_SIGMAS,
    HEIGHT_SIGMA_M,
    LENGTH_MIN_PX,
    MAGNIFICATIONS_MIN,
    ONE_ROTATION_COS,
    PIVOT,
    PIVOT_SIGMA,
    POINTED_SIGMA_PX,
    PRINCIPAL_POINT,
    REPEATABILITY,
    SCALE_HELD,
    SLOPE_SIGMAS,
    STAGE_SIGMA_MAX,
    STEP_MAX,
)
from semcal_ros.core.ladder.unknowns import LadderSetup
from semcal_ros.core.wording import format_length

#: The method of the calibration, as its file says it.
METHOD = "specimen"


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
        if self.pixels < LENGTH_MIN_PX:
            raise InvalidValueError(
                f"a length of {self.pixels:.3g} px",
                expected=f"{LENGTH_MIN_PX:g} px or more",
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
        edges = np.sqrt(2.0) * POINTED_SIGMA_PX / self.pixels
        return ScaleAnchor(
            self.length_m / seen_m / camera.m, magnification, float(np.hypot(self.sigma, edges))
        )


@dataclass(frozen=True, eq=False)
class StageMoves:
    """Where a trusted stage was at each picture.

    Attributes
    ----------
    position_m
        (M, 2) x and y of the stage without tilt; not finite where it was not known.
    time_s
        (M,) when the pictures were taken.
    sigma
        Relative 1-sigma of the length of a move.
    """

    position_m: Array
    time_s: Array
    sigma: float

    def __post_init__(self) -> None:
        check_range(self.sigma, "relative 1-sigma of the moves of a stage", 1e-6, 0.2)
        if self.position_m.shape != (len(self.time_s), 2):
            raise InvalidValueError(
                f"positions of the shape {self.position_m.shape} at {len(self.time_s)} times",
                expected="x and y for each",
            )

    def as_anchor(self, measured: LadderMeasurement, numbers: Sequence[int]) -> ScaleAnchor:
        """The pixel size that the moves mean, at the lowest magnification, where they are longest.

        Where the pictures lie on the specimen is compared with where the stage was: a turn or a reflection, one length,
        and a steady drift (:func:`.fit_stage_moves`). Only moves at one magnification with one rotation of the scan are
        compared: about which pixel a scan turns and zooms is not known.

        Parameters
        ----------
        measured
            A ladder whose scale is held.
        numbers
            Which of the pictures each of its pictures is.

        Raises
        ------
        CalibrationError
            If the stage is known for too few pictures, or did not move with them.
        """
        setup, poses = measured.setup, measured.fit.state.poses
        pixels = np.array([setup.pixel_m(picture.magnification) for picture in setup.pictures])
        cos, sin = np.cos(poses[:, 0]), np.sin(poses[:, 0])
        shift = pixels[:, None] * poses[:, 1:3]
        # The place in the middle: what is seen at x is R x + shift.
        places = -np.stack(
            [cos * shift[:, 0] + sin * shift[:, 1], cos * shift[:, 1] - sin * shift[:, 0]], axis=1
        )
        position, time = self.position_m[list(numbers)], self.time_s[list(numbers)]
        position, places, time, lost = _within_levels(setup, poses[:, 0], position, places, time)
        try:
            found = fit_stage_moves(position, places, time, 1.0)
            freedom = (len(time) - 4.0) / check_positive(len(time) - 3.0 - lost, "spare moves")
        except InvalidValueError as error:
            raise CalibrationError(
                f"moves of the stage that tell no length: {error}",
                expected="x and y of an untilted stage for five pictures or more, moved by it and not by the beam",
                do="give --pixel-size or --length instead",
            ) from error
        ratios = 1.0 + np.array([found.scale_x, found.scale_y])
        # The places of the middles take freedom, too.
        spreads = np.sqrt(freedom) * np.array([found.scale_x_sigma, found.scale_y_sigma])
        weights = (
            spreads**-2.0 / np.sum(spreads**-2.0) if np.all(spreads > 0.0) else np.full(2, 0.5)
        )
        ratio = float(weights @ ratios)
        fitted = float(np.sqrt(np.sum((weights * spreads) ** 2))) / ratio
        if not fitted < STAGE_SIGMA_MAX or abs(ratios[1] - ratios[0]) > 5.0 * np.hypot(
            np.hypot(*spreads), 2.0 * self.sigma
        ):
            raise CalibrationError(
                f"moves of the stage that do not fit the pictures: {100.0 * ratios[0]:.1f} % of their length along x, "
                f"{100.0 * ratios[1]:.1f} % along y, +- {100.0 * fitted:.1f} %",
                expected="a stage that says where it is, and pictures that were moved by it, not by the beam",
                do="give --pixel-size or --length instead",
            )
        g = min(picture.magnification for picture in setup.pictures)
        row = setup.design(g)[0] @ measured.fit.state.theta
        return ScaleAnchor(1.0 / (float(row) * ratio), g, float(np.hypot(self.sigma, fitted)))


def _within_levels(
    setup: LadderSetup, angles: Array, position: Array, places: Array, time: Array
) -> tuple[Array, Array, Array, int]:
    """Positions, places and times of pictures from the mean of their level, and the number of levels.

    A level has the pictures of one magnification that are not turned against its first one and whose position is known.
    """
    magnifications = np.array([picture.magnification for picture in setup.pictures])
    known = np.all(np.isfinite(position), axis=1)
    rows: list[Array] = []
    count = 0
    for g in np.unique(magnifications):
        own = np.flatnonzero(known & (magnifications == g))
        own = own[np.cos(angles[own] - angles[own[:1]]) > ONE_ROTATION_COS]
        if len(own) > 1:
            level = np.column_stack([position[own], places[own], time[own]])
            rows.append(level - level.mean(axis=0))
            count += 1
    table = np.concatenate(rows) if rows else np.empty((0, 5))
    return table[:, :2], table[:, 2:4], table[:, 4], count


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
    known: ScaleAnchor | KnownLength | StageMoves,
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
        One known pixel size, at a magnification within the range of the pictures, or a known length in one of them,
        or where a stage was whose moves are known.
    display_width_m
        Display width that magnifications refer to.
    timing, on_progress
        As there.

    Raises
    ------
    CalibrationError
        As there, or if there are fewer than three magnifications, or the moves of the stage do not fit.
    InvalidValueError
        If the pictures differ in size, or the anchor is not one of their range.
    """
    seen = sorted({check_positive(p.magnification, "magnification") for p in pictures})
    if len(seen) < MAGNIFICATIONS_MIN:
        raise CalibrationError(
            f"pictures at {len(seen)} magnifications",
            expected=f"{MAGNIFICATIONS_MIN} or more, in steps of at most {STEP_MAX:g}",
            do="record more, or take a grid",
        )
    check_steps(seen)
    if isinstance(known, ScaleAnchor):
        anchor = known
    elif isinstance(known, StageMoves):
        if len(known.time_s) != len(pictures):
            raise InvalidValueError(
                f"{len(known.time_s)} positions of the stage for {len(pictures)} pictures",
                expected="one for each",
            )
        # Any scale: the moves correct it when the places of the pictures are known.
        anchor = ScaleAnchor(
            display_width_m / seen[0] / pictures[0].image.shape[1], seen[0], known.sigma
        )
    else:
        if not 0 <= known.picture < len(pictures):
            raise InvalidValueError(
                f"a length in picture {known.picture} of {len(pictures)}",
                expected=f"0 to {len(pictures) - 1}",
            )
        size = pictures[known.picture].image.shape[1::-1]
        ends = np.array([known.start_xy, known.end_xy])
        if not np.all((ends >= 0.0) & (ends <= np.subtract(size, 1))):
            raise InvalidValueError(
                f"a length from pixel {known.start_xy} to {known.end_xy} of a picture of {size[0]} x {size[1]} px",
                expected="two pixels of the picture",
            )
        at = pictures[known.picture].magnification
        # Any scale: the length corrects it when the distortion is known.
        anchor = ScaleAnchor(display_width_m / at / pictures[0].image.shape[1], at, known.sigma)
    if not seen[0] * (1 - 1e-6) <= anchor.magnification <= seen[-1] * (1 + 1e-6):
        raise InvalidValueError(
            f"a pixel size at {anchor.magnification:g}x for pictures from {seen[0]:g}x to {seen[-1]:g}x",
            expected="one at a magnification of that range",
        )
    _check_display_width(anchor, pictures[0].image.shape[1])
    start = _unknown_microscope(pictures[0].image.shape, seen, anchor, display_width_m)
    measured = measure_ladder(
        start, pictures, timing=timing, on_progress=on_progress, calibrated=False
    )
    model = make_model(measured)
    if isinstance(known, KnownLength):
        anchor = known.as_anchor(model, anchor.magnification)
    elif isinstance(known, StageMoves):
        anchor = known.as_anchor(measured, measured.numbers)
    _check_display_width(anchor, pictures[0].image.shape[1])
    model = _anchored(model, anchor)
    steps = describe_steps(measured)
    weaknesses = (*find_unrest(measured), *_find_weaknesses(steps, anchor, model))
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


def _check_display_width(anchor: ScaleAnchor, width_px: int) -> None:
    """Refuse a known size that no microscope has: as a rule, another unit."""
    width_m = anchor.pixel_size_m * anchor.magnification * width_px
    low, high = DISPLAY_WIDTH_LIMITS_M
    if not low <= width_m <= high:
        raise InvalidValueError(
            f"a pixel size of {format_length(anchor.pixel_size_m)} at {anchor.magnification:g}x, that is, a display of "
            f"{width_m:.3g} m",
            expected=f"one of {low:g} to {high:g} m",
            do="check the unit of the known size, and the magnification",
        )


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
        "rho": PIVOT,
        "ex": 0.5 * (width - 1),
        "ey": 0.5 * (height - 1),
    }
    unseen = {"px": PRINCIPAL_POINT * width, "py": PRINCIPAL_POINT * width, "rho": PIVOT_SIGMA}
    functions, sigmas = {}, []
    for name in ("scale", "aspect", "skew", "px", "py", "rho", "xi_r", "xi_t", "ex", "ey"):
        unit = width if name in ("ex", "ey") else 1.0
        if name in unseen:
            own, spread = [means[name]], [unseen[name]]
        else:
            own = [means.get(name, 0.0), 0.0]
            constant = SCALE_HELD if name == "scale" else CONSTANT_SIGMAS[name]
            spread = [constant * unit, 0.5 * SLOPE_SIGMAS[name] * unit]
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
        scale_sigma=ScaleSigma(repeatability=REPEATABILITY, height_m=HEIGHT_SIGMA_M),
    )


def _anchored(model: CalibrationModel, anchor: ScaleAnchor) -> CalibrationModel:
    """Multiply all scales so that the pixel size at the anchor is the known one."""
    g = anchor.magnification
    scale, own = model.functions["scale"], columns_of(model.functions)["scale"]
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
            f"the scale (px per m) jumps by {100.0 * relay.jump:+.2f} % between {relay.low:g}x and {relay.high:g}x"
            for relay in model.ladder.relays
        ]
    return tuple(found)
