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

"""What a command and a node cost before they do anything, beside the import of numpy.

    python -m benchmarks.start_up

Processor time is that of the whole process, as a multiple of `python -c "import numpy"`, which has
its turn in every round. Memory is the largest resident size; libraries that other processes have
loaded, too, count in it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from pathlib import Path
from statistics import median

from benchmarks.table import quick_from_command_line, show

NODES = (
    *("bag_player", "calibration_server", "drift_compensator", "microscope", "parameter_server"),
    *("rectifier", "stream_corrector", "virtual_sem", "visual_servo"),
)
UNIT = "import numpy"


def programs(folder: Path) -> dict[str, list[str]]:
    """Arguments of Python for each row."""
    file = folder / "cal.yaml"
    # Not in this process: Linux counts the memory of the parent as a child's until it has more.
    code = "import sys; from benchmarks.live.scenes import calibration; calibration().save(sys.argv[1])"
    run(["-c", code, str(file)])
    return {
        UNIT: ["-c", "import numpy"],
        "semcal --help": ["-m", "semcal_ros", "--help"],
        "semcal at cal.yaml 5250": ["-m", "semcal_ros", "at", str(file), "5250"],
        "from semcal_ros import Calibration": ["-c", "from semcal_ros import Calibration"],
        **{
            f"import of the node {name}": ["-c", f"import semcal_ros.nodes.{name}"]
            for name in NODES
        },
    }


def run(arguments: list[str]) -> tuple[float, float]:
    """Processor time in s and largest memory in MB of a process."""
    made = subprocess.Popen(
        [sys.executable, *arguments],
        stdout=subprocess.DEVNULL,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )
    _, status, used = os.wait4(made.pid, 0)
    made.returncode = os.waitstatus_to_exitcode(status)
    if made.returncode:
        raise subprocess.CalledProcessError(made.returncode, arguments)
    return used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def main() -> None:
    rounds = 3 if quick_from_command_line(__doc__) else 11
    with tempfile.TemporaryDirectory() as folder:
        rows = programs(Path(folder))
        seen: dict[str, list[tuple[float, float]]] = {name: [] for name in rows}
        for k in range(rounds + 1):
            for name, arguments in rows.items():
                used = run(arguments)
                # The first round compiles modules and reads files from the disk.
                if k:
                    seen[name].append(used)
    unit_s = median(cpu_s for cpu_s, _ in seen[UNIT])
    show(
        f"Start-up: processor time over that of `{UNIT}` ({unit_s:.2f} s), memory in MB",
        ["program", "time", "memory"],
        [
            [name, median(c for c, _ in values) / unit_s, median(m for _, m in values)]
            for name, values in seen.items()
        ],
    )


if __name__ == "__main__":
    main()
