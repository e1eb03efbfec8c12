"""The camera that the display width alone predicts."""

from __future__ import annotations

from semcal_ros.bridge.config import MicroscopeConfig
from semcal_ros.core.camera import ScanCamera

__all__ = ["nominal_camera"]


def nominal_camera(
    config: MicroscopeConfig, magnification: float, width: int, height: int
) -> ScanCamera:
    """Parallel projection without distortion whose field of view is ``display width / magnification`` wide.

    It turns pixels into metres to a few percent where there is no calibration.

    Raises
    ------
    InvalidValueError
        The magnification is not positive and finite, or the size is not positive.
    """
    centre_x, centre_y = 0.5 * (width - 1), 0.5 * (height - 1)
    return ScanCamera(
        magnification=magnification,
        m=magnification * width / config.display_width_m,
        aspect=1.0,
        skew=0.0,
        px=centre_x,
        py=centre_y,
        rho=0.0,
        xi_r=0.0,
        xi_t=0.0,
        ex=centre_x,
        ey=centre_y,
        norm_px=0.5 * width,
        width=width,
        height=height,
    )
