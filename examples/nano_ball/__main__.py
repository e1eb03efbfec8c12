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

"""A ball of 900 nm on a tip, reconstructed from a recording at 9000x to 10 000x.

After section 4.4 of Malti et al. (2012). The virtual SEM records the chess grid and the ball; the grid is
calibrated, the ball is reconstructed with that calibration and compared with the truth, which nothing before has
seen.

    .venv/bin/python -m examples.nano_ball            # 2000 frames of 2048 x 320 px, some minutes and 1.4 GB
    .venv/bin/python -m examples.nano_ball --only-looks --seeds 60   # balls of 60 other looks, an hour
    .venv/bin/python -m examples.nano_ball --quick    # 40 frames of two thirds of a turn to and fro
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import trimesh
from joblib import Parallel, delayed
from tqdm import tqdm

from examples.nano_ball.looks import compare_looks, slow_down
from semcal_ros import Calibration
from semcal_ros.applications.reconstruction import SequenceTracker, TrackKeyframe
from semcal_ros.cli import main as semcal
from semcal_ros.config.config import load_config
from semcal_ros.files.bags.writer import SIMULATED_START_NS, write_simulated
from semcal_ros.files.recordings import open_recording
from semcal_ros.report.html.encode import encode_png
from semcal_ros.report.html.style import INK, OURS, SECOND, add_color_bar, create_figure, style_axes
from semcal_ros.synthetic.drift import drift_preset
from semcal_ros.synthetic.specimens.ball import BallPlan, Turning, ball_plan

GRID_MAGNIFICATIONS = (100, 500, 1000, 2000, 3000, 4500, 6000, 7500, 9000, 10000)
CONFIG = """\
name: virtual SEM, ten strips per second
display_width_m: 0.12
magnification: {topic: magnification, quantity: magnification}
scan: {frame_time_s: 0.1, averages: 1, flyback_fraction: 0.1}
"""


def run(*arguments: object) -> str:
    """Call ``semcal`` as from a shell; returns what it prints."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        status = semcal([str(a) for a in arguments])
    if status:
        raise SystemExit(f"semcal {arguments[0]} ended with status {status}")
    return printed.getvalue()


# -- recording ------------------------------------------------------------------------------------


def record(plan: BallPlan, path: Path) -> None:
    """Write the ball to a bag with its truth beside it; frames are drawn on all processors."""
    drawn = Parallel(n_jobs=-1, return_as="generator")(
        delayed(plan.render)(index) for index in range(len(plan))
    )
    bar = tqdm(drawn, total=len(plan), desc="simulating", unit="frame", disable=None)
    write_simulated(path, plan.frames, bar, plan.truth(), overwrite=True)


# -- comparison -----------------------------------------------------------------------------------


def distances_nm(points: np.ndarray, diameter_nm: float) -> np.ndarray:
    """Distances of points (n, 3) from a sphere of the true size at the best place.

    The place is free because nothing fixes it: drift and the manipulator move the ball as they like.
    """
    centre = points.mean(axis=0)
    for _ in range(50):
        offset = points - centre
        length = np.linalg.norm(offset, axis=1)
        outward = offset / length[:, None]
        centre = centre + np.linalg.lstsq(outward, length - diameter_nm / 2.0, rcond=None)[0]
    return np.linalg.norm(points - centre, axis=1) - diameter_nm / 2.0


def compared(cloud: Path, mesh: Path, truth: dict, result: dict) -> dict[str, float]:
    """What was measured against the truth."""
    true_nm = 1e9 * truth["ball_diameter_m"]
    made: Any = trimesh.load(cloud, process=False)
    raw = made.metadata["_ply_raw"]["vertex"]["data"]
    points = np.asarray(made.vertices)[np.asarray(raw["on_ball"]).ravel() > 0.5]
    shape: Any = trimesh.load(mesh, process=False)
    vertices = np.asarray(shape.vertices)
    low, high = (1e9 * v for v in result["diameter_interval_m"])
    return {
        "diameter_error_percent": 100.0 * (1e9 * result["diameter_m"] / true_nm - 1.0),
        "interval_holds_truth": float(low <= true_nm <= high),
        "points_rms_nm": float(np.sqrt(np.mean(distances_nm(points, true_nm) ** 2))),
        "mesh_rms_nm": float(np.sqrt(np.mean(distances_nm(vertices, true_nm) ** 2))),
    }


# -- figures --------------------------------------------------------------------------------------


def picture_of_tracks(bag: Path, config: Path, model: Calibration, frames: int) -> bytes:
    """Some frames with the features that are followed, as in Fig. 17(a) of the paper."""
    tracker = SequenceTracker()
    with open_recording(bag, load_config(str(config))) as opened:
        for number, frame in enumerate(opened.frames()):
            if number >= frames:
                break
            height, width = frame.image.shape
            camera = model.at(frame.magnification).resized(width, height)
            tracker.add(frame.image, camera, (frame.stamp_ns - SIMULATED_START_NS) * 1e-9)
    keyframes = tracker.finish()
    chosen = [keyframes[int(k)] for k in np.linspace(0, len(keyframes) - 1, 3)]
    figure = create_figure(9.6, 2.8)
    figure.set_layout_engine("constrained", h_pad=0.1)
    for column, keyframe in enumerate(chosen):
        axes = figure.add_subplot(1, 3, column + 1)
        axes.imshow(keyframe.image, cmap="gray", vmin=0, vmax=200)
        draw_trails(axes, keyframes[: keyframes.index(keyframe) + 1])
        left = np.percentile(keyframe.xy[:, 0], 1) - 40.0
        axes.set(xlim=(left, left + 420.0), ylim=(319.5, -0.5), xticks=[], yticks=[])
        title = f"frame {keyframe.index}, {keyframe.camera.magnification:g}x"
        axes.set_title(title, fontsize=9, color=INK)
        bar_px = 500e-9 / keyframe.camera.pixel_size_m[0]
        axes.plot((left + 20.0, left + 20.0 + bar_px), (300.0, 300.0), color="white", linewidth=2.0)
        axes.text(left + 20.0, 290.0, "500 nm", color="white", fontsize=8)
    return encode_png(figure, 100.0)


def draw_trails(axes, keyframes: list[TrackKeyframe]) -> None:
    """Features of the last keyframe, and where they were in those before."""
    last = keyframes[-1]
    axes.plot(*last.xy.T, ".", color="#4fb3ff", markersize=2)
    for number in last.ids[:: max(1, len(last.ids) // 120)]:
        parts = [f.xy[f.ids == number] for f in keyframes[-8:]]
        trail = np.concatenate([part for part in parts if len(part)])
        axes.plot(*trail.T, "-", color="#ffb347", linewidth=0.6)


def picture_of_error(mesh: Path, true_nm: float) -> bytes:
    """Where the mesh departs from the true sphere."""
    shape: Any = trimesh.load(mesh, process=False)
    vertices = np.asarray(shape.vertices)
    error = distances_nm(vertices, true_nm)
    figure = create_figure(9.0, 3.0)
    figure.set_layout_engine("constrained", w_pad=0.12, h_pad=0.08, wspace=0.08)
    axes = figure.add_subplot(1, 2, 1)
    reach = float(np.percentile(np.abs(error), 98))
    shown = axes.scatter(*vertices[:, :2].T, c=error, s=9, cmap="RdBu_r", vmin=-reach, vmax=reach)
    style_axes(axes, xlabel="X (nm)", ylabel="Y (nm)")
    axes.set_aspect("equal")
    axes.invert_yaxis()
    add_color_bar(shown, axes, "from the true sphere (nm)")
    axes = figure.add_subplot(1, 2, 2)
    axes.hist(error, bins=31, color=OURS)
    axes.axvline(0.0, color=SECOND, linewidth=1.0)
    style_axes(axes, xlabel="distance from the true sphere (nm)", ylabel="vertices")
    return encode_png(figure, 100.0)


# -- all of it ------------------------------------------------------------------------------------


def report(path: Path, summary: dict[str, Any]) -> None:
    path.write_text(json.dumps(summary, indent=1))
    for name, value in summary.items():
        print(f"{name:28} {value}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--frames", type=int, help="of the ball (default 2000)")
    parser.add_argument(
        "--quick",
        action="store_true",
        help="40 frames of a simpler movement, a smaller calibration",
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--seeds",
        type=int,
        help="number of balls of other looks besides, from --seed on (default 5; quick: none)",
    )
    parser.add_argument("--only-looks", action="store_true", help="only the balls of other looks")
    parser.add_argument("--output", type=Path, default=Path("nano_ball_output"))
    parser.add_argument("--images", type=Path, help="folder for the figures (default: the output)")
    given = parser.parse_args()
    frames = given.frames or (40 if given.quick else 2000)
    out, images = given.output, given.images or given.output
    out.mkdir(parents=True, exist_ok=True)
    seeds = given.seeds if given.seeds is not None else (0 if given.quick else 5)
    looks = compare_looks(seeds, given.seed) if seeds else {}
    if given.only_looks:
        report(out / "looks.json", looks)
        return
    config = out / "strips.yaml"
    config.write_text(CONFIG)

    # 1. Calibrate with 512 x 512 images of the grid; the ball's frames have another size.
    magnifications = GRID_MAGNIFICATIONS[-3:] if given.quick else GRID_MAGNIFICATIONS
    wanted = [part for g in magnifications for part in ("--magnification", g)]
    views = 3 if given.quick else 5
    run("simulate", out / "grid", "--views", views, *wanted, "--seed", given.seed, "--overwrite")
    print(run("calibrate", out / "grid", "-o", out / "cal.yaml"))

    # 2. The ball, with drift, every line at its own time.
    # Fewer frames are some of the same movement, not a faster one.
    interval_s = 0.1 * max(1.0, 2000 / frames)
    # In a recording of half an hour, the drift of some minutes would carry the ball out of the field.
    drift = slow_down(drift_preset("settling"), 2000 / frames)
    # So few frames follow a simpler movement only: from one to the next, features must stay alike.
    motion = Turning(frames * interval_s, rolls=0.67, yaws=0.67) if given.quick else None
    plan = ball_plan(
        frames=frames, interval_s=interval_s, motion=motion, drift=drift, seed=given.seed
    )
    record(plan, out / "ball")

    # 3. Reconstruct.
    begun = time.perf_counter()
    command = ["reconstruct", out / "ball", "--calibration", out / "cal.yaml", "--config", config]
    files = ["--cloud", out / "cloud.ply", "--figure", images / "nano_ball_mesh.png"]
    printed = run(*command, "-o", out / "ball.ply", *files, "--json")
    seconds = time.perf_counter() - begun
    result = json.loads(printed)

    # 4. Compare with the truth.
    truth = json.loads((out / "ball" / "truth.json").read_text())
    errors = compared(out / "cloud.ply", out / "ball.ply", truth, result)
    report(out / "summary.json", {"seconds": seconds, **result, **errors, **looks})

    # 5. Figures.
    model = Calibration.load(out / "cal.yaml")
    tracks = picture_of_tracks(out / "ball", config, model, 10 if given.quick else min(frames, 200))
    (images / "nano_ball_tracks.png").write_bytes(tracks)
    error = picture_of_error(out / "ball.ply", 1e9 * truth["ball_diameter_m"])
    (images / "nano_ball_error.png").write_bytes(error)


if __name__ == "__main__":
    main()
