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

"""All benchmarks as plain text tables.

    python benchmarks/run.py                  everything
    python benchmarks/run.py --quick          smaller and fewer
    python benchmarks/run.py drift rectify    only these parts

===========  =======================================================================================
calibration  calibration methods (joint with and without residual field, the paper's, interpolations
             of separate calibrations, cv2.calibrateCamera) on five simulated microscopes and the
             reference recordings, judged at magnifications that none of them saw; the corner finder
             beside OpenCV's
coverage     how often the stated uncertainty of a calibration holds the truth
drift        registration beside phase correlation, ECC, scikit-image, imreg_dft and pystackreg
             where they are installed, and the Cramer-Rao bound; the time of the tracker, and what
             it leaves of a drift inside the frames
rectify      rectification beside a bare cv2.remap; its map beside the exact inverse
ball         what makes a reconstructed ball too small, one cause at a time
live         one frame through core and node, and the stream over DDS, beside a bare remap and copy
start_up     commands and nodes before they do anything, beside the import of numpy
===========  =======================================================================================

Not among these: ``python -m benchmarks.drift.soak``, 20 000 frames out and back,
``python -m benchmarks.drift.turning``, frames that turn or grow,
``python -m benchmarks.drift.scenes``, scenes of every kind with tools, overlays and lattices in them,
``python -m benchmarks.calibration.ladder``, calibrations that a specimen extends beyond their grid,
``python -m benchmarks.calibration.observable``, what of that shifts, turns and zooms tell,
``python -m benchmarks.calibration.fleet``, random microscopes that a calibration has to hold on,
``python -m benchmarks.calibration.starts``, random first states that have to end at the same place,
``python -m benchmarks.calibration.solvers``, the solver of the calibration beside others,
``python -m benchmarks.calibration.looks``, random pictures of grids that have to be found, and
``python -m benchmarks.thresholds``, what the numbers in the tables of thresholds do.

Everything but one column is measured on simulated data whose truth is known, with fixed seeds.
Accuracy is in px and stands beside a bound wherever there is one. A time is the ratio of two
medians, taken turn by turn in one run, so that it means something on another machine or on a busy
one. Ratios of a few percent are still chance. Nothing here passes or fails.

Each part runs in a process of its own and can be started alone from the root of the repository:
``python -m benchmarks.drift --quick``.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import scipy

ROOT = Path(__file__).resolve().parents[1]
PARTS = {
    "calibration": "benchmarks.calibration",
    "coverage": "benchmarks.calibration.coverage",
    "drift": "benchmarks.drift",
    "rectify": "benchmarks.rectification",
    "ball": "benchmarks.ball",
    "live": "benchmarks.live",
    "start_up": "benchmarks.start_up",
}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help="; ".join(PARTS))
    parser.add_argument("--quick", action="store_true", help="less of everything")
    options = parser.parse_args()
    for part in options.parts:
        if part not in PARTS:
            parser.error(f"no part {part}; there are {', '.join(PARTS)}")
    print(
        f"Python {platform.python_version()}, numpy {np.__version__}, scipy {scipy.__version__},"
        f" OpenCV {cv2.__version__} with {cv2.getNumThreads()} threads, {os.cpu_count()} processors",
        flush=True,
    )
    failed = []
    for part in options.parts or PARTS:
        start = time.monotonic()
        command = [sys.executable, "-m", PARTS[part], *(["--quick"] if options.quick else [])]
        done = subprocess.run(command, cwd=ROOT, check=False)
        if done.returncode:
            failed.append(part)
        print(f"[{part}: {time.monotonic() - start:.0f} s]", flush=True)
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    raise SystemExit(main())
