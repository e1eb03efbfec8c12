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

"""Olympus Soft Imaging Solutions: tag 33560, which analySIS and cameras of other makers' microscopes write.

tifffile decodes it. The size of a pixel was calibrated in that program for the magnification that is stated.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

from semcal_ros.files.images.metadata import (
    aspect_notes,
    check_pixel_size,
    is_credible_year,
    plain_number,
    positive,
)
from semcal_ros.files.images.sem_image import VendorSettings

# OlympusSIS.
TAG = 33560


def olympus_settings(path: Path, tag: Mapping[str, Any]) -> VendorSettings:
    """Read the settings from the decoded tag.

    Raises
    ------
    TiffError
        The pixel size is missing or unusable.
    """
    width, height = tag.get("pixelsizex"), tag.get("pixelsizey")
    pixel_m = check_pixel_size(path, plain_number(width), "pixelsizex in tag 33560 (SIS)", width)
    pixel_y_m = check_pixel_size(path, plain_number(height) or pixel_m, "pixelsizey", height)
    date = tag.get("datetime")
    return VendorSettings(
        maker="olympus",
        pixel_size_m=pixel_m,
        pixel_size_y_m=pixel_y_m,
        displayed_magnification=positive(plain_number(tag.get("magnification"))),
        detector=str(tag.get("cameraname", "")).strip(),
        time=date if isinstance(date, datetime) and is_credible_year(date.year) else None,
        notes=tuple(aspect_notes(pixel_m, pixel_y_m)),
    )
