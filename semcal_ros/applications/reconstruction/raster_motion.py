"""Movement while a frame is scanned.

Rows are seen one after the other, so a moving specimen is sheared. What a pixel shows is brought to the centre of the
acquisition with the velocity of the image, which the tracker knows from the frames before and after.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semcal_ros.applications.reconstruction.feature_tracks import Keyframe, to_plane
from semcal_ros.core.camera.scan_timing import ScanTiming

__all__ = ["displacement_m", "plane_at_centre"]

Array = NDArray[np.float64]


def displacement_m(frame: Keyframe, scan: ScanTiming | None, raw: Array, xy_m: Array) -> Array:
    """How far (n, 2) in m the specimen has moved since the centre of the acquisition when raw pixels
    (n, 2) are seen that show the places ``xy_m`` (n, 2) of the sem frame.
    """
    if scan is None:
        return np.zeros_like(xy_m)
    height, width = frame.image.shape[:2]
    offset = scan.pixel_offset_s(raw[:, 1], raw[:, 0], height, width) - scan.centre_offset_s
    velocity = xy_m @ frame.velocity[:, :2].T + frame.velocity[:, 2]
    return np.asarray(velocity * offset[:, None], dtype=np.float64)


def plane_at_centre(frame: Keyframe, scan: ScanTiming | None, raw: Array) -> Array:
    """Sem-frame X, Y (n, 2) in m of raw pixels (n, 2), as they were at the centre of the acquisition."""
    seen = to_plane(frame.camera, raw)
    return seen - displacement_m(frame, scan, raw, seen)
