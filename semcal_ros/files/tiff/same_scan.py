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

"""Images that several detectors took of one scan: they are not a time series."""

from __future__ import annotations

from collections.abc import Sequence

from semcal_ros.files.tiff.sem_image import VendorSettings

_STAMP_S = 1.0  # makers give whole seconds


def _can_be_one_scan(first: VendorSettings, other: VendorSettings) -> bool:
    """Whether the same pass of the beam can have made two images.

    Scan, stage and microscope must be the same, and the second image must have come before a second pass can have
    ended: within a frame time, or within the whole second that the stamps resolve.
    """
    same = (
        "maker", "model", "serial_number", "beam", "acceleration_voltage_v", "pixel_size_m", "pixel_size_y_m",
        "working_distance_m", "scan_rotation_rad", "stage_tilt_rad", "stage_rotation_rad", "dwell_s", "frame_time_s",
    )  # fmt: skip
    if first.time is None or other.time is None:
        return False
    apart_s = abs((other.time - first.time).total_seconds())
    in_one_pass = apart_s == 0.0 or apart_s + _STAMP_S <= (first.frame_time_s or 0.0)
    return in_one_pass and all(getattr(first, name) == getattr(other, name) for name in same)


def group_by_scan(
    images: Sequence[tuple[VendorSettings, tuple[int, int]]],
) -> tuple[tuple[int, ...], ...]:
    """Group images whose detectors saw the same pass of the beam.

    Images without a detector or a time stand alone, and so does each of two images of one detector, which are two
    scans even in the same second.

    Parameters
    ----------
    images
        Settings and stored (width, height) of each image.

    Returns
    -------
    tuple
        Indices of each scan's images, in the order of the first of them; each index once.
    """
    groups: list[list[int]] = []
    for index, (settings, size_px) in enumerate(images):
        for group in groups:
            first, first_size_px = images[group[0]]
            detectors = {images[member][0].detector for member in group}
            if (
                settings.detector
                and "" not in detectors
                and settings.detector not in detectors
                and size_px == first_size_px
                and _can_be_one_scan(first, settings)
            ):
                group.append(index)
                break
        else:
            groups.append([index])
    return tuple(tuple(group) for group in groups)
