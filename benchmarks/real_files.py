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

"""Real files, beside independent readers and methods: a table of file, result, reference and verdict.

    python -m benchmarks.real_files --tiffs DIR... --triplet a.png b.png c.png --patterns FILE... --scans FILE

Nothing is fetched: the files are those of public repositories, named in ``doc/measured.md``. With RosettaSciIO
(``pip install rosettasciio``), ``--tiffs`` compares with what it reads. Photographs of a board have a benchmark of
their own, ``python -m benchmarks.calibration.photographs``.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import tempfile
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy import ndimage

from benchmarks.table import show
from semcal_ros.cli import main as semcal
from semcal_ros.core.arrays import Array
from semcal_ros.core.corners import LatticeDetection, find_lattice
from semcal_ros.core.corners.pattern import PATTERN_NAMES
from semcal_ros.core.errors import SemcalError
from semcal_ros.files.images.image_file import describe_image_file
from semcal_ros.files.images.metadata import quantity

# Pixel sizes are compared to the four digits that makers print.
SAME = 5e-4
# Of one pass over a picture of a tilted specimen nothing is known but its pixels: heights are in pixels.
PIXEL_M, TILT_DEG = 100e-9, 7.0
# Of the smooth map that a lens makes of a flat grid.
ORDER = 5


def _rosetta_pixel_m(path: Path) -> float | None:
    """Width of a pixel by RosettaSciIO; None where it gives none."""
    signal = import_module("rsciio.tiff").file_reader(str(path))[0]
    axes = [axis for axis in signal["axes"] if axis.get("navigate") is not True]
    return quantity(f"{axes[-1]['scale']} {axes[-1]['units']}", "m")


def compare_tiffs(paths: Sequence[Path]) -> None:
    """The pixel sizes of SEM TIFFs beside those of RosettaSciIO."""
    rows: list[list[object]] = []
    for path in paths:
        try:
            file = describe_image_file(path)
            pages, own_m = len(file.pages), file.pixel_size_m
        except SemcalError as error:
            pages, own_m = 0, None
            print(f"{path.name}: {error}")
        try:
            other_m = _rosetta_pixel_m(path)
        except ModuleNotFoundError:
            other_m = None
        except Exception as error:
            other_m = None
            print(f"{path.name}: RosettaSciIO: {error!r}")
        rows.append([path.name, pages, _nm(own_m), _nm(other_m), _judge(own_m, other_m)])
    show("TIFFs", ["", "images", "nm per px", "RosettaSciIO", "verdict"], rows)


def _nm(value_m: float | None) -> str | None:
    return None if value_m is None else f"{1e9 * value_m:.7g}"


def _judge(own: float | None, other: float | None) -> str:
    if own is None or other is None:
        return "neither" if own is other else "only here" if other is None else "only there"
    return "agree" if abs(own / other - 1.0) < SAME else "DIFFER"


def _run(*arguments: object) -> tuple[int, str]:
    told = io.StringIO()
    with contextlib.redirect_stdout(told), contextlib.redirect_stderr(told):
        status = semcal([str(argument) for argument in arguments])
    return status, told.getvalue()


def compare_triplet(paths: Sequence[Path]) -> None:
    """Heights of a tilt triplet beside the dense optical flow of OpenCV between the second and the third picture."""
    with tempfile.TemporaryDirectory() as name:
        heights = Path(name) / "heights.tif"
        tilts = f"--tilts=-{TILT_DEG:g}deg,0deg,{TILT_DEG:g}deg"
        given = (tilts, "--tilt-axis", "90deg", "--pixel-size", f"{1e9 * PIXEL_M:g}nm")
        status, told = _run("reconstruct", *paths, *given, "-o", heights)
        print("".join(f"  {line}\n" for line in told.splitlines() if not line.startswith("note")))
        if status:
            return
        height_px, sigma_px = 1e-6 / PIXEL_M * tifffile.imread(heights)[:2]
    second, third = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in paths[1:3])
    flow = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(second, third, None)
    slope, correlation, apart = compare_heights(height_px, sigma_px, flow[..., 0])
    rows: list[list[object]] = [
        ["correlation of heights and flow", correlation],
        ["flow per height over sin(tilt)", abs(slope) / np.sin(np.radians(TILT_DEG))],
        ["scatter between them over the stated 1-sigma", apart],
    ]
    show(f"{paths[0].name} ...", ["", "value"], rows)


def compare_heights(height: Array, sigma: Array, flow: Array) -> tuple[float, float, float]:
    """Slope and correlation of a flow against heights, without a plane; and their scatter in sigmas of the height."""
    y, x = np.nonzero(np.isfinite(height) & np.isfinite(sigma))
    h, f, s = height[y, x], flow[y, x].astype(np.float64), sigma[y, x]
    # The tilt shortens the picture along x, and the field is not scanned from the same place.
    plane = np.column_stack([np.ones(len(x)), x, y]).astype(np.float64)
    keep = np.ones(len(x), dtype=bool)
    for _ in range(4):
        design = np.column_stack([plane, h])
        found = np.linalg.lstsq(design[keep], f[keep], rcond=None)[0]
        left = f - design @ found
        # The flow smooths over edges and guesses in flat parts: a few per cent are wrong by far.
        keep = np.abs(left) < 4.0 * 1.4826 * np.median(np.abs(left[keep]))
    own, other = (v - plane @ np.linalg.lstsq(plane[keep], v[keep], rcond=None)[0] for v in (h, f))
    correlation = float(abs(np.corrcoef(own[keep], other[keep])[0, 1]))
    scatter = 1.4826 * np.median(np.abs(left[keep]) / (abs(found[3]) * s[keep]))
    return float(found[3]), correlation, float(scatter)


def find_patterns(paths: Sequence[Path]) -> None:
    """Dots, lines and chess boards in photographs; dots beside the centroids of parts above a threshold."""
    rows: list[list[object]] = []
    for path in paths:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        found = find_lattice(image)
        if not isinstance(found, LatticeDetection):
            rows.append([path.name, str(found.reason), None, None, None, None])
            continue
        own = centroids = None
        if found.pattern == "dots":
            other = find_centroids(image, found.xy, found.spacing_px)
            kept = np.isfinite(other[:, 0])
            centroids = scatter_px(found.ij[kept], other[kept])
            own = scatter_px(found.ij[kept], found.xy[kept])
        else:
            own = scatter_px(found.ij, found.xy)
        sigma = float(np.median(found.sigma_px))
        rows.append([path.name, PATTERN_NAMES[found.pattern], len(found.xy), sigma, own, centroids])
    header = ["", "found", "points", "1-sigma px", "scatter px", "of centroids px"]
    note = f"scatter: robust RMS per axis about a polynomial of order {ORDER} in the indices."
    show("patterns", header, rows, note)


def scatter_px(ij: Array, xy: Array) -> float:
    """Robust RMS per axis of points about a smooth map from their indices."""
    u, v = ((ij - ij.mean(axis=0)) / np.ptp(ij, axis=0).max()).T
    powers = [(m, n) for m in range(ORDER + 1) for n in range(ORDER + 1 - m)]
    design = np.column_stack([u**m * v**n for m, n in powers])
    keep = np.ones(len(xy), dtype=bool)
    for _ in range(4):
        left = xy - design @ np.linalg.lstsq(design[keep], xy[keep], rcond=None)[0]
        spread = 1.4826 * float(np.median(np.abs(left[keep])))
        keep = np.all(np.abs(left) < 4.0 * spread, axis=1)
    return spread


def find_centroids(image: NDArray[np.uint8], xy: Array, spacing_px: float) -> Array:
    """Grey-weighted centroids of the parts around points that a local threshold leaves; NaN where there is none."""
    block = 2 * round(spacing_px) + 1
    signed = image - cv2.blur(image.astype(np.float32), (block, block))
    at = np.rint(xy).astype(int)
    if float(np.median(signed[at[:, 1], at[:, 0]])) < 0.0:
        signed = -signed
    reach = round(0.45 * spacing_px)
    out = np.full(xy.shape, np.nan)
    for k, (x, y) in enumerate(at):
        if min(x, y) < reach or x + reach >= image.shape[1] or y + reach >= image.shape[0]:
            continue
        part = signed[y - reach : y + reach + 1, x - reach : x + reach + 1]
        labels, _ = ndimage.label(part > 0.5 * part.max())
        if labels[reach, reach]:
            row, column = ndimage.center_of_mass(part, labels, labels[reach, reach])
            out[k] = x + column - reach, y + row - reach
    return out


def compare_scans(path: Path) -> None:
    """Drift of a series of fast scans beside the median displacement of bright spots, by their centroids."""
    with tempfile.TemporaryDirectory() as name:
        table = Path(name) / "drift.csv"
        given = ("--pixel-size", "1nm", "--frame-interval", "1s", "-o", table)
        status, told = _run("drift", path, *given)
        if status:
            print(told)
            return
        with table.open() as file:
            lines = list(csv.DictReader(file))
    frames = [
        np.asarray(page.asarray(), dtype=np.float64) for page in tifffile.TiffFile(path).pages
    ]
    spots = [find_spots(frame) for frame in frames]
    rows: list[list[object]] = []
    for number, (line, own) in enumerate(zip(lines[1:], spots[1:], strict=True), 1):
        drift = np.array([float(line["dx_px"]), float(line["dy_px"])])
        sigma = np.array([float(line[f"sigma_{axis}_m"]) / 1e-9 for axis in "xy"])
        moved = _follow(spots[0], own, drift)
        rows.append([number, *drift, *np.median(moved, axis=0), *sigma, len(moved)])
    difference = np.array([[row[1] - row[3], row[2] - row[4]] for row in rows])  # type: ignore[operator]
    header = ["frame", "drift x px", "y", "spots x px", "y", "1-sigma x", "y", "spots"]
    mean, scatter = difference.mean(axis=0), difference.std(axis=0)
    note = f"mean difference {mean[0]:.2f}, {mean[1]:.2f} px; scatter {scatter[0]:.2f}, {scatter[1]:.2f} px"
    show(path.name, header, rows, note)


def find_spots(frame: Array) -> Array:
    """(n, 2) centroids of bright spots."""
    band = ndimage.gaussian_filter(frame, 1.2) - ndimage.gaussian_filter(frame, 5.0)
    high = band > 4.0 * 1.4826 * np.median(np.abs(band))
    spots = []
    for row, column in np.argwhere(high & (band == ndimage.maximum_filter(band, 7))):
        part = np.clip(band[row - 3 : row + 4, column - 3 : column + 4], 0.0, None)
        if part.shape == (7, 7):
            at = ndimage.center_of_mass(part)
            spots.append([column + at[1] - 3.0, row + at[0] - 3.0])
    return np.array(spots)


def _follow(before: Array, after: Array, drift: Array) -> Array:
    """Displacements (n, 2) of spots to the nearest one within 2.5 px of where the drift puts them."""
    apart = after[None] - before[:, None]
    distance = np.linalg.norm(apart - drift, axis=2)
    nearest = np.argmin(distance, axis=1)
    found = np.min(distance, axis=1) < 2.5
    return np.asarray(apart[np.arange(len(before)), nearest][found])


def _listed(paths: Sequence[Path], suffixes: Sequence[str]) -> list[Path]:
    out: list[Path] = []
    for path in paths:
        out += (
            sorted(p for p in path.iterdir() if p.suffix in suffixes) if path.is_dir() else [path]
        )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tiffs", nargs="*", type=Path, default=[], help="files or folders")
    parser.add_argument("--triplet", nargs=3, type=Path, action="append", default=[])
    parser.add_argument("--patterns", nargs="*", type=Path, default=[], help="files or folders")
    parser.add_argument("--scans", nargs="*", type=Path, default=[], help="multipage TIFFs")
    given: Any = parser.parse_args()
    if given.tiffs:
        compare_tiffs(_listed(given.tiffs, (".tif",)))
    for paths in given.triplet:
        compare_triplet(paths)
    if given.patterns:
        find_patterns(_listed(given.patterns, (".jpg", ".png")))
    for path in given.scans:
        compare_scans(path)


if __name__ == "__main__":
    main()
