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

"""One view raw and corrected, for a page that shows them in turn at the same place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import AnyImage, Array
from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.views import FoundView
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.report.html.encode import convert_to_8_bits, encode_data_uri, encode_jpeg, shrink
from semcal_ros.report.html.scale_bar import DrawnScaleBar, draw_scale_bar
from semcal_ros.report.html.text import format_length, remove_control_characters

# Width of the pictures, px: distortions of some pixels are still seen.
_WIDTH = 640
_JPEG_QUALITY = 74
# Size of the marks as a part of the width: legible at 390 px.
_MARK = 0.012
# Crosses across the picture: a mark at every corner would hide a fine grid.
_CROSSES = 6
# Views whose corners move nearly as far as those of the best one: of them the coarsest grid is easiest to see.
_NEARLY = 0.8


@dataclass(frozen=True)
class Blink:
    """A raw picture and the same corrected, of one size.

    Attributes
    ----------
    raw, corrected
        Data URIs.
    width, height
        Of both.
    marks
        SVG path of crosses where the corners belong in the corrected picture.
    bar
        Scale bar of the corrected picture.
    alt, caption
        Texts.
    """

    raw: str
    corrected: str
    width: int
    height: int
    marks: str
    bar: DrawnScaleBar
    alt: str
    caption: str


def choose_blink(result: CalibrationResult, detections: Sequence[FoundView]) -> Blink | None:
    """Take the view whose corners the correction moves most; None where no picture is at hand."""
    size = result.model.image_size
    images = {
        (view.name, view.magnification): view.image
        for view in detections
        if view.image is not None and view.image.shape[:2] == (size[1], size[0])
    }
    moves: list[tuple[float, int, AnyImage]] = []
    for index, view in enumerate(result.views):
        image = images.get((view.name, view.magnification))
        if image is None:
            continue
        moved = result.model.at(view.magnification).rect_from_raw(view.image_xy) - view.image_xy
        length = np.hypot(moved[:, 0], moved[:, 1])
        largest = float(np.max(length, where=np.isfinite(length), initial=0.0))
        moves.append((largest, index, image))
    if not moves:
        return None
    least = _NEARLY * max(moved for moved, _, _ in moves)
    far = [move for move in moves if move[0] >= least]
    return _make(result, *min(far, key=lambda move: len(result.views[move[1]].image_xy)))


def _make(result: CalibrationResult, moved_px: float, index: int, image: AnyImage) -> Blink:
    view = result.views[index]
    camera = result.model.at(view.magnification)
    raw = convert_to_8_bits(image)
    small, factor = shrink(raw, _WIDTH)
    corrected, _ = shrink(convert_to_8_bits(Rectifier("cubic").rectify(raw, camera)), _WIDTH)
    height, width = small.shape[:2]
    points = (
        view.board_xy_m @ result.fit.rotations[index][:, :2].T + result.fit.translations_m[index]
    )
    # Pixel centres are at integers, the coordinates of SVG start at the edge of the first pixel.
    at = (camera.rectified.project(points) + 0.5) * factor
    square_m = camera.rectified.pixel_size_m[0]
    bar = draw_scale_bar(camera.rectified, image.shape[1], (width, height))
    name = remove_control_characters(view.name)
    nm = format_length(moved_px * square_m)
    return Blink(
        raw=_encode(small),
        corrected=_encode(corrected),
        width=width,
        height=height,
        marks=_draw_crosses(_spread(at, width, height), _MARK * width),
        bar=bar,
        alt=f"The view {name} at {view.magnification:g}x, raw and corrected",
        caption=_describe(bar, f"{name}, {view.magnification:g}×", moved_px, nm),
    )


def _describe(bar: DrawnScaleBar, name: str, moved_px: float, moved: str) -> str:
    return (
        f"{name}: the correction moves its corners by up to {moved_px:.2g} px, {moved}. The crosses stay: there, "
        f"corners of a flat, regular grid in this pose belong. {bar.pixel_size} in the corrected picture, to which "
        "the scale bar belongs."
    )


def _spread(xy: Array, width: int, height: int) -> Array:
    """Choose points that are spread over the picture: the nearest to the middle of each cell."""
    known = xy[np.all(np.isfinite(xy), axis=1)]
    cell = width / _CROSSES
    index = np.floor(known / cell)
    distance = np.max(np.abs(known / cell - index - 0.5), axis=1)
    nearest: dict[tuple[float, float], int] = {}
    for k in np.argsort(-distance, kind="stable"):
        nearest[float(index[k, 0]), float(index[k, 1])] = int(k)
    inside = [
        k for (i, j), k in nearest.items() if 0 <= i * cell < width and 0 <= j * cell < height
    ]
    return np.asarray(known[inside], dtype=np.float64)


def _encode(image: AnyImage) -> str:
    return encode_data_uri("jpeg", encode_jpeg(convert_to_8_bits(image), _JPEG_QUALITY))


def _draw_crosses(xy: Array, half: float) -> str:
    return "".join(
        f"M{x - half:.1f} {y:.1f}h{2 * half:.3g}m{-half:.3g} {-half:.3g}v{2 * half:.3g}"
        for x, y in xy
    )
