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

"""The methods of the benchmark of the calibrations, and their errors at magnifications that they never saw."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.polynomial import Polynomial
from scipy.interpolate import PchipInterpolator

from benchmarks.calibration.cases import HEIGHT_SIGMA_M, Array, Case, PixelSize
from semcal_ros.core.calibration.estimator.problem import Priors, Setup
from semcal_ros.core.calibration.judgement.evaluate import fit_poses
from semcal_ros.core.calibration.options import CalibrationOptions
from semcal_ros.core.calibration.paper.discrete import DiscreteFit, fit_discrete, table_functions
from semcal_ros.core.calibration.paper.pda import pda_functions
from semcal_ros.core.calibration.pipeline import calibrate_views
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.continuous_function import ContinuousFunction
from semcal_ros.core.camera.projection import PARAMETER_NAMES
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.errors import CalibrationError, InvalidValueError

CameraAt = Callable[[float], ScanCamera]
Curve = Callable[[float], Array]

# The poses are fitted with sigmas of the corners and of the height that are so many times as large. The optimum is the
# same, but the robust loss is quadratic for large errors too: bad cameras get the pose with the smallest RMS.
LOOSENED = 100.0

# What OpenCV's camera consists of, in the order of the rows below; the last two columns are the pixel size.
_DISTORTION = slice(4, 9)
_PIXEL_SIZE = slice(9, 11)


@dataclass(frozen=True)
class Answer:
    """A calibration.

    Attributes
    ----------
    residuals
        Observed minus projected px of views of one magnification, whose poses are fitted.
    pixel_size_m
        Pixel size (x, y) at a magnification.
    drifting
        Whether it leaves drift in the images.
    remarks
        What a reader should know.
    """

    residuals: Callable[[Sequence[GridView]], list[Array]]
    pixel_size_m: Callable[[float], PixelSize]
    drifting: bool = False
    remarks: tuple[str, ...] = ()


@dataclass
class Work:
    """A case with its separate calibrations, which are made when they are first asked for."""

    case: Case
    separate_s: float = 0.0

    @property
    def setup(self) -> Setup:
        views = tuple(sorted(self.case.seen, key=lambda v: v.magnification))
        magnifications = np.unique([v.magnification for v in views])
        c = self.case
        return Setup(views, magnifications, c.image_size, c.display_width_m, Priors())

    @cached_property
    def separate(self) -> DiscreteFit:
        start = time.perf_counter()
        fit = fit_discrete(self.setup)
        self.separate_s = time.perf_counter() - start
        return fit


@dataclass(frozen=True)
class Method:
    """How a calibration is made; ``separate`` says that it takes separate calibrations, and their time."""

    make: Callable[[Work], Answer]
    separate: bool = False
    fitted: bool = True


@dataclass(frozen=True)
class Judged:
    """What came of a method in one case.

    Attributes
    ----------
    clean_px, noisy_px
        RMS over the magnifications of the corners' distances.
    worst_at
        Magnification of the largest error without noise.
    scale_percent
        Largest relative error of a pixel size.
    seconds
        Time of the calibration.
    remarks
        What a reader should know.
    """

    clean_px: float | None = None
    noisy_px: float | None = None
    worst_at: float | None = None
    scale_percent: float | None = None
    seconds: float | None = None
    remarks: tuple[str, ...] = ()


def by_cameras(
    camera_at: CameraAt, *, drifting: bool = False, remarks: tuple[str, ...] = ()
) -> Answer:
    """An answer in the suite's own cameras."""

    def residuals(views: Sequence[GridView]) -> list[Array]:
        for view in views:
            require_ideal_corners(camera_at(view.magnification), view)
        loose = [
            GridView(v.magnification, v.board_xy_m, v.image_xy, v.sigma_px * LOOSENED, v.name)
            for v in views
        ]
        return list(
            fit_poses(loose, camera_at, height_sigma_m=HEIGHT_SIGMA_M * LOOSENED).residuals_px
        )

    return Answer(residuals, lambda g: camera_at(g).pixel_size_m, drifting, remarks)


def require_ideal_corners(camera: ScanCamera, view: GridView) -> None:
    """An interpolated distortion may be so strong that corners have no undistorted pixel."""
    known = np.all(np.isfinite(camera.undistort(view.image_xy)), axis=1)
    if not known.all():
        raise CalibrationError(
            f"{np.sum(~known)} of {len(known)} corners without an undistorted pixel",
            expected="a camera that sees all of the image",
        )


def nominal(work: Work, drifting: bool) -> Answer:
    c = work.case
    return by_cameras(
        lambda g: ScanCamera.nominal(g, *c.image_size, c.display_width_m), drifting=drifting
    )


def by_curve(work: Work, curve: Curve) -> Answer:
    """Of parameters as functions of g, the scale relative to the nominal one."""
    c = work.case

    def camera_at(g: float) -> ScanCamera:
        values = dict(zip(PARAMETER_NAMES, curve(g).tolist(), strict=True))
        values["m"] *= c.nominal_px_per_m(g)
        width, height = c.image_size
        return ScanCamera(
            magnification=g, **values, norm_px=0.5 * width, width=width, height=height
        )

    return by_cameras(camera_at, remarks=remarks_on(work.separate))


def remarks_on(fit: DiscreteFit) -> tuple[str, ...]:
    """Where separate calibrations failed, or knew what others have to estimate."""
    pairs = list(zip(fit.magnifications, fit.results, fit.centres, strict=True))
    failed = [f"{g:g}" for g, result, _ in pairs if not result.converged]
    straight = sum(centre.degenerate for _, _, centre in pairs)
    out = []
    if failed:
        out.append(f"separate calibrations did not converge at {', '.join(failed)}")
    if straight:
        out.append(
            f"separate calibrations took the radial distortion for zero at {straight} of {len(pairs)}"
            " magnifications, where a test found none; joint always estimates it"
        )
    return tuple(out)


def nearest(work: Work) -> Answer:
    fit = work.separate
    logs = np.log(fit.magnifications)
    return by_curve(work, lambda g: fit.parameters[np.argmin(np.abs(logs - np.log(g)))])


def pchip(work: Work) -> Answer:
    fit = work.separate
    curve = PchipInterpolator(np.log(fit.magnifications), fit.parameters)
    return by_curve(work, lambda g: np.asarray(curve(np.log(g))))


def polynomial(work: Work, degree: int) -> Answer:
    """Weighted least squares in log g."""
    fit = work.separate
    if len(fit.magnifications) < degree + 2:
        raise CalibrationError(
            f"{len(fit.magnifications)} magnifications", expected=f"at least {degree + 2}"
        )
    logs = np.log(fit.magnifications)
    sigmas = np.sqrt(np.diagonal(fit.covariances, axis1=1, axis2=2))
    curves = [
        Polynomial.fit(logs, values, degree, w=1.0 / sigma)
        for values, sigma in zip(fit.parameters.T, sigmas.T, strict=True)
    ]
    return by_curve(work, lambda g: np.array([curve(np.log(g)) for curve in curves]))


def by_functions(
    work: Work, found: tuple[dict[str, ContinuousFunction], Array], name: str
) -> Answer:
    c, fit = work.case, work.separate
    magnifications = tuple(float(g) for g in fit.magnifications)
    model = CalibrationModel(*found, *c.image_size, c.display_width_m, magnifications, name)
    return by_cameras(model.at, remarks=remarks_on(fit))


def linear(work: Work) -> Answer:
    """The suite's method "discrete"."""
    fit = work.separate
    found = table_functions(fit.magnifications, fit.parameters, fit.covariances)
    return by_functions(work, found, "discrete")


def pda(work: Work, order: int = 2, degree: int | None = None) -> Answer:
    found = pda_functions(work.separate, order=order, legendre_degree=degree)
    return by_functions(work, found, "pda")


def joint(work: Work, residual: str) -> Answer:
    c = work.case
    result = calibrate_views(
        c.seen,
        image_size=c.image_size,
        display_width_m=c.display_width_m,
        options=CalibrationOptions(residual=residual),
    )
    return by_cameras(result.model.at)


def opencv(work: Work, guess: bool) -> Answer:
    camera = OpenCv.calibrated(work.case, guess)
    refused = ", ".join(f"{g:g}" for g in camera.refused)
    remarks = (f"cv2.calibrateCamera refused {refused}",) if refused else ()
    return Answer(camera.residuals, camera.pixel_size_m, remarks=remarks)


JOINT, JOINT_FIELD = "joint", "joint, residual field"

METHODS: dict[str, Method] = {
    "no correction": Method(lambda w: nominal(w, True), fitted=False),
    "drift only": Method(lambda w: nominal(w, False), fitted=False),
    "discrete": Method(nearest, True),
    "discrete, linear": Method(linear, True),
    "discrete, PCHIP": Method(pchip, True),
    **{f"discrete, polynomial {k}": Method(lambda w, k=k: polynomial(w, k), True) for k in (3, 5)},
    **{f"discrete, Legendre {k}": Method(lambda w, k=k: pda(w, degree=k), True) for k in (3, 5)},
    **{f"pda, order {k}": Method(lambda w, k=k: pda(w, order=k), True) for k in (1, 2, 3, 4)},
    JOINT: Method(lambda w: joint(w, "off")),
    JOINT_FIELD: Method(lambda w: joint(w, "on")),
    "cv2.calibrateCamera": Method(lambda w: opencv(w, False)),
    "cv2, f guessed, centre fixed": Method(lambda w: opencv(w, True)),
}


def errors_px(
    answer: Answer, views: Sequence[GridView], shifts_px: Sequence[Array]
) -> dict[float, float]:
    """RMS at each magnification. One without an answer counts as infinitely wrong.

    A method that leaves the drift meets every view again in the frames that follow, under the pose of the first.
    """
    out: dict[float, float] = {}
    for g in sorted({v.magnification for v in views}):
        own = [i for i, v in enumerate(views) if v.magnification == g]
        try:
            residuals = answer.residuals([views[i] for i in own])
        except (CalibrationError, InvalidValueError):
            out[g] = float("inf")
            continue
        if answer.drifting and shifts_px:
            residuals = [r + shifts_px[i] for i, r in zip(own, residuals, strict=True)]
        distances2 = [np.sum(r * r, axis=-1).ravel() for r in residuals]
        rms = float(np.sqrt(np.mean(np.concatenate(distances2))))
        out[g] = rms if np.isfinite(rms) else float("inf")
    return out


def together(errors: dict[float, float]) -> float:
    """RMS over the magnifications."""
    return float(np.sqrt(np.mean(np.square(list(errors.values())))))


def scale_percent(answer: Answer, case: Case) -> float:
    """Largest relative error of a pixel size, in percent; infinite where there is none."""
    try:
        found = np.array([answer.pixel_size_m(g) for g in case.pixel_size_m])
    except InvalidValueError:
        return float("inf")
    truth = np.array(list(case.pixel_size_m.values()))
    return 100.0 * float(np.max(np.abs(found / truth - 1.0)))


def judged(name: str, work: Work) -> Judged:
    """Calibrate and judge."""
    method, case = METHODS[name], work.case
    earlier_s, start = work.separate_s, time.perf_counter()
    try:
        answer = method.make(work)
    except (CalibrationError, InvalidValueError) as error:
        return Judged(remarks=(f"{name}: {error}",))
    seconds = time.perf_counter() - start + (earlier_s if method.separate else 0.0)
    clean = errors_px(answer, case.clean, case.shifts_px)
    return Judged(
        together(clean),
        together(errors_px(answer, case.judged, case.shifts_px)),
        max(clean, key=lambda g: clean[g]),
        scale_percent(answer, case),
        seconds if method.fitted else None,
        answer.remarks,
    )


@dataclass(frozen=True)
class OpenCv:
    """Separate calibrations; their parameters are interpolated linearly in log g.

    Focal lengths are divided by g before, and pixel sizes multiplied, as they are nearly proportional to it. Lengths
    are measured in units of 256 nominal px, so that numbers stay near 1.

    Attributes
    ----------
    magnifications, parameters
        (M,) and (M, 11): focal lengths over g, principal point, five coefficients of distortion, pixel sizes in m
        times g at the mean distance of the views, which is OpenCV's nearest to a reference plane.
    refused
        Magnifications at which OpenCV raised an error.
    """

    case: Case
    magnifications: Array
    parameters: Array
    refused: tuple[float, ...]

    @classmethod
    def calibrated(cls, case: Case, guess: bool) -> OpenCv:
        """With ``guess`` the focal length starts from the working distance, and the principal point is fixed."""
        magnifications, rows, refused = [], [], []
        for g in sorted({v.magnification for v in case.seen}):
            own = [v for v in case.seen if v.magnification == g]
            try:
                rows.append(_calibrated_at(case, g, own, guess))
                magnifications.append(g)
            except cv2.error:
                refused.append(g)
        if not rows:
            raise CalibrationError("views that OpenCV refuses", expected="a calibration")
        return cls(case, np.array(magnifications), np.array(rows), tuple(refused))

    def _at(self, g: float) -> Array:
        logs = np.log(self.magnifications)
        return np.array([np.interp(np.log(g), logs, column) for column in self.parameters.T])

    def pixel_size_m(self, g: float) -> PixelSize:
        """Pixel size (x, y) at the mean distance."""
        x, y = self._at(g)[_PIXEL_SIZE] / g
        return float(x), float(y)

    def residuals(self, views: Sequence[GridView]) -> list[Array]:
        """Observed minus projected px of views, each under the better of the two poses that a plane allows."""
        return [self._residual(view) for view in views]

    def _residual(self, view: GridView) -> Array:
        p = self._at(view.magnification)
        f = p[:2] * view.magnification
        k = np.array([[f[0], 0.0, p[2]], [0.0, f[1], p[3]], [0.0, 0.0, 1.0]])
        d, board = p[_DISTORTION], _board(self.case, view)
        pixels = view.image_xy.reshape(-1, 1, 2)
        try:
            _, turns, moves, _ = cv2.solvePnPGeneric(board, pixels, k, d, flags=cv2.SOLVEPNP_IPPE)
            found = []
            for turn, move in zip(turns, moves, strict=True):
                turn, move = cv2.solvePnPRefineLM(board, pixels, k, d, turn, move)
                seen = cv2.projectPoints(board, turn, move, k, d)[0].reshape(-1, 2)
                found.append(view.image_xy - seen)
        except cv2.error as error:
            raise CalibrationError(
                f"no pose at magnification {view.magnification:g}: {error.err}",
                expected="a pose from solvePnP",
            ) from error
        return min(found, key=lambda r: float(np.sum(r * r)))


def _unit_m(case: Case, g: float) -> float:
    return 256.0 / case.nominal_px_per_m(g)


def _board(case: Case, view: GridView) -> Array:
    flat = view.board_xy_m / _unit_m(case, view.magnification)
    return np.column_stack([flat, np.zeros(len(flat))]).reshape(-1, 1, 3)


def _calibrated_at(case: Case, g: float, views: Sequence[GridView], guess: bool) -> list[float]:
    """One row of :attr:`OpenCv.parameters`."""
    boards = [_board(case, v).astype(np.float32) for v in views]
    pixels = [v.image_xy.astype(np.float32).reshape(-1, 1, 2) for v in views]
    start, flags = np.eye(3), 0
    if guess:
        start = np.diag([case.nominal_px_per_m(g) * case.working_distance_m] * 2 + [1.0])
        start[:2, 2] = (np.array(case.image_size) - 1.0) / 2.0
        flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_K3
    _, k, d, _, moves = cv2.calibrateCamera(
        boards, pixels, case.image_size, start, None, flags=flags
    )
    distance_m = float(np.mean([move.ravel()[2] for move in moves])) * _unit_m(case, g)
    f = np.array([k[0, 0], k[1, 1]])
    return [*(f / g), k[0, 2], k[1, 2], *d.ravel()[:5], *(distance_m / f * g)]
