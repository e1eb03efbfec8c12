"""``semcal at``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from semcal_ros.bridge.parameters import value_of
from semcal_ros.calibration import Calibration
from semcal_ros.cli.common import echo_json
from semcal_ros.core.arrays import Array
from semcal_ros.core.camera.projection import PARAMETER_NAMES
from semcal_ros.core.camera.scan_camera import ScanCamera

__all__ = ["command"]


@click.command("at")
@click.argument("calibration", type=click.Path(path_type=Path))
@click.argument("magnification", type=float)
@click.option("--json", "as_json", is_flag=True, help="Machine-readable output, SI units.")
def command(calibration: Path, magnification: float, as_json: bool) -> None:
    """Camera of CALIBRATION at MAGNIFICATION: K, P, distortion, nm per pixel, with uncertainty.

    \b
    Example:
      semcal at cal.yaml 5250 --json
    """
    model = Calibration.load(calibration)
    camera = model.at(magnification)
    if as_json:
        echo_json(_as_dict(camera, model))
    else:
        _tell(camera, model)


def _sigma(covariance: Array) -> Array:
    # Of an exactly known parameter, rounding may leave a variance of less than nothing.
    return np.asarray(np.sqrt(np.maximum(np.diag(covariance), 0.0)))


def _as_dict(camera: ScanCamera, model: Calibration) -> dict[str, Any]:
    assert camera.covariance is not None
    sigma = _sigma(camera.covariance)
    perspective = camera.rho > 0.0
    return {
        "magnification": camera.magnification,
        "in_range": camera.in_range,
        "magnification_range": list(model.magnification_range),
        "image_width_px": camera.width,
        "image_height_px": camera.height,
        "pixel_size_m": list(camera.pixel_size_m),
        "pixel_size_sigma_m": list(camera.pixel_size_sigma_m),
        "mean_pixel_size_m": 1.0 / camera.m,
        "K": camera.K.tolist() if perspective else None,
        "P": camera.P.tolist() if perspective else None,
        "P_affine": camera.P_affine.tolist(),
        "distortion": {"xi_r": camera.xi_r, "xi_t": camera.xi_t, "norm_px": camera.norm_px},
        "distortion_centre_px": [camera.ex, camera.ey],
        "parameters": dict(zip(PARAMETER_NAMES, camera.parameters.tolist(), strict=True)),
        "parameter_sigma": dict(zip(PARAMETER_NAMES, sigma.tolist(), strict=True)),
        "projection_sigma_px": value_of("sigma", camera),
    }


def _matrix(name: str, values: Any) -> str:
    rows = [" ".join(f"{v:14.6g}" for v in row) for row in values]
    return "\n".join(f"{name if i == 0 else '':9}[{row}]" for i, row in enumerate(rows))


def _tell(camera: ScanCamera, model: Calibration) -> None:
    assert camera.covariance is not None
    (x, y), (sx, sy) = camera.pixel_size_m, camera.pixel_size_sigma_m
    sigma = dict(zip(PARAMETER_NAMES, _sigma(camera.covariance), strict=True))
    low, high = model.magnification_range
    click.echo(f"magnification {camera.magnification:g}, image {camera.width} x {camera.height} px")
    click.echo(f"nm per px      {1e9 / camera.m:.4f} (mean of both axes)")
    click.echo(f"  x            {x * 1e9:.4f} +- {sx * 1e9:.4f}")
    click.echo(f"  y            {y * 1e9:.4f} +- {sy * 1e9:.4f}")
    if camera.rho > 0.0:
        click.echo(_matrix("K", camera.K))
        click.echo(_matrix("P", camera.P))
    else:
        click.echo("K, P         parallel projection: no finite focal length")
    click.echo(_matrix("P_affine", camera.P_affine))
    click.echo(f"xi_r         {camera.xi_r:.6g} +- {sigma['xi_r']:.2g}")
    click.echo(f"xi_t         {camera.xi_t:.6g} +- {sigma['xi_t']:.2g}")
    click.echo(
        f"centre px    ({camera.ex:.2f} +- {sigma['ex']:.2f}, {camera.ey:.2f} +- {sigma['ey']:.2f})"
    )
    click.echo(f"1/pivot      {camera.rho:.4g} +- {sigma['rho']:.2g} 1/m")
    if not camera.in_range:
        click.echo(
            f"warning: outside of the calibrated range {low:g} to {high:g}: extrapolated", err=True
        )
