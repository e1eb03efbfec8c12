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

"""Pictures of views: examples with the corners that were found, the views that fit worst, and one raw and corrected.

The views that fit worst are shown with their residuals and what these look like; the last is shown in turn at the same
place.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semcal_ros.core.arrays import AnyImage, Array
from semcal_ros.core.calibration.judge import CalibrationResult
from semcal_ros.core.calibration.judgement.findings import compute_tilts_deg
from semcal_ros.core.calibration.views import FoundView, RejectedView
from semcal_ros.core.camera.calibration_model import CalibrationModel
from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.core.rectification.rectifier import Rectifier
from semcal_ros.core.wording import counted
from semcal_ros.files.images.scale_bar import choose_scale_bar
from semcal_ros.report.html.encode import convert_to_8_bits, encode_data_uri, encode_jpeg, shrink
from semcal_ros.report.html.page import format_length, format_px, remove_control_characters
from semcal_ros.report.html.style import choose_arrow_factor

# Size of the type as a part of the width: legible where the picture is 390 px wide, and as a thumbnail of 200 px.
_TYPE, _THUMBNAIL_TYPE = 0.042, 0.06
# Distance of the bar from the edges, as a part of the width.
_EDGE = 0.03

# Width of a thumbnail with marks, px: two fit beside each other in the column of a page.
_OVERLAY_WIDTH = 320
# Half the size of a cross, as a part of the corner spacing, within the limits below.
_MARK_OF_SPACING = 0.2
# Smaller crosses cannot be seen, larger ones cover the corner.
_MARK_LIMITS_PX = (0.8, 4.0)
# Thumbnails only give an impression; a page may hold dozens of them.
_EXAMPLE_QUALITY = 70
# Width of the thumbnail of a rejected image, px: enough to see what is wrong with it.
_REJECTED_WIDTH = 200

# Width of the picture of a view, px: a column of the page.
_WORST_WIDTH = 480
_WORST_QUALITY = 75
# Length of the arrow of a large residual, as a part of the width: neighbouring corners stay apart.
_ARROW = 0.07
# Length of the head of an arrow, as a part of its length, and the tangent of half of its angle.
_HEAD, _HEAD_SLOPE = 0.35, 0.5
# The longest residuals, whose values are shown when one points at them.
_WITH_VALUES = 40
# Deviations of an RMS from what the corners' 1-sigma predicts that are more than chance.
_DEVIATIONS = 3.0
# A trend over the field that is worth a word explains more than this part of the squares of the residuals.
_TREND_SHARE = 0.25
# The worst corners, and the part of the squares that makes them stand out: by chance they have 0.2 of them.
_WORST_PART, _WORST_SHARE = 0.05, 0.5
# Against the median number of corners at this magnification.
_FEW_CORNERS = 0.5

# Width of the pictures, px: distortions of some pixels are still seen.
_BLINK_WIDTH = 640
_BLINK_QUALITY = 74
# Size of the marks as a part of the width: legible at 390 px.
_MARK = 0.012
# Crosses across the picture: a mark at every corner would hide a fine grid.
_CROSSES = 6
# Views whose corners move nearly as far as those of the best one: of them the coarsest grid is easiest to see.
_NEARLY = 0.8


@dataclass(frozen=True)
class DrawnScaleBar:
    """A bar and its label in the lower right corner of a picture.

    Attributes
    ----------
    path
        SVG path of the bar.
    label
        Its length with the 1-sigma.
    pixel_size
        The size of a pixel with the 1-sigma, for the caption.
    x, y
        Right lower end of the label.
    type_px
        Size of the type.
    """

    path: str
    label: str
    pixel_size: str
    x: float
    y: float
    type_px: float


def draw_scale_bar(
    camera: ScanCamera, image_width_px: int, drawn_px: tuple[int, int], *, thumbnail: bool = False
) -> DrawnScaleBar:
    """Draw the bar of an image that is shown smaller than it is.

    Parameters
    ----------
    camera
        Camera of the image; its ``rectified`` one for a corrected image. In a raw image the bar is right at the
        centre of the distortion.
    image_width_px
        Width of the image, which shows the camera's whole field.
    drawn_px
        (width, height) of the picture on the page.
    thumbnail
        Whether the type is to be legible in a small picture.
    """
    width, height = drawn_px
    # An image of another size shows the same field.
    size_m, sigma_m = _image_pixel(camera, camera.width / image_width_px)
    shown_m, shown_sigma_m = _image_pixel(camera, camera.width / width)
    bar = choose_scale_bar(width, shown_m, shown_sigma_m)
    right, low = width * (1.0 - _EDGE), height - width * _EDGE
    return DrawnScaleBar(
        path=f"M{right - bar.length_px:.1f} {low:.1f}H{right:.1f}",
        label=bar.label,
        pixel_size=choose_scale_bar(image_width_px, size_m, sigma_m).pixel_size,
        x=round(right, 1),
        y=round(low - _EDGE * width / 2.0, 1),
        type_px=round((_THUMBNAIL_TYPE if thumbnail else _TYPE) * width, 1),
    )


def _image_pixel(camera: ScanCamera, factor: float) -> tuple[float, float | None]:
    """Width of a pixel that is ``factor`` of the camera's, and its 1-sigma where it is known."""
    known = camera.covariance is not None
    sigma_m = factor * float(camera.pixel_size_sigma_m[0]) if known else None
    return factor * float(camera.pixel_size_m[0]), sigma_m


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
        src=encode_data_uri("jpeg", encode_jpeg(small, _EXAMPLE_QUALITY)),
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
                src=encode_data_uri("jpeg", encode_jpeg(small, _EXAMPLE_QUALITY)),
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


@dataclass(frozen=True)
class CornerMark:
    """The residual of one corner: an SVG path, and its value as text (empty for most)."""

    path: str
    text: str


@dataclass(frozen=True)
class WorstView:
    """A view and how it fits.

    Attributes
    ----------
    name, magnification, corners, rms
        Ready to read; the error in px and as a length.
    ratio
        RMS error over what the 1-sigma of the corners predicts.
    facts
        (name, text) pairs: error, pose, and why it is suspicious.
    src
        Data URI of the picture; empty where it is not at hand.
    width, height
        Of the drawing, in its units.
    bar
        Scale bar, right at the centre.
    dots
        SVG path of the corners.
    arrows
        SVG path of the residuals whose values are not shown, and ``marks`` the others.
    caption
        Below the drawing.
    """

    name: str
    magnification: str
    corners: int
    rms: str
    ratio: float
    facts: tuple[tuple[str, str], ...]
    src: str
    width: int
    height: int
    bar: DrawnScaleBar
    dots: str
    arrows: str
    marks: tuple[CornerMark, ...]
    alt: str
    caption: str


def choose_worst_views(
    result: CalibrationResult, detections: Sequence[FoundView], count: int
) -> list[WorstView]:
    """Choose the views that fit worst for the uncertainty of their corners, the worst first.

    Parameters
    ----------
    result
        The calibration.
    detections
        Images of its views, of which those with the same name and magnification are shown.
    count
        How many, at most.
    """
    ratios = np.array(
        [
            _compute_rms_px(residuals) / view.expected_rms_px
            for view, residuals in zip(result.views, result.fit.residuals_px, strict=True)
        ]
    )
    width, height = result.model.image_size
    images = {
        (view.name, view.magnification): view.image
        for view in detections
        if view.image is not None and view.image.shape[:2] == (height, width)
    }
    tilts = np.stack(compute_tilts_deg(result), axis=1)
    chosen = np.argsort(-ratios, kind="stable")[:count]
    return [_describe_worst(result, int(k), float(ratios[k]), tilts[k], images) for k in chosen]


def _compute_rms_px(residuals: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))


def _describe_worst(
    result: CalibrationResult,
    index: int,
    ratio: float,
    tilt_deg: Array,
    images: dict[tuple[str, float], AnyImage],
) -> WorstView:
    view, residuals = result.views[index], result.fit.residuals_px[index]
    camera = result.model.at(view.magnification)
    pixel_m = float(np.mean(camera.pixel_size_m))
    rms_px = _compute_rms_px(residuals)
    lengths = np.hypot(residuals[:, 0], residuals[:, 1])
    worst = int(np.argmax(lengths))
    x, y = view.image_xy[worst]
    rms = f"{format_px(rms_px)}, {format_length(rms_px * pixel_m)}"
    turn_deg = np.degrees(
        np.arctan2(result.fit.rotations[index, 1, 0], result.fit.rotations[index, 0, 0])
    )
    origin = ", ".join(
        f"{axis} {format_length(value)}"
        for axis, value in zip("xyz", result.fit.translations_m[index], strict=True)
    )
    same = [len(v.image_xy) for v in result.views if v.magnification == view.magnification]
    reasons = describe_pattern(view.image_xy, residuals, ratio)
    if len(residuals) < _FEW_CORNERS * float(np.median(same)):
        reasons.append(
            f"it has {counted(len(residuals), 'corner')}, other views at this magnification {np.median(same):.0f}"
        )
    facts = (
        (
            "RMS",
            f"{rms}: {ratio:.2f} times the noise of its corners ({format_px(view.expected_rms_px)})",
        ),
        (
            "Largest residual",
            f"{format_px(float(lengths[worst]))}, {format_length(float(lengths[worst]) * pixel_m)}, "
            f"at column {x:.0f}, row {y:.0f}",
        ),
        ("Corners", f"{len(residuals)}"),
        (
            "Pose",
            f"tilted by {tilt_deg[0]:.1f}° towards {tilt_deg[1]:.0f}°, turned by {turn_deg:.0f}°",
        ),
        ("Origin of the grid", origin),
        ("Why suspicious", "; ".join(reasons)),
    )
    name = remove_control_characters(view.name) or "(no name)"
    image = images.get((view.name, view.magnification))
    src, size, factor = _draw_picture(image, result.model.image_size)
    long = choose_arrow_factor(float(np.quantile(lengths, 0.95)) * factor, _ARROW * size[0])
    # Pixel centres are at integers, the coordinates of SVG start at the edge of the first pixel.
    xy, moves = (view.image_xy + 0.5) * factor, residuals * factor * long
    named = np.argsort(-lengths)[:_WITH_VALUES]
    others = np.setdiff1d(np.arange(len(lengths)), named)
    return WorstView(
        name=name,
        magnification=f"{view.magnification:g}×",
        corners=len(residuals),
        rms=rms,
        ratio=ratio,
        facts=facts,
        src=src,
        width=size[0],
        height=size[1],
        bar=draw_scale_bar(camera, camera.width, size),
        dots="".join(f"M{a:.1f} {b:.1f}h0" for a, b in xy),
        arrows="".join(_draw_arrow(xy[k], moves[k]) for k in others),
        marks=tuple(
            CornerMark(
                _draw_arrow(xy[k], moves[k]),
                f"{lengths[k]:.3f} px, {format_length(float(lengths[k]) * pixel_m)}",
            )
            for k in named
        ),
        alt=f"Residuals of {counted(len(residuals), 'corner')} in {name} at {view.magnification:g}x, "
        f"drawn {long:g} times as long",
        caption=f"Residuals (found minus predicted), {long:g} times as long as they are"
        + ("" if src else "; the picture was not kept")
        + ".",
    )


def describe_pattern(xy: Array, residuals: Array, ratio: float) -> list[str]:
    """Describe what the residuals of a view look like.

    Parameters
    ----------
    xy
        (n, 2) corners, px.
    residuals
        (n, 2) found minus predicted, px.
    ratio
        RMS over what the 1-sigma of the corners predicts.
    """
    n = len(xy)
    # The relative 1-sigma of the RMS of 2n normal numbers is 1 / sqrt(4n).
    if ratio < 1.0 + _DEVIATIONS / np.sqrt(4.0 * n):
        return ["it is not: its residuals are no larger than the noise of its corners"]
    reasons = []
    squares = np.sum(residuals**2, axis=1)
    total = float(squares.sum())
    worst = np.sort(squares)[::-1][: max(1, round(_WORST_PART * n))]
    if n >= 1.0 / _WORST_PART and float(worst.sum()) > _WORST_SHARE * total:
        reasons.append(
            f"{len(worst)} of its corners make {100.0 * float(worst.sum()) / total:.0f} % of the squared error: "
            "dirt, a damaged square or a wrong corner there"
        )
    centred = (xy - xy.mean(axis=0)) / max(float(np.ptp(xy)), 1.0)
    design = np.column_stack([np.ones(n), centred])
    left = residuals - design @ np.linalg.lstsq(design, residuals, rcond=None)[0]
    share = 1.0 - float(np.sum(left**2)) / total
    if n > 12 and share > _TREND_SHARE:
        reasons.append(
            f"a stretch or a shear of the whole view makes {100.0 * share:.0f} % of the squared error: "
            "drift or charging during the frame, or the magnification did not come back"
        )
    if not reasons:
        reasons.append(
            "its residuals are larger everywhere than the noise of its corners, without a trend: look for blur, "
            "vibration or a bent grid"
        )
    return reasons


def _draw_picture(
    image: AnyImage | None, image_size: tuple[int, int]
) -> tuple[str, tuple[int, int], float]:
    """Return the data URI of a picture, the size of the drawing and its scale."""
    if image is None:
        factor = _WORST_WIDTH / image_size[0]
        return "", (_WORST_WIDTH, max(1, round(factor * image_size[1]))), factor
    small, factor = shrink(convert_to_8_bits(image), _WORST_WIDTH)
    src = encode_data_uri("jpeg", encode_jpeg(small, _WORST_QUALITY))
    return src, (small.shape[1], small.shape[0]), factor


def _draw_arrow(at: Array, move: Array) -> str:
    """Draw an SVG path from a corner along its residual, with a head."""
    across = _HEAD_SLOPE * np.array([-move[1], move[0]])
    barbs = (-_HEAD * (move - across), -_HEAD * (move + across))
    one, other = barbs
    return (
        f"M{at[0]:.1f} {at[1]:.1f}l{move[0]:.1f} {move[1]:.1f}l{one[0]:.1f} {one[1]:.1f}"
        f"m{-one[0]:.1f} {-one[1]:.1f}l{other[0]:.1f} {other[1]:.1f}"
    )


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
    return _make_blink(result, *min(far, key=lambda move: len(result.views[move[1]].image_xy)))


def _make_blink(result: CalibrationResult, moved_px: float, index: int, image: AnyImage) -> Blink:
    view = result.views[index]
    camera = result.model.at(view.magnification)
    raw = convert_to_8_bits(image)
    small, factor = shrink(raw, _BLINK_WIDTH)
    corrected, _ = shrink(convert_to_8_bits(Rectifier("cubic").rectify(raw, camera)), _BLINK_WIDTH)
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
        marks=_draw_crosses(_spread_points(at, width, height), _MARK * width),
        bar=bar,
        alt=f"The view {name} at {view.magnification:g}x, raw and corrected",
        caption=_describe_blink(bar, f"{name}, {view.magnification:g}×", moved_px, nm),
    )


def _describe_blink(bar: DrawnScaleBar, name: str, moved_px: float, moved: str) -> str:
    return (
        f"{name}: the correction moves its corners by up to {moved_px:.2g} px, {moved}. The crosses stay: there, "
        f"corners of a flat, regular grid in this pose belong. {bar.pixel_size} in the corrected picture, to which "
        "the scale bar belongs."
    )


def _spread_points(xy: Array, width: int, height: int) -> Array:
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
    return encode_data_uri("jpeg", encode_jpeg(convert_to_8_bits(image), _BLINK_QUALITY))


def _draw_crosses(xy: Array, half: float) -> str:
    return "".join(
        f"M{x - half:.1f} {y:.1f}h{2 * half:.3g}m{-half:.3g} {-half:.3g}v{2 * half:.3g}"
        for x, y in xy
    )
