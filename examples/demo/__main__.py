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

"""The whole suite at work, without a microscope: `make demo` runs this.

1. The virtual SEM records a multi-scale chess grid at nine magnifications, upwards and downwards, on a stage whose tilt
   axis misses the specimen.
2. `semcal calibrate` makes a magnification-continuous calibration and its report.
3. The nodes run as processes of their own on the replay of a second recording, in which the specimen drifts and the
   magnification is stepped to values that were never calibrated.
4. What arrives on their topics is measured against the grid, in the paper's own three rows (`--paper` prints its
   errors beside them).

Everything lands in demo_output/.

    python -m examples.demo [--quick] [--paper] [--output FOLDER]
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from examples.demo.correction_page import DemoRow, overlay_change, write_correction_report
from examples.demo.live_suite import LiveSuite, Received
from examples.demo.overview import overview
from semcal_ros import Calibration
from semcal_ros.core.calibration.judgement.evaluate import fit_poses
from semcal_ros.core.calibration.views import GridView
from semcal_ros.core.corners import find_lattice
from semcal_ros.core.errors import Rejection
from semcal_ros.files.images.scale_bar import format_length


@dataclass(frozen=True)
class Plan:
    """What is recorded, and where it goes."""

    output: Path
    calibrated: tuple[int, ...] = (100, 250, 600, 1200, 2500, 4000, 6000, 8000, 10000)
    views: int = 4
    replayed: tuple[int, ...] = (400, 1800, 7000)
    frames: int = 10


STAGES: dict[str, tuple[str, float | tuple[float, float]]] = {
    "image_raw": ("without correction", 7.0),
    "image_stabilized": ("with drift correction", 3.0),
    "image_rect": ("with drift and distortion correction", (0.9, 1.45)),
}


def semcal(*arguments: object) -> None:
    """Run the command as a user would, and stop the demo if it fails."""
    command = [str(Path(sys.executable).with_name("semcal")), *map(str, arguments)]
    print("\n$ semcal", *arguments, flush=True)
    subprocess.run(command, check=True)


def calibrate(plan: Plan) -> Path:
    """Steps 1 and 2."""
    output = plan.output
    magnifications = [x for g in plan.calibrated for x in ("--magnification", g)]
    semcal("simulate", output / "grid", "--plan", "grid", "--views", plan.views, *magnifications)
    semcal(
        "calibrate", output / "grid", "-o", output / "cal.yaml", "--report", output / "report.html"
    )
    semcal("at", output / "cal.yaml", 5250)
    return output / "cal.yaml"


def replay(plan: Plan, calibration: Path) -> Received:
    """Step 3: the nodes on a replay, as processes of their own."""
    output = plan.output
    magnifications = [x for g in plan.replayed for x in ("--magnification", g)]
    semcal(
        "simulate",
        output / "replay",
        "--plan",
        "steps",
        "--frames",
        plan.frames,
        "--drift",
        "fast",
        *magnifications,
    )
    print("\nNodes on the replay:", flush=True)
    with LiveSuite(output / "logs", config="virtual_sem", calibration=calibration) as suite:
        frames = plan.frames * len(plan.replayed)
        for rate in (1.5, 0.75, 0.5):
            received = suite.replay(output / "replay", frames=frames, rate=rate)
            if received.is_complete(frames):
                break
        matrix = suite.parameter("p@2345.6")
    for topic, messages in received.counts().items():
        print(f"  {topic:18} {messages} messages")
    print("  parameter_server  p@2345.6 = " + " ".join(f"{v:.6g}" for v in matrix))
    return received


def reprojection_rms(
    images: dict[int, np.ndarray], view: GridView, cal: Calibration, *, rectified: bool
) -> float:
    """RMS px between the corners of ``images`` and where the grid of the reference frame is.

    The pose of the grid is fitted once, to the corrected reference frame under the camera of rectified images, so what
    is left in other frames is drift and distortion. The aspect and skew of images that are not rectified are no error.
    """
    raw = cal.at(view.magnification)
    camera = raw.rectified
    fit = fit_poses([view], lambda g: camera)
    rotation, translation = fit.rotations[0], fit.translations_m[0]
    h = camera.P_affine @ np.vstack(
        [np.column_stack([rotation[:, :2], translation]), [0.0, 0.0, 1.0]]
    )
    square = np.median(np.diff(np.unique(view.board_xy_m[:, 0].round(12))))
    errors = []
    for image in images.values():
        detection = find_lattice(image)
        if isinstance(detection, Rejection):
            continue
        xy = detection.xy if rectified else raw.rect_from_ideal(detection.xy)
        board = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(h).T
        corner = np.round(board[:, :2] / board[:, 2:] / square) * square
        seen = np.column_stack([corner, np.ones(len(corner))]) @ h.T
        errors.append(np.sum((xy - seen[:, :2] / seen[:, 2:]) ** 2, axis=1))
    return float(np.sqrt(np.mean(np.concatenate(errors))))


def scale_of(cal: Calibration, g: float) -> tuple[float, float]:
    """Pixel size of corrected images, m, and its 1-sigma."""
    camera = cal.at(g).rectified
    return float(camera.pixel_size_m[0]), float(camera.pixel_size_sigma_m[0])


def frames_at(plan: Plan, g: float) -> list[dict[str, Any]]:
    """What truth.json says of the frames at a magnification."""
    truth = json.loads((plan.output / "replay" / "truth.json").read_text())
    return [f for f in truth["frames"] if f["magnification"] == g]


def stamps_at(plan: Plan, g: float, received: Received) -> list[int]:
    """Header stamps, ns, of the frames at a magnification."""
    start = min(received.images["image_raw"])
    return [start + round(f["start_time_s"] * 1e9) for f in frames_at(plan, g)]


def describe_visits(plan: Plan) -> str:
    """How the magnifications of the replay came back, in truth, and where that is in the errors."""
    off = (100.0 * (frames_at(plan, g)[0]["visit_scale"] - 1.0) for g in plan.replayed)
    listed = ", ".join(f"{part:+.2f} % at {g}x" for part, g in zip(off, plan.replayed, strict=True))
    return (
        f"A magnification does not come back exactly: the scale of the replay is off by {listed}. "
        "The fitted height of the grid takes this up, so it is no part of these errors, but of every "
        "length that is measured: see the 1-sigma of nm per px."
    )


def measure(plan: Plan, received: Received, cal: Calibration) -> dict[str, list[float]]:
    """Step 4: RMS of each stage at each magnification."""
    rows: dict[str, list[float]] = {topic: [] for topic in STAGES}
    for g in plan.replayed:
        stamps = stamps_at(plan, g, received)
        first = next((s for s in stamps if s in received.images["image_rect"]), None)
        if first is None:
            sys.exit(f"no frame at {g}x came through all nodes: free the computer and run it again")
        found = find_lattice(received.images["image_rect"][first])
        assert not isinstance(found, Rejection), found.reason
        view = GridView(
            float(g), found.ij * frames_at(plan, g)[0]["square_m"], found.xy, found.sigma_px
        )
        for topic in STAGES:
            images = {s: received.images[topic][s] for s in stamps if s in received.images[topic]}
            rms = reprojection_rms(images, view, cal, rectified=topic == "image_rect")
            rows[topic].append(rms)
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description="The whole suite at work, without a microscope.")
    parser.add_argument("--output", type=Path, default=Path("demo_output"), help="folder to make")
    parser.add_argument("--quick", action="store_true", help="fewer views and frames")
    parser.add_argument("--paper", action="store_true", help="the errors beside those of the paper")
    options = parser.parse_args()
    plan = Plan(options.output)
    if options.quick:
        plan = Plan(options.output, (250, 1000, 4000, 10000), 3, (500, 7000), 6)
    started = time.monotonic()
    if plan.output.exists():
        # Only what the demo has made itself is replaced.
        made = {
            "grid",
            "replay",
            "logs",
            "cal.yaml",
            "report.html",
            "correction.html",
            "overview.png",
        }
        if not {path.name for path in plan.output.iterdir()} <= made:
            parser.error(f"--output {plan.output} has other files; choose a new folder")
        shutil.rmtree(plan.output)
    plan.output.mkdir(parents=True)
    calibration = calibrate(plan)
    received = replay(plan, calibration)
    cal = Calibration.load(calibration)
    rms = measure(plan, received, cal)

    print(
        "\nRMS reprojection error in px, grid corners in the live images, magnifications never calibrated:"
    )
    print(
        f"{'':40}"
        + "".join(f"{g:>8}x" for g in plan.replayed)
        + "      all"
        + "   paper" * options.paper
    )
    rows = []
    for topic, (label, paper) in STAGES.items():
        total = float(np.sqrt(np.mean(np.square(rms[topic]))))
        at = [
            (float(g), error, scale_of(cal, g)[0])
            for g, error in zip(plan.replayed, rms[topic], strict=True)
        ]
        row = DemoRow(label, total, paper if options.paper else None, tuple(at))
        rows.append(row)
        beside = f"   {row.paper_text}" if options.paper else ""
        print(f"{label:40}" + "".join(f"{v:9.3f}" for v in rms[topic]) + f"{total:9.3f}{beside}")

    print(describe_visits(plan))
    through = set.intersection(*(set(received.images[topic]) for topic in STAGES))
    g = plan.replayed[-1]
    stamps = sorted(through & set(stamps_at(plan, g, received)))
    pictures = []
    for topic, (label, _) in STAGES.items():
        first, last = (received.images[topic][stamp] for stamp in (stamps[0], stamps[-1]))
        error = f"{rms[topic][-1]:.2g} px, {format_length(rms[topic][-1] * scale_of(cal, g)[0])}"
        pictures.append(
            (
                f"{label}, {g}x: corners off by {error} RMS",
                overlay_change(first, last, *scale_of(cal, g)),
            )
        )
    overview(plan.output / "overview.png", received.images, stamps, rms, plan.replayed, cal)
    write_correction_report(
        rows,
        pictures,
        plan.output / "correction.html",
        title="Live correction of the virtual SEM",
        notes=[
            f"{plan.frames} frames each at {', '.join(f'{g}x' for g in plan.replayed)}, replayed to the nodes.",
            f"Pictures: the first frame at {g}x in red, the last one in cyan, "
            f"{(stamps[-1] - stamps[0]) / 1e9:.0f} s apart; grey where they agree. "
            "What the distortion does is seen in report.html, raw and corrected.",
            "The grid's pose is fitted once per magnification, to the first corrected frame.",
            describe_visits(plan),
        ],
    )
    print(
        f"\nLook at {plan.output}/report.html, {plan.output}/correction.html and {plan.output}/overview.png "
        f"({time.monotonic() - started:.0f} s)"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
