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

"""One frame from message to message, and the stream over DDS, beside the least that must be done.

callback.py measures what happens inside a process, stream.py what three processes see
of each other; this makes one table and a plot of both.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path

from benchmarks.live.callback import COLUMNS
from benchmarks.live.stream import DDS_VARIABLES, MALLOC
from benchmarks.table import show

REPOSITORY = Path(__file__).resolve().parents[2]
PLOT = REPOSITORY / "bench_output" / "live.png"
SIZES = (512, 1024, 2048, 4096)
# Frames per second over DDS, and seconds; so many that the busiest process has time to spare.
RATES = {512: 60.0, 1024: 25.0, 2048: 8.0, 4096: 3.0}
SECONDS = 15.0


def asked(command: list[str], extra: dict[str, str] | None = None) -> dict[str, object] | None:
    """JSON that a module of this folder prints, or None if it fails."""
    environment = {k: v for k, v in os.environ.items() if k not in (*DDS_VARIABLES, *MALLOC)}
    # As the nodes set it for themselves: small matrices do not want threads that wait in loops.
    environment |= {"OPENBLAS_NUM_THREADS": "1", **(extra or {})}
    done = subprocess.run(
        [sys.executable, "-m", *command],
        cwd=REPOSITORY,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        check=False,
    )
    return json.loads(done.stdout) if done.returncode == 0 and done.stdout.strip() else None


def callbacks(sizes: tuple[int, ...], quick: bool, busy: bool) -> list[list[object]]:
    rows: list[list[object]] = []
    for size in sizes:
        for depth in (8, 16):
            command = ["benchmarks.live.callback", str(size), str(depth)]
            command += ["--quick"] * quick + ["--busy"] * busy
            found = asked(command, MALLOC) or {}
            floor = found.get("floor")
            in_ms = 1e3 * floor if isinstance(floor, float) else None
            rows.append([f"{size} mono{depth}", in_ms, *(found.get(name) for name in COLUMNS)])
    return rows


def streams(sizes: tuple[int, ...], floors: dict[int, float], quick: bool) -> list[list[object]]:
    rows: list[list[object]] = []
    seconds = str(SECONDS / (3.0 if quick else 1.0))
    variants = {
        "least node, default transport": ["--relay", "--default-transport"],
        "least node": ["--relay"],
        "stream_corrector, default transport": ["--default-transport"],
        "stream_corrector": [],
    }
    for size in sizes:
        for name, options in variants.items():
            command = ["benchmarks.live.stream", str(size), str(RATES[size]), "--seconds", seconds]
            found = asked(command + options) or {}

            def times(key: str, found: dict = found, size: int = size) -> float | None:
                value = found.get(key)
                return None if value is None else float(value) / floors[size]

            row: list[object] = [f"{size}  {name}", RATES[size], found.get("in"), found.get("lost")]
            row += [times("median_ms"), times("p99_ms"), found.get("cores")]
            rows.append(row)
    return rows


def plot(rows: list[list[object]], path: Path) -> None:
    """Ratios to the floor over the image size, one line for each column; mono8."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7.0, 4.2), layout="constrained")
    kept = [row for row in rows if "mono8" in str(row[0]) and row[1] is not None]
    sizes = [int(str(row[0]).split()[0]) for row in kept]
    styles = {"core": "--", "field": ":", "node": "-"}
    for index, name in enumerate(COLUMNS[:-1], 2):
        style = styles[name.partition(",")[0]]
        axes.plot(sizes, [row[index] for row in kept], style, marker="o", label=name)
    axes.axhline(1.0, color="0.5", linewidth=1.0)
    axes.set(xscale="log", xlabel="image size, px", ylabel="time over remap + copy", ylim=(0, None))
    axes.set_xticks(sizes, [str(size) for size in sizes], minor=False)
    axes.minorticks_off()
    axes.legend(frameon=False, fontsize=8, ncols=2)
    path.parent.mkdir(exist_ok=True)
    figure.savefig(path, dpi=120)
    print(f"plot: {path}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="less of everything")
    parser.add_argument(
        "--busy", action="store_true", help="processor time of one thread, and nothing over DDS"
    )
    parser.add_argument("--plot", type=Path, default=PLOT)
    options = parser.parse_args()
    try:
        import rclpy  # noqa: F401
    except ImportError:
        print("\nLive nodes over DDS: rclpy is not installed")
        return
    sizes = SIZES[:3] if options.quick else SIZES
    inside = callbacks(sizes, options.quick, options.busy)
    show(
        "Live, inside a process: time as ratio to cv2.remap with maps at hand and one copy",
        ["frames", "floor ms", *COLUMNS],
        inside,
        "core: Rectifier.rectify; field: the same with a residual field.",
        "node: from the message that has arrived to the messages published.",
        "still: nothing changes. drift, magnification, both: they change with every frame.",
        "node, still: rectifier; node, both: stream_corrector without registration, which stands",
        "beside it. Floor ms: for orientation, on this machine at this moment.",
    )
    if options.busy:
        plot(inside, options.plot)
        return
    floors = {int(str(r[0]).split()[0]): float(str(r[1])) for r in inside if "mono8" in str(r[0])}
    show(
        "Live, over DDS: mono8 from publisher to node to subscriber, three processes",
        ["frames  node", "Hz", "in", "lost", "median", "99 %", "cores"],
        streams(sizes, floors, options.quick),
        "median, 99 %: latency from before publishing to a Python subscriber, over the floor of this",
        "size above. least node: cv2.remap with maps at hand into the outgoing message, in Python.",
        "cores: processor time of the node per second. Transport: the profile in dds/ and malloc set,",
        "or the default. Reliable, keep-last 10 at the node.",
    )
    plot(inside, options.plot)


if __name__ == "__main__":
    main()
