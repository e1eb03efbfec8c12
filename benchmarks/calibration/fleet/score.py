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

"""How well a calibration knows a microscope of the fleet, at magnifications that it never saw.

**Pixels.** A plane of points is seen by the true microscope, and by the calibrated camera in the pose that fits best:
what the six unknowns of a pose take up is no error. The stated sigma is that of the same points, from the joint
covariance, after what a pose takes up is removed in the same way.

**Nanometres.** Lens, coils and settling contain linear maps, and a calibration is free to count them to the scale or
not. So what is compared is the linear map that fits the whole picture best: the regression of the raw pixels of points
of the reference plane on their X and Y. As its rotation is one of the specimen, it is brought to the triangular form of
the camera, ``A R = [[m a, m s], [0, m / a]]``; 1 / A_11 and 1 / A_22 are nm per pixel along x and y, and for a camera
without distortion they are its ``pixel_size_m``. Where there is neither spiral, coil nor settling, ``pixel_size_m``
has but one meaning, and is compared as well.

A verdict compares with the mean of the microscope. The error over sigma compares with the next visit of it, at another
height, since that is what the sigmas claim to hold.
"""

from __future__ import annotations

import time
import traceback
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from benchmarks.calibration.fleet.microscope import (
    DISPLAY_WIDTH_M,
    Array,
    Microscope,
    draw_microscope,
    record,
    tilted,
)
from benchmarks.calibration.fleet.pictures import shrink, views_of_pictures
from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import SemcalError

WRONG_PX, WRONG_SIGMAS = 0.1, 4.0
# Of the height of what is measured later: the calibration's own assumption.
LATER_HEIGHT_M = CalibrationOptions().height_sigma_m
# Tilts of the planes whose points are compared, and the directions of their axes, rad.
PLANES = ((0.0, 0.0), (0.5, 0.3), (0.5, 1.9))
POINTS_ACROSS = 13
# By how much one view's magnification is stated wrongly, where it is not that of the magnification before or after.
MISSTATED = (0.02, 0.15)
# Steps of the pose fit at most. The tilt of a plane seen from above acts by its square, so that some take hundreds.
_STEPS = 1000


@dataclass(frozen=True)
class Outcome:
    """What became of one microscope; lists have an element per magnification between calibrated ones.

    Attributes
    ----------
    raised, where, is_semcal
        Exception, the places in the package that it came through, and whether it is one raised on purpose.
    numpy_warnings
        What was printed during the calibration.
    error_px, sigma_px
        RMS distance of the points after a pose fit, and its stated 1-sigma.
    px_next
        The same distance in the next visit.
    nm_error, nm_sigma
        Relative errors of nm per pixel along x and y, and the stated sigmas.
    nm_next
        The same errors against the next visit.
    literal_sigmas
        Errors of ``pixel_size_m`` over its sigma, where it has but one meaning; else empty.
    views_left_out
        How many views were left out, without the one that ought to be.
    misstated, has_found
        By what factor the magnification of one view was stated wrongly, 1 if none was, and whether it was left out.
    """

    index: int
    microscope: dict[str, object]
    seconds: float
    corners: int
    raised: str = ""
    where: tuple[str, ...] = ()
    is_semcal: bool = False
    numpy_warnings: tuple[str, ...] = ()
    between: tuple[float, ...] = ()
    error_px: tuple[float, ...] = ()
    sigma_px: tuple[float, ...] = ()
    px_next: tuple[float, ...] = ()
    nm_error: tuple[tuple[float, float], ...] = ()
    nm_sigma: tuple[tuple[float, float], ...] = ()
    nm_next: tuple[tuple[float, float], ...] = ()
    literal_sigmas: tuple[tuple[float, float], ...] = ()
    views_left_out: int = 0
    has_field: bool = False
    excess_px: float = 0.0
    repeatability: float = 0.0
    messages: tuple[str, ...] = ()
    misstated: float = 1.0
    has_found: bool = False

    @property
    def worst_px(self) -> float:
        return max(self.error_px, default=float("nan"))

    @property
    def px_over_sigma(self) -> Array:
        """Against the mean of the microscope."""
        return np.array(self.error_px) / np.array(self.sigma_px)

    @property
    def nm_over_sigma(self) -> Array:
        """Against the mean of the microscope."""
        return np.array(self.nm_error) / np.array(self.nm_sigma)

    @property
    def next_px_over_sigma(self) -> Array:
        return np.array(self.px_next) / np.array(self.sigma_px)

    @property
    def next_nm_over_sigma(self) -> Array:
        return np.array(self.nm_next) / np.array(self.nm_sigma)

    @property
    def is_wrong_px(self) -> bool:
        error, sigma = np.array(self.error_px), np.array(self.sigma_px)
        return not bool(np.all((error <= WRONG_PX) | (error <= WRONG_SIGMAS * sigma)))

    @property
    def is_wrong_nm(self) -> bool:
        sigmas = [self.nm_over_sigma.ravel(), np.ravel(self.literal_sigmas)]
        return not bool(np.all(np.abs(np.concatenate(sigmas)) <= WRONG_SIGMAS))

    @property
    def verdict(self) -> str:
        if self.raised:
            return "raised"
        return "wrong" if self.is_wrong_px or self.is_wrong_nm else "fine"


# -- calibration -----------------------------------------------------------------------------------


def views_of(own: Microscope) -> list[GridView]:
    """The views that a recording gives: corners with their sigma, and the numbers of the visits."""
    return [
        GridView(
            seen.magnification,
            seen.board_m,
            seen.xy,
            np.full(len(seen.xy), own.noise_px),
            seen.name,
            visit=seen.visit,
            square_m=seen.square_m,
        )
        for seen in record(own)
    ]


def misstate_one(own: Microscope, views: Sequence[GridView]) -> tuple[list[GridView], int, float]:
    """The views with a wrong magnification for one of them, which one, and by what factor.

    Half of the time it is by MISSTATED in either direction, as of a setting that was rounded or read too early; else
    the one view has the magnification before or after its own, as of a file that was copied to the wrong place.
    """
    rng = np.random.default_rng((own.seed, own.index, 3))
    out, chosen = list(views), int(rng.integers(len(views)))
    wrong, g = out[chosen], own.magnifications
    at = g.index(wrong.magnification)
    neighbours = [g[k] for k in (at - 1, at + 1) if 0 <= k < len(g)]
    if rng.uniform() < 0.5:
        factor = float(np.exp(rng.choice([-1.0, 1.0]) * rng.uniform(*MISSTATED)))
        # What states the magnification states the size of the squares with it: they are told from one another by it.
        out[chosen] = replace(wrong, board_xy_m=wrong.board_xy_m / factor)
    else:
        stated = float(rng.choice(neighbours))
        factor = stated / wrong.magnification
        out[chosen] = replace(wrong, magnification=stated)
    return out, chosen, factor


def judge(
    seed: int,
    index: int,
    *,
    misstate: bool = False,
    other_physics: bool = False,
    pictures: bool = False,
) -> tuple[Outcome, str]:
    """The outcome of one microscope, and the traceback if there is one.

    With ``misstate`` the magnification of one view is wrong (:func:`misstate_one`); with ``pictures`` the corners are
    those that are found in pictures (:mod:`benchmarks.calibration.fleet.pictures`).
    """
    own = draw_microscope(seed, index, other_physics=other_physics)
    own = shrink(own) if pictures else own
    views = list(views_of_pictures(own)) if pictures else views_of(own)
    wrong, factor = "", 1.0
    if misstate:
        views, chosen, factor = misstate_one(own, views)
        wrong = views[chosen].name
    facts = {
        "misstated": factor,
        "index": index,
        "microscope": asdict(own),
        "corners": sum(len(view.image_xy) for view in views),
    }
    start = time.process_time()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            result = calibrate_views(
                views, image_size=(own.width, own.height), display_width_m=DISPLAY_WIDTH_M
            )
        # Whatever it raises is the outcome.
        except Exception as error:
            facts |= {
                "raised": f"{type(error).__name__}: {error}",
                "where": _places(error),
                "is_semcal": isinstance(error, SemcalError),
            }
            result = None
            trace = traceback.format_exc()
    facts["numpy_warnings"] = tuple(
        f"{w.category.__name__}: {w.message} ({w.filename.rpartition('semcal_ros/')[2]}:{w.lineno})"
        for w in caught
    )
    facts["seconds"] = time.process_time() - start
    if result is None:
        return Outcome(**facts), trace
    with np.errstate(all="ignore"):
        facts |= score(own, result)
    left_out = {view.name for view in result.outliers}
    facts |= {"has_found": wrong in left_out, "views_left_out": len(left_out - {wrong})}
    return Outcome(**facts), ""


def _places(error: BaseException) -> tuple[str, ...]:
    """Files and lines of the package that an exception came through, the innermost last."""
    frames = traceback.extract_tb(error.__traceback__)
    return tuple(
        f"{frame.filename.rpartition('semcal_ros/')[2]}:{frame.lineno} {frame.name}"
        for frame in frames
        if "semcal_ros/" in frame.filename and "site-packages" not in frame.filename
    )


def score(own: Microscope, result: CalibrationResult) -> dict[str, object]:
    """The fields of an :class:`Outcome` that compare a calibration with the truth."""
    model = result.model
    rng = np.random.default_rng((own.seed, own.index, 2))
    pixels, lengths, literal = [], [], []
    for g in own.between:
        camera = model.at(g)
        visit = 1.0 + own.visit_sigma * rng.normal()
        pixels.append(compare_pixels(own, g, camera, visit))
        height = LATER_HEIGHT_M * rng.normal()
        lengths.append(compare_lengths(own, g, camera, visit, height))
        if own.is_plain:
            linear = own.linear(g)
            true = 1.0 / np.array([linear[0, 0], linear[1, 1]])
            off = (np.array(camera.pixel_size_m) - true) / np.array(camera.pixel_size_sigma_m)
            literal.append((float(off[0]), float(off[1])))
    return {
        "between": own.between,
        "error_px": tuple(error for error, _, _ in pixels),
        "px_next": tuple(later for _, later, _ in pixels),
        "sigma_px": tuple(sigma for _, _, sigma in pixels),
        "nm_error": tuple(error for error, _, _ in lengths),
        "nm_next": tuple(later for _, later, _ in lengths),
        "nm_sigma": tuple(sigma for _, _, sigma in lengths),
        "literal_sigmas": tuple(literal),
        "has_field": model.residual is not None,
        "excess_px": float(model.statistics.get("excess_sigma_px", 0.0)),
        "repeatability": model.scale_sigma.repeatability,
        "messages": result.warnings,
    }


# -- pixels ----------------------------------------------------------------------------------------


def compare_pixels(
    own: Microscope, g: float, camera: ScanCamera, visit: float
) -> tuple[float, float, float]:
    """RMS over the planes of the distance after a pose fit, px: from the mean, and a visit; and the stated sigma."""
    squares, later, spreads = [], [], []
    for tilt, axis in PLANES:
        board, rotation = _lattice(own, tilted(tilt, axis), g)
        points = board @ rotation.T
        true = own.project(g, points)
        inside = own.is_inside(true)
        points, true = points[inside], true[inside]
        left, moves, at = fit_pose(camera.project, points, true)
        squares.append(np.mean(np.sum(left**2, axis=1)))
        spreads.append(_stated_square(camera, at, moves))
        off, _, _ = fit_pose(camera.project, points, own.project(g, points, visit))
        later.append(np.mean(np.sum(off**2, axis=1)))
    error, next_one, sigma = (np.sqrt(np.mean(own)) for own in (squares, later, spreads))
    return _finite(error), _finite(next_one), float(sigma)


def _finite(error: float) -> float:
    return float(error if np.isfinite(error) else np.inf)


def _lattice(own: Microscope, rotation: Array, g: float) -> tuple[Array, Array]:
    """(n, 3) points of a plane that cover the picture, and the rotation that tilts them."""
    # Tilted planes look shorter: the lattice is longer by as much, and denser than it need be across.
    reach = 0.65 * own.width / own.scale(g) / rotation[2, 2]
    line = np.linspace(-reach, reach, round(1.3 * POINTS_ACROSS / rotation[2, 2]))
    x, y = np.meshgrid(line, line)
    return np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1), rotation


def fit_pose(
    project: Callable[[Array], Array], points: Array, seen: Array
) -> tuple[Array, Array, Array]:
    """Move points (n, 3) as a rigid body until they are projected to where they are seen.

    Levenberg and Marquardt's method. Returns what is left (n, 2), the derivative (2 n, 6) by the moves, and the
    moved points.
    """
    size = float(np.sqrt(np.mean(np.sum((points - points.mean(axis=0)) ** 2, axis=1))))
    at, damping = points, 1e-6
    left = seen - project(at)
    moves = _by_moves(project, at, size)
    for _ in range(_STEPS):
        if not (np.all(np.isfinite(left)) and np.all(np.isfinite(moves))):
            break
        norms = np.linalg.norm(moves, axis=0)
        scaled = np.concatenate([moves / norms, np.sqrt(damping) * np.eye(6)])
        right = np.concatenate([left.ravel(), np.zeros(6)])
        step = np.linalg.lstsq(scaled, right, rcond=1e-12)[0] / norms
        tried = _moved(at, step, size)
        off = seen - project(tried)
        gain = np.sum(left**2) - np.sum(off**2)
        # Not a number is no gain.
        if not gain > 0.0:
            if damping > 1e8 or np.linalg.norm(moves @ step) < 1e-9 * np.sqrt(left.size):
                break
            damping *= 30.0
            continue
        done = gain < 1e-10 * np.sum(left**2)
        at, left, damping = tried, off, max(0.1 * damping, 1e-12)
        moves = _by_moves(project, at, size)
        if done:
            break
    return left, moves, at


def _moved(points: Array, step: Array, size: float) -> Array:
    """Points after a turn about their middle (rad) and a shift (in units of their extent)."""
    middle, angle = points.mean(axis=0), float(np.linalg.norm(step[:3]))
    out = points - middle
    if angle > 0.0:
        x, y, z = step[:3] / angle
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        turn = np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * (cross @ cross)
        out = out @ turn.T
    return out + middle + size * step[3:]


def _by_moves(project: Callable[[Array], Array], points: Array, size: float) -> Array:
    """(2 n, 6) central differences by the moves."""
    columns = []
    for k in range(6):
        step = 1e-4 * np.eye(6)[k]
        ahead, behind = project(_moved(points, step, size)), project(_moved(points, -step, size))
        columns.append(((ahead - behind) / 2e-4).ravel())
    return np.stack(columns, axis=1)


def _stated_square(camera: ScanCamera, points: Array, moves: Array) -> float:
    """The stated variance of the distance of the points after a pose fit, mean over the points, px^2."""
    covariance = camera.joint_covariance
    rows = camera.project_jacobian(points).reshape(2 * len(points), -1)
    if covariance is None or not (np.all(np.isfinite(rows)) and np.all(np.isfinite(moves))):
        return float("nan")
    basis, size, _ = np.linalg.svd(moves / np.linalg.norm(moves, axis=0), full_matrices=False)
    # The same directions count as moves as in the fit.
    basis = basis[:, size > 1e-9 * size[0]]
    rows = rows - basis @ (basis.T @ rows)
    return float(np.sum((rows @ covariance) * rows) / len(points))


# -- nanometres ------------------------------------------------------------------------------------


def compare_lengths(
    own: Microscope, g: float, camera: ScanCamera, visit: float, height_m: float
) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float]]:
    """Relative errors of nm per pixel along x and y: against the mean, and a visit; and the stated sigmas."""
    points, _ = _lattice(own, np.eye(3), g)
    seen = own.project(g, points)
    points = points[own.is_inside(seen)]
    later = own.project(g, points + [0.0, 0.0, height_m], visit)
    xy = camera.project(points)
    regression = np.linalg.pinv(np.column_stack([points[:, :2], np.ones(len(points))]))[:2]
    mean, next_one = (_triangular(regression @ px) for px in (own.project(g, points), later))
    if not np.all(np.isfinite(xy)):
        return (np.inf, np.inf), (np.inf, np.inf), (1.0, 1.0)
    found = _triangular(regression @ xy)
    # The sizes of a pixel are the inverse of the scales.
    error, off = np.log(mean / found), np.log(next_one / found)
    by = np.einsum("kn,nip->kip", regression, camera.project_jacobian(points))
    linear = (regression @ xy).T
    along_y = linear[1] @ by[:, 1] / (linear[1] @ linear[1])
    both = np.einsum("ki,ikp->p", np.linalg.inv(linear), np.swapaxes(by, 0, 1))
    gradient = np.stack([both - along_y, along_y])
    covariance = camera.joint_covariance
    assert covariance is not None
    spread = np.sqrt(np.sum((gradient @ covariance) * gradient, axis=1))
    return _pair(error), _pair(off), _pair(spread)


def _triangular(transposed: Array) -> Array:
    """(2,) diagonal of the upper triangular matrix that a linear map becomes by a rotation of the plane."""
    linear = transposed.T
    second = float(np.linalg.norm(linear[1]))
    return np.array([abs(float(np.linalg.det(linear))) / second, second])


def _pair(values: Sequence[float] | Array) -> tuple[float, float]:
    return float(values[0]), float(values[1])
