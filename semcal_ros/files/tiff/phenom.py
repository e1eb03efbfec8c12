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

"""Phenom: XML in tag 34683 with the root ``FeiImage``, whose values have their units.

``rotation`` of the scan has none, so it is left out unless it is 0.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from semcal_ros.core.errors import TiffError
from semcal_ros.files.images.metadata import (
    check_pixel_size,
    date_of,
    number_of,
    positive,
    quantity_of,
    text_of,
)
from semcal_ros.files.images.sem_image import VendorSettings

ROOT = "FeiImage"


def phenom_settings(
    path: Path, root: ElementTree.Element, size_px: tuple[int, int]
) -> VendorSettings:
    """Read the settings from the root of the XML.

    Raises
    ------
    TiffError
        The pixel size is missing or unusable, or the databar is higher than the image.
    """
    seen = root.findtext("pixelWidth")
    pixel_m = check_pixel_size(path, quantity_of(root, "pixelWidth", "m"), "pixelWidth", seen)
    pixel_y_m = quantity_of(root, "pixelHeight", "m") or pixel_m
    check_pixel_size(path, pixel_y_m, "pixelHeight", root.findtext("pixelHeight"))
    bar = number_of(root, "databarHeight") or 0.0
    if not 0 <= bar < size_px[1]:
        raise TiffError(
            f"{path.name}: databarHeight is {bar:g} in an image of {size_px[1]} rows",
            expected="fewer rows of databar than of the image",
            do="use the original file, not a cropped copy",
        )
    scan = "acquisition/scan"
    display_m = positive(quantity_of(root, "displayWidth", "m"))
    voltage_v = quantity_of(root, f"{scan}/highVoltage", "V")
    turn = number_of(root, f"{scan}/rotation")
    notes = []
    if turn:
        notes.append(f"the scan rotation is {turn:g} without a unit: it is left out")
    return VendorSettings(
        maker="phenom",
        beam="electron",
        model=text_of(root, "instrument/type"),
        serial_number=text_of(root, "instrument/uniqueID"),
        pixel_size_m=pixel_m,
        pixel_size_y_m=pixel_y_m,
        displayed_magnification=None if display_m is None else display_m / (pixel_m * size_px[0]),
        databar_rows=int(bar),
        working_distance_m=quantity_of(root, "workingDistance", "m"),
        acceleration_voltage_v=None if voltage_v is None else abs(voltage_v),
        scan_rotation_rad=0.0 if turn == 0.0 else None,
        dwell_s=positive(quantity_of(root, f"{scan}/dwellTime", "s")),
        detector=text_of(root, f"{scan}/detector"),
        time=date_of(root, "time"),
        notes=tuple(notes),
    )
