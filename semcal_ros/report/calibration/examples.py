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

"""Example images with the found corners drawn on them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import AnyImage, Array
from semcal_ros.core.calibration.views import FoundView, RejectedView
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.wording import counted
from semcal_ros.report.html.encode import convert_to_8_bits, encode_data_uri, encode_jpeg, shrink
from semcal_ros.report.html.scale_bar import DrawnScaleBar, draw_scale_bar
from semcal_ros.report.html.text import remove_control_characters

# Width of a thumbnail with marks, px: two fit beside each other in the column of a page.
_OVERLAY_WIDTH = 320
# Half the size of a cross, as a part of the corner spacing, within the limits below.
_MARK_OF_SPACING = 0.2
# Smaller crosses cannot be seen, larger ones cover the corner.
_MARK_LIMITS_PX = (0.8, 4.0)
# Thumbnails only give an impression; a page may hold dozens of them.
_JPEG_QUALITY = 70
# Width of the thumbnail of a rejected image, px: enough to see what is wrong with it.
_REJECTED_WIDTH = 200


@dataclass(frozen=True)
class Overlay:
    """An image with marks at the corners, for inline SVG.

    Attributes
    ----------
    src
        Data URI of the image.
    width, height
        Size of the embedded image, px; the marks are in its coordinates with (0, 0) at the top left
        edge.
    marks, refused
        SVG paths of all crosses, and of squares where corners were refused.
    bar
        Scale bar, right at the centre.
    alt, caption
        Texts.
    """

    src: str
    width: int
    height: int
    marks: str
    refused: str
    bar: DrawnScaleBar
    alt: str
    caption: str


def choose_examples(views: Sequence[FoundView]) -> list[FoundView]:
    """Choose the view with most corners for each magnification, ascending, of those with an image."""
    best: dict[float, FoundView] = {}
    for view in views:
        if view.image is None:
            continue
        known = best.get(view.magnification)
        if known is None or len(view.detection.xy) > len(known.detection.xy):
            best[view.magnification] = view
    return [best[g] for g in sorted(best)]


def _mark_size(spacing: float) -> float:
    return float(np.clip(_MARK_OF_SPACING * np.nan_to_num(spacing), *_MARK_LIMITS_PX))


def _draw_squares(xy: Array, k: float) -> str:
    return "".join(f"M{x - k:.1f} {y - k:.1f}h{2 * k:.3g}v{2 * k:.3g}h{-2 * k:.3g}z" for x, y in xy)


def _draw_crosses(xy: Array, k: float) -> str:
    return "".join(f"M{x - k:.1f} {y:.1f}h{2 * k:.3g}m{-k:.3g} {-k:.3g}v{2 * k:.3g}" for x, y in xy)


def overlay_corners(view: FoundView, model: CalibrationModel) -> Overlay:
    """Shrink a view, with a cross at each corner and a square at each refused one."""
    assert view.image is not None
    small, factor = shrink(convert_to_8_bits(view.image), _OVERLAY_WIDTH)
    # Pixel centres are at integers, the coordinates of SVG start at the edge of the first pixel.
    xy, refused_xy = (
        (np.asarray(points, dtype=np.float64) + 0.5) * factor
        for points in (view.detection.xy, view.detection.rejected_xy)
    )
    count, size = len(xy), _mark_size(view.detection.spacing_px * factor)
    refused = view.detection.rejected
    dropped = f", {refused} refused" if refused else ""
    sigma = view.detection.sigma_px
    precision = f", median 1-sigma {np.median(sigma):.3f} px" if len(sigma) else ""
    return Overlay(
        src=encode_data_uri("jpeg", encode_jpeg(small, _JPEG_QUALITY)),
        width=small.shape[1],
        height=small.shape[0],
        marks=_draw_crosses(xy, size),
        refused=_draw_squares(refused_xy, size),
        bar=_draw_bar(model, view, small),
        alt=f"Image at {view.magnification:g}x with {counted(count, 'corner')} of the grid marked by crosses",
        caption=remove_control_characters(
            f"{view.magnification:g}×: {counted(count, 'corner')}{dropped}{precision} ({view.name})"
        ),
    )


def _draw_bar(
    model: CalibrationModel, view: FoundView | RejectedView, small: AnyImage
) -> DrawnScaleBar:
    assert view.image is not None
    camera, drawn = model.at(view.magnification), (small.shape[1], small.shape[0])
    return draw_scale_bar(camera, view.image.shape[1], drawn, thumbnail=True)


def show_rejected(
    views: Sequence[RejectedView], count: int, model: CalibrationModel
) -> list[Overlay]:
    """Make thumbnails of rejected images that have pixels, different reasons first."""
    ranked: list[tuple[int, int]] = []
    seen: Counter[str] = Counter()
    for index, view in enumerate(views):
        if view.image is not None:
            ranked.append((seen[view.reason], index))
            seen[view.reason] += 1
    pictures = []
    for _, index in sorted(ranked)[:count]:
        view = views[index]
        assert view.image is not None
        small, _ = shrink(convert_to_8_bits(view.image), _REJECTED_WIDTH)
        text = remove_control_characters(f"{view.magnification:g}×: {view.reason} ({view.name})")
        pictures.append(
            Overlay(
                src=encode_data_uri("jpeg", encode_jpeg(small, _JPEG_QUALITY)),
                width=small.shape[1],
                height=small.shape[0],
                marks="",
                refused="",
                bar=_draw_bar(model, view, small),
                alt=f"Rejected image, {text}",
                caption=text,
            )
        )
    return pictures
