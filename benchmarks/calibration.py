"""Calibration methods judged at magnifications that none of them saw; corners beside OpenCV's.

The views are those of a simulated recording of the grid; its corners are projected by the true
microscope and given Gaussian noise. Every calibration then meets other views, of magnifications in
between, and only their poses are fitted: once with noise, as one would measure it, and once without
noise, which shows the error of the model alone.
"""

from __future__ import annotations

import os

# Small matrices: more threads only wait for each other, all the more on a busy machine.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from table import interleaved, quick_from_command_line, show

from semcal_ros.core.camera import ScanCamera
from semcal_ros.core.corners import LatticeDetection, find_lattice
from semcal_ros.core.discrete import DiscreteFit, fit_discrete, table_functions
from semcal_ros.core.errors import CalibrationError, InvalidValueError
from semcal_ros.core.evaluate import fit_poses, rms_by_magnification
from semcal_ros.core.functions import ContinuousFunction
from semcal_ros.core.joint import fit_joint
from semcal_ros.core.model import CalibrationModel
from semcal_ros.core.pda import pda_functions
from semcal_ros.core.problem import Priors, Setup
from semcal_ros.core.views import GridView
from semcal_ros.synthetic import CALIBRATION_MAGNIFICATIONS, RecordingPlan, calibration_plan, preset

Array = NDArray[np.float64]

MICROSCOPE = preset("jsm820")
SIZE = MICROSCOPE.image_size
NOISE_PX = 0.05
QUICK = (100.0, 1000.0, 2000.0, 3500.0, 5000.0, 6500.0, 8000.0, 10000.0)
HELD_OUT = (170.0, 300.0, 750.0, 1250.0, 2750.0, 4250.0, 5750.0, 7250.0, 9250.0)
HEIGHT_SIGMA_M = 4e-5
# What somebody who knows the working distance would tell OpenCV.
WORKING_DISTANCE_M = 0.020


# -- views of known truth --------------------------------------------------------------------------


def lattice(plan: RecordingPlan, index: int, margin: float) -> tuple[Array, Array]:
    """Corners of the grid in a frame, m on the grid and px in the image."""
    frame = plan.frames[index]
    assert frame.square_m is not None
    i, j = np.meshgrid(np.arange(-80, 81), np.arange(-80, 81))
    board = np.column_stack([i.ravel(), j.ravel()]) * frame.square_m
    # Far outside, the distortion has no answer and no business.
    ideal = MICROSCOPE.camera_at(frame.magnification).project_ideal(
        frame.pose.sem_from_specimen(board)
    )
    near = np.all(np.abs(ideal - np.array(SIZE) / 2.0) < 0.7 * np.array(SIZE), axis=1)
    board = board[near]
    xy = MICROSCOPE.distort(frame.magnification, ideal[near])
    inside = np.all((xy > margin) & (xy < np.array(SIZE) - 1.0 - margin), axis=1)
    return board[inside], xy[inside]


def views_at(
    magnifications: Sequence[float], views: int, seed: int, noise: float
) -> list[GridView]:
    plan = calibration_plan(MICROSCOPE, magnifications=magnifications, views=views, seed=seed)
    rng = np.random.default_rng(seed)
    out = []
    for index, frame in enumerate(plan.frames):
        board, xy = lattice(plan, index, 5.0)
        measured = xy + rng.normal(0.0, noise, xy.shape) if noise else xy
        sigma = np.full(len(xy), noise or 0.01)
        out.append(GridView(frame.magnification, board, measured, sigma, f"view {index}"))
    return out


def nominal_px_per_m(g: float) -> float:
    return g * SIZE[0] / MICROSCOPE.display_width_m


# -- the methods: RMS px of views by magnification ---------------------------------------------------

Judge = Callable[[list[GridView]], dict[float, float]]


def judged_by_cameras(camera_at: Callable[[float], ScanCamera]) -> Judge:
    """As the suite judges itself. A magnification without a camera counts as infinitely wrong."""

    def judge(views: list[GridView]) -> dict[float, float]:
        out: dict[float, float] = {}
        for g in sorted({v.magnification for v in views}):
            own = [v for v in views if v.magnification == g]
            try:
                fit = fit_poses(own, camera_at, height_sigma_m=HEIGHT_SIGMA_M)
                out |= rms_by_magnification(fit)
            except (CalibrationError, InvalidValueError):
                out[g] = float("inf")
        return out

    return judge


def model(
    views: Sequence[GridView], found: tuple[dict[str, ContinuousFunction], Array], method: str
) -> CalibrationModel:
    functions, covariance = found
    magnifications = tuple(sorted({v.magnification for v in views}))
    return CalibrationModel(
        functions, covariance, *SIZE, MICROSCOPE.display_width_m, magnifications, method
    )


def setup_of(views: Sequence[GridView]) -> Setup:
    ordered = tuple(sorted(views, key=lambda v: v.magnification))
    magnifications = np.unique([v.magnification for v in ordered])
    return Setup(ordered, magnifications, SIZE, MICROSCOPE.display_width_m, Priors())


def joint(views: Sequence[GridView]) -> Judge:
    fit = fit_joint(setup_of(views))
    return judged_by_cameras(model(views, (fit.functions, fit.result.covariance), "joint").at)


def table_model(views: Sequence[GridView], fit: DiscreteFit) -> Judge:
    found = table_functions(fit.magnifications, fit.parameters, fit.covariances)
    return judged_by_cameras(model(views, found, "discrete").at)


def pda(views: Sequence[GridView], fit: DiscreteFit, order: int) -> Judge:
    found = pda_functions(fit, order=order, legendre_degree=None)
    return judged_by_cameras(model(views, found, "pda").at)


@dataclass
class OpenCv:
    """cv2.calibrateCamera at every magnification; parameters interpolated linearly in log g.

    The focal lengths are divided by g before, as they are proportional to it. Lengths are measured
    in units of 256 nominal px, so that numbers stay near 1.
    """

    magnifications: Array
    parameters: Array

    @classmethod
    def calibrated(cls, views: Sequence[GridView], guess: bool) -> OpenCv:
        magnifications, rows = [], []
        for g in sorted({v.magnification for v in views}):
            own = [v for v in views if v.magnification == g]
            boards = [cls._board(v).astype(np.float32) for v in own]
            pixels = [v.image_xy.astype(np.float32).reshape(-1, 1, 2) for v in own]
            start, flags = np.eye(3), 0
            if guess:
                start = np.diag([nominal_px_per_m(g) * WORKING_DISTANCE_M] * 2 + [1.0])
                start[:2, 2] = (np.array(SIZE) - 1.0) / 2.0
                flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT
                flags |= cv2.CALIB_FIX_K3
            try:
                _, k, d, _, _ = cv2.calibrateCamera(boards, pixels, SIZE, start, None, flags=flags)
            except cv2.error:
                continue
            rows.append([k[0, 0] / g, k[1, 1] / g, k[0, 2], k[1, 2], *d.ravel()[:5]])
            magnifications.append(g)
        return cls(np.array(magnifications), np.array(rows))

    @staticmethod
    def _board(view: GridView) -> Array:
        flat = view.board_xy_m * nominal_px_per_m(view.magnification) / 256.0
        return np.column_stack([flat, np.zeros(len(flat))]).reshape(-1, 1, 3)

    def judge(self, views: list[GridView]) -> dict[float, float]:
        square: dict[float, list[Array]] = {}
        for view in views:
            g = view.magnification
            p = [np.interp(np.log(g), np.log(self.magnifications), c) for c in self.parameters.T]
            k = np.array([[p[0] * g, 0.0, p[2]], [0.0, p[1] * g, p[3]], [0.0, 0.0, 1.0]])
            square.setdefault(g, []).append(self._squares(view, k, np.array(p[4:])))
        return {g: float(np.sqrt(np.mean(np.concatenate(s)))) for g, s in square.items()}

    def _squares(self, view: GridView, k: Array, d: Array) -> Array:
        """Squared distances under the better of the two poses that a plane allows."""
        board, pixels = self._board(view), view.image_xy.reshape(-1, 1, 2)
        best = np.full(len(pixels), np.inf)
        try:
            _, turns, moves, _ = cv2.solvePnPGeneric(board, pixels, k, d, flags=cv2.SOLVEPNP_IPPE)
            for turn, move in zip(turns, moves, strict=True):
                turn, move = cv2.solvePnPRefineLM(board, pixels, k, d, turn, move)
                seen = cv2.projectPoints(board, turn, move, k, d)[0]
                square = np.sum((seen - pixels).reshape(-1, 2) ** 2, axis=1)
                if np.sum(square) < np.sum(best):
                    best = square
        except cv2.error:
            pass
        return best


def methods(quick: bool) -> None:
    magnifications = QUICK if quick else CALIBRATION_MAGNIFICATIONS
    seen = views_at(magnifications, 3 if quick else 5, 0, NOISE_PX)
    noisy = views_at(HELD_OUT, 2, 99, NOISE_PX)
    clean = views_at(HELD_OUT, 2, 99, 0.0)
    at_calibrated = views_at(magnifications, 2, 98, 0.0)
    times = {} if quick else method_times()
    start = time.perf_counter()
    discrete = fit_discrete(setup_of(seen))
    taken = {"discrete, linear in between": time.perf_counter() - start}

    def nominal(g: float) -> ScanCamera:
        return ScanCamera.nominal(g, *SIZE, MICROSCOPE.display_width_m)

    judges: dict[str, Callable[[], Judge]] = {
        "no correction (nominal camera)": lambda: judged_by_cameras(nominal),
        "discrete, linear in between": lambda: table_model(seen, discrete),
        **{f"pda, order {k}": lambda k=k: pda(seen, discrete, k) for k in (1, 2, 3, 4)},
        "joint": lambda: joint(seen),
        "cv2.calibrateCamera": lambda: OpenCv.calibrated(seen, False).judge,
        "cv2, f guessed, centre fixed": lambda: OpenCv.calibrated(seen, True).judge,
        "the true camera": lambda: judged_by_cameras(MICROSCOPE.camera_at),
    }
    rows: list[list[object]] = []
    for name, make in judges.items():
        try:
            start = time.perf_counter()
            judge = make()
            taken.setdefault(name, time.perf_counter() - start)
        except (CalibrationError, InvalidValueError) as error:
            print(f"{name}: {error}")
            rows.append([name, *[None] * 7])
            continue
        shown, truth = judge(noisy), judge(clean)
        worst = max(truth, key=lambda g: truth[g])
        rms = [float(np.sqrt(np.mean(np.square(list(by_g.values()))))) for by_g in (shown, truth)]
        middle = float(np.median(list(truth.values())))
        own = float(np.sqrt(np.mean(np.square(list(judge(at_calibrated).values())))))
        row = [name, rms[0], floor(noisy), own, rms[1], middle]
        rows.append([*row, f"{truth[worst]:.3g} at {worst:g}x", times.get(name)])
    if quick:
        for row in rows:
            fitted = not str(row[0]).startswith(("pda", "no ", "the "))
            row[-1] = taken[str(row[0])] / taken["joint"] if fitted else None
    failed = [
        f"{g:g}"
        for g, r in zip(discrete.magnifications, discrete.results, strict=True)
        if not r.converged
    ]
    show(
        f"Calibration from {len(seen)} views, {sum(len(v.image_xy) for v in seen)} corners, noise"
        f" {NOISE_PX} px, {len(magnifications)} magnifications; judged at {len(HELD_OUT)} others",
        ["method", "held-out RMS px", "bound px", "calibrated px", "model error px"]
        + ["median px", "worst px", "time"],
        rows,
        "RMS of the distance of corners, over magnifications; bound: the noise that is left after the",
        "poses have been fitted. Model error: the same without noise; median and worst over the",
        "magnifications. calibrated: without noise at the magnifications that were shown, other poses.",
        "OpenCV's poses have free distances, which hide an error of scale; ours have not.",
        "time: ratio to joint"
        + (", one turn" if quick else ", medians of 3 turns")
        + " on the recording of --quick, without held-out checks.",
        f"discrete did not converge at {', '.join(failed) or 'no magnification'}.",
    )


def floor(views: list[GridView]) -> float:
    """RMS over magnifications of what noise leaves: of two coordinates per corner, a view's pose
    takes six.
    """
    shares = []
    for g in sorted({v.magnification for v in views}):
        counts = [len(v.image_xy) for v in views if v.magnification == g]
        shares.append(2.0 * (1.0 - 6.0 * len(counts) / (2.0 * sum(counts))))
    return NOISE_PX * float(np.sqrt(np.mean(shares)))


def method_times() -> dict[str, float]:
    """Times as ratio to joint."""
    seen = views_at(QUICK, 3, 0, NOISE_PX)
    actions: dict[str, Callable[[], object]] = {
        "joint": lambda: joint(seen),
        "discrete, linear in between": lambda: table_model(seen, fit_discrete(setup_of(seen))),
        "cv2.calibrateCamera": lambda: OpenCv.calibrated(seen, False),
        "cv2, f guessed, centre fixed": lambda: OpenCv.calibrated(seen, True),
    }
    times = interleaved(actions, 3)
    return {name: value / times["joint"] for name, value in times.items()}


# -- corners ---------------------------------------------------------------------------------------


def opencv_corners(image: NDArray[np.uint8]) -> Array:
    """Corners that OpenCV finds of a board of unknown extent."""
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_LARGER | cv2.CALIB_CB_ACCURACY
    found, corners, _ = cv2.findChessboardCornersSBWithMeta(image, (3, 3), flags)
    return corners.reshape(-1, 2).astype(np.float64) if found else np.zeros((0, 2))


def against(truth: Array, found: Array) -> tuple[int, int, float | None, NDArray[np.bool_]]:
    """Corners found to a pixel, false ones, RMS error of one coordinate, and which are right."""
    if not len(found):
        return 0, 0, None, np.zeros(0, dtype=bool)
    distance, nearest = cKDTree(truth).query(found)
    right = distance < 1.0
    if not right.any():
        return 0, len(found), None, right
    rms = float(np.sqrt(np.mean((found[right] - truth[nearest[right]]) ** 2)))
    return len(set(nearest[right])), int(np.sum(~right)), rms, right


def corners(quick: bool) -> None:
    magnifications = (100.0, 1000.0, 5000.0) if quick else (100.0, 500.0, 1000.0, 3000.0, 10000.0)
    plan = calibration_plan(MICROSCOPE, magnifications=magnifications, views=2, seed=3)
    rows: list[list[object]] = []
    for index, frame in enumerate(plan.frames):
        image = plan.render(index)
        board, truth = lattice(plan, index, -3.0)
        visible = int(np.sum(np.all((truth > 5.0) & (truth < np.array(SIZE) - 6.0), axis=1)))
        results: dict[str, list[object]] = {"ours": [], "cv2": []}

        def ours(image=image, results=results) -> None:
            results["ours"].append(find_lattice(image))

        def theirs(image=image, results=results) -> None:
            results["cv2"].append(opencv_corners(image))

        times = interleaved({"ours": ours, "cv2": theirs}, 2 if quick else 5)
        mine: LatticeDetection = results["ours"][0]  # type: ignore[assignment]
        found, false, rms, right = against(truth, mine.xy)
        score = None
        sigma = None
        if rms is not None:
            nearest = cKDTree(truth).query(mine.xy[right])[1]
            error = mine.xy[right] - truth[nearest]
            sigma = float(np.sqrt(np.mean(mine.sigma_px[right] ** 2)))
            score = float(np.sqrt(np.mean((error / mine.sigma_px[right][:, None]) ** 2)))
        other = against(truth, results["cv2"][0])  # type: ignore[arg-type]
        tilt = np.degrees(frame.pose.tilt_rad)
        label = f"{frame.magnification:g}x, tilt {tilt:.0f} deg"
        row = [label, visible, found, false, rms, sigma, score, *other[:3]]
        rows.append([*row, times["ours"] / times["cv2"]])
    show(
        "Corner finding in rendered frames of 512 x 512: find_lattice, and findChessboardCornersSB",
        ["frame", "in view", "found", "false", "RMS px", "bound px", "err/sigma"]
        + ["SB found", "SB false", "SB RMS px", "time"],
        rows,
        "RMS is of one coordinate. bound: the 1-sigma that the detection itself states (RMS), which is",
        "the Cramer-Rao bound of its edge model; err/sigma: RMS of error over stated sigma, 1 if honest.",
        "In view: at least 5 px inside; nearer corners may be found as well. SB: 3 x 3 or larger.",
        "time: find_lattice as ratio to findChessboardCornersSB in the same frame, however few it finds.",
    )


def main() -> None:
    quick = quick_from_command_line(__doc__)
    corners(quick)
    methods(quick)


if __name__ == "__main__":
    main()
