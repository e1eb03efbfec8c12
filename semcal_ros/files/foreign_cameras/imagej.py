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

"""Scale and distortion for ImageJ and Fiji: a macro, and a map that other programs read, too."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semcal_ros.core.arrays import Array32
from semcal_ros.core.camera.scan_camera import ScanCamera

__all__ = ["compute_raw_map", "format_macro"]


def format_macro(pixel_size_m: tuple[float, float], notes: Sequence[str]) -> str:
    """Format a macro that sets the pixel size of the current image."""
    x_nm, y_nm = (1e9 * size for size in pixel_size_m)
    lines = [f"// {note}" for note in notes]
    lines.append(f'setVoxelSize({x_nm!r}, {y_nm!r}, 1, "nm");')
    return "\n".join(lines) + "\n"


def compute_raw_map(camera: ScanCamera) -> Array32:
    """Compute x and y of the raw pixel that each rectified pixel shows, (2, height, width) px.

    They are NaN where there is none.
    """
    y, x = np.mgrid[0 : camera.height, 0 : camera.width]
    raw = camera.raw_from_rect(np.stack([x.ravel(), y.ravel()], axis=1))
    shape = (camera.height, camera.width)
    return np.stack([raw[:, k].reshape(shape) for k in (0, 1)]).astype(np.float32)
