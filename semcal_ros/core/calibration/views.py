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

"""Views of a planar grid, from which a calibration is computed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from semcal_ros.core.arrays import MEDIAN_CHI2, AnyImage, Array, Mask, check_positive
from semcal_ros.core.calibration.stage import StageReading
from semcal_ros.core.calibration.thresholds import (
    LINES_TILT_MAX_RAD,
    SCALE_WEIGHT,
    SQUARE_FAR,
    SQUARE_MISFIT,
    SQUARE_SCATTER,
    VARIANCE_RATIO_KEPT,
)
from semcal_ros.core.corners import LatticeDetection
from semcal_ros.core.errors import CalibrationError, InvalidValueError, Rejection


@dataclass(frozen=True)
class GridView:
    """Corresponding points of one image of a planar grid.

    Attributes
    ----------
    magnification
        Magnification of the image.
    board_xy_m
        (n, 2) positions on the grid, m.
    image_xy
        (n, 2) observed raw pixels.
    sigma_px
        (n,) 1-sigma of the observation per axis, px.
    name
        For messages and reports, such as the frame number.
    covariance_px2
        (n, 2, 2) covariance of the observations, or None where only ``sigma_px`` is known.
    visit
        Number of the visit of this magnification, in the order of the recording: a stretch without
        a change of magnification in between. -1 where it is not known, which makes all views at
        one magnification one visit.
    square_m
        Side of the squares in view, m; 0 where it is not known.
    stage
        What the stage said about this view, or None.
    untilted
        Whether the specimen is known not to be tilted.
    excess_px
        Part of the sigmas that :meth:`add_excess_noise` has added, px per axis.
    across
        (n, 2) unit vectors across the lines of a grating, the only direction in which its points are known; None
        where both are.
    scan_response
        (n, 2, 2) as of :class:`~semcal_ros.core.corners.LatticeDetection`, or None where it is not known.
    """

    magnification: float
    board_xy_m: Array
    image_xy: Array
    sigma_px: Array
    name: str = ""
    covariance_px2: Array | None = None
    visit: int = -1
    square_m: float = 0.0
    stage: StageReading | None = None
    untilted: bool = False
    excess_px: float = 0.0
    across: Array | None = None
    scan_response: Array | None = None

    def __post_init__(self) -> None:
        n = len(self.board_xy_m)
        shapes = (self.board_xy_m.shape, self.image_xy.shape, self.sigma_px.shape)
        if shapes != ((n, 2), (n, 2), (n,)):
            raise InvalidValueError(
                f"view arrays of shapes {shapes}", expected="(n, 2), (n, 2), (n,)"
            )
        check_positive(self.magnification, "magnification")
        for values, what, unit in (
            (self.board_xy_m, "places on the grid", "metres"),
            (self.image_xy, "corners", "pixels"),
        ):
            if not np.all(np.isfinite(values)):
                raise InvalidValueError(
                    f"a view with {what} that are not finite", expected=f"finite {unit}"
                )
        if not np.all((self.sigma_px > 0) & np.isfinite(self.sigma_px)):
            raise InvalidValueError(
                "a view with sigmas of corners that are not positive or not finite",
                expected="finite numbers of pixels above 0; leave out what is not known",
            )
        if self.covariance_px2 is not None and not _all_positive(self.covariance_px2, n):
            raise InvalidValueError(
                f"covariances of shape {self.covariance_px2.shape}",
                expected=f"positive definite ones of shape ({n}, 2, 2)",
            )
        if self.scan_response is not None and self.scan_response.shape != (n, 2, 2):
            raise InvalidValueError(
                f"responses to the scan of shape {self.scan_response.shape}",
                expected=f"({n}, 2, 2)",
            )

    @property
    def has_stage_tilt(self) -> bool:
        """Whether the stage said how the specimen was tilted."""
        return self.stage is not None and self.stage.tilt_rad is not None

    @property
    def whitening(self) -> Array:
        """(n, 3) lower triangle (xx, yx, yy) of the matrix that whitens the observation errors."""
        if self.covariance_px2 is None:
            weight = 1.0 / self.sigma_px
            return np.stack([weight, np.zeros_like(weight), weight], axis=1)
        xx, xy, yy = (self.covariance_px2[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
        first = 1.0 / np.sqrt(xx)
        last = 1.0 / np.sqrt(yy - xy * xy / xx)
        return np.stack([first, -last * xy / xx, last], axis=1)

    def add_excess_noise(self, sigma_px: float) -> GridView:
        """Return the view with corners that are more uncertain by ``sigma_px`` per axis."""
        spread = self.covariance_px2
        if spread is not None:
            spread = spread + sigma_px**2 * np.eye(2)
        return replace(
            self,
            sigma_px=np.hypot(self.sigma_px, sigma_px),
            covariance_px2=spread,
            excess_px=float(np.hypot(self.excess_px, sigma_px)),
        )

    def add_line_noise(self, sigma_px: float) -> GridView:
        """Return the view with corners that are more uncertain by ``sigma_px`` along x, as where lines of the raster
        are shifted; ``sigma_px`` of each grows as in the mean over both axes.
        """
        spread = self.covariance_px2
        if spread is None:
            spread = self.sigma_px[:, None, None] ** 2 * np.eye(2)
        return replace(
            self,
            sigma_px=np.hypot(self.sigma_px, np.sqrt(0.5) * sigma_px),
            covariance_px2=spread + sigma_px**2 * np.diag([1.0, 0.0]),
        )

    @property
    def own_variance_share(self) -> Array:
        """(n,) part of the variance of the observations that is not excess noise."""
        return 1.0 - (self.excess_px / self.sigma_px) ** 2

    def chosen(self, keep: NDArray[Any]) -> GridView:
        """Return the view with some of its corners, by index or mask."""
        spread = None if self.covariance_px2 is None else self.covariance_px2[keep]
        return replace(
            self,
            board_xy_m=self.board_xy_m[keep],
            image_xy=self.image_xy[keep],
            sigma_px=self.sigma_px[keep],
            covariance_px2=spread,
            across=None if self.across is None else self.across[keep],
            # With the others it was that of another lattice.
            scan_response=None,
        )

    @property
    def dimensions(self) -> int:
        """In how many directions each point is known: 1 for lines, 2 else."""
        return 2 if self.across is None else 1

    @property
    def expected_rms_px(self) -> float:
        """RMS error, as a length in the image, that the 1-sigma of the corners predicts."""
        return float(np.sqrt(self.dimensions * np.mean(self.sigma_px**2)))

    def known_residuals(self, residuals_px: Array) -> Array:
        """Return (n, dimensions) residuals along the directions that are known, of (n, 2)."""
        if self.across is None:
            return residuals_px
        return np.sum(residuals_px * self.across, axis=1, keepdims=True)


def _all_positive(covariance: Array, n: int) -> bool:
    if covariance.shape != (n, 2, 2) or not np.all(np.isfinite(covariance)):
        return False
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    if not np.all((xx > 0.0) & (xx * yy > xy * xy)):
        return False
    return bool(np.all(np.abs(xy - covariance[:, 1, 0]) <= 1e-6 * np.sqrt(xx * yy)))


@dataclass(frozen=True)
class FoundView:
    """One image with its corners.

    Attributes
    ----------
    name
        For messages and reports, such as the number of the frame.
    magnification
        Magnification of the image.
    image
        (h, w) grey values where they are at hand, or None.
    detection
        The corners.
    stage, visit
        As in :class:`GridView`.
    file_name
        Name of the file of the image; empty for a recording.
    """

    name: str
    magnification: float
    image: AnyImage | None
    detection: LatticeDetection
    stage: StageReading | None = None
    visit: int = -1
    file_name: str = ""


class ViewStatus(Enum):
    """Why an image with a grid is not used."""

    OTHER_IMAGE_SIZE = "other image size"
    UNKNOWN_SQUARES = "squares of no known size"
    COPY = "copy of another image"
    OUTLIER = "outlier"


@dataclass(frozen=True)
class RejectedView:
    """One image that was not used.

    Attributes
    ----------
    name, magnification
        As in :class:`FoundView`.
    rejection
        Why: a :class:`ViewStatus`, or a :class:`~semcal_ros.core.corners.LatticeStatus` where no
        grid was found.
    image
        (h, w) grey values where they are at hand, or None.
    """

    name: str
    magnification: float
    rejection: Rejection[Any]
    image: AnyImage | None = None

    @property
    def reason(self) -> str:
        """The reason in words."""
        return self.rejection.reason


@dataclass(frozen=True)
class SquareAssignment:
    """Which square size each view shows.

    Attributes
    ----------
    square_m
        (v,) side of the squares seen in each view, m.
    scale_factor
        Median ratio of the observed px per m to the nominal one of the display width.
    apparent_m
        (v,) side according to the magnification of each view, without the common ratio.
    """

    square_m: Array
    scale_factor: float
    apparent_m: Array

    @property
    def spread(self) -> float:
        """Largest deviation of one view from the common ratio, as a factor above 1."""
        return float(np.exp(np.max(np.abs(np.log(self.apparent_m / self.square_m)))))

    @property
    def misfits(self) -> Mask:
        """(v,) whether the squares of a view have none of the known sizes at its magnification."""
        return np.abs(np.log(self.apparent_m / self.square_m)) > SQUARE_MISFIT


def assign_squares(
    spacing_px: Array, nominal_px_per_m: Array, squares_m: Sequence[float]
) -> SquareAssignment:
    """Find the square size of each view from how all spacings change with the magnification.

    ``spacing_px / nominal_px_per_m`` is the square size up to one factor common to all views (a
    wrong display width). Among all factors that map the observed sizes onto the known ones, the one
    with the smallest spread wins, and of equally good ones the one nearest to 1.

    Parameters
    ----------
    spacing_px
        (v,) un-foreshortened spacing of each view.
    nominal_px_per_m
        (v,) nominal scale of each view, from its magnification and the display width.
    squares_m
        The square sizes that the grid has.
    """
    sizes = np.log(np.sort(np.asarray(squares_m, dtype=np.float64)))
    observed = np.log(np.asarray(spacing_px) / np.asarray(nominal_px_per_m))
    best: tuple[float, float] | None = None
    # Any consistent factor maps the first view onto one of the sizes.
    for offset in observed[0] - sizes:
        for _ in range(3):
            nearest = np.argmin(np.abs(observed[:, None] - offset - sizes[None, :]), axis=1)
            offset = float(np.median(observed - sizes[nearest]))
        deviation = np.abs(observed - offset - sizes[nearest])
        # The mean, so that a size with few views is not given up for the others.
        spread = float(np.mean(np.minimum(deviation, SQUARE_FAR)))
        score = max(spread, SQUARE_SCATTER) + SCALE_WEIGHT * abs(offset)
        if best is None or score < best[0]:
            best = (score, offset)
    if best is None:
        raise CalibrationError("no views", expected="at least one view with a grid")
    _, offset = best
    nearest = np.argmin(np.abs(observed[:, None] - offset - sizes[None, :]), axis=1)
    return SquareAssignment(
        np.exp(sizes[nearest]), float(np.exp(offset)), np.exp(observed - offset)
    )


def _centre_lattice(detection: LatticeDetection) -> Array:
    """Return (n, 2) lattice indices with the origin at the corner nearest to the image centre.

    The height of a view is that of its origin, and its prior refers to the height of the part of
    the specimen in view.
    """
    middle = 0.5 * (np.array(detection.image_size, dtype=np.float64) - 1.0)
    nearest = np.argmin(np.sum((detection.xy - middle) ** 2, axis=1))
    return np.asarray(detection.ij - detection.ij[nearest], dtype=np.float64)


def views_from_detections(
    detections: Sequence[LatticeDetection],
    magnifications: Sequence[float],
    *,
    display_width_m: float,
    squares_m: Sequence[float],
    names: Sequence[str] | None = None,
    stages: Sequence[StageReading | None] | None = None,
    visits: Sequence[int] | None = None,
) -> tuple[tuple[GridView, ...], SquareAssignment]:
    """Make views in metres from accepted lattice detections.

    Parameters
    ----------
    detections
        Accepted detections, one per image.
    magnifications
        Magnification of each image.
    display_width_m
        Display width to which the magnifications refer, m.
    squares_m
        The square sizes that the grid has, m.
    names, stages, visits
        Name, reading of the stage and number of the visit of each image, where they are known.

    Raises
    ------
    CalibrationError
        If there are no detections.
    """
    if not detections:
        raise CalibrationError(
            "no image with a grid",
            expected="images that show a chess grid",
            do="check focus, contrast and that the grid fills the image",
        )
    widths = np.array([d.image_size[0] for d in detections], dtype=np.float64)
    nominal = np.asarray(magnifications, dtype=np.float64) * widths / display_width_m
    spacing = np.array([d.spacing_px for d in detections])
    assignment = assign_squares(spacing, nominal, squares_m)
    labels = names if names is not None else [str(i) for i in range(len(detections))]
    views = tuple(
        GridView(
            float(g),
            _centre_lattice(d) * float(square),
            d.xy,
            d.sigma_px,
            label,
            d.covariance_px2 if len(d.covariance_px2) else None,
            visit,
            float(square),
            stage,
            untilted=bool(len(d.across)),
            across=d.across if len(d.across) else None,
            scan_response=d.scan_response if len(d.scan_response) else None,
        )
        for d, g, square, label, stage, visit in zip(
            detections,
            magnifications,
            assignment.square_m,
            labels,
            stages if stages is not None else [None] * len(detections),
            visits if visits is not None else [-1] * len(detections),
            strict=True,
        )
    )
    return views, assignment


def estimate_excess_sigma_px(
    views: Sequence[GridView], residuals_px: Array, unknowns: int
) -> float:
    """Estimate the scatter of all corners beyond their own sigmas, 1-sigma per axis in px.

    The result is 0 where the excess is too small for a correction.

    Parameters
    ----------
    views
        Views with n corners together.
    residuals_px
        (n, 2) residuals of a fit, in the directions that are known.
    unknowns
        Number of fitted unknowns, which make the residuals smaller than the errors.
    """
    own = np.concatenate([v.sigma_px for v in views]) ** 2
    square = np.sum(residuals_px**2, axis=1)
    dimensions = views[0].dimensions
    target: float = MEDIAN_CHI2[dimensions] * max(1.0 - unknowns / (dimensions * len(square)), 0.1)

    def surplus(variance: float) -> float:
        ratio = float(np.median(square / (own + variance)))
        return ratio - target

    if not np.all(np.isfinite(square)) or surplus(0.0) < (VARIANCE_RATIO_KEPT - 1.0) * target:
        return 0.0
    return float(np.sqrt(brentq(surplus, 0.0, float(square.max()) / target + 1e-12)))


def median_sigma_px(views: Sequence[GridView]) -> float:
    """Return the median 1-sigma of the corners of all views, per axis in px."""
    return float(np.median(np.concatenate([view.sigma_px for view in views])))


def add_excess_noise(views: Sequence[GridView], sigma_px: float) -> tuple[GridView, ...]:
    """Return the views with corners that are more uncertain by ``sigma_px`` per axis."""
    return tuple(view.add_excess_noise(sigma_px) for view in views)


def show_lines(views: Sequence[GridView]) -> bool:
    """Whether any of the views is one of a grating, which is turned and not tilted."""
    return any(view.across is not None for view in views)


def refuse_tilted_lines(views: Sequence[GridView]) -> None:
    """Refuse views that the stage tilts where any of them shows parallel lines, which do not tell a tilt.

    Raises
    ------
    CalibrationError
        If a view is tilted, where any view is one of parallel lines.
    """
    if not show_lines(views):
        return
    for view in views:
        tilt = 0.0 if view.stage is None or view.stage.tilt_rad is None else view.stage.tilt_rad
        if abs(tilt) > LINES_TILT_MAX_RAD:
            raise CalibrationError(
                f"{view.name}, tilted by {np.degrees(tilt):.1f} degrees, among views of parallel lines",
                expected="untilted views: what a tilt does to lines in one direction, another scale does as well",
                do="leave this view out, or use a grid of two directions",
            )
