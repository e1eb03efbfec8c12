"""A measured cantilever drawn over its frame."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semcal_ros.applications.cantilever import Deflection

__all__ = ["drawn"]

_FRACTION_BITS = 4


def drawn(image: NDArray[Any], frame: Deflection, grey: tuple[float, float]) -> NDArray[np.float32]:
    """The picture with the centre line and the end of the beam, in black and white.

    Parameters
    ----------
    image
        (h, w) raw grey picture.
    frame
        What was measured in it.
    grey
        Grey levels of black and white.
    """
    out = np.array(image, dtype=np.float32)
    scale = max(1, round(max(image.shape) / 512))
    points = frame.line_px[np.isfinite(frame.line_px).all(axis=1)]
    fixed = np.round(points * 2**_FRACTION_BITS).astype(np.int32)
    for level, width in ((grey[0], 3 * scale), (grey[1], scale)):
        cv2.polylines(out, [fixed[:, None]], False, float(level), width, cv2.LINE_8, _FRACTION_BITS)
        tip = frame.tip_px
        if np.isfinite(tip).all() and np.all(np.abs(tip) < 1e5):
            at = round(float(tip[0])), round(float(tip[1]))
            cv2.circle(out, at, 5 * scale, float(level), width)
    return out
