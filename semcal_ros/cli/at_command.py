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

"""``semcal at``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from semcal_ros.calibration import Calibration
from semcal_ros.cli.options import PATH, json_option
from semcal_ros.cli.output import echo_json
from semcal_ros.workflows.describe_camera import describe_camera

__all__ = ["command"]


@click.command("at")
@click.argument("calibration", type=PATH)
@click.argument("magnification", type=float)
@json_option
def command(calibration: Path, magnification: float, as_json: bool) -> None:
    """Camera of CALIBRATION at MAGNIFICATION: K, P, distortion, nm per pixel, with uncertainty.

    \b
    Example:
      semcal at cal.yaml 5250 --json
    """
    described = describe_camera(Calibration.load(calibration), magnification)
    if as_json:
        echo_json(described)
    else:
        _echo_camera(described)


def _format_matrix(name: str, values: Any) -> str:
    rows = [" ".join(f"{v:14.6g}" for v in row) for row in values]
    return "\n".join(f"{name if i == 0 else '':9}[{row}]" for i, row in enumerate(rows))


def _echo_camera(camera: dict[str, Any]) -> None:
    value, sigma = camera["parameters"], camera["parameter_sigma"]
    (x, y), (sx, sy) = camera["pixel_size_m"], camera["pixel_size_sigma_m"]
    click.echo(
        f"magnification {camera['magnification']:g}, "
        f"image {camera['image_width_px']} x {camera['image_height_px']} px"
    )
    click.echo(f"nm per px      {1e9 * camera['mean_pixel_size_m']:.4f} (mean of both axes)")
    click.echo(f"  x            {x * 1e9:.4f} +- {sx * 1e9:.4f}")
    click.echo(f"  y            {y * 1e9:.4f} +- {sy * 1e9:.4f}")
    if camera["K"] is not None:
        click.echo(_format_matrix("K", camera["K"]))
        click.echo(_format_matrix("P", camera["P"]))
    else:
        click.echo("K, P         parallel projection: no finite focal length")
    click.echo(_format_matrix("P_affine", camera["P_affine"]))
    square = camera["rectified"]
    focal = "" if square["K"] is None else f"f {square['K'][0][0]:.6g} px, "
    click.echo(
        f"image_rect   {1e9 * square['pixel_size_m']:.4f} nm per px along both axes, {focal}"
        "principal point ({:.2f}, {:.2f}) px".format(*square["principal_point_px"])
    )
    click.echo(f"xi_r         {value['xi_r']:.6g} +- {sigma['xi_r']:.2g}")
    click.echo(f"xi_t         {value['xi_t']:.6g} +- {sigma['xi_t']:.2g}")
    click.echo(
        f"centre px    ({value['ex']:.2f} +- {sigma['ex']:.2f}, "
        f"{value['ey']:.2f} +- {sigma['ey']:.2f})"
    )
    click.echo(f"1/pivot      {value['rho']:.4g} +- {sigma['rho']:.2g} 1/m")
    if not camera["in_range"]:
        low, high = camera["magnification_range"]
        click.echo(
            f"warning: outside the calibrated range {low:g} to {high:g}: extrapolated", err=True
        )
