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

"""A scale bar over a picture of a page, as SVG: sharp at any size of the screen."""

from __future__ import annotations

from dataclasses import dataclass

from semcal_ros.core.camera.scan_camera import ScanCamera
from semcal_ros.files.images.scale_bar import choose_scale_bar

# Size of the type as a part of the width: legible where the picture is 390 px wide, and as a thumbnail of 200 px.
_TYPE, _THUMBNAIL_TYPE = 0.042, 0.06
# Distance of the bar from the edges, as a part of the width.
_EDGE = 0.03


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
