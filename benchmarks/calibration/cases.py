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

"""Views of the grid for the benchmark of the calibrations, with their truth: of simulated microscopes, and the
reference recordings.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from semcal_ros.config.config import load_config
from semcal_ros.core.arrays import Array
from semcal_ros.core.calibration.judgement.evaluate import fit_poses
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.files.recordings import open_recording
from semcal_ros.synthetic import (
    CALIBRATION_MAGNIFICATIONS,
    RecordingPlan,
    VirtualMicroscope,
    calibration_plan,
    drift_preset,
    preset,
)
from semcal_ros.workflows.find_grid import CollectedViews, collect_views, find_views, named_frames

PixelSize = tuple[float, float]

# Label in the tables, and the preset.
MICROSCOPES = {
    "ordinary": "jsm820",
    "perspective": "strong_perspective",
    "off centre": "off_centre",
    "undistorted": "no_distortion",
    "residual": "scan_nonlinear",
}
REFERENCE = "reference"
RECORDINGS = ("grid_calibration", "grid_zoom_sweep")
CONFIG = load_config("generic")
NOISE_PX = 0.05
# Of the views' heights: that of the simulated recordings, and what is assumed of those that are judged.
HEIGHT_SIGMA_M = 4e-5
QUICK = (100.0, 500.0, 1500.0, 3000.0, 5000.0, 7000.0, 10000.0)
HELD_OUT = (170.0, 300.0, 750.0, 1250.0, 2750.0, 4250.0, 5750.0, 7250.0, 9250.0)
BORDER_PX = 5.0
# As in the demo: frames without a pause, while the specimen drifts.
DRIFT, DRIFT_FRAMES = "fast", 10


@dataclass(frozen=True)
class Case:
    """One microscope: what the methods calibrate from, and what they are judged by.

    Attributes
    ----------
    name, source
        Label in the tables, and where the views come from.
    seen
        Views to calibrate from.
    judged, clean
        Views of magnifications that are not among those, and the same without noise.
    shifts_px
        (frames, n, 2) for each of these views: how far drift moves its corners. Empty if there is none.
    pixel_size_m
        True pixel size (x, y) at the magnifications of these views.
    working_distance_m
        From the scan pivot to the reference plane.
    """

    name: str
    source: str
    image_size: tuple[int, int]
    display_width_m: float
    seen: tuple[GridView, ...]
    judged: tuple[GridView, ...]
    clean: tuple[GridView, ...]
    shifts_px: tuple[Array, ...]
    pixel_size_m: Mapping[float, PixelSize]
    working_distance_m: float

    def nominal_px_per_m(self, g: float) -> float:
        """Scale that the display width alone predicts."""
        return g * self.image_size[0] / self.display_width_m

    def bound_px(self) -> float:
        """RMS of what the noise leaves: of two coordinates per corner, a view's pose takes six."""
        shares = []
        for g in sorted(self.pixel_size_m):
            own = [v for v in self.judged if v.magnification == g]
            square = np.concatenate([v.sigma_px**2 for v in own])
            shares.append(2.0 * np.mean(square) * (1.0 - 6.0 * len(own) / (2.0 * len(square))))
        return float(np.sqrt(np.mean(shares)))


# -- simulated microscopes -------------------------------------------------------------------------


def lattice(plan: RecordingPlan, index: int, margin: float) -> tuple[Array, Array]:
    """Corners of the grid in a frame, m on the grid and px in the image."""
    frame, microscope = plan.frames[index], plan.microscope
    assert frame.square_m is not None
    size = np.array(microscope.image_size)
    i, j = np.meshgrid(np.arange(-80, 81), np.arange(-80, 81))
    board = np.column_stack([i.ravel(), j.ravel()]) * frame.square_m
    # Far outside, the distortion has no answer and no business.
    ideal = microscope.camera_at(frame.magnification).project_ideal(
        frame.pose.sem_from_specimen(board)
    )
    near = np.all(np.abs(ideal - size / 2.0) < 0.7 * size, axis=1)
    board = board[near]
    xy = microscope.distort(frame.magnification, ideal[near])
    inside = np.all((xy > margin) & (xy < size - 1.0 - margin), axis=1)
    return board[inside], xy[inside]


def views_of(plan: RecordingPlan, noise_px: float) -> tuple[GridView, ...]:
    """The frames' corners with that noise, but always with the sigma of the usual one."""
    rng = np.random.default_rng(plan.seed)
    out = []
    for index, frame in enumerate(plan.frames):
        board, xy = lattice(plan, index, BORDER_PX)
        measured = xy + rng.normal(0.0, noise_px, xy.shape)
        sigma = np.full(len(xy), NOISE_PX)
        out.append(GridView(frame.magnification, board, measured, sigma, f"view {index}"))
    return tuple(out)


def drift_shifts(plan: RecordingPlan, index: int) -> Array:
    """(frames, n, 2) px by which drift moves a frame's corners from then on, each pixel at its own time."""
    frame, microscope = plan.frames[index], plan.microscope
    board, xy = lattice(plan, index, BORDER_PX)
    points = frame.pose.sem_from_specimen(board)
    width, height = microscope.image_size
    late_s = microscope.timing.pixel_offset_s(xy[:, 1], xy[:, 0], height, width)
    drift = drift_preset(DRIFT)
    out = []
    for number in range(DRIFT_FRAMES):
        moved = points.copy()
        moved[:, :2] += drift(number * microscope.timing.acquisition_time_s + late_s)
        out.append(microscope.project(frame.magnification, moved) - xy)
    return np.stack(out)


def simulated(label: str, quick: bool) -> Case:
    """A simulated microscope: corners projected by the true camera, with noise."""
    microscope = preset(MICROSCOPES[label])
    # Columns with luck of their own.
    seed = list(MICROSCOPES).index(label)
    magnifications = QUICK if quick else CALIBRATION_MAGNIFICATIONS
    shown = calibration_plan(
        microscope,
        magnifications=magnifications,
        views=3 if quick else 5,
        seed=seed,
        height_sigma_m=HEIGHT_SIGMA_M,
    )
    held_out = HELD_OUT[::3] if quick else HELD_OUT
    plan = calibration_plan(
        microscope, magnifications=held_out, views=2, seed=99 + seed, height_sigma_m=HEIGHT_SIGMA_M
    )
    return Case(
        label,
        f"simulated {microscope.name}",
        microscope.image_size,
        microscope.display_width_m,
        views_of(shown, NOISE_PX),
        views_of(plan, NOISE_PX),
        views_of(plan, 0.0),
        tuple(drift_shifts(plan, index) for index in range(len(plan))),
        {g: pixel_size_m(microscope, g) for g in held_out},
        1.0 / microscope.camera_at(HELD_OUT[0]).rho,
    )


def pixel_size_m(microscope: VirtualMicroscope, g: float) -> PixelSize:
    """True pixel size (x, y), to which what the residual has of a linear map belongs.

    That is found by regression on shifts, linear maps and the patterns of the two distortion parameters.
    """
    camera = microscope.camera_at(g)
    x, y = np.meshgrid(*(np.linspace(0.0, size - 1.0, 64) for size in microscope.image_size))
    raw = np.column_stack([x.ravel(), y.ravel()])
    moved = camera.distort(microscope.undistort(g, raw)) - raw
    q = (raw - [camera.ex, camera.ey]) / camera.norm_px
    r2 = np.sum(q * q, axis=1, keepdims=True)
    maps = np.einsum("nk,ij->nikj", np.column_stack([np.ones(len(q)), q]), np.eye(2))
    patterns = np.stack([r2 * q, r2 + 2.0 * q * q], axis=2)
    design = np.concatenate([maps.reshape(len(q), 2, 6), patterns], axis=2).reshape(-1, 8)
    found = np.linalg.lstsq(design, moved.ravel() / camera.norm_px, rcond=None)[0]
    # Columns of the maps: by 1, x and y, for each of them the x and the y of the displacement.
    own_x, own_y = camera.pixel_size_m
    return own_x / (1.0 - float(found[2])), own_y / (1.0 - float(found[5]))


# -- reference recordings --------------------------------------------------------------------------


def reference_folder() -> Path:
    """Where the reference recordings are looked for."""
    beside = Path(__file__).resolve().parents[3] / "shared" / "data"
    return Path(os.environ.get("SEMCAL_REFERENCE_DATA") or beside)


def reference(folder: Path, quick: bool) -> Case:
    """Another simulator's recordings: the corners are found in their images. The sweep is free of drift.

    Without noise, the corners of the sweep are where the true camera sees them in the pose that they have.
    """
    calibration, sweep = (folder / name for name in RECORDINGS)
    # Five views follow one another at each magnification.
    shown = found_in(calibration, lambda k, g: not quick or (g in QUICK and k % 5 < 3))
    known = {v.magnification for v in shown.views}
    judged = found_in(sweep, lambda k, g: g not in known and not (quick and k % 6))
    truth = json.loads((sweep / "truth.json").read_text())["params"]
    cameras = {float(g): true_camera(float(g), p, shown.image_size) for g, p in truth.items()}
    rho = next(iter(cameras.values())).rho
    return Case(
        REFERENCE,
        f"{calibration.name} and {sweep.name}",
        shown.image_size,
        CONFIG.display_width_m,
        shown.views,
        judged.views,
        seen_by(judged.views, lambda g: cameras[g]),
        (),
        {v.magnification: cameras[v.magnification].pixel_size_m for v in judged.views},
        1.0 / rho,
    )


def true_camera(g: float, truth: Mapping[str, float], image_size: tuple[int, int]) -> ScanCamera:
    """From the truth of the recordings, in um. They have no residual."""
    assert truth["spiral"] == truth["sine"] == 0.0
    width, height = image_size
    return ScanCamera(
        magnification=g,
        m=truth["m"] * 1e6,
        aspect=truth["a"],
        skew=truth["s"] / truth["m"],
        px=truth["px"],
        py=truth["py"],
        rho=truth["rho"] * 1e6,
        xi_r=truth["xr"],
        xi_t=truth["xt"],
        ex=truth["ex"],
        ey=truth["ey"],
        norm_px=0.5 * width,
        width=width,
        height=height,
    )


def seen_by(
    views: Sequence[GridView], camera_at: Callable[[float], ScanCamera]
) -> tuple[GridView, ...]:
    """The views without noise: their corners where these cameras see them, in the poses that fit best."""
    fit = fit_poses(views, camera_at, height_sigma_m=HEIGHT_SIGMA_M)
    out = []
    for view, rotation, shift in zip(views, fit.rotations, fit.translations_m, strict=True):
        xy = camera_at(view.magnification).project(view.board_xy_m @ rotation[:, :2].T + shift)
        out.append(GridView(view.magnification, view.board_xy_m, xy, view.sigma_px, view.name))
    return tuple(out)


def found_in(path: Path, wanted: Callable[[int, float], bool]) -> CollectedViews:
    """The grid in the images of a recording whose number and magnification are wanted."""
    with open_recording(path, CONFIG) as recording:
        frames = (f for k, f in enumerate(named_frames(recording)) if wanted(k, f[2]))
        found, rejected = find_views(frames)
    if rejected:
        print(f"{path.name}: {len(rejected)} images rejected, the first: {rejected[0].reason}")
    return collect_views(
        found, rejected, display_width_m=CONFIG.display_width_m, squares_m=CONFIG.squares_m
    )
