"""Are the stated uncertainties true? Many simulated calibrations, and how often their intervals hold the truth.

Each calibration has its own poses, heights and corner noise. A point in the field of a magnification between the
calibrated ones is projected by the calibrated and by the true camera; the difference over `project_sigma` should have
the quantiles of a normal distribution. Points of one calibration share its errors, so the counts are over few
independent cases.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


import numpy as np
from joblib import Parallel, delayed

from benchmarks.table import quick_from_command_line, show
from semcal_ros.core.calibration.calibrate import calibrate_views
from semcal_ros.synthetic import preset
from semcal_ros.synthetic.grid_views import grid_views

PRESETS = ("jsm820", "strong_perspective", "off_centre", "pincushion", "no_distortion")
MAGNIFICATIONS = (100.0, 300.0, 700.0, 1500.0, 2500.0, 4000.0, 6000.0, 8000.0, 10000.0)
NOISE_PX = 0.05
POINTS = 40


def deviations(name: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Errors over stated sigmas: of projected points, both coordinates, and of nm per pixel."""
    microscope, rng = preset(name), np.random.default_rng(seed)
    views = grid_views(
        microscope.camera_at,
        MAGNIFICATIONS,
        views=4,
        noise_px=NOISE_PX,
        seed=seed,
        flat_height_sigma_m=40e-6,
    )
    model = calibrate_views(
        views, image_size=microscope.image_size, display_width_m=microscope.display_width_m
    ).model
    pixel, scale = [], []
    for g in np.exp(rng.uniform(np.log(100.0), np.log(10000.0), POINTS)):
        camera, truth = model.at(float(g)), microscope.camera_at(float(g))
        xy = rng.uniform(0.0, 511.0, (1, 2))
        point = truth.sem_from_ideal(truth.undistort(xy))
        pixel.append((camera.project(point) - truth.project(point)) / camera.project_sigma(point))
        change = np.array(camera.pixel_size_m) - np.array(truth.pixel_size_m)
        scale.append(change / np.array(camera.pixel_size_sigma_m))
    return np.concatenate(pixel).ravel(), np.concatenate(scale)


def share(z: np.ndarray, limit: float) -> str:
    """Percentage within a limit."""
    return f"{100.0 * np.mean(np.abs(z) < limit):.1f}"


def main() -> None:
    """Print the table."""
    count = 10 if quick_from_command_line(__doc__) else 50
    jobs = [(PRESETS[seed % len(PRESETS)], seed) for seed in range(count)]
    results = Parallel(n_jobs=-1)(delayed(deviations)(*job) for job in jobs)
    rows: list[list[object]] = []
    for name in (*PRESETS, "all"):
        chosen = [r for (own, _), r in zip(jobs, results, strict=True) if name in (own, "all")]
        row: list[object] = [name, len(chosen)]
        for k in (0, 1):
            z = np.concatenate([r[k] for r in chosen])
            row += [float(np.sqrt(np.mean(z**2))), share(z, 1.0), share(z, 1.96)]
        rows.append(row)
    show(
        f"Coverage of the stated uncertainty; {len(MAGNIFICATIONS)} magnifications x 4 views",
        [
            "microscope",
            "calibrations",
            "px err/sigma",
            "68 %",
            "95 %",
            "nm err/sigma",
            "68 %",
            "95 %",
        ],
        rows,
        "err/sigma: RMS, 1 if honest; 68 % and 95 %: percent of the errors within 1 and 1.96 sigma.",
        "px: project_sigma of points in the field; nm: pixel_size_sigma_m. At magnifications between.",
    )


if __name__ == "__main__":
    main()
