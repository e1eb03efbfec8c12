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

"""`semcal acquire` on the virtual microscope with its one-axis stage, unattended, and nm per pixel against the truth.

`python -m benchmarks.acquisition.live` starts the node `virtual_sem` (with the faults of stage, grid and magnification
that it has by default), calibrates from 500x to 10 000x by the command that a user types, and compares nm per pixel of
the result with the microscope that took the pictures. It takes some minutes: the microscope scans as slowly as a real
one. Exit status 1 if an error is above 0.1 %. Needs the nodes installed, as `make setup` does.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.table import quick_from_command_line, show
from examples.live_nodes import LiveNodes
from semcal_ros.calibration import Calibration
from semcal_ros.synthetic import preset

REPOSITORY = Path(__file__).resolve().parents[2]
RANGE = (500.0, 10000.0)
QUICK_RANGE = (1500.0, 3000.0)
TARGET, QUICK_TARGET = 1e-3, 5e-2
SIZE, QUICK_SIZE = 512, 320
# Of the table; the largest error is looked for at more magnifications.
SHOWN, COMPARED = 7, 60


def acquire(folder: Path, limits: tuple[float, float], target: float) -> tuple[Path, str, float]:
    """Calibrate; the file, the last progress that the command told, and how long it took, s."""
    output = folder / "cal.yaml"
    command = [sys.executable, "-u", "-m", "semcal_ros", "acquire", "-o", str(output)]
    command += ["--range", "{:g},{:g}".format(*limits), "--target", f"{100.0 * target:g}%"]
    command += ["--microscope", "virtual_sem", "--config", "virtual_sem"]
    print(" ".join(["semcal", *command[4:]]), flush=True)
    started_s, told = time.monotonic(), ""
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=REPOSITORY) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if re.match(r"\d+/\d+: ", line):
                told = line.partition(":")[0]
            if "calibrating" in line or not re.match(r"\d+/\d+: ", line):
                print(f"{time.monotonic() - started_s:6.0f} s  {line}", end="", flush=True)
    if not output.exists():
        raise SystemExit("no calibration came of it")
    return output, told, time.monotonic() - started_s


def main() -> int:
    """Print the table."""
    quick = quick_from_command_line(__doc__)
    limits, target = (QUICK_RANGE, QUICK_TARGET) if quick else (RANGE, TARGET)
    size = QUICK_SIZE if quick else SIZE
    scene = {"specimen": "grid", "magnification": limits[0], "width": size, "height": size}
    with tempfile.TemporaryDirectory() as folder:
        nodes = LiveNodes(Path(folder) / "logs")
        try:
            nodes.start("virtual_sem", scene)
            file, views, seconds = acquire(Path(folder), limits, target)
        finally:
            nodes.end()
        calibration = Calibration.load(file)
    truth = preset("jsm820").with_image_size(size, size)

    def compare(g: float) -> tuple[float, float, float, float]:
        camera, true_m = calibration.at(g), np.array(truth.camera_at(g).pixel_size_m)
        error = np.array(camera.pixel_size_m) / true_m - 1.0
        stated = np.array(camera.pixel_size_sigma_m) / np.array(camera.pixel_size_m)
        worst = int(np.argmax(np.abs(error)))
        nm = 1e9 * camera.pixel_size_m[worst], 1e9 * true_m[worst]
        return nm[0], nm[1], float(error[worst]), float(stated[worst])

    rows: list[list[object]] = []
    for g in np.geomspace(*limits, SHOWN):
        nm, true_nm, error, stated = compare(float(g))
        told_nm = [f"{value:.4f}" for value in (nm, true_nm)]
        rows.append([f"{g:.0f}x", *told_nm, f"{100.0 * error:+.3f}", f"{100.0 * stated:.3f}"])
    errors = [compare(float(g))[2] for g in np.geomspace(*limits, COMPARED)]
    largest = float(np.max(np.abs(errors)))
    show(
        f"nm per pixel of `semcal acquire` against the microscope that took the pictures, {size} x {size}",
        ["", "nm per px", "truth", "error %", "stated 1-sigma %"],
        rows,
        f"{views.partition('/')[0]} views in {seconds / 60.0:.1f} minutes",
        f"largest error at {COMPARED} magnifications from {limits[0]:g}x to {limits[1]:g}x: {100.0 * largest:.3f} %"
        f" ({'within' if largest <= TARGET else 'above'} {100.0 * TARGET:g} %)",
    )
    return int(largest > TARGET)


if __name__ == "__main__":
    raise SystemExit(main())
